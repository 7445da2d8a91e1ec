"""The segmented multinomial, prepared once and applied to scalars or numpy arrays, forwards and backwards."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar, overload

from teds_provision.errors import BadData
from teds_provision.lazy import late

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from teds_provision.teds.calibration.model import Calibration, CalibrationInput

    Floats = NDArray[np.float64]
else:
    np = late("numpy")

_Value = TypeVar("_Value")

_SAMPLES: Final = 4097
_HALVINGS: Final = 64
"""Halvings of an interval until no Float64 lies between its ends."""


@dataclass(frozen=True)
class Evaluation(Generic[_Value]):
    """Result of the formula in calibrated units, and where an input lay outside its outer boundaries."""

    value: _Value
    outside: _Value


class PreparedCurve:
    """A calibration's formula with its tables laid out once, in Float64 with the coefficients as they are.

    ``curve(x)`` takes one array for each input, all of one shape, and gives the results with the zero offset.
    """

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        parts = calibration.inputs
        each = math.prod(part.degree + 1 for part in parts)
        self._table = np.asarray(calibration.coefficients, dtype=np.float64).reshape(-1, each)
        self._columns = [np.ascontiguousarray(column) for column in self._table.T]
        self._inner = [np.asarray(part.boundaries[1:-1], dtype=np.float64) for part in parts]
        self._offsets = [np.asarray(part.offsets, dtype=np.float64) for part in parts]
        self._powers = tuple(itertools.product(*(range(part.degree + 1) for part in parts)))
        self._plain = len(self._table) == 1  # one cell: no search, no gathering

    def __call__(self, *inputs: Floats) -> Floats:
        """Results for one array per input."""
        with np.errstate(over="ignore", invalid="ignore"):
            if self._plain:
                distances = [values - offsets[0] for values, offsets in zip(inputs, self._offsets, strict=True)]
                terms: Sequence[Any] = self._table[0]
            else:
                cell: Any = 0
                distances = []
                for values, inner, offsets in zip(inputs, self._inner, self._offsets, strict=True):
                    segment = np.searchsorted(inner, values, side="right")
                    distances.append(values - offsets[segment])
                    cell = cell * len(offsets) + segment
                terms = [column[cell] for column in self._columns]
            return self._sum(terms, distances) + self.calibration.zero_offset

    def _sum(self, terms: Sequence[Any], distances: list[Floats]) -> Floats:
        total = np.zeros_like(distances[0])
        if len(distances) == 1:  # Horner
            for term in reversed(terms):
                total = total * distances[0] + term
            return total
        for column, powers in enumerate(self._powers):
            term = terms[column]
            for distance, power in zip(distances, powers, strict=True):
                term = term * distance**power
            total = total + term
        return total

    def outside(self, *inputs: Floats) -> NDArray[np.bool_]:
        """Where an input lies outside its outer boundaries, or is no number."""
        flags = np.zeros(inputs[0].shape, dtype=bool)
        for part, values in zip(self.calibration.inputs, inputs, strict=True):
            flags |= ~((values >= part.boundaries[0]) & (values <= part.boundaries[-1]))
        return flags


class PreparedInverse:
    """The way back through a calibration: which input gives a result. Raises BadData where more than one would.

    ``low`` and ``high`` are the ends between which the input ``main`` is looked for; other inputs are given with each
    call. Results beyond what lies between the ends give the nearer end. ``step`` is how close is close enough, 0 for as
    close as Float64 gets.
    """

    def __init__(self, curve: PreparedCurve, low: float, high: float, *, main: int = 0, step: float = 0.0) -> None:
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise BadData("A calibration is only inverted between two finite ends.")
        self._curve, self._low, self._high, self._main = curve, low, high, main
        self._halvings = math.ceil(math.log2((high - low) / step)) + 2 if step > 0 else _HALVINGS
        self._count = len(curve.calibration.inputs)
        self._direction = self._single_direction() if self._count == 1 else 0
        self._straight = self._lines() if self._count == 1 and curve.calibration.inputs[0].degree == 1 else None

    def _single_direction(self) -> int:
        part = self._curve.calibration.inputs[0]
        samples = np.concatenate([np.linspace(self._low, self._high, _SAMPLES), np.asarray(part.boundaries)])
        samples = np.unique(samples[(samples >= self._low) & (samples <= self._high)])
        results = self._curve(samples)
        steps = np.diff(results)
        slack = 8 * 2.0**-23 * float(np.abs(results).max(initial=0.0))
        if np.isfinite(results).all() and results[0] != results[-1]:
            direction = 1 if results[-1] > results[0] else -1
            if (steps * direction >= -slack).all():
                return direction
        raise BadData(
            f"The calibration of channel {self._curve.calibration.channel} cannot be inverted: "
            "its curve does not rise or fall all the way.",
        )

    def _lines(self) -> tuple[Floats, Floats, Floats, Floats, Floats] | None:
        """Of a curve of straight lines: results at the inner nodes, and per segment start, slope, and its ends."""
        part = self._curve.calibration.inputs[0]
        table = self._curve._table
        if part.segments != len(table) or not np.all(table[:, 1] * self._direction > 0):
            return None
        nodes = self._curve(np.asarray(part.boundaries[1:-1], dtype=np.float64)) * self._direction
        edges = np.asarray(part.boundaries, dtype=np.float64).copy()
        edges[0], edges[-1] = min(edges[0], self._low), max(edges[-1], self._high)
        start = table[:, 0] + self._curve.calibration.zero_offset
        return nodes, start, table[:, 1], edges[:-1], edges[1:]

    def __call__(self, results: Floats, others: Sequence[Floats] = ()) -> Floats:
        """Inputs that give these results, kept between the ends."""
        results = np.asarray(results, dtype=np.float64)
        if self._straight is not None:
            nodes, start, slope, below, above = self._straight
            segment = np.searchsorted(np.maximum.accumulate(nodes), results * self._direction, side="right")
            offsets = self._curve._offsets[0]
            found = (results - start[segment]) / slope[segment] + offsets[segment]
            return np.clip(np.clip(found, below[segment], above[segment]), self._low, self._high)
        return self._bisect(results, others)

    def ends(self, shape: tuple[int, ...], others: Sequence[Floats] = ()) -> tuple[Floats, Floats]:
        """Results at the low and at the high end, for as many values of the other inputs."""
        return self._at(np.full(shape, self._low), others), self._at(np.full(shape, self._high), others)

    def _bisect(self, results: Floats, others: Sequence[Floats]) -> Floats:
        low = np.full(results.shape, self._low)
        high = np.full(results.shape, self._high)
        direction = self._direction or np.where(self._at(high, others) >= self._at(low, others), 1, -1)
        for _ in range(self._halvings):
            middle = low + (high - low) / 2
            short = (results - self._at(middle, others)) * direction > 0
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        nearer = np.abs(self._at(low, others) - results) <= np.abs(self._at(high, others) - results)
        return np.where(nearer, low, high)

    def _at(self, own: Floats, others: Sequence[Floats]) -> Floats:
        inputs = [*others[: self._main], own, *others[self._main :]]
        return self._curve(*inputs)


@overload
def evaluate(calibration: Calibration, *inputs: float) -> Evaluation[float]: ...
@overload
def evaluate(calibration: Calibration, *inputs: NDArray[np.float64]) -> Evaluation[NDArray[np.float64]]: ...
def evaluate(calibration: Calibration, *inputs: object) -> object:
    """Apply the formula and the zero offset to one value, or one array, per input.

    Arrays are broadcast against each other; ``outside`` is then an array of the same shape (1 where an input lies
    outside its boundaries or is NaN), else 0.0 or 1.0. Raises BadData for another number of inputs.
    """
    parts: tuple[CalibrationInput, ...] = calibration.inputs
    if len(inputs) != len(parts):
        raise BadData(f"The calibration of channel {calibration.channel} takes {len(parts)} inputs, not {len(inputs)}.")
    scalar = all(np.ndim(value) == 0 for value in inputs)  # type: ignore[arg-type]
    arrays = np.broadcast_arrays(*(np.asarray(value, dtype=np.float64) for value in inputs))
    curve = PreparedCurve(calibration)
    value, flags = curve(*arrays), curve.outside(*arrays).astype(np.float64)
    return Evaluation(float(value), float(flags)) if scalar else Evaluation(value, flags)
