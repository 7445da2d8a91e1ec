"""Whitelist, nodes, names, drafts and the journal."""

from __future__ import annotations

from dataclasses import replace

import pytest

from teds_provision.errors import BadDataError, KeyMismatchError, NotFoundError, StoreError, UsageError
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft, NodeRecord, WhitelistEntry
from teds_provision.teds.image import Image

FINGER = bytes.fromhex("0102030405060708090a")
JOINT = bytes.fromhex("0102ff0405060708090a")
POINT = b"\x04" + bytes(64)


def test_a_node_comes_back_as_it_was_put(station: Station) -> None:
    record = NodeRecord(
        FINGER,
        POINT,
        "finger",
        "tactile-finger-sensor",
        2,
        3,
        17,
        0x21,
        "ab" * 32,
        "authentic",
        "t",
        4,
    )
    station.nodes.restore(record)
    assert station.nodes.get(FINGER) == record
    assert station.nodes.all() == [record]
    assert station.nodes.get(JOINT) is None


def test_epoch_and_sequence_never_go_back(station: Station) -> None:
    station.nodes.restore(NodeRecord(FINGER, epoch=5, sequence=70000))
    station.nodes.restore(NodeRecord(FINGER, epoch=4, sequence=1, name="again"))
    node = station.nodes.get(FINGER)
    assert node is not None
    assert (node.epoch, node.sequence, node.name) == (5, 70000, "again")


def test_a_known_node_with_another_identity_key_is_refused(station: Station) -> None:
    station.nodes.restore(NodeRecord(FINGER, POINT, epoch=2))
    with pytest.raises(KeyMismatchError):
        station.nodes.restore(NodeRecord(FINGER, b"\x04" + bytes(63) + b"\1"))
    assert station.nodes.get(FINGER) == NodeRecord(FINGER, POINT, epoch=2)


def test_a_record_without_the_key_does_not_forget_it(station: Station) -> None:
    station.nodes.restore(NodeRecord(FINGER, POINT))
    station.nodes.restore(NodeRecord(FINGER, name="finger"))
    assert station.nodes.get(FINGER) == NodeRecord(FINGER, POINT, name="finger")


def test_an_owner_may_unpin_a_node_and_its_counters_stay(station: Station) -> None:
    station.nodes.restore(NodeRecord(FINGER, POINT, epoch=9, sequence=8))
    station.nodes.unpin(FINGER)
    station.nodes.restore(NodeRecord(FINGER, b"\x04" + bytes(63) + b"\1"))
    node = station.nodes.get(FINGER)
    assert node is not None
    assert (node.point, node.epoch, node.sequence) == (b"\x04" + bytes(63) + b"\1", 9, 8)


def test_a_uuid_of_the_wrong_length_does_not_come_in(station: Station) -> None:
    with pytest.raises(StoreError):
        station.nodes.restore(NodeRecord(b"short"))
    with pytest.raises(StoreError):
        station.pins.restore([WhitelistEntry(bytes(16))])
    assert (station.nodes.all(), station.pins.whitelist()) == ([], [])


@pytest.mark.parametrize(
    "text", ["0102030405060708090a", "0x0102030405060708090A", "010203", "0X010203", " finger ", "finger"]
)
def test_a_node_is_found_by_uuid_prefix_and_name(station: Station, text: str) -> None:
    station.nodes.restore(NodeRecord(FINGER, name="finger"))
    station.pins.restore([WhitelistEntry(JOINT, name="joint")])
    assert station.nodes.resolve(text) == FINGER


def test_the_whitelist_resolves_too(station: Station) -> None:
    station.pins.restore([WhitelistEntry(JOINT, name="joint")])
    assert station.nodes.resolve("joint") == station.nodes.resolve("0102f") == JOINT


def test_an_odd_number_of_digits_is_a_prefix_too(station: Station) -> None:
    station.nodes.restore(NodeRecord(FINGER))
    station.nodes.restore(NodeRecord(JOINT))
    assert station.nodes.resolve("01020") == FINGER
    assert station.nodes.resolve("0102f") == JOINT


def test_a_full_uuid_is_returned_even_if_unknown(station: Station) -> None:
    assert station.nodes.resolve("0x" + "fe" * 10) == b"\xfe" * 10


def test_an_ambiguous_prefix_lists_the_candidates(station: Station) -> None:
    station.nodes.restore(NodeRecord(FINGER))
    station.pins.restore([WhitelistEntry(JOINT)])
    with pytest.raises(UsageError, match=f"{FINGER.hex()}, {JOINT.hex()}"):
        station.nodes.resolve("0102")


def test_a_renamed_node_leaves_its_old_name_although_the_whitelist_keeps_it(station: Station) -> None:
    """An import puts one name into both tables; the whitelist's row is sealed, and not written again by a rename."""
    station.pins.restore([WhitelistEntry(FINGER, name="grip")])
    assert station.nodes.resolve("grip") == FINGER
    station.nodes.restore(NodeRecord(FINGER, name="grip"))
    station.nodes.restore(NodeRecord(FINGER, name="wrist"))
    assert station.nodes.resolve("wrist") == FINGER
    with pytest.raises(NotFoundError):
        station.nodes.resolve("grip")
    assert station.nodes.bearers_of(["grip", "wrist"]) == {"wrist": FINGER}
    assert station.nodes.all_named("grip") == []
    assert (station.nodes.named("grip"), station.nodes.named("wrist")) == (None, FINGER)
    station.nodes.restore(NodeRecord(JOINT, name="grip"))
    assert station.nodes.named("grip") == JOINT
    station.nodes.restore(NodeRecord(JOINT, name="elbow"))
    assert station.nodes.beginning_with("wr", 9) == [("wrist", FINGER.hex())]
    assert station.nodes.beginning_with("gr", 9) == []


def test_names_and_uuids_that_begin_so_come_in_order_and_no_more_than_are_asked_for(station: Station) -> None:
    first, second, third = (bytes.fromhex("ab" * 9 + end) for end in ("01", "02", "03"))
    station.nodes.restore(NodeRecord(first, name="abel"))
    station.nodes.restore(NodeRecord(second))
    station.pins.restore([WhitelistEntry(first, name="abacus"), WhitelistEntry(third, name="abc")])
    uuids = [(first.hex(), "abel"), (second.hex(), ""), (third.hex(), "abc")]
    assert station.nodes.beginning_with("ab", 9) == [*uuids, ("abc", third.hex()), ("abel", first.hex())]
    assert station.nodes.beginning_with("ab", 2) == uuids[:2]
    for text in ("0xab", "0xABAB", "AB"):
        assert station.nodes.beginning_with(text, 9) == uuids


def test_a_name_that_two_nodes_have_is_ambiguous(station: Station) -> None:
    station.nodes.restore(NodeRecord(FINGER, name="twin"))
    station.nodes.restore(NodeRecord(JOINT, name="twin"))
    with pytest.raises(UsageError):
        station.nodes.resolve("twin")


@pytest.mark.parametrize(
    "text", ["", "0x", "010", "ffff", "nobody", "0102030405060708090a0b", "%", "0102%", "' OR 1=1"]
)
def test_what_fits_no_node_is_not_found(station: Station, text: str) -> None:
    station.nodes.restore(NodeRecord(FINGER, name="finger"))
    with pytest.raises(NotFoundError):
        station.nodes.resolve(text)


def test_a_name_in_a_broken_encoding_is_bad_data(station: Station) -> None:
    with pytest.raises(BadDataError):
        station.nodes.resolve("caf\udce9")


def test_the_whitelist_keeps_and_removes(station: Station) -> None:
    entry = WhitelistEntry(FINGER, "cd" * 32, "2026-01-01T00:00:00Z", "tap", "finger")
    station.pins.put(WhitelistEntry(FINGER))
    station.pins.put(entry)
    assert station.pins.row(FINGER) == entry
    assert station.pins.whitelist() == [entry]
    assert station.pins.remove(FINGER)
    assert not station.pins.remove(FINGER)
    assert station.pins.row(FINGER) is None


def test_a_draft_goes_through_its_stages(station: Station) -> None:
    draft = Draft(FINGER, Image(FINGER, {(0, 1): b"meta"}), profile="tactile-finger-sensor")
    station.datasheets.keep_draft(draft)
    station.datasheets.keep_draft(replace(draft, stage="signed"))
    assert station.datasheets.draft(FINGER) == replace(draft, stage="signed")
    station.datasheets.drop_draft(FINGER)
    assert station.datasheets.draft(FINGER) is None


def test_ten_thousand_nodes_are_quick_to_find(station: Station) -> None:
    with station.transaction():
        for number in range(10_000):
            station.nodes.restore(NodeRecord(b"\xaa" + number.to_bytes(9, "big"), name=f"node-{number}"))
    assert len(station.nodes.all()) == 10_000
    assert station.nodes.resolve("node-9999") == b"\xaa" + (9999).to_bytes(9, "big")
    assert station.nodes.resolve("aa" + (9998).to_bytes(9, "big").hex()[:-1] + "e") == b"\xaa" + (9998).to_bytes(
        9, "big"
    )


def test_a_node_was_met_last_at_the_place_of_its_last_meeting(station: Station) -> None:
    first, second = bytes(10), bytes([1]) * 10
    for uuid, place in ((first, "can:a"), (second, "can:a"), (first, "ble:hci0"), (first, "")):
        station.nodes.met_at(uuid, place)
    assert station.nodes.last_places([first, second]) == {first: "ble:hci0", second: "can:a"}
