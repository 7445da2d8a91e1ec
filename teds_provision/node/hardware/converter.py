"""Conversion of a source's values to the octets of a sample, one at a time and quickly; and back for an actuator."""

from __future__ import annotations

import bisect
import math
import struct
from typing import Final

import numpy as np

from teds_provision.errors import BadDataError
from teds_provision.node.sources.base import Reading, SourceChannel
from teds_provision.teds.calibration.interpreter import ChannelInterpreter
from teds_provision.teds.calibration.samples import DataModel, SampleReader
from teds_provision.teds.sheet import Channel, Sheet

_KNOTS: Final = 257
_INTEGER_TOLERANCE: Final = 0.01  # of a step: a value this near a rounding edge may go either way
_FLOAT_TOLERANCE: Final = 1e-9
_MOST_FLOAT: Final = 3e38
_PACKING: Final = {DataModel.FLOAT32: struct.Struct(">f"), DataModel.FLOAT64: struct.Struct(">d")}


class Converter:
    """Converts for one channel of the datasheet that the node was made with.

    Without a calibration, an integer channel is an ideal converter: its range is spread evenly over the raw numbers.
    Raises BadDataError if samples of that form cannot be made.
    """

    def __init__(self, sheet: Sheet, channel: Channel) -> None:
        if channel.sample is None:
            raise BadDataError(f"The datasheet does not say how a sample of channel {channel.number} is coded.")
        self.form = channel.sample
        self._writer = SampleReader(channel.sample)
        self._channel = channel
        self._interpreter = ChannelInterpreter(sheet, channel.number)
        self.low, self.high = self._interpreter.limits
        self._octets = self.form.octets
        width = 8 * self._octets
        bits = self.form.bits if 0 < self.form.bits < width else width
        self._most = (1 << bits) - 1 if self.form.integer or self.form.model == DataModel.BITS else None
        self._packing = _PACKING.get(DataModel(self.form.model))
        self._turn = self._interpreter.turn
        # If values wrap, the curve's range begins at its first raw number, not at LowLimit.
        self._from, self._to = self.low, self.high
        if self._turn < math.inf and not self._interpreter.problem:
            self._from, high = self._interpreter.given or (self.low, self.high)
            self._to = min(high, self._from + self._turn * (1 - 1e-9))
        self._table = self._tabulated()

    @property
    def place(self) -> SourceChannel:
        """The channel as sources see it."""
        return SourceChannel(self._channel.number, self._channel.name, self.low, self.high)

    def octets(self, reading: Reading) -> bytes:
        """Return the sample of a reading; values are kept within the limits, and rounded to what a sample holds.

        Raises BadDataError if the value cannot be converted to a sample.
        """
        if reading.missing:
            return self._no_value()
        return self.write(reading.raw if reading.raw is not None else self.raw(reading.value or 0.0))

    def raw(self, value: float) -> float:
        """Return the raw number, not rounded, of a value in its display unit."""
        if self._turn < math.inf:
            value = self._wrapped(value)
        else:
            value = self.low if value < self.low else self.high if value > self.high else value
        if self._table is None:
            return float(self._interpreter.raw_numbers(np.array([value]))[0])
        values, raws = self._table
        at = bisect.bisect_right(values, value, 1, len(values) - 1)
        share = (value - values[at - 1]) / (values[at] - values[at - 1])
        return raws[at - 1] + share * (raws[at] - raws[at - 1])

    def _wrapped(self, value: float) -> float:
        """Return an angle moved by whole turns into the range of the curve, or to the nearer of its ends."""
        value = self._from + (value - self._from) % self._turn
        if value <= self._to:
            return value
        return self._to if value - self._to <= self._from + self._turn - value else self._from

    def write(self, raw: float) -> bytes:
        """Return the octets of a raw number, rounded and clipped to what a sample can hold."""
        if self._most is not None:
            return min(max(round(raw), 0), self._most).to_bytes(self._octets, "big")
        if self._packing is not None and abs(raw) < _MOST_FLOAT:
            return self._packing.pack(raw)
        return self._writer.write(np.array([raw]))

    def _no_value(self) -> bytes:
        """Return a sample that no reader takes for a value; raises BadDataError if every sample is one."""
        if self._packing is not None:
            return self._packing.pack(math.nan)
        if self._most is not None and self._most < (1 << 8 * self._octets) - 1:
            return b"\xff" * self._octets
        raise BadDataError("Every sample of this channel is a value.")

    def value(self, octets: bytes) -> float | None:
        """Return the value that a set point means, None if it is undefined."""
        if self._interpreter.problem:
            ends, raw = self.form.raw_range, self.raw_of(octets)
            if ends is None or not math.isfinite(raw) or not self._ranged:
                return None
            return self.low + raw / ends[1] * (self.high - self.low)
        values = self._interpreter.decode(octets).value
        return float(values[0]) if math.isfinite(values[0]) else None

    def raw_of(self, octets: bytes) -> float:
        """Return the raw number that octets hold; NaN if they hold none."""
        numbers, possible = self._writer.numbers(self._writer.raw(octets))
        return float(numbers[0]) if possible[0] else math.nan

    @property
    def _ranged(self) -> bool:
        return math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high

    def _tabulated(self) -> tuple[list[float], list[float]] | None:
        """Return knots from values to raw numbers if straight lines between them are as good as the curve."""
        if not self._ranged:
            return None
        ends = self.form.raw_range
        if self._interpreter.problem:
            return ([self._from, self._to], [0.0, ends[1]]) if ends is not None else None
        knots = np.linspace(self._from, self._to, 2 * _KNOTS - 1)
        try:
            raws = self._interpreter.raw_numbers(knots)
        except BadDataError:
            return None
        between = (raws[0:-1:2] + raws[2::2]) / 2
        tolerance = _INTEGER_TOLERANCE if self.form.integer else _FLOAT_TOLERANCE * float(np.abs(raws).max())
        if not np.isfinite(raws).all() or float(np.abs(between - raws[1::2]).max()) > tolerance:
            return None
        return [float(x) for x in knots[::2]], [float(x) for x in raws[::2]]
