"""Strangers' nodes that break the rules of what they send, all of them under one measurement beside good ones.

What is published is held against what a stranger's sensor shows: the millisecond of its tick.
"""

from __future__ import annotations

import itertools
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest

from tests.e2e.desk import ANGLE
from tests.measure.rig import Rig, events, of, states
from tests.pace import until
from tests.strangers.test_node import StrangerNode
from tests.strangers.troublemaker import TROUBLES

pytestmark = pytest.mark.link
RATE = 10  # Hz
VICTIM, FREE = "victim", [name for name in TROUBLES if "tick" in name]
ORDER = ["", VICTIM, "from another node", *(name for name in TROUBLES if name not in ("", "from another node"))]
NEVER = "says it is another node"
COUNTED = {
    "longer": "bad", "shorter": "bad", "twice the instants": "bad", "no instants": "bad",
    "empty frames": "bad", VICTIM: "bad",
    "begins again": "late", "stands still": "late", "counts down": "late", "leaps": "bad",
    "ticks jump ahead": "bad", "ticks jump back": "late", "ticks of 32 bits": "late",
    "every second tick is the one before": "bad", "ticks at the end": "bad",
    "data before the reply": "bad",
}  # fmt: skip
NOTHING = {
    "longer", "shorter", "twice the instants", "no instants", "of another stream", "to another station",
    "from another node", "ticks of 32 bits", "ticks at the end", NEVER,
}  # fmt: skip
UNDISTURBED = ["", "goes on after Stop", "announces itself as others", "empty frames", "data before the reply"]


@dataclass
class NodeEvents:
    """What the measurement said of one node."""

    lines: list[dict[str, Any]]
    end: dict[str, Any]

    @property
    def samples(self) -> list[tuple[float, int, float | None]]:
        """Time, raw value and the bound of the time's error, in the order in which they were published."""
        return [
            (moment, value, line["clock_error"])
            for line in of(self.lines)
            for moment, value in zip(line["time"], line["raw"], strict=True)
        ]

    def count(self, what: str) -> int:
        return sum(stream[what] for stream in self.end["streams"])


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, NodeEvents]]:
    names = {f"t{number}": name for number, name in enumerate(ORDER)}
    rig = Rig(tmp_path_factory.mktemp("troubles"), dict.fromkeys(names, ANGLE))
    try:
        nodes = {name: StrangerNode(rig, place, True, 0x41 + int(place[1:])) for place, name in names.items()}
        others = [nodes[name].uuid for name in ("", VICTIM)]
        plans = [node.plan("" if name == VICTIM else name, others=others) for name, node in nodes.items()]
        crowd = rig.desk.start(*plans, program=(sys.executable, "-m", "tests.strangers.troublemaker"))
        crowd.wait_for('"ready": true')
        found: dict[str, NodeEvents] = {}
        for names_of, words in (([name for name in ORDER if name not in FREE], ()), (["", *FREE], ("--kind", "free"))):
            found |= measured(rig, {name: nodes[name].uuid for name in names_of}, *words)
        yield found
    finally:
        rig.close()


def measured(rig: Rig, uuids: dict[str, str], *words: object) -> dict[str, NodeEvents]:
    running = rig.begin(*uuids.values(), "--rate", RATE, *words)

    def enough() -> bool:
        running.read(0.1)
        lines = events(running.out)
        states_of = {name: states([line for line in lines if line.get("uuid") == uuid]) for name, uuid in uuids.items()}
        again = states_of.get("claims go", []).count("running") > 1 and "refused" in states_of["datasheet goes"]
        rest = "claims go" not in uuids or again
        return rest and len(of(lines, uuids[""])) > 6 * RATE

    until(enough, lambda: "\n".join(str(line) for line in events(running.out) if line["event"] == "status")[-20_000:])
    running.signal(signal.SIGTERM)
    lines = events(running.end().out)
    ends = {node["uuid"]: node for node in lines[-1]["nodes"]}
    return {
        name: NodeEvents([line for line in lines if line.get("uuid") == uuid], ends[uuid])
        for name, uuid in uuids.items()
    }


def test_every_trouble_is_here(seen: dict[str, NodeEvents]) -> None:
    assert set(seen) == {*TROUBLES, VICTIM}
    assert len(TROUBLES) > 20


@pytest.mark.parametrize("name", ORDER)
def test_every_value_that_was_published_is_what_the_sensor_showed_then(seen: dict[str, NodeEvents], name: str) -> None:
    samples = seen[name].samples
    assert bool(samples) != (name in NOTHING)
    for (before, low, error), (after, high, other) in itertools.pairwise(samples):
        assert after > before
        apart = (after - before) * 1000
        if apart < 60_000 and error is not None and other is not None:
            bounds = 1000 * (error + other) + 1  # the sensor shows whole milliseconds
            assert abs(apart - (high - low) % 65536) <= bounds, "milliseconds by stamp and by sensor"


def test_a_bound_of_the_error_is_claimed_if_the_clock_is_good(seen: dict[str, NodeEvents]) -> None:
    known = [error for name in UNDISTURBED for _, _, error in seen[name].samples]
    assert known
    assert None not in known


@pytest.mark.parametrize("name", COUNTED)
def test_what_is_not_believed_is_counted(seen: dict[str, NodeEvents], name: str) -> None:
    assert seen[name].count(COUNTED[name]) > 0, seen[name].end


@pytest.mark.parametrize("name", [*UNDISTURBED, VICTIM])
def test_who_keeps_to_the_rules_is_measured_on(seen: dict[str, NodeEvents], name: str) -> None:
    result = seen[name]
    assert "lost" not in states(result.lines)
    assert result.count("samples") + result.count("lost") + result.count("late") >= 3 * RATE
    assert name in COUNTED or result.count("bad") == 0


def test_a_datasheet_that_changed_under_its_session_gives_no_value_in_the_next_one(seen: dict[str, NodeEvents]) -> None:
    result = seen["datasheet goes"]
    assert states(result.lines).count("running") == 1
    assert result.end["error"]["code"] == "not-authentic"


def test_claims_that_a_node_lost_are_claimed_again(seen: dict[str, NodeEvents]) -> None:
    assert states(seen["claims go"].lines).count("running") > 1
