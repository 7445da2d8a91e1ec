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
    tedsid = octets[:2] in _TEDSIDS
    if _is_service(octets) and not (tedsid and octets[3]):
        return True
    return not tedsid and (_is_command(octets) or _is_reply(octets))


def _counts(octets: bytes, at: int) -> bool:
    """Whether the u16 at ``at`` counts what follows it to the octet."""
    return len(octets) >= at + 2 and int.from_bytes(octets[at : at + 2], "big") == len(octets) - at - 2


def _is_service(octets: bytes) -> bool:
    """A network service of 2024: type 1 to 9, id, message type 1 to 5, length."""
    return _counts(octets, 3) and 1 <= octets[0] <= 9 and 1 <= octets[2] <= 5


def _is_command(octets: bytes) -> bool:
    """A command of 2007: channel u16, class 1 to 7 or a maker's, function, length."""
    return _counts(octets, 4) and octets[3] != 0 and (1 <= octets[2] <= 7 or octets[2] >= 128)


def _is_reply(octets: bytes) -> bool:
    """A reply of 2007: flag 0 or 1, length."""
    return _counts(octets, 1) and octets[0] <= 1


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
