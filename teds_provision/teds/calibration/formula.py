"""The segmented multinomial: evaluated forwards and backwards, fitted to measured points, described for people.

A curve is prepared once and applied to scalars or numpy arrays. numpy is loaded at the first evaluation, not before.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final, Generic, TypeVar, overload

from teds_provision.arrays import Floats, NDArray, np, without_repeats
from teds_provision.errors import BadDataError
from teds_provision.sanitize import counted
from teds_provision.teds.calibration.model import MAXIMUM_DEGREE, Calibration, CalibrationInput, Method

_Value = TypeVar("_Value")

_SAMPLES: Final = 4097
_HALVINGS: Final = 64
"""Halvings of an interval until no Float64 lies between its ends."""


@dataclass(frozen=True)
class Evaluation(Generic[_Value]):
    """Result of the formula in calibrated units, and where an input was outside its outer boundaries."""

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
        self._plain = len(self._table) == 1  # one cell: no segment to search

    def __call__(self, *inputs: Floats) -> Floats:
        """Return the results for one array per input."""
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
        """Return where an input is outside its outer boundaries, or is not a number."""
        flags = np.zeros(inputs[0].shape, dtype=bool)
        for part, values in zip(self.calibration.inputs, inputs, strict=True):
            flags |= ~((values >= part.boundaries[0]) & (values <= part.boundaries[-1]))
        return flags


class PreparedInverse:
    """The inverse of a calibration: which input gives a result. Raises BadDataError if more than one would.

    ``low`` and ``high`` are the ends between which the input ``main`` is searched; other inputs are given with each
    call. Results beyond those of the ends give the nearer end. ``step`` is how close is close enough, 0 for as close as
    Float64 gets.
    """

    def __init__(self, curve: PreparedCurve, low: float, high: float, *, main: int = 0, step: float = 0.0) -> None:
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise BadDataError("A calibration is only inverted between two finite ends.")
        self._curve, self._low, self._high, self._main = curve, low, high, main
        self._halvings = math.ceil(math.log2((high - low) / step)) + 2 if step > 0 else _HALVINGS
        self._count = len(curve.calibration.inputs)
        self._direction = self._single_direction() if self._count == 1 else 0
        self._straight = self._lines() if self._count == 1 and curve.calibration.inputs[0].degree == 1 else None

    def _single_direction(self) -> int:
        part = self._curve.calibration.inputs[0]
        samples = np.concatenate([np.linspace(self._low, self._high, _SAMPLES), np.asarray(part.boundaries)])
        samples = without_repeats(samples[(samples >= self._low) & (samples <= self._high)])
        results = self._curve(samples)
        steps = np.diff(results)
        slack = 8 * 2.0**-23 * float(np.abs(results).max(initial=0.0))
        if np.isfinite(results).all() and results[0] != results[-1]:
            direction = 1 if results[-1] > results[0] else -1
            if (steps * direction >= -slack).all():
                return direction
        raise BadDataError(
            f"The calibration of channel {self._curve.calibration.channel} cannot be inverted: "
            "its curve does not rise or fall all the way.",
        )

    def _lines(self) -> tuple[Floats, Floats, Floats, Floats, Floats] | None:
        """Return results at inner nodes and each segment's start, slope and ends; None unless all are straight."""
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
        """Return the inputs that give these results, kept between the ends."""
        results = np.asarray(results, dtype=np.float64)
        if self._straight is not None:
            nodes, start, slope, below, above = self._straight
            segment = np.searchsorted(np.maximum.accumulate(nodes), results * self._direction, side="right")
            offsets = self._curve._offsets[0]
            found = (results - start[segment]) / slope[segment] + offsets[segment]
            return np.clip(np.clip(found, below[segment], above[segment]), self._low, self._high)
        return self._bisect(results, others)

    def ends(self, shape: tuple[int, ...], others: Sequence[Floats] = ()) -> tuple[Floats, Floats]:
        """Return the results at the low and at the high end, for as many values of the other inputs."""
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

    Arrays are broadcast against each other; ``outside`` is then an array of the same shape (1 if an input is outside
    its boundaries or is NaN), else 0.0 or 1.0. Raises BadDataError for another number of inputs.
    """
    parts: tuple[CalibrationInput, ...] = calibration.inputs
    if len(inputs) != len(parts):
        raise BadDataError(
            f"The calibration of channel {calibration.channel} takes {len(parts)} inputs, not {len(inputs)}."
        )
    scalar = all(np.ndim(value) == 0 for value in inputs)  # type: ignore[arg-type]
    arrays = np.broadcast_arrays(*(np.asarray(value, dtype=np.float64) for value in inputs))
    curve = PreparedCurve(calibration)
    value, flags = curve(*arrays), curve.outside(*arrays).astype(np.float64)
    return Evaluation(float(value), float(flags)) if scalar else Evaluation(value, flags)


Points = Sequence[tuple[float, float]]
MAXIMUM_NODES = 8000  # 8 octets of coefficients each, in one tuple of at most 65,535 octets


@dataclass(frozen=True)
class Residuals:
    """Point by point: input, reference value, curve, difference (reference - curve); in the calibrated unit.

    For an actuator the differences are raw.
    """

    inputs: tuple[float, ...]
    references: tuple[float, ...]
    curve: tuple[float, ...]
    differences: tuple[float, ...]

    @property
    def maximum(self) -> float:
        """Largest absolute difference."""
        return max((abs(value) for value in self.differences), default=0.0)

    @property
    def rms(self) -> float:
        """Root of the mean square of the differences."""
        return float(np.sqrt(np.mean(np.square(self.differences)))) if self.differences else 0.0

    @property
    def worst(self) -> tuple[float, float]:
        """Input and difference of the worst point."""
        at = int(np.argmax(np.abs(self.differences)))
        return self.inputs[at], self.differences[at]


def oriented(points: Points, *, actuator: bool) -> list[tuple[float, float]]:
    """Return points as (input, output): (raw, value) for sensors, (value, raw) for actuators."""
    return [(value, raw) for raw, value in points] if actuator else list(points)


def residuals(calibration: Calibration) -> Residuals | None:
    """Return the residuals of a calibration's own points by the curve as written (Float32), without the zero offset.

    None without points.
    """
    if not calibration.points:
        return None
    pairs = oriented(calibration.points, actuator=calibration.actuator)
    inputs = np.array([x for x, _ in pairs])
    references = np.array([y for _, y in pairs])
    curve = evaluate(calibration, inputs).value - calibration.zero_offset
    return Residuals(*(tuple(part.tolist()) for part in (inputs, references, curve, references - curve)))


MOST_LEFT_OUT = 200


def left_out(calibration: Calibration) -> tuple[float, ...]:
    """Return differences (reference - curve) of each inner point from a fit without it, in the order of the points.

    The residuals of a table are always 0, as it goes through every point. Empty if there are too few points for that,
    more than 200, or an actuator's.
    """
    points = calibration.points
    inputs = {raw for raw, _ in points}
    if calibration.actuator or not 3 <= len(points) <= MOST_LEFT_OUT:
        return ()
    degree = calibration.inputs[0].degree if calibration.method == "polynomial" else None
    found = []
    for raw, value in points:
        if raw in (min(inputs), max(inputs)):
            continue
        others = [point for point in points if point[0] != raw]
        try:
            curve = fit(others, calibration.method, channel=calibration.channel, degree=degree)
        except BadDataError:  # too few points are left
            return ()
        found.append(value - evaluate(curve, raw).value)
    return tuple(found)


def fit(
    points: Points,
    method: Method,
    *,
    channel: int,
    degree: int | None = None,
    actuator: bool = False,
    tolerance: float = 0.0,
) -> Calibration:
    """Fit a calibration to (raw, value) points. The curve only; dates, limits and unit are the caller's.

    linear: least squares, C = [intercept, slope], H = 0. polynomial: least squares about the middle of the points
    (default degree: 3, or what the points allow). table: through every point, straight in between; points of the same
    input are averaged, and with a ``tolerance`` nodes are left out as long as every point stays that close. steps: the
    value of a point holds up to the next one. Raises BadDataError for too few points, or more than a TEDS can hold.
    """
    pairs = oriented(points, actuator=actuator)
    distinct = len({x for x, _ in pairs})
    if distinct < 2:
        raise BadDataError(f"A calibration needs points at two different inputs or more; there are {distinct}.")
    match method:
        case "linear":
            part, coefficients = _polynomial(pairs, 1, about=0.0)
        case "polynomial":
            wanted = min(3, distinct - 1) if degree is None else degree
            if not 1 <= wanted <= MAXIMUM_DEGREE:
                raise BadDataError(f"The degree of a polynomial goes from 1 to {MAXIMUM_DEGREE}, not {wanted}.")
            if distinct <= wanted:
                raise BadDataError(
                    f"A polynomial of degree {wanted} needs {wanted + 1} different inputs; there are {distinct}."
                )
            xs = [x for x, _ in pairs]
            part, coefficients = _polynomial(pairs, wanted, about=(min(xs) + max(xs)) / 2)
        case "table":
            part, coefficients = _table(_require_room(_thinned(_averaged(pairs), tolerance)))
        case "steps":
            part, coefficients = _steps(_require_room(_averaged(pairs)))
    curve = CalibrationInput(channel, *part)
    if not curve.ascending:
        raise BadDataError(
            "Two inputs of the calibration are so close together that a Float32 cannot distinguish them."
        )
    return Calibration(channel, method, (curve,), coefficients, points=tuple(points), actuator=actuator)


_Part = tuple[int, tuple[float, ...], tuple[float, ...]]


def _polynomial(pairs: Points, degree: int, *, about: float) -> tuple[_Part, tuple[float, ...]]:
    about = float(np.float32(about))
    x = np.array([x for x, _ in pairs]) - about
    y = np.array([y for _, y in pairs])
    fitted = np.polynomial.Polynomial.fit(x, y, degree).convert()
    coefficients = np.zeros(degree + 1)
    coefficients[: len(fitted.coef)] = fitted.coef
    ends = (float(x.min() + about), float(x.max() + about))
    return (degree, ends, (about,)), tuple(coefficients.tolist())


def _averaged(pairs: Points) -> list[tuple[float, float]]:
    outputs: dict[float, list[float]] = defaultdict(list)
    for x, y in pairs:
        outputs[x].append(y)
    return [(x, sum(ys) / len(ys)) for x, ys in sorted(outputs.items())]


def _table(pairs: Points) -> tuple[_Part, tuple[float, ...]]:
    x, y = _columns(pairs)
    slopes = np.diff(y) / np.diff(x)
    coefficients = np.column_stack([y[:-1], slopes]).ravel()
    return (1, tuple(x.tolist()), tuple(x[:-1].tolist())), tuple(coefficients.tolist())


def _steps(pairs: Points) -> tuple[_Part, tuple[float, ...]]:
    x, y = _columns(pairs)
    end = x[-1] + (x[-1] - x[-2])
    return (0, (*x.tolist(), float(end)), tuple(x.tolist())), tuple(y.tolist())


def _require_room(pairs: list[tuple[float, float]]) -> list[tuple[float, float]]:
    if len(pairs) > MAXIMUM_NODES:
        raise BadDataError(
            f"A table of {len(pairs)} nodes is too large for a TEDS, which holds {MAXIMUM_NODES} at most.",
            hint="Thin it with a tolerance (# tolerance: 0.05), or fit a polynomial.",
        )
    return pairs


def _thinned(pairs: list[tuple[float, float]], tolerance: float) -> list[tuple[float, float]]:
    """Return nodes of a polygon that stays within ``tolerance`` of every point (Douglas-Peucker, vertical distance)."""
    if tolerance <= 0 or len(pairs) < 3:
        return pairs
    x, y = _columns(pairs)
    keep = np.zeros(len(x), dtype=bool)
    keep[[0, -1]] = True
    pending = [(0, len(x) - 1)]
    while pending:
        first, last = pending.pop()
        if last - first < 2:
            continue
        inner = slice(first + 1, last)
        away = np.abs(y[inner] - np.interp(x[inner], x[[first, last]], y[[first, last]]))
        worst = first + 1 + int(np.argmax(away))
        if away.max() > tolerance:
            keep[worst] = True
            pending += [(first, worst), (worst, last)]
    return [pair for pair, kept in zip(pairs, keep.tolist(), strict=True) if kept]


def _columns(pairs: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    both = np.array(pairs, dtype=np.float64)
    return both[:, 0], both[:, 1]


def kind_of(calibration: Calibration) -> str:
    """Return ``linear``, ``polynomial of degree 3`` or ``table of 64 segments``."""
    segments = math.prod(part.segments for part in calibration.inputs)
    if calibration.method in ("table", "steps"):
        return f"{calibration.method} of {segments} segment{'s' if segments > 1 else ''}"
    text = f"polynomial of degree {calibration.inputs[0].degree}" if calibration.method == "polynomial" else "linear"
    return text if segments == 1 else f"{text}, {segments} segments"


def describe_calibration(calibration: Calibration, now: datetime | None = None) -> dict[str, Any]:
    """Return plain data of a calibration; residuals if it has its points, ``overdue`` if ``now`` is given."""
    left = residuals(calibration)
    shown = None
    if left is not None:
        at, difference = left.worst
        shown = {
            "points": len(left.inputs),
            "maximum": left.maximum,
            "rms": left.rms,
            "worst": {"input": at, "difference": difference},
        }
    return {
        "channel": calibration.channel,
        "kind": kind_of(calibration),
        "method": calibration.method,
        "inputs": [part.channel for part in calibration.inputs],
        "coefficients": len(calibration.coefficients),
        "unit": calibration.unit.text,
        "uncertainty": calibration.uncertainty,
        "zero_offset": calibration.zero_offset,
        "zeroed": calibration.zeroed.isoformat() if calibration.zeroed else None,
        "monotone": calibration.monotone,
        "raw_range": list(calibration.raw_range) if calibration.raw_range else None,
        "date": calibration.date.isoformat() if calibration.date else None,
        "interval": calibration.interval,
        "due": calibration.due.isoformat() if calibration.due else None,
        "overdue": calibration.overdue(now) if now is not None else None,
        "by": calibration.by,
        "residuals": shown,
    }


def sentence(calibration: Calibration) -> str:
    """Return text for people: ``channel 1: polynomial of degree 3, 20 points, largest residual 0.1 N at raw 300``."""
    unit = "raw" if calibration.actuator else calibration.unit.text
    text = f"channel {calibration.channel}: {kind_of(calibration)}"
    left = residuals(calibration)
    if left is not None:
        at, _ = left.worst
        place = f"{at:.6g} {calibration.unit.text}" if calibration.actuator else f"raw {at:.8g}"
        text += f", {counted(len(left.inputs), 'point')}, largest residual {left.maximum:.3g} {unit} at {place}"
        text += f", rms {left.rms:.3g} {unit}"
    if calibration.due is not None:
        text += f", due {calibration.due:%Y-%m-%d}"
    return text
