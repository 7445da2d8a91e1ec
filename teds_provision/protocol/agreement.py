"""Key agreement: Request, Confirm, and the link key they give (profile.md, "Key agreement").

NIST SP 800-56A rev. 3 scheme C(1e, 2s, ECC CDH) with bilateral key confirmation; HKDF of RFC 5869. Pure: no I/O, both
roles. Python cannot wipe memory reliably; Z and OKM live in local names only and are dropped on return.
"""

from __future__ import annotations

import hashlib
import hmac
import os
from dataclasses import dataclass, field

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from teds_provision.errors import Garbled, NotAuthentic, OtherKey, PolicyRefused
from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.keys import PrivateKey, SoftwareKey, fingerprint, is_point, node_key_good
from teds_provision.protocol.messages.frames import Command, Function, security_command
from teds_provision.teds.codec import security

REQUEST_OCTETS = 65 + 64 + 65 + 65
REPLY_HEAD_OCTETS = 16 + 4 + 16
TAG_OCTETS = 16
LAST_EPOCH = 0xFFFFFFFF


@dataclass(frozen=True)
class Credentials:
    """What a station shows: its key, and its owner's CA's signature over it (SIG104, 64 octets) with P(CA)."""

    key: PrivateKey
    station_signature: bytes
    ca: bytes


@dataclass(frozen=True)
class RequestPayload:
    """P(station) ‖ SIG104 ‖ P(CA) ‖ E."""

    station: bytes
    station_signature: bytes
    ca: bytes
    one_time: bytes

    def encode(self) -> bytes:
        """Return the 259 octets."""
        return self.station + self.station_signature + self.ca + self.one_time

    @classmethod
    def decode(cls, octets: bytes) -> RequestPayload:
        """Cut 259 octets; the caller has checked the length."""
        return cls(octets[:65], octets[65:129], octets[129:194], octets[194:259])


@dataclass(frozen=True)
class LinkKey:
    """K and the two confirmation tags of one agreement."""

    key: bytes = field(repr=False)
    node_tag: bytes = field(repr=False)
    station_tag: bytes = field(repr=False)


def key_id(key: bytes) -> bytes:
    """Return keyId of a link key: SHA-256("TEDS1 key id" ‖ 00 ‖ K)[0:8]."""
    return hashlib.sha256(b"TEDS1 key id\0" + key).digest()[:8]


def transcript(request: bytes, nonce: bytes, epoch: int, uuid: bytes, node: bytes, teds: bytes) -> bytes:
    """T: SHA-256 over the label, the request payload, nonceN, epoch, UUID, P(node) and the hash of the TEDS."""
    digest = hashlib.sha256(teds).digest()
    return hashlib.sha256(
        b"TEDS1 transcript\0" + request + nonce + epoch.to_bytes(4, "big") + uuid + node + digest
    ).digest()


def derive(shared: bytes, nonce: bytes, script: bytes) -> LinkKey:
    """Link key and tags from Z (64 octets), nonceN and T."""
    okm = HKDF(hashes.SHA256(), 48, nonce, b"TEDS1 link key\0" + script).derive(shared)
    key, confirmation = okm[:16], okm[16:]
    return LinkKey(
        key,
        hmac.digest(confirmation, b"node" + script, "sha256")[:TAG_OCTETS],
        hmac.digest(confirmation, b"station" + script, "sha256")[:TAG_OCTETS],
    )


@dataclass(frozen=True)
class AgreedKey:
    """What the station has after a good Request: the key to store as pending, and the Confirm to send then.

    ``unsigned`` says that the node shows its initial Security TEDS: authentic, since the transcript covers it.
    """

    key: bytes = field(repr=False)
    epoch: int
    node: bytes
    confirm: Command = field(repr=False)
    unsigned: bool

    @property
    def key_id(self) -> bytes:
        """KeyId of the new key, 8 octets."""
        return key_id(self.key)


class StationAgreement:
    """The station's half. One object is one Request."""

    def __init__(self, credentials: Credentials, uuid: bytes, *, one_time: PrivateKey | None = None) -> None:
        self._credentials = credentials
        self._uuid = uuid
        self._one_time = one_time or SoftwareKey.generate()
        self._payload = RequestPayload(
            credentials.key.point, credentials.station_signature, credentials.ca, self._one_time.point
        ).encode()

    def request(self) -> Command:
        """Return the Request to send."""
        return security_command(Function.REQUEST, self._payload)

    def accept(self, reply: bytes, *, pinned: str | None, epoch: int) -> AgreedKey:
        """Check the reply's payload and derive the key.

        ``pinned`` is the fingerprint that the whitelist holds, None where none is pinned yet; ``epoch`` that of the
        current key, 0 for none. Raises Garbled, OtherKey, PolicyRefused (epoch) or NotAuthentic (102, tagN).
        """
        if len(reply) < REPLY_HEAD_OCTETS:
            raise Garbled(f"The reply to Request has {len(reply)} octets; {REPLY_HEAD_OCTETS} and a TEDS are due.")
        nonce, offered, tag, teds = reply[:16], int.from_bytes(reply[16:20], "big"), reply[20:36], reply[36:]
        shown = security.decode(teds)
        node = shown.node_key
        if pinned is not None and not same_key(pinned, fingerprint(node)):
            raise other_key(pinned, node)
        if node in (self._credentials.key.point, self._one_time.point) or not is_point(node):
            raise NotAuthentic("The node's public key is not a valid point, or is this station's own.")
        if not node_key_good(self._uuid, node, shown.node_key_signature):
            raise NotAuthentic("The node's key is not signed for this UUID (field 102): it belongs to another node.")
        if offered <= epoch:
            raise PolicyRefused(
                f"The node offers key epoch {offered}; this station already holds epoch {epoch}.",
                hint="The node may be a copy or was restored; take it to the bench and reset it by hand.",
            )
        script = transcript(self._payload, nonce, offered, self._uuid, node, teds)
        shared = self._one_time.ecdh(node) + self._credentials.key.ecdh(node)
        derived = derive(shared, nonce, script)
        if not hmac.compare_digest(derived.node_tag, tag):
            raise NotAuthentic("The node's confirmation tag is wrong: it does not hold the key that it shows.")
        confirm = security_command(Function.CONFIRM, derived.station_tag)
        return AgreedKey(derived.key, offered, node, confirm, unsigned=not shown.signed)


def other_key(pinned: str, node: bytes) -> OtherKey:
    """The error for a known UUID that comes with another key."""
    return OtherKey(
        f"This UUID is known with key {pinned[:16]}, the node shows {fingerprint(node)[:16]}.",
        hint="It may be a clone. If the board was replaced on purpose: whitelist remove UUID, then whitelist it anew.",
    )


@dataclass(frozen=True)
class NodeAgreement:
    """The node's half between Request and Confirm; lies in RAM only."""

    reply: bytes = field(repr=False)
    key: bytes = field(repr=False)
    station_tag: bytes = field(repr=False)
    epoch: int
    station: bytes
    ca: bytes

    @classmethod
    def answer(
        cls, node: PrivateKey, uuid: bytes, payload: bytes, *, epoch: int, teds: bytes, nonce: bytes | None = None
    ) -> NodeAgreement:
        """Answer a Request whose points and signature were checked; ``epoch`` is the stored epoch + 1."""
        request = RequestPayload.decode(payload)
        nonce = os.urandom(16) if nonce is None else nonce
        script = transcript(payload, nonce, epoch, uuid, node.point, teds)
        derived = derive(node.ecdh(request.one_time) + node.ecdh(request.station), nonce, script)
        reply = nonce + epoch.to_bytes(4, "big") + derived.node_tag + teds
        return cls(reply, derived.key, derived.station_tag, epoch, request.station, request.ca)


def good_point(point: bytes, own: bytes) -> bool:
    """Strict decoding of a point: on the curve, not infinity, not one's own."""
    return point != own and is_point(point)
