"""Which host, origin and site the guard lets through, asked of it in this process."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

import pytest

from teds_provision.ncap.web.guard import Guard, Message, Receive, Scope, Send, front
from teds_provision.ncap.web.tokens import Tokens

PORT = 8451
HERE = f"127.0.0.1:{PORT}"


async def app(scope: Scope, _receive: Receive, send: Send) -> None:
    prefix = "websocket." if scope["type"] == "websocket" else ""
    await send({"type": f"{prefix}http.response.start", "status": 200, "headers": []})


def status_of(guard: Guard, headers: dict[str, str], kind: str = "http", *, more: tuple[str, str] | None = None) -> int:
    sent: list[Message] = []

    async def run() -> None:
        async def send(message: Message) -> None:
            sent.append(message)

        async def receive() -> Message:
            return {"type": "http.disconnect"}

        every = [*headers.items(), *([more] if more else [])]
        pairs = [(name.encode(), value.encode()) for name, value in every]
        await guard({"type": kind, "method": "GET", "path": "/api/v1/live", "headers": pairs}, receive, send)

    asyncio.run(run())
    return int(sent[0]["status"])


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, 200),
        ({"host": "LOCALHOST:8451"}, 200),
        ({"host": "127.0.0.1"}, 421),
        ({"host": "evil.example:8451"}, 421),
        ({"origin": f"http://{HERE}"}, 200),
        ({"origin": f"HTTP://{HERE}"}, 200),
        ({"origin": f"https://{HERE}"}, 403),
        ({"origin": "http://127.0.0.1:8452"}, 403),
        ({"origin": "null"}, 403),
        ({"sec-fetch-site": "same-origin"}, 200),
        ({"sec-fetch-site": "none"}, 200),
        ({"sec-fetch-site": "same-site"}, 403),
        ({"sec-fetch-site": "cross-site"}, 403),
        ({"origin": f"http://{HERE}", "sec-fetch-site": "cross-site"}, 403),
    ],
)
@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_a_good_token_works_from_its_own_origin_only(
    tmp_path: Path, kind: str, headers: dict[str, str], status: int
) -> None:
    tokens = Tokens(tmp_path)
    good = {"host": HERE, "authorization": f"Bearer {tokens.add('script')}"}
    guard = Guard(app, tokens, front((), PORT, tls=False))
    assert status_of(guard, {**good, **headers}, kind) == status
    without = {"host": HERE, **headers}
    assert status_of(guard, without, kind) == (401 if status == 200 else status), "the token is looked at last"


def test_a_browsers_websocket_names_its_origin(tmp_path: Path) -> None:
    """Browsers send one with each WebSocket, to whatever server; a request without one is none of our page."""
    tokens = Tokens(tmp_path)
    guard = Guard(app, tokens, front((), PORT, tls=False))
    cookie = {"host": HERE, "cookie": f"ncap-{PORT}={tokens.login(tokens.login_link())}"}
    assert status_of(guard, cookie) == 200
    assert status_of(guard, cookie, "websocket") == 403
    assert status_of(guard, {**cookie, "origin": f"http://{HERE}"}, "websocket") == 200
    assert status_of(guard, {**cookie, "origin": "http://evil.example"}, "websocket") == 403


def test_the_users_own_socket_has_no_origin_to_compare(tmp_path: Path) -> None:
    guard = Guard(app, Tokens(tmp_path), None)
    assert status_of(guard, {"host": "anything", "origin": "http://evil.example"}) == 200


@pytest.mark.parametrize("name", ["host", "origin", "content-length", "content-type", "authorization"])
def test_a_header_that_decides_comes_once(tmp_path: Path, name: str) -> None:
    """A proxy in front and the service behind it would each read another one."""
    tokens = Tokens(tmp_path)
    guard = Guard(app, tokens, front((), PORT, tls=False))
    good = {"host": HERE, "authorization": f"Bearer {tokens.add('script')}", "origin": f"http://{HERE}"}
    good |= {"content-length": "0", "content-type": "application/json"}
    assert status_of(guard, good) == 200
    assert status_of(guard, good, more=(name.title(), good[name])) == 400
    assert status_of(guard, good, more=("accept", "text/html")) == 200


def test_wrong_tokens_of_more_than_a_minute_ago_count_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("teds_provision.ncap.web.guard._SLOWED", 0.0)
    guard = Guard(app, Tokens(tmp_path), front((), PORT, tls=False))
    wrong = {"host": HERE, "authorization": "Bearer nonsense"}
    for ago, status in ((61.0, 401), (30.0, 429)):
        guard._wrong.clear()
        guard._wrong.extend([time.monotonic() - ago] * 10)
        assert status_of(guard, wrong) == status


def test_who_waits_for_a_refusal_gives_the_place_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else wrong tokens would be slowed down fifty times, and never again until the service ends."""
    monkeypatch.setattr("teds_provision.ncap.web.guard._SLOWED", 0.0)
    monkeypatch.setattr("teds_provision.ncap.web.guard._MOST_SLOWED", 1)
    guard = Guard(app, Tokens(tmp_path), front((), PORT, tls=False))
    guard._wrong.extend([time.monotonic()] * 10)
    slept: list[float] = []

    async def sleep(seconds: float) -> None:
        assert guard._slowed == 1
        slept.append(seconds)

    monkeypatch.setattr("teds_provision.ncap.web.guard.asyncio.sleep", sleep)
    for _ in range(3):
        assert status_of(guard, {"host": HERE, "authorization": "Bearer nonsense"}) == 429
    assert slept == [0.0] * 3


def test_what_the_page_says_of_its_own_files_is_said_once(tmp_path: Path) -> None:
    """A browser that finds two answers may take the one that keeps an old page for ever."""
    sent: list[Message] = []

    async def page(_scope: Scope, _receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": [(b"Cache-Control", b"no-cache")]})

    async def send(message: Message) -> None:
        sent.append(message)

    none: Any = None
    asyncio.run(
        Guard(page, Tokens(tmp_path), None)({"type": "http", "method": "GET", "path": "/", "headers": []}, none, send)
    )
    names = [name.lower() for name, _ in sent[0]["headers"]]
    assert names.count(b"cache-control") == 1
    assert b"content-security-policy" in names


def test_a_token_that_has_expired_is_not_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tokens = Tokens(tmp_path)
    tokens.add("script")
    tokens.login(tokens.login_link())
    assert [token.name for token in tokens.all()] == ["script", "browser"]
    later = time.time() + 31 * 86_400
    monkeypatch.setattr(time, "time", lambda: later)
    assert [token.name for token in tokens.all()] == ["script"]
