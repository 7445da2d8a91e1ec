"""What a station finds under its own key before it adds a page: nothing new, its own pages, or another home's."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from teds_provision import plant
from teds_provision.errors import ForkError, LinkError, NotAuthenticError, PolicyError
from teds_provision.plant.apply_pages import alarm
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.sync import SyncResult, acknowledge, own_chain, resume, sync
from teds_provision.plant.transport import CarriedPage
from teds_provision.protocol.plant.document import hash_of
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry
from tests.plant.stations import Plant, ask


class Registry(FolderTransport):
    """A transport as a registry's database is one: each member appends its own pages and reads those that it lacks."""

    carries_all = False

    def pages(self, station: str, after: int) -> Iterator[CarriedPage]:
        return (page for page in super().pages(station, after) if page.number > after)


class West:
    """A station whose pages are few, and copies of its home as it was before."""

    def __init__(self, plants: Plant) -> None:
        self.plants, self.stick = plants, plants.stick
        self.station = plants.member("west", "line", "sign")
        self.others: list[Station] = []
        self.pins = 0

    def write(self, station: Station | None = None) -> None:
        """Have something to put into the next page."""
        self.pins += 1
        (station or self.station).pins.put(WhitelistEntry(bytes([self.pins] * 10), "ab" * 32, assurance="tap"))

    def page(self, station: Station | None = None) -> SyncResult:
        """Write a page into the registry."""
        self.write(station)
        return self.sync(station)

    def sync(self, station: Station | None = None, *, connected: bool = True, folder: Path | None = None) -> SyncResult:
        return sync(station or self.station, Registry(folder or self.stick), connected=connected)

    def copy(self, name: str = "yesterday", *, restored: bool = True) -> Station:
        """Return its home as it is now, in another folder: a backup rebuilt it."""
        self.station.close()
        shutil.copytree(self.plants.folder / "west", self.plants.folder / name)
        self.station = Station.open(self.plants.folder / "west", ask=ask)
        copy = Station.open(self.plants.folder / name, ask=ask)
        self.others.append(copy)
        if restored:
            copy.unlock()
            copy.plant.begin_restored()
        return copy

    def file(self, number: int) -> Path:
        return self.stick / self.station.fingerprint / f"{number}.jws"

    def close(self) -> None:
        for station in (self.station, *self.others):
            station.close()


@pytest.fixture
def west(tmp_path: Path) -> Iterator[West]:
    plants = Plant(tmp_path)
    made = West(plants)
    yield made
    made.close()
    plants.close()


def alarms(station: Station) -> list[str]:
    return [alarm.code for alarm in station.plant.alarms.all()]


def about_the_backup(done: SyncResult) -> list[str]:
    return [remark for remark in done.remarks if "backup" in remark]


def joined_by(station: Station, url: str | None) -> None:
    joined = station.plant.joined
    assert joined is not None
    station.plant.put_record(replace(joined, url=url))


class ReadOnlyRegistry(Registry):
    """A registry that is gone when a page is to be appended."""

    def append(self, station: str, n: int, previous: str, hash: str, octets: bytes) -> None:
        raise LinkError("The connection broke.")


@pytest.mark.parametrize("genuine", [0, 2])
def test_a_page_under_ones_own_name_that_ones_key_did_not_sign_stops_all(west: West, genuine: int) -> None:
    """Also beside genuine pages that come with it: nothing is pushed until a person has deleted it there."""
    for _ in range(genuine):
        west.page()
    copy = west.copy(restored=False)
    west.page()
    west.page()
    number = genuine + 3
    west.file(number).write_bytes(west.file(number - 1).read_bytes()[:-4] + b"AAAA")
    west.write(copy)
    kept = sorted(file.name for file in west.file(1).parent.iterdir())
    with pytest.raises(NotAuthenticError) as stopped:
        west.sync(copy)
    assert f"from number {number} on" in stopped.value.message
    assert f"registry sql --mend west {number}" in stopped.value.hint
    assert alarms(copy) == ["junk"]
    assert sorted(file.name for file in west.file(1).parent.iterdir()) == kept


def test_a_registry_that_forgot_pages_is_refilled_and_that_is_an_alarm(west: West) -> None:
    assert west.page().remarks == []
    assert west.sync().remarks == []
    for left in (0, 1, 0):
        newest = west.station.plant.pages.chain(west.station.fingerprint).counted[0]
        for number in range(left + 1, newest + 1):
            west.file(number).unlink()
        elsewhere = west.plants.folder / f"another {newest}"
        elsewhere.mkdir()
        assert west.sync(connected=False, folder=elsewhere).remarks == [], "it is not what this station joined by"
        assert sync(west.station, FolderTransport(elsewhere)).remarks == [], "a folder need not have them"
        with pytest.raises(LinkError):
            sync(west.station, ReadOnlyRegistry(west.stick))
        acknowledge(west.station)
        (remark,) = west.sync().remarks
        assert f"was rolled back: page {newest} was there, and now {left} is the last; it is being refilled" in remark
        assert west.file(newest).exists()
        (raised,) = (raised for raised in west.station.plant.alarms.all() if raised.n == newest)
        assert (raised.code, raised.seen) == ("rolled-back", False), "it happened once more since it was seen"
        assert west.sync().remarks == []


@pytest.mark.parametrize(
    ("count", "message"),
    [
        (1, "1 page that this station wrote before its backup is back"),
        (2, "2 pages that this station wrote before its backup are back"),
    ],
)
def test_a_rebuilt_home_takes_back_what_it_wrote_since(west: West, count: int, message: str) -> None:
    west.page()
    back = west.copy()
    for _ in range(count):
        west.page()
    alarm(back, "fork", back.fingerprint, 2, "a look while a page was missing")
    assert about_the_backup(west.sync(back)) == [message]
    assert not alarms(back)
    assert not back.plant.restored
    assert west.page(back).remarks == []


@pytest.mark.parametrize(
    ("url", "connected", "ends"),
    [(None, False, True), ("postgresql://plant", True, True), ("postgresql://plant", False, False)],
)
def test_a_rebuilt_home_goes_on_once_it_has_looked_where_its_pages_would_be(
    west: West, url: str | None, connected: bool, ends: bool
) -> None:
    west.page()
    back = west.copy()
    joined_by(back, url)
    west.write(back)
    remarks = about_the_backup(west.sync(back, connected=connected))
    assert back.plant.restored is not ends
    assert west.file(2).exists() is ends
    assert [remark.partition(" and ")[2] for remark in remarks] == (
        [] if ends else ["publishes nothing new until it has synced with its own registry"]
    )


def test_a_rebuilt_home_goes_on_if_a_stick_brings_its_pages(west: West) -> None:
    west.page()
    back = west.copy()
    joined_by(back, "postgresql://plant")
    west.page()
    assert about_the_backup(west.sync(back, connected=False)) == [
        "1 page that this station wrote before its backup is back"
    ]
    assert not back.plant.restored


def test_a_rebuilt_home_compares_its_first_page_too(west: West) -> None:
    twin = west.copy("twin", restored=False)
    west.page()
    kept = west.file(1).read_bytes()
    west.file(1).unlink()
    west.page(twin)
    other = west.file(1).read_bytes()
    west.file(1).write_bytes(kept)
    west.sync()
    back = west.copy()
    west.file(1).write_bytes(other)
    with pytest.raises(ForkError):
        west.sync(back)


def test_what_others_report_of_pages_that_are_missing_stops_a_rebuilt_home_alone(west: West) -> None:
    """A member may lie: a home that lost nothing knows its pages, and goes on."""
    west.page()
    for back in (west.copy(), west.station):
        with back.transaction():
            north = back.plant.pages.chain(west.plants.north.fingerprint).id
            back.plant.pages.put_heads(north, {back.fingerprint: (9, "ab" * 32)})
        if back is west.station:
            assert west.page().pushed == 1
        else:
            with pytest.raises(PolicyError, match="has seen its page 9, but the last one here is 1"):
                west.sync(back)


def another_wrote(west: West) -> Station:
    """Return a copy that wrote a page of its own, of which the first one hears where it syncs."""
    copy = west.copy("copy", restored=False)
    west.page(copy)
    west.write()
    return copy


def nothing_more(west: West) -> None:
    """The registry shows the other's page no more."""


def not_there(west: West) -> None:
    west.file(2).unlink()


@pytest.mark.parametrize("later", [nothing_more, not_there])
def test_pages_that_another_home_wrote_stop_everything_until_a_person_decides(
    west: West, later: Callable[[West], None]
) -> None:
    west.page()
    another_wrote(west)
    with pytest.raises(ForkError, match="a copy of this home is in use"):
        west.sync()
    later(west)
    for _ in range(2):
        with pytest.raises(ForkError):
            west.sync()
    assert alarms(west.station) == ["fork"]
    assert resume(west.station, Registry(west.stick)) == (1 if later is nothing_more else 0)
    west.sync()
    assert alarms(west.station) == []
    assert west.file(2).exists()


def test_a_rebuilt_home_goes_on_if_only_a_removed_station_or_its_own_newest_page_is_reported(west: West) -> None:
    south = west.plants.member("south", "base")
    west.page()
    west.plants.change(plant.owner.draft_removal(west.plants.north, "south", "lost", 0))
    west.plants.sync(west.plants.north)
    back = west.copy()
    west.sync(back, connected=False)  # it takes the roster, and does not know of the registry yet
    back.plant.begin_restored()
    chain = own_chain(back)
    with back.transaction():
        pages = back.plant.pages
        pages.put_heads(pages.chain(south.fingerprint).id, {back.fingerprint: (9, "ab" * 32)})
        pages.put_heads(pages.chain(west.plants.north.fingerprint).id, {back.fingerprint: chain.counted})
    west.write(back)
    west.sync(back)
    assert not back.plant.restored
    assert own_chain(back).counted[0] == chain.counted[0] + 1


def test_a_decision_makes_another_home_of_it_that_has_nothing_acknowledged(west: West) -> None:
    west.page()
    another_wrote(west)
    with pytest.raises(ForkError):
        west.sync()
    home, joined = west.station.plant.home, west.station.plant.joined
    assert joined is not None
    assert joined.acknowledged == 1
    assert resume(west.station, Registry(west.stick)) == 1
    entry = list(west.station.audit_log.entries())[-1]
    assert (entry.act, entry.outcome, entry.detail) == ("registry", "resumed", {"adopted": 1})
    joined = west.station.plant.joined
    assert joined is not None
    assert joined.acknowledged == 0
    assert west.station.plant.home != home, "a copy that is found later can be told from it"
    west.sync()
    page = next(west.station.plant.pages.each(own_chain(west.station).id, 2))
    assert page.home == west.station.plant.home


def test_what_a_lost_page_said_is_said_again_but_for_what_the_adopted_pages_have(west: West) -> None:
    west.page()
    west.write()  # both homes publish this
    copy = west.copy("copy", restored=False)
    west.sync(copy)
    elsewhere = west.plants.folder / "elsewhere"
    elsewhere.mkdir()
    for _ in range(3):
        west.write()
        west.sync(connected=False, folder=elsewhere)
    assert west.station.plant.outbox(9) == []
    assert own_chain(west.station).counted[0] == 4
    with pytest.raises(ForkError):
        west.sync()
    assert resume(west.station, Registry(west.stick)) == 1
    waiting = [json.loads(text) for _, _, text in west.station.plant.outbox(9)]
    assert [one["uuid"] for one in waiting if one["act"] == "pinned"] == ["03" * 10, "04" * 10, "05" * 10]
    adopted = own_chain(west.station).counted
    assert adopted[0] == 2
    assert west.sync().pushed == 1, "no page of the history that was given up"
    newest = own_chain(west.station).counted
    row = west.station.plant.pages.get(own_chain(west.station).id, *newest)
    assert row is not None
    assert (row.n, row.previous) == (3, adopted[1])
    joined_by(west.station, "postgresql://plant")
    assert west.station.plant.unsent() == 0
    west.write()
    assert west.station.plant.unsent() == 1
    assert hash_of(west.file(3).read_bytes().strip()) == newest[1]


def test_a_sync_reports_a_roster_that_it_refuses_and_posts_its_own(west: West) -> None:
    west.sync()
    held = west.station.plant.roster
    assert held is not None
    ahead = replace(
        plant.owner.following(west.plants.north, expires=held.created + timedelta(days=399)),
        created=held.created + timedelta(days=30),
    )
    elsewhere = west.plants.folder / "elsewhere"
    (elsewhere / "roster").mkdir(parents=True)
    (elsewhere / "roster/9.jws").write_bytes(plant.owner.signed(west.plants.north, ahead).octets)
    (remark,) = west.sync(connected=False, folder=elsewhere).remarks
    assert remark.startswith(f"roster {held.version + 1}: refused: it is dated in the future")
    assert (elsewhere / f"roster/{held.version}.jws").read_bytes().strip() == held.octets
