"""The last hour of every channel that is measured, in the memory of the station: it outlives a reload of the page.

Bins of 1 s for an hour, and of 10 ms for the last minute. A bin holds the least and the greatest valid value (SI), how
many samples came, how many of them were not valid, and (those of 1 s) how many were lost. One channel takes 98.4 kB at
most, whatever its rate: 14 octets a second of the hour, 8 a bin of the minute. A thousand channels stay below 100 MB;
what was silent for an hour is forgotten.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import NotFoundError
from teds_provision.lazy import late

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from teds_provision.measure.blocks import Block
else:
    np = late("numpy")

HOUR, MINUTE = 3600, 60
FINE: Final = 0.01  # seconds of a bin of the last minute
_WAITING = 4096  # blocks that wait to be taken in; whoever brings more takes them in himself
_EVERY = 0.5  # seconds
_LATE: Final = 2.0  # seconds by which samples may come behind others; more, and the clock was put back

_EDGE: Final = 1e-6  # of a bin: a moment so short before an edge lies behind it, as 0.01 is no binary fraction

Key = tuple[str, int]


class _Bins:
    """A ring of bins of one width, by their number since 1970. The newest is ``newest``; those before it stay ``size``.

    ``coarse``: the greatest value is kept as the distance from the least, rounded up to 8 bits of mantissa (0.4 % of
    the distance, 0.8 at most), and counts end at 255: half the memory. Else both are Float32, counts end at 65535.
    """

    def __init__(self, width: float, size: int, *, coarse: bool) -> None:
        self.width, self.size, self.coarse = width, size, coarse
        self.newest = -1
        counts = np.uint8 if coarse else np.uint16
        self._low = np.full(size, np.nan, np.float32)
        self._high = np.zeros(size, np.uint16) if coarse else np.full(size, np.nan, np.float32)
        # samples, invalid, lost; what never happened takes no memory
        self._counts: list[NDArray[Any] | None] = [np.zeros(size, counts), *([None] * (1 if coarse else 2))]
        self._type, self._most = counts, np.iinfo(counts).max

    def add(self, numbers: NDArray[Any], low: NDArray[Any], high: NDArray[Any], counts: NDArray[Any]) -> None:
        """Take in bins, ascending and each once; ``counts`` has a row each for samples, invalid and lost ones."""
        first, last = int(numbers[0]), int(numbers[-1])
        if self.newest >= 0 and first < self.newest - _LATE / self.width:
            self._forget(first, self.newest)  # the clock was put back: that time is written anew
            self.newest = first - 1
        if last > self.newest:
            self._forget(max(self.newest + 1, last - self.size + 1), last)
            self.newest = last
        kept = numbers > self.newest - self.size
        slots = numbers[kept] % self.size
        least = np.fmin(self._low[slots], low[kept]).astype(np.float32)
        self._put_high(slots, least, np.fmax(self._high_of(slots), high[kept]))
        self._low[slots] = least
        for row, more in enumerate(counts[: len(self._counts), kept]):
            held = self._counts[row]
            if held is None and more.any():
                held = self._counts[row] = np.zeros(self.size, self._type)
            if held is not None:
                held[slots] = np.minimum(held[slots].astype(np.int64) + more, self._most)

    def _forget(self, first: int, last: int) -> None:
        """Empty these bins and those between them."""
        slots = np.arange(first, last + 1) % self.size if last - first < self.size else slice(None)
        self._low[slots] = np.nan
        self._high[slots] = 0 if self.coarse else np.nan
        for held in self._counts:
            if held is not None:
                held[slots] = 0

    def _high_of(self, slots: NDArray[Any]) -> NDArray[Any]:
        if not self.coarse:
            return np.asarray(self._high[slots])
        return np.asarray(self._low[slots] + (self._high[slots].astype(np.uint32) << 16).view(np.float32))

    def _put_high(self, slots: NDArray[Any], low: NDArray[Any], high: NDArray[Any]) -> None:
        if not self.coarse:
            self._high[slots] = high
            return
        apart = np.nan_to_num(high - low, nan=0.0, posinf=3e38).astype(np.float32)
        self._high[slots] = ((apart.view(np.uint32).astype(np.uint64) + 0xFFFF) >> 16).astype(np.uint16)

    def between(self, first: int, last: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Number, least, greatest and counts of the bins from ``first`` to ``last`` in which something happened."""
        numbers = np.arange(max(first, self.newest - self.size + 1, 0), min(last, self.newest) + 1)
        slots = numbers % self.size
        nothing = np.zeros(len(slots), np.int64)
        counts = np.stack([nothing if held is None else held[slots].astype(np.int64) for held in self._counts])
        some = counts.any(axis=0)
        slots, counts = slots[some], counts[:, some]
        if self.coarse:
            counts = np.vstack([counts, nothing[some]])
        return numbers[some], self._low[slots], self._high_of(slots), counts


class _Channel:
    def __init__(self) -> None:
        self.hour = _Bins(1.0, HOUR, coarse=False)
        self.minute = _Bins(FINE, round(MINUTE / FINE), coarse=True)


@dataclass
class _Stream:
    """Where the samples of a stream go on: a gap before them was lost."""

    run: tuple[int, int | None]
    expected: int


class History:
    """The last hour of all channels. ``block`` may be called from any thread and returns at once."""

    def __init__(self) -> None:
        self._waiting: deque[Block] = deque()
        self._channels: dict[Key, _Channel] = {}
        self._streams: dict[tuple[str, int], _Stream] = {}
        self._turn = threading.Lock()
        self._end = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Take in what comes, in a thread of its own, until :meth:`close`."""
        self._thread = threading.Thread(target=self._run, name="past", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._end.set()
        if self._thread is not None:
            self._thread.join(5.0)

    def block(self, block: Block) -> None:
        """Samples of a stream; a test pattern is no measurement."""
        if block.test_pattern or not len(block.time):
            return
        self._waiting.append(block)
        if len(self._waiting) > _WAITING:
            self._take_in()

    def _run(self) -> None:
        looked = time.monotonic()
        while not self._end.wait(_EVERY):
            self._take_in()
            if time.monotonic() - looked > MINUTE:
                looked = time.monotonic()
                with self._turn:
                    gone = [key for key, channel in self._channels.items() if channel.hour.newest < time.time() - HOUR]
                    for key in gone:
                        del self._channels[key]

    def _take_in(self) -> None:
        with self._turn:
            while self._waiting:
                self._put(self._waiting.popleft())

    def _put(self, block: Block) -> None:
        at = np.asarray(block.time, np.float64)
        run, key = (block.run, block.channels[0]), (block.uuid, block.stream)
        known = self._streams.get(key)
        lost = max(0, block.index - known.expected) if known is not None and known.run == run else 0
        self._streams[key] = _Stream(run, block.index + len(block.time))
        valid = np.asarray(block.valid, bool)
        values = np.where(valid, block.value, np.nan)
        for fine in (False, True):
            numbers, starts = _bins_of(at, FINE if fine else 1.0)
            with np.errstate(invalid="ignore"):
                low = np.fmin.reduceat(values, starts, axis=0)
                high = np.fmax.reduceat(values, starts, axis=0)
            total = np.diff(np.append(starts, len(at)))
            invalid = np.add.reduceat(~valid, starts, axis=0, dtype=np.int64)
            gone = np.zeros(len(starts), np.int64)
            gone[0] = lost
            for column, number in enumerate(block.channels):
                one = self._channels.get((block.uuid, number))
                if one is None:
                    one = self._channels.setdefault((block.uuid, number), _Channel())
                bins = one.minute if fine else one.hour
                bins.add(numbers, low[:, column], high[:, column], np.stack([total, invalid[:, column], gone]))

    # -- what is asked -----------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        """How many channels have a past."""
        return len(self._channels)

    def channel_history(
        self, uuid: str, channel: int, since: float | None = None, until: float | None = None, points: int = 600
    ) -> dict[str, Any]:
        """At most ``points`` bins of a channel between two moments (unix seconds; None: an hour ago, now).

        ``bin`` is their width in s, ``time`` their beginnings; a bin in which nothing happened is left out. ``low`` and
        ``high`` are SI values, None where none was valid. The last minute is given in bins of 10 ms if no more is asked
        for. Raises NotFoundError where nothing of the channel was measured within the hour.
        """
        self._take_in()
        end = time.time() if until is None else until
        begin = end - HOUR if since is None else since
        with self._turn:
            one = self._channels.get((uuid, channel))
            if one is None:
                raise NotFoundError(
                    f"Nothing was measured of channel {channel} of node {uuid} within the last hour.",
                    hint="Start a measurement; the station keeps an hour of it in memory.",
                )
            newest = (one.minute.newest + 1) * FINE
            bins = one.minute if begin >= newest - MINUTE - 1 and end - begin <= MINUTE + 1 else one.hour
            first, last = (int(np.floor(moment / bins.width + _EDGE)) for moment in (begin, end))
            first, last = max(first, bins.newest - bins.size + 1), min(last, bins.newest)
            numbers, low, high, counts = bins.between(first, last)
            rate = _rate(one.hour)
        each = max(1, -(-(last - first + 1) // max(1, points)))
        if len(numbers) and each > 1:
            numbers, low, high, counts = _together(numbers // each, low, high, counts)
        width = bins.width * each
        return {
            "uuid": uuid,
            "channel": channel,
            "rate": rate,
            "since": begin,
            "until": end,
            "bin": width,
            "time": np.round(numbers * width, 3).tolist(),
            "low": _plain(low),
            "high": _plain(high),
            "count": counts[0].tolist(),
            "invalid": counts[1].tolist(),
            "lost": counts[2].tolist(),
        }


def _rate(hour: _Bins) -> float | None:
    """Samples a second of the last ten whole seconds in which there were some; None where they are long past."""
    newest = hour.newest
    numbers, _, _, counts = hour.between(newest - 10, newest - 1)
    if not len(numbers) or newest < time.time() - 60:
        return None
    return float(counts[0].sum() / (newest - int(numbers[0])))


def _bins_of(times: NDArray[Any], width: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Numbers of the bins of ascending times, each once, and where each begins among them."""
    numbers = np.floor(np.maximum.accumulate(times) / width + _EDGE).astype(np.int64)
    starts = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
    return numbers[starts], starts


def _together(
    numbers: NDArray[Any], low: NDArray[Any], high: NDArray[Any], counts: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Bins of the same number made one."""
    starts = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
    with np.errstate(invalid="ignore"):
        least, most = np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)
    return numbers[starts], least, most, np.add.reduceat(counts, starts, axis=1)


def _plain(values: NDArray[Any]) -> list[float | None]:
    return [float(f"{value:.7g}") if value == value else None for value in values.tolist()]  # noqa: PLR0124 - NaN
