"""An attacker on the bus without the key: he forges Identify, relays Prove to the real node, serves what he recorded.

Where a key is held, no session means no verdict (contract: cli.md, "Rules for them"; profile: security-teds.md
sections 1 and 4).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import pytest

from teds_provision.errors import (
    AddressConflictError,
    NodeRefusedError,
    NotAuthenticError,
    PolicyError,
    TedsProvisionError,
    UnprovenError,
)
from teds_provision.links import Contact, LinkSettings, Notice
from teds_provision.links.ports import CAN, Capabilities
from teds_provision.protocol.messages.frames import COMMON, Function, Reason, Reply, refusal, security_command
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.provisioning.agree import proof_of_reset, require_session
from teds_provision.provisioning.conversation import Conversation, SessionLostError, came_under_key, refused
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.meeting import drop_duplicate_uuids, refuse_duplicate_uuids
from teds_provision.provisioning.read import ReadReport, read_at
from teds_provision.provisioning.verify import require_authentic
from teds_provision.provisioning.verify_node import verify_at, verify_at_node
from teds_provision.provisioning.visit import NodeVisit
from teds_provision.shapes.verdict import Verification
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry
from teds_provision.teds.image import SECURITY, Image
from tests.bench import Board, MemoryLink, contact, make_station, talk

from .test_provision import ANGLE, SilentReporter, run

FORGED_ADDRESS = 99


@dataclass
class Attacker:
    """Answers in the place of ``board``: its own Identify, recorded TEDS, a refusal to open; Prove it relays."""

    board: Board
    recorded: Image
    state: NodeState = NodeState.FACTORY
    reason: Reason = Reason.WRONG_STATE
    via: str = "can"
    capabilities: Capabilities = CAN
    asked: list[int] = field(default_factory=list)

    @property
    def identity(self) -> Identity:
        return replace(self.board.tim.identity(), state=self.state, can_address=FORGED_ADDRESS)

    def exchange(self, octets: bytes) -> bytes:
        function, payload = octets[3], octets[6:]
        self.asked.append(function)
        if octets[2] == COMMON:
            code, offset = payload[0], int.from_bytes(payload[1:5], "big")
            teds = self.recorded.blocks[int.from_bytes(octets[:2], "big"), code]
            return Reply(True, offset.to_bytes(4, "big") + teds[offset : offset + 900]).encode()
        listed = b"".join(channel.to_bytes(2, "big") + bytes([code]) for channel, code in sorted(self.recorded))
        answers: dict[int, Callable[[], bytes]] = {
            Function.IDENTIFY: lambda: Reply(True, self.identity.encode()).encode(),
            Function.LIST: lambda: Reply(True, listed).encode(),
            Function.PROVE: lambda: self.board.tim.handle(octets, link="can", tapped=False),
            Function.RESET: lambda: self.board.tim.handle(octets, link="can", tapped=False),
        }
        return answers.get(function, lambda: refusal(self.reason).encode())()

    def close(self) -> None:
        """Nothing to leave."""


def looked_at(station: Station, attacker: Attacker) -> Verification:
    node = Conversation(Contact(attacker.identity, attacker, address=FORGED_ADDRESS), notice=lambda notice: None)
    with node:
        return verify_at_node(station, node, identify(station, node)).verified


@pytest.mark.parametrize("state", list(NodeState))
@pytest.mark.parametrize("reason", [Reason.WRONG_STATE, Reason.UNKNOWN_KEY, Reason.NOT_PERMITTED])
def test_the_very_datasheet_of_the_node_without_a_session_is_unproven(
    station: Station, board: Board, state: NodeState, reason: Reason
) -> None:
    recorded = run(station, board).image
    before = station.nodes.get(board.uuid)
    attacker = Attacker(board, recorded, state, reason)
    verified = looked_at(station, attacker)
    assert verified.verdict == "unproven"
    with pytest.raises(UnprovenError) as caught:
        require_authentic(verified)
    assert caught.value.exit_code == 5
    assert (Function.RESET in attacker.asked) == (state == NodeState.FACTORY)
    after = station.nodes.get(board.uuid)
    assert before is not None
    assert after is not None
    assert replace(after, last_seen=before.last_seen) == before, "nothing of this is believed, its address least of all"


def test_an_old_datasheet_without_a_session_is_not_authentic(station: Station, board: Board) -> None:
    old = run(station, board).image
    run(station, board, order=replace(ANGLE, name="renamed"))
    verified = looked_at(station, Attacker(board, old))
    assert verified.verdict == "not authentic"
    with pytest.raises(NotAuthenticError, match="sequence 1 is older than the 2"):
        require_authentic(verified)


def test_if_no_key_is_held_the_stores_own_values_still_count(station: Station, board: Board) -> None:
    old = run(station, board).image
    new = run(station, board, order=replace(ANGLE, name="renamed")).image
    station.keys.remove(board.uuid)
    assert looked_at(station, Attacker(board, new)).verdict == "authentic"
    assert looked_at(station, Attacker(board, old)).verdict == "not authentic"
    assert looked_at(station, Attacker(board, new)).verdict == "authentic", "the old one was not remembered"


def test_a_forged_initial_teds_does_not_raise_what_a_node_must_show(station: Station, board: Board) -> None:
    """106 and 107 of an unsigned TEDS are anyone's: remembered, they would lock the real datasheet out for ever."""
    initial = board.state.security_teds()
    from teds_provision.teds.codec import security

    forged = replace(security.decode(initial), sequence=2**32 - 1, key_epoch=2**32 - 1).encode()
    assert looked_at(station, Attacker(board, Image(board.uuid, {SECURITY: forged}))).verdict == "unsigned"
    assert run(station, board).verified.verdict == "authentic"


def test_a_node_that_was_reset_shows_it_by_its_signature(station: Station, board: Board) -> None:
    run(station, board)
    board.tim.reset_by_hand()
    with talk(board) as node:
        verified = verify_at_node(station, node, identify(station, node)).verified
    assert verified.verdict == "unsigned"
    (check,) = [check for check in verified.checks if check.name == "session"]
    assert (check.result, "was reset" in check.why) == ("passed", True)


def test_a_proof_of_reset_with_another_key_is_none(station: Station, board: Board) -> None:
    board.tim.reset_by_hand()
    with talk(board) as node, pytest.raises(NotAuthenticError):
        proof_of_reset(node, Board().key.point)


def test_in_its_session_a_node_is_held_against_what_this_station_saw(station: Station, board: Board) -> None:
    """A flash put back from a copy, sequence and epoch with it: the node agrees with its own old datasheet."""
    run(station, board)
    copy = board.state
    newer = run(station, board, order=replace(ANGLE, name="renamed")).image
    board.flash.state = copy
    board.power_on()
    with talk(board) as node:
        verified = verify_at_node(station, node, identify(station, node)).verified
    assert verified.verdict == "not authentic"
    assert [check.name for check in verified.checks if check.result == "failed"] == ["sequence"]
    assert station.datasheets.datasheet(board.uuid) == newer, "what it had stays known"


def test_one_uuid_at_two_addresses_is_a_conflict_that_names_both(board: Board) -> None:
    here, there = (replace(contact(board, MemoryLink(board, via="can")), address=at) for at in (0x11, 0x22))
    with pytest.raises(AddressConflictError, match=f"{board.uuid.hex()} answers at 0x11 and at 0x22"):
        refuse_duplicate_uuids([here, there])
    other = replace(contact(Board(uuid=bytes(10))), address=0x22)
    assert refuse_duplicate_uuids([here, other]) == [here, other]


def test_a_copied_uuid_costs_its_own_node_alone(board: Board) -> None:
    """One stranger with somebody's UUID had hidden every node of the bus from `identify` and `provision --all`."""
    here, there = (replace(contact(board, MemoryLink(board, via="can")), address=at) for at in (0x11, 0x22))
    other = replace(contact(Board(uuid=bytes(10))), address=0x33)
    notices: list[Notice] = []
    assert drop_duplicate_uuids([here, other, there], notices.append) == [other]
    assert [notice.uuid for notice in notices] == [board.uuid]
    with pytest.raises(AddressConflictError):
        drop_duplicate_uuids([here, there], notices.append)


def test_a_stranger_without_the_key_judges_by_signatures(station: Station, board: Board, tmp_path) -> None:  # type: ignore[no-untyped-def]
    recorded = run(station, board).image
    stranger = make_station(tmp_path / "stranger")
    verified = looked_at(stranger, Attacker(board, recorded, NodeState.PROVISIONED))
    assert verified.verdict == "not authentic"


def test_a_refused_challenge_is_unproven_and_no_error_if_a_key_is_held(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(station, board)

    def refuses(*_: object, **__: object) -> Iterator[None]:
        raise refused(Reason.BUSY, "to prove its key")
        yield

    monkeypatch.setattr("teds_provision.provisioning.verify_node.at_node", contextmanager(refuses))
    done = verify_at(station, LinkSettings(), board.uuid.hex(), SilentReporter())
    assert (done.verified.verdict, type(done.error)) == ("unproven", UnprovenError)

    stranger = bytes(9) + b"\1"
    with pytest.raises(NodeRefusedError):
        verify_at(station, LinkSettings(), stranger.hex(), SilentReporter())


def test_read_needs_a_session_or_a_proof_of_reset_if_a_key_is_held(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = run(station, board).image

    def met(node: Conversation) -> None:
        @contextmanager
        def at(*_: object, **__: object) -> Iterator[NodeVisit]:
            with node:
                yield NodeVisit(station, node, identify(station, node))

        monkeypatch.setattr("teds_provision.provisioning.read.at_node", at)

    def read() -> ReadReport:
        return read_at(station, LinkSettings(), board.uuid.hex(), SilentReporter())

    attacker = Attacker(board, recorded)
    met(Conversation(Contact(attacker.identity, attacker, address=FORGED_ADDRESS), notice=lambda notice: None))
    forged = read()
    assert (forged.image, type(forged.error)) == (recorded, UnprovenError)
    met(talk(board))
    assert read().error is None, "in a session"
    board.tim.reset_by_hand()
    met(talk(board))
    assert read().error is None, "its signature shows that it was reset"


def test_an_unknown_key_does_not_move_last_seen_over_a_bus(station: Station, board: Board) -> None:
    """Whoever answers on a bus may sign with a key of his own as long as the UUID is pinned to none."""
    station.pins.put(WhitelistEntry(board.uuid, None))
    with talk(board, MemoryLink(board, via="can")) as node:
        identify(station, node)
    assert station.nodes.get(board.uuid) is None
    with talk(board) as node:
        identify(station, node)
    tapped = station.nodes.get(board.uuid)
    assert tapped is not None
    assert tapped.last_seen is not None


def test_a_session_moves_last_seen(station: Station, board: Board) -> None:
    run(station, board)
    station.nodes.remember(board.uuid, last_seen="2020-01-01T00:00:00Z")
    with talk(board, MemoryLink(board, via="can")) as node:
        verify_at_node(station, node, identify(station, node))
    known = station.nodes.get(board.uuid)
    assert known is not None
    assert str(known.last_seen) > "2026"


def test_a_refusal_outside_a_session_is_reported_as_not_proven(station: Station, board: Board) -> None:
    run(station, board)
    board.flash.state = replace(board.flash.state, key=bytes(16))
    board.power_on()
    with talk(board) as node, pytest.raises(PolicyError, match="proves nothing"):
        require_session(station, node)
    with talk(board) as node, pytest.raises(NodeRefusedError, match="Not verified"):
        node.request_plain(security_command(Function.CLOSE), "to close")


def test_a_refusal_in_a_session_is_the_nodes_own_word(station: Station, board: Board) -> None:
    run(station, board)
    with talk(board) as node:
        require_session(station, node)
        with pytest.raises(NodeRefusedError, match="The node refused to do the unknown") as refusal:
            node.request(security_command(99), "to do the unknown")
    assert came_under_key(refusal.value)


@pytest.mark.parametrize(
    "plain_reply", [refusal(Reason.NOT_PERMITTED), refusal(Reason.BAD_TAG), Reply(True, bytes(40))]
)
def test_no_plain_answer_in_a_session_is_the_nodes_own_word(station: Station, board: Board, plain_reply: Reply) -> None:
    """A second board at its address says so, or any other device; opened again, it says so again."""
    run(station, board)
    heard = False

    def second_board(_count: int, reply: bytes) -> bytes:
        return plain_reply.encode() if heard else reply

    with talk(board, MemoryLink(board, tamper=second_board)) as node:
        require_session(station, node)
        heard = True
        with pytest.raises(SessionLostError) as lost:
            node.request(security_command(99), "to do the unknown")
        assert not came_under_key(lost.value)
        with pytest.raises(TedsProvisionError) as given_up:
            node.request_idempotent(security_command(99), "to do the unknown")
        assert not came_under_key(given_up.value)


@pytest.mark.parametrize("answer", [bytes(64), b"", b"the wrong signature".ljust(64)])
def test_who_does_not_prove_the_key_that_he_shows_is_not_identified(
    station: Station, board: Board, answer: bytes
) -> None:
    """The TEDS of a node on another chip: the public key is there, and nothing signs a fresh challenge."""

    def forged(_count: int, reply: bytes) -> bytes:
        return Reply(True, answer).encode() if len(reply) == 3 + 64 else reply

    with (
        talk(board, MemoryLink(board, tamper=forged)) as node,
        pytest.raises(NotAuthenticError, match="cannot prove that it holds the key"),
    ):
        identify(station, node)
    assert station.nodes.get(board.uuid) is None
