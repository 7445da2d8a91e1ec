"""Receipts and undo: what closes a handover, what takes it back, and what cannot be taken back."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from teds_provision.errors import NotAuthenticError, NotFoundError, PolicyError
from teds_provision.handover.pending import close, find_handover, list_handovers, undo
from teds_provision.plant.backlog import backlog
from teds_provision.protocol.handover.receipt import open_receipt
from teds_provision.provisioning.agree import agree
from teds_provision.provisioning.identify import identify
from teds_provision.station.store.records import Tombstone, WhitelistEntry
from tests.bench import make_station, talk
from tests.handover.desk import Pair, everything, held, row, session, trust


def key_again(station, board):  # type: ignore[no-untyped-def]
    with talk(board) as node:
        agree(station, node, identify(station, node))


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
    with pytest.raises(NotAuthenticError):
        close(pair.north, taken.receipt[:-4] + b"AAAA")
    stations = {pair.south.fingerprint: pair.south.point}
    receipt = open_receipt(taken.receipt, stations.get)
    from teds_provision.protocol.handover.receipt import seal_receipt

    key = pair.south.vault.identity()
    forged = {
        "another file": (replace(receipt, bundle_sha256="0" * 64), NotAuthenticError),
        "other nodes": (replace(receipt, imported=(bytes(10),)), NotAuthenticError),
        "another sender of the bundle": (replace(receipt, to="0" * 64), PolicyError),
        "unknown id": (replace(receipt, id="3d1a4d1c-52c4-4d0b-9d3c-0c8f4bd5a7f1"), NotFoundError),
    }
    for bad, error in forged.values():
        with pytest.raises(error):
            close(pair.north, seal_receipt(bad, key))
    west = make_station(tmp_path / "west", "west")
    trust(pair.north, west)
    with pytest.raises(PolicyError):
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
    assert "gave" in {act for act, _, _ in backlog(pair.north)}
    assert undo(pair.north, find_handover(pair.north, exported.plan.id[:8])).fresh
    assert "gave" not in {act for act, _, _ in backlog(pair.north)}
    assert not undo(pair.north, find_handover(pair.north, exported.plan.id)).fresh
    assert [holder.fingerprint for holder in pair.north.keys.holders()] == [pair.south.fingerprint]
    assert session(pair.north, pair.board) == 2
    assert pair.north.keys.holders() == []
    assert session(pair.north, pair.board) == 2


def test_an_undone_move_that_was_imported_all_the_same(pair: Pair) -> None:
    path, exported = pair.export("move")
    undo(pair.north, find_handover(pair.north, exported.plan.id))
    taken = pair.take(path)
    with pytest.raises(PolicyError, match="took 1 key in all the same"):
        close(pair.north, taken.receipt)
    assert session(pair.north, pair.board) == 2
    with pytest.raises(PolicyError, match="knows none of the keys"):
        session(pair.south, pair.board)


def test_what_cannot_be_undone(pair: Pair) -> None:
    _, copied = pair.export("copy")
    with pytest.raises(PolicyError, match="copy cannot be undone"):
        undo(pair.north, find_handover(pair.north, copied.plan.id))
    path, moved = pair.export("move")
    close(pair.north, pair.take(path).receipt)
    with pytest.raises(PolicyError, match="receipt of this move has arrived"):
        undo(pair.north, find_handover(pair.north, moved.plan.id))
    with pytest.raises(NotFoundError):
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
    with pytest.raises(PolicyError, match="was moved to station"):
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


def test_a_receipt_deletes_nothing_of_a_node_that_rests_because_of_another_move(pair: Pair) -> None:
    path, _ = pair.export("move")
    taken = pair.take(path)
    pair.north.policy.take_back([pair.board.uuid])
    pair.north.policy.put_tombstone(Tombstone(pair.board.uuid, pair.south.fingerprint, "a later move"))
    assert close(pair.north, taken.receipt).fresh
    assert held(pair.north, pair.board) != []
