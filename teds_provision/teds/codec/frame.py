"""The general structure of every TEDS: Length ‖ data block of tuples ‖ Checksum (teds.md, "Frame, tuples, verdicts").

Everything is big-endian. ``Length`` counts the data block and the two checksum octets. The checksum is a plain sum and
no security measure: it cannot see exchanged octets.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from teds_provision.errors import BadData

TEDSID = 3
MINIMUM_OCTETS = 12  # Length 4, TEDSID tuple 6, Checksum 2


class RawTuple(NamedTuple):
    """One tuple as it stands: ``offset`` of its Type octet counted from the start of what was walked."""

    type: int
    value: bytes
    offset: int


def checksum(octets: bytes) -> int:
    """0xFFFF minus the sum of all octets modulo 65536 (Length included, checksum excluded)."""
    return 0xFFFF - (sum(octets) & 0xFFFF)


def frame(block: bytes) -> bytes:
    """Put Length before and Checksum behind a data block."""
    head = (len(block) + 2).to_bytes(4, "big") + block
    return head + checksum(head).to_bytes(2, "big")


def unframe(teds: bytes) -> bytes:
    """Return the data block of a framed TEDS; raises BadData when Length or Checksum are wrong."""
    if len(teds) < 6:
        raise BadData(f"A TEDS has at least {MINIMUM_OCTETS} octets, this one {len(teds)}.")
    length = int.from_bytes(teds[:4], "big")
    if length != len(teds) - 4:
        raise BadData(f"The Length of this TEDS says {length} octets follow; {len(teds) - 4} do.")
    stated, right = int.from_bytes(teds[-2:], "big"), checksum(teds[:-2])
    if stated != right:
        raise BadData(f"The checksum of this TEDS is {stated:04X}; its octets give {right:04X}.")
    return teds[4:-2]


def tuples(block: bytes, *, width: int = 1) -> Iterator[RawTuple]:
    """Walk the tuples of a data block whose tuple lengths have ``width`` octets (TEDSID: always one).

    Raises BadData at the first tuple that runs past the end.
    """
    at = 0
    while at < len(block):
        kind = block[at]
        octets = 1 if at == 0 and kind == TEDSID else width
        start = at + 1 + octets
        end = start + int.from_bytes(block[at + 1 : start], "big")
        if start > len(block) or end > len(block):
            raise BadData(f"The tuple of type {kind} at octet {at} runs past the end of the data block.")
        yield RawTuple(kind, block[start:end], at)
        at = end


def raw_tuple(kind: int, value: bytes, *, width: int = 1) -> bytes:
    """Write one tuple; raises BadData when the value does not fit the length octets."""
    if len(value) >= 1 << 8 * width:
        raise BadData(f"Field {kind} has {len(value)} octets; {width} length octets allow {(1 << 8 * width) - 1}.")
    return bytes([kind]) + len(value).to_bytes(width, "big") + value


def teds_class(block: bytes) -> int | None:
    """Class (access code) that the TEDSID of a data block names, None where there is no readable TEDSID.

    The TEDSID is 4 octets in the 2007 form and 5 in the 2024 form (teds.md, "Frame, tuples, verdicts").
    """
    if len(block) < 6 or block[0] != TEDSID:
        return None
    if block[1] == 4:
        return block[3]
    if block[1] == 5 and len(block) >= 7:
        return block[4]
    return None
