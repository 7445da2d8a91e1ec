"""Streams on the node: what leaves when, what is dropped whole, what is taken back (operation.md sections 3, 4, 5)."""

from __future__ import annotations

import itertools

import pytest

from teds_provision.protocol.messages.frames import Function, Reason, security_command
from teds_provision.protocol.operation.can_frames import Assembly, data_address
from teds_provision.protocol.operation.commands import ChannelState, write_data_set
from teds_provision.protocol.operation.datagram import LAST_COUNTER, Layout
from teds_provision.protocol.operation.driving import Driver
from teds_provision.protocol.operation.hardware import Port
from teds_provision.protocol.operation.stream_commands import (
    CLOCK,
    NONE,
    WAITS,
    Action,
    Arm,
    Clock,
    Driven,
    Kind,
    decode_stopped,
    drive,
    stop,
)
from teds_provision.protocol.operation.subscription import Message, Plan, Receiver, TickBounds
from teds_provision.protocol.operation.timing import Token

from .bench import MS, SAFE_VALUE, SECOND, Bench

WIDTHS = {1: 2, 2: 2, 3: 4, 4: 2, 5: 1, 6: 2}


class Consumer:
    """A station's end of one stream: subscribes and takes every frame that the bench has sent since."""

    def __init__(self, bench: Bench, stream: int = 0, channels: tuple[int, ...] = (1,), *, link: str = "can:f1",
                 left: bool = True, **more: object) -> None:  # fmt: skip
        asked = {"n": 2, "period": 10 * MS} | more
        self.bench, self.link = bench, link
        self.plan = Plan.of(stream, tuple((channel, WIDTHS[channel]) for channel in channels), **asked)  # type: ignore[arg-type]
        reply = bench.send(self.plan.command(), link, left=left)
        assert reply.ok, reply.reason
        self.reply = self.plan.accept(reply.payload, TickBounds(bench.hardware.tick, bench.hardware.tick))
        self.receiver = Receiver(self.plan, self.reply, bench.sessions[link].message_key, oldest=1 << 62)
        self.assembly = Assembly(self.plan.length, fd=False)
        self.taken = len(bench.frames)

    def messages(self) -> list[Message]:
        """Messages that came whole since the last call."""
        found = []
        for tick, frame in self.bench.frames[self.taken :]:
            address = data_address(frame.identifier)
            if address is None or (f"can:{address.station:02x}", address.stream) != (
                self.link,
                self.plan.subscribe.stream,
            ):
                continue
            whole = self.assembly.take(address.segment, frame.data)
            message = self.receiver.take(whole, TickBounds(tick, tick)) if whole is not None else None
            if message is not None:
                found.append(message)
        self.taken = len(self.bench.frames)
        return found

    def stop(self) -> int:
        """Stop, and tell the receiver what the count was."""
        counter = decode_stopped(self.bench.send(stop(self.plan.subscribe.stream), self.link).payload)
        self.receiver.finish(counter)
        return counter


def values(message: Message, width: int = 2) -> list[int]:
    return [int.from_bytes(message.data[at : at + width], "big") for at in range(0, len(message.data), width)]


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
    bench.tim.reply_left("can:f1")
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
    assert bench.reason(Plan.of(0, ((2, 2),), n=1, period=10 * MS).command()) == Reason.WRONG_STATE
    bench.until(130 * MS)
    assert first.messages()
    second = Consumer(bench, start=200 * MS)
    bench.until(300 * MS)
    assert (first.reply.run, second.reply.run) == (1, 2)
    assert second.messages()
    assert second.receiver.counts.bad == 0


# -- sending -----------------------------------------------------------------------------------------------------------


def test_frames_leave_at_least_the_largest_gap_apart() -> None:
    bench = Bench().open().operate(1, 2)
    Consumer(bench, 0, n=25, period=1 * MS, gap=300, start=100 * MS)
    Consumer(bench, 1, (2,), n=5, period=10 * MS, gap=700, start=100 * MS)
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
    assert consumer.receiver.counts.lost == 5


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


def test_ble_streams_are_whole_notifications_of_their_connection() -> None:
    bench = Bench().open("ble:2", Port("ble", "ble", 2, mtu=247)).operate(1, link="ble:2")
    plan = Plan.of(3, ((1, 2),), n=2, period=10 * MS, start=100 * MS)
    reply = plan.accept(bench.send(plan.command(), "ble:2").payload, TickBounds(0, 0))
    bench.until(150 * MS)
    _, frame = bench.frames[0]
    assert (frame.link_source, frame.identifier, frame.data[0]) == (2, 0, 3)
    receiver = Receiver(plan, reply, bench.sessions["ble:2"].message_key)
    message = receiver.take(frame.data[1:], TickBounds(150 * MS, 150 * MS))
    assert message is not None
    assert values(message) == [100, 110]


# -- events, free, test pattern ----------------------------------------------------------------------------------------


def test_events_before_the_start_do_not_count_and_those_too_soon_do() -> None:
    bench = Bench().open().operate(5)
    consumer = Consumer(bench, channels=(5,), kind=Kind.EVENT, n=1, period=20 * MS, start=100 * MS)
    for tick in (90, 100, 119, 120, 139, 141):
        bench.until(tick * MS)
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
    consumer = Consumer(bench, channels=(5,), kind=Kind.EVENT, n=1, period=20 * MS, start=100 * MS, test_pattern=True)
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


# -- trigger -----------------------------------------------------------------------------------------------------------


def armed(bench: Bench, action: Action, *, life: int = 10, link: str = "can:f1") -> Token:
    token = Token.draw()
    assert bench.send(token.arm(action, life).command(), link).ok
    return token


def clock(bench: Bench, link: str = "can:f1") -> Clock:
    return Clock.decode(bench.send(CLOCK, link).payload)


def test_a_trigger_starts_the_waiting_streams_of_its_session_10_ms_after_the_mark() -> None:
    bench = Bench().open().open("can:f2").operate(1).operate(1, link="can:f2")
    mine, other = Consumer(bench, start=WAITS), Consumer(bench, start=WAITS, link="can:f2")
    assert mine.reply.start == WAITS
    token = armed(bench, Action.START)
    bench.later(50 * MS)
    assert not bench.frames
    mark = bench.hardware.tick - 40_000
    bench.tim.trigger("can:f2", token.octets, mark)
    bench.tim.trigger("can:f1", bytes(8), mark)
    assert clock(bench).mark == 0, "a wrong T changes nothing, nor does another station's frame"
    bench.tim.trigger("can:f1", token.octets, mark)
    assert clock(bench).mark == mark
    bench.later(40 * MS)
    assert not mine.messages(), "held until the mark is read"
    message = mine.receiver.begin(mark + 10 * MS)[0]
    assert values(message) == [(mark + 10 * MS) // MS, (mark + 20 * MS) // MS]
    assert not other.messages()
    assert other.stop() == 0, "it still waits"


def test_a_trigger_is_good_once_and_for_its_life() -> None:
    bench = Bench().open()
    token = armed(bench, Action.MARK, life=1)
    bench.later(1 * SECOND)
    bench.tim.trigger("can:f1", token.octets, 7)
    assert clock(bench).mark == 0
    token = armed(bench, Action.MARK)
    bench.tim.trigger("can:f1", token.octets, 8)
    bench.tim.trigger("can:f1", token.octets, 9)
    assert clock(bench).mark == 8


def test_one_trigger_per_action_and_life_0_disarms_that_action() -> None:
    bench = Bench().open()
    first, second, start = armed(bench, Action.MARK), armed(bench, Action.MARK), armed(bench, Action.START)
    bench.tim.trigger("can:f1", first.octets, 1)
    assert clock(bench).mark == 0
    assert bench.send(Arm(bytes(16), 0, Action.MARK).command()).ok
    bench.tim.trigger("can:f1", second.octets, 2)
    assert clock(bench).mark == 0
    bench.tim.trigger("can:f1", start.octets, 3)
    assert clock(bench).mark == 3


def test_what_is_armed_goes_with_the_last_claim() -> None:
    bench = Bench().open().operate(1, 2)
    token = armed(bench, Action.MARK)
    bench.idle(1)
    bench.idle(2)
    bench.tim.trigger("can:f1", token.octets, 5)
    assert clock(bench).mark == 0


def test_a_stop_trigger_brings_every_actuator_of_the_session_to_its_safe_state() -> None:
    bench = Bench().open().open("can:f2").operate(1, 4).operate(6, link="can:f2")
    bench.send(write_data_set(4, b"\x03\xe8"))
    bench.send(write_data_set(6, b"\x03\xe8"), "can:f2")
    token = armed(bench, Action.STOP)
    bench.tim.trigger("can:f1", token.octets, bench.hardware.tick)
    states = bench.operation().channels
    assert states[4][0] == ChannelState.ACTUATOR | ChannelState.SAFE | ChannelState.STOPPED
    assert bench.hardware.points[4] == SAFE_VALUE
    assert states[6] == (ChannelState.ACTUATOR | ChannelState.CLAIMED_BY_OTHER, 0xF2), "the other session's goes on"
    assert states[1][0] == ChannelState.CLAIMED_HERE, "and its own sensors"


# -- Drive -------------------------------------------------------------------------------------------------------------


class Wheel:
    """Actuators 4 and 6 driven by message."""

    def __init__(self, bench: Bench, dead_man: int = 500) -> None:
        self.bench = bench
        reply = Driven.decode(bench.send(drive([4, 6])).payload)
        self.layout = Layout((4, 6), (2, 2))
        self.driver = Driver(self.layout, reply, bench.sessions["can:f1"].message_key, dead_man=dead_man)
        self.assembly_segments: list[bytes] = []

    def message(self, *values: int, hold: int | None = None, now: int | None = None) -> bytes:
        tick = self.bench.hardware.tick if now is None else now
        octets = tuple(value.to_bytes(2, "big") for value in values)
        return self.driver.seal(octets, TickBounds(tick, tick), hold=hold)

    def hear(self, message: bytes) -> None:
        from teds_provision.protocol.operation.can_frames import cut

        for piece in cut(message, fd=False, drive=True):
            self.bench.tim.drive("can:f1", piece.data)

    @property
    def points(self) -> tuple[int, int]:
        points = self.bench.hardware.points
        return int.from_bytes(points[4], "big"), int.from_bytes(points[6], "big")


@pytest.fixture
def wheel() -> Wheel:
    return Wheel(Bench().open().operate(4, 6, dead_man=500))


def test_drive_messages_are_sets_and_feed_the_dead_men(wheel: Wheel) -> None:
    for value in range(1000, 1010):
        wheel.hear(wheel.message(value, value + 1))
        assert wheel.points == (value, value + 1)
        wheel.bench.later(400 * MS)
    assert wheel.bench.tim.actuator_claimed()
    assert clock(wheel.bench).last == 9
    wheel.bench.later(200 * MS)
    assert wheel.points == (100, 100)


def test_a_fresh_drive_message_after_the_dead_man_moves_nothing_even_where_nobody_polled(wheel: Wheel) -> None:
    """A node whose processor hung wakes up with a fresh message in its controller: its timer ran out before that."""
    wheel.hear(wheel.message(1000, 1000))
    wheel.bench.hardware.tick += 500 * MS
    wheel.hear(wheel.message(2000, 2000))
    assert wheel.points == (100, 100)
    states = wheel.bench.operation().channels
    assert states[4] == states[6] == (ChannelState.ACTUATOR | ChannelState.SAFE | ChannelState.STOPPED, 0)


def test_a_drive_message_that_is_late_replayed_forged_or_too_much_moves_nothing(wheel: Wheel) -> None:
    bench = wheel.bench
    good = wheel.message(1000, 1000)
    held_back = wheel.message(2000, 2000, hold=20 * MS)
    wheel.hear(good)
    assert clock(bench).last == 0
    assert wheel.points == (1000, 1000)
    forged = bytearray(wheel.message(3000, 3000))
    forged[-1] ^= 1
    wheel.hear(bytes(forged))
    assert clock(bench).last == 0, "a bad tag uses up nothing"
    bench.later(21 * MS)
    wheel.hear(held_back)
    assert (wheel.points, clock(bench).last) == ((1000, 1000), 1), "its until is past; its counter is used up"
    ahead = wheel.message(3000, 3000, now=bench.hardware.tick + 501 * MS, hold=1 * MS)
    wheel.hear(ahead)
    assert wheel.points == (1000, 1000), "further ahead than the smallest dead-man"
    wheel.hear(wheel.message(3000, 4001))
    assert wheel.points == (1000, 1000), "one value that the hardware does not bear: all of it"
    wheel.hear(good)
    assert wheel.points == (1000, 1000)
    wheel.hear(wheel.message(1500, 1600))
    assert wheel.points == (1500, 1600)


def test_until_runs_over_every_71_minutes(wheel: Wheel) -> None:
    bench = wheel.bench
    bench.hardware.tick = ((1 << 32) - 5) * 1000
    bench.tim._role.claims.actuators[4].deadline = 1 << 62  # type: ignore[union-attr]
    for held in bench.tim._role.claims.actuators.values():  # type: ignore[union-attr]
        held.deadline = 1 << 62
    bench.tim._role.claims._leases.clear()  # type: ignore[union-attr]
    wheel.hear(wheel.message(1234, 1234, hold=50 * MS))
    assert wheel.points == (1234, 1234)


def test_drive_ends_with_the_claim_of_any_of_its_channels(wheel: Wheel) -> None:
    wheel.hear(wheel.message(1000, 1000))
    wheel.bench.idle(6)
    wheel.hear(wheel.message(2000, 2000))
    assert wheel.points == (1000, 100)
    assert clock(wheel.bench).last == NONE


def test_a_new_drive_replaces_the_one_before(wheel: Wheel) -> None:
    old = wheel.message(2000, 2000)
    again = Wheel(wheel.bench)
    assert again.driver.run == wheel.driver.run + 1
    wheel.hear(old)
    assert wheel.points == (100, 100)
    again.hear(again.message(1000, 1000))
    assert wheel.points == (1000, 1000)
    assert wheel.bench.reason(drive([4, 1])) == Reason.WRONG_STATE
    again.hear(again.message(1001, 1001))
    assert wheel.points == (1001, 1001), "a refused one changes nothing"


def test_frames_of_a_drive_message_out_of_order_move_nothing(wheel: Wheel) -> None:
    from teds_provision.protocol.operation.can_frames import cut

    pieces = list(cut(wheel.message(1000, 1000), fd=False, drive=True))
    for at in (0, 2, 1):
        wheel.bench.tim.drive("can:f1", pieces[at].data)
    assert wheel.points == (100, 100)


def test_messages_without_a_session_or_a_drive_are_nothing() -> None:
    bench = Bench()
    bench.tim.drive("can:f1", bytes(8))
    bench.tim.trigger("can:f1", bytes(8), 5)
    bench.open()
    bench.send(CLOCK)
    bench.tim.drive("can:f1", bytes(8))
    bench.tim.drive("can:f1", b"")
    bench.tim.event(5, 1, b"\0")
    assert bench.send(security_command(Function.CLOSE)).ok
    assert bench.tim.next_frame("can") is None
