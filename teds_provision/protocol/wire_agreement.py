"""Key agreement 2: Request, Confirm, and the link key they give (profile.md, "Key agreement").

ECC CDH of NIST SP 800-56A rev. 3 over two one-time keys and the station's static one, with bilateral key confirmation;
the node's identity key signs the transcript, as in SIGMA, and agrees on nothing. HKDF of RFC 5869. Pure: no I/O, both
roles. Python cannot wipe memory reliably; Z, OKM and the one-time keys live in local names only, or go with the object
that made them.
"""

from __future__ import annotations

import hashlib
import hmac
import os
from dataclasses import dataclass, field

from teds_provision.errors import BadDataError, GarbledError, NotAuthenticError, PolicyError
from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.keys import (
    POINT_OCTETS,
    SIGNATURE_OCTETS,
    Credentials,
    PrivateKey,
    SoftwareKey,
    agreement_message,
    fingerprint,
    is_point,
    node_key_good,
    other_key,
    verify,
)
from teds_provision.protocol.messages.frames import Command, Function, security_command
from teds_provision.protocol.primitives import hashes, hkdf
from teds_provision.teds.codec import security
from teds_provision.teds.codec.security import SecurityTeds

NONCE_OCTETS = 16
TAG_OCTETS = 16
REQUEST_OCTETS = POINT_OCTETS + SIGNATURE_OCTETS + POINT_OCTETS + POINT_OCTETS
REPLY_OCTETS = NONCE_OCTETS + 4 + POINT_OCTETS + TAG_OCTETS + SIGNATURE_OCTETS
LAST_EPOCH = 0xFFFFFFFF


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


def transcript(
    request: bytes, nonce: bytes, epoch: int, one_time: bytes, uuid: bytes, node: bytes, teds: bytes
) -> bytes:
    """Return T: SHA-256 over label, request payload, nonceN, epoch, En, UUID, P(node) and the hash of the TEDS.

    ``one_time`` is En, 65 octets; ``teds`` the node's Security TEDS as it is when Request is run, Length to Checksum.
    """
    digest = hashlib.sha256(teds).digest()
    return hashlib.sha256(
        b"TEDS1 transcript\0" + request + nonce + epoch.to_bytes(4, "big") + one_time + uuid + node + digest
    ).digest()


def derive(shared: bytes, nonce: bytes, script: bytes) -> LinkKey:
    """Link key and tags from Z = ECDH(E, En) ‖ ECDH(station, En) (64 octets), nonceN and T."""
    okm = hkdf.HKDF(hashes.SHA256(), 48, nonce, b"TEDS1 link key\0" + script).derive(shared)
    key, confirmation = okm[:16], okm[16:]
    return LinkKey(
        key,
        hmac.digest(confirmation, b"node" + script, "sha256")[:TAG_OCTETS],
        hmac.digest(confirmation, b"station" + script, "sha256")[:TAG_OCTETS],
    )


@dataclass(frozen=True)
class AgreedKey:
    """The station's result of a good Request: the key to store as pending, and the Confirm to send then.

    ``unsigned``: the node shows its initial Security TEDS: authentic, since sigN covers the transcript.
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


class TranscriptMismatchError(NotAuthenticError):
    """A wrong tagN: the node's Security TEDS changed meanwhile, or the reply was disturbed. No proof of misbehavior."""


def fit_to_agree(teds: bytes, uuid: bytes, pinned: str | None) -> SecurityTeds:
    """Check a node's Security TEDS before a Request: canonical, this profile's values, its own key.

    ``pinned`` is the fingerprint that the whitelist holds, None if this contact pins. Raises NotCanonicalError,
    BadDataError (another ProfileVersion, SessionSuite or KeyAgreement, by name), KeyMismatchError, NotAuthenticError
    (field 102).
    """
    shown = security.decode(teds)
    if other := security.other_wire(shown):
        raise BadDataError(f"This node speaks {other}.", hint="It needs firmware of this version of the profile.")
    node = shown.node_key
    if pinned is not None and not same_key(pinned, fingerprint(node)):
        raise other_key(pinned, node)
    if not node_key_good(uuid, node, shown.node_key_signature):
        raise NotAuthenticError("The node's key is not signed for this UUID (field 102): it belongs to another node.")
    return shown


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

    def accept(self, reply: bytes, teds: bytes, *, pinned: str | None, epoch: int) -> AgreedKey:
        """Check the reply's payload and derive the key; checked in this order: length, En, tagN, sigN, epoch.

        ``teds`` is the node's Security TEDS, read before on this link (in a session: in it); ``pinned`` as in
        :func:`fit_to_agree`; ``epoch`` that of the current key, 0 for none. Raises what :func:`fit_to_agree` raises,
        Garbled (length), NotAuthenticError (En, sigN), TranscriptMismatchError (tagN), PolicyError (epoch).
        """
        shown = fit_to_agree(teds, self._uuid, pinned)
        node, station = shown.node_key, self._credentials.key
        if node in (station.point, self._one_time.point):
            raise NotAuthenticError("The key that the node shows is this station's own.")
        if len(reply) != REPLY_OCTETS:
            raise GarbledError(f"The reply to Request has {len(reply)} octets, not {REPLY_OCTETS}.")
        nonce, reply = reply[:NONCE_OCTETS], reply[NONCE_OCTETS:]
        offered, one_time = int.from_bytes(reply[:4], "big"), reply[4 : 4 + POINT_OCTETS]
        tag, signature = reply[4 + POINT_OCTETS : -SIGNATURE_OCTETS], reply[-SIGNATURE_OCTETS:]
        if not good_one_time(one_time, self._one_time.point, station.point, node):
            raise NotAuthenticError(
                "The node's one-time key in its reply to Request is not a valid point, or is no one-time key."
            )
        script = transcript(self._payload, nonce, offered, one_time, self._uuid, node, teds)
        derived = derive(self._one_time.ecdh(one_time) + station.ecdh(one_time), nonce, script)
        if not hmac.compare_digest(derived.node_tag, tag):
            raise TranscriptMismatchError(
                "The node's confirmation tag (tagN) is wrong: it made it over another Request or Security TEDS.",
                hint="A disturbed link does this, or a node with another owner's hand on it: try again at the reader.",
            )
        if not verify(node, agreement_message(script), signature):
            raise NotAuthenticError(
                "The node's signature on the agreement (sigN) is wrong: it does not hold the key that it shows.",
                hint="This may be a copied tag, or another device answers in its place. Do not use it.",
            )
        if offered <= epoch:
            raise PolicyError(
                f"The node offers key epoch {offered}; this station already holds epoch {epoch}.",
                hint="The node may be a copy or was restored; take it to the bench and reset it by hand.",
            )
        confirm = security_command(Function.CONFIRM, derived.station_tag)
        return AgreedKey(derived.key, offered, node, confirm, unsigned=not shown.signed)


@dataclass(frozen=True)
class NodeAgreement:
    """The node's half between Request and Confirm; kept in RAM only."""

    reply: bytes = field(repr=False)
    key: bytes = field(repr=False)
    station_tag: bytes = field(repr=False)
    epoch: int
    station: bytes
    ca: bytes

    @classmethod
    def answer(
        cls,
        node: PrivateKey,
        uuid: bytes,
        payload: bytes,
        *,
        epoch: int,
        teds: bytes,
        nonce: bytes | None = None,
        one_time: PrivateKey | None = None,
    ) -> NodeAgreement:
        """Answer a Request whose points and signature were checked; ``epoch`` is the stored epoch + 1.

        ``node``, the identity key, signs and does nothing else; ``one_time`` is the key of En, for this Request alone.
        """
        request = RequestPayload.decode(payload)
        nonce = os.urandom(NONCE_OCTETS) if nonce is None else nonce
        one_time = SoftwareKey.generate() if one_time is None else one_time
        script = transcript(payload, nonce, epoch, one_time.point, uuid, node.point, teds)
        derived = derive(one_time.ecdh(request.one_time) + one_time.ecdh(request.station), nonce, script)
        proof = node.sign(agreement_message(script))
        reply = nonce + epoch.to_bytes(4, "big") + one_time.point + derived.node_tag + proof
        return cls(reply, derived.key, derived.station_tag, epoch, request.station, request.ca)


def good_point(point: bytes, own: bytes) -> bool:
    """Return True if a point decodes strictly: on the curve, not infinity, not one's own."""
    return point != own and is_point(point)


def good_one_time(point: bytes, *others: bytes) -> bool:
    """Return True if ``point`` may be the other side's one-time key.

    It must be a point, none of one's own, nor a known static one.
    """
    return point not in others and is_point(point)
