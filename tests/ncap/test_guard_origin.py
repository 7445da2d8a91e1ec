"""Which host, origin and site the guard lets through, asked of it in this process."""

from __future__ import annotations

import asyncio
import json
import os
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NotFoundError, StoreError, UsageError
from teds_provision.ncap.web.guard import (
    Caller,
    Guard,
    Message,
    Receive,
    RequestRefusedError,
    Scope,
    Send,
    _bearer,
    _limited,
    _require_may_change,
    front,
)
from teds_provision.ncap.web.tokens import Tokens, digest_of
from teds_provision.station.store.audit import ACTOR, acting_for

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
    prefix = "websocket." if kind == "websocket" else ""
    kinds = [message["type"] for message in sent]
    assert kinds == [f"{prefix}http.response.{part}" for part in ("start", "body")[: len(sent)]]
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


@pytest.mark.parametrize("cookie", ["a[b]=1", 'x="', "no pair", f"ncap-{PORT}", "=", ";;;"])
def test_a_cookie_that_nobody_can_read_is_none(tmp_path: Path, cookie: str) -> None:
    tokens = Tokens(tmp_path)
    guard = Guard(app, tokens, front((), PORT, tls=False))
    assert status_of(guard, {"host": HERE, "cookie": cookie}) == 401
    assert status_of(guard, {"host": HERE, "cookie": cookie, "authorization": f"Bearer {tokens.add('script')}"}) == 200


def test_what_is_no_request_passes_the_guard(tmp_path: Path) -> None:
    """ASGI servers report their start and end by the same call, without headers."""
    came: list[str] = []

    async def any_app(scope: Scope, _receive: Receive, _send: Send) -> None:
        came.append(scope["type"])

    async def nothing(*_: object) -> Any:
        raise AssertionError

    asyncio.run(Guard(any_app, Tokens(tmp_path), front((), PORT, tls=False))({"type": "lifespan"}, nothing, nothing))
    assert came == ["lifespan"]


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


def asked(guard: Guard, path: str, headers: dict[str, str], query: bytes = b"") -> tuple[int, dict[str, list[str]]]:
    """Return the status and the headers of one GET."""
    sent: list[Message] = []

    async def send(message: Message) -> None:
        sent.append(message)

    none: Any = None
    pairs = [(name.encode(), value.encode()) for name, value in headers.items()]
    scope = {"type": "http", "method": "GET", "path": path, "query_string": query, "headers": pairs}
    asyncio.run(guard(scope, none, send))
    found: dict[str, list[str]] = {}
    for name, value in sent[0]["headers"]:
        found.setdefault(name.decode(), []).append(value.decode())
    return int(sent[0]["status"]), found


def test_every_answer_has_these_headers(tmp_path: Path) -> None:
    csp = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "font-src 'self'; manifest-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
    )
    tokens = Tokens(tmp_path)
    guard = Guard(app, tokens, front((), PORT, tls=False))
    good = {"host": HERE, "authorization": f"Bearer {tokens.add('script')}"}
    for headers, status in ((good, 200), ({"host": HERE}, 401), ({"host": "evil.example"}, 421)):
        found = asked(guard, "/api/v1/status", headers)
        assert found[0] == status
        assert {name: values for name, values in found[1].items() if not name.startswith("content-")} == {
            "x-content-type-options": ["nosniff"],
            "x-frame-options": ["DENY"],
            "referrer-policy": ["no-referrer"],
            "cross-origin-resource-policy": ["same-origin"],
            "cross-origin-opener-policy": ["same-origin"],
            "cache-control": ["no-store"],
        }
        assert found[1]["content-security-policy"] == [csp]


@pytest.mark.parametrize(("tls", "more"), [(False, ""), (True, "; Secure")])
def test_the_cookie_of_a_browser_is_for_this_site_alone_and_with_tls_for_tls_alone(
    tmp_path: Path, tls: bool, more: str
) -> None:
    tokens = Tokens(tmp_path)
    guard = Guard(app, tokens, front((), PORT, tls=tls))
    status, headers = asked(guard, "/login", {"host": HERE}, f"token={tokens.login_link()}".encode())
    (cookie,) = headers["set-cookie"]
    value = cookie.partition(";")[0].removeprefix(f"ncap-{PORT}=")
    assert (status, headers["location"]) == (303, ["/"])
    assert cookie == f"ncap-{PORT}={value}; HttpOnly; SameSite=Strict; Path=/; Max-Age=2592000{more}"
    found = tokens.find(value)
    assert found is not None
    assert found.kind == "browser"


@pytest.mark.parametrize(
    ("tls", "port", "host", "status"),
    [
        (False, 80, "localhost", 200),
        (False, 443, "localhost", 421),
        (True, 443, "localhost", 200),
        (True, 80, "localhost", 421),
        (True, 443, "arm.example", 200),
        (True, 8451, "arm.example:8451", 200),
        (True, 8451, "arm.example", 421),
        (True, 8451, "[fd00::7]:8451", 200),
        (True, 8451, "[::1]:8451", 200),
        (True, 8451, "other.example:8451", 421),
    ],
)
def test_a_host_is_named_with_its_port_but_for_the_usual_one(
    tmp_path: Path, tls: bool, port: int, host: str, status: int
) -> None:
    tokens = Tokens(tmp_path)
    guard = Guard(app, tokens, front(("Arm.example", "fd00::7"), port, tls=tls))
    good = {"host": host, "authorization": f"Bearer {tokens.add('script')}"}
    assert status_of(guard, good) == status
    if status == 200:
        assert status_of(guard, {**good, "origin": f"{'https' if tls else 'http'}://{host}"}) == 200
        assert status_of(guard, {**good, "origin": f"{'http' if tls else 'https'}://{host}"}) == 403


def test_a_bearer_token_goes_before_the_cookie(tmp_path: Path) -> None:
    """A script in a browser's session has the rights, and the name in the log, of its own token."""
    tokens, callers = Tokens(tmp_path), []

    async def page(scope: Scope, _receive: Receive, send: Send) -> None:
        callers.append(scope["teds.caller"])
        await send({"type": "http.response.start", "status": 200, "headers": []})

    guard = Guard(page, tokens, front((), PORT, tls=False))
    browser = f"ncap-{PORT}={tokens.login(tokens.login_link())}"
    script = f"Bearer {tokens.add('plotter', read_only=True)}"
    assert status_of(guard, {"host": HERE, "cookie": browser, "authorization": script}) == 200
    assert status_of(guard, {"host": HERE, "cookie": browser}) == 200
    assert [(caller.name, caller.kind, caller.read_only) for caller in callers] == [
        ("plotter", "script", True),
        ("browser", "browser", False),
    ]
    assert [(caller.actor, caller.owner) for caller in callers] == [("token plotter", "api:plotter"), ("page", "page")]
    assert status_of(guard, {"host": HERE, "cookie": browser, "authorization": "Bearer nonsense"}) == 401


IMAGE = "application/octet-stream"
MEBI = 1 << 20


@pytest.mark.parametrize(
    ("method", "path", "kind", "length", "status"),
    [
        ("POST", "/api/v1/updates", IMAGE, 4 * MEBI, None),
        ("POST", "/api/v1/updates", IMAGE, 4 * MEBI + 1, 413),
        ("POST", "/api/v1/updates", "application/json", 5, 415),
        ("POST", "/api/v1/updates/u1", IMAGE, 5, 415),
        ("PUT", "/api/v1/updates", IMAGE, 5, 415),
        ("GET", "/api/v1/updates", "", MEBI + 1, 413),
        ("PUT", "/api/v1/detection", "Application/JSON; charset=utf-8", MEBI, None),
        ("PUT", "/api/v1/detection", "application/json", MEBI + 1, 413),
        ("PUT", "/api/v1/detection", "", 0, 415),
    ],
)
def test_a_change_is_json_of_a_mebibyte_or_the_image_of_an_update_of_four(
    method: str, path: str, kind: str, length: int, status: int | None
) -> None:
    headers = {"content-type": kind, "content-length": str(length)}
    with pytest.raises(RequestRefusedError) if status is not None else nullcontext() as refused:
        _require_may_change({"type": "http", "method": method, "path": path}, headers, Caller("arm", "script"))
    assert status is None or (refused is not None and refused.value.status == status)


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH"])
def test_a_token_that_may_only_read_changes_nothing_and_hears_what_to_do(method: str) -> None:
    caller, headers = Caller("plotter", "script", read_only=True), {"content-type": "application/json"}
    with pytest.raises(RequestRefusedError) as refused:
        _require_may_change({"type": "http", "method": method, "path": "/x"}, headers, caller)
    assert (refused.value.status, refused.value.code) == (403, "read-only")
    assert refused.value.hint == "Use a token that was added without --read-only."
    _require_may_change({"type": "http", "method": "GET", "path": "/x"}, {}, caller)


@pytest.mark.parametrize(
    ("pieces", "passes"), [((4, 4), True), ((8,), True), ((4, 4, 1), False), ((9,), False), ((0, 0), True)]
)
def test_a_body_that_comes_in_pieces_is_counted_whole(pieces: tuple[int, ...], passes: bool) -> None:
    waiting = [{"body": bytes(octets)} for octets in pieces]

    async def receive() -> Message:
        return waiting.pop(0)

    async def run() -> None:
        following = _limited(receive, 8)
        for _ in pieces:
            await following()

    with nullcontext() if passes else pytest.raises(RequestRefusedError):
        asyncio.run(run())


def test_of_eleven_wrong_tokens_the_last_is_slowed_down_and_told_when_to_come_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("teds_provision.ncap.web.guard._SLOWED", 0.0)
    guard = Guard(app, Tokens(tmp_path), front((), PORT, tls=False))

    async def run() -> list[RequestRefusedError]:
        return [await guard._wrong_token() for _ in range(11)]

    refused = asyncio.run(run())
    assert [refusal.status for refusal in refused] == [401] * 10 + [429]
    assert refused[-1].headers == ((b"retry-after", b"60"),)
    assert "ncap open" in refused[0].hint


def test_the_scheme_of_a_token_is_read_in_any_case() -> None:
    given = ("Bearer abc", "bearer  abc ", "BEARER abc", "Basic abc", "abc", "")
    assert [_bearer({"authorization": text}) for text in given] == ["abc"] * 3 + [""] * 3


def test_a_name_is_one_token_of_a_script_and_whoever_removes_it_removes_all_of_that_name(tmp_path: Path) -> None:
    tokens = Tokens(tmp_path)
    link = tokens.login_link()
    cookie = tokens.login(link)
    assert cookie is not None
    assert tokens.login(link) is None, "it works once"
    script = tokens.add("browser")
    with pytest.raises(UsageError, match="already exists"):
        tokens.add("browser")
    tokens.add("x" * 64)
    for name in ("x" * 65, "a\nb", " ", ""):
        with pytest.raises(UsageError, match="is not a valid token name"):
            tokens.add(name)
    with pytest.raises(NotFoundError) as unknown:
        tokens.remove("plotter")
    assert unknown.value.hint == f"Known tokens: browser, {'x' * 64}."
    assert tokens.remove("browser") == 2
    assert (tokens.find(script), tokens.find(cookie)) == (None, None)
    tokens.remove("x" * 64)
    with pytest.raises(NotFoundError) as unknown:
        tokens.remove("plotter")
    assert unknown.value.hint == "Known tokens: none."


def test_tokens_of_another_process_are_read_as_soon_as_their_file_is_another_or_gone(tmp_path: Path) -> None:
    tokens, file = Tokens(tmp_path), tmp_path / "ncap-tokens.json"
    first = tokens.add("a")
    assert tokens.is_good(digest_of(first))
    before = file.stat()
    second = Tokens(tmp_path).add("b")
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert all(tokens.is_good(digest_of(token)) for token in (first, second)), "another file of the same moment"
    file.unlink()
    assert not tokens.is_good(digest_of(first))
    file.write_text("{}")
    with pytest.raises(StoreError) as unreadable:
        tokens.find(first)
    assert unreadable.value.hint == "Remove the file and create new tokens: ncap token add NAME"


def answer_of(guard: Guard, **scope: Any) -> tuple[int, dict[str, str], str]:
    """Return status, headers and text of the answer to one request."""
    sent: list[Message] = []

    async def send(message: Message) -> None:
        sent.append(message)

    none: Any = None
    given = {"type": "http", "method": "GET", "path": "/", "query_string": b"", **scope}
    given["headers"] = [(name.encode(), value.encode()) for name, value in scope.get("headers", {}).items()]
    asyncio.run(guard(given, none, send))
    headers = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    return int(sent[0]["status"]), headers, b"".join(message.get("body", b"") for message in sent[1:]).decode()


def test_who_came_by_the_users_own_socket_is_nobody_else_in_the_log(tmp_path: Path) -> None:
    """The audit log has the user there; ``socket`` is no name of anybody, and a token may have it."""
    actors: list[tuple[str | None, str]] = []

    async def page(scope: Scope, _receive: Receive, send: Send) -> None:
        actors.append((ACTOR.get(), scope["teds.caller"].owner))
        await send({"type": "http.response.start", "status": 200, "headers": []})

    tokens = Tokens(tmp_path)
    with acting_for("token plotter"):
        assert status_of(Guard(page, tokens, None), {}) == 200
    script = {"host": HERE, "authorization": f"Bearer {tokens.add('socket')}"}
    assert status_of(Guard(page, tokens, front((), PORT, tls=False)), script) == 200
    assert actors == [(None, "ncap"), ("token socket", "api:socket")]


@pytest.mark.parametrize(("slowed", "waits"), [(49, True), (50, False)])
def test_at_most_fifty_requests_are_slowed_down_at_once(
    tmp_path: Path, slowed: int, waits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fifty-first is refused without a wait: each that waits has one of the places that all share."""
    guard = Guard(app, Tokens(tmp_path), front((), PORT, tls=False))
    guard._wrong.extend([time.monotonic()] * 10)
    guard._slowed = slowed
    slept: list[float] = []

    async def sleep(seconds: float) -> None:
        slept.append(seconds)

    monkeypatch.setattr("teds_provision.ncap.web.guard.asyncio.sleep", sleep)
    assert status_of(guard, {"host": HERE, "authorization": "Bearer nonsense"}) == 429
    assert (slept, guard._slowed) == ([1.0] if waits else [], slowed)


def test_who_leaves_while_it_is_slowed_down_leaves_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fifty that hung up would have kept all places for ever, and nobody would be slowed down any more."""
    guard = Guard(app, Tokens(tmp_path), front((), PORT, tls=False))

    async def sleep(_seconds: float) -> None:
        raise asyncio.CancelledError

    monkeypatch.setattr("teds_provision.ncap.web.guard.asyncio.sleep", sleep)
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(guard._slow_down())
    assert guard._slowed == 0


def test_a_wrong_token_counts_for_a_minute_and_a_hundred_at_most_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    guard, now = Guard(app, Tokens(tmp_path), front((), PORT, tls=False)), [100.0]

    async def sleep(_seconds: float) -> None:
        """Wait no time."""

    monkeypatch.setattr("teds_provision.ncap.web.guard.asyncio.sleep", sleep)
    monkeypatch.setattr("teds_provision.ncap.web.guard.time", SimpleNamespace(monotonic=lambda: now[0]))
    statuses = [asyncio.run(guard._wrong_token()).status for _ in range(11)]
    assert statuses == [401] * 10 + [429]
    now[0] += 60.0
    assert asyncio.run(guard._wrong_token()).status == 429, "a minute has not passed"
    now[0] += 0.5
    assert asyncio.run(guard._wrong_token()).status == 401
    for _ in range(200):
        asyncio.run(guard._wrong_token())
    assert len(guard._wrong) == 100


def test_the_login_address_is_asked_for_and_never_posted_to(tmp_path: Path) -> None:
    tokens = Tokens(tmp_path)
    guard, link = Guard(app, tokens, front((), PORT, tls=False)), tokens.login_link()
    words: dict[str, Any] = {"path": "/login", "query_string": f"token={link}".encode(), "headers": {"host": HERE}}
    for method in ("POST", "HEAD", "PUT"):
        status, _, text = answer_of(guard, method=method, **words)
        assert (status, json.loads(text)["error"]) == (
            405, {"code": "usage", "message": "The login address takes GET requests only.", "hint": ""},
        )  # fmt: skip
    words["headers"] = {"host": HERE, "accept": "text/html"}
    status, headers, text = answer_of(guard, **words)
    assert (status, headers["location"], text) == (303, "/", ""), "the link was not used up"
    assert answer_of(guard, path="/login", headers={"host": HERE})[0] == 401
    assert answer_of(guard, path="/login", headers={"host": "evil.example"})[0] == 421


def test_a_body_that_is_too_long_ends_its_connection_and_no_other_refusal_does(tmp_path: Path) -> None:
    """The rest of the body would be read as the next request."""
    tokens = Tokens(tmp_path)
    guard = Guard(app, tokens, front((), PORT, tls=False))
    good = {"host": HERE, "authorization": f"Bearer {tokens.add('script')}"}
    long = {**good, "content-length": str(MEBI + 1), "content-type": "application/json"}
    status, headers, text = answer_of(guard, method="PUT", headers=long)
    assert (status, headers["connection"], headers["content-type"]) == (413, "close", "application/json")
    assert json.loads(text)["error"]["message"] == "The request body may have at most 1048576 octets."
    assert headers["content-length"] == str(len(text))
    for refused in ({"host": HERE}, {**good, "host": "evil.example"}):
        assert "connection" not in answer_of(guard, headers=refused)[1]
    both = {**good, "content-length": "4", "transfer-encoding": "chunked"}
    status, headers, _ = answer_of(guard, method="PUT", headers=both)
    assert (status, headers["connection"]) == (400, "close")


def test_a_browsers_address_line_is_refused_by_a_page_and_a_script_by_json(tmp_path: Path) -> None:
    guard = Guard(app, Tokens(tmp_path), front((), PORT, tls=False))
    html = {"host": HERE, "accept": "text/html,*/*"}
    for scope, page in (
        ({"headers": html}, True),
        ({"headers": {"host": HERE}}, False),
        ({"headers": html, "method": "POST"}, False),
        ({"headers": html, "type": "websocket"}, False),
    ):
        status, headers, text = answer_of(guard, **scope)
        assert (status, headers["content-type"]) == (401, "text/html; charset=utf-8" if page else "application/json")
        assert text.startswith("<!doctype html>" if page else '{"error": {"code": "no-token"'), text
        assert "teds-provision ncap open" in text


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_tokens_that_cannot_be_read_are_reported_without_their_folder(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens = Tokens(tmp_path)

    def find(_token: str) -> None:
        raise StoreError("/home/me/ncap-tokens.json cannot be read.", hint="Look at /home/me/ncap-tokens.json.")

    monkeypatch.setattr(tokens, "find", find)
    guard = Guard(app, tokens, front((), PORT, tls=False))
    status, _, text = answer_of(guard, type=kind, headers={"host": HERE, "authorization": "Bearer x"})
    error = {"code": "store", "message": "ncap-tokens.json cannot be read.", "hint": "Look at ncap-tokens.json."}
    assert (status, json.loads(text)["error"]) == (503, error)


def test_a_cookie_header_that_comes_twice_is_one(tmp_path: Path) -> None:
    """RFC 9113, section 8.2.3: a proxy may split it."""
    tokens = Tokens(tmp_path)
    guard = Guard(app, tokens, front((), PORT, tls=False))
    mine = f"ncap-{PORT}={tokens.login(tokens.login_link())}"
    for first, second in (("a=1", mine), (mine, "a=1")):
        assert status_of(guard, {"host": HERE, "cookie": first}, more=("Cookie", second)) == 200
    assert status_of(guard, {"host": HERE, "cookie": "a=1; ncap-8452=x"}) == 401, "another service's"
