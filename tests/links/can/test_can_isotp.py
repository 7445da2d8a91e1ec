"""ISO-TP between a pair of addresses, in memory: any manners of the other side, and any frames at all."""

from __future__ import annotations

import os
import threading
import time
from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.links.can import pacing
from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.bus_multiplexer import BroadcastReplies
from teds_provision.links.can.isotp import (
    Pair,
    Reassembly,
    addresses,
    consecutive_frames,
    first_frame,
    gap_seconds,
    padded,
    physical_id,
    read_single,
    single,
)
from teds_provision.links.can.pacing import Pacer, classic_bits, fd_seconds
from teds_provision.links.can.spec import parse_spec
from tests.pace import PATIENCE

STATION, NODE = 0xF1, 0x21


class Wire:
    """Two pairs, and the frames between them; ``manners`` are can-isotp parameters of the node."""

    def __init__(self, *, fd: bool = False, **manners: object) -> None:
        self.frames: deque[Frame] = deque()
        self.log: list[Frame] = []
        self.station = Pair(STATION, NODE, self._put, fd=fd)
        self.node = Pair(NODE, STATION, self._put)
        for key, value in manners.items():
            self.node._logic.params.set(key, value, validate=False)
        self.node._logic.load_params()

    def _put(self, frame: Frame) -> None:
        self.frames.append(frame)
        self.log.append(frame)

    def settle(self, seconds: float = PATIENCE) -> None:
        until = time.monotonic() + seconds
        while time.monotonic() < until and (self.frames or self.station.sending or self.node.sending):
            if self.frames:
                frame = self.frames.popleft()
                assert self.station.handle_frame(frame) or self.node.handle_frame(frame)
            self.station.run()
            self.node.run()


@pytest.mark.parametrize("length", [1, 6, 7, 8, 62, 63, 700, 4095])
@pytest.mark.parametrize(
    "manners",
    [
        {},
        {"blocksize": 0},
        {"blocksize": 1},
        {"blocksize": 255, "stmin": 0xF1},
        {"blocksize": 8, "tx_padding": None},
        {"tx_padding": 0x55},
    ],
    ids=str,
)
def test_takes_any_block_size_gap_and_padding(length: int, manners: dict[str, object]) -> None:
    wire = Wire(**manners)
    body = os.urandom(length)
    wire.station.send(body)
    wire.settle()
    assert wire.node.received() == body
    wire.node.send(body[::-1])
    wire.settle()
    assert wire.station.received() == body[::-1]
    assert wire.station.error == ""


def test_our_frames_are_what_the_profile_says() -> None:
    wire = Wire()
    wire.station.send(bytes(301))
    wire.settle()
    assert {frame.identifier for frame in wire.log} == {0x18DA21F1, 0x18DAF121}
    assert all(len(frame.data) == 8 and not frame.fd for frame in wire.log)
    assert next(frame.data for frame in wire.log if frame.data[0] == 0x30) == bytes.fromhex("301000cccccccccc")
    assert wire.log[-1].data[1:] == b"\x00" + b"\xcc" * 6


@pytest.mark.parametrize("fd", [False, True])
def test_a_pair_asks_and_waits_as_the_profile_says(fd: bool) -> None:
    params = Pair(0x21, 0xF1, lambda _frame: None, fd=fd)._logic.params
    assert (params.blocksize, params.stmin, params.tx_padding) == (16, 0, 0xCC)
    assert (params.rx_flowcontrol_timeout, params.rx_consecutive_frame_timeout) == (1000, 1000), "N_Bs and N_Cr, ms"
    assert params.wftmax >= 10, "ten WAITs are borne"
    assert (params.max_frame_size, params.tx_data_length) == (4095, 64 if fd else 8)


def test_the_node_answers_in_the_form_in_which_it_was_asked() -> None:
    wire = Wire(fd=True)
    wire.station.send(bytes(200))
    wire.settle()
    assert wire.node.received() == bytes(200)
    wire.node.send(bytes(200))
    wire.settle()
    assert wire.station.received() == bytes(200)
    assert all(frame.fd for frame in wire.log)
    wire.log.clear()
    wire.node.handle_frame(Frame(physical_id(NODE, STATION), single(b"abc")))
    wire.node.send(bytes(20))
    assert not wire.log[0].fd


def test_more_than_4095_octets_are_answered_with_overflow() -> None:
    wire = Wire()
    wire.node.handle_frame(Frame(physical_id(NODE, STATION), bytes.fromhex("1000000010000000")))
    overflow = wire.log[-1]
    assert overflow.data[:1] == b"\x32"
    wire.station.send(bytes(100))
    wire.station.handle_frame(overflow)
    assert wire.station.overflow


@pytest.mark.parametrize("length", [0, 1, 8, 57, 58, 1025, 4095, 4096])
@pytest.mark.parametrize("fd", [False, True])
def test_a_length_in_32_bits_that_12_bits_hold_is_nobodys(length: int, fd: bool) -> None:
    data = (b"\x10\x00" + length.to_bytes(4, "big")).ljust(64 if fd else 8, b"A")
    wire = Wire()
    wire.node.handle_frame(Frame(physical_id(NODE, STATION), data, fd))
    assert wire.node.receiving is False
    assert (Reassembly.begin(STATION, Frame(0, data, fd)) is None) == (length <= 4095)


@pytest.mark.parametrize("octets", [2, 3, 7, 8, 12, 64])
@pytest.mark.parametrize("first", [8, 12, 64])
def test_a_consecutive_frame_as_long_as_none_can_be_is_ignored(first: int, octets: int) -> None:
    """Only the last may be shorter than the first frame, and none longer; the good one goes on."""
    fd, body = first > 8, bytes(range(100)) * 2
    sent: list[Frame] = []
    pair = Pair(NODE, STATION, sent.append)

    def take(data: bytes) -> None:
        pair.handle_frame(Frame(physical_id(NODE, STATION), data, fd))

    take(b"\x10" + bytes([len(body)]) + body[: first - 2])
    at, number = first - 2, 1
    while at < len(body):
        could_be_the_last = octets < first and octets - 1 >= len(body) - at
        if octets != first and not could_be_the_last:
            take(bytes([0x20 | number & 15]) + b"\xee" * (octets - 1))
        take(bytes([0x20 | number & 15]) + body[at : at + first - 1])
        at, number = at + first - 1, number + 1
    assert pair.received() == body


@pytest.mark.parametrize(
    ("octets", "data"),
    [
        (8, "00065500008007ff"),  # the escape of a length in a frame of 8 octets
        (8, "000755000080070000"),
        (12, "0755000080070000cccccccc"),  # a longer frame without it
        (12, "000755000080070000cccccc"),  # with a length that needs none
        (12, "000b55000080070000cccccc"),  # with one that it does not hold
    ],
)
def test_a_single_frame_has_its_length_where_the_standard_wants_it(octets: int, data: str) -> None:
    frame = Frame(physical_id(NODE, STATION), bytes.fromhex(data)[:octets].ljust(octets, b"\xcc"), octets > 8)
    wire = Wire()
    wire.node.handle_frame(frame)
    assert wire.node.received() is None
    assert read_single(frame.data) is None


@pytest.mark.parametrize(("octets", "least"), [(8, 8), (12, 11), (64, 63)])
def test_a_first_frame_of_what_fits_one_frame_is_ignored(octets: int, least: int) -> None:
    """FF_DLmin of ISO 15765-2."""
    for length in (1, 7, 8, least - 1, least):
        data = (b"\x10" + bytes([length])).ljust(octets, b"A")
        wire = Wire(fd=octets > 8)
        wire.node.handle_frame(Frame(physical_id(NODE, STATION), data, octets > 8))
        assert wire.node.receiving is (length >= least), length
        assert (Reassembly.begin(STATION, Frame(0, data, octets > 8)) is not None) is (length >= least)


def test_a_message_that_comes_by_and_by_is_dropped_as_a_whole() -> None:
    """Each frame just in time for N_Cr, and the message takes longer than 5 s: the next one is heard."""
    now = 100.0
    sent: list[Frame] = []
    pair = Pair(NODE, STATION, sent.append, clock=lambda: now)

    def take(data: bytes) -> None:
        pair.handle_frame(Frame(physical_id(NODE, STATION), data))

    take(b"\x10\x64" + bytes(6))
    for number in range(1, 9):
        now += 0.7
        take(bytes([0x20 | number]) + bytes(7))
        assert pair.receiving is (now < 105.0), now
        pair.run()
    assert pair.received() is None
    take(b"\x10\x0a" + bytes(6))
    take(b"\x21" + bytes(7))
    assert pair.received() == bytes(10)


@pytest.mark.parametrize("octet", range(0xF1, 0xFA))
def test_a_gap_of_hundreds_of_microseconds_is_kept(octet: int) -> None:
    sent: list[Frame] = []
    station = Pair(STATION, NODE, sent.append)
    station.send(bytes(30))
    station.handle_frame(Frame(physical_id(STATION, NODE), bytes([0x30, 0, octet])))
    gap = (octet - 0xF0) / 10_000
    assert 0 <= station.due_in(1.0) <= gap
    began = time.monotonic()
    while station.sending:
        time.sleep(station.due_in(1.0))
        station.run()
    assert [frame.data[0] for frame in sent] == [0x10, 0x21, 0x22, 0x23, 0x24]
    assert time.monotonic() - began >= 3 * gap
    assert gap_seconds(octet) == pytest.approx((octet - 0xF0) / 10_000)


def test_a_frame_out_of_sequence_tears_a_message_and_the_one_before_does_not() -> None:
    partial = Reassembly.begin(NODE, Frame(0, b"\x10\x30" + bytes(6)))
    assert partial is not None
    assert partial.add_frame(b"\x21" + bytes(7)) == "more"
    assert partial.add_frame(b"\x21" + bytes(7)) == "again"
    assert partial.add_frame(b"\x21" + b"another") == "torn"
    assert partial.add_frame(b"\x23" + bytes(7)) == "torn"
    assert partial.add_frame(b"\x20" + bytes(7)) == "torn"
    assert partial.add_frame(b"\x22" + bytes(7)) == "more"


def test_a_flow_control_is_due_after_each_sixteen_frames() -> None:
    head, rest = first_frame(bytes(range(200)) * 2, fd=False)
    partial = Reassembly.begin(0x21, Frame(0x18DAF121, head))
    assert partial is not None
    taken = [partial.add_frame(frame) for frame in consecutive_frames(rest, fd=False)]
    assert [number for number, what in enumerate(taken, 1) if what == "block"] == [16, 32, 48]
    assert (taken[-1], bytes(partial.octets)) == ("whole", bytes(range(200)) * 2)


def test_a_second_first_frame_begins_again() -> None:
    wire = Wire()
    head = Frame(physical_id(NODE, STATION), bytes.fromhex("100a010203040506"))
    for data in ("100a090909090909", "100a010203040506", "210708090a"):
        wire.node.handle_frame(Frame(head.identifier, bytes.fromhex(data)))
    assert wire.node.received() == bytes(range(1, 11))
    assert wire.node.received() is None


def test_wait_frames_and_a_reserved_gap_are_borne() -> None:
    sent: list[Frame] = []
    station = Pair(STATION, NODE, sent.append)
    flow = physical_id(STATION, NODE)
    station.send(bytes(20))
    for data in ("310000", "310000", "3000fa"):
        station.handle_frame(Frame(flow, bytes.fromhex(data)))
    until = time.monotonic() + PATIENCE
    while station.sending and time.monotonic() < until:
        time.sleep(station.due_in(0.05))
        station.run()
    assert [frame.data[0] for frame in sent] == [0x10, 0x21, 0x22]


@given(st.lists(st.binary(max_size=64), max_size=30), st.booleans())
@settings(max_examples=60, deadline=None)
def test_no_frames_break_a_pair(datas: list[bytes], fd: bool) -> None:
    wire = Wire(fd=fd)
    wire.station.send(bytes(30))
    for data in datas:
        wire.station.handle_frame(Frame(physical_id(STATION, NODE), data, fd))
    wire.station.abandon()
    wire.station.speak(fd=False)
    wire.log.clear()
    wire.frames.clear()
    wire.station.send(b"still here")
    wire.settle()
    assert wire.node.received() == b"still here"


def frames_of(node: int, body: bytes) -> list[Frame]:
    frames: list[Frame] = []
    pair = Pair(node, STATION, frames.append)
    pair.send(body)
    pair.handle_frame(Frame(physical_id(node, STATION), b"\x30\x00\x00"))
    return frames


def test_answers_of_many_nodes_come_apart() -> None:
    gathering = BroadcastReplies(STATION, 7)
    sequences = [frames_of(node, b"\x07" + bytes([node]) * 26) for node in range(1, 21)]
    flows = [gathering.add_frame(frame) for frames in zip(*sequences, strict=True) for frame in frames]
    assert gathering.answers == {node: bytes([node]) * 26 for node in range(1, 21)}
    assert not gathering.conflicts
    assert not gathering.busy
    assert [flow.identifier for flow in flows if flow] == [physical_id(node, STATION) for node in range(1, 21)]


def test_an_answer_to_an_earlier_identify_is_sent_away() -> None:
    gathering = BroadcastReplies(STATION, 7)
    first = frames_of(NODE, b"\x06" + bytes(26))[0]
    flow = gathering.add_frame(first)
    assert flow is not None
    assert flow.data[0] == 0x32
    for frame in frames_of(NODE, b"\x07" + bytes(26)):
        gathering.add_frame(frame)
    assert gathering.answers == {NODE: bytes(26)}
    assert not gathering.conflicts


@pytest.mark.parametrize("order", [(0, 0, 1, 1), (0, 2), (0, 1, 1)])
def test_two_first_frames_or_a_broken_sequence_are_a_conflict(order: tuple[int, ...]) -> None:
    frames = frames_of(NODE, b"\x07" + bytes(26))
    gathering = BroadcastReplies(STATION, 7)
    for number in order:
        gathering.add_frame(frames[number])
    assert gathering.conflicts == {NODE}


def test_a_second_first_frame_of_one_address_is_a_conflict_and_certain_if_it_differs() -> None:
    """Two nodes may have the same answer: an equal one counts as well, although the answer is whole after it."""
    frames = frames_of(NODE, b"\x07" + bytes(10))
    assert len(frames) == 2
    other = frames_of(NODE, b"\x07" + bytes([1]) * 10)[0]
    for first, clashes in ((frames[0], set()), (other, {NODE})):
        gathering = BroadcastReplies(STATION, 7)
        for frame in (first, *frames):
            gathering.add_frame(frame)
        assert gathering.answers == {NODE: bytes(10)}
        assert (gathering.conflicts, gathering.repeated, gathering.clashes) == ({NODE}, {NODE}, clashes)


@given(st.lists(st.tuples(st.integers(0x18DAF101, 0x18DAF104), st.binary(max_size=64)), max_size=40))
def test_no_frames_break_a_gathering(frames: list[tuple[int, bytes]]) -> None:
    gathering = BroadcastReplies(STATION, 7)
    for identifier, data in frames:
        flow = gathering.add_frame(Frame(identifier, data))
        assert flow is None or len(flow.data) == 8


@given(st.binary(min_size=1, max_size=62))
def test_single_frames_round_trip(body: bytes) -> None:
    data = single(body, fd=len(body) > 7)
    assert read_single(data) == body
    assert len(data) in (8, 12, 16, 20, 24, 32, 48, 64)


@given(st.binary(max_size=64))
def test_any_octets_as_a_single_frame(data: bytes) -> None:
    body = read_single(data)
    assert body is None or 0 < len(body) < len(data)


def test_addresses_are_those_of_normal_fixed_addressing() -> None:
    assert physical_id(0x21, 0xF1) == 0x18DA21F1
    assert addresses(0x18DA21F1) == (0x21, 0xF1)
    assert addresses(0x18DBFFF1) is None
    assert padded(b"a", fd=True) == b"a" + b"\xcc" * 7


def test_bit_times_lie_within_those_of_the_standard() -> None:
    # an extended frame with 8 octets has 131 bits without stuffing and at most 160 with it
    assert classic_bits(0, bytes(8)) > classic_bits(0x15555555, b"\x55" * 8) >= 131
    assert max(classic_bits(0, bytes(8)), classic_bits(0x1FFFFFFF, b"\xff" * 8)) <= 160
    assert classic_bits(0x15555555, b"") >= 67
    # eight times the octets in one FD frame at four times the rate
    assert fd_seconds(0x18DA21F1, bytes(64), 500_000, 2_000_000) < 3 * classic_bits(0x18DA21F1, bytes(8)) / 500_000


def bits_of(fields: str) -> str:
    """Fields "value:width …" as bits, the highest first."""
    return "".join(f"{int(value):0{width}b}" for value, width in (name.split(":") for name in fields.split()))


def stuff_bits_of(bits: str) -> int:
    """Add one bit after five equal ones, stuffed bits counted in; read from ISO 11898-1 clause 10.5 bit by bit."""
    out = ""
    for bit in bits:
        out += bit
        if out[-5:] in ("00000", "11111"):
            out += "10"[int(bit)]
    return len(out) - len(bits)


@given(st.integers(0, (1 << 29) - 1), st.binary(max_size=8))
def test_classic_frames_are_as_long_as_counted_bit_by_bit(identifier: int, data: bytes) -> None:
    base, extension = identifier >> 18, identifier & 0x3FFFF
    fields = bits_of(f"0:1 {base}:11 3:2 {extension}:18 0:3 {len(data)}:4 " + " ".join(f"{octet}:8" for octet in data))
    crc = 0
    for bit in fields:
        crc = (crc << 1 ^ (0x4599 if (crc >> 14 ^ int(bit)) & 1 else 0)) & 0x7FFF
    fields += bits_of(f"{crc}:15")
    assert classic_bits(identifier, data) == len(fields) + stuff_bits_of(fields) + 13


@given(
    st.integers(0, (1 << 29) - 1),
    st.sampled_from([0, 3, 8, 12, 48, 64]).flatmap(lambda n: st.binary(min_size=n, max_size=n)),
)
def test_fd_frames_are_as_long_as_counted_bit_by_bit(identifier: int, data: bytes) -> None:
    slow = bits_of(f"0:1 {identifier >> 18}:11 3:2 {identifier & 0x3FFFF}:18 0:1 1:1 0:1 1:1")
    code = (*range(9), 12, 16, 20, 24, 32, 48, 64).index(len(data))
    fast = bits_of(f"0:1 {code}:4 " + " ".join(f"{octet}:8" for octet in data))
    stuffed = stuff_bits_of(slow)
    crc, fixed = (17, 6) if len(data) <= 16 else (21, 7)
    fast_bits = len(fast) + stuff_bits_of(slow + fast) - stuffed + 4 + crc + fixed
    expected = (len(slow) + stuffed + 13) / 500_000 + fast_bits / 2_000_000
    assert fd_seconds(identifier, data, 500_000, 2_000_000) == pytest.approx(expected)


def test_a_paced_sender_takes_the_time_of_the_wire() -> None:
    pacer = Pacer(125_000, 2_000_000)
    began = time.perf_counter()
    for _ in range(20):
        pacer.wait(0x18DA21F1, bytes(8), fd=False)
    assert (
        time.perf_counter() - began
        >= pacer.busy_seconds
        == pytest.approx(20 * classic_bits(0x18DA21F1, bytes(8)) / 125_000)
    )


def test_two_senders_on_one_paced_bus_take_turns(group: str) -> None:
    """Each held back its own frames alone: 200 nodes seemed to need less time than the bus has."""
    spec = parse_spec(f"{group}&pace=1&bitrate=125000")
    senders = Bus(spec), Bus(spec)
    frame = Frame(0x18DA21F1, bytes(8))
    began = time.perf_counter()
    threads = [threading.Thread(target=lambda bus=bus: [bus.send(frame) for _ in range(20)]) for bus in senders]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert time.perf_counter() - began >= 40 * classic_bits(frame.identifier, frame.data) / 125_000
    wire = pacing.Wire(spec.wire)
    assert wire.busy_seconds == pytest.approx(40 * classic_bits(frame.identifier, frame.data) / 125_000)
    for bus in senders:
        bus.close()
    assert wire._path.exists(), "somebody is still on it"
    wire.close()
    assert not wire._path.exists()


class LibraryPair(Pair):
    """A pair that never takes the short way for single frames."""

    @property
    def _is_busy(self) -> bool:
        return True

    @property
    def sending(self) -> bool:
        return True


@given(st.binary(max_size=64), st.booleans())
def test_a_single_frame_is_read_as_the_library_reads_it(data: bytes, fd: bool) -> None:
    frame = Frame(physical_id(NODE, STATION), bytes([data[0] & 0xF]) + data[1:] if data else b"", fd)
    bodies = []
    for made in (Pair, LibraryPair):
        pair = made(NODE, STATION, lambda _: None, fd=fd)
        assert pair.handle_frame(frame)
        bodies.append(pair.received())
        assert pair.received() is None
    assert bodies[0] == bodies[1]


@given(st.binary(min_size=1, max_size=63), st.booleans())
def test_a_single_frame_is_written_as_the_library_writes_it(body: bytes, fd: bool) -> None:
    sent: list[list[Frame]] = []
    for made in (Pair, LibraryPair):
        frames: list[Frame] = []
        made(NODE, STATION, frames.append, fd=fd).send(body)
        sent.append(frames)
    assert sent[0] == sent[1]


def test_a_single_frame_in_the_middle_of_a_message_ends_it_and_comes_first() -> None:
    wire = Wire()
    wire.node.handle_frame(Frame(physical_id(NODE, STATION), bytes.fromhex("100a010203040506")))
    wire.node.handle_frame(Frame(physical_id(NODE, STATION), single(b"abc")))
    wire.node.handle_frame(Frame(physical_id(NODE, STATION), single(b"def")))
    assert [wire.node.received() for _ in range(3)] == [b"abc", b"def", None]


def test_of_a_message_that_a_single_frame_ended_nothing_comes_any_more() -> None:
    """ISO 15765-2: the two are not read beside each other."""
    wire, identifier = Wire(), physical_id(NODE, STATION)
    for octets in ("100a010203040506", "0363626143434343", "210708090acccccc"):
        wire.node.handle_frame(Frame(identifier, bytes.fromhex(octets)))
    assert [wire.node.received() for _ in range(2)] == [b"cba", None]
    assert not wire.node.receiving
