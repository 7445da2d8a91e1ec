"""Opening a session from the station's side: another station's Open may come between (profile section 4)."""

from __future__ import annotations

import pytest

from teds_provision.errors import LinkError, NodeRefusedError
from teds_provision.protocol.keys import Credentials, SoftwareKey, station_key_message
from teds_provision.protocol.messages.frames import Function, Reason, decode_reply, read_teds, security_command
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.wire_agreement import StationAgreement
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.teds_read import read_identity
from teds_provision.teds.image import SECURITY
from tests.bench import Board, MemoryLink, contact, talk

STATION, CA = SoftwareKey(5), SoftwareKey(3)


def keyed(board: Board) -> bytes:
    """Agree a key with the board; returns K."""
    agreement = StationAgreement(
        Credentials(STATION, CA.sign(station_key_message(STATION.point)), CA.point), board.uuid
    )
    reply = board.tim.handle(agreement.request().encode(), link="nfc", tapped=True)
    agreed = agreement.accept(decode_reply(reply).payload, board.state.security_teds(), pinned=None, epoch=0)
    board.tim.handle(agreed.confirm.encode(), link="nfc", tapped=True)
    return agreed.key


class FasterStation(MemoryLink):
    """A link on which another station opens a session whenever this one has just asked for c; so many times."""

    def __init__(self, board: Board, key: bytes, times: int) -> None:
        super().__init__(board, via="can", tapped=False)
        self._key, self._times = key, times

    def exchange(self, frame: bytes) -> bytes:
        reply = super().exchange(frame)
        if frame == security_command(Function.OPEN).encode() and self._times:
            self._times -= 1
            session = StationSession(self._key, self.board.uuid)
            opened = session.open(decode_reply(reply).payload).encode()
            assert decode_reply(self.board.tim.handle(opened, link="can:f2", tapped=False)).ok
        return reply


def test_an_open_that_came_second_is_tried_once_more(board: Board) -> None:
    key = keyed(board)
    with talk(board, FasterStation(board, key, times=1)) as node:
        node.open(key)
        assert node.sealed
        node.request(security_command(Function.IDENTIFY), "to identify")


def test_what_a_node_said_in_a_session_is_asked_again_in_the_next(board: Board) -> None:
    key = keyed(board)
    with talk(board) as node:
        for end in (node.forget, node.leave):
            node.open(key)
            assert node.proven is None
            assert read_identity(node) == node.proven
            end()


def test_what_a_node_said_bounds_it_in_a_session_under_the_same_key(board: Board) -> None:
    key = keyed(board)
    with talk(board) as node:
        node.open(key)
        said = read_identity(node)
        first = node.open_counter
        node.reopen()
        assert node.sealed
        assert node.open_counter != first
        assert node.proven == said


def test_after_the_second_refusal_the_operator_is_told(board: Board) -> None:
    key = keyed(board)
    link = FasterStation(board, key, times=2)
    with talk(board, link) as node:
        with pytest.raises(NodeRefusedError) as caught:
            node.open(key)
        assert caught.value.reason == Reason.BAD_TAG
        assert not node.sealed
    assert link.count == 4


def test_an_unknown_key_is_not_tried_twice(board: Board) -> None:
    keyed(board)
    link = MemoryLink(board)
    with talk(board, link) as node:
        with pytest.raises(NodeRefusedError) as caught:
            node.open(bytes(16))
        assert caught.value.reason == Reason.UNKNOWN_KEY
    assert link.count == 2


class DisturbedLink(MemoryLink):
    """A bus on which an octet of some requests is changed on the way: ``at`` are their numbers, ``octet`` which one."""

    def __init__(self, board: Board, at: set[int], octet: int) -> None:
        super().__init__(board, via="can", tapped=False)
        self._at, self._octet = at, octet

    def exchange(self, frame: bytes) -> bytes:
        changed = bytearray(frame)
        if self.count + 1 in self._at:
            changed[self._octet] ^= 0x40
        return super().exchange(bytes(changed))


@pytest.mark.parametrize(("octet", "what"), [(6, "keyId"), (20, "Es"), (5, "the length")])
def test_an_open_that_was_disturbed_on_a_bus_is_tried_once_more(board: Board, octet: int, what: str) -> None:
    key = keyed(board)
    with talk(board, DisturbedLink(board, {2}, octet)) as node:
        node.open(key)
        assert node.sealed, what


def test_a_refusal_of_a_plain_question_on_a_bus_counts_when_it_comes_twice(board: Board) -> None:
    """A disturbed octet made of "read TEDS 128" another one, which the node does not have: no word of the node's."""
    question = read_teds(*SECURITY, 0)
    with talk(board, DisturbedLink(board, {1}, 6)) as node:
        assert node.request_idempotent(question, "to read") == node.request_idempotent(question, "to read")
    link = DisturbedLink(board, {1, 2}, 6)
    with talk(board, link) as node, pytest.raises(NodeRefusedError):
        node.request_idempotent(question, "to read")
    assert link.count == 2


def test_a_request_that_was_disturbed_on_a_bus_is_sent_once_more(board: Board) -> None:
    link = DisturbedLink(board, {1}, 80)  # an octet of field 104
    link.tapped = True  # a node that was built without NFC, in factory state
    agreement = StationAgreement(
        Credentials(STATION, CA.sign(station_key_message(STATION.point)), CA.point), board.uuid
    )
    with talk(board, link) as node:
        reply = node.request_retry_once(agreement.request(), "the key agreement")
    assert agreement.accept(reply, board.state.security_teds(), pinned=None, epoch=0).epoch == 1
    assert link.count == 2


def test_a_node_that_stays_busy_is_asked_for_one_patience_and_no_new_session_is_opened(
    board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of three sessions had a patience of its own: `verify` waited for half a minute."""
    monkeypatch.setattr("teds_provision.provisioning.conversation.BUSY_PAUSE", 0.001)
    key = keyed(board)
    sealed = bytes([0, 0, 128, Function.SEALED])

    def busy(number: int, reply: bytes) -> bytes:
        return bytes([0, 0, 1, Reason.BUSY]) if link.frames[number - 1].startswith(sealed) else reply

    link = MemoryLink(board, via="can", tapped=False, tamper=busy)
    with Conversation(contact(board, link), notice=lambda _notice: None, busy_seconds=0.05) as node:
        node.open(key)
        with pytest.raises(NodeRefusedError) as caught:
            node.request_idempotent(security_command(Function.LIST), "to list its TEDS")
        assert caught.value.reason == Reason.BUSY
        node.forget()
    asked = [frame.startswith(sealed) for frame in link.frames]
    assert asked.index(True) == 2, "asked for c, then Open"
    assert sum(asked) >= 2, "it may have been for a moment"
    assert all(asked[2:])


@pytest.mark.parametrize(
    ("via", "answers", "lives"), [("can", True, True), ("can", False, False), ("nfc", True, False)]
)
def test_after_a_lost_message_a_node_on_a_bus_is_asked_whether_it_lives(
    board: Board, via: str, answers: bool, lives: bool
) -> None:
    """At a reader it is not: who does not answer there has left the field."""

    class Silent(MemoryLink):
        def exchange(self, frame: bytes) -> bytes:
            if not answers:
                raise LinkError("No answer.")
            return super().exchange(frame)

    link = Silent(board, via=via, tapped=via == "nfc")
    with talk(board, link) as node:
        assert node.is_alive() is lives
    assert link.count == int(via == "can" and answers)
