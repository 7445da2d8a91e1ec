"""SMP packets (version 2) and their CBOR, written from RFC 8949: for tests, also what no encoder would make."""

from __future__ import annotations

from typing import Any, Final

READ, WRITE = 0x08, 0x0A
PARAMETERS: Final = (READ, 0, 6)
BOOT_LOADER: Final = (READ, 0, 8)
STATES: Final = (READ, 1, 0)
SLOTS: Final = (READ, 1, 6)
ECHO: Final = (WRITE, 0, 0)
RESTART: Final = (WRITE, 0, 5)
SET_STATE: Final = (WRITE, 1, 0)
UPLOAD: Final = (WRITE, 1, 1)
EMPTY: Final = b"\xa0"
CONFIRM: Final = b"\xa1\x67confirm\xf5"


def start(image: bytes) -> bytes:
    """Return the body of 1/0 that starts an image at the next restart, on trial."""
    return b"\xa1\x64hash\x58\x20" + image


def packet(command: tuple[int, int, int], body: bytes = EMPTY, sequence: int = 7) -> bytes:
    """Return a packet."""
    first, group, number = command
    head = bytes([first, 0]) + len(body).to_bytes(2, "big") + group.to_bytes(2, "big")
    return head + bytes([sequence, number]) + body


def body_of(reply: bytes) -> Any:
    """Return what the body of a reply says; raises AssertionError if its header is not right."""
    assert reply[0] in (READ | 1, WRITE | 1)
    assert int.from_bytes(reply[2:4], "big") == len(reply) - 8
    value, end = _decode(reply, 8)
    assert end == len(reply)
    return value


def head(major: int, value: int) -> bytes:
    """Return an item's head, its number as short as it can be."""
    if value < 24:
        return bytes([major << 5 | value])
    size = next(size for size in range(4) if value < 1 << (8 << size))
    return bytes([major << 5 | 24 + size]) + value.to_bytes(1 << size, "big")


def encode(value: object) -> bytes:
    """Return the CBOR of a value."""
    if isinstance(value, bool):
        return b"\xf5" if value else b"\xf4"
    if isinstance(value, int):
        return head(0, value)
    if isinstance(value, bytes):
        return head(2, len(value)) + value
    if isinstance(value, str):
        return head(3, len(value.encode())) + value.encode()
    if isinstance(value, list):
        return head(4, len(value)) + b"".join(map(encode, value))
    assert isinstance(value, dict)
    return head(5, len(value)) + b"".join(encode(key) + encode(entry) for key, entry in value.items())


def _decode(octets: bytes, at: int) -> tuple[Any, int]:
    major, additional = octets[at] >> 5, octets[at] & 31
    at += 1
    value = additional
    if 24 <= additional <= 27:
        size = 1 << (additional - 24)
        value, at = int.from_bytes(octets[at : at + size], "big"), at + size
    if major == 0:
        return value, at
    if major in (2, 3):
        text = octets[at : at + value]
        return (text if major == 2 else text.decode()), at + value
    if major == 7:
        return {20: False, 21: True}[additional], at
    entries: list[Any] = []
    count = value * (2 if major == 5 else 1)
    while (octets[at] != 0xFF) if additional == 31 else len(entries) < count:
        entry, at = _decode(octets, at)
        entries.append(entry)
    at += additional == 31
    return (dict(zip(entries[::2], entries[1::2], strict=True)) if major == 5 else entries), at
