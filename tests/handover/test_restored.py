"""A station that came back from a backup: no use of a key over a bus without a tap or a person's word (issue 7, M6)."""

from __future__ import annotations

from pathlib import Path

import pytest

from teds_provision.backup.backup import backup
from teds_provision.backup.restore import rebuild
from teds_provision.backup.sealed_file import SealedFile
from teds_provision.errors import NodeSilentError, PolicyError
from teds_provision.provisioning.agree import agree, open_session, require_session
from teds_provision.provisioning.identify import identify
from teds_provision.station.station import Station
from teds_provision.vault.passphrase import THROWAWAY
from teds_provision.vault.selection import forget_vaults
from tests.bench import PASSPHRASE, Board, MemoryLink, make_station, talk
from tests.handover.desk import held, key_up


def ask(prompt: str, confirm: bool) -> str:
    return PASSPHRASE


def restored(tmp_path: Path, board: Board) -> Station:
    station = make_station(tmp_path / "home")
    key_up(station, board)
    return back(station, tmp_path)


def test_over_a_bus_it_takes_a_persons_word_and_a_new_key(tmp_path: Path) -> None:
    board = Board()
    station = restored(tmp_path, board)
    bus = MemoryLink(board, via="can", tapped=False)
    with talk(board, bus) as node:
        with pytest.raises(PolicyError, match="restored from a backup"):
            require_session(station, node)
        with pytest.raises(PolicyError, match="restored from a backup"):
            agree(station, node, identify(station, node))
    assert board.state.epoch == 1
    with talk(board, MemoryLink(board, via="can", tapped=False)) as node:
        assert agree(station, node, identify(station, node), rotate=True).epoch == 2
    with talk(board, MemoryLink(board, via="can", tapped=False)) as node:
        assert require_session(station, node).record.epoch == 2
    station.close()


def test_a_tap_is_enough_and_the_key_is_new_afterwards(tmp_path: Path) -> None:
    board = Board()
    station = restored(tmp_path, board)
    with talk(board) as node:
        assert require_session(station, node).record.epoch == 2
    assert station.keys.rotation_due(board.uuid) is None
    assert [state for state, *_ in held(station, board)] == ["active"]
    station.close()


def test_a_pending_key_out_of_a_backup_counts_for_no_rotation(tmp_path: Path) -> None:
    """Model, OLD_PENDING."""
    board = Board()
    station = make_station(tmp_path / "home")
    key_up(station, board)
    held_key = board.state.key
    assert held_key is not None
    station.keys.add_pending(board.uuid, key=bytes(16), key_id=b"pending!", epoch=2)
    station.keys.demand_rotation(board.uuid, "others may have it")
    assert {record.source for record in station.keys.keys_of(board.uuid) if record.state == "pending"} == {"import"}
    station.close()


def test_a_pending_key_that_came_back_and_opens_is_no_rotation(tmp_path: Path) -> None:
    """Model, OLD_PENDING: the node took the key of the cut agreement, and so may others have since the backup."""
    board = Board()
    station = make_station(tmp_path / "home")
    key_up(station, board)
    board.flash.die_after = True
    with talk(board) as node, pytest.raises(NodeSilentError):
        agree(station, node, identify(station, node), rotate=True)
    assert [(state, epoch) for state, epoch, *_ in held(station, board)] == [("pending", 2), ("active", 1)]
    again = back(station, tmp_path)
    assert {record.source for record in again.keys.keys_of(board.uuid) if record.state == "pending"} == {"agreement"}
    with talk(board) as node:
        opened = open_session(again, node)
        assert opened is not None
        assert opened.record.epoch == 2
    assert again.keys.restored(board.uuid), "that key is as old as the backup"
    with talk(board) as node:
        assert require_session(again, node).record.epoch == 3
    assert again.keys.rotation_due(board.uuid) is None
    again.close()


def back(station: Station, tmp_path: Path) -> Station:
    """Return the station as it comes back from a backup of now."""
    backup(station, tmp_path / "b", ask, costs=THROWAWAY)
    station.close()
    forget_vaults()
    with SealedFile(tmp_path / "b").open_with_passphrase(PASSPHRASE) as content:
        rebuild(tmp_path / "new", content, ask, costs=THROWAWAY)
    return Station.open(tmp_path / "new", ask=ask)
