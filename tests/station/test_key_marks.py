"""What a station notes of a node's keys: how they open, which CA the node keeps, why and when one is rotated."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest

from teds_provision.errors import NoPassphraseError, StoreChangedError, UnknownMasterKeyError, VaultError
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.station import node_keys
from teds_provision.station.node_keys import deferred, deferred_until
from teds_provision.station.station import Station, rewrap
from teds_provision.station.store.records import Holder, KeyFlags, KeyRecord
from teds_provision.station.store.row_sample import RowSample
from teds_provision.station.store.store import Store

A, B, C = (bytes.fromhex("8d4d9da65281f7000000")[:9] + bytes([number]) for number in (1, 2, 3))
WEST, NORTH = SoftwareKey(91).point, SoftwareKey(92).point
EARLY, AT, LATE = (f"2026-10-0{day}T08:00:00Z" for day in (1, 2, 3))


def id_of(epoch: int) -> str:
    return f"{epoch:016x}"


def agreed(station: Station, uuid: bytes, *epochs: int) -> None:
    for epoch in epochs:
        station.keys.add_pending(uuid, key=bytes([epoch]) * 16, key_id=bytes.fromhex(id_of(epoch)), epoch=epoch)


# -- the keys ----------------------------------------------------------------------------------------------------------


def test_a_key_that_does_not_open_hides_no_other_and_is_told_at_the_end(station: Station, store: Store) -> None:
    agreed(station, A, 1, 2, 3)
    store.execute("UPDATE keys SET wrapped = substr(wrapped, 1, 40) WHERE epoch = 2")
    found = station.keys.unwrapped(A)
    assert [(held.record.epoch, held.key) for held in (next(found), next(found))] == [(3, b"\3" * 16), (1, b"\1" * 16)]
    with pytest.raises(VaultError, match="does not belong"):
        next(found)


def test_without_a_passphrase_no_key_is_passed_over(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    agreed(station, A, 1, 2)

    def locked(record: KeyRecord) -> bytes:
        raise NoPassphraseError("The vault's passphrase is needed.")

    monkeypatch.setattr(station.keys, "unwrap", locked)
    with pytest.raises(NoPassphraseError):
        next(station.keys.unwrapped(A))


def test_keys_by_name_epoch_and_slot(station: Station) -> None:
    keys = station.keys
    agreed(station, B, 5)
    agreed(station, A, 2, 3)
    assert keys.active_epoch(A) == 0
    keys.activate(A, id_of(2))
    assert [keys.active_epoch(uuid) for uuid in (A, B, C)] == [2, 0, 0]
    assert [keys.held(uuid) for uuid in (A, B, C)] == [True, True, False]
    assert list(keys.all_key_names()) == [
        (B, id_of(5), 5, "pending"), (A, id_of(2), 2, "active"), (A, id_of(3), 3, "pending")
    ]  # fmt: skip
    assert [record.epoch for record in keys.all()] == [5, 2, 3]
    assert [record.epoch for record in keys.get_many([A, C])] == [2, 3]
    assert keys.slots_of([A, B, C]) == {A: 2, B: 1}
    assert keys.next_slot(C) == 1
    named = keys.unwrap_named({A: id_of(2), B: id_of(9), C: id_of(2)})
    assert named == {A: (2, b"\2" * 16)}


def test_a_corrected_epoch_keeps_the_key_in_a_slot_of_its_own(station: Station) -> None:
    agreed(station, A, 1, 2)
    keys = station.keys
    keys.activate(A, id_of(1))
    (record,) = (record for record in keys.keys_of(A) if record.epoch == 1)
    corrected = keys.correct_epoch(record, 7)
    assert (corrected.epoch, corrected.slot, corrected.state, corrected.key_id) == (7, 3, "active", id_of(1))
    assert [(held.record.epoch, held.key) for held in keys.unwrapped(A)] == [(2, b"\2" * 16), (7, b"\1" * 16)]
    assert (corrected.created, corrected.source) == (record.created, record.source)


# -- the CA that a node keeps ------------------------------------------------------------------------------------------


def test_the_ca_of_a_node_is_the_owners_unless_a_bundle_brought_another(station: Station, store: Store) -> None:
    keys = station.keys
    assert keys.ca_of(A) == station.ca
    keys.set_ca_of(A, WEST)
    keys.set_ca_of(B, NORTH)
    keys.set_ca_of(C, station.ca)
    assert [keys.ca_of(uuid) for uuid in (A, B, C)] == [WEST, NORTH, station.ca]
    assert keys.cas_of_nodes() == {A: WEST, B: NORTH}
    assert keys.cas_among([A, C]) == {A: WEST}
    names = [name for name, *_ in keys.mac_rows(RowSample(full=True))]
    assert sorted(names) == [f"the CA of node {A.hex()}", f"the CA of node {B.hex()}"]
    keys.set_ca_of(B, station.ca)
    assert keys.all_flags().keys() == {A}, "the owner's CA is no flag, and a node without one has no row"
    store.execute("UPDATE marks SET ca_mac = zeroblob(16)")
    for ask in (lambda: keys.ca_of(A), keys.cas_of_nodes, lambda: keys.cas_among([A])):
        with pytest.raises(StoreChangedError, match=f"the CA of node {A.hex()}"):
            ask()


def test_flags_change_one_by_one_and_the_others_stay(station: Station) -> None:
    keys = station.keys
    keys.set_former(A, "f1" * 32)
    keys.demand_rotation(A, "why")
    keys.set_flags({A: {"ca": WEST}, B: {"rotation": "because"}})
    kept = keys.all_flags()
    assert (kept[A].former, kept[A].rotation, kept[A].ca) == ("f1" * 32, "why", WEST)
    assert kept[B] == KeyFlags(rotation="because")
    assert [keys.former(uuid) for uuid in (A, B)] == ["f1" * 32, None]
    keys.set_former(A, None)
    keys.rotated(A)
    assert keys.all_flags()[A] == replace(kept[A], former=None, rotation=None)
    keys.set_flags({A: {"ca": None}, B: {"rotation": None}})
    assert keys.all_flags().keys() <= {A}
    assert keys.ca_of(A) == station.ca


# -- rotations ---------------------------------------------------------------------------------------------------------

NOW = datetime.now(UTC)
WHY = "registry: stolen: east had this key"


def test_a_rotation_that_another_station_does_first_names_the_time(station: Station) -> None:
    begins = datetime(2026, 3, 1, 12, 30, 5, tzinfo=UTC)
    assert deferred(begins, "east was removed") == "registry: from 2026-03-01T12:30:05Z: east was removed"
    assert deferred_until("registry: from 2026-03-01T12:30:05Z: east: at 12:00Z") == "2026-03-01T12:30:05Z"
    assert [deferred_until(why) for why in ("registry: east was removed", "from 2026-03-01T12:30:05Z: x", "")] == [
        None, None, None
    ]  # fmt: skip


def test_a_rotation_is_due_at_once_or_from_its_time_on(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    keys = station.keys
    assert (keys.rotation_due(A), keys.rotates_now(A)) == (None, False)
    keys.demand_rotation(A, "why")
    keys.demand_rotation(B, deferred(NOW, "why"))
    assert keys.rotates_now(A)
    for seconds, due in ((-1, False), (0, True), (1, True)):
        now = (NOW + timedelta(seconds=seconds)).strftime("%Y-%m-%dT%H:%M:%SZ")
        monkeypatch.setattr(node_keys, "utc_now", lambda now=now: now)
        assert keys.rotates_now(B) is due
    assert keys.rotations_due() == {A: "why", B: deferred(NOW, "why")}
    assert keys.due_among([A, C]) == {A}
    keys.rotated(A)
    assert (keys.rotation_due(A), keys.due_among([A, B])) == (None, {B})


@pytest.mark.parametrize(
    ("why", "restored", "stolen"),
    [
        ("restored from a backup of 2026-03-01", True, None),
        ("it was restored from a backup", False, None),
        (WHY, False, WHY),
        ("registry: east was removed", False, None),
        ("stolen", False, None),
    ],
)
def test_which_rotations_need_a_person_and_which_end_a_session(
    station: Station, why: str, restored: bool, stolen: str | None
) -> None:
    station.keys.demand_rotation(A, why)
    assert (station.keys.restored(A), station.keys.stolen(A)) == (restored, stolen)
    assert (station.keys.restored(B), station.keys.stolen(B)) == (False, None)


def test_a_key_that_was_pending_when_a_rotation_became_due_does_not_end_it(station: Station) -> None:
    agreed(station, A, 1, 2)
    agreed(station, B, 1)
    station.keys.activate(A, id_of(1))
    station.keys.demand_rotation(A, "why")
    agreed(station, A, 3)
    assert [(key.epoch, key.source) for key in station.keys.keys_of(A)] == [
        (3, "agreement"), (2, "import"), (1, "agreement")
    ]  # fmt: skip
    assert [key.source for key in station.keys.keys_of(B)] == ["agreement"]


def test_a_removal_is_over_once_a_key_opens_that_no_removed_station_had(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = station.keys
    agreed(station, A, 4)
    (record,) = keys.keys_of(A)
    keys.put_holder(Holder(A, "f1" * 32, "2999-01-01T00:00:00Z"), Holder(A, "f2" * 32, EARLY))
    asked: list[object] = []
    had = [True]

    def removed_had(*which: object) -> bool:
        asked.append(which)
        return had[0]

    monkeypatch.setattr(station.plant, "removed_had", removed_had)
    keys.demand_rotation(A, "why")
    keys.end_removal_mark(record)
    assert (keys.rotation_due(A), asked) == ("why", []), "only what a removal demanded"
    for first, left in ((True, "registry: gone"), (False, None)):
        had[0] = first
        keys.demand_rotation(A, "registry: gone")
        keys.end_removal_mark(record)
        assert keys.rotation_due(A) == left
    assert asked == [(A, 4, id_of(4), {"f1" * 32})] * 2
    assert len(keys.holders(A)) == 2


# -- other holders -----------------------------------------------------------------------------------------------------


def test_who_else_holds_keys(station: Station) -> None:
    keys, one, two = station.keys, "f1" * 32, "f2" * 32
    rows = Holder(A, two, EARLY), Holder(A, one, AT), Holder(B, one, AT)
    keys.put_holder(*reversed(rows))
    assert keys.holders() == list(rows)
    assert keys.holders(A) == list(rows[:2])
    assert keys.all_holders() == {one, two}
    record = KeyRecord(A, 1, id_of(1), "active", 1, b"w", "agreement", AT)
    assert keys.holders_of_key(record) == {one}, "since the key came, that second included"
    assert keys.holders_of_key(replace(record, created=LATE)) == set()
    keys.put_holder(Holder(A, one, LATE))
    assert keys.holders(A) == [rows[0], Holder(A, one, LATE)]
    assert (keys.remove_holder(B, two), keys.remove_holder(A, two)) == (False, True)
    assert {(holder.uuid, holder.fingerprint) for holder in keys.holders()} == {(A, one), (B, one)}
    keys.rotated(A)
    assert keys.holders() == [rows[2]]


# -- a master key that changed meanwhile -------------------------------------------------------------------------------


def test_a_record_that_was_read_before_the_master_key_changed_is_read_again(station: Station) -> None:
    agreed(station, A, 1, 2)
    records = station.keys.keys_of(A)
    with station.lock("test"):
        rewrap(station)
    assert [station.keys.unwrap(record) for record in records] == [b"\2" * 16, b"\1" * 16]
    assert station.keys.unwrap_named({A: id_of(1)}) == {A: (1, b"\1" * 16)}


def test_a_key_under_a_master_key_that_never_was_is_damaged(station: Station, store: Store) -> None:
    agreed(station, A, 1)
    store.execute("UPDATE keys SET wrapped = CAST(x'0100000009' || substr(wrapped, 6) AS BLOB)")
    (record,) = station.keys.keys_of(A)
    with pytest.raises(UnknownMasterKeyError):
        station.keys.unwrap(record)


def test_a_new_key_is_wrapped_under_the_master_key_of_now(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    agreed(station, A, 1)
    reread: list[str] = []
    monkeypatch.setattr(station.keys, "_reopened", lambda: reread.append("vault"))
    station.keys.refresh()
    assert reread == []
    monkeypatch.setattr(type(station.identity), "master", property(lambda identity: 7))
    agreed(station, A, 2)
    assert reread == ["vault"]
    (newest, _) = station.keys.keys_of(A)
    station.keys.correct_epoch(newest, 5)
    assert reread == ["vault", "vault"], "before a key is wrapped once more, too"


def test_of_nine_pending_keys_the_oldest_goes_and_the_active_one_stays(station: Station) -> None:
    agreed(station, A, 1)
    station.keys.activate(A, id_of(1))
    agreed(station, A, *range(2, 10))
    assert [key.epoch for key in station.keys.keys_of(A)] == [9, 8, 7, 6, 5, 4, 3, 2, 1]
    agreed(station, A, 10)
    assert [key.epoch for key in station.keys.keys_of(A)] == [10, 9, 8, 7, 6, 5, 4, 3, 1]
