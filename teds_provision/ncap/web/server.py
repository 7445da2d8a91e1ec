"""The servers: uvicorn on the Unix socket of the home, and on loopback (or, with TLS, elsewhere) where asked for."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterator
from typing import Final

import uvicorn

from teds_provision.errors import LinkFailure
from teds_provision.ncap.settings import Settings
from teds_provision.ncap.web.connections import MOST, Connection
from teds_provision.ncap.web.guard import App

_ENDING: Final = 2
"""Seconds that open requests have at the end."""


class _Server(uvicorn.Server):
    """A server whose signals are the daemon's business."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave signals alone."""
        yield


def listen(host: str, port: int) -> socket.socket:
    """A listening TCP socket; raises LinkFailure where the address is taken or not this machine's."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(128)
    except (OSError, OverflowError) as error:
        listener.close()
        raise LinkFailure(
            f"The page cannot be served on {host}:{port}: {getattr(error, 'strerror', None) or error}.",
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
            http=Connection,
            ws="websockets-sansio",
            ws_max_size=4096,
            ws_per_message_deflate=False,
            timeout_keep_alive=30,
            limit_concurrency=4 * MOST,  # of requests; one of which the connection was ended counts for a moment more
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
