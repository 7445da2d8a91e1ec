"""What a transport carries is read in its own place and in order, and a job only in its own registry."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.errors import NotAuthenticError, PolicyError
from teds_provision.plant.fetching import Taken, note_waiting, open_carried, take_carried
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.jobs import read_job
from teds_provision.plant.transport import CarriedPage
from teds_provision.station.station import Station
from tests.plant.owner import alone, job_of
from tests.plant.stations import Plant

UUIDS = [bytes.fromhex("8d4d9da65281f7") + number.to_bytes(3, "big") for number in range(3)]


@pytest.fixture
def plants(tmp_path: Path) -> Iterator[Plant]:
    made = Plant(tmp_path)
    yield made
    made.close()


def pages_of(plants: Plant, author: Station) -> list[CarriedPage]:
    """Have ``author`` state three things, each on a page of its own; the other stations have not read them."""
    for uuid in UUIDS:
        with author.transaction():
            author.plant.record_name(uuid, f"arm {uuid[-1]}")
        plants.sync(author)
    return list(FolderTransport(plants.stick).pages(author.fingerprint, 0))


def test_a_page_counts_only_under_its_author_and_its_number(plants: Plant) -> None:
    west, south = plants.member("west", "base"), plants.member("south", "base")
    plants.round()
    roster = plants.north.plant.roster
    assert roster is not None
    page = pages_of(plants, west)[-1]

    assert open_carried(page, roster, west.fingerprint).number == page.number
    with pytest.raises(NotAuthenticError, match="in the place of another page"):
        open_carried(CarriedPage(west.fingerprint, page.number + 1, page.octets), roster, west.fingerprint)
    with pytest.raises(NotAuthenticError, match="in the place of another page"):
        open_carried(CarriedPage(south.fingerprint, page.number, page.octets), roster, south.fingerprint)


def test_pages_behind_a_gap_wait_until_it_is_filled(plants: Plant) -> None:
    west = plants.member("west", "base")
    plants.round()
    north, roster = plants.north, plants.north.plant.roster
    assert roster is not None
    before = len(north.plant.pages.chain_links(north.plant.pages.chain(west.fingerprint).id))
    first, second, third = pages_of(plants, west)[-3:]

    assert take_carried(north, roster, west.fingerprint, [first, third]).pages == 1
    assert take_carried(north, roster, west.fingerprint, [third]).pages == 0
    assert take_carried(north, roster, west.fingerprint, [second, third]).pages == 2
    assert len(north.plant.pages.chain_links(north.plant.pages.chain(west.fingerprint).id)) == before + 3


def test_a_chain_waits_for_a_newer_version_until_it_is_read_on(plants: Plant) -> None:
    west = plants.member("west", "base")
    for waits in ("A page of format 9.", None):
        note_waiting(plants.north, west.fingerprint, Taken(waits=waits))
        assert plants.north.plant.pages.chain(west.fingerprint).waits == waits


def test_the_page_of_a_newer_version_is_the_one_after_the_newest_that_is_here(plants: Plant) -> None:
    west = plants.member("west", "base")
    pages_of(plants, west)
    plants.round()
    pages = plants.north.plant.pages
    newest = max(n for n, _, _ in pages.chain_links(pages.chain(west.fingerprint).id))
    assert newest >= 3
    for author in (west.fingerprint, "ab" * 32):
        note_waiting(plants.north, author, Taken(waits="A page of format 9."))
    found = {alarm.about: (alarm.code, alarm.n, alarm.why) for alarm in plants.north.plant.alarms.all()}
    assert found == {
        west.fingerprint: ("newer-format", newest + 1, "A page of format 9."),
        "ab" * 32: ("newer-format", 1, "A page of format 9."),
    }


def test_a_job_of_another_registry_is_refused_though_a_keeper_signed_it(tmp_path: Path) -> None:
    keeper = alone(tmp_path / "home")
    assert read_job(keeper, job_of(keeper)).title == "three angles"
    with pytest.raises(PolicyError, match="another registry"):
        read_job(keeper, job_of(keeper, registry="11111111-2222-4333-8444-555555555555"))
    keeper.close()
