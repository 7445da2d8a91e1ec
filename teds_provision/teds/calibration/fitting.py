"""Calibrations from measured points: straight line, polynomial, table with interpolation, table of steps."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from teds_provision.errors import BadData
from teds_provision.lazy import late
from teds_provision.teds.calibration.formula import evaluate
from teds_provision.teds.calibration.model import Calibration, CalibrationInput, Method

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
else:
    np = late("numpy")

Points = Sequence[tuple[float, float]]
MAXIMUM_DEGREE = 12
MAXIMUM_NODES = 8000  # 8 octets of coefficients each, in one tuple of at most 65535


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
    """Points as (input, output): (raw, value) for sensors, (value, raw) for actuators."""
    return [(value, raw) for raw, value in points] if actuator else list(points)


def residuals(calibration: Calibration) -> Residuals | None:
    """Residuals of a calibration's own points, by the curve as written (Float32), the zero offset left out.

    None without points.
    """
    if not calibration.points:
        return None
    pairs = oriented(calibration.points, actuator=calibration.actuator)
    inputs = np.array([x for x, _ in pairs])
    references = np.array([y for _, y in pairs])
    curve = evaluate(calibration, inputs).value - calibration.zero_offset
    return Residuals(*(tuple(part.tolist()) for part in (inputs, references, curve, references - curve)))


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
    value of a point holds up to the next one. Raises BadData for too few points, or more than a TEDS can hold.
    """
    pairs = oriented(points, actuator=actuator)
    distinct = len({x for x, _ in pairs})
    if distinct < 2:
        raise BadData(f"A calibration needs points at two different inputs or more; there are {distinct}.")
    match method:
        case "linear":
            part, coefficients = _polynomial(pairs, 1, about=0.0)
        case "polynomial":
            wanted = min(3, distinct - 1) if degree is None else degree
            _require_degree(wanted, distinct)
            xs = [x for x, _ in pairs]
            part, coefficients = _polynomial(pairs, wanted, about=(min(xs) + max(xs)) / 2)
        case "table":
            part, coefficients = _table(_held(_thinned(_averaged(pairs), tolerance)))
        case "steps":
            part, coefficients = _steps(_held(_averaged(pairs)))
    curve = CalibrationInput(channel, *part)
    if not curve.ascending:
        raise BadData("Two inputs of the calibration lie so close together that a Float32 cannot tell them apart.")
    return Calibration(channel, method, (curve,), coefficients, points=tuple(points), actuator=actuator)


def _require_degree(degree: int, inputs: int) -> None:
    if not 1 <= degree <= MAXIMUM_DEGREE:
        raise BadData(f"The degree of a polynomial goes from 1 to {MAXIMUM_DEGREE}, not {degree}.")
    if inputs <= degree:
        raise BadData(f"A polynomial of degree {degree} needs {degree + 1} different inputs; there are {inputs}.")


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


def _held(pairs: list[tuple[float, float]]) -> list[tuple[float, float]]:
    if len(pairs) > MAXIMUM_NODES:
        raise BadData(
            f"A table of {len(pairs)} nodes is too large for a TEDS, which holds {MAXIMUM_NODES} at most.",
            hint="Thin it with a tolerance (# tolerance: 0.05), or fit a polynomial.",
        )
    return pairs


def _thinned(pairs: list[tuple[float, float]], tolerance: float) -> list[tuple[float, float]]:
    """Nodes of a polygon that stays within ``tolerance`` of every point (Douglas-Peucker, measured upright)."""
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
