"""CAN frames as text: sender, receiver, and the part of a message (profile.md, "CAN"; ISO 15765-2)."""

from __future__ import annotations

from typing import Final

from teds_provision.links.can.isotp import FUNCTIONAL, addresses, read_single
from teds_provision.links.ports import Direction
from teds_provision.protocol.announce import Announce
from teds_provision.protocol.operation.can_frames import TRIGGER, data_address, drive_address

_NONE = "no frame of ISO 15765-2"
_FLOWS = ("go on", "wait", "overflow")


def can_words(identifier: int, data: bytes) -> str:
    """Describe a frame of the profile; "not of the profile" for any other. Never raises."""
    ends = addresses(identifier)
    if ends is not None:
        return f"{ends[1]:02x} to {ends[0]:02x}: {_transport(data)}"
    source = identifier & 0xFF
    if identifier & 0x1FFFFF00 == FUNCTIONAL:
        return f"{source:02x} to all: {_transport(data)}"
    if (driven := drive_address(identifier)) is not None:
        return f"{driven.station:02x} to {driven.node:02x}: Drive, part {data[0] if data else 0}"
    if (stream := data_address(identifier)) is not None:
        return f"{stream.node:02x} to {stream.station:02x}: data of stream {stream.stream}, part {stream.segment}"
    if (announce := Announce.decode(identifier, data)) is not None:
        return f"{source:02x}: Announce" + (", button pressed" if announce.pressed else "")
    if identifier & 0x1FFFFF00 == TRIGGER:
        return f"{source:02x} to all: trigger {data.hex()}"
    return "not of the profile"


def _transport(data: bytes) -> str:
    """Describe the ISO 15765-2 part of a frame; transactions are the first octet of the profile's messages."""
    if not data:
        return "empty"
    kind, low = data[0] >> 4, data[0] & 0xF
    if kind == 0 and (body := read_single(data)):
        return f"single frame, transaction {body[0]}, {len(body) - 1} octets"
    if kind == 1 and len(data) >= 3:
        length = low << 8 | data[1]
        return f"first frame, transaction {data[2]}, {length - 1} octets" if length else "first frame, long form"
    if kind == 2:
        return f"consecutive frame {low}"
    return _flow(data, low) if kind == 3 and len(data) >= 3 else _NONE


def _flow(data: bytes, status: int) -> str:
    return f"flow control: {_FLOWS[status]}, block {data[1]}, gap {data[2]}" if status < len(_FLOWS) else _NONE


# NFC frames as text: blocks of ISO/IEC 14443-4 with their APDU, and the commands of Type 2 tags.

_APDUS: Final = {0xA4: "SELECT", 0xB0: "READ BINARY", 0xD6: "UPDATE BINARY"}
_ANSWER_OCTETS: Final = 16


def nfc_words(octets: bytes, direction: Direction) -> str:
    """Describe a frame by its own octets (a Type 2 page and a block may begin alike). Never raises."""
    if not octets:
        return "empty"
    return (_asked(octets) if direction == "out" else _answered(octets)) or _of_iso_dep(octets, direction)


def _answered(octets: bytes) -> str:
    head, size = octets[0], len(octets)
    if size == 1:
        return "ACK" if head & 0xF == 0xA else f"NAK {head & 0xF:x}"
    return "16 octets of a Type 2 tag" if size == _ANSWER_OCTETS and head & 0xE2 != 0x02 else ""


def _of_iso_dep(octets: bytes, direction: Direction) -> str:
    head, size = octets[0], len(octets)
    if head & 0xE2 == 0x02:
        return _block(octets, direction)
    if head & 0xE6 == 0xA2:
        return f"R block {head & 1}, {'NAK' if head & 0x10 else 'ACK'}"
    if head & 0xC7 == 0xC2:
        return "S block, DESELECT" if not head & 0x30 else f"S block, more time x {octets[1] & 0x3F if size > 1 else 0}"
    return f"{size} octets"


def _asked(octets: bytes) -> str:
    match octets[0], len(octets):
        case 0xE0, 2:
            return "RATS"
        case 0x30, 2:
            return f"READ from page {octets[1]}"
        case 0xA2, 6:
            return f"WRITE of page {octets[1]}"
        case 0x00, size if size >= 4 and octets[1] in _APDUS:  # PC/SC readers get the bare APDU
            return _APDUS[octets[1]]
    return ""


def _block(octets: bytes, direction: Direction) -> str:
    more = ", goes on" if octets[0] & 0x10 else ""
    text = f"I block {octets[0] & 1}{more}, {len(octets) - 1} octets"
    if direction == "out" and len(octets) >= 5 and octets[1] == 0 and octets[2] in _APDUS:
        return f"{text}: {_APDUS[octets[2]]} {octets[3]:02x}{octets[4]:02x}"
    if direction == "in" and not more and len(octets) >= 3:
        return f"{text}, status {octets[-2:].hex()}"
    return text
