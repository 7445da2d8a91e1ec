"""What a station believes of a stream: each cause of a drop counted apart; clocks and triggers (section 3, 5)."""

from __future__ import annotations

import dataclasses

import pytest

from teds_provision.errors import GarbledError, NotAuthenticError
from teds_provision.protocol.operation.budget import MOST_OCTETS
from teds_provision.protocol.operation.commands import TEST_PATTERN
from teds_provision.protocol.operation.datagram import DatagramSealer, Layout, drive_key, stream_key
from teds_provision.protocol.operation.driving import Driver
from teds_provision.protocol.operation.stream_commands import (
    NONE,
    SOON,
    WAITS,
    Action,
    ClockReply,
    DriveReply,
    StreamKind,
    SubscribeReply,
)
from teds_provision.protocol.operation.subscription import (
    MOST_HELD,
    Counts,
    Receiver,
    StreamMessage,
    StreamPlan,
    TickBounds,
    most_instants,
)
from teds_provision.protocol.operation.timing import ClockSample, TriggerToken, mark_is_honest

MS = 1_000_000
K_M = bytes(range(32))
START = 3000 * MS
LATER = TickBounds(START + 100 * MS, START + 100 * MS)


def plan(**changes: object) -> StreamPlan:
    asked: dict[str, object] = {"n": 2, "period": 10 * MS} | changes
    return StreamPlan.for_channels(0, ((1, 2),), **asked)  # type: ignore[arg-type]


def receiver(run: int = 1, *, start: int = START, previous: Receiver | None = None, **changes: object) -> Receiver:
    made = plan(**changes)
    return Receiver(made, SubscribeReply(run, made.length, start), K_M, previous=previous)


def sealed(counter: int, run: int = 1, *, flags: int = 0, body: bytes = bytes(4)) -> bytes:
    return DatagramSealer(stream_key(K_M, run)).seal(counter, bytes([flags]) + body)


def counted(taker: Receiver, **counts: int) -> None:
    assert dataclasses.asdict(taker.counts) == dataclasses.asdict(Counts(**counts))


def test_good_messages_carry_index_and_tick() -> None:
    taker = receiver()
    assert taker.open_message(sealed(0, body=b"abcd"), LATER) == StreamMessage(0, 0, START, 0, b"abcd")
    found = taker.open_message(sealed(3), LATER)
    assert found is not None
    assert (found.index, found.tick) == (6, START + 60 * MS)
    counted(taker, good=2, lost=2)


def test_each_cause_is_counted_apart_and_each_message_once() -> None:
    taker = receiver()
    first = sealed(5)
    assert taker.open_message(first, LATER) is not None
    counted(taker, good=1, lost=5)
    assert taker.open_message(first, LATER) is None
    assert taker.open_message(sealed(4), LATER) is None
    counted(taker, good=1, lost=5, late=2)
    assert taker.open_message(sealed(6)[:-1], LATER) is None
    counted(taker, good=1, lost=5, late=2, junk=1)
    bent = bytearray(sealed(9))
    bent[-1] ^= 1
    assert taker.open_message(bytes(bent), LATER) is None
    assert taker.last == 5, "only a good tag changes anything"
    counted(taker, good=1, lost=5, late=2, junk=1, bad=1)
    assert taker.open_message(sealed(6, flags=TEST_PATTERN), LATER) is None
    counted(taker, good=1, lost=5, late=2, junk=1, bad=1, unasked=1)
    taker.finish(9)
    counted(taker, good=1, lost=7, late=2, junk=1, bad=1, unasked=1)


def test_a_measurement_in_place_of_a_test_pattern_is_unasked_too() -> None:
    taker = receiver(test_pattern=True)
    assert taker.open_message(sealed(0), LATER) is None
    counted(taker, unasked=1)


def test_messages_of_an_earlier_run_are_dropped_and_not_counted() -> None:
    before = receiver(1)
    taker = receiver(2, previous=before)
    assert taker.open_message(sealed(7, 1), LATER) is None
    counted(taker)
    assert taker.open_message(sealed(7, 3), LATER) is None
    counted(taker, bad=1)


def test_a_message_from_the_future_or_held_back_is_dropped() -> None:
    """Counter 0 begins at START and ends at START + 10 ms; it may be 2 · 20 + 200 ms old."""
    first = sealed(0)
    for now, cause in [
        (TickBounds(START - 50 * MS, START - 1), "future"),
        (TickBounds(START - 50 * MS, START), "good"),
        (TickBounds(START + 250 * MS, START + 900 * MS), "good"),
        (TickBounds(START + 250 * MS + 1, START + 900 * MS), "stale"),
    ]:
        taker = receiver()
        assert (taker.open_message(first, now) is not None) is (cause == "good")
        counted(taker, **{cause: 1})


def test_the_consumer_may_set_another_age() -> None:
    made = plan()
    taker = Receiver(made, SubscribeReply(1, made.length, START), K_M, oldest=5 * MS)
    assert taker.open_message(sealed(0), TickBounds(START + 16 * MS, START + 16 * MS)) is None
    counted(taker, stale=1)


def test_messages_are_held_until_the_mark_is_read() -> None:
    taker = receiver(start=WAITS)
    for counter in range(MOST_HELD + 2):
        assert taker.open_message(sealed(counter), LATER) is None
    early, *rest = taker.begin(START + 100 * MS - 40 * MS)
    assert (early.counter, early.tick) == (2, START + 100 * MS)
    assert rest == [], "the others came before their first tick: from the future"
    assert taker.counts.overflow == 2
    assert taker.counts.future == MOST_HELD - 1
    late = TickBounds(START + 3000 * MS, START + 3000 * MS)
    assert taker.open_message(sealed(140), late) is not None, "from now on they are handed on at once"


def test_events_and_free_streams_carry_their_tick() -> None:
    taker = receiver(kind=StreamKind.EVENT, n=1)
    found = taker.open_message(sealed(4, body=START.to_bytes(8, "big") + b"ab"), LATER)
    assert found == StreamMessage(4, 4, START, 0, b"ab")
    waiting = receiver(start=WAITS, kind=StreamKind.FREE)
    assert waiting.open_message(sealed(0, body=START.to_bytes(8, "big") + b"abcd"), LATER) is not None


@pytest.mark.parametrize("kind", [StreamKind.EVENT, StreamKind.FREE])
def test_ticks_of_messages_that_do_not_go_forward_are_counted_and_not_believed(kind: StreamKind) -> None:
    """Stamps never go back, so such samples were handed on with the time of the ones before."""
    taker = receiver(kind=kind, n=1)
    ticks = (0, 10, 10, 3, 20)
    messages = [sealed(k, body=(START + at * MS).to_bytes(8, "big") + b"ab") for k, at in enumerate(ticks)]
    found = [opened.tick - START if (opened := taker.open_message(octets, LATER)) else None for octets in messages]
    assert found == [0, 10 * MS, None, None, 20 * MS]
    counted(taker, good=3, back=2)


@pytest.mark.parametrize("jump", [2**31, -(2**31), 2**63, -START])
def test_a_tick_that_jumps_is_no_time_of_a_sample(jump: int) -> None:
    taker = receiver(kind=StreamKind.FREE, n=1)
    lie = ((START + jump) % 2**64).to_bytes(8, "big")
    for counter, tick in enumerate((START.to_bytes(8, "big"), lie, (START + 10 * MS).to_bytes(8, "big"))):
        taker.open_message(sealed(counter, body=tick + b"ab"), LATER)
    counted(taker, good=2, **{"future" if jump > 0 else "stale": 1})


# -- the plan ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "start", "good"),
    [
        (SOON, START, True),
        (SOON, START + 1000 * MS, True),
        (SOON, START + 1000 * MS + 1, False),
        (SOON, START - 1000 * MS - 1, False),
        (SOON, WAITS, False),
        (START + 5, START + 5, True),
        (START + 5, START + 6, False),
        (WAITS, WAITS, True),
        (WAITS, START, False),
    ],
)
def test_a_start_that_was_not_asked_is_reported(asked: int, start: int, good: bool) -> None:
    made, now = plan(start=asked), TickBounds(START, START)
    reply = SubscribeReply(1, made.length, start).encode()
    if good:
        assert made.accept(reply, now).start == start
    else:
        with pytest.raises(NotAuthenticError, match="another time"):
            made.accept(reply, now)


def test_a_length_that_was_not_computed_is_reported() -> None:
    made = plan()
    for length in (18, 16):
        with pytest.raises(NotAuthenticError, match=f"{length} octets a message; 17"):
            made.accept(SubscribeReply(1, length, START).encode(), LATER)
    with pytest.raises(NotAuthenticError, match="run 0"):
        made.accept(SubscribeReply(0, 17, START).encode(), TickBounds(START, START))
    with pytest.raises(GarbledError):
        made.accept(bytes(11), LATER)


def test_a_run_that_was_there_before_is_reported() -> None:
    """Its key is that of the run before, so messages of that one would count again."""
    made, now = plan(), TickBounds(START, START)
    assert made.accept(SubscribeReply(4, made.length, START).encode(), now, after=3).run == 4
    for run in (3, 2):
        with pytest.raises(NotAuthenticError, match=f"run {run} after run 3"):
            made.accept(SubscribeReply(run, made.length, START).encode(), now, after=3)
    layout = Layout((1,), (2,))
    with pytest.raises(NotAuthenticError, match="run 3 after run 3"):
        Driver(layout, DriveReply(3, 18), K_M, dead_man=100, after=3)
    assert Driver(layout, DriveReply(4, 18), K_M, dead_man=100, after=3).run == 4


def test_how_many_instants_fit() -> None:
    assert [most_instants(StreamKind.PERIODIC, octets) for octets in (1, 2, 6, 227, 228, 0)] == [227, 113, 37, 1, 0, 0]
    assert most_instants(StreamKind.FREE, 2) == 109
    assert most_instants(StreamKind.EVENT, 2) == 1
    assert most_instants(StreamKind.PERIODIC, 2, most=23 - 4) == 3, "BLE with an MTU of 23"
    assert most_instants(StreamKind.EVENT, 1, most=23 - 4) == 0
    assert plan(n=113).fits
    assert not plan(n=114).fits
    assert plan(n=113).length == MOST_OCTETS - 1
    exactly = StreamPlan.for_channels(0, ((1, 1),), n=227, period=MS)
    assert (exactly.length, exactly.fits) == (MOST_OCTETS, True)


# -- clock -------------------------------------------------------------------------------------------------------------


def clock(received: int, sent: int) -> ClockReply:
    return ClockReply(received, sent, 0, 1000, 50, NONE)


def test_a_clock_that_lies_is_caught() -> None:
    with pytest.raises(NotAuthenticError, match="lies"):
        ClockSample(0, 10 * MS, clock(5 * MS, 5 * MS - 1))
    with pytest.raises(NotAuthenticError, match="lies"):
        ClockSample(0, 10 * MS, clock(0, 10 * MS + 1))
    ClockSample(0, 10 * MS, clock(0, 10 * MS))


def test_delay_makes_the_bound_worse_and_never_wrong() -> None:
    true = 500 * MS  # node's tick = station's time + true
    for there, back in [(0, 0), (3 * MS, 1 * MS), (0, 90 * MS), (90 * MS, 0)]:
        seen = ClockSample(0, there + back, clock(true + there, true + there))
        assert abs(seen.offset - true) <= seen.error(there + back)
        bounds = seen.tick(there + back)
        assert bounds.low <= true + there + back <= bounds.high


def test_the_bound_grows_with_the_drift_of_both_clocks() -> None:
    first = ClockSample(0, 2 * MS, clock(501 * MS, 501 * MS))
    assert first.error(1002 * MS, own_drift=50) == 1 * MS + 1000 + 100 * 1000


def test_tokens_are_new_each_time_and_marks_are_held_against_the_frame() -> None:
    first, other = TriggerToken.draw(), TriggerToken.draw()
    assert first.octets != other.octets
    assert len(first.octets) == 8
    assert first.arm(Action.STOP, 5).commitment == first.commitment != other.commitment
    seen = TickBounds(START, START + MS)
    marks = (START - 1, START, START + MS, START + MS + 1)
    assert [mark_is_honest(mark, seen) for mark in marks] == [False, True, True, False]


# -- Drive -------------------------------------------------------------------------------------------------------------


def test_a_drive_message_holds_no_longer_than_the_dead_man() -> None:
    driver = Driver(Layout((4,), (2,)), DriveReply(3, 18), K_M, dead_man=50)
    opener = DatagramSealer(drive_key(K_M, 3))
    for hold, until in [(None, 50), (20 * MS, 20), (80 * MS, 50)]:
        plain = opener.open(driver.seal((b"ab",), TickBounds(START, START + 5 * MS), hold=hold))
        assert plain is not None
        assert int.from_bytes(plain[:4], "big") == (START + until * MS) // 1000
    assert driver.next == 3
    with pytest.raises(GarbledError, match="widths"):
        driver.seal((b"abc",), LATER)
    driver.next = 1 << 32
    with pytest.raises(GarbledError, match="used up"):
        driver.seal((b"ab",), LATER)
    with pytest.raises(NotAuthenticError, match="19 octets; 18"):
        Driver(Layout((4,), (2,)), DriveReply(3, 19), K_M, dead_man=50)


@pytest.mark.parametrize(
    ("wanted", "lost", "cut"), [(None, 3, 0), (9, 3, 0), (8, 2, 1), (6, 0, 3), (3, 0, 3), (20, 3, 0)]
)
def test_what_stop_takes_back_after_the_end_of_the_measurement_is_not_lost(
    wanted: int | None, lost: int, cut: int
) -> None:
    """The node had begun 9 messages when Stop came; 0 to 5 are there."""
    taker = receiver()
    for counter in range(6):
        assert taker.open_message(sealed(counter), LATER)
    taker.finish(9, wanted)
    counted(taker, good=6, lost=lost, cut=cut)
    assert taker.open_message(sealed(8), LATER) is None
    counted(taker, good=6, lost=lost, cut=cut, late=1)


def test_a_stop_that_counts_less_than_came_lets_no_message_count_twice() -> None:
    taker = receiver()
    for counter in range(6):
        assert taker.open_message(sealed(counter), LATER)
    taker.finish(3)
    assert taker.open_message(sealed(4), LATER) is None
    counted(taker, good=6, late=1)


def test_how_many_messages_had_begun_at_a_tick() -> None:
    taker = receiver()
    found = [taker.begun(START + tick) for tick in (-1, 0, 20 * MS - 1, 20 * MS, 65 * MS)]
    assert found == [0, 1, 1, 2, 4]
    waiting, events = receiver(start=WAITS), receiver(kind=StreamKind.EVENT)
    assert [each.begun(START + 65 * MS) for each in (waiting, events)] == [0, 0]


def test_only_bits_0_and_7_of_the_flags_mean_something() -> None:
    taker = receiver()
    for counter, flags in enumerate((0x00, 0x7E, 0x01, 0x7F)):
        message = taker.open_message(sealed(counter, flags=flags), LATER)
        assert message is not None
        assert (message.valid, message.test_pattern) == (not flags & 1, False)
    assert taker.open_message(sealed(4, flags=0xFE), LATER) is None
    counted(taker, good=4, unasked=1)
    pattern = receiver(test_pattern=True)
    message = pattern.open_message(sealed(0, flags=0xFE), LATER)
    assert message is not None
    assert (message.valid, message.test_pattern) == (True, True)
