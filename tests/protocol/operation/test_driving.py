"""Drive messages on the node: sets that feed the dead-man, and all that moves nothing (operation.md section 2)."""

from __future__ import annotations

import pytest

from teds_provision.protocol.messages.frames import Function, Reason, security_command
from teds_provision.protocol.operation.commands import ChannelState
from teds_provision.protocol.operation.datagram import DatagramSealer, DriveValues, Layout, drive_key
from teds_provision.protocol.operation.driving import Driver
from teds_provision.protocol.operation.hardware import SessionPort
from teds_provision.protocol.operation.stream_commands import (
    CLOCK,
    NONE,
    DriveReply,
    drive,
)
from teds_provision.protocol.operation.subscription import TickBounds

from .bench import MS, Bench
from .consumer import clock


class Wheel:
    """Actuators 4 and 6 driven by message."""

    def __init__(self, bench: Bench, dead_man: int = 500) -> None:
        self.bench = bench
        reply = DriveReply.decode(bench.send(drive([4, 6])).payload)
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


def test_a_fresh_drive_message_after_the_dead_man_moves_nothing_even_without_a_poll(wheel: Wheel) -> None:
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


def test_a_drive_message_that_was_heard_moves_nothing_again_while_it_is_in_time(wheel: Wheel) -> None:
    first, second = (wheel.message(value, value, hold=450 * MS) for value in (1500, 1700))
    wheel.hear(first)
    wheel.hear(second)
    wheel.hear(first)
    assert (wheel.points, clock(wheel.bench).last) == ((1700, 1700), 1), "an older counter"
    wheel.bench.later(400 * MS)
    wheel.hear(second)
    wheel.bench.later(101 * MS)
    assert wheel.points == (100, 100), "the last counter: it feeds no dead-man"


@pytest.mark.parametrize("wrong", ["late", "too far ahead", "forged", "beyond the hardware", "fault", "heard before"])
def test_a_drive_message_that_moves_nothing_feeds_no_dead_man(wheel: Wheel, wrong: str) -> None:
    bench = wheel.bench
    heard = wheel.message(1000, 1000, hold=490 * MS)
    wheel.hear(heard)
    late = wheel.message(2000, 2000, hold=20 * MS)
    bench.later(400 * MS)
    match wrong:
        case "late":
            wheel.hear(late)
        case "too far ahead":
            wheel.hear(wheel.message(2000, 2000, now=bench.hardware.tick + 501 * MS, hold=1 * MS))
        case "forged":
            forged = wheel.message(2000, 2000)
            wheel.hear(forged[:-1] + bytes([forged[-1] ^ 1]))
        case "beyond the hardware":
            wheel.hear(wheel.message(2000, 4001))
        case "fault":
            bench.hardware.faults = {6}
            wheel.hear(wheel.message(2000, 2000))
        case "heard before":
            wheel.hear(heard)
    assert wheel.points == (1000, 1000)
    bench.later(99 * MS)
    assert wheel.points == (1000, 1000)
    bench.later(1 * MS)
    assert wheel.points == (100, 100)


@pytest.mark.parametrize("short", [4, 6])
def test_the_shortest_dead_man_of_all_its_actuators_limits_a_drive_message(short: int) -> None:
    bench = Bench().open()
    for channel in (4, 6):
        bench.operate(channel, dead_man=100 if channel == short else 500)
    wheel = Wheel(bench)
    wheel.hear(wheel.message(1000, 1000, hold=101 * MS))
    assert (wheel.points, clock(bench).last) == ((100, 100), 0), "heard, and too far ahead for one of them"
    wheel.hear(wheel.message(1000, 1000, hold=100 * MS))
    assert wheel.points == (1000, 1000)


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


def test_a_new_drive_counts_from_the_start_and_forgets_what_the_old_one_had_begun(wheel: Wheel) -> None:
    """Counters are those of a run: the first message of the new one is no replay of the old one's."""
    from teds_provision.protocol.operation.can_frames import cut

    for value in (2000, 2100):
        wheel.hear(wheel.message(value, value))
    begun, *rest = cut(wheel.message(2200, 2200), fd=False, drive=True)
    wheel.bench.tim.drive("can:f1", begun.data)
    again = Wheel(wheel.bench)
    assert clock(wheel.bench).last == NONE
    for piece in rest:
        wheel.bench.tim.drive("can:f1", piece.data)
    assert wheel.points == (2100, 2100)
    again.hear(again.message(1000, 1000))
    assert (wheel.points, clock(wheel.bench).last) == ((1000, 1000), 0)


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


def test_over_ble_a_message_comes_whole_and_in_no_other_length() -> None:
    bench = Bench().open("ble:2", SessionPort("ble", "ble", 2, mtu=247))
    bench.tim.drive("ble:2", bytes(20))
    bench.operate(4, 6, link="ble:2", dead_man=500)
    bench.tim.drive("ble:2", bytes(20))
    reply = DriveReply.decode(bench.send(drive([4, 6]), "ble:2").payload)
    assert reply == DriveReply(1, 20), "counter 4, until 4, data sets 2 and 2, tag 8"
    sealer = DatagramSealer(drive_key(bench.sessions["ble:2"].message_key, 1))
    until = (bench.hardware.tick + 100 * MS) // 1000
    octets = bytes.fromhex("03e803e9")
    for counter, data in ((0, octets + b"\0"), (1, octets[:3])):
        bench.tim.drive("ble:2", sealer.seal(counter, DriveValues(until, data).encode()))
        assert clock(bench, "ble:2").last == NONE, "dropped before its tag is looked at"
    bench.tim.drive("ble:2", sealer.seal(0, DriveValues(until, octets).encode()))
    assert (bench.hardware.points[4], bench.hardware.points[6]) == (b"\x03\xe8", b"\x03\xe9")
    assert clock(bench, "ble:2").last == 0


def test_a_drive_message_begins_anew_with_segment_0_and_ends_with_a_frame_of_another_length(wheel: Wheel) -> None:
    from teds_provision.protocol.operation.can_frames import cut

    def hear(*frames: bytes) -> tuple[int, int]:
        for frame in frames:
            wheel.bench.tim.drive("can:f1", frame)
        return wheel.points

    def frames_of(value: int) -> list[bytes]:
        return [piece.data for piece in cut(wheel.message(value, value), fd=False, drive=True)]

    cut_short, whole = frames_of(1000), frames_of(1001)
    assert [len(frame) for frame in whole] == [8, 8, 7], "20 octets: 7, 7 and 6, each after its segment"
    assert hear(*cut_short[:2], *whole) == (1001, 1001), "segment 0 drops what was begun"
    first, second, third = frames_of(1002)
    assert hear(first, second[:-1], third) == (1001, 1001), "a short one"
    assert hear(first, second, third + b"\xcc") == (1001, 1001), "a long one"
    assert hear(first, third) == (1001, 1001), "one is missing"
    assert hear(second, third) == (1001, 1001), "the first is missing"
    assert hear(first, b"\x08" + second[1:], second, third) == (1002, 1002), "no segment: it is no frame of a message"
