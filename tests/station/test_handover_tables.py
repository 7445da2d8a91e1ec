"""Trust, handovers, tombstones, holders and revocations."""

from __future__ import annotations

from dataclasses import replace

import pytest

from teds_provision.errors import PolicyError, StoreError, UsageError
from teds_provision.station.store import Handover, Holder, RevocationRecord, Store, Tombstone, TrustRecord

NODE = bytes(range(10))
LAB = TrustRecord("lab", "station", b"\x04" + bytes(64), "ab" * 32)


def test_a_trusted_station_is_listed_and_removed_by_name(store: Store) -> None:
    store.put_trust(LAB)
    assert store.trusted() == [LAB]
    assert store.remove_trust("lab")
    assert not store.remove_trust("lab")
    assert store.trusted() == []


@pytest.mark.parametrize("digits", ["ab" * 32, "AB" * 32, "ab" * 8])
def test_a_trusted_station_is_removed_by_fingerprint(store: Store, digits: str) -> None:
    store.put_trust(LAB)
    assert store.remove_trust(digits)
    assert store.trusted() == []


def test_few_digits_or_ambiguous_ones_remove_nothing(store: Store) -> None:
    other = replace(LAB, name="shop", fingerprint="ab" * 31 + "cd")
    store.put_trust(LAB)
    store.put_trust(other)
    assert not store.remove_trust("abab")
    with pytest.raises(UsageError):
        store.remove_trust("ab" * 8)
    assert store.trusted() == [LAB, other]


def test_a_name_does_not_silently_change_its_key(store: Store) -> None:
    store.put_trust(LAB)
    with pytest.raises(PolicyError):
        store.put_trust(replace(LAB, fingerprint="cd" * 32))
    with pytest.raises(PolicyError):
        store.put_trust(replace(LAB, role="ca"))
    assert store.trusted() == [LAB]


def test_a_key_can_be_renamed_and_can_have_both_roles(store: Store) -> None:
    store.put_trust(LAB)
    store.put_trust(replace(LAB, name="bench"))
    store.put_trust(replace(LAB, name="owner", role="ca"))
    assert [(record.name, record.role) for record in store.trusted()] == [("bench", "station"), ("owner", "ca")]


def test_a_handover_is_kept_per_direction(store: Store) -> None:
    out = Handover("b1", "out", "move", ("ab" * 32,), "open", "[]", "cd" * 32, None, "2026-01-01T00:00:00Z")
    back = replace(out, direction="in", peers=("cd" * 32, "ef" * 32))
    store.put_handover(out)
    store.put_handover(back)
    store.put_handover(replace(out, state="closed", receipt="eyJ"))
    assert store.handover("b1", "out") == replace(out, state="closed", receipt="eyJ")
    assert store.handover("b1", "in") == back
    assert len(store.handovers()) == 2
    assert store.remove_handover("b1", "in")
    assert not store.remove_handover("b1", "in")


def test_a_tombstone_says_where_a_node_went(store: Store) -> None:
    stone = Tombstone(NODE, "ab" * 32, "b1")
    store.put_tombstone(stone)
    assert store.tombstone(NODE) == stone
    assert store.tombstones() == [stone]
    store.remove_tombstones([NODE])
    assert store.tombstone(NODE) is None


def test_holders_are_listed_per_node_and_in_all(store: Store) -> None:
    one, two = Holder(NODE, "ab" * 32), Holder(bytes(10), "cd" * 32, mode="move")
    store.put_holder(one)
    store.put_holder(two)
    assert store.holders(NODE) == [one]
    assert store.holders() == [two, one]
    assert store.remove_holder(NODE, "ab" * 32)
    assert not store.remove_holder(NODE, "ab" * 32)


def test_a_revocation_is_kept_with_its_statement(store: Store) -> None:
    revocation = RevocationRecord(NODE, None, "stolen", "eyJ.x.y")
    store.put_revocation(revocation)
    assert store.revocation(NODE) == revocation
    assert store.revocations() == [revocation]
    assert store.remove_revocation(NODE)
    assert store.revocation(NODE) is None


def test_a_point_of_the_wrong_length_is_not_trusted(store: Store) -> None:
    with pytest.raises(StoreError):
        store.put_trust(replace(LAB, point=b"\x04"))
    assert store.trusted() == []
