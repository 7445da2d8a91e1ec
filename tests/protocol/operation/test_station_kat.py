"""Known answers of operation.md on the station's side: every message, frame, key, token and load of the vectors."""

from __future__ import annotations

import pytest

from teds_provision.protocol.announce import Announce, uuid_crc
from teds_provision.protocol.messages.frames import Command, decode_reply
from teds_provision.protocol.operation import budget
from teds_provision.protocol.operation.can_frames import (
    DataAddress,
    DriveAddress,
    StreamAssembly,
    ble_frame,
    cut,
    data_address,
    drive_address,
    read_ble_frame,
    trigger_identifier,
    trigger_station,
)
from teds_provision.protocol.operation.commands import (
    OPERATION,
    POWER,
    ChannelState,
    OperateCommand,
    OperationReply,
    PowerFlag,
    PowerReply,
    SampleReply,
    decode_data_set,
    idle,
    read_data_set,
    run_self_test,
    sample,
    set_values,
    write_data_set,
)
from teds_provision.protocol.operation.datagram import Layout, drive_key, stream_key
from teds_provision.protocol.operation.driving import Driver
from teds_provision.protocol.operation.stream_commands import (
    CLOCK,
    NONE,
    WAITS,
    Action,
    ClockReply,
    DriveReply,
    StreamKind,
    SubscribeCommand,
    SubscribeReply,
    decode_stopped,
    drive,
    stop,
)
from teds_provision.protocol.operation.subscription import Receiver, StreamPlan, TickBounds
from teds_provision.protocol.operation.timing import START_AFTER_MARK, ClockSample, TriggerToken

from .kat import KAT, MESSAGE_KEY, NODE, STATION, UUID, WIDTHS, can_frame

STREAMS = [pytest.param(stream, id=stream["name"]) for stream in KAT["streams"]]
ANY = TickBounds(0, 1 << 63)
COMMANDS = {entry["counter"]: entry for entry in KAT["commands"]}


def plan_of(stream: dict) -> StreamPlan:
    channels = tuple((channel, WIDTHS[channel]) for channel in stream["channels"])
    start = stream["start"] if stream["start"] == WAITS else 0
    return StreamPlan.for_channels(
        stream["stream"],
        channels,
        n=stream["n"],
        period=stream["period"],
        kind=StreamKind(stream["kind"]),
        gap=1000,
        start=start,
        test_pattern=stream["test_pattern"],
    )


@pytest.mark.parametrize("stream", STREAMS)
def test_messages_are_opened_as_published(stream: dict) -> None:
    plan = plan_of(stream)
    reply = SubscribeReply(stream["run"], stream["length"], stream["start"])
    assert plan.accept(reply.encode(), TickBounds(stream["start"], stream["start"])) == reply
    receiver = Receiver(plan, reply, MESSAGE_KEY, oldest=1 << 62)
    for entry in stream["messages"]:
        found = receiver.open_message(bytes.fromhex(entry["message"]), ANY)
        if stream["start"] == WAITS:
            assert found is None
            (found,) = receiver.begin(KAT["trigger"]["start"])
        assert found is not None
        plain = bytes.fromhex(entry["plaintext"])
        timed = stream["kind"] != StreamKind.PERIODIC
        assert (found.counter, found.flags) == (entry["counter"], plain[0])
        assert found.data == plain[9 if timed else 1 :]
        assert found.test_pattern == stream["test_pattern"]
        if timed:
            assert found.tick == int.from_bytes(plain[1:9], "big")
        else:
            assert found.index == entry["counter"] * stream["n"]
        if stream["test_pattern"]:
            assert found.data == receiver.expected(found)
    receiver.finish(stream["stop"])
    counters = [entry["counter"] for entry in stream["messages"]]
    assert receiver.counts.lost == stream["stop"] - len(counters)
    assert receiver.counts.good == len(counters)


@pytest.mark.parametrize("stream", STREAMS)
def test_messages_are_cut_and_put_together_as_published(stream: dict) -> None:
    for entry in stream["messages"]:
        message = bytes.fromhex(entry["message"])
        for form, fd in (("can", False), ("can_fd", True)):
            frames = [can_frame(text) for text in entry[form]]
            pieces = list(cut(message, fd=fd))
            assert [
                (DataAddress(STATION, stream["stream"], piece.segment, NODE).identifier, piece.data) for piece in pieces
            ] == frames
            assert budget.frames(len(message), link="can", fd=fd) == len(frames)
            assembly, whole = StreamAssembly(len(message), fd=fd), None
            for identifier, data in frames:
                address = data_address(identifier)
                assert address is not None
                assert address[:2] == (STATION, stream["stream"])
                assert whole is None
                whole = assembly.add_segment(address.segment, data)
            assert whole == message
        assert ble_frame(stream["stream"], message).hex() == entry["ble"]
        assert read_ble_frame(bytes.fromhex(entry["ble"])) == (stream["stream"], message)


def test_keys_of_runs_are_those_of_the_vectors() -> None:
    for entry in KAT["keys"]:
        assert stream_key(MESSAGE_KEY, entry["run"]).hex() == entry["stream"]
        assert drive_key(MESSAGE_KEY, entry["run"]).hex() == entry["drive"]


def test_drive_messages_are_sealed_as_published() -> None:
    drive = KAT["drive"]
    layout = Layout(tuple(drive["channels"]), tuple(WIDTHS[channel] for channel in drive["channels"]))
    driver = Driver(layout, DriveReply(drive["run"], drive["length"]), MESSAGE_KEY, dead_man=10_000)
    for entry in drive["messages"]:
        driver.next = entry["counter"]
        values = tuple(value.to_bytes(2, "big") for value in entry["values"])
        now = entry["until_us"] * 1000 - 20_000_000
        message = driver.seal(values, TickBounds(now, now), hold=20_000_000)
        assert message.hex() == entry["message"]
        for form, fd in (("can", False), ("can_fd", True)):
            frames = [can_frame(text) for text in entry[form]]
            assert [piece.data for piece in cut(message, fd=fd, drive=True)] == [data for _, data in frames]
            assert {drive_address(identifier) for identifier, _ in frames} == {DriveAddress(NODE, STATION)}
            assembly = StreamAssembly(len(message), fd=fd, drive=True)
            assert [assembly.add_drive_segment(data) for _, data in frames][-1] == message
        assert ble_frame(0, message).hex() == entry["ble"]


def test_the_trigger_is_the_vectors() -> None:
    trigger = KAT["trigger"]
    token = TriggerToken(bytes.fromhex(trigger["T"]))
    assert token.commitment.hex() == trigger["C"]
    identifier, data = can_frame(trigger["can"])
    assert (trigger_identifier(STATION), token.octets) == (identifier, data)
    assert trigger_station(identifier) == STATION
    assert trigger["start"] == trigger["mark"] + START_AFTER_MARK


def test_the_announce_is_the_vectors() -> None:
    identifier, data = can_frame(KAT["announce"])
    assert Announce.decode(identifier, data) == Announce(NODE, 2, uuid_crc(UUID))
    assert data_address(identifier) is None, "no data frame, though it shares the prefix"


def test_the_budget_is_the_vectors() -> None:
    for entry in KAT["load"]:
        count = budget.frames(entry["octets"], link="can", fd=entry["fd"])
        assert budget.share(count, max(1, entry["gap"]), entry["n"], entry["period"]) == entry["ppm"]


def inner(counter: int) -> Command:
    octets = bytes.fromhex(COMMANDS[counter]["inner"])
    return Command(int.from_bytes(octets[:2], "big"), octets[2], octets[3], octets[6:])


def payload(counter: int) -> bytes:
    return decode_reply(bytes.fromhex(COMMANDS[counter]["inner_reply"])).payload


def test_every_command_is_built_as_published() -> None:
    digest = bytes.fromhex(KAT["digest"])
    trigger = TriggerToken(bytes.fromhex(KAT["trigger"]["T"]))
    built = {
        1: OPERATION,
        2: sample([1]),
        3: OperateCommand(0, bytes(16), 10).command(),
        4: OperateCommand(0, digest, 61).command(),
        5: CLOCK,
        6: OperateCommand(0, digest, 60).command(),
        7: read_data_set(1),
        8: sample([3, 1]),
        9: write_data_set(1, bytes(2)),
        10: OperateCommand(4, digest, 60, 10_000).command(),
        12: write_data_set(4, (1000).to_bytes(2, "big")),
        14: set_values([(4, (2000).to_bytes(2, "big")), (6, (3000).to_bytes(2, "big"))]),
        30: run_self_test(1),
        33: trigger.arm(Action.START, 20).command(),
        37: drive([4, 6]),
        42: POWER,
        43: idle(),
        44: stop(0),
    }
    for counter, command in built.items():
        assert command == inner(counter), COMMANDS[counter]["name"]
    for stream in KAT["streams"]:
        entry = next(e for e in KAT["commands"] if e["name"] == f"Subscribe: {stream['name']}")
        assert plan_of(stream).command() == inner(entry["counter"])
        assert SubscribeCommand.decode(inner(entry["counter"]).payload) == plan_of(stream).subscribe
        assert SubscribeReply.decode(payload(entry["counter"])) == SubscribeReply(
            stream["run"], stream["length"], stream["start"]
        )
        ended = next(e for e in KAT["commands"] if e["name"] == f"Stop {stream['stream']}: {stream['name']}")
        assert decode_stopped(payload(ended["counter"])) == stream["stop"]


def test_every_reply_is_read_as_published() -> None:
    idle_state = OperationReply.decode(payload(1))
    assert not idle_state.measuring
    assert idle_state.channels[4] == (ChannelState.ACTUATOR | ChannelState.SAFE, 0)
    assert idle_state.channels[5] == (ChannelState.EVENT_SENSOR, 0)
    claimed = OperationReply.decode(payload(41))
    assert claimed.measuring
    assert claimed.channels[4] == (ChannelState.ACTUATOR | ChannelState.CLAIMED_HERE, STATION)
    assert ClockReply.decode(payload(5)) == ClockReply(67_900_000, 67_900_000, 0, 1000, 50, NONE)
    assert ClockReply.decode(payload(34)).mark == KAT["trigger"]["mark"]
    assert ClockReply.decode(payload(40)).last == KAT["drive"]["messages"][-1]["counter"]
    assert decode_data_set(payload(7), 2) == bytes.fromhex("0046")
    assert SampleReply.decode(payload(8), 6) == SampleReply(72_100_000, 0, bytes.fromhex("000000d80048"))
    assert DriveReply.decode(payload(37)) == DriveReply(9, 20)
    assert PowerReply.decode(payload(42)) == PowerReply(PowerFlag.BATTERY, 87, 3.7, -0.012, 23)
    for counter in (1, 5, 8, 37, 42):
        reply = {1: OperationReply, 5: ClockReply, 37: DriveReply, 42: PowerReply}.get(counter)
        if reply is not None:
            assert reply.decode(payload(counter)).encode() == payload(counter)


def test_a_clock_sample_bounds_the_offset() -> None:
    clock = ClockReply(1_005_000, 1_006_000, 0, 1000, 50, NONE)
    seen = ClockSample(10_000, 21_000, clock)
    assert seen.offset == ((1_005_000 - 10_000) + (1_006_000 - 21_000)) / 2
    assert seen.error(21_000) == (11_000 - 1_000) / 2 + 1000
    assert seen.error(21_000 + 1_000_000, own_drift=50) == 6000 + 100
