"""The service that follows a registry: woken by what others push, and unharmed by a registry that is gone."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.ncap.live import Live
from teds_provision.ncap.web.metrics import text
from teds_provision.plant import connecting, membership, service
from teds_provision.plant.demo.cluster import Cluster
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.schema import member_sql, registry_sql
from teds_provision.plant.service import EVERY, PlantWatch
from teds_provision.plant.sync import sync
from teds_provision.protocol.plant.document import open_request
from teds_provision.station.station import Station
from tests.pace import until
from tests.plant.handing import board_of
from tests.plant.postgres import Database
from tests.plant.stations import Plant
from tests.plant.test_synced_by_database import Office

pytestmark = pytest.mark.system


@pytest.fixture
def office(tmp_path: Path, cluster: Cluster) -> Iterator[Office]:
    made = Office(tmp_path, cluster)
    made.member("south", "base")
    yield made
    made.plant.close()


def by_url(office: Office, station: Station) -> Station:
    """Joined by the database's URL and the login of its own request, as `registry connect` does it."""
    from dataclasses import replace

    asked = open_request(membership.request(station))
    office.database.sql(member_sql(asked.fingerprint, asked.login))
    record = station.plant.joined
    assert record is not None
    station.plant.put_record(replace(record, url=office.database.url))
    return station


def synced(station: Station) -> None:
    transport = connecting.open_transport(station)
    assert transport is not None
    sync(station, transport)
    transport.close()


def watching(station: Station) -> tuple[PlantWatch, list[dict[str, Any]], list[float]]:
    live, published, changed = Live(), list[dict[str, Any]](), list[float]()
    live.on_event = published.append
    return PlantWatch(station, live, lambda: changed.append(time.monotonic())), published, changed


def test_what_another_station_pushes_arrives_without_waiting_for_the_minute(office: Office) -> None:
    north, south = by_url(office, office.north), by_url(office, office.plant.stations[1])
    synced(north)
    watch, published, changed = watching(south)
    watch.start()
    try:
        until(lambda: any(entry["state"] == "synced" for entry in published), published)
        for _ in range(2):  # the first may come by the sync that follows listening, the second by its notification
            board = board_of(north, os.urandom(10))
            before = len(changed)
            synced(north)
            pushed = time.monotonic()
            until(lambda before=before: len(changed) > before, "it was not woken")
            assert changed[before] - pushed < EVERY / 2, "only by the minute"
        assert north.fingerprint in south.plant.claims.of_nodes([board.uuid])[board.uuid]
        status = watch.status()
        assert status is not None
        assert [station["name"] for station in status["stations"]] == ["north", "south"]
        assert (status["state"], status["unsent"]) == ("synced", 0)
        lines = text({"version": "1", "station": {"name": "south"}, "links": [], "measurements": [], "sinks": [],
                      "budget": {"used": 0}, "clients": 0}, [watch])  # fmt: skip
        assert "teds_registry_alarms 0\n" in lines
        assert "teds_registry_age_seconds " in lines
    finally:
        watch.stop()


def test_the_service_follows_the_registry_to_another_database(
    office: Office, cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It went on with the old one, and said "synced", until it was started anew; nothing of the new one arrived."""
    monkeypatch.setattr(service, "EVERY", 0.5)
    north, south = by_url(office, office.north), by_url(office, office.plant.stations[1])
    first = office.database
    board_of(north, os.urandom(10))
    synced(north)
    watch, published, _ = watching(south)
    watch.start()
    try:
        until(lambda: any(entry["state"] == "synced" for entry in published), published)
        office.database = Database(cluster, f"{first.name}_new", first.registry)
        cluster.psql(f"create database {office.database.name}")
        office.database.sql(registry_sql(first.registry))
        for station in (north, south):
            asked = open_request(membership.request(station))
            office.database.sql(member_sql(asked.fingerprint, asked.login))
            with station.transaction():
                station.plant.join(first.registry, office.database.url)
        for _ in range(2):  # by a sync of its own, then by the notification of the new database
            board = board_of(north, os.urandom(10))
            synced(north)
            until(lambda uuid=board.uuid: uuid in south.plant.claims.of_nodes([uuid]), published)
        assert south.plant.alarms.all() == north.plant.alarms.all() == []
        assert first.sql("select max(n) from registry.page") == [["1"]]
    finally:
        watch.stop()


def test_a_registry_that_is_gone_is_reported_once_and_stops_nothing(office: Office, cluster: Cluster) -> None:
    south = by_url(office, office.plant.stations[1])
    cluster.psql(f"alter database {office.database.name} allow_connections false")
    watch, published, _ = watching(south)
    watch.start()
    try:
        until(lambda: any(entry["state"] == "unreachable" for entry in published), published)
        watch._wake.set()
        time.sleep(0.3)
        assert [entry["state"] for entry in published] == ["unreachable"]
    finally:
        watch.stop()


def test_a_database_is_looked_over_once_an_hour(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    looked, clock = list[float](), [1000.0]
    home = Plant(tmp_path)
    monkeypatch.setattr(connecting, "open_transport", lambda station: FolderTransport(home.stick))
    monkeypatch.setattr(connecting, "check_database", lambda station, transport: looked.append(clock[0]))
    monkeypatch.setattr(service, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    watch, _, _ = watching(home.north)
    for clock[0] in (1000.0, 1060.0, 4599.0, 4600.0, 4660.0):
        assert not watch._sync()
    assert looked == [1000.0, 4600.0]
    home.close()


def test_an_alarm_is_reported(office: Office) -> None:
    from teds_provision.station.plant.alarms import Alarm

    south = by_url(office, office.plant.stations[1])
    south.plant.alarms.put(Alarm("junk", office.north.fingerprint, 1, "something is there"))
    watch, published, _ = watching(south)
    watch.start()
    try:
        until(lambda: any(entry["state"] == "alarm" for entry in published), published)
    finally:
        watch.stop()


def test_a_removed_station_is_told_so_once_and_goes_on_by_itself(office: Office) -> None:
    from teds_provision import plant

    south = by_url(office, office.plant.stations[1])
    office.plant.change(plant.owner.draft_removal(office.north, "south", "retired", None))
    office.sync(office.north)
    watch, published, _ = watching(south)
    watch.start()
    try:
        until(lambda: any(entry["state"] == "removed" for entry in published), published)
        assert [entry["state"] for entry in published] == ["removed"]
    finally:
        watch.stop()
