"""Which copies of keys come in without a question, and what waits for a person (contract/plant.md section 4)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import NotFoundError, PolicyError, StoreError
from teds_provision.handover.incoming import ImportPlan
from teds_provision.handover.pending import BundleNotes
from teds_provision.plant.parcels import (
    _BY_SHARE,
    _delete,
    _due,
    _expire,
    _forget,
    _is_over,
    _note_refused,
    _put_out,
    _Reader,
    _why_held_back,
    import_parcel,
    waiting_out,
)
from teds_provision.plant.transport import Parcel
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.plant.claim import Claim
from teds_provision.protocol.plant.merged_claims import MergedClaims
from teds_provision.protocol.plant.roster import Share
from teds_provision.station.plant.parcels import ParcelKind, ParcelRow, ParcelState
from teds_provision.station.station import Station
from teds_provision.station.store.records import Handover
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


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = alone(tmp_path / "alone")
    yield made
    made.close()


def test_of_what_expired_without_a_receipt_an_open_move_goes_again_and_a_copy_is_made_anew(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    parcels, again = station.plant.parcels, list[tuple[str, tuple[bytes, ...], str]]()

    def planned(_station: Station, order: Any, _now: Any) -> str:
        again.append((order.to[0], order.nodes, order.mode))
        return "plan"

    monkeypatch.setattr("teds_provision.plant.parcels.outgoing.plan_export", planned)
    monkeypatch.setattr("teds_provision.plant.parcels.send_export", lambda *_: "")
    cases: list[tuple[str, Any, str, str]] = [
        ("open move", "move", "open", "2026-03-01T12:00:00Z"),
        ("young move", "move", "open", "2026-03-01T12:00:01Z"),
        ("closed move", "move", "closed", "2026-03-01T12:00:00Z"),
        ("undone move", "move", "undone", "2026-03-01T12:00:00Z"),
        ("copy", "copy", "open", "2026-03-01T12:00:00Z"),
        ("closed copy", "copy", "closed", "2026-03-01T12:00:00Z"),
        ("twice", "copy", "open", "2026-03-01T12:00:00Z"),
        ("thrice", "copy", "open", "2026-03-01T12:00:00Z"),
    ]
    with station.transaction():
        for name, mode, state, expires in cases:
            notes = BundleNotes((A.hex(),), "content", "ca", expires).to_json()
            station.handovers.put(Handover(name, "out", mode, (SOUTH,), state, notes))
            parcels.put(ParcelRow(name, "out", SOUTH, "bundle", "sent", expires, name, "", "2026-02-22T12:00:00Z"), b"")
            parcels.put_shared([(A, len(name))], SOUTH, name, "sent")
        again_at = "2026-03-08T12:00:00Z"
        parcels.put(ParcelRow("2", "out", SOUTH, "bundle", "ready", again_at, "twice", "", "2026-03-01T12:00:00Z"), b"")
        parcels.put(ParcelRow("3", "out", SOUTH, "bundle", "sent", again_at, "thrice", "", "2026-03-01T12:00:00Z"), b"")
    _expire(station, NOW)
    assert again == [(SOUTH, (A,), "move")]
    assert [row.id for row in parcels.all("out", "ready", "sent")] == ["young move", "2", "3"]
    assert {row.id: row.state for row in station.handovers.all()} == {
        "open move": "open", "young move": "open", "closed move": "closed", "undone move": "undone", "copy": "dropped",
        "closed copy": "closed", "twice": "open", "thrice": "open",
    }, "handover list shows as open what may still be receipted"  # fmt: skip
    assert [name for name, *_ in cases if parcels.shared_in(name)] == ["young move"], "to be shared once more"


@pytest.mark.parametrize("error", [PolicyError("It was revoked since."), NotFoundError("It was forgotten since.")])
def test_a_move_of_which_nothing_may_go_any_more_waits_for_a_person(
    station: Station, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def planned(*_: object) -> Any:
        raise error

    monkeypatch.setattr("teds_provision.plant.parcels.outgoing.plan_export", planned)
    parcels, at = station.plant.parcels, "2026-03-01T12:00:00Z"
    with station.transaction():
        for name in ("one", "two"):
            notes = BundleNotes((A.hex(),), "content", "ca", at).to_json()
            station.handovers.put(Handover(name, "out", "move", (SOUTH,), "open", notes))
            parcels.put(ParcelRow(name, "out", SOUTH, "bundle", "sent", at, name, "", "2026-02-22T12:00:00Z"), b"")
    _expire(station, NOW)
    assert parcels.all("out", "ready", "sent") == []
    assert [row.state for row in station.handovers.all()] == ["open", "open"], "`handover undo` reports it"


def test_a_receiver_refuses_on_its_own_page_what_came_from_here(station: Station) -> None:
    parcels = station.plant.parcels
    bundles = [f"11111111-2222-4333-8444-{number:012}" for number in range(4)]
    me = station.fingerprint
    said = {SOUTH: {(bundles[0], me, "revoked"), (bundles[1], EAST, "revoked")}, EAST: {(bundles[2], me, "revoked")}}
    with station.transaction():
        for bundle in bundles:
            row = ParcelRow(bundle, "out", SOUTH, "bundle", "sent", "2026-03-08T12:00:00Z", bundle)
            parcels.put(row, b"")
            parcels.put_shared([(A, int(bundle[-1]))], SOUTH, bundle, "sent")
            left = BundleNotes((A.hex(),), "content", "ca", "2026-03-08T12:00:00Z").to_json()
            station.handovers.put(Handover(bundle, "out", "copy", (SOUTH,), "open", left))
        for digits, refused in said.items():
            chain = station.plant.pages.chain(digits)
            station.plant.claims.put(chain.id, {A: Claim(refused=refused).to_json()})
        for name, kind in (("empty", "bundle"), ("receipt", "receipt")):
            row = ParcelRow(name, "out", SOUTH, cast("Any", kind), "sent", "2026-03-08T12:00:00Z", name, "", "9999")
            parcels.put(row, b"")
    _note_refused(station)
    assert [row.id for row in parcels.all("out", "sent")] == [*bundles[1:], "empty", "receipt"]
    assert [parcels.shared_in(bundle)[0][2] for bundle in bundles] == ["refused", "sent", "sent", "sent"]
    states = {row.id: row.state for row in station.handovers.all()}
    assert [states[bundle] for bundle in bundles] == ["dropped", "open", "open", "open"]


def test_a_bundle_that_was_imported_leaves_with_its_receipt_for_its_sender_or_stays(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    parcels = station.plant.parcels
    row = ParcelRow("came", "in", WEST, "bundle", "waiting", "2099-01-01T00:00:00Z")
    parcels.put(row, b"bundle")
    done = SimpleNamespace(row=SimpleNamespace(id="a bundle", peers=(WEST,)), receipt=b"\nreceipt\n")
    plan = cast("Any", SimpleNamespace())
    imported = list[object]()
    monkeypatch.setattr(
        "teds_provision.plant.parcels.incoming.import_bundle", lambda *given: imported.append(given) or done
    )

    def full(*_: object, **__: object) -> str:
        raise StoreError("The disk is full.")

    with monkeypatch.context() as patch:
        patch.setattr("teds_provision.plant.parcels._put_out", full)
        with pytest.raises(StoreError, match="The disk is full"):
            import_parcel(station, row, plan)
    assert parcels.get("came", "in") is not None, "all in one transaction"
    assert import_parcel(station, row, plan) is cast("Any", done)
    assert imported == [(station, plan)] * 2
    assert parcels.get("came", "in") is None
    [out] = parcels.all("out", "ready")
    assert (out.kind, out.peer, out.about, parcels.document(out.id, "out")) == ("receipt", WEST, "a bundle", b"receipt")


@pytest.mark.parametrize(
    ("peer", "mode", "by_share", "after", "shares", "why"),
    [
        (SOUTH, "copy", True, -SECOND, True, ""),
        (SOUTH, "copy", False, -SECOND, False, ""),
        (SOUTH, "copy", True, -SECOND, False, "keys for south, as no share of the roster sends them there any more"),
        (SOUTH, "copy", True, timedelta(0), True,
         "keys for south, as the roster expired on 2026-03-31; ask its owner: registry renew"),
        (SOUTH, "move", False, timedelta(0), False, ""),
        (SOUTH, "none", False, timedelta(0), False, ""),
        ("gone", "move", False, -SECOND, True,
         "gone is no member any more; to take back a move to it: handover undo ID"),
    ],
)  # fmt: skip
def test_a_copy_leaves_under_a_roster_that_holds_and_shares_it_and_a_move_by_its_operator(
    monkeypatch: pytest.MonkeyPatch, peer: str, mode: Any, by_share: bool, after: timedelta,
    shares: bool, why: str,
) -> None:  # fmt: skip
    monkeypatch.setattr("teds_provision.plant.parcels.outgoing.why_outdated", lambda *_: None)
    monkeypatch.setattr(
        "teds_provision.plant.parcels.sharing.receivers", lambda _roster, _me, share: {SOUTH} if share else set()
    )
    ends = datetime(2026, 3, 31, tzinfo=UTC)
    now = SimpleNamespace(
        name_of={SOUTH: "south", "gone": "gone"}.__getitem__, member=lambda who: who if who == SOUTH else None,
        expires=ends, share=[False, shares],
    )  # fmt: skip
    handover = None if mode == "none" else SimpleNamespace(mode=mode, id="h")
    kept = {("about", "out"): handover}
    station: Any = SimpleNamespace(fingerprint=WEST, handovers=SimpleNamespace(get=lambda *of: kept[of]))
    row = ParcelRow("p", "out", peer, "bundle", "ready", "", "about", _BY_SHARE if by_share else "")
    assert _why_held_back(station, cast("Any", now), row, ends + after) == why


def test_a_receipt_waits_seven_days_and_a_bundle_until_it_expires(station: Station) -> None:
    parcels = station.plant.parcels
    with station.transaction():
        receipt = _put_out(station, "receipt", SOUTH, b"receipt", "bundle")
        bundle = _put_out(station, "bundle", SOUTH, b"bundle", "bundle", expires=NOW)
    rows = {row.id: row for row in parcels.all("out", "ready")}
    assert rows[bundle].expires == "2026-03-01T12:00:00Z"
    left = datetime.fromisoformat(rows[receipt].expires) - datetime.now(UTC)
    assert timedelta(days=6, hours=23) < left <= timedelta(days=7)
    assert waiting_out(station) == 1, "a receipt is owed to nobody"


# -- what is copied, and what is deleted then --------------------------------------------------------------------------

C, D, E = (bytes([number] * 10) for number in (3, 4, 5))
IMU = Share(("profile", "imu"), (SOUTH,))


def due(
    views: dict[bytes, MergedClaims], *shares: Share, own: Sequence[bytes] = (), imported: Sequence[bytes] = (),
    quiet: set[str] | None = None, removed: bool = True,
) -> tuple[list[bytes], list[bytes]]:  # fmt: skip
    """Return the nodes of which south gets a copy from west, and apart those that stations disagree about."""

    def unshared(receiver: str, **more: bool) -> list[tuple[bytes, int, str]]:
        assert receiver == SOUTH
        return [(uuid, *KEY) for uuid in (imported if more.get("imported") else own)]

    parcels = SimpleNamespace(unshared=unshared)
    station: Any = SimpleNamespace(fingerprint=WEST, plant=SimpleNamespace(parcels=parcels))
    held_roster = roster(*shares)
    if not removed:
        held_roster = replace(held_roster, removed=())
    return _due(station, held_roster, lambda uuids: {uuid: views[uuid] for uuid in uuids}, SOUTH, quiet or set())


def test_a_receiver_gets_what_a_share_covers_disputed_nodes_apart_and_none_that_it_gave_away() -> None:
    away = frozenset({(SOUTH, 3, "a1", WEST, "move", "id")})
    views = {
        A: seen(),
        B: seen(conflicts={"two keys": "x"}),
        C: seen(gave=away),
        D: seen(written={WEST: (1, "e5" * 32, "imu")}),
        E: seen(written={SOUTH: (1, "e5" * 32, "imu")}),
    }
    assert due(views, TO_SOUTH, own=[A, B, C, D, E]) == ([A, D, E], [B])
    assert due(views, IMU, own=[A, B, C, D, E]) == ([D], []), "what this station itself wrote"
    assert due(views, IMU, TO_SOUTH, own=[A, D]) == ([A, D], [])
    assert due(views, Share(ALL, (EAST,)), own=[A]) == ([], []), "it is for another station"


def test_a_key_that_others_made_is_copied_only_if_its_maker_is_removed_or_silent_and_it_is_this_ones_turn() -> None:
    views = {
        A: seen(held={WEST: KEY, AT["north"]: KEY}, made=frozenset({AT["north"]})),
        B: seen(held={WEST: KEY}, made=frozenset(), left={AT["gone"]: KEY}),
        C: seen(held={WEST: KEY}, made=frozenset()),  # who made it is unknown
    }
    assert due(views, TO_SOUTH, imported=[A, B, C]) == ([B], [])
    assert due(views, TO_SOUTH, imported=[A, B, C], removed=False) == ([], []), "nobody left: it is not even asked"
    assert due(views, TO_SOUTH, imported=[A, C], quiet={AT["north"]}, removed=False) == ([A], [])


def test_keys_are_deleted_that_all_receivers_of_a_forgetting_share_have(monkeypatch: pytest.MonkeyPatch) -> None:
    deleted: list[tuple[bytes, int]] = []
    monkeypatch.setattr("teds_provision.plant.parcels._delete", lambda _, uuid, epoch: deleted.append((uuid, epoch)))
    receipted = [(A, 3, {SOUTH, AT["north"]}), (B, 3, {SOUTH}), (C, 2, {SOUTH, AT["north"], EAST})]
    parcels = SimpleNamespace(receipted=lambda: receipted)
    station: Any = SimpleNamespace(fingerprint=WEST, plant=SimpleNamespace(parcels=parcels))
    both = (SOUTH, AT["north"])
    for shares, gone in (
        ((Share(ALL, both, forget=True),), [(A, 3), (C, 2)]),
        ((Share(ALL, both),), []),
        ((Share(ALL, both, forget=True), Share(("profile", "imu"), (WEST,))), [(A, 3), (C, 2)]),
        ((Share(ALL, both, forget=True), Share(ALL, (WEST,))), []),
        ((Share(("profile", "imu"), both, forget=True),), []),
    ):
        deleted.clear()
        _forget(station, roster(*shares), lambda uuids: {uuid: seen() for uuid in uuids})
        assert deleted == gone, shares


def test_what_is_deleted_is_every_key_up_to_its_epoch_and_that_is_told(station: Station) -> None:
    for epoch in (2, 3, 4):
        station.keys.add_pending(A, key=bytes(16), key_id=bytes([epoch]) * 8, epoch=epoch)
    station.keys.add_pending(B, key=bytes(16), key_id=bytes([9]) * 8, epoch=2)
    _delete(station, A, 3)
    assert [key.epoch for key in station.keys.keys_of(A)] == [4]
    assert [key.epoch for key in station.keys.keys_of(B)] == [2]
    [(_, _, text)] = station.plant.outbox(9)
    assert '"act":"forgot"' in text
    assert f'"uuid":"{A.hex()}","epoch":3' in text
