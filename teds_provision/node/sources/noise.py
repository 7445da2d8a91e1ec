"""``noise``: every instant another value, evenly spread over the range."""

from __future__ import annotations

import random
from collections.abc import Sequence

from teds_provision.errors import UsageError
from teds_provision.node.sources.base import GeneratedSource, Notify, Reading, SourceChannel


class Noise(GeneratedSource):
    """Evenly spread noise over each channel's range."""

    def at(self, channel: int, seconds: float) -> Reading | None:
        """Return a new random value at each call."""
        place = self.places.get(channel)
        return None if place is None else place.between(random.random())


def make(argument: str, places: Sequence[SourceChannel], notify: Notify) -> Noise:
    """Make the source of ``noise``, which takes no argument."""
    if argument:
        raise UsageError(f"noise takes no argument, not {argument!r}.", hint="Write --source noise.")
    return Noise(places)
