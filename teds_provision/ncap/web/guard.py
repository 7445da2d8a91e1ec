"""In front of every request, WebSocket included: its origin, its token, and its body.

A page in the user's browser reaches a server on loopback, and so does any page of the net through it. So Host and
Origin are checked against an exact list, fetch metadata reveal whether another site asks, a token identifies the
client, and changes come as JSON, which a form cannot send. The Unix socket has the file's mode in place of all that.
"""

from __future__ import annotations

import asyncio
import html
import json
import time
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from typing import Any, Final, Literal
from urllib.parse import parse_qs

from teds_provision.api.operations import API, LARGEST_IMAGE
from teds_provision.errors import StoreError
from teds_provision.ncap.sinks import for_readers
from teds_provision.ncap.web.tokens import Tokens
from teds_provision.shapes.problem import Error, problem_of
from teds_provision.station.store.audit import ACTOR, by_token

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

CALLER: Final = "teds.caller"
LARGEST_BODY: Final = 1 << 20
_JSON, _OCTETS = "application/json", "application/octet-stream"
_UPDATES: Final = f"{API}/updates"
_WRONG_TOKENS: Final = 10
_WRONG_WITHIN: Final = 60.0
_SLOWED: Final = 1.0
_MOST_SLOWED: Final = 50  # at once; each one uses one of the places that all requests share
SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS"})
_CSP: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "font-src 'self'; manifest-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
)
HEADERS: Final = (
    (b"content-security-policy", _CSP.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cache-control", b"no-store"),
)


@dataclass(frozen=True)
class Caller:
    """The caller of a request: the user over the Unix socket, a browser with its cookie, or a script with its token."""

    name: str
    kind: Literal["socket", "browser", "script"]
    read_only: bool = False
    digest: str = ""
    """Digest of the token, which distinguishes two of one name; "" for the user's own socket."""

    @property
    def actor(self) -> str | None:
        """The actor for the audit log; None: the user who runs the daemon."""
        return {"socket": None, "browser": "page"}.get(self.kind, by_token(self.name))

    @property
    def owner(self) -> str:
        """Return the owner of a measurement that the caller begins; on the socket, which its user has, it is ncap."""
        return {"socket": "ncap", "browser": "page"}.get(self.kind, f"api:{self.name}")


@dataclass(eq=False)
class RequestRefusedError(Exception):
    """A refused request: status, code, message and hint."""

    status: int
    code: str
    message: str
    hint: str = ""
    headers: tuple[tuple[bytes, bytes], ...] = ()


@dataclass(frozen=True)
class ServedNames:
    """Under which names the page is served: ``host:port`` of each, and whether by TLS."""

    hosts: frozenset[str]
    port: int
    tls: bool = False

    @property
    def origins(self) -> frozenset[str]:
        """The origins that these names make."""
        return frozenset(f"{'https' if self.tls else 'http'}://{host}" for host in self.hosts)

    @property
    def cookie(self) -> str:
        """Name of the cookie: cookies know no ports, so the name does."""
        return f"ncap-{self.port}"


def front(hosts: tuple[str, ...], port: int, *, tls: bool) -> ServedNames:
    """Return the names of a server: loopback's always, and those that were allowed."""
    names = {
        "127.0.0.1",
        "localhost",
        "[::1]",
        *(f"[{host}]" if host.count(":") > 1 else host.lower() for host in hosts),
    }
    usual = 443 if tls else 80
    return ServedNames(frozenset({f"{name}:{port}" for name in names} | (names if port == usual else set())), port, tls)


@dataclass
class Guard:
    """Wraps the application. ``front`` None: the Unix socket, whose caller is the user."""

    app: App
    tokens: Tokens
    front: ServedNames | None
    _wrong: deque[float] = field(default_factory=deque)
    _slowed: int = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Judge one request or WebSocket before it reaches the application (ASGI)."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        begun = False

        async def with_headers(message: Message) -> None:
            nonlocal begun
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                begun = True
                own = {name.lower() for name, _ in message.get("headers", ())}
                more = [(name, value) for name, value in HEADERS if name not in own]
                message["headers"] = [*message.get("headers", ()), *more]
            await send(message)

        try:
            headers = _headers(scope)
            scope[CALLER] = await self._caller(scope, headers)
            ACTOR.set(scope[CALLER].actor)
            _require_may_change(scope, headers, scope[CALLER])
            await self.app(
                scope, _limited(receive, _largest(scope)) if scope["type"] == "http" else receive, with_headers
            )
        except (RequestRefusedError, StoreError) as error:
            refusal = error if isinstance(error, RequestRefusedError) else _unreadable(error)
            if not begun:
                await _refuse(scope, with_headers, refusal, as_page=_wants_html(scope))

    async def _caller(self, scope: Scope, headers: Mapping[str, str]) -> Caller:
        if self.front is None:
            return Caller("socket", "socket")
        _require_origin(self.front, headers)
        path = scope["path"]
        if path == "/login" and scope["type"] == "http":
            raise await self._login(scope)
        cookie, bearer = _cookie(headers, self.front.cookie), _bearer(headers)
        given = bearer or cookie
        if not given:
            raise RequestRefusedError(
                401, "no-token", "A token is required.", "Open the page with: teds-provision ncap open"
            )
        found = await asyncio.to_thread(self.tokens.find, given)
        if found is None:
            raise await self._wrong_token()
        if scope["type"] == "websocket" and found.kind == "browser" and "origin" not in headers:
            raise RequestRefusedError(403, "no-origin", "The WebSocket request has no Origin header.")
        return Caller(found.name, found.kind, found.read_only, found.digest)

    async def _login(self, scope: Scope) -> RequestRefusedError:
        """Trade the token of `ncap open` for a cookie, with a redirection to the page without it."""
        assert self.front is not None
        if scope["method"] != "GET":
            return RequestRefusedError(405, "usage", "The login address takes GET requests only.")
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        cookie = await asyncio.to_thread(self.tokens.login, given)
        if cookie is None:
            return await self._wrong_token()
        secure = "; Secure" if self.front.tls else ""
        value = f"{self.front.cookie}={cookie}; HttpOnly; SameSite=Strict; Path=/; Max-Age=2592000{secure}"
        return RequestRefusedError(303, "", "", headers=((b"set-cookie", value.encode()), (b"location", b"/")))

    async def _wrong_token(self) -> RequestRefusedError:
        now = time.monotonic()
        while self._wrong and now - self._wrong[0] > _WRONG_WITHIN:
            self._wrong.popleft()
        self._wrong.append(now)
        if len(self._wrong) > _WRONG_TOKENS:
            if len(self._wrong) > 10 * _WRONG_TOKENS:
                self._wrong.popleft()
            await self._slow_down()  # requests with a good token are never delayed, so a client cannot lock others out
            return RequestRefusedError(429, "too-many", "Too many wrong tokens.", headers=((b"retry-after", b"60"),))
        return RequestRefusedError(
            401, "wrong-token", "This token is invalid or has expired.", "Get a new one: teds-provision ncap open"
        )

    async def _slow_down(self) -> None:
        if self._slowed < _MOST_SLOWED:
            self._slowed += 1
            try:
                await asyncio.sleep(_SLOWED)
            finally:
                self._slowed -= 1


def _unreadable(failure: StoreError) -> RequestRefusedError:
    """Return the refusal if the file of the tokens cannot be read; it names no folder."""
    return RequestRefusedError(503, failure.code, for_readers(failure.message), for_readers(failure.hint))


def _headers(scope: Scope) -> dict[str, str]:
    found: dict[str, str] = {}
    for name, value in scope["headers"]:
        key = name.decode("latin-1").lower()
        if key in found and key in ("host", "origin", "content-length", "content-type", "authorization"):
            raise RequestRefusedError(400, "usage", f"Header {key} appears twice.")
        found[key] = value.decode("latin-1") if key not in found else f"{found[key]}; {value.decode('latin-1')}"
    # RFC 9112, section 6.3: proxies and servers may disagree which one applies
    if "content-length" in found and "transfer-encoding" in found:
        raise RequestRefusedError(
            400,
            "usage",
            "A request must not have both Content-Length and Transfer-Encoding.",
            headers=((b"connection", b"close"),),
        )
    return found


def _require_origin(named: ServedNames, headers: Mapping[str, str]) -> None:
    if headers.get("host", "").lower() not in named.hosts:
        raise RequestRefusedError(
            421,
            "foreign-host",
            "This host name is not allowed.",
            "Use the address that ncap open prints; see --http-allow.",
        )
    if "origin" in headers and headers["origin"].lower() not in named.origins:
        raise RequestRefusedError(403, "foreign-origin", "Requests from another origin are not allowed.")
    if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
        raise RequestRefusedError(403, "foreign-origin", "Requests from another site are not allowed.")


def _require_may_change(scope: Scope, headers: Mapping[str, str], caller: Caller) -> None:
    """Require, for a change, a token that may write, and JSON of limited size."""
    if scope["type"] != "http":
        return
    length, most = headers.get("content-length", ""), _largest(scope)
    if length.isdecimal() and int(length) > most:
        raise _too_large(most)
    if scope["method"] in SAFE:
        return
    if caller.read_only:
        raise RequestRefusedError(
            403, "read-only", f"Token {caller.name!r} is read-only.", "Use a token that was added without --read-only."
        )
    empty = scope["method"] == "DELETE" and length in ("", "0") and "transfer-encoding" not in headers
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    if _takes_image(scope):
        if kind != _OCTETS:
            raise RequestRefusedError(
                415, "not-octets", "A firmware image is sent as it is.", f"Send Content-Type: {_OCTETS}."
            )
    elif not empty and kind != _JSON:
        raise RequestRefusedError(
            415, "not-json", "Requests that change something must be JSON.", f"Send Content-Type: {_JSON}."
        )


def _takes_image(scope: Scope) -> bool:
    """Return True if the body is a firmware image; a form cannot send its type, nor JSON's."""
    return bool(scope["method"] == "POST" and scope["path"] == _UPDATES)


def _largest(scope: Scope) -> int:
    return LARGEST_IMAGE if _takes_image(scope) else LARGEST_BODY


def _too_large(most: int) -> RequestRefusedError:
    return RequestRefusedError(413, "too-large", f"The request body may have at most {most} octets.")


def _limited(receive: Receive, most: int) -> Receive:
    """Return a body without a stated length, cut off at the limit."""
    taken = 0

    async def next_message() -> Message:
        nonlocal taken
        message = await receive()
        taken += len(message.get("body", b""))
        if taken > most:
            raise _too_large(most)
        return message

    return next_message


def _cookie(headers: Mapping[str, str], name: str) -> str:
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(name)
    except CookieError:
        return ""
    return found.value if found is not None else ""


def _bearer(headers: Mapping[str, str]) -> str:
    scheme, _, token = headers.get("authorization", "").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else ""


def _wants_html(scope: Scope) -> bool:
    accept = dict(scope["headers"]).get(b"accept", b"")
    return scope["type"] == "http" and scope["method"] == "GET" and b"text/html" in accept


async def _refuse(scope: Scope, send: Send, refusal: RequestRefusedError, *, as_page: bool) -> None:
    """Send a refusal as JSON, to a browser's address line as a plain page."""
    if as_page and refusal.code:
        text = f"<!doctype html><html lang=en><meta charset=utf-8><title>{refusal.status}</title>"
        text += f"<p>{html.escape(refusal.message)}<p>{html.escape(refusal.hint)}"
        body, kind = text.encode(), b"text/html; charset=utf-8"
    else:
        body = json.dumps(Error(error=problem_of(refusal))).encode() if refusal.code else b""
        kind = b"application/json"
    headers = [(b"content-type", kind), (b"content-length", str(len(body)).encode()), *refusal.headers]
    if refusal.status == 413:
        headers.append((b"connection", b"close"))
    prefix = "websocket." if scope["type"] == "websocket" else ""
    await send({"type": f"{prefix}http.response.start", "status": refusal.status, "headers": headers})
    await send({"type": f"{prefix}http.response.body", "body": body})
