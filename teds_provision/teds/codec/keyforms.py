"""Keys and signatures in foreign Security TEDS: PEM, hex, base64, DER or raw, recognised without cryptography.

Only the wrapping is removed; neither points nor signatures are verified.
"""

from __future__ import annotations

import base64
import binascii
from dataclasses import dataclass
from typing import Final, Literal

Form = Literal["pem", "hex", "base64", "der", "raw"]

POINT_OCTETS: Final = 65
# SubjectPublicKeyInfo of a P-256 key up to its point (RFC 5480).
_SPKI_P256: Final = bytes.fromhex("3059301306072a8648ce3d020106082a8648ce3d030107034200")
_HEX_DIGITS: Final = frozenset(b"0123456789abcdefABCDEF")


@dataclass(frozen=True)
class ParsedKey:
    """A key or signature without its wrapping: the ``form`` it came in, its ``octets``, its P-256 ``point`` if any.

    ``point`` is the SEC 1 uncompressed point, 65 octets.
    """

    form: Form
    octets: bytes
    point: bytes | None = None


def read_key(value: bytes | str) -> ParsedKey:
    """Unwrap the value of a field 100 to 104; never raises: what is nothing else is raw."""
    octets = value.encode() if isinstance(value, str) else bytes(value)
    stripped = octets.strip()
    form, inner = _unwrap(octets, stripped)
    return ParsedKey(form, inner, _point(inner))


def _unwrap(octets: bytes, stripped: bytes) -> tuple[Form, bytes]:
    if stripped.startswith(b"-----BEGIN"):
        inner = _base64(
            b"".join(line.strip() for line in stripped.splitlines() if b"-----" not in line and b":" not in line)
        )
        return ("pem", inner) if inner is not None else ("raw", octets)
    if stripped and len(stripped) % 2 == 0 and _HEX_DIGITS.issuperset(stripped):
        return "hex", bytes.fromhex(stripped.decode("ascii"))
    text = _base64(stripped) if len(stripped) >= 8 else None
    if text is not None:
        return "base64", text
    return ("der", octets) if _is_der(octets) else ("raw", octets)


def _base64(text: bytes) -> bytes | None:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        return None


def _is_der(octets: bytes) -> bool:
    """Return True for one SEQUENCE whose length is exactly that of the rest."""
    if len(octets) < 2 or octets[0] != 0x30:
        return False
    if octets[1] < 0x80:
        return octets[1] == len(octets) - 2
    count = octets[1] & 0x7F
    return 1 <= count <= 4 and int.from_bytes(octets[2 : 2 + count], "big") == len(octets) - 2 - count


def _point(octets: bytes) -> bytes | None:
    if len(octets) == POINT_OCTETS and octets[0] == 4:
        return octets
    if len(octets) == len(_SPKI_P256) + POINT_OCTETS and octets.startswith(_SPKI_P256):
        return octets[len(_SPKI_P256) :]
    return None
