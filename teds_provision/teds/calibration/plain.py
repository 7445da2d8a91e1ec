"""A calibration as plain data, whole: what a recording or a ROS topic needs to calibrate raw values again."""

from __future__ import annotations

import math
from datetime import datetime
from typing import Any, Final

from teds_provision.errors import BadDataError
from teds_provision.teds.calibration.model import METHODS, Calibration, CalibrationInput
from teds_provision.teds.codec.model import Units
from teds_provision.teds.units import recognize

MOST_NUMBERS: Final = 100_000
"""Coefficients, or boundaries of an input, that are read."""


def calibration_as_json(calibration: Calibration) -> dict[str, Any]:
    """Return plain data from which :func:`calibration_from_json` makes the same curve.

    ``si`` are slope and intercept from ``unit`` into SI. The formula is that of :mod:`model`; an input has a boundary
    more than segments, and an offset for each.
    """
    unit = calibration.unit
    found: dict[str, Any] = {
        "method": calibration.method,
        "unit": unit.text,
        "si": [unit.scale, unit.offset],
        "inputs": [
            {
                "channel": part.channel,
                "degree": part.degree,
                "boundaries": list(part.boundaries),
                "offsets": list(part.offsets),
            }
            for part in calibration.inputs
        ],
        "coefficients": list(calibration.coefficients),
        "zero_offset": calibration.zero_offset,
        "uncertainty": calibration.uncertainty,
        "date": calibration.date.isoformat() if calibration.date else None,
        "interval": calibration.interval,
        "actuator": calibration.actuator or None,
    }
    return {name: value for name, value in found.items() if value is not None}


def calibration_from_json(data: object, channel: int, units: Units) -> Calibration:
    """Return the calibration of a channel with these exponents; raises BadDataError if the data are none."""
    if not isinstance(data, dict) or data.get("method") not in METHODS:
        raise BadDataError("The calibration is not that of a recording.")
    try:
        scale, offset = _numbers(data["si"])
        inputs = tuple(
            CalibrationInput(
                _u16(given["channel"]), _u16(given["degree"]), _numbers(given["boundaries"]), _numbers(given["offsets"])
            )
            for given in data["inputs"]
        )
        date, interval = data.get("date"), data.get("interval")
        uncertainty = data.get("uncertainty")
        return Calibration(
            channel,
            data["method"],
            inputs,
            _numbers(data["coefficients"]),
            recognize(units, scale, offset),
            zero_offset=_numbers([data["zero_offset"]])[0],
            uncertainty=None if uncertainty is None else _numbers([uncertainty])[0],
            date=None if date is None else datetime.fromisoformat(str(date)),
            interval=None if interval is None else _numbers([interval])[0],
            actuator=data.get("actuator") is True,
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise BadDataError("The calibration is not that of a recording.") from error


def _u16(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 0xFFFF:
        raise ValueError(value)
    return value


def _numbers(values: object) -> tuple[float, ...]:
    if not isinstance(values, list) or len(values) > MOST_NUMBERS:
        raise TypeError("no list of numbers")
    found = tuple(float(value) for value in values if isinstance(value, int | float) and not isinstance(value, bool))
    if len(found) != len(values) or not all(map(math.isfinite, found)):
        raise ValueError("no finite number")
    return found
