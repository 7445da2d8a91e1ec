"""The servers: uvicorn on the Unix socket of the home, and on loopback (or, with TLS, elsewhere) if configured."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import Iterator
from typing import Any, Final

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from teds_provision.errors import LinkError
from teds_provision.ncap.settings import Settings
from teds_provision.ncap.web.guard import CALLER, App

# HTTP connections with time limits: a client that connects and sends nothing, or sends slowly, is disconnected.
#
# uvicorn waits without limit for the end of a request's head and body. A program without a token could open enough
# sockets to reach its limit of connections, and so lock out all other clients. So if there are too many connections,
# those without a good token are closed first, whatever they are sending.

MOST: Final = 500
"""Connections at once; of more than these the oldest without a good token is ended, else the one silent longest."""
HEAD: Final = 10.0
"""Seconds that the head of a request may take."""
BODY: Final = 30.0
"""Seconds that its body may take: 1 MiB at most."""
LONGEST_MESSAGE: Final = 1 << 16
"""Octets of a WebSocket message: lines of a simulation."""


class HttpConnection(H11Protocol):
    """uvicorn's, with an end to its patience."""

    _began = 0.0
    _heard = 0.0
    _awaited: Any = None
    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Handle a new connection: wait for the head of its first request."""
        super().connection_made(transport)
        self._began = self._heard = time.monotonic()
        self._await()
        if len(self.connections) >= MOST:
            self._make_room()

    def _make_room(self) -> None:
        """End the oldest connection without a good token, else the one that has been silent longest."""
        mine = [
            connection
            for connection in self.connections
            if isinstance(connection, HttpConnection) and connection is not self
        ]
        strangers = [http_connection for http_connection in mine if not http_connection.is_known]
        silent = [http_connection for http_connection in mine if http_connection.is_silent]
        if strangers:
            min(strangers, key=lambda http_connection: http_connection._began).end()
        elif silent:
            min(silent, key=lambda http_connection: http_connection._heard).end()
        else:
            self.limit_concurrency = MOST  # all connections have a running request: reply 503

    def connection_lost(self, exc: Exception | None) -> None:
        """Handle the end of a connection."""
        self._forget()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Handle a piece of a request."""
        self._heard = time.monotonic()
        super().data_received(data)
        self._await()

    @property
    def is_known(self) -> bool:
        """True if its request, or the one before, came with a good token (or by the Unix socket)."""
        scope: Any = self.scope  # None before its first request
        return scope is not None and CALLER in scope

    @property
    def is_silent(self) -> bool:
        """True if no request of it is running, nor any body on its way."""
        return self.conn.their_state is h11.IDLE

    def end(self) -> None:
        """Close it, without a word."""
        self.connections.discard(self)
        self.transport.abort()

    def _await(self) -> None:
        """Start the time limit of a head, or of a body, when it begins."""
        state = self.conn.their_state
        if state is self._awaited:
            return
        self._forget()
        patience = {h11.IDLE: HEAD, h11.SEND_BODY: BODY}.get(state)
        if patience is not None and not self.transport.is_closing():
            self._awaited = state
            self._late = self.loop.call_later(patience, self.end)

    def _forget(self) -> None:
        if self._late is not None:
            self._late.cancel()
        self._late = self._awaited = None


_ENDING: Final = 2
"""Seconds that open requests have at the end."""


class _Server(uvicorn.Server):
    """A server whose signals are the daemon's business."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals alone."""
        yield


def listen(host: str, port: int) -> socket.socket:
    """Return a listening TCP socket; raises LinkError if the address is taken or not this machine's."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(128)
    except (OSError, OverflowError) as error:
        listener.close()
        raise LinkError(
            f"Cannot serve the page on {host}:{port}: {getattr(error, 'strerror', None) or error}.",
            hint="Choose another address with --http.",
        ) from error
    return listener


class Servers:
    """Serves applications on listening sockets until :meth:`stop`."""

    def __init__(self) -> None:
        self._servers: list[_Server] = []
        self._tasks: list[asyncio.Task[None]] = []

    async def serve(self, app: App, listener: socket.socket, settings: Settings | None = None) -> None:
        """Begin; returns when it answers. ``settings`` bring TLS."""
        tls = settings if settings is not None and settings.certificate is not None else None
        config = uvicorn.Config(
            app,
            log_level="critical",
            log_config=None,
            access_log=False,
            lifespan="off",
            server_header=False,
            proxy_headers=False,
            http=HttpConnection,
            ws="websockets-sansio",
            ws_max_size=LONGEST_MESSAGE,
            ws_per_message_deflate=False,
            timeout_keep_alive=30,
            limit_concurrency=4 * MOST,  # of requests; one whose connection was closed counts for a moment longer
            timeout_graceful_shutdown=_ENDING,
            h11_max_incomplete_event_size=32_768,
            ssl_certfile=tls.certificate if tls else None,
            ssl_keyfile=tls.key if tls else None,
        )
        server = _Server(config)
        self._servers.append(server)
        task = asyncio.create_task(server.serve(sockets=[listener]))
        self._tasks.append(task)
        while not server.started and not task.done():
            await asyncio.sleep(0.005)
        if task.done():
            task.result()

    async def stop(self) -> None:
        """End every connection, in order as far as they answer."""
        for server in self._servers:
            server.should_exit = True
        await asyncio.gather(*self._tasks, return_exceptions=True)
