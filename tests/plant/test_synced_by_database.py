"""Stations that sync through a real PostgreSQL: pages, rosters, keys, and what the way does to them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from teds_provision import plant as plant_room
from teds_provision.errors import ForkError, NotAuthenticError, RegistryError
from teds_provision.plant.demo.cluster import Cluster
from teds_provision.plant.postgres import PostgresTransport, Registry, parameters
from teds_provision.plant.schema import member_sql, mend_sql, registry_sql
from teds_provision.plant.scram import verifier
from teds_provision.plant.sync import SyncResult, resume, sync
from teds_provision.protocol.plant.roster import Share
from teds_provision.station.station import Station
from teds_provision.station.store.records import TrustRecord, WhitelistEntry
from tests.cli.shell import call
from tests.plant.handing import board_of
from tests.plant.postgres import Database
from tests.plant.relay import relay
from tests.plant.stations import Plant, ask
from tests.plant.test_reported_firmware import OLD, board_with, look, version

pytestmark = pytest.mark.system


class Office:
    """A plant whose stations sync through a database of its own."""

    def __init__(self, folder: Path, cluster: Cluster) -> None:
        self.plant = Plant(folder)
        self.database = Database(cluster, f"plant_{os.urandom(4).hex()}", self.plant.roster.registry)
        cluster.psql(f"create database {self.database.name}")
        self.database.sql(registry_sql(self.database.registry))
        self.secrets: dict[str, bytes] = {}
        self.north = self.known(self.plant.north)

    def known(self, station: Station) -> Station:
        self.secrets[station.fingerprint] = secret = os.urandom(32)
        self.database.sql(member_sql(station.fingerprint, verifier(secret)))
        return station

    def member(self, name: str, *roles: Any) -> Station:
        made = self.known(self.plant.member(name, *roles))
        for station, other in ((made, self.north), (self.north, made)):
            if other.fingerprint not in station.policy.station_points():
                station.policy.trust(TrustRecord(other.name, "station", other.point, other.fingerprint))
        return made

    def transport(self, station: Station, **more: Any) -> PostgresTransport:
        settings = parameters(self.database.url, station.fingerprint, self.secrets[station.fingerprint])
        return PostgresTransport(Registry(settings | more), "the registry", station.fingerprint)

    def sync(self, *stations: Station) -> SyncResult:
        done = SyncResult()
        for station in stations:
            transport = self.transport(station)
            done = sync(station, transport)
            transport.close()
        return done


@pytest.fixture
def office(tmp_path: Path, cluster: Cluster) -> Iterator[Office]:
    made = Office(tmp_path, cluster)
    yield made
    made.plant.close()


def roster_with(office: Office, share: Share) -> None:
    office.plant.change(plant_room.owner.shared(office.north, share))


def test_pages_and_rosters_reach_all_stations(office: Office) -> None:
    south = office.member("south", "base")
    board = board_of(office.north, os.urandom(10))
    office.sync(office.north, south)
    assert south.plant.pages.chains()[office.north.fingerprint].counted == (
        office.north.plant.pages.chains()[office.north.fingerprint].counted
    )
    assert office.north.fingerprint in south.plant.claims.of_nodes([board.uuid])[board.uuid]
    west = office.member("west", "line")
    office.sync(office.north, south)
    assert south.plant.roster is not None
    assert south.plant.roster.member(west.fingerprint) is not None


def test_firmware_that_a_board_reported_reaches_the_other_station(office: Office) -> None:
    south = office.member("south", "base")
    board = board_with(office.north, OLD)
    look(office.north, board)
    office.sync(office.north, south)
    assert version(south, board) == ("1.2.0", "north")


def test_nothing_new_is_one_round_trip(office: Office) -> None:
    south = office.member("south", "base")
    office.sync(office.north, south, office.north, south)
    with relay(office.database.cluster.port) as way:
        transport = office.transport(south, port=way.port)
        transport.registry()
        before = way.sent
        done = sync(south, transport)
        assert (done.pushed, done.fetched, done.remarks) == (0, 0, [])
        assert way.sent - before == 1
        transport.close()


def test_a_shared_key_arrives_and_its_receipt_returns(office: Office) -> None:
    south = office.member("south", "base")
    roster_with(office, Share(("all", ""), (south.fingerprint,)))
    office.sync(office.north, south)
    board = board_of(office.north, os.urandom(10))
    office.sync(office.north)
    assert office.sync(south).parcels_in == 1
    assert [key.epoch for key in south.keys.keys_of(board.uuid)] == [1]
    assert office.sync(office.north).parcels_in == 1
    assert office.database.sql("select count(*) from registry.parcel") == [["0"]]
    assert plant_room.parcels.waiting_out(office.north) == 0


def test_a_database_that_was_lost_is_filled_by_its_members(office: Office, cluster: Cluster) -> None:
    south = office.member("south", "base")
    board_of(office.north, os.urandom(10))
    office.sync(office.north, south)
    before = office.database.sql("select n, jws from registry.page order by n, jws")
    cluster.psql(f"drop database {office.database.name} with (force)")
    cluster.psql(f"create database {office.database.name}")
    office.database.sql(registry_sql(office.database.registry))
    for station in (office.north, south):
        office.known(station)
    remarks = office.sync(office.north).remarks + office.sync(south).remarks
    assert any("rolled back" in line for line in remarks)
    assert office.database.sql("select n, jws from registry.page order by n, jws")[: len(before)] == before
    assert office.database.sql("select count(distinct jws) from registry.roster") == [["1"]]


def test_a_database_of_yesterday_is_brought_up_to_today(office: Office) -> None:
    south = office.member("south", "base")
    office.sync(office.north, south)
    board_of(office.north, os.urandom(10))
    office.sync(office.north)
    newest = office.north.plant.pages.chains()[office.north.fingerprint].counted[0]
    office.database.sql(mend_sql(office.north.fingerprint, newest))  # as if it had not come yet
    remarks = office.sync(office.north).remarks
    assert any(f"page {newest} was there, and now {newest - 1} is the last" in line for line in remarks), remarks
    assert [alarm.code for alarm in office.north.plant.alarms.all()] == ["rolled-back"]
    office.sync(south)
    assert south.plant.pages.chains()[office.north.fingerprint].counted[0] >= newest


def test_rows_that_a_stolen_login_wrote_stop_the_push_until_they_are_mended(office: Office) -> None:
    office.sync(office.north)
    transport = office.transport(office.north)
    transport.registry()
    n, digest = transport._look.heads[office.north.fingerprint]
    transport.append(office.north.fingerprint, n + 1, digest, "", b"h." + b"x" * 200 + b".s")
    board_of(office.north, os.urandom(10))
    with pytest.raises(NotAuthenticError, match="its key did not sign") as refused:
        office.sync(office.north)
    assert f"--mend north {n + 1}" in refused.value.hint
    office.database.sql(mend_sql(office.north.fingerprint, n + 1))
    assert office.sync(office.north).pushed == 1
    transport.close()


def test_a_database_without_room_is_reported_and_nothing_is_lost(office: Office) -> None:
    office.database.sql(
        "create function registry.no_room() returns trigger language plpgsql as $$ begin"
        " raise exception 'could not extend file: No space left on device' using errcode = '53100'; end $$;"
        " create trigger no_room before insert on registry.page execute function registry.no_room()"
    )
    board_of(office.north, os.urandom(10))
    with pytest.raises(RegistryError, match="full"):
        office.sync(office.north)
    office.database.sql("drop trigger no_room on registry.page")
    assert office.sync(office.north).pushed > 0
    assert office.north.plant.unsent() == 0


def test_a_sync_that_is_cut_anywhere_is_followed_by_the_same_sync(office: Office) -> None:
    south = office.member("south", "base")
    roster_with(office, Share(("all", ""), (south.fingerprint,)))
    board = board_of(office.north, os.urandom(10))
    with relay(office.database.cluster.port) as way:
        for after in range(2, 14):
            for station in (office.north, south):
                transport = office.transport(station, port=way.port)
                way.cut_after = way.sent + after
                with suppress(RegistryError):
                    sync(station, transport)
                way.cut_after = 0
                transport.close()
    office.sync(office.north, south, office.north)
    assert [key.epoch for key in south.keys.keys_of(board.uuid)] == [1]
    assert office.database.sql("select count(*) from registry.parcel") == [["0"]]
    assert office.database.sql("select count(*) = max(n) from registry.page group by station") == [["t"], ["t"]]


def test_the_doors_that_a_restore_opens_are_seen_by_every_member(office: Office) -> None:
    transport = office.transport(office.north)
    transport.registry()
    assert transport.open_doors() == []
    office.database.sql(f"grant temp on database {office.database.name} to public")  # as pg_restore does
    assert transport.open_doors() == ["TEMP for PUBLIC"]
    office.database.sql(registry_sql(office.database.registry))
    assert transport.open_doors() == []
    transport.close()


def test_what_the_database_allows_too_much_is_kept_for_the_status(office: Office) -> None:
    west, transport = office.member("west", "line"), office.transport(office.north)
    office.sync(office.north, west)
    assert plant_room.connecting.check_database(office.north, transport) == []
    office.plant.change(plant_room.owner.draft_removal(office.north, "west", "stolen", 0))
    assert plant_room.connecting.check_database(office.north, transport) == ["login of west, which was removed"]
    shown = call(office.north.home, "--json", "registry", "status").json
    assert shown["open_doors"] == ["login of west, which was removed"]
    removed = [item.fingerprint for item in office.north.plant.roster.removed]  # type: ignore[union-attr]
    office.database.sql(registry_sql(office.database.registry, removed))
    assert plant_room.connecting.check_database(office.north, transport) == []
    transport.close()


def test_a_copy_of_a_home_at_work_beside_it_stops_both_until_a_person_decides(office: Office) -> None:
    south = office.member("south", "base")
    office.sync(office.north, south)
    shutil.copytree(south.home, office.plant.folder / "copy")
    copy = Station.open(office.plant.folder / "copy", ask=ask)
    for n, station in enumerate((copy, south), 1):
        station.pins.put(WhitelistEntry(bytes([n] * 10), "ab" * 32, assurance="tap"))
    office.sync(copy)
    with pytest.raises(ForkError, match="a copy of this home is in use"):
        office.sync(south)
    assert office.database.sql("select count(*) from registry.page where n > 1") == [["0"]]
    transport = office.transport(south)
    assert resume(south, transport) == 1
    transport.close()
    office.sync(south)
    with pytest.raises(ForkError):
        office.sync(copy)
    office.sync(office.north)
    assert [alarm.code for alarm in office.north.plant.alarms.all()] == []
    events = [stated.event for stated in plant_room.status.log(office.north, of=south.fingerprint)]
    uuids = {event["uuid"] for event in events if event["act"] == "pinned"}
    assert uuids == {bytes([n] * 10).hex() for n in (1, 2)}
    copy.close()
