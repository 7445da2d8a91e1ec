"""Streams on the node: what leaves when, what is dropped whole, what is taken back (operation.md sections 3, 4)."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.operation.can_frames import data_address
from teds_provision.protocol.operation.datagram import LAST_COUNTER
from teds_provision.protocol.operation.hardware import SessionPort
from teds_provision.protocol.operation.stream_commands import (
    CLOCK,
    StreamKind,
    stop,
)
from teds_provision.protocol.operation.stream_role import StreamRole
from teds_provision.protocol.operation.subscription import Receiver, StreamPlan, TickBounds

from .bench import MS, SECOND, Bench
from .consumer import Consumer, values

# -- periodic ----------------------------------------------------------------------------------------------------------


def test_samples_are_taken_at_their_instants_however_late_the_node_is_polled() -> None:
    bench = Bench().open().operate(1)
    consumer = Consumer(bench, n=3, start=200 * MS)
    bench.until(229 * MS)
    (message,) = consumer.messages()
    assert (message.tick, values(message)) == (200 * MS, [200, 210, 220])
    bench.hardware.tick = 277 * MS  # the host slept for most of two messages
    bench.until(300 * MS)
    first, second = consumer.messages()[-2:]
    assert (first.tick, values(first)) == (230 * MS, [230, 240, 250])
    assert (second.tick, values(second)) == (260 * MS, [260, 270, 280])
    assert consumer.receiver.counts.lost == 0


def test_a_node_that_slept_long_loses_whole_messages_and_shows_it() -> None:
    bench = Bench().open().operate(1)
    consumer = Consumer(bench, n=2, start=200 * MS)
    bench.until(219 * MS)
    assert len(consumer.messages()) == 1
    bench.hardware.tick = 700 * MS
    bench.until(760 * MS)
    found = consumer.messages()
    assert consumer.receiver.counts.lost > 10
    assert all(values(m) == [m.tick // MS, m.tick // MS + 10] for m in found), "what comes is right"
    assert found[0].tick >= 660 * MS


def test_nothing_leaves_before_the_reply_and_nothing_after_stop() -> None:
    bench = Bench().open().operate(1)
    consumer = Consumer(bench, start=bench.hardware.tick + 1, left=False)
    bench.later(100 * MS)
    assert not bench.frames, "the reply has not left yet"
    bench.tim.reply_sent("can:f1")
    bench.later(50 * MS)
    assert consumer.messages()
    before = len(bench.frames)
    assert consumer.stop() == consumer.receiver.last + 1
    bench.later(100 * MS)
    assert len(bench.frames) == before
    assert consumer.receiver.counts.lost + consumer.receiver.counts.good == consumer.receiver.last + 1


@pytest.mark.parametrize("end", ["stop", "idle", "lost", "lease", "replaced"])
def test_frames_not_yet_sent_are_taken_back_at_every_end(end: str) -> None:
    bench = Bench().open().operate(1, lease=1)
    consumer = Consumer(bench, n=25, period=1 * MS, gap=2000, start=100 * MS)
    bench.until(129 * MS)
    assert not consumer.messages()
    sent = len(bench.frames)
    assert 0 < sent < 8, "a message is being sent"
    match end:
        case "stop":
            bench.send(stop(0))
        case "idle":
            bench.idle()
        case "lost":
            bench.tim.link_lost("can:f1")
        case "lease":
            bench.hardware.tick += 1 * SECOND
        case "replaced":
            bench.open()
            bench.send(CLOCK)
    bench.later(50 * MS)
    assert len(bench.frames) == sent


def test_a_half_open_open_ends_nothing() -> None:
    bench = Bench().open().operate(1)
    Consumer(bench, start=100 * MS)
    bench.open()
    bench.later(200 * MS)
    assert bench.frames


def test_a_new_subscribe_ends_the_run_before_and_a_refused_one_does_not() -> None:
    bench = Bench().open().operate(1)
    first = Consumer(bench, start=100 * MS)
    assert bench.reason(StreamPlan.for_channels(0, ((2, 2),), n=1, period=10 * MS).command()) == Reason.WRONG_STATE
    bench.until(130 * MS)
    assert first.messages()
    second = Consumer(bench, start=200 * MS)
    bench.until(300 * MS)
    assert (first.reply.run, second.reply.run) == (1, 2)
    assert second.messages()
    assert second.receiver.counts.bad == 0


# -- sending -----------------------------------------------------------------------------------------------------------


def test_the_segments_of_a_long_message_count_from_1_to_7_and_round() -> None:
    bench = Bench().open().operate(1)
    consumer = Consumer(bench, n=113, period=1 * MS, start=100 * MS)
    bench.until(300 * MS)
    segments = [frame.identifier >> 8 & 7 for _, frame in bench.frames]
    assert segments == [0, *(k % 7 + 1 for k in range(29))], "239 octets in 30 frames"
    (message,) = consumer.messages()
    assert values(message) == list(range(100, 213))


@pytest.mark.parametrize("gaps", [(300, 700), (700, 300)])
def test_frames_leave_at_least_the_largest_gap_apart(gaps: tuple[int, int]) -> None:
    bench = Bench().open().operate(1, 2)
    Consumer(bench, 0, n=25, period=1 * MS, gap=gaps[0], start=100 * MS)
    Consumer(bench, 1, (2,), n=5, period=10 * MS, gap=gaps[1], start=100 * MS)
    bench.until(500 * MS)
    at = [tick for tick, _ in bench.frames]
    apart = [later - before for before, later in itertools.pairwise(at)]
    assert min(apart) == 700_000
    assert bench.frames[0][0] >= 100 * MS


def test_of_messages_that_wait_the_shorter_goes_next() -> None:
    bench = Bench().open().operate(1, 2)
    slow = Consumer(bench, 0, n=10, period=10 * MS, gap=1000, start=100 * MS)
    quick = Consumer(bench, 1, (2,), n=1, period=90 * MS, gap=1000, start=190 * MS)
    bench.until(250 * MS)
    streams = [data_address(frame.identifier).stream for _, frame in bench.frames]  # type: ignore[union-attr]
    assert streams[:2] == [1, 1], "both are full at 190 ms; n · period 90 ms goes before 100 ms"
    assert quick.messages()
    assert slow.messages()


def test_a_message_that_is_not_begun_when_the_next_is_full_is_dropped_whole() -> None:
    """The bus is taken for a while (nobody asks for frames): newest wins, and the counter shows what is missing."""
    bench = Bench().open().operate(1)
    consumer = Consumer(bench, n=1, period=10 * MS, start=100 * MS)
    bench.buses.clear()
    for tick in range(100 * MS, 160 * MS, 5 * MS):
        bench.until(tick)
    bench.buses.add("can")
    bench.until(159 * MS)
    (message,) = consumer.messages()
    assert (message.counter, values(message)) == (5, [150])
    assert consumer.receiver.counts.lost == bench.tim.missed == 5
    assert bench.send(stop(0)).ok
    assert bench.tim.missed == 5, "since the start, whatever ended"


def test_the_last_counter_is_sent_and_ends_the_stream() -> None:
    bench = Bench().open().operate(1)
    consumer = Consumer(bench, n=1, period=10 * MS, start=100 * MS)
    (stream,) = bench.tim._role.streams._streams  # type: ignore[union-attr]
    stream.counter = LAST_COUNTER
    stream.start = consumer.receiver.start = 100 * MS - LAST_COUNTER * 10 * MS
    bench.until(200 * MS)
    (message,) = consumer.messages()
    assert message.counter == LAST_COUNTER
    assert not bench.tim._role.streams.running  # type: ignore[union-attr]
    assert bench.reason(stop(0)) == Reason.WRONG_STATE


def test_the_messages_of_a_long_sleep_are_counted_as_missed() -> None:
    bench = Bench().open().operate(1)
    consumer = Consumer(bench, n=2, start=200 * MS)
    bench.until(219 * MS)
    consumer.messages()
    bench.hardware.tick = 700 * MS
    bench.until(760 * MS)
    consumer.messages()
    assert consumer.receiver.counts.lost == bench.tim.missed > 10
    assert bench.send(stop(0)).ok
    assert consumer.receiver.counts.lost == bench.tim.missed, "since the start, whatever ended"


def test_a_node_that_slept_past_the_last_counter_sends_it_and_ends_the_stream() -> None:
    """No counter beyond the last is counted as lost: none was due."""
    bench = Bench().open().operate(1)
    consumer = Consumer(bench, n=1, period=10 * MS, start=100 * MS)
    (stream,) = bench.tim._role.streams._streams  # type: ignore[union-attr]
    stream.counter = LAST_COUNTER - 20
    stream.start = consumer.receiver.start = 100 * MS - stream.counter * 10 * MS
    bench.hardware.tick = 5 * SECOND
    bench.until(5 * SECOND + 10 * MS)
    (message,) = consumer.messages()
    assert (message.counter, values(message)) == (LAST_COUNTER, [300])
    assert bench.tim.missed == 20
    assert not bench.tim._role.streams.running  # type: ignore[union-attr]


def test_ble_streams_are_whole_notifications_of_their_connection() -> None:
    bench = Bench().open("ble:2", SessionPort("ble", "ble", 2, mtu=247)).operate(1, link="ble:2")
    plan = StreamPlan.for_channels(3, ((1, 2),), n=2, period=10 * MS, start=100 * MS)
    reply = plan.accept(bench.send(plan.command(), "ble:2").payload, TickBounds(0, 0))
    bench.until(150 * MS)
    _, frame = bench.frames[0]
    assert (frame.link_source, frame.identifier, frame.data[0]) == (2, 0, 3)
    receiver = Receiver(plan, reply, bench.sessions["ble:2"].message_key)
    message = receiver.open_message(frame.data[1:], TickBounds(150 * MS, 150 * MS))
    assert message is not None
    assert values(message) == [100, 110]


def test_the_reply_to_another_session_lets_no_stream_begin() -> None:
    bench = Bench().open().open("can:f2").operate(1)
    Consumer(bench, start=bench.hardware.tick + 1, left=False)
    bench.send(CLOCK, "can:f2")
    bench.later(100 * MS)
    assert not bench.frames, "the reply to Subscribe has not left yet"
    bench.tim.reply_sent("can:f1")
    bench.later(50 * MS)
    assert bench.frames


def test_notifications_that_are_disabled_end_the_streams_of_their_connection_alone() -> None:
    bench = Bench()
    links = ("ble:2", "ble:3")
    for link in links:
        bench.open(link, SessionPort("ble", "ble", int(link[-1]), mtu=247)).operate(1, link=link)
        assert bench.send(StreamPlan.for_channels(0, ((1, 2),), n=1, period=50 * MS).command(), link).ok
    bench.later(100 * MS)
    assert {frame.link_source for _, frame in bench.frames} == {2, 3}
    bench.tim.unheard("ble:2")
    bench.frames.clear()
    bench.later(100 * MS)
    assert {frame.link_source for _, frame in bench.frames} == {3}
    assert [bench.reason(stop(0), link) for link in links] == [Reason.WRONG_STATE, None]


# -- events, free, test pattern ----------------------------------------------------------------------------------------


def test_events_before_the_start_do_not_count_and_those_too_soon_do() -> None:
    bench = Bench().open().operate(5)
    consumer = Consumer(bench, channels=(5,), kind=StreamKind.EVENT, n=1, period=20 * MS, start=100 * MS)
    late = {99: 101, 100: 102}
    """When they are taken up."""
    for tick in (90, 99, 100, 119, 120, 139, 141):
        bench.until(late.get(tick, tick) * MS)
        bench.tim.event(5, tick * MS, bytes([tick]), valid=tick != 120)
    bench.until(200 * MS)
    found = consumer.messages()
    assert [(m.counter, m.tick // MS, m.data[0], m.valid) for m in found] == [
        (0, 100, 100, True),
        (2, 120, 120, False),
        (4, 141, 141, True),
    ]
    assert consumer.stop() == 5
    assert consumer.receiver.counts.lost == 2, "sooner than the period: dropped, and shown"


def test_events_of_the_test_pattern_come_one_every_period() -> None:
    bench = Bench().open().operate(5)
    consumer = Consumer(
        bench, channels=(5,), kind=StreamKind.EVENT, n=1, period=20 * MS, start=100 * MS, test_pattern=True
    )
    bench.tim.event(5, 110 * MS, b"\xff")
    bench.until(165 * MS)
    found = consumer.messages()
    assert [(m.tick // MS, m.data) for m in found] == [(100, b"\5"), (120, b"\6"), (140, b"\7"), (160, b"\x08")]
    assert all(m.data == consumer.receiver.expected(m) for m in found)


def test_flags_speak_of_their_message_alone() -> None:
    bench = Bench().open().operate(1)
    consumer = Consumer(bench, n=2, start=100 * MS)
    bench.until(105 * MS)
    bench.hardware.invalid = {1}
    bench.until(115 * MS)
    bench.hardware.invalid = set()
    bench.until(145 * MS)
    assert [m.valid for m in consumer.messages()] == [False, True]
    bench.hardware.faults = {1}
    bench.until(165 * MS)
    assert [m.valid for m in consumer.messages()] == [False], "a fault, told by the hardware apart"


# -- which stream, which session ---------------------------------------------------------------------------------------


def test_a_stream_ends_with_a_claim_of_its_own_channels_in_its_own_session_alone() -> None:
    bench = Bench().open().open("can:f2").operate(1, 2, 3).operate(1, link="can:f2")
    one, both = Consumer(bench, 0, (1,), start=100 * MS), Consumer(bench, 1, (2, 3), start=100 * MS)
    other = Consumer(bench, 0, (1,), start=100 * MS, link="can:f2")

    def came(until: int) -> list[bool]:
        bench.until(until)
        return [bool(consumer.messages()) for consumer in (one, both, other)]

    assert came(150 * MS) == [True, True, True]
    bench.idle(3)
    assert came(200 * MS) == [True, False, True], "one channel of two is enough; the other stream goes on"
    bench.idle(1, "can:f2")
    assert came(250 * MS) == [True, False, False], "the other session's claim of the same sensor"
    assert bench.reason(stop(1)) == Reason.WRONG_STATE
    assert bench.send(stop(0)).ok


@pytest.mark.parametrize(
    ("due", "earliest"),
    [((500, 300), 300), ((300, 500), 300), ((None, 300), 300), ((300, None), 300), ((None, None), None), ((0, 7), 0)],
)
def test_the_next_frame_is_the_earliest_of_every_bus(due: tuple[int | None, ...], earliest: int | None) -> None:
    role: Any = StreamRole.__new__(StreamRole)
    role._streams = [SimpleNamespace(port=SimpleNamespace(bus=bus)) for bus in ("can", "ble", "can")]
    role._senders = {bus: SimpleNamespace(due=lambda _, at=at: at) for bus, at in zip(("can", "ble"), due, strict=True)}
    assert role.next_frame() == earliest


def test_the_node_wants_to_be_called_for_the_first_instant_of_all_its_streams() -> None:
    bench = Bench().open().operate(1, 2)
    Consumer(bench, 0, (1,), start=200 * MS)
    Consumer(bench, 1, (2,), start=120 * MS)
    wait = bench.tim.poll()
    assert wait is not None
    assert round(wait * SECOND) == 120 * MS - bench.hardware.tick
