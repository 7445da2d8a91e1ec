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
    ) -> bytes:
        """Return a whole image."""
        protected = b""
        if counter is not None:
            protected += struct.pack("<HHI", _COUNTER, 4, counter)
        if text:
            protected += struct.pack("<HH", _TEXT, len(text)) + text.encode()
        if protected:
            protected = struct.pack("<HH", _PROTECTED, len(protected) + 4) + protected
        head = struct.pack("<IIHHII", _MAGIC, 0, HEADER, len(protected), len(payload), 0)
        head += struct.pack("<BBHII", *version, 0)
        body = head.ljust(HEADER, b"\0") + payload + protected
        digest = hashlib.sha256(body).digest()
        tlvs = struct.pack("<HH", _SHA256, 32) + digest
        tlvs += struct.pack("<HH", _KEY_HASH, 32) + hashlib.sha256(self.public).digest()
        if signed:
            signature = self.key.sign(body, ec.ECDSA(hashes.SHA256()))
            tlvs += struct.pack("<HH", _ECDSA, len(signature)) + signature
        return body + struct.pack("<HH", _TLVS, len(tlvs) + 4) + tlvs


def digest_of(image: bytes) -> bytes:
    """Return an image's SHA256 TLV."""
    header, protected, octets = struct.unpack_from("<HHI", image, 8)
    at = header + octets + protected + 4
    assert struct.unpack_from("<HH", image, at) == (_SHA256, 32)
    return image[at + 4 : at + 36]
