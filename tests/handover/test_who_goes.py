"""Which nodes leave in a bundle, which stay and why, and how they are divided (handover.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from teds_provision.errors import NotFoundError, PolicyError, UsageError
from teds_provision.handover.outgoing import ExportOrder, ExportPlan, Selection, outputs_of, plan_export, plan_exports
from teds_provision.handover.pending import BundleNotes
from teds_provision.protocol.handover.bundle import Mode
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.station.station import Station
from teds_provision.station.store.records import (
    Handover,
    Holder,
    KeyRecord,
    NodeRecord,
    RevocationRecord,
    Tombstone,
    TrustRecord,
    WhitelistEntry,
)

SOUTH, WEST, NODE, OTHER = (SoftwareKey(number).point for number in (131, 132, 133, 134))
TO_SOUTH, TO_WEST = fingerprint(SOUTH), fingerprint(WEST)
A, B, C, D = (bytes.fromhex("8d4d9da65281f70000") + bytes([number]) for number in (1, 2, 3, 4))
NOW = datetime(2026, 3, 1, 8, tzinfo=UTC)
AT = "2026-03-01T08:00:00Z"
Change = Callable[[Station], object]


def keyed(station: Station, uuid: bytes, epoch: int = 1, state: str = "active", slot: int = 1) -> bool:
    key_id = f"{uuid[-1]:02x}{epoch:014x}"
    station.keys.add(KeyRecord(uuid, epoch, key_id, state, slot, b"w", "agreement", AT))  # type: ignore[arg-type]
    return True


@pytest.fixture
def north(station: Station) -> Station:
    """A station that trusts south and west, with nodes A and B that are ready to go."""
    station.unlock()
    for name, point in (("south", SOUTH), ("west", WEST)):
        station.policy.trust(TrustRecord(name, "station", point, fingerprint(point)))
    for uuid in (B, A):
        station.nodes.put(NodeRecord(uuid, NODE))
        keyed(station, uuid)
    return station


def plan(station: Station, *nodes: bytes, mode: Mode = "copy", to: tuple[str, ...] = ("south",), ca: str | None = None,
         days: int = 7) -> ExportPlan:  # fmt: skip
    return plan_export(station, ExportOrder(to, nodes or None, mode, days, ca), now=NOW)


def going(station: Station, *nodes: bytes, mode: Mode = "copy") -> list[bytes]:
    return [node.uuid for node in plan(station, *nodes, mode=mode).nodes]


def moved(station: Station, uuid: bytes, *, to: str = TO_SOUTH, id: str = "h1", state: str = "open",
          run: str = "", created: str = AT) -> bool:  # fmt: skip
    station.policy.put_tombstone(Tombstone(uuid, to, id, AT))
    notes = BundleNotes((uuid.hex(),), id, "04", "2026-03-08T08:00:00Z", run=run)
    station.handovers.put(Handover(id, "out", "move", (to,), state, notes.to_json(), created=created))
    return True


REVOKED, AWAY, NO_KEY = "it is revoked", "it was moved to station", "this station holds no key for it"
UNPROVEN, DUE = "its key was never proven in a session", "its key must be rotated first"
UNSETTLED = "an agreement with it is not settled: the key that it has now may be a newer one"
NO_POINT = "its public key is not known"
OUT, ELSEWHERE = "it is out of service", "the key that it showed last is not the one that it is pinned to"


@pytest.mark.parametrize(
    ("change", "copy", "move"),
    [
        (lambda s: None, "", ""),
        (lambda s: s.policy.deny(RevocationRecord(A, None, "lost", "s", AT)), REVOKED, REVOKED),
        (lambda s: s.keys.demand_rotation(A, "why"), DUE, DUE),
        (lambda s: keyed(s, A, 2, "pending", 2), "", UNSETTLED),
        (lambda s: s.keys.remove(A), NO_KEY, NO_KEY),
        (lambda s: (s.keys.remove(A), keyed(s, A, 2, "pending", 2)), UNPROVEN, UNPROVEN),
        (lambda s: s.nodes.unpin(A), NO_POINT, NO_POINT),
        (lambda s: s.nodes.remember(A, retired="decommissioned, unconfirmed"), OUT, OUT),
        (lambda s: s.nodes.remember(A, retired=f"replaced by {B.hex()}"), OUT, OUT),
        (lambda s: s.nodes.remember(A, retired="on the shelf"), "", ""),
        (lambda s: s.pins.put(WhitelistEntry(A, fingerprint(OTHER))), ELSEWHERE, ELSEWHERE),
        (lambda s: s.pins.put(WhitelistEntry(A, fingerprint(NODE)[:32])), "", ""),
        (lambda s: moved(s, A), f"{AWAY} {TO_SOUTH[:16]}", ""),  # that move is carried on
        (lambda s: moved(s, A, to=TO_WEST), f"{AWAY} {TO_WEST[:16]}", f"{AWAY} {TO_WEST[:16]}"),
        (lambda s: moved(s, A, state="closed"), f"{AWAY} {TO_SOUTH[:16]}", f"{AWAY} {TO_SOUTH[:16]}"),
        (lambda s: (moved(s, A, to=TO_WEST), s.policy.deny(RevocationRecord(A, None, "l", "s", AT))), REVOKED, REVOKED),
        (lambda s: (s.keys.demand_rotation(A, "why"), s.nodes.unpin(A)), DUE, DUE),
    ],
)  # fmt: skip
def test_a_named_node_goes_or_the_first_reason_is_told(north: Station, change: Change, copy: str, move: str) -> None:
    change(north)
    modes: tuple[tuple[Mode, str], ...] = (("copy", copy), ("move", move))
    for mode, why in modes:
        if not why:
            nodes = (A,) if north.policy.tombstones() else (B, A, B)
            assert going(north, *nodes, mode=mode) == sorted(set(nodes))
            continue
        with pytest.raises(PolicyError) as caught:
            plan(north, B, A, mode=mode)
        assert caught.value.message == f"Node {A.hex()} cannot be handed over: {why}."


def test_all_that_can_go_goes_and_the_others_are_named(north: Station) -> None:
    for uuid, point in ((C, NODE), (D, None)):
        north.nodes.put(NodeRecord(uuid, point))
        keyed(north, uuid)
    north.keys.demand_rotation(B, "why")
    keyed(north, C, 2, "pending", 2)
    found = plan(north)
    assert [(node.uuid, node.key_id, node.epoch) for node in found.nodes] == [
        (A, f"{1:02x}{1:014x}", 1), (C, f"{3:02x}{1:014x}", 1)
    ]  # fmt: skip
    assert found.skipped == ((B, DUE), (D, NO_POINT))
    assert plan(north, mode="move").skipped == ((B, DUE), (C, UNSETTLED), (D, NO_POINT))
    assert plan(north, A, C).skipped == ()


def test_if_nothing_is_left_all_means_the_last_move_that_was_cut(north: Station) -> None:
    moved(north, A, id="h1", run="r", created="2026-03-01T08:00:01Z")
    moved(north, B, id="h2", run="r", created="2026-03-01T08:00:02Z")
    with pytest.raises(NotFoundError, match="no node to hand over"):
        plan(north)
    parts = plan_exports(north, ExportOrder(("south",), None, "move"), now=NOW)
    assert [[node.uuid for node in part.nodes] for part in parts] == [[A], [B]]
    north.policy.deny(RevocationRecord(B, None, "lost", "s", AT))
    with pytest.raises(PolicyError) as caught:
        plan_exports(north, ExportOrder(("south",), None, "move"), now=NOW)
    assert caught.value.message == (
        f"The pending move includes node {B.hex()} and cannot be sealed again: it is revoked."
    )
    with pytest.raises(NotFoundError):
        plan(north, mode="move", to=("west",))
    north.policy.forgive(B)
    north.keys.remove(B)
    with pytest.raises(PolicyError, match="cannot be sealed again: this station holds no key for it"):
        plan_exports(north, ExportOrder(("south",), None, "move"), now=NOW)


def test_while_others_can_go_a_move_that_was_cut_stays(north: Station) -> None:
    moved(north, B)
    found = plan(north, mode="move")
    assert [node.uuid for node in found.nodes] == [A]
    assert found.skipped == ((B, f"{AWAY} {TO_SOUTH[:16]}"),)


def test_of_named_nodes_those_that_fit_by_uuid(north: Station) -> None:
    north.keys.demand_rotation(C, "why")
    order = ExportOrder(("south",), (C, B, A, B))
    assert [node.uuid for node in Selection(north, order, {TO_SOUTH}).fitting()] == [A, B]
    north.keys.demand_rotation(A, "why")
    assert [node.uuid for node in Selection(north, order, {TO_SOUTH}).fitting()] == [B]


@pytest.mark.parametrize(
    ("runs", "again"), [(("", ""), [B]), (("r", "r"), [A, B]), (("q", "r"), [B]), (("r", ""), [B])]
)
def test_of_two_moves_that_were_cut_the_newest_command_is_carried_on(
    north: Station, runs: tuple[str, str], again: list[bytes]
) -> None:
    moved(north, A, id="h1", run=runs[0], created="2026-03-01T08:00:01Z")
    moved(north, B, id="h2", run=runs[1], created="2026-03-01T08:00:02Z")
    parts = plan_exports(north, ExportOrder(("south",), None, "move"), now=NOW)
    assert [node.uuid for part in parts for node in part.nodes] == again


def test_a_copy_to_the_same_station_since_is_no_move_that_was_cut(north: Station) -> None:
    moved(north, A)
    moved(north, B)
    notes = BundleNotes((C.hex(),), "copy", "04", "2026-03-08T08:00:00Z")
    north.handovers.put(
        Handover("h2", "out", "copy", (TO_SOUTH,), "open", notes.to_json(), created="2026-03-01T09:00:00Z")
    )
    assert going(north, mode="move") == [B]


def test_nodes_are_divided_and_those_of_an_open_move_stay_together(north: Station) -> None:
    for uuid in (C, D):
        north.nodes.put(NodeRecord(uuid, NODE))
        keyed(north, uuid)
    moved(north, C)
    parts = plan_exports(north, ExportOrder(("south",), (A, B, C, D), "move"), most=2, now=NOW)
    assert [[node.uuid for node in part.nodes] for part in parts] == [[C], [A, B], [D]]
    north.nodes.unpin(D)
    parts = plan_exports(north, ExportOrder(("south",), None, "move"), most=1, now=NOW)
    away = f"{AWAY} {TO_SOUTH[:16]}"
    assert [([node.uuid for node in part.nodes], part.skipped) for part in parts] == [
        ([A], ((C, away), (D, NO_POINT))), ([B], ())
    ], "what stays is named once"  # fmt: skip
    north.nodes.put(NodeRecord(D, NODE))
    with pytest.raises(UsageError, match="too many nodes for one bundle"):
        plan(north, A, C, mode="move")
    assert [path.name for path in outputs_of(Path("out.jwe"), 3)] == ["out.jwe", "out.jwe.2", "out.jwe.3"]


@pytest.mark.parametrize(
    ("order", "error", "why"),
    [
        (ExportOrder((), None), UsageError, "No receiver was given."),
        (ExportOrder(("nobody",), None), NotFoundError, "No trusted station is known as 'nobody'."),
        (ExportOrder(("south", "west"), None, "move"), UsageError, "A move has exactly one receiver."),
        (ExportOrder(("south",), None, days=0), UsageError, "A bundle is valid for at least one day."),
        (ExportOrder(("south",), None, ca="ab"), NotFoundError, "None of these nodes holds the CA key ab."),
    ],
)
def test_an_order_that_means_nothing(north: Station, order: ExportOrder, error: type[Exception], why: str) -> None:
    with pytest.raises(error) as caught:
        plan_export(north, order, now=NOW)
    assert str(caught.value).startswith(why)


def test_a_receiver_counts_once_and_a_bundle_ends_after_its_days(north: Station) -> None:
    found = plan(north, A, to=("south", TO_SOUTH[:16]), days=1, mode="move")
    assert [record.name for record in found.receivers] == ["south"]
    assert found.expires == NOW + timedelta(days=1)
    both = plan(north, A, to=("west", "south"))
    assert [record.name for record in both.receivers] == ["west", "south"]
    assert set(both.signatures) == {TO_SOUTH, TO_WEST}
    assert both.expires == NOW + timedelta(days=7)


def test_one_bundle_has_one_ca_and_a_receiver_that_it_certified(north: Station) -> None:
    other = SoftwareKey(135)
    north.keys.set_ca_of(B, other.point)
    own, theirs = sorted((fingerprint(north.ca)[:16], fingerprint(other.point)[:16]))
    with pytest.raises(PolicyError, match="2 different CA keys") as caught:
        plan(north)
    assert caught.value.hint == f"Export them separately: --ca {own} / --ca {theirs}"
    assert [node.uuid for node in plan(north, ca=fingerprint(north.ca)[:8].upper()).nodes] == [A]
    with pytest.raises(PolicyError, match="Station 'south' is not certified by the CA"):
        plan(north, B)
    north.identity.put_certificate(fingerprint(other.point), TO_SOUTH, b"s" * 64)
    found = plan(north, ca=fingerprint(other.point))
    assert ([node.uuid for node in found.nodes], found.ca) == ([B], other.point)
    assert found.signatures == {TO_SOUTH: b"s" * 64}


def test_other_stations_that_hold_these_keys_are_named(north: Station) -> None:
    third = "0a" * 32
    north.keys.put_holder(
        Holder(A, TO_SOUTH, AT), Holder(A, TO_WEST, AT), Holder(A, third, AT), Holder(B, "0b" * 32, AT)
    )
    assert plan(north, A).also_held_by == tuple(sorted((TO_WEST, third)))
    assert plan(north, A, to=("west", "south")).also_held_by == (third,)
    north.keys.rotated(A)
    assert plan(north, A).also_held_by == ()


def test_the_same_order_again_carries_an_open_handover_on(north: Station) -> None:
    first = plan(north, A, B)
    notes = BundleNotes((A.hex(), B.hex()), first.content, "04", "2026-03-08T08:00:00Z")
    row = Handover(first.id, "out", "copy", (TO_SOUTH,), "open", notes.to_json(), created=AT)
    north.handovers.put(row)
    again = plan(north, B, A)
    assert (again.earlier, again.id, again.content) == (row, first.id, first.content)
    for other in (plan(north, A), plan(north, A, B, mode="move"), plan(north, A, B, to=("west",))):
        assert (other.earlier, other.content == first.content) == (None, False)
    late = NOW + timedelta(days=7)
    assert plan_export(north, ExportOrder(("south",), (A, B)), now=late).earlier is None, "a copy that expired"
    north.handovers.put(replace(row, state="closed"))
    assert plan(north, A, B).earlier is None
