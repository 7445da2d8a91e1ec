"""The last hour of every channel that is measured, in the memory of the station: it outlives a reload of the page.

Bins of 1 s for an hour, and of 10 ms for the last minute. A bin holds the least and the greatest valid value (SI), how
many samples came, how many of them were not valid, and (those of 1 s) how many were lost. One channel takes 98.4 kB at
most, whatever its rate: 14 octets a second of the hour, 8 a bin of the minute. A thousand channels stay below 100 MB;
what was silent for an hour is forgotten.

If a channel's datasheet gives its values another meaning (unit, calibration, zero), a new segment begins: no bin holds
values of two segments. The bin in which it begins drops what the segment before left there.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Container, Iterable
from dataclasses import dataclass, replace
from typing import Any, Final

from teds_provision.arrays import NDArray, np
from teds_provision.errors import NotFoundError
from teds_provision.measure.blocks import Block, ChannelFacts
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.codec.model import Units

HOUR, MINUTE = 3600, 60
FINE: Final = 0.01  # seconds of a bin of the last minute
_WAITING = 4096  # blocks that wait to be taken in; a thread that brings more takes them in itself
_EVERY = 0.5  # seconds
_LATE: Final = 2.0  # seconds by which samples may come behind others; more, and the clock was put back

_EDGE: Final = 1e-6  # of a bin: a moment so short before an edge counts as behind it, as 0.01 is no binary fraction

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
        self._starts: list[tuple[int, int]] = []  # first bin and number of each segment, both ascending

    def add(
        self, numbers: NDArray[Any], low: NDArray[Any], high: NDArray[Any], counts: NDArray[Any], segment: int
    ) -> None:
        """Take in bins of a segment, ascending and each once.

        ``counts`` has a row each for samples, invalid and lost ones.
        """
        first, last = int(numbers[0]), int(numbers[-1])
        if self.newest >= 0 and first < self.newest - _LATE / self.width:
            self._forget(first, self.newest)  # the clock was put back: that time is overwritten
            self.newest = first - 1
        self._extend_to(first, segment)
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

    def _extend_to(self, first: int, segment: int) -> None:
        """Let a segment begin at bin ``first`` at the latest; older segments lose their bins from there on."""
        if self._starts and self._starts[-1][1] == segment and self._starts[-1][0] <= first:
            return
        own = self._starts[-1][0] if self._starts and self._starts[-1][1] == segment else self.newest + 1
        if first < own:
            self._forget(first, own - 1)
        oldest = self.newest - self.size + 1
        kept = [start for start in self._starts if start[0] < first and start[1] != segment]
        gone = sum(start <= oldest for start, _ in kept[1:])  # segments without a bin in the ring
        self._starts = [*kept[gone:], (first, segment)]

    @property
    def segments(self) -> set[int]:
        """The segments that may have bins here."""
        return {segment for _, segment in self._starts}

    def segments_of(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Return the segment of each bin."""
        at = np.searchsorted([first for first, _ in self._starts], numbers, side="right") - 1
        return np.array([segment for _, segment in self._starts], np.int64)[at]

    def _forget(self, first: int, last: int) -> None:
        """Empty the bins from ``first`` to ``last``."""
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
        """Return number, least, greatest and counts of the non-empty bins from ``first`` to ``last``."""
        numbers = np.arange(max(first, self.newest - self.size + 1, 0), min(last, self.newest) + 1)
        slots = numbers % self.size
        nothing = np.zeros(len(slots), np.int64)
        counts = np.stack([nothing if held is None else held[slots].astype(np.int64) for held in self._counts])
        some = counts.any(axis=0)
        slots, counts = slots[some], counts[:, some]
        if self.coarse:
            counts = np.vstack([counts, nothing[some]])
        return numbers[some], self._low[slots], self._high_of(slots), counts


@dataclass(frozen=True)
class _Meaning:
    """Meaning of a channel's values: values of two meanings are not compared."""

    unit: str = ""
    units: Units | None = None
    calibration: Calibration | None = None
    turn: tuple[float | None, float | None] | None = None  # limits between which its values wrap
    unsigned: bool = False
    raw: bool = False  # it has no values: raw numbers are kept

    @classmethod
    def from_facts(cls, facts: ChannelFacts, *, raw: bool = False) -> _Meaning:
        """Return it; a calibration that was only dated or documented again is the same one."""
        calibration = facts.calibration
        if calibration is not None:
            calibration = replace(calibration, date=None, zeroed=None, interval=None, points=(), by="")
        turn = (facts.low, facts.high) if facts.full_turn else None
        return cls(facts.unit, facts.units, calibration, turn, facts.unsigned, raw)


_NOTHING_KNOWN: Final = _Meaning()


def raw_numbers(block: Block, column: int) -> NDArray[Any]:
    """Return the raw values of a channel as numbers; NaN for what is none."""
    raw = block.raw[:, column]
    if raw.dtype != object:
        return np.asarray(raw, np.float64)
    return np.array(
        [float(number) if isinstance(number, int | float) else np.nan for number in raw.tolist()], np.float64
    )


class _Channel:
    def __init__(self, meaning: _Meaning) -> None:
        self.hour = _Bins(1.0, HOUR, coarse=False)
        self.minute = _Bins(FINE, round(MINUTE / FINE), coarse=True)
        self.segment, self.meaning = 0, meaning
        self._meanings = {0: meaning}

    def begin_segment(self, meaning: _Meaning) -> None:
        """Let what comes from now on be of another segment."""
        self.segment, self.meaning = self.segment + 1, meaning
        self._meanings = {
            segment: known
            for segment, known in self._meanings.items()
            if any(segment in bins.segments for bins in (self.hour, self.minute))
        } | {self.segment: meaning}

    def described(self, segment: int) -> dict[str, Any]:
        """Return a segment with its SI unit; one of raw numbers has none."""
        meaning = self._meanings[segment]
        return {"id": segment, "unit": "", "raw": True} if meaning.raw else {"id": segment, "unit": meaning.unit}


@dataclass
class _Stream:
    """Expected continuation of a stream: samples in a gap before it were lost."""

    run: tuple[int, int | None]
    expected: int


class History:
    """The last hour of all channels. ``block`` may be called from any thread and returns at once."""

    def __init__(self) -> None:
        self._waiting: deque[Block | dict[Key, _Meaning]] = deque()
        self._channels: dict[Key, _Channel] = {}
        self._meanings: dict[Key, _Meaning] = {}
        self._streams: dict[tuple[str, int], _Stream] = {}
        self._turn = threading.Lock()
        self._end = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Take in blocks, in a thread, until :meth:`close`."""
        self._thread = threading.Thread(target=self._run, name="past", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._end.set()
        if self._thread is not None:
            self._thread.join(5.0)

    def learn(self, facts: Iterable[ChannelFacts], raw: Container[Key] = ()) -> None:
        """Take the facts of channels whose blocks come from now on: with another meaning a new segment begins.

        Channels in ``raw`` have raw numbers alone.
        """
        self._waiting.append({known.key: _Meaning.from_facts(known, raw=known.key in raw) for known in facts})

    def block(self, block: Block) -> None:
        """Queue samples of a stream; a test pattern is no measurement."""
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
                item = self._waiting.popleft()
                if isinstance(item, dict):
                    self._meanings.update(item)
                else:
                    self._put(item)

    def _channel(self, key: Key) -> _Channel:
        """Return a channel, in the segment of what its values mean now."""
        meaning = self._meanings.get(key, _NOTHING_KNOWN)
        channel = self._channels.get(key)
        if channel is None:
            channel = self._channels[key] = _Channel(meaning)
        elif channel.meaning != meaning:
            channel.begin_segment(meaning)
        return channel

    def _put(self, block: Block) -> None:
        at = np.asarray(block.time, np.float64)
        run, key = (block.run, block.channels[0]), (block.uuid, block.stream)
        known = self._streams.get(key)
        lost = max(0, block.index - known.expected) if known is not None and known.run == run else 0
        self._streams[key] = _Stream(run, block.index + len(block.time))
        valid = np.asarray(block.valid, bool)
        values = np.where(valid, block.value, np.nan)
        for column, number in enumerate(block.channels):
            if self._meanings.get((block.uuid, number), _NOTHING_KNOWN).raw:
                values[:, column] = raw_numbers(block, column)
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
                one = self._channel((block.uuid, number))
                bins = one.minute if fine else one.hour
                counts = np.stack([total, invalid[:, column], gone])
                bins.add(numbers, low[:, column], high[:, column], counts, one.segment)

    # -- what is asked -----------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        """Return the number of channels with a history."""
        return len(self._channels)

    def channel_history(
        self, uuid: str, channel: int, since: float | None = None, until: float | None = None, points: int = 600
    ) -> dict[str, Any]:
        """Return at most ``points`` bins of a channel between two moments (unix seconds; None: an hour ago, now).

        ``bin`` is their width in s, ``time`` their beginnings; a bin in which nothing happened is left out. ``low`` and
        ``high`` are SI values, None where none was valid, or raw numbers in a segment that is ``raw`` (no calibration).
        The last minute is given in bins of 10 ms if no more is asked for. ``segment`` is the ``id`` of each bin's
        segment, ``segments`` has the SI ``unit`` of each: values of two segments have different meanings. Raises
        NotFoundError if nothing of the channel was measured in that hour.
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
            segments = bins.segments_of(numbers)
            known = [one.described(int(segment)) for segment in dict.fromkeys(segments.tolist())]
            rate = _rate(one.hour)
        each = max(1, -(-(last - first + 1) // max(1, points)))
        if len(numbers) and each > 1:
            numbers, segments, low, high, counts = _together(numbers // each, segments, low, high, counts)
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
            "segment": segments.tolist(),
            "segments": known,
        }


def _rate(hour: _Bins) -> float | None:
    """Return samples a second of the last ten whole seconds that have any; None if they are long past."""
    newest = hour.newest
    numbers, _, _, counts = hour.between(newest - 10, newest - 1)
    if not len(numbers) or newest < time.time() - 60:
        return None
    return float(counts[0].sum() / (newest - int(numbers[0])))


def _bins_of(times: NDArray[Any], width: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return numbers of the bins of ascending times, each once, and where each begins among them."""
    numbers = np.floor(np.maximum.accumulate(times) / width + _EDGE).astype(np.int64)
    starts = np.flatnonzero(np.diff(numbers, prepend=numbers[0] - 1))
    return numbers[starts], starts


def _together(
    numbers: NDArray[Any], segments: NDArray[Any], low: NDArray[Any], high: NDArray[Any], counts: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return one bin for those of the same number and segment."""
    changes = np.diff(numbers, prepend=numbers[0] - 1) | np.diff(segments, prepend=segments[0])
    starts = np.flatnonzero(changes)
    with np.errstate(invalid="ignore"):
        least, most = np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)
    return numbers[starts], segments[starts], least, most, np.add.reduceat(counts, starts, axis=1)


def _plain(values: NDArray[Any]) -> list[float | None]:
    return [float(f"{value:.7g}") if value == value else None for value in values.tolist()]  # noqa: PLR0124 - NaN
