"""Keys handed from one base station to another: copy, move, receipt, undo, and who may use what in between."""

from __future__ import annotations

import hashlib
import json
import stat
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from teds_provision.errors import BadData, NodeRefused, NotAuthentic, NotFound, PolicyRefused, UsageFailure
from teds_provision.handover.export_keys import export_keys, plan_export
from teds_provision.handover.import_keys import Imported, ImportPlan, import_keys, plan_import
from teds_provision.handover.pending import close, content_digest, find_handover, list_handovers, undo
from teds_provision.handover.prove import prove_node, proven_of
from teds_provision.handover.selection import ExportOrder
from teds_provision.protocol.agreement import key_id
from teds_provision.protocol.handover.bundle import open_bundle
from teds_provision.protocol.handover.receipt import open_receipt
from teds_provision.steps.agree import agree
from teds_provision.steps.identify import identify
from teds_provision.steps.read import read_image
from teds_provision.steps.reset import reset_node
from teds_provision.steps.verify_node import verify_node
from teds_provision.store import WhitelistEntry
from tests.bench import Board, MemoryLink, make_station, talk
from tests.handover.desk import Pair, everything, held, key_up, node_key_id, provisioned, row, session, trust

SESSIONS = 1000


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    made = Pair.make(tmp_path)
    yield made
    made.close()


# -- copy -------------------------------------------------------------------------------------------------------------


def test_after_a_copy_both_stations_reach_the_node(pair: Pair) -> None:
    path, _exported = pair.export("copy")
    taken = pair.take(path)
    assert taken.uuids == (pair.board.uuid,)
    assert held(pair.south, pair.board) == [("pending", 1, "import")]
    assert session(pair.south, pair.board) == 1
    assert held(pair.south, pair.board) == [("active", 1, "import")]
    assert session(pair.north, pair.board) == 1
    record = pair.south.nodes.get(pair.board.uuid)
    assert record is not None
    assert (record.name, record.groups, record.profile) == ("finger 1", ("left hand",), "tactile-finger-sensor")
    entry = pair.south.pins.entry(pair.board.uuid)
    assert entry is not None
    assert (entry.assurance, entry.fingerprint is not None) == ("import", True)


def test_each_station_knows_who_else_holds_a_copy(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    assert [(h.fingerprint, h.mode) for h in pair.north.keys.holders()] == [(pair.south.fingerprint, "copy")]
    assert [(h.fingerprint, h.mode) for h in pair.south.keys.holders()] == [(pair.north.fingerprint, "copy")]


def test_stations_alternate_sessions_under_one_copied_key(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    for number in range(SESSIONS):
        assert session((pair.north, pair.south)[number % 2], pair.board, via=("can", "nfc")[number // 2 % 2]) == 1


def test_sessions_of_both_at_once_on_two_links_do_not_disturb_each_other(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    with (
        talk(pair.board, MemoryLink(pair.board)) as here,
        talk(pair.board, MemoryLink(pair.board, via="can", tapped=False)) as there,
    ):
        for _ in range(3):
            prove_node(pair.north, here)
            prove_node(pair.south, there)
            assert read_image(here) == read_image(there)


def test_a_rotation_by_one_locks_the_other_out_and_is_told(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    with talk(pair.board) as node:
        agree(pair.south, node, identify(pair.south, node), rotate=True)
    assert pair.south.keys.holders() == []
    with talk(pair.board) as node, pytest.raises(PolicyRefused, match="knows none of the keys"):
        agree(pair.north, node, identify(pair.north, node))
    assert session(pair.south, pair.board) == 2


def test_one_bundle_for_several_stations(pair: Pair, tmp_path: Path) -> None:
    west = make_station(tmp_path / "west", "west")
    trust(pair.north, west)
    trust(west, pair.north)
    trust(pair.south, west)
    path, _exported = pair.export("copy", to=("south", west.fingerprint[:16]))
    for station in (pair.south, west):
        pair.take(path, station)
        assert session(station, pair.board) == 1
    assert {h.fingerprint for h in pair.south.keys.holders()} == {pair.north.fingerprint, west.fingerprint}
    assert pair.south.identity.certificate(pair.north.ca, west.point) is not None
    west.close()


def test_a_copy_for_several_is_closed_by_the_last_receipt(pair: Pair, tmp_path: Path) -> None:
    west = make_station(tmp_path / "west", "west")
    trust(pair.north, west)
    trust(west, pair.north)
    path, exported = pair.export("copy", to=("south", "west"))
    for station, state in ((pair.south, "open"), (west, "closed")):
        receipt = pair.take(path, station).receipt
        assert (close(pair.north, receipt).row.state, close(pair.north, receipt).fresh) == (state, False)
    assert row(pair.north, exported.plan.id, "out").state == "closed"
    west.close()


# -- move -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [0, 1, 3, 1001])
def test_a_handover_is_known_by_the_digest_that_earlier_versions_noted(count: int) -> None:
    nodes = [(number.to_bytes(10, "big"), f"{number:016x}", number) for number in range(count)]
    said = [
        "ab" * 32,
        ["cd" * 32, "ef" * 32],
        "copy",
        "04" * 65,
        [[uuid.hex(), key, epoch] for uuid, key, epoch in nodes],
    ]
    whole = hashlib.sha256(json.dumps(said, separators=(",", ":")).encode()).hexdigest()
    assert content_digest("ab" * 32, ["ef" * 32, "cd" * 32], "copy", b"\x04" * 65, nodes) == whole


def test_what_lies_there_before_the_key_rests_opens_for_nobody(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that is killed before the store has the move leaves a draft at most, without signature and tag."""
    left: list[bytes] = []

    def dying(*_: object) -> None:
        (draft,) = (path for path in pair.folder.glob(".*") if path.name.endswith(".teds-part"))
        left.append(draft.read_bytes())
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("teds_provision.handover.export_keys._record", dying)
        with pytest.raises(KeyboardInterrupt):
            pair.export("move")
    assert not pair.north.policy.tombstones()
    assert b'"tag"' not in left[0]
    for closed in (left[0], left[0] + b'"}', left[0] + b'","tag":"AAAAAAAAAAAAAAAAAAAAAA"}'):
        with pytest.raises((BadData, NotAuthentic)):
            plan_import(pair.south, closed)
    assert isinstance(plan_import(pair.south, pair.export("move")[0].read_bytes()), ImportPlan)


def test_a_move_rests_the_key_at_once(pair: Pair) -> None:
    _, exported = pair.export("move")
    for act in (session, key_again):
        with pytest.raises(PolicyRefused, match="was moved to station") as refused:
            act(pair.north, pair.board)
        assert f"handover undo {exported.plan.id}" in refused.value.hint


def key_again(station, board):  # type: ignore[no-untyped-def]
    with talk(board) as node:
        agree(station, node, identify(station, node))


def test_a_moved_node_can_still_be_verified_by_its_former_station(pair: Pair) -> None:
    provisioned(pair.north, pair.board)
    pair.export("move")
    with talk(pair.board) as node:
        who = identify(pair.north, node)
        assert verify_node(pair.north, node, read_image(node), who.point).verdict == "authentic"


def test_the_receiver_of_a_move_rotates_at_its_first_contact(pair: Pair) -> None:
    pair.take(pair.export("move")[0])
    before = node_key_id(pair.board)
    with talk(pair.board, MemoryLink(pair.board, via="can", tapped=False)) as node:
        proven = prove_node(pair.south, node)
    assert (proven.rotated, proven.epoch) == (True, 2)
    assert node_key_id(pair.board) != before
    assert held(pair.south, pair.board) == [("active", 2, "agreement")]
    assert proven_of(pair.south, [pair.board.uuid]) == {pair.board.uuid}
    assert pair.south.keys.holders() == []
    assert pair.south.keys.rotation_due(pair.board.uuid) is None


@pytest.mark.parametrize("lost", range(1, 9))
@pytest.mark.parametrize("what", ["lose_request", "lose_reply"])
def test_a_first_contact_cut_anywhere_is_carried_on(pair: Pair, what: str, lost: int) -> None:
    from teds_provision.errors import NodeSilent

    pair.take(pair.export("move")[0])
    link = MemoryLink(pair.board, via="can", tapped=False, **{what: lost})
    try:
        with talk(pair.board, link) as node:
            prove_node(pair.south, node)
    except NodeSilent:
        pass
    epoch = session(pair.south, pair.board)
    assert epoch >= 2
    assert pair.south.keys.rotation_due(pair.board.uuid) is None
    assert [key.key_id for key in pair.south.keys.of(pair.board.uuid)] == [node_key_id(pair.board)]


def test_any_first_contact_after_a_move_rotates_even_to_write(pair: Pair) -> None:
    provisioned(pair.north, pair.board)
    pair.take(pair.export("move")[0])
    done = provisioned(pair.south, pair.board)
    assert done.verified.verdict == "authentic"
    assert (pair.board.state.epoch, pair.board.state.station) == (2, pair.south.point)


def test_the_receiver_writes_and_rotates_under_the_senders_ca(pair: Pair) -> None:
    assert pair.north.ca != pair.south.ca
    pair.take(pair.export("copy")[0])
    done = provisioned(pair.south, pair.board)
    assert done.verified.verdict == "authentic"
    assert pair.board.state.ca == pair.north.ca
    with talk(pair.board) as node:
        assert agree(pair.south, node, identify(pair.south, node), rotate=True).epoch == 2


def test_the_senders_ca_counts_for_these_nodes_and_no_others(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    assert pair.north.ca in pair.south.policy.trusted_cas(pair.board.uuid)
    assert pair.north.ca not in pair.south.policy.trusted_cas()
    assert pair.north.ca not in pair.south.policy.trusted_cas(bytes(10))


def test_a_reset_node_gets_its_new_stations_own_ca(pair: Pair) -> None:
    pair.take(pair.export("move")[0])
    pair.board.tim.reset_by_hand()
    with talk(pair.board) as node:
        agree(pair.south, node, identify(pair.south, node))
    assert pair.board.state.ca == pair.south.ca
    assert provisioned(pair.south, pair.board).verified.verdict == "authentic"


def test_a_move_has_one_receiver(pair: Pair, tmp_path: Path) -> None:
    west = make_station(tmp_path / "west", "west")
    trust(pair.north, west)
    with pytest.raises(UsageFailure, match="exactly one receiver"):
        pair.export("move", to=("south", "west"))
    west.close()


def test_a_node_goes_there_and_back(pair: Pair) -> None:
    pair.take(pair.export("move")[0])
    session(pair.south, pair.board)
    back = pair.folder / "back.jwe"
    export_keys(pair.south, plan_export(pair.south, ExportOrder(("north",), None, "move")), back)
    pair.take(back, pair.north)
    assert session(pair.north, pair.board) == 3
    assert pair.north.policy.tombstone(pair.board.uuid) is None
    with pytest.raises(PolicyRefused, match="was moved to station"):
        session(pair.south, pair.board)


# -- receipt and undo -------------------------------------------------------------------------------------------------


def test_the_receipt_closes_a_move_and_deletes_its_keys(pair: Pair) -> None:
    path, exported = pair.export("move")
    taken = pair.take(path)
    assert close(pair.north, taken.receipt).fresh
    assert held(pair.north, pair.board) == []
    assert row(pair.north, exported.plan.id, "out").state == "closed"
    tombstone = pair.north.policy.tombstone(pair.board.uuid)
    assert tombstone is not None
    assert tombstone.to_fingerprint == pair.south.fingerprint
    assert not close(pair.north, taken.receipt + b"\n").fresh


def test_a_receipt_is_for_this_bundle_from_its_receiver(pair: Pair, tmp_path: Path) -> None:
    path, _exported = pair.export("move")
    taken = pair.take(path)
    before = everything(pair.north)
    with pytest.raises(NotAuthentic):
        close(pair.north, taken.receipt[:-4] + b"AAAA")
    stations = {pair.south.fingerprint: pair.south.point}
    receipt = open_receipt(taken.receipt, stations.get)
    from teds_provision.protocol.handover.receipt import seal_receipt

    key = pair.south.vault.identity()
    forged = {
        "another file": (replace(receipt, bundle_sha256="0" * 64), NotAuthentic),
        "other nodes": (replace(receipt, imported=(bytes(10),)), NotAuthentic),
        "another sender of the bundle": (replace(receipt, to="0" * 64), PolicyRefused),
        "unknown id": (replace(receipt, id="3d1a4d1c-52c4-4d0b-9d3c-0c8f4bd5a7f1"), NotFound),
    }
    for bad, error in forged.values():
        with pytest.raises(error):
            close(pair.north, seal_receipt(bad, key))
    west = make_station(tmp_path / "west", "west")
    trust(pair.north, west)
    with pytest.raises(PolicyRefused):
        close(pair.north, seal_receipt(replace(receipt, sender=west.fingerprint), west.vault.identity()))
    west.close()
    assert everything(pair.north) == before


def test_a_lost_receipt_is_had_again_by_the_same_import(pair: Pair) -> None:
    path, _ = pair.export("move")
    first = pair.take(path)
    before = everything(pair.south)
    again = pair.take(path)
    assert (again.receipt, again.fresh) == (first.receipt, False)
    assert everything(pair.south) == before


def test_undo_gives_the_key_back_and_rotates_it_before_anything_else(pair: Pair) -> None:
    _, exported = pair.export("move")
    assert undo(pair.north, find_handover(pair.north, exported.plan.id[:8])).fresh
    assert not undo(pair.north, find_handover(pair.north, exported.plan.id)).fresh
    assert [holder.fingerprint for holder in pair.north.keys.holders()] == [pair.south.fingerprint]
    assert session(pair.north, pair.board) == 2
    assert pair.north.keys.holders() == []
    assert session(pair.north, pair.board) == 2


def test_an_undone_move_that_was_imported_all_the_same(pair: Pair) -> None:
    path, exported = pair.export("move")
    undo(pair.north, find_handover(pair.north, exported.plan.id))
    taken = pair.take(path)
    with pytest.raises(PolicyRefused, match="took 1 keys in all the same"):
        close(pair.north, taken.receipt)
    assert session(pair.north, pair.board) == 2
    with pytest.raises(PolicyRefused, match="knows none of the keys"):
        session(pair.south, pair.board)


def test_what_cannot_be_undone(pair: Pair) -> None:
    _, copied = pair.export("copy")
    with pytest.raises(PolicyRefused, match="copy cannot be taken back"):
        undo(pair.north, find_handover(pair.north, copied.plan.id))
    path, moved = pair.export("move")
    close(pair.north, pair.take(path).receipt)
    with pytest.raises(PolicyRefused, match="receipt of this move came"):
        undo(pair.north, find_handover(pair.north, moved.plan.id))
    with pytest.raises(NotFound):
        find_handover(pair.north, "ffffffff")


def test_a_node_refused_by_the_receiver_of_a_move_is_the_senders_again(tmp_path: Path) -> None:
    pair = Pair.make(tmp_path, 2)
    first, second = pair.boards
    pair.south.pins.put(WhitelistEntry(second.uuid, "ab" * 32))
    path, _ = pair.export("move")
    taken = pair.take(path)
    assert [uuid for uuid, _ in taken.notes.refused] == [second.uuid.hex()]
    close(pair.north, taken.receipt)
    assert held(pair.north, first) == []
    assert session(pair.north, second) == 2
    pair.close()


def test_a_node_that_was_given_away_and_reset_may_be_keyed_again(pair: Pair) -> None:
    path, _ = pair.export("move")
    close(pair.north, pair.take(path).receipt)
    with pytest.raises(PolicyRefused, match="was moved to station"):
        key_again(pair.north, pair.board)
    pair.board.tim.reset_by_hand()
    key_again(pair.north, pair.board)
    assert session(pair.north, pair.board) == 2


def test_the_list_of_handovers(pair: Pair) -> None:
    path, _ = pair.export("move")
    pair.take(path)
    (out,) = list_handovers(pair.north, datetime.now(UTC))
    (came,) = list_handovers(pair.south, datetime.now(UTC))
    assert (out.row.state, out.peers, out.count, out.expired) == ("open", ("south",), 1, False)
    assert (came.row.state, came.peers) == ("imported", ("north",))
    assert list_handovers(pair.north, datetime.now(UTC) + timedelta(days=8))[0].expired


# -- exporting again, and what is refused -----------------------------------------------------------------------------


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


def test_a_bundle_file_is_private_and_never_overwritten(pair: Pair) -> None:
    path, _ = pair.export("copy")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    occupied = pair.folder / "occupied"
    occupied.write_text("a letter")
    with pytest.raises(UsageFailure, match="exists already"):
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
    with pytest.raises(PolicyRefused, match="never proven"):
        plan_export(pair.south, ExportOrder(("north",), (pair.board.uuid,)))
    with pytest.raises(PolicyRefused, match="no key of it is held"):
        plan_export(pair.north, ExportOrder(("south",), (other.uuid,)))
    with pytest.raises(NotFound):
        plan_export(pair.south, ExportOrder(("north",), None))


def test_a_key_that_is_due_for_rotation_is_not_handed_over(pair: Pair) -> None:
    _, exported = pair.export("move")
    undo(pair.north, find_handover(pair.north, exported.plan.id))
    with pytest.raises(PolicyRefused, match="must be rotated first"):
        plan_export(pair.north, ExportOrder(("south",), (pair.board.uuid,)))


def test_a_moved_node_is_not_handed_to_someone_else(pair: Pair, tmp_path: Path) -> None:
    pair.export("move")
    west = make_station(tmp_path / "west", "west")
    trust(pair.north, west)
    for mode in ("copy", "move"):
        with pytest.raises(PolicyRefused, match="was moved to station"):
            plan_export(pair.north, ExportOrder(("west",), (pair.board.uuid,), mode))  # type: ignore[arg-type]
    west.close()


def test_without_the_ca_key_the_receiver_must_be_certified_already(pair: Pair) -> None:
    signature = pair.north.identity.certify(pair.south.point)
    pair.north.vault.drop_ca()  # type: ignore[attr-defined]
    with pytest.raises(PolicyRefused, match="not certified by the CA"):
        pair.export("copy")
    pair.north.identity.keep_certificate(pair.north.ca, pair.south.point, signature)
    pair.take(pair.export("copy")[0])
    assert provisioned(pair.south, pair.board).verified.verdict == "authentic"


def test_nodes_of_two_cas_go_in_two_bundles(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    session(pair.south, pair.board)
    own = Board(uuid=bytes.fromhex("8d4d9da65281f700ffff"))
    key_up(pair.south, own)
    with pytest.raises(PolicyRefused, match="2 different CA keys"):
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
    path, _exported = pair.export("copy")
    keys = {pair.north.fingerprint: pair.north.point}
    opened = open_bundle(path.read_bytes(), pair.south.vault.identity(), keys.get, datetime.now(UTC))
    (node,) = opened.bundle.nodes
    record = pair.north.nodes.get(pair.board.uuid)
    assert record is not None
    assert (node.uuid, node.node_key, node.key) == (pair.board.uuid, pair.board.key.point, pair.board.state.key)
    assert (node.epoch, node.sequence, node.teds_sha256) == (1, 1, record.teds_sha256)
    assert opened.bundle.expires - opened.bundle.created == timedelta(days=7)
    assert opened.station_signature is not None
    assert json.loads(path.read_bytes())["recipients"][0]["header"]["kid"] == pair.south.fingerprint


# -- importing: what is refused ---------------------------------------------------------------------------------------


def test_an_expired_bundle_is_refused_but_its_receipt_can_be_had(pair: Pair) -> None:
    path, _ = pair.export("copy")
    later = datetime.now(UTC) + timedelta(days=8)
    with pytest.raises(PolicyRefused, match="expired"):
        plan_import(pair.south, path.read_bytes(), later)
    taken = pair.take(path)
    again = plan_import(pair.south, path.read_bytes(), later)
    assert isinstance(again, Imported)
    assert again.receipt == taken.receipt


def test_a_bundle_for_another_station_or_from_a_stranger(pair: Pair, tmp_path: Path) -> None:
    west = make_station(tmp_path / "west", "west")
    path, _ = pair.export("copy")
    with pytest.raises(PolicyRefused, match="not sealed for this station"):
        plan_import(west, path.read_bytes())
    pair.south.policy.distrust("north")
    with pytest.raises(NotAuthentic, match="Nobody trusted here"):
        plan_import(pair.south, path.read_bytes())
    west.close()


def test_an_id_that_came_before_with_other_content(pair: Pair) -> None:
    path, exported = pair.export("copy")
    pair.take(path)
    other = Board(uuid=bytes.fromhex("8d4d9da65281f700ffff"))
    key_up(pair.north, other)
    plan = replace(plan_export(pair.north, ExportOrder(("south",), None)), id=exported.plan.id)
    forged = pair.folder / "forged.jwe"
    export_keys(pair.north, plan, forged)
    before = everything(pair.south)
    with pytest.raises(PolicyRefused, match="replayed or forged"):
        plan_import(pair.south, forged.read_bytes())
    assert everything(pair.south) == before


def test_an_older_epoch_than_the_stores_is_refused(pair: Pair) -> None:
    old, _ = pair.export("copy")
    with talk(pair.board) as node:
        agree(pair.north, node, identify(pair.north, node), rotate=True)
    new, _ = pair.export("copy")
    pair.take(new)
    session(pair.south, pair.board)
    with pytest.raises(PolicyRefused, match="epoch 1 is older than 2"):
        plan_import(pair.south, old.read_bytes())


def test_a_newer_epoch_comes_in_beside_the_old_key_until_it_is_proven(pair: Pair) -> None:
    pair.take(pair.export("copy")[0])
    session(pair.south, pair.board)
    with talk(pair.board) as node:
        agree(pair.north, node, identify(pair.north, node), rotate=True)
    plan = plan_import(pair.south, pair.export("copy")[0].read_bytes())
    assert isinstance(plan, ImportPlan)
    assert [node.decision for node in plan.nodes] == ["newer"]
    import_keys(pair.south, plan)
    assert held(pair.south, pair.board) == [("pending", 2, "import"), ("active", 1, "import")]
    assert session(pair.south, pair.board) == 2
    assert held(pair.south, pair.board) == [("active", 2, "import")]


def test_a_newer_key_under_another_ca_counts_once_it_is_proven(pair: Pair) -> None:
    """North shares a node; south resets it and keys it under its own CA, then shares it back."""
    pair.take(pair.export("copy")[0])
    with talk(pair.board) as node:
        reset_node(pair.south, node, identify(pair.south, node))
    key_again(pair.south, pair.board)
    assert pair.board.state.ca == pair.south.ca
    bundle = pair.folder / "back.jwe"
    export_keys(pair.south, plan_export(pair.south, ExportOrder(("north",), None)), bundle)
    pair.take(bundle, pair.north)
    assert pair.north.keys.ca_of(pair.board.uuid) == pair.north.ca
    assert session(pair.north, pair.board) == 2
    assert pair.north.keys.ca_of(pair.board.uuid) == pair.south.ca
    assert provisioned(pair.north, pair.board).verified.verdict == "authentic"


def test_a_claimed_key_under_another_ca_does_not_spoil_the_one_in_use(pair: Pair) -> None:
    """A trusted station that errs, or lies: its key is never proven, and the node stays reachable and writable."""
    path, _ = pair.export("copy")
    pair.take(path)
    key = bytes(range(16))
    pair.south.keys.add_pending(pair.board.uuid, key=key, key_id=key_id(key), epoch=9)
    pair.south.keys.promote(pair.board.uuid, key_id(key).hex())
    pair.south.keys.set_ca_of(pair.board.uuid, pair.south.ca)
    bundle = pair.folder / "lie.jwe"
    export_keys(pair.south, plan_export(pair.south, ExportOrder(("north",), None)), bundle)
    pair.take(bundle, pair.north)
    assert session(pair.north, pair.board) == 1
    assert provisioned(pair.north, pair.board).verified.verdict == "authentic"


def test_a_uuid_known_with_another_node_key_is_refused_and_the_rest_comes_in(tmp_path: Path) -> None:
    pair = Pair.make(tmp_path, 2)
    clone = Board(uuid=pair.boards[1].uuid)
    key_up(pair.south, clone)
    plan = plan_import(pair.south, pair.export("copy")[0].read_bytes())
    assert isinstance(plan, ImportPlan)
    assert [node.decision for node in plan.nodes] == ["new", "refused"]
    assert "another node key" in plan.nodes[1].why
    import_keys(pair.south, plan)
    assert session(pair.south, clone) == 1
    assert session(pair.south, pair.boards[0]) == 1
    pair.close()


def test_where_every_node_is_refused_nothing_is_imported(pair: Pair) -> None:
    key_up(pair.south, Board(uuid=pair.board.uuid))
    before = everything(pair.south)
    with pytest.raises(PolicyRefused, match="another node key"):
        plan_import(pair.south, pair.export("copy")[0].read_bytes())
    assert everything(pair.south) == before


def test_the_same_keys_again_in_a_new_bundle(pair: Pair) -> None:
    first, exported = pair.export("copy")
    close(pair.north, pair.take(first).receipt)
    second, again = pair.export("copy")
    assert again.plan.id != exported.plan.id
    plan = plan_import(pair.south, second.read_bytes())
    assert isinstance(plan, ImportPlan)
    assert [node.decision for node in plan.nodes] == ["same"]
    import_keys(pair.south, plan)
    assert len(held(pair.south, pair.board)) == 1


def test_a_station_that_lost_the_node_to_a_rotation_does_not_agree_anew(pair: Pair) -> None:
    pair.take(pair.export("move")[0])
    pair.north.policy.take_back([pair.board.uuid])
    with talk(pair.board) as node:
        agree(pair.north, node, identify(pair.north, node), rotate=True)
    with talk(pair.board) as node, pytest.raises((PolicyRefused, NodeRefused), match="knows none"):
        agree(pair.south, node, identify(pair.south, node))
    assert pair.board.state.epoch == 2
