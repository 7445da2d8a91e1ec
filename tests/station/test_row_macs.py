"""Each row that decides whom a station trusts: changed in any octet, under another row's MAC, or under none.

Another program does it in the store's file. Not held, and not promised: a row that this station once made is put back.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest

from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.station.row_macs import KEY_OCTETS, MAC_OCTETS, RowMacs
from teds_provision.station.station import Station
from teds_provision.station.store.records import RevocationRecord, TrustRecord, WhitelistEntry
from tests.plant.stations import Plant

ONE, TWO = bytes(range(10)), bytes(range(10, 20))
Value = str | bytes | int | None

COLUMNS = {
    "station": ("point", "ca", "signature"),
    "whitelist": ("uuid", "fingerprint", "assurance", "name"),
    "trust": ("name", "role", "point", "fingerprint"),
    "nodes": ("uuid", "point"),
    "marks": ("uuid", "ca"),
    "lifted": ("statement",),
    "ended_cas": ("ca",),
    "plant": ("registry",),
    "rosters": ("hash",),
    "digests": ("digest", "n", "vouched"),
    "firmware": ("uuid", "report", "at", "signed"),
    "statements": ("hash",),
}
"""The tables with a MAC, and the columns that it is over."""
MACS = {"nodes": "point_mac", "marks": "ca_mac"}
OTHERS = {"plant": ("restored", "restored_mac")}
"""A second MAC of a table: over this column, in that one."""


@dataclass
class Home:
    """A station whose vault is open, and another program that has its file."""

    station: Station
    database: sqlite3.Connection

    def broken(self) -> list[str]:
        return list(self.station.row_macs.all_broken())

    def rows(self, table: str, *columns: str) -> list[tuple[Value, ...]]:
        """Return what a table has in these columns; of the rosters the one that is held comes first."""
        order = " ORDER BY held DESC" if table == "rosters" else ""
        return self.database.execute(f"SELECT {', '.join(columns)} FROM {table}{order}").fetchall()

    def put(self, table: str, column: str, value: Value, was: tuple[tuple[str, Value], ...]) -> None:
        """Write a value into the one row that has these."""
        named = " AND ".join(f"{name} IS ?" for name, _ in was)
        done = self.database.execute(
            f"UPDATE {table} SET {column} = ? WHERE {named}", (value, *(old for _, old in was))
        )
        assert done.rowcount == 1, (table, column)


def mac_of(table: str) -> str:
    return MACS.get(table, "mac")


def changed(value: Value) -> Iterator[Value]:
    """Yield the value with one octet changed, each in turn, and without any."""
    if isinstance(value, int):
        yield from (value + 1, value + 256)
    elif isinstance(value, bytes):
        for place in range(len(value)):
            yield value[:place] + bytes([value[place] ^ 1 << place % 8]) + value[place + 1 :]
    elif isinstance(value, str):
        for place, letter in enumerate(value):
            yield value[:place] + ("0" if letter != "0" else "1") + value[place + 1 :]
        yield value + " "


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Home]:
    """Yield a keeper of a plant with two rows of each kind, restored from a backup, and nothing broken."""
    plant = Plant(tmp_path_factory.mktemp("macs"))
    north = plant.north
    plant.member("south", "base", "sign")
    north.unlock()
    points = [SoftwareKey.generate().point for _ in range(4)]
    for uuid, point in zip((ONE, TWO), points, strict=False):
        north.pins.put(WhitelistEntry(uuid, fingerprint(point), assurance="tap", name=f"node {uuid[0]}"))
        north.nodes.remember(uuid, point=point)
        north.keys.set_ca_of(uuid, point)
        north.firmware_reports.keep(uuid, bytes(42), in_session=True, signed=True)
        north.policy.deny(RevocationRecord(uuid, None, "lost", f"a ban of {uuid.hex()}", "2026-11-21T00:00:00Z"))
        assert north.policy.lift(uuid)
        with north.transaction():
            north.plant.record_event("signed", uuid, epoch=1, sequence=1, teds_sha256=os.urandom(32).hex())
    north.policy.trust(TrustRecord("peer", "station", points[2], fingerprint(points[2])))
    for point in points[2:]:
        north.policy.end_ca(point)
    plant.round()
    with north.transaction():
        north.plant.begin_restored()
    with closing(sqlite3.connect(Path(north.home) / "store.sqlite3", isolation_level=None)) as database:
        database.execute("PRAGMA ignore_check_constraints = ON")
        database.execute("PRAGMA synchronous = OFF")
        made = Home(north, database)
        assert made.broken() == []
        yield made
    plant.close()


@pytest.fixture(autouse=True)
def whole_again(home: Home) -> Iterator[None]:
    yield
    assert home.broken() == [], "a test left something changed"


@pytest.mark.parametrize("table", COLUMNS)
def test_a_row_that_was_changed_in_any_octet_is_named(home: Home, table: str) -> None:
    columns = COLUMNS[table]
    rows = home.rows(table, *columns)
    assert rows, "no row to change"
    row = rows[0]
    for place, column in enumerate(columns):
        for value in changed(row[place]):
            was = tuple(zip(columns, row, strict=True))
            now = tuple((name, value if name == column else old) for name, old in was)
            home.put(table, column, value, was)
            broken = home.broken()
            home.put(table, column, row[place], now)
            assert len(broken) == 1, (column, row[place], value, broken)


@pytest.mark.parametrize("table", COLUMNS)
def test_a_row_under_no_mac_another_rows_or_a_wrong_octet_is_named(home: Home, table: str) -> None:
    column = mac_of(table)
    keyed = (*COLUMNS[table], column)
    rows = home.rows(table, *keyed)
    row = rows[0]
    mac = row[-1]
    assert isinstance(mac, bytes)
    others: list[Value] = [found[-1] for found in rows[1:]]
    for value in (*([] if table == "nodes" else [None]), *others, *changed(mac)):  # a node's key without one is a hint
        was = tuple(zip(keyed, row, strict=True))
        home.put(table, column, value, was)
        broken = home.broken()
        home.put(table, column, mac, (*was[:-1], (column, value)))
        assert len(broken) == 1, (value, broken)


def test_a_note_of_a_restored_home_is_named_when_it_is_changed(home: Home) -> None:
    ((column, mac_column),) = OTHERS.values()
    ((note, mac),) = home.rows("plant", column, mac_column)
    for name, value in ((column, note), (mac_column, mac)):
        for other in changed(value):
            home.put("plant", name, other, ((name, value),))
            broken = home.broken()
            home.put("plant", name, value, ((name, other),))
            assert broken == ["the note of a restored home"]


def test_every_column_with_a_mac_is_among_these(home: Home) -> None:
    """A table that gets a MAC gets its line here."""
    found = {
        (table, column)
        for (table,) in home.database.execute("SELECT name FROM sqlite_schema WHERE type = 'table'").fetchall()
        for (column,) in home.database.execute("SELECT name FROM pragma_table_info(?)", (table,)).fetchall()
        if column == "mac" or column.endswith("_mac")
    }
    assert found == {(table, mac_of(table)) for table in COLUMNS} | {(table, mac) for table, (_, mac) in OTHERS.items()}


@pytest.mark.parametrize("length", [0, 1, 55, 63, 64, 65, 1000])
def test_the_mac_of_a_row_is_hmac_over_its_kind_and_values(length: int) -> None:
    """As RFC 2104 has it, however the hashes are kept: stores of earlier versions have such MACs."""
    key, value = bytes(range(KEY_OCTETS)), "x" * length
    macs = RowMacs(lambda: pytest.fail("the vault is not asked"))
    macs.use(key)
    whole = b"kind\0" + length.to_bytes(4, "big") + value.encode() + b"\xff\xff\xff\xff" + b"\0\0\0\x01\x07"
    expected = hmac.new(key, whole, hashlib.sha256).digest()[:MAC_OCTETS]
    for _ in range(2):
        assert macs.mac("kind", (value, None, b"\x07")) == expected
    assert macs.is_key(key)
    assert not macs.is_key(bytes(KEY_OCTETS))


def test_the_length_of_a_text_in_a_mac_counts_octets() -> None:
    key, text = bytes(range(KEY_OCTETS)), "5 °C"
    macs = RowMacs(lambda: pytest.fail("the vault is not asked"))
    macs.use(key)
    whole = b"kind\0" + b"\0\0\0" + bytes([5]) + text.encode()
    assert macs.mac("kind", (text,)) == hmac.new(key, whole, hashlib.sha256).digest()[:MAC_OCTETS]


def test_with_a_closed_vault_a_row_counts_and_holds_for_nobody() -> None:
    """Lists ask for no passphrase; what decides opens the vault first."""
    macs = RowMacs(lambda: pytest.fail("the vault is not asked"))
    assert not macs.active
    assert [macs.counts(mac, "kind", ("x",)) for mac in (None, b"", bytes(16))] == [True, True, True]
    assert not macs.is_key(bytes(32))
    macs.use(bytes(32))
    right = macs.mac("kind", ("x",))
    assert [macs.counts(mac, "kind", ("x",)) for mac in (None, b"", bytes(16), right)] == [False, False, False, True]
    assert [macs.holds(mac, "kind", ("x",)) for mac in (None, right, right[:8])] == [False, True, False]
    assert not macs.counts(right, "another kind", ("x",))
