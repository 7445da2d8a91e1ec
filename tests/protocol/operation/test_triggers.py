"""Triggers: what they start and stop, once, for their life and for their session (operation.md section 5)."""

from __future__ import annotations

from teds_provision.protocol.messages.frames import decode_reply
from teds_provision.protocol.operation.commands import ChannelState, write_data_set
from teds_provision.protocol.operation.stream_commands import (
    CLOCK,
    WAITS,
    Action,
    ArmCommand,
    ClockReply,
)
from teds_provision.protocol.operation.timing import TriggerToken

from .bench import MS, SAFE_VALUE, SECOND, Bench
from .consumer import Consumer, clock, values


def armed(bench: Bench, action: Action, *, life: int = 10, link: str = "can:f1") -> TriggerToken:
    token = TriggerToken.draw()
    assert bench.send(token.arm(action, life).command(), link).ok
    return token


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
    assert bench.send(ArmCommand(bytes(16), 0, Action.MARK).command()).ok
    bench.tim.trigger("can:f1", second.octets, 2)
    assert clock(bench).mark == 0
    bench.tim.trigger("can:f1", start.octets, 3)
    assert clock(bench).mark == 3


def test_what_is_armed_goes_with_the_last_claim() -> None:
    bench = Bench().open().operate(1, 2)
    first, second = armed(bench, Action.START), armed(bench, Action.MARK)
    bench.idle(1)
    bench.tim.trigger("can:f1", first.octets, 5)
    assert clock(bench).mark == 5, "another claim is left, and whatever the action it is the session's mark"
    bench.idle(2)
    bench.tim.trigger("can:f1", second.octets, 6)
    assert clock(bench).mark == 5


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


def test_a_trigger_that_marks_or_starts_moves_no_actuator() -> None:
    bench = Bench().open().operate(1, 4)
    bench.send(write_data_set(4, b"\x03\xe8"))
    for action in (Action.MARK, Action.START):
        token = armed(bench, action)
        bench.tim.trigger("can:f1", token.octets, 7)
        assert clock(bench).mark == 7
        assert bench.operation().channels[4] == (ChannelState.ACTUATOR | ChannelState.CLAIMED_HERE, 0xF1)
        assert int.from_bytes(bench.hardware.points[4], "big") == 1000


def test_arm_needs_no_claim_and_a_new_one_replaces_that_of_its_action_alone() -> None:
    bench = Bench().open()
    stop, mark = armed(bench, Action.STOP), armed(bench, Action.MARK)
    again = armed(bench, Action.STOP)
    for token, seen in ((stop, 0), (mark, 2), (again, 3)):
        bench.tim.trigger("can:f1", token.octets, {0: 1}.get(seen, seen))
        assert clock(bench).mark == seen


def test_a_clock_was_received_with_its_last_frame_and_sent_just_before_it_was_sealed() -> None:
    bench = Bench().open().operate(1)
    session = bench.sessions["can:f1"]
    came = bench.hardware.tick
    sealed = session.seal(CLOCK)
    bench.hardware.tick += 3 * MS
    outer = decode_reply(
        bench.tim.handle(sealed.encode(), link="can:f1", tapped=False, port=bench.ports.get("can:f1"), received=came)
    )
    found = ClockReply.decode(session.unseal(outer.payload).payload)
    assert found == ClockReply(came, came + 3 * MS, 0, 1000, 50, 0xFFFFFFFF)
