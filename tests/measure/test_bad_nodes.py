"""What bad input gets: nodes with one fault each under one measurement, beside one without; nothing false is published.

They run together, as on a bus: so each is also a disturbance for the others.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.desk import ANGLE
from tests.measure.faulty_node import FAULTS
from tests.measure.rig import FAULTY, Rig, events, of, states

pytestmark = pytest.mark.link
RATE = 20
SCALE = 6.281440 / 65535  # rad: the calibration of these nodes
METRES = 0.110 / 4095  # of the gripper's opening
SECONDS = 8.0
TRIES = 4


@dataclass
class NodeEvents:
    """What the measurement said of one node."""

    lines: list[dict[str, Any]]
    end: dict[str, Any]

    @property
    def states(self) -> list[str]:
        return states(self.lines)

    @property
    def text(self) -> str:
        """Every reason that was given."""
        return " | ".join(line["why"] for line in self.lines if line["event"] == "status")

    @property
    def data(self) -> list[dict[str, Any]]:
        return of(self.lines) or of(self.lines, channel=2)

    @property
    def is_undisturbed(self) -> bool:
        """Whether it was measured from its beginning to the end, and left out a tenth of its messages at most."""
        missing = self.count("lost") + self.count("late")
        return self.states == ["waiting", "running", "ended"] and missing <= 0.1 * self.count("messages")

    def count(self, what: str) -> int:
        """Return a counter over all its streams."""
        return sum(stream[what] for stream in self.end["streams"])


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, NodeEvents]]:
    """What was seen of all of them; once more where the machine itself disturbed the two that must not be disturbed."""
    rig = Rig(tmp_path_factory.mktemp("bad"), {**dict.fromkeys(FAULTS, ANGLE), "out_of_range": "gripper"})
    try:
        for number in range(TRIES):
            found = measured_together(rig, rig.folder / f"bad{number}.jsonl")
            if all(found[name].is_undisturbed for name in ("good", "junk")):
                break
        yield found
    finally:
        rig.close()


def measured_together(rig: Rig, file: Path) -> dict[str, NodeEvents]:
    """Return every node under one measurement, until all that takes its time has happened."""
    process = rig.desk.start(rig.can, *(f"{fault}={rig.nodes[fault].folder}" for fault in FAULTS), program=FAULTY)
    process.wait_for('"ready": true')
    uuids = {rig.nodes[fault].uuid: fault for fault in FAULTS}
    running = rig.begin(*uuids, "--rate", RATE, "--to", file)
    running.wait_for('"event":"data"')
    until = time.monotonic() + SECONDS
    while time.monotonic() < until or not _all_told(running.out, rig.nodes["forgets"].uuid):
        running.read(0.1)
        assert time.monotonic() < until + 60, running.out[-3000:]
    running.signal(signal.SIGTERM)
    outcome = running.end()
    lines = events(outcome.out)
    end = lines[-1]
    assert end["event"] == "end", outcome
    assert outcome.code != 0, "some of them never measured, and the exit code says so"
    process.close()
    return {
        uuids[node["uuid"]]: NodeEvents([line for line in lines if line.get("uuid") == node["uuid"]], node)
        for node in end["nodes"]
    }


def _all_told(text: str, forgetful: str) -> bool:
    """Return True if what takes its time has happened: one is lost, the lying clock told, the forgetful one is back."""
    reported = all(
        words in text for words in ("No message from the node", "its clock is inconsistent", "not authentic")
    )
    return reported and states(of_node(text, forgetful)).count("running") >= 2


def of_node(text: str, uuid: str) -> list[dict[str, Any]]:
    """Return the lines of states of one node."""
    return events("".join(line for line in text.splitlines(keepends=True) if uuid in line and '"status"' in line))


def test_every_fault_is_here_and_the_good_node_is_not_disturbed(seen: dict[str, NodeEvents]) -> None:
    assert set(seen) == set(FAULTS)
    assert len(FAULTS) > 20
    good = seen["good"]
    assert good.states == ["waiting", "running", "ended"]
    assert (good.count("bad"), good.count("invalid")) == (0, 0)
    assert good.count("samples") + good.count("lost") + good.count("late") >= 5 * RATE
    assert good.count("lost") + good.count("late") <= 0.1 * good.count("messages"), good.end
    assert "error" not in good.end


def test_no_value_is_published_that_is_not_the_calibrated_raw_value(seen: dict[str, NodeEvents]) -> None:
    for fault, seen_node in seen.items():
        for line in seen_node.data:
            assert len(line["raw"]) == len(line["value"]) == len(line["valid"]) == len(line["time"])
            for raw, value, valid in zip(line["raw"], line["value"], line["valid"], strict=True):
                assert (value is not None) == valid, fault
                scale = METRES if fault == "out_of_range" else SCALE
                assert value is None or value == pytest.approx(raw * scale, abs=1e-4), fault


def test_times_of_a_node_never_go_back_whatever_it_does(seen: dict[str, NodeEvents]) -> None:
    for fault, seen_node in seen.items():
        times = [instant for line in seen_node.data for instant in line["time"]]
        assert times == sorted(times), fault


@pytest.mark.parametrize("fault", ["wrong_tag", "cut_short", "test_pattern"])
def test_what_is_bad_is_counted_and_nothing_of_it_comes_out(seen: dict[str, NodeEvents], fault: str) -> None:
    result = seen[fault]
    assert result.data == []
    assert result.count("samples") == 0
    if fault != "cut_short":  # a message without its end is no message: it shows as silence
        assert result.count("bad") > RATE
    assert "lost" in result.states, "no good message came: the node is told as lost"


def test_a_message_that_comes_twice_counts_once(seen: dict[str, NodeEvents]) -> None:
    result = seen["replayed"]
    indices = [line["index"] for line in result.data]
    assert len(indices) == len(set(indices))
    assert result.count("late") > RATE


def test_gaps_are_counted_as_lost(seen: dict[str, NodeEvents]) -> None:
    result = seen["gaps"]
    assert result.count("lost") >= 0.2 * result.count("messages"), "every fifth, and what a busy machine costs"
    assert result.states[-1] == "ended"


@pytest.mark.parametrize("fault", ["held_back", "swapped"])
def test_what_comes_too_late_is_counted_as_late(seen: dict[str, NodeEvents], fault: str) -> None:
    result = seen[fault]
    assert result.count("late") > RATE
    if fault == "held_back":
        assert result.data == []


def test_junk_between_messages_harms_no_message(seen: dict[str, NodeEvents]) -> None:
    result = seen["junk"]
    assert result.count("samples") > RATE
    assert result.count("invalid") == 0
    assert result.states == ["waiting", "running", "ended"]


def test_a_node_whose_samples_run_ahead_of_its_clock_is_not_believed(seen: dict[str, NodeEvents]) -> None:
    result = seen["too_fast"]
    assert result.count("bad") > RATE, "from the future"


def test_a_node_whose_samples_fall_behind_is_not_believed(seen: dict[str, NodeEvents]) -> None:
    assert seen["too_slow"].count("late") > 0


@pytest.mark.parametrize("fault", ["jumping_clock", "backward_clock"])
def test_a_clock_that_contradicts_itself_is_reported_and_its_data_claim_no_bound(
    seen: dict[str, NodeEvents], fault: str
) -> None:
    result = seen[fault]
    assert "its clock is inconsistent" in result.text
    assert result.data[-1]["clock_error"] is None, "data of a clock that lies are marked (operation.md section 5)"
    assert seen["good"].data[-1]["clock_error"] is not None


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        ("wrong_length", "octets a message"),
        ("wrong_start", "begins at another time"),
        ("clock_of_tomorrow", "begins at another time"),
        ("refuses_claims", "another station claims"),
    ],
)
def test_a_node_that_contradicts_what_was_agreed_measures_nothing(
    seen: dict[str, NodeEvents], fault: str, why: str
) -> None:
    result = seen[fault]
    assert result.data == []
    assert why in result.text
    assert "running" not in result.states
    assert "error" in result.end


def test_values_beyond_the_limits_are_null_and_the_raw_value_stays(seen: dict[str, NodeEvents]) -> None:
    lines = seen["out_of_range"].data
    raws = [(raw, value) for line in lines for raw, value in zip(line["raw"], line["value"], strict=True)]
    assert {value for raw, value in raws if raw == 65535} == {None}
    assert any(value is not None for _, value in raws)
    assert seen["out_of_range"].count("invalid") > 0


def test_what_the_node_calls_invalid_has_no_value(seen: dict[str, NodeEvents]) -> None:
    result = seen["not_valid"]
    assert result.data
    assert {value for line in result.data for value in line["value"]} == {None}
    assert result.count("invalid") == result.count("samples")


def test_a_node_that_falls_silent_is_lost_and_reported(seen: dict[str, NodeEvents]) -> None:
    result = seen["falls_silent"]
    assert "lost" in result.states
    assert "No message from the node" in result.text


def test_a_node_that_lost_its_sessions_is_measured_on(seen: dict[str, NodeEvents]) -> None:
    result = seen["forgets"]
    assert result.states.count("running") >= 2
    assert result.states[-1] == "ended"


def test_a_datasheet_that_changed_under_way_ends_its_values(seen: dict[str, NodeEvents]) -> None:
    result = seen["another_datasheet"]
    assert result.states.count("running") == 1
    assert "lost" in result.states
    assert "not authentic" in result.text
    lost = next(place for place, line in enumerate(result.lines) if line.get("state") == "lost")
    assert not [line for line in result.lines[lost:] if line["event"] == "data"]
    assert result.end["error"]["code"] == "not-authentic"


def test_random_replies_are_no_news(seen: dict[str, NodeEvents]) -> None:
    result = seen["babbles"]
    assert result.data
    assert result.states[-1] == "ended"
