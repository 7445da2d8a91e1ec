"""Whose datasheets count in a plant: real ones, signed by stations of one CA, judged at another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest

from teds_provision import plant
from teds_provision.errors import PolicyError, UnprovenError
from teds_provision.protocol.plant.roster import Role, Roster, Share
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.provisioning.verify import require_authentic, snapshot_trust, verify_image, verify_images
from teds_provision.shapes.verdict import Verification
from teds_provision.station.station import Station
from teds_provision.teds.image import Image
from tests.bench import Board, talk
from tests.plant.stations import Plant
from tests.station.test_commits import StatementLog


@pytest.fixture
def plants(tmp_path: Path) -> Iterator[Plant]:
    made = Plant(tmp_path)
    yield made
    made.close()


def made_by(station: Station, board: Board) -> Image:
    """Return the datasheet that a station provisions a board with."""
    with talk(board) as node:
        provision(
            station, node, BuildOrder("temperature-sensor"), operator=AcceptingOperator(), reporter=SilentReporter()
        )
    image = station.datasheets.datasheet(board.uuid)
    assert image is not None
    return image


def judged(station: Station, image: Image) -> Verification:
    return Verification(image.uuid, tuple(verify_image(station, image)), "image")


def verdict(station: Station, image: Image) -> str:
    """Return the verdict of a station, and of what it remembered for many files, which must be the same."""
    alone = judged(station, image)
    (together,) = verify_images(snapshot_trust(station), [image])
    assert tuple(together) == alone.checks
    return alone.verdict


def now_of(plants: Plant) -> Roster:
    roster = plants.north.plant.roster
    assert roster is not None
    return roster


def newest(plants: Plant, station: Station) -> int:
    return plants.north.plant.pages.chain(station.fingerprint).counted[0]


def test_a_stolen_lines_datasheets_count_up_to_its_last_page_and_none_after(plants: Plant) -> None:
    west, south = plants.member("west", "line", "sign"), plants.member("south", "base")
    before = made_by(west, Board())
    plants.round()
    assert verdict(south, before) == "authentic"
    last = newest(plants, west)
    after = made_by(west, Board(bytes([7] * 10)))
    plants.round()
    assert verdict(south, after) == "authentic"
    plants.change(plant.owner.draft_removal(plants.north, "west", "stolen", last))
    plants.sync(plants.north)
    plants.sync(south)
    assert (verdict(south, before), verdict(south, after)) == ("authentic", "not authentic")
    assert [check.name for check in judged(south, after).checks if check.result == "failed"] == ["signing station"]


def test_a_removal_without_the_pages_proves_nothing_until_they_come(plants: Plant) -> None:
    west, south = plants.member("west", "line", "sign"), plants.member("south", "base")
    image = made_by(west, Board())
    plants.sync(west)
    plants.sync(plants.north)
    plants.change(plant.owner.draft_removal(plants.north, "west", "lost", newest(plants, west)))
    held = plants.north.plant.roster
    assert held is not None
    plant.apply_pages.take_rosters(south, [held.octets])
    found = judged(south, image)
    assert found.verdict == verdict(south, image) == "unproven"
    with pytest.raises(UnprovenError, match="pages of west") as error:
        require_authentic(found)
    assert "registry sync" in error.value.hint
    plants.sync(plants.north)
    plants.sync(south)
    assert verdict(south, image) == "authentic"


def test_a_certificate_of_the_ca_alone_signs_nothing(plants: Plant) -> None:
    west, south = plants.member("west", "line", "sign"), plants.member("south", "base")
    image = made_by(west, Board())
    plants.change(plant.owner.with_roles(plants.north, "west", frozenset({"line"}), (0, "")))
    plants.round()
    assert verdict(south, image) == "not authentic"
    with pytest.raises(PolicyError, match="role sign"):
        made_by(west, Board(bytes([9] * 10)))
    with pytest.raises(PolicyError, match="role line"):
        made_by(south, Board(bytes([8] * 10)))


def test_a_keeper_vouches_for_what_a_station_signed_that_never_joined(plants: Plant) -> None:
    from tests.plant.stations import certified

    old = certified(plants.folder / "old", "old", plants.north)
    south = plants.member("south", "base")
    board = Board()
    image = made_by(old, board)
    old.close()
    assert verdict(plants.north, image) == "not authentic", "it is in no roster"
    plants.north.datasheets.keep_datasheet(image)
    found = plant.membership.vouchable(plants.north, [board.uuid])
    assert [uuid for uuid, _, _ in found] == [board.uuid]
    assert plant.membership.vouch(plants.north, found) == 1
    plants.round()
    assert plant.membership.vouch(plants.north, found) == 0
    assert (verdict(plants.north, image), verdict(south, image)) == ("authentic", "authentic")
    with pytest.raises(PolicyError, match="keeper"):
        plant.membership.vouch(south, found)


def test_a_keeper_vouches_beside_another_keeper(plants: Plant) -> None:
    """The word of the first is gone with its role; that of the second stays."""
    from tests.plant.stations import certified

    old = certified(plants.folder / "old", "old", plants.north)
    south = plants.member("south", "base", "keeper")
    board = Board()
    image = made_by(old, board)
    old.close()
    for station in (plants.north, south):
        station.datasheets.keep_datasheet(image)
    assert plant.membership.vouch(south, plant.membership.vouchable(south, [board.uuid])) == 1
    found = plant.membership.vouchable(plants.north, [board.uuid])
    plants.round()
    assert plant.membership.vouch(plants.north, found) == 1
    plants.round()
    plants.change(plant.owner.draft_removal(plants.north, "south", "stolen", 0))
    plants.sync(plants.north)
    assert verdict(plants.north, image) == "authentic"


def test_who_lost_sign_and_has_it_again_signs_on(plants: Plant) -> None:
    west = plants.member("west", "line", "sign", "base")
    plants.round()
    without = frozenset[Role]({"line", "base"})
    plants.change(plant.owner.with_roles(plants.north, "west", without, None))
    assert now_of(plants).by_key[west.fingerprint].signed is not None
    plants.change(plant.owner.with_roles(plants.north, "west", without | {"sign"}, None))
    assert now_of(plants).by_key[west.fingerprint].signed is None
    plants.round()
    image = made_by(west, Board())
    plants.round()
    assert verdict(plants.north, image) == "authentic"


def test_a_station_that_left_knows_no_registry_to_connect_to(plants: Plant, tmp_path: Path) -> None:
    west = plants.member("west", "base")
    plant.owner.join(west, now_of(plants), url=f"file:{tmp_path}", events=[])
    plant.membership.disconnect(west)
    plant.owner.join(west, now_of(plants), url=None, events=[])
    assert west.plant.joined is not None
    assert west.plant.joined.url is None


def test_nothing_is_shared_with_nobody(plants: Plant) -> None:
    """A share whose only receiver was removed is none; another one keeps its other receivers."""
    south, west = plants.member("south", "base"), plants.member("west", "base")
    only = Share(("all", ""), (south.fingerprint,))
    plants.change(plant.owner.shared(plants.north, only))
    plants.change(plant.owner.draft_removal(plants.north, "south", "retired", None))
    assert now_of(plants).share == ()
    plants.change(plant.owner.shared(plants.north, replace(only, to=(west.fingerprint,))))
    assert [share.to for share in now_of(plants).share] == [(west.fingerprint,)]


def test_no_roster_is_dated_before_the_one_it_follows(plants: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    """The owner's clock was put back."""
    held = now_of(plants)
    monkeypatch.setattr(plant.owner, "now", lambda: held.created - timedelta(days=400))
    drafted = plant.owner.following(plants.north)
    assert (drafted.created, drafted.expires) == (held.created, held.expires)


def test_a_store_of_today_joins_its_owner_retires_it_and_its_datasheets_stay(plants: Plant) -> None:
    from tests.plant.stations import certified, request_of

    west = certified(plants.folder / "west", "west", plants.north)
    image = made_by(west, Board())
    plants.change(plant.owner.add(plants.north, request_of(west), frozenset({"line", "sign"})))
    assert plants.north.plant.roster is not None
    events = list(plant.backlog.backlog(west))
    assert {"pinned", "agreed", "signed"} <= {act for act, _, _ in events}
    plant.owner.join(west, plants.north.plant.roster, url=None, events=events)
    plants.stations.append(west)
    plants.round()
    plants.change(plant.owner.draft_removal(plants.north, "west", "retired", None))
    plants.sync(plants.north)
    assert verdict(plants.north, image) == "authentic"


def test_who_joined_waits_for_the_disk_no_more_often(plants: Plant, tmp_path: Path) -> None:
    """The same provisioning with and without a registry: the outbox is written in the acts' own transactions."""
    from tests.plant.stations import owner

    alone = owner(tmp_path / "alone", "alone")
    waited = []
    for station in (alone, plants.north):
        watched = StatementLog(station)
        station._store._connection.set_trace_callback(watched.statements.append)
        _, commits = watched.run(Board(bytes([len(waited) + 1] * 10)))
        waited.append((commits, watched.waited))
        station._store._connection.set_trace_callback(None)
    assert plants.north.plant.unsent() >= 4
    assert waited[0] == waited[1]
    alone.close()
