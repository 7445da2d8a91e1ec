"""Stored replies of the node in C, over CAN: how long one is kept, and which one gives way to another station's."""

from __future__ import annotations

import pytest

from teds_provision.links.can.isotp import physical_id, single
from teds_provision.protocol.messages.frames import IDENTIFY, Function, security_command
from tests.firmware.desk import CDesk
from tests.firmware.memory_node import MemoryNode
from tests.firmware.test_manage import Firmware
from tests.firmware.test_power_cuts import commit, confirm
from tests.protocol.desk import NODE, UUID

pytestmark = pytest.mark.system

PLACES = 3
"""Two sessions, and one for every other station (firmware/include/teds/config.h)."""


class Stations:
    """Stations that have a board blink, which nobody does twice for one wish."""

    def __init__(self) -> None:
        self.now, self.firmware = 0.0, Firmware()
        self.node = MemoryNode(
            lambda kind, size: NODE.secret() if kind == "i" else b"\x01" * size, lambda: self.now, uuid=UUID
        )
        self.node.has_firmware(self.firmware)
        assert self.node.start() == 0
        self.node.joins_bus()
        self.address = self.node.can_address
        self._take_all()

    def locate(self, number: int, transaction: int = 5, seconds: int = 60) -> bytes:
        """Ask for it; return what the node sends back."""
        return self.ask(number, bytes((transaction,)) + security_command(Function.LOCATE, bytes((seconds,))).encode())

    def ask(self, number: int, body: bytes) -> bytes:
        """Send one request; return what the node sends back."""
        self.node.take_frame(physical_id(self.address, number), single(body, fd=True), fd=True)
        return self._take_all()

    def _take_all(self) -> bytes:
        octets = b""
        for _ in range(50):
            self.node.poll()
            while (sent := self.node.next_frame()) is not None:
                octets += sent[1] if sent[0] & 0x1FFF0000 == 0x18DA0000 else b""  # it announces itself too
        return octets


@pytest.fixture
def stations() -> Stations:
    return Stations()


def test_a_reply_is_kept_for_20_seconds(stations: Stations) -> None:
    reply = stations.locate(0xF1)
    assert reply
    stations.now = 19.999
    assert stations.locate(0xF1) == reply
    assert stations.firmware.blinks == [60]
    assert stations.locate(0xF1, transaction=6) != reply
    assert stations.firmware.blinks == [60, 60], "another transaction is another wish"
    stations.now = 39.999  # 20 s after it
    stations.locate(0xF1, transaction=6)
    assert stations.firmware.blinks == [60, 60, 60]
    stations.node.close()


def test_about_is_answered_anew_each_time(stations: Stations) -> None:
    about = b"\x05" + bytes.fromhex("000080150000")
    for text in (b"board/one", b"board/two"):
        stations.firmware.text = text
        assert text in stations.ask(0xF1, about)
    stations.node.close()


@pytest.mark.parametrize(
    "question",
    [
        "000080070000",
        "0000800b0000",
        "000101010001 0c",
        "000101020005 0c00000000",
        "000001010001 80",
        "000001020005 80 00000000",
    ],
    ids=["Identify", "List", "Query", "Read", "Query of channel 0", "Read of channel 0"],
)
def test_a_question_is_answered_anew_each_time(question: str) -> None:
    desk = CDesk()
    confirm(desk)

    def ask() -> str:
        body = b"\x05" + bytes.fromhex(question)
        desk.node.take_frame(physical_id(desk.node.can_address, 0xF5), single(body, fd=True), fd=True)
        desk.node.poll()
        sent = desk.node.next_frame()
        assert sent is not None
        return sent[1].hex()

    before = ask()
    assert ask() == before
    assert commit(desk).ok
    assert ask() != before
    CDesk.close_all()


def test_a_proof_is_made_anew_each_time(stations: Stations) -> None:
    prove = b"\x05" + bytes.fromhex("000080080020") + bytes(32)
    work = []
    for _ in range(2):
        stations.node.chip_fails(0)
        assert stations.ask(0xF1, prove)
        work.append(stations.node.chip_calls)
    assert work == [1, 1], "a signature each time"
    stations.node.close()


def test_the_oldest_reply_gives_way(stations: Stations) -> None:
    for number in range(PLACES + 1):
        stations.now = float(number)
        stations.locate(0xF1 + number)
    assert len(stations.firmware.blinks) == PLACES + 1
    for number in range(1, PLACES + 1):
        stations.now += 1
        stations.locate(0xF1 + number)
    assert len(stations.firmware.blinks) == PLACES + 1, "those that came later are there"
    stations.now += 1
    stations.locate(0xF1)
    assert len(stations.firmware.blinks) == PLACES + 2
    for number in (0xF3, 0xF4):
        stations.locate(number)
    assert len(stations.firmware.blinks) == PLACES + 2, "it took the place of the oldest once more"
    stations.locate(0xF2)
    assert len(stations.firmware.blinks) == PLACES + 3
    stations.node.close()


@pytest.mark.parametrize("number", [0xF1, 0xF2, 0xF7])
def test_strangers_take_no_place_of_a_reply_in_a_session(number: int) -> None:
    """Whichever place it has: strangers have asked before it, or not."""
    desk = CDesk()
    desk.agree().open(link=f"can:{number:02x}")
    assert desk.session is not None

    def ask(station: int, body: bytes) -> bytes:
        desk.now += 0.1
        desk.node.take_frame(physical_id(desk.node.can_address, station), single(body, fd=True), fd=True)
        desk.node.poll()
        sent = desk.node.next_frame()
        assert sent is not None
        return sent[1]

    sealed = b"\x07" + desk.session.seal(IDENTIFY).encode()
    for station in range(0xF1, number):
        ask(station, b"\x05" + IDENTIFY.encode())
    reply = ask(number, sealed)
    assert reply[:2] == b"\x00\x38", "56 octets in one frame"
    for _ in range(2):
        for station in range(0xF1, 0xF8):
            if station != number:
                assert b"\x05\x01" in ask(station, b"\x05" + IDENTIFY.encode())
        assert ask(number, sealed) == reply, "a repetition gets the stored reply, and no refusal 13"
    CDesk.close_all()
