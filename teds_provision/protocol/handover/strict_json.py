"""JSON and base64url as signed data needs them: one reading, or none (RFC 8259, RFC 4648, RFC 7515 section 2).

Readers that disagree about a duplicate name, a padded string or a spare bit are how signed documents get two meanings.
Any input either has exactly one reading or raises :class:`BadDataError`.
"""

from __future__ import annotations

import binascii
import codecs
import json
import re
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from io import BytesIO
from typing import Any
from uuid import UUID

from teds_provision.errors import BadDataError
from teds_provision.json_decoder import DuplicateNameError, strict_decoder

_TO_URL = bytes.maketrans(b"+/", b"-_")
# The two characters that only plain base64 has, and the padding, are mapped to one that no alphabet has.
_FROM_URL = bytes.maketrans(b"-_+/=", b"+/***")
_PART = 3 << 16  # a multiple of 3, so that the base64 of the parts is that of the whole
_PADDING = (b"", b"===", b"==", b"=")
_ALPHABET = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
_TWICE = "an object names a member twice"
_BYTE_ORDER_MARK = "a byte order mark is no JSON"
_WINDOW = 64 * 1024
_NUMBER_GOES_ON = 2  # "1e+" is read as 1, but one more digit makes another number
_WHITE = " \t\n\r"
# The permitted last characters, whose spare bits are zero, by the number of characters in the last group (1 is
# invalid).
_LAST = (frozenset(_ALPHABET), frozenset[int](), frozenset(_ALPHABET[::16]), frozenset(_ALPHABET[::4]))


def base64url(octets: bytes) -> bytes:
    """Return base64url without padding, as ASCII octets."""
    return binascii.b2a_base64(octets, newline=False).translate(_TO_URL).rstrip(b"=")


def write_base64url(into: BytesIO, octets: memoryview) -> None:
    """Write base64url of many octets a part at a time: a coder of it all at once copies the megabytes three times."""
    for start in range(0, len(octets), _PART):
        into.write(base64url(bytes(octets[start : start + _PART])))


class Base64urlWriter:
    """Base64url of octets that come in pieces: at most two of them wait for the next piece."""

    def __init__(self) -> None:
        self._rest = b""

    def more(self, octets: bytes) -> bytes:
        """Return the characters of all whole groups of three octets so far."""
        octets = self._rest + octets
        whole = len(octets) - len(octets) % 3
        self._rest = octets[whole:]
        return base64url(octets[:whole])

    def end(self) -> bytes:
        """Return the last characters."""
        return base64url(self._rest)


class Base64urlReader:
    """Octets of base64url that comes in pieces, read as strictly as :func:`decode_base64url` does."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._rest = b""

    def more(self, text: bytes) -> bytes:
        """Return the octets of all whole groups of four characters so far; raises BadDataError."""
        text = self._rest + text
        whole = len(text) - len(text) % 4
        self._rest = text[whole:]
        return decode_base64url(text[:whole], self._what)

    def end(self) -> bytes:
        """Return the last octets; raises BadDataError."""
        return decode_base64url(self._rest, self._what)


def encode_base64url(octets: bytes) -> str:
    """Return base64url without padding, as text."""
    return base64url(octets).decode("ascii")


def decode_base64url(text: object, what: str) -> bytes:
    """Read base64url (text or ASCII octets) without padding, spare bits zero.

    Raises BadDataError that names ``what``.
    """
    try:
        if isinstance(text, str):
            octets = text.encode("ascii").translate(_FROM_URL)
        elif isinstance(text, bytes):
            octets = text.translate(_FROM_URL)
        else:
            raise BadDataError(f"{what} is not a base64url string.")
        plain = binascii.a2b_base64(octets + _PADDING[len(octets) % 4], strict_mode=True)
    except ValueError as error:
        raise BadDataError(f"{what} is not base64url without padding.") from error
    if octets and octets[-1] not in _LAST[len(octets) % 4]:
        raise BadDataError(f"{what} has spare bits set in its last base64url character.")
    return plain


def dump(value: object) -> bytes:
    """Return compact JSON, in ASCII."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode("ascii")


def separators(octets: bytes) -> int:
    """Count what begins or parts values in JSON."""
    return sum(octets.count(separator) for separator in (b",", b"[", b"{"))


def refuse_many(count: int, most: int, what: str) -> None:
    """Raise BadDataError if a JSON text has more separators than ``what`` ever has.

    It would cost far more than it is.
    """
    if count > most:
        raise BadDataError(f"This JSON has far more members than {what}.")


def load_object(octets: bytes, what: str) -> dict[str, Any]:
    """Read one JSON object; refuses other encodings than UTF-8, duplicate names, NaN and what is nested too deeply.

    The caller has bounded the size. Raises BadDataError that names ``what``.
    """
    try:
        value = _DECODER.decode(_decoded(octets))
    except (RecursionError, ValueError) as error:
        raise _damaged(error, what) from error
    if not isinstance(value, dict):
        raise BadDataError(f"{what} is JSON, but not an object.")
    return value


def load_exact(octets: bytes, what: str) -> dict[str, Any]:
    """Load as :func:`load_object` does, without fractions and exponents, which readers round differently."""
    try:
        value = _EXACT.decode(_decoded(octets))
    except (RecursionError, ValueError) as error:
        raise _damaged(error, what) from error
    if not isinstance(value, dict):
        raise BadDataError(f"{what} is JSON, but not an object.")
    return value


def load_long(octets: bytearray, what: str, name: str, make: Callable[[object], object]) -> dict[str, Any]:
    """Load an object whose member ``name`` is a long list; each element is passed through ``make``.

    So neither the text nor the elements are ever all there beside what is made of them. ``octets`` is emptied as it is
    read. Whatever ``make`` raises comes out as it is.
    """
    try:
        walk = _Walk(octets)
        if walk.next() == "{":
            return walk.members(name, make)
        _DECODER.decode(walk.rest())
    except (RecursionError, ValueError) as error:
        raise _damaged(error, what) from error
    raise BadDataError(f"{what} is JSON, but not an object.")


def _damaged(error: RecursionError | ValueError, what: str) -> BadDataError:
    """Return what is wrong with a JSON text."""
    if isinstance(error, RecursionError):
        return BadDataError(f"{what} is nested too deeply.")
    detail = _TWICE if isinstance(error, DuplicateNameError) else "it is damaged or something else"
    return BadDataError(f"{what} is not the JSON that it should be: {detail}.")


def _decoded(octets: bytes | bytearray) -> str:
    text = octets.decode("utf-8")
    if text.startswith("\ufeff"):
        raise ValueError(_BYTE_ORDER_MARK)
    return text


class _Walk:
    """Reads the outermost object of a JSON text member by member (RFC 8259 sections 2, 4 and 5).

    Decodes a window of the text at a time, and a longer one if a value does not end in it.
    """

    def __init__(self, octets: bytearray) -> None:
        self._octets = octets
        self._decoder = codecs.getincrementaldecoder("utf-8")()
        self._text = ""
        self._at = 0
        self._more(_WINDOW)
        if self._text.startswith("\ufeff"):
            raise ValueError(_BYTE_ORDER_MARK)

    def rest(self) -> str:
        """Return all that was not read yet."""
        self._more(len(self._octets))
        return self._text[self._at :]

    def members(self, name: str, make: Callable[[object], object]) -> dict[str, Any]:
        """Read all members, the elements of the list ``name`` through ``make``, and nothing may follow."""
        members: dict[str, Any] = {}
        for _ in self._entries("}"):
            if self.next() != '"':
                raise ValueError("a member has no name")
            key = self._value()
            if key in members:
                raise DuplicateNameError(key)
            if self.next() != ":":
                raise ValueError("a member has no value")
            self._at += 1
            if key == name and self.next() == "[":
                members[key] = [make(self._value()) for _ in self._entries("]")]
            else:
                members[key] = self._value()
        if self.next():
            raise ValueError("more than one value")
        return members

    def _entries(self, closing: str) -> Iterator[None]:
        """Go from entry to entry of an object or list, over its brackets and commas."""
        self._at += 1
        if self.next() != closing:
            yield
            while self.next() == ",":
                self._at += 1
                yield
        if self.next() != closing:
            raise ValueError("an object or list does not end")
        self._at += 1

    def next(self) -> str:
        """Return the next character that is no white space, "" at the end."""
        while True:
            character = self._text[self._at : self._at + 1]
            if character and character not in _WHITE:
                return character
            if character:
                self._at += 1
            elif not self._more(_WINDOW):
                return ""

    def _value(self) -> Any:
        """Read a value; one that ends at the window's end may continue behind it."""
        self.next()
        window = _WINDOW
        while True:
            try:
                value, at = _DECODER.raw_decode(self._text, self._at)
            except ValueError:
                if not self._more(window):
                    raise
            else:
                if at + _NUMBER_GOES_ON < len(self._text) or not self._more(window):
                    self._at = at
                    return value
            window *= 2

    def _more(self, count: int) -> bool:
        """Decode as many octets more and drop the text that was read; False if there are none."""
        if not self._octets:
            return False
        piece = self._octets[:count]
        del self._octets[:count]
        self._text = self._text[self._at :] + self._decoder.decode(piece, final=not self._octets)
        self._at = 0
        return True


_DECODER = strict_decoder()
_EXACT = strict_decoder(fractions=False)


# Reads the members of a signed payload (profile.md, "Handover between base stations"), each with its type, range and
# error message.
#
# Unknown members are skipped: the signature covers them, and a later format may add some. Known members are read
# strictly. Text for users must be printable, so that a name cannot control a terminal.

LAST_U32 = 0xFFFFFFFF
_MAX_TEXT = 1024
_UUID = re.compile(r"[0-9A-Fa-f]{20}")
_RANDOM_ID = re.compile(r"[0-9a-f]{8}-[0-9a-f]{4}-4[0-9a-f]{3}-[89ab][0-9a-f]{3}-[0-9a-f]{12}")
_SHA256 = re.compile(r"[0-9A-Fa-f]{64}")
# RFC 3339 section 5.6.
_TIME = re.compile(r"\d{4}-\d\d-\d\d[Tt]\d\d:\d\d:\d\d(\.\d{1,6})?([Zz]|[+-]\d\d:\d\d)")


class Members:
    """The members of one JSON object; ``where`` opens every complaint."""

    def __init__(self, members: object, where: str) -> None:
        if not isinstance(members, dict):
            raise BadDataError(f"{where} is not an object.")
        self._members: Mapping[str, Any] = members
        self._where = where

    def get(self, name: str) -> Any:
        """Return a member as it is, None if it is absent or null."""
        return self._members.get(name)

    def text(self, name: str) -> str:
        """Return a text for people: printable, at most 1,024 characters."""
        return self._printable(name, self.get(name))

    def texts(self, name: str) -> tuple[str, ...]:
        """Return a list of such texts, empty if it is absent or null."""
        return tuple(self._printable(name, value) for value in self.list_of(name, required=False))

    def text_or_none(self, name: str) -> str | None:
        """Return the value of :meth:`text`; None if it is absent or null."""
        value = self._members.get(name)
        return None if value is None else self._printable(name, value)

    def list_of(self, name: str, *, required: bool = True) -> list[Any]:
        """Return a list; an empty one if an optional one is absent or null."""
        value = self.get(name)
        if value is None and not required:
            return []
        if not isinstance(value, list):
            raise self._bad(name, "is no list")
        return value

    def u32(self, name: str, first: int = 0) -> int:
        """Return an integer of ``first`` to 2^32 - 1 (JSON true is no integer)."""
        value = self.get(name)
        if type(value) is not int or not first <= value <= LAST_U32:
            raise self._bad(name, f"is no integer of {first} to {LAST_U32}")
        return value

    def uuid(self, name: str) -> bytes:
        """Return a node's UUID, 10 octets from 20 hex digits."""
        return bytes.fromhex(self._match(name, _UUID, "is no UUID of 20 hex digits"))

    def sha256(self, name: str) -> str:
        """Return a fingerprint or digest, 64 hex digits in lower case."""
        return self._match(name, _SHA256, "is no SHA-256 of 64 hex digits").lower()

    def sha256_or_none(self, name: str) -> str | None:
        """Return the value of :meth:`sha256`; None if it is absent or null."""
        return None if self._members.get(name) is None else self.sha256(name)

    def time(self, name: str) -> datetime:
        """Return an RFC 3339 time, in UTC."""
        text = self._match(name, _TIME, "is no RFC 3339 time")
        try:
            return datetime.fromisoformat(text.upper()).astimezone(UTC)
        except (ValueError, OverflowError) as error:
            raise self._bad(name, "is no RFC 3339 time") from error

    def random_id(self, name: str) -> str:
        """Return a UUIDv4 (RFC 9562) in its canonical spelling."""
        value = self.get(name)
        if isinstance(value, str) and _RANDOM_ID.fullmatch(value):
            return value
        try:
            read = UUID(value) if isinstance(value, str) else None
        except ValueError:
            read = None
        if read is None or read.version != 4 or str(read) != str(value).lower():
            raise self._bad(name, "is no UUIDv4")
        return str(read)

    def _printable(self, name: str, value: object) -> str:
        if not isinstance(value, str) or not is_label(value):
            raise self._bad(name, "is no printable text")
        return value

    def _match(self, name: str, pattern: re.Pattern[str], complaint: str) -> str:
        value = self.get(name)
        if not isinstance(value, str) or not pattern.fullmatch(value):
            raise self._bad(name, complaint)
        return value

    def _bad(self, name: str, complaint: str) -> BadDataError:
        return BadDataError(f"{self._where}: {name} {complaint}.")


def is_label(text: str) -> bool:
    """Return True if a text may be shown to people: printable, at most 1,024 characters."""
    return text.isprintable() and len(text) <= _MAX_TEXT


def fingerprints(values: list[Any], what: str) -> tuple[str, ...]:
    """Read a list of fingerprints, each once; raises BadDataError that names ``what``."""
    found = tuple(value.lower() for value in values if isinstance(value, str) and _SHA256.fullmatch(value))
    if len(found) != len(values) or len(set(found)) != len(found):
        raise BadDataError(f"{what} is no list of fingerprints, each of 64 hex digits and each once.")
    return found


def time_text(moment: datetime) -> str:
    """Return an aware time as ``2026-01-31T12:00:00Z`` (whole seconds)."""
    return moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
