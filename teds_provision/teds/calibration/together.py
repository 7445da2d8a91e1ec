"""Many channels of one form at once: what :class:`ChannelInterpreter` gives for each, in one pass over all.

A stream brings a few samples of many channels, and numpy's cost is then that of its calls. Channels of unsigned
integers of one width, each with at most one input, are laid side by side: their curves become one table, padded to the
longest. The results are those of the interpreters to the last bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from teds_provision.teds.calibration.interpreter import ChannelInterpreter
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.calibration.samples import DataModel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_WORD: Final = 8
_MOST_SEGMENTS: Final = 64
"""Longer tables are searched channel by channel: here each boundary is compared."""


class Together:
    """Channels side by side; make one with :meth:`of`. Values are in SI units, NaN where not valid."""

    def __init__(self, channels: Sequence[ChannelInterpreter], usable: Sequence[bool]) -> None:
        self._lay_curves([one.channel.calibration for one in channels])
        self._scale = np.array([one.unit.scale for one in channels])
        self._offset = np.array([one.unit.offset for one in channels])
        self._same = np.array([one.shown_as_computed for one in channels])
        self._converts = not self._same.all()
        bounds = [one.reader.form.raw_range for one in channels]
        self._most = np.array([np.inf if bound is None else bound[1] for bound in bounds])
        self._floor, self._ceiling = (np.array(ends) for ends in zip(*(one.accepted for one in channels), strict=True))
        self._usable = np.array(usable)
        self._width = channels[0].octets
        self._columns = np.arange(len(channels))

    def _lay_curves(self, curves: Sequence[Calibration | None]) -> None:
        """The curves as one table; a channel without one gives its raw values (one segment, C = [0, 1])."""
        parts = [curve.inputs[0] for curve in curves if curve is not None]
        segments = max((part.segments for part in parts), default=1)
        degree = max((part.degree for part in parts), default=1)
        count = len(curves)
        self._inner = np.full((count, segments - 1), np.inf)
        self._offsets = np.zeros((count, segments))
        self._terms = np.zeros((degree + 1, count, segments))
        self._zero = np.zeros(count)
        self._own_scale, self._own_offset = np.ones(count), np.zeros(count)
        for row, curve in enumerate(curves):
            if curve is None:
                self._terms[1, row, :] = 1.0
            else:
                self._lay_curve(row, curve)

    def _lay_curve(self, row: int, curve: Calibration) -> None:
        part = curve.inputs[0]
        own = part.segments
        self._inner[row, : own - 1] = part.boundaries[1:-1]
        self._offsets[row, :own] = part.offsets
        table = np.asarray(curve.coefficients, dtype=np.float64).reshape(own, part.degree + 1)
        self._terms[: part.degree + 1, row, :own] = table.T
        self._zero[row] = curve.zero_offset
        self._own_scale[row], self._own_offset[row] = curve.unit.scale, curve.unit.offset

    @classmethod
    def of(cls, channels: Sequence[ChannelInterpreter], usable: Sequence[bool]) -> Together | None:
        """Side by side, or None where they are not of one form; those that are not ``usable`` give no values."""
        widths = {one.octets for one in channels}
        if len(widths) != 1 or max(widths) > _WORD:
            return None
        return cls(channels, usable) if all(map(_can_stand_beside, channels)) else None

    def raw(self, rows: NDArray[np.uint8]) -> NDArray[np.uint64]:
        """Raw values, instants × channels, of instants as they stand in a message."""
        padded = np.zeros((len(rows), len(self._columns), _WORD), dtype=np.uint8)
        padded[:, :, _WORD - self._width :] = rows.reshape(len(rows), -1, self._width)
        return padded.view(">u8")[:, :, 0].astype(np.uint64)

    def values(self, raw: NDArray[np.uint64]) -> tuple[Floats, NDArray[np.bool_]]:
        """Values in SI units, and which are valid."""
        numbers = raw.astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            if self._inner.shape[1]:
                segment = (numbers[:, :, None] >= self._inner).sum(axis=2)
                distance = numbers - self._offsets[self._columns, segment]
                terms = self._terms[:, self._columns, segment]
            else:
                distance = numbers - self._offsets[:, 0]
                terms = self._terms[:, :, 0]
            total: Floats = np.zeros_like(numbers)
            for term in terms[::-1]:
                total *= distance
                total += term
            total += self._zero
            if self._converts:
                converted = (total * self._own_scale + self._own_offset - self._offset) / self._scale
                total = np.where(self._same, total, converted)
            valid = (numbers <= self._most) & (total >= self._floor) & (total <= self._ceiling) & np.isfinite(total)
            valid &= self._usable
            total = total * self._scale + self._offset
            if not valid.all():
                total[~valid] = np.nan
            return total, valid


def _can_stand_beside(one: ChannelInterpreter) -> bool:
    """A sensor of unsigned integers with a curve over its own raw value, of not too many segments, or none."""
    if one.reader.form.model != DataModel.UNSIGNED or one.channel.actuator or one.others:
        return False
    curve = one.channel.calibration
    return curve is None or (len(curve.inputs) == 1 and curve.inputs[0].segments <= _MOST_SEGMENTS)
