"""Data messages and Drive messages: run keys, sealing, opening, layouts (operation.md sections 3 and 4). Both roles.

A data message is ``counter u32 ‖ CCM(key, nonce = 9 zero octets ‖ counter, empty AAD, flags u8 ‖ body, 8-octet tag)``.
Keys die with the session, runs never repeat in it and counters never in a run: no (key, nonce) comes twice.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final, NamedTuple

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.ciphers.aead import AESCCM
from cryptography.hazmat.primitives.kdf.hkdf import HKDFExpand

TAG_OCTETS: Final = 8
COUNTER_OCTETS: Final = 4

"""Counter, flags and tag."""
LAST_COUNTER: Final = 0xFFFFFFFF
LAST_RUN: Final = 0xFFFF
DRIVE_HEAD: Final = 4
_NONCE_HEAD: Final = bytes(9)


def stream_key(message_key: bytes, run: int) -> bytes:
    """Return the key of a stream's run: HKDF-Expand-SHA-256(k_m, "TEDS1 stream" ‖ 00 ‖ run u16, 16 octets)."""
    return HKDFExpand(hashes.SHA256(), 16, b"TEDS1 stream\0" + run.to_bytes(2, "big")).derive(message_key)


def drive_key(message_key: bytes, run: int) -> bytes:
    """Return the key of a Drive's run, derived like that of a stream with "TEDS1 drive"."""
    return HKDFExpand(hashes.SHA256(), 16, b"TEDS1 drive\0" + run.to_bytes(2, "big")).derive(message_key)


class DatagramSealer:
    """Seals and opens the messages of one run."""

    def __init__(self, key: bytes) -> None:
        self._cipher = AESCCM(key, tag_length=TAG_OCTETS)
        self._decrypt = self._cipher.decrypt

    def seal(self, counter: int, plain: bytes) -> bytes:
        """Seal one message. The caller has to use each counter once only."""
        head = counter.to_bytes(COUNTER_OCTETS, "big")
        return head + self._cipher.encrypt(_NONCE_HEAD + head, plain, None)

    def open(self, message: bytes) -> bytes | None:
        """Return the plain octets, None for a bad tag (or too few octets to hold one)."""
        try:
            return self._decrypt(_NONCE_HEAD + message[:COUNTER_OCTETS], message[COUNTER_OCTETS:], None)
        except (InvalidTag, ValueError):
            return None


def counter_of(message: bytes) -> int:
    """Return the counter at its head."""
    return int.from_bytes(message[:COUNTER_OCTETS], "big")


class DriveValues(NamedTuple):
    """Content of a Drive message: ``until`` in µs (node's tick / 1000 mod 2^32), and its data sets in order."""

    until: int
    data: bytes

    def encode(self) -> bytes:
        """Return until u32 ‖ data sets."""
        return struct.pack(">I", self.until) + self.data

    @classmethod
    def decode(cls, plain: bytes) -> DriveValues:
        """Cut the plain octets of a message whose length was checked."""
        return cls(int.from_bytes(plain[:DRIVE_HEAD], "big"), plain[DRIVE_HEAD:])


def drive_length(octets: int) -> int:
    """Return the octets of a Drive message whose data sets have ``octets`` together."""
    return COUNTER_OCTETS + DRIVE_HEAD + octets + TAG_OCTETS


@dataclass(frozen=True)
class Layout:
    """Positions of a stream's channels in one instant: channel numbers and their ModLenth in octets."""

    channels: tuple[int, ...]
    widths: tuple[int, ...]

    @property
    def octets(self) -> int:
        """Octets of one instant."""
        return sum(self.widths)

    def cut(self, instant: bytes) -> tuple[bytes, ...]:
        """Split one instant into data sets, in order."""
        parts, at = [], 0
        for width in self.widths:
            parts.append(instant[at : at + width])
            at += width
        return tuple(parts)


def pattern(channel: int, octets: int, index: int) -> bytes:
    """Sample ``index`` of ``channel`` of the test pattern: (index + channel) mod 2^(8 · octets), ``octets`` octets."""
    return ((index + channel) % (1 << 8 * octets)).to_bytes(octets, "big") if octets else b""
