"""From the octets of a channel to values with a unit, and back, prepared once from its datasheet.

This is the papers' interpreter: no line of code knows a sensor, everything comes from the :class:`Sheet`. It works in
blocks: callers pass the octets of many samples at once.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from teds_provision.arrays import Floats, NDArray, Octets, np
from teds_provision.errors import BadDataError
from teds_provision.teds.calibration.formula import PreparedCurve, PreparedInverse
from teds_provision.teds.calibration.samples import Range, SampleForm, SampleReader
from teds_provision.teds.channel import ROUNDING, TURN, wrapped
from teds_provision.teds.sheet import Channel, Sheet
from teds_provision.teds.units import WrittenUnit


@dataclass(frozen=True)
class Values:
    """A block of samples: ``raw`` by the data model, ``value`` in the channel's unit, NaN if not ``valid``.

    Not valid: the raw value is impossible (more than SigBits, not a number), or the value is beyond the limits by more
    than the stated uncertainty, or is not a number. Angles over a full turn wrap, so no limit is beyond them.
    ``extrapolated``: an input was outside the calibrated range; such a value is valid as long as it is within the
    limits, which the guard checked before the datasheet was signed.
    """

    raw: NDArray[np.generic]
    value: Floats
    valid: NDArray[np.bool_]
    extrapolated: NDArray[np.bool_]


class ChannelInterpreter:
    """Reads and writes the samples of one channel of a datasheet.

    ``unit`` is the unit of the values, ``uncertainty`` the worst case in it (None if not stated), ``limits`` are
    LowLimit and HiLimit in it (infinite if not stated), ``turn`` is a turn in it if values wrap into ``wraps_into``,
    else infinite. ``problem`` is a sentence on why there are raw values only ("" if there are values), for example a
    channel without calibration.
    """

    def __init__(self, sheet: Sheet, number: int) -> None:
        """Prepare channel ``number``; raises BadDataError if it does not exist or its samples cannot be decoded."""
        channel = sheet.channel(number)
        if channel is None:
            raise BadDataError(f"The datasheet describes no channel {number}.")
        if channel.sample is None:
            raise BadDataError(f"The datasheet does not say how a sample of channel {number} is coded.")
        self.channel: Channel = channel
        self.reader = SampleReader(channel.sample)
        self.unit: WrittenUnit = channel.unit
        self._readers = {part: SampleReader(form) for part, form in _forms(sheet, self.inputs).items()}
        self.problem = self._problem(sheet)
        self.limits = self._limits()
        self.turn = abs(self.unit.difference_from_si(TURN)) if channel.full_turn else math.inf
        ends = self.unit.from_si(channel.low), self.unit.from_si(channel.high)
        self.wraps_into: Range = min(ends), max(ends)
        stated = self.channel.stated_uncertainty
        self.uncertainty = self.unit.difference_from_si(stated) if math.isfinite(stated) and stated >= 0 else None
        slack = self.uncertainty or 0.0
        low, high = self.limits
        self._floor = low - slack - ROUNDING * abs(low) if math.isfinite(low) else -math.inf
        self._ceiling = high + slack + ROUNDING * abs(high) if math.isfinite(high) else math.inf

    @property
    def octets(self) -> int:
        """Octets of one sample (ModLenth)."""
        return self.reader.octets

    @property
    def inputs(self) -> tuple[int, ...]:
        """Channels whose raw values the calibration takes, in its order; this channel alone without one."""
        own = self.channel.calibration
        if own is None or self.channel.actuator:
            return (self.channel.number,)
        return tuple(part.channel for part in own.inputs)

    @property
    def others(self) -> tuple[int, ...]:
        """Further channels whose raw values are needed for a value of this one."""
        return tuple(number for number in dict.fromkeys(self.inputs) if number != self.channel.number)

    def decode(self, octets: Octets, others: Mapping[int, Octets] | None = None) -> Values:
        """Return the values of a block of samples; ``others`` has octets of as many samples of each further input."""
        raw = self.reader.raw(octets)
        rows = {number: self._readers[number].raw(more) for number, more in (others or {}).items()}
        return self.values(raw, rows)

    def values(self, raw: NDArray[np.generic], others: Mapping[int, NDArray[np.generic]] | None = None) -> Values:
        """Return values of raw values (of :meth:`SampleReader.raw`); raises BadDataError if an input is missing."""
        shown, valid, extrapolated = self._computed(raw, others or {})
        valid &= (shown >= self._floor) & (shown <= self._ceiling) & np.isfinite(shown)
        return Values(raw, np.where(valid, shown, math.nan), valid, extrapolated)

    def calibrated(
        self, raw: NDArray[np.generic], others: Mapping[int, NDArray[np.generic]] | None = None
    ) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_]]:
        """Return the result of a sensor's calibration, in its own unit, neither wrapped nor limited.

        In addition: which raw values are possible, and which are beyond the calibrated range. Raises BadDataError if
        there is no calibration that can be computed, or an input is missing.
        """
        if self.problem or self._curve is None or self.channel.actuator:
            raise BadDataError(self.problem or f"Channel {self.channel.number} has no calibration of a sensor.")
        inputs, possible = self._inputs(*self.reader.numbers(raw), others or {})
        return self._curve(*inputs), possible, self._curve.outside(*inputs)

    def why_invalid(
        self, raw: NDArray[np.generic], others: Mapping[int, NDArray[np.generic]] | None = None
    ) -> dict[str, int]:
        """Return why raw values are invalid, as half sentences with counts; nothing for valid ones."""
        if self.problem:
            return {self.problem.removesuffix("."): len(raw)}
        shown, possible, extrapolated = self._computed(raw, others or {})
        low, high = (self.channel.show(self.unit.to_si(limit)) for limit in self.limits)
        found: dict[str, int] = {}
        left = np.ones(len(raw), dtype=bool)
        with np.errstate(invalid="ignore"):
            beyond = (shown < self._floor) | (shown > self._ceiling)
            for why, where in (
                ("the raw value is none that the channel can give", ~possible),
                ("beyond the calibrated range", beyond & extrapolated),
                (f"below its low limit, {low}", shown < self._floor),
                (f"above its high limit, {high}", shown > self._ceiling),
                ("the calibration gives no number", ~np.isfinite(shown)),
            ):
                count = int(np.count_nonzero(left & where))
                left &= ~where
                if count:
                    found[why] = count
        return found

    def _computed(
        self, raw: NDArray[np.generic], others: Mapping[int, NDArray[np.generic]]
    ) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_]]:
        """Return values before limits are applied, which raw values are possible, and which are extrapolated."""
        numbers, valid = self.reader.numbers(raw)
        if self.problem or (self.channel.actuator and self._curve is not None and self._way_back is None):
            nothing = np.full(len(raw), math.nan)
            return nothing, np.zeros(len(raw), dtype=bool), np.zeros(len(raw), dtype=bool)
        if self.channel.actuator and self._way_back is not None:
            shown = self._shown(self._way_back(numbers))
            extrapolated = np.zeros(len(raw), dtype=bool)
        elif self._curve is not None:
            inputs, valid = self._inputs(numbers, valid, others)
            shown = self._shown(self._curve(*inputs))
            extrapolated = self._curve.outside(*inputs)
        else:
            shown, extrapolated = self._shown(numbers), np.zeros(len(raw), dtype=bool)
        return self.within_turn(shown), valid, extrapolated

    def encode(self, values: Floats | float, others: Mapping[int, NDArray[np.generic]] | None = None) -> bytes:
        """Return the octets of values in :attr:`unit`, kept within the limits, converted and rounded to the sample.

        For an actuator the set point to send, for a virtual sensor the sample that it would give. Raises BadDataError
        if there is no inverse (no calibration, a curve that turns, a value that is not finite).
        """
        values = np.clip(self.within_turn(np.atleast_1d(np.asarray(values, dtype=np.float64))), *self.limits)
        if not np.isfinite(values).all():
            raise BadDataError(f"A value of channel {self.channel.number} is not finite.")
        return self.reader.write(self.raw_numbers(values, others))

    def raw_numbers(self, values: Floats, others: Mapping[int, NDArray[np.generic]] | None = None) -> Floats:
        """Return the raw values (not yet rounded) for values in :attr:`unit`.

        Raises BadDataError as :meth:`encode` does.
        """
        if self.problem:
            raise BadDataError(self.problem)
        if self._curve is None:
            return self._stated(values)
        if self.channel.actuator:
            return self._curve(self._stated(values))
        given = others or {}
        for number in self.others:
            if number not in given:
                raise BadDataError(
                    f"Channel {self.channel.number} is compensated by channel {number}, which is not given."
                )
        more = [self._readers[n].numbers(given[n])[0] for n in self.inputs if n != self.channel.number]
        stated = self._stated(values)
        return self._inverse(self._nearest_turn(stated, more) if math.isfinite(self.turn) else stated, more)

    def within_turn(self, values: Floats) -> Floats:
        """Return values in :attr:`unit` within [LowLimit, HiLimit) if the channel spans a full turn, else unchanged."""
        return wrapped(values, *self.wraps_into, self.turn) if math.isfinite(self.turn) else values

    @property
    def given(self) -> Range | None:
        """Lowest and highest value in :attr:`unit`, not wrapped, that the curve gives of all raw values.

        None if it takes the raw values of other channels, or has no inverse.
        """
        if self.problem or self.others or self._curve is None:
            return None
        ends = [float(self._shown(end)) for end in self._inverse.ends(())]
        return min(ends), max(ends)

    def _nearest_turn(self, values: Floats, others: Sequence[Floats]) -> Floats:
        """Return angles, in the unit of the curve, moved by whole turns into or nearest to its range."""
        assert self.channel.calibration is not None
        turn = self.channel.calibration.unit.difference_from_si(TURN)
        low, high = self._inverse.ends(values.shape, others)
        low, high = np.minimum(low, high), np.maximum(low, high)
        above = low + np.mod(values - low, turn)
        return np.where((above <= high) | (above - high <= low + turn - above), above, above - turn)

    def beyond(self, value: float, written: WrittenUnit | None = None) -> str:
        """Return why a value may not be set, as a sentence in the unit ``written``; "" if the limits allow it.

        ``value`` is in :attr:`unit`; without ``written`` the sentence is in the display unit.
        """
        low, high = self.limits
        if math.isfinite(value) and low - ROUNDING * abs(low) <= value <= high + ROUNDING * abs(high):
            return ""
        unit = written or self.channel.shown
        asked, *ends = (unit.from_si(self.unit.to_si(number)) for number in (value, low, high))
        text = f"{min(ends):.6g} to {max(ends):.6g} {unit.text}".strip()
        return f"{asked:.6g} {unit.text} exceeds the limits of channel {self.channel.label}, {text}."

    @property
    def accepted(self) -> Range:
        """Values in :attr:`unit` that are taken: the limits, widened by uncertainty and rounding."""
        return self._floor, self._ceiling

    @property
    def shown_as_computed(self) -> bool:
        """True if the curve gives values in :attr:`unit` without conversion."""
        return self._same

    @cached_property
    def _curve(self) -> PreparedCurve | None:
        own = self.channel.calibration
        return PreparedCurve(own) if own is not None else None

    @cached_property
    def _inverse(self) -> PreparedInverse:
        curve = self._curve
        assert curve is not None, "a channel without calibration is not inverted"
        parts = curve.calibration.inputs
        main = next((n for n, part in enumerate(parts) if part.channel == self.channel.number), 0)
        low, high = self._ends(curve) or (parts[main].boundaries[0], parts[main].boundaries[-1])
        step = 0.25 if self.reader.form.integer and not self.channel.actuator else 0.0
        return PreparedInverse(curve, low, high, main=main, step=step)

    def _ends(self, curve: PreparedCurve) -> Range | None:
        """Return the inputs of the curve between which its inverse is searched; None if the datasheet sets no ends."""
        if not self.channel.actuator:
            return curve.calibration.raw_range or self.reader.form.raw_range
        ends = [float(self._stated(np.asarray(limit))) for limit in self.limits]
        return (min(ends), max(ends)) if all(map(math.isfinite, ends)) else None

    @cached_property
    def _way_back(self) -> PreparedInverse | None:
        """Return an actuator's conversion from raw set point to values.

        None if its curve turns, which makes it ambiguous.
        """
        try:
            return self._inverse if self._curve is not None else None
        except BadDataError:
            return None

    def _inputs(
        self, numbers: Floats, valid: NDArray[np.bool_], others: Mapping[int, NDArray[np.generic]]
    ) -> tuple[list[Floats], NDArray[np.bool_]]:
        inputs = []
        for number in self.inputs:
            if number == self.channel.number:
                inputs.append(numbers)
                continue
            raw = others.get(number)
            if raw is None or len(raw) != len(numbers):
                raise BadDataError(
                    f"Channel {self.channel.number} is compensated by channel {number}, which is not given."
                )
            more, possible = self._readers[number].numbers(raw)
            inputs.append(more)
            valid = valid & possible
        return inputs, valid

    @cached_property
    def _same(self) -> bool:
        """True if the curve gives values in :attr:`unit` without conversion."""
        own = self.channel.calibration
        scale, offset = (own.unit.scale, own.unit.offset) if own is not None else (1.0, 0.0)
        return (scale, offset) == (self.unit.scale, self.unit.offset)

    def _shown(self, values: Floats) -> Floats:
        """Convert values of the curve (without one: SI values) to :attr:`unit`."""
        if self._same:
            return values
        own = self.channel.calibration
        si = values * own.unit.scale + own.unit.offset if own is not None else values
        return (si - self.unit.offset) / self.unit.scale

    def _stated(self, values: Floats) -> Floats:
        """Convert values in :attr:`unit` to the unit of the curve (without one: SI)."""
        if self._same:
            return values
        si = values * self.unit.scale + self.unit.offset
        own = self.channel.calibration
        return (si - own.unit.offset) / own.unit.scale if own is not None else si

    def _limits(self) -> Range:
        """Return the narrower of the channel's limits (SI) and those of its calibration, in :attr:`unit`."""
        channel, own = self.channel, self.channel.calibration
        lows, highs = [channel.low], [channel.high]
        if own is not None:
            lows += [own.unit.to_si(own.low_limit)] if own.low_limit is not None else []
            highs += [own.unit.to_si(own.high_limit)] if own.high_limit is not None else []
        low = max(filter(math.isfinite, lows), default=-math.inf)
        high = min(filter(math.isfinite, highs), default=math.inf)
        return self.unit.from_si(low), self.unit.from_si(high)

    def _problem(self, sheet: Sheet) -> str:
        channel = self.channel
        for number in self.others:
            if number not in self._readers:
                known = sheet.channel(number)
                why = "is not described" if known is None else "has samples that cannot be read"
                return f"Channel {channel.number} is compensated by channel {number}, which {why}."
        if channel.actuator and channel.calibration is not None and len(channel.calibration.inputs) > 1:
            return f"The calibration of actuator {channel.number} takes several inputs; one is what can be set here."
        return channel.value_problem


def _forms(sheet: Sheet, numbers: tuple[int, ...]) -> dict[int, SampleForm]:
    """Sample forms of channels that can be read."""
    found = {number: sheet.channel(number) for number in numbers}
    forms = {number: channel.sample for number, channel in found.items() if channel is not None}
    return {number: form for number, form in forms.items() if form is not None and not form.problem}
