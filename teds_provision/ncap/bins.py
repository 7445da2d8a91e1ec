"""Bins of one width for the past of a channel: a ring of all of them, or those of a slow channel that hold something.

A bin holds the least and the greatest valid value, how many samples came, how many of them were not valid, and how many
were lost. Bins are numbered since 1970. Each belongs to a segment, within which values mean the same.
"""

from __future__ import annotations

import math
import struct
from array import array
from bisect import bisect_left, bisect_right
from typing import Any, Final, cast

from teds_provision.arrays import NDArray, np

_LATE: Final = 2.0  # seconds by which samples may arrive late; beyond that, the clock was set back
_MOST_FEW: Final = 1500  # bins; so many need two thirds of the memory of a ring with 6,000
_TIDY: Final = 32  # bins between two removals of old ones
_RARE: Final = 40  # bins with losses that are stored singly; for more of them, an array of all bins is smaller
_FARTHEST: Final = 3e38  # largest distance between two values of a bin
_REAL, _BITS = struct.Struct("<f"), struct.Struct("<I")


class SegmentedBins:
    """Common part of both kinds of bins: the newest bin, and the first bin of each segment."""

    def __init__(self, width: float, size: int) -> None:
        self.width, self.size = width, size
        self.newest = -1
        self._starts: list[tuple[int, int]] = []  # (first bin, segment), ascending in both

    def _forget(self, first: int, last: int) -> None:
        """Empty the bins from ``first`` to ``last``."""
        raise NotImplementedError

    def _reach(self, number: int, segment: int) -> bool:
        """Make room for bin ``number``, the next that is written; False if it is too old to be kept."""
        if self.newest >= 0 and number < self.newest - _LATE / self.width:
            self._forget(number, self.newest)  # the clock was set back: overwrite that time
            self.newest = number - 1
        if not self._starts or self._starts[-1][1] != segment or self._starts[-1][0] > number:
            self._extend_to(number, segment)
        if number > self.newest:
            self._forget(max(self.newest + 1, number - self.size + 1), number)
            self.newest = number
        return number > self.newest - self.size

    def _extend_to(self, first: int, segment: int) -> None:
        """Let a segment begin at bin ``first`` at the latest; older segments lose their bins from there on."""
        own = self._starts[-1][0] if self._starts and self._starts[-1][1] == segment else self.newest + 1
        if first < own:
            self._forget(first, own - 1)
        oldest = self.newest - self.size + 1
        kept = [start for start in self._starts if start[0] < first and start[1] != segment]
        gone = sum(start <= oldest for start, _ in kept[1:])  # segments whose bins have all left the ring
        self._starts = [*kept[gone:], (first, segment)]

    @property
    def segments(self) -> set[int]:
        """The segments that may have bins here."""
        return {segment for _, segment in self._starts}

    def segments_of(self, numbers: NDArray[Any]) -> NDArray[Any]:
        """Return the segment of each bin."""
        at = np.searchsorted([first for first, _ in self._starts], numbers, side="right") - 1
        return np.array([segment for _, segment in self._starts], np.int64)[at]


class Bins(SegmentedBins):
    """A ring of bins of one width, by their number. The newest is ``newest``; those before it stay ``size``.

    ``coarse``: the greatest value is kept as the distance from the least, rounded up to 8 bits of mantissa (0.4 % of
    the distance, 0.8 at most, and once more each time that the least value falls), and counts end at 255: half the
    memory. Else both are Float32, counts end at 65535.
    """

    def __init__(self, width: float, size: int, *, coarse: bool) -> None:
        super().__init__(width, size)
        self.coarse = coarse
        counts = np.uint8 if coarse else np.uint16
        self._low = np.full(size, np.nan, np.float32)
        self._high = np.zeros(size, np.uint16) if coarse else np.full(size, np.nan, np.float32)
        self._type, self._most = counts, int(np.iinfo(counts).max)
        # Samples, invalid, lost; of the last two, a few bins are stored singly.
        self._counts: list[NDArray[Any] | dict[int, int]] = [
            np.zeros(self.size, self._type),
            *({} for _ in range(1 if coarse else 2)),
        ]
        low, high = cast("Any", self._low), cast("Any", self._high)
        self._lows, self._highs = (
            cast("Any", memoryview(low)),
            cast("Any", memoryview(high)),
        )  # single numbers: a tenth of the time of indexing arrays

    def _count_in(self, row: int, slot: int, more: int) -> None:
        """Count in one slot."""
        held = self._counts[row]
        if isinstance(held, dict):
            held[slot] = min(held.get(slot, 0) + more, self._most)
            if len(held) > _RARE:
                self._counts[row] = whole = np.zeros(self.size, self._type)
                whole[list(held)] = list(held.values())
        else:
            held[slot] = min(int(held[slot]) + more, self._most)

    def add_one(self, number: int, value: float, invalid: int, lost: int, segment: int) -> None:
        """Take in one sample of a segment; ``value`` is NaN if there is none, ``invalid`` 1 if it is not valid."""
        if not self._reach(number, segment):
            return
        slot = number % self.size
        if value == value:  # noqa: PLR0124  NaN alone is not itself
            if self.coarse:
                self._widen(slot, value)
            else:
                if not self._lows[slot] <= value:
                    self._lows[slot] = value
                if not self._highs[slot] >= value:
                    self._highs[slot] = value
        for row, more in enumerate((1, invalid, lost)[: len(self._counts)]):
            if more:
                self._count_in(row, slot, more)

    def _widen(self, slot: int, value: float) -> None:
        """Let a coarse bin hold a value."""
        low = self._lows[slot]
        high = value
        if low == low:  # noqa: PLR0124
            high = max(value, low + _REAL.unpack(_BITS.pack(self._highs[slot] << 16))[0])
        if not low <= value:
            self._lows[slot] = value
            low = self._lows[slot]
        apart = _BITS.unpack(_REAL.pack(min(high - low, _FARTHEST) if high > low else 0.0))[0]
        self._highs[slot] = (apart + 0xFFFF) >> 16 & 0xFFFF

    def add(
        self, numbers: NDArray[Any], low: NDArray[Any], high: NDArray[Any], counts: NDArray[Any], segment: int
    ) -> None:
        """Take in bins of a segment, ascending and each once.

        ``counts`` has a row each for samples, invalid and lost ones.
        """
        last = int(numbers[-1])
        self._reach(int(numbers[0]), segment)
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
            if isinstance(held, dict):
                for place in np.flatnonzero(more).tolist():
                    self._count_in(row, int(slots[place]), int(more[place]))
            else:
                held[slots] = np.minimum(held[slots].astype(np.int64) + more, self._most)

    def _forget(self, first: int, last: int) -> None:
        """Empty the bins from ``first`` to ``last``."""
        begin, count = first % self.size, last - first + 1
        if count >= self.size:
            self._empty(slice(None))
        elif begin + count <= self.size:
            self._empty(slice(begin, begin + count))
        else:
            self._empty(slice(begin, None))
            self._empty(slice(None, begin + count - self.size))

    def _empty(self, slots: slice) -> None:
        emptied = range(*slots.indices(self.size))
        self._low[slots] = np.nan
        self._high[slots] = 0 if self.coarse else np.nan
        for held in self._counts:
            if isinstance(held, dict):
                for slot in [slot for slot in held if slot in emptied] if held else ():
                    del held[slot]
            else:
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
        counts = np.stack([self._counted(held, slots) for held in self._counts])
        some = counts.any(axis=0)
        slots, counts = slots[some], counts[:, some]
        if self.coarse:
            counts = np.vstack([counts, nothing[some]])
        return numbers[some], self._low[slots], self._high_of(slots), counts

    @staticmethod
    def _counted(held: NDArray[Any] | dict[int, int], slots: NDArray[Any]) -> NDArray[Any]:
        if isinstance(held, dict):
            return np.array([held.get(slot, 0) for slot in slots.tolist()] if held else np.zeros(len(slots)), np.int64)
        return np.asarray(held[slots], np.int64)


class FewBins(SegmentedBins):
    """Bins of a slow channel, in their order: those that hold something. :meth:`all_bins` when they are too many."""

    def __init__(self, width: float, size: int) -> None:
        super().__init__(width, size)
        self._numbers = array("q")
        self._low, self._high = array("f"), array("f")
        self._samples, self._invalid = array("B"), array("B")

    @property
    def full(self) -> bool:
        """True if a ring of all bins would be better."""
        return len(self._numbers) >= _MOST_FEW

    def add_one(self, number: int, value: float, invalid: int, lost: int, segment: int) -> None:
        """Take in one sample, as :meth:`Bins.add_one`; what was lost is not kept here."""
        del lost
        if not self._reach(number, segment):
            return
        at = len(self._numbers)
        if at and number <= self._numbers[-1]:
            at = bisect_left(self._numbers, number)
        if at == len(self._numbers) or self._numbers[at] != number:
            for column, first in ((self._numbers, number), (self._low, value), (self._high, value)):
                column.insert(at, first)  # type: ignore[arg-type]
            self._samples.insert(at, 1)
            self._invalid.insert(at, invalid)
            if len(self._numbers) % _TIDY == 0:
                self._drop(0, bisect_right(self._numbers, self.newest - self.size))
            return
        if not self._low[at] <= value and not math.isnan(value):
            self._low[at] = value
        if not self._high[at] >= value and not math.isnan(value):
            self._high[at] = value
        self._samples[at] = min(self._samples[at] + 1, 255)
        self._invalid[at] = min(self._invalid[at] + invalid, 255)

    def _forget(self, first: int, last: int) -> None:
        """Empty the bins from ``first`` to ``last``."""
        if self._numbers and self._numbers[-1] >= first:
            self._drop(bisect_left(self._numbers, first), bisect_right(self._numbers, last))
            # those that are too old but not removed yet would be back in reach after the clock was set back
            self._drop(0, bisect_right(self._numbers, self.newest - self.size))

    def _drop(self, begin: int, end: int) -> None:
        for column in (self._numbers, self._low, self._high, self._samples, self._invalid):
            del column[begin:end]

    def between(self, first: int, last: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Return number, least, greatest and counts of the non-empty bins from ``first`` to ``last``."""
        begin = bisect_left(self._numbers, max(first, self.newest - self.size + 1, 0))
        part = slice(begin, max(begin, bisect_right(self._numbers, min(last, self.newest))))
        samples, invalid = np.array(self._samples[part], np.int64), np.array(self._invalid[part], np.int64)
        counts = np.stack([samples, invalid, np.zeros_like(samples)])
        return (
            np.array(self._numbers[part], np.int64),
            np.array(self._low[part], np.float32),
            np.array(self._high[part], np.float32),
            counts,
        )

    def all_bins(self) -> Bins:
        """Return a ring of all bins that holds the same."""
        ring = Bins(self.width, self.size, coarse=True)
        numbers, low, high, counts = self.between(0, self.newest)
        segments = self.segments_of(numbers) if len(numbers) else numbers
        for segment in dict.fromkeys(segments.tolist()):
            own = segments == segment
            ring.add(numbers[own], low[own], high[own], counts[:, own], segment)
        ring.newest, ring._starts = self.newest, list(self._starts)
        return ring
