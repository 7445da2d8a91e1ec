"""Sessions under a link key: Open, Sealed, counters (profile section 4). Pure, both roles.

AES-128-CCM of RFC 3610 with a 16-octet tag, PKCS #7 padding, HKDF and HMAC as in the key agreement.
"""

from __future__ import annotations

import hmac
import os
from dataclasses import dataclass, field

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.ciphers.aead import AESCCM
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from teds_provision.errors import Garbled, NotAuthentic
from teds_provision.protocol.agreement import key_id
from teds_provision.protocol.messages.frames import Command, Function, Reply, decode_reply, security_command

NONCE_OCTETS = 16
TAG_OCTETS = 16
OPEN_OCTETS = 8 + NONCE_OCTETS
SEALED_HEAD_OCTETS = 4 + TAG_OCTETS
LAST_COUNTER = 0xFFFFFFFF
BLOCK_OCTETS = 16


def pad(octets: bytes) -> bytes:
    """PKCS #7 padding to 16 octets (RFC 5652 section 6.3)."""
    count = BLOCK_OCTETS - len(octets) % BLOCK_OCTETS
    return octets + bytes([count]) * count


def unpad(octets: bytes) -> bytes | None:
    """Take the padding off; None where it is not right."""
    count = octets[-1] if octets else 0
    if len(octets) % BLOCK_OCTETS or not 1 <= count <= BLOCK_OCTETS or octets[-count:] != bytes([count]) * count:
        return None
    return octets[:-count]


@dataclass(frozen=True)
class SessionKeys:
    """k_sn, k_ns (16 octets each) and the node's tag of one Open."""

    to_node: bytes = field(repr=False)
    to_station: bytes = field(repr=False)
    node_tag: bytes = field(repr=False)

    @classmethod
    def derive(cls, key: bytes, uuid: bytes, station_nonce: bytes, node_nonce: bytes) -> SessionKeys:
        """HKDF-SHA-256(K, salt = nonceS ‖ nonceN, info = "TEDS1 session" ‖ 00 ‖ UUID, 64 octets)."""
        okm = HKDF(hashes.SHA256(), 64, station_nonce + node_nonce, b"TEDS1 session\0" + uuid).derive(key)
        tag = hmac.digest(okm[32:], b"node open" + key_id(key) + station_nonce + node_nonce, "sha256")
        return cls(okm[:16], okm[16:32], tag[:TAG_OCTETS])


def _seal(key: bytes, counter: int, octets: bytes) -> bytes:
    nonce = bytes(9) + counter.to_bytes(4, "big")
    return counter.to_bytes(4, "big") + AESCCM(key, tag_length=TAG_OCTETS).encrypt(nonce, pad(octets), None)


def _unseal(key: bytes, payload: bytes) -> bytes | None:
    try:
        padded = AESCCM(key, tag_length=TAG_OCTETS).decrypt(bytes(9) + payload[:4], payload[4:], None)
    except (InvalidTag, ValueError):
        return None
    return unpad(padded)


class StationSession:
    """The station's half: one Open, then sealed commands with rising counters."""

    def __init__(self, key: bytes, uuid: bytes, *, nonce: bytes | None = None) -> None:
        self._key, self._uuid = key, uuid
        self._nonce = os.urandom(NONCE_OCTETS) if nonce is None else nonce
        self._keys: SessionKeys | None = None
        self._counter = 0

    def open(self) -> Command:
        """Return the Open to send."""
        return security_command(Function.OPEN, key_id(self._key) + self._nonce)

    def accept(self, payload: bytes) -> None:
        """Check the reply to Open; raises Garbled or NotAuthentic (the node does not hold the key)."""
        if len(payload) != NONCE_OCTETS + TAG_OCTETS:
            raise Garbled(f"The reply to Open has {len(payload)} octets, not {NONCE_OCTETS + TAG_OCTETS}.")
        keys = SessionKeys.derive(self._key, self._uuid, self._nonce, payload[:NONCE_OCTETS])
        if not hmac.compare_digest(keys.node_tag, payload[NONCE_OCTETS:]):
            raise NotAuthentic("The node's tag on Open is wrong: it does not hold the key.")
        self._keys = keys

    def seal(self, command: Command) -> Command:
        """Seal one inner command under the next counter."""
        assert self._keys is not None, "seal() before a good accept()"
        if self._counter >= LAST_COUNTER:
            raise Garbled("This session has used up its counters; open a new one.")
        self._counter += 1
        return security_command(Function.SEALED, _seal(self._keys.to_node, self._counter, command.encode()))

    def unseal(self, payload: bytes) -> Reply:
        """Open the sealed reply to the last command; raises Garbled or NotAuthentic."""
        assert self._keys is not None, "unseal() before a good accept()"
        if len(payload) < SEALED_HEAD_OCTETS + BLOCK_OCTETS or int.from_bytes(payload[:4], "big") != self._counter:
            raise NotAuthentic("A sealed reply does not belong to the command that was sent.")
        inner = _unseal(self._keys.to_station, payload)
        if inner is None:
            raise NotAuthentic("The tag of a sealed reply is wrong.")
        return decode_reply(inner)


class NodeSession:
    """The node's half of one Open; ``counter`` is that of the last good frame, 0 while half-open."""

    def __init__(self, key: bytes, uuid: bytes, station_nonce: bytes, *, nonce: bytes | None = None) -> None:
        node_nonce = os.urandom(NONCE_OCTETS) if nonce is None else nonce
        self._keys = SessionKeys.derive(key, uuid, station_nonce, node_nonce)
        self.reply = node_nonce + self._keys.node_tag
        self.counter = 0
        self.good_at = 0.0
        self.staging: dict[tuple[int, int], bytes] = {}

    def unseal(self, payload: bytes) -> bytes | None:
        """Return the inner frame where tag and padding are right, else None. Changes nothing."""
        return _unseal(self._keys.to_node, payload)

    def seal(self, counter: int, frame: bytes) -> bytes:
        """Seal the one reply of ``counter``."""
        return _seal(self._keys.to_station, counter, frame)
