"""Every codec of measurement operation, both ways: what is written is read, and no octets do harm."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import GarbledError
from teds_provision.protocol.messages.frames import CommandRefusedError
from teds_provision.protocol.operation import budget
from teds_provision.protocol.operation.can_frames import (
    DataAddress,
    DriveAddress,
    StreamAssembly,
    ble_frame,
    cut,
    data_address,
    drive_address,
    fd_length,
    frames_of,
    next_segment,
    read_ble_frame,
    trigger_identifier,
    trigger_station,
)
from teds_provision.protocol.operation.commands import (
    ChannelState,
    OperateCommand,
    OperationReply,
    PowerReply,
    SampleReply,
    decode_data_set,
)
from teds_provision.protocol.operation.datagram import DatagramSealer, DriveValues, Layout, drive_length, pattern
from teds_provision.protocol.operation.hardware import SessionPort, port_of
from teds_provision.protocol.operation.stream_commands import (
    ArmCommand,
    ClockReply,
    DriveReply,
    StreamKind,
    SubscribeCommand,
    SubscribeReply,
    decode_stopped,
)

u8, u16, u32, u64 = (st.integers(0, (1 << bits) - 1) for bits in (8, 16, 32, 64))
stations, nodes = st.integers(0xF1, 0xF7), st.integers(1, 0xEF)
channel_lists = st.lists(st.integers(1, 255), min_size=1, max_size=16, unique=True).map(tuple)


@given(stations, st.integers(0, 3), st.integers(0, 7), nodes)
def test_data_identifiers(station: int, stream: int, segment: int, node: int) -> None:
    address = DataAddress(station, stream, segment, node)
    assert data_address(address.identifier) == address
    assert address.identifier > 0x18DBFFFF, "every command and reply wins arbitration against it"


@given(nodes, stations)
def test_drive_and_trigger_identifiers(node: int, station: int) -> None:
    address = DriveAddress(node, station)
    assert drive_address(address.identifier) == address
    assert trigger_station(trigger_identifier(station)) == station
    assert data_address(address.identifier) is None
    assert drive_address(trigger_identifier(station)) is None


@given(st.integers(0, (1 << 29) - 1))
def test_an_identifier_is_one_thing_at_most(identifier: int) -> None:
    found = [data_address(identifier), drive_address(identifier), trigger_station(identifier)]
    assert sum(item is not None for item in found) <= 1


@given(st.binary(min_size=9, max_size=240), st.booleans(), st.booleans())
def test_messages_are_cut_and_put_together(message: bytes, fd: bool, drive: bool) -> None:
    pieces = list(cut(message, fd=fd, drive=drive))
    assert len(pieces) == frames_of(len(message), fd=fd, drive=drive)
    assert [piece.segment for piece in pieces[:9]] == [0, 1, 2, 3, 4, 5, 6, 7, 1][: len(pieces)]
    assembly = StreamAssembly(len(message), fd=fd, drive=drive)
    take: Callable[[int, bytes], bytes | None] = (
        (lambda _, data: assembly.add_drive_segment(data)) if drive else assembly.add_segment
    )
    assert [take(*piece) for piece in pieces] == [None] * (len(pieces) - 1) + [message]
    assert assembly.broken == 0
    assert all(len(piece.data) <= (64 if fd else 8) for piece in pieces)
    if fd:
        assert all(len(piece.data) == fd_length(len(piece.data)) for piece in pieces)


@given(st.data())
def test_a_missing_doubled_or_swapped_frame_drops_its_message_and_no_other(data: st.DataObject) -> None:
    length = data.draw(st.integers(17, 240))
    messages = [data.draw(st.binary(min_size=length, max_size=length)) for _ in range(3)]
    pieces = [list(cut(message, fd=False)) for message in messages]
    at = data.draw(st.integers(0, len(pieces[1]) - 1))
    fault = data.draw(st.sampled_from(["missing", "doubled", "swapped"]))
    hurt = list(pieces[1])
    if fault == "missing":
        del hurt[at]
    elif fault == "doubled":
        hurt.insert(at, hurt[at])
    else:
        other = (at + 1) % len(hurt)
        hurt[at], hurt[other] = hurt[other], hurt[at]
    assembly = StreamAssembly(length, fd=False)
    whole = [assembly.add_segment(*piece) for piece in (*pieces[0], *hurt, *pieces[2])]
    found = [message for message in whole if message is not None]
    harmless = fault == "doubled" and at in (0, len(pieces[1]) - 1)  # segment 0 begins again; after the last is nothing
    assert found == (messages if harmless else [messages[0], messages[2]])
    assert assembly.broken >= (0 if harmless else 1) if fault != "missing" or at else True


@given(st.lists(st.tuples(st.integers(0, 7), st.binary(max_size=64)), max_size=60), st.integers(9, 240), st.booleans())
def test_junk_frames_make_no_message_of_another_length(frames: list[tuple[int, bytes]], length: int, fd: bool) -> None:
    assembly = StreamAssembly(length, fd=fd)
    for frame in frames:
        message = assembly.add_segment(*frame)
        assert message is None or len(message) == length


def test_segments_count_from_1_to_7_and_round() -> None:
    segments, segment = [], 0
    for _ in range(16):
        segments.append(segment)
        segment = next_segment(segment)
    assert segments == [0, 1, 2, 3, 4, 5, 6, 7, 1, 2, 3, 4, 5, 6, 7, 1]


@given(st.integers(0, 3), st.binary(min_size=1, max_size=240))
def test_ble_notifications(stream: int, message: bytes) -> None:
    assert read_ble_frame(ble_frame(stream, message)) == (stream, message)
    assert read_ble_frame(ble_frame(stream + 4, message)) is None
    assert read_ble_frame(b"") is None


# -- payloads ----------------------------------------------------------------------------------------------------------


@given(st.integers(0, 3), st.sampled_from(StreamKind), st.integers(1, 255), u16, u64, u64, channel_lists, st.booleans())
def test_subscribe(
    stream: int, kind: StreamKind, n: int, gap: int, period: int, start: int, channels: tuple[int, ...], test: bool
) -> None:
    if kind == StreamKind.EVENT:
        n, channels = 1, channels[:1]
    asked = SubscribeCommand(stream, kind, n, gap, period, start, channels, test)
    assert SubscribeCommand.decode(asked.encode()) == asked


@given(
    st.builds(SubscribeReply, u16, u16, u64),
    st.builds(DriveReply, u16, u16),
    st.builds(ClockReply, u64, u64, u64, u32, u16, u32),
)
def test_replies(subscribed: SubscribeReply, driven: DriveReply, clock: ClockReply) -> None:
    assert SubscribeReply.decode(subscribed.encode()) == subscribed
    assert DriveReply.decode(driven.encode()) == driven
    assert ClockReply.decode(clock.encode()) == clock


@given(st.binary(min_size=16, max_size=16), u8, u8, st.integers(1, 255), u16)
def test_operate_and_arm(octets: bytes, life: int, action: int, channel: int, dead_man: int) -> None:
    arm = ArmCommand(octets, life, action)
    assert ArmCommand.decode(arm.command().payload) == arm
    sensor, actuator = OperateCommand(channel, octets, life), OperateCommand(channel, octets, life, dead_man)
    assert OperateCommand.decode(channel, sensor.command().payload, actuator=False) == sensor
    assert OperateCommand.decode(channel, actuator.command().payload, actuator=True) == actuator


@given(st.booleans(), st.dictionaries(st.integers(1, 255), st.tuples(u8.map(ChannelState), u8)))
def test_operation(measuring: bool, channels: dict[int, tuple[ChannelState, int]]) -> None:
    reply = OperationReply(measuring, channels)
    assert OperationReply.decode(reply.encode()) == reply


@given(
    u8,
    st.none() | st.integers(0, 100),
    st.none() | st.integers(0, 0xFFFE),
    st.none() | st.integers(-0x8000, 0x7FFE),
    st.none() | st.integers(-128, 126),
)
def test_power(flags: int, level: int | None, mv: int | None, ma: int | None, celsius: int | None) -> None:
    reply = PowerReply(flags, level, None if mv is None else mv / 1000, None if ma is None else ma / 1000, celsius)
    assert PowerReply.decode(reply.encode()) == reply


@given(u64, u8, st.binary(max_size=100), u32)
def test_samples_and_drive_values(tick: int, flags: int, data: bytes, until: int) -> None:
    reply = SampleReply(tick, flags, data)
    assert SampleReply.decode(reply.encode(), len(data)) == reply
    values = DriveValues(until, data)
    assert DriveValues.decode(values.encode()) == values
    assert drive_length(len(data)) == 4 + len(values.encode()) + 8


@given(st.binary(max_size=60))
def test_no_octets_of_a_node_do_harm(octets: bytes) -> None:
    """A reply is read or it is GarbledError; nothing else comes out."""
    for decode in (
        SubscribeReply.decode,
        DriveReply.decode,
        ClockReply.decode,
        OperationReply.decode,
        PowerReply.decode,
        decode_stopped,
    ):
        with contextlib.suppress(GarbledError):
            decode(octets)
    for width in (0, 1, 8):
        with contextlib.suppress(GarbledError):
            SampleReply.decode(octets, width)
        with contextlib.suppress(GarbledError):
            assert len(decode_data_set(octets, width)) == width


@pytest.mark.parametrize(
    ("decode", "octets"),
    [
        (SubscribeReply.decode, 12),
        (DriveReply.decode, 4),
        (ClockReply.decode, 34),
        (PowerReply.decode, 7),
        (decode_stopped, 4),
        (lambda octets: SampleReply.decode(octets, 2), 11),
        (lambda octets: decode_data_set(octets, 2), 6),
    ],
    ids=["subscribe", "drive", "clock", "power", "stop", "sample", "data set"],
)
def test_a_reply_of_an_octet_more_or_less_is_garbled(decode: Callable[[bytes], object], octets: int) -> None:
    decode(bytes(octets))
    for wrong in (octets - 1, octets + 1):
        with pytest.raises(GarbledError):
            decode(bytes(wrong))


@pytest.mark.parametrize("offset", ["00000001", "01000000"])
def test_a_data_set_begins_at_offset_0(offset: str) -> None:
    assert decode_data_set(bytes.fromhex("00000000aabb"), 2) == b"\xaa\xbb"
    with pytest.raises(GarbledError):
        decode_data_set(bytes.fromhex(offset + "aabb"), 2)


@pytest.mark.parametrize(
    ("payload", "channels"),
    [
        ("00", {}),
        ("01 01 02 f1 02 00 00 ff 80 00", {1: (2, 0xF1), 2: (0, 0), 255: (0x80, 0)}),
        ("", None),
        ("02", None),
        ("01 01 02", None),
        ("01 01 02 f1 02", None),
        ("01 02 00 00 01 00 00", None),
        ("01 02 00 00 02 00 00", None),
        ("01 00 00 00 01 00 00", None),
    ],
)
def test_operation_has_mode_0_or_1_and_each_channel_once_ascending(
    payload: str, channels: dict[int, tuple[int, int]] | None
) -> None:
    octets = bytes.fromhex(payload)
    if channels is None:
        with pytest.raises(GarbledError):
            OperationReply.decode(octets)
        return
    found = OperationReply.decode(octets)
    assert (found.measuring, dict(found.channels)) == (octets[0] == 1, channels)


def test_of_power_each_field_has_one_value_that_means_unknown() -> None:
    unknown = PowerReply(0x10, None, None, None, None)
    assert PowerReply.decode(bytes.fromhex("10 ff ffff 7fff 7f")) == unknown
    assert unknown.encode().hex() == "10ffffff7fff7f"
    assert PowerReply.decode(bytes.fromhex("00 00 0000 0000 00")) == PowerReply(0, 0, 0.0, 0.0, 0)
    assert PowerReply.decode(bytes.fromhex("1f 64 fffe ff38 80")) == PowerReply(0x1F, 100, 65.534, -0.2, -128)
    assert PowerReply.decode(bytes.fromhex("00 fe 0ce4 8000 ff")) == PowerReply(0, 254, 3.3, -32.768, -1)


@given(st.binary(max_size=60))
def test_no_octets_of_a_station_do_harm(octets: bytes) -> None:
    for decode in (SubscribeCommand.decode, ArmCommand.decode, lambda o: OperateCommand.decode(1, o, actuator=True)):
        with contextlib.suppress(CommandRefusedError):
            decode(octets)


# -- sealing -----------------------------------------------------------------------------------------------------------


@given(st.binary(min_size=16, max_size=16), u32, st.binary(min_size=1, max_size=200), st.data())
def test_a_message_opens_whole_and_unchanged_alone(key: bytes, counter: int, plain: bytes, data: st.DataObject) -> None:
    sealer = DatagramSealer(key)
    message = sealer.seal(counter, plain)
    assert len(message) == 4 + len(plain) + 8
    assert sealer.open(message) == plain
    at = data.draw(st.integers(0, 8 * len(message) - 1))
    bent = bytearray(message)
    bent[at // 8] ^= 1 << at % 8
    assert sealer.open(bytes(bent)) is None
    assert sealer.open(message[: data.draw(st.integers(0, len(message) - 1))]) is None


@given(st.lists(st.integers(1, 8), min_size=1, max_size=16), st.data())
def test_a_layout_cuts_an_instant(widths: list[int], data: st.DataObject) -> None:
    layout = Layout(tuple(range(1, len(widths) + 1)), tuple(widths))
    parts = tuple(data.draw(st.binary(min_size=width, max_size=width)) for width in widths)
    assert layout.cut(b"".join(parts)) == parts
    assert layout.octets == sum(widths)


def test_the_test_pattern_counts_and_runs_over() -> None:
    assert [pattern(3, 1, k)[0] for k in (0, 1, 252, 253)] == [3, 4, 255, 0]
    assert pattern(1, 2, 65_535) == b"\0\0"


# -- links -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("link", "port"),
    [
        ("nfc", SessionPort("nfc", "nfc", 1)),
        ("can:f1", SessionPort("can", "can", 0xF1)),
        ("can1:f7", SessionPort("can", "can1", 0xF7)),
        ("ble:2", SessionPort("ble", "ble", 2)),
    ],
)
def test_a_links_name_says_its_port(link: str, port: SessionPort) -> None:
    assert port_of(link) == port


@pytest.mark.parametrize(
    ("n", "classic", "worst"), [(1, 5.3, 6.2), (25, 0.86, 1.02), (57, 0.76, 0.90), (113, 0.72, 0.85)]
)
def test_the_load_of_the_papers_sensor_on_500_kbit(n: int, classic: float, worst: float) -> None:
    """16 bits at 10 kHz: the table of section 6. The mean lies between no stuffing and the worst."""
    length = 13 + 2 * n
    assert budget.bus_load(length, n, 100_000, bitrate=500_000) == pytest.approx(worst, abs=0.006)
    bare = budget.bus_load(length, n, 100_000, bitrate=500_000, worst=False)
    assert bare < classic < worst


@pytest.mark.parametrize(("n", "mean"), [(1, 1.86), (25, 0.155), (57, 0.136), (113, 0.131)])
def test_the_load_of_the_papers_sensor_on_can_fd(n: int, mean: float) -> None:
    length = 13 + 2 * n
    bare = budget.bus_load(length, n, 100_000, bitrate=500_000, data_bitrate=2_000_000, worst=False)
    most = budget.bus_load(length, n, 100_000, bitrate=500_000, data_bitrate=2_000_000)
    assert bare < mean < most
    assert most / bare < 1.35


@pytest.mark.parametrize(("octets", "bare", "worst"), [(0, 67, 80), (1, 75, 90), (7, 123, 150), (8, 131, 160)])
def test_bits_of_a_classic_frame(octets: int, bare: int, worst: int) -> None:
    """54 bits up to the CRC and 8 an octet, a stuff bit after the fifth and then every fourth, 13 without any."""
    assert (budget.classic_bits(octets, worst=False), budget.classic_bits(octets)) == (bare, worst)


@pytest.mark.parametrize(
    ("octets", "bare", "worst"),
    [
        (0, 5 + 27, 5 + 27 + 1),
        (8, 69 + 27, 69 + 27 + 17),
        (16, 133 + 27, 133 + 27 + 33),  # a CRC of 17 bits, the stuff count 4, fixed stuff bits 6
        (20, 165 + 32, 165 + 32 + 41),  # 21, 4 and 7
        (64, 517 + 32, 517 + 32 + 129),
    ],
)
def test_bits_of_an_fd_frame(octets: int, bare: int, worst: int) -> None:
    """36 bits up to the switch of the bit rate, 8 stuff bits in them at most, and 13 at the end, are slow."""
    never = 10**12
    assert round(budget.fd_seconds(octets, 1, never, worst=False)) == 36 + 13
    assert round(budget.fd_seconds(octets, 1, never)) == 36 + 8 + 13
    assert round(budget.fd_seconds(octets, never, 1, worst=False)) == bare
    assert round(budget.fd_seconds(octets, never, 1)) == worst


@pytest.mark.parametrize(("length", "bits"), [(8, 160), (15, 310), (16, 320), (17, 410), (239, 29 * 160 + 150)])
def test_a_message_loads_a_classic_bus_with_full_frames_and_one_of_the_rest(length: int, bits: int) -> None:
    assert budget.bus_load(length, 2, 10**9, bitrate=1000) == pytest.approx(bits / 1000 / 2)


def test_a_message_loads_an_fd_bus_with_frames_of_64_and_one_of_the_next_length() -> None:
    whole, rest = (budget.fd_seconds(octets, 500_000, 2_000_000) for octets in (64, 12))
    for length, seconds in ((64, whole), (128, 2 * whole), (73, whole + rest), (63, whole), (9, rest)):
        load = budget.bus_load(length, 1, 10**9, bitrate=500_000, data_bitrate=2_000_000)
        assert load == pytest.approx(seconds)


def test_frames_of_a_message() -> None:
    lengths = (1, 8, 9, 15, 64, 65, 240)
    assert [budget.frames(length, link="can", fd=False) for length in lengths] == [1, 1, 2, 2, 8, 9, 30]
    assert [budget.frames(length, link="can", fd=True) for length in lengths] == [1, 1, 1, 1, 1, 2, 4]
    assert {budget.frames(length, link="ble", fd=False) for length in lengths} == {1}


@pytest.mark.parametrize(
    ("identifier", "found"),
    [
        (0x18EF01F1, (0x01, 0xF1)),
        (0x18EFEFF7, (0xEF, 0xF7)),
        (0x18EF00F1, None),
        (0x18EFF0F1, None),
        (0x18EF21F0, None),
        (0x18EF21F8, None),
        (0x18EF0000, None),
        (0x18EE21F1, None),
        (0x1CFF2001, (0xF1, 0, 0, 0x01)),
        (0x1CFFFFEF, (0xF7, 3, 7, 0xEF)),
        (0x1CFF4921, (0xF2, 1, 1, 0x21)),
        (0x1CFF2000, None),
        (0x1CFF20F0, None),
        (0x1CFF0021, None),  # an Announce
        (0x1CFE2021, None),
        (0x18FF00F1, 0xF1),
        (0x18FF00F7, 0xF7),
        (0x18FF00F0, None),
        (0x18FF00F8, None),
        (0x18FF01F1, None),
    ],
)
def test_what_an_identifier_names(identifier: int, found: tuple[int, ...] | int | None) -> None:
    seen = [data_address(identifier), drive_address(identifier), trigger_station(identifier)]
    assert [each for each in seen if each is not None] == ([] if found is None else [found])


def pieces(assembly: StreamAssembly, *frames: tuple[int, int]) -> list[int | None]:
    """Give frames of (segment, octets); what comes of each: the octets of a whole message."""
    whole = [assembly.add_segment(segment, bytes([segment]) * octets) for segment, octets in frames]
    return [None if message is None else len(message) for message in whole]


def test_frames_that_make_no_message_are_counted_once_and_leave_nothing() -> None:
    """A message of 15 octets: 8 and 7."""
    doubled = StreamAssembly(15, fd=False)
    assert pieces(doubled, (0, 8), (0, 8), (1, 7)) == [None, None, 15]
    assert (doubled.broken, doubled.wrong) == (1, 0)
    missing = StreamAssembly(15, fd=False)
    assert pieces(missing, (1, 7), (0, 8), (2, 7), (1, 7), (3, 7), (0, 8), (1, 7)) == [None] * 6 + [15]
    assert (missing.broken, missing.wrong) == (1, 0), "frames before the first segment 0 belong to no message"
    for bad in ((0, 7), (0, 9)):
        short = StreamAssembly(15, fd=False)
        assert pieces(short, bad, (1, 7), (0, 8), (1, 8), (1, 7), (0, 8), (1, 7)) == [None] * 6 + [15]
        assert (short.broken, short.wrong) == (0, 2)


def test_the_last_frame_of_fd_has_the_next_length_that_fd_knows() -> None:
    """73 octets: 64 and 9, which go in 12; a Drive message of 20 goes with its segment in 24."""
    data = StreamAssembly(73, fd=True)
    assert pieces(data, (0, 64), (1, 12), (0, 64), (1, 9), (0, 64), (1, 12)) == [None, 73, None, None, None, 73]
    assert (data.broken, data.wrong) == (0, 1)
    driven = StreamAssembly(20, fd=True, drive=True)
    assert [driven.add_drive_segment(bytes(octets)) for octets in (21, 24, 20)] == [None, bytes(20), None]
    assert driven.wrong == 2


def test_a_drive_message_has_7_octets_a_frame_and_segments_to_7() -> None:
    message = bytes(range(60))
    frames = list(cut(message, fd=False, drive=True))
    assert [piece.data[0] for piece in frames] == [0, 1, 2, 3, 4, 5, 6, 7, 1]
    assembly = StreamAssembly(60, fd=False, drive=True)
    assert [assembly.add_drive_segment(piece.data) for piece in frames] == [None] * 8 + [message]
    assert assembly.add_drive_segment(bytes([8]) + bytes(7)) is None
    assert assembly.add_drive_segment(b"") is None
    assert (assembly.broken, assembly.wrong) == (0, 0), "no segment at all"
