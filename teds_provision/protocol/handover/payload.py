"""Reading the members of a signed payload: each with its type, its range and its own complaint.

The payloads are those of profile.md, "Handover between base stations".

Members that are not known are passed over: the signature covers them, and a later format may add some. Members that
are known are read strictly. Text for people must be printable, so that a name cannot steer a terminal.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any
from uuid import UUID

from teds_provision.errors import BadData

LAST_U32 = 0xFFFFFFFF
_MAX_TEXT = 1024
_UUID = re.compile(r"[0-9A-Fa-f]{20}")
_SHA256 = re.compile(r"[0-9A-Fa-f]{64}")
# RFC 3339 section 5.6.
_TIME = re.compile(r"\d{4}-\d\d-\d\d[Tt]\d\d:\d\d:\d\d(\.\d{1,6})?([Zz]|[+-]\d\d:\d\d)")


class Members:
    """The members of one JSON object; ``where`` opens every complaint."""

    def __init__(self, members: object, where: str) -> None:
        if not isinstance(members, dict):
            raise BadData(f"{where} is not an object.")
        self._members: Mapping[str, Any] = members
        self._where = where

    def get(self, name: str) -> Any:
        """Return a member as it is, None where it is absent or null."""
        return self._members.get(name)

    def text(self, name: str) -> str:
        """Return a text for people: printable, at most 1,024 characters."""
        return self._printable(name, self.get(name))

    def texts(self, name: str) -> tuple[str, ...]:
        """Return a list of such texts, empty where it is absent or null."""
        return tuple(self._printable(name, value) for value in self.list_of(name, required=False))

    def text_or_none(self, name: str) -> str | None:
        """Like :meth:`text`; None where it is absent or null."""
        value = self._members.get(name)
        return None if value is None else self._printable(name, value)

    def list_of(self, name: str, *, required: bool = True) -> list[Any]:
        """Return a list; an empty one where an optional one is absent or null."""
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
        """Like :meth:`sha256`; None where it is absent or null."""
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

    def _bad(self, name: str, complaint: str) -> BadData:
        return BadData(f"{self._where}: {name} {complaint}.")


def is_label(text: str) -> bool:
    """Whether a text may stand where people read it: printable, at most 1,024 characters."""
    return text.isprintable() and len(text) <= _MAX_TEXT


def fingerprints(values: list[Any], what: str) -> tuple[str, ...]:
    """Read a list of fingerprints, each once; raises BadData that names ``what``."""
    found = tuple(value.lower() for value in values if isinstance(value, str) and _SHA256.fullmatch(value))
    if len(found) != len(values) or len(set(found)) != len(found):
        raise BadData(f"{what} is no list of fingerprints, each of 64 hex digits and each once.")
    return found


def time_text(moment: datetime) -> str:
    """Return an aware time as ``2026-01-31T12:00:00Z`` (whole seconds)."""
    return moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
