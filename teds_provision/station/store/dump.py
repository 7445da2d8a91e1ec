"""A whole store as a stream of rows, and back: what a backup holds (nothing in it is executed when it comes back).

One line of JSON (schema version, tables with their columns), then records: table u8, length u32, and each value as
0 (null), 1 ‖ i64, 2 ‖ length u32 ‖ UTF-8, 3 ‖ length u32 ‖ octets or 4 ‖ f64. A record of table 255 ends it. The reader
makes the tables from its own schema of that version, never from the file.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Final, Protocol

from teds_provision.errors import BadDataError, StoreError
from teds_provision.station.store.connection import too_old
from teds_provision.station.store.database import CHUNK, places
from teds_provision.station.store.schema import APPLICATION_ID, OLDEST_SCHEMA, SCHEMA_VERSION, statements
from teds_provision.station.store.sqlite import sqlite3
from teds_provision.station.store.store import Store

MAX_RECORD_OCTETS: Final = 128 << 20
_MAX_HEAD_OCTETS: Final = 64 * 1024
_CACHE_KIB: Final = 64 * 1024
_END: Final = 255
_HEAD: Final = struct.Struct(">BI")
_LENGTH: Final = struct.Struct(">BI")
_INTEGER: Final = struct.Struct(">Bq")
_REAL: Final = struct.Struct(">Bd")
_NAME: Final = re.compile("[a-z][a-z0-9_]*")


class RowSource(Protocol):
    """Source of a dump."""

    def read(self, size: int) -> bytes:
        """Return exactly ``size`` octets."""

    def read_line(self, limit: int) -> bytes:
        """Return the octets up to a line feed."""


def dump(store: Store) -> Iterator[bytes]:
    """Give the store as it is at one moment, a few hundred rows at a time; others may read and write meanwhile.

    Raises StoreError.
    """
    with store._lock, store._translated():
        connection = store._connection
        connection.execute("BEGIN")  # the snapshot begins with the first SELECT and does not block other processes
        try:
            version = int(connection.execute("PRAGMA user_version").fetchone()[0])
            tables = _tables(connection)
            yield json.dumps({"schema": version, "tables": tables}, separators=(",", ":")).encode() + b"\n"
            for number, (table, columns) in enumerate(tables.items()):
                rows = connection.execute(f"SELECT {', '.join(columns)} FROM {table}")
                while chunk := rows.fetchmany(CHUNK):
                    yield b"".join(_record(number, row) for row in chunk)
            yield _HEAD.pack(_END, 0)
        finally:
            with suppress(sqlite3.Error):
                connection.execute("ROLLBACK")


def load(source: RowSource) -> Store:
    """Make a store of a dump, in a private database that SQLite keeps in memory or in an unnamed temporary file.

    An older schema is brought forward. Raises BadDataError (form, unknown tables, rows that break a rule), StoreError.
    """
    connection = sqlite3.connect("", isolation_level=None, check_same_thread=False)
    try:
        for pragma in (f"cache_size=-{_CACHE_KIB}", "journal_mode=OFF", "synchronous=OFF", "trusted_schema=OFF"):
            connection.execute(f"PRAGMA {pragma}")
        _fill(connection, source)
        store = Store.of_backup(connection)
        if connection.execute("PRAGMA foreign_key_check").fetchone():
            raise BadDataError("The store in the backup is damaged.")
    except (sqlite3.IntegrityError, sqlite3.DataError, UnicodeDecodeError) as error:
        connection.close()
        raise BadDataError("The store in the backup breaks a rule of its tables.") from error
    except sqlite3.Error as error:
        connection.close()
        raise StoreError(
            f"The backup cannot be unpacked: {error}.", hint="Free some space in the folder for temporary files."
        ) from error
    except BaseException:
        connection.close()
        raise
    return store


def _tables(connection: sqlite3.Connection) -> dict[str, list[str]]:
    names = connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table' ORDER BY rowid").fetchall()
    own = [str(name) for (name,) in names if not str(name).startswith("sqlite_")]
    return {name: [str(row[1]) for row in connection.execute(f"PRAGMA table_info({name})")] for name in own}


def _fill(connection: sqlite3.Connection, source: RowSource) -> None:
    version, tables = _head(source)
    connection.execute("BEGIN")
    for statement in statements(0, version):
        connection.execute(statement)
    known = _tables(connection)
    for table, columns in tables.items():
        if known.get(table) != columns:
            raise BadDataError(f"The store in the backup has an unknown table {table}.")
    for table in known:
        connection.execute(f"DELETE FROM {table}")  # rows that the schema creates are replaced by the dump's
    inserts = [f"INSERT INTO {table} VALUES({places(columns)})" for table, columns in tables.items()]
    widths = [len(columns) for columns in tables.values()]
    for number, chunk in _chunks(source, widths):
        connection.executemany(inserts[number], chunk)
    connection.execute("COMMIT")
    connection.execute(f"PRAGMA application_id={APPLICATION_ID}")
    connection.execute(f"PRAGMA user_version={version}")


def _head(source: RowSource) -> tuple[int, dict[str, list[str]]]:
    try:
        head = json.loads(source.read_line(_MAX_HEAD_OCTETS))
        version, tables = head["schema"], head["tables"]
        whole = type(version) is int and all(_is_table(name, columns) for name, columns in tables.items())
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise BadDataError("The backup holds no store.") from None
    if not whole or version < 1 or len(tables) >= _END:
        raise BadDataError("The backup holds no store.")
    if version < OLDEST_SCHEMA:
        raise too_old("The store in the backup", version)
    if version > SCHEMA_VERSION:
        raise StoreError(
            f"The store in the backup has schema {version}; this version of the tool knows up to {SCHEMA_VERSION}.",
            hint="Use the newer version of teds-provision that made it.",
        )
    return version, tables


def _is_table(name: str, columns: list[str]) -> bool:
    return bool(columns) and all(_NAME.fullmatch(word) for word in (name, *columns))


def _chunks(source: RowSource, widths: list[int]) -> Iterator[tuple[int, list[tuple[Any, ...]]]]:
    """Yield the rows of a table in chunks."""
    current, chunk = 0, list[tuple[Any, ...]]()
    while True:
        number, length = _HEAD.unpack(source.read(_HEAD.size))
        if chunk and (number != current or len(chunk) >= CHUNK):
            yield current, chunk
            chunk = []
        if number == _END and length == 0:
            return
        if number >= len(widths) or length > MAX_RECORD_OCTETS:
            raise BadDataError("A row of the store in the backup is damaged.")
        current = number
        chunk.append(_row(source.read(length), widths[number]))


def _record(number: int, row: tuple[Any, ...]) -> bytes:
    body = b"".join(map(_value, row))
    if len(body) > MAX_RECORD_OCTETS:
        raise StoreError("A row of the store is too large for a backup.", hint="Please report this.")
    return _HEAD.pack(number, len(body)) + body


def _value(value: Any) -> bytes:
    if value is None:
        return b"\0"
    if isinstance(value, str):
        octets = value.encode()
        return _LENGTH.pack(2, len(octets)) + octets
    if isinstance(value, bytes):
        return _LENGTH.pack(3, len(value)) + value
    return _INTEGER.pack(1, value) if isinstance(value, int) else _REAL.pack(4, value)


def _row(body: bytes, width: int) -> tuple[Any, ...]:
    values: list[Any] = []
    place = 0
    try:
        while place < len(body):
            kind = body[place]
            if kind == 0:
                values.append(None)
                place += 1
            elif kind in (1, 4):
                values.append((_INTEGER if kind == 1 else _REAL).unpack_from(body, place)[1])
                place += 9
            else:
                length = int.from_bytes(body[place + 1 : place + 5], "big")
                octets = body[place + 5 : place + 5 + length]
                if len(octets) != length or kind not in (2, 3):
                    raise ValueError
                values.append(octets.decode() if kind == 2 else octets)
                place += 5 + length
    except (struct.error, ValueError):
        raise BadDataError("A row of the store in the backup is damaged.") from None
    if len(values) != width:
        raise BadDataError("A row of the store in the backup is damaged.")
    return tuple(values)
