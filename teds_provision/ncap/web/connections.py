"""One connection of HTTP: who opens it and says nothing, or says it slowly, loses it.

uvicorn waits without end for the end of a request's head and body. Its limit of connections would then keep everybody
out, by no more than so many sockets of a program that has no token. So where there are too many, those that have not
shown a good token go first, whatever they are sending.
"""

from __future__ import annotations

import asyncio
import time
from typing import Any, Final

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from teds_provision.ncap.web.guard import CALLER

MOST: Final = 500
"""Connections at once; of more than these the oldest without a good token is ended, else the one silent longest."""
HEAD: Final = 10.0
"""Seconds that the head of a request may take."""
BODY: Final = 30.0
"""Seconds that its body may take: 1 MiB at most."""


class Connection(H11Protocol):
    """uvicorn's, with an end to its patience."""

    _began = 0.0
    _awaited: Any = None
    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """It begins: the head of its first request is awaited."""
        super().connection_made(transport)
        self._began = time.monotonic()
        self._await()
        if len(self.connections) >= MOST:
            self._make_room()

    def _make_room(self) -> None:
        """End the oldest connection that works for nobody."""
        mine = [one for one in self.connections if isinstance(one, Connection) and one is not self]
        strangers = [one for one in mine if not one.is_known]
        useless = strangers or [one for one in mine if one.is_silent]
        if useless:
            min(useless, key=lambda one: one._began).end()
        else:
            self.limit_concurrency = MOST  # all of them work for somebody: 503

    def connection_lost(self, exc: Exception | None) -> None:
        """It has ended."""
        self._forget()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """A piece of a request."""
        super().data_received(data)
        self._await()

    @property
    def is_known(self) -> bool:
        """Whether its request, or the one before, came with a good token (or by the Unix socket)."""
        scope: Any = self.scope  # None before its first request
        return scope is not None and CALLER in scope

    @property
    def is_silent(self) -> bool:
        """Whether nothing that it asked for is being done, nor any body on its way."""
        return self.conn.their_state is h11.IDLE

    def end(self) -> None:
        """Close it, without a word."""
        self.connections.discard(self)
        self.transport.abort()

    def _await(self) -> None:
        """Time runs from the beginning of a head, and of a body, to its end."""
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
