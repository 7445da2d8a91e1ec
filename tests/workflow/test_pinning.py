"""Which contacts pin a node's key: a tap and the owner's word do, a bus on which anyone may speak does not."""

from __future__ import annotations

import pytest

from teds_provision.errors import OtherKey, PolicyRefused
from teds_provision.store import Revocation, WhitelistEntry
from teds_provision.workflow.agree import agree
from teds_provision.workflow.identify import identify
from teds_provision.workflow.provision import add_to_whitelist
from teds_provision.workflow.station import Station
from teds_provision.workflow.whitelist import remove

from .bench import Board, MemoryLink, talk


def over_the_bus(board: Board) -> MemoryLink:
    return MemoryLink(board, via="can", tapped=False)


def test_an_impostor_on_the_bus_does_not_keep_the_real_node_out(station: Station, board: Board) -> None:
    identify(station, talk(impostor := Board(), over_the_bus(impostor)))
    assert identify(station, talk(board)).point == board.key.point
    with pytest.raises(OtherKey):
        identify(station, talk(impostor, over_the_bus(impostor)))


def test_an_impostor_on_the_bus_does_not_take_an_entry_without_key(station: Station, board: Board) -> None:
    station.store.put_whitelist(WhitelistEntry(board.uuid))
    identify(station, talk(impostor := Board(), over_the_bus(impostor)))
    with talk(board) as node:
        agree(station, node, identify(station, node))
    entry, known = station.store.whitelisted(board.uuid), station.store.node(board.uuid)
    assert entry is not None
    assert known is not None
    assert (entry.assurance, known.point) == ("tap", board.key.point)


def test_what_an_impostor_showed_is_not_built_upon(station: Station, board: Board) -> None:
    from teds_provision.workflow.sign import known_node_keys

    identify(station, talk(impostor := Board(), over_the_bus(impostor)))
    identify(station, talk(board))
    assert known_node_keys(station, board.uuid).key == board.key.point


def test_a_node_whitelisted_over_its_bus_is_pinned_from_then_on(station: Station, board: Board) -> None:
    node = talk(board, over_the_bus(board))
    add_to_whitelist(station, node, identify(station, node))
    with pytest.raises(OtherKey):
        identify(station, talk(Board()))


def test_an_entry_that_came_meanwhile_is_not_replaced(station: Station, board: Board) -> None:
    node = talk(board)
    who = identify(station, node)
    station.store.put_whitelist(WhitelistEntry(board.uuid, who.fingerprint, assurance="import", name="left hand"))
    assert add_to_whitelist(station, node, who).name == "left hand"
    station.store.put_whitelist(WhitelistEntry(board.uuid, "ab" * 32, assurance="import"))
    with pytest.raises(OtherKey):
        add_to_whitelist(station, node, who)


def test_a_revoked_node_is_not_whitelisted_again_by_a_tap(station: Station, board: Board) -> None:
    station.store.put_revocation(Revocation(board.uuid, None, "lost", "signed elsewhere"))
    node = talk(board)
    with pytest.raises(PolicyRefused, match="revoked"):
        add_to_whitelist(station, node, identify(station, node))
    assert station.store.whitelisted(board.uuid) is None


def test_a_tapped_key_that_was_never_whitelisted_can_be_forgotten(station: Station, board: Board) -> None:
    identify(station, talk(Board()))
    with pytest.raises(OtherKey):
        identify(station, talk(board))
    assert remove(station, board.uuid)
    assert identify(station, talk(board)).point == board.key.point
