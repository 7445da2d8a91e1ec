"""A trace as pcapng, which Wireshark opens (IETF draft-ietf-opsawg-pcapng, block types of its section 4).

Three interfaces, by link type: CAN frames (227, SocketCAN: identifier and flags u32 big-endian, length, FD flags, two
octets reserved, data), NFC frames (264, ISO 14443: version 0, event, length u16 big-endian, data without its CRC), and
messages and all else (147, user 0: the octets as sent). The opened form and its description are comments of the packet.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final

from teds_provision import __version__
from teds_provision.errors import BadDataError
from teds_provision.links.ports import Direction
from teds_provision.trace.frames import can_words, nfc_words
from teds_provision.trace.record import Record

_SECTION, _INTERFACE, _PACKET = 0x0A0D0D0A, 1, 6
_ORDER: Final = 0x1A2B3C4D
_CAN, _NFC, _MESSAGE = 227, 264, 147
_INTERFACES: Final = ((_CAN, "can"), (_NFC, "nfc"), (_MESSAGE, "messages"))
_EXTENDED: Final = 0x80000000
_FD_FLAGS: Final = 0x05
"""CANFD_BRS and CANFD_FDF (linux/can.h)."""
_TO_TAG, _TO_READER = 0xFA, 0xFB
"""Events: data of the reader to the tag, of the tag to the reader, the CRC not among them."""
_END, _COMMENT, _NAME, _APPLICATION, _FLAGS, _RESOLUTION = 0, 1, 2, 4, 2, 9
_INBOUND, _OUTBOUND = 1, 2
_OPENED: Final = "opened: "
_UUID: Final = "node: "
_LINK: Final = "link: "


def head() -> bytes:
    """Return the section header and the three interfaces."""
    section = struct.pack("<IHHq", _ORDER, 1, 0, -1) + _option(_APPLICATION, f"teds-provision {__version__}".encode())
    octets = _block(_SECTION, section + _option(_END))
    for link_type, name in _INTERFACES:
        options = _option(_NAME, name.encode()) + _option(_RESOLUTION, b"\x06") + _option(_END)
        octets += _block(_INTERFACE, struct.pack("<HHI", link_type, 0, 0) + options)
    return octets


def block(record: Record) -> bytes:
    """Return one record as an Enhanced Packet Block, its time in µs."""
    number, data = _framed(record)
    moment = round(record.time * 1e6)
    comments = [record.command] if number == 2 else []
    comments += [f"{_OPENED}{record.opened.hex()}"] if record.opened is not None else []
    comments += [f"{_UUID}{record.uuid}"] if record.uuid else []
    comments += [f"{_LINK}{record.link} {record.layer}"] if number == 2 else []
    flags = _option(_FLAGS, struct.pack("<I", _OUTBOUND if record.direction == "out" else _INBOUND))
    options = b"".join(_option(_COMMENT, text.encode()) for text in comments) + flags + _option(_END)
    fixed = struct.pack("<IIIII", number, moment >> 32, moment & 0xFFFFFFFF, len(data), len(data))
    return _block(_PACKET, fixed + _padded(data) + options)


def is_pcapng(octets: bytes) -> bool:
    """Return True if a file begins as pcapng does."""
    return octets[:4] == _SECTION.to_bytes(4, "big") and len(octets) >= 12


def read_pcapng(octets: bytes) -> Iterator[Record]:
    """Yield every packet of a known link type; a last block that was cut off is left out.

    Raises BadDataError.
    """
    interfaces: list[tuple[int, float]] = []
    for at, order, kind, body in _blocks(octets):
        try:
            if kind == _SECTION:
                interfaces = []
            elif kind == _INTERFACE:
                interfaces.append(_interface(order, body))
            elif kind == _PACKET and (record := _record(order, body, interfaces)) is not None:
                yield record
        except (struct.error, IndexError, ValueError) as error:
            raise BadDataError(f"The pcapng block at octet {at} does not parse: {error}.") from error


def _blocks(octets: bytes) -> Iterator[tuple[int, str, int, bytes]]:
    """Place, order of octets ("<" or ">"), type and body of each whole block."""
    order, at = "<", 0
    while at + 12 <= len(octets):
        if octets[at : at + 4] == _SECTION.to_bytes(4, "big"):
            order = "<" if octets[at + 8 : at + 12] == struct.pack("<I", _ORDER) else ">"
        kind, length = struct.unpack_from(f"{order}II", octets, at)
        if length < 12 or length % 4:
            raise BadDataError(f"The pcapng block at octet {at} says it has {length} octets.")
        if at + length > len(octets):
            return
        yield at, order, kind, octets[at + 8 : at + length - 4]
        at += length


def _framed(record: Record) -> tuple[int, bytes]:
    """Return the number of the interface, and the packet with the head of its link type."""
    data = record.octets
    if record.layer == "message" or (record.identifier is None and record.link != "nfc"):
        return 2, data
    if record.identifier is not None:
        flags = _FD_FLAGS if record.fd else 0
        return 0, struct.pack(">IBBH", record.identifier | _EXTENDED, len(data), flags, 0) + data
    return 1, struct.pack(">BBH", 0, _TO_TAG if record.direction == "out" else _TO_READER, len(data)) + data


def _block(kind: int, body: bytes) -> bytes:
    length = len(body) + 12
    return struct.pack("<II", kind, length) + body + struct.pack("<I", length)


def _option(code: int, value: bytes = b"") -> bytes:
    return struct.pack("<HH", code, len(value)) + _padded(value)


def _padded(octets: bytes) -> bytes:
    return octets + bytes(-len(octets) % 4)


def _options(order: str, octets: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + 4 <= len(octets):
        code, length = struct.unpack_from(f"{order}HH", octets, at)
        if code == _END:
            return
        yield code, octets[at + 4 : at + 4 + length]
        at += 4 + length + -length % 4


def _interface(order: str, body: bytes) -> tuple[int, float]:
    """Link type, and seconds of one tick of its clock."""
    resolution = 6
    for code, value in _options(order, body[8:]):
        resolution = value[0] if code == _RESOLUTION else resolution
    tick = 2.0 ** -(resolution & 0x7F) if resolution & 0x80 else 10.0**-resolution
    return int(struct.unpack_from(f"{order}H", body)[0]), tick


def _record(order: str, body: bytes, interfaces: list[tuple[int, float]]) -> Record | None:
    number, high, low, captured, _ = struct.unpack_from(f"{order}IIIII", body)
    if captured > len(body) - 20:
        raise ValueError(f"{captured} octets are said to be captured, {len(body) - 20} are there")
    link_type, tick = interfaces[number]
    data = body[20 : 20 + captured]
    direction: Direction = "in"
    comments = []
    for code, value in _options(order, body[20 + captured + -captured % 4 :]):
        if code == _FLAGS and len(value) == 4:
            direction = "out" if struct.unpack(f"{order}I", value)[0] & 3 == _OUTBOUND else "in"
        elif code == _COMMENT:
            comments.append(value.decode(errors="replace"))
    moment = (high << 32 | low) * tick
    if link_type == _CAN:
        return _can(moment, direction, data)
    if link_type == _NFC:
        return _nfc(moment, data)
    return _message(moment, direction, data, comments) if link_type == _MESSAGE else None


def _can(moment: float, direction: Direction, data: bytes) -> Record:
    identifier, length, flags, _ = struct.unpack_from(">IBBH", data)
    payload, identifier = data[8 : 8 + length], identifier & 0x1FFFFFFF
    words = can_words(identifier, payload)
    return Record(
        moment, direction, "can", "frame", payload, words, identifier=identifier, fd=bool(flags & 4) or length > 8
    )


def _nfc(moment: float, data: bytes) -> Record:
    _, event, length = struct.unpack_from(">BBH", data)
    direction: Direction = "out" if event in (_TO_TAG, 0xFE) else "in"
    payload = data[4 : 4 + length]
    return Record(moment, direction, "nfc", "frame", payload, nfc_words(payload, direction))


def _message(moment: float, direction: Direction, data: bytes, comments: list[str]) -> Record:
    comments_by_key = {
        key: text[len(key) :] for text in comments for key in (_OPENED, _UUID, _LINK) if text.startswith(key)
    }
    link, _, layer = comments_by_key.get(_LINK, "").partition(" ")
    words = next((text for text in comments if not text.startswith((_OPENED, _UUID, _LINK))), "")
    return Record(
        moment,
        direction,
        link,
        "frame" if layer == "frame" else "message",
        data,
        words,
        opened=bytes.fromhex(comments_by_key[_OPENED]) if _OPENED in comments_by_key else None,
        sealed=_OPENED in comments_by_key or words.endswith("not opened"),
        uuid=comments_by_key.get(_UUID, ""),
    )
