"""NFC frames in words: blocks of ISO/IEC 14443-4 with their APDU, and the commands of Type 2 tags."""

from __future__ import annotations

from typing import Final

from teds_provision.links.ports import Direction

_APDUS: Final = {0xA4: "SELECT", 0xB0: "READ BINARY", 0xD6: "UPDATE BINARY"}
_ANSWER_OCTETS: Final = 16


def nfc_words(octets: bytes, direction: Direction) -> str:
    """What a frame is, as far as one frame says it (a Type 2 page and a block may begin alike). Never raises."""
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
        case 0x00, size if size >= 4 and octets[1] in _APDUS:  # a PC/SC reader is given the APDU alone
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
