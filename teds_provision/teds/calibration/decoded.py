"""A calibration read back from its TEDS."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta

from teds_provision.errors import BadData
from teds_provision.teds.calibration.model import METHODS, MONOTONE, Calibration, CalibrationInput, Method, Monotone
from teds_provision.teds.codec.model import Decoded, Field, TimeInstance, Units
from teds_provision.teds.units import WrittenUnit, recognize


def from_decoded(
    decoded: Decoded, *, channel: int | None = None, units: Units | None = None, actuator: bool = False
) -> Calibration:
    """Calibration of a decoded Calibration TEDS; ``units`` and ``actuator`` as the channel's own TEDS says.

    Without ``channel`` it is that of the first input.

    Raises BadData where the TEDS has no coefficients of the general form, or they do not fit together.
    """
    number = channel or 0
    inputs = tuple(_input(field, number) for field in decoded.fields if field.name == "CalInput")
    coefficients = _top(decoded, "Coefs")
    if not inputs or not isinstance(coefficients, tuple):
        raise BadData(
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
        raise BadData(f"An input of the Calibration TEDS of channel {channel} lacks its degree, boundaries or offsets.")
    number, key = values.get("ChanNum"), values.get("ChanKey")
    return CalibrationInput(
        number if isinstance(number, int) else channel,
        degree,
        tuple(float(value) for value in boundaries),
        tuple(float(value) for value in offsets),
        key if isinstance(key, int) else 0,
    )


def _top(decoded: Decoded, name: str) -> object:
    return next((field.value for field in decoded.fields if field.name == name), None)


def _number(decoded: Decoded, name: str) -> float | None:
    value = _top(decoded, name)
    return float(value) if isinstance(value, (int, float)) else None


def calibrated_unit(decoded: Decoded, units: Units) -> WrittenUnit:
    """Calibrated unit of a decoded Calibration TEDS: exponents of the channel, SIConvrt as the way into SI."""
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
    """Whether it can be computed: every number of it is a number, and the boundaries of its segments ascend."""
    return is_finite(calibration) and all(part.ascending for part in calibration.inputs)


def is_finite(calibration: Calibration) -> bool:
    """Whether every number of it is a number."""
    numbers = [*calibration.coefficients, calibration.zero_offset]
    for part in calibration.inputs:
        numbers += [*part.boundaries, *part.offsets]
    return all(math.isfinite(number) for number in numbers)
