"""The two JOSE forms of a handover: compact JWS with ES256, and JWE (JSON) with ECDH-ES+A256KW and A256GCM.

RFC 7515, 7516 and 7518 sections 3.4, 4.6 and 5.3, on ``cryptography``, for keys that may be in a token: a
:class:`PrivateKey` signs and agrees, nothing here sees its scalar. Exactly these algorithms exist; a header cannot
select another one, compression, or anything "critical". Every octet string ends in a value or in
:class:`NotAuthenticError` (signature, tag), :class:`PolicyError` (algorithm, extension, recipient) or
:class:`BadDataError` (form, size). An error of a key in a token (``VaultError``) passes through.

The profile's rule that s must be low does not hold in JOSE: other signers give either s.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from typing import TYPE_CHECKING, Any

from teds_provision.errors import BadDataError, NotAuthenticError, PolicyError
from teds_provision.limits import check_size
from teds_provision.protocol.handover.strict_json import (
    Base64urlWriter,
    base64url,
    decode_base64url,
    dump,
    encode_base64url,
    load_object,
    refuse_many,
    separators,
    write_base64url,
)
from teds_provision.protocol.keys import SIGNATURE_OCTETS, PrivateKey, SoftwareKey, fingerprint, public_key
from teds_provision.protocol.primitives import (
    aead,
    algorithms,
    ciphers,
    concatkdf,
    ec,
    exceptions,
    hashes,
    keywrap,
    modes,
    utils,
)

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.ciphers import AEADDecryptionContext

SIGNATURE_ALGORITHM = "ES256"
KEY_ALGORITHM = "ECDH-ES+A256KW"
CONTENT_ALGORITHM = "A256GCM"
MAX_RECIPIENTS = 256

NO_COMPACT_JWS = "A compact JWS has three parts."
CHANGED_CONTENT = "The sealed content was changed: its tag does not fit."

_KEY_OCTETS = 32
_WRAPPED_OCTETS = _KEY_OCTETS + 8
_IV_OCTETS = 12
_TAG_OCTETS = 16
_MAX_HEADER_CHARACTERS = 8192
_MAX_PARTY_INFO_OCTETS = 256
# A JWE has about ten members per recipient. Parsing a flood of tiny values would need a hundred times its size.
MAX_SEPARATORS = 20 * MAX_RECIPIENTS

FindKey = Callable[[str], bytes | None]
"""Maps a ``kid`` to the 65-octet point of a trusted key, None if there is none."""


@dataclass(frozen=True)
class VerifiedJws:
    """Content under a good signature: ``kid`` and point of the signer, and the payload."""

    kid: str
    signer: bytes
    payload: bytes = field(repr=False)


@dataclass(frozen=True)
class JweHeader:
    """The clear part of a JWE, unauthenticated; ``recipients`` are the ``kid`` of each, "" for none."""

    algorithm: str
    encryption: str
    content_type: str
    recipients: tuple[str, ...]


def sign_compact(payload: bytes, key: PrivateKey, *, typ: str) -> bytes:
    """Return a compact JWS: ES256, ``kid`` the fingerprint of ``key``."""
    octets = BytesIO()
    octets.write(signed_header(key, typ))
    write_base64url(octets, memoryview(payload))
    octets.write(b"." + base64url(key.sign(octets.getvalue())))
    return octets.getvalue()


def signed_header(key: PrivateKey, typ: str) -> bytes:
    """Return what a compact JWS of ``key`` begins with: the header and its dot."""
    return base64url(dump({"alg": SIGNATURE_ALGORITHM, "kid": fingerprint(key.point), "typ": typ})) + b"."


def verify_compact(octets: bytes, find_key: FindKey, *, typ: str, max_octets: int) -> VerifiedJws:
    """Check a compact JWS of this ``typ`` whose ``kid`` is the fingerprint of a key that ``find_key`` trusts.

    The payload is decoded only under a good signature. Raises NotAuthenticError, PolicyError or BadDataError.
    """
    check_size(len(octets), max_octets, "the signed document")
    parts = octets.split(b".", 3)
    if len(parts) != 3:
        raise BadDataError(NO_COMPACT_JWS)
    message = memoryview(octets)[: len(octets) - len(parts[2]) - 1]
    kid, signer = check_signature(parts[0], parts[2], hashlib.sha256(message).digest(), find_key, typ)
    return VerifiedJws(kid, signer, decode_base64url(parts[1], "The payload"))


def check_signature(
    header_text: bytes, signature_text: bytes, digest: bytes, find_key: FindKey, typ: str
) -> tuple[str, bytes]:
    """Check the header and the signature of a compact JWS; ``digest`` is the SHA-256 of what is signed.

    Returns ``kid`` and point of the signer. Raises NotAuthenticError, PolicyError or BadDataError.
    """
    header = _header(header_text, "The JWS header")
    _only(header, "alg", (SIGNATURE_ALGORITHM,), "signature algorithm")
    _no_extensions(header)
    if str(header.get("typ", "")).lower().removeprefix("application/") != typ:
        raise BadDataError(f"This document says that it is {_shown(header.get('typ'))}, not {typ}.")
    kid = header.get("kid")
    if not isinstance(kid, str):
        raise BadDataError("The JWS header names no signer (kid).")
    signer = find_key(kid)
    if signer is None or fingerprint(signer) != kid:
        raise NotAuthenticError(
            f"The key {kid[:16]!r} that signed this is not trusted here.",
            hint="Compare the fingerprint with its owner by voice, then: teds-provision trust add NAME FILE.",
        )
    if not _es256_good(signer, digest, decode_base64url(signature_text, "The signature")):
        raise NotAuthenticError(f"The signature does not verify under the key {kid[:16]}: the content was changed.")
    return kid, signer


def _es256_good(point: bytes, digest: bytes, signature: bytes) -> bool:
    """Verify ES256 (RFC 7518 section 3.4): r ‖ s of 32 octets each; either s is accepted."""
    if len(signature) != SIGNATURE_OCTETS:
        return False
    der = utils.encode_dss_signature(int.from_bytes(signature[:32], "big"), int.from_bytes(signature[32:], "big"))
    try:
        public_key(point).verify(der, digest, ec.ECDSA(utils.Prehashed(hashes.SHA256())))
    except exceptions.InvalidSignature:
        return False
    return True


class JweWriter:
    """A JWE in the General JSON serialization, written a piece at a time: ``begin``, ``more`` of the payload, ``end``.

    Algorithms and ``cty`` are in the protected header, ``kid`` (the fingerprint) and ``epk`` with each recipient. The
    tag comes last: without :meth:`end` the result cannot be opened. Raises BadDataError for a bad point.
    """

    def __init__(self, recipients: Sequence[bytes], *, cty: str) -> None:
        if not 1 <= len(recipients) <= MAX_RECIPIENTS:
            raise BadDataError(f"A JWE here has 1 to {MAX_RECIPIENTS} recipients, not {len(recipients)}.")
        protected = encode_base64url(dump({"alg": KEY_ALGORITHM, "cty": cty, "enc": CONTENT_ALGORITHM}))
        content_key, iv = os.urandom(_KEY_OCTETS), os.urandom(_IV_OCTETS)
        entries = [_recipient_entry(point, content_key) for point in recipients]
        self._head = dump({"protected": protected, "recipients": entries, "iv": encode_base64url(iv)})
        self._cipher = ciphers.Cipher(algorithms.AES(content_key), modes.GCM(iv)).encryptor()
        self._cipher.authenticate_additional_data(protected.encode())
        self._text = Base64urlWriter()

    def begin(self) -> bytes:
        """Return the octets before the ciphertext."""
        return self._head[:-1] + b',"ciphertext":"'  # base64url needs no escapes

    def more(self, payload: bytes | memoryview) -> bytes:
        """Return the next characters of the ciphertext."""
        return self._text.more(self._cipher.update(payload))

    def end(self) -> bytes:
        """Return the last characters of the ciphertext, and the tag."""
        last = self._text.more(self._cipher.finalize()) + self._text.end()
        return last + b'","tag":"' + base64url(self._cipher.tag) + b'"}'


def encrypt(payload: bytes, recipients: Sequence[bytes], *, cty: str) -> bytes:
    """Return a whole JWE for the points ``recipients``, see :class:`JweWriter`."""
    jwe = JweWriter(recipients, cty=cty)
    return jwe.begin() + jwe.more(payload) + jwe.end()


def _recipient_entry(point: bytes, content_key: bytes) -> dict[str, object]:
    one_time = SoftwareKey.generate()
    wrapping = _wrapping_key(one_time.ecdh(point), b"", b"")
    return {
        "header": {"kid": fingerprint(point), "epk": public_jwk(one_time.point)},
        "encrypted_key": encode_base64url(keywrap.aes_key_wrap(wrapping, content_key)),
    }


def _wrapping_key(shared: bytes, party_u: bytes, party_v: bytes) -> bytes:
    """Derive the wrapping key (RFC 7518 section 4.6.2): Concat KDF over Z, AlgorithmID, Party*Info and SuppPubInfo."""
    parts = [len(part).to_bytes(4, "big") + part for part in (KEY_ALGORITHM.encode(), party_u, party_v)]
    info = b"".join(parts) + (8 * _KEY_OCTETS).to_bytes(4, "big")
    return concatkdf.ConcatKDFHash(hashes.SHA256(), _KEY_OCTETS, info).derive(shared)


def decrypt(octets: bytes, key: PrivateKey, *, cty: str, max_octets: int) -> bytes:
    """Open a JWE that names ``key`` among its recipients; General or Flattened JSON serialization.

    A recipient entry is ours if its ``kid`` is our fingerprint, or if it has no ``kid``. Size is checked before
    parsing. Raises NotAuthenticError, PolicyError or BadDataError.
    """
    document = _document(octets, max_octets)
    content_key, seal = content_key_for(document, key, cty=cty)
    ciphertext = decode_base64url(document.get("ciphertext"), "The ciphertext")
    try:
        return aead.AESGCM(content_key).decrypt(seal.iv, ciphertext + seal.tag, seal.additional)
    except exceptions.InvalidTag as error:
        raise NotAuthenticError(CHANGED_CONTENT) from error


@dataclass(frozen=True)
class ContentSeal:
    """Inputs that open a ciphertext beside its key: initialisation vector, tag, additional authenticated data."""

    iv: bytes
    tag: bytes
    additional: bytes

    def opener(self, content_key: bytes) -> AEADDecryptionContext:
        """Decrypt a piece at a time; its ``finalize`` raises InvalidTag, and before that nothing may be believed."""
        cipher = ciphers.Cipher(algorithms.AES(content_key), modes.GCM(self.iv, self.tag)).decryptor()
        cipher.authenticate_additional_data(self.additional)
        return cipher


def content_key_for(document: Mapping[str, Any], key: PrivateKey, *, cty: str) -> tuple[bytes, ContentSeal]:
    """Unwrap the content key of a JWE with the recipient's ``key``; raises as :func:`decrypt` does."""
    shared = _shared_header(document)
    own = fingerprint(key.point)
    named = False
    for entry in _entries(document):
        header = _merged(shared, _mapping(entry.get("header"), "The header of a recipient"))
        if header.get("kid", own) != own:
            continue
        named = True
        _only(header, "alg", (KEY_ALGORITHM,), "key management algorithm")
        _only(header, "enc", (CONTENT_ALGORITHM,), "content encryption")
        _no_extensions(header)
        if str(header.get("cty", "")).lower() != cty.lower():
            raise BadDataError(f"The sealed content says that it is {_shown(header.get('cty'))}, not {cty}.")
        content_key = _content_key(header, entry, key)
        if content_key is not None:
            return content_key, _seal(document)
    if not named:
        raise PolicyError(
            f"This was not sealed for this station ({own[:16]}).",
            hint="Ask the sender to export it for this station; teds-provision show FILE names the recipients.",
        )
    raise NotAuthenticError("The sealed key does not open: it was changed, or made for another key under this name.")


def read_header(octets: bytes, *, max_octets: int) -> JweHeader:
    """Read the clear part of a JWE, without any key; raises BadDataError."""
    return header_of(_document(octets, max_octets))


def header_of(document: Mapping[str, Any]) -> JweHeader:
    """Read the clear part of a JWE that :func:`parse_document` returned; raises BadDataError."""
    shared = _shared_header(document)
    headers = [
        _merged(shared, _mapping(entry.get("header"), "The header of a recipient")) for entry in _entries(document)
    ]
    first = headers[0]
    return JweHeader(
        _text(first.get("alg")),
        _text(first.get("enc")),
        _text(first.get("cty")),
        tuple(_text(header.get("kid")) for header in headers),
    )


def _document(octets: bytes, max_octets: int) -> dict[str, Any]:
    check_size(len(octets), max_octets, "the sealed document")
    return parse_document(octets)


def parse_document(octets: bytes) -> dict[str, Any]:
    """Read the JSON of a JWE, whose size the caller has bounded; raises BadDataError."""
    if octets[:64].lstrip(b" \t\r\n")[:1] != b"{":
        raise BadDataError("This is not a JWE in a JSON serialization.")
    refuse_many(separators(octets), MAX_SEPARATORS, "a JWE")
    return load_object(octets, "The sealed document")


def _shared_header(document: Mapping[str, Any]) -> dict[str, Any]:
    protected = _header(document.get("protected"), "The protected header")
    if "enc" not in protected:
        raise BadDataError("The protected header names no content encryption (enc).")
    return _merged(protected, _mapping(document.get("unprotected"), "The unprotected header"))


def _entries(document: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield the recipient entries of the General form, or the one of the Flattened form (RFC 7516 section 7.2)."""
    if "recipients" not in document:
        return iter((document,))
    entries = document["recipients"]
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_RECIPIENTS:
        raise BadDataError(f"A JWE here has 1 to {MAX_RECIPIENTS} recipients.")
    if "encrypted_key" in document or "header" in document:
        raise BadDataError("A JWE is in the General or in the Flattened form, not in both.")
    return iter([_mapping(entry, "A recipient") for entry in entries])


def _content_key(header: Mapping[str, Any], entry: Mapping[str, Any], key: PrivateKey) -> bytes | None:
    """Agree and unwrap; return None if the wrapped key is not for this key."""
    one_time = point_of(header.get("epk"), "The one-time key (epk)")
    wrapped = decode_base64url(entry.get("encrypted_key"), "The encrypted key")
    party_u, party_v = _party_info(header, "apu"), _party_info(header, "apv")
    if len(wrapped) != _WRAPPED_OCTETS:
        raise BadDataError(f"The encrypted key has {len(wrapped)} octets, not {_WRAPPED_OCTETS}.")
    try:
        return keywrap.aes_key_unwrap(_wrapping_key(key.ecdh(one_time), party_u, party_v), wrapped)
    except keywrap.InvalidUnwrap:
        return None


def _party_info(header: Mapping[str, Any], name: str) -> bytes:
    octets = decode_base64url(header[name], name) if name in header else b""
    if len(octets) > _MAX_PARTY_INFO_OCTETS:
        raise BadDataError(f"The header {name} is longer than {_MAX_PARTY_INFO_OCTETS} octets.")
    return octets


def _seal(document: Mapping[str, Any]) -> ContentSeal:
    iv, tag = decode_base64url(document.get("iv"), "The iv"), decode_base64url(document.get("tag"), "The tag")
    if len(iv) != _IV_OCTETS or len(tag) != _TAG_OCTETS:
        raise BadDataError(
            f"The iv has {_IV_OCTETS} octets and the tag {_TAG_OCTETS}; these have {len(iv)} and {len(tag)}."
        )
    additional = str(document.get("protected"))
    if "aad" in document:
        decode_base64url(document["aad"], "The aad")
        additional = f"{additional}.{document['aad']}"
    return ContentSeal(iv, tag, additional.encode())


def _header(text: object, what: str) -> dict[str, Any]:
    if isinstance(text, str | bytes) and len(text) > _MAX_HEADER_CHARACTERS:
        raise BadDataError(f"{what} is longer than {_MAX_HEADER_CHARACTERS} characters.")
    return load_object(decode_base64url(text, what), what)


def _mapping(value: object, what: str) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise BadDataError(f"{what} is not an object.")
    return value


def _merged(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """Join two headers, which must share no name (RFC 7516 section 7.2.1)."""
    if not first.keys().isdisjoint(second):
        raise BadDataError("A header parameter occurs in two headers.")
    return first | second


def _only(header: Mapping[str, Any], name: str, allowed: tuple[str, ...], what: str) -> None:
    if header.get(name) not in allowed:
        raise PolicyError(f"The {what} {_shown(header.get(name))} is not accepted; only {', '.join(allowed)} is.")


def _no_extensions(header: Mapping[str, Any]) -> None:
    for name in ("crit", "zip", "b64"):
        if name in header:
            raise PolicyError(f"The header parameter {name} is not accepted.")


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""


def _shown(value: object) -> str:
    """Return a value from outside, short and printable, for a message."""
    return ascii(value)[:40]


# Keys as JSON Web Keys: public P-256 points and link keys (RFC 7517, RFC 7518 sections 6.2 and 6.4).
#
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
    """Return the point (65 octets) of a public P-256 JWK; other members (kid, use, alg) are ignored.

    Raises BadDataError that names ``what``: another key type or curve, a private key, wrong lengths, not on the curve.
    The test of the curve is plain arithmetic on public values, as a bundle has ten thousand of them.
    """
    if not isinstance(jwk, dict):
        raise BadDataError(f"{what} is not a JSON Web Key.")
    if "d" in jwk or jwk.get("kty") == "oct":
        raise BadDataError(f"{what} holds a private or secret key where a public one belongs.")
    if jwk.get("kty") != "EC" or jwk.get("crv") != "P-256":
        raise BadDataError(f"{what} is not a P-256 key; stations, CAs and nodes have P-256 keys.")
    x, y = decode_base64url(jwk.get("x"), what), decode_base64url(jwk.get("y"), what)
    if len(x) != _COORDINATE_OCTETS or len(y) != _COORDINATE_OCTETS:
        raise BadDataError(f"{what} has coordinates that are not {_COORDINATE_OCTETS} octets each.")
    if not _on_curve(int.from_bytes(x, "big"), int.from_bytes(y, "big")):
        raise BadDataError(f"{what} is not a point of the curve P-256.")
    return b"\x04" + x + y


def _on_curve(x: int, y: int) -> bool:
    return x < _P and y < _P and (y * y - (x * x - 3) % _P * x - _B) % _P == 0


def link_key_of(jwk: object, what: str) -> tuple[bytes, str]:
    """Return a link key (16 octets) and the ``kid`` that it claims, in lower case; raises BadDataError."""
    if not isinstance(jwk, dict) or jwk.get("kty") != "oct":
        raise BadDataError(f"{what} is not a symmetric JSON Web Key.")
    key = decode_base64url(jwk.get("k"), what)
    if len(key) != _LINK_KEY_OCTETS:
        raise BadDataError(f"{what} has {len(key)} octets, a link key has {_LINK_KEY_OCTETS}.")
    kid = jwk.get("kid")
    if not isinstance(kid, str):
        raise BadDataError(f"{what} has no kid.")
    return key, kid.lower()
