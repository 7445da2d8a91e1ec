"""P-256 keys: points, fingerprints, the profile's signatures and ECDH (profile.md, "Notation"; SEC 1).

A private key is anything that can sign and agree: a key in software, in the OS keyring or in a token. Everything above
uses :class:`PrivateKey` alone.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Protocol

from teds_provision.errors import BadDataError, KeyMismatchError
from teds_provision.protocol.primitives import ec, exceptions, hashes, serialization, utils

POINT_OCTETS = 65
SIGNATURE_OCTETS = 64
CHALLENGE_OCTETS = 32
# Order of the group P-256, SP 800-186 table 1.
GROUP_ORDER = 0xFFFFFFFF00000000FFFFFFFFFFFFFFFFBCE6FAADA7179E84F3B9CAC2FC632551
# Field and coefficient b of y² = x³ - 3x + b, from the same table.
_FIELD = 0xFFFFFFFF00000001000000000000000000000000FFFFFFFFFFFFFFFFFFFFFFFF
_CURVE_B = 0x5AC635D8AA3A93E7B3EBBD55769886BC651D06B0CC53B0F63BCE3C3E27D2604B
_ZERO, _ORDER, _HALF = (number.to_bytes(32, "big") for number in (0, GROUP_ORDER, GROUP_ORDER // 2))


class PrivateKey(Protocol):
    """A P-256 private key, in software or in a token."""

    @property
    def point(self) -> bytes:
        """P(x): the uncompressed SEC 1 point of the public key, 65 octets."""

    def sign(self, message: bytes) -> bytes:
        """Return SIG(key, message): ECDSA with SHA-256, r ‖ s, 64 octets, s in the lower half of the group order."""

    def sign_digest(self, digest: bytes) -> bytes:
        """Return the same signature, of a message whose SHA-256 the caller made piece by piece."""

    def ecdh(self, peer: bytes) -> bytes:
        """Return the x-coordinate (32 octets) of the ECC CDH with the 65-octet point ``peer``."""


@dataclass(frozen=True)
class Credentials:
    """A station's credentials: its key, and its owner's CA's signature over it (SIG104, 64 octets) with P(CA)."""

    key: PrivateKey
    station_signature: bytes
    ca: bytes


class SoftwareKey:
    """A P-256 private key in this process's memory; signs deterministically (RFC 6979)."""

    def __init__(self, secret: int | ec.EllipticCurvePrivateKey) -> None:
        self._key = ec.derive_private_key(secret, ec.SECP256R1()) if isinstance(secret, int) else secret
        self.point: bytes = _uncompressed(self._key.public_key())

    @classmethod
    def generate(cls) -> SoftwareKey:
        """Make a new random key."""
        return cls(ec.generate_private_key(ec.SECP256R1()))

    @classmethod
    def from_secret(cls, octets: bytes) -> SoftwareKey:
        """Make the key of a 32-octet scalar as :meth:`secret` gives it; raises BadDataError."""
        value = int.from_bytes(octets, "big")
        if len(octets) != 32 or not 0 < value < GROUP_ORDER:
            raise BadDataError("A P-256 private key is 32 octets between 1 and the group order.")
        return cls(value)

    def secret(self) -> bytes:
        """Return the scalar, 32 octets. The caller must seal it."""
        return self._key.private_numbers().private_value.to_bytes(32, "big")

    def sign(self, message: bytes) -> bytes:
        """Return SIG(key, message), see :class:`PrivateKey`."""
        der = self._key.sign(message, ec.ECDSA(hashes.SHA256(), deterministic_signing=True))
        return raw_signature(der)

    def sign_digest(self, digest: bytes) -> bytes:
        """Return SIG(key, message) of the message's SHA-256, see :class:`PrivateKey`."""
        der = self._key.sign(digest, ec.ECDSA(utils.Prehashed(hashes.SHA256()), deterministic_signing=True))
        return raw_signature(der)

    def ecdh(self, peer: bytes) -> bytes:
        """Return the x-coordinate of the ECDH, see :class:`PrivateKey`."""
        return self._key.exchange(ec.ECDH(), public_key(peer))

    def __repr__(self) -> str:
        return f"SoftwareKey({fingerprint(self.point)[:16]})"


def raw_signature(der: bytes) -> bytes:
    """Turn a DER ECDSA signature into r ‖ s with s in the lower half, 64 octets."""
    r, s = utils.decode_dss_signature(der)
    return r.to_bytes(32, "big") + min(s, GROUP_ORDER - s).to_bytes(32, "big")


def normalise_signature(raw: bytes) -> bytes:
    """Bring s of an r ‖ s signature into the lower half of the group order (tokens use their own k)."""
    s = int.from_bytes(raw[32:], "big")
    return raw[:32] + min(s, GROUP_ORDER - s).to_bytes(32, "big")


@lru_cache(maxsize=256)  # stations, CAs and the present node recur, and a check takes 25 µs
def public_key(point: bytes) -> ec.EllipticCurvePublicKey:
    """Read a 65-octet point strictly: uncompressed, on the curve, not infinity. Raises BadDataError."""
    return _load_key(point)


def _load_key(point: bytes) -> ec.EllipticCurvePublicKey:
    if len(point) != POINT_OCTETS or point[0] != 0x04:
        raise BadDataError("A public key is an uncompressed P-256 point of 65 octets that starts with 04.")
    try:
        return ec.EllipticCurvePublicKey.from_encoded_point(ec.SECP256R1(), point)
    except ValueError as error:
        raise BadDataError("A public key is not a point of the curve P-256.") from error


@lru_cache(maxsize=256)  # those of stations and CAs recur
def is_point(point: bytes) -> bool:
    """Return True if 65 octets are a valid uncompressed P-256 point (SP 800-186 section 3.2.1.3), without loading it.

    To load it as a key takes four times as long.
    """
    x, y = int.from_bytes(point[1:33], "big"), int.from_bytes(point[33:], "big")
    return (
        len(point) == POINT_OCTETS
        and point[0] == 0x04
        and x < _FIELD
        and y < _FIELD
        and (y * y - (x * x - 3) * x - _CURVE_B) % _FIELD == 0
    )


@cache
def _of_digest() -> ec.ECDSA:
    return ec.ECDSA(utils.Prehashed(hashes.SHA256()))


Verify = Callable[[bytes, bytes, bytes], bool]
"""Returns True if a signature (64 octets) is SIG(point, message); :func:`verify`, or a chip that does it."""


def verify(point: bytes, message: bytes, signature: bytes) -> bool:
    """Return True if ``signature`` (64 octets) is SIG(point, message); a high s is refused."""
    return _holds(public_key, point, message, signature)


def verify_once(point: bytes, message: bytes, signature: bytes) -> bool:
    """Return :func:`verify` of a key that is not asked for again: it is loaded and freed 4 µs sooner than kept."""
    return _holds(_load_key, point, message, signature)


def verify_each_once(point: bytes, signed: Sequence[tuple[bytes, bytes]]) -> list[bool]:
    """Return :func:`verify_once` of several messages, each with its signature, under one key: it is loaded once."""
    try:
        key = _load_key(point)
    except BadDataError:
        return [False] * len(signed)
    return [_has_signed(key, message, signature) for message, signature in signed]


def _holds(load: Callable[[bytes], ec.EllipticCurvePublicKey], point: bytes, message: bytes, signature: bytes) -> bool:
    try:
        key = load(point)
    except BadDataError:
        return False
    return _has_signed(key, message, signature)


def _has_signed(key: ec.EllipticCurvePublicKey, message: bytes, signature: bytes) -> bool:
    der = _to_der(signature)
    if der is None:
        return False
    try:
        key.verify(der, hashlib.sha256(message).digest(), _of_digest())
    except exceptions.InvalidSignature:
        return False
    return True


def _to_der(signature: bytes) -> bytes | None:
    """Return r ‖ s in DER; None if it is not 64 octets long, or r or s is out of its range (a high s too).

    Numbers of one length compare as octets do. Most r and s have no leading zeros, and are put together here: the
    library takes 0.6 µs longer for them.
    """
    r, s = signature[:32], signature[32:]
    if len(signature) != SIGNATURE_OCTETS or not _ZERO < r < _ORDER or not _ZERO < s <= _HALF:
        return None
    if s[0]:  # below 0x80, as s is in the lower half
        if r[0] > 0x7F:
            return b"\x30\x45\x02\x21\0" + r + b"\x02\x20" + s
        if r[0]:
            return b"\x30\x44\x02\x20" + r + b"\x02\x20" + s
    return utils.encode_dss_signature(int.from_bytes(r, "big"), int.from_bytes(s, "big"))


def verify_der(point: bytes, message: bytes, signature: bytes) -> bool:
    """Return True if ``signature`` (DER, as others than nodes write it) is that of ``point`` over ``message``."""
    try:
        public_key(point).verify(signature, hashlib.sha256(message).digest(), _of_digest())
    except (exceptions.InvalidSignature, BadDataError):
        return False
    return True


def fingerprint(point: bytes) -> str:
    """Return SHA-256(P(x)), 64 hex digits; people see the first 16."""
    return hashlib.sha256(point).hexdigest()


def other_key(pinned: str, node: bytes) -> KeyMismatchError:
    """Return the error for a known UUID that comes with another key."""
    return KeyMismatchError(
        f"This UUID is known with key {pinned[:16]}, the node shows {fingerprint(node)[:16]}.",
        hint="It may be a clone. If the board was replaced on purpose: whitelist remove UUID, then whitelist add UUID.",
    )


def to_pem(point: bytes) -> str:
    """Return a point as SubjectPublicKeyInfo in PEM."""
    form = serialization.PublicFormat.SubjectPublicKeyInfo
    return public_key(point).public_bytes(serialization.Encoding.PEM, form).decode()


def from_pem(text: bytes) -> bytes:
    """Return the point (65 octets) of a P-256 public key in PEM; raises BadDataError, which names private keys."""
    if b"PRIVATE KEY" in text:
        raise BadDataError("This file holds a private key where a public one belongs.")
    try:
        key = serialization.load_pem_public_key(text)
    except exceptions.UnsupportedAlgorithm as error:
        raise BadDataError(
            "This is no P-256 key: its kind is not known here; stations and CAs have P-256 keys."
        ) from error
    except ValueError as error:
        raise BadDataError("This file holds no public key in PEM form.") from error
    if not isinstance(key, ec.EllipticCurvePublicKey) or not isinstance(key.curve, ec.SECP256R1):
        raise BadDataError("This is not a P-256 key; stations and CAs have P-256 keys.")
    return _uncompressed(key)


def _uncompressed(key: ec.EllipticCurvePublicKey) -> bytes:
    return key.public_bytes(serialization.Encoding.X962, serialization.PublicFormat.UncompressedPoint)


# Messages of the profile that begin with a label. Labels of signatures end in 00.


@lru_cache(maxsize=256)
def node_key_good(uuid: bytes, node: bytes, signature: bytes) -> bool:
    """Return True if SIG102 (64 octets) is a node's over its own key for this UUID; False if ``node`` is no point.

    Cached: each step of a provisioning needs it for the same octets, and it never changes.
    """
    return verify(node, node_key_message(uuid, node), signature)


def node_key_good_once(uuid: bytes, node: bytes, signature: bytes) -> bool:
    """Return :func:`node_key_good` of a node among many, without the cache."""
    return verify_once(node, node_key_message(uuid, node), signature)


def node_key_message(uuid: bytes, node: bytes) -> bytes:
    """Return the message that field 102 signs."""
    return b"TEDS1 node key\0" + uuid + node


def station_key_message(station: bytes) -> bytes:
    """Return the message that field 104 (SIG104) signs."""
    return b"TEDS1 station key\0" + station


def agreement_message(script: bytes) -> bytes:
    """Return the message that sigN of the reply to Request signs; ``script`` is T, 32 octets."""
    return b"TEDS1 agree\0" + script


def prove_message(uuid: bytes, challenge: bytes) -> bytes:
    """Return the message that the reply to Prove signs."""
    return b"TEDS1 prove\0" + uuid + challenge


def reset_message(uuid: bytes, epoch: int, challenge: bytes) -> bytes:
    """Return the message that the reply to Reset signs."""
    return b"TEDS1 reset\0" + uuid + epoch.to_bytes(4, "big") + challenge
