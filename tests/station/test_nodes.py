"""Whitelist, nodes, names, drafts and the journal."""

from __future__ import annotations

from dataclasses import replace

import pytest

from teds_provision.errors import BadDataError, KeyMismatchError, NotFoundError, StoreError, UsageError
from teds_provision.station.store import Draft, NodeRecord, Store, WhitelistEntry
from teds_provision.teds.image import Image

FINGER = bytes.fromhex("0102030405060708090a")
JOINT = bytes.fromhex("0102ff0405060708090a")
POINT = b"\x04" + bytes(64)


def test_a_node_comes_back_as_it_was_put(store: Store) -> None:
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
    store.put_node(record)
    assert store.node(FINGER) == record
    assert store.nodes() == [record]
    assert store.node(JOINT) is None


def test_epoch_and_sequence_never_go_back(store: Store) -> None:
    store.put_node(NodeRecord(FINGER, epoch=5, sequence=70000))
    store.put_node(NodeRecord(FINGER, epoch=4, sequence=1, name="again"))
    node = store.node(FINGER)
    assert node is not None
    assert (node.epoch, node.sequence, node.name) == (5, 70000, "again")


def test_a_known_node_with_another_identity_key_is_refused(store: Store) -> None:
    store.put_node(NodeRecord(FINGER, POINT, epoch=2))
    with pytest.raises(KeyMismatchError):
        store.put_node(NodeRecord(FINGER, b"\x04" + bytes(63) + b"\1"))
    assert store.node(FINGER) == NodeRecord(FINGER, POINT, epoch=2)


def test_a_record_without_the_key_does_not_forget_it(store: Store) -> None:
    store.put_node(NodeRecord(FINGER, POINT))
    store.put_node(NodeRecord(FINGER, name="finger"))
    assert store.node(FINGER) == NodeRecord(FINGER, POINT, name="finger")


def test_an_owner_may_unpin_a_node_and_its_counters_stay(store: Store) -> None:
    store.put_node(NodeRecord(FINGER, POINT, epoch=9, sequence=8))
    store.unpin_node(FINGER)
    store.put_node(NodeRecord(FINGER, b"\x04" + bytes(63) + b"\1"))
    node = store.node(FINGER)
    assert node is not None
    assert (node.point, node.epoch, node.sequence) == (b"\x04" + bytes(63) + b"\1", 9, 8)


def test_a_uuid_of_the_wrong_length_does_not_come_in(store: Store) -> None:
    with pytest.raises(StoreError):
        store.put_node(NodeRecord(b"short"))
    with pytest.raises(StoreError):
        store.put_whitelist(WhitelistEntry(bytes(16)))
    assert (store.nodes(), store.whitelist()) == ([], [])


@pytest.mark.parametrize(
    "text", ["0102030405060708090a", "0x0102030405060708090A", "010203", "0X010203", " finger ", "finger"]
)
def test_a_node_is_found_by_uuid_prefix_and_name(store: Store, text: str) -> None:
    store.put_node(NodeRecord(FINGER, name="finger"))
    store.put_whitelist(WhitelistEntry(JOINT, name="joint"))
    assert store.resolve(text) == FINGER


def test_the_whitelist_resolves_too(store: Store) -> None:
    store.put_whitelist(WhitelistEntry(JOINT, name="joint"))
    assert store.resolve("joint") == store.resolve("0102f") == JOINT


def test_an_odd_number_of_digits_is_a_prefix_too(store: Store) -> None:
    store.put_node(NodeRecord(FINGER))
    store.put_node(NodeRecord(JOINT))
    assert store.resolve("01020") == FINGER
    assert store.resolve("0102f") == JOINT


def test_a_full_uuid_is_returned_even_if_unknown(store: Store) -> None:
    assert store.resolve("0x" + "fe" * 10) == b"\xfe" * 10


def test_an_ambiguous_prefix_lists_the_candidates(store: Store) -> None:
    store.put_node(NodeRecord(FINGER))
    store.put_whitelist(WhitelistEntry(JOINT))
    with pytest.raises(UsageError, match=f"{FINGER.hex()}, {JOINT.hex()}"):
        store.resolve("0102")


def test_a_renamed_node_leaves_its_old_name_although_the_whitelist_keeps_it(store: Store) -> None:
    """An import puts one name into both tables; the whitelist's row is sealed, and not written again by a rename."""
    store.put_whitelist(WhitelistEntry(FINGER, name="grip"))
    assert store.resolve("grip") == FINGER
    store.put_node(NodeRecord(FINGER, name="grip"))
    store.put_node(NodeRecord(FINGER, name="wrist"))
    assert store.resolve("wrist") == FINGER
    with pytest.raises(NotFoundError):
        store.resolve("grip")
    assert store.bearers_of(["grip", "wrist"]) == {"wrist": FINGER}
    assert store.all_named("grip") == []
    assert store.beginning_with("", 9) == [(FINGER.hex(), "wrist"), ("wrist", FINGER.hex())]


def test_a_name_that_two_nodes_have_is_ambiguous(store: Store) -> None:
    store.put_node(NodeRecord(FINGER, name="twin"))
    store.put_node(NodeRecord(JOINT, name="twin"))
    with pytest.raises(UsageError):
        store.resolve("twin")


@pytest.mark.parametrize(
    "text", ["", "0x", "010", "ffff", "nobody", "0102030405060708090a0b", "%", "0102%", "' OR 1=1"]
)
def test_what_fits_no_node_is_not_found(store: Store, text: str) -> None:
    store.put_node(NodeRecord(FINGER, name="finger"))
    with pytest.raises(NotFoundError):
        store.resolve(text)


def test_a_name_in_a_broken_encoding_is_bad_data(store: Store) -> None:
    with pytest.raises(BadDataError):
        store.resolve("caf\udce9")


def test_the_whitelist_keeps_and_removes(store: Store) -> None:
    entry = WhitelistEntry(FINGER, "cd" * 32, "2026-01-01T00:00:00Z", "tap", "finger")
    store.put_whitelist(WhitelistEntry(FINGER))
    store.put_whitelist(entry)
    assert store.whitelisted(FINGER) == entry
    assert store.whitelist() == [entry]
    assert store.remove_whitelist(FINGER)
    assert not store.remove_whitelist(FINGER)
    assert store.whitelisted(FINGER) is None


def test_a_draft_goes_through_its_stages(store: Store) -> None:
    draft = Draft(FINGER, Image(FINGER, {(0, 1): b"meta"}), profile="tactile-finger-sensor")
    store.put_draft(draft)
    store.put_draft(replace(draft, stage="signed"))
    assert store.draft(FINGER) == replace(draft, stage="signed")
    store.drop_draft(FINGER)
    assert store.draft(FINGER) is None


def test_ten_thousand_nodes_are_quick_to_find(store: Store) -> None:
    with store.transaction():
        for number in range(10_000):
            store.put_node(NodeRecord(b"\xaa" + number.to_bytes(9, "big"), name=f"node-{number}"))
    assert len(store.nodes()) == 10_000
    assert store.resolve("node-9999") == b"\xaa" + (9999).to_bytes(9, "big")
    assert store.resolve("aa" + (9998).to_bytes(9, "big").hex()[:-1] + "e") == b"\xaa" + (9998).to_bytes(9, "big")
