"""The content of an opened backup."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from types import TracebackType
from typing import Any, Final

from teds_provision import __version__
from teds_provision.errors import BadDataError, NotAuthenticError, VaultError
from teds_provision.protocol.handover.strict_json import dump, load_object
from teds_provision.protocol.keys import fingerprint, is_point
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeyRecord
from teds_provision.vault.base import Vault, node_key_context

MAX_HEAD_OCTETS: Final = 64 * 1024
_TEXTS: Final = ("store", "station", "point", "name", "created", "keystore", "material")


def digest_of(document: dict[str, Any]) -> str:
    """Return the ``sha256`` member of a file's clear part: a digest over all other members."""
    return hashlib.sha256(dump(document)).hexdigest()


def check_digest(document: dict[str, Any]) -> None:
    """Raise NotAuthenticError if a file's ``sha256`` does not match, to distinguish damage from a wrong key."""
    rest = {name: value for name, value in document.items() if name != "sha256"}
    if document.get("sha256") != digest_of(rest):
        raise NotAuthenticError(
            "The backup was damaged or changed: its digest does not match.", hint="Use another copy."
        )


def context_of(clear: dict[str, Any], form: str) -> bytes:
    """Return the context to which the sealed part of a file is bound: the format and the clear part."""
    return form.encode() + b"\0" + dump(clear)


@dataclass(frozen=True)
class BackupHead:
    """The owner of a backup: store id, station's point (65 octets), name, time, keystore (its kind, as it was called).

    ``material`` is all that the vault keeps secret; for a token, only what it has sealed.
    """

    store: str
    point: bytes
    name: str
    created: str
    keystore: str
    material: str = field(repr=False)

    @property
    def station(self) -> str:
        """Fingerprint of the station."""
        return fingerprint(self.point)

    @property
    def in_token(self) -> bool:
        """True if the station's key is in a token."""
        return self.keystore.startswith("pkcs11")

    def line(self, form: str) -> bytes:
        """Return the head as a line of JSON, for a file of that format (``teds-backup/2``)."""
        texts = {name: getattr(self, name) for name in _TEXTS}
        return dump({"format": form, **texts, "point": self.point.hex(), "version": __version__}) + b"\n"

    @staticmethod
    def read(line: bytes, form: str) -> BackupHead:
        """Parse the head from a line; raises BadDataError: another format, a missing text, no point of P-256."""
        members = load_object(line, "The head of the backup")
        if members.get("format") != form or not all(isinstance(members.get(name), str) for name in _TEXTS):
            raise BadDataError("The header of the backup is from another version.")
        try:
            point = bytes.fromhex(members["point"])
        except ValueError:
            point = b""
        if not is_point(point):
            raise BadDataError("The backup names no valid station key.")
        values = (members[name] for name in ("name", "created", "keystore", "material"))
        return BackupHead(members["store"], point, *values)

    def age_days(self, now: datetime | None = None) -> int:
        """Return the backup's age in whole days; negative for a time in the future, 0 if the time cannot be parsed."""
        try:
            made = datetime.fromisoformat(self.created)
        except ValueError:
            return 0
        made = made if made.tzinfo is not None else made.replace(tzinfo=UTC)
        return ((now or datetime.now(UTC)) - made).days


@dataclass(frozen=True)
class Content(BackupHead):
    """An opened backup: its head, and its store as a private copy that lives until :meth:`close`."""

    copy: Station = field(repr=False, kw_only=True)

    def unopened(self, vault: Vault) -> Iterator[KeyRecord]:
        """Yield the keys that ``vault`` cannot open."""
        for record in self.copy.keys.all():
            context = node_key_context(self.copy.id, record.uuid, record.epoch, record.slot)
            try:
                vault.unwrap(record.wrapped, context=context)
            except VaultError:
                yield record

    def close(self) -> None:
        """Let the copy go."""
        self.copy.close()

    def __enter__(self) -> Content:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
