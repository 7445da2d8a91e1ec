"""Last raw numbers of a wrapped channel, and why there is none that is valid.

Samples are taken up to 150 ms behind the clock (``node/virtual.py``), so a few numbers before the last one are kept:
a sample takes the newest one that is not younger than its own tick.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from teds_provision.node.sources.base import Reading
from teds_provision.node.wrapped.description import PERIODS_LATE, WrappedChannel

_KEPT_SECONDS: Final = 0.3
_LEAST_KEPT: Final = 4
_ROUNDING: Final = 1e-9
_UNREAD: Final = 0.01
"""Seconds for which a frame may have come without having been read: so much later a value is late by the clock."""
_MISSING: Final = Reading(missing=True)


class Arrival(NamedTuple):
    """A raw number and when its frame came, in seconds of the monotonic clock; ``problem``: why it is not valid."""

    at: float
    raw: float
    problem: str = ""


class LatestValues:
    """Arrivals of one channel; ``put`` is called by the thread that reads the bus, ``at`` by the one that samples."""

    def __init__(self, channel: WrappedChannel, what: str = "frame") -> None:
        self.channel, self._what = channel, what
        kept = max(_LEAST_KEPT, math.ceil(_KEPT_SECONDS / channel.period))
        self._arrivals: deque[Arrival] = deque(maxlen=min(kept, 4096))
        low, high = channel.limits
        slack = _ROUNDING * max(abs(low), abs(high), abs(channel.scale))
        self._low, self._high = low - slack, high + slack
        self._longest = PERIODS_LATE * channel.period
        self._form = channel.sample
        self._trouble = ""
        self._silent = None if channel.shares_frame else _MISSING

    def put(self, at: float, raw: float, problem: str = "") -> None:
        """Keep an arrival."""
        self._arrivals.append(Arrival(at, raw, problem))

    def set_carrier(self, what: str) -> None:
        """Name what carries the values in reasons: frame, PDO, SDO reply, reading."""
        self._what = what

    def note_trouble(self, why: str) -> None:
        """Note why nothing comes, "" for no known cause; it is a part of the reason while values are late."""
        self._trouble = why

    def at(self, moment: float) -> tuple[Reading | None, str]:
        """Return the reading at a time of the monotonic clock, and why it is not valid ("" if it is).

        None if all channels of the node are silent together, as the data message has a mark for that.
        """
        arrival = self._newest(moment)
        if arrival is None:
            return self._silent, self._trouble or f"no {self._what} has come yet"
        if moment - arrival.at > self._longest and time.monotonic() - arrival.at > self._longest + _UNREAD:
            return self._silent, self._late()
        problem = arrival.problem or self._outside(arrival.raw)
        if problem:
            return _MISSING, problem
        form, channel = self._form, self.channel
        return Reading(raw=arrival.raw + form.shift if form.raw else channel.number(arrival.raw)), ""

    @property
    def last(self) -> Arrival | None:
        """The newest arrival."""
        return self._arrivals[-1] if self._arrivals else None

    def _newest(self, moment: float) -> Arrival | None:
        """Return the newest arrival that is not younger than ``moment``; the reading thread may append meanwhile."""
        for back in range(1, len(self._arrivals) + 1):
            try:
                arrival = self._arrivals[-back]
            except IndexError:
                return None
            if arrival.at <= moment:
                return arrival
        return None

    def _outside(self, raw: float) -> str:
        value = self.channel.value(raw)
        if self._low <= value <= self._high:
            return ""
        low, high = self.channel.limits
        unit = "" if self.channel.unit == "count" else f" {self.channel.unit}"
        return f"{value:.6g}{unit} is outside {low:.6g} to {high:.6g}{unit}"

    def _late(self) -> str:
        period = self.channel.period * 1000
        text = f"no {self._what} for {PERIODS_LATE * period:.4g} ms, {PERIODS_LATE} periods of {period:.4g} ms"
        return f"{text}: {self._trouble}" if self._trouble else text


class ValidityEvents:
    """Reports when a channel becomes invalid, with the reason, or valid again; a new reason alone is no news.

    ``report`` gets channel number, name and reason ("" for valid) and must return at once.
    """

    def __init__(self, report: Callable[[int, str, str], None]) -> None:
        self._report, self._reasons = report, dict[int, str]()
        self._lock = threading.Lock()

    def note(self, channel: int, name: str, reason: str) -> None:
        """Note how a channel is now."""
        before = self._reasons.get(channel)
        if before is not None and bool(before) == bool(reason):
            return
        with self._lock:
            self._reasons[channel] = reason
        if reason or before is not None:
            self._report(channel, name, reason)
