"""The key of each UUID: whole or its beginning, from the whitelist or a contact, what the plant hears of it."""

from __future__ import annotations

from typing import Any

import pytest

from teds_provision.errors import KeyMismatchError, StoreChangedError
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.station.pins import Pins
from teds_provision.station.plant.plant import Plant
from teds_provision.station.station import Station
from teds_provision.station.store.records import NewPin, NodeRecord, WhitelistEntry
from teds_provision.station.store.row_sample import RowSample
from teds_provision.station.store.store import Store

A, B, C = (bytes.fromhex("8d4d9da65281f70000") + bytes([number]) for number in (1, 2, 3))
POINT, POINT2 = SoftwareKey(101).point, SoftwareKey(102).point
WHOLE, WHOLE2 = fingerprint(POINT), fingerprint(POINT2)
AT = "2026-10-01T08:00:00Z"


def entry(uuid: bytes = A, key: str | None = None, name: str | None = None, **more: Any) -> WhitelistEntry:
    return WhitelistEntry(uuid, key, AT, name=name, **more)


@pytest.mark.parametrize(
    ("listed", "shown", "pinned"),
    [
        (None, None, None),
        ("", None, None),  # listed without a key
        ("", POINT, WHOLE),
        (None, POINT, WHOLE),
        (WHOLE, None, WHOLE),
        (WHOLE, POINT2, WHOLE),  # the whitelist's word
        (WHOLE[:32], None, WHOLE[:32]),
        (WHOLE[:32], POINT, WHOLE),  # the whole of it was seen
        (WHOLE[:32], POINT2, WHOLE[:32]),
        (WHOLE[:63], POINT, WHOLE),
    ],
)
def test_a_uuid_is_pinned_to_the_whitelists_key_else_to_the_one_that_it_showed(
    station: Station, listed: str | None, shown: bytes | None, pinned: str | None
) -> None:
    pins = station.pins
    if listed is not None:
        pins.put(entry(key=listed or None))
    if shown is not None:
        station.nodes.put(NodeRecord(A, shown))
    assert pins.pinned(A) == pinned
    assert pins.all() == ({} if pinned is None else {A: pinned})
    for point in (POINT, POINT2):
        if pinned is None or fingerprint(point).startswith(pinned[:32]):
            pins.check(A, point)
            continue
        with pytest.raises(KeyMismatchError) as caught:
            pins.check(A, point)
        assert caught.value.message == (
            f"This UUID is known with key {pinned[:16]}, the node shows {fingerprint(point)[:16]}."
        )
    pins.check(B, POINT)


def test_entries_by_uuid(station: Station) -> None:
    pins = station.pins
    pins.put(entry(B, WHOLE2, "grip", assurance="tap"), entry(A, None))
    pins.add_many([NewPin(C, WHOLE, AT, "import", "wrist")])
    rows = [entry(A), entry(B, WHOLE2, "grip", assurance="tap"), entry(C, WHOLE, "wrist", assurance="import")]
    assert pins.whitelist() == list(pins.all_entries()) == rows
    assert pins.get_many([C, bytes(10)]) == {C: rows[2]}
    assert [pins.entry(B), pins.entry(bytes(10)), pins.row(A)] == [rows[1], None, rows[0]]
    assert [row[0] for row in pins.mac_rows(RowSample(full=True))] == [
        f"the whitelist entry of {uuid.hex()}" for uuid in (A, B, C)
    ]
    assert (pins.remove(A), pins.remove(A)) == (True, False)
    assert pins.whitelist() == rows[1:]


@pytest.mark.parametrize(
    "change", ["fingerprint = NULL", "assurance = 'tap'", "name = 'other'", "mac = NULL", "mac = zeroblob(16)"]
)
def test_an_entry_that_another_program_changed_is_not_read(station: Station, store: Store, change: str) -> None:
    station.pins.put(entry(A, WHOLE, "grip"), entry(B, WHOLE2))
    store.execute(f"UPDATE whitelist SET {change} WHERE uuid = ?", (A,))
    pins = station.pins
    for read in (
        lambda: pins.entry(A), lambda: pins.pinned(A), pins.whitelist, lambda: list(pins.all_entries()),
        lambda: pins.get_many([A]), lambda: pins.check(A, POINT),
    ):  # fmt: skip
        with pytest.raises(StoreChangedError, match=f"the whitelist entry of {A.hex()}"):
            read()
    assert pins.entry(B) == entry(B, WHOLE2)
    assert pins.row(A) is not None
    assert pins.remove(A), "it can be removed all the same"


# -- what the plant hears ----------------------------------------------------------------------------------------------


@pytest.fixture
def told(station: Station, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """The station has joined a plant; what it reports."""
    heard: list[tuple[Any, ...]] = []
    monkeypatch.setattr(Plant, "joined", property(lambda plant: object()))
    monkeypatch.setattr(station.plant, "record_event", lambda act, uuid, **more: heard.append((act, uuid, more)))
    monkeypatch.setattr(station.plant, "record_name", lambda uuid, name: heard.append(("named", uuid, name)))
    return heard


def pinned_by(how: str, key: str = WHOLE) -> tuple[str, bytes, dict[str, str]]:
    return "pinned", A, {"fingerprint": key, "assurance": how}


@pytest.mark.parametrize(
    ("before", "after", "heard"),
    [
        (None, entry(), []),
        (None, entry(key=WHOLE, assurance="tap"), [pinned_by("tap")]),
        (None, entry(key=WHOLE[:63], assurance="tap"), []),  # not the whole key
        (None, entry(key=WHOLE, assurance="registry"), []),  # the plant said so
        (entry(), entry(key=WHOLE), [pinned_by("uuid")]),
        (entry(key=WHOLE), entry(key=WHOLE), []),
        (entry(key=WHOLE), entry(key=WHOLE, assurance="tap"), [pinned_by("tap")]),
        (entry(key=WHOLE), entry(key=WHOLE2), [pinned_by("uuid", WHOLE2)]),
        (entry(key=WHOLE), entry(key=WHOLE, name="grip"), [("named", A, "grip")]),
        (entry(key=WHOLE, name="grip"), entry(key=WHOLE), [("named", A, None)]),
        (None, entry(key=WHOLE, name="grip"), [("named", A, "grip"), pinned_by("uuid")]),
        (None, entry(key=WHOLE, name="grip", assurance="registry"), [("named", A, "grip")]),
    ],
)
def test_a_new_pin_of_this_station_is_reported_once(
    station: Station,
    told: list[tuple[Any, ...]],
    before: WhitelistEntry | None,
    after: WhitelistEntry,
    heard: list[tuple[Any, ...]],
) -> None:
    if before is not None:
        station.pins.put_many([before])
    assert told == [], "what a bundle or a backup brings is not reported"
    station.pins.put(after)
    assert told == heard
    assert station.pins.entry(A) == after


@pytest.mark.parametrize(
    ("before", "heard"),
    [
        (entry(key=WHOLE), [("unpinned", A, {})]),
        (entry(key=WHOLE[:40]), []),
        (entry(), []),
        (entry(key=WHOLE, assurance="registry"), []),
    ],
)
def test_who_takes_a_pin_away_reports_it_if_it_was_this_stations(
    station: Station, told: list[tuple[Any, ...]], before: WhitelistEntry, heard: list[tuple[Any, ...]]
) -> None:
    station.pins.put_many([before])
    assert station.pins.remove(A)
    assert told == heard
    assert not station.pins.remove(A)
    assert told == heard


def test_without_a_plant_nothing_is_reported(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Pins, "_report_pin", lambda pins, entry: pytest.fail("reported"))
    station.pins.put(entry(key=WHOLE))
    assert station.pins.remove(A)


# -- a board that was replaced -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("listed", "shown", "former"),
    [
        (WHOLE, None, WHOLE),
        (WHOLE, POINT2, WHOLE),
        (WHOLE[:32], POINT, WHOLE),
        (WHOLE[:32], POINT2, None),  # no board with that beginning was met
        (WHOLE[:32], None, None),
        ("", POINT2, WHOLE2),
        ("", None, None),
    ],
)
def test_the_link_keys_of_an_unpinned_board_stay_with_the_one_that_had_the_pin(
    station: Station, listed: str, shown: bytes | None, former: str | None
) -> None:
    pins = station.pins
    pins.put(entry(key=listed or None))
    if shown is not None:
        station.nodes.put(NodeRecord(A, shown, epoch=4))
    station.keys.add_pending(A, key=bytes(16), key_id=bytes(8), epoch=4)
    station.keys.activate(A, bytes(8).hex())
    pins.unpin(A)
    assert station.keys.former(A) == former
    assert pins.is_unsettled(A) is (former is not None)
    node = station.nodes.get(A)
    assert node is None or (node.point, node.epoch) == (None, 4)
    other = WHOLE if former == WHOLE2 else WHOLE2
    assert pins.epoch_to_exceed(A, other) == (0 if former else 4), "another board never agreed on that key"
    assert pins.epoch_to_exceed(A, former or WHOLE) == 4
    assert pins.epoch_to_exceed(A, None) == 4
    pins.settled(A)
    assert not pins.is_unsettled(A)
    assert pins.epoch_to_exceed(A, other) == 4


def test_a_shown_key_that_another_program_changed_pins_nothing(station: Station, store: Store) -> None:
    station.unlock()
    pins = station.pins
    station.nodes.put(NodeRecord(A, POINT))
    station.nodes.put(NodeRecord(B))
    pins.put(entry(B), entry(C, WHOLE2))
    assert pins.all() == {A: WHOLE, C: WHOLE2}
    assert pins.all([]) == {C: WHOLE2}, "of the nodes that were read already"
    assert [pins.pinned(uuid) for uuid in (A, B, C)] == [WHOLE, None, WHOLE2]
    assert pins.pinned_elsewhere(station.nodes.all()) == set()
    store.execute("UPDATE nodes SET point = ? WHERE uuid = ?", (POINT2, A))
    nodes = station.nodes.all()
    for read in (lambda: pins.pinned(A), pins.all, lambda: pins.pinned_elsewhere(nodes), lambda: pins.check(A, POINT2)):
        with pytest.raises(StoreChangedError, match=f"the key of node {A.hex()}"):
            read()
