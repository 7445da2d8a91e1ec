"""Single values of a node: what is asked of it in which order, and when a reading counts."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from teds_provision.errors import BadDataError, PolicyError
from teds_provision.measure import sample_series, sampling
from teds_provision.measure.capture import _point
from teds_provision.measure.clock import ClockMap, Exchange, WallClock
from teds_provision.measure.sample_series import SampleSeries, require_still, take_samples_of
from teds_provision.measure.sampling import Sample, shown_json
from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.measure.zero import ZeroOrder, _ZeroRun
from teds_provision.protocol.messages.frames import Command
from teds_provision.protocol.operation.commands import SampleReply
from teds_provision.teds import Sheet
from teds_provision.teds.calibration import Calibration, CalibrationInput, ChannelInterpreter, fit
from teds_provision.teds.calibration.points import Point
from teds_provision.teds.calibration.samples import DataModel, SampleForm
from teds_provision.teds.calibration.zero import SampleStatistics
from teds_provision.teds.units import parse_unit
from tests.teds.test_interpreter import changed, sheet_of

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


TEMPERATURE = sheet_of("temperature-sensor", {1: replace(fit([(0, -40.0), (21120, 125.0)], "linear", channel=1),
                                                         unit=parse_unit("degC"))})  # fmt: skip
TURNING = sheet_of("magnetic-angular-position-sensor", {1: replace(fit([(0, 0.0), (65536, 360.0)], "linear", channel=1),
                                                                   unit=parse_unit("degree"))})  # fmt: skip


@pytest.mark.parametrize(
    ("sheet", "value", "unit", "wanted"),
    [
        (TEMPERATURE, 20.0, "degC", 20.0),
        (TEMPERATURE, 293.15, "K", 20.0),
        (TEMPERATURE, -40.4, "degC", -40.4),  # the stated uncertainty is 0.5 K
        (TEMPERATURE, -40.6, "degC", None),
        (TEMPERATURE, 125.4, "degC", 125.4),
        (TEMPERATURE, 125.6, "degC", None),
        (TURNING, 450.0, "degree", 450.0),  # a turn has no end
        (TURNING, -math.pi, "rad", -180.0),
    ],
)
def test_the_value_that_a_zero_asks_for_is_within_the_limits_in_any_unit(
    sheet: Sheet, value: float, unit: str, wanted: float | None
) -> None:
    channel = sheet.channels[0]
    assert channel.calibration is not None
    run: Any = SimpleNamespace(order=ZeroOrder(1, value, unit, shown_unit_asked=False))
    if wanted is not None:
        assert _ZeroRun._wanted(run, channel, channel.calibration) == pytest.approx(wanted)
        return
    with pytest.raises(PolicyError, match=r"exceeds the limits of channel 1 \(temperature\), -40 degC to 125 degC"):
        _ZeroRun._wanted(run, channel, channel.calibration)


@pytest.mark.parametrize(
    ("sheet", "raws", "why"),
    [
        (TURNING, [100, 104], ""),
        (TURNING, [0, 65535], "is at the wrap of its raw values"),
        (TURNING, [0, 32800], "is at the wrap of its raw values"),
        (TURNING, [0, 32700], "is not steady"),
        (TURNING, [100, 400], "is not steady"),  # the stated uncertainty is 1 degree, 182 raw values
        (TEMPERATURE, [0, 21120], "is not steady"),
        (sheet_of("magnetic-angular-position-sensor"), [100, 400], ""),  # nothing to read it by
        (sheet_of("magnetic-angular-position-sensor"), [0, 65535], "is at the wrap of its raw values"),
    ],
)
def test_samples_of_one_place_give_a_point(sheet: Sheet, raws: list[int], why: str) -> None:
    series = SampleSeries(ChannelInterpreter(sheet, 1), np.array(raws, dtype=np.uint64), {})
    if not why:
        assert _point(series, 1.5) == Point(1, sum(raws) / 2, 1.5, (raws[1] - raws[0]) / 2, 2)
        return
    with pytest.raises(PolicyError, match=why):
        _point(series, 1.5)


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


class SampledNode:
    """A node that answers Sample with these raw values and the flags of each channel; one channel a reply."""

    def __init__(self, raws: dict[int, int], marked: set[int]) -> None:
        self.raws, self.marked, self.course = raws, marked, list[str]()

    def request(self, command: Command, doing: str) -> bytes:
        self.course.append(f"{doing} {command.payload.hex()}".strip())
        if doing != "to sample":
            return b""
        number = command.payload[0]
        return SampleReply(number * 10**9, number in self.marked, self.raws[number].to_bytes(2, "big")).encode()


@pytest.mark.parametrize(
    ("raws", "marked", "lie", "why"),
    [
        ({1: 5000, 2: 10}, set(), "", ""),
        ({1: 5000, 2: 10}, set(), "its clock was set", ""),
        ({1: 5000, 2: 10}, {1}, "", "the node marks it as invalid"),
        ({1: 5000, 2: 10}, {2}, "", "the node marks it as invalid"),
        ({1: 5000, 2: 4096}, set(), "", "the raw value is none that the channel can give"),
        ({1: 4096, 2: 4096}, {2}, "", "the node marks it as invalid"),
    ],
)
def test_a_compensated_sample_is_valid_if_every_reading_that_it_takes_is(
    raws: dict[int, int], marked: set[int], lie: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its time is that of its own reply by the node's clock, or of its arrival if that clock is dishonest."""
    inputs = (CalibrationInput(1, 1, (0, 65535), (0,)), CalibrationInput(2, 1, (0, 65535), (0,)))
    both = Calibration(1, "polynomial", inputs, (0.0, 0.0001, 0.0005, 0.0), unit=parse_unit("N"))
    sheet = changed(sheet_of("tactile-finger-sensor", {1: both}), 2, sample=SampleForm(DataModel.UNSIGNED, 2, 12))
    node = SampledNode(raws, marked)

    def exchange(_node: object, clock: ClockMap) -> None:
        node.course.append("clock")
        assert clock.exchange(Exchange(50 * 10**9, 50 * 10**9, 0, 0, 1, 20)), clock.lie
        clock.lie = lie

    monkeypatch.setattr(sampling, "exchange_clock", exchange)
    monkeypatch.setattr(
        sampling, "claim", lambda _trusted, number, *, lease: node.course.append(f"claim {number} for {lease} s")
    )
    monkeypatch.setattr(WallClock, "now", lambda: WallClock(1000.0))
    monkeypatch.setattr(sampling, "time", SimpleNamespace(time=lambda: 7000.0))
    monkeypatch.setattr(sampling, "ROOM", 2)
    trusted = VerifiedSession(cast(Any, node), sheet, "00" * 32, "finger")
    [found] = sampling.take_samples(trusted, [1])
    assert node.course == [
        "clock", "clock", "clock", "claim 1 for 5 s", "claim 2 for 5 s", "to sample 01", "to sample 02", "to let go",
    ]  # fmt: skip
    assert (found.channel, found.raw, found.valid, found.why) == (1, raws[1], not why, why)
    assert found.value == (None if why else pytest.approx(2.501, abs=1e-6))
    assert found.time == pytest.approx(7000.0 if lie else 1051.0, abs=1e-3)


def test_the_text_of_a_raw_number_is_that_of_a_valid_one_and_only_a_full_turn_has_a_beginning() -> None:
    def sampled(raw: int, *, good: bool, **facts: Any) -> Sample:
        sheet = changed(SHEET, 2, value_table={0: "closed", 4095: "open", 5000: "never"}, **facts)
        return sampling._sample(ChannelInterpreter(sheet, 2), {2: np.array([raw], dtype=np.uint64)}, {2: good}, 1.0)

    assert [sampled(raw, good=True).text for raw in (0, 1, 4095, 5000)] == ["closed", "", "open", ""]
    assert sampled(0, good=False).text == ""
    assert sampled(0, good=True).turn is None
    radians = parse_unit("rad").units
    assert sampled(0, good=True, units=radians, low=-math.pi, high=math.pi).turn == -math.pi
    assert sampled(0, good=True, units=radians, low=-math.pi, high=0.0).turn is None


def test_channels_of_one_reply_are_cut_apart_and_each_says_why_it_has_no_value(monkeypatch: pytest.MonkeyPatch) -> None:
    """Channel 1 is calibrated, 2 is not, 3 needs a channel that the datasheet lacks; all come in one reply."""
    inputs = (CalibrationInput(3, 1, (0, 65535), (0,)), CalibrationInput(60, 1, (0, 65535), (0,)))
    lacking = Calibration(3, "polynomial", inputs, (0.0, 0.0, 0.001, 0.0), unit=parse_unit("N"))
    line = replace(fit([(0, 0.0), (10_000, 10.0)], "linear", channel=1), unit=parse_unit("N"))
    sheet = sheet_of("tactile-finger-sensor", {1: line, 3: lacking})
    course = list[str]()

    def request(command: Command, doing: str) -> bytes:
        course.append(f"{doing} {command.payload.hex()}".strip())
        if doing != "to sample":
            return b""
        return SampleReply(10**9, 0, b"".join((100 * number).to_bytes(2, "big") for number in command.payload)).encode()

    monkeypatch.setattr(sampling, "exchange_clock", lambda _node, _clock: None)
    monkeypatch.setattr(sampling, "claim", lambda *_, lease: None)
    trusted = VerifiedSession(cast(Any, SimpleNamespace(request=request)), sheet, "00" * 32, "finger")
    found = sampling.take_samples(trusted, [3, 1, 2])
    assert course == ["to sample 030102", "to let go"]
    assert [(one.channel, one.raw, one.valid) for one in found] == [(3, 300, False), (1, 100, True), (2, 200, False)]
    assert found[1].value == pytest.approx(0.1)
    assert [one.value for one in found[::2]] == [None, None]
    assert found[0].why == "Channel 3 is compensated by channel 60, which is not described."
    assert found[2].why.startswith("Channel 2 has no calibration")
    assert found[1].why == ""
