"""The interface of a source, from which a virtual transducer takes its measurements."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

from teds_provision.errors import UsageError


class Reading(NamedTuple):
    """One channel at one instant: a ``value`` in its display unit, or a ``raw`` number.

    ``missing``: this channel alone has no valid value. It is sent as a raw number that the channel cannot give, as the
    data message has one mark for all its channels (operation.md, section 3).
    """

    value: float | None = None
    raw: float | None = None
    missing: bool = False


@dataclass(frozen=True)
class SourceChannel:
    """A sensor that a source feeds: its number, name, and range in the unit in which people see it."""

    number: int
    name: str
    low: float = math.nan
    high: float = math.nan

    @cached_property
    def span(self) -> tuple[float, float]:
        """Return low and high of its range; 0 to 1 if the datasheet has none."""
        stated = math.isfinite(self.low) and math.isfinite(self.high)
        return (self.low, self.high) if stated else (0.0, 1.0)

    def between(self, share: float) -> Reading:
        """Return the value at a share (0 to 1) of the range."""
        low, high = self.span
        return Reading(value=low + share * (high - low))


Notify = Callable[[str], None]


class Source(Protocol):
    """A source of values. ``at`` is called from the node's measuring thread."""

    def at(self, channel: int, seconds: float) -> Reading | None:
        """Return a channel's reading at a time of the node's clock (seconds since its start), None if it is invalid."""

    def start(self, drive: SimulationClock) -> None:
        """Begin; a source with a clock drives the node's. Raises an error with the reason if it cannot."""

    def acted(self, values: Mapping[str, float]) -> None:
        """Receive new values of actuators, by channel name, in display units."""

    def stop(self) -> None:
        """End; never raises."""


class SimulationClock(Protocol):
    """The node's clock in the hands of a simulation."""

    def now(self) -> float:
        """Return the seconds since the node's start by its clock."""

    def own_clock(self) -> None:
        """Stop the clock, except for :meth:`advance`, from now on."""

    def advance(self, seconds: float, change: Callable[[], None]) -> None:
        """Move the clock to ``seconds`` since the node's start, never back; then call ``change`` for the new values.

        Samples that fall due before use the values before.
        """

    def host_clock(self) -> None:
        """Let the clock go on with that of the host: the source has ended."""


class GeneratedSource:
    """A source that is a function of time: it needs no beginning and no end."""

    def __init__(self, places: Sequence[SourceChannel]) -> None:
        self.places = {place.number: place for place in places}

    def start(self, drive: SimulationClock) -> None:
        """Do nothing: there is nothing to begin."""

    def acted(self, values: Mapping[str, float]) -> None:
        """Ignore the values of actuators."""

    def stop(self) -> None:
        """Do nothing: there is nothing to end."""


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
