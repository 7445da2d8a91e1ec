"""The source of a wrapped node's values: the latest ones from its reader, by the node's clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from teds_provision.node.sources.base import Reading, SimulationClock
from teds_provision.node.wrapped.latest_values import LatestValues, ValidityEvents

LAG: Final = 10_000_000
"""ns after its tick that a sample is taken: the thread that reads the sensors may get the interpreter's lock 5 ms late.

What was read is dated by the kernel, so a sample takes the value that was the last one at its tick.
"""

Report = Callable[[int, str, str], None]
"""Channel number, name, and the reason why it is invalid ("" once it is valid again)."""


class WrappedSource:
    """Values of one wrapped node; ``channels`` are numbered from 1 in the order of its description."""

    def __init__(self, channels: Sequence[LatestValues], report: Report) -> None:
        self._channels = dict(enumerate(channels, 1))
        self._events = ValidityEvents(report)
        self._since = 0.0

    def at(self, channel: int, seconds: float) -> Reading | None:
        """Return the last number that came by then; None, and an event with the reason, if it is not valid."""
        values = self._channels.get(channel)
        if values is None:
            return None
        reading, reason = values.at(self._since + seconds)
        self._events.note(channel, values.channel.name, reason)
        return reading

    def start(self, drive: SimulationClock) -> None:
        """Note where the node's clock is on the monotonic one, by which arrivals are dated."""
        self._since = time.monotonic() - drive.now()

    def acted(self, values: Mapping[str, float]) -> None:
        """Do nothing: a wrapped node has sensors only."""

    def stop(self) -> None:
        """Do nothing: its reader serves other nodes too."""
