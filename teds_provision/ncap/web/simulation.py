"""WebSocket `/virtual/NAME/source`: a simulation feeds its virtual transducer; one writer, a token that may write.

A message has lines as those of ``node run --source -``, of which ``t`` may be left out. The station answers with JSON
texts: ``ready`` first, ``set`` for actuators, ``skipped`` and ``limited`` for values that were not taken as they came.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from teds_provision.errors import LinkError, TedsProvisionError
from teds_provision.ncap.daemon import Daemon
from teds_provision.ncap.nodes.simulation import MOST_OCTETS, CheckedLines, FedChannel, Feed, Pace, fed_channels
from teds_provision.ncap.nodes.virtual import Virtual, opened_folder, short_path
from teds_provision.ncap.web.guard import CALLER, Caller, RequestRefusedError
from teds_provision.ncap.web.responses import changing, status_of

_STARTING: Final = 10.0  # seconds for a transducer's process to start
_AGAIN: Final = 0.2
_NEWS: Final = 1.0  # seconds between two messages about skipped lines
_GONE: Final = 1012  # the transducer was restarted or removed

Watch = Callable[[WebSocket, Caller, asyncio.Event], Awaitable[None]]


def feeding(daemon: Daemon, watch: Watch) -> Callable[[WebSocket], Awaitable[None]]:
    """Return the handler; ``watch`` ends the connection if its token is invalid."""

    async def feed(socket: WebSocket) -> None:
        caller: Caller = socket.scope[CALLER]
        if caller.read_only:
            raise RequestRefusedError(
                403,
                "read-only",
                f"Token {caller.name!r} is read-only.",
                "Use a token that was added without --read-only.",
            )
        loop, gone = asyncio.get_running_loop(), asyncio.Event()
        place = Feed(caller.owner, lambda: loop.call_soon_threadsafe(gone.set))
        try:
            virtual = daemon.virtuals.find(socket.path_params["name"])
            await changing(daemon.virtuals.begin_feed, virtual, place)
        except TedsProvisionError as error:
            raise _refused(error) from error
        try:
            channels = await asyncio.to_thread(fed_channels, virtual.folder)
            reader, writer = await _connected(virtual)
            try:
                await _Session(socket, place, channels, writer).run(
                    reader, gone, watch(socket, caller, asyncio.Event())
                )
            finally:
                writer.close()
        except TedsProvisionError as error:
            raise _refused(error) from error
        finally:
            await asyncio.shield(changing(daemon.virtuals.end_feed, virtual, place))

    return feed


def _refused(error: TedsProvisionError) -> RequestRefusedError:
    return RequestRefusedError(status_of(error), error.code, error.message, error.hint)


async def _connected(virtual: Virtual) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Connect to the transducer's process, which may be starting; raises LinkError."""
    until = time.monotonic() + _STARTING
    while True:
        with suppress(OSError), opened_folder(virtual.folder) as folder:
            return await asyncio.open_unix_connection(short_path(folder))
        if time.monotonic() > until:
            raise LinkError(f"{virtual.name or virtual.uuid} does not run.", hint="Try again, or see GET /virtual.")
        await asyncio.sleep(_AGAIN)


@dataclass
class _News:
    """Lines that were refused: how many, why last, and how many of them the simulation knows, since when."""

    count: int = 0
    why: str = ""
    sent: int = 0
    at: float = 0.0

    def note(self, why: str) -> None:
        """Count one."""
        if why:
            self.count, self.why = self.count + 1, why


@dataclass
class _Session:
    socket: WebSocket
    feed: Feed
    channels: list[FedChannel]
    writer: asyncio.StreamWriter
    skipped: _News = field(default_factory=_News)
    limited: _News = field(default_factory=_News)

    async def run(self, reader: asyncio.StreamReader, gone: asyncio.Event, watching: Awaitable[None]) -> None:
        """Take lines until the simulation, its token or its transducer is gone."""
        await self.socket.accept()
        tasks = [
            asyncio.ensure_future(work) for work in (self._receive_lines(), self._act(reader), gone.wait(), watching)
        ]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            states = self.socket.client_state, self.socket.application_state
            if states == (WebSocketState.CONNECTED, WebSocketState.CONNECTED):
                with suppress(WebSocketDisconnect, RuntimeError, OSError):
                    await self.socket.close(_GONE, "The transducer was restarted or removed.")
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _receive_lines(self) -> None:
        ready = {"ready": True, "channels": [channel.as_json() for channel in self.channels], "limit": MOST_OCTETS}
        lines, pace = CheckedLines(self.channels), Pace()
        with suppress(WebSocketDisconnect, RuntimeError, OSError):  # the client may have left already
            await self.socket.send_json(ready)
            while self.socket.client_state is WebSocketState.CONNECTED:
                with suppress(TimeoutError):
                    message = await asyncio.wait_for(self.socket.receive(), _NEWS)
                    if message["type"] == "websocket.disconnect":
                        return
                    octets = message.get("bytes") or (message.get("text") or "").encode()
                    await self._pass_on(octets, lines)
                    await self._send_news()
                    await asyncio.sleep(pace.delay(len(octets)))
                    continue
                await self._send_news()

    async def _pass_on(self, octets: bytes, lines: CheckedLines) -> None:
        """Give the good lines of a message to the node; a node that is behind holds the simulation up."""
        good = []
        for line in octets.split(b"\n"):
            if not line.strip():
                continue
            why, beyond = lines.check(line)
            self.skipped.note(why)
            self.limited.note(beyond)
            if not why:
                good.append(line + b"\n")
        self.feed.lines += len(good)
        self.feed.skipped = self.skipped.count
        self.writer.write(b"".join(good))
        await self.writer.drain()

    async def _send_news(self) -> None:
        """Report the first line of either kind at once, and the others of that kind once a second."""
        now = time.monotonic()
        for name, news in (("skipped", self.skipped), ("limited", self.limited)):
            if news.count > news.sent and (not news.sent or now - news.at >= _NEWS):
                news.sent, news.at = news.count, now
                await self.socket.send_json({name: news.count, "why": news.why})

    async def _act(self, reader: asyncio.StreamReader) -> None:
        """Send what actuators are set to, until the node's process ends."""
        with suppress(WebSocketDisconnect, RuntimeError, OSError, ValueError):
            while line := await reader.readline():
                found: Any = json.loads(line)
                await self.socket.send_json(found)
