"""A signed payload sealed a piece at a time, and opened again: compact JWS (ES256) inside a JWE (A256GCM).

A bundle of ten thousand nodes is 7 MB, and all of its forms in memory at once would be five times that. When writing,
the signature comes last in the JWS and the tag last in the JWE, so a payload of any length passes through once. When
reading, the ciphertext stays in the file until its key is known. The plaintext is returned only if tag and signature
are good. The octets are those of :mod:`.jose`: every JOSE library writes and reads them.
"""

from __future__ import annotations

import hashlib
import os
import secrets
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, BinaryIO

from teds_provision.errors import BadDataError, NotAuthenticError
from teds_provision.limits import check_size
from teds_provision.protocol.handover.jose import (
    CHANGED_CONTENT,
    MAX_SEPARATORS,
    NO_COMPACT_JWS,
    FindKey,
    JweWriter,
    check_signature,
    content_key_for,
    parse_document,
    signed_header,
)
from teds_provision.protocol.handover.strict_json import (
    Base64urlReader,
    Base64urlWriter,
    base64url,
    refuse_many,
    separators,
)
from teds_provision.protocol.keys import PrivateKey
from teds_provision.protocol.primitives import exceptions

PIECE = 64 * 1024
_LONGEST_EDGE = 16384  # characters of a JWS header or signature
_ESCAPE = 5  # most characters of an escape (backslash, u, four digits) that remain if it is cut
_ALPHABET = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_"

Source = bytes | BinaryIO
"""Octets, or a file of them that can be read from any place."""


class EnvelopeWriter:
    """Writer of a payload: :meth:`body`, then :meth:`end`, without which the result can be neither opened nor verified.

    The digests and ``octets`` are known when :meth:`end` has returned. ``signed_sha256`` is over the JWS inside.
    """

    def __init__(
        self, payload: Iterable[bytes], signer: PrivateKey, recipients: Sequence[bytes], *, typ: str, cty: str
    ) -> None:
        self._payload = payload
        self._signer = signer
        self._header = signed_header(signer, typ)
        self._jwe = JweWriter(recipients, cty=cty)
        self._signed = hashlib.sha256()
        self._file = hashlib.sha256()
        self.octets = 0

    @property
    def sha256(self) -> str:
        """Digest of the octets of the file, in hex."""
        return self._file.hexdigest()

    @property
    def signed_sha256(self) -> str:
        """Digest of the signed document inside, in hex."""
        return self._signed.hexdigest()

    def body(self) -> Iterator[bytes]:
        """Give all but the signature and the tag, a piece at a time."""
        text = Base64urlWriter()
        yield self._out(self._jwe.begin())
        yield self._sealed(self._header)
        for piece in self._payload:
            yield self._sealed(text.more(piece))
        yield self._sealed(text.end())

    def end(self) -> bytes:
        """Sign, and return the last octets."""
        signature = self._signer.sign_digest(self._signed.digest())
        return self._sealed(b"." + base64url(signature)) + self._out(self._jwe.end())

    def _sealed(self, text: bytes) -> bytes:
        self._signed.update(text)
        return self._out(self._jwe.more(text))

    def _out(self, octets: bytes) -> bytes:
        self._file.update(octets)
        self.octets += len(octets)
        return octets


@dataclass(frozen=True)
class UnsealedPayload:
    """An opened payload: ``kid`` and point of the signer, the payload, and both digests in hex."""

    kid: str
    signer: bytes
    payload: bytearray = field(repr=False)
    signed_sha256: str
    sha256: str


@dataclass(frozen=True)
class Envelope:
    """The JSON of a JWE without its ciphertext, that is ``before``, octets ``first`` to ``last`` of it, ``after``.

    ``before`` is whatever the member held if that was no text. ``octets`` and ``sha256`` are those of the whole file.
    """

    document: dict[str, Any] = field(repr=False)
    before: object
    first: int
    last: int
    after: str
    octets: int
    sha256: str


def as_file(source: Source) -> BinaryIO:
    """Return a file of the octets of a source; nothing is copied."""
    return BytesIO(source) if isinstance(source, bytes) else source


def unseal(
    source: Source, key: PrivateKey, find_key: FindKey, *, typ: str, cty: str, max_octets: int
) -> UnsealedPayload:
    """Open a JWE that names ``key`` among its recipients, and check the JWS in it by a key that ``find_key`` trusts.

    Raises NotAuthenticError, PolicyError or BadDataError, as :func:`.jose.decrypt` and :func:`.jose.verify_compact` do.
    """
    file = as_file(source)
    envelope = read_envelope(file, max_octets)
    content_key, seal = content_key_for(envelope.document, key, cty=cty)
    text, opener, jws = Base64urlReader("The ciphertext"), seal.opener(content_key), _SplitJws()
    for piece in _ciphertext(file, envelope):
        jws.more(opener.update(text.more(piece)))
    jws.more(opener.update(text.end()))
    try:
        opener.finalize()
    except exceptions.InvalidTag as error:
        raise NotAuthenticError(CHANGED_CONTENT) from error
    kid, signer = check_signature(*jws.signed(), find_key, typ)
    return UnsealedPayload(kid, signer, jws.payload(), jws.sha256, envelope.sha256)


def read_envelope(file: BinaryIO, max_octets: int) -> Envelope:
    """Read the JSON of a JWE, leaving the inner part of a long ciphertext in the file; raises BadDataError.

    A run of base64url characters in a JSON text can be replaced by another one without any effect on the rest; so it
    does not matter in which member, or in which piece of the file, it begins.
    """
    size = file.seek(0, os.SEEK_END)
    check_size(size, max_octets, "the sealed document")
    file.seek(0)
    outline = _Outline()
    while piece := file.read(min(size - outline.octets, PIECE)):
        outline.feed(piece)
    document, first, last = parse_document(bytes(outline.text)), outline.first, outline.last
    before, found, after = _cut(document.pop("ciphertext", None), outline.mark.decode())
    if last and not found:  # the run belongs to another member: parse the whole text
        file.seek(0)
        document = parse_document(file.read(max_octets))
        before, first, last = document.pop("ciphertext", None), 0, 0
    return Envelope(document, before, first, last, after, outline.octets, outline.digest.hexdigest())


class _Outline:
    """A file, piece by piece: its text with ``mark`` for the run of base64url between ``first`` and ``last``."""

    def __init__(self) -> None:
        self.mark = b"z" + secrets.token_hex(16).encode()
        self.text, self.digest = bytearray(), hashlib.sha256()
        self.octets = self.first = self.last = 0
        self._separators = 0

    def feed(self, piece: bytes) -> None:
        """Read on; raises BadDataError for more separators than a JWE has."""
        here, self.octets = self.octets, self.octets + len(piece)
        self.digest.update(piece)
        if not self._is_run(piece, here):
            self.text += piece
            self._separators += separators(piece)
            refuse_many(self._separators, MAX_SEPARATORS, "a JWE")
            return
        if not self.last:
            self.first = here
            self.text += self.mark
        self.last = self.octets

    def _is_run(self, piece: bytes, here: int) -> bool:
        """Return True if a piece is nothing but base64url, and begins or continues the run."""
        if len(piece) < PIECE or self.last not in (0, here):
            return False
        begins_in_an_escape = not self.last and b"\\" in self.text[-_ESCAPE:]
        return not begins_in_an_escape and not piece.translate(None, _ALPHABET)


def _cut(ciphertext: object, mark: str) -> tuple[object, bool, str]:
    """Cut the ciphertext in two at the mark."""
    if not isinstance(ciphertext, str):
        return ciphertext, False, ""
    before, found, after = ciphertext.partition(mark)
    return before, bool(found), after


def _ciphertext(file: BinaryIO, envelope: Envelope) -> Iterator[bytes]:
    yield _ascii(envelope.before)
    file.seek(envelope.first)
    left = envelope.last - envelope.first
    while left and (piece := file.read(min(left, PIECE))):
        left -= len(piece)
        yield piece
    yield _ascii(envelope.after)


def _ascii(text: object) -> bytes:
    if not isinstance(text, str):
        raise BadDataError("The ciphertext is not a base64url string.")
    try:
        return text.encode("ascii")
    except UnicodeEncodeError as error:
        raise BadDataError("The ciphertext is not base64url without padding.") from error


class _SplitJws:
    """A compact JWS that comes in pieces: its payload decoded, its edges unchanged. Nothing of it is verified yet.

    A fault in its form is reported only at the end, after the tag was checked.
    """

    def __init__(self) -> None:
        self._edges = [bytearray(), bytearray()]
        self._octets = bytearray()
        self._reader = Base64urlReader("The payload")
        self._dots = 0
        self._hash = hashlib.sha256()
        self._digest = b""
        self._fault: BadDataError | None = None

    def more(self, text: bytes) -> None:
        """Take the next characters."""
        for number, part in enumerate(text.split(b".")):
            if number:
                self._dots += 1
                if self._dots == 2:
                    self._digest = self._hash.digest()
                    self._decode(self._reader.end)
                self._hash.update(b".")
            self._part(part)

    def signed(self) -> tuple[bytes, bytes, bytes]:
        """Return header and signature as they came, and the digest of what was signed; raises BadDataError."""
        if self._dots != 2:
            raise BadDataError(NO_COMPACT_JWS)
        return bytes(self._edges[0]), bytes(self._edges[1]), self._digest

    def payload(self) -> bytearray:
        """Return the payload, once the signature is known to be good; raises BadDataError."""
        if self._fault is not None:
            raise self._fault
        return self._octets

    @property
    def sha256(self) -> str:
        """Digest of the whole of it, in hex."""
        return self._hash.hexdigest()

    def _part(self, text: bytes) -> None:
        self._hash.update(text)
        if self._dots == 1:
            self._decode(lambda: self._reader.more(text))
        elif self._dots in (0, 2) and len(self._edges[self._dots // 2]) <= _LONGEST_EDGE:
            self._edges[self._dots // 2] += text

    def _decode(self, read: Callable[[], bytes]) -> None:
        if self._fault is None:
            try:
                self._octets += read()
            except BadDataError as fault:
                self._fault = fault
                self._octets.clear()
