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


def test_each_change_of_a_group_is_reported_once_and_what_changes_nothing_is_not(station: Station) -> None:
    station.plant.put_record(PlantRecord(REGISTRY))
    one, two, three = (UUID[:-1] + bytes([number]) for number in range(1, 4))

    def reported() -> list[tuple[int, bool]]:
        waiting = station.plant.outbox(99)
        station.plant.drop_events(name for _, name, _ in waiting)
        events = [json.loads(text) for _, _, text in waiting]
        assert {(event["act"], event["group"]) for event in events} <= {("grouped", "hand")}
        return [(bytes.fromhex(event["uuid"])[-1], event["member"]) for event in events]

    for _ in range(2):
        station.groups.create("hand", [one, two])
    assert reported() == [(1, True), (2, True)]
    station.groups.add("hand", [two, three, three])
    assert reported() == [(3, True)]
    station.groups.remove("hand", [three, UUID])
    assert reported() == [(3, False)]
    assert station.groups.hand_on(one, two) == ["hand"]
    assert reported() == [(1, False)], "the other one was in it"
    assert station.groups.hand_on(two, three) == ["hand"]
    assert reported() == [(2, False), (3, True)]
    assert station.groups.hand_on(three, None) == ["hand"]
    assert reported() == [(3, False)]
    station.groups.add("hand", [one])
    assert station.groups.delete("hand")
    assert not station.groups.delete("hand")
    assert reported() == [(1, True), (1, False)]


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
