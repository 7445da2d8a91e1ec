"""The profile's TNEP service beside one of the board's application, on one tag."""

from __future__ import annotations

import pytest

from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.message import EXTERNAL, WELL_KNOWN, NdefRecord
from teds_provision.links.nfc.pieces import Piece
from teds_provision.protocol.messages.frames import Function, security_command
from tests.firmware.memory_node import MemoryNode
from tests.protocol.desk import NODE, UUID

pytestmark = pytest.mark.system

SETTINGS = b"urn:nfc:xsn:example.com:settings"
IDENTIFY = security_command(Function.IDENTIFY).encode()
GOOD, GARBLED, ERROR = 0x00, 0x80, 0x01
LAST = 0x40
FIRST = 0x80


def new_node(max_ndef: int = 499) -> MemoryNode:
    """Return a node with a tag that is not started yet."""
    node = MemoryNode(lambda kind, size: NODE.secret() if kind == "i" else b"\x01" * size, lambda: 0.0, uuid=UUID)
    node.has_nfc(max_ndef=max_ndef)
    return node


def ask(transaction: int) -> bytes:
    """Identify as a reader writes it."""
    return message.encode([tnep.payload_record(Piece(transaction, len(IDENTIFY), 0, IDENTIFY).encode())])


def status(shown: bytes) -> int:
    """The TNEP status of an answer."""
    first = message.decode(shown)[0]
    assert first.is_well_known(b"Te")
    return first.payload[0]


def test_a_reader_uses_both_services_of_the_tag() -> None:
    node, asked = new_node(), list[bytes]()

    def answer(octets: bytes, room: int) -> bytes:
        asked.append(octets)
        assert room == 499 - 6
        if message.decode(octets)[0].is_well_known(b"Ts"):
            return b""
        record = message.encode(
            [NdefRecord(EXTERNAL, b"example.com:settings", message.decode(octets)[0].payload[::-1])]
        )
        return bytes((record[0] & ~FIRST,)) + record[1:]

    node.has_nfc_service(SETTINGS, answer)
    assert node.start() == 0
    node.nfc_field(True)
    initial = message.decode(node.nfc_message())
    assert [record.payload[2 : 2 + record.payload[1]] for record in initial if record.is_well_known(b"Tp")] == [
        tnep.SERVICE,
        SETTINGS,
    ]
    ours = tnep.our_service(initial)
    assert ours is not None
    assert (ours.wt_int, ours.n_wait, ours.max_ndef) == (4, 15, 499)
    assert initial[-1].is_external(b"teds-provision:id")

    # ours works as ever
    assert status(node.nfc_write(message.encode([tnep.select(tnep.SERVICE)]))) == GOOD
    identity = message.decode(node.nfc_write(ask(1)))[1].payload
    assert UUID in identity
    assert asked == []

    # the application's gets whole messages until another one is selected, ours none of them
    select = message.encode([tnep.select(SETTINGS)])
    assert node.nfc_write(select) == message.encode([NdefRecord(WELL_KNOWN, b"Te", b"\0")])
    written = message.encode([NdefRecord(EXTERNAL, b"example.com:settings", b"volume 11")])
    shown = message.decode(node.nfc_write(written))
    assert shown[0].payload == b"\0"
    assert shown[1].payload == b"11 emulov"
    assert asked == [select, written]
    node.nfc_write(ask(2))
    assert asked[2:] == [ask(2)]

    # and back
    assert status(node.nfc_write(message.encode([tnep.select(tnep.SERVICE)]))) == GOOD
    assert UUID in message.decode(node.nfc_write(ask(3)))[1].payload
    assert len(asked) == 3
    # deselected, and after the field was gone, nothing reaches the application
    node.nfc_write(select)
    node.nfc_write(message.encode([tnep.select(b"")]))
    assert status(node.nfc_write(written)) == ERROR
    node.nfc_write(select)
    node.nfc_field(False)
    node.nfc_field(True)
    assert status(node.nfc_write(written)) == ERROR
    assert len(asked) == 5
    node.close()


@pytest.mark.parametrize("returned", [None, b"\x54\x01\x01Tx" * 200], ids=["not understood", "longer than the room"])
def test_an_application_that_cannot_answer_is_reported_as_garbled(returned: bytes | None) -> None:
    node = new_node()
    node.has_nfc_service(SETTINGS, lambda octets, room: returned)
    assert node.start() == 0
    node.nfc_field(True)
    assert node.nfc_write(message.encode([tnep.select(SETTINGS)])) == message.encode(
        [NdefRecord(WELL_KNOWN, b"Te", bytes((GARBLED,)))]
    )
    node.close()


def test_a_message_in_chunks_never_reaches_the_application_in_pieces() -> None:
    node, asked = new_node(), list[bytes]()

    def answer(octets: bytes, room: int) -> bytes:
        asked.append(octets)
        return b""

    node.has_nfc_service(SETTINGS, answer)
    assert node.start() == 0
    node.nfc_field(True)
    node.nfc_write(message.encode([tnep.select(SETTINGS)]))
    chunks = bytes((FIRST | 0x20 | 0x10 | EXTERNAL, 3, 2)) + b"a:b" + b"12" + bytes((LAST | 0x10 | 6, 0, 2)) + b"34"
    assert status(node.nfc_write(chunks)) == GARBLED
    assert len(asked) == 1
    node.close()


@pytest.mark.parametrize(
    "name", [b"", tnep.SERVICE, b"urn:nfc:xsn:" + b"x" * 120], ids=["no name", "the profile's own", "too long"]
)
def test_a_service_that_cannot_be_stops_the_start(name: bytes) -> None:
    node = new_node(4160)
    node.has_nfc_service(name, lambda octets, room: b"")
    assert node.start() == -1
    node.close()


def test_services_that_leave_no_room_for_the_initial_message_stop_the_start() -> None:
    node = new_node(160)
    node.has_nfc_service(SETTINGS, lambda octets, room: b"")
    assert node.start() == -1
    node.close()
