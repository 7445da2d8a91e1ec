"""What a source of values is: where a virtual transducer has its measurements from."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

from teds_provision.errors import UsageError


class Reading(NamedTuple):
    """What a channel shows at one instant: a ``value`` in the unit in which people see it, or a ``raw`` number."""

    value: float | None = None
    raw: float | None = None


@dataclass(frozen=True)
class SourceChannel:
    """A sensor that a source feeds: its number, name, and range in the unit in which people see it."""

    number: int
    name: str
    low: float = math.nan
    high: float = math.nan

    @cached_property
    def span(self) -> tuple[float, float]:
        """Low and high of its range; 0 to 1 where the datasheet states none."""
        stated = math.isfinite(self.low) and math.isfinite(self.high)
        return (self.low, self.high) if stated else (0.0, 1.0)

    def between(self, share: float) -> Reading:
        """The value at a share (0 to 1) of the range."""
        low, high = self.span
        return Reading(value=low + share * (high - low))


Tell = Callable[[str], None]


class Source(Protocol):
    """Where values come from. ``at`` is called from the node's measuring thread."""

    def at(self, channel: int, seconds: float) -> Reading | None:
        """What a channel shows at a time of the node's clock (seconds since its start), None for nothing valid."""

    def start(self, drive: SimulationClock) -> None:
        """Begin; a source with a clock of its own drives the node's. Raises what names why it cannot."""

    def acted(self, values: Mapping[str, float]) -> None:
        """Actuators were told new values, by channel name, in the units in which people see them."""

    def stop(self) -> None:
        """End; never raises."""


class SimulationClock(Protocol):
    """The node's clock in the hands of a simulation."""

    def now(self) -> float:
        """Seconds since the node's start by its clock."""

    def own_clock(self) -> None:
        """From now on the clock stands still but for :meth:`advance`."""

    def advance(self, seconds: float, change: Callable[[], None]) -> None:
        """The clock goes to ``seconds`` since the node's start, never back; then ``change`` puts the new values.

        Whatever falls due before is sampled with the values before.
        """

    def host_clock(self) -> None:
        """The source has ended: the clock goes on with that of the host."""


class GeneratedSource:
    """A source that is a function of time: it needs no beginning and no end."""

    def __init__(self, places: Sequence[SourceChannel]) -> None:
        self.places = {place.number: place for place in places}

    def start(self, drive: SimulationClock) -> None:
        """Nothing to begin."""

    def acted(self, values: Mapping[str, float]) -> None:
        """Nobody listens."""

    def stop(self) -> None:
        """Nothing to end."""


def seconds_of(text: str, word: str) -> float:
    """Read the period of ``sine:PERIOD`` or ``ramp:PERIOD``: seconds, or with a unit (``20ms``, ``2s``, ``1min``)."""
    units = {"ms": 1e-3, "s": 1.0, "min": 60.0}
    number, scale = text.strip(), 1.0
    for unit in ("ms", "min", "s"):
        if number.endswith(unit):
            number, scale = number[: -len(unit)].strip(), units[unit]
            break
    try:
        period = float(number) * scale
    except ValueError:
        period = math.nan
    if not (math.isfinite(period) and period > 0):
        raise UsageError(f"{word}:{text} has no period.", hint=f"Write seconds: {word}:2, or {word}:20ms.")
    return period
