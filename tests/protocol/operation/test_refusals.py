"""What the node refuses, and in which order: the first check of operation.md that fails gives the reason."""

from __future__ import annotations

from dataclasses import replace

import pytest

from teds_provision.protocol.messages.frames import Command, Function, Reason, security_command
from teds_provision.protocol.operation.commands import (
    OperateCommand,
    PowerFlag,
    PowerReply,
    idle,
    read_data_set,
    run_self_test,
    sample,
    set_values,
    write_data_set,
)
from teds_provision.protocol.operation.hardware import ChannelHardware, SessionPort
from teds_provision.protocol.operation.stream_commands import (
    CLOCK,
    WAITS,
    Action,
    ArmCommand,
    StreamKind,
    SubscribeCommand,
    drive,
    stop,
)
from teds_provision.teds.sheet import ChannelKind

from .bench import DIGEST, MS, SECOND, Bench, channel_teds, channels

BAD_DIGEST = bytes(16)
GOOD_VALUE = (1000).to_bytes(2, "big")
TOO_MUCH = (4001).to_bytes(2, "big")
U, R = Reason, Command


def sent(bench: Bench, rows: list[tuple[str, Command, int | None]], link: str = "can:f1") -> None:
    """Send each and compare: what is wrong is listed by its words."""
    found = [(words, bench.reason(command, link)) for words, command, _ in rows]
    assert found == [(words, reason) for words, _, reason in rows]


def operate(channel: int, *, digest: bytes = DIGEST, lease: int = 10, dead_man: int | None = None) -> Command:
    return OperateCommand(channel, digest, lease, dead_man).command()


def test_operate_in_the_order_of_section_1() -> None:
    facts = channels()
    bench = Bench(teds={(1, 3): channel_teds(facts[1], octets=4)}).open()
    bad = operate(1, digest=BAD_DIGEST, lease=0)
    sent(
        bench,
        [
            (
                "a channel that is not there, all else wrong too",
                operate(9, digest=BAD_DIGEST, lease=0),
                U.UNKNOWN_COMMAND,
            ),
            ("every channel at once", R(0xFFFF, 4, 1, bad.payload), U.UNKNOWN_COMMAND),
            ("an address group", R(0x8001, 4, 1, bad.payload), U.UNKNOWN_COMMAND),
            ("channel 257", R(257, 4, 1, bad.payload), U.UNKNOWN_COMMAND),
            ("a sensor with a dead-man", operate(1, digest=BAD_DIGEST, lease=0, dead_man=500), U.BAD_FORM),
            ("an actuator without one", operate(4, digest=BAD_DIGEST, lease=0), U.BAD_FORM),
            ("too short", R(1, 4, 1, bytes(16)), U.BAD_FORM),
            ("another datasheet", operate(2, digest=BAD_DIGEST, lease=0), U.DIGEST_MISMATCH),
            ("a Channel TEDS with another width", operate(1, lease=0), U.DIGEST_MISMATCH),
            ("lease 0", operate(2, lease=0), U.OUT_OF_RANGE),
            ("lease 61", operate(2, lease=61), U.OUT_OF_RANGE),
            ("dead-man 19", operate(4, dead_man=19), U.OUT_OF_RANGE),
            ("dead-man 10001", operate(4, dead_man=10_001), U.OUT_OF_RANGE),
            ("good", operate(4, dead_man=20), None),
            ("its own again, lease wrong too", operate(4, lease=0, dead_man=500), U.OUT_OF_RANGE),
            ("its own again", operate(4, dead_man=500), U.WRONG_STATE),
            ("a sensor", operate(2), None),
            ("a sensor again renews its lease", operate(2), None),
        ],
    )
    bench.open("can:f2")
    bench.hardware.faults = {2, 4}
    sent(
        bench,
        [
            ("another's actuator, faulty too", operate(4, dead_man=500), U.BUSY),
            ("a faulty sensor", operate(2), U.FAULT),
            ("all sensors: the faulty and the unfit are left out", operate(0), None),
        ],
        "can:f2",
    )
    assert bench.tim._role is not None
    claimed = bench.tim._role.claims.channels_of(bench.tim._sessions.on("can:f2"))  # type: ignore[arg-type]
    assert claimed == {3, 5}


def test_operate_0_gets_6_if_no_sensor_is_left_and_23_with_no_power() -> None:
    bench = Bench().open()
    bench.hardware.faults = {1, 2, 3, 5}
    assert bench.reason(operate(0)) == Reason.DIGEST_MISMATCH
    bench.hardware.faults.clear()
    bench.hardware.charge = PowerReply(PowerFlag.BATTERY | PowerFlag.TOO_LOW)
    assert bench.reason(operate(0)) == Reason.FAULT
    only_actuators = Bench()
    only_actuators.hardware.channels = {4: channels()[4]}
    only_actuators.restart()
    only_actuators.open()
    assert only_actuators.reason(operate(0, digest=BAD_DIGEST)) == Reason.UNKNOWN_COMMAND


@pytest.mark.parametrize("change", [{"kind": 1}, {"model": 1}, {"octets": 3}, {"halt": 2}, "absent"])
def test_a_teds_that_says_something_else_than_the_hardware_gets_6(change: dict[str, int] | str) -> None:
    number = 4 if isinstance(change, dict) and "halt" in change else 2
    facts = channels()[number]
    if isinstance(change, str):
        bench = Bench()
        blocks = {block: teds for block, teds in bench.memory.state.blocks.items() if block != (number, 3)}
        object.__setattr__(bench.memory.state, "blocks", blocks)
    else:
        bench = Bench(teds={(number, 3): channel_teds(facts, **change)})
    bench.restart()
    asked = operate(number, dead_man=500 if facts.actuator else None)
    assert bench.open().reason(asked) == Reason.DIGEST_MISMATCH


def test_an_actuators_halt_need_not_be_there() -> None:
    bench = Bench(teds={(4, 3): channel_teds(channels()[4], halt=None)}).open()
    assert bench.reason(operate(4, dead_man=500)) is None


@pytest.mark.parametrize("halt", [0, 1, 2, 255])
def test_a_halt_in_the_teds_of_a_sensor_does_not_matter(halt: int) -> None:
    """Nothing of a sensor halts, whatever a foreign datasheet states."""
    bench = Bench(teds={(2, 3): channel_teds(channels()[2], halt=halt)}).open()
    assert bench.reason(operate(2)) is None


def test_data_sets_in_the_order_of_section_2() -> None:
    bench = Bench().open().operate(1, 4, 5)
    bench.hardware.faults = {4, 5}
    sample_of = lambda *octets: security_command(Function.SAMPLE, bytes(octets))  # noqa: E731
    both = set_values([(4, GOOD_VALUE), (6, GOOD_VALUE)])
    sent(
        bench,
        [
            ("read of a channel that is not there", read_data_set(9), U.UNKNOWN_COMMAND),
            ("read of channel 0", read_data_set(0), U.UNKNOWN_COMMAND),
            ("read of channel 257", R(257, 3, 1, bytes(4)), U.UNKNOWN_COMMAND),
            ("read with three octets", R(1, 3, 1, bytes(3)), U.BAD_FORM),
            ("read of one not claimed, offset 1", R(2, 3, 1, b"\0\0\0\1"), U.WRONG_STATE),
            ("read at offset 1 of a faulty one", R(5, 3, 1, b"\0\0\0\1"), U.OUT_OF_RANGE),
            ("read of a faulty one", read_data_set(5), U.FAULT),
            ("read", read_data_set(1), None),
            ("sample of nothing", sample_of(), U.BAD_FORM),
            ("sample of 0", sample_of(1, 0), U.BAD_FORM),
            ("sample of one twice", sample_of(1, 1), U.BAD_FORM),
            ("sample of 65", sample_of(*range(1, 66)), U.BAD_FORM),
            ("sample of one that is not there", sample_of(1, 9), U.WRONG_STATE),
            ("sample of one not claimed", sample_of(1, 2), U.WRONG_STATE),
            ("sample with a faulty one", sample_of(1, 5), U.FAULT),
            ("write to a channel that is not there", write_data_set(9, b""), U.UNKNOWN_COMMAND),
            ("write to channel 0", R(0, 3, 2, bytes(4)), U.UNKNOWN_COMMAND),
            ("write to channel 260", R(260, 3, 2, bytes(4) + GOOD_VALUE), U.UNKNOWN_COMMAND),
            ("write of another width", write_data_set(4, b"\0"), U.BAD_FORM),
            ("write of another width, not claimed", write_data_set(6, b"\0"), U.BAD_FORM),
            ("write to one not claimed", write_data_set(6, TOO_MUCH), U.WRONG_STATE),
            ("write to a sensor that is not claimed", write_data_set(2, bytes(2)), U.WRONG_STATE),
            ("set of a sensor that is not claimed", set_values([(2, bytes(2))]), U.WRONG_STATE),
            ("write to a sensor, at offset 1", R(1, 3, 2, b"\0\0\0\1\0\0"), U.NOT_PERMITTED),
            ("write at offset 1", R(4, 3, 2, b"\0\0\0\1" + GOOD_VALUE), U.OUT_OF_RANGE),
            ("write past the hardware, which is faulty", write_data_set(4, TOO_MUCH), U.OUT_OF_RANGE),
            ("write to a faulty one", write_data_set(4, GOOD_VALUE), U.FAULT),
            ("set of nothing", set_values([]), U.BAD_FORM),
            ("set cut short, not claimed", set_values([(6, b"\0")]), U.BAD_FORM),
            ("set of one twice", set_values([(4, GOOD_VALUE)] * 2), U.BAD_FORM),
            ("set of channel 0", set_values([(0, b"")]), U.BAD_FORM),
            ("set of one that is not there", set_values([(9, b"")]), U.WRONG_STATE),
            (
                "set of one not claimed, the other past the hardware",
                set_values([(4, TOO_MUCH), (6, TOO_MUCH)]),
                U.WRONG_STATE,
            ),
            ("set of a sensor and past the hardware", set_values([(4, TOO_MUCH), (1, bytes(2))]), U.NOT_PERMITTED),
            ("set of one not claimed", both, U.WRONG_STATE),
        ],
    )
    assert ("apply", {}) not in bench.hardware.log
    assert not [entry for entry in bench.hardware.log if entry[0] == "apply"], "nothing was applied"


@pytest.mark.parametrize(("last", "reason"), [(204, None), (205, Reason.TOO_LARGE)])
def test_a_sample_that_no_message_holds_gets_10(last: int, reason: Reason | None) -> None:
    """9 + Σ ModLenth is at most maxMessage - 46: 978 of 1024."""
    widths = {1: 255, 2: 255, 3: 255, 6: last}
    bench = Bench(max_message=1024)
    bench.hardware.channels = {number: ChannelHardware(ChannelKind.SENSOR, width) for number, width in widths.items()}
    blocks = {(number, 3): channel_teds(facts) for number, facts in bench.hardware.channels.items()}
    object.__setattr__(bench.memory.state, "blocks", {**bench.memory.state.blocks, **blocks})
    bench.restart()
    bench.open().operate(0)
    assert bench.reason(sample([1, 2, 3, 6])) == reason


def test_self_test_power_operation_clock_and_idle() -> None:
    bench = Bench().open().open("can:f2").operate(2, link="can:f2")
    sent(
        bench,
        [
            ("self-test of a channel that is not there", run_self_test(9), U.UNKNOWN_COMMAND),
            ("self-test of channel 257", R(257, 1, 5, b"\0"), U.UNKNOWN_COMMAND),
            ("self-test without argument", R(1, 1, 5), U.BAD_FORM),
            ("self-test 1 of one that another claims", R(2, 1, 5, b"\1"), U.OUT_OF_RANGE),
            ("self-test of one that another claims", run_self_test(2), U.BUSY),
            ("self-test of all", run_self_test(), U.BUSY),
            ("self-test without a claim", run_self_test(1), None),
            ("power with a payload", R(0, 128, 18, b"\0"), U.BAD_FORM),
            ("operation with a payload", R(0, 128, 19, b"\0"), U.BAD_FORM),
            ("clock with a payload", R(0, 128, 16, b"\0"), U.BAD_FORM),
            ("clock without a claim", CLOCK, None),
            ("idle of a channel that is not there", idle(9), U.UNKNOWN_COMMAND),
            ("idle of channel 257", R(257, 4, 2), U.UNKNOWN_COMMAND),
            ("idle with a payload", R(1, 4, 2, b"\0"), U.BAD_FORM),
            ("idle where nothing was claimed", idle(1), None),
            ("idle of all", idle(), None),
            ("other functions of class 4", R(1, 4, 3, b"\1"), U.UNKNOWN_COMMAND),
            ("class 2", R(1, 2, 4, b"\1"), U.UNKNOWN_COMMAND),
            ("class 7, Reset", R(0, 7, 1), U.UNKNOWN_COMMAND),
            ("service-request mask", R(1, 1, 6, bytes(4)), U.UNKNOWN_COMMAND),
        ],
    )
    assert bench.hardware.tests == {1}


def subscribe(**changes: object) -> Command:
    asked: dict[str, object] = {
        "stream": 0, "kind": StreamKind.PERIODIC, "n": 2, "gap": 0, "period": 10 * MS, "start": 0, "channels": (1,)
    }  # fmt: skip
    return SubscribeCommand(**{**asked, **changes}).command()  # type: ignore[arg-type]


def raw_subscribe(stream: int, kind: int, n: int, *numbers: int) -> Command:
    octets = bytes([stream, kind, n]) + bytes(2) + (10 * MS).to_bytes(8, "big") + bytes(8) + bytes(numbers)
    return security_command(Function.SUBSCRIBE, octets)


def test_subscribe_in_the_order_of_section_4() -> None:
    bench = Bench(teds={(3, 3): channel_teds(channels()[3], period=0.02)}, streams=2).open().operate(1, 3, 4, 5)
    bench.hardware.unkept = {7}
    now = bench.hardware.tick
    sent(
        bench,
        [
            ("no channels", raw_subscribe(0, 0, 1), U.BAD_FORM),
            ("17 channels", raw_subscribe(0, 0, 1, *range(1, 18)), U.BAD_FORM),
            ("one twice", raw_subscribe(0, 0, 1, 1, 1), U.BAD_FORM),
            ("channel 0", raw_subscribe(0, 0, 1, 0), U.BAD_FORM),
            ("stream 4", raw_subscribe(4, 0, 1, 9), U.BAD_FORM),
            ("kind 3", raw_subscribe(0, 3, 1, 9), U.BAD_FORM),
            ("kind bit 6", raw_subscribe(0, 0x40, 1, 9), U.BAD_FORM),
            ("n 0", raw_subscribe(0, 0, 0, 9), U.BAD_FORM),
            ("events, n 2", raw_subscribe(0, 1, 2, 5), U.BAD_FORM),
            ("events, two channels", raw_subscribe(0, 1, 1, 5, 1), U.BAD_FORM),
            ("one that is not there, an actuator too", subscribe(channels=(4, 9)), U.WRONG_STATE),
            ("one not claimed", subscribe(channels=(1, 2)), U.WRONG_STATE),
            ("an actuator, period 0", subscribe(channels=(4,), period=0), U.NOT_PERMITTED),
            ("periodic of an event sensor", subscribe(channels=(5,)), U.OUT_OF_RANGE),
            ("free with an event sensor", subscribe(kind=StreamKind.FREE, channels=(1, 5)), U.OUT_OF_RANGE),
            ("events of a sensor", subscribe(kind=StreamKind.EVENT, n=1), U.OUT_OF_RANGE),
            ("period 0, too long as well", subscribe(period=0, n=200), U.OUT_OF_RANGE),
            ("period above 10^12", subscribe(period=10**12 + 1), U.OUT_OF_RANGE),
            ("shorter than SPeriod", subscribe(channels=(3,), period=19 * MS), U.OUT_OF_RANGE),
            ("shorter than a later channel's", subscribe(channels=(1, 3), period=19 * MS), U.OUT_OF_RANGE),
            ("a period that the clock does not keep", subscribe(period=7), U.OUT_OF_RANGE),
            ("too long, budget broken too", subscribe(n=114, gap=65535), U.TOO_LARGE),
            ("the budget", subscribe(n=1, gap=5001), U.DOES_NOT_FIT),
            ("a start that is past", subscribe(start=now), U.TOO_LATE),
            ("a start above 60 s ahead", subscribe(start=now + 61 * SECOND), U.TOO_LATE),
            ("SPeriod itself (a Float32)", subscribe(channels=(3,), period=20 * MS), None),
            ("a second stream", subscribe(stream=1, start=now + 60 * SECOND), None),
            ("a third: no room", subscribe(stream=2), U.NO_ROOM),
            ("in place of the first", subscribe(stream=0), None),
        ],
    )


def test_a_stream_that_is_replaced_takes_its_gap_with_it() -> None:
    bench = Bench().open().operate(1)
    assert bench.reason(subscribe(n=1, period=1000 * MS, gap=60000)) is None
    assert bench.reason(subscribe(n=1, period=1 * MS, gap=200)) is None, "2 frames: 400000 ppm of its own gap"
    assert bench.reason(subscribe(stream=1, n=1, period=1000 * MS, gap=300)) is None, "600000 ppm, and 600 ppm more"
    assert bench.reason(subscribe(stream=1, n=1, period=1000 * MS, gap=501)) == Reason.DOES_NOT_FIT


def test_the_budget_counts_every_stream_of_the_bus_and_the_largest_gap() -> None:
    bench = Bench().open().open("can:f2").operate(1).operate(1, link="can:f2")
    assert bench.reason(subscribe(n=1, period=1 * MS, gap=200)) is None, "2 frames: 400000 ppm"
    sent(
        bench, [("600000 ppm more, gap 300 for both", subscribe(n=1, period=1 * MS, gap=300), U.DOES_NOT_FIT)], "can:f2"
    )
    sent(bench, [("400000 ppm more", subscribe(n=1, period=1 * MS, gap=200), None)], "can:f2")
    assert bench.reason(subscribe(n=1, period=1 * MS, gap=251)) == Reason.DOES_NOT_FIT
    assert bench.reason(subscribe(n=1, period=1 * MS, gap=250)) is None, "2 · 500000 ppm is the most"
    bench = Bench().open().open("can:f2").operate(1).operate(1, link="can:f2")
    assert bench.reason(subscribe(n=1, period=1 * MS, gap=300)) is None
    sent(bench, [("its gap is for both", subscribe(n=1, period=1 * MS, gap=200), U.DOES_NOT_FIT)], "can:f2")


@pytest.mark.parametrize(
    ("period", "shortest"),
    [(0.02, 20 * MS), (float("nan"), 1), (0.0, 1), (-1.0, 1), (float("inf"), None), (3e38, None)],
)
def test_speriod_as_it_may_stand(period: float, shortest: int | None) -> None:
    bench = Bench(teds={(1, 3): channel_teds(channels()[1], period=period)}).open().operate(1)
    if shortest is None:
        assert bench.reason(subscribe(period=10**12)) == Reason.OUT_OF_RANGE
        return
    assert bench.reason(subscribe(n=113, period=max(shortest, 1 * MS), gap=0)) is None
    if shortest > 1:
        assert bench.reason(subscribe(period=shortest // 1000 * 999)) == Reason.OUT_OF_RANGE


def test_links_that_do_not_offer_all() -> None:
    bench = Bench().open("nfc").operate(1, 4, link="nfc")
    arm = ArmCommand(bytes(16), 10, Action.MARK).command()
    sent(
        bench,
        [
            ("Subscribe over NFC, form wrong", raw_subscribe(0, 0, 0, 1), U.BAD_FORM),
            ("Subscribe over NFC, not claimed", subscribe(channels=(2,)), U.DOES_NOT_FIT),
            ("Drive over NFC, not claimed", drive([6]), U.DOES_NOT_FIT),
            ("Arm over NFC", arm, U.DOES_NOT_FIT),
            ("Arm over NFC, life 61", ArmCommand(bytes(16), 61, 0).command(), U.OUT_OF_RANGE),
            ("Sample over NFC", sample([1]), None),
            ("Clock over NFC", CLOCK, None),
        ],
        "nfc",
    )
    bench.open("ble:2", SessionPort("ble", "ble", 2, mtu=247)).operate(1, link="ble:2")
    sent(
        bench,
        [
            ("239 octets fit an MTU of 247", subscribe(n=113), None),
            ("a stream that waits for a trigger", subscribe(start=WAITS), U.DOES_NOT_FIT),
            ("Arm over BLE", arm, U.DOES_NOT_FIT),
        ],
        "ble:2",
    )
    bench.open("ble:3", SessionPort("ble", "ble", 3, mtu=23)).operate(1, 5, link="ble:3")
    sent(
        bench,
        [
            ("n = 3 of 2 octets fits an MTU of 23", subscribe(n=3), None),
            ("n = 4 does not", subscribe(n=4), U.TOO_LARGE),
            ("nor does an event", subscribe(kind=StreamKind.EVENT, n=1, channels=(5,)), U.TOO_LARGE),
        ],
        "ble:3",
    )


def test_stop_drive_and_arm() -> None:
    bench = Bench().open().operate(1, 4)
    sent(
        bench,
        [
            ("stop of none", stop(0), U.WRONG_STATE),
            ("stop without a number", R(0, 128, 15), U.BAD_FORM),
            ("drive of nothing", drive([]), U.BAD_FORM),
            ("drive of 17", drive(range(1, 18)), U.BAD_FORM),
            ("drive of one that is not there", drive([4, 9]), U.WRONG_STATE),
            ("drive of one not claimed", drive([6, 1]), U.WRONG_STATE),
            ("drive of a sensor", drive([4, 1]), U.NOT_PERMITTED),
            ("drive", drive([4]), None),
            ("arm too short", R(0, 128, 17, bytes(17)), U.BAD_FORM),
            ("arm, life 61", ArmCommand(bytes(16), 61, 0).command(), U.OUT_OF_RANGE),
            ("arm, action 3", ArmCommand(bytes(16), 60, 3).command(), U.OUT_OF_RANGE),
            ("disarm, action 3", ArmCommand(bytes(16), 0, 3).command(), U.OUT_OF_RANGE),
            ("arm", ArmCommand(bytes(16), 60, 2).command(), None),
            ("disarm", ArmCommand(bytes(16), 0, 2).command(), None),
        ],
    )


def test_runs_are_used_up_after_65535() -> None:
    bench = Bench().open().operate(1, 4)
    session = bench.tim._sessions.on("can:f1")
    assert bench.tim._role is not None
    assert session is not None
    bench.tim._role.streams._measuring_of(session).run = 65_534
    assert bench.reason(subscribe()) is None
    assert bench.reason(drive([4])) == Reason.NO_ROOM
    assert bench.reason(subscribe()) == Reason.NO_ROOM
    assert bench.tim._role.streams.running, "a refused one changes nothing"


def test_a_node_without_hardware_answers_1() -> None:
    bench = Bench()
    bench.tim.hardware = None
    bench.tim.__post_init__()
    bench.open()
    commands = [operate(1), sample([1]), CLOCK, subscribe(), read_data_set(1), run_self_test(), idle()]
    assert {bench.reason(command) for command in commands} == {Reason.UNKNOWN_COMMAND}


def test_outside_a_session_they_get_3() -> None:
    numbers = [(1, n) for n in range(5, 13)] + [(g, n) for g in range(2, 8) for n in range(1, 6)]
    numbers += [(128, n) for n in range(12, 21)]
    bench = Bench()
    for link in ("can:f1", "nfc"):
        found = {number: bench.plain(R(0, *number, b"\1"), link).reason for number in numbers}
        assert found == dict.fromkeys(numbers, Reason.NOT_PERMITTED)
    assert bench.plain(R(0, 128, 21)).reason == Reason.UNKNOWN_COMMAND


def test_the_firmwares_shortest_period_counts_beside_that_of_the_teds() -> None:
    """The longest of both, of every channel of the stream."""
    bench = Bench(teds={(2, 3): channel_teds(channels()[2], period=0.001)})
    facts = bench.hardware.channels
    bench.hardware.channels = {**facts, 1: replace(facts[1], shortest=20 * MS), 2: replace(facts[2], shortest=5000)}
    bench.restart()
    bench.open().operate(1, 2)
    sent(
        bench,
        [
            ("shorter than the firmware's", subscribe(period=20 * MS - 1), U.OUT_OF_RANGE),
            ("of the first of two", subscribe(period=20 * MS - 1, channels=(1, 2)), U.OUT_OF_RANGE),
            ("of the second of two", subscribe(period=20 * MS - 1, channels=(2, 1)), U.OUT_OF_RANGE),
            ("the firmware's", subscribe(period=20 * MS, channels=(1, 2)), None),
            ("shorter than the TEDS's, not than the firmware's", subscribe(period=998 * 1000, channels=(2,)), 19),
            ("the TEDS's", subscribe(period=1 * MS, channels=(2,)), None),
        ],
    )


def test_a_gap_of_0_counts_as_one_microsecond() -> None:
    """15 octets are 2 frames: each takes 2 · 1 µs of n · period."""
    bench = Bench().open().operate(1)
    sent(
        bench,
        [
            ("2 µs of every 1.999", subscribe(n=1, period=1999), U.DOES_NOT_FIT),
            ("2 µs of every 2", subscribe(n=1, period=2000), None),
            ("gap 1", subscribe(n=1, period=2000, gap=1), None),
            ("gap 2", subscribe(n=1, period=2000, gap=2), U.DOES_NOT_FIT),
        ],
    )


def test_a_share_of_the_budget_is_rounded_up() -> None:
    """⌈2 · 2 · 10^9 / 4000001⌉ + ⌈2 · 2 · 10^9 / 4 · 10^9⌉ … each part counts whole."""
    bench = Bench().open().operate(1)
    assert bench.reason(subscribe(n=1, gap=2, period=4001)) is None, "⌈999750.06⌉ = 999751 ppm"
    assert bench.reason(subscribe(stream=1, n=1, period=16_064_258)) is None, "⌈248.9⌉ = 249: 10^6 are full"
    assert bench.reason(subscribe(stream=1, n=1, period=16_064_256)) == Reason.DOES_NOT_FIT, "⌈249.0000…⌉ = 250"


def test_over_ble_nothing_streams_to_a_station_that_does_not_hear_it() -> None:
    """Data messages have to be enabled before Subscribe; that is checked before what the channels are."""
    bench = Bench().open("ble:2", SessionPort("ble", "ble", 2, mtu=247, hears=False)).operate(1, 4, link="ble:2")
    sent(
        bench,
        [
            ("form first", raw_subscribe(0, 0, 0, 1), U.BAD_FORM),
            ("not enabled", subscribe(), U.WRONG_STATE),
            ("not enabled, an actuator", subscribe(channels=(4,)), U.WRONG_STATE),
            ("Drive needs no notification", drive([4]), None),
            ("nor does Sample", sample([1]), None),
        ],
        "ble:2",
    )
