"""The general structure of every TEDS: Length ‖ data block of tuples ‖ Checksum (teds.md, "Frame, tuples, verdicts").

:func:`shape_of` distinguishes it from a bare data block and from a message, by the first octets alone.

Everything is big-endian. ``Length`` counts the data block and the two checksum octets. The checksum is a plain sum and
no security measure: it cannot detect exchanged octets.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, Literal, NamedTuple
from zlib import adler32

from teds_provision.errors import BadDataError

TEDSID = 3
_SUMMED = 256
MINIMUM_OCTETS = 12  # Length 4, TEDSID tuple 6, Checksum 2

Shape = Literal["framed", "block", "message"]
_TEDSIDS: Final = (bytes([TEDSID, 4]), bytes([TEDSID, 5]))


class RawTuple(NamedTuple):
    """One tuple: ``offset`` of its Type octet counted from the start of the walk."""

    type: int
    value: bytes
    offset: int


def checksum(octets: bytes) -> int:
    """Return 0xFFFF minus the sum of all octets modulo 65536 (Length included, checksum excluded)."""
    # The lower half of Adler-32 is 1 plus the sum, modulo 65521, which 256 octets never reach; this is much faster than
    # sum().
    if len(octets) <= _SUMMED:
        return 0x10000 - (adler32(octets) & 0xFFFF)
    pieces = [adler32(octets[at : at + _SUMMED]) & 0xFFFF for at in range(0, len(octets), _SUMMED)]
    return 0xFFFF - (sum(pieces) - len(pieces) & 0xFFFF)


def frame(block: bytes) -> bytes:
    """Put Length before and Checksum behind a data block."""
    head = (len(block) + 2).to_bytes(4, "big") + block
    return head + checksum(head).to_bytes(2, "big")


def unframe(teds: bytes) -> bytes:
    """Return the data block of a framed TEDS; raises BadDataError when Length or Checksum are wrong."""
    if len(teds) < 6:
        raise BadDataError(f"A TEDS has at least {MINIMUM_OCTETS} octets, this one {len(teds)}.")
    length = int.from_bytes(teds[:4], "big")
    if length != len(teds) - 4:
        raise BadDataError(f"The Length of this TEDS says {length} octets follow; {len(teds) - 4} do.")
    stated, right = int.from_bytes(teds[-2:], "big"), checksum(teds[:-2])
    if stated != right:
        raise BadDataError(f"The checksum of this TEDS is {stated:04X}; its octets give {right:04X}.")
    return teds[4:-2]


def tuples(block: bytes, *, width: int = 1) -> Iterator[RawTuple]:
    """Walk the tuples of a data block whose tuple lengths have ``width`` octets (TEDSID: always one).

    Raises BadDataError at the first tuple that runs past the end.
    """
    at = 0
    while at < len(block):
        kind = block[at]
        octets = 1 if at == 0 and kind == TEDSID else width
        start = at + 1 + octets
        end = start + int.from_bytes(block[at + 1 : start], "big")
        if start > len(block) or end > len(block):
            raise BadDataError(f"The tuple of type {kind} at octet {at} runs past the end of the data block.")
        yield RawTuple(kind, block[start:end], at)
        at = end


def raw_tuple(kind: int, value: bytes, *, width: int = 1) -> bytes:
    """Write one tuple; raises BadDataError when the value does not fit the length octets."""
    if len(value) >= 1 << 8 * width:
        raise BadDataError(f"Field {kind} has {len(value)} octets; {width} length octets allow {(1 << 8 * width) - 1}.")
    return bytes([kind]) + len(value).to_bytes(width, "big") + value


def teds_class(block: bytes) -> int | None:
    """Return the class (access code) in the TEDSID of a data block, None if there is no valid TEDSID.

    The TEDSID is 4 octets in the 2007 form and 5 in the 2024 form (teds.md, "Frame, tuples, verdicts").
    """
    if len(block) < 6 or block[0] != TEDSID:
        return None
    if block[1] == 4:
        return block[3]
    if block[1] == 5 and len(block) >= 7:
        return block[4]
    return None


def shape_of(octets: bytes) -> Shape:
    """Return what octets are: a TEDS with Length and checksum, a data block without, or a message around something.

    A data block starts with a TEDSID (03 04 or 03 05). A message is recognised by a length in its header that fits to
    the octet. Everything else counts as a framed TEDS, however damaged.
    """
    if int.from_bytes(octets[:4], "big") == len(octets) - 4:
        return "framed"
    if octets[:2] in _TEDSIDS:
        return "message" if _is_message(octets) else "block"
    if octets[4:6] in _TEDSIDS:
        return "framed"
    return "message" if _is_message(octets) else "framed"


def _is_message(octets: bytes) -> bool:
    tedsid = octets[:2] in _TEDSIDS
    if _is_service(octets) and not (tedsid and octets[3]):
        return True
    return not tedsid and (_is_command(octets) or (_counts(octets, 1) and octets[0] <= 1))


def _counts(octets: bytes, at: int) -> bool:
    """Return True if the u16 at ``at`` counts what follows it to the octet."""
    return len(octets) >= at + 2 and int.from_bytes(octets[at : at + 2], "big") == len(octets) - at - 2


def _is_service(octets: bytes) -> bool:
    """Return True for a network service of 2024: type 1 to 9, id, message type 1 to 5, length."""
    return _counts(octets, 3) and 1 <= octets[0] <= 9 and 1 <= octets[2] <= 5


def _is_command(octets: bytes) -> bool:
    """Return True for a command of 2007: channel u16, class 1 to 7 or a maker's, function, length."""
    return _counts(octets, 4) and octets[3] != 0 and (1 <= octets[2] <= 7 or octets[2] >= 128)
