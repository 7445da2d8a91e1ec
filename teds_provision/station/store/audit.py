"""The audit log: append-only, hash-chained, one entry per act.

Each entry's hash is SHA-256(hash of the entry before ‖ canonical JSON of this one); the first follows SHA-256("TEDS1
audit" ‖ 00 ‖ store id). Canonical JSON: sorted keys, no spaces, ASCII. The number of entries and the last hash are kept
beside the table, so that a removed tail is noticed. Triggers refuse to change or delete.

It does not prove everything: a process that may write the file can recompute the whole chain. If that matters, compare
``AuditVerdict.head`` with one that is noted elsewhere.
"""

from __future__ import annotations

import getpass
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from typing import Any

from teds_provision.portable import HAS_OWNERS, name_of_machine
from teds_provision.station.store.database import Database
from teds_provision.station.store.records import utc_now
from teds_provision.station.store.row_sample import RowSample

ACTOR: ContextVar[str | None] = ContextVar("ACTOR", default=None)
"""The actor of acts done here, if it is not the user who runs this process: ``page``, ``token NAME``."""
_quoted = json.encoder.encode_basestring_ascii
_encode = json.JSONEncoder(sort_keys=True, separators=(",", ":")).encode
_NOTED = "(SELECT value FROM meta WHERE name = 'audit-head')"
_END = f"SELECT seq, hash, {_NOTED} FROM audit ORDER BY seq DESC LIMIT 1"
_PAGE_OF_ENTRIES = "SELECT * FROM audit WHERE seq > ? ORDER BY seq LIMIT ?"
_RUN_OF_ENTRIES = "SELECT * FROM audit WHERE seq BETWEEN ? AND ? ORDER BY seq"


_TOKEN = "token "


@contextmanager
def acting_for(actor: str | None) -> Iterator[None]:
    """Do the block as an act of ``actor``, in whichever thread; None: of the user who runs this process."""
    before = ACTOR.set(actor)
    try:
        yield
    finally:
        ACTOR.reset(before)


def by_token(name: str) -> str:
    """Return the value of :data:`ACTOR` for a token of the API."""
    return f"{_TOKEN}{name}"


@dataclass(frozen=True)
class AuditEntry:
    """One entry: actor, act, node, time and outcome; ``hash`` is 64 hex digits."""

    seq: int
    at: str
    who: str
    act: str
    uuid: bytes | None
    outcome: str
    detail: dict[str, Any]
    hash: str

    @property
    def actor(self) -> str:
        """The user, the name of the API's token, or ``page``."""
        return self.who.removeprefix(_TOKEN)


@dataclass(frozen=True)
class AuditFilter:
    """Criteria for entries; an entry must meet all fields that are set."""

    uuid: bytes | None = None
    act: str | None = None
    failed: bool = False
    text: str | None = None
    """Matches act, outcome, details, actor or UUID, in either case."""
    before: int | None = None
    """Only entries with a smaller number."""
    since: str | None = None
    """Only entries of this moment or later (UTC, as entries have it), wherever they are in the chain."""


FAILED = (
    "failed", "refused", "error", "unproven", "unsigned", "other key", "read-back differs", "interrupted", "skipped",
    "lost", "declined",
    "not-", "not ", "no-", "node-", "other-key", "address-conflict", "frozen", "garbled", "link", "store", "vault",
    "wrong-", "calibration-misfit", "usage", "bad-data", "bug",
    "changed", "conflict", "fork", "incomplete-installation", "missing-field",
    "newer-format", "newer-store", "office-refused", "registry", "roster-expired", "two-histories", "unclear-item",
    "downgrade", "firmware", "reverted", "uuid-known",
)  # fmt: skip
"""How the outcome of an act begins that did not do what it should: words, and the codes of the errors that end one."""


def is_failure(outcome: str) -> bool:
    """Return True if an act did not succeed."""
    return outcome.startswith(FAILED)


@dataclass(frozen=True)
class AuditVerdict:
    """Verdict on the chain; ``first_bad`` is the number of the first wrong entry, ``why`` the reason."""

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
        """Add one entry; ``detail`` holds JSON values only and never a secret. Raises StoreError."""
        text = _encode(dict(detail or {}))
        with self._database.together(), self._database.logging():
            last = self._database.first_row(_END)
            count, previous, noted = last or (0, self._root, self._noted())
            if self._read(noted) != (count, previous):  # entries are missing: continue, but record the loss permanently
                self._database.execute("INSERT OR IGNORE INTO meta VALUES('audit-lost', ?)", (str(count + 1),))
            row = (count + 1, utc_now(), ACTOR.get() or _who(), act, uuid, outcome, text)
            head = _chained(previous, row)
            self._database.add("INSERT INTO audit VALUES(?, ?, ?, ?, ?, ?, ?, ?)", (*row, head))
            self._remember(count + 1, head)

    def entries(self, after: int = 0) -> Iterator[AuditEntry]:
        """Give the entries numbered above ``after``, oldest first; raises StoreError."""
        return self._database.stream(_entry, _PAGE_OF_ENTRIES, after)

    def chosen(self, choice: AuditFilter, after: int = 0) -> Iterator[AuditEntry]:
        """Give the entries numbered above ``after`` that are meant, oldest first; raises StoreError."""
        terms = _terms(choice)
        statement = f"SELECT * FROM audit WHERE seq > ?{terms} ORDER BY seq LIMIT ?"
        return self._database.stream(_entry, statement, after)

    def latest(self) -> str | None:
        """Return the time of the newest entry of the chain, None for an empty log.

        A clock that once was ahead and has been corrected since leaves later times in the middle of the chain.
        """
        row = self._database.first_row("SELECT at FROM audit ORDER BY seq DESC LIMIT 1")
        return str(row[0]) if row is not None else None

    def newest(self) -> tuple[int, str]:
        """Return number and hash (64 digits) of the newest entry; (0, the root) for an empty log."""
        row = self._database.first_row("SELECT seq, hash FROM audit ORDER BY seq DESC LIMIT 1")
        return (int(row[0]), bytes(row[1]).hex()) if row is not None else (0, self._root.hex())

    def entry_before(self, choice: AuditFilter, *, last: int | None = None) -> int:
        """Return the number of the entry before the first one to show: of the ``last`` chosen, or made ``since``.

        With ``last`` the search starts at the end. A time does not determine the position, as clocks are set back, so
        ``since`` without ``last`` reads entries from the beginning (0.1 s for a million).
        """
        if last is not None:
            statement = f"SELECT seq FROM audit WHERE seq > 0{_terms(choice)} ORDER BY seq DESC LIMIT ?"
            rows = self._database.execute(statement, (last,))
            first = rows[-1] if rows else None
        elif choice.since is not None:
            first = self._database.first_row(
                "SELECT seq FROM audit WHERE at >= ? ORDER BY seq LIMIT 1", (choice.since,)
            )
        else:
            return 0
        if first is not None:
            return int(first[0]) - 1
        end = self._database.first_row("SELECT coalesce(max(seq), 0) FROM audit")
        return int(end[0]) if end is not None else 0

    def check(self, after: int = 0) -> AuditVerdict:
        """Recompute the chain from entry ``after`` on (0: the whole of it); raises StoreError for an unreadable file.

        From the middle on it proves only that the rest is unchanged relative to the entry before.
        """
        expected, previous = after, self._root
        if after:
            row = self._database.first_row("SELECT hash FROM audit WHERE seq = ?", (after,))
            if row is None:
                return self._broken(after, after - 1, self._root, f"entry {after} is missing")
            previous = bytes(row[0])
        for seq, good, digest in self._database.stream(_linked, _PAGE_OF_ENTRIES, after):
            expected += 1
            if seq != expected:
                return self._broken(expected, expected - 1, previous, f"entry {expected} is missing")
            if good(previous) != digest:
                return self._broken(expected, expected, previous, f"entry {expected} was changed, or the one before")
            previous = digest
        lost = self._database.first_row("SELECT value FROM meta WHERE name = 'audit-lost'")
        if lost is not None:
            first = int(lost[0]) if str(lost[0]).isdecimal() else 1
            return self._broken(first, expected, previous, f"the log once ended before entry {first} and was cut there")
        if self._remembered() != (expected, previous):
            return self._broken(expected + 1, expected, previous, "the end of the log was cut off or replaced")
        return AuditVerdict(True, None, expected, previous.hex())

    def spot_check(self, sample: RowSample) -> AuditVerdict:
        """Recompute the hashes of the entries in ``sample``, each from the entry before, and compare count and end.

        The whole log is checked if anything is wrong, so the verdict on a broken chain is that of :meth:`check`.
        """
        count, head = self.newest()
        counted = self._database.first_row("SELECT count(*) FROM audit")
        whole = counted == (count,) and self._remembered() == (count, bytes.fromhex(head))
        if whole and all(self._run_holds(*run) for run in sample.runs(count)):
            lost = self._database.first_row("SELECT value FROM meta WHERE name = 'audit-lost'")
            if lost is None:
                return AuditVerdict(True, None, count, head)
        return self.check()

    def _run_holds(self, first: int, last: int) -> bool:
        """Return True if the entries of these numbers are there and each hash follows from the one before."""
        rows = self._database.read(_linked, _RUN_OF_ENTRIES, (first, last))
        before = self._database.first_row("SELECT hash FROM audit WHERE seq = ?", (first - 1,))
        previous = self._root if before is None else before[0]
        for seq, (number, good, digest) in zip(range(first, last + 1), rows, strict=False):
            if number != seq or good(previous) != digest:
                return False
            previous = digest
        return len(rows) == last - first + 1

    def _remembered(self) -> tuple[int, bytes] | None:
        """Return the number of entries and the last hash, None if that note is damaged."""
        return self._read(self._noted())

    def _noted(self) -> object:
        row = self._database.first_row(f"SELECT {_NOTED}")
        return None if row is None else row[0]

    def _read(self, noted: object) -> tuple[int, bytes] | None:
        if noted is None:
            return 0, self._root
        count, _, head = str(noted).partition(":")
        try:
            return int(count), bytes.fromhex(head)
        except ValueError:
            return None

    def _remember(self, count: int, head: bytes) -> None:
        self._database.execute("INSERT OR REPLACE INTO meta VALUES('audit-head', ?)", (f"{count}:{head.hex()}",))

    @staticmethod
    def _broken(first_bad: int, count: int, head: bytes, why: str) -> AuditVerdict:
        return AuditVerdict(False, first_bad, count, head.hex(), why)


def _entry(
    seq: int, at: str, who: str, act: str, uuid: bytes | None, outcome: str, text: str, digest: bytes
) -> AuditEntry:
    try:
        detail = json.loads(text)
    except ValueError:
        detail = None
    if not isinstance(detail, dict):
        detail = {"unreadable": text}
    return AuditEntry(seq, at, who, act, uuid, outcome, detail, digest.hex())


def _linked(*row: Any) -> tuple[int, Callable[[bytes], bytes], bytes]:
    """Return number, the hash as a function of the one before, and the stored hash."""
    texts, uuid, digest = (row[1], row[2], row[3], row[5], row[6]), row[4], row[7]
    if (
        not all(isinstance(text, str) for text in texts)
        or not isinstance(uuid, bytes | None)
        or type(digest) is not bytes
    ):
        raise TypeError
    return row[0], lambda previous: _chained(previous, row[:7]), row[7]


def _chained(previous: bytes, row: tuple[Any, ...]) -> bytes:
    """Return the hash of an entry. Its canonical JSON is put together by hand: a log has a million entries."""
    seq, at, who, act, uuid, outcome, detail = row
    node = "null" if uuid is None else f'"{uuid.hex()}"'
    text = (
        f'{{"act":{_quoted(act)},"at":{_quoted(at)},"detail":{_quoted(detail)},"outcome":{_quoted(outcome)},'
        f'"seq":{seq},"uuid":{node},"who":{_quoted(who)}}}'
    )
    return hashlib.sha256(previous + text.encode()).digest()


def _terms(choice: AuditFilter) -> str:
    """Return the SQL of a choice. Its values were written by this program, or are UUID digits, or are quoted here."""
    terms = ""
    if choice.uuid is not None:
        terms += f" AND uuid = x'{choice.uuid.hex()}'"
    if choice.act is not None:
        terms += " AND act = '" + choice.act.replace("'", "''").replace("\0", "") + "'"
    if choice.text:
        part = _like(choice.text)
        columns = ("act", "outcome", "detail", "who", "lower(hex(uuid))")
        terms += " AND (" + " OR ".join(f"{column} LIKE {part} ESCAPE '!'" for column in columns) + ")"
    if choice.since is not None:
        terms += " AND at >= '" + choice.since.replace("'", "''").replace("\0", "") + "'"
    if choice.before is not None:
        terms += f" AND seq < {int(choice.before)}"
    if choice.failed:
        terms += " AND (" + " OR ".join(f"outcome GLOB '{word}*'" for word in FAILED) + ")"
    return terms


def _like(text: str) -> str:
    """Return a text as a quoted pattern of SQL. Details are kept as canonical JSON, in ASCII."""
    plain = _quoted(text)[1:-1]
    for sign in "!%_":
        plain = plain.replace(sign, f"!{sign}")
    return "'%" + plain.replace("'", "''").replace("\0", "") + "%'"


@cache
def _who() -> str:
    """Return the user and the host of this process; neither changes while it runs."""
    try:
        user = getpass.getuser()
    # the user has no entry in the user database, as in a container, or the system has none
    except (KeyError, OSError, ImportError):
        user = f"uid {os.getuid()}" if HAS_OWNERS else "unknown"
    return f"{user}@{name_of_machine()}"
