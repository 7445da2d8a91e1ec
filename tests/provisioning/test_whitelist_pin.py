"""When a whitelist entry without fingerprint gets its key: at the first tap in which the node proves it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from teds_provision.errors import KeyMismatchError, NotAuthenticError, PolicyError
from teds_provision.protocol.keys import fingerprint
from teds_provision.provisioning.identify import IdentifiedNode, identify
from teds_provision.provisioning.whitelist import ListedNode, add, plan_addition, remove
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry
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


@pytest.mark.parametrize(
    ("tapped", "listed", "point", "last_seen"),
    [
        (True, None, True, True),
        (True, "uuid", True, True),
        (False, None, False, False),  # any device of a bus can use any UUID
        (False, "uuid", False, False),
        (False, "key", True, True),
        (False, "first digits", True, True),
    ],
)
def test_what_is_remembered_of_a_node_that_proved_its_key(
    station: Station, board: Board, tapped: bool, listed: str | None, point: bool, last_seen: bool
) -> None:
    whole = fingerprint(board.key.point)
    pins = {"uuid": None, "key": whole, "first digits": whole[:32]}
    if listed is not None:
        station.pins.put(WhitelistEntry(board.uuid, pins[listed], assurance="import" if pins[listed] else "uuid"))
    who = identify(station, talk(board, MemoryLink(board, via="nfc" if tapped else "can", tapped=tapped)))
    known = station.nodes.get(board.uuid)
    assert (known is not None and known.point == board.key.point) == point
    assert (known is not None and known.last_seen is not None) == last_seen
    entry = station.pins.entry(board.uuid)
    assert who.whitelisted == entry
    if listed == "first digits":
        assert entry is not None
        assert (entry.fingerprint, entry.assurance) == (whole, "import"), "the other digits, and no higher assurance"


@pytest.mark.parametrize("same", [True, False])
def test_over_a_bus_a_known_key_alone_was_seen_again(station: Station, board: Board, same: bool) -> None:
    known_key = {"point": board.key.point} if same else {}
    station.nodes.remember(board.uuid, last_seen="2026-01-01T00:00:00Z", **known_key)
    identify(station, talk(board, MemoryLink(board, via="can", tapped=False)))
    known = station.nodes.get(board.uuid)
    assert known is not None
    assert (known.last_seen != "2026-01-01T00:00:00Z") == same


def test_a_board_that_was_not_meant_leaves_nothing_here(station: Station, board: Board) -> None:
    def expect(who: IdentifiedNode) -> None:
        assert who.fingerprint == fingerprint(board.key.point)
        raise PolicyError("Another one was meant.")

    with pytest.raises(PolicyError, match="Another one was meant"):
        identify(station, talk(board), expect=expect)
    assert station.nodes.get(board.uuid) is None
    assert not any(line.uuid == board.uuid for line in station.audit_log.entries())


def test_a_key_that_is_not_signed_for_its_uuid_is_refused_before_it_is_proved(station: Station, board: Board) -> None:
    """The Security TEDS of another board, copied onto this one."""
    other = Board(bytes(9) + b"\1")
    board.flash.state = replace(board.state, node_key_signature=other.state.node_key_signature)
    board.power_on()
    link = MemoryLink(board)
    with pytest.raises(NotAuthenticError, match=rf"is not signed for UUID {board.uuid.hex()} \(field 102\)"):
        identify(station, talk(board, link))
    assert station.nodes.get(board.uuid) is None
    prove = bytes([0, 0, 128, 8])
    assert not any(frame.startswith(prove) for frame in link.frames)
