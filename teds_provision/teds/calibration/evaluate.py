"""The segmented multinomial, for scalars and numpy arrays."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np

from teds_provision.errors import BadData
from teds_provision.teds.calibration.model import Evaluation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from teds_provision.teds.calibration.model import Calibration, CalibrationInput


def evaluate(calibration: Calibration, inputs: tuple[object, ...]) -> Evaluation[Any]:
    """See :meth:`Calibration.evaluate`; computes in Float64 with the coefficients as they are."""
    parts = calibration.inputs
    if len(inputs) != len(parts):
        raise BadData(f"The calibration of channel {calibration.channel} takes {len(parts)} inputs, not {len(inputs)}.")
    scalar = all(np.ndim(value) == 0 for value in inputs)  # type: ignore[arg-type]
    arrays = np.broadcast_arrays(*(np.asarray(value, dtype=np.float64) for value in inputs))
    cell = np.zeros(arrays[0].shape, dtype=np.intp)
    outside = np.zeros(arrays[0].shape, dtype=bool)
    distances: list[NDArray[np.float64]] = []
    for part, values in zip(parts, arrays, strict=True):
        segment, distance = _locate(part, values)
        cell = cell * part.segments + segment
        distances.append(distance)
        outside |= ~((values >= part.boundaries[0]) & (values <= part.boundaries[-1]))
    with np.errstate(over="ignore", invalid="ignore"):
        value = _sum(calibration, cell, distances) + calibration.zero_offset
    flags = outside.astype(np.float64)
    return Evaluation(float(value), float(flags)) if scalar else Evaluation(value, flags)


def _locate(part: CalibrationInput, values: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Segment of each value (a boundary belongs to the upper one) and its distance from the segment's offset."""
    inner = np.asarray(part.boundaries[1:-1])
    segment = np.searchsorted(inner, values, side="right")
    return segment, values - np.asarray(part.offsets)[segment]


def _sum(calibration: Calibration, cell: NDArray[np.intp], distances: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    exponents = [range(part.degree + 1) for part in calibration.inputs]
    table = np.asarray(calibration.coefficients, dtype=np.float64).reshape(-1, _count(exponents))
    if len(distances) == 1:  # Horner
        total = np.zeros_like(distances[0])
        for column in reversed(range(table.shape[1])):
            total = total * distances[0] + table[cell, column]
        return total
    total = np.zeros_like(distances[0])
    for column, powers in enumerate(itertools.product(*exponents)):
        term = table[cell, column]
        for distance, power in zip(distances, powers, strict=True):
            term = term * distance**power
        total = total + term
    return total


def _count(exponents: list[range]) -> int:
    count = 1
    for powers in exponents:
        count *= len(powers)
    return count
