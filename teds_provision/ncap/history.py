"""The last hour of every channel that is measured, in the memory of the station: it outlives a reload of the page.

Bins of 1 s for an hour, and of 10 ms for the last minute. A bin holds the least and the greatest valid value (SI), how
many samples came, how many of them were not valid, and (those of 1 s) how many were lost. One channel takes 98.4 kB at
most, whatever its rate: 14 octets a second of the hour, 8 a bin of the minute. Of a slow channel those bins of the
minute alone are kept that hold something. A thousand channels stay below 100 MB; what was silent for an hour is
forgotten.

If a channel's datasheet gives its values another meaning (unit, calibration, zero), a new segment begins: no bin holds
values of two segments. The bin in which it begins drops what the segment before left there.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Container, Iterable
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Any, Final

from teds_provision.arrays import NDArray, np
from teds_provision.errors import NotFoundError
from teds_provision.measure.blocks import Block, ChannelFacts, nearest_float
from teds_provision.ncap.bins import Bins, FewBins
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.codec.model import Units

HOUR, MINUTE = 3600, 60
FINE: Final = 0.01  # seconds of a bin of the last minute
_WAITING = 4096  # blocks in the queue; a thread that adds more processes them itself
_EVERY = 0.5  # seconds
_FEW: Final = 8  # blocks of at most so many instants are added one by one, which is faster than numpy's calls
_SLOW: Final = 25.0  # up to so many instants a second, only a few bins of the last minute are allocated
_EDGE: Final = 1e-6  # seconds: a moment so close before an edge counts as after it, since 0.01 is not a binary fraction

Key = tuple[str, int]


@dataclass(frozen=True)
class _Meaning:
    """Meaning of a channel's values: values of two meanings are not compared."""

    unit: str = ""
    units: Units | None = None
    calibration: Calibration | None = None
    turn: tuple[float | None, float | None] | None = None  # the limits between which its values wrap
    unsigned: bool = False
    raw: bool = False  # it has no values, so raw numbers are stored

    @classmethod
    def from_facts(cls, facts: ChannelFacts, *, raw: bool = False) -> _Meaning:
        """Return it; a calibration that was only dated or documented again is the same one."""
        calibration = facts.calibration
        if calibration is not None:
            calibration = replace(
                calibration, date=None, zeroed=None, interval=None, points=(), by="", certificate=None
            )
        turn = (facts.low, facts.high) if facts.full_turn else None
        return cls(facts.unit, facts.units, calibration, turn, facts.unsigned, raw)


_NOTHING_KNOWN: Final = _Meaning()


def raw_numbers(block: Block, column: int) -> NDArray[Any]:
    """Return the raw values of a channel as numbers; NaN for what is none."""
    raw = block.raw[:, column]
    if raw.dtype != object:
        return np.asarray(raw, np.float64)
    return np.array([nearest_float(number) for number in raw.tolist()], np.float64)


class _Channel:
    def __init__(self, meaning: _Meaning) -> None:
        self.hour = Bins(1.0, HOUR, coarse=False)
        self.minute: Bins | FewBins = FewBins(FINE, round(MINUTE / FINE))
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

    def add_one(self, at: float, value: float, invalid: int, lost: int) -> None:
        """Take in one sample."""
        self.hour.add_one(math.floor(at + _EDGE), value, invalid, lost, self.segment)
        minute = self.minute
        if isinstance(minute, FewBins) and minute.full:
            minute = self.minute = minute.all_bins()
        minute.add_one(math.floor((at + _EDGE) / FINE), value, invalid, lost, self.segment)

    def ring(self, *, fine: bool) -> Bins:
        """Return the bins of the last minute, or of the hour, for many samples at a time."""
        if not fine:
            return self.hour
        if isinstance(self.minute, FewBins):
            self.minute = self.minute.all_bins()
        return self.minute

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
        elif channel.meaning is not meaning and channel.meaning != meaning:
            channel.begin_segment(meaning)
        return channel

    def _put(self, block: Block) -> None:
        run, key = (block.run, block.channels[0]), (block.uuid, block.stream)
        known = self._streams.get(key)
        lost = max(0, block.index - known.expected) if known is not None and known.run == run else 0
        self._streams[key] = _Stream(run, block.index + len(block.time))
        # A slow channel sends what it kept during a pause as one block; _put_many would allocate a ring for it
        # permanently.
        if len(block.time) <= _FEW or len(block.time) - 1 <= _SLOW * float(block.time[-1] - block.time[0]):
            self._put_few(block, lost)
        else:
            self._put_many(block, lost)

    def _put_few(self, block: Block, lost: int) -> None:
        """Take in samples one by one; ``lost`` were missing before the first."""
        moments = list(accumulate(block.time.tolist(), max))
        for column, number in enumerate(block.channels):
            channel = self._channel((block.uuid, number))
            valid = block.valid[:, column].tolist()
            values = (raw_numbers(block, column) if channel.meaning.raw else block.value[:, column]).tolist()
            missing = lost
            for at, value, is_valid in zip(moments, values, valid, strict=True):
                channel.add_one(at, value if is_valid or channel.meaning.raw else math.nan, not is_valid, missing)
                missing = 0

    def _put_many(self, block: Block, lost: int) -> None:
        """Take in samples all at once; ``lost`` were missing before the first."""
        at = np.asarray(block.time, np.float64)
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
                counts = np.stack([total, invalid[:, column], gone])
                one.ring(fine=fine).add(numbers, low[:, column], high[:, column], counts, one.segment)

    # -- queries -----------------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        """Return the number of channels with a history."""
        return len(self._channels)

    def channel_history(
        self, uuid: str, channel: int, since: float | None = None, until: float | None = None, points: int = 600
    ) -> dict[str, Any]:
        """Return at most ``points`` bins of a channel between two moments (unix seconds; None: an hour ago, now).

        ``bin`` is their width in s, ``time`` their beginnings; a bin in which nothing happened is left out. ``low`` and
        ``high`` are SI values, None if none was valid, or raw numbers in a segment that is ``raw`` (no calibration).
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
            bins: Bins | FewBins = (
                one.minute if begin >= newest - MINUTE - 1 and end - begin <= MINUTE + 1 else one.hour
            )
            first, last = (int(np.floor((moment + _EDGE) / bins.width)) for moment in (begin, end))
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


def _rate(hour: Bins) -> float | None:
    """Return samples a second of the last ten whole seconds that have any; None if they are long past."""
    newest = hour.newest
    numbers, _, _, counts = hour.between(newest - 10, newest - 1)
    if not len(numbers) or newest < time.time() - 60:
        return None
    return float(counts[0].sum() / (newest - int(numbers[0])))


def _bins_of(times: NDArray[Any], width: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return numbers of the bins of ascending times, each once, and where each begins among them."""
    numbers = np.floor((np.maximum.accumulate(times) + _EDGE) / width).astype(np.int64)
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
