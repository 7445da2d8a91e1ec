"""Another CAN address: by tap, in a session, never plainly over the bus of a keyed node."""

from __future__ import annotations

from dataclasses import replace

import pytest

from teds_provision.errors import GarbledError, NodeRefusedError, NodeSilentError, UsageError
from teds_provision.links import LinkSettings
from teds_provision.protocol.messages.frames import Command
from teds_provision.protocol.messages.identity import Identity
from teds_provision.provisioning import address
from teds_provision.provisioning.address import set_address, set_address_at
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.station.station import Station
from tests.bench import Board, MemoryLink, talk

from .test_provision import run


def test_a_tapped_node_takes_another_address_and_keeps_it(station: Station, board: Board) -> None:
    with talk(board) as node:
        assert set_address(station, node, 0x21)
    board.power_on()
    assert board.state.can_address == 0x21
    record = station.nodes.get(board.uuid)
    assert record is not None
    assert record.can_address == 0x21
    with talk(board) as node:
        assert not set_address(station, node, 0x21), "again there is nothing to do"


def test_over_the_bus_it_takes_a_session(station: Station, board: Board) -> None:
    run(station, board)
    with talk(board, MemoryLink(board, via="can", tapped=False)) as node:
        assert set_address(station, node, 0x22)
        assert not node.sealed, "the session was one of the old address"
    assert board.state.can_address == 0x22


def test_over_the_bus_without_a_key_it_is_refused(station: Station, board: Board) -> None:
    with talk(board, MemoryLink(board, via="can", tapped=False)) as node, pytest.raises(NodeRefusedError):
        set_address(station, node, 0x23)
    assert board.state.can_address != 0x23


class OneBus(MemoryLink):
    """A line on a bus, where somebody else may be asked as well."""

    def from_station(self, source: int) -> MemoryLink:
        return self

    def identify_functional(self) -> bytes:
        return b""

    def identify_at(self, address: int) -> Identity | None:
        identity = self.board.tim.identity()
        return identity if identity.can_address == address else None

    def begin(self, octets: int) -> bytes:
        return b""

    address = 0


def test_a_board_that_moves_at_once_and_loses_its_reply_is_found_at_the_new_address(
    station: Station, board: Board
) -> None:
    run(station, board)
    link = OneBus(board, via="can", tapped=False, lose_reply=3)  # c, Open, Set CAN address
    with talk(board, link) as node:
        assert set_address(station, node, 0x22)
    record = station.nodes.get(board.uuid)
    assert record is not None
    assert record.can_address == 0x22


@pytest.mark.parametrize("there", [True, False])
def test_a_disturbed_reply_is_as_good_as_none(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch, there: bool
) -> None:
    run(station, board)
    with talk(board, OneBus(board, via="can", tapped=False)) as node:
        send = node.request

        def disturbed(command: Command, doing: str) -> bytes:
            if there:
                send(command, doing)
            raise GarbledError("The reply was disturbed.")

        monkeypatch.setattr(node, "request", disturbed)
        if there:
            assert set_address(station, node, 0x22)
        else:
            with pytest.raises(GarbledError, match="disturbed"):
                set_address(station, node, 0x22)
    record = station.nodes.get(board.uuid)
    assert record is not None
    assert (record.can_address == 0x22) is there


def test_a_node_that_is_not_at_the_new_address_is_silent(station: Station, board: Board) -> None:
    run(station, board)
    with talk(board, OneBus(board, via="can", tapped=False, lose_request=3)) as node, pytest.raises(NodeSilentError):
        set_address(station, node, 0x22)
    record = station.nodes.get(board.uuid)
    assert record is not None
    assert record.can_address != 0x22


def test_another_node_at_the_new_address_is_not_this_one(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(station, board)
    stranger = replace(board.tim.identity(), uuid=bytes(10), can_address=0x22)
    monkeypatch.setattr(OneBus, "identify_at", lambda _link, _address: stranger)
    with talk(board, OneBus(board, via="can", tapped=False, lose_reply=3)) as node, pytest.raises(NodeSilentError):
        set_address(station, node, 0x22)


def test_a_node_without_can_has_no_address_and_one_that_keeps_the_old_one_is_told(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(station, board)
    with talk(board) as node:
        node.identity = replace(node.identity, can_address=0)
        with pytest.raises(UsageError, match=r"^This node has no CAN, so it has no CAN address\.$"):
            set_address(station, node, 0x22)
    old = board.tim.identity()
    monkeypatch.setattr(address, "read_identity", lambda _node: old)
    with talk(board) as node, pytest.raises(GarbledError, match="still reports the old one"):
        set_address(station, node, 0x22)
    assert not [entry for entry in station.audit_log.entries() if entry.act == "address"]
    monkeypatch.setattr(address, "read_identity", lambda _node: board.tim.identity())
    board.seconds += 10.0
    with talk(board) as node:
        assert set_address(station, node, 0x23)
    (line,) = [entry for entry in station.audit_log.entries() if entry.act == "address"]
    assert (line.uuid, line.outcome, line.detail) == (board.uuid, "done", {"address": 0x23})


def test_a_dry_run_meets_no_node(station: Station, board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(address, "at_node", None)
    report = set_address_at(station, LinkSettings(), board.uuid.hex(), 0x22, SilentReporter(), dry_run=True)
    assert (report.uuid, report.changed) == (board.uuid, None)


def test_a_session_that_is_lost_while_an_address_is_set_ends_with_its_cause(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    cause = NodeSilentError("It is silent.")

    def lose(*_: object, **__: object) -> bytes:
        raise SessionLostError(cause)

    monkeypatch.setattr(address, "open_session", lambda *_: None)
    with talk(board) as node:
        monkeypatch.setattr(node, "request", lose)
        with pytest.raises(NodeSilentError) as lost:
            set_address(station, node, 0x21)
    assert lost.value is cause
