"""One node's commands, seen from the station: how long it is patient, when it opens again, what it leaves behind."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import GarbledError, LinkError, NodeRefusedError, NodeSilentError, NotAuthenticError
from teds_provision.links import Contact, Notice
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.messages.frames import Function, Reason, Reply, security_command
from teds_provision.protocol.messages.identity import Identity
from teds_provision.protocol.session import StationSession
from teds_provision.provisioning import conversation
from teds_provision.provisioning.conversation import Conversation, SessionLostError, came_under_key, is_busy, refused
from tests.bench import Board, MemoryLink, contact, talk

from .test_opening import keyed

IDENTIFY = security_command(Function.IDENTIFY)


@dataclass
class ScriptedLink(MemoryLink):
    """A board's link on which the next exchanges are answered by ``script``: a reply, or an error; None: the board."""

    script: list[bytes | Exception | None] = field(default_factory=list)
    closed: int = 0
    deadlines: list[float] = field(default_factory=list)

    def exchange(self, frame: bytes) -> bytes:
        answer = self.script.pop(0) if self.script else None
        if answer is None:
            return super().exchange(frame)
        self.frames.append(frame)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def exchange_within(self, frame: bytes, seconds: float) -> bytes:
        self.deadlines.append(seconds)
        return self.exchange(frame)

    def resend(self, frame: bytes) -> bytes:
        return self.exchange(frame)

    def close(self) -> None:
        self.closed += 1
        super().close()


def refusal(reason: Reason) -> bytes:
    return Reply(False, bytes([reason])).encode()


def on_bus(board: Board, *script: bytes | Exception | None) -> ScriptedLink:
    return ScriptedLink(board, via="can", tapped=False, script=list(script))


def in_session(board: Board, link: ScriptedLink, **more: Any) -> Conversation:
    made = Conversation(contact(board, link), notice=lambda _notice: None, **more)
    made.open(keyed(board))
    return made


class StoppedClock:
    """The module ``time``: sleeping is all that takes time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.slept: list[float] = []
        monkeypatch.setattr(conversation, "time", self)

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds


@pytest.mark.parametrize(("patience", "pauses"), [(None, 40), (1.0, 4), (0.0, 0)])
def test_a_busy_node_is_asked_four_times_a_second_for_ten_seconds_or_what_patience_there_is(
    board: Board, monkeypatch: pytest.MonkeyPatch, patience: float | None, pauses: int
) -> None:
    clock = StoppedClock(monkeypatch)
    notices: list[Notice] = []
    link = on_bus(board, *[refusal(Reason.BUSY)] * 60)
    node = Conversation(contact(board, link), notice=notices.append, busy_seconds=patience)
    with pytest.raises(NodeRefusedError) as refused_by:
        node.request_plain(IDENTIFY, "to say who it is")
    assert is_busy(refused_by.value)
    assert clock.slept == [0.25] * pauses
    assert len(link.frames) == pauses + 1
    assert [notice.text for notice in notices] == ["The node is busy with another station"] * pauses
    assert [notice.seconds for notice in notices[:1]] == [10.0 if patience is None else patience][: min(pauses, 1)]


def test_an_order_with_a_deadline_is_sent_once_and_with_its_deadline_where_the_link_has_one(board: Board) -> None:
    link = on_bus(board)
    node = in_session(board, link)
    node.request(IDENTIFY, "x", within=1.5)
    node.request(IDENTIFY, "x")
    assert link.deadlines == [1.5]
    link.script, before = [refusal(Reason.BUSY)] * 3, len(link.frames)
    with pytest.raises(SessionLostError):
        node.request(IDENTIFY, "x", within=1.5)
    assert len(link.frames) == before + 1, "no later"


@pytest.mark.parametrize(
    ("via", "error", "tries"),
    [
        ("can", NodeSilentError("gone"), 6),
        ("can", GarbledError("torn"), 41),
        ("nfc", NodeSilentError("gone"), 1),
        ("can", LinkError("no bus"), 1),
        ("can", NotAuthenticError("wrong tag"), 1),
    ],
)
def test_how_often_a_command_that_does_no_harm_is_sent(board: Board, via: str, error: Exception, tries: int) -> None:
    link = ScriptedLink(board, via=via, tapped=via == "nfc")
    link.script = [step for _ in range(60) for step in (error, None)]  # each time it is asked whether it lives
    with talk(board, link) as node:
        with pytest.raises(type(error)):
            node.request_idempotent(security_command(Function.LIST), "to list its TEDS")
        asked = link.frames.count(security_command(Function.LIST).encode())
        link.script = []
    assert asked == tries


def test_a_mute_node_is_not_asked_again(board: Board) -> None:
    link = on_bus(board, NodeSilentError("first"), NodeSilentError("and mute"))
    with talk(board, link) as node, pytest.raises(NodeSilentError, match="first"):
        node.request_idempotent(security_command(Function.LIST), "to list its TEDS")
    assert len(link.frames) == 2


def test_a_command_is_repeated_for_a_minute(board: Board, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = StoppedClock(monkeypatch)
    link = on_bus(board, *[step for _ in range(20) for step in (GarbledError("torn"), None)])
    tries = 0

    def slow(frame: bytes) -> bytes:
        nonlocal tries
        tries += 1
        clock.now += 8.0  # and 8 s for the question whether it lives
        return ScriptedLink.exchange(link, frame)

    monkeypatch.setattr(link, "exchange", slow)
    node = talk(board, link)
    with pytest.raises(GarbledError):
        node.request_idempotent(security_command(Function.LIST), "to list its TEDS")
    assert tries == 9, "torn at 8, 24, 40 and 56 s it is asked whether it lives; at 72 s it is enough"


def test_a_session_that_is_lost_is_opened_twice_again_and_no_more(board: Board) -> None:
    link = on_bus(board)
    node = in_session(board, link)
    opened = 0
    key = node._key

    def lose(command: object, doing: str, **_more: object) -> bytes:
        raise SessionLostError(refused(12, doing))

    def reopen() -> None:
        nonlocal opened
        opened += 1

    node.request = lose  # type: ignore[assignment]
    node.reopen = reopen  # type: ignore[method-assign]
    with pytest.raises(NodeRefusedError, match="a tag is wrong"):
        node.request_idempotent(IDENTIFY, "to say who it is")
    assert opened == 2
    assert node._key == key


def test_a_session_that_is_opened_again_refuses_the_same_static_keys(
    board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    """P(station) and P(node), of which a one-time key is none; without them at the first Open, none are known."""
    asked: list[tuple[bytes, ...]] = []

    class Noting(StationSession):
        def __init__(self, key: bytes, uuid: bytes, *, statics: tuple[bytes, ...] = ()) -> None:
            asked.append(statics)
            super().__init__(key, uuid, statics=statics)

    monkeypatch.setattr(conversation, "StationSession", Noting)
    statics = (SoftwareKey(5).point, board.key.point)
    node = Conversation(contact(board, on_bus(board)), notice=lambda _notice: None)
    key = keyed(board)
    node.open(key)
    node.open(key, statics=statics)
    node.reopen()
    assert asked == [(), statics, statics]


def test_a_reply_that_does_not_open_counts_as_a_lost_session(board: Board) -> None:
    link = on_bus(board)
    node = in_session(board, link)
    link.script = [Reply(True, payload=bytes(40)).encode()]
    with pytest.raises(SessionLostError):
        node.request(IDENTIFY, "x")
    assert node.request_idempotent(IDENTIFY, "x") == board.tim.identity().encode()


@pytest.mark.parametrize(
    "error",
    [
        NodeSilentError("gone"),
        refusal(Reason.WRONG_STATE),
        Reply(True, payload=bytes(40)).encode(),
        LinkError("no bus"),
    ],
)
def test_a_conversation_that_ends_well_closes_its_session_whatever_the_node_says(
    board: Board, error: bytes | Exception
) -> None:
    link = on_bus(board)
    with in_session(board, link) as node:
        released: list[str] = []
        node._release = lambda: released.append("given back")
        link.script, before = [error], len(link.frames)
    assert len(link.frames) == before + 1
    assert (node.sealed, link.closed, released) == (False, 1, ["given back"])
    node.leave()
    assert len(link.frames) == before + 1, "nothing is open any more"


def test_a_node_that_refuses_in_its_session_to_close_it_is_left_too(board: Board) -> None:
    node = in_session(board, on_bus(board))

    def refuse(_command: object, doing: str) -> bytes:
        raise refused(2, doing, sealed=True)

    node.request = refuse  # type: ignore[assignment]
    node.leave()
    assert not node.sealed


def test_a_conversation_that_ends_in_an_error_says_nothing_to_the_node_and_gives_the_port_back(board: Board) -> None:
    link = on_bus(board)
    released: list[str] = []
    node = in_session(board, link)
    node._release = lambda: released.append("given back")
    before = len(link.frames)
    with pytest.raises(KeyError), node:
        raise KeyError
    assert (len(link.frames), link.closed, released) == (before, 1, ["given back"])


def test_what_is_forgotten_with_a_session_and_what_stays(board: Board) -> None:
    node = in_session(board, on_bus(board))
    node.proven = board.tim.identity()
    counter = node.open_counter
    node.forget()
    assert (node.sealed, node.proven, node._key, node.open_counter) == (False, None, None, counter)


def test_a_conversation_goes_on_with_the_same_node_on_another_link(board: Board) -> None:
    reader, bus = ScriptedLink(board), on_bus(board)
    order: list[str] = []
    node = Conversation(contact(board, reader), notice=lambda _notice: None)
    node.open(keyed(board))
    found = contact(board, bus)
    assert (node.tapped, node.wired) == (True, False)
    assert found.identity == Identity.decode(board.tim.identity().encode())

    def find() -> Contact:
        order.append(f"found with {reader.closed} closed and {'a' if node.sealed else 'no'} session")
        return found

    node.move_to(find, lambda: order.append("given back"))
    assert order == ["found with 1 closed and no session"]
    assert (node.identity is found.identity, node.sealed, node.tapped, node.wired) == (True, True, False, True)
    assert node.request(IDENTIFY, "x")
    with node:
        pass
    assert (order[1:], bus.closed, reader.closed) == (["given back"], 1, 1)


def caused_by(error: BaseException, context: BaseException) -> BaseException:
    error.__context__ = context
    return error


@pytest.mark.parametrize(
    ("error", "vouched"),
    [
        (refused(5, "x", sealed=True), True),
        (refused(5, "x"), False),
        (NodeSilentError("x"), False),
        (LinkError("x"), False),
        (NotAuthenticError("x"), True),
        (SessionLostError(NotAuthenticError("x")), False),
        (caused_by(NotAuthenticError("x"), SessionLostError(LinkError("x"))), False),
        (caused_by(NotAuthenticError("x"), ValueError("x")), True),
    ],
)
def test_which_errors_are_the_nodes_own(error: BaseException, vouched: bool) -> None:
    assert came_under_key(error) is vouched


REASONS = {
    1: ("it does not know the command", ""),
    2: ("its state does not allow that now", ""),
    3: ("this is not permitted here (a tap or a session is needed)", "Tap the node on the NFC reader (--via nfc)"),
    17: ("it is busy, or another station claims what is asked for", "Try again in a moment; mode UUID shows which"),
}


def test_a_refusal_in_whole_words() -> None:
    for number, (meaning, cure) in REASONS.items():
        error = refused(number, "to do it")
        assert error.message == f"Not verified: the node refuses to do it: {meaning} (reason {number})."
        assert error.hint.startswith(cure)
        assert bool(error.hint) == bool(cure)
        assert (error.reason, error.sealed) == (number, False)
        own = refused(number, "to do it", sealed=True)
        assert own.message == f"The node refused to do it: {meaning} (reason {number})."
        assert own.sealed
    for unknown, kept in ((200, 200), (None, 0)):
        strange = refused(unknown, "to do it", sealed=True)
        assert strange.message == f"The node refused to do it without a known reason ({unknown})."
        assert (strange.reason, strange.hint) == (kept, "")


def test_what_a_trace_gets_of_a_sealed_command_and_its_reply(board: Board) -> None:
    noted: list[tuple[object, ...]] = []
    link = on_bus(board)
    node = in_session(board, link)
    trace: Any = SimpleNamespace()
    node.contact = SimpleNamespace(  # type: ignore[assignment]
        link=link,
        trace=trace,
        note=lambda way, octets, _words, *, sealed=False, opened=None: noted.append((way, octets[0], sealed, opened)),
    )
    plain = board.tim.identity().encode()
    node.request(IDENTIFY, "x")
    assert [(way, sealed) for way, _, sealed, _ in noted] == [("out", True), ("in", True)]
    assert noted[0][3] == IDENTIFY.encode()
    assert noted[1][3] == Reply(True, payload=plain).encode()
    noted.clear()
    link.script = [refusal(Reason.WRONG_STATE)]
    with pytest.raises(SessionLostError):
        node.request(IDENTIFY, "x")
    assert [(way, sealed) for way, _, sealed, _ in noted] == [("out", True), ("in", False)], "a refusal in plain"
    noted.clear()
    link.script = [Reply(True, payload=bytes(24)).encode()]
    with pytest.raises(SessionLostError):
        node.request(IDENTIFY, "x")
    assert [(way, sealed, opened) for way, _, sealed, opened in noted] == [
        ("out", True, IDENTIFY.encode()), ("in", True, None)
    ], "a reply with a wrong tag is sealed, and not opened"  # fmt: skip
    noted.clear()
    node.forget()
    node.request(IDENTIFY, "x")
    assert [(way, sealed, opened) for way, _, sealed, opened in noted] == [("out", False, None), ("in", False, None)]
