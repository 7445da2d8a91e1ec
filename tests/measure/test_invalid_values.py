"""Values of a stream that are not valid are counted once each, by channel and reason."""

from __future__ import annotations

import struct
import time
from types import SimpleNamespace

import numpy as np
import pytest

from teds_provision.measure import interpreter as measure_interpreter
from teds_provision.measure.blocks import InvalidValues
from teds_provision.measure.clock import ClockMap, Exchange, HostClock, MonotonicStamps, WallClock
from teds_provision.measure.interpreter import NODE_SAYS_SO, StreamInterpreter
from teds_provision.protocol.operation.commands import NOT_VALID
from teds_provision.protocol.operation.stream_commands import StreamKind
from teds_provision.protocol.operation.subscription import StreamMessage, StreamPlan
from teds_provision.teds.calibration import Calibration, fit
from teds_provision.teds.calibration.model import CalibrationInput
from teds_provision.teds.channel import SampleForm
from tests.teds.test_interpreter import changed, sheet_of

N, MS = 3, 1_000_000
CURVES = {number: fit([(0, 0.0), (1000, 10.0)], "linear", channel=number) for number in (1, 2)}
SHEET = changed(sheet_of("tactile-finger-sensor", CURVES), high=5.0, low=0.0, uncertainty=0.0)
"""Channel 1 measures up to 5, channel 2 as far as its curve goes."""
LOW, HIGH = 100, 900


def interpreter(raw_only: str = "") -> StreamInterpreter:
    plan = StreamPlan.for_channels(0, ((1, 2), (2, 2)), n=N, period=MS, kind=StreamKind.PERIODIC)
    clock, now = ClockMap(), time.monotonic_ns()
    clock.exchange(Exchange(now, now + 2000, 500, 1500, 1, 20))
    return StreamInterpreter(SHEET, plan, 1, clock, HostClock(WallClock(1.8e9)), MonotonicStamps(), raw_only=raw_only)


def message(counter: int, *instants: tuple[int, int], flags: int = 0) -> StreamMessage:
    data = np.array(instants, dtype=">u2").tobytes()
    return StreamMessage(counter, counter * N, 10**9 + counter * N * MS, flags, data)


def reasons(found: tuple[InvalidValues, ...]) -> dict[tuple[int, str], int]:
    assert len({(invalid.channel, invalid.why) for invalid in found}) == len(found)
    return {(invalid.channel, invalid.why): invalid.count for invalid in found}


def test_each_value_counts_once_and_what_the_node_marks_has_no_other_reason() -> None:
    heard = interpreter()
    heard.blocks([message(0, (LOW, LOW), (LOW, LOW), (LOW, LOW))])
    assert heard.invalid == ()
    heard.blocks(
        [
            message(1, (LOW, LOW), (HIGH, LOW), (HIGH, LOW)),
            message(2, (HIGH, LOW), (LOW, LOW), (LOW, LOW), flags=NOT_VALID),  # too high as well: the mark counts
            message(3, (LOW, LOW), (LOW, LOW), (HIGH, LOW)),
        ]
    )
    (limit,) = {why for (_, why) in reasons(heard.invalid)} - {NODE_SAYS_SO}
    assert limit.startswith("above its high limit, 5")
    assert reasons(heard.invalid) == {(1, limit): 3, (1, NODE_SAYS_SO): 3, (2, NODE_SAYS_SO): 3}
    heard.blocks([message(4, (HIGH, HIGH), (LOW, LOW), (LOW, LOW))])
    assert reasons(heard.invalid) == {(1, limit): 4, (1, NODE_SAYS_SO): 3, (2, NODE_SAYS_SO): 3}, "they add up"


def test_a_channel_without_calibration_counts_each_value_under_its_reason() -> None:
    heard = interpreter(raw_only="The datasheet is not signed.")
    heard.blocks([message(0, (LOW, LOW), (LOW, LOW), (LOW, LOW))])
    heard.blocks([message(1, (LOW, LOW), (LOW, LOW), (LOW, LOW), flags=NOT_VALID)])
    assert reasons(heard.invalid) == {
        (1, "The datasheet is not signed"): 6,
        (2, "The datasheet is not signed"): 6,
    }


def test_the_flag_of_a_message_marks_its_instants_alone_and_other_flags_nothing() -> None:
    """operation.md section 3: bit 0 for some value in it, bit 7 a test pattern; others are ignored."""
    heard, good = interpreter(), [(LOW, LOW)] * N
    flagged = [message(0, *good), message(1, *good, flags=0x01), message(2, *good, flags=0x7E)]
    [block] = heard.blocks([*flagged, message(3, *good, flags=0x80)])
    assert block.valid[:, 0].tolist() == [True] * 3 + [False] * 3 + [True] * 3 + [False] * 3
    np.testing.assert_array_equal(np.isnan(block.value), ~block.valid)
    assert block.raw.tolist() == [[LOW, LOW]] * 12, "the raw values are kept"
    [block] = heard.blocks([message(4, *good, flags=0x7E)])
    assert block.valid.all()
    assert reasons(heard.invalid) == {(1, NODE_SAYS_SO): 6, (2, NODE_SAYS_SO): 6}


def test_a_gap_begins_a_new_block_and_ticks_go_on_by_the_period() -> None:
    heard, good = interpreter(), [(LOW, LOW)] * N
    blocks = heard.blocks([message(counter, *good) for counter in (0, 1, 3, 4, 5, 9)])
    assert [(block.index, len(block.time)) for block in blocks] == [(0, 6), (9, 9), (27, 3)]
    assert [block.tick.tolist() for block in blocks] == [
        [10**9 + (block.index + k) * MS for k in range(len(block.time))] for block in blocks
    ]
    assert {(block.run, block.stream, block.channels) for block in blocks} == {(1, 0, (1, 2))}


def test_channels_of_other_widths_stand_one_after_another_in_an_instant() -> None:
    """A Float32 and two octets: 500.5 and 100, 250.25 and 200; the curves give a hundredth."""
    sheet = changed(SHEET, 2, sample=SampleForm(1, 4))
    plan = StreamPlan.for_channels(0, ((2, 4), (1, 2)), n=2, period=MS)
    clock = ClockMap()
    clock.exchange(Exchange(0, 2000, 500, 1500, 1, 20))
    heard = StreamInterpreter(sheet, plan, 1, clock, HostClock(WallClock(1.8e9)), MonotonicStamps())
    data = struct.pack(">fHfH", 500.5, 100, 250.25, 200)
    [block] = heard.blocks([StreamMessage(0, 0, 10**9, 0, data)])
    assert block.channels == (2, 1)
    assert block.raw.tolist() == [[500.5, 100], [250.25, 200]]
    np.testing.assert_allclose(block.value, [[5.005, 1.0], [2.5025, 2.0]], rtol=1e-6)
    assert block.valid.all()


def test_the_age_of_a_block_counts_from_its_last_instant(monkeypatch: pytest.MonkeyPatch) -> None:
    """The node's clock is the host's; the first message has its instants at 1.000, 1.001 and 1.002 s."""
    monkeypatch.setattr(measure_interpreter, "time", SimpleNamespace(monotonic=lambda: 1.010))
    plan = StreamPlan.for_channels(0, ((1, 2), (2, 2)), n=N, period=MS)
    clock = ClockMap()
    clock.exchange(Exchange(0, 2000, 500, 1500, 1, 20))
    heard = StreamInterpreter(SHEET, plan, 1, clock, HostClock(WallClock(1.8e9)), MonotonicStamps())
    good = [(LOW, LOW)] * N
    for messages, age in (([message(0, *good)], 0.008), ([message(1, *good), message(2, *good)], 0.002)):
        [block] = heard.blocks(messages)
        assert block.age == pytest.approx(age, abs=1e-4)
    np.testing.assert_allclose(block.time - 1.8e9, 1.003 + np.arange(6) / 1000, atol=1e-5)


def test_the_clock_error_of_a_block_holds_the_hosts_too_and_a_clock_that_lies_has_none() -> None:
    """operation.md section 5: the bound of an exchange of 2 ms is 1 ms and its step; a lie marks the data."""
    plan = StreamPlan.for_channels(0, ((1, 2), (2, 2)), n=N, period=MS)
    clock, host = ClockMap(), HostClock(WallClock(1.8e9))
    heard = StreamInterpreter(SHEET, plan, 1, clock, host, MonotonicStamps())
    good = [(LOW, LOW)] * N
    errors = []
    clock.arrival(10**9, 2 * 10**9)
    errors.append(heard.blocks([message(0, *good)])[0].clock_error)
    clock.exchange(Exchange(2 * 10**9, 2 * 10**9 + 2 * MS, 10**9 + MS, 10**9 + MS, 1000, 20))
    errors.append(heard.blocks([message(1, *good)])[0].clock_error)
    host.apart = 0.0005
    errors.append(heard.blocks([message(2, *good)])[0].clock_error)
    clock.lie = "its clock was set"
    errors.append(heard.blocks([message(3, *good)])[0].clock_error)
    assert errors == [None, pytest.approx(0.001, rel=0.1), pytest.approx(0.0015, rel=0.1), None]


@pytest.mark.parametrize(("raw", "dtype"), [(2**53 - 1, "float64"), (2**53 + 1, "object"), (2**63 + 1, "object")])
def test_raw_values_of_different_forms_stay_exact(raw: int, dtype: str) -> None:
    """A Float32 beside an integer of 8 octets: from 2^53 on, a Float64 would change it."""
    sheet = changed(changed(SHEET, 2, sample=SampleForm(1, 4)), 1, sample=SampleForm(0, 8))
    plan = StreamPlan.for_channels(0, ((2, 4), (1, 8)), n=1, period=MS)
    clock = ClockMap()
    clock.exchange(Exchange(0, 2000, 500, 1500, 1, 20))
    heard = StreamInterpreter(sheet, plan, 1, clock, HostClock(WallClock(1.8e9)), MonotonicStamps())
    [block] = heard.blocks([StreamMessage(0, 0, 10**9, 0, struct.pack(">fQ", 0.5, raw))])
    assert [int(value) if k else float(value) for k, value in enumerate(block.raw[0])] == [0.5, raw]
    assert block.raw.dtype == np.dtype(dtype)


def test_a_test_pattern_has_no_value_and_counts_none_as_invalid() -> None:
    plan = StreamPlan.for_channels(0, ((1, 2), (2, 2)), n=N, period=MS, kind=StreamKind.PERIODIC, test_pattern=True)
    clock, now = ClockMap(), time.monotonic_ns()
    clock.exchange(Exchange(now, now + 2000, 500, 1500, 1, 20))
    heard = StreamInterpreter(SHEET, plan, 1, clock, HostClock(WallClock(1.8e9)), MonotonicStamps())
    [block] = heard.blocks([message(0, (LOW, LOW), (HIGH, LOW), (LOW, LOW), flags=0x80)])
    assert block.test_pattern
    assert not block.valid.any()
    assert np.isnan(block.value).all()
    assert block.raw.tolist() == [[LOW, LOW], [HIGH, LOW], [LOW, LOW]]
    assert heard.invalid == ()


def test_a_channel_that_needs_one_of_another_stream_has_raw_values_and_those_beside_it_have_theirs() -> None:
    inputs = (CalibrationInput(1, 1, (0, 1000), (0,)), CalibrationInput(2, 1, (0, 1000), (0,)))
    both = Calibration(1, "polynomial", inputs, (0.0, 0.01, 0.001, 0.0), unit=CURVES[1].unit)
    sheet = sheet_of("tactile-finger-sensor", {**CURVES, 1: both})
    clock = ClockMap()
    clock.exchange(Exchange(0, 2000, 500, 1500, 1, 20))
    why = "Channel 1 is compensated by channel 2, which is not part of the same stream."
    third = sheet.channels[2].number
    for numbers, problems in (((1, third), {1: why}), ((1, 2), {})):
        plan = StreamPlan.for_channels(0, tuple((number, 2) for number in numbers), n=1, period=MS)
        heard = StreamInterpreter(sheet, plan, 1, clock, HostClock(WallClock(1.8e9)), MonotonicStamps())
        assert {number: heard.problems[number] for number in heard.problems if number == 1} == problems
        [block] = heard.blocks([StreamMessage(0, 0, 10**9, 0, struct.pack(">HH", 400, 200))])
        assert block.raw.tolist() == [[400, 200]]
        assert block.valid[0, 0] == (not problems)
        if problems:
            assert np.isnan(block.value[0, 0])
            assert reasons(heard.invalid)[1, why.removesuffix(".")] == 1
        else:
            np.testing.assert_allclose(block.value, [[2.4, 2.0]], rtol=1e-6)


def test_a_channel_behind_one_without_values_has_its_own() -> None:
    """One that is compensated keeps the others from being computed side by side: each is computed alone."""
    inputs = (CalibrationInput(2, 1, (0, 1000), (0,)), CalibrationInput(1, 1, (0, 1000), (0,)))
    both = Calibration(2, "polynomial", inputs, (0.0, 0.01, 0.001, 0.0), unit=CURVES[1].unit)
    bare = changed(sheet_of("tactile-finger-sensor", {2: both}), calibration=None, units_stated=True)
    clock = ClockMap()
    clock.exchange(Exchange(0, 2000, 500, 1500, 1, 20))
    plan = StreamPlan.for_channels(0, ((1, 2), (2, 2)), n=1, period=MS)
    heard = StreamInterpreter(bare, plan, 1, clock, HostClock(WallClock(1.8e9)), MonotonicStamps())
    assert set(heard.problems) == {1}
    [block] = heard.blocks([StreamMessage(0, 0, 10**9, 0, struct.pack(">HH", 400, 200))])
    assert block.valid.tolist() == [[False, True]]
    assert block.value[0, 1] == pytest.approx(4.2)
