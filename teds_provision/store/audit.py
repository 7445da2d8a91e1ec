"""The audit log: append-only, hash-chained, one entry per act.

Each entry's hash is SHA-256(hash of the entry before ‖ canonical JSON of this one); the first follows
SHA-256("TEDS1 audit" ‖ 00 ‖ store id). Canonical JSON: sorted keys, no spaces, ASCII. The number of entries and the
last hash are remembered beside the table, so a tail that was cut off is noticed. Triggers refuse to change or delete.

What it does not prove: whoever may write the file can recompute the whole chain. Compare ``AuditVerdict.head`` with
one noted elsewhere where that matters.
"""

from __future__ import annotations

import getpass
import hashlib
import json
import os
import socket
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from teds_provision.store.database import Database
from teds_provision.store.records import utc_now

_PAGE = 500


@dataclass(frozen=True)
class AuditEntry:
    """Who did what to which node, when, and how it ended; ``hash`` is 64 hex digits."""

    seq: int
    at: str
    who: str
    act: str
    uuid: bytes | None
    outcome: str
    detail: dict[str, Any]
    hash: str


@dataclass(frozen=True)
class AuditVerdict:
    """Whether the chain holds; ``first_bad`` numbers the first entry that does not, ``why`` says what is wrong."""

    intact: bool
    first_bad: int | None
    count: int
    head: str
    why: str = ""


class AuditLog:
    """The log of one store. An entry made inside a transaction shares its fate."""

    def __init__(self, database: Database, store_id: str) -> None:
        self._database = database
        self._root = hashlib.sha256(b"TEDS1 audit\0" + store_id.encode()).digest()

    def append(self, act: str, uuid: bytes | None, outcome: str, detail: Mapping[str, Any] | None = None) -> None:
        """Add one entry; ``detail`` holds JSON values only and never a secret. Raises StoreFailure."""
        text = _canonical(dict(detail or {}))
        with self._database.transaction():
            count, previous = self._remembered()
            row = (count + 1, utc_now(), _who(), act, uuid, outcome, text)
            head = _chained(previous, row)
            self._database.execute("INSERT INTO audit VALUES(?, ?, ?, ?, ?, ?, ?, ?)", (*row, head))
            self._remember(count + 1, head)

    def entries(self, after: int = 0) -> Iterator[AuditEntry]:
        """Give the entries numbered above ``after``, oldest first; raises StoreFailure."""
        for row in self._rows(after):
            try:
                detail = json.loads(row[6])
            except ValueError:
                detail = {"unreadable": row[6]}
            if not isinstance(detail, dict):
                detail = {"unreadable": row[6]}
            seq, at, who, act, uuid, outcome, _, digest = row
            yield AuditEntry(seq, at, who, act, uuid, outcome, detail, digest.hex())

    def check(self) -> AuditVerdict:
        """Recompute the whole chain; raises StoreFailure only where the file itself cannot be read."""
        expected, previous = 0, self._root
        for row in self._rows(0):
            expected += 1
            if row[0] != expected:
                return self._broken(expected, expected - 1, previous, f"entry {expected} is missing")
            if _chained(previous, row[:7]) != row[7]:
                return self._broken(expected, expected, previous, f"entry {expected} was changed, or the one before")
            previous = row[7]
        try:
            count, head = self._remembered()
        except ValueError:
            count, head = -1, b""
        if (count, head) != (expected, previous):
            return self._broken(expected + 1, expected, previous, "the end of the log was cut off or replaced")
        return AuditVerdict(True, None, expected, previous.hex())

    def _rows(self, after: int) -> Iterator[tuple[Any, ...]]:
        while rows := self._database.execute("SELECT * FROM audit WHERE seq > ? ORDER BY seq LIMIT ?", (after, _PAGE)):
            yield from rows
            after = rows[-1][0]

    def _remembered(self) -> tuple[int, bytes]:
        row = self._database.one("SELECT value FROM meta WHERE name = 'audit-head'")
        if row is None:
            return 0, self._root
        count, head = row[0].split(":")
        return int(count), bytes.fromhex(head)

    def _remember(self, count: int, head: bytes) -> None:
        self._database.execute("INSERT OR REPLACE INTO meta VALUES('audit-head', ?)", (f"{count}:{head.hex()}",))

    @staticmethod
    def _broken(first_bad: int, count: int, head: bytes, why: str) -> AuditVerdict:
        return AuditVerdict(False, first_bad, count, head.hex(), why)


def _chained(previous: bytes, row: tuple[Any, ...]) -> bytes:
    seq, at, who, act, uuid, outcome, detail = row
    entry = {
        "seq": seq,
        "at": at,
        "who": who,
        "act": act,
        "uuid": None if uuid is None else uuid.hex(),
        "outcome": outcome,
        "detail": detail,
    }
    return hashlib.sha256(previous + _canonical(entry).encode()).digest()


def _canonical(value: dict[str, Any]) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def _who() -> str:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # no entry in the user database, as in a container
        user = f"uid {os.getuid()}"
    return f"{user}@{socket.gethostname()}"
