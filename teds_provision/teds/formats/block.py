"""One TEDS with its place, and cutting a run of framed TEDS apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from teds_provision.limits import LIMITS, check_count
from teds_provision.teds.codec.frame import MINIMUM_OCTETS, checksum, teds_class


class Block(NamedTuple):
    """A TEDS or bare data block: its channel and access code where they are known, and its octets as they are."""

    channel: int | None
    access_code: int | None
    octets: bytes


def class_of(octets: bytes) -> int | None:
    """Access code that the TEDSID of a framed TEDS or a bare data block names, None where there is none."""
    framed = teds_class(octets[4:])
    return framed if framed is not None else teds_class(octets)


def split_run(octets: bytes) -> list[bytes]:
    """Framed TEDS that stand one after the other; everything as one piece where they do not close to the octet."""
    pieces: list[bytes] = []
    at = 0
    while at < len(octets):
        end = at + 4 + int.from_bytes(octets[at : at + 4], "big")
        piece = octets[at:end]
        if len(piece) < MINIMUM_OCTETS or end > len(octets) or octets[at + 4] != 3:
            return [octets]
        if pieces or end < len(octets):
            stated = int.from_bytes(piece[-2:], "big")
            if stated != checksum(piece[:-2]):
                return [octets]
        pieces.append(piece)
        check_count(len(pieces), LIMITS.teds_of_a_file, "TEDS")
        at = end
    return pieces


def with_class(octets: bytes) -> Block:
    """Block whose access code is the class that its TEDSID names."""
    return Block(None, class_of(octets), octets)


def is_run(blocks: Sequence[Block]) -> bool:
    """Whether blocks put one after the other come apart again as they were."""
    return [block.octets for block in blocks] == split_run(b"".join(block.octets for block in blocks))
