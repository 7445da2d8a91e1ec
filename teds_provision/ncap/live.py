"""Live values and events to many clients: values thinned to what a page can draw.

Blocks come from the receiver threads and are only queued. Every BEAT they become one message, which is encoded once for
all clients. A client has one slot for values: the newest wins, what it missed is counted and reported to it. Events are
never thinned; a client that leaves too many unread is sent ``resync``.
"""

from __future__ import annotations

import asyncio
import json
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Container, Iterable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Final

from teds_provision.arrays import NDArray, np
from teds_provision.measure.blocks import Block, ChannelFacts
from teds_provision.measure.sinks.json_events import plain
from teds_provision.ncap.history import History, raw_numbers
from teds_provision.ncap.sinks import for_readers
from teds_provision.teds.channel import TURN

_log = logging.getLogger(__name__)
BEAT: Final = 0.05  # seconds between two messages of values
POINTS: Final = 100.0  # most points a second and channel
_CREDIT: Final = 20.0  # points that a channel may save up, since samples come in bursts
_WAITING: Final = 512  # blocks between two beats; if there are more, the oldest are dropped
_EVENTS: Final = 256  # events that may be queued for a client
_TOLD: Final = 0.5  # seconds between two keep-alive messages

Key = tuple[str, int]


@dataclass(frozen=True)
class LastValue:
    """The newest value of a channel: SI unit of the datasheet, None if it is not valid; unix seconds."""

    value: float | None
    raw: Any
    time: float


class LiveClient:
    """One client. ``wait`` gives the next messages for it, each a JSON text.

    ``reader``: it may only read, so it receives no files and users of this machine.
    """

    def __init__(self, *, reader: bool = False) -> None:
        self.reader = reader
        self._values: str | None = None
        self._events: deque[str] = deque()
        self._dropped = 0
        self._news = asyncio.Event()
        self.dropped = 0

    def values(self, text: str) -> None:
        """Replace the values that wait: the newest win."""
        if self._values is not None:
            self._dropped += 1
            self.dropped += 1
        self._values = text
        self._news.set()

    def event(self, text: str) -> None:
        """Queue an event, in order; if there are too many none is kept, and the client is sent ``resync``."""
        if len(self._events) >= _EVENTS:
            self._events.clear()
            text = json.dumps({"type": "resync"})
        self._events.append(text)
        self._news.set()

    async def wait(self) -> list[str]:
        """Return the messages that are due, at least one."""
        await self._news.wait()
        self._news.clear()
        found = list(self._events)
        self._events.clear()
        if self._dropped:
            found.append(json.dumps({"type": "dropped", "messages": self._dropped}))
            self._dropped = 0
        if self._values is not None:
            found.append(self._values)
            self._values = None
        return found


@dataclass
class _Channel:
    credit: float = _CREDIT
    times: list[NDArray[Any]] = field(default_factory=list)
    values: list[NDArray[Any]] = field(default_factory=list)
    before: float = math.nan  # value of the last point that was sent


class Live:
    """The fan-out. ``block`` and ``event`` may be called from any thread and return at once.

    ``history`` keeps the last hour of what comes.
    """

    def __init__(self) -> None:
        self.history = History()
        self._lock = threading.Lock()
        self._waiting: deque[Block] = deque()
        self._channels: dict[Key, _Channel] = {}
        self._last: dict[Key, LastValue] = {}
        self._turning: frozenset[Key] = frozenset()
        self._raw: frozenset[Key] = frozenset()  # channels without calibration: their raw numbers are sent
        self._listeners: set[LiveClient] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self.overrun = 0
        self.values = 0
        self.on_event: Callable[[dict[str, Any]], None] = lambda _event: None
        """Gets every event as well: the daemon's lines."""

    # -- from any thread ---------------------------------------------------------------------------------------------

    def block(self, block: Block) -> None:
        """Queue samples of a stream."""
        self.history.block(block)
        with self._lock:
            if len(self._waiting) >= _WAITING:
                self._waiting.popleft()
                self.overrun += 1
            self._waiting.append(block)

    def learn(self, facts: Iterable[ChannelFacts], raw: Container[Key] = ()) -> None:
        """Record facts of channels: no line is drawn from one end of a full turn to the other.

        Channels in ``raw`` have raw numbers alone.
        """
        every = list(facts)
        self.history.learn(every, raw)
        keys = {known.key for known in every}
        self._raw = (self._raw - keys) | {key for key in keys if key in raw}
        turning = {facts.key for facts in every if facts.full_turn}
        self._turning = (self._turning - {facts.key for facts in every}) | turning

    def event(self, event: str, **facts: Any) -> None:
        """Send an event about a node, a measurement, a link or a step to every client, in order."""
        line = {"event": event, "time": time.time(), **facts}
        self.on_event(line)
        text = json.dumps({"type": "event", **line})
        loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._broadcast, text, json.dumps({"type": "event", **for_readers(line)}))

    def last(self, uuid: str, channel: int) -> LastValue | None:
        """Return the newest value of a channel."""
        return self._last.get((uuid, channel))

    # -- in the event loop -------------------------------------------------------------------------------------------

    def join(self, *, reader: bool = False) -> LiveClient:
        """Add a client."""
        listener = LiveClient(reader=reader)
        self._listeners.add(listener)
        return listener

    def remove_client(self, listener: LiveClient) -> None:
        """Remove a client."""
        self._listeners.discard(listener)

    @property
    def listeners(self) -> int:
        """How many clients listen."""
        return len(self._listeners)

    async def run(self) -> None:
        """Give out what came, every BEAT, until cancelled."""
        self._loop = asyncio.get_running_loop()
        reported_at = before = time.monotonic()
        while True:
            await asyncio.sleep(BEAT)
            now = time.monotonic()
            try:
                changed = self._gather(now - before)
            except Exception:  # noqa: BLE001 - what one node sends ends the live channel of no client
                _log.exception("Values of one beat cannot be shown.")
                self._channels, changed = {}, {}
            before = now
            if changed:
                names = {f"{uuid}/{number}" for uuid, number in self._raw}
                raw = {name: points for name, points in changed.items() if name in names}
                values = {name: points for name, points in changed.items() if name not in raw}
                message: dict[str, Any] = {"type": "values", "time": time.time(), "channels": values}
                text = json.dumps({**message, "raw": raw} if raw else message)
                for listener in self._listeners:
                    listener.values(text)
            if now - reported_at >= _TOLD:
                reported_at = now
                beat = json.dumps({"type": "beat", "time": time.time()})
                self._broadcast(beat, beat)

    def _broadcast(self, text: str, for_reader: str) -> None:
        for listener in self._listeners:
            listener.event(for_reader if listener.reader else text)

    def _gather(self, seconds: float) -> dict[str, list[list[float | None]]]:
        """Return what came since the last beat, by ``uuid/channel``: times and values."""
        with self._lock:
            blocks, self._waiting = self._waiting, deque()
        if not blocks and not self._channels:
            return {}
        touched = self._put_aside(blocks)
        out: dict[str, list[list[float | None]]] = {}
        for key, channel in self._channels.items():
            channel.credit = min(_CREDIT, channel.credit + POINTS * seconds)
            if key not in touched or not self._listeners:
                channel.times, channel.values = [], []
                continue
            times, values = np.concatenate(channel.times), np.concatenate(channel.values)
            channel.times, channel.values = [], []
            turning = key in self._turning
            times, values = thinned(
                times, values, int(channel.credit), **({"before": channel.before} if turning else {})
            )
            if len(values):
                channel.before = float(values[-1])
            channel.credit -= len(times)
            self.values += len(times)
            if len(times):
                numbers = [float(f"{value:.7g}") if math.isfinite(value) else None for value in values.tolist()]
                out[f"{key[0]}/{key[1]}"] = [np.round(times, 4).tolist(), numbers]
        return out

    def _put_aside(self, blocks: Iterable[Block]) -> set[Key]:
        touched: set[Key] = set()
        for block in blocks:
            if block.test_pattern or not len(block.time):
                continue
            for column, number in enumerate(block.channels):
                key = block.uuid, number
                one = self._channels.setdefault(key, _Channel())
                one.times.append(block.time)
                if key in self._raw:
                    one.values.append(raw_numbers(block, column))
                else:
                    one.values.append(np.where(block.valid[:, column], block.value[:, column], np.nan))
                touched.add(key)
                value = float(block.value[-1, column]) if block.valid[-1, column] else None
                self._last[key] = LastValue(value, plain(block.raw[-1:, column].tolist()[0]), float(block.time[-1]))
        return touched


def thinned(
    times: NDArray[Any], values: NDArray[Any], most: int, *, before: float | None = None
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return at most ``most`` of these points, among them the least and the greatest of each of ``most // 2`` parts.

    Points stay in order and are measured ones; of a part without a value its first is kept, as a gap. ``before`` is the
    last point before, for angles (rad) that wrap at a full turn: a gap is inserted if they continue at the other end of
    the turn, and there are fewer parts if necessary.
    """
    if before is None:
        return _extremes(times, values, most)
    for points in (most, most // 2):
        found = _parted(*_extremes(times, values, points), before)
        if len(found[0]) <= most:
            return found
    return times[:0], values[:0]


def _parted(times: NDArray[Any], values: NDArray[Any], before: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return angles with a gap wherever one is more than half a turn from the one before it."""
    if not len(times):
        return times, values
    with np.errstate(invalid="ignore"):
        across = np.flatnonzero(np.abs(np.diff(values, prepend=before)) > TURN / 2)
    between = (times[np.maximum(across - 1, 0)] + times[across]) / 2
    return np.insert(times, across, between), np.insert(values, across, np.nan)


def _extremes(times: NDArray[Any], values: NDArray[Any], most: int) -> tuple[NDArray[Any], NDArray[Any]]:
    if len(times) <= most:
        return times, values
    parts = most // 2
    if parts < 1:
        return times[:0], values[:0]
    kept: list[int] = []
    edges = np.linspace(0, len(times), parts + 1).astype(int)
    for begin, end in pairwise(edges.tolist()):
        part = values[begin:end]
        if np.isnan(part).all():
            kept.append(int(begin))
            continue
        kept += sorted({int(begin + np.nanargmin(part)), int(begin + np.nanargmax(part))})
    return times[kept], values[kept]
