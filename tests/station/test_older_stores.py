"""Stores of before KeyAgreement 2 are refused by name, and nothing of them is read."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from teds_provision.errors import StoreError
from teds_provision.station.groups import is_valid_name, valid_name
from teds_provision.station.station import Station
from teds_provision.station.store.schema import APPLICATION_ID, OLDEST_SCHEMA, SCHEMA_VERSION, statements
from teds_provision.station.store.store import Store
from tests.bench import make_station


def stamped(home: Path, version: int) -> bytes:
    """The station's store says that it is of another schema; its octets."""
    with closing(sqlite3.connect(home / "store.sqlite3")) as connection:
        connection.execute(f"PRAGMA user_version={version}")
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    return (home / "store.sqlite3").read_bytes()


@pytest.mark.parametrize("version", range(1, OLDEST_SCHEMA))
def test_a_store_of_before_key_agreement_2_is_refused_and_left_as_it_is(tmp_path: Path, version: int) -> None:
    home = tmp_path / "home"
    make_station(home).close()
    before = stamped(home, version)
    with pytest.raises(StoreError, match="from before KeyAgreement 2") as error:
        Store.open(home)
    assert error.value.exit_code == 7
    assert "init" in error.value.hint
    assert (home / "store.sqlite3").read_bytes() == before


def test_a_store_of_a_later_schema_is_refused(tmp_path: Path) -> None:
    home = tmp_path / "home"
    make_station(home).close()
    stamped(home, SCHEMA_VERSION + 1)
    with pytest.raises(StoreError, match="knows up to"):
        Store.open(home)


def tables(path: Path) -> dict[str, list[tuple[object, ...]]]:
    """Columns of every table, and the statements of every index and trigger."""
    with closing(sqlite3.connect(path)) as connection:
        names = connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'").fetchall()
        found = {name: connection.execute(f"PRAGMA table_info({name})").fetchall() for (name,) in names}
        rest = connection.execute("SELECT name, sql FROM sqlite_schema WHERE type <> 'table' ORDER BY name").fetchall()
        return {**found, "": rest}


def test_a_measurement_of_an_earlier_schema_gets_an_owner(tmp_path: Path) -> None:
    """What lasted was begun by the service; what ended with its command is that of a command which has ended."""
    home = tmp_path / "home"
    home.mkdir(mode=0o700)
    with closing(sqlite3.connect(home / "store.sqlite3")) as connection:
        for statement in statements(0, 12):
            connection.execute(statement)
        connection.execute("INSERT INTO meta VALUES('id', 'ab')")
        connection.execute("INSERT INTO groups VALUES('arm', '2026-01-01T00:00:00Z')")
        for name, lasting in (("kept", 1), ("cut", 0)):
            columns = (
                "id, group_name, uuids, channels, trigger, actuators, dead_man, scalar_rate, sinks, lasting, created"
            )
            values = (name, "arm", "[]", "[2]", 1, 0, 500, 5.0, '["ros2"]', lasting, "2026-01-01T00:00:00Z")
            marks = ", ".join("?" * len(values))
            connection.execute(f"INSERT INTO measurements({columns}) VALUES({marks})", values)
        connection.execute(f"PRAGMA application_id={APPLICATION_ID}")
        connection.execute("PRAGMA user_version=12")
        connection.commit()
    with closing(Station.inspect(home)) as store:
        kept = {measurement.id: measurement for measurement in store.measurements._rows()}
        measurements = store.measurements
        continued = measurements.settings_to_continue("arm")
        assert [measurement.id for measurement in measurements.all()] == ["kept"], (
            "the next reader removes that of a dead command"
        )
    assert {name: measurement.owner for name, measurement in kept.items()} == {"kept": "ncap", "cut": "command"}
    assert (kept["kept"].channels, kept["kept"].sinks, kept["kept"].lasting) == ((2,), ("ros2",), True)
    assert continued is not None
    assert (continued.owner, continued.id, continued.channels) == ("command", "", (2,))


def test_groups_of_an_earlier_schema_are_kept_once(tmp_path: Path) -> None:
    """A bundle or `replace` wrote groups into the rows of nodes, `group` into a table: the store keeps the union."""
    home, nodes = tmp_path / "home", [bytes([number]) * 10 for number in range(1, 4)]
    labels = [["arm", "left hand"], ["all", "beef", "0xBEEF", ".", "Bé" * 100], []]
    home.mkdir(mode=0o700)
    with closing(sqlite3.connect(home / "store.sqlite3")) as connection:
        for statement in statements(0, 13):
            connection.execute(statement)
        connection.execute("INSERT INTO meta VALUES('id', 'ab')")
        connection.execute("INSERT INTO groups VALUES('arm', '2026-01-01T00:00:00Z')")
        connection.execute("INSERT INTO group_members VALUES('arm', ?)", (nodes[2],))
        for number, retired in ((8, "decommissioned, unconfirmed"), (9, "replaced by " + nodes[0].hex())):
            connection.execute(
                "INSERT INTO nodes(uuid, state, epoch, sequence, can_address, groups, channels, retired)"
                " VALUES(?, 0, 0, 0, 0, '[\"arm\"]', 0, ?)",
                (bytes([number]) * 10, retired),
            )
            connection.execute("INSERT INTO group_members VALUES('arm', ?)", (bytes([number]) * 10,))
        for uuid, of_node in zip(nodes, labels, strict=True):
            row = (uuid, json.dumps(of_node))
            connection.execute(
                "INSERT INTO nodes(uuid, state, epoch, sequence, can_address, groups, channels)"
                " VALUES(?, 0, 0, 0, 0, ?, 0)",
                row,
            )
        connection.execute(f"PRAGMA application_id={APPLICATION_ID}")
        connection.execute("PRAGMA user_version=13")
        connection.commit()
    with closing(Station.inspect(home)) as store:
        found = {group.name: group.uuids for group in store.groups.all()}
        assert store.nodes.get(nodes[0]) is not None
    assert found.pop("arm") == (nodes[0], nodes[2])
    assert found.pop("left hand") == (nodes[0],)
    assert found == {valid_name(label): (nodes[1],) for label in labels[1]}
    assert all(map(is_valid_name, found))


@pytest.mark.parametrize("version", range(OLDEST_SCHEMA, SCHEMA_VERSION))
def test_a_store_of_an_earlier_schema_becomes_one_of_today_s(tmp_path: Path, version: int) -> None:
    home, fresh = tmp_path / "home", tmp_path / "fresh"
    for folder in (home, fresh):
        folder.mkdir(mode=0o700)
    with closing(sqlite3.connect(home / "store.sqlite3")) as connection:
        for statement in statements(0, version):
            connection.execute(statement)
        connection.execute("INSERT INTO meta VALUES('id', 'ab')")
        connection.execute("INSERT INTO topics VALUES(?, 1, 'grip')", (bytes(10),))
        connection.execute(f"PRAGMA application_id={APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version={version}")
        connection.commit()
    Store.open(home).close()
    Store.open(fresh, create=True).close()
    assert tables(home / "store.sqlite3") == tables(fresh / "store.sqlite3")
    with closing(sqlite3.connect(home / "store.sqlite3")) as connection:
        assert connection.execute("SELECT name FROM topics").fetchall() == [("grip",)]
