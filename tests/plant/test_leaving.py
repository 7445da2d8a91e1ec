"""A station left: which keys are rotated, by whom and when, and what only a tap can heal (contract, section 7)."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from teds_provision import plant
from teds_provision.errors import KeyStolenError
from teds_provision.measure.standing import NodeStanding
from teds_provision.plant import removed_members
from teds_provision.protocol.plant.roster import Share, Why
from teds_provision.provisioning.agree import agree, session_if_keyed
from teds_provision.provisioning.identify import identify
from teds_provision.station.node_keys import REMOVED, deferred
from teds_provision.station.station import Station
from teds_provision.station.store.records import Holder
from tests.bench import talk
from tests.plant.handing import board_of
from tests.plant.stations import Plant, ask


class Scene:
    """North (keeper, the CA key), west on the line, and south, to whom every key is copied."""

    def __init__(self, folder: Path) -> None:
        self.plant = Plant(folder)
        self.north = self.plant.north
        self.south = self.plant.member("south", "base")
        self.west = self.plant.member("west", "line", "base")
        to = (self.south.fingerprint,)
        self.plant.change(plant.owner.shared(self.north, Share(("all", ""), to)))
        self.plant.round()

    def sync(self, *stations: Station) -> None:
        for station in stations:
            self.plant.sync(station)

    def keyed_by(self, station: Station) -> bytes:
        """Return a board that a station keyed and that south has a copy of."""
        uuid = board_of(station, os.urandom(10)).uuid
        self.sync(station, self.south, station, self.north)
        return uuid

    def remove(self, station: Station, why: Why) -> None:
        last = self.north.plant.pages.chain(station.fingerprint).counted[0]
        self.plant.change(plant.owner.draft_removal(self.north, station.identity.name, why, last))
        self.sync(self.north)

    def marks(self, station: Station) -> list[bytes]:
        return [uuid for uuid, why in station.keys.rotations_due().items() if why.startswith(REMOVED)]


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    made = Scene(tmp_path)
    yield made
    made.plant.close()


def later(station: Station, hours: float) -> None:
    """What a sync finds so many hours from now."""
    roster = station.plant.roster
    assert roster is not None
    removed_members.review(station, roster, datetime.now(UTC) + timedelta(hours=hours))


def test_who_made_a_key_that_a_thief_has_rotates_it_at_the_next_contact(scene: Scene) -> None:
    board = board_of(scene.north, os.urandom(10))
    other = scene.keyed_by(scene.west)
    scene.sync(scene.north, scene.south, scene.north)
    scene.remove(scene.south, "stolen")
    assert scene.marks(scene.north) == [board.uuid]
    assert removed_members.rotations_due(scene.north) == 1
    before = scene.north.keys.keys_of(board.uuid)[-1].epoch
    with talk(board) as node:
        session_if_keyed(scene.north, node)
    assert scene.north.keys.keys_of(board.uuid)[-1].epoch == before + 1
    scene.sync(scene.north)
    assert scene.marks(scene.north) == []
    scene.sync(scene.west)
    assert scene.marks(scene.west) == [other]


def test_the_only_holder_of_a_key_that_a_lost_station_made_rotates_it_at_once(scene: Scene) -> None:
    uuid = scene.keyed_by(scene.west)
    scene.remove(scene.west, "lost")
    scene.sync(scene.south)
    assert scene.marks(scene.south) == [uuid]
    assert scene.south.keys.rotation_due(uuid) == "registry: station west (lost) has held this key"
    assert scene.south.keys.rotates_now(uuid)


def test_of_two_holders_the_first_rotates_what_a_thief_made_and_the_other_goes_on_with_the_new_key(
    scene: Scene,
) -> None:
    """Both mark at once; one rotates and shares; the other takes its copy and ends its mark without a rotation."""
    to = (scene.south.fingerprint, scene.north.fingerprint)
    scene.plant.change(plant.owner.shared(scene.north, Share(("all", ""), to)))
    scene.sync(scene.north, scene.west)
    board = board_of(scene.west, os.urandom(10))
    scene.sync(scene.west, scene.south, scene.north, scene.west, scene.south, scene.north)
    first, other = sorted((scene.north, scene.south), key=lambda station: station.fingerprint)
    assert all(station.keys.held(board.uuid) for station in (first, other))
    with talk(board) as node:
        session_if_keyed(other, node)  # its key is active: the copy has been used
    other.keys.put_holder(Holder(board.uuid, scene.west.fingerprint, "2026-01-31T12:00:00Z"))  # not this very second
    running = [NodeStanding(station, board.uuid) for station in (first, other)]
    scene.remove(scene.west, "stolen")
    scene.sync(scene.south)
    assert scene.marks(first) == scene.marks(other) == [board.uuid]
    with pytest.raises(KeyStolenError):
        running[0].require()
    running[1].require()
    due = other.keys.rotation_due(board.uuid)
    assert due is not None
    assert due.endswith("Z: station west (stolen) has held this key")
    epoch = other.keys.active_epoch(board.uuid)
    with talk(board) as node:
        session_if_keyed(other, node)
    assert other.keys.active_epoch(board.uuid) == epoch, "it is the other station's turn"

    with talk(board) as node:
        session_if_keyed(first, node)
    assert first.keys.active_epoch(board.uuid) == epoch + 1
    assert scene.marks(first) == []
    scene.sync(first, other)
    with talk(board) as node:
        session_if_keyed(other, node)
    assert other.keys.active_epoch(board.uuid) == epoch + 1, "the thief never had this key"
    assert scene.marks(other) == []
    later(other, 30)
    assert scene.marks(other) == []


def test_whose_turn_it_is_not_rotates_a_day_later(scene: Scene) -> None:
    to = (scene.south.fingerprint, scene.north.fingerprint)
    scene.plant.change(plant.owner.shared(scene.north, Share(("all", ""), to)))
    scene.sync(scene.north, scene.west)
    uuid = board_of(scene.west, os.urandom(10)).uuid
    scene.sync(scene.west, scene.south, scene.north, scene.west, scene.south, scene.north)
    other = max((scene.north, scene.south), key=lambda station: station.fingerprint)
    scene.remove(scene.west, "stolen")
    scene.sync(scene.south)
    for hours, now in ((0, False), (23, False), (25, True)):
        later(other, hours)
        assert scene.marks(other) == [uuid]
        assert other.keys.rotates_now(uuid) == now
    assert other.keys.stolen(uuid)


def test_a_deferred_rotation_begins_at_its_time_without_another_sync(scene: Scene) -> None:
    uuid = scene.keyed_by(scene.west)
    at = datetime.now(UTC)
    for begins, now in ((at + timedelta(minutes=1), False), (at - timedelta(minutes=1), True)):
        scene.south.keys.demand_rotation(uuid, deferred(begins, "station west (lost) has held this key"))
        assert scene.south.keys.rotates_now(uuid) == now


def test_a_clock_that_was_ahead_prevents_no_later_search(scene: Scene) -> None:
    scene.keyed_by(scene.west)
    scene.remove(scene.west, "lost")
    scene.sync(scene.south)
    later(scene.south, 20_000)
    later(scene.south, 0)
    review = removed_members.last(scene.south)
    assert review is not None
    assert abs(datetime.fromisoformat(review.at) - datetime.now(UTC)) < timedelta(minutes=5)


def test_a_retired_one_that_forgot_has_no_key_any_more(scene: Scene) -> None:
    """What it forgot is a key of one epoch: it may have had a later one since."""
    boards = [board_of(scene.north, os.urandom(10)) for _ in range(3)]
    kept, forgotten, rotated = (board.uuid for board in boards)
    with talk(boards[2]) as node:
        agree(scene.north, node, identify(scene.north, node), rotate=True)
    scene.sync(scene.north, scene.south, scene.north)
    with scene.south.transaction():
        for uuid in (forgotten, rotated):
            scene.south.plant.record_event("forgot", uuid, epoch=1)
    scene.sync(scene.south, scene.north)
    scene.remove(scene.south, "retired")
    assert sorted(scene.marks(scene.north)) == sorted([kept, rotated])


def test_a_stolen_one_that_says_it_forgot_is_not_believed(scene: Scene) -> None:
    uuid = board_of(scene.north, os.urandom(10)).uuid
    scene.sync(scene.north, scene.south, scene.north)
    with scene.south.transaction():
        scene.south.plant.record_event("forgot", uuid, epoch=1)
    scene.sync(scene.south, scene.north)
    scene.remove(scene.south, "stolen")
    assert scene.marks(scene.north) == [uuid]


def test_a_key_that_a_thief_names_on_another_history_is_rotated_too(scene: Scene, tmp_path: Path) -> None:
    """The roster's ``last`` is page 2 of one branch; the copy said on its own page 2 that it had the key."""
    board = board_of(scene.north, os.urandom(10))
    (key,) = scene.north.keys.keys_of(board.uuid)
    scene.plant.change(plant.owner.unshared(scene.north, ("all", "")))
    scene.sync(scene.north, scene.west)
    with scene.west.transaction():
        scene.west.plant.record_event("named", bytes(10), name="one")
    scene.sync(scene.west)
    shutil.copytree(scene.west.home, tmp_path / "copy")
    copy = Station.open(tmp_path / "copy", ask=ask)
    other = tmp_path / "other stick"
    other.mkdir()
    with copy.transaction():
        copy.plant.record_event("agreed", board.uuid, fingerprint="ab" * 32, epoch=key.epoch, key_id=key.key_id)
    scene.plant.sync(copy, other)
    copy.close()
    with scene.west.transaction():
        scene.west.plant.record_event("named", bytes(10), name="two")
    scene.sync(scene.west, scene.north)
    scene.plant.sync(scene.north, other)
    branch = scene.west.plant.pages.chain(scene.west.fingerprint).counted[1]
    plant.membership.accept(scene.north, scene.west.fingerprint, branch, None)
    scene.remove(scene.west, "stolen")
    assert scene.north.keys.rotation_due(board.uuid), "what he says that he has, he has"


def test_what_only_the_lost_one_held_is_counted_as_a_tap(scene: Scene) -> None:
    scene.plant.change(plant.owner.unshared(scene.north, ("all", "")))
    scene.sync(scene.north, scene.west)
    board_of(scene.west, os.urandom(10))
    scene.sync(scene.west, scene.north)
    scene.remove(scene.west, "lost")
    review = removed_members.last(scene.north)
    assert review is not None
    assert (review.alone, removed_members.rotations_due(scene.north)) == (1, 0)


def test_no_station_left_and_nothing_is_due(scene: Scene) -> None:
    scene.keyed_by(scene.west)
    assert (removed_members.last(scene.north), removed_members.rotations_due(scene.west)) == (None, 0)


@pytest.mark.parametrize(("why", "cut"), [("stolen", True), ("lost", False), ("retired", False)])
def test_a_running_measurement_ends_for_a_thief_alone(scene: Scene, why: Why, cut: bool) -> None:
    uuid = board_of(scene.north, os.urandom(10)).uuid
    scene.sync(scene.north, scene.south, scene.north)
    measuring = Station.open(scene.north.home, ask=ask)  # the process that measures, beside `registry remove`
    standing = NodeStanding(measuring, uuid)
    standing.require()
    scene.remove(scene.south, why)
    assert scene.marks(scene.north) == [uuid]
    if cut:
        with pytest.raises(KeyStolenError, match=r"stolen: south has held this key"):
            standing.require()
    standing.require()
    NodeStanding(measuring, uuid).require()  # a session that began since is not ended again
    measuring.close()


def test_a_key_that_was_due_for_another_station_is_cut_off_when_one_is_stolen(scene: Scene) -> None:
    uuid = board_of(scene.west, os.urandom(10)).uuid
    to = (scene.south.fingerprint, scene.north.fingerprint)
    scene.plant.change(plant.owner.unshared(scene.north, ("all", "")))
    scene.plant.change(plant.owner.shared(scene.north, Share(("all", ""), to)))
    scene.sync(scene.north, scene.west, scene.south, scene.north, scene.west, scene.south, scene.north)
    assert scene.north.keys.keys_of(uuid)
    scene.remove(scene.west, "lost")
    later(scene.north, 25)
    assert scene.north.keys.stolen(uuid) is None
    scene.remove(scene.south, "stolen")
    later(scene.north, 50)
    assert scene.north.keys.stolen(uuid) == "registry: stolen: south has held this key"
