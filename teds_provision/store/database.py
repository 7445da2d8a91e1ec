"""The SQLite file under the store: opened safely, written durably, and never a foreign exception.

Write-ahead log with ``synchronous=FULL``: a commit that returned has reached the disk, and a process killed at any
instant leaves the last commit. ``secure_delete`` overwrites what is deleted.
"""

from __future__ import annotations

import errno
import os
import stat
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from teds_provision.errors import BadData, StoreFailure, StoreLocked
from teds_provision.lazy import late
from teds_provision.store.frozen import open_copy
from teds_provision.store.migration import carry
from teds_provision.store.schema import APPLICATION_ID, SCHEMA_VERSION, STEPS_TO

if TYPE_CHECKING:
    import sqlite3
else:  # loaded with the first store: --help does not wait for it
    sqlite3 = late("sqlite3")


FILE_NAME = "store.sqlite3"
BUSY_SECONDS = 10.0
_QUIET_MILLISECONDS = 300
_PAGE = 500
_RESTORE = "Restore a backup (teds-provision restore), or move the file away and run teds-provision init."

_FULL = ("there is no space left on the disk", "Free some space and run the same command again; nothing is lost.")
_READ_ONLY = (
    "it cannot be written",
    "Check the owner and mode of the home directory and whether the disk is read-only.",
)
# SQLite's primary result codes; written out, so that sqlite3 is not loaded for --help (sqlite.org, rescode).
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
_Record = TypeVar("_Record")
_OS_CAUSES: dict[int, tuple[str, str]] = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EROFS: _READ_ONLY,
    errno.EACCES: _READ_ONLY,
    errno.EPERM: _READ_ONLY,
}


def as_store_failure(error: sqlite3.Error | OSError, path: Path) -> StoreFailure:
    """Say in the words of the tool why SQLite or the system refused; cause and cure, no octet of the contents."""
    if isinstance(error, OSError):
        cause, cure = _OS_CAUSES.get(error.errno or 0, (error.strerror or type(error).__name__, "Check that path."))
        return StoreFailure(f"The store {path} cannot be used: {cause}.", hint=cure)
    primary = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if primary in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        return StoreLocked(
            f"The store {path} was kept busy by another process for {BUSY_SECONDS:.0f} s.",
            hint="Wait until the other command has ended, then run this one again.",
        )
    cause, cure = _CAUSES.get(primary, (f"SQLite says: {error}", "Run teds-provision doctor."))
    return StoreFailure(f"The store {path} cannot be used: {cause}.", hint=cure)


class Database:
    """One connection: statements, re-entrant transactions, errors translated. Safe to share between threads."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection
        self._lock = threading.RLock()
        self._depth = 0
        self.notice: Callable[[str], object] | None = None
        """Told, in a sentence, what a change of the store waits for."""
        self._frozen: StoreFailure | None = None
        """Why nothing can be written; what is read then comes from a private copy."""

    @classmethod
    def open(cls, home: Path, *, create: bool) -> Database:
        """Open ``home``/store.sqlite3, making it (0600, in a directory of 0700) if ``create``.

        Raises StoreFailure: missing, damaged, of a newer version, foreign, no permission, no space.
        """
        path = home / FILE_NAME
        try:
            _prepare_home(home, create=create)
            _prepare_file(path, create=create)
        except OSError as error:
            raise as_store_failure(error, path) from error
        try:
            return cls._opened(path, create=create)
        except StoreFailure as failure:
            if create or not _is_no_place_to_write(failure):
                raise
            return cls._read_only(path, failure)

    @classmethod
    def _opened(cls, path: Path, *, create: bool) -> Database:
        try:
            connection = sqlite3.connect(path, timeout=BUSY_SECONDS, isolation_level=None, check_same_thread=False)
        except sqlite3.Error as error:
            raise as_store_failure(error, path) from error
        database = cls(path, connection)
        try:
            database._set_up(create=create)
        except BaseException:
            connection.close()
            raise
        return database

    @classmethod
    def _read_only(cls, path: Path, failure: StoreFailure) -> Database:
        """Open a private copy to be read; whatever would change it raises why the store itself cannot be written."""
        try:
            connection = open_copy(path)
        except (OSError, sqlite3.Error):
            raise failure from None
        database = cls(path, connection)
        try:
            database._bring_in_order(create=False)
            database.execute("PRAGMA query_only=ON")
        except BaseException:
            connection.close()
            raise
        database._frozen = failure
        return database

    @property
    def frozen(self) -> StoreFailure | None:
        """Why nothing can be written (the disk is full or read-only), None where it can."""
        return self._frozen

    def close(self) -> None:
        """Close the connection; a second call does nothing."""
        with self._lock, suppress(sqlite3.Error):
            self._connection.close()

    def execute(self, statement: str, values: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """Run one statement and return all its rows; raises StoreFailure."""
        with self._lock, self._translated():
            return self._connection.execute(statement, values).fetchall()

    def change(self, statement: str, values: Sequence[Any] = ()) -> int:
        """Run one statement and return how many rows it changed; raises StoreFailure."""
        with self._lock, self._translated():
            return self._connection.execute(statement, values).rowcount

    def execute_many(self, statement: str, rows: Iterable[Sequence[Any]]) -> None:
        """Run one statement with each row of values; raises StoreFailure."""
        with self._lock, self._translated():
            self._connection.executemany(statement, rows)

    def one(self, statement: str, values: Sequence[Any] = ()) -> tuple[Any, ...] | None:
        """Return the first row, None if there is none; raises StoreFailure."""
        rows = self.execute(statement, values)
        return rows[0] if rows else None

    def read(self, make: Callable[..., _Record], statement: str, values: Sequence[Any] = ()) -> list[_Record]:
        """Make a record of every row; raises StoreFailure, also where a damaged row makes no record."""
        rows = self.execute(statement, values)
        try:
            return [make(*row) for row in rows]
        except (ValueError, TypeError, AttributeError) as error:
            raise self._damaged() from error

    def read_one(self, make: Callable[..., _Record], statement: str, values: Sequence[Any] = ()) -> _Record | None:
        """Make a record of the first row, None if there is none; raises StoreFailure."""
        records = self.read(make, statement, values)
        return records[0] if records else None

    def stream(self, make: Callable[..., _Record], statement: str, after: int = 0) -> Iterator[_Record]:
        """Make records a page at a time, holding no lock between pages; raises StoreFailure.

        The statement has two marks, for the number to go on after and for the page's length, and its first column is
        that number, growing.
        """
        while rows := self.execute(statement, (after, _PAGE)):
            for row in rows:
                if not isinstance(row[0], int) or row[0] <= after:
                    raise self._damaged()
                after = row[0]
                try:
                    record = make(*row)
                except (ValueError, TypeError, AttributeError) as error:
                    raise self._damaged() from error
                yield record

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """All or nothing: BEGIN IMMEDIATE, COMMIT, or ROLLBACK when anything is raised; inside another, a savepoint."""
        with self._lock:
            if self._frozen is not None:
                raise self._frozen
            level = self._depth
            begin, commit, rollback = (
                ("BEGIN IMMEDIATE", "COMMIT", ("ROLLBACK",))
                if level == 0
                else (f"SAVEPOINT s{level}", f"RELEASE s{level}", (f"ROLLBACK TO s{level}", f"RELEASE s{level}"))
            )
            self._begin(begin)
            self._depth += 1
            try:
                yield
                self.execute(commit)
            except BaseException:
                for statement in rollback:
                    with suppress(sqlite3.Error):  # SQLite may have rolled back by itself (disk full)
                        self._connection.execute(statement)
                raise
            finally:
                self._depth -= 1

    def _begin(self, statement: str) -> None:
        """Begin; where another process is writing and does not end soon, say what is waited for and until when."""
        if self._depth or self.notice is None:
            self.execute(statement)
            return
        try:
            self.execute(f"PRAGMA busy_timeout={_QUIET_MILLISECONDS}")
            try:
                self.execute(statement)
                return
            except StoreLocked:
                self.notice(f"Waiting up to {BUSY_SECONDS:.0f} s for another process that is writing to the store.")
            finally:
                self.execute(f"PRAGMA busy_timeout={BUSY_SECONDS * 1000:.0f}")
            self.execute(statement)
        except BaseException:  # interrupted between BEGIN and the block that would roll it back
            if self._connection.in_transaction:
                self._connection.execute("ROLLBACK")
            raise

    def _damaged(self) -> StoreFailure:
        cause, cure = _CAUSES[sqlite3.SQLITE_CORRUPT]
        return StoreFailure(f"The store {self.path} cannot be used: {cause}.", hint=cure)

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            if self._frozen is not None and getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_READONLY:
                raise self._frozen from error
            raise as_store_failure(error, self.path) from error
        except UnicodeDecodeError as error:  # SQLite quotes what it found in a damaged file
            raise self._damaged() from error
        except UnicodeEncodeError as error:  # a name from a command line that is not UTF-8
            raise BadData("A name or text is not valid UTF-8.", hint="Give it in UTF-8.") from error

    def _set_up(self, *, create: bool) -> None:
        self._check_version(create=create)
        self._write_ahead()
        self._bring_in_order(create=create)

    def _check_version(self, *, create: bool) -> int:
        version = self._version()
        if version == 0 and not create:
            raise StoreFailure(f"The store {self.path} is empty.", hint="Run teds-provision init.")
        return version

    def _bring_in_order(self, *, create: bool) -> None:
        for pragma in ("trusted_schema=OFF", "foreign_keys=ON", "secure_delete=ON", "synchronous=FULL"):
            self.execute(f"PRAGMA {pragma}")
        version = self._check_version(create=create)
        if version < SCHEMA_VERSION:
            try:
                self._bring_forward()
            except ValueError as error:  # a value of an old schema that this tool never wrote
                raise self._damaged() from error

    def _bring_forward(self) -> None:
        """Make the tables of the present schema out of what is there, or out of nothing, all or none of them."""
        with self.transaction(), self._translated():
            before = self._version()  # another process may have been first
            for step in range(before + 1, SCHEMA_VERSION + 1):
                with carry(self._connection, step) if before else nullcontext():
                    for statement in STEPS_TO[step]:
                        self.execute(statement)
            self.execute(f"PRAGMA application_id={APPLICATION_ID}")
            self.execute(f"PRAGMA user_version={SCHEMA_VERSION}")

    def _write_ahead(self) -> None:
        """Switch to the write-ahead log; SQLite does not wait by itself here when two processes open at once."""
        until = time.monotonic() + BUSY_SECONDS
        while True:
            try:
                self.execute("PRAGMA journal_mode=WAL")
            except StoreLocked:
                if time.monotonic() >= until:
                    raise
                time.sleep(0.01)
            else:
                return

    def _version(self) -> int:
        (mark,), (version,) = self.execute("PRAGMA application_id")[0], self.execute("PRAGMA user_version")[0]
        tables = self.execute("SELECT count(*) FROM sqlite_schema")[0][0]
        if (version or tables) and mark != APPLICATION_ID:
            raise StoreFailure(f"{self.path} is a database of another program.", hint="Choose another --home.")
        if version > SCHEMA_VERSION:
            raise StoreFailure(
                f"The store {self.path} has schema {version}; this version of the tool knows up to {SCHEMA_VERSION}.",
                hint="Use the newer version of teds-provision that made it.",
            )
        return int(version)


def _is_no_place_to_write(failure: StoreFailure) -> bool:
    """Whether a store could not be opened because nothing can be written where it lies."""
    cause = failure.__cause__
    if isinstance(cause, OSError):
        return cause.errno in _OS_CAUSES
    refused = (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_FULL)
    return isinstance(cause, sqlite3.Error) and getattr(cause, "sqlite_errorcode", 0) & 0xFF in refused


def _prepare_home(home: Path, *, create: bool) -> None:
    """Make the directory with mode 0700; refuse one in which others may write."""
    if create:
        home.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError):
            home.mkdir(mode=0o700)
            home.chmod(0o700)  # whatever the umask said
    try:
        status = home.stat()
    except FileNotFoundError:
        raise StoreFailure(f"There is no store in {home}.", hint="Run teds-provision init.") from None
    if not stat.S_ISDIR(status.st_mode):
        raise StoreFailure(f"{home} is not a directory.", hint="Choose another --home.")
    if status.st_uid != os.geteuid():
        raise StoreFailure(f"{home} belongs to another user.", hint="Run this as its owner, or choose another --home.")
    private = not status.st_mode & 0o077
    if create and not private and not any(home.iterdir()):
        home.chmod(0o700)
    elif status.st_mode & 0o022:
        raise StoreFailure(f"Others may write in {home}.", hint=f"Run: chmod 700 {home}, or choose another --home.")


def _prepare_file(path: Path, *, create: bool) -> None:
    """Make the file with mode 0600 before SQLite would make it wider; its -wal and -shm follow its mode."""
    if create:
        with suppress(FileExistsError):
            os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_NOFOLLOW, 0o600))
    for file in (path, path.with_name(path.name + "-wal"), path.with_name(path.name + "-shm")):
        _require_own(file)
    if not path.exists():
        raise StoreFailure(f"There is no store in {path.parent}.", hint="Run teds-provision init.")
    if path.stat().st_mode & 0o077:
        with suppress(OSError):  # a disk that is read-only: what is read stays as open as it was
            path.chmod(0o600)


def _require_own(file: Path) -> None:
    """Refuse a link, or another user's file, in the place of the store: somebody put it there."""
    try:
        status = file.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid():
        what = "a link" if stat.S_ISLNK(status.st_mode) else "not this user's own file"
        raise StoreFailure(f"{file} is {what}.", hint="Somebody put it there: look at it, and move it away.")
