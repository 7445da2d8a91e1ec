"""What leaves in a bundle, how often, and what is not handed over."""

from __future__ import annotations

import hashlib
import json
import stat
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.cli.station.handover import import_text
from teds_provision.errors import NotFoundError, PolicyError, UsageError
from teds_provision.handover import outgoing
from teds_provision.handover.incoming import ImportPlan, import_bundle, plan_import
from teds_provision.handover.outgoing import (
    ExportOrder,
    _announced,
    _of_the_last_run,
    export_all,
    export_bundle,
    outputs_of,
    plan_export,
    plan_exports,
    record_export,
    seal_export,
)
from teds_provision.handover.pending import BundleNotes, close, find_handover, undo
from teds_provision.protocol.handover.bundle import BundledNode, open_bundle
from teds_provision.provisioning.agree import agree
from teds_provision.provisioning.identify import identify
from teds_provision.station.plant.plant import PlantRecord
from tests.bench import Board, make_station, talk
from tests.handover.desk import Pair, everything, key_up, provisioned, session, trust


@pytest.mark.parametrize("mode", ["copy", "move"])
@pytest.mark.parametrize("named", [True, False])
def test_the_same_export_again_is_the_same_handover(pair: Pair, mode: str, named: bool) -> None:
    nodes = (pair.board.uuid,) if named else None
    path, first = pair.export(mode, nodes=nodes)  # type: ignore[arg-type]
    _, finished = pair.export(mode, nodes=nodes, output=path)  # type: ignore[arg-type]
    assert (finished.fresh, finished.plan.id, finished.sha256) == (False, first.plan.id, first.sha256)
    other, again = pair.export(mode, nodes=nodes)  # type: ignore[arg-type]
    assert (again.fresh, again.plan.id) == (True, first.plan.id)
    taken = pair.take(path)
    assert pair.take(other).receipt == taken.receipt
    assert close(pair.north, taken.receipt).fresh


def test_a_move_that_is_carried_on_after_its_end_gets_a_new_one_and_a_copy_is_another_handover(pair: Pair) -> None:
    now = datetime.now(UTC)
    for mode in ("copy", "move"):
        first = pair.export(mode)[1].plan  # type: ignore[arg-type]
        order = ExportOrder(("south",), (pair.board.uuid,), mode)  # type: ignore[arg-type]
        assert plan_export(pair.north, order, now=first.expires - timedelta(seconds=1)).expires == first.expires
        later = plan_export(pair.north, order, now=first.expires)
        assert (later.id == first.id) is (mode == "move")
        assert later.expires > now + timedelta(days=13)


@pytest.mark.parametrize(("days", "why"), [(8, "expired at 20"), (-3, "is dated 20.*in the future")])
def test_a_file_that_no_receiver_takes_is_not_called_done(pair: Pair, days: int, why: str) -> None:
    """Who had to export again, as the receiver's hint asked, was told that there is nothing to do."""
    path, first = pair.export("move")
    order, now = ExportOrder(("south",), (pair.board.uuid,), "move"), datetime.now(UTC) + timedelta(days=days)
    plan = plan_export(pair.north, order, now=now)
    assert (plan.id, plan.expires) == (first.plan.id, now.replace(microsecond=0) + timedelta(days=7))
    with pytest.raises(UsageError, match=why):
        export_bundle(pair.north, plan, path, now)
    anew = pair.folder / "anew.jwe"
    assert export_bundle(pair.north, plan, anew, now).fresh
    plan = plan_export(pair.north, order, now=now)
    assert not export_bundle(pair.north, plan, anew, now).fresh
    with pytest.raises(UsageError, match="sealed again since"):
        export_bundle(pair.north, plan, path, now)
    taken = plan_import(pair.south, anew.read_bytes(), now)
    assert isinstance(taken, ImportPlan)
    assert close(pair.north, import_bundle(pair.south, taken).receipt).fresh


def test_a_bundle_file_is_private_and_never_overwritten(pair: Pair) -> None:
    path, _ = pair.export("copy")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    occupied = pair.folder / "occupied"
    occupied.write_text("a letter")
    with pytest.raises(UsageError, match="already exists"):
        pair.export("move", output=occupied)
    assert occupied.read_text() == "a letter"
    assert pair.north.policy.tombstones() == []


def test_no_key_in_the_clear_anywhere(pair: Pair) -> None:
    path, exported = pair.export("copy")
    taken = pair.take(path)
    key = pair.board.state.key
    assert key is not None
    import base64

    spellings = {key, key.hex().encode(), base64.b64encode(key)[:21], base64.urlsafe_b64encode(key)[:21]}
    files = [file for file in pair.folder.rglob("*") if file.is_file()]
    assert len(files) >= 5
    for file in files:
        assert not any(spelling in file.read_bytes() for spelling in spellings), file
    shown = repr((exported, taken, plan_import(pair.south, path.read_bytes()))).encode()
    assert not any(spelling in shown for spelling in spellings)


def test_only_a_proven_key_is_handed_over(pair: Pair) -> None:
    other = Board(uuid=bytes.fromhex("8d4d9da65281f700ffff"))
    pair.take(pair.export("copy")[0])
    trust(pair.south, pair.north)
    with pytest.raises(PolicyError, match="never proven"):
        plan_export(pair.south, ExportOrder(("north",), (pair.board.uuid,)))
    with pytest.raises(PolicyError, match="holds no key for it"):
        plan_export(pair.north, ExportOrder(("south",), (other.uuid,)))
    with pytest.raises(NotFoundError):
        plan_export(pair.south, ExportOrder(("north",), None))


def test_a_key_that_is_due_for_rotation_is_not_handed_over(pair: Pair) -> None:
    _, exported = pair.export("move")
    undo(pair.north, find_handover(pair.north, exported.plan.id))
    with pytest.raises(PolicyError, match="must be rotated first"):
        plan_export(pair.north, ExportOrder(("south",), (pair.board.uuid,)))


def test_a_key_that_waits_for_its_proof_holds_back_a_move_and_no_copy(pair: Pair) -> None:
    pair.north.keys.add_pending(pair.board.uuid, key=bytes(16), key_id=b"no proof", epoch=2)
    for named in ((pair.board.uuid,), None):
        (node,) = plan_export(pair.north, ExportOrder(("south",), named, "copy")).nodes
        assert node.epoch == 1
    with pytest.raises(PolicyError, match="not settled"):
        plan_export(pair.north, ExportOrder(("south",), (pair.board.uuid,), "move"))


def test_the_plant_hears_once_of_what_is_sealed_again(pair: Pair) -> None:
    pair.north.plant.put_record(PlantRecord("11111111-2222-4333-8444-555555555555"))
    for _ in range(2):
        pair.export("copy")
    events = [json.loads(text) for _, _, text in pair.north.plant.outbox(9)]
    assert [event["act"] for event in events] == ["gave"]


def test_what_an_export_leaves_in_the_store_and_the_same_again(pair: Pair) -> None:
    pair.export("move")
    assert pair.north.identity.certificate(pair.north.ca, pair.south.point) is not None
    [tombstone] = pair.north.policy.tombstones()
    early = replace(tombstone, created="2026-01-31T12:00:00Z")
    pair.north.policy.put_tombstone(early)
    pair.export("move")
    assert pair.north.policy.tombstones() == [early], "it rests since the first of them"
    assert [entry.outcome for entry in pair.north.audit_log.entries() if entry.act == "export"] == ["done", "again"]


def test_a_key_that_was_replaced_between_plan_and_sealing_does_not_leave(pair: Pair) -> None:
    plan = plan_export(pair.north, ExportOrder(("south",), None))
    with talk(pair.board) as node:
        agree(pair.north, node, identify(pair.north, node), rotate=True)
    with pytest.raises(PolicyError, match=f"Node {pair.board.uuid.hex()} was changed in the meantime"):
        export_bundle(pair.north, plan, pair.folder / "late.jwe")
    assert pair.north.handovers.all() == []


def test_of_two_bundles_neither_is_made_beside_a_file_that_is_in_the_way(tmp_path: Path) -> None:
    pair = Pair.make(tmp_path, 2)
    plans = plan_exports(pair.north, ExportOrder(("south",), None, "move"), most=1)
    first, second = outputs_of(tmp_path / "out.jwe", 2)
    second.write_text("a letter")
    before = everything(pair.north)
    with pytest.raises(UsageError, match="already exists"):
        export_all(pair.north, plans, (first, second))
    assert (first.exists(), everything(pair.north)) == (False, before)
    second.unlink()
    made = export_all(pair.north, plans, (first, second))
    notes = [BundleNotes.from_json(row.nodes) for row in pair.north.handovers.all()]
    assert [note.run for note in notes] == [made[0].plan.id] * 2
    pair.close()


def test_bundles_of_a_command_that_was_cut_stay_together(tmp_path: Path) -> None:
    pair = Pair.make(tmp_path, 2)
    order = ExportOrder(("south",), tuple(board.uuid for board in pair.boards), "move")
    first, _ = plan_exports(pair.north, order, most=1)
    with pair.north.transaction():
        _announced(pair.north, first, "the first command")
    plans = plan_exports(pair.north, order, most=1)
    assert [plan.earlier is not None for plan in plans] == [True, False]
    export_all(pair.north, plans, outputs_of(tmp_path / "out.jwe", 2))
    notes = [BundleNotes.from_json(row.nodes) for row in pair.north.handovers.all()]
    assert [note.run for note in notes] == ["the first command"] * 2
    pair.close()


def test_a_bundle_that_is_sealed_for_a_parcel_is_recorded_as_its_file_would_be(pair: Pair) -> None:
    now = datetime(2026, 3, 1, 8, 0, 0, 999_999, tzinfo=UTC)
    plan = plan_export(pair.north, ExportOrder(("south",), (pair.board.uuid,), "copy"), now=now)
    sealed = seal_export(pair.north, plan, now)
    assert sealed.sha256 == hashlib.sha256(sealed.octets).hexdigest()
    with pair.north.transaction():
        record_export(pair.north, sealed)
    (row,) = pair.north.handovers.all()
    notes = BundleNotes.from_json(row.nodes)
    assert (notes.files, notes.created) == ((sealed.sha256, sealed.signed_sha256), "2026-03-01T08:00:00Z")
    assert sealed.signed_sha256 != sealed.sha256
    assert isinstance(plan_import(pair.south, sealed.octets, now), ImportPlan)


def test_a_moved_node_is_not_handed_to_someone_else(pair: Pair, tmp_path: Path) -> None:
    pair.export("move")
    west = make_station(tmp_path / "west", "west")
    trust(pair.north, west)
    for mode in ("copy", "move"):
        with pytest.raises(PolicyError, match="was moved to station"):
            plan_export(pair.north, ExportOrder(("west",), (pair.board.uuid,), mode))  # type: ignore[arg-type]
    west.close()


def test_without_the_ca_key_the_receiver_must_be_certified_already(pair: Pair) -> None:
    signature = pair.north.identity.certify(pair.south.point)
    pair.north.vault.drop_ca()  # type: ignore[attr-defined]
    with pytest.raises(PolicyError, match="not certified by the CA"):
        pair.export("copy")
    pair.north.identity.keep_certificate(pair.north.ca, pair.south.point, signature)
    pair.take(pair.export("copy")[0])
    assert provisioned(pair.south, pair.board).verified.verdict == "authentic"


def test_nodes_of_two_cas_go_in_two_bundles(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    session(pair.south, pair.board)
    own = Board(uuid=bytes.fromhex("8d4d9da65281f700ffff"))
    key_up(pair.south, own)
    with pytest.raises(PolicyError, match="2 different CA keys"):
        plan_export(pair.south, ExportOrder(("north",), None))
    from teds_provision.protocol.keys import fingerprint

    plan = plan_export(pair.south, ExportOrder(("north",), None, ca=fingerprint(pair.north.ca)[:16]))
    assert [node.uuid for node in plan.nodes] == [pair.board.uuid]


def test_a_plan_changes_nothing(pair: Pair) -> None:
    before = everything(pair.north)
    plan_export(pair.north, ExportOrder(("south",), None, "move"))
    assert everything(pair.north) == before
    path, _ = pair.export("copy")
    before = everything(pair.south)
    assert isinstance(plan_import(pair.south, path.read_bytes()), ImportPlan)
    assert everything(pair.south) == before


def test_the_bundle_says_what_the_profile_lists(pair: Pair) -> None:
    provisioned(pair.north, pair.board)
    before = datetime.now(UTC).replace(microsecond=0)
    path, _exported = pair.export("copy")
    keys = {pair.north.fingerprint: pair.north.point}
    opened = open_bundle(path.read_bytes(), pair.south.vault.identity(), keys.get, datetime.now(UTC))
    (node,) = opened.bundle.nodes
    record = pair.north.nodes.get(pair.board.uuid)
    assert record is not None
    assert (node.uuid, node.node_key, node.key) == (pair.board.uuid, pair.board.key.point, pair.board.state.key)
    assert (node.epoch, node.sequence, node.teds_sha256) == (1, 1, record.teds_sha256)
    begun = opened.bundle.expires - timedelta(days=7)  # of the plan; it is sealed, and so created, a moment later
    assert before <= begun <= opened.bundle.created <= datetime.now(UTC)
    assert opened.station_signature is not None
    assert json.loads(path.read_bytes())["recipients"][0]["header"]["kid"] == pair.south.fingerprint


def test_all_again_means_the_newest_open_move_with_all_that_its_command_made() -> None:
    def notes(name: str, run: str = "") -> BundleNotes:
        return BundleNotes((name,), name, "", "", run=run)

    assert _of_the_last_run([]) == []
    assert _of_the_last_run([notes("old"), notes("new")]) == [notes("new")]
    old, new = notes("old", "run 1"), [notes(name, "run 2") for name in ("one", "two")]
    assert _of_the_last_run([old, *new]) == new


def test_every_note_about_every_accepted_node_is_in_the_plan_of_an_import(pair: Pair) -> None:
    provisioned(pair.north, pair.board)
    path, _exported = pair.export("copy")
    plan = plan_import(pair.south, path.read_bytes())
    assert isinstance(plan, ImportPlan)
    (node,) = plan.nodes
    noted = replace(plan, nodes=(replace(node, notes=("Its name is taken.", "Its group is measured.")),) * 2)
    uuid = pair.board.uuid.hex()
    lines = import_text(pair.south, noted).splitlines()
    assert [line for line in lines if line.startswith(f"  {uuid}: ")] == [
        f"  {uuid}: Its name is taken.", f"  {uuid}: Its group is measured.",
    ] * 2  # fmt: skip


def test_a_node_whose_row_point_or_key_is_gone_does_not_leave() -> None:
    one, two = bytes(9) + b"\1", bytes(9) + b"\2"
    whole = SimpleNamespace(point=b"point", sequence=9, profile="p", name="n", groups=("hand",), teds_sha256="ab" * 32)
    records: dict[bytes, Any] = {one: whole, two: whole}
    keys: dict[bytes, Any] = {one: (3, b"k" * 16), two: (0, b"l" * 16)}
    station: Any = SimpleNamespace(
        nodes=SimpleNamespace(exported_many=lambda uuids: {uuid: records[uuid] for uuid in uuids if uuid in records}),
        keys=SimpleNamespace(unwrap_named=lambda named: {uuid: keys[uuid] for uuid in named if uuid in keys}),
    )
    nodes = [outgoing.LeavingNode(one, "a1", 3), outgoing.LeavingNode(two, "b1", 0)]
    assert list(outgoing._bundled(station, nodes)) == [
        BundledNode(one, b"point", b"k" * 16, 3, 9, "p", "n", ("hand",), "ab" * 32),
        BundledNode(two, b"point", b"l" * 16, 0, 9, "p", "n", ("hand",), "ab" * 32),
    ]
    for change in (
        lambda: records.update({two: SimpleNamespace(**{**vars(whole), "point": None})}),
        lambda: records.pop(two),
        lambda: (records.update({two: whole}), keys.pop(two)),
    ):
        change()
        bundled = outgoing._bundled(station, nodes)
        assert next(bundled).uuid == one
        with pytest.raises(PolicyError, match=rf"^Node {two.hex()} was changed in the meantime\.$"):
            next(bundled)
