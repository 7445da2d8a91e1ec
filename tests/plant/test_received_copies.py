"""Which copies of keys come in without a question, and what waits for a person (contract/plant.md section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.handover.incoming import ImportPlan
from teds_provision.plant.parcels import _is_over, _Reader
from teds_provision.plant.transport import Parcel
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.plant.merged_claims import MergedClaims
from teds_provision.protocol.plant.roster import Share
from teds_provision.station.plant.parcels import ParcelKind, ParcelRow, ParcelState
from tests.plant.owner import alone
from tests.plant.test_sharing import ALL, AT, EAST, KEY, NOW, OTHER, SOUTH, TO_SOUTH, WEST, roster, view

NODE = SoftwareKey(77)
PIN = fingerprint(NODE.point)
A, B = (bytes([number] * 10) for number in (1, 2))
ENDS = NOW + timedelta(days=90)
SECOND = timedelta(seconds=1)


def node(uuid: bytes = A, key_id: str = "a1") -> Any:
    return SimpleNamespace(node=SimpleNamespace(uuid=uuid, kid=key_id, epoch=3, node_key=NODE.point))


def held(key_id: str, *holders: str, state: str = "pending", source: str = "import", uuid: bytes = A) -> Any:
    """Return a key of a node here, and which stations hold the node's key by this store."""
    return SimpleNamespace(uuid=uuid, key_id=key_id, state=state, source=source), holders


def seen(**more: Any) -> MergedClaims:
    return view(**{"pin": PIN, "pins": {WEST: PIN}, **more})


def why_not(
    *, sender: str = WEST, mode: str = "copy", ca: bytes = b"CA", at: Any = NOW, nodes: Sequence[Any] = (),
    keys: Sequence[Any] = (), views: dict[bytes, MergedClaims] | None = None, pins: dict[bytes, str] | None = None,
    shares: tuple[Share, ...] = (TO_SOUTH,),
) -> str:  # fmt: skip
    """Return why south does not take in a bundle of west's without a question."""
    there = views or {}
    held_keys = [key for key, _ in keys]
    holders = {key.uuid: [SimpleNamespace(fingerprint=who) for who in names] for key, names in keys}
    station = SimpleNamespace(
        fingerprint=SOUTH,
        ca=b"CA",
        pins=SimpleNamespace(
            get_many=lambda _: {uuid: SimpleNamespace(fingerprint=pin) for uuid, pin in (pins or {}).items()}
        ),
        keys=SimpleNamespace(get_many=lambda _: held_keys, holders=lambda uuid: holders.get(uuid, [])),
    )
    reader: Any = _Reader.__new__(_Reader)
    reader.station, reader.roster, reader.now, reader.quiet = station, roster(*shares), at, set()
    reader.views = lambda uuids: {uuid: there.get(uuid, seen()) for uuid in uuids}
    bundle = SimpleNamespace(sender=sender, mode=mode, ca=ca)
    plan = SimpleNamespace(opened=SimpleNamespace(bundle=bundle), taken=list(nodes) or [node()])
    return cast("str", reader._why_not(cast("ImportPlan", plan)))


NEVER = f"{A.hex()}: a key of it from this sender was never proven"
LATER = "the sender's pages are not here yet"


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ({}, ""),
        ({"mode": "move"}, "a move needs confirmation"),
        ({"mode": "move", "sender": AT["gone"]}, "a move needs confirmation"),
        ({"at": ENDS - SECOND}, ""),
        ({"at": ENDS}, "the roster has expired"),
        ({"sender": AT["gone"]}, "its sender is not a member"),
        ({"sender": AT["stranger"]}, "its sender is not a member"),
        ({"ca": b"other"}, "its nodes belong to another CA"),
        ({"shares": ()}, f"{A.hex()}: no share of the roster sends it here"),
        ({"pins": {A: "cd" * 32}},
         f"{A.hex()}: it comes with another node key than the one that it is pinned to"),
        ({"pins": {A: PIN}}, ""),
        ({"keys": [held("b2", WEST)]}, NEVER),
        ({"keys": [held("a1", WEST)]}, ""),  # this very key
        ({"keys": [held("b2", EAST)]}, ""),  # of another sender
        ({"keys": [held("b2", EAST, WEST)]}, NEVER),
        ({"keys": [held("b2", WEST, state="active")]}, ""),
        ({"keys": [held("b2", WEST, source="agreement")]}, ""),
        ({"keys": [held("b2", WEST, uuid=B)]}, ""),  # of another node
        ({"views": {A: seen(held={WEST: OTHER})}}, LATER),
        ({"nodes": [node(A), node(B)], "views": {A: seen(held={WEST: OTHER})}}, LATER),
        ({"nodes": [node(A), node(B)], "views": {B: seen(held={WEST: OTHER})}}, LATER),
        ({"nodes": [node(A), node(B)], "views": {A: seen(held={WEST: OTHER}), B: seen(conflicts={"x": "y"})}},
         f"{B.hex()}: x: y"),  # one that needs a person makes all wait for one
        ({"nodes": [node(A), node(B)], "views": {A: seen(conflicts={"x": "y"})}}, f"{A.hex()}: x: y"),
    ],
)  # fmt: skip
def test_a_bundle_is_accepted_without_a_question_only_if_nothing_speaks_against_it(
    how: dict[str, Any], why: str
) -> None:
    assert why_not(**how) == why


def test_this_station_itself_is_named_by_the_share() -> None:
    assert why_not(shares=(Share(ALL, (EAST,)),)) == f"{A.hex()}: no share of the roster sends it here"
    assert KEY == (3, "a1"), "the key that west made"


@pytest.mark.parametrize(
    ("kind", "created", "expires", "over"),
    [
        ("bundle", 0, 1, False),
        ("bundle", 0, 0, True),
        ("bundle", 0, -1, True),
        ("receipt", 0, 0, True),
        ("receipt", 10_000_000, 1, False),  # its date counts for nothing
        ("bundle", 10_000_000, 20_000_000, True),  # a clock dated it ahead
    ],
)
def test_what_was_not_receipted_is_over_when_it_expires(kind: Any, created: int, expires: int, over: bool) -> None:
    made, ends = (f"{NOW + timedelta(seconds=at):%Y-%m-%dT%H:%M:%SZ}" for at in (created, expires))
    row = ParcelRow("id", "out", "peer", kind, "sent", ends, "about", "", made)
    assert _is_over(row, NOW) is over


def test_a_receipt_ends_the_parcel_of_its_bundle_to_its_sender_and_says_what_was_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    station = alone(tmp_path / "alone")
    parcels = station.plant.parcels
    kinds: list[tuple[str, str, ParcelKind, ParcelState, str]] = [
        ("ours", SOUTH, "bundle", "sent", "bundle 1"), ("others", EAST, "bundle", "sent", "bundle 1"),
        ("another", SOUTH, "bundle", "sent", "bundle 2"), ("ready", SOUTH, "bundle", "ready", "bundle 1"),
        ("receipt", SOUTH, "receipt", "ready", "bundle 1"),
    ]  # fmt: skip
    rows = [
        ParcelRow(id, "out", peer, kind, state, "2026-03-08T12:00:00Z", about) for id, peer, kind, state, about in kinds
    ]
    with station.transaction():
        for row in rows:
            parcels.put(row, b"sealed")
        for row in rows[:4]:
            parcels.put_shared([(A, 3), (B, 3)] if row.id == "ours" else [(row.id.encode().ljust(10), 3)], row.peer,
                               row.id, "sent")  # fmt: skip
    receipt = SimpleNamespace(id="bundle 1", sender=SOUTH, refused=[SimpleNamespace(uuid=A)])
    monkeypatch.setattr("teds_provision.plant.parcels.pending.close", lambda *_: SimpleNamespace(receipt=receipt))
    reader: Any = _Reader.__new__(_Reader)
    reader.station = station
    assert reader._receipt(Parcel("parcel", "me", b"receipt", "", SOUTH))
    assert {row.id for row in parcels.all("out", "ready", "sent")} == {"others", "another", "receipt"}
    assert parcels.shared_in("ours") == [(A, 3, "refused"), (B, 3, "taken")]
    assert [state for _, _, state in parcels.shared_in("ready")] == ["taken"]
    assert [state for id in ("others", "another") for _, _, state in parcels.shared_in(id)] == ["sent", "sent"]
    station.close()
