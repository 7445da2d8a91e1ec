"""The routes of the API and of the page, as api.md lists them."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import Scope
from starlette.websockets import WebSocket, WebSocketDisconnect

from teds_provision.client import API
from teds_provision.errors import NotFound, TedsProvisionError
from teds_provision.ncap.daemon import Daemon
from teds_provision.ncap.live import Listener
from teds_provision.ncap.web import metrics
from teds_provision.ncap.web.answers import answer_bug, answer_error, answer_refusal
from teds_provision.ncap.web.clause12 import Clause12
from teds_provision.ncap.web.guard import Refusal
from teds_provision.ncap.web.resources import Resources

PAGE: Final = Path(__file__).parent.parent / "page"
MOST_LISTENERS: Final = 200


def build(daemon: Daemon) -> Starlette:
    """The application; the guard goes in front of it."""
    routes: list[BaseRoute] = [
        Mount(
            API,
            routes=[
                *Resources(daemon).routes(),
                WebSocketRoute("/live", _live(daemon)),
                Route("/{rest:path}", _nothing),
            ],
        ),
    ]
    if daemon.settings.metrics:
        routes.append(metrics.route(daemon))
    if daemon.settings.clause_12:
        routes += Clause12(daemon).routes()
    if PAGE.is_dir():
        routes.append(Mount("/", _Page(directory=PAGE, html=True)))
    handlers: dict[Any, Any] = {
        TedsProvisionError: answer_error,
        Refusal: answer_refusal,
        404: _no_page,
        405: _no_method,
        Exception: answer_bug,
    }
    return Starlette(routes=routes, exception_handlers=handlers)


class _Page(StaticFiles):
    """The files of the page; a browser asks whether they are still good."""

    async def get_response(self, path: str, scope: Scope) -> Response:
        """One file."""
        response = await super().get_response(path, scope)
        response.headers["cache-control"] = "no-cache"
        return response


def _no_page(_request: Request, _error: Exception) -> Response:
    error = {"code": "not-found", "message": "There is no such page.", "hint": "See /api/v1/openapi.json."}
    return JSONResponse({"error": error}, 404)


def _no_method(request: Request, error: Exception) -> Response:
    told = {"code": "usage", "message": f"{request.method} is not for this resource.", "hint": ""}
    return JSONResponse({"error": told}, 405, headers=getattr(error, "headers", None))


async def _nothing(_request: Request) -> Response:
    raise NotFound("There is no such resource.", hint="See /api/v1/openapi.json.")


def _live(daemon: Daemon) -> Callable[[WebSocket], Awaitable[None]]:
    async def live(socket: WebSocket) -> None:
        if daemon.live.listeners >= MOST_LISTENERS:
            await socket.close(1013)
            return
        await socket.accept()
        listener = daemon.live.join()
        sender = asyncio.create_task(_send(socket, listener, daemon.hello()))
        try:
            while True:
                message = await socket.receive()
                if message["type"] == "websocket.disconnect":
                    break
        finally:
            daemon.live.leave(listener)
            sender.cancel()

    return live


async def _send(socket: WebSocket, listener: Listener, hello: dict[str, Any]) -> None:
    try:
        await socket.send_json(hello)
        while True:
            for text in await listener.wait():
                await socket.send_text(text)
    except (WebSocketDisconnect, RuntimeError, OSError):
        return  # it has gone; the receiving side sees that too
