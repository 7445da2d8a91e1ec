"""The connection of a simulation without a service: who gets one, what passes in either direction, and what ends it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.websockets import WebSocketDisconnect, WebSocketState

from teds_provision.errors import LinkError, NodeBusyError, NotFoundError, TedsProvisionError
from teds_provision.ncap.nodes.simulation import CheckedLines, FedChannel, Feed
from teds_provision.ncap.nodes.virtual import Virtual
from teds_provision.ncap.web import simulation
from teds_provision.ncap.web.guard import CALLER, Caller, RequestRefusedError
from teds_provision.ncap.web.simulation import _connected, _Session, feeding
from teds_provision.node.sources.base import SourceChannel
from tests.pace import PATIENCE

GONE: list[Exception] = [WebSocketDisconnect(1001), RuntimeError("closed"), ConnectionResetError()]
OPENING = FedChannel(SourceChannel(2, "opening", 0.0, 110.0), "mm")


class MockSocket:
    """A client's WebSocket: it receives ``messages`` and keeps what is sent and how it is closed."""

    def __init__(self, *messages: Any, caller: Caller | None = None) -> None:
        self.messages, self.sent, self.closed = list(messages), list[Any](), list[tuple[int, str]]()
        self.client_state = self.application_state = WebSocketState.CONNECTED
        self.scope, self.path_params = {CALLER: caller}, {"name": "hand"}
        self.fails: Exception | None = None

    async def accept(self) -> None:
        self.sent.append("accepted")

    async def send_json(self, found: Any) -> None:
        if self.fails is not None:
            raise self.fails
        self.sent.append(found)

    async def receive(self) -> Any:
        if not self.messages:
            await asyncio.Event().wait()
        message = self.messages.pop(0)
        if isinstance(message, Exception):
            raise message
        return message

    async def close(self, code: int, why: str) -> None:
        if self.fails is not None:
            raise self.fails
        self.closed.append((code, why))


class MockWriter:
    """The way to the node's process."""

    def __init__(self) -> None:
        self.octets, self.drained, self.ended = b"", 0, 0

    def write(self, octets: bytes) -> None:
        self.octets += octets

    async def drain(self) -> None:
        self.drained += 1

    def close(self) -> None:
        self.ended += 1


def session_of(socket: MockSocket, writer: MockWriter | None = None, feed: Feed | None = None) -> _Session:
    given: Any = (socket, feed or Feed("api:sim", lambda: None), [OPENING], writer or MockWriter())
    return _Session(*given)


def finished(work: Callable[[], Awaitable[Any]]) -> Any:
    async def soon() -> Any:
        return await asyncio.wait_for(work(), PATIENCE)

    return asyncio.run(soon())


# -- from the node to the simulation -----------------------------------------------------------------------------------


def acted(socket: MockSocket, octets: bytes) -> list[Any]:
    """Return what the simulation gets when the node's process gives ``octets`` and ends."""

    async def act() -> None:
        reader = asyncio.StreamReader()
        reader.feed_data(octets)
        reader.feed_eof()
        await session_of(socket)._act(reader)

    finished(act)
    return socket.sent


def test_the_simulation_gets_each_line_of_the_node_until_its_process_ends() -> None:
    assert acted(MockSocket(), b'{"set": {"opening": 0.5}}\n{"set": {"opening": null}}\n') == [
        {"set": {"opening": 0.5}},
        {"set": {"opening": None}},
    ]


@pytest.mark.parametrize("line", [b"no JSON\n", b"\xff\n", b"x" * 70_000 + b"\n"])
def test_a_line_of_the_node_that_is_none_ends_the_connection_in_order(line: bytes) -> None:
    assert acted(MockSocket(), b'{"set": {}}\n' + line + b'{"set": {}}\n') == [{"set": {}}]


@pytest.mark.parametrize("error", GONE)
def test_a_simulation_that_has_left_is_no_error(error: Exception) -> None:
    socket = MockSocket()
    socket.fails = error
    assert acted(socket, b"{}\n{}\n") == []
    finished(lambda: session_of(socket)._receive_lines())
    socket = MockSocket(error)
    finished(lambda: session_of(socket)._receive_lines())
    assert [sorted(found) for found in socket.sent] == [["channels", "limit", "ready"]]


# -- from the simulation to the node -----------------------------------------------------------------------------------


def test_good_lines_are_passed_on_and_all_are_counted() -> None:
    writer, feed = MockWriter(), Feed("api:sim", lambda: None)
    session, lines = session_of(MockSocket(), writer, feed), CheckedLines([OPENING])
    good = b'{"value": {"opening": 1}}'
    finished(lambda: session._pass_on(good + b"\n\n  \n" + b"nonsense\n" + good, lines))
    assert writer.octets == good + b"\n" + good + b"\n"
    assert writer.drained == 1, "a node that is behind holds the simulation up"
    assert (feed.lines, feed.skipped, session.skipped.count, session.limited.count) == (2, 1, 1, 0)
    finished(lambda: session._pass_on(b'{"value": {"opening": 111}}', lines))
    assert (feed.lines, feed.skipped, session.limited.count) == (3, 1, 1)
    assert session.limited.why.startswith("opening: 111 mm is outside 0 to 110 mm")


def test_texts_and_octets_are_lines_and_are_read_no_faster_than_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    writer, pauses = MockWriter(), list[tuple[str, float]]()

    class MockPace:
        def delay(self, octets: int) -> float:
            pauses.append(("octets", octets))
            return octets / 1000

    async def sleep(seconds: float) -> None:
        pauses.append(("sleep", seconds))

    monkeypatch.setattr(simulation, "Pace", MockPace)
    monkeypatch.setattr("teds_provision.ncap.web.simulation.asyncio.sleep", sleep)
    text = '{"value": {"opening": null}}'
    socket = MockSocket(
        {"type": "websocket.receive", "text": text},
        {"type": "websocket.receive", "bytes": text.encode(), "text": None},
        {"type": "websocket.receive", "text": "é"},
        TimeoutError(),
        {"type": "websocket.disconnect"},
        {"type": "websocket.receive", "text": text},
    )
    finished(lambda: session_of(socket, writer)._receive_lines())
    assert socket.sent[0] == {"ready": True, "channels": [OPENING.as_json()], "limit": 1_048_576}
    assert [sorted(found) for found in socket.sent[1:]] == [["skipped", "why"]]
    assert writer.octets == f"{text}\n{text}\n".encode(), "and none after the simulation has left"
    assert pauses == [
        ("octets", 28), ("sleep", 0.028), ("octets", 28), ("sleep", 0.028), ("octets", 2), ("sleep", 0.002),
    ]  # fmt: skip


def test_what_there_is_to_report_is_reported_also_while_nothing_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(simulation, "time", SimpleNamespace(monotonic=lambda: now[0]))
    socket = MockSocket(TimeoutError(), {"type": "websocket.disconnect"})
    session = session_of(socket)
    session.skipped.note("no JSON")
    finished(session._receive_lines)
    assert socket.sent[1:] == [{"skipped": 1, "why": "no JSON"}]


# -- what ends a connection --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ended", "state", "closed"),
    [
        ("gone", WebSocketState.CONNECTED, [(1012, "The transducer was restarted or removed.")]),
        ("node", WebSocketState.CONNECTED, [(1012, "The transducer was restarted or removed.")]),
        ("token", WebSocketState.DISCONNECTED, []),
        ("client", WebSocketState.DISCONNECTED, []),
    ],
)
def test_whatever_ends_first_ends_all_and_a_client_that_is_there_learns_why(
    ended: str, state: WebSocketState, closed: list[tuple[int, str]]
) -> None:
    socket = MockSocket(*[{"type": "websocket.disconnect"}] * (ended == "client"))
    left = list[str]()

    async def work() -> None:
        gone, reader = asyncio.Event(), asyncio.StreamReader()

        async def watch() -> None:
            try:
                if ended != "token":
                    await asyncio.Event().wait()
            finally:
                left.append("the token is watched no more")

        if ended == "gone":
            gone.set()
        elif ended == "node":
            reader.feed_eof()
        else:
            socket.application_state = state
        await session_of(socket).run(reader, gone, watch())
        assert len(asyncio.all_tasks()) <= 2, "this one and what waits for it"

    finished(work)
    assert socket.sent[0] == "accepted"
    assert (socket.closed, left) == (closed, ["the token is watched no more"])


@pytest.mark.parametrize("error", GONE)
def test_a_client_that_leaves_while_it_is_closed_is_no_error(error: Exception) -> None:
    socket = MockSocket()
    socket.fails = error

    async def work() -> None:
        await session_of(socket).run(asyncio.StreamReader(), asyncio.Event(), asyncio.sleep(0))

    finished(work)
    assert socket.closed == []


# -- who gets one ------------------------------------------------------------------------------------------------------


class MockVirtuals:
    """The virtual transducers of a station: one, at ``folder``."""

    def __init__(self, folder: Path) -> None:
        self.one = Virtual("ab" * 10, "hand", "simulation", folder)
        self.course: list[Any] = []
        self.refusal: TedsProvisionError | None = None

    def find(self, name: str) -> Virtual:
        self.course.append(("find", name))
        return self.one

    def begin_feed(self, virtual: Virtual, feed: Feed) -> None:
        if self.refusal is not None:
            raise self.refusal
        self.course.append(("begin", virtual, feed.by))
        self.feed = feed

    def end_feed(self, virtual: Virtual, feed: Feed) -> None:
        assert feed is self.feed
        self.course.append(("end", virtual))


async def nothing_to_watch(_socket: Any, _caller: Caller, _leaving: asyncio.Event) -> None:
    await asyncio.Event().wait()


def fed(virtuals: MockVirtuals, socket: MockSocket) -> None:
    daemon: Any = SimpleNamespace(virtuals=virtuals)
    mock: Any = socket
    finished(lambda: feeding(daemon, nothing_to_watch)(mock))


def test_a_token_that_may_only_read_feeds_nothing(tmp_path: Path) -> None:
    virtuals = MockVirtuals(tmp_path)
    with pytest.raises(RequestRefusedError) as refused:
        fed(virtuals, MockSocket(caller=Caller("plotter", "script", read_only=True)))
    no = refused.value
    assert (no.status, no.code, no.message, no.hint) == (
        403, "read-only", "Token 'plotter' is read-only.", "Use a token that was added without --read-only.",
    )  # fmt: skip
    assert virtuals.course == []


@pytest.mark.parametrize(
    ("refusal", "status", "code"),
    [(NotFoundError("None.", hint="Look."), 404, "not-found"), (NodeBusyError("Fed.", hint="Look."), 423, "node-busy")],
)
def test_one_that_cannot_be_fed_is_refused_before_the_connection_is_there(
    refusal: TedsProvisionError, status: int, code: str, tmp_path: Path
) -> None:
    virtuals, socket = MockVirtuals(tmp_path), MockSocket(caller=Caller("arm", "script"))
    virtuals.refusal = refusal
    with pytest.raises(RequestRefusedError) as refused:
        fed(virtuals, socket)
    no = refused.value
    assert (no.status, no.code, no.message, no.hint) == (
        status, code, refusal.message, "Look.",
    )  # fmt: skip
    assert (virtuals.course, socket.sent) == ([("find", "hand")], [])


@pytest.mark.parametrize("ended", ["node", "link", "bug"])
def test_the_place_is_free_again_however_a_connection_ends(
    ended: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    virtuals, socket, writer = MockVirtuals(tmp_path), MockSocket(caller=Caller("arm", "script")), MockWriter()
    asked = list[Path]()

    def channels(folder: Path) -> list[FedChannel]:
        asked.append(folder)
        if ended == "bug":
            raise ZeroDivisionError
        return [OPENING]

    async def connected(virtual: Virtual) -> tuple[asyncio.StreamReader, MockWriter]:
        assert virtual is virtuals.one
        if ended == "link":
            raise LinkError("It does not run.", hint="Look.")
        virtuals.feed.end()  # as for one that is removed
        return asyncio.StreamReader(), writer

    monkeypatch.setattr(simulation, "fed_channels", channels)
    monkeypatch.setattr(simulation, "_connected", connected)
    if ended == "node":
        fed(virtuals, socket)
        assert socket.sent[0] == "accepted"
        assert socket.closed == [(1012, "The transducer was restarted or removed.")]
    else:
        with pytest.raises(ZeroDivisionError if ended == "bug" else RequestRefusedError) as raised:
            fed(virtuals, socket)
        if isinstance(raised.value, RequestRefusedError):
            assert (raised.value.status, raised.value.message) == (503, "It does not run.")
    assert virtuals.course == [("find", "hand"), ("begin", virtuals.one, "api:arm"), ("end", virtuals.one)]
    assert (asked, writer.ended) == ([tmp_path], int(ended == "node"))


def test_a_process_that_starts_is_waited_for_ten_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, tries = [100.0], list[Path]()
    monkeypatch.setattr(simulation, "time", SimpleNamespace(monotonic=lambda: now[0]))

    async def sleep(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr("teds_provision.ncap.web.simulation.asyncio.sleep", sleep)
    virtual = Virtual("ab" * 10, "", "simulation", tmp_path / "none")
    with pytest.raises(LinkError) as refused:
        finished(lambda: _connected(virtual))
    assert refused.value.message == f"{'ab' * 10} does not run."
    assert refused.value.hint == "Try again, or see GET /virtual."
    assert now[0] == pytest.approx(110.0, abs=0.3)
    virtual.name = "hand"
    with pytest.raises(LinkError, match=r"^hand does not run\.$"):
        finished(lambda: _connected(virtual))

    async def opened(path: str) -> tuple[str, str]:
        tries.append(Path(path).resolve())
        if len(tries) < 3:
            raise ConnectionRefusedError
        return "reader", "writer"

    monkeypatch.setattr("teds_provision.ncap.web.simulation.asyncio.open_unix_connection", opened)
    virtual.folder, began = tmp_path, now[0]
    assert finished(lambda: _connected(virtual)) == ("reader", "writer")
    assert tries == [tmp_path / "source.sock"] * 3
    assert now[0] - began == pytest.approx(0.4)


def test_a_line_is_news_if_there_is_a_reason() -> None:
    news = simulation._News()
    for why in ("no JSON", "", "NaN"):
        news.note(why)
    assert (news.count, news.why, news.sent) == (2, "NaN", 0)
