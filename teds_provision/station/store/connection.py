"""Statements and transactions on one connection to SQLite: waits, rollbacks, and translated errors.

``synchronous=FULL``: a commit that returned has reached the disk, unless it was allowed to come later, and a process
killed at any instant leaves the last commit.
"""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, TypeVar

from teds_provision.errors import BadDataError, NewerStoreError, StoreError, StoreLockedError, TedsProvisionError
from teds_provision.portable import CLOSING, NOFOLLOW, sync_content
from teds_provision.station.store.background_writer import BackgroundWriter
from teds_provision.station.store.schema import SCHEMA_VERSION
from teds_provision.station.store.sqlite import sqlite3

# Translates errors of SQLite and of the system into messages with cause and remedy.

BUSY_SECONDS = 10.0
_RESTORE = "Restore a backup (teds-provision restore), or move the file away and run teds-provision init."

_FULL = ("there is no space left on the disk", "Free some space and run the same command again; nothing is lost.")
_READ_ONLY = (
    "it cannot be written",
    "Check the owner and mode of the home directory and whether the disk is read-only.",
)
# SQLite's primary result codes (sqlite.org, rescode); written out, so that --help need not load sqlite3.
_SQLITE_FULL, _SQLITE_READONLY, _SQLITE_PERM, _SQLITE_CANTOPEN = 13, 8, 3, 14
_SQLITE_IOERR, _SQLITE_CORRUPT, _SQLITE_NOTADB, _SQLITE_CONSTRAINT = 10, 11, 26, 19
_CAUSES: dict[int, tuple[str, str]] = {
    _SQLITE_FULL: _FULL,
    _SQLITE_READONLY: _READ_ONLY,
    _SQLITE_PERM: _READ_ONLY,
    _SQLITE_CANTOPEN: ("it cannot be opened", _READ_ONLY[1]),
    _SQLITE_IOERR: (
        "the disk failed or is full",
        "Check the disk (space, quota, kernel log), then run the same command again.",
    ),
    _SQLITE_CORRUPT: ("it is damaged", _RESTORE),
    _SQLITE_NOTADB: ("it is damaged or no store of this tool", _RESTORE),
    _SQLITE_CONSTRAINT: ("the entry breaks a rule of the store", "Nothing was changed; please report this."),
}
_OS_CAUSES: dict[int, tuple[str, str]] = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EROFS: _READ_ONLY,
    errno.EACCES: _READ_ONLY,
    errno.EPERM: _READ_ONLY,
}


def as_store_failure(error: sqlite3.Error | OSError, path: Path) -> StoreError:
    """Translate an error of SQLite or the system: cause and remedy, no octet of the contents."""
    if isinstance(error, OSError):
        cause, cure = _OS_CAUSES.get(error.errno or 0, (error.strerror or type(error).__name__, "Check that path."))
        return StoreError(f"The store {path} cannot be used: {cause}.", hint=cure)
    primary = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if primary in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        return StoreLockedError(
            f"The store {path} was kept busy by another process for {BUSY_SECONDS:.0f} s.",
            hint="Wait until the other command has ended, then run this one again.",
        )
    cause, cure = _CAUSES.get(primary, (f"SQLite says: {error}", "Run teds-provision doctor."))
    return StoreError(f"The store {path} cannot be used: {cause}.", hint=cure)


def newer_schema(path: Path, version: int) -> NewerStoreError:
    """Return the error for a store of a schema that this version of the tool does not know."""
    return NewerStoreError(
        f"The store {path} has schema {version}; this version of the tool knows up to {SCHEMA_VERSION}.",
        hint="Use the newer version of teds-provision that made it.",
    )


def damaged(path: Path) -> StoreError:
    """Return the error for a file with content that this tool never wrote."""
    cause, cure = _CAUSES[_SQLITE_CORRUPT]
    return StoreError(f"The store {path} cannot be used: {cause}.", hint=cure)


def is_no_place_to_write(failure: StoreError) -> bool:
    """Return True if a store could not be opened because its place cannot be written to."""
    cause = failure.__cause__
    if isinstance(cause, OSError):
        return cause.errno in _OS_CAUSES
    refused = (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_FULL)
    return isinstance(cause, sqlite3.Error) and getattr(cause, "sqlite_errorcode", 0) & 0xFF in refused


def too_old(what: str, version: int) -> StoreError:
    """Return the error for a store, or the store in a backup (``what``), of a schema before KeyAgreement 2."""
    return StoreError(
        f"{what} is of schema {version}, from before KeyAgreement 2, which nodes no longer support.",
        hint="That version was never released. Choose another --home, run init there, and provision the nodes again.",
    )


QUIET_SECONDS: Final = 0.3
"""Seconds that SQLite waits silently for another process; then there is a notice, and another try."""
SYNC_ON_COMMIT: Final = "synchronous=FULL"
_Given = TypeVar("_Given")


class Connection:
    """Statements and re-entrant transactions. Safe to share between threads."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection
        self._cursor = connection.cursor()
        """Of every statement whose rows are fetched at once, under the lock.

        The connection keeps each new cursor in a list that it tidies every 200: whichever thread makes the list longer
        is left with its former memory, so hundreds of threads would grow for hours.
        """
        self._lock = threading.RLock()
        self._depth = 0
        self._steady: int | None = None
        self._reader: int | None = None
        self._taken_back = 0
        self._logged = 0
        self._added = False
        self._spoilt = False
        self.commits_not_waited_for = 0
        """How many commits did not wait for the disk."""
        self._settled = 0
        self.background: dict[int, BackgroundWriter] = {}
        """By thread: the run that has a step taken in the background, for which its next statement waits."""
        self.notice: Callable[[str], object] | None = None
        """Receives a sentence about what a change of the store waits for."""
        self._frozen: StoreError | None = None
        """Why nothing can be written; what is read then comes from a private copy."""

    def execute(self, statement: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Run one statement and return all its rows; raises StoreError."""
        if self.background:
            self.drain()
        with self._lock:
            try:  # without _run(), because each step executes dozens of statements
                return self._cursor.execute(statement, values).fetchall()
            except (sqlite3.Error, OSError, UnicodeError) as error:
                if not self._is_to_wait(error):
                    raise self._failure(error) from error
            return self._wait_for(lambda: self._cursor.execute(statement, values).fetchall())

    def drain(self) -> None:
        """Wait until what this thread has had taken in the background is done; raises what that raised."""
        steps = self.background.get(threading.get_ident())
        if steps is not None:
            steps.wait()

    def add(self, statement: str, values: Sequence[Any] = ()) -> None:
        """Run an INSERT of one new row: the transaction around it is sure to write to the disk; raises StoreError."""
        self.execute(statement, values)
        self._added = True

    def change(self, statement: str, values: Sequence[Any] = ()) -> int:
        """Run one statement and return how many rows it changed; raises StoreError."""
        return self._run(lambda: self._cursor.execute(statement, values).rowcount)

    def execute_many(self, statement: str, rows: Iterable[Sequence[Any]]) -> None:
        """Run one statement with each row of values, all or none; raises StoreError."""
        with self.together(), self._translated():
            self._connection.executemany(statement, rows)

    def _run(self, run: Callable[[], _Given]) -> _Given:
        if self.background:
            self.drain()
        with self._lock:
            try:
                return run()
            except (sqlite3.Error, OSError, UnicodeError) as error:
                if not self._is_to_wait(error):
                    raise self._failure(error) from error
            return self._wait_for(run)

    def _wait_for(self, run: Callable[[], _Given]) -> _Given:
        """Try again until it works; report what it waits for and until when."""
        until = time.monotonic() + BUSY_SECONDS
        if self.notice is not None:
            self.notice(f"Waiting up to {BUSY_SECONDS:.0f} s for another process that is writing to the store.")
        while True:
            try:
                return run()
            except (sqlite3.Error, OSError, UnicodeError) as error:
                if not self._is_to_wait(error) or time.monotonic() >= until:
                    raise self._failure(error) from error

    def _is_to_wait(self, error: Exception) -> bool:
        """Return True if another process holds the file; inside a transaction that is impossible."""
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        return not self._depth and code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)

    def version(self) -> int:
        """Return a number that changes when another connection has changed the file."""
        return int(self.execute("PRAGMA data_version")[0][0])

    def require_known_schema(self) -> None:
        """Raise NewerStoreError if a newer version of this tool has brought the store to its schema meanwhile."""
        with self._lock:
            version = self._cursor.execute("PRAGMA user_version").fetchall()[0][0]
        if version > SCHEMA_VERSION:
            raise newer_schema(self.path, version)

    def changes(self) -> tuple[int, int]:
        """Return what differs after any change of the file, by this connection or another one.

        This connection's own entries of the audit log do not count: they record what was done, and decide nothing.
        """
        return self.version(), self._connection.total_changes - self._logged

    @contextmanager
    def logging(self) -> Iterator[None]:
        """Leave what the block changes, in a transaction, out of :meth:`changes`."""
        before = self._connection.total_changes
        try:
            yield
        finally:
            self._logged += self._connection.total_changes - before

    def state(self) -> tuple[int, int]:
        """Return what changes when another connection has changed the file, or this one took changes back.

        Equal ones, and no change of one's own between them: what was read is still so.
        """
        with self._lock:
            held = self._depth or self._reader == threading.get_ident()
            if self._steady is None or not held:  # within our own transaction, no other connection can change it
                self._steady = self.version()
            return self._steady, self._taken_back

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Keep rows that were read before, and not changed by this process, valid for the block, in this thread.

        For many reads at one moment, with no waiting in between: changes by another process are checked for once.
        Changes inside the block are made, and seen, as usual.
        """
        self.drain()
        with self._lock:
            mine = self._reader is None
            if mine:
                self._reader, self._steady = threading.get_ident(), None
        try:
            yield
        finally:
            if mine:
                self._reader = None

    def transaction(self, *, later: bool = False) -> AbstractContextManager[None]:
        """Run the block as a transaction: BEGIN IMMEDIATE, COMMIT or, on an error, ROLLBACK; in another, a savepoint.

        It is on the disk when the block ends; ``later``: when a later one is, or after :meth:`flush`. A loss of power
        until then undoes it whole, and never without those that came after it.
        """
        return Transaction(self, later=later)

    def together(self) -> AbstractContextManager[None]:
        """Run all or nothing, as :meth:`transaction`; inside another one, join it without a savepoint.

        A failure after a write rolls back the outer transaction: if that error is caught and the rest goes on, the end
        undoes everything and raises StoreError.
        """
        return Transaction(self, apart=False)

    def flush(self, through: int | None = None) -> None:
        """Wait until all commits, or the first ``through`` of those that did not wait, are on the disk.

        Raises StoreError.
        """
        self.drain()
        with self._lock:
            if (self.commits_not_waited_for if through is None else through) <= self._settled:
                return
            try:
                log = os.open(self.path.with_name(self.path.name + "-wal"), os.O_RDWR | NOFOLLOW | CLOSING)
                try:
                    sync_content(log)  # fsync on any descriptor writes the whole file
                finally:
                    os.close(log)
            except OSError as error:
                raise as_store_failure(error, self.path) from error
            self._settled = self.commits_not_waited_for

    def enter(self, block: Transaction) -> None:
        """Begin a block; for :class:`Transaction` alone."""
        if self.background:
            self.drain()
        self._lock.acquire()
        try:
            if self._frozen is not None:
                raise self._frozen
            block.level, block.spoilt = self._depth, self._spoilt
            if block.level == 0:
                self._begin(block.later)
            elif block.apart:
                self.execute(f"SAVEPOINT s{block.level}")
            else:
                block.changes = self._connection.total_changes
            self._depth += 1
        except BaseException:
            self._lock.release()
            raise

    def _begin(self, later: bool) -> None:
        if later:  # commits are written in order, but without waiting for the disk
            self.execute("PRAGMA synchronous=NORMAL")
        try:
            self.execute("BEGIN IMMEDIATE")
            self.require_known_schema()
        except BaseException:  # also after an interrupt between BEGIN and the caller's block
            with suppress(sqlite3.Error):
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
            if later:
                self.execute(f"PRAGMA {SYNC_ON_COMMIT}")
            raise
        self._steady, self._added = None, False

    def leave(self, block: Transaction, *, failed: bool) -> None:
        """End a block; for :class:`Transaction` alone. Raises StoreError if it cannot be kept."""
        try:
            if failed:
                self._undo(block)
            else:
                try:
                    self._conclude(block)
                except BaseException:
                    self._undo(block)
                    raise
        finally:
            self._depth = block.level
            self._steady = self._steady if block.level else None
            try:
                if block.later and block.level == 0:
                    self.commits_not_waited_for += 1
                    self.execute(f"PRAGMA {SYNC_ON_COMMIT}")
            finally:
                self._lock.release()

    def _conclude(self, block: Transaction) -> None:
        """Run COMMIT; with SYNC_ON_COMMIT it is on the disk when this returns."""
        if self._spoilt and not block.spoilt and (block.apart or block.level == 0):
            raise StoreError("Part of this change failed, so all of it was undone.", hint="Run it again.")
        if block.level == 0:
            self.execute("COMMIT")
            if self._added and not block.later:  # this fsync also covers earlier commits in the log
                self._settled = self.commits_not_waited_for
        elif block.apart:
            self.execute(f"RELEASE s{block.level}")

    def _undo(self, block: Transaction) -> None:
        """Take back what a block changed: by itself, or with the block that it is a part of."""
        self._taken_back += 1
        if block.level and not block.apart:
            self._spoilt = self._spoilt or self._connection.total_changes != block.changes
            return
        name = f"s{block.level}"
        for statement in (f"ROLLBACK TO {name}", f"RELEASE {name}") if block.level else ("ROLLBACK",):
            with suppress(sqlite3.Error):  # SQLite may have rolled back already (disk full)
                self._connection.execute(statement)
        self._spoilt = block.spoilt

    def _damaged(self) -> StoreError:
        return damaged(self.path)

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError, UnicodeError) as error:
            raise self._failure(error) from error

    def _failure(self, error: Exception) -> TedsProvisionError:
        """Return the error to raise in place of one of SQLite, of the system, or of a text."""
        # the message contains octets of the damaged file; the driver's own error has no code
        if isinstance(error, UnicodeDecodeError) or str(error).startswith("Could not decode to UTF-8"):
            return self._damaged()
        if isinstance(error, sqlite3.Error | OSError):
            if self._frozen is not None and getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_READONLY:
                return self._frozen
            # perhaps an unknown column, as in another schema
            if getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_ERROR:
                with suppress(sqlite3.Error):
                    self.require_known_schema()
            return as_store_failure(error, self.path)
        return BadDataError("A name or text is not valid UTF-8.", hint="Give it in UTF-8.")  # from the command line


class Transaction:
    """One ``with`` block of :meth:`Connection.transaction` or :meth:`Connection.together`."""

    __slots__ = ("_connection", "apart", "changes", "later", "level", "spoilt")

    def __init__(self, connection: Connection, *, later: bool = False, apart: bool = True) -> None:
        self._connection = connection
        self.later, self.apart = later, apart
        self.level = self.changes = 0
        self.spoilt = False

    def __enter__(self) -> None:
        self._connection.enter(self)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connection.leave(self, failed=kind is not None)
