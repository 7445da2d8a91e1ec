"""Sessions, sealed commands and data messages by pyca/cryptography alone (profile.md, "Sessions"; operation.md)."""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import decode_dss_signature
from cryptography.hazmat.primitives.ciphers.aead import AESCCM
from cryptography.hazmat.primitives.kdf.hkdf import HKDF, HKDFExpand
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

CURVE = ec.SECP256R1()
ORDER = 0xFFFFFFFF00000000FFFFFFFFFFFFFFFFBCE6FAADA7179E84F3B9CAC2FC632551


def point(key: ec.EllipticCurvePrivateKey) -> bytes:
    """P(x)."""
    return key.public_key().public_bytes(Encoding.X962, PublicFormat.UncompressedPoint)


def mac(key: bytes, *parts: bytes) -> bytes:
    """Return the first 16 octets."""
    return hmac.new(key, b"".join(parts), hashlib.sha256).digest()[:16]


def key_id(key: bytes) -> bytes:
    """Of a link key."""
    return hashlib.sha256(b"TEDS1 key id\0" + key).digest()[:8]


@dataclass
class Keys:
    """What Open gives."""

    down: bytes
    up: bytes
    confirm: bytes
    streams: bytes

    @classmethod
    def of(
        cls, link_key: bytes, uuid: bytes, own: ec.EllipticCurvePrivateKey, theirs: bytes, es: bytes, en: bytes
    ) -> Keys:
        z = own.exchange(ec.ECDH(), ec.EllipticCurvePublicKey.from_encoded_point(CURVE, theirs))
        info = b"TEDS1 session\0" + uuid + es + en
        okm = HKDF(hashes.SHA256(), 96, link_key, info).derive(z)
        return cls(okm[:16], okm[16:32], okm[32:64], okm[64:])

    def tag(self, link_key: bytes, es: bytes, en: bytes) -> bytes:
        return mac(self.confirm, b"node open", key_id(link_key), es, en)

    def run(self, run: int, drive: bool = False) -> bytes:
        """The key of a stream's run."""
        info = (b"TEDS1 drive\0" if drive else b"TEDS1 stream\0") + run.to_bytes(2, "big")
        return HKDFExpand(hashes.SHA256(), 16, info).derive(self.streams)


def nonce(counter: int) -> bytes:
    return bytes(9) + counter.to_bytes(4, "big")


def seal(key: bytes, counter: int, inner: bytes) -> bytes:
    """Return a sealed command or reply, padded as PKCS #7."""
    pad = 16 - len(inner) % 16
    return counter.to_bytes(4, "big") + AESCCM(key, 16).encrypt(nonce(counter), inner + bytes([pad]) * pad, None)


def unseal(key: bytes, sealed: bytes) -> tuple[int, bytes]:
    """Counter and inner; raises InvalidTag or ValueError."""
    counter = int.from_bytes(sealed[:4], "big")
    whole = AESCCM(key, 16).decrypt(nonce(counter), sealed[4:], None)
    pad = whole[-1]
    if not 1 <= pad <= 16 or whole[-pad:] != bytes([pad]) * pad:
        raise ValueError("padding")
    return counter, whole[:-pad]


def message(key: bytes, counter: int, plain: bytes) -> bytes:
    """Return a data or Drive message."""
    return counter.to_bytes(4, "big") + AESCCM(key, 8).encrypt(nonce(counter), plain, None)


def opened(key: bytes, octets: bytes) -> tuple[int, bytes]:
    """Counter and plaintext of a message; raises InvalidTag."""
    counter = int.from_bytes(octets[:4], "big")
    return counter, AESCCM(key, 8).decrypt(nonce(counter), octets[4:], None)


def signature(key: ec.EllipticCurvePrivateKey, words: bytes) -> bytes:
    """SIG: r, s, the lower half."""
    r, s = decode_dss_signature(key.sign(words, ec.ECDSA(hashes.SHA256())))
    return r.to_bytes(32, "big") + min(s, ORDER - s).to_bytes(32, "big")
