"""The one form of every document that a plant signs: a compact JWS, one kind for each ``typ`` (contract/plant.md).

ES256, ``kid`` the signer's fingerprint, payload JSON in UTF-8 without spaces. A document is kept and passed on as the
octets that came. Its name is H: SHA-256 of its signing input, all before the last dot. A document that was signed again
(another random k, the other s) has the same H, so two of them never look like two histories.

Readers are bounded and strict: one size for each kind, exactly ``alg``, ``kid``, ``typ`` in the header, no member
twice, no floating number. Whatever the octets, they end in a value or in an error of ours.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Final

from teds_provision.errors import BadDataError
from teds_provision.limits import check_size
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.strict_json import base64url, decode_base64url, load_exact
from teds_provision.protocol.keys import PrivateKey, fingerprint, is_point

LAST_NUMBER: Final = 0xFFFFFFFF
LONGEST_NAME: Final = 100
LONGEST_TEXT: Final = 1024
_HEADER: Final = frozenset({"alg", "kid", "typ"})


@dataclass(frozen=True)
class DocumentKind:
    """One kind of document: its ``typ``, the most octets that are read, its ``format``, and what people call it."""

    typ: str
    most: int
    format: str
    what: str


ROSTER: Final = DocumentKind("teds-roster+jws", 1 << 20, "teds-roster/1", "the roster")
PAGE: Final = DocumentKind("teds-page+jws", 1 << 20, "teds-page/1", "the page")
MEMBER_REQUEST: Final = DocumentKind("teds-member-request+jws", 16 << 10, "teds-member-request/1", "the request")
JOB: Final = DocumentKind("teds-job+jws", 4 << 20, "teds-job/1", "the job")
SIGN_REQUEST: Final = DocumentKind("teds-sign-request+jws", 1 << 20, "teds-sign-request/1", "the sign request")
SIGNED: Final = DocumentKind("teds-signed+jws", 64 << 10, "teds-signed/1", "the office's answer")


class NewerFormatError(BadDataError):
    """The document is of a newer version of its format; a newer program can read it."""

    code = "newer-format"


@dataclass(frozen=True)
class SignedDocument:
    """A document under a good signature: the signer's fingerprint and point, H, and its members."""

    signer: str
    point: bytes
    hash: str
    members: Mapping[str, Any] = field(repr=False)
    octets: bytes = field(repr=False)


def payload(members: Mapping[str, Any]) -> bytes:
    """Return the octets that are signed for these members, in their order."""
    return json.dumps(members, ensure_ascii=False, separators=(",", ":"), allow_nan=False).encode()


def sign_document(members: Mapping[str, Any], key: PrivateKey, kind: DocumentKind) -> bytes:
    """Sign a document; raises BadDataError if it is larger than readers accept."""
    octets = jose.sign_compact(payload(members), key, typ=kind.typ)
    check_size(len(octets), kind.most, kind.what)
    return octets


def hash_of(octets: bytes) -> str:
    """Return H: SHA-256 of the signing input, 64 digits."""
    return hashlib.sha256(octets.rpartition(b".")[0]).hexdigest()


def open_document(octets: bytes, find_key: Callable[[str], bytes | None], kind: DocumentKind) -> SignedDocument:
    """Verify a document's signature and read its members; the caller checks their values.

    ``find_key`` gives the point of a fingerprint that may sign this kind. Raises NotAuthenticError (no known signer),
    BadDataError (no such document), NewerFormatError.
    """
    check_size(len(octets), kind.most, kind.what)
    header = load_exact(decode_base64url(octets.partition(b".")[0], "The JWS header"), "The JWS header")
    if header.keys() != _HEADER or header["typ"] != kind.typ:
        raise BadDataError(f"The header of {kind.what} does not hold exactly alg, kid and typ {kind.typ}.")
    verified = jose.verify_compact(octets, find_key, typ=kind.typ, max_octets=kind.most)
    members = load_exact(verified.payload, f"T{kind.what[1:]}")
    format_name = members.get("format")
    if format_name != kind.format:
        newer = isinstance(format_name, str) and re.fullmatch(
            re.escape(kind.format[:-1]) + r"[1-9]\d{0,8}", format_name
        )
        if newer:
            raise NewerFormatError(
                f"T{kind.what[1:]} is of a newer version ({format_name}).",
                hint="Use a newer version of teds-provision.",
            )
        raise BadDataError(f"The format of {kind.what} is not {kind.format}.")
    return SignedDocument(verified.kid, verified.signer, hash_of(octets), members, octets)


def split(octets: bytes) -> tuple[bytes, bytes, bytes]:
    """Return header (unchanged), payload and signature of an opened document; :func:`join` gives the same octets."""
    header, text, signature = octets.split(b".")
    return header, decode_base64url(text, "The payload"), decode_base64url(signature, "The signature")


def join(header: bytes, content: bytes, signature: bytes) -> bytes:
    """Return the document of which :func:`split` gave the parts."""
    return b".".join((header, base64url(content), base64url(signature)))


# -- forms of values: lower case, whole numbers, one spelling each -----------------------------------------------------

_PATTERNS: Final = {
    "uuid": (re.compile("[0-9a-f]{20}"), "is no UUID of 20 hex digits in lower case"),
    "sha256": (re.compile("[0-9a-f]{64}"), "is no SHA-256 of 64 hex digits in lower case"),
    "digits": (re.compile("[0-9a-f]{16}"), "is no 16 hex digits in lower case"),
    "point": (re.compile("04[0-9a-f]{128}"), "is no point of 130 hex digits in lower case"),
    "time": (re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", re.ASCII), "is no time such as 2026-01-31T12:00:00Z"),
    "random_id": (
        re.compile("[0-9a-f]{8}-[0-9a-f]{4}-4[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}"),
        "is no UUIDv4 in lower case",
    ),
}


def is_form(kind: str, value: object) -> bool:
    """Return True if a value is a text of one of the forms: uuid, sha256, digits, point, time, random_id."""
    return isinstance(value, str) and _PATTERNS[kind][0].fullmatch(value) is not None


def is_time(value: object) -> bool:
    """Return True if a value is an existing time of that form: the 31st of February is none."""
    try:
        return is_form("time", value) and datetime.fromisoformat(str(value)) is not None
    except ValueError:
        return False


def is_number(value: object) -> bool:
    """Return True if a value is a whole number of 0 to 2^32 - 1 (true is none)."""
    return type(value) is int and 0 <= value <= LAST_NUMBER


def is_name(value: object) -> bool:
    """Return True if a value is 1 to 100 printable characters without space at either end."""
    return isinstance(value, str) and 1 <= len(value) <= LONGEST_NAME and value.isprintable() and value == value.strip()


def is_text(value: object) -> bool:
    """Return True if a value is printable and of at most 1,024 characters."""
    return isinstance(value, str) and len(value) <= LONGEST_TEXT and value.isprintable()


class Fields:
    """The members of one object, read strictly; ``where`` opens every complaint. Unknown members are ignored."""

    def __init__(self, members: object, where: str) -> None:
        if not isinstance(members, dict):
            raise BadDataError(f"{where} is not an object.")
        self.members: dict[str, Any] = members
        self._where = where

    def text_of_form(self, form: str, name: str) -> str:
        """Return a text of one of the forms of :func:`is_form`."""
        value = self.members.get(name)
        if not is_form(form, value):
            raise self.bad(name, _PATTERNS[form][1])
        return str(value)

    def number(self, name: str, least: int = 0) -> int:
        """Return a whole number of ``least`` to 2^32 - 1."""
        value = self.members.get(name)
        if type(value) is not int or not least <= value <= LAST_NUMBER:
            raise self.bad(name, f"is no whole number of {least} to {LAST_NUMBER}")
        return value

    def name(self, name: str) -> str:
        """Return a name: 1 to 100 printable characters."""
        value = self.members.get(name)
        if not is_name(value):
            raise self.bad(name, f"is no name of 1 to {LONGEST_NAME} printable characters")
        return str(value)

    def point(self, name: str) -> bytes:
        """Return a public key, 65 octets, on the curve."""
        point = bytes.fromhex(self.text_of_form("point", name))
        if not is_point(point):
            raise self.bad(name, "is no point of the curve P-256")
        return point

    def octets(self, name: str, count: int) -> bytes:
        """Return a member of ``count`` octets in base64url; raises BadDataError."""
        value = self.members.get(name)
        octets = decode_base64url(value, f"{self._where}: {name}") if isinstance(value, str) else b""
        if len(octets) != count:
            raise self.bad(name, f"is no {count} octets in base64url")
        return octets

    def time(self, name: str) -> datetime:
        """Return a moment, in UTC."""
        text = self.text_of_form("time", name)
        try:
            return datetime.strptime(text, "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=UTC)
        except ValueError as error:
            raise self.bad(name, "is no time") from error

    def flag(self, name: str) -> bool:
        """Return a boolean."""
        value = self.members.get(name)
        if not isinstance(value, bool):
            raise self.bad(name, "is neither true nor false")
        return value

    def one_of(self, name: str, words: tuple[str, ...]) -> str:
        """Return a member that is one of these words; raises BadDataError."""
        value = self.members.get(name)
        if value not in words or not isinstance(value, str):
            raise self.bad(name, f"is none of {', '.join(words)}")
        return value

    def list_of(self, name: str, most: int) -> list[Any]:
        """Return a list of at most so many; an absent one is empty."""
        value = self.members.get(name, [])
        if not isinstance(value, list):
            raise self.bad(name, "is no list")
        if len(value) > most:
            raise self.bad(name, f"has {len(value)} entries; at most {most} are read")
        return value

    def place(self, name: str) -> tuple[int, str]:
        """Return a page by its number and H; ``[0, ""]`` is none."""
        value = self.members.get(name)
        if isinstance(value, list) and len(value) == 2 and is_number(value[0]):
            number, named = value
            if (number == 0 and named == "") or (number > 0 and is_form("sha256", named)):
                return number, named
        raise self.bad(name, "is no page as [number, H]")

    def bad(self, name: str, complaint: str) -> BadDataError:
        """Return the error for one member."""
        return BadDataError(f"{self._where}: {name} {complaint}.")


# -- requests to become a member ---------------------------------------------------------------------------------------

_LOGIN: Final = re.compile(r"SCRAM-SHA-256\$4096:[A-Za-z0-9+/]{22,86}={0,2}\$[A-Za-z0-9+/]{43}=:[A-Za-z0-9+/]{43}=")


@dataclass(frozen=True)
class MemberRequest:
    """A station's request for membership: its name, key, certificate (SIG104), and its login's verifier."""

    name: str
    point: bytes
    certificate: bytes
    login: str
    created: datetime

    @property
    def fingerprint(self) -> str:
        """Of the station's key."""
        return fingerprint(self.point)

    def signed(self, key: PrivateKey) -> bytes:
        """Return the request, signed by the station itself."""
        members = {
            "format": MEMBER_REQUEST.format,
            "name": self.name,
            "point": self.point.hex(),
            "certificate": base64url(self.certificate).decode(),
            "login": self.login,
            "created": self.created.strftime("%Y-%m-%dT%H:%M:%SZ"),
        }
        return sign_document(members, key, MEMBER_REQUEST)


def open_request(octets: bytes) -> MemberRequest:
    """Read a request, which is signed with its own key; an operator must compare the fingerprint.

    Raises NotAuthenticError, BadDataError.
    """
    octets = octets.strip()
    check_size(len(octets), MEMBER_REQUEST.most, MEMBER_REQUEST.what)
    parts = octets.split(b".")
    claimed = load_exact(decode_base64url(parts[1] if len(parts) == 3 else b"", "The request"), "The request")
    point = Fields(claimed, "The request").point("point")
    document = open_document(octets, lambda kid: point if kid == fingerprint(point) else None, MEMBER_REQUEST)
    fields = Fields(document.members, "The request")
    login = fields.members.get("login")
    if not isinstance(login, str) or not _LOGIN.fullmatch(login):
        raise fields.bad("login", "is no SCRAM-SHA-256 verifier")
    return MemberRequest(fields.name("name"), point, fields.octets("certificate", 64), login, fields.time("created"))
