"""Single values of a node: what is asked of it in which order, and when a reading counts."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import BadDataError, PolicyError
from teds_provision.measure import sample_series, sampling
from teds_provision.measure.sample_series import require_still, take_samples_of
from teds_provision.measure.sampling import Sample, shown_json
from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.protocol.operation.commands import SampleReply
from teds_provision.teds.calibration import fit
from teds_provision.teds.calibration.zero import SampleStatistics
from teds_provision.teds.units import parse_unit
from tests.teds.test_interpreter import sheet_of

SHEET = sheet_of("gripper", {2: fit([(0, 0.0), (4095, 0.11)], "linear", channel=2)})
ACTUATOR, OPENING = 1, 2


class Node:
    """A session whose node gives one raw value after the other; ``course`` is what was asked of it."""

    def __init__(self, raws: list[int], invalid_at: int | None = None) -> None:
        self.raws, self.invalid_at, self.course = raws, invalid_at, list[str]()

    def request(self, _command: object, doing: str) -> bytes:
        self.course.append(doing)
        if doing != "to sample":
            return b""
        taken = self.course.count("to sample") - 1
        flags = 1 if taken == self.invalid_at else 0
        return SampleReply(taken, flags, self.raws[taken].to_bytes(2, "big")).encode()


def session_of(node: Node, monkeypatch: pytest.MonkeyPatch) -> VerifiedSession:
    monkeypatch.setattr(
        sample_series, "claim", lambda _trusted, number, *, lease: node.course.append(f"claim {number} for {lease} s")
    )
    return VerifiedSession(cast(Any, node), SHEET, "00" * 32, "g")


def test_samples_are_spread_over_half_a_second_and_the_sensor_is_released(monkeypatch: pytest.MonkeyPatch) -> None:
    """32 of them: so mains hum averages out, and a slow movement shows."""
    now, moments = [100.0], list[float]()

    def sleep(seconds: float) -> None:
        now[0] += seconds
        moments.append(round(now[0] - 100.0, 4))

    monkeypatch.setattr(sample_series, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
    node = Node([100 + number for number in range(32)])
    series = take_samples_of(session_of(node, monkeypatch), OPENING)
    assert series.raw.tolist() == [100 + number for number in range(32)]
    assert moments == [round(number * 0.5 / 31, 4) for number in range(32)]
    assert node.course == ["claim 2 for 10 s", *["to sample"] * 32, "to let go"]
    assert series.others == {}
    assert not series.extrapolated


def test_a_reading_that_the_node_marks_is_refused_and_the_sensor_released(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample_series, "time", SimpleNamespace(monotonic=lambda: 0.0, sleep=lambda _seconds: None))
    node = Node([1, 2, 3, 4], invalid_at=2)
    with pytest.raises(PolicyError, match="The node marks the reading of channel 2 as invalid"):
        take_samples_of(session_of(node, monkeypatch), OPENING, count=4)
    assert node.course[-2:] == ["to sample", "to let go"]
    node.course.clear()
    with pytest.raises(BadDataError, match="is an actuator, not a sensor"):
        take_samples_of(session_of(node, monkeypatch), ACTUATOR)
    assert node.course == []


@pytest.mark.parametrize(
    ("spread", "drift", "stated", "words"),
    [
        (0.9, 0.9, 1.0, ""),
        (1.1, 0.5, 1.0, "spreads by 1.1; 1 is allowed"),
        (0.5, -1.1, 1.0, "drifts by 1.1; 1 is allowed"),
        (1.2, 1.2, 1.0, "spreads by 1.2; 1 is allowed"),
        (0.09, 0.0, 0.0, ""),
        (0.11, 0.0, 0.0, "spreads by 0.11; 0.1 is allowed"),
        (0.11, 0.0, float("nan"), "spreads by 0.11; 0.1 is allowed"),
    ],
)
def test_a_reading_is_still_within_its_uncertainty_or_else_a_hundredth_of_its_range(
    spread: float, drift: float, stated: float, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    reading = SampleStatistics(5.0, spread, drift, 32)
    monkeypatch.setattr(sample_series, "reading_of", lambda _values, _turn: reading)
    monkeypatch.setattr(sample_series, "turn_of", lambda _own, *, full_turn: 0.0)
    unit = SimpleNamespace(difference_from_si=lambda number: number, difference_to_si=lambda number: number)
    channel = SimpleNamespace(
        number=3,
        calibration=SimpleNamespace(unit=unit),
        full_turn=False,
        low=5.0,
        high=-5.0,
        stated_uncertainty=stated,
        show=lambda amount, *, difference: f"{amount:g}",
    )
    series: Any = SimpleNamespace(interpreter=SimpleNamespace(channel=channel), calibrated=lambda: None)
    if not words:
        assert require_still(series) is reading
        return
    with pytest.raises(PolicyError, match=f"Channel 3 is not steady: its reading {words}"):
        require_still(series)


def test_a_sample_is_shown_with_what_is_known_of_it() -> None:
    """As `sample --json` prints it: SI, and beside it what people read."""
    celsius = parse_unit("degC")
    whole = Sample(
        2, "oil", 293.15, "K", 77, 0.5, valid=True, time=5.0, shown=celsius, text="warm", why="by the way", turn=0.0
    )
    assert whole.as_json() == {
        "channel": 2, "name": "oil", "value": 293.15, "unit": "K", "raw": 77, "uncertainty": 0.5, "valid": True,
        "shown": {"value": pytest.approx(20.0), "unit": celsius.text, "uncertainty": 0.5},
        "time": 5.0, "text": "warm", "why": "by the way",
    }  # fmt: skip
    bare = Sample(2, "oil", None, "K", 77, None, valid=False, time=5.0)
    assert bare.as_json() == {
        "channel": 2, "name": "oil", "value": None, "unit": "K", "raw": 77, "uncertainty": None, "valid": False,
        "time": 5.0,
    }  # fmt: skip
    millimetres = parse_unit("mm")
    assert shown_json(None, None, millimetres) == {"value": None, "unit": "mm", "uncertainty": None}
    assert shown_json(0.02, 0.001, millimetres) == {"value": 20.0, "unit": "mm", "uncertainty": 1.0}


@pytest.mark.parametrize(
    ("octets", "parts"),
    [
        ([90, 90], [[0, 1]]),
        ([90, 91], [[0], [1]]),
        ([200, 1, 179, 1], [[0], [1, 2], [3]]),
        ([1] * 65, [list(range(64)), [64]]),
    ],
)
def test_channels_are_sampled_together_as_far_as_a_reply_of_any_node_holds_them(
    octets: list[int], parts: list[list[int]]
) -> None:
    """180 octets of data, and 64 channels (operation.md): a longer one is asked for alone."""
    interpreters = {number: cast(Any, SimpleNamespace(octets=size)) for number, size in enumerate(octets)}
    assert sampling._parts(interpreters) == parts
