"""Copies of a whole store: held against a living one, put in the place of a lost one."""

from __future__ import annotations

import time
from contextlib import closing, suppress
from enum import Enum
from pathlib import Path
from typing import Final

from teds_provision.errors import StoreError
from teds_provision.files import whole_draft
from teds_provision.station.station import Station
from teds_provision.station.store.connection import as_store_failure
from teds_provision.station.store.sqlite import FILE_NAME, sqlite3

_COUNTED: Final = ("whitelist", "nodes", "keys", "trust")
# SQLITE_CORRUPT, SQLITE_NOTADB (sqlite.org, rescode); written out, so that --help need not load sqlite3
_DAMAGE: Final = (11, 26)


class Relation(Enum):
    """Relation of a copy to the store that it is compared with, by their audit logs."""

    SAME = "the same state"
    OLDER = "an older state"
    NEWER = "a newer state"
    DIVERGED = "a state that went another way"


def place(copy: Station, home: Path) -> None:
    """Make a copy the store of a home that has none: the whole file, or none. The caller holds the StoreLock.

    Raises StoreError: a store is there already, or it cannot be written.
    """
    path = home / FILE_NAME
    if path.exists():
        raise StoreError(f"There is a store in {home} already.", hint="Restore into another --home.")
    try:
        with whole_draft(path, replace=False) as (draft, _):
            store = copy._store
            with closing(sqlite3.connect(draft)) as target, store._lock, store._translated():
                target.execute("PRAGMA journal_mode=OFF")  # needs no rollback: a failed draft is deleted
                store._connection.backup(target)
            for left in ("-wal", "-shm"):  # files of a former store, which SQLite would replay into this one
                path.with_name(FILE_NAME + left).unlink(missing_ok=True)
    except (OSError, sqlite3.Error) as error:
        raise as_store_failure(error, path) from error


def totals(station: Station) -> dict[str, int]:
    """Count whitelist, nodes, keys and trusted keys of a station's store."""
    count = station._store.first_row
    return {table: int((count(f"SELECT count(*) FROM {table}") or (0,))[0]) for table in _COUNTED}


def set_aside(home: Path) -> Path:
    """Give a damaged store another name, with its log, and return it. Raises StoreError."""
    path = home / FILE_NAME
    name = f"{FILE_NAME}.damaged-{time.strftime('%Y%m%dT%H%M%S', time.gmtime())}"
    try:
        for end in ("-wal", "-shm", ""):  # the store last: until it is renamed, the same command can be repeated
            with suppress(FileNotFoundError):
                path.with_name(FILE_NAME + end).rename(path.with_name(name + end))
    except OSError as error:
        raise as_store_failure(error, path) from error
    return path.with_name(name)


def is_damage(failure: StoreError) -> bool:
    """Return True if a store could not be used because its file is damaged (and not locked, newer or unreadable)."""
    cause = failure.__cause__
    return isinstance(cause, sqlite3.Error) and getattr(cause, "sqlite_errorcode", 0) & 0xFF in _DAMAGE


def relation(copy: Station, live: Station) -> Relation:
    """Compare the audit logs of a copy and of a store: the one that continues the other is the newer."""
    ours, theirs = live.audit_log.check(), copy.audit_log.check()
    if (ours.count, ours.head) == (theirs.count, theirs.head):
        return Relation.SAME
    if _hash_at(live, theirs.count) == theirs.head:
        return Relation.OLDER
    if _hash_at(copy, ours.count) == ours.head:
        return Relation.NEWER
    return Relation.DIVERGED


def extend_audit(live: Station, copy: Station) -> int:
    """Append the entries that only a newer copy's audit log has; return their number. Call it inside a transaction."""
    store, after = live._store, live.audit_log.check().count
    rows = copy._store.execute("SELECT * FROM audit WHERE seq > ? ORDER BY seq", (after,))
    for row in rows:
        store.execute("INSERT INTO audit VALUES(?, ?, ?, ?, ?, ?, ?, ?)", row)
    if rows:
        live.audit_log._remember(int(rows[-1][0]), bytes(rows[-1][-1]))
    return len(rows)


def _hash_at(station: Station, seq: int) -> str:
    if seq == 0:
        return station.audit_log._root.hex()
    entry = next(station.audit_log.entries(seq - 1), None)
    return entry.hash if entry is not None and entry.seq == seq else ""
