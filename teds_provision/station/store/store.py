"""The store of one station: one SQLite file in its home directory, the only durable state besides the vault."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal

from teds_provision.errors import BadDataError, StoreError
from teds_provision.station.store.audit import AuditLog
from teds_provision.station.store.background_writer import BackgroundWriter
from teds_provision.station.store.database import FILE_NAME, Database
from teds_provision.station.store.tables.datasheets import DatasheetTables
from teds_provision.station.store.tables.facts import FactTables
from teds_provision.station.store.tables.handovers import HandoverTables
from teds_provision.station.store.tables.keys import KeyTables
from teds_provision.station.store.tables.line import LineTables
from teds_provision.station.store.tables.measurements import MeasurementTables
from teds_provision.station.store.tables.nodes import BulkTables, NodeTables
from teds_provision.station.store.tables.overview import OverviewTables
from teds_provision.station.store.tables.parcels import ParcelTables
from teds_provision.station.store.tables.plant import PlantTables

if TYPE_CHECKING:
    import sqlite3

_ID_OCTETS = 16


class Store(
    NodeTables,
    KeyTables,
    DatasheetTables,
    HandoverTables,
    BulkTables,
    FactTables,
    MeasurementTables,
    OverviewTables,
    PlantTables,
    LineTables,
    ParcelTables,
):
    """Whitelist, nodes, wrapped keys, datasheets, drafts, trust, handovers, groups and the audit log of one station.

    Every method is durable when it returns, and all of them raise StoreError (or StoreLockedError) if the file fails.
    Several processes may have it open; a command that changes it holds a StoreLock.
    """

    id: str
    audit: AuditLog

    def __init__(self, database: Database) -> None:
        self._database = database
        self._home = database.path.parent

    @classmethod
    def open(cls, home: Path, *, create: bool = False) -> Store:
        """Open the store of ``home``; ``create`` makes it (and the directory) if it is missing.

        Raises StoreError: missing, damaged, of a newer version, not ours, no permission, no space.
        """
        database = Database.open(home, create=create)
        try:
            return cls._identified(database, create=create)
        except BaseException:
            database.close()
            raise

    @classmethod
    def of_backup(cls, connection: sqlite3.Connection) -> Store:
        """Return the store in a private database that a backup was unpacked to; an older schema is migrated.

        Raises BadDataError if it is damaged, StoreError. The connection stays open then.
        """
        database = Database(Path("backup", FILE_NAME), connection)
        database.set_up(create=False)
        store = cls._identified(database)
        if store.damage() is not None:
            raise BadDataError("The store in the backup is damaged.")
        return store

    @classmethod
    def _identified(cls, database: Database, *, create: bool = False) -> Store:
        store = cls(database)
        store.id = store._identifier(create=create)
        store.audit = AuditLog(database, store.id)
        return store

    @property
    def home(self) -> Path:
        """The directory of the store."""
        return self._home

    @property
    def frozen(self) -> StoreError | None:
        """Why nothing can be written (the disk is full or read-only), None if it can."""
        return self._database.frozen

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._database.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def transaction(self, *, later: bool = False) -> AbstractContextManager[None]:
        """Run all of the block or nothing of it; may be nested.

        ``later``: it is on the disk with the next one that is not, or after :meth:`flush`.
        """
        return self._database.transaction(later=later)

    def together(self) -> AbstractContextManager[None]:
        """All of the block or nothing of it, nor of a transaction around it: no error in it is to be caught."""
        return self._database.together()

    def reading(self) -> AbstractContextManager[None]:
        """Many questions at one moment: what was read before counts as it was when the block began."""
        return self._database.reading()

    def flush(self, through: int | None = None) -> None:
        """Wait until everything that was committed is on the disk, or what was when :attr:`later` was ``through``."""
        self._database.flush(through)

    def background_writer(self) -> BackgroundWriter:
        """For a run of this thread: what takes its steps behind its back, which its next statement here waits for."""
        return BackgroundWriter(self._database.background)

    def drain(self) -> None:
        """Wait for what this thread has done behind its back; before it takes a lock that such a step takes too."""
        self._database.drain()

    @property
    def later(self) -> int:
        """How many commits did not wait for the disk; see :meth:`transaction`."""
        return self._database.later

    def when_waiting(self, notice: Callable[[str], object]) -> None:
        """Have ``notice`` receive a sentence when a change has to wait for another process."""
        self._database.notice = notice

    def version(self) -> int:
        """Return a number that changes when another connection has changed the file."""
        return self._database.version()

    def require_known_schema(self) -> None:
        """Raise NewerStoreError if a newer version of this tool has brought the store to its schema meanwhile."""
        self._database.require_known_schema()

    def changes(self) -> tuple[int, int]:
        """Return what differs after any change of the file, by this connection or another one."""
        return self._database.changes()

    def count(self, table: Literal["nodes", "whitelist", "keys", "trust"]) -> int:
        """Return how many rows a table has."""
        row = self._database.one(f"SELECT count(*) FROM {table}")
        return int(row[0]) if row is not None else 0

    def damage(self) -> str | None:
        """Return what is wrong with the file: a cut last page, or what SQLite finds; None if nothing (for doctor)."""
        try:
            page = int(self._database.execute("PRAGMA page_size")[0][0])
            file = str(self._database.execute("PRAGMA database_list")[0][2])  # "" for the private one of a backup
            if file and Path(file).stat().st_size % page:  # SQLite reads zeros for the octets that are missing
                return "The file ends within a page."
            found = str(self._database.execute("PRAGMA quick_check(1)")[0][0])
        except StoreError as failure:
            return failure.message
        except OSError as error:
            return f"The file cannot be read: {error.strerror}."
        return None if found == "ok" else found

    def _identifier(self, *, create: bool) -> str:
        row = self._database.one("SELECT value FROM meta WHERE name = 'id'")
        if row is None and create:
            with self.transaction():  # OR IGNORE: another process may have been first
                fresh = secrets.token_hex(_ID_OCTETS)
                self._database.execute("INSERT OR IGNORE INTO meta VALUES('id', ?)", (fresh,))
                row = self._database.one("SELECT value FROM meta WHERE name = 'id'")
        if row is None:
            raise StoreError(f"The store {self._database.path} has no identifier.", hint="Run teds-provision init.")
        return str(row[0])
