"""Keys as JSON Web Keys: public P-256 points and link keys (RFC 7517, RFC 7518 sections 6.2 and 6.4)."""

from __future__ import annotations

from teds_provision.errors import BadData
from teds_provision.protocol.handover.strict_json import decode_base64url, encode_base64url

# P-256, SP 800-186 section 3.2.1.3: y^2 = x^3 - 3x + b over the field of _P elements; the cofactor is 1.
_P = 0xFFFFFFFF00000001000000000000000000000000FFFFFFFFFFFFFFFFFFFFFFFF
_B = 0x5AC635D8AA3A93E7B3EBBD55769886BC651D06B0CC53B0F63BCE3C3E27D2604B
_COORDINATE_OCTETS = 32
_LINK_KEY_OCTETS = 16


def public_jwk(point: bytes) -> dict[str, str]:
    """Return the JWK of a 65-octet point."""
    return {
        "kty": "EC",
        "crv": "P-256",
        "x": encode_base64url(point[1:33]),
        "y": encode_base64url(point[33:65]),
    }


def point_of(jwk: object, what: str) -> bytes:
    """Return the point (65 octets) of a public P-256 JWK; members that do not matter (kid, use, alg) are passed over.

    Raises BadData that names ``what``: another key type or curve, a private key, wrong lengths, not on the curve.
    The test of the curve is plain arithmetic on public values, as ten thousand of them stand in a bundle.
    """
    if not isinstance(jwk, dict):
        raise BadData(f"{what} is not a JSON Web Key.")
    if "d" in jwk or jwk.get("kty") == "oct":
        raise BadData(f"{what} holds a private or secret key where a public one belongs.")
    if jwk.get("kty") != "EC" or jwk.get("crv") != "P-256":
        raise BadData(f"{what} is not a P-256 key; stations, CAs and nodes have P-256 keys.")
    x, y = decode_base64url(jwk.get("x"), what), decode_base64url(jwk.get("y"), what)
    if len(x) != _COORDINATE_OCTETS or len(y) != _COORDINATE_OCTETS:
        raise BadData(f"{what} has coordinates that are not {_COORDINATE_OCTETS} octets each.")
    if not _on_curve(int.from_bytes(x, "big"), int.from_bytes(y, "big")):
        raise BadData(f"{what} is not a point of the curve P-256.")
    return b"\x04" + x + y


def _on_curve(x: int, y: int) -> bool:
    return x < _P and y < _P and (y * y - (x * x - 3) % _P * x - _B) % _P == 0


def link_key_of(jwk: object, what: str) -> tuple[bytes, str]:
    """Return a link key (16 octets) and the ``kid`` that it claims, in lower case; raises BadData."""
    if not isinstance(jwk, dict) or jwk.get("kty") != "oct":
        raise BadData(f"{what} is not a symmetric JSON Web Key.")
    key = decode_base64url(jwk.get("k"), what)
    if len(key) != _LINK_KEY_OCTETS:
        raise BadData(f"{what} has {len(key)} octets, a link key has {_LINK_KEY_OCTETS}.")
    kid = jwk.get("kid")
    if not isinstance(kid, str):
        raise BadData(f"{what} has no kid.")
    return key, kid.lower()
