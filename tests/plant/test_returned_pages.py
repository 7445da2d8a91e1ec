"""Losing the database costs nothing: pages of stations that left return by themselves (plant.md section 5)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision import plant as plant_room
from teds_provision.errors import StoreError
from teds_provision.plant.demo.cluster import Cluster
from teds_provision.plant.returned import FORGED
from teds_provision.plant.schema import close_sql, member_sql, mend_sql, registry_sql
from teds_provision.plant.scram import verifier
from teds_provision.protocol.plant.roster import Role, Why
from teds_provision.station.station import Station
from tests.plant.postgres import Login
from tests.plant.relay import relay
from tests.plant.test_returned_sql import as_schema_1, restore
from tests.plant.test_synced_by_database import Office

pytestmark = pytest.mark.system


class Loss(Office):
    """North (keeper, the CA key), south that measures, and a station that leaves; its pages are here and there."""

    def __init__(self, folder: Path, cluster: Cluster) -> None:
        super().__init__(folder, cluster)
        self.south = self.member("south", "base")

    def leaver(self, *roles: Role) -> Station:
        """Return a station that wrote two pages and that all stations have heard."""
        west = self.member("west", *roles)
        for _ in range(2):
            self.write(west)
            self.sync(west)
        self.sync(self.north, self.south, self.north)
        return west

    def write(self, station: Station) -> None:
        """Have the station say something with its next page."""
        with station.transaction():
            station.plant.record_event("named", os.urandom(10), name="a board")

    def remove(self, station: Station, why: Why = "stolen") -> None:
        last = self.north.plant.pages.chain(station.fingerprint).counted[0]
        self.plant.change(plant_room.owner.draft_removal(self.north, station.identity.name, why, last))
        self.sync(self.north)
        self.database.sql(close_sql(station.fingerprint))
        self.sync(self.south)

    def lose(self, *left: Station) -> None:
        """A new database in the place of the lost one; only those who are left can log in."""
        name = self.database.name
        self.database.cluster.psql(f"drop database {name} with (force)")
        self.database.cluster.psql(f"create database {name}")
        self.database.sql(registry_sql(self.database.registry))
        for station in left:
            self.database.sql(member_sql(station.fingerprint, verifier(self.secrets[station.fingerprint])))

    def pages_here(self, station: Station, of: Station) -> list[str]:
        return [hash for _, hash, _ in station.plant.pages.chain_links(station.plant.pages.chain(of.fingerprint).id)]

    def handed_in(self, of: Station) -> list[list[str]]:
        return self.database.sql(f"select n, hash from registry.found where author = '\\x{of.fingerprint}' order by n")

    def login(self, station: Station) -> Login:
        return Login(self.database, station.fingerprint, self.secrets[station.fingerprint])


@pytest.fixture
def loss(tmp_path: Path, cluster: Cluster) -> Iterator[Loss]:
    made = Loss(tmp_path, cluster)
    yield made
    made.plant.close()


OTHER_ROLES = pytest.mark.nightly(
    "tests/plant/test_returned_pages.py::test_the_pages_of_a_removed_station_return_whatever_it_was[roles0]"
)


@pytest.mark.parametrize(
    "roles",
    [
        ("line",),
        pytest.param(("keeper", "sign"), marks=OTHER_ROLES),
        *(pytest.param(roles, marks=pytest.mark.soak) for roles in [("sign",), ("base",), ("audit",)]),
    ],
)
def test_the_pages_of_a_removed_station_return_whatever_it_was(loss: Loss, roles: tuple[Role, ...]) -> None:
    west = loss.leaver(*roles)
    loss.remove(west)
    loss.lose(loss.north, loss.south)
    done = loss.sync(loss.south)
    assert done.returned == len(loss.pages_here(loss.south, west))
    assert loss.sync(loss.north).returned == 0, "south was there before"
    later = loss.member("later", "base")
    loss.sync(loss.north, later)
    assert loss.pages_here(later, west) == loss.pages_here(loss.north, west)
    assert plant_room.apply_pages.heads_digest(later) == plant_room.apply_pages.heads_digest(loss.north)


def test_a_datasheet_of_a_removed_signer_is_judged_by_a_station_that_joins_after_the_loss(loss: Loss) -> None:
    west = loss.leaver("line", "sign")
    signed = os.urandom(32)
    with west.transaction():
        west.plant.record_event("signed", os.urandom(10), epoch=1, sequence=1, teds_sha256=signed.hex())
    loss.sync(west, loss.north, loss.south)
    loss.remove(west)
    loss.lose(loss.north, loss.south)
    later = loss.member("later", "base")
    loss.sync(later)
    assert verdict(later, west, signed) == "unproven"
    loss.sync(loss.south, later)
    assert verdict(later, west, signed) == "passed"
    assert verdict(later, west, os.urandom(32)) == "failed"


def verdict(station: Station, signer: Station, digest: bytes) -> str:
    rules = station.policy.signer_rules()
    assert rules is not None
    request = rules.signing(station.ca, signer.point, digest)
    assert request is not None
    return request.result


def test_a_row_that_was_lost_is_filled_until_its_station_is_added_again(loss: Loss) -> None:
    west = loss.leaver("line")
    loss.lose(loss.north, loss.south)
    loss.sync(loss.south)
    assert len(loss.handed_in(west)) == len(loss.pages_here(loss.south, west))
    later = loss.member("later", "base")
    loss.sync(loss.north, later)
    assert loss.pages_here(later, west) == loss.pages_here(west, west)
    loss.known(west)
    assert any("rolled back" in line for line in loss.sync(west).remarks)
    loss.write(west)
    loss.sync(west, later)
    assert loss.pages_here(later, west) == loss.pages_here(west, west)


def test_an_older_database_gets_what_it_lacks_of_a_removed_station(loss: Loss) -> None:
    west = loss.leaver("line")
    newest = loss.north.plant.pages.chain(west.fingerprint).counted[0]
    loss.remove(west)
    loss.database.sql(mend_sql(west.fingerprint, newest))  # as the dump of yesterday has it
    loss.sync(loss.north)
    assert [row[0] for row in loss.handed_in(west)] == [str(newest)]
    later = loss.member("later", "base")
    loss.sync(loss.north, later)
    assert loss.pages_here(later, west) == loss.pages_here(loss.north, west)


@pytest.mark.nightly("tests/plant/test_synced_by_database.py::test_nothing_new_is_one_round_trip")
def test_nothing_new_is_one_round_trip_when_pages_were_handed_in(loss: Loss) -> None:
    west = loss.leaver("line")
    loss.remove(west)
    loss.lose(loss.north, loss.south)
    loss.sync(loss.south, loss.north, loss.south, loss.north, loss.south)
    with relay(loss.database.cluster.port) as way:
        transport = loss.transport(loss.south, port=way.port)
        transport.registry()
        before = way.sent
        done = plant_room.sync.sync(loss.south, transport)
        assert (done.returned, done.fetched, done.remarks) == (0, 0, [])
        assert way.sent - before == 1
        transport.close()


def test_a_sync_that_was_cut_hands_in_the_rest(loss: Loss) -> None:
    west = loss.leaver("line")
    loss.remove(west)
    loss.lose(loss.north, loss.south)
    loss.sync(loss.north, loss.south)
    loss.database.sql("delete from registry.found where n = 2; delete from registry.handed")
    loss.sync(loss.south)
    assert {row[0] for row in loss.handed_in(west)} >= {"1", "2"}


def test_forged_pages_and_a_wrong_author_are_passed_over_and_the_member_is_named(loss: Loss) -> None:
    west = loss.leaver("line")
    page = loss.north.plant.pages.get(
        loss.north.plant.pages.chain(west.fingerprint).id, 1, loss.pages_here(loss.north, west)[0]
    )
    assert page is not None
    genuine = plant_room.apply_pages.octets_of(page).decode()
    loss.remove(west)
    loss.lose(loss.north, loss.south)
    liar = loss.member("liar", "audit")
    forged = genuine[:-8] + ("AAAAAAAA" if genuine[-8:] != "AAAAAAAA" else "BBBBBBBB")
    with loss.login(liar).connect() as connection:
        assert restore(connection, west.fingerprint, 1, forged), "the same H, another signature"
        assert restore(connection, west.fingerprint, 2, genuine), "not its place"
        assert restore(connection, west.fingerprint, 3, f"h.{'x' * 200}.s")
        assert restore(connection, os.urandom(32).hex(), 1, genuine), "nobody's chain"
    loss.sync(loss.north, loss.south)
    later = loss.member("later", "base")
    loss.sync(loss.north, later)
    assert loss.pages_here(later, west) == loss.pages_here(loss.north, west)
    alarms = [alarm for alarm in later.plant.alarms.all() if alarm.code == FORGED]
    assert [alarm.about for alarm in alarms] == [liar.fingerprint]
    assert alarms[0].why == "liar handed in a page of west that west did not sign"
    loss.database.sql(f"delete from registry.found where by = '\\x{liar.fingerprint}'; delete from registry.handed")
    loss.database.sql(
        "insert into registry.handed select author, by, count(*), sum(octet_length(jws)), now()"
        " from registry.found group by author, by"
    )
    loss.sync(later)
    assert [alarm for alarm in later.plant.alarms.all() if alarm.code == FORGED] == []


def test_of_a_member_that_floods_with_forged_pages_only_the_first_few_are_read(loss: Loss) -> None:
    west = loss.leaver("line")
    loss.remove(west)
    loss.lose(loss.north, loss.south)
    liar = loss.member("liar", "audit")
    with loss.login(liar).connect() as connection:
        for n in range(1, 101):
            restore(connection, west.fingerprint, n, f"h.{'x' * 100_000}{n}.s")
    loss.sync(loss.north, loss.south)
    later = loss.member("later", "base")
    loss.sync(loss.north)
    with relay(loss.database.cluster.port) as way:
        transport = loss.transport(later, port=way.port)
        plant_room.sync.sync(later, transport)
        assert way.received < 2_000_000
        transport.close()
    assert loss.pages_here(later, west) == loss.pages_here(loss.north, west)


def test_another_history_that_a_thief_wrote_gives_way_to_the_rosters_last(loss: Loss, tmp_path: Path) -> None:
    """The thief signs another page 2 with the stolen key and has an accomplice hand it in first."""
    west = loss.leaver("line")
    chain = loss.north.plant.pages.chain(west.fingerprint)
    first = loss.pages_here(loss.north, west)[0]
    west.unlock()
    roster = loss.north.plant.roster
    assert roster is not None
    draft = plant_room.sync.PageDraft(
        roster.registry, 2, first, "0" * 16, plant_room.apply_pages.now(), {}, (1, "0" * 64)
    )
    other = plant_room.sync.sign_page(draft, [], west.credentials().key)
    loss.remove(west)
    loss.lose(loss.north, loss.south)
    liar = loss.member("liar", "audit")
    genuine = loss.north.plant.pages.get(chain.id, 1, first)
    assert genuine is not None
    with loss.login(liar).connect() as connection:
        restore(connection, west.fingerprint, 1, plant_room.apply_pages.octets_of(genuine).decode())
        restore(connection, west.fingerprint, 2, other.decode())
    later = loss.member("later", "base")
    loss.sync(later)
    assert later.plant.pages.chain(west.fingerprint).counted[0] == 1
    loss.sync(loss.north, later)
    counted = later.plant.pages.chain(west.fingerprint).counted
    assert counted == loss.north.plant.pages.chain(west.fingerprint).counted
    assert counted[0] >= 2


def test_the_limit_of_a_member_is_shown_and_others_carry_on(loss: Loss) -> None:
    west = loss.leaver("line")
    loss.remove(west)
    loss.lose(loss.north, loss.south)
    loss.database.sql(
        f"insert into registry.handed values ('\\x{os.urandom(32).hex()}', '\\x{loss.south.fingerprint}',"
        " 65536, 67108864, now())"
    )
    done = loss.sync(loss.south)
    assert done.returned == 0
    assert any("64 MiB" in line for line in done.remarks)
    assert loss.sync(loss.north).returned == len(loss.pages_here(loss.north, west))
    assert loss.sync(loss.south, loss.south).remarks == []


def test_a_database_of_schema_1_is_used_as_before_and_the_cure_is_named(loss: Loss) -> None:
    west = loss.leaver("line")
    loss.remove(west)
    as_schema_1(loss.database)
    loss.write(loss.south)
    done = loss.sync(loss.south)
    assert (done.pushed, done.returned, done.remarks) == (1, 0, [])
    loss.lose(loss.north, loss.south)
    as_schema_1(loss.database)
    for _ in range(2):
        assert any("registry sql | psql" in line for line in loss.sync(loss.south).remarks)
    loss.database.sql(registry_sql(loss.database.registry))
    assert loss.sync(loss.south).returned == len(loss.pages_here(loss.south, west))


def test_a_newer_schema_is_refused_whatever_tables_it_has(loss: Loss) -> None:
    for change in ("alter table registry.handed rename to later", "drop table registry.found"):
        loss.database.sql(f"update registry.meta set version = 3; {change}")
        with pytest.raises(StoreError, match="schema 3"):
            loss.sync(loss.south)


def test_a_home_from_a_backup_finds_its_own_pages_among_those_handed_in(loss: Loss) -> None:
    """The database is lost and a station's home, too: others have its pages, under its own key."""
    west = loss.leaver("line")
    chain = west.plant.pages.chain(west.fingerprint)
    loss.lose(loss.north, loss.south)
    loss.sync(loss.south)
    newest = chain.counted[0]
    hash = chain.counted[1]
    with west.transaction():  # as a backup from before its last page has it
        west._store.execute("DELETE FROM pages WHERE chain = ? AND hash = ?", (chain.id, hash))
        roster = west.plant.roster
        assert roster is not None
        plant_room.apply_pages.recount(west, chain, roster)
        west.unlock()
        west.plant.begin_restored()
    loss.known(west)
    assert "1 page that this station wrote before its backup is back" in loss.sync(west).remarks
    assert loss.pages_here(west, west)[newest - 1] == hash
    assert not west.plant.restored
