"""State that ends with one link of the C node and with no other: stored reply, session, half-open Open, Request."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from teds_provision.links.can.isotp import physical_id, single
from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.pieces import Piece
from teds_provision.protocol.messages import ble
from teds_provision.protocol.messages.frames import Function, Reason, refusal, security_command
from teds_provision.protocol.wire_agreement import StationAgreement
from tests.firmware.desk import CDesk
from tests.firmware.memory_node import MemoryNode
from tests.firmware.test_manage import Firmware
from tests.protocol.desk import CREDENTIALS, NODE, UUID

pytestmark = pytest.mark.system

LINKS = ("can", "nfc", "ble 0", "ble 1")
LOCATE = security_command(Function.LOCATE, b"\x05").encode()
IDENTIFY = security_command(Function.IDENTIFY)


class Blinking:
    """A node in factory state that is asked to blink, by the same octets over each of its links."""

    def __init__(self) -> None:
        self.now, self.firmware = 0.0, Firmware()
        self.node = MemoryNode(
            lambda kind, size: NODE.secret() if kind == "i" else bytes(size), lambda: self.now, uuid=UUID
        )
        self.node.has_firmware(self.firmware)
        self.node.has_nfc()
        assert self.node.start() == 0
        self.node.nfc_field(True)
        for connection in (0, 1):
            self.node.ble_connected(connection, 247)

    def ask(self, link: str) -> int:
        """Ask once; return how often it has blinked since the start."""
        if link == "can":
            self.node.take_frame(physical_id(self.node.can_address, 0xF1), single(b"\x05" + LOCATE, fd=True), fd=True)
            self.node.poll()
            assert self.node.next_frame() is not None
        elif link != "nfc":
            for frame in ble.cut(5, LOCATE, 247):
                assert self.node.ble_written(int(link[-1]), frame)
        else:
            self.node.nfc_write(message.encode([tnep.select(tnep.SERVICE)]))
            self.node.nfc_write(message.encode([tnep.payload_record(Piece(5, len(LOCATE), 0, LOCATE).encode())]))
        return len(self.firmware.blinks)

    def lose(self, link: str) -> None:
        """Lose a link, and have it back."""
        if link == "can":
            self.node.bus_off()
            self.now += 1.0
        elif link != "nfc":
            self.node.ble_disconnected(int(link[-1]))
            self.node.ble_connected(int(link[-1]), 247)
        else:
            self.node.nfc_field(False)
            self.node.nfc_field(True)


@pytest.mark.parametrize("lost", LINKS)
@pytest.mark.parametrize("link", LINKS)
def test_a_stored_reply_goes_with_its_link_and_with_no_other(link: str, lost: str) -> None:
    board = Blinking()
    assert board.ask(link) == 1
    assert board.ask(link) == 1, "a repetition gets the stored reply"
    board.lose(lost)
    assert board.ask(link) == (2 if link == lost else 1)
    board.node.close()


@pytest.fixture
def desk() -> Iterator[CDesk]:
    made = CDesk().agree()
    assert isinstance(made, CDesk)
    yield made
    CDesk.close_all()


@pytest.mark.parametrize("lost", ["can:f1", "can:f2", "nfc", "ble:2"])
def test_a_session_a_half_open_one_and_a_request_go_with_their_link_and_with_no_other(desk: CDesk, lost: str) -> None:
    opened = desk.open(link="can:f1").session
    assert opened is not None
    sealed = opened.seal(IDENTIFY)
    desk.node.link_lost(lost)
    half_open = desk.plain(sealed, link="can:f1", tapped=False)
    assert half_open == refusal(Reason.WRONG_STATE) if lost == "can:f1" else half_open.ok
    sealed = desk.open(link="can:f1").session.seal(IDENTIFY)  # type: ignore[union-attr]
    assert desk.plain(sealed, link="can:f1", tapped=False).ok
    sealed = desk.session.seal(IDENTIFY)  # type: ignore[union-attr]
    desk.node.link_lost(lost)
    session = desk.plain(sealed, link="can:f1", tapped=False)
    assert session == refusal(Reason.WRONG_STATE) if lost == "can:f1" else session.ok
    agreement = StationAgreement(CREDENTIALS, UUID)
    reply = desk.plain(agreement.request(), link="nfc", tapped=True)
    assert reply.ok
    desk.node.link_lost(lost)
    confirmed = desk.plain(security_command(Function.CONFIRM, bytes(15)), link="nfc", tapped=True)
    assert confirmed == refusal(Reason.WRONG_STATE if lost == "nfc" else Reason.BAD_FORM)
