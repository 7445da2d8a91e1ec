"""Which keys of a station that left are rotated, by whom and from when (contract/plant.md section 7), rule by rule."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.plant.removed_members import (
    _first_removals,
    _keys_held,
    _own_turn,
    _why_due,
    review,
    rotations_due,
)
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.plant.claim import Claim
from teds_provision.protocol.plant.roster import RemovedMember, Roster
from teds_provision.station.plant.plant import RosterRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeyRecord
from tests.plant.owner import ALL, alone, member, roster_of
from tests.plant.test_contract_states import held, others

NOW = datetime(2026, 3, 1, 12, tzinfo=UTC)
DAY, SECOND = timedelta(hours=24), timedelta(seconds=1)
KEY = cast("KeyRecord", SimpleNamespace(epoch=3, source="import"))


def gone(name: str, why: Any, number: int) -> RemovedMember:
    return RemovedMember(name, SoftwareKey(number).point, frozenset({"base"}), why, (9, "ab" * 32))


RETIRED, LOST, STOLEN = gone("west", "retired", 701), gone("south", "lost", 702), gone("east", "stolen", 703)
DUE_RETIRED = "registry: station west (retired) has held this key"
DUE_LOST = "registry: station south (lost) has held this key"
CUT = "registry: stolen: east has held this key"


def why(*known: RemovedMember, forgot: int = -1, own_turn: bool = True, since: timedelta | None = None) -> str | None:
    """Return why a key of epoch 3 is rotated; the removals are known here ``since`` then."""
    claims = {one.fingerprint: Claim(forgot=forgot) for one in known} if forgot >= 0 else {}
    ours = {} if since is None else {one.fingerprint: NOW - since for one in known}
    return _why_due(known, KEY, claims, NOW, ours, own_turn=own_turn)


@pytest.mark.parametrize(
    ("removed", "forgot", "due"),
    [
        ([], -1, None),
        ([RETIRED], -1, DUE_RETIRED),
        ([RETIRED], 2, DUE_RETIRED),  # it may have had a later one since
        ([RETIRED], 3, None),
        ([RETIRED], 4, None),
        ([LOST], 9, DUE_LOST),  # its word counts for nothing now
        ([STOLEN], 9, CUT),
        ([RETIRED, LOST], 3, DUE_LOST),
        ([STOLEN, LOST], -1, CUT),
        ([LOST, STOLEN], -1, CUT),
    ],
)
def test_a_key_that_a_removed_station_has_had_is_rotated_unless_a_retired_one_forgot_it(
    removed: list[RemovedMember], forgot: int, due: str | None
) -> None:
    assert why(*removed, forgot=forgot) == due


def test_another_stations_turn_is_waited_for_a_day_from_when_the_removal_is_known_here() -> None:
    tomorrow = "registry: from 2026-03-02T12:00:00Z: station south (lost) has held this key"
    assert why(LOST, own_turn=False) == tomorrow
    assert why(LOST, own_turn=False, since=timedelta(0)) == tomorrow
    soon = "registry: from 2026-03-01T12:00:01Z: station south (lost) has held this key"
    assert why(LOST, own_turn=False, since=DAY - SECOND) == soon
    assert why(LOST, own_turn=False, since=DAY) == DUE_LOST
    assert why(LOST, own_turn=True, since=timedelta(0)) == DUE_LOST
    stolen = "registry: from 2026-03-02T12:00:00Z: station east (stolen) has held this key"
    assert why(STOLEN, own_turn=False) == stolen, "who is not in turn cuts nothing yet"
    assert why(STOLEN, own_turn=False, since=DAY) == CUT
    assert why(LOST, STOLEN, own_turn=False) == tomorrow


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = alone(tmp_path / "alone")
    yield made
    made.close()


def test_a_removal_is_known_since_the_first_roster_here_that_has_it(station: Station) -> None:
    own = member(station, "owner", *ALL)
    for version, removed, at in ((2, (LOST,), "2026-03-03T00:00:00Z"), (3, (LOST, STOLEN), "2026-03-02T00:00:00Z"),
                                 (4, (LOST, STOLEN), "2026-03-05T00:00:00Z")):  # fmt: skip
        made = roster_of(station, own, version=version, previous="ab" * 32, removed=removed)
        station.plant.put_roster(RosterRow(version, made.hash, made.octets, True, at))
    second, sixth = datetime(2026, 3, 2, tzinfo=UTC), datetime(2026, 3, 6, tzinfo=UTC)
    assert _first_removals(station, sixth) == {LOST.fingerprint: second, STOLEN.fingerprint: second}


def test_a_removal_that_a_clock_ahead_took_in_is_known_since_the_roster_was_made(station: Station) -> None:
    """Else the turn of a holder that never comes would last until that date."""
    own = member(station, "owner", *ALL)
    made = roster_of(station, own, version=2, previous="ab" * 32, removed=(LOST,))
    station.plant.put_roster(RosterRow(2, made.hash, made.octets, True, "2027-03-02T00:00:00Z"))
    assert _first_removals(station, made.created + DAY) == {LOST.fingerprint: made.created}
    exactly = datetime(2027, 3, 2, tzinfo=UTC)
    assert _first_removals(station, exactly) == {LOST.fingerprint: exactly}


def test_the_key_that_is_held_is_the_active_one_or_the_newest_copy(station: Station) -> None:
    uuid = bytes(10)
    for epoch in (1, 2):
        station.keys.add_pending(uuid, key=bytes(16), key_id=bytes([epoch]) * 8, epoch=epoch)
    assert _keys_held(station, [uuid])[uuid].epoch == 2
    station.keys.activate(uuid, "01" * 8)
    station.keys.add_pending(uuid, key=bytes(16), key_id=bytes([3]) * 8, epoch=3)
    assert (_keys_held(station, [uuid])[uuid].epoch, _keys_held(station, [b"x" * 10])) == (1, {})


def dated(station: Station, made: Roster) -> Roster:
    """Have a roster that counts here be known since then."""
    station.plant.put_roster(RosterRow(made.version, made.hash, made.octets, True, "2026-03-01T12:00:00Z"))
    return made


def test_a_review_counts_what_only_a_station_that_left_held_and_is_made_again_when_another_one_left(
    station: Station,
) -> None:
    (west,) = others(station, west="line")
    now = dated(station, held(station, west, removed=(LOST,)))
    alone_, shared, here, theirs = (bytes([number] * 10) for number in range(1, 5))
    made, took = Claim(agreed=(3, "a1" * 8, "cd" * 32)), Claim(took=(3, "a1" * 8))
    station.keys.add_pending(here, key=bytes(16), key_id=b"\xa1" * 8, epoch=3)
    with station.transaction():
        for digits, nodes in ((LOST.fingerprint, {alone_: made, shared: made, here: made}),
                              (west.fingerprint, {shared: took, theirs: made})):  # fmt: skip
            chain = station.plant.pages.chain(digits)
            station.plant.claims.put(chain.id, {uuid: claim.to_json() for uuid, claim in nodes.items()})
    first = review(station, now, NOW)
    assert first is not None
    assert (first.of, first.alone) == (1, 1)
    assert station.keys.rotation_due(here) == "registry: station south (lost) has held this key"
    assert rotations_due(station) == 1
    assert review(station, now, NOW + timedelta(minutes=59)) == first
    later = review(station, now, NOW + timedelta(hours=1))
    assert later is not None
    assert later != first
    other = dated(station, held(station, west, removed=(STOLEN,)))
    again = review(station, other, NOW + timedelta(hours=1))
    assert again is not None
    assert again != later, "another station left"


def test_a_rotation_that_is_due_for_another_reason_keeps_it(station: Station) -> None:
    now = dated(station, held(station, *others(station, west="line"), removed=(LOST,)))
    moved, plain = (bytes([number] * 10) for number in (1, 2))
    claim = Claim(agreed=(3, "a1" * 8, "cd" * 32)).to_json()
    for uuid in (moved, plain):
        station.keys.add_pending(uuid, key=bytes(16), key_id=b"\xa1" * 8, epoch=3)
    station.keys.demand_rotation(moved, "it came from another station")
    with station.transaction():
        station.plant.claims.put(station.plant.pages.chain(LOST.fingerprint).id, {moved: claim, plain: claim})
    assert review(station, now, NOW) is not None
    assert [station.keys.rotation_due(uuid) for uuid in (moved, plain)] == [
        "it came from another station", "registry: station south (lost) has held this key"
    ]  # fmt: skip


def test_who_agreed_a_key_itself_is_in_turn(station: Station) -> None:
    roster = station.plant.roster
    assert roster is not None
    assert _own_turn(station, roster, bytes(10), replace_source("agreement"))
    assert _own_turn(station, roster, bytes(10), replace_source("import")), "no other station holds it"


def replace_source(source: str) -> KeyRecord:
    return cast("KeyRecord", SimpleNamespace(source=source, epoch=3, key_id="a1" * 8))
