"""One TransducerChannel of a datasheet, as values with types and units; see :mod:`teds_provision.teds.sheet`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from enum import IntEnum
from functools import cached_property
from typing import Final

from teds_provision.arrays import Ends, NDArray, np
from teds_provision.errors import BadDataError
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.calibration.samples import DataModel, SampleForm
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.model import DecodedTeds, Units
from teds_provision.teds.image import BlockId
from teds_provision.teds.units import (
    ARBITRARY,
    DIGITAL,
    RATIO,
    WrittenUnit,
    display_unit,
    format_value,
    name_of_units,
    parse_unit,
    units_of,
)

NOT_STATED: Final = math.nan
"""Represents a number that the TEDS lack, or call not available: IEEE 1451.0 writes NaN for that itself."""
ROUNDING: Final = 4 * 2.0**-23
"""Limits and coefficients are Float32: a value this much of the limit beyond it is not beyond it."""
TURN: Final = 2 * math.pi
_NEARLY_A_TURN: Final = 1e-5
"""Float32 limits of 0 and 2 pi are 1.7e-7 from a turn; the bound is that of the contract (docs/calibration.md)."""
_RADIANS: Final = units_of(radians=1)


def spans_a_turn(units: Units, low: float, high: float) -> bool:
    """Return True if limits in SI units are one turn apart.

    Then an angle beyond one of them comes back at the other.
    """
    return units == _RADIANS and abs(high - low - TURN) < _NEARLY_A_TURN


def wrapped(values: NDArray[np.float64], low: Ends, high: Ends, turn: Ends) -> NDArray[np.float64]:
    """Return angles moved by whole turns into [low, high), all in one unit with this ``turn``; NaN if not finite.

    ``high`` is Float32 and may be short of the turn by its rounding: what falls between comes to ``low``.
    """
    with np.errstate(invalid="ignore"):
        moved = low + np.mod(values - low, turn)
    return np.where(moved >= high, low, moved)


def within_turn(value: float, unit: WrittenUnit, low: float, digits: int = 6) -> str:
    """Return an angle in a unit as text; one that rounds up to the end of its turn is the turn's beginning.

    ``low`` is the beginning in SI units.
    """
    begin = unit.from_si(low)
    text, end = f"{value:.{digits}g}", f"{begin + unit.difference_from_si(TURN):.{digits}g}"
    chosen = text if float(text) < float(end) else f"{begin:.{digits}g}"
    return "0" if float(chosen) == 0 else chosen


class ChannelKind(IntEnum):
    """ChanType (field 11 of the TransducerChannel TEDS): what a channel is."""

    SENSOR = 0
    ACTUATOR = 1
    EVENT_SENSOR = 2

    @property
    def word(self) -> str:
        """``sensor``, ``actuator``, ``event sensor``."""
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True)
class Sampling:
    """Sampling modes of a channel: SampMode (a mask), SDefault unchanged (sources disagree on it); None: not stated."""

    modes: int | None = None
    default: int | None = None


@dataclass(frozen=True)
class Timing:
    """Times of a channel in seconds, NaN if not stated; ``period`` is SPeriod."""

    period: float = NOT_STATED
    update: float = NOT_STATED
    write_setup: float = NOT_STATED
    read_setup: float = NOT_STATED
    read_delay: float = NOT_STATED
    warm_up: float = NOT_STATED


@dataclass(frozen=True)
class Channel:
    """One TransducerChannel. Limits and uncertainty are in SI units as its own TEDS states them, NaN if it does not.

    ``units`` are the exponents of PhyUnits, ``unit`` the unit in which its values are computed, ``shown`` the display
    unit: ``display`` if a profile names one, else ``unit``. ``kind`` is None for a ChanType that is not known, ``halt``
    is ActHalt (field 36). ``described`` is False if there is no TransducerChannel TEDS. ``calibration`` is None if
    there is none or none that can be computed; ``calibration_problem`` is then the reason. ``value_table`` holds
    the texts of raw numbers that mean states.
    """

    number: int
    name: str = ""
    described: bool = False
    kind: ChannelKind | None = None
    units: Units = Units()  # noqa: RUF009 - frozen
    units_stated: bool = False
    low: float = NOT_STATED
    high: float = NOT_STATED
    uncertainty: float = NOT_STATED
    sample: SampleForm | None = None
    sampling: Sampling = Sampling()
    timing: Timing = Timing()
    halt: int | None = None
    calibration_key: int | None = None
    calibration: Calibration | None = None
    calibration_problem: str = ""
    display: str = ""
    value_table: Mapping[int, str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """``2 (opening)``, or the number alone of a channel without a name."""
        return f"{self.number} ({self.name})" if self.name else str(self.number)

    @property
    def actuator(self) -> bool:
        """True for an actuator; everything else gives values."""
        return self.kind is ChannelKind.ACTUATOR

    @property
    def period(self) -> float:
        """SPeriod in seconds, NaN if not stated."""
        return self.timing.period

    @cached_property
    def unit(self) -> WrittenUnit:
        """Return the unit that its datasheet suggests: the calibrated one if that is usual, else a friendly one."""
        if self.calibration is not None and self.calibration.unit.text[:1] not in ("", "("):
            return self.calibration.unit
        return display_unit(self.units)

    @cached_property
    def shown(self) -> WrittenUnit:
        """Return the display unit: the profile's if one is known and fits, else the datasheet's."""
        if self.display:
            with suppress(BadDataError):
                chosen = display_unit(self.units, self.display)
                if parse_unit(self.display).units == self.units:
                    return chosen
        return self.unit

    @property
    def si_unit(self) -> str:
        """Name of the SI unit of limits and uncertainty: ``rad``, ``N``; ``count`` for plain numbers."""
        return name_of_units(self.units)

    @property
    def has_range(self) -> bool:
        """True if both limits are stated."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    @property
    def full_turn(self) -> bool:
        """True if its values wrap: a sensor of angles whose limits are one turn apart. A set point never wraps."""
        return not self.actuator and spans_a_turn(self.units, self.low, self.high)

    @property
    def stated_uncertainty(self) -> float:
        """Uncertainty in SI units: that of the calibration if it states one, else that of the channel."""
        own = self.calibration
        if own is not None and own.uncertainty is not None and math.isfinite(own.uncertainty):
            return own.unit.difference_to_si(own.uncertainty)
        return self.uncertainty

    @property
    def calibrated_at(self) -> datetime | None:
        """Date of the last calibration, None if there is none."""
        return self.calibration.date if self.calibration is not None else None

    @property
    def due(self) -> datetime | None:
        """When the next calibration is due, None if unknown."""
        return self.calibration.due if self.calibration is not None else None

    def overdue(self, now: datetime) -> bool:
        """Return True if the next calibration was due before ``now``."""
        return self.calibration is not None and self.calibration.overdue(now)

    @property
    def value_problem(self) -> str:
        """Why its samples give no values in a unit, as a sentence; "" if they do.

        Without a calibration only floats (in SI units), counts, bits, times and fractions of a ratio are values.
        """
        if self.calibration_problem:
            return f"Channel {self.number} has a calibration that cannot be used: {self.calibration_problem}"
        if self.sample is None:
            return f"The datasheet does not say how a sample of channel {self.number} is coded."
        if self.sample.problem:
            return f"The samples of channel {self.number} cannot be read: {self.sample.problem}."
        if self.calibration is None and not self._speaks_for_itself(self.sample.model):
            unit = self.unit.text
            return f"Channel {self.number} has no calibration: raw values cannot be turned into {unit}."
        return ""

    def _speaks_for_itself(self, model: int) -> bool:
        if model in (DataModel.FLOAT32, DataModel.FLOAT64, DataModel.TIME_OF_DAY):
            return True
        if self.units.interpretation in (DIGITAL, ARBITRARY) or self.units == Units(extension=self.units.extension):
            return True
        return self.units.interpretation == RATIO and model in (DataModel.FRACTION, DataModel.LONG_FRACTION)

    def show(self, value: float, *, difference: bool = False, digits: int = 6) -> str:
        """Return an SI value as people see it: ``360 °``, ``0.35 N``; a difference ignores the unit's offset."""
        return format_value(value, self.shown, difference=difference, digits=digits)

    def show_reading(self, value: float, *, digits: int = 6) -> str:
        """Show a reading in SI units; over a full turn one that rounds up to the end of the turn is its beginning."""
        if not self.full_turn or not math.isfinite(value):
            return self.show(value, digits=digits)
        text = within_turn(self.shown.from_si(value), self.shown, self.low, digits)
        return f"{text} {self.shown.text}".strip()


def described(number: int, blocks: Mapping[BlockId, bytes]) -> Channel:
    """Return one channel as its TransducerChannel TEDS describes it, without name and calibration."""
    octets = blocks.get((number, AccessCode.CHANNEL))
    return read_channel(number, "", decode(octets) if octets is not None else None)


def channel_from(decoded: DecodedTeds) -> Channel:
    """Return the channel of a decoded TransducerChannel TEDS alone."""
    return read_channel(0, "", decoded)


def read_channel(number: int, name: str, teds: DecodedTeds | None) -> Channel:
    """Return the channel of that number and name as its decoded TransducerChannel TEDS describes it."""
    if teds is None:
        return Channel(number, name)
    units, kind = teds.get("PhyUnits"), integer_of(teds, "ChanType")
    model, octets = integer_of(teds, "DatModel"), integer_of(teds, "ModLenth")
    return Channel(
        number,
        name,
        described=True,
        kind=ChannelKind(kind) if kind in set(ChannelKind) else None,
        units=units if isinstance(units, Units) else Units(),
        units_stated=isinstance(units, Units),
        low=number_of(teds, "LowLimit"),
        high=number_of(teds, "HiLimit"),
        uncertainty=number_of(teds, "OError"),
        sample=None if model is None or octets is None else SampleForm(model, octets, integer_of(teds, "SigBits") or 0),
        sampling=Sampling(integer_of(teds, "SampMode"), integer_of(teds, "SDefault")),
        timing=Timing(
            period=number_of(teds, "SPeriod"),
            update=number_of(teds, "UpdateT"),
            write_setup=number_of(teds, "WSetupT"),
            read_setup=number_of(teds, "RSetupT"),
            read_delay=number_of(teds, "RDelayT"),
            warm_up=number_of(teds, "WarmUpT"),
        ),
        halt=integer_of(teds, "ActHalt"),
        calibration_key=integer_of(teds, "CalKey"),
    )


def number_of(teds: DecodedTeds, name: str) -> float:
    """Return the number of a field, NaN if it is not stated."""
    value = teds.get(name)
    return float(value) if isinstance(value, (int, float)) else NOT_STATED


def integer_of(teds: DecodedTeds, name: str) -> int | None:
    """Return the integer of a field, None if it is not stated."""
    value = teds.get(name)
    return value if isinstance(value, int) else None
