"""Trust, handovers, tombstones, holders and revocations."""

from __future__ import annotations

from dataclasses import replace

import pytest

from teds_provision.errors import PolicyError, StoreError, UsageError
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.station.bulk import BulkRows
from teds_provision.station.station import Station
from teds_provision.station.store.records import (
    Handover,
    Holder,
    NewNode,
    NewPin,
    NodeRecord,
    RevocationRecord,
    Tombstone,
    TrustRecord,
    WhitelistEntry,
)

NODE = bytes(range(10))
LAB = TrustRecord("lab", "station", b"\x04" + bytes(64), "ab" * 32)


def test_a_trusted_station_is_listed_and_removed_by_name(station: Station) -> None:
    station.policy.restore_trust(LAB)
    assert station.policy.trust_rows() == [LAB]
    assert station.policy.distrust("lab")
    assert not station.policy.distrust("lab")
    assert station.policy.trust_rows() == []


@pytest.mark.parametrize("digits", ["ab" * 32, "AB" * 32, "ab" * 8])
def test_a_trusted_station_is_removed_by_fingerprint(station: Station, digits: str) -> None:
    station.policy.restore_trust(LAB)
    assert station.policy.distrust(digits)
    assert station.policy.trust_rows() == []


def test_few_digits_or_ambiguous_ones_remove_nothing(station: Station) -> None:
    other = replace(LAB, name="shop", fingerprint="ab" * 31 + "cd")
    station.policy.restore_trust(LAB)
    station.policy.restore_trust(other)
    assert not station.policy.distrust("abab")
    with pytest.raises(UsageError):
        station.policy.distrust("ab" * 8)
    assert station.policy.trust_rows() == [LAB, other]


def test_a_name_does_not_silently_change_its_key(station: Station) -> None:
    station.policy.restore_trust(LAB)
    with pytest.raises(PolicyError):
        station.policy.restore_trust(replace(LAB, fingerprint="cd" * 32))
    with pytest.raises(PolicyError):
        station.policy.restore_trust(replace(LAB, role="ca"))
    assert station.policy.trust_rows() == [LAB]


def test_a_key_can_be_renamed_and_can_have_both_roles(station: Station) -> None:
    station.policy.restore_trust(LAB)
    station.policy.restore_trust(replace(LAB, name="bench"))
    station.policy.restore_trust(replace(LAB, name="owner", role="ca"))
    assert [(record.name, record.role) for record in station.policy.trust_rows()] == [
        ("bench", "station"),
        ("owner", "ca"),
    ]


def test_a_handover_is_kept_per_direction(station: Station) -> None:
    out = Handover("b1", "out", "move", ("ab" * 32,), "open", "[]", "cd" * 32, None, "2026-01-01T00:00:00Z")
    back = replace(out, direction="in", peers=("cd" * 32, "ef" * 32))
    station.handovers.put(out)
    station.handovers.put(back)
    station.handovers.put(replace(out, state="closed", receipt="eyJ"))
    assert station.handovers.get("b1", "out") == replace(out, state="closed", receipt="eyJ")
    assert station.handovers.get("b1", "in") == back
    assert len(station.handovers.all()) == 2
    assert station.handovers.remove("b1", "in")
    assert not station.handovers.remove("b1", "in")


def test_a_tombstone_says_where_a_node_went(station: Station) -> None:
    stone = Tombstone(NODE, "ab" * 32, "b1")
    station.policy.put_tombstone(stone)
    assert station.policy.tombstone(NODE) == stone
    assert station.policy.tombstones() == [stone]
    station.policy.take_back([NODE])
    assert station.policy.tombstone(NODE) is None


def test_holders_are_listed_per_node_and_in_all(station: Station) -> None:
    first, second = Holder(NODE, "ab" * 32), Holder(bytes(10), "cd" * 32, mode="move")
    station.keys.put_holder(first)
    station.keys.put_holder(second)
    assert station.keys.holders(NODE) == [first]
    assert station.keys.holders() == [second, first]
    assert station.keys.remove_holder(NODE, "ab" * 32)
    assert not station.keys.remove_holder(NODE, "ab" * 32)


def test_a_revocation_is_kept_with_its_statement(station: Station) -> None:
    revocation = RevocationRecord(NODE, None, "stolen", "eyJ.x.y")
    station.policy.deny(revocation)
    assert station.policy.revocation(NODE) == revocation
    assert station.policy.revocations() == [revocation]
    assert station.policy.forgive(NODE)
    assert station.policy.revocation(NODE) is None


def test_a_point_of_the_wrong_length_is_not_trusted(station: Station) -> None:
    with pytest.raises(StoreError):
        station.policy.restore_trust(replace(LAB, point=b"\x04"))
    assert station.policy.trust_rows() == []


def test_rows_at_once_replace_whole_rows_with_what_they_leave_empty(station: Station) -> None:
    """A column that no row of a chunk has a value for is left out of the statement, and is empty afterwards."""
    named = NodeRecord(NODE, name="left", profile="tactile", retired="worn", epoch=3, due="2027-01-31")
    other = NodeRecord(bytes(10), name="right", epoch=1)
    station.bulk.put(BulkRows(nodes=[named, other]))
    assert station.nodes.all() == [other, named]
    bare = [NodeRecord(NODE, epoch=4), NodeRecord(bytes(10), epoch=2, charging="{}")]
    station.bulk.put(BulkRows(nodes=bare))
    assert station.nodes.all() == bare[::-1]


def test_new_rows_at_once_have_macs_and_never_take_the_place_of_others(station: Station) -> None:
    point = SoftwareKey(5).point
    node = NewNode(NODE, point, "left", "tactile", 2, "ab" * 32)
    pin = NewPin(NODE, fingerprint(point), "2026-01-31T12:00:00Z", "import", "left")
    station.bulk.put(BulkRows(new_nodes=[node], new_pins=[pin]))
    assert station.nodes.get(NODE) == NodeRecord(NODE, point, "left", "tactile", 2, teds_sha256="ab" * 32)
    assert station.pins.entry(NODE) == WhitelistEntry(*pin)
    assert list(station.row_macs.all_broken()) == []
    with pytest.raises(StoreError):
        station.bulk.put(BulkRows(new_nodes=[node._replace(uuid=bytes(10)), node._replace(name="right")]))
    assert [record.name for record in station.nodes.all()] == ["left"]


def test_handovers_are_listed_from_the_oldest_on_whatever_their_ids(station: Station) -> None:
    for first, at in (("f", "2026-01-30T10:00:00Z"), ("0", "2026-01-30T10:00:05Z"), ("a", "2026-01-30T10:00:05Z")):
        station.handovers.put(Handover(first, "out", "copy", (), "open", "{}", None, None, at))
    assert [row.id for row in station.handovers.all()] == ["f", "0", "a"]
