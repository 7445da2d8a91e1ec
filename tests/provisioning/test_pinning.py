"""What a bus may not decide, and what one damaged key may not hide."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.errors import GarbledError, PolicyError, VaultError
from teds_provision.provisioning import teds_read as reading
from teds_provision.provisioning.identify import add_to_whitelist, identify
from teds_provision.provisioning.whitelist import remove
from teds_provision.station.station import Station
from tests.bench import Board, MemoryLink, make_station, talk

from .test_agree import run as agree
from .test_agree import whitelist


def test_a_keyed_node_on_a_bus_is_listed_by_uuid_and_pinned_by_its_first_tap(
    station: Station, board: Board, tmp_path: Path
) -> None:
    owner = make_station(tmp_path / "owner")
    whitelist(owner, board)
    agree(owner, board)
    with talk(board, MemoryLink(board, via="can", tapped=False)) as node:
        entry = add_to_whitelist(station, node, identify(station, node))
    assert (entry.assurance, entry.fingerprint) == ("uuid", None)
    known = station.nodes.get(board.uuid)
    assert known is None or known.point is None, "what a stranger could have shown over the bus is no key of the node"
    (added,) = [line for line in station.audit_log.entries() if line.act == "whitelist"]
    assert (added.uuid, added.outcome) == (board.uuid, "added")
    assert added.detail == {"fingerprint": None, "assurance": "uuid"}
    with talk(board) as node:
        shown = identify(station, node)
    pinned = station.pins.entry(board.uuid)
    assert pinned is not None
    assert pinned.fingerprint == shown.fingerprint


def test_a_new_node_on_a_bus_and_any_node_that_is_tapped_are_pinned_with_their_key(station: Station) -> None:
    for number, (via, tapped, assurance) in enumerate([("can", False, "bus"), ("nfc", True, "tap")]):
        new = Board(bytes([number]) * 10)
        with talk(new, MemoryLink(new, via=via, tapped=tapped)) as node:
            entry = add_to_whitelist(station, node, who := identify(station, node))
            assert add_to_whitelist(station, node, who) == entry
        known = station.nodes.get(new.uuid)
        assert known is not None
        assert (entry.assurance, entry.fingerprint, known.point) == (assurance, who.fingerprint, new.key.point)
    assert [line.outcome for line in station.audit_log.entries() if line.act == "whitelist"] == ["added", "added"]
    station.pins.put(replace(entry, name="first"))
    with talk(new) as node:
        assert add_to_whitelist(station, node, who).name == "first", "an entry that is there already stays"


def test_an_open_session_shows_that_a_board_whose_pin_was_taken_off_was_not_replaced(
    station: Station, board: Board
) -> None:
    whitelist(station, board)
    agree(station, board)
    assert remove(station, board.uuid)
    assert station.pins.is_unsettled(board.uuid)
    whitelist(station, board)
    agree(station, board)
    assert not station.pins.is_unsettled(board.uuid)


def test_one_damaged_key_does_not_hide_the_good_one(station: Station, board: Board) -> None:
    whitelist(station, board)
    agree(station, board)
    station.keys.add_pending(board.uuid, key=bytes(16), key_id=bytes(8), epoch=9)
    station._store.execute("UPDATE keys SET wrapped = x'00' WHERE state = 'pending'")
    assert agree(station, board).epoch == 1
    station._store.execute("UPDATE keys SET wrapped = x'00'")
    with pytest.raises(VaultError):
        agree(station, board)


def test_a_node_that_hands_out_its_teds_too_slowly_is_left(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "READING_SECONDS", -1.0)
    with talk(board) as node, pytest.raises(GarbledError, match="too slowly"):
        reading.read_image(node)


def test_a_node_given_away_and_provisioned_elsewhere_does_not_come_back_on_a_hint(
    station: Station, board: Board
) -> None:
    from dataclasses import replace

    from teds_provision.protocol.messages.identity import NodeState
    from teds_provision.provisioning.agree import agree as step
    from teds_provision.station.store.records import Handover, Tombstone

    from .test_provision import run as provision

    provision(station, board)
    station.keys.remove(board.uuid)
    station.handovers.put(Handover("one", "out", "move", ("ab" * 32,), "closed", "{}"))
    station.policy.put_tombstone(Tombstone(board.uuid, "ab" * 32, "one"))
    with talk(board) as node, pytest.raises(PolicyError, match="was moved"):
        step(station, node, replace(identify(station, node), state=NodeState.FACTORY))
    assert station.policy.tombstone(board.uuid) is not None
    board.tim.reset_by_hand()
    assert agree(station, board).epoch == 2
    assert station.policy.tombstone(board.uuid) is None
