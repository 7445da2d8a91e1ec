"""Common times for all channels of a group: the "synchronized data" of the second paper.

There is a row at every multiple of the grid's period. Each channel gives its last value that is not newer than the row
(never one from the future), with its age; after two of its periods without a value both are NaN. A row waits until
every live stream has come past it, but no longer than ``patience``, so that no row waits for the slowest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from teds_provision.arrays import NDArray
from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows

PERIODS_OF_A_VALUE = 2.0  # periods after which a value is too old to represent the channel
LONGEST_BURST = 10_000  # rows at once; after a longer gap in all streams, older rows are left out


@dataclass
class _Stream:
    channels: tuple[int, ...]
    columns: list[int]
    place: slice | list[int]  # the columns; as a slice if they are adjacent, which numpy indexes faster
    keeps: float  # seconds for which a value represents its channels
    times: list[NDArray[Any]] = field(default_factory=list)
    values: list[NDArray[Any]] = field(default_factory=list)
    newest: float = -math.inf
    began: float = math.nan


class Grid:
    """Gathers blocks of a group's streams and gives out rows.

    ``period`` is in seconds, the shortest of the channels'; ``patience`` the longest wait for a row
    after its time. Channels without a period (events) keep their last value.
    """

    def __init__(self, group: str, facts: Sequence[ChannelFacts], *, patience: float = 0.1) -> None:
        self.group = group
        self.channels = tuple(channel_facts.key for channel_facts in facts)
        self.patience = patience
        periods = [channel_facts.period for channel_facts in facts if channel_facts.period]
        self.period = min(periods, default=1.0)
        self._columns = {key: place for place, key in enumerate(self.channels)}
        self._keeps = {
            channel_facts.key: PERIODS_OF_A_VALUE * channel_facts.period if channel_facts.period else math.inf
            for channel_facts in facts
        }
        self._streams: dict[tuple[str, int], _Stream] = {}
        self._next: int | None = None  # number of the next row, whose time is number × period
        self._test = False

    def add_block(self, block: Block) -> None:
        """Add samples of a stream; channels that are not of this group are left out."""
        stream = self._stream(block)
        if stream is None or not len(block.time):
            return
        value = block.value
        if len(stream.columns) < len(block.channels):
            value = value[:, [k for k, number in enumerate(block.channels) if (block.uuid, number) in self._columns]]
        stream.times.append(block.time)
        stream.values.append(value)
        if math.isnan(stream.began):
            stream.began = float(block.time[0])
        stream.newest = max(stream.newest, float(block.time[-1]))
        self._test = self._test or block.test_pattern
        if self._next is None:
            self._next = math.ceil(float(block.time[0]) / self.period - 1e-6)

    def _stream(self, block: Block) -> _Stream | None:
        key = block.uuid, block.stream
        known = self._streams.get(key)
        if known is not None and known.channels == block.channels:
            return known
        columns = [
            self._columns[block.uuid, number] for number in block.channels if (block.uuid, number) in self._columns
        ]
        if not columns:
            return None
        keeps = max(self._keeps[self.channels[column]] for column in columns)
        known = self._streams[key] = _Stream(block.channels, columns, _side_by_side(columns), keeps)
        return known

    def rows(self, now: float) -> GroupRows | None:
        """Return the rows that are due at unix time ``now``; None if there is none."""
        if self._next is None:
            return None
        live = [
            stream.newest for stream in self._streams.values() if stream.newest > now - stream.keeps - self.patience
        ]
        ready = min(live) if live else -math.inf
        # The small number makes up for rounding, so that a stamp counts for its own row.
        until = math.floor(max(ready, now - self.patience) / self.period + 1e-6)
        if until < self._next:
            return None
        first = max(self._next, until - LONGEST_BURST + 1)
        self._next = until + 1
        times = np.arange(first, until + 1) * self.period
        value = np.full((len(times), len(self.channels)), np.nan)
        age = np.full_like(value, np.nan)
        upto = times + self.period * 1e-6
        for stream in self._streams.values():
            _fill(stream, times, upto, value, age)
        return GroupRows(self.group, self.channels, times, value, age, self._test)

    def began_apart(self) -> float:
        """Return the seconds between the first samples of the earliest and of the latest stream."""
        began = [stream.began for stream in self._streams.values() if not math.isnan(stream.began)]
        return max(began) - min(began) if began else 0.0


def _side_by_side(columns: list[int]) -> slice | list[int]:
    first, count = columns[0], len(columns)
    return slice(first, first + count) if columns == list(range(first, first + count)) else columns


def _fill(stream: _Stream, rows: NDArray[Any], upto: NDArray[Any], value: NDArray[Any], age: NDArray[Any]) -> None:
    """Fill in the columns of a stream; ``upto``: times of the rows, and a little for rounding."""
    if not stream.times:
        return
    times, values = stream.times[0], stream.values[0]
    if len(stream.times) > 1:
        times, values = np.concatenate(stream.times), np.concatenate(stream.values)
    place = times.searchsorted(upto, "right") - 1
    old = rows - times[place]
    if place[0] >= 0 and old.max() <= stream.keeps:
        value[:, stream.place] = values[place]
        age[:, stream.place] = np.maximum(old, 0.0)[:, None]
    else:
        good = np.flatnonzero((place >= 0) & (old <= stream.keeps))
        value[good[:, None], stream.columns] = values[place[good]]
        age[good[:, None], stream.columns] = np.maximum(old[good], 0.0)[:, None]
    kept = int(place[-1])
    # Later rows may still need the last value before the next row, and all later ones.
    if kept > 0:
        stream.times, stream.values = [times[kept:]], [values[kept:]]
