"""The curve of a calibration over everything that the channel can give, as the guard looks at it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

from teds_provision.arrays import NDArray, np, without_repeats
from teds_provision.teds.calibration.formula import evaluate
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.calibration.samples import Range
from teds_provision.teds.channel import TURN, spans_a_turn
from teds_provision.teds.codec.model import Units
from teds_provision.teds.image import BlockId
from teds_provision.teds.profile.model import Profile
from teds_provision.teds.sheet import described
from teds_provision.teds.units import WrittenUnit, display_unit, format_value

SAMPLES: Final = 65_537
GRID: Final = 250_000
TERMS: Final = 50_000_000
"""Terms of the formula that are computed for one curve of several inputs, at most."""
FLOAT32_STEP: Final = 2.0**-23


@dataclass(frozen=True)
class CurveChannel:
    """Facts of a channel, in SI units; NaN if not stated."""

    number: int
    units: Units
    low: float
    high: float
    uncertainty: float
    raw: Range | None
    actuator: bool
    integer: bool
    display: str | None = None
    monotone: str | None = None

    @property
    def full_turn(self) -> bool:
        """True if its values wrap, so that a zero offset only turns the scale."""
        return not self.actuator and spans_a_turn(self.units, self.low, self.high)

    @property
    def tolerance(self) -> float:
        """Stated uncertainty, 0 if none is stated."""
        return self.uncertainty if self.uncertainty > 0 else 0.0

    def show(self, value: float, *, difference: bool = False, like: WrittenUnit | None = None) -> str:
        """Return a value in SI units in the unit that people use for this channel."""
        preferred = like if like is not None and self.display is None and like.text[:1] != "(" else None
        unit = preferred or display_unit(self.units, self.display)
        return format_value(value, unit, difference=difference, digits=5)


def channel_of(number: int, blocks: Mapping[BlockId, bytes], profile: Profile | None) -> CurveChannel:
    """Return the facts of a channel from TEDS and profile; the limits are those of the TEDS."""
    own = described(number, blocks)
    said = profile.channel(number) if profile is not None else None
    ends = said.raw_range if said is not None else own.sample.raw_range if own.sample is not None else None
    return CurveChannel(
        number,
        own.units if own.units_stated or said is None else said.units,
        own.low,
        own.high,
        own.uncertainty,
        ends,
        own.actuator,
        own.sample is None or own.sample.integer,
        said.display or said.unit.text if said else None,
        said.calibration.monotone if said else None,
    )


@dataclass(frozen=True)
class Curve:
    """A calibration evaluated over the whole range of its channel.

    ``axes`` are the samples of each input; ``main`` is the axis of the channel's own input. Results are in SI units for
    sensors and raw for actuators, an array with one dimension per input.
    """

    calibration: Calibration
    channel: CurveChannel
    axes: tuple[NDArray[np.float64], ...]
    main: int

    @cached_property
    def result(self) -> NDArray[np.float64]:
        """Results with the zero offset; angles over a full turn as the curve gives them, not wrapped."""
        values = evaluate(self.calibration, *np.meshgrid(*self.axes, indexing="ij")).value
        if self.channel.actuator:
            return values
        return values * self.calibration.unit.scale + self.calibration.unit.offset

    def difference(self, other: Curve) -> NDArray[np.float64]:
        """Return this curve's results less those of another one over the same axes; wrapping angles the shorter way."""
        less = self.result - other.result
        return less - TURN * np.round(less / TURN) if self.channel.full_turn else less

    def inputs_at(self, index: int) -> tuple[float, ...]:
        """Return the inputs of a flat index into the results."""
        places = np.unravel_index(index, self.result.shape)
        return tuple(float(axis[place]) for axis, place in zip(self.axes, places, strict=True))

    @property
    def noise(self) -> float:
        """Differences below this come from Float32 rounding."""
        finite = self.result[np.isfinite(self.result)]
        return float(8 * FLOAT32_STEP * np.abs(finite).max(initial=0.0))

    @cached_property
    def steps(self) -> NDArray[np.float64]:
        """Differences of neighbouring results along the channel's own input."""
        return np.diff(self.result, axis=self.main)

    @property
    def net(self) -> float:
        """Median change from the low to the high end of the channel's own input."""
        first = np.take(self.result, 0, axis=self.main)
        last = np.take(self.result, -1, axis=self.main)
        return float(np.median(last - first))

    def monotone(self, direction: str) -> bool:
        """Return True if the results never go the other way; ``direction`` is increasing, decreasing or either."""
        rises = bool((self.steps >= -self.noise).all())
        falls = bool((self.steps <= self.noise).all())
        return {"increasing": rises, "decreasing": falls}.get(direction, rises or falls)

    def worst_step(self, direction: str) -> tuple[tuple[float, ...], float]:
        """Return the inputs before the largest step the wrong way, and that step (signed)."""
        rising = direction == "increasing" or (direction == "either" and self.net >= 0)
        at = int(np.argmin(self.steps) if rising else np.argmax(self.steps))
        places = np.unravel_index(at, self.steps.shape)
        inputs = tuple(float(axis[place]) for axis, place in zip(self.axes, places, strict=True))
        return inputs, float(self.steps[places])

    def next_sample(self, value: float) -> float:
        """Return the sample of the channel's own input that follows one."""
        axis = self.axes[self.main]
        return float(axis[min(int(np.searchsorted(axis, value, side="right")), len(axis) - 1)])


def curve_of(
    calibration: Calibration,
    channel: CurveChannel,
    channels: Mapping[int, CurveChannel],
    *,
    also: Calibration | None = None,
    dense: bool = False,
) -> Curve:
    """Evaluate a calibration (finite, boundaries ascending) over everything that its inputs can give.

    One input is sampled at every integer, or at 65537 places and both sides of each boundary. If the curve (and that of
    ``also``, to be compared with) is straight between its boundaries, these and the ends are enough unless ``dense``.
    """
    main = next((n for n, part in enumerate(calibration.inputs) if part.channel == channel.number), 0)
    straight = not dense and _straight(calibration) and (also is None or _straight(also))
    each = 2 if straight else _samples(calibration)
    axes = []
    for number, part in enumerate(calibration.inputs):
        source = channel if number == main else channels.get(part.channel)
        edges = (
            part.boundaries
            if also is None or len(also.inputs) != len(calibration.inputs)
            else tuple(sorted({*part.boundaries, *also.inputs[number].boundaries}))
        )
        axes.append(_axis(edges, source, each, channel.actuator and number == main, calibration.unit))
    return Curve(calibration, channel, tuple(axes), main)


def _samples(calibration: Calibration) -> int:
    """Return the samples of each input: many of one, of several so few that the whole grid stays affordable."""
    count = len(calibration.inputs)
    terms = math.prod(part.degree + 1 for part in calibration.inputs)
    return SAMPLES if count == 1 else max(3, int(min(GRID, TERMS / terms) ** (1 / count)))


def _straight(calibration: Calibration) -> bool:
    return len(calibration.inputs) == 1 and calibration.inputs[0].degree <= 1


def _axis(
    boundaries: tuple[float, ...], source: CurveChannel | None, count: int, actuator: bool, unit: WrittenUnit
) -> NDArray[np.float64]:
    """Return the samples of one input: every integer if there are few, else evenly spread.

    And both sides of each boundary.

    Two samples at least, whatever limits a foreign datasheet has.
    """
    low, high, whole = _ends(boundaries, source, actuator, unit)
    if whole and high - low < SAMPLES and count == SAMPLES:
        samples = np.arange(math.ceil(low), math.floor(high) + 1, dtype=np.float64)
    else:
        samples = _spread(boundaries, low, high, count, whole)
    return samples if len(samples) > 1 else np.array([low, high])


def _ends(
    boundaries: tuple[float, ...], source: CurveChannel | None, actuator: bool, unit: WrittenUnit
) -> tuple[float, float, bool]:
    """Return lowest and highest input, and whether it has only whole numbers."""
    ends = source.raw if source else None
    whole = source is not None and source.integer
    if actuator and source is not None:
        ends, whole = (unit.from_si(source.low), unit.from_si(source.high)), False
    if ends is None or not all(map(math.isfinite, ends)) or ends[0] == ends[1]:
        ends = boundaries[0], boundaries[-1]
    return min(ends), max(ends), whole


def _spread(boundaries: tuple[float, ...], low: float, high: float, count: int, whole: bool) -> NDArray[np.float64]:
    spread = np.linspace(low, high, count)
    edges = np.asarray(boundaries)
    if whole:
        spread, below, at = np.rint(spread), np.ceil(edges) - 1, np.ceil(edges)
    else:
        below, at = np.nextafter(edges, -np.inf), edges
    if 2 < count < SAMPLES and len(edges) > count:
        below, at = below[:: len(edges) // count + 1], at[:: len(edges) // count + 1]
    samples = np.concatenate([spread, below, at])
    return without_repeats(samples[(samples >= low) & (samples <= high)])
