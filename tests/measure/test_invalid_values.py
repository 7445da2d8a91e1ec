"""Values of a stream that are not valid are counted once each, by channel and reason."""

from __future__ import annotations

import time

import numpy as np

from teds_provision.measure.blocks import InvalidValues
from teds_provision.measure.clock import ClockMap, Exchange, HostClock, MonotonicStamps, WallClock
from teds_provision.measure.interpreter import NODE_SAYS_SO, StreamInterpreter
from teds_provision.protocol.operation.commands import NOT_VALID
from teds_provision.protocol.operation.stream_commands import StreamKind
from teds_provision.protocol.operation.subscription import StreamMessage, StreamPlan
from teds_provision.teds.calibration import fit
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
