"""Frames of the node in C, one by one: forms, edges, silence, and who gives way (wire.md, "CAN"; ISO 15765-2)."""

from __future__ import annotations

import zlib
from collections.abc import Iterator

import pytest

from teds_provision.links.can.isotp import consecutive_frames, first_frame, single
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.messages.frames import security_command
from tests.firmware import builds
from tests.firmware.desk import CDesk
from tests.firmware.memory_node import MemoryNode
from tests.protocol.desk import NODE, UUID

pytestmark = pytest.mark.system

OWN = 192
IDENTIFY = "000080070000"
EVERYONE = 0x18DBFF00


class Bus:
    """A node on a bus, in factory state, and stations that send it frames."""

    def __init__(self, node: MemoryNode | None = None, desk: CDesk | None = None) -> None:
        self.now = 100.0
        self.desk = desk
        draw = lambda kind, size: NODE.secret() if kind == "i" else bytes(size)  # noqa: E731
        self.node = node or MemoryNode(draw, lambda: self.now, uuid=UUID)
        if node is None:
            assert self.node.start() == 0

    def hears(self, data: str, *, station: int = 0xF1, fd: bool = False, to: int = OWN) -> None:
        self.node.take_frame(0x18DA0000 | to << 8 | station, bytes.fromhex(data), fd=fd)

    def says(self, *, station: int = 0xF1) -> list[tuple[str, bool]]:
        """Return what it sends now to one station, in hex, and whether it is FD: nothing to others, no press."""
        sent = []
        self.node.poll()
        while (frame := self.node.next_frame()) is not None:
            if frame[0] & 0x1FFFFF00 == 0x1CFF0000:
                assert frame[1][6] == 0, "an Announce of a press"
                continue
            assert frame[0] & 0x1FFFFF00 == 0x18DA0000 | station << 8, hex(frame[0])
            sent.append((frame[1].hex(), frame[2]))
        return sent

    def with_teds(self, octets: int) -> Bus:
        self.node.put(Flash(UUID, NODE.point, b"", blocks={(1, 12): bytes(octets)}, can_address=OWN))
        return self

    def reads(self, *, fd: bool = False) -> None:
        """Ask for the TEDS: the reply has 8 octets beside it, the transaction among them."""
        body = bytes.fromhex("07 0001 0102 0005 0c 00000000")
        if fd:
            self.node.take_frame(0x18DA00F1 | OWN << 8, single(body, fd=True), fd=True)
            return
        head, rest = first_frame(body, fd=False)
        self.node.take_frame(0x18DA00F1 | OWN << 8, head)
        assert self.says()[0][0].startswith("30")
        for frame in consecutive_frames(rest, fd=False):
            self.node.take_frame(0x18DA00F1 | OWN << 8, frame)


@pytest.fixture
def bus() -> Iterator[Bus]:
    made = Bus()
    yield made
    made.node.close()


def test_a_reply_of_one_fd_frame_has_62_octets_at_most(bus: Bus) -> None:
    bus.with_teds(54).reads(fd=True)
    ((frame, fd),) = bus.says()
    assert (frame[:10], len(frame), fd) == ("003e070100", 128, True)
    bus.with_teds(55).reads(fd=True)
    ((frame, fd),) = bus.says()
    assert (frame[:10], len(frame), fd) == ("103f070100", 128, True)


def test_blocks_without_a_limit_go_on_beyond_255_frames() -> None:
    node = MemoryNode(
        lambda kind, size: NODE.secret() if kind == "i" else bytes(size),
        lambda: 100.0,
        uuid=UUID,
        max_message=2048,
        library=builds.library(2048, 16388),
    )
    assert node.start() == 0
    bus = Bus(node).with_teds(1990)
    bus.reads()
    ((frame, _),) = bus.says()
    octets = int(frame[1:4], 16)
    assert octets > 1900
    bus.hears("300000")
    assert len(bus.says()) == (octets - 6 + 6) // 7 > 255
    node.close()


def test_ten_waits_of_a_station_are_borne_whatever_the_reply_before_needed(bus: Bus) -> None:
    def ask(transaction: str) -> None:
        bus.hears(f"07{transaction}{IDENTIFY}")
        assert bus.says()[0][0].startswith(f"101b{transaction}")

    ask("01")
    for _ in range(6):
        bus.now += 0.9
        bus.hears("310000")
    ask("02")
    for _ in range(10):
        bus.now += 0.9
        bus.hears("310000")
        assert bus.says() == []
    bus.hears("300000")
    assert len(bus.says()) == 3
    ask("03")
    for _ in range(11):
        bus.now += 0.9
        bus.hears("310000")
        bus.says()
    bus.hears("300000")
    assert bus.says() == []


@pytest.mark.parametrize(
    ("frame", "answered"),
    [
        ("0708" + IDENTIFY, True),
        ("000708" + IDENTIFY + "cccccc", False),  # seven octets need no escape
        ("050808" + IDENTIFY + "00cccc", False),  # a length before the escape
        ("000808" + IDENTIFY + "00cccc", True),  # a command with an octet too many: refused, but heard
    ],
)
def test_a_single_frame_of_more_than_8_octets_has_its_length_in_the_second_one(
    bus: Bus, frame: str, answered: bool
) -> None:
    bus.hears(frame, fd=True)
    assert bool(bus.says()) == answered


@pytest.mark.parametrize("before", [None, False, True])
@pytest.mark.parametrize("fd", [False, True])
def test_an_answer_to_everyone_has_the_form_of_the_question(bus: Bus, fd: bool, before: bool | None) -> None:
    if before is not None:
        bus.hears("0708" + IDENTIFY, fd=before)
        assert bus.says()[0][1] == before
        bus.now += 2.0
        bus.says()
    bus.node.take_frame(EVERYONE | 0xF1, bytes.fromhex("0742" + IDENTIFY), fd=fd)
    bus.now += 0.05
    ((frame, form),) = bus.says()
    assert form == fd
    assert frame.startswith("001b42" if fd else "101b42")


def test_without_randomness_the_wait_of_an_answer_to_everyone_follows_from_the_uuid(bus: Bus) -> None:
    """Nodes that start together must not answer together: both halves of the CRC-32 of the UUID, of 2^16, of 50 ms."""
    crc = zlib.crc32(UUID)
    bus.node.chip_fails(1)
    bus.node.take_frame(EVERYONE | 0xF1, bytes.fromhex("0742" + IDENTIFY), fd=True)
    wait = (50_000_000 >> 16) * ((crc ^ crc >> 16) & 0xFFFF) / 1e9
    bus.now += wait - 1e-5
    assert bus.says() == []
    bus.now += 2e-5
    assert bus.says()[0][0].startswith("001b42")


def test_a_long_request_in_fd_beside_a_classic_answer_to_everyone_is_asked_on_in_fd(bus: Bus) -> None:
    bus.node.take_frame(EVERYONE | 0xF1, bytes.fromhex("0742" + IDENTIFY))
    bus.now += 0.05
    assert bus.says()[0][0].startswith("101b42")
    bus.hears("106407" + "00" * 61, fd=True)
    ((frame, fd),) = bus.says()
    assert (frame[:2], fd) == ("30", True)


def test_a_station_that_waits_for_the_answer_to_everyone_keeps_its_line_if_another_one_rests(bus: Bus) -> None:
    bus.node.take_frame(EVERYONE | 0xF3, bytes.fromhex("0742" + IDENTIFY), fd=True)
    bus.node._draw = lambda kind, size: b"\xff" * size  # the longest wait
    bus.node.take_frame(EVERYONE | 0xF3, bytes.fromhex("0742" + IDENTIFY), fd=True)
    for station in (0xF1, 0xF2, 0xF4, 0xF5):
        bus.hears("0708" + IDENTIFY, station=station, fd=True)
        assert bus.says(station=station)[0][0].startswith("001b08")
    bus.now += 0.05
    assert bus.says(station=0xF3)[0][0].startswith("001b42")


@pytest.mark.parametrize(("step", "answered"), [(0.6, True), (0.7, False)])
def test_a_request_has_five_seconds_from_its_first_frame_however_fast_its_frames_follow(
    bus: Bus, step: float, answered: bool
) -> None:
    """Eight frames behind the first, each within N_Cr; the last one 4.8 or 5.6 s after it."""
    head, rest = first_frame(bytes.fromhex("07 0000 ff 01 0038") + bytes(56), fd=False)
    bus.hears(head.hex())
    assert bus.says()[0][0].startswith("30")
    frames = list(consecutive_frames(rest, fd=False))
    for frame in frames:
        bus.now += step * 8 / len(frames)
        bus.hears(frame.hex())
    assert bool(bus.says()) is answered


def test_a_first_frame_that_is_followed_by_number_0_is_torn(bus: Bus) -> None:
    head, rest = first_frame(bytes.fromhex("07 0001 0102 0005 0c 00000000"), fd=False)
    bus.hears(head.hex())
    assert bus.says()[0][0].startswith("30")
    (last,) = consecutive_frames(rest, fd=False)
    bus.hears("20" + last[1:].hex())
    bus.hears(last.hex())
    assert bus.says() == []


def test_during_its_silence_after_bus_off_a_node_hears_nothing_and_says_nothing(bus: Bus) -> None:
    bus.node.bus_off()
    bus.hears("0708" + IDENTIFY)
    bus.node.press()
    bus.now += 0.999
    bus.hears("0709" + IDENTIFY)
    bus.node.press()
    assert bus.says() == []
    bus.now += 0.001
    assert bus.says() == [], "what it missed is not made good, a press neither"
    bus.hears("070a" + IDENTIFY)
    assert bus.says()[0][0].startswith("101b0a")


@pytest.mark.parametrize(("seconds", "silence"), [(59.9, 2.0), (60.0, 1.0)])
def test_after_a_minute_on_the_bus_its_silence_is_a_second_again(bus: Bus, seconds: float, silence: float) -> None:
    bus.node.bus_off()
    bus.now += 1.0 + seconds
    bus.node.poll()
    while bus.node.next_frame() is not None:
        pass
    bus.node.bus_off()
    bus.now += silence - 0.001
    bus.hears("0708" + IDENTIFY)
    assert bus.says() == []
    bus.now += 0.001
    bus.hears("0708" + IDENTIFY)
    assert bus.says() != []


# -- stations beside each other ----------------------------------------------------------------------------------------


@pytest.fixture
def desk() -> Iterator[CDesk]:
    """Stations F1 and F2 have a session."""
    made = CDesk().agree()
    for link in ("can:f1", "can:f2"):
        assert made.open(link=link).sealed(security_command(7), link=link).ok
    assert isinstance(made, CDesk)
    yield made
    CDesk.close_all()


@pytest.mark.parametrize("fd", [False, True])
def test_a_station_for_which_there_is_no_line_is_refused_in_its_own_form(desk: CDesk, fd: bool) -> None:
    """Four lines: of two sessions, of a long request that is coming, and of a reply that has only just begun."""
    bus = Bus(desk.node)
    for station in (0xF1, 0xF2, 0xF4):
        bus.hears("0708" + IDENTIFY, station=station)
        assert bus.says(station=station)[0][0].startswith("101b08")
    bus.hears("1064070000010300", station=0xF3)
    assert bus.says(station=0xF3)[0][0].startswith("30")
    bus.hears("0709" + IDENTIFY, station=0xF5, fd=fd)
    ((frame, form),) = bus.says(station=0xF5)
    assert frame.startswith("050900000111")
    assert form == fd
    desk.now += 0.1
    bus.hears("070a" + IDENTIFY, station=0xF5, fd=fd)
    assert bus.says(station=0xF5)[0][0][:6] in ("101b0a", "001b0a"), "a reply that nobody takes gives way"


def test_a_stranger_whose_request_gives_way_gets_no_flow_control_any_more(desk: CDesk) -> None:
    bus = Bus(desk.node)
    bus.hears("1064070000010300", station=0xF3)
    bus.hears("1064070000010300", station=0xF1)
    desk.node.poll()
    sent = sorted((frame[0] >> 8 & 0xFF, frame[1].hex()[:12]) for frame in iter(desk.node.next_frame, None))
    assert [(station, data[:2]) for station, data in sent] == [(0xF1, "30"), (0xF3, "05")]
    assert sent[1][1] == "050700000111"


def test_a_request_after_128_10_whose_reply_waits_is_not_answered_at_the_old_address(desk: CDesk) -> None:
    """The new request shows that nobody waits for the reply: the node moves, and is heard at the new address alone."""
    bus = Bus(desk.node)
    assert desk.session is not None
    desk.open(link="can:f1")
    sealed = b"\x07" + desk.session.seal(security_command(10, bytes([33]))).encode()
    head, rest = first_frame(sealed, fd=False)
    bus.hears(head.hex())
    assert bus.says()[0][0].startswith("30")
    for frame in consecutive_frames(rest, fd=False):
        bus.hears(frame.hex())
    ((reply, _),) = bus.says()
    assert reply[0] == "1", "its first frame, from the old address"
    bus.hears("0708" + IDENTIFY)
    assert bus.says() == []
    bus.hears("0709" + IDENTIFY)
    assert bus.says() == []
    bus.hears("070a" + IDENTIFY, to=33)
    assert bus.says()[0][0].startswith("101b0a")


@pytest.mark.parametrize("before", [None, False, True])
@pytest.mark.parametrize("fd", [False, True])
def test_a_refusal_in_place_of_a_flow_control_has_the_form_of_its_first_frame(
    bus: Bus, fd: bool, before: bool | None
) -> None:
    if before is not None:
        bus.hears("0708" + IDENTIFY, fd=before)
        assert bus.says()[0][1] == before
        bus.now += 2.0
        bus.says()
    bus.hears("1fff770000010300", fd=fd)
    ((frame, form),) = bus.says()
    assert (frame[:12], form) == ("05770000010a", fd)
