"""CAN frames in words: who to whom, and which part of a message (profile.md, "CAN"; ISO 15765-2)."""

from __future__ import annotations

from teds_provision.links.can.isotp import FUNCTIONAL, addresses, read_single
from teds_provision.protocol.announce import Announce
from teds_provision.protocol.operation.can_frames import TRIGGER, data_address, drive_address

_NONE = "no frame of ISO 15765-2"
_FLOWS = ("go on", "wait", "overflow")


def can_words(identifier: int, data: bytes) -> str:
    """What a frame of the profile is; "not of the profile" for any other. Never raises."""
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
    if Announce.decode(identifier, data) is not None:
        return f"{source:02x}: Announce"
    if identifier & 0x1FFFFF00 == TRIGGER:
        return f"{source:02x} to all: trigger {data.hex()}"
    return "not of the profile"


def _transport(data: bytes) -> str:
    """The ISO 15765-2 part of a frame; transactions are the first octet of the profile's messages."""
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
