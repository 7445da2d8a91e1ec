"""Many channels of one form at once: what :class:`ChannelInterpreter` gives for each, in one pass over all.

A stream brings a few samples of many channels, and numpy's cost is then that of its calls. Channels of unsigned
integers of one width, each with at most one input, are laid side by side: their curves become one table, padded to the
longest. The results are those of the interpreters to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final
from weakref import WeakValueDictionary

import numpy as np

from teds_provision.arrays import Floats, NDArray
from teds_provision.teds.calibration.interpreter import ChannelInterpreter
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.calibration.samples import WORD, DataModel, big_endian
from teds_provision.teds.channel import wrapped

_FAR_FROM_OVERFLOW: Final = 1e100
_MOST_SEGMENTS: Final = 64
"""Longer tables are searched channel by channel: here each boundary is compared."""
_MOST_KNOWN: Final = 1 << 16
"""Raw values of all channels together that :meth:`ManyChannels.calibrate_all` calibrates, half a megabyte: one channel
of 16 bits, or 256 of 8."""
_MOST_TABLES: Final = 16
"""Such tables in one process: those of further channels would take more memory than time they save."""
_TABLES: Final[WeakValueDictionary[tuple[object, ...], NDArray[np.float64]]] = WeakValueDictionary()
"""Those in use, by everything that they follow from: channels of one curve share one."""


class ManyChannels:
    """Channels side by side; make one with :meth:`side_by_side`. Values are in SI units, NaN if not valid."""

    def __init__(self, channels: Sequence[ChannelInterpreter], usable: Sequence[bool]) -> None:
        self._lay_curves([interpreter.channel.calibration for interpreter in channels])
        self._scale = np.array([interpreter.unit.scale for interpreter in channels])
        self._offset = np.array([interpreter.unit.offset for interpreter in channels])
        self._same = np.array([interpreter.shown_as_computed for interpreter in channels])
        self._converts = not self._same.all()
        self._most = np.array([_most(interpreter) for interpreter in channels])
        self._floor, self._ceiling = (
            np.array(ends) for ends in zip(*(interpreter.accepted for interpreter in channels), strict=True)
        )
        self._turns = np.array([math.isfinite(interpreter.turn) for interpreter in channels])
        self._turning = bool(self._turns.any())
        self._turn = np.array(
            [interpreter.turn if math.isfinite(interpreter.turn) else 1.0 for interpreter in channels]
        )
        self._begin, self._end = (
            np.array(ends) for ends in zip(*(interpreter.wraps_into for interpreter in channels), strict=True)
        )
        self._usable = None if all(usable) else np.array(usable)
        self._width = channels[0].octets
        self._columns = np.arange(len(channels))
        self._prepare()

    def _prepare(self) -> None:
        """Drop operations without effect: a call of numpy costs as much for few samples as for many."""
        self._form = np.dtype(f">u{self._width}") if self._width in (1, 2, 4, 8) else None
        self._native = np.dtype(np.int64 if self._width < WORD else np.uint64)
        self._may_be_more = bool((self._most < 2.0 ** (8 * self._width) - 1).any())
        self._curves = np.concatenate([self._offsets[None], self._terms])
        self._lowest, self._highest = self._curves[:, None, :, 0], self._curves[:, None, :, -1]
        self._plain = [self._bare(row) for row in self._lowest[:, 0]] if self._inner.shape[1] == 0 else None
        self._lows, self._highs = self._bare(self._floor), self._bare(self._ceiling)
        self._bounded = bool(np.isfinite(self._floor).all() and np.isfinite(self._ceiling).all())
        self._shifted = bool(self._zero.any())
        self._scaled = bool((self._scale != 1.0).any() or self._offset.any())
        # An upper bound for the curve's values: if it is far below the largest float, nothing can overflow.
        reach = 2.0 ** (8 * self._width) + np.abs(self._offsets).max()
        with np.errstate(all="ignore"):
            largest = sum(np.abs(term).max() * reach**power for power, term in enumerate(self._terms))
        self._tame = bool(largest < _FAR_FROM_OVERFLOW)
        self._known: Floats | None = None

    def calibrate_all(self) -> None:
        """Calibrate every possible raw value, if they are few: from then on a message is looked up, in half the time.

        That takes 2 ms and half a megabyte for a channel of 16 bits, so it is for a stream that has many messages.
        """
        possible = 1 << 8 * self._width
        if self._known is not None or possible * len(self._columns) > _MOST_KNOWN:
            return
        curves = (self._inner, self._curves, self._zero, self._own_scale, self._own_offset)
        units = (self._scale, self._offset, self._same, self._most, self._floor, self._ceiling)
        turns = (self._turns, self._turn, self._begin, self._end, self._usable)
        parts = (None if part is None else part.tobytes() for part in (*curves, *units, *turns))
        key = (self._width, self._curves.shape, *parts)
        table = _TABLES.get(key)
        if table is None and len(_TABLES) < _MOST_TABLES:
            every = np.repeat(np.arange(possible)[:, None], len(self._columns), axis=1)
            _TABLES[key] = table = np.ascontiguousarray(self.values(every)[0].T).ravel()
        self._places = self._columns * possible if len(self._columns) > 1 else None
        self._known = table

    @staticmethod
    def _bare(row: Floats) -> Floats | float:
        """Return a number for each channel; of one channel the number itself, which numpy takes in half the time."""
        return float(row[0]) if len(row) == 1 else row

    def _lay_curves(self, curves: Sequence[Calibration | None]) -> None:
        """Arrange the curves as one table; a channel without one gives its raw values (one segment, C = [0, 1])."""
        parts = [curve.inputs[0] for curve in curves if curve is not None]
        segments = max((part.segments for part in parts), default=1)
        # step functions have degree 0: their second coefficient is 0
        degree = max([1, *(part.degree for part in parts)])
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
    def side_by_side(cls, channels: Sequence[ChannelInterpreter], usable: Sequence[bool]) -> ManyChannels | None:
        """Return them side by side, or None if they are not of one form.

        Those that are not ``usable`` give no values.
        """
        widths = {interpreter.octets for interpreter in channels}
        if len(widths) != 1 or max(widths) > WORD:
            return None
        return cls(channels, usable) if all(map(_can_stand_beside, channels)) else None

    def raw(self, octets: bytes) -> NDArray[Any]:
        """Return raw values (int64; of 8 octets uint64), instants × channels, of a message's consecutive instants."""
        if self._form is not None:
            return np.frombuffer(octets, self._form).astype(self._native).reshape(-1, len(self._columns))
        rows = np.frombuffer(octets, dtype=np.uint8).reshape(-1, len(self._columns), self._width)
        return big_endian(rows).astype(self._native)

    def values(self, raw: NDArray[Any]) -> tuple[Floats, NDArray[np.bool_]]:
        """Return values in SI units, and which are valid."""
        if self._known is not None:
            value: Floats = self._known.take(raw if self._places is None else raw + self._places)
            return value, value == value  # noqa: PLR0124  NaN alone is not itself
        numbers = raw.astype(np.float64)
        if self._tame:
            return self._valued(numbers, self._curved(numbers))
        with np.errstate(over="ignore", invalid="ignore"):
            return self._valued(numbers, self._curved(numbers))

    def _curved(self, numbers: Floats) -> Floats:
        """Return the curves' results for raw numbers, in their own units."""
        offset, *terms = self._plain or self._segments(numbers)
        distance = numbers - offset
        total: Floats = terms[-1] * distance
        for term in terms[-2:0:-1]:
            total += term
            total *= distance
        total += terms[0]
        if self._shifted:
            total += self._zero
        return total

    def _segments(self, numbers: Floats) -> Floats:
        """Return offset and coefficients of each number's segment, (degree + 2) × instants × channels."""
        if self._inner.shape[1] == 1:
            return np.where(numbers >= self._inner[:, 0], self._highest, self._lowest)
        segment = (numbers[:, :, None] >= self._inner).sum(axis=2)
        found: Floats = self._curves[:, self._columns, segment]
        return found

    def _valued(self, numbers: Floats, total: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Convert curve values to the channels' units, check them against their limits, and return them in SI units."""
        if self._converts:
            converted = (total * self._own_scale + self._own_offset - self._offset) / self._scale
            total = np.where(self._same, total, converted)
        if self._turning:
            total = np.where(self._turns, wrapped(total, self._begin, self._end, self._turn), total)
        valid = total >= self._lows
        valid &= total <= self._highs
        if not self._bounded:
            valid &= np.isfinite(total)
        if self._may_be_more:
            valid &= numbers <= self._most
        if self._usable is not None:
            valid &= self._usable
        if self._scaled:
            total = total * self._scale + self._offset
        if np.count_nonzero(valid) < valid.size:
            total[~valid] = np.nan
        return total, valid


def _most(interpreter: ChannelInterpreter) -> float:
    """Return the largest raw value that counts."""
    bound = interpreter.reader.form.raw_range
    return math.inf if bound is None else bound[1]


def _can_stand_beside(interpreter: ChannelInterpreter) -> bool:
    """Return True for a sensor of unsigned integers with few segments over its own raw value, or without a curve."""
    if interpreter.reader.form.model != DataModel.UNSIGNED or interpreter.channel.actuator or interpreter.others:
        return False
    curve = interpreter.channel.calibration
    return curve is None or (len(curve.inputs) == 1 and curve.inputs[0].segments <= _MOST_SEGMENTS)
