"""What a station tells: in the transaction of the act, and nothing where none was joined."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from teds_provision.provisioning.agree import agree
from teds_provision.provisioning.identify import identify
from teds_provision.station.plant.plant import PlantRecord
from teds_provision.station.station import Station
from teds_provision.station.store.connection import Connection
from teds_provision.station.store.records import WhitelistEntry
from tests.bench import Board, make_station, talk

UUID = bytes.fromhex("8d4d9da65281f7000000")
REGISTRY = "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    station = make_station(tmp_path / "home")
    yield station
    station.close()


def test_a_station_without_a_registry_reports_nothing(station: Station) -> None:
    station.plant.record_event("named", UUID, name="grip")
    assert station.plant.unsent() == 0


def test_an_event_shares_the_fate_of_its_act(station: Station) -> None:
    station.plant.put_record(PlantRecord(REGISTRY))

    def fails() -> None:
        with station.transaction():
            station.plant.record_event("named", UUID, name="grip")
            raise KeyError

    with pytest.raises(KeyError):
        fails()
    assert station.plant.unsent() == 0
    with station.transaction():
        station.plant.record_event("named", UUID, name="grip")
    ((_, name, text),) = station.plant.outbox(10)
    record = json.loads(text)
    assert (record["id"], record["act"], record["name"]) == (name, "named", "grip")
    assert station.plant.claims.to_judge(10) == [UUID]


def test_a_station_that_left_reports_nothing_any_more(station: Station) -> None:
    station.plant.put_record(PlantRecord(REGISTRY, left="2026-01-31T12:00:00Z"))
    station.plant.record_event("named", UUID, name="grip")
    assert station.plant.unsent() == 0


def test_a_registry_costs_no_further_commit(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each commit waits for the disk: what is told goes with the act that tells it."""
    seen: list[str] = []
    execute = Connection.execute

    def counted(self: Connection, statement: str, values: Any = ()) -> Any:
        if statement == "COMMIT":
            seen.append(statement)
        return execute(self, statement, values)

    monkeypatch.setattr(Connection, "execute", counted)

    def commits() -> int:
        seen.clear()
        board = Board(os.urandom(10))
        with talk(board) as node:
            who = identify(station, node)
            agree(station, node, who, newcomer=WhitelistEntry(node.uuid, who.fingerprint, assurance="tap"))
        station.pins.put(WhitelistEntry(os.urandom(10), "ab" * 32, assurance="tap"))
        return len(seen)

    alone = commits()
    station.plant.put_record(PlantRecord(REGISTRY))
    assert commits() == alone > 0
    assert station.plant.unsent() >= 3, "pinned, agreed, pinned"
