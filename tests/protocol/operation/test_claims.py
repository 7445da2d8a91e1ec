"""Claims, leases, dead-men and safe states: whatever dies, the actuator is safe and the node silent (section 1, 2)."""

from __future__ import annotations

import pytest

from teds_provision.protocol.messages.firmware import ABOUT, FirmwareReport
from teds_provision.protocol.messages.frames import (
    Command,
    Function,
    Reason,
    read_teds,
    security_command,
    update_teds,
    write_teds,
)
from teds_provision.protocol.operation.commands import (
    ChannelState,
    PowerFlag,
    PowerReply,
    read_data_set,
    sample,
    set_values,
    write_data_set,
)
from teds_provision.protocol.operation.stream_commands import CLOCK, StreamKind, SubscribeCommand, drive
from teds_provision.protocol.session import StationSession

from .bench import MS, SAFE_VALUE, SECOND, UUID, Bench, K

VALUE = (1000).to_bytes(2, "big")
CHALLENGE = bytes(32)
PROVE = security_command(Function.PROVE, CHALLENGE)
LIST = security_command(Function.LIST)
READ = read_teds(0, 128, 0)
IDENTIFY = security_command(Function.IDENTIFY)


def safe(bench: Bench, channel: int = 4) -> bool:
    """Return True if the hardware holds the actuator in its safe state."""
    return bench.hardware.points[channel] == SAFE_VALUE


def acting(**more: int) -> Bench:
    """Actuator 4 claimed and told a value."""
    bench = Bench().open().operate(4, **more)
    assert bench.send(write_data_set(4, VALUE)).ok
    assert not safe(bench)
    return bench


# -- safe states -------------------------------------------------------------------------------------------------------


def test_actuators_are_safe_from_the_start_and_until_the_first_value() -> None:
    bench = Bench()
    assert safe(bench)
    bench.hardware.points[4] = VALUE  # as if something else had moved it
    bench.open().operate(4)
    assert safe(bench)
    assert bench.operation().channels[4][0] & ChannelState.SAFE
    assert bench.send(write_data_set(4, VALUE)).ok
    assert not bench.operation().channels[4][0] & ChannelState.SAFE


@pytest.mark.parametrize(
    "end",
    ["idle", "dead-man", "lease", "close", "lost", "confirm", "reset", "by hand", "replaced", "power", "last counter"],
)
def test_whatever_ends_a_claim_brings_the_actuator_to_its_safe_state(end: str) -> None:
    bench = acting(lease=5, dead_man=2000)
    session = bench.sessions["can:f1"]
    match end:
        case "idle":
            bench.idle(4)
        case "dead-man":
            for _ in range(4):  # a keep-alive thread is no sign of life
                bench.later(500 * MS)
                bench.send(CLOCK)
        case "lease":
            bench.until(bench.hardware.tick)
            bench.tim._role.claims.actuators[4].deadline = 1 << 62  # type: ignore[union-attr]
            bench.later(5 * SECOND)
        case "close":
            assert bench.send(security_command(Function.CLOSE)).ok
        case "lost":
            bench.tim.link_lost("can:f1")
        case "confirm" | "reset":
            before: list[bytes] = []
            commit = bench.memory.commit
            bench.memory.commit = lambda state: (before.append(bench.hardware.points[4]), commit(state))[1]  # type: ignore[method-assign]
            if end == "reset":
                assert bench.send(security_command(Function.RESET, CHALLENGE)).ok
            else:
                bench.tim._commit(bench.memory.state, safe=True)
            assert before == [SAFE_VALUE], "before it writes"
        case "by hand":
            bench.tim.reset_by_hand()
        case "replaced":
            bench.open()
            assert not safe(bench), "a half-open Open ends nothing"
            bench.send(IDENTIFY)
        case "power":
            bench.hardware.charge = PowerReply(PowerFlag.BATTERY | PowerFlag.TOO_LOW)
            bench.tim.poll()
        case "last counter":
            session._counter = 0xFFFFFFFE
            bench.send(CLOCK)
    assert safe(bench)
    assert not bench.tim.actuator_claimed()


@pytest.mark.parametrize("channel", [1, 4, 5])
def test_every_claim_ends_if_power_is_too_low_to_measure(channel: int) -> None:
    bench = Bench().open("can:f1").open("can:f2").operate(channel, link="can:f2")
    bench.hardware.charge = PowerReply(PowerFlag.BATTERY)
    bench.tim.poll()
    assert bench.operation().measuring
    bench.hardware.charge = PowerReply(PowerFlag.BATTERY | PowerFlag.TOO_LOW)
    bench.tim.poll()
    assert not bench.operation().measuring


@pytest.mark.parametrize("value", ["3.2", "Set"])
def test_the_dead_man_lives_by_values_for_this_channel_alone(value: str) -> None:
    bench = Bench().open().operate(4, 6, dead_man=200)
    command = write_data_set(4, VALUE) if value == "3.2" else set_values([(4, VALUE)])
    for _ in range(5):
        bench.later(150 * MS)
        assert bench.send(command).ok
    assert not safe(bench)
    states = bench.operation().channels
    assert states[4] == (ChannelState.ACTUATOR | ChannelState.CLAIMED_HERE, 0xF1)
    assert states[6] == (ChannelState.ACTUATOR | ChannelState.SAFE | ChannelState.STOPPED, 0)


@pytest.mark.parametrize(
    ("refused", "reason"),
    [
        (write_data_set(4, b"\xff\xff"), Reason.OUT_OF_RANGE),
        (set_values([(4, b"\xff\xff")]), Reason.OUT_OF_RANGE),
        (write_data_set(4, b"\1"), Reason.BAD_FORM),
        (set_values([(4, VALUE), (6, VALUE)]), Reason.WRONG_STATE),
        (set_values([(4, VALUE), (1, VALUE)]), Reason.NOT_PERMITTED),
        (write_data_set(4, VALUE), Reason.FAULT),
        (set_values([(4, VALUE)]), Reason.FAULT),
    ],
)
def test_a_refused_value_does_not_feed_the_dead_man(refused: Command, reason: Reason) -> None:
    bench = acting(dead_man=200).operate(1)
    bench.later(150 * MS)
    bench.hardware.faults = {4} if reason == Reason.FAULT else set()
    assert bench.reason(refused) == reason
    bench.later(50 * MS)
    assert safe(bench)


def test_the_dead_man_runs_out_at_its_time_and_not_before() -> None:
    bench = Bench().open().operate(4, dead_man=20)
    bench.later(20 * MS - 1)
    assert bench.send(write_data_set(4, VALUE)).ok
    bench.later(20 * MS)
    assert bench.reason(write_data_set(4, VALUE)) == Reason.WRONG_STATE, "the way back is a new Operate"
    bench.operate(4)
    assert not bench.operation().channels[4][0] & ChannelState.STOPPED


def test_a_late_value_is_refused_even_without_a_poll() -> None:
    bench = acting(dead_man=200)
    bench.hardware.tick += 200 * MS
    assert bench.reason(write_data_set(4, VALUE)) == Reason.WRONG_STATE
    assert safe(bench)


def test_set_is_all_or_nothing() -> None:
    bench = Bench().open().operate(4, 6)
    bench.hardware.log.clear()
    assert bench.reason(set_values([(4, VALUE), (6, b"\xff\xff")])) == Reason.OUT_OF_RANGE
    assert bench.hardware.log == []
    assert bench.send(set_values([(4, VALUE), (6, VALUE)])).ok
    assert bench.hardware.log == [("apply", {4: 1000, 6: 1000})], "together"


# -- leases ------------------------------------------------------------------------------------------------------------


def test_a_lease_lives_by_any_good_sealed_frame_and_is_one_per_session() -> None:
    bench = Bench().open().operate(1, lease=60).operate(2, lease=2)
    bench.later(1999 * MS)
    assert bench.reason(read_data_set(9)) == Reason.UNKNOWN_COMMAND, "whatever its inner command gets"
    bench.later(1999 * MS)
    assert bench.operation().measuring
    bench.later(2 * SECOND)
    assert not bench.operation().measuring, "claims of both are over, the session is not"


def test_a_frame_after_the_lease_does_not_revive_it() -> None:
    bench = Bench().open().operate(1, lease=1)
    bench.hardware.tick += 1 * SECOND  # not polled
    assert bench.reason(read_data_set(1)) == Reason.WRONG_STATE


def test_what_is_no_good_sealed_frame_is_no_sign_of_life() -> None:
    bench = Bench().open().operate(1, lease=1)
    frame = bench.sessions["can:f1"].seal(CLOCK)
    assert bench.plain(frame).ok
    for _ in range(4):
        bench.later(250 * MS)
        assert bench.plain(frame).reason == Reason.REPLAY
        assert bench.plain(IDENTIFY).ok
    assert not bench.operation().measuring


# -- several sessions --------------------------------------------------------------------------------------------------


def test_sensors_are_shared_and_actuators_are_not() -> None:
    bench = Bench().open("can:f1").open("can:f3").open("nfc")
    bench.operate(1, 4, link="can:f1").operate(1, link="can:f3").operate(1, link="nfc")
    states = bench.operation("nfc").channels
    assert states[1] == (ChannelState.CLAIMED_HERE | ChannelState.CLAIMED_BY_OTHER, 0xF3), "the highest of several"
    assert states[4][1] == 0xF1
    bench.idle(link="can:f1")
    bench.idle(link="can:f3")
    assert bench.operation("nfc").channels[1] == (ChannelState.CLAIMED_HERE, 1)


def test_the_session_beyond_the_room_ends_the_silent_one_without_a_claim() -> None:
    bench = Bench(sessions=2).open("can:f1").operate(1).open("can:f2")
    assert bench.send(CLOCK, "can:f2").ok
    bench.later(1 * SECOND).open("can:f3")
    assert bench.send(CLOCK, "can:f3").ok
    assert bench.plain(bench.sessions["can:f2"].seal(CLOCK), "can:f2").reason == Reason.WRONG_STATE
    assert bench.send(CLOCK, "can:f1").ok
    bench.operate(2, link="can:f3").open("can:f4")
    assert bench.reason(CLOCK, "can:f4") == Reason.NO_ROOM
    assert bench.plain(bench.sessions["can:f4"].seal(CLOCK), "can:f4").reason == Reason.WRONG_STATE


def test_of_two_sessions_without_a_claim_the_one_that_was_silent_longest_ends() -> None:
    bench = Bench(sessions=2).open("can:f1").open("can:f2")
    for link in ("can:f1", "can:f2", "can:f1"):  # the first to begin is not the one that is silent longest
        assert bench.later(1 * SECOND).send(CLOCK, link).ok
    assert bench.open("can:f3").send(CLOCK, "can:f3").ok
    assert bench.plain(bench.sessions["can:f2"].seal(CLOCK), "can:f2").reason == Reason.WRONG_STATE
    assert bench.send(CLOCK, "can:f1").ok


def test_half_open_sessions_beyond_the_room_replace_the_oldest() -> None:
    bench = Bench(sessions=2)
    for number in (1, 2, 3):
        bench.later(1 * MS).open(f"can:f{number}")
    assert bench.plain(bench.sessions["can:f1"].seal(CLOCK), "can:f1").reason == Reason.WRONG_STATE
    assert bench.send(CLOCK, "can:f2").ok
    assert bench.send(CLOCK, "can:f3").ok


# -- the datasheet does not change under a claim -----------------------------------------------------------------------

WRITE, UPDATE = write_teds(1, 12, 0, b"x"), update_teds(1, 12)
ADDRESS = security_command(Function.SET_CAN_ADDRESS, b"\x21")


def test_writing_is_refused_while_a_session_claims() -> None:
    bench = Bench().open("can:f1").open("can:f2").operate(1, link="can:f1")
    for command in (WRITE, UPDATE, ADDRESS):
        assert bench.reason(command, "can:f1") == Reason.WRONG_STATE, "its own claim"
        assert bench.reason(command, "can:f2") == Reason.BUSY, "another's"
    assert bench.plain(ADDRESS, "nfc").reason == Reason.BUSY, "tapped, outside a session"
    bench.operate(2, link="can:f2")
    assert bench.reason(WRITE, "can:f2") == Reason.WRONG_STATE, "its own, whoever else does"
    bench.idle(link="can:f1")
    bench.idle(link="can:f2")
    assert bench.reason(WRITE, "can:f1") is None
    assert bench.plain(ADDRESS, "nfc").ok


def test_a_tap_ends_the_claims_of_others_on_sensors() -> None:
    bench = Bench().open("can:f1").operate(1, 2).open("nfc")
    assert bench.reason(UPDATE, "nfc") == Reason.BUSY, "not by 1.4"
    assert bench.reason(write_teds(1, 12, 9, b"x"), "nfc") == Reason.BAD_FORM, "a refused 1.3 changes nothing"
    assert bench.operation("can:f1").channels[1][0] & ChannelState.CLAIMED_HERE
    assert bench.reason(WRITE, "nfc") is None
    assert not bench.operation("can:f1").measuring


def test_but_not_if_an_actuator_is_claimed() -> None:
    bench = Bench().open("can:f1").operate(1, 4).open("nfc")
    assert bench.reason(WRITE, "nfc") == Reason.BUSY
    assert bench.operation("can:f1").channels[1][0] & ChannelState.CLAIMED_HERE


# -- no stranger stops a motor -----------------------------------------------------------------------------------------


class Reporting:
    """Firmware that reports, and blinks for nobody."""

    def about(self) -> FirmwareReport:
        return FirmwareReport("board/loadcell", (1, 2, 3), 4)

    def locate(self, seconds: int) -> None:
        raise AssertionError


def long_open(bench: Bench) -> int | None:
    session = StationSession(K, UUID)
    counter = bench.plain(session.request_counter(), "can:f5")
    assert counter.ok, "the short form costs nothing"
    reply = bench.plain(session.open(counter.payload), "can:f5")
    return None if reply.ok else reply.reason


@pytest.mark.parametrize("quick", [True, False])
def test_point_arithmetic_for_strangers_waits_while_an_actuator_is_claimed(quick: bool) -> None:
    bench = Bench(quick_points=quick).open().operate(1)
    assert bench.plain(PROVE).ok
    assert long_open(bench) is None
    bench.operate(4)
    refused = None if quick else Reason.BUSY
    assert bench.plain(PROVE).reason == refused
    assert long_open(bench) == refused
    assert bench.send(PROVE).ok, "inside the session"
    bench.idle(4)
    assert long_open(bench) is None


def test_strangers_read_once_a_second_while_a_stream_runs() -> None:
    bench = Bench(firmware=Reporting()).open().operate(1)
    assert [bench.plain(command).ok for command in (READ, LIST, ABOUT, READ)] == [True] * 4
    assert bench.send(SubscribeCommand(0, StreamKind.PERIODIC, 1, 0, 100 * MS, 0, (1,)).command()).ok
    asked = [bench.plain(READ), bench.plain(LIST, "nfc"), bench.plain(READ, "can:f2"), bench.plain(ABOUT, "can:f3")]
    assert [reply.reason for reply in asked] == [None, *[Reason.BUSY] * 3], "together and over all links"
    bench.later(999 * MS)
    assert bench.plain(LIST).reason == Reason.BUSY
    assert bench.plain(ABOUT, "nfc").reason == Reason.NOT_PERMITTED, "which takes no stranger's turn"
    bench.later(1 * MS)
    assert bench.plain(ABOUT).ok, "a refused one does not begin the second again"
    assert bench.plain(READ).reason == Reason.BUSY
    assert [bench.send(command).ok for command in (READ, LIST, ABOUT)] == [True] * 3, "inside the session"
    bench.idle()
    assert [bench.plain(command).ok for command in (READ, LIST, ABOUT, READ)] == [True] * 4


# -- the rest ----------------------------------------------------------------------------------------------------------


def test_a_sample_is_not_valid_while_a_sensor_says_so_or_tests_itself() -> None:
    bench = Bench().open().operate(0)
    flags = 8
    assert bench.send(sample([1, 2])).payload[flags] == 0
    bench.hardware.invalid = {2}
    assert bench.send(sample([1, 2])).payload[flags] == 1
    assert bench.send(sample([1])).payload[flags] == 0
    assert bench.send(sample([2, 1])).payload[flags] == 1, "whichever of them it is"
    bench.hardware.tests = {1}
    assert bench.send(sample([1])).payload[flags] == 1
    assert bench.operation().channels[1][0] & ChannelState.TESTING


def test_after_a_restart_the_node_is_silent() -> None:
    bench = acting()
    bench.restart()
    assert safe(bench)
    assert not bench.open().operation().measuring
    assert bench.reason(drive([4])) == Reason.WRONG_STATE


@pytest.mark.parametrize("end", ["close", "lost", "by hand", "replaced"])
def test_nothing_of_a_session_stays_in_ram(end: str) -> None:
    bench = acting()
    match end:
        case "close":
            bench.send(security_command(Function.CLOSE))
        case "lost":
            bench.tim.link_lost("can:f1")
        case "by hand":
            bench.tim.reset_by_hand()
        case _:
            bench.open().send(IDENTIFY)
    role = bench.tim._role
    assert role is not None
    assert (role._ports, role.streams._sessions, role.claims._leases) == ({}, {}, {})
