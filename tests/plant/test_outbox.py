"""What a station tells: in the transaction of the act, and nothing where none was joined."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.station.station import Station
from teds_provision.store.tables.plant import PlantRecord
from tests.bench import make_station

UUID = bytes.fromhex("8d4d9da65281f7000000")
REGISTRY = "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    station = make_station(tmp_path / "home")
    yield station
    station.close()


def test_who_joined_no_registry_tells_nothing(station: Station) -> None:
    station.plant.tell("named", UUID, name="grip")
    assert station.plant.tables.unsent() == 0


def test_an_event_shares_the_fate_of_its_act(station: Station) -> None:
    station.plant.tables.put_plant(PlantRecord(REGISTRY))

    def fails() -> None:
        with station.transaction():
            station.plant.tell("named", UUID, name="grip")
            raise KeyError

    with pytest.raises(KeyError):
        fails()
    assert station.plant.tables.unsent() == 0
    with station.transaction():
        station.plant.tell("named", UUID, name="grip")
    ((_, name, text),) = station.plant.tables.outbox(10)
    told = json.loads(text)
    assert (told["id"], told["act"], told["name"]) == (name, "named", "grip")
    assert station.plant.tables.to_judge(10) == [UUID]


def test_who_left_tells_nothing_any_more(station: Station) -> None:
    station.plant.tables.put_plant(PlantRecord(REGISTRY, left="2026-01-31T12:00:00Z"))
    station.plant.tell("named", UUID, name="grip")
    assert station.plant.tables.unsent() == 0
