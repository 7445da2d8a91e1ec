"""``ramp:PERIOD``: from the lowest value to the highest in each period."""

from __future__ import annotations

from collections.abc import Sequence

from teds_provision.node.sources.base import GeneratedSource, Notify, Reading, SourceChannel, seconds_of


class Ramp(GeneratedSource):
    """A ramp of ``period`` seconds over each channel's range."""

    def __init__(self, places: Sequence[SourceChannel], period: float) -> None:
        super().__init__(places)
        self.period = period

    def at(self, channel: int, seconds: float) -> Reading | None:
        """Return the ramp at that time."""
        place = self.places.get(channel)
        return None if place is None else place.between((seconds / self.period) % 1.0)


def make(argument: str, places: Sequence[SourceChannel], notify: Notify) -> Ramp:
    """Return the source of ``ramp:2`` or ``ramp:20ms``; 10 s by default."""
    return Ramp(places, seconds_of(argument or "10", "ramp"))
