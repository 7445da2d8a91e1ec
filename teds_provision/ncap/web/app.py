"""The routes of the API and of the page, as api.md lists them."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import Scope
from starlette.websockets import WebSocket, WebSocketDisconnect

from teds_provision.api.operations import API
from teds_provision.errors import NotFoundError, StoreError, TedsProvisionError
from teds_provision.ncap.daemon import Daemon
from teds_provision.ncap.live import LiveClient
from teds_provision.ncap.web import metrics, simulation, wot
from teds_provision.ncap.web.clause12 import Clause12
from teds_provision.ncap.web.guard import CALLER, SAFE, Caller, RequestRefusedError
from teds_provision.ncap.web.resources import Resources, routes_of_parts
from teds_provision.ncap.web.responses import ASKED, answer_bug, answer_error, answer_refusal, changing
from teds_provision.ncap.web.tokens import Tokens
from teds_provision.shapes.problem import Error, Problem

PAGE: Final = Path(__file__).parent.parent / "page"
MOST_LISTENERS: Final = 200
OF_ONE_TOKEN: Final = 100
"""Places that one token may have, while there is room."""
_FULL, _NOT_GOOD = 1013, 1008
_UUID: Final = re.compile(r"[0-9a-f]{20}")
_LONGEST_PATH: Final = 200
_OF_AN_ENTRY: Final = frozenset({"act", "uuid", "outcome"})


def build(daemon: Daemon) -> Starlette:
    """Return the application; the caller wraps it in a Guard."""
    routes: list[BaseRoute] = [
        Mount(
            API,
            routes=[
                *Resources(daemon).routes(),
                *routes_of_parts(daemon.parts.values()),
                WebSocketRoute("/live", _live(daemon)),
                WebSocketRoute("/virtual/{name}/source", simulation.feeding(daemon, _watched(daemon))),
                Route("/{rest:path}", _nothing),
            ],
        ),
    ]
    routes.append(wot.route(daemon))
    if daemon.settings.metrics:
        routes.append(metrics.route(daemon))
    if daemon.settings.clause_12:
        routes += Clause12(daemon).routes()
    if PAGE.is_dir():
        routes.append(Mount("/", _Page(directory=PAGE, html=True)))
    handlers: dict[Any, Any] = {
        TedsProvisionError: _noted(daemon),
        RequestRefusedError: answer_refusal,
        404: _no_page,
        405: _no_method,
        Exception: answer_bug,
    }
    return Starlette(routes=routes, exception_handlers=handlers)


def _noted(daemon: Daemon) -> Callable[[Request, Exception], Awaitable[Response]]:
    """Return errors as answers; a refused change is in the audit log with its client and reason.

    An invalid request (a wrong body, a node that does not exist) changes no log. A set point has its own entry.
    """

    def note(request: Request, error: TedsProvisionError) -> None:
        members = request.scope.get(ASKED, {})
        asked = {name: value for name, value in members.items() if name not in _OF_AN_ENTRY}
        node = str(request.path_params.get("uuid") or members.get("uuid", ""))
        uuid = bytes.fromhex(node) if _UUID.fullmatch(node) else None
        facts = {"method": request.method, "path": request.url.path[:_LONGEST_PATH], "why": error.message}
        with suppress(StoreError):
            daemon.station.audit("api", uuid, error.code, **{**asked, **facts})

    async def answer(request: Request, error: Exception) -> Response:
        assert isinstance(error, TedsProvisionError)
        shown = not isinstance(error, NotFoundError | StoreError) and "number" not in request.path_params
        if request.method not in SAFE and shown:
            await changing(note, request, error)
        return answer_error(request, error)

    return answer


class _Page(StaticFiles):
    """The files of the page; a browser asks whether they are still good."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return one file, which the browser has to revalidate."""
        response = await super().get_response(path, scope)
        response.headers["cache-control"] = "no-cache"
        return response


def _no_page(_request: Request, _error: Exception) -> Response:
    problem = Problem(code="not-found", message="Page not found.", hint="See /api/v1/openapi.json.")
    return JSONResponse(Error(error=problem), 404)


def _no_method(request: Request, error: Exception) -> Response:
    problem = Problem(code="usage", message=f"{request.method} is not allowed for this resource.", hint="")
    return JSONResponse(Error(error=problem), 405, headers=getattr(error, "headers", None))


async def _nothing(_request: Request) -> Response:
    raise NotFoundError("Resource not found.", hint="See /api/v1/openapi.json.")


class LiveSlots:
    """The places of /live, ``most`` in all and ``of_one`` for one token.

    If all are taken, a token with fewer places than the one that has most gets the newest place of that one: no client
    excludes the others, however many connections it opens.
    """

    def __init__(self, most: int = MOST_LISTENERS, of_one: int = OF_ONE_TOKEN) -> None:
        self._most, self._of_one = most, of_one
        self._taken: dict[str, list[Callable[[], object]]] = {}

    def acquire(self, token: str, leave: Callable[[], object]) -> bool:
        """Take a place; ``leave`` is called if it has to be given up for another token. False: there is none."""
        own = self._taken.get(token, [])
        if len(own) >= self._of_one:
            return False
        if sum(map(len, self._taken.values())) >= self._most:
            greedy = max(self._taken, key=lambda token: len(self._taken[token]))
            if len(self._taken[greedy]) <= len(own) + 1:
                return False
            out = self._taken[greedy][-1]
            self.release(greedy, out)
            out()
        self._taken.setdefault(token, []).append(leave)
        return True

    def release(self, token: str, leave: Callable[[], object]) -> None:
        """Give it back; one that was given up already is none any more."""
        own = self._taken.get(token, [])
        if leave in own:
            own.remove(leave)
        if not own:
            self._taken.pop(token, None)


def _live(daemon: Daemon) -> Callable[[WebSocket], Awaitable[None]]:
    places = LiveSlots()

    async def live(socket: WebSocket) -> None:
        caller: Caller = socket.scope[CALLER]
        leaving = asyncio.Event()
        leave = leaving.set
        if not places.acquire(caller.digest, leave):
            await socket.close(_FULL)
            return
        tasks: list[asyncio.Task[None]] = []
        try:
            await socket.accept()
            listener = daemon.live.join(reader=caller.read_only)
            try:
                tasks.append(asyncio.create_task(_send(socket, listener, daemon.first_message())))
                tasks.append(asyncio.create_task(_end_in_time(socket, daemon, caller, leaving)))
                while (await socket.receive())["type"] != "websocket.disconnect":
                    pass
            finally:
                daemon.live.remove_client(listener)
        finally:
            places.release(caller.digest, leave)
            for task in tasks:
                task.cancel()

    return live


def _watched(daemon: Daemon) -> simulation.Watch:
    """Return what ends the connection of a simulation whose token is invalid."""

    async def watch(socket: WebSocket, caller: Caller, leaving: asyncio.Event) -> None:
        await _end_in_time(socket, daemon, caller, leaving)

    return watch


async def _end_in_time(socket: WebSocket, daemon: Daemon, caller: Caller, leaving: asyncio.Event) -> None:
    """End the connection when its token is invalid, or its place is another one's."""
    while True:
        with suppress(TimeoutError):
            await asyncio.wait_for(leaving.wait(), daemon.waits.token)
        if leaving.is_set():
            code, why = _FULL, "This connection was closed to make room for another token."
        elif caller.kind != "socket" and not _is_good(daemon.tokens, caller.digest):
            code, why = _NOT_GOOD, "This token is invalid or has expired."
        else:
            continue
        with suppress(WebSocketDisconnect, RuntimeError, OSError):  # the client may have left already
            await socket.close(code, why)
        return


def _is_good(tokens: Tokens, digest: str) -> bool:
    try:
        return tokens.is_good(digest)
    except StoreError:  # while the file is unreadable, no token is accepted
        return False


async def _send(socket: WebSocket, listener: LiveClient, hello: dict[str, Any]) -> None:
    try:
        await socket.send_json(hello)
        while True:
            for text in await listener.wait():
                await socket.send_text(text)
    except (WebSocketDisconnect, RuntimeError, OSError):
        return  # the client has left; the receiving side notices that too
