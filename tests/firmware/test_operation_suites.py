"""The suites of the reference's measurement operation, with the node in C on the bench."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from _pytest.fixtures import FixtureFunctionDefinition

from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.messages.frames import Command, Function, Reason, security_command
from teds_provision.protocol.operation.can_frames import cut
from teds_provision.protocol.operation.commands import (
    ChannelState,
    PowerFlag,
    PowerReply,
    read_data_set,
    run_self_test,
    sample,
    set_values,
    write_data_set,
)
from teds_provision.protocol.operation.hardware import ChannelHardware, SessionPort
from teds_provision.protocol.operation.stream_commands import CLOCK, Action, StreamKind, drive, stop
from teds_provision.teds.sheet import ChannelKind
from tests.firmware.bench import CBench, MeasuringMemoryNode
from tests.protocol.operation import (
    test_any_octets,
    test_claims,
    test_driving,
    test_node_kat,
    test_refusals,
    test_streams,
    test_triggers,
)
from tests.protocol.operation.bench import MS, SECOND, channel_teds
from tests.protocol.operation.consumer import Consumer, clock
from tests.protocol.operation.kat import MESSAGE_KEY
from tests.protocol.operation.test_claims import CHALLENGE, IDENTIFY, VALUE, safe
from tests.protocol.operation.test_driving import Wheel
from tests.protocol.operation.test_refusals import operate, sent, subscribe

MODULES = (test_refusals, test_claims, test_driving, test_streams, test_triggers, test_any_octets, test_node_kat)
INSIDE = "reaches into the objects of the Python node: below"
LEFT_OUT = {
    "test_operate_in_the_order_of_section_1": INSIDE,
    "test_a_sample_that_no_message_holds_gets_10": "its channels are in the state that the bench makes: below",
    "test_subscribe_in_the_order_of_section_4": "a clock of ns keeps every period: below",
    "test_runs_are_used_up_after_65535": INSIDE,
    "test_a_node_without_hardware_answers_1": INSIDE,
    "test_a_clock_was_received_with_its_last_frame_and_sent_just_before_it_was_sealed": "its bench has whole messages",
    "test_whatever_ends_a_claim_brings_the_actuator_to_its_safe_state": INSIDE,
    "test_nothing_of_a_session_stays_in_ram": INSIDE,
    "test_until_runs_over_every_71_minutes": INSIDE,
    "test_the_last_counter_is_sent_and_ends_the_stream": INSIDE,
    "test_a_node_that_slept_past_the_last_counter_sends_it_and_ends_the_stream": INSIDE,
    "test_no_key_and_nonce_come_twice_whatever_a_station_asks": INSIDE,
    "test_a_message_that_is_not_begun_when_the_next_is_full_is_dropped_whole": "poll asks for a bus that is free",
}
"""Tests that ask what a node in C cannot be asked, and why."""

pytestmark = pytest.mark.system

for _module in MODULES:
    for _name, _test in vars(_module).items():
        if isinstance(_test, FixtureFunctionDefinition):
            globals()[_name] = _test
        elif _name.startswith("test_") and callable(_test) and _name not in LEFT_OUT:
            globals()[f"{_name}_in_c"] = _test


@pytest.fixture(autouse=True)
def in_c(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every bench has the node in C on it."""
    for module in MODULES:
        monkeypatch.setattr(module, "Bench", CBench)
    monkeypatch.setattr(test_node_kat, "load_dice", load_dice)
    monkeypatch.setattr(test_node_kat, "message_key", lambda bench: MESSAGE_KEY)  # its frames show it
    yield
    CBench.close_all()


def load_dice(bench: CBench, opens: int, one_time: SoftwareKey) -> None:
    """What the node draws, from a start on."""
    node(bench).loaded = {"n": [opens.to_bytes(8, "big")], "o": [one_time.secret()]}
    bench.restart()


def node(bench: CBench) -> MeasuringMemoryNode:
    return bench.tim  # type: ignore[return-value]


def acting(*, lease: int = 60, dead_man: int = 10_000) -> CBench:
    bench = CBench()
    bench.open().operate(4, lease=lease, dead_man=dead_man)
    assert bench.send(write_data_set(4, VALUE)).ok
    assert not safe(bench)
    return bench


def test_operate_in_its_order() -> None:
    bench = CBench(teds={(1, 3): channel_teds(test_refusals.channels()[1], octets=4)})
    bench.open().open("can:f2").operate(4)
    bad = {"digest": bytes(16), "lease": 0}
    sent(
        bench,
        [
            ("a channel that is not there, all else wrong too", operate(9, **bad), Reason.UNKNOWN_COMMAND),
            ("every channel at once", Command(0xFFFF, 4, 1, bytes(17)), Reason.UNKNOWN_COMMAND),
            ("channel 257", Command(257, 4, 1, operate(1, **bad).payload), Reason.UNKNOWN_COMMAND),
            ("a sensor with a dead-man", operate(1, **bad, dead_man=500), Reason.BAD_FORM),
            ("an actuator without one", operate(4, **bad), Reason.BAD_FORM),
            ("another datasheet", operate(2, **bad), Reason.DIGEST_MISMATCH),
            ("a Channel TEDS with another width", operate(1, lease=0), Reason.DIGEST_MISMATCH),
            ("lease 0", operate(2, lease=0), Reason.OUT_OF_RANGE),
            ("lease 61", operate(2, lease=61), Reason.OUT_OF_RANGE),
            ("dead-man 19", operate(4, dead_man=19), Reason.OUT_OF_RANGE),
            ("dead-man 10001", operate(4, dead_man=10_001), Reason.OUT_OF_RANGE),
            ("its own again, lease wrong too", operate(4, lease=0, dead_man=500), Reason.OUT_OF_RANGE),
            ("its own again", operate(4, dead_man=500), Reason.WRONG_STATE),
        ],
    )
    bench.hardware.faults = {2, 4}
    sent(
        bench,
        [
            ("another's actuator, faulty too", operate(4, dead_man=500), Reason.BUSY),
            ("a faulty sensor", operate(2), Reason.FAULT),
            ("all sensors: the faulty and the unfit are left out", operate(0), None),
        ],
        "can:f2",
    )
    states = bench.operation("can:f2").channels
    assert {number for number, (state, _) in states.items() if state & ChannelState.CLAIMED_HERE} == {3, 5}


def test_subscribe_in_its_order() -> None:
    bench = CBench(teds={(3, 3): channel_teds(test_refusals.channels()[3], period=0.02)}, streams=2)
    bench.open().operate(1, 3, 4, 5)
    now = bench.hardware.tick
    sent(
        bench,
        [
            ("stream 4", subscribe(stream=4, channels=(9,)), Reason.BAD_FORM),
            ("one that is not there, an actuator too", subscribe(channels=(4, 9)), Reason.WRONG_STATE),
            ("an actuator, period 0", subscribe(channels=(4,), period=0), Reason.NOT_PERMITTED),
            ("periodic of an event sensor, period 0", subscribe(channels=(5,), period=0), Reason.OUT_OF_RANGE),
            ("events of a sensor", subscribe(kind=StreamKind.EVENT, n=1), Reason.OUT_OF_RANGE),
            ("period above 10^12", subscribe(period=10**12 + 1), Reason.OUT_OF_RANGE),
            (
                "shorter than SPeriod, too long as well",
                subscribe(channels=(3,), period=19 * MS, n=200),
                Reason.OUT_OF_RANGE,
            ),
            ("too long, budget broken too", subscribe(n=114, gap=65535), Reason.TOO_LARGE),
            ("the budget, a start that is past too", subscribe(n=1, gap=5001, start=now), Reason.DOES_NOT_FIT),
            ("a start that is past", subscribe(start=now), Reason.TOO_LATE),
            ("60 s and 1 ns ahead", subscribe(start=now + 60 * SECOND + 1), Reason.TOO_LATE),
            ("SPeriod itself (a Float32)", subscribe(channels=(3,), period=20 * MS), None),
            ("60 s ahead", subscribe(stream=1, start=now + 60 * SECOND), None),
            ("a third: no room", subscribe(stream=2), Reason.NO_ROOM),
            ("in place of the first", subscribe(stream=0), None),
        ],
    )


@pytest.mark.parametrize(("last", "reason"), [(204, None), (205, Reason.TOO_LARGE)])
def test_a_sample_wider_than_a_message_gets_10(last: int, reason: Reason | None) -> None:
    """9 + Σ ModLenth is at most maxMessage - 46: 978 of 1024."""
    widths = {1: 255, 2: 255, 3: 255, 5: last}
    wide = {number: ChannelHardware(ChannelKind.SENSOR, width) for number, width in widths.items()}
    bench = CBench(max_message=1024, teds={(number, 3): channel_teds(facts) for number, facts in wide.items()})
    bench.hardware.channels = wide
    bench.restart()
    bench.open().operate(0)
    if reason is not None:
        bench.hardware.faults = {5}  # its fault comes after
    assert bench.reason(sample([1, 2, 3, 5])) == reason


def test_no_run_follows_the_last() -> None:
    bench = CBench()
    bench.open().operate(1, 4)
    node(bench).set_run("can:f1", 65_534)
    assert bench.reason(subscribe()) is None
    assert bench.reason(drive([4])) == Reason.NO_ROOM
    assert bench.reason(subscribe()) == Reason.NO_ROOM
    assert node(bench).streaming, "a refused one changes nothing"


def test_a_board_without_channels_answers_1() -> None:
    bench = CBench()
    bench.hardware.channels = {}
    bench.restart()
    bench.open()
    commands = [operate(1), sample([1]), CLOCK, subscribe(), read_data_set(1), run_self_test(), set_values([])]
    assert {bench.reason(command) for command in commands} == {Reason.UNKNOWN_COMMAND}


@pytest.mark.parametrize(
    "end", ["idle", "dead-man", "lease", "close", "lost", "reset", "by hand", "replaced", "power", "last counter"]
)
def test_every_end_of_a_claim_is_safe_and_leaves_nothing(end: str) -> None:
    bench = acting(lease=5, dead_man=2000) if end != "lease" else acting(lease=5)
    match end:
        case "idle":
            bench.idle(4)
        case "dead-man":
            for _ in range(4):
                bench.later(500 * MS)
                bench.send(CLOCK)
        case "lease":
            bench.later(5 * SECOND - 1)
            assert not safe(bench)
            bench.later(1)
        case "close":
            assert bench.send(security_command(Function.CLOSE)).ok
        case "lost":
            node(bench).link_lost("can:f1")
        case "reset":
            node(bench).fails(True)
            assert bench.reason(security_command(Function.RESET, CHALLENGE)) == Reason.FLASH_FAILURE
            assert safe(bench), "before it writes"
            node(bench).fails(False)
        case "by hand":
            node(bench).reset_by_hand()
        case "replaced":
            bench.open()
            assert not safe(bench), "a half-open Open ends nothing"
            bench.send(IDENTIFY)
        case "power":
            bench.hardware.charge = PowerReply(PowerFlag.BATTERY | PowerFlag.TOO_LOW)
            node(bench).poll()
        case "last counter":
            bench.sessions["can:f1"]._counter = 0xFFFFFFFE
            bench.send(CLOCK)
    assert safe(bench)
    assert not node(bench).actuator_claimed()
    assert node(bench).hooks.timers[-1] == (4, 0), "its timer is off"
    if end in ("idle", "dead-man", "lease", "replaced"):
        assert bench.reason(write_data_set(4, VALUE)) == Reason.WRONG_STATE, "the way back is a new Operate"
        stopped = ChannelState.STOPPED if end == "dead-man" else 0
        assert bench.operation().channels[4] == (ChannelState.ACTUATOR | ChannelState.SAFE | stopped, 0)


@pytest.mark.parametrize("number", [1, 8])
@pytest.mark.parametrize("end", ["idle", "all idle", "dead-man", "lease", "trigger", "by hand", "power"])
def test_an_actuator_is_served_alike_in_the_first_place_of_the_table_and_in_the_last(number: int, end: str) -> None:
    """Eight channels, which is all that a build takes by default; actuators are the first and the last."""
    facts = {each: ChannelHardware(ChannelKind.SENSOR, 2) for each in range(2, 8)}
    facts |= {each: ChannelHardware(ChannelKind.ACTUATOR, 2, halt=1) for each in (1, 8)}
    bench = CBench(teds={(each, 3): channel_teds(own) for each, own in facts.items()})
    bench.hardware.channels = facts
    bench.hardware.points = dict.fromkeys((1, 8), VALUE)
    bench.restart()
    assert safe(bench, 1)
    assert safe(bench, 8)
    other = 9 - number
    bench.open().operate(number, lease=5, dead_man=10_000 if end == "lease" else 2000)
    assert bench.send(write_data_set(number, VALUE)).ok
    states = bench.operation().channels
    assert states[number] == (ChannelState.ACTUATOR | ChannelState.CLAIMED_HERE, 0xF1)
    assert states[other] == (ChannelState.ACTUATOR | ChannelState.SAFE, 0)
    assert bench.reason(write_data_set(other, VALUE)) == Reason.WRONG_STATE
    assert node(bench).actuator_claimed()
    token = test_triggers.armed(bench, Action.STOP)
    bench.hardware.log.clear()
    now = bench.hardware.tick
    match end:
        case "idle":
            bench.idle(number)
        case "all idle":
            bench.idle(0)
        case "dead-man" | "lease":
            due = now + (2 if end == "dead-man" else 5) * SECOND
            bench.until(due - 1)
            assert not safe(bench, number)
            bench.until(due)
        case "trigger":
            bench.tim.trigger("can:f1", token.octets, now)
        case "by hand":
            node(bench).reset_by_hand()
        case "power":
            bench.hardware.charge = PowerReply(PowerFlag.BATTERY | PowerFlag.TOO_LOW)
            node(bench).poll()
    assert safe(bench, number)
    assert ("safe", number) in bench.hardware.log
    assert not node(bench).actuator_claimed()
    if end != "by hand":
        stopped = ChannelState.STOPPED if end in ("dead-man", "trigger") else 0
        assert bench.operation().channels[number] == (ChannelState.ACTUATOR | ChannelState.SAFE | stopped, 0)
        if end != "power":
            bench.operate(number)
            claimed = ChannelState.ACTUATOR | ChannelState.CLAIMED_HERE | ChannelState.SAFE
            assert bench.operation().channels[number] == (claimed, 0xF1), "stopped is since its last Operate"


def test_two_event_sensors_have_rings_of_their_own() -> None:
    """A sensor and an actuator between them; what the ring of one loses is not missing from the other."""
    facts = {
        1: ChannelHardware(ChannelKind.EVENT_SENSOR, 2),
        2: ChannelHardware(ChannelKind.SENSOR, 2),
        3: ChannelHardware(ChannelKind.ACTUATOR, 2, halt=1),
        4: ChannelHardware(ChannelKind.EVENT_SENSOR, 2),
    }
    bench = CBench(teds={(each, 3): channel_teds(own) for each, own in facts.items()})
    bench.hardware.channels = facts
    bench.restart()
    bench.open().operate(0)
    start = bench.hardware.tick + 100 * MS
    streams = {
        channel: Consumer(bench, stream, (channel,), kind=StreamKind.EVENT, n=1, period=MS, start=start)
        for stream, channel in enumerate((1, 4))
    }
    bench.until(start)
    for at in range(7):  # a ring keeps four
        node(bench).interrupt(4, start + at * MS, bytes((4, at)))
    node(bench).interrupt(1, start + 2 * MS, b"\x01\x00")
    for number in (2, 3):
        node(bench).interrupt(number, start + 3 * MS, b"\xff\xff")  # they are no event sensors
    bench.hardware.tick = start + 8 * MS
    bench.until(start + 10 * MS)
    seen = {channel: [(m.counter, m.data.hex()) for m in stream.messages()] for channel, stream in streams.items()}
    assert seen == {1: [(0, "0100")], 4: [(3, "0403")]}, "of those that wait the newest leaves"
    for channel in (4, 1):
        node(bench).interrupt(channel, bench.hardware.tick, bytes((channel, 9)))
        bench.later(10 * MS)
    seen = {channel: [(m.counter, m.data.hex()) for m in stream.messages()] for channel, stream in streams.items()}
    assert seen == {1: [(1, "0109")], 4: [(7, "0409")]}
    assert [stream.stop() for stream in streams.values()] == [2, 8]


def test_the_hardware_timer_is_armed_by_operate_and_kicked_by_good_values_alone() -> None:
    bench = CBench()
    bench.open()
    timers = node(bench).hooks.timers
    timers.clear()
    bench.operate(4, dead_man=500).operate(6, dead_man=700)
    assert [entry for entry in timers if entry[1]] == [(4, 500), (6, 700)]
    timers.clear()
    assert bench.send(write_data_set(4, VALUE)).ok
    assert bench.send(set_values([(6, VALUE)])).ok
    wheel = Wheel(bench)
    wheel.hear(wheel.message(1000, 1000))
    assert timers == [(4, None), (6, None), (4, None), (6, None)]
    timers.clear()
    wheel.hear(wheel.message(1000, 4001))
    assert bench.reason(write_data_set(4, b"\xff\xff")) == Reason.OUT_OF_RANGE
    bench.send(CLOCK)
    bench.hardware.faults = {4}
    assert bench.reason(set_values([(4, VALUE), (6, VALUE)])) == Reason.FAULT
    assert timers == []


def test_until_runs_over() -> None:
    bench = CBench()
    bench.hardware.tick = ((1 << 32) - 5) * 1000
    wheel = Wheel(bench.open().operate(4, 6, dead_man=500))
    wheel.hear(wheel.message(1234, 1234, hold=50 * MS))
    assert wheel.points == (1234, 1234)
    bench.hardware.tick += 6_000
    wheel.hear(wheel.message(1235, 1235, hold=50 * MS))
    assert wheel.points == (1235, 1235)


def test_a_drive_wider_than_this_build_takes_gets_22() -> None:
    wide = {4: ChannelHardware(ChannelKind.ACTUATOR, 33, halt=1), 6: ChannelHardware(ChannelKind.ACTUATOR, 32, halt=1)}
    bench = CBench(teds={(number, 3): channel_teds(facts) for number, facts in wide.items()})
    bench.hardware.channels = wide
    bench.restart()
    bench.open().operate(4, 6)
    assert bench.reason(drive([4])) == Reason.NO_ROOM
    assert bench.reason(drive([6])) is None


def test_the_last_counter_of_a_stream_is_sent() -> None:
    bench = CBench()
    bench.open().operate(1)
    consumer = Consumer(bench, n=1, period=10 * MS, start=100 * MS)
    last = 0xFFFFFFFF
    node(bench).set_counter(last, 100 * MS - last * 10 * MS)
    consumer.receiver.start = 100 * MS - last * 10 * MS
    bench.until(200 * MS)
    (message,) = consumer.messages()
    assert message.counter == last
    assert not node(bench).streaming
    assert bench.reason(stop(0)) == Reason.WRONG_STATE


@pytest.mark.parametrize("fd", [False, True], ids=["classic", "FD"])
def test_drive_and_streams_go_in_the_form_in_which_they_were_asked_for(fd: bool) -> None:
    bench = CBench()
    bench.ports["can:f1"] = SessionPort("can", "can", 0xF1, fd=fd)
    bench.open().operate(1, 3, 4, 6)
    wheel = Wheel(bench)
    message = wheel.message(1000, 1001)
    pieces = [piece.data for piece in cut(message, fd=fd, drive=True)]
    assert len(pieces) == (1 if fd else 3)
    if fd:
        node(bench).drive("can:f1", pieces[0][:20])  # a length that no such message has
        assert wheel.points == (100, 100)
    for piece in pieces:
        node(bench).drive("can:f1", piece)
    assert wheel.points == (1000, 1001)
    assert bench.send(subscribe(n=10, channels=(1, 3), start=100 * MS)).ok
    bench.until(201 * MS)
    sizes = [len(frame.data) for _, frame in bench.frames]
    assert {frame.fd for _, frame in bench.frames} == {fd}
    assert sizes == ([64, 12] if fd else [8] * 9 + [1]), "13 + 10 · 6 octets; FD knows no 9"


def test_drive_frames_for_another_node_disturb_none_of_ones_own() -> None:
    wheel = Wheel(CBench().open().operate(4, 6, dead_man=500))
    own = node(wheel.bench)  # type: ignore[arg-type]
    pieces = list(cut(wheel.message(1000, 1001), fd=False, drive=True))
    for piece in pieces:
        own.take_frame(0x18EFC1F1, pieces[0].data)
        own.drive("can:f1", piece.data)
    assert len(pieces) > 1
    assert wheel.points == (1000, 1001)


def test_a_trigger_has_eight_octets() -> None:
    bench = CBench()
    bench.open()
    token = test_triggers.armed(bench, Action.MARK).octets
    for data, mark in ((token + bytes(4), 0), (token[:7], 0), (token, bench.hardware.tick)):
        node(bench).take_frame(0x18FF00F1, data, fd=len(data) > 8)
        assert (clock(bench).mark != 0) == bool(mark)
