"""The SQLite file under the store: opened safely, written durably, and never a foreign exception.

Write-ahead log with ``synchronous=FULL``: a commit that returned has reached the disk, unless it was said that it may
come later, and a process killed at any instant leaves the last commit. ``secure_delete`` overwrites what is deleted.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence, Sized
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from teds_provision.errors import StoreFailure, StoreLocked
from teds_provision.lazy import late
from teds_provision.store.connection import QUIET_SECONDS, WAITING, Connection
from teds_provision.store.failures import BUSY_SECONDS, as_store_failure, is_no_place_to_write, too_old
from teds_provision.store.frozen import open_copy
from teds_provision.store.home import FILE_NAME, prepare_file, prepare_home
from teds_provision.store.schema import APPLICATION_ID, OLDEST_SCHEMA, SCHEMA_VERSION, STEPS_TO

if TYPE_CHECKING:
    import sqlite3
else:  # loaded with the first store: --help does not wait for it
    sqlite3 = late("sqlite3")


PAGE = 500
"""Rows that are looked up, read or written at once."""
_REMEMBERED = 100
_Record = TypeVar("_Record")


def places(values: Sized) -> str:
    """A ``?`` for each value, as a statement has them."""
    return ", ".join("?" * len(values))


class Database(Connection):
    """The store's file: opened, its schema, and its rows as records."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        super().__init__(path, connection)
        self._remembered: dict[tuple[object, ...], Any] = {}
        self._remembered_at: object = None

    @classmethod
    def open(cls, home: Path, *, create: bool) -> Database:
        """Open ``home``/store.sqlite3, making it (0600, in a directory of 0700) if ``create``.

        Raises StoreFailure: missing, damaged, of a newer version, foreign, no permission, no space.
        """
        path = home / FILE_NAME
        try:
            prepare_home(home, create=create)
            prepare_file(path, create=create)
        except OSError as error:
            raise as_store_failure(error, path) from error
        try:
            return cls._opened(path, create=create)
        except StoreFailure as failure:
            if create or not is_no_place_to_write(failure):
                raise
            return cls._read_only(path, failure)

    @classmethod
    def _opened(cls, path: Path, *, create: bool) -> Database:
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
        """Make a record of the first row, None if there is none; as :meth:`recall`."""
        records = self.recall(make, statement, values)
        return records[0] if records else None

    def recall(self, make: Callable[..., _Record], statement: str, values: Sequence[Any] = ()) -> tuple[_Record, ...]:
        """Make a record of every row; what was read a moment ago, and nobody has changed since, is given once more.

        For what every step asks again of the node at hand. Raises what :meth:`read` raises.
        """
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

    def stream(self, make: Callable[..., _Record], statement: str, after: int = 0) -> Iterator[_Record]:
        """Make records a page at a time, holding no lock between pages; raises StoreFailure.

        The statement has two marks, for the number to go on after and for the page's length, and its first column is
        that number, growing.
        """
        while rows := self.execute(statement, (after, PAGE)):
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
        """Bring a connection into order: its journal, its schema, its pragmas. Raises StoreFailure."""
        self._check_version(create=create)
        self._write_ahead()
        self._bring_in_order(create=create)

    def _check_version(self, *, create: bool) -> int:
        version = self._version()
        if version == 0 and not create:
            raise StoreFailure(f"The store {self.path} is empty.", hint="Run teds-provision init.")
        return version

    def _bring_in_order(self, *, create: bool) -> None:
        for pragma in ("trusted_schema=OFF", "foreign_keys=ON", "secure_delete=ON", WAITING):
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
        if 0 < version < OLDEST_SCHEMA:
            raise too_old(f"The store {self.path}", version)
        if version > SCHEMA_VERSION:
            raise StoreFailure(
                f"The store {self.path} has schema {version}; this version of the tool knows up to {SCHEMA_VERSION}.",
                hint="Use the newer version of teds-provision that made it.",
            )
        return int(version)
