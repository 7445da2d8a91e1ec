"""JSON and base64url as signed data needs them: one reading, or none (RFC 8259, RFC 4648, RFC 7515 section 2).

Readers that disagree about a duplicate name, a padded string or a spare bit are how signed documents get two meanings.
Everything here either reads one way or raises :class:`BadData`; nothing else comes out, whatever the octets.
"""

from __future__ import annotations

import binascii
import codecs
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from typing import Any

from teds_provision.errors import BadData

_TO_URL = bytes.maketrans(b"+/", b"-_")
# The two characters of plain base64 and the padding become one that no alphabet holds.
_FROM_URL = bytes.maketrans(b"-_+/=", b"+/***")
_PART = 3 << 16  # a multiple of 3, so that base64 of the parts is that of the whole
_PADDING = (b"", b"===", b"==", b"=")
_ALPHABET = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
_TWICE = "an object names a member twice"
_BYTE_ORDER_MARK = "a byte order mark is no JSON"
_WINDOW = 64 * 1024
_NUMBER_GOES_ON = 2  # "1e+" reads as 1, and with a digit more as another number
_WHITE = " \t\n\r"
# The last characters that leave no spare bit set, by how many characters the last group has (1 decodes to nothing).
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
        """Return the octets of all whole groups of four characters so far; raises BadData."""
        text = self._rest + text
        whole = len(text) - len(text) % 4
        self._rest = text[whole:]
        return decode_base64url(text[:whole], self._what)

    def end(self) -> bytes:
        """Return the last octets; raises BadData."""
        return decode_base64url(self._rest, self._what)


def encode_base64url(octets: bytes) -> str:
    """Return base64url without padding, as text."""
    return base64url(octets).decode("ascii")


def decode_base64url(text: object, what: str) -> bytes:
    """Read base64url (text or ASCII octets) without padding, spare bits zero; raises BadData that names ``what``."""
    try:
        if isinstance(text, str):
            octets = text.encode("ascii").translate(_FROM_URL)
        elif isinstance(text, bytes):
            octets = text.translate(_FROM_URL)
        else:
            raise BadData(f"{what} is not a base64url string.")
        plain = binascii.a2b_base64(octets + _PADDING[len(octets) % 4], strict_mode=True)
    except ValueError as error:
        raise BadData(f"{what} is not base64url without padding.") from error
    if octets and octets[-1] not in _LAST[len(octets) % 4]:
        raise BadData(f"{what} has spare bits set in its last base64url character.")
    return plain


def dump(value: object) -> bytes:
    """Return compact JSON, in ASCII."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode("ascii")


def separators(octets: bytes) -> int:
    """Count what begins or parts values in JSON."""
    return sum(octets.count(separator) for separator in (b",", b"[", b"{"))


def refuse_many(count: int, most: int, what: str) -> None:
    """Raise BadData where a JSON text has more separators than ``what`` ever has: it would cost far more than it is."""
    if count > most:
        raise BadData(f"This JSON has far more members than {what}.")


def load_object(octets: bytes, what: str) -> dict[str, Any]:
    """Read one JSON object; refuses other encodings than UTF-8, duplicate names, NaN and what is nested too deeply.

    The caller has bounded the size. Raises BadData that names ``what``.
    """
    with _told(what):
        value = _DECODER.decode(_decoded(octets))
    if not isinstance(value, dict):
        raise BadData(f"{what} is JSON, but not an object.")
    return value


def load_long(octets: bytearray, what: str, name: str, make: Callable[[object], object]) -> dict[str, Any]:
    """:func:`load_object` of an object whose member ``name`` is a long list: each element is passed through ``make``.

    So neither the text nor the elements are ever all there beside what is made of them. ``octets`` is emptied as it is
    read. Whatever ``make`` raises comes out as it is.
    """
    with _told(what):
        walk = _Walk(octets)
        if walk.next() == "{":
            return walk.members(name, make)
        _DECODER.decode(walk.rest())
    raise BadData(f"{what} is JSON, but not an object.")


@contextmanager
def _told(what: str) -> Iterator[None]:
    """Say what is wrong with a JSON text."""
    try:
        yield
    except RecursionError as error:
        raise BadData(f"{what} is nested too deeply.") from error
    except ValueError as error:
        detail = error.args[0] if isinstance(error, _DuplicateName) else "it is damaged or something else"
        raise BadData(f"{what} is not the JSON that it should be: {detail}.") from error


def _decoded(octets: bytes | bytearray) -> str:
    text = octets.decode("utf-8")
    if text.startswith("\ufeff"):
        raise ValueError(_BYTE_ORDER_MARK)
    return text


class _Walk:
    """Reads the outermost object of a JSON text member by member (RFC 8259 sections 2, 4 and 5).

    A window of the text is decoded at a time, and longer where a value does not end in it.
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
                raise _DuplicateName(_TWICE)
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
        """Read a value; one that ends where the window does may go on behind it."""
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
        """Decode as many octets more and let go of the text that was read; False where there are none."""
        if not self._octets:
            return False
        piece = self._octets[:count]
        del self._octets[:count]
        self._text = self._text[self._at :] + self._decoder.decode(piece, final=not self._octets)
        self._at = 0
        return True


class _DuplicateName(ValueError):
    """Two members of one object have the same name."""


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) != len(pairs):
        raise _DuplicateName(_TWICE)
    return members


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")


_DECODER = json.JSONDecoder(object_pairs_hook=_unique, parse_constant=_refuse_constant)
