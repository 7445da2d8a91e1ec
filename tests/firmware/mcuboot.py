"""Images as ``imgtool sign`` makes them for MCUboot: header, payload, protected TLVs, TLVs; signed by ECDSA P-256."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, field
from typing import Final

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

HEADER: Final = 0x200
_MAGIC: Final = 0x96F3B83D
_TLVS, _PROTECTED = 0x6907, 0x6908
_KEY_HASH, _SHA256, _ECDSA, _COUNTER, _TEXT = 0x01, 0x10, 0x22, 0x50, 0x54A0


@dataclass(frozen=True)
class Owner:
    """Who signs images."""

    key: ec.EllipticCurvePrivateKey = field(default_factory=lambda: ec.generate_private_key(ec.SECP256R1()))

    @property
    def public(self) -> bytes:
        """Return the public key as the boot loader has it: 91 octets, as ``imgtool getpub -e raw`` writes them."""
        return self.key.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)

    def image(
        self,
        version: tuple[int, int, int, int] = (1, 0, 0, 0),
        *,
        payload: bytes = b"payload",
        counter: int | None = None,
        text: str = "",
        signed: bool = True,
        flags: int = 0,
        header: int = HEADER,
        octets: int | None = None,
        protected: bytes = b"",
        beside: bytes = b"",
        named: bytes | None = None,
    ) -> bytes:
        """Return a whole image.

        ``header``, ``octets``: what its head states, where that is not so. ``protected``, ``beside``: more TLVs in and
        behind the protected part. ``named``: the hash of the key that it names.
        """
        if counter is not None:
            protected += struct.pack("<HHI", _COUNTER, 4, counter)
        if text:
            protected += struct.pack("<HH", _TEXT, len(text)) + text.encode()
        if protected:
            protected = struct.pack("<HH", _PROTECTED, len(protected) + 4) + protected
        stated = len(payload) if octets is None else octets
        head = struct.pack("<IIHHII", _MAGIC, 0, header, len(protected), stated, flags)
        head += struct.pack("<BBHII", *version, 0)
        body = head.ljust(HEADER, b"\0") + payload + protected
        return self.image_of(body, signed=signed, beside=beside, named=named)

    def image_of(self, body: bytes, *, signed: bool = True, beside: bytes = b"", named: bytes | None = None) -> bytes:
        """Return an image of these octets before its TLVs."""
        digest = hashlib.sha256(body).digest()
        tlvs = struct.pack("<HH", _SHA256, 32) + digest
        if named != b"":
            tlvs += tlv(_KEY_HASH, hashlib.sha256(self.public).digest() if named is None else named)
        if signed:
            signature = self.key.sign(body, ec.ECDSA(hashes.SHA256()))
            tlvs += struct.pack("<HH", _ECDSA, len(signature)) + signature
        tlvs += beside
        return body + struct.pack("<HH", _TLVS, len(tlvs) + 4) + tlvs


def tlv(kind: int, value: bytes) -> bytes:
    """Return one TLV."""
    return struct.pack("<HH", kind, len(value)) + value


def digest_of(image: bytes) -> bytes:
    """Return an image's SHA256 TLV."""
    header, protected, octets = struct.unpack_from("<HHI", image, 8)
    at = header + octets + protected + 4
    assert struct.unpack_from("<HH", image, at) == (_SHA256, 32)
    return image[at + 4 : at + 36]
