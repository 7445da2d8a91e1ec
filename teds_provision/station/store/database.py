"""The SQLite file under the store: opened safely, written durably, and never a foreign exception.

Write-ahead log with ``synchronous=FULL``: a commit that returned has reached the disk, unless it was allowed to come
later, and a process killed at any instant leaves the last commit. ``secure_delete`` overwrites what is deleted.
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any, Self, TypeVar

from teds_provision.errors import StoreError, StoreLockedError
from teds_provision.portable import NOFOLLOW, is_mine, is_open_to
from teds_provision.station.store.connection import (
    BUSY_SECONDS,
    QUIET_SECONDS,
    SYNC_ON_COMMIT,
    Connection,
    as_store_failure,
    is_no_place_to_write,
    newer_schema,
    too_old,
)
from teds_provision.station.store.schema import APPLICATION_ID, OLDEST_SCHEMA, SCHEMA_VERSION, statements
from teds_provision.station.store.sqlite import FILE_NAME, sqlite3

# Checks of a home's files before SQLite opens them: owner, permissions, and content.


def prepare_home(home: Path, *, create: bool) -> None:
    """Make the directory with mode 0700; refuse one in which others may write."""
    if create:
        home.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError):
            home.mkdir(mode=0o700)
            home.chmod(0o700)  # mkdir's mode is reduced by the umask
    try:
        status = home.stat()
    except FileNotFoundError:
        raise StoreError(f"There is no store in {home}.", hint="Run teds-provision init.") from None
    if not stat.S_ISDIR(status.st_mode):
        raise StoreError(f"{home} is not a directory.", hint="Choose another --home.")
    if not is_mine(status):
        raise StoreError(f"{home} belongs to another user.", hint="Run this as its owner, or choose another --home.")
    private = not is_open_to(0o077, status)
    if create and not private and not any(home.iterdir()):
        home.chmod(0o700)
    elif is_open_to(0o022, status):
        raise StoreError(f"Other users can write to {home}.", hint=f"Run: chmod 700 {home}, or choose another --home.")


def prepare_file(path: Path, *, create: bool) -> None:
    """Make the file with mode 0600 before SQLite would make it wider; its -wal and -shm follow its mode."""
    if create:
        with suppress(FileExistsError):
            os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR | NOFOLLOW, 0o600))
    for file in (path, path.with_name(path.name + "-wal"), path.with_name(path.name + "-shm")):
        _require_own(file)
    if not path.exists():
        raise StoreError(f"There is no store in {path.parent}.", hint="Run teds-provision init.")
    if is_open_to(0o077, path.stat()):
        with suppress(OSError):  # on a read-only disk the mode cannot be changed
            path.chmod(0o600)


def _require_own(file: Path) -> None:
    """Refuse a link, or another user's file, in the place of the store, as it may have been planted."""
    try:
        status = file.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISREG(status.st_mode) or not is_mine(status):
        what = "a link" if stat.S_ISLNK(status.st_mode) else "not owned by this user"
        raise StoreError(f"{file} is {what}.", hint="Another program put it there: check it and move it away.")


CHUNK = 500
"""Rows that are looked up, read or written at once."""
_FEW_NODES = 32
"""So many nodes are looked up one by one."""
_REMEMBERED = 100
_Record = TypeVar("_Record")
_Value = TypeVar("_Value")


def places(values: Sized) -> str:
    """Return a ``?`` for each value, as a statement has them."""
    return ", ".join("?" * len(values))


def chunks(values: Iterable[_Value], length: int = CHUNK) -> Iterator[list[_Value]]:
    """Divide many values into chunks, as many as one statement looks up at once."""
    rest = iter(values)
    while chunk := list(islice(rest, length)):
        yield chunk


class Database(Connection):
    """The store's file: opened, its schema, and its rows as records."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        super().__init__(path, connection)
        self._remembered: dict[tuple[object, ...], Any] = {}
        self._remembered_at: object = None

    @classmethod
    def open(cls, home: Path, *, create: bool = False) -> Self:
        """Open ``home``/store.sqlite3, making it (0600, in a directory of 0700) if ``create``.

        Raises StoreError: missing, damaged, of a newer version, foreign, no permission, no space.
        """
        path = home / FILE_NAME
        try:
            prepare_home(home, create=create)
            prepare_file(path, create=create)
        except OSError as error:
            raise as_store_failure(error, path) from error
        try:
            return cls._opened(path, create=create)
        except StoreError as failure:
            if create or not is_no_place_to_write(failure):
                raise
            return cls._read_only(path, failure)

    @classmethod
    def _opened(cls, path: Path, *, create: bool) -> Self:
        try:
            connection = sqlite3.connect(path, timeout=QUIET_SECONDS, isolation_level=None, check_same_thread=False)
        except sqlite3.Error as error:
            raise as_store_failure(error, path) from error
        database = cls(path, connection)
        try:
            database.set_up(create=create)
        except BaseException:
            connection.close()
            raise
        return database

    @classmethod
    def _read_only(cls, path: Path, failure: StoreError) -> Self:
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
    def frozen(self) -> StoreError | None:
        """Why nothing can be written (the disk is full or read-only), None if it can."""
        return self._frozen

    def close(self) -> None:
        """Close the connection; a second call does nothing."""
        with self._lock, suppress(sqlite3.Error):
            self._connection.close()

    def first_row(self, statement: str, values: Sequence[Any] = ()) -> tuple[Any, ...] | None:
        """Return the first row, None if there is none; raises StoreError."""
        rows = self.execute(statement, values)
        return rows[0] if rows else None

    def read(self, make: Callable[..., _Record], statement: str, values: Sequence[Any] = ()) -> list[_Record]:
        """Make a record of every row; raises StoreError, also if a damaged row makes no record."""
        rows = self.execute(statement, values)
        try:
            return [make(*row) for row in rows]
        except (ValueError, TypeError, AttributeError) as error:
            raise self._damaged() from error

    def read_one(self, make: Callable[..., _Record], statement: str, values: Sequence[Any] = ()) -> _Record | None:
        """Make a record of the first row, None if there is none; as :meth:`recall`."""
        records = self.recall(make, statement, values)
        return records[0] if records else None

    def recall(self, make: Callable[..., _Record], statement: str, values: Sequence[Any] = ()) -> tuple[_Record, ...]:
        """Make a record of every row, from the cache if no process has changed the table since.

        For what every step reads again of the node at hand. Raises what :meth:`read` raises.
        """
        if self.background:
            self.drain()
        with self._lock:
            state = (self.state(), self._connection.total_changes)
            if state != self._remembered_at or len(self._remembered) >= _REMEMBERED:
                self._remembered.clear()
                self._remembered_at = state
            asked = (make, statement, *values)
            records: tuple[_Record, ...] | None = self._remembered.get(asked)
            if records is None:
                records = self._remembered[asked] = tuple(self.read(make, statement, values))
            return records

    def read_of_nodes(self, make: Callable[..., _Record], selection: str, uuids: Sequence[bytes]) -> list[_Record]:
        """Make a record of every row that :meth:`rows_of_nodes` returns; raises what :meth:`read` raises."""
        rows = self.rows_of_nodes(selection, uuids)
        try:
            return [make(*row) for row in rows]
        except (ValueError, TypeError, AttributeError) as error:
            raise self._damaged() from error

    def rows_of_nodes(self, selection: str, uuids: Sequence[bytes]) -> list[tuple[Any, ...]]:
        """Return every row of a chunk of nodes, by UUID; raises StoreError.

        ``selection`` is a SELECT without a condition, its first column ``uuid`` that of an index. Of many nodes in a
        row, as in a handover, mostly all between the first and the last are asked for, or none is here: then one walk
        over the index costs half of the look-ups, or nothing.
        """
        if len(uuids) > _FEW_NODES:
            most = len(uuids) + _FEW_NODES
            wanted = set(uuids)
            statement = f"{selection} WHERE uuid BETWEEN ? AND ? ORDER BY uuid LIMIT ?"
            rows = self.execute(statement, (min(wanted), max(wanted), most))
            if len(rows) < most:  # otherwise the limit was reached: the range has many other nodes
                return [row for row in rows if row[0] in wanted]
        return self.execute(f"{selection} WHERE uuid IN ({places(uuids)}) ORDER BY uuid", uuids)

    def replace_rows(self, table: str, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
        """Add or replace whole rows, all or none; raises StoreError.

        A column that has no value in any row is left out: it is NULL then, and to bind a NULL costs as much as a value.
        """
        with self.together():
            for chunk in chunks(rows):
                by_column = list(zip(*chunk, strict=True))
                used = [number for number, values in enumerate(by_column) if values.count(None) < len(values)]
                names = [columns[number] for number in used]
                statement = f"INSERT OR REPLACE INTO {table}({', '.join(names)}) VALUES({places(names)})"
                self.execute_many(statement, zip(*(by_column[number] for number in used), strict=True))

    def stream(self, make: Callable[..., _Record], statement: str, after: int = 0) -> Iterator[_Record]:
        """Make records a chunk at a time, holding no lock between chunks; raises StoreError.

        The statement has two marks, for the number to go on after and for the page's length, and its first column is
        that number, growing.
        """
        while rows := self.execute(statement, (after, CHUNK)):
            for row in rows:
                if not isinstance(row[0], int) or row[0] <= after:
                    raise self._damaged()
                after = row[0]
                try:
                    record = make(*row)
                except (ValueError, TypeError, AttributeError) as error:
                    raise self._damaged() from error
                yield record

    def set_up(self, *, create: bool) -> None:
        """Bring a connection into order: its journal, its schema, its pragmas. Raises StoreError."""
        self._check_version(create=create)
        self._write_ahead()
        self._bring_in_order(create=create)

    def _check_version(self, *, create: bool) -> int:
        version = self._version()
        if version == 0 and not create:
            raise StoreError(f"The store {self.path} is empty.", hint="Run teds-provision init.")
        return version

    def _bring_in_order(self, *, create: bool) -> None:
        for pragma in ("trusted_schema=OFF", "foreign_keys=ON", "secure_delete=ON", SYNC_ON_COMMIT):
            self.execute(f"PRAGMA {pragma}")
        version = self._check_version(create=create)
        if version < SCHEMA_VERSION:
            self._bring_forward()

    def _bring_forward(self) -> None:
        """Make the tables of the present schema out of what is there, or out of nothing, all or none of them."""
        with self.transaction(), self._translated():
            before = self._version()  # another process may have done it meanwhile
            for statement in statements(before):
                self.execute(statement)
            self.execute(f"PRAGMA application_id={APPLICATION_ID}")
            self.execute(f"PRAGMA user_version={SCHEMA_VERSION}")

    def _write_ahead(self) -> None:
        """Switch to the write-ahead log; SQLite does not wait by itself here when two processes open at once."""
        until = time.monotonic() + BUSY_SECONDS
        while True:
            try:
                self.execute("PRAGMA journal_mode=WAL")
            except StoreLockedError:
                if time.monotonic() >= until:
                    raise
                time.sleep(0.01)
            else:
                return

    def _version(self) -> int:
        (version,) = self.execute("PRAGMA user_version")[0]
        tables = self.execute("SELECT count(*) FROM sqlite_schema")[0][0]
        (mark,) = self.execute("PRAGMA application_id")[0]  # last: another process may set all three meanwhile
        if (version or tables) and mark != APPLICATION_ID:
            raise StoreError(f"{self.path} is a database of another program.", hint="Choose another --home.")
        if 0 < version < OLDEST_SCHEMA:
            raise too_old(f"The store {self.path}", version)
        if version > SCHEMA_VERSION:
            raise newer_schema(self.path, version)
        return int(version)


# A full or read-only disk must not prevent reading the store. SQLite needs a writable folder for the shared memory of a
# write-ahead log, and without the log the newest entries would be missing. So both files are copied to a place with
# room (memory first), merged there, and then unlinked while open: nothing of the copy is left when the process ends,
# even after a kill.

_LOG = "-wal"


def open_copy(path: Path) -> sqlite3.Connection:
    """Return a connection to a private copy of the database with its log; raises OSError, sqlite3.Error."""
    last: OSError | None = None
    for place in _places():
        try:
            folder = Path(tempfile.mkdtemp(prefix="teds-provision-", dir=place))
        except OSError as error:
            last = error
            continue
        try:
            return _copied(path, folder)
        except OSError as error:  # not enough room here either
            last = error
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    raise last or OSError(f"There is no space for a copy of {path}.")


def _places() -> Iterator[str]:
    yield "/dev/shm"
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        yield runtime
    with suppress(OSError):
        yield tempfile.gettempdir()


def _copied(path: Path, folder: Path) -> sqlite3.Connection:
    copy = folder / path.name
    shutil.copyfile(path, copy)
    log = path.with_name(path.name + _LOG)
    with suppress(FileNotFoundError):
        shutil.copyfile(log, copy.with_name(copy.name + _LOG))
    connection = sqlite3.connect(copy, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA locking_mode=EXCLUSIVE")  # avoids the shared memory, which would be a third file
        connection.execute("PRAGMA journal_mode=MEMORY")  # moves the log's contents into the file
        connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()
    except BaseException:
        connection.close()
        raise
    return connection
