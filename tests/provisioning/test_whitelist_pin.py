"""When a whitelist entry without fingerprint gets its key: at the first tap in which the node proves it."""

from __future__ import annotations

import pytest

from teds_provision.errors import KeyMismatchError
from teds_provision.protocol.keys import fingerprint
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.whitelist import ListedNode, add, plan_addition, remove
from teds_provision.station.station import Station
from tests.bench import Board, MemoryLink, talk


def test_the_first_tap_pins_the_key_and_raises_the_assurance(station: Station, board: Board) -> None:
    add(station, plan_addition(station, [ListedNode(0, board.uuid, name="finger")]))
    who = identify(station, talk(board))
    entry = station.pins.entry(board.uuid)
    assert entry is not None
    assert (entry.fingerprint, entry.assurance, entry.name) == (fingerprint(board.key.point), "tap", "finger")
    assert who.whitelisted == entry
    assert [e.outcome for e in station.audit_log.entries() if e.act == "whitelist"] == ["added", "pinned"]
    identify(station, talk(board))
    assert len([e for e in station.audit_log.entries() if e.act == "whitelist"]) == 2


def test_a_bus_pins_nothing(station: Station, board: Board) -> None:
    add(station, plan_addition(station, [ListedNode(0, board.uuid)]))
    identify(station, talk(board, MemoryLink(board, via="can", tapped=False)))
    entry = station.pins.entry(board.uuid)
    assert entry is not None
    assert (entry.fingerprint, entry.assurance) == (None, "uuid")


def test_another_board_under_the_same_uuid_is_refused_until_the_entry_is_removed(
    station: Station, board: Board
) -> None:
    add(station, plan_addition(station, [ListedNode(0, board.uuid)]))
    identify(station, talk(board))
    replaced = Board(board.uuid)
    with pytest.raises(KeyMismatchError):
        identify(station, talk(replaced))
    remove(station, board.uuid)
    add(station, plan_addition(station, [ListedNode(0, board.uuid)]))
    identify(station, talk(replaced))
    entry = station.pins.entry(board.uuid)
    assert entry is not None
    assert entry.fingerprint == fingerprint(replaced.key.point)
