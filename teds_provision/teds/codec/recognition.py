"""Tell a framed TEDS from a bare data block and from a message, by the first octets alone; words of the verdict."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, Literal

from teds_provision.teds.codec.frame import TEDSID
from teds_provision.teds.codec.model import Finding, Verdict

Shape = Literal["framed", "block", "message"]

FRAME_CODES: Final = frozenset({"frame-length", "frame-checksum", "frame-trailing"})
MALFORMED_CODES: Final = frozenset({"not-closed", "too-short", "too-large", "too-many"})
_TEDSIDS: Final = (bytes([TEDSID, 4]), bytes([TEDSID, 5]))


def shape_of(octets: bytes) -> Shape:
    """What octets are: a TEDS with Length and checksum, a data block without, or a message around something.

    A data block starts with a TEDSID (03 04 or 03 05). A message is recognised by a length in its header that fits to
    the octet. Everything else is taken for a framed TEDS, however damaged.
    """
    if int.from_bytes(octets[:4], "big") == len(octets) - 4:
        return "framed"
    if octets[:2] in _TEDSIDS:
        return "message" if _is_message(octets) else "block"
    if octets[4:6] in _TEDSIDS:
        return "framed"
    return "message" if _is_message(octets) else "framed"


def _is_message(octets: bytes) -> bool:
    size = len(octets)
    if size >= 5 and octets[:1] <= b"\x09" and octets[0] and 1 <= octets[2] <= 5:
        length = int.from_bytes(octets[3:5], "big")
        if length == size - 5 and not (octets[:2] in _TEDSIDS and octets[3]):
            return True
    if octets[:2] in _TEDSIDS:
        return False
    commanded = size >= 6 and octets[3] and (1 <= octets[2] <= 7 or octets[2] >= 128)
    if commanded and int.from_bytes(octets[4:6], "big") == size - 6:
        return True
    return size >= 3 and octets[0] <= 1 and int.from_bytes(octets[1:3], "big") == size - 3


def verdict_of(framed: bool, findings: Iterable[Finding]) -> Verdict:
    """Verdict from the errors found; warnings and notes do not count."""
    frame = content = False
    for finding in findings:
        if finding.severity != "error":
            continue
        if finding.code in MALFORMED_CODES:
            return Verdict.MALFORMED
        if finding.code in FRAME_CODES:
            frame = True
        else:
            content = True
    if not framed:
        return Verdict.BLOCK_NONCONFORMANT if content else Verdict.BLOCK_CLEAN
    if frame:
        return Verdict.FRAME_AND_CONTENT_BAD if content else Verdict.FRAME_BAD
    return Verdict.CONTENT_NONCONFORMANT if content else Verdict.CLEAN
