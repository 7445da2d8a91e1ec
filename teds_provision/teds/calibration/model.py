"""The general calibration of IEEE 1451: a segmented multinomial over one or several inputs.

``Y = Σi … Σp C[i, …, p] · (X1 - H1)^i · … · (Xn - Hn)^p`` with a coefficient set for every cell of the grid that the
segment boundaries of the inputs span (teds.md, "5 CalTEDS"; the formula is certain, the field numbers are not).
Coefficients are ordered cell after cell, the last input running fastest, and within a cell exponent after exponent,
again the last input fastest; a value on a boundary belongs to the upper segment (both from memory); outside the outer
boundaries the end segment applies and the result is flagged.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Final, Literal

from teds_provision.errors import BadDataError
from teds_provision.sanitize import counted
from teds_provision.teds.certificate import CertificateReference
from teds_provision.teds.codec.model import DecodedTeds, Edition, Field, TimeInstance, Units
from teds_provision.teds.units import WrittenUnit, parse_unit, recognize

Method = Literal["linear", "polynomial", "table", "steps"]
Monotone = Literal["increasing", "decreasing", "either"]
METHODS: Final[tuple[Method, ...]] = ("linear", "polynomial", "table", "steps")
"""Names of the codes of field 135 (house profile), in order."""
MAXIMUM_DEGREE: Final = 12
"""Highest degree of a polynomial that is fitted to points."""
MONOTONE: Final[tuple[Monotone, ...]] = ("increasing", "decreasing", "either")
"""Names of the codes 1 to 3 of field 137 (house profile)."""

MAXIMUM_INPUTS: Final = 8
"""Inputs of one calibration that are read: what is looked at grows with the power of their number."""

PLAIN: Final = parse_unit("1")


def float32(values: tuple[float, ...], name: str) -> tuple[float, ...]:
    """Round to what a Float32 holds; raises BadDataError if one does not fit."""
    try:
        return struct.unpack(f">{len(values)}f", struct.pack(f">{len(values)}f", *values))
    except (OverflowError, struct.error) as error:
        raise BadDataError(f"{name} of the calibration hold a number that does not fit a Float32.") from error


@dataclass(frozen=True)
class CalibrationInput:
    """One input of the formula: the channel it comes from, its degree, n + 1 boundaries and n offsets of n segments."""

    channel: int
    degree: int
    boundaries: tuple[float, ...]
    offsets: tuple[float, ...]
    key: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.degree <= 255:
            raise BadDataError(f"The degree of a calibration input goes from 0 to 255, not {self.degree}.")
        if not self.offsets or len(self.boundaries) != len(self.offsets) + 1:
            raise BadDataError(
                f"A calibration input has {len(self.boundaries)} boundaries and {len(self.offsets)} offsets; "
                "there is one boundary more than segments, and one offset for each."
            )
        object.__setattr__(self, "boundaries", float32(self.boundaries, "Boundaries"))
        object.__setattr__(self, "offsets", float32(self.offsets, "Offsets"))

    @property
    def segments(self) -> int:
        """Number of segments."""
        return len(self.offsets)

    @property
    def ascending(self) -> bool:
        """True if the boundaries ascend strictly, as they must for the formula to mean anything."""
        return all(low < high for low, high in zip(self.boundaries, self.boundaries[1:], strict=False))


@dataclass(frozen=True)
class Calibration:
    """Calibration of one channel; every number is rounded to what the TEDS will hold (Float32).

    ``unit`` is the calibrated unit with its conversion into SI (SIConvrt); limits, uncertainty and zero offset are in
    it. For an actuator the formula runs from calibrated units to raw, and the zero offset is raw. ``points`` are the
    (raw, value) pairs that it was fitted to; they do not go into the TEDS. ``interval`` is in seconds, ``zeroed`` when
    the zero offset of the mounted sensor was set. ``certificate`` is its source, in a TEDS of its own.
    ``monotone`` and ``raw_range`` are what the transducer type demands and delivers, carried along so that the guard
    knows them without the profile.
    """

    channel: int
    method: Method
    inputs: tuple[CalibrationInput, ...]
    coefficients: tuple[float, ...]
    unit: WrittenUnit = PLAIN
    zero_offset: float = 0.0
    low_limit: float | None = None
    high_limit: float | None = None
    uncertainty: float | None = None
    date: datetime | None = None
    interval: float | None = None
    actuator: bool = False
    points: tuple[tuple[float, float], ...] = ()
    by: str = ""
    monotone: Monotone | None = None
    raw_range: tuple[float, float] | None = None
    zeroed: datetime | None = None
    certificate: CertificateReference | None = None

    def __post_init__(self) -> None:
        if not 1 <= len(self.inputs) <= MAXIMUM_INPUTS:
            raise BadDataError(f"A calibration has 1 to {MAXIMUM_INPUTS} inputs, not {len(self.inputs)}.")
        cells = math.prod(part.segments for part in self.inputs)
        each = math.prod(part.degree + 1 for part in self.inputs)
        if len(self.coefficients) != cells * each:
            raise BadDataError(
                f"The calibration of channel {self.channel} has {len(self.coefficients)} coefficients; "
                f"{cells} cells of {each} need {cells * each}."
            )
        object.__setattr__(self, "coefficients", float32(self.coefficients, "Coefficients"))
        if self.raw_range:
            object.__setattr__(self, "raw_range", float32(self.raw_range, "RawRange"))
        for name in ("zero_offset", "low_limit", "high_limit", "uncertainty"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, float32((value,), name)[0])

    @property
    def due(self) -> datetime | None:
        """When the next calibration is due; None without date or interval."""
        if self.date is None or not self.interval:
            return None
        try:
            return self.date + timedelta(seconds=self.interval)
        except OverflowError:
            return None

    def overdue(self, now: datetime) -> bool:
        """Return True if the due date has passed."""
        return self.due is not None and self.due < now

    def date_warnings(self, now: datetime, demanded_interval: float | None = None) -> list[str]:
        """Return warnings about the calibration's age, as sentences."""
        if self.date is None:
            if demanded_interval is None:
                return ["the calibration has no date."]
            days = demanded_interval / 86_400
            return [f"the calibration has no date, and is to be repeated every {days:.0f} days."]
        out = []
        if self.date > now + timedelta(days=1):
            out.append(f"the calibration date {self.date:%Y-%m-%d} lies in the future.")
        due = self.due
        if due is None and demanded_interval:  # the certificate gives no interval, so that of the type applies
            due = replace(self, interval=demanded_interval).due
        if due is not None and due < now:
            late = (now - due).days
            out.append(
                f"the calibration of {self.date:%Y-%m-%d} was due again on {due:%Y-%m-%d}, {counted(late, 'day')} ago."
            )
        if demanded_interval and self.interval and self.interval > demanded_interval * 1.001:
            asked, given = demanded_interval / 86_400, self.interval / 86_400
            out.append(f"its interval of {given:.0f} days is longer than the {asked:.0f} days that its type asks for.")
        return out

    def fields(self, edition: Edition = 2007) -> list[tuple[str, object]]:
        """Return the fields of the Calibration TEDS (access code 5) by name, for the composer."""
        out: list[tuple[str, object]] = []
        if self.date is not None:
            out.append(("LstCalDt", instant(self.date)))
        if self.interval is not None:
            out.append(("CalInrvl", TimeInstance(round(self.interval))))
        out.append(("SIConvrt", (("Slope", self.unit.scale), ("Intercept", self.unit.offset))))
        for name, value in (("LowLimit", self.low_limit), ("HiLimit", self.high_limit), ("OError", self.uncertainty)):
            if value is not None:
                out.append((name, value))
        for part in self.inputs:
            inner = (
                ("ChanNum", part.channel),
                ("ChanKey", part.key),
                ("Degree", part.degree),
                ("Boundaries", part.boundaries),
                ("Offsets", part.offsets),
            )
            out.append(("CalInput", inner))
        out.append(("Coefs", self.coefficients))
        out.append(("Method", METHODS.index(self.method)))
        if self.zero_offset:
            out.append(("ZeroOffset", self.zero_offset))
        if self.monotone:
            out.append(("Monotone", 1 + MONOTONE.index(self.monotone)))
        if self.raw_range:
            out.append(("RawRange", self.raw_range))
        if self.zeroed is not None:
            out.append(("ZeroDate", instant(self.zeroed)))
        return out


def instant(moment: datetime) -> TimeInstance:
    """Return a moment as a TEDS has it, to the second."""
    seconds = (moment - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(seconds=1)
    return TimeInstance(abs(seconds), 0, seconds < 0)


def from_decoded(
    decoded: DecodedTeds, *, channel: int | None = None, units: Units | None = None, actuator: bool = False
) -> Calibration:
    """Return the calibration of a decoded Calibration TEDS; ``units`` and ``actuator`` from the channel's own TEDS.

    Without ``channel`` it is that of the first input.

    Raises BadDataError if the TEDS has no coefficients of the general form, or they do not fit together.
    """
    number = channel or 0
    inputs = tuple(_input(field, number) for field in decoded.fields if field.name == "CalInput")
    coefficients = _top(decoded, "Coefs")
    if not inputs or not isinstance(coefficients, tuple):
        raise BadDataError(
            f"The Calibration TEDS of channel {number} has no inputs and coefficients that are understood here.",
            hint="Its field numbers are not those of docs/teds.md; the octets are kept as they are.",
        )
    return Calibration(
        inputs[0].channel if channel is None else channel,
        _method(_top(decoded, "Method")) or _guess(inputs),
        inputs,
        tuple(map(float, coefficients)),
        unit=calibrated_unit(decoded, units or Units()),
        zero_offset=_number(decoded, "ZeroOffset") or 0.0,
        low_limit=_number(decoded, "LowLimit"),
        high_limit=_number(decoded, "HiLimit"),
        uncertainty=_number(decoded, "OError"),
        date=_date(_top(decoded, "LstCalDt")),
        interval=_seconds(_top(decoded, "CalInrvl")),
        actuator=actuator,
        monotone=_monotone(_top(decoded, "Monotone")),
        raw_range=_raw_range(_top(decoded, "RawRange")),
        zeroed=_date(_top(decoded, "ZeroDate")),
    )


def _method(code: object) -> Method | None:
    return METHODS[code] if isinstance(code, int) and code < len(METHODS) else None


def _monotone(code: object) -> Monotone | None:
    return MONOTONE[code - 1] if isinstance(code, int) and 1 <= code <= len(MONOTONE) else None


def _raw_range(value: object) -> tuple[float, float] | None:
    if isinstance(value, tuple) and len(value) == 2 and value[0] < value[1]:
        return float(value[0]), float(value[1])
    return None


def _guess(inputs: tuple[CalibrationInput, ...]) -> Method:
    first = inputs[0]
    if len(inputs) == 1 and first.segments > 1 and first.degree <= 1:
        return "table" if first.degree else "steps"
    return "linear" if len(inputs) == 1 and first.degree == 1 else "polynomial"


def _input(field: Field, channel: int) -> CalibrationInput:
    values = {child.name: child.value for child in field.children}
    degree, boundaries, offsets = (values.get(name) for name in ("Degree", "Boundaries", "Offsets"))
    if not isinstance(degree, int) or not isinstance(boundaries, tuple) or not isinstance(offsets, tuple):
        raise BadDataError(
            f"An input of the Calibration TEDS of channel {channel} lacks its degree, boundaries or offsets."
        )
    number, key = values.get("ChanNum"), values.get("ChanKey")
    return CalibrationInput(
        number if isinstance(number, int) else channel,
        degree,
        tuple(float(value) for value in boundaries),
        tuple(float(value) for value in offsets),
        key if isinstance(key, int) else 0,
    )


def _top(decoded: DecodedTeds, name: str) -> object:
    return next((field.value for field in decoded.fields if field.name == name), None)


def _number(decoded: DecodedTeds, name: str) -> float | None:
    value = _top(decoded, name)
    return float(value) if isinstance(value, (int, float)) else None


def calibrated_unit(decoded: DecodedTeds, units: Units) -> WrittenUnit:
    """Return the calibrated unit of a decoded Calibration TEDS: exponents of the channel, SIConvrt as the way to SI."""
    convert = next((field for field in decoded.fields if field.name == "SIConvrt"), None)
    if convert is None:
        return recognize(units, 1.0, 0.0)
    values = {child.name: child.value for child in convert.children}
    slope, intercept = values.get("Slope", 1.0), values.get("Intercept", 0.0)
    if not isinstance(slope, float) or not isinstance(intercept, float):
        return recognize(units, 1.0, 0.0)
    return recognize(units, slope, intercept)


def _date(value: object) -> datetime | None:
    seconds = _seconds(value)
    if seconds is None or not isinstance(value, TimeInstance):
        return None
    try:
        return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=-seconds if value.negative else seconds)
    except OverflowError:
        return None


def _seconds(value: object) -> float | None:
    if not isinstance(value, TimeInstance):
        return None
    return value.seconds + value.nanoseconds * 1e-9


def is_sound(calibration: Calibration) -> bool:
    """Return True if it can be computed: every number of it is a number, and the boundaries of its segments ascend."""
    return is_finite(calibration) and all(part.ascending for part in calibration.inputs)


def is_finite(calibration: Calibration) -> bool:
    """Return True if every number of it is a number."""
    numbers = [*calibration.coefficients, calibration.zero_offset]
    for part in calibration.inputs:
        numbers += [*part.boundaries, *part.offsets]
    return all(math.isfinite(number) for number in numbers)
