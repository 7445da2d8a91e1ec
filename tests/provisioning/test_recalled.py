"""When a node proves the key of its last reading and is not read again, and what a node says of itself."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision import teds
from teds_provision.errors import KeyMismatchError, NodeRefusedError
from teds_provision.protocol.messages.frames import Reason, TedsFunction
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning import identify as step
from teds_provision.provisioning.identify import Description, describe, examine
from teds_provision.station.station import Station
from tests.bench import Board, MemoryLink, talk

from .test_provision import run as provision

READ_SECURITY = bytes([0, 0, 1, TedsFunction.READ])


def recalled(station: Station, board: Board, *, recall: bool = True) -> tuple[bool, int]:
    """Return whether the key was recalled, and how often a TEDS was read."""
    link = MemoryLink(board)
    with talk(board, link) as node:
        who = examine(station, node, recall=recall)
    assert who.point == board.key.point
    return who.recalled, sum(frame.startswith(READ_SECURITY) for frame in link.frames)


def test_a_node_that_was_read_in_a_session_proves_that_key_and_is_not_read(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    provision(station, board)
    assert recalled(station, board) == (True, 0)
    assert recalled(station, board, recall=False) == (False, 1)
    row = station.datasheets.reading(board.uuid)
    with monkeypatch.context() as patched:
        plain = SimpleNamespace(**{name: getattr(row, name) for name in ("node_key", "node_key_signature")})
        plain.in_session = False
        patched.setattr(type(station.datasheets), "reading", lambda *_: plain)
        assert recalled(station, board) == (False, 1), "what was read plainly is a hint"
    with monkeypatch.context() as patched:
        patched.setattr(type(station.datasheets), "datasheet", lambda *_: None)
        assert recalled(station, board) == (False, 1)
    with monkeypatch.context() as patched:
        patched.setattr(type(station.keys), "held", lambda *_: [])
        assert recalled(station, board) == (False, 1), "no session will follow"


def test_a_node_in_factory_state_shows_its_key_anew(station: Station, board: Board) -> None:
    provision(station, board)
    board.tim.reset_by_hand()
    assert board.state.state == NodeState.FACTORY
    assert recalled(station, board) == (False, 1)


def test_a_board_that_cannot_prove_the_key_of_the_last_reading_is_read_and_held_against_the_pin(
    station: Station, board: Board
) -> None:
    provision(station, board)
    clone = Board(board.uuid)
    clone.flash.state = replace(clone.state, key=board.state.key, station=board.state.station, ca=board.state.ca)
    clone.power_on()
    link = MemoryLink(clone)
    with talk(clone, link) as node, pytest.raises(KeyMismatchError):
        examine(station, node, recall=True)
    assert any(frame.startswith(READ_SECURITY) for frame in link.frames)


@pytest.mark.parametrize(
    ("blocks", "described"),
    [
        ({1: {"MaxChan": 3}, 12: {"TCName": "finger"}}, Description("finger", 3)),
        ({12: {"TCName": "finger"}}, Description("finger", 0)),
        ({1: {"MaxChan": 3}}, Description(None, 3)),
        ({}, Description(None, 0)),
        ({1: {"MaxChan": 2}, 12: {"TCName": "a\x1bb"}}, Description("a\ufffdb", 2)),
    ],
)
def test_what_a_node_says_of_itself(
    monkeypatch: pytest.MonkeyPatch, blocks: dict[int, dict[str, Any]], described: Description
) -> None:
    def read_block(_node: object, block: tuple[int, int]) -> bytes:
        if block[1] not in blocks:
            raise NodeRefusedError("no such TEDS", reason=Reason.NO_SUCH_TEDS)
        return bytes([block[1]])

    monkeypatch.setattr(step, "read_block", read_block)
    monkeypatch.setattr(teds, "decode", lambda octets: blocks[octets[0]])
    assert describe(cast("Any", None)) == described
