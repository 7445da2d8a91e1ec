"""The signed datasheet: field 100, and the checks that node and reader share (profile.md, "The Security TEDS")."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

from teds_provision.errors import BadDataError
from teds_provision.protocol.keys import Credentials, Verify, is_point, station_key_message, verify
from teds_provision.teds.codec import frame, security
from teds_provision.teds.codec.security import SecurityTeds
from teds_provision.teds.image import SECURITY, BlockId

UUID_FIELD = 4
_UUID_HEAD = bytes([UUID_FIELD, 10])
_TEDSID_OF_2007 = b"\x03\x04"
SEQUENCE_WINDOW = 65536
STORED_CODES = frozenset({*range(1, 18), *range(128, 136)})
LAST_CHANNEL = 255


@dataclass(frozen=True)
class SignedNodeKey:
    """Fields 101 and 102 of a node: its key and the key's signature over itself, for one UUID."""

    uuid: bytes
    key: bytes
    signature: bytes


def can_be_stored(block: BlockId) -> bool:
    """Return True if a node may hold this TEDS: access codes 1 to 17 and 128 to 135, channels 0 to 255."""
    return 0 <= block[0] <= LAST_CHANNEL and block[1] in STORED_CODES


def digests(blocks: Mapping[BlockId, bytes]) -> dict[BlockId, bytes]:
    """Return the SHA-256 of every TEDS (Length to Checksum inclusive) except the Security TEDS."""
    return {key: hashlib.sha256(teds).digest() for key, teds in blocks.items() if key != SECURITY}


def unsigned_datasheet(
    node: SignedNodeKey, station: bytes, station_signature: bytes, listed: Mapping[BlockId, bytes], **values: object
) -> SecurityTeds:
    """Fill in everything but field 100; ``values`` are ca, last_modified, sequence, key_epoch."""
    return SecurityTeds(
        node_key=node.key,
        node_key_signature=node.signature,
        station_key=station,
        station_key_signature=station_signature,
        signed_blocks=dict(sorted(listed.items())),
        **values,  # type: ignore[arg-type]
    )


def sign_datasheet(teds: SecurityTeds, uuid: bytes, credentials: Credentials) -> bytes:
    """Sign a filled-in Security TEDS; returns the framed TEDS."""
    signature = credentials.key.sign(security.tbs(uuid, teds.encode()))
    return teds.with_signature(signature).encode()


def passes_own_check(block: BlockId, teds: bytes) -> bool:
    """Return True if Length and Checksum are right and the TEDSID's class is the access code."""
    try:
        return frame.teds_class(frame.unframe(teds)) == block[1]
    except BadDataError:
        return False


def own_values(teds: SecurityTeds) -> bool:
    """Return True if fields 1 to 4, 105, 109 and 110 have the values of this profile."""
    return teds.values == security.OUR_VALUES


def station_signature_good(teds: SecurityTeds, ca: bytes, verify: Verify | None = None) -> bool:
    """Return True if 104 is the CA's signature over 103, and 103 a point; a node passes its chip's ``verify``."""
    if verify is None:
        return is_certified(ca, teds.station_key, teds.station_key_signature)
    if teds.station_key is None or teds.station_key_signature is None or not is_point(teds.station_key):
        return False
    return verify(ca, station_key_message(teds.station_key), teds.station_key_signature)


def is_certified(ca: bytes, station: bytes | None, signature: bytes | None) -> bool:
    """Return True if ``signature`` (field 104) is that of ``ca`` over ``station`` (field 103), and that a point."""
    return station is not None and signature is not None and is_point(station) and _certified(ca, station, signature)


@lru_cache(maxsize=256)
def _certified(ca: bytes, station: bytes, signature: bytes) -> bool:
    """Return the same, cached: it never changes, and every node of a station needs it twice."""
    return verify(ca, station_key_message(station), signature)


def signature_good(teds: SecurityTeds, octets: bytes, uuid: bytes, check: Verify | None = None) -> bool:
    """Return True if 100 verifies under 103 over the octets as they are; a node passes its chip's ``check``."""
    if teds.station_key is None or teds.signature is None:
        return False
    message = security.tbs(uuid, octets)
    return message_signature_good(teds, message) if check is None else check(teds.station_key, message, teds.signature)


def message_signature_good(teds: SecurityTeds, message: bytes) -> bool:
    """Return True if 100 verifies under 103 over ``message``, which :func:`security.tbs` cut from the octets."""
    if teds.station_key is None or teds.signature is None:
        return False
    return _signed(teds.station_key, message, teds.signature)


def message_signature_good_once(teds: SecurityTeds, message: bytes) -> bool:
    """Return :func:`message_signature_good` of a datasheet among many, without the cache."""
    key, signature = teds.station_key, teds.signature
    return key is not None and signature is not None and verify(key, message, signature)


@lru_cache(maxsize=16)
def _signed(station: bytes, message: bytes, signature: bytes) -> bool:
    """Verify a signature once: what was just read and what is stored are usually the same."""
    return verify(station, message, signature)


def meta_names(teds: bytes, uuid: bytes) -> bool:
    """Return True if field 4 of a Meta-TEDS of the 2007 form is ``uuid``; other forms are not compared (True)."""
    try:
        block = frame.unframe(teds)
        if block[:2] != _TEDSID_OF_2007:
            return True
        width = block[5] if len(block) > 5 else 1
        if width == 1 and block[6:18] == _UUID_HEAD + uuid:
            return True  # always the first field in TEDS of this program
        return any(part.type == UUID_FIELD and part.value == uuid for part in frame.tuples(block, width=width or 1))
    except BadDataError:
        return False
