"""``sine:PERIOD``: a sine over the whole range; channel n runs a twelfth of the period behind channel n - 1."""

from __future__ import annotations

import math
from collections.abc import Sequence

from teds_provision.node.sources.base import GeneratedSource, Notify, Reading, SourceChannel, seconds_of


class Sine(GeneratedSource):
    """A sine of ``period`` seconds; at time 0 channel 1 is in the middle of its range and rises."""

    def __init__(self, places: Sequence[SourceChannel], period: float) -> None:
        super().__init__(places)
        self.period = period

    def at(self, channel: int, seconds: float) -> Reading | None:
        """Return the sine at that time."""
        place = self.places.get(channel)
        if place is None:
            return None
        phase = seconds / self.period - (channel - 1) / 12
        return place.between(0.5 + 0.5 * math.sin(2 * math.pi * phase))


def make(argument: str, places: Sequence[SourceChannel], notify: Notify) -> Sine:
    """Return the source of ``sine:2`` or ``sine:20ms``; 10 s by default."""
    return Sine(places, seconds_of(argument or "10", "sine"))
