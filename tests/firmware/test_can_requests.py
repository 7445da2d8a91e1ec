"""Requests to the node in C over CAN: which count as tapped, and whose long one is taken (wire.md, "CAN")."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from teds_provision.links.can.isotp import consecutive_frames, first_frame, single
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.messages.frames import IDENTIFY
from teds_provision.protocol.session import StationSession
from tests.firmware.desk import CDesk
from tests.firmware.memory_node import MemoryNode
from tests.protocol.desk import NODE, UUID

pytestmark = pytest.mark.system

OWN = 192
FLOW_CONTROL, REFUSED_17 = "30", "050700000111"


def sent_to(node: MemoryNode, station: int) -> str:
    """Return what the node sends now to this station, in hex; it sends nothing else."""
    octets = ""
    node.poll()
    while (frame := node.next_frame()) is not None:
        assert frame[0] == 0x18DA0000 | station << 8 | node.can_address
        octets += frame[1].hex()
    return octets


@pytest.mark.parametrize(
    ("nfc", "keyed", "reply"),
    [(False, False, "010000"), (True, False, "00000103"), (False, True, "00000103"), (True, True, "00000103")],
)
def test_a_wired_bus_counts_as_tapped_without_nfc_and_in_factory_state_alone(
    nfc: bool, keyed: bool, reply: str
) -> None:
    node = MemoryNode(lambda kind, size: NODE.secret() if kind == "i" else bytes(size), lambda: 1.0, uuid=UUID)
    if nfc:
        node.has_nfc()
    assert node.start() == 0
    if keyed:
        node.put(Flash(UUID, NODE.point, b"", can_address=OWN, key=b"k" * 16, epoch=1))
    set_address = bytes.fromhex("070000800a000121")
    node.take_frame(0x18DA00F1 | OWN << 8, single(set_address, fd=True), fd=True)
    node.poll()
    answer = node.next_frame()
    assert answer is not None
    assert answer[1].hex().startswith(f"{1 + len(reply) // 2:02x}07{reply}")
    node.close()


@pytest.mark.parametrize(("octets", "answer"), [(1025, FLOW_CONTROL), (1026, "05070000010a")])
def test_a_request_of_max_message_is_taken_and_a_longer_one_gets_10(octets: int, answer: str) -> None:
    """1024 octets and the transaction, which stands before each."""
    node = MemoryNode(lambda kind, size: NODE.secret() if kind == "i" else bytes(size), lambda: 1.0, uuid=UUID)
    assert node.start() == 0
    node.take_frame(0x18DA00F1 | OWN << 8, (0x1000 | octets).to_bytes(2, "big") + b"\x07" + bytes(5))
    assert sent_to(node, 0xF1).startswith(answer)
    node.close()


@pytest.fixture
def desk() -> Iterator[CDesk]:
    """Stations F1 and F2 have a session, F3 and F4 have none."""
    desk = CDesk().agree()
    for link in ("can:f1", "can:f2"):
        assert desk.open(link=link).sealed(IDENTIFY, link=link).ok
    assert isinstance(desk, CDesk)
    yield desk
    CDesk.close_all()


def begins(desk: CDesk, station: int) -> None:
    """Send the first frame of a request of 100 octets."""
    desk.node.take_frame(0x18DA0000 | OWN << 8 | station, bytes.fromhex("1064070000010300"))


@pytest.mark.parametrize("second", [0xF2, 0xF3])
def test_a_long_request_of_a_session_is_not_given_up_for_another_one(desk: CDesk, second: int) -> None:
    begins(desk, 0xF1)
    assert sent_to(desk.node, 0xF1).startswith(FLOW_CONTROL)
    begins(desk, second)
    assert sent_to(desk.node, second).startswith(REFUSED_17)
    desk.now += 1.0
    begins(desk, second)
    assert sent_to(desk.node, second).startswith(FLOW_CONTROL), "a second without a frame ended the first one"


def test_a_long_request_of_a_stranger_gives_way_to_one_of_a_session_and_to_no_other(desk: CDesk) -> None:
    begins(desk, 0xF3)
    assert sent_to(desk.node, 0xF3).startswith(FLOW_CONTROL)
    begins(desk, 0xF4)
    assert sent_to(desk.node, 0xF4).startswith(REFUSED_17)
    begins(desk, 0xF2)
    desk.node.poll()
    frames = {frame[0] >> 8 & 0xFF: frame[1].hex() for frame in iter(desk.node.next_frame, None)}
    assert frames.keys() == {0xF2, 0xF3}
    assert frames[0xF2].startswith(FLOW_CONTROL)
    assert frames[0xF3].startswith(REFUSED_17)


def test_a_long_reply_is_kept_for_20_seconds_from_its_last_frame(desk: CDesk) -> None:
    session = StationSession(desk.key, UUID)
    opening = session.open(desk.plain(session.request_counter(), link="can:f3", tapped=False).payload)
    to_node = 0x18DA00F3 | OWN << 8

    def asks() -> str:
        """Send the Open in FD frames; return the first frame of what comes back."""
        head, rest = first_frame(b"\x07" + opening.encode(), fd=True)
        desk.node.take_frame(to_node, head, fd=True)
        assert sent_to(desk.node, 0xF3).startswith(FLOW_CONTROL)
        for frame in consecutive_frames(rest, fd=True):
            desk.node.take_frame(to_node, frame, fd=True)
        return sent_to(desk.node, 0xF3)

    reply = asks()
    assert reply.startswith("105507010051")
    desk.now += 0.9
    desk.node.take_frame(to_node, bytes.fromhex("300000"), fd=True)
    assert sent_to(desk.node, 0xF3).startswith("21")
    desk.now += 19.9
    assert asks() == reply
    desk.node.take_frame(to_node, bytes.fromhex("300000"), fd=True)
    assert sent_to(desk.node, 0xF3).startswith("21")
    desk.now += 20.0
    assert asks().startswith("05070000010c"), "run again, it is no longer good"
