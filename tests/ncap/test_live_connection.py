"""One connection to /live without a service: its place, its messages, and why it is closed."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from types import SimpleNamespace
from typing import Any

import pytest
from starlette.requests import Request
from starlette.websockets import WebSocketDisconnect

from teds_provision.errors import NotAuthenticError, NotFoundError, StoreError, TedsProvisionError, UsageError
from teds_provision.ncap.live import LiveClient
from teds_provision.ncap.web import app
from teds_provision.ncap.web.guard import CALLER, Caller
from teds_provision.ncap.web.responses import ASKED
from tests.pace import PATIENCE

HELLO = {"type": "hello"}
SCRIPT = Caller("arm", "script", digest="d1")
READER = Caller("plotter", "script", read_only=True, digest="d2")
GONE: list[Exception] = [WebSocketDisconnect(1001), RuntimeError("closed"), ConnectionResetError()]


class MockSocket:
    """A client's WebSocket: it receives ``messages`` and keeps what is sent and how it is closed."""

    def __init__(self, *messages: str, caller: Caller = SCRIPT) -> None:
        self.messages, self.scope, self.course = list(messages), {CALLER: caller}, list[Any]()
        self.fails: Exception | None = None

    async def accept(self) -> None:
        self.course.append("accepted")

    async def receive(self) -> dict[str, Any]:
        await asyncio.sleep(0)
        if not self.messages:
            await asyncio.Event().wait()
        return {"type": f"websocket.{self.messages.pop(0)}"}

    async def send_json(self, found: Any) -> None:
        self.course.append(found)

    async def send_text(self, text: str) -> None:
        if self.fails is not None:
            raise self.fails
        self.course.append(text)

    async def close(self, code: int, why: str = "") -> None:
        if self.fails is not None:
            raise self.fails
        self.course.append((code, why))


class MockDaemon:
    """What a connection asks of the daemon; tokens in ``good`` are good."""

    def __init__(self) -> None:
        self.good, self.tokens, self.waits = {"d1", "d2"}, self, SimpleNamespace(token=0.001)
        self.live, self.here, self.log = self, list[LiveClient](), list[Any]()
        self.station: Any = self
        self.fails: Exception | None = None

    def is_good(self, digest: str) -> bool:
        if self.fails is not None:
            raise self.fails
        return digest in self.good

    def join(self, *, reader: bool) -> LiveClient:
        self.here.append(LiveClient(reader=reader))
        return self.here[-1]

    def remove_client(self, listener: LiveClient) -> None:
        self.here.remove(listener)

    def first_message(self) -> dict[str, Any]:
        return HELLO

    def audit(self, *words: Any, **facts: Any) -> None:
        self.log.append((*words, facts))
        if self.fails is not None:
            raise self.fails


def finished(work: Callable[[], Awaitable[Any]]) -> Any:
    async def soon() -> Any:
        return await asyncio.wait_for(work(), PATIENCE)

    return asyncio.run(soon())


def as_any(*mocks: Any) -> tuple[Any, ...]:
    """Return the mocks, for functions that take what they stand for."""
    return mocks


def listening(daemon: MockDaemon) -> Callable[[Any], Awaitable[None]]:
    mock: Any = daemon
    return app._live(mock)


def test_a_client_is_greeted_listens_by_the_rights_of_its_token_and_is_forgotten_when_it_leaves() -> None:
    for caller in (SCRIPT, READER):
        daemon, there = MockDaemon(), list[bool]()
        socket = MockSocket("receive", "receive", caller=caller)

        async def work(daemon: MockDaemon = daemon, socket: MockSocket = socket, there: list[bool] = there) -> None:
            visit = asyncio.create_task(listening(daemon)(socket))
            while HELLO not in socket.course or socket.messages:
                await asyncio.sleep(0)
            there.extend(client.reader for client in daemon.here)
            daemon.here[0].event("news")
            while "news" not in socket.course:
                await asyncio.sleep(0)
            visit.cancel()
            await asyncio.gather(visit, return_exceptions=True)
            for _ in range(9):
                await asyncio.sleep(0)
            assert len(asyncio.all_tasks()) <= 2, "this one and what waits for it"

        finished(work)
        assert socket.course == ["accepted", HELLO, "news"]
        assert there == [caller.read_only]
        assert daemon.here == []


def test_a_client_that_disconnects_gives_its_place_back(monkeypatch: pytest.MonkeyPatch) -> None:
    course = list[Any]()

    class MockSlots:
        def acquire(self, token: str, leave: Callable[[], object]) -> bool:
            course.append(("acquire", token, leave))
            return len(course) == 1

        def release(self, token: str, leave: Callable[[], object]) -> None:
            course.append(("release", token, leave))

    monkeypatch.setattr(app, "LiveSlots", MockSlots)
    daemon, socket, late = MockDaemon(), MockSocket("receive", "disconnect"), MockSocket()

    async def work() -> None:
        live = listening(daemon)
        await live(socket)
        await live(late)

    finished(work)
    (taken, token, leave), given, again = course
    assert (taken, token, again[0]) == ("acquire", "d1", "acquire")
    assert given == ("release", "d1", leave)
    assert daemon.here == []
    assert late.course == [(1013, "")], "try again later; and it never listened"


@pytest.mark.parametrize("error", GONE)
def test_a_client_that_has_left_ends_the_sending_and_is_no_error(error: Exception) -> None:
    socket, client = MockSocket(), LiveClient()
    socket.fails = error
    client.event("one")
    mock: Any = socket
    finished(lambda: app._send(mock, client, HELLO))
    assert socket.course == [HELLO]
    leaving, daemon = asyncio.Event(), MockDaemon()
    leaving.set()
    asked: Any = daemon
    finished(lambda: app._end_in_time(mock, asked, SCRIPT, leaving))


@pytest.mark.parametrize(
    ("caller", "good", "leaves", "closed"),
    [
        (SCRIPT, True, True, (1013, "This connection was closed to make room for another token.")),
        (SCRIPT, False, False, (1008, "This token is invalid or has expired.")),
        (Caller("page", "browser", digest="d3"), True, False, (1008, "This token is invalid or has expired.")),
        (SCRIPT, None, False, (1008, "This token is invalid or has expired.")),
        (Caller("socket", "socket"), False, True, (1013, "This connection was closed to make room for another token.")),
    ],
)
def test_a_connection_is_closed_with_the_reason(
    caller: Caller, good: bool | None, leaves: bool, closed: tuple[int, str]
) -> None:
    """A token that cannot be checked is not good; the socket has none."""
    socket, daemon = MockSocket(), MockDaemon()
    if good is None:
        daemon.fails = StoreError("unreadable")
    elif not good:
        daemon.good.clear()
    mock, asked = as_any(socket, daemon)

    async def work() -> None:
        leaving = asyncio.Event()
        end = asyncio.create_task(app._end_in_time(mock, asked, caller, leaving))
        if leaves:
            for _ in range(3):
                await asyncio.sleep(0.002)
                assert not end.done(), "it is looked at and stays"
            leaving.set()
        await end

    finished(work)
    assert socket.course == [closed]


def test_the_watch_of_a_simulation_ends_it_with_its_token() -> None:
    socket, daemon = MockSocket(), MockDaemon()
    daemon.good.clear()
    mock, asked = as_any(socket, daemon)
    finished(lambda: app._watched(asked)(mock, SCRIPT, asyncio.Event()))
    assert socket.course == [(1008, "This token is invalid or has expired.")]


@pytest.mark.parametrize(
    ("method", "error", "path", "asked", "entry"),
    [
        ("PUT", UsageError("No."), {"uuid": "ab" * 10}, {}, (bytes.fromhex("ab" * 10), "usage", {})),
        ("POST", NotAuthenticError("No."), {}, {"uuid": "cd" * 10, "rate": 5, "act": "x", "outcome": "y"},
         (bytes.fromhex("cd" * 10), "not-authentic", {"rate": 5})),
        ("POST", UsageError("No."), {"uuid": "hand"}, {"name": "n"}, (None, "usage", {"name": "n"})),
        ("GET", UsageError("No."), {}, {}, None),
        ("HEAD", UsageError("No."), {}, {}, None),
        ("PUT", NotFoundError("No."), {}, {}, None),
        ("PUT", StoreError("No."), {}, {}, None),
        ("PUT", UsageError("No."), {"uuid": "ab" * 10, "number": 2}, {}, None),
    ],
)  # fmt: skip
def test_a_refused_change_is_logged_with_its_node_and_reason(
    method: str, error: TedsProvisionError, path: dict[str, Any], asked: dict[str, Any], entry: Any
) -> None:
    """What was only read, what does not exist, and a set point, which has its own entry, are not."""
    scope = {"type": "http", "method": method, "path": "/api/v1/" + "x" * 300, "path_params": path}
    request = Request({**scope, "query_string": b"", "headers": [], CALLER: SCRIPT, ASKED: asked})
    for full in (False, True):
        daemon = MockDaemon()
        daemon.fails = StoreError("disk full") if full else None
        mock: Any = daemon
        answer: Any = finished(lambda mock=mock: app._noted(mock)(request, error))
        assert answer.status_code == {"not-found": 404, "store": 503}.get(error.code, 422)
        if entry is None:
            assert daemon.log == []
            continue
        node, code, facts = entry
        more = {"method": method, "path": ("/api/v1/" + "x" * 300)[:200], "why": "No."}
        assert daemon.log == [("api", node, code, facts | more)]
