"""Link keys: pending beside active, promotion, a change of the master key."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import NotFoundError, StoreError
from teds_provision.station.plant.plant import PlantRecord
from teds_provision.station.station import Station
from teds_provision.station.store.records import Holder, KeyRecord, NodeRecord, StationRecord

NODE = bytes(range(10))
OTHER = bytes(range(1, 11))


def a_key(number: int, state: str = "pending", uuid: bytes = NODE) -> KeyRecord:
    return KeyRecord(uuid, number, f"{number:016x}", state, number, f"wrapped {number}".encode())  # type: ignore[arg-type]


def numbers(station: Station, uuid: bytes = NODE) -> list[int]:
    return [key.epoch for key in station.keys.keys_of(uuid)]


def test_the_newest_pending_key_is_tried_first_and_the_active_one_last(station: Station) -> None:
    for key in (a_key(1, "active"), a_key(2), a_key(3), a_key(9, uuid=OTHER)):
        station.keys.add(key)
    assert numbers(station) == [3, 2, 1]


def test_a_good_open_makes_one_key_active_and_deletes_the_active_one_before(station: Station) -> None:
    for key in (a_key(1, "active"), a_key(2), a_key(3), a_key(9, uuid=OTHER)):
        station.keys.add(key)
    station.keys.activate(NODE, f"{2:016x}")
    assert [(key.epoch, key.state) for key in station.keys.keys_of(NODE)] == [(3, "pending"), (2, "active")]
    assert numbers(station, OTHER) == [9]


def test_promoting_again_changes_nothing(station: Station) -> None:
    station.keys.add(a_key(1))
    station.keys.activate(NODE, f"{1:016x}")
    before = station.keys.keys_of(NODE)
    station.keys.activate(NODE, f"{1:016x}")
    assert station.keys.keys_of(NODE) == before


def test_promoting_an_unknown_key_deletes_nothing(station: Station) -> None:
    station.keys.add(a_key(1, "active"))
    with pytest.raises(NotFoundError):
        station.keys.activate(NODE, "f" * 16)
    assert numbers(station) == [1]


def test_there_is_never_a_second_active_key(station: Station) -> None:
    station.keys.add(a_key(1, "active"))
    with pytest.raises(StoreError):
        station.keys.add(a_key(2, "active"))
    assert numbers(station) == [1]


def test_the_same_key_again_changes_nothing(station: Station) -> None:
    station.keys.add(a_key(1, "active"))
    station.keys.add(a_key(1))
    assert [(key.epoch, key.state) for key in station.keys.keys_of(NODE)] == [(1, "active")]


def test_a_slot_is_never_given_twice(station: Station) -> None:
    first = station.keys.next_slot(NODE)
    station.keys.add(KeyRecord(NODE, 1, "0" * 16, "pending", 7, b"w"))
    second = station.keys.next_slot(NODE)
    station.keys.remove(NODE)
    assert (first, second, station.keys.next_slot(NODE), station.keys.next_slot(OTHER)) == (1, 8, 9, 1)
    station.keys.add(KeyRecord(NODE, 2, "1" * 16, "pending", 3, b"w"))  # out of a backup
    assert station.keys.next_slot(NODE) == 10


def test_a_master_change_rewraps_all_or_nothing(station: Station) -> None:
    for number in range(1, 1201):
        station.keys.add(a_key(number, uuid=number.to_bytes(10, "big")))

    def fails_late(record: KeyRecord) -> bytes:
        if record.epoch == 1100:
            raise ValueError("stop")
        return b"new"

    with pytest.raises(ValueError, match="stop"):
        station.keys.wrap_anew(fails_late)
    assert {key.wrapped[:7] for key in station.keys.all()} == {b"wrapped"}
    assert station.keys.wrap_anew(lambda record: b"new " + record.wrapped) == 1200
    assert {key.wrapped[:11] for key in station.keys.all()} == {b"new wrapped"}


def test_a_wrapped_key_never_shows_in_a_repr() -> None:
    assert "wrapped" not in repr(a_key(1))


def test_transactions_nest_and_undo_only_what_failed(station: Station) -> None:
    with station.transaction():
        station.nodes.restore(NodeRecord(NODE))
        with suppress(RuntimeError), station.transaction():
            station.nodes.restore(NodeRecord(OTHER))
            raise RuntimeError
    assert [node.uuid for node in station.nodes.all()] == [NODE]
    with suppress(RuntimeError), station.transaction():
        station.identity.put(StationRecord("lost", "file"))
        with station.transaction():
            station.keys.add(a_key(1))
        raise RuntimeError
    assert (station.name, station.keys.keys_of(NODE)) == ("bench", [])


def test_a_part_of_a_change_that_failed_takes_the_whole_with_it(station: Station) -> None:
    """``together`` sets no savepoint: whoever catches its error and goes on keeps nothing, and is told."""

    def caught() -> None:
        with station.transaction():
            station.nodes.restore(NodeRecord(NODE))
            with suppress(RuntimeError), station._store.together():
                station.nodes.restore(NodeRecord(OTHER))
                raise RuntimeError

    for _ in range(2):  # the second time as the first: what failed once is over
        with pytest.raises(StoreError, match="Part of this change failed"):
            caught()
        assert station.nodes.all() == []


def test_a_part_that_failed_takes_no_more_than_its_savepoint_with_it(station: Station) -> None:
    with station.transaction():
        station.nodes.restore(NodeRecord(NODE))
        with suppress(NotFoundError), station._store.together():
            station.keys.activate(NODE, "00" * 8)  # nothing was changed before it failed
        with (
            suppress(RuntimeError),
            station.transaction(),
            station._store.together(),
        ):  # a savepoint around it takes it back
            station.nodes.restore(NodeRecord(OTHER))
            raise RuntimeError
    assert [node.uuid for node in station.nodes.all()] == [NODE]


def test_what_was_read_a_moment_ago_is_never_older_than_the_store(station: Station, home: Path) -> None:
    """Rows are remembered: another process, an own change, and one that was taken back must be seen."""
    station.nodes.restore(NodeRecord(NODE, name="a"))
    with Station.inspect(home) as other:
        assert [station.nodes.get(NODE), other.nodes.get(NODE)] == [NodeRecord(NODE, name="a")] * 2
        other.nodes.restore(NodeRecord(NODE, name="b"))
        assert station.nodes.get(NODE) == NodeRecord(NODE, name="b")
        with suppress(RuntimeError), station.transaction():
            station.nodes.restore(NodeRecord(NODE, name="c"))
            assert station.nodes.get(NODE) == NodeRecord(NODE, name="c")
            raise RuntimeError
        assert station.nodes.get(NODE) == NodeRecord(NODE, name="b")
        with station.reading():
            assert station.nodes.get(NODE) == NodeRecord(NODE, name="b")
            other.nodes.restore(NodeRecord(NODE, name="d"))
            assert station.nodes.get(NODE) == NodeRecord(NODE, name="b"), "as it was when the block began"
            station.nodes.restore(NodeRecord(OTHER))
            assert station.nodes.get(NODE) == NodeRecord(NODE, name="d"), "but for one's own changes"
        assert station.nodes.get(NODE) == NodeRecord(NODE, name="d")


CA = bytes([4]) + bytes(range(64))
"""P(CA) of another owner, in whose bundle a key came."""


def test_a_key_that_came_in_a_bundle_and_opens_brings_the_ca_of_its_bundle(station: Station) -> None:
    for key in (a_key(1, "active"), a_key(2)):
        station.keys.add(key)
    station.keys.set_flags({NODE: {"next_key_id": f"{2:016x}", "next_ca": CA}})
    assert station.keys.ca_of(NODE) == station.ca != CA, "until the key is proven"
    station.keys.promote(NODE, f"{2:016x}")
    assert station.keys.ca_of(NODE) == CA
    assert numbers(station) == [2]
    flags = station.keys.all_flags()[NODE]
    assert (flags.next_key_id, flags.next_ca) == (None, None)


def test_a_good_open_makes_older_keys_obsolete_and_leaves_a_newer_agreement(station: Station) -> None:
    for key in (a_key(1, "active"), a_key(2), a_key(3), a_key(4), a_key(2, uuid=OTHER)):
        station.keys.add(key)
    station.keys.promote(NODE, f"{3:016x}")
    assert [(key.epoch, key.state) for key in station.keys.keys_of(NODE)] == [(4, "pending"), (3, "active")]
    assert numbers(station, OTHER) == [2]


@pytest.mark.parametrize(
    ("change", "stays"),
    [
        ({}, True),
        ({"epoch": 2}, False),  # the node has gone on from it: no Confirm of it can be good any more
        ({"epoch": 1}, False),
        ({"source": "import"}, False),
        ({"created": timedelta(seconds=110)}, True),  # 60 s of the profile, and a slow bus
        ({"created": timedelta(seconds=130)}, False),
    ],
)
def test_of_the_other_keys_only_a_newer_agreement_of_a_moment_ago_outlives_a_good_open(
    station: Station, change: dict[str, Any], stays: bool
) -> None:
    if "created" in change:
        change = {"created": (datetime.now(UTC) - change["created"]).strftime("%Y-%m-%dT%H:%M:%SZ")}
    other = replace(a_key(3), **change)
    station.keys.add(a_key(2, "active"), other)
    station.keys.promote(NODE, f"{2:016x}")
    assert [key.key_id for key in station.keys.keys_of(NODE)] == [*[other.key_id] * stays, f"{2:016x}"]


def test_the_plant_hears_that_a_node_is_forgotten_with_its_last_key(station: Station) -> None:
    station.plant.put_record(PlantRecord("11111111-2222-4333-8444-555555555555"))

    def forgot() -> list[int]:
        reported = [json.loads(text) for _, _, text in station.plant.outbox(9)]
        return [event["epoch"] for event in reported if event["act"] == "forgot"]

    station.keys.add(a_key(1, "active"), a_key(2))
    assert station.keys.remove_key(NODE, f"{1:016x}")
    assert not station.keys.remove_key(NODE, "f" * 16)
    assert forgot() == []
    assert station.keys.remove_key(NODE, f"{2:016x}")
    assert forgot() == [2]
    station.keys.add(a_key(4, "active"), a_key(3))
    assert station.keys.remove(NODE) == 2
    assert station.keys.remove(NODE) == 0
    assert forgot() == [2, 4], "no key up to the newest is left"


def test_a_ca_whose_key_did_not_open_is_forgotten(station: Station) -> None:
    for key in (a_key(1, "active"), a_key(2)):
        station.keys.add(key)
    station.keys.set_flags({NODE: {"next_key_id": f"{2:016x}", "next_ca": CA}})
    station.keys.promote(NODE, f"{1:016x}")
    assert station.keys.ca_of(NODE) == station.ca
    station.keys.add(a_key(2))
    station.keys.promote(NODE, f"{2:016x}")
    assert station.keys.ca_of(NODE) == station.ca, "what the bundle said of that key was dropped"


def test_promoting_a_key_that_is_not_held_changes_nothing(station: Station) -> None:
    for key in (a_key(1, "active"), a_key(2)):
        station.keys.add(key)
    station.keys.set_flags({NODE: {"next_key_id": f"{2:016x}", "next_ca": CA}})
    before = station.keys.all_flags()
    with pytest.raises(NotFoundError):
        station.keys.promote(NODE, "f" * 16)
    assert numbers(station) == [2, 1]
    assert station.keys.all_flags() == before


def test_who_was_noted_as_holder_in_the_second_in_which_a_key_came_holds_it(station: Station) -> None:
    """An import notes both at once: else a key that a removed station gave would count as one that it never had."""
    at, uuid = ["2026-10-01T08:00:00Z", "2026-10-01T08:00:01Z", "2026-10-01T08:00:02Z"], bytes(10)
    for digits, since in zip(("aa" * 32, "bb" * 32, "cc" * 32), at, strict=True):
        station.keys.put_holder(Holder(uuid, digits, since))
    key = KeyRecord(uuid, 1, "0" * 16, "active", 1, b"", "import", at[1])
    assert station.keys.holders_of_key(key) == {"bb" * 32, "cc" * 32}
