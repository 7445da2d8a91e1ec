"""What the table of measurements shows of one: its state by the reports of its nodes, and the rate to try."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import StoreError, TedsProvisionError
from teds_provision.measure.running.streams import StreamTotals
from teds_provision.ncap.membership import Member, Membership
from teds_provision.ncap.running_measurement import RunningMeasurement
from teds_provision.station.store.records import KeptMeasurement

NODES = ("aa", "bb", "cc")
FULL = StoreError("The disk is full.")


def running(states: str, *, match: str | None = None, unknown_type: str = "") -> RunningMeasurement:
    """Return a measurement of a node for each letter of ``states``: running, lost, refused, waiting; ``-``: none."""
    words = {"r": "running", "l": "lost", "x": "refused", "w": "waiting"}
    kept = KeptMeasurement("1", match=match)
    members = {uuid: Member() for uuid, _ in zip(NODES, states, strict=False)}
    found = RunningMeasurement(kept, Membership(0.0, members), kept, unknown_type=unknown_type)
    told = zip(NODES, states, strict=False)
    found.reports = {uuid: {"state": words[state], "samples": 7, "lost": 2} for uuid, state in told if state != "-"}
    return found


@pytest.mark.parametrize(
    ("states", "error", "state", "why"),
    [
        ("---", None, "starting", ""),
        ("rr", None, "running", ""),
        ("rl", None, "running", "1 of 2 nodes is missing"),
        ("r--", None, "running", "2 of 3 nodes are missing"),
        ("rxx", FULL, "running", "2 of 3 nodes are missing"),
        ("lx", FULL, "waiting", "The disk is full."),
        ("x", None, "waiting", "1 of 1 node is refused"),
        ("lxx", None, "waiting", "2 of 3 nodes are refused"),
        ("lw", None, "waiting", "no node has answered yet"),
    ],
)
def test_a_measurement_of_listed_nodes_counts_those_that_are_missing_or_refused(
    states: str, error: TedsProvisionError | None, state: str, why: str
) -> None:
    job: Any = SimpleNamespace(error=error)
    assert running(states).present_state(job, 0) == (state, why)


@pytest.mark.parametrize(
    ("states", "error", "taken", "why"),
    [
        ("", None, 0, "no profile is called x"),
        ("l", None, 0, "no matching node is present"),
        ("l", None, 1, "1 matching node is measured by another measurement"),
        ("l", None, 2, "2 matching nodes are measured by another measurement"),
        ("l", FULL, 2, "The disk is full."),
        ("lr", FULL, 2, None),
    ],
)
def test_a_measurement_that_takes_nodes_in_says_what_it_waits_for(
    states: str, error: TedsProvisionError | None, taken: int, why: str | None
) -> None:
    job: Any = SimpleNamespace(error=error)
    found = running(states, match="all", unknown_type="no profile is called x")
    assert found.present_state(job, taken) == (("running", "") if why is None else ("waiting", why))


def test_a_value_of_a_node_that_left_is_none_of_a_measurement_that_takes_nodes_in() -> None:
    found = running("r", match="all")
    found.membership.members.clear()
    job: Any = SimpleNamespace(error=None)
    assert found.present_state(job, 0) == ("waiting", "no matching node is present")


def test_of_streams_that_lose_values_the_slowest_rate_is_proposed() -> None:
    streams = [
        [StreamTotals((1,), 0.01, messages=100), StreamTotals((2,), 0.01, messages=90, lost=10)],
        [StreamTotals((1,), 0.1, messages=90, lost=10)],
    ]
    found = running("rr")
    assert found.lower_rate() is None
    supervisors = [SimpleNamespace(streams=SimpleNamespace(summed=lambda every=every: every)) for every in streams]
    job: Any = SimpleNamespace(measurement=SimpleNamespace(supervisors=supervisors))
    found.job = job
    assert found.lower_rate() == 5.0, "0.8 · 0.9 of 10 Hz; the other stream bears 50"
    supervisors.pop()
    assert found.lower_rate() == 50.0


def test_the_counts_of_all_nodes_are_in_the_log_and_none_of_a_measurement_without_a_node() -> None:
    assert running("rl").counts() == {"samples": 14, "lost": 4}
    assert running("--").counts() == {}
