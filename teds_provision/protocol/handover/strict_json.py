"""JSON and base64url as signed data needs them: one reading, or none (RFC 8259, RFC 4648, RFC 7515 section 2).

Readers that disagree about a duplicate name, a padded string or a spare bit are how signed documents get two meanings.
Everything here either reads one way or raises :class:`BadData`; nothing else comes out, whatever the octets.
"""

from __future__ import annotations

import binascii
import json
from io import BytesIO
from typing import Any

from teds_provision.errors import BadData

_TO_URL = bytes.maketrans(b"+/", b"-_")
# The two characters of plain base64 and the padding become one that no alphabet holds.
_FROM_URL = bytes.maketrans(b"-_+/=", b"+/***")
_PART = 3 << 16  # a multiple of 3, so that base64 of the parts is that of the whole
_PADDING = (b"", b"===", b"==", b"=")
_ALPHABET = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
# The last characters that leave no spare bit set, by how many characters the last group has (1 decodes to nothing).
_LAST = (frozenset(_ALPHABET), frozenset[int](), frozenset(_ALPHABET[::16]), frozenset(_ALPHABET[::4]))


def base64url(octets: bytes) -> bytes:
    """Return base64url without padding, as ASCII octets."""
    return binascii.b2a_base64(octets, newline=False).translate(_TO_URL).rstrip(b"=")


def write_base64url(into: BytesIO, octets: memoryview) -> None:
    """Write base64url of many octets a part at a time: a coder of it all at once copies the megabytes three times."""
    for start in range(0, len(octets), _PART):
        into.write(base64url(bytes(octets[start : start + _PART])))


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


def load_object(octets: bytes, what: str) -> dict[str, Any]:
    """Read one JSON object; refuses other encodings than UTF-8, duplicate names, NaN and what is nested too deeply.

    The caller has bounded the size. Raises BadData that names ``what``.
    """
    try:
        value = json.loads(octets.decode("utf-8"), object_pairs_hook=_unique, parse_constant=_refuse_constant)
    except RecursionError as error:
        raise BadData(f"{what} is nested too deeply.") from error
    except ValueError as error:
        detail = error.args[0] if isinstance(error, _DuplicateName) else "it is damaged or something else"
        raise BadData(f"{what} is not the JSON that it should be: {detail}.") from error
    if not isinstance(value, dict):
        raise BadData(f"{what} is JSON, but not an object.")
    return value


class _DuplicateName(ValueError):
    """Two members of one object have the same name."""


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) != len(pairs):
        raise _DuplicateName("an object names a member twice")
    return members


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")
