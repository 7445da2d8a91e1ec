"""The TEDS of one node out of a document that holds them: which channel each belongs to, and whose they are."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from teds_provision.errors import BadData
from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.frame import frame, raw_tuple, tuples, unframe
from teds_provision.teds.formats import Kind, detect, read_blocks
from teds_provision.teds.image import BlockId
from teds_provision.teds.sheet import Sheet

UUID_OCTETS: Final = 10
_META: Final[BlockId] = (0, AccessCode.META)
_UUID_FIELD: Final = 4
_OF_A_CHANNEL: Final = frozenset({AccessCode.CHANNEL, AccessCode.CALIBRATION})


def placed(octets: bytes, kind: Kind | None = None, *, path: Path | None = None) -> dict[BlockId, bytes]:
    """TEDS of a document by channel and access code, without the Security TEDS; channel TEDS alone are of channel 1.

    ``path`` is where a profile lies, for what it extends. Raises BadData for what holds no TEDS, or two of one place.
    """
    found: dict[BlockId, bytes] = {}
    for channel, code, teds in read_blocks(octets, kind or detect(octets), path=path):
        if code is None:
            raise BadData(
                "There are octets in it that are no TEDS.", hint="See what it holds: teds-provision show FILE"
            )
        usual = 1 if code in _OF_A_CHANNEL else 0
        key = (usual if channel is None else channel, int(code))
        if key in found:
            raise BadData(f"It holds two TEDS of access code {code} for channel {key[0]}.")
        found[key] = teds
    found = {key: teds for key, teds in found.items() if key[1] != AccessCode.SECURITY}
    if not found:
        raise BadData("It holds no TEDS.")
    return found


def stated_uuid(blocks: Mapping[BlockId, bytes]) -> bytes | None:
    """The UUID that the Meta-TEDS states, 10 octets; None where it states none, or zeros."""
    stated = Sheet.of_blocks(blocks).meta.uuid
    return stated if stated and len(stated) == UUID_OCTETS and any(stated) else None


def under(blocks: Mapping[BlockId, bytes], uuid: bytes) -> dict[BlockId, bytes]:
    """The same TEDS of another node: field 4 of a Meta-TEDS of the 2007 form says its UUID."""
    meta = blocks.get(_META)
    if meta is None or stated_uuid(blocks) == uuid:
        return dict(blocks)
    parts = [
        raw_tuple(part.type, uuid if part.type == _UUID_FIELD and len(part.value) == UUID_OCTETS else part.value)
        for part in tuples(unframe(meta))
    ]
    return {**blocks, _META: frame(b"".join(parts))}
