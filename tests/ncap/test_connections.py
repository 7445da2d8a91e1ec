"""Who opens connections and says nothing, or says it slowly: he loses them, and keeps nobody out."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from types import SimpleNamespace
from typing import Any, cast

import h11
import pytest

from teds_provision.errors import LinkError
from teds_provision.ncap.web import server
from teds_provision.ncap.web.guard import CALLER, Receive, Scope, Send
from tests.pace import PATIENCE

Pair = tuple[asyncio.StreamReader, asyncio.StreamWriter]
GET = b"GET / HTTP/1.1\r\nHost: x\r\n"
PUT = b"PUT / HTTP/1.1\r\nHost: x\r\nContent-Length: 4\r\n\r\n"
KNOWN = b"GET /known HTTP/1.1\r\nHost: x\r\n\r\n"


async def echo(scope: Scope, receive: Receive, send: Send) -> None:
    if scope["path"] == "/known":
        scope[CALLER] = "somebody with a token"
    body = b""
    while (message := await receive())["type"] == "http.request":
        body += message["body"]
        if not message["more_body"]:
            break
    length = [(b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": 200, "headers": length})
    await send({"type": "http.response.body", "body": body})


def served(work: Callable[[Callable[[], Awaitable[Pair]]], Awaitable[None]]) -> None:
    """Run it against a server on loopback."""

    async def run() -> None:
        listener = server.listen("127.0.0.1", 0)
        port = listener.getsockname()[1]
        servers = server.Servers()
        await servers.serve(echo, listener)
        try:
            await asyncio.wait_for(work(lambda: asyncio.open_connection("127.0.0.1", port)), 2 * PATIENCE)
        finally:
            await servers.stop()

    asyncio.run(run())


def test_an_address_that_cannot_be_served_on_is_named_with_the_remedy() -> None:
    with server.listen("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        places = (("127.0.0.1", port, "Address already in use"), ("192.0.2.1", 0, "Cannot assign requested address"))
        for host, number, why in places:
            with pytest.raises(LinkError) as refused:
                server.listen(host, number)
            assert refused.value.message == f"Cannot serve the page on {host}:{number}: {why}."
            assert refused.value.hint == "Choose another address with --http."
    with pytest.raises(LinkError, match=r"^Cannot serve the page on 127\.0\.0\.1:65536: .*0-65535"):
        server.listen("127.0.0.1", 65536)


async def is_ended(pair: Pair) -> bool:
    try:
        return await asyncio.wait_for(pair[0].read(1), PATIENCE) == b""
    except ConnectionResetError:
        return True


async def answer(pair: Pair, octets: bytes) -> bytes:
    pair[1].write(octets)
    return await asyncio.wait_for(pair[0].readline(), PATIENCE)


def test_a_head_and_a_body_that_do_not_end_cost_the_connection(monkeypatch: pytest.MonkeyPatch) -> None:
    async def work(connect: Callable[[], Awaitable[Pair]]) -> None:
        second = await connect()
        await asyncio.sleep(0.05)  # the server has it
        monkeypatch.setattr(server, "HEAD", 0.2)  # for new and for answered connections from now on
        monkeypatch.setattr(server, "BODY", 0.2)
        mute, head, body = [await connect() for _ in range(3)]
        head[1].write(GET + b"X: ")
        body[1].write(PUT + b"ab")
        assert await answer(second, GET + b"\r\n") == b"HTTP/1.1 200 OK\r\n"
        await second[0].readuntil(b"\r\n\r\n")
        second[1].write(GET)  # of its second request half a head
        for what, pair in {"mute": mute, "head": head, "body": body, "second head": second}.items():
            assert await is_ended(pair), what

    served(work)


def test_the_time_of_a_head_is_not_the_time_of_a_body_nor_of_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "HEAD", 1.0)

    async def work(connect: Callable[[], Awaitable[Pair]]) -> None:
        pair = await connect()
        pair[1].write(PUT + b"ab")
        await asyncio.sleep(1.2)
        assert await answer(pair, b"cd") == b"HTTP/1.1 200 OK\r\n"

    served(work)


def test_a_connection_that_is_closing_gets_no_new_limit() -> None:
    """It still has its last answer to send, however slowly it is read."""
    limits, ending = list[float](), [False]
    rig: Any = SimpleNamespace(
        conn=SimpleNamespace(their_state=h11.IDLE),
        _awaited=None,
        _late=None,
        _forget=lambda: limits.append(-1.0),
        transport=SimpleNamespace(is_closing=lambda: ending[0]),
        loop=SimpleNamespace(call_later=lambda seconds, _work: limits.append(seconds)),
        end=None,
    )
    for closing, state, taken in (
        (True, h11.IDLE, [-1.0]), (False, h11.IDLE, [-1.0, 10.0]), (False, h11.IDLE, []),
        (False, h11.SEND_BODY, [-1.0, 30.0]), (False, h11.DONE, [-1.0]),
    ):  # fmt: skip
        limits.clear()
        ending[0] = closing
        rig.conn.their_state = state
        server.HttpConnection._await(rig)
        assert limits == taken


def test_silent_connections_make_room_for_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MOST", 20)
    monkeypatch.setattr(server, "MOST", 20)

    async def work(connect: Callable[[], Awaitable[Pair]]) -> None:
        mute = [await connect() for _ in range(40)]
        for _, writer in mute:
            writer.write(GET)
        pair = await connect()
        assert await answer(pair, GET + b"\r\n") == b"HTTP/1.1 200 OK\r\n"
        assert await is_ended(mute[0]), "the oldest goes first"

    served(work)


def test_slow_bodies_without_a_token_keep_no_client_out_and_end_no_connection(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Five hundred of them, each with one octet of its body, were 503 for everybody else."""
    monkeypatch.setattr(server, "MOST", 20)
    monkeypatch.setattr(server, "MOST", 20)

    async def work(connect: Callable[[], Awaitable[Pair]]) -> None:
        browser = await connect()
        assert await answer(browser, KNOWN) == b"HTTP/1.1 200 OK\r\n"
        slow = []
        for _ in range(60):
            slow.append(await connect())
            slow[-1][1].write(PUT + b"a")
        for _ in range(3):
            pair = await connect()
            assert await answer(pair, KNOWN) == b"HTTP/1.1 200 OK\r\n"
        assert await is_ended(slow[0]), "the oldest goes first"
        await browser[0].readuntil(b"\r\n\r\n")
        assert await answer(browser, KNOWN) == b"HTTP/1.1 200 OK\r\n"

    served(work)


def test_of_clients_with_a_token_the_one_that_was_silent_longest_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest connection was closed, though its client had asked a moment ago."""
    monkeypatch.setattr(server, "MOST", 3)

    async def work(connect: Callable[[], Awaitable[Pair]]) -> None:
        oldest, silent = await connect(), await connect()
        for pair in (oldest, silent, oldest):
            assert await answer(pair, KNOWN) == b"HTTP/1.1 200 OK\r\n"
            await pair[0].readuntil(b"\r\n\r\n")
        third = await connect()
        assert await answer(third, KNOWN) == b"HTTP/1.1 200 OK\r\n"
        assert await is_ended(silent)
        assert await answer(oldest, KNOWN) == b"HTTP/1.1 200 OK\r\n"

    served(work)


@pytest.mark.parametrize("certificate", [None, "cert.pem"])
def test_a_server_bounds_what_a_client_sends_and_believes_no_proxy(
    monkeypatch: pytest.MonkeyPatch, certificate: str | None
) -> None:
    kept: list[dict[str, Any]] = []
    listeners: list[Any] = []
    failures: list[OSError | None] = [None, OSError("The socket is closed.")]

    class MockServer:
        started = False

        def __init__(self, config: Any) -> None:
            kept.append(config)

        async def serve(self, sockets: list[Any]) -> None:
            listeners.append(sockets)
            if failure := failures.pop(0):
                raise failure
            self.started = True

    monkeypatch.setattr(server.uvicorn, "Config", lambda app, **settings: {"app": app, **settings})  # type: ignore[attr-defined]
    monkeypatch.setattr(server, "_Server", MockServer)
    app, listener, settings = (
        cast("Any", object()),
        cast("Any", object()),
        SimpleNamespace(certificate=certificate, key="key.pem"),
    )

    async def run() -> None:
        servers = server.Servers()
        await servers.serve(app, listener, cast("Any", settings))
        with pytest.raises(OSError, match=r"The socket is closed\."):
            await servers.serve(app, listener)

    asyncio.run(run())
    bounds = {
        "app": app, "proxy_headers": False, "server_header": False, "access_log": False, "log_level": "critical",
        "log_config": None, "lifespan": "off", "http": server.HttpConnection, "ws": "websockets-sansio",
        "ws_max_size": 65_536, "ws_per_message_deflate": False, "h11_max_incomplete_event_size": 32_768,
        "limit_concurrency": 2000, "timeout_keep_alive": 30, "timeout_graceful_shutdown": server._ENDING,
    }  # fmt: skip
    plain = {"ssl_certfile": None, "ssl_keyfile": None}
    tls = {"ssl_certfile": certificate, "ssl_keyfile": "key.pem"} if certificate else plain
    assert kept == [bounds | tls, bounds | plain]
    assert listeners == [[listener]] * 2
