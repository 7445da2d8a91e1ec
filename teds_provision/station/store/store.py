"""The store of one station: one SQLite file in its home directory, the only durable state besides the vault."""

from __future__ import annotations

import secrets
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

from teds_provision.errors import BadDataError, StoreError
from teds_provision.station.store.audit import AuditLog
from teds_provision.station.store.database import Database
from teds_provision.station.store.row_sample import ALL_ROWS, RowSample
from teds_provision.station.store.sqlite import FILE_NAME, sqlite3

_ID_OCTETS = 16


class Store(Database):
    """The file of one station: its identifier, its audit log, transactions and statements.

    A method is durable when it returns; in a transaction, when the outermost one ends (``Connection.transaction``).
    All of them raise StoreError (or StoreLockedError) if the file fails. Several processes may have it open; a command
    that changes it holds a StoreLock.
    """

    id: str
    audit: AuditLog

    @classmethod
    def open(cls, home: Path, *, create: bool = False) -> Self:
        """Open the store of ``home``; ``create`` makes it (and the directory) if it is missing.

        Raises StoreError: missing, damaged, of a newer version, not ours, no permission, no space.
        """
        store = super().open(home, create=create)
        try:
            store._identify(create=create)
        except BaseException:
            store.close()
            raise
        return store

    @classmethod
    def of_backup(cls, connection: sqlite3.Connection) -> Self:
        """Return the store in a private database that a backup was unpacked to; an older schema is migrated.

        Raises BadDataError if it is damaged, StoreError. The connection stays open then.
        """
        store = cls(Path("backup", FILE_NAME), connection)
        store.set_up(create=False)
        store._identify(create=False)
        if store.damage() is not None:
            raise BadDataError("The store in the backup is damaged.")
        return store

    @property
    def home(self) -> Path:
        """The directory of the store."""
        return self.path.parent

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def count(self, table: Literal["nodes", "whitelist", "keys", "trust"]) -> int:
        """Return how many rows a table has."""
        row = self.first_row(f"SELECT count(*) FROM {table}")
        return int(row[0]) if row is not None else 0

    def damage(self, sample: RowSample | None = None) -> str | None:
        """Return what is wrong with the file: a cut last page, or what SQLite finds; None if nothing (for doctor).

        With ``sample`` keys, datasheets and log are read in part if they are long.
        """
        try:
            page = int(self.execute("PRAGMA page_size")[0][0])
            file = str(self.execute("PRAGMA database_list")[0][2])  # "" for the in-memory store of a backup
            if file and Path(file).stat().st_size % page:  # SQLite reads missing octets as zeros
                return "The file ends within a page."
            found = self._checked("1") if sample is None else self._spot_check(sample)
        except StoreError as failure:
            return failure.message
        except OSError as error:
            return f"The file cannot be read: {error.strerror}."
        return None if found == "ok" else found

    def _spot_check(self, sample: RowSample) -> str:
        """Return what SQLite finds, "ok" if nothing; of a large table, only read the sample."""
        tables = self.execute("SELECT name, wr FROM pragma_table_list WHERE schema = 'main' AND type = 'table'")
        for table, without_numbers in tables:
            if without_numbers:
                key = f"SELECT name FROM pragma_table_info('{table}') WHERE pk ORDER BY pk"
                large = sample.row_runs(self, table, [name for (name,) in self.execute(key)])
            elif large := (rows := sample.numbered_rows(self, table)) != ALL_ROWS:
                self.execute(f"SELECT * FROM {table} WHERE {rows}")
            if not large and (found := self._checked(f"'{table}'")) != "ok":
                return found
        return "ok"

    def _checked(self, what: str) -> str:
        return str(self.execute(f"PRAGMA quick_check({what})")[0][0])

    def _identify(self, *, create: bool) -> None:
        """Read the identifier, which wrapped keys and the audit log are bound to; make it in a new store."""
        row = self.first_row("SELECT value FROM meta WHERE name = 'id'")
        if row is None and create:
            with self.transaction():  # OR IGNORE: another process may have inserted it first
                fresh = secrets.token_hex(_ID_OCTETS)
                self.execute("INSERT OR IGNORE INTO meta VALUES('id', ?)", (fresh,))
                row = self.first_row("SELECT value FROM meta WHERE name = 'id'")
        if row is None:
            raise StoreError(f"The store {self.path} has no identifier.", hint="Run teds-provision init.")
        self.id = str(row[0])
        self.audit = AuditLog(self, self.id)
