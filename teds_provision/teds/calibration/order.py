"""The content of a calibration file, and the resulting calibration for one channel of a profile."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime
from difflib import get_close_matches
from itertools import pairwise

from teds_provision.errors import BadDataError
from teds_provision.teds.calibration.formula import fit, residuals
from teds_provision.teds.calibration.model import METHODS, Calibration, CalibrationInput, Method
from teds_provision.teds.profile.model import ChannelProfile
from teds_provision.teds.profile.reader import FLOAT32_MAXIMUM, TomlTable
from teds_provision.teds.units import WrittenUnit, parse_seconds, parse_unit


def is_number(value: object) -> bool:
    """Return True if a value is a finite number that a Float32 may hold."""
    return type(value) in (int, float) and abs(value) <= FLOAT32_MAXIMUM  # type: ignore[arg-type]


@dataclass
class CalibrationOrder:
    """A file's content about one calibration, before it is fitted to a channel: values with their places."""

    file: str
    line: int
    values: dict[str, tuple[object, int]] = field(default_factory=dict)

    def wrong(self, key: str, message: str) -> BadDataError:
        """Return the error at a key, with file and line."""
        line = self.values[key][1] if key in self.values else self.line
        return BadDataError(f"{self.file}:{line}: {key}: {message}" if key else f"{self.file}:{line}: {message}")

    def get(self, key: str) -> object:
        """Return the value of a key, None if it is absent."""
        return self.values[key][0] if key in self.values else None

    def number(self, key: str) -> float | None:
        """Return the number of a key."""
        value = self.get(key)
        return None if value is None else self.as_number(key, value)

    def as_number(self, key: str, value: object) -> float:
        """Return ``value``, which the file has at a key, as a number."""
        try:
            number = float(value) if isinstance(value, (str, int, float)) and not isinstance(value, bool) else None
        except (ValueError, OverflowError):
            number = None
        if number is None or not math.isfinite(number):
            raise self.wrong(key, f"a number is expected, not {value!r}.")
        return number

    def numbers(self, key: str) -> tuple[float, ...] | None:
        """List of numbers of a key."""
        value = self.get(key)
        if value is None:
            return None
        if isinstance(value, list | tuple) and value and all(is_number(part) for part in value):
            return tuple(float(part) for part in value)
        raise self.wrong(key, f"a list of numbers is expected, not {str(value)[:60]}.")


def calibration_of(order: CalibrationOrder, channel: ChannelProfile) -> Calibration:
    """Fit or take over the file's calibration for a channel; raises BadDataError with file, line and field."""
    unit = _unit(order, channel)
    try:
        curve = _curve(order, channel)
    except BadDataError as error:
        if error.message.startswith(f"{order.file}:"):
            raise
        raise order.wrong("", error.message) from error
    known = [value for value in (_uncertainty(order, unit), _misfit(curve)) if value]
    low, high = order.number("low-limit"), order.number("high-limit")
    if low is not None and high is not None and low >= high:
        raise order.wrong("low-limit", "it must be below the high limit.")
    by = order.get("by")
    return replace(
        curve,
        unit=unit,
        zero_offset=order.number("zero-offset") or 0.0,
        low_limit=low,
        high_limit=high,
        uncertainty=max(known) if known else None,
        date=_date(order),
        interval=_interval(order, channel),
        by=str(by) if by is not None else "",
        monotone=channel.calibration.monotone,
        raw_range=channel.calibration.raw_range,
    )


def _misfit(curve: Calibration) -> float | None:
    """Return the largest residual of a fit in the calibrated unit.

    None if it is Float32 rounding (or raw, of an actuator).
    """
    left = None if curve.actuator else residuals(curve)
    if left is None:
        return None
    return left.maximum if left.maximum > 1e-5 * max(map(abs, left.references)) else None


def _curve(order: CalibrationOrder, channel: ChannelProfile) -> Calibration:
    method, degree = _method(order), _degree(order)
    sources = [key for key in ("points", "segments", "inputs", "slope", "coefficients") if order.get(key) is not None]
    match sources:
        case ["points"]:
            return _fitted(order, channel, method, degree)
        case ["segments"]:
            return _segments(order, channel, method)
        case ["inputs", "coefficients"]:
            return _multinomial(order, channel, method)
        case ["slope"]:
            pair = (order.number("intercept") or 0.0, order.number("slope") or 0.0)
            part = CalibrationInput(channel.number, 1, _ends(order, channel), (0.0,))
            return Calibration(channel.number, method or "linear", (part,), pair, actuator=channel.type == 1)
        case ["coefficients"]:
            return _with_coefficients(order, channel, method, degree)
        case []:
            raise order.wrong("", "there is nothing to calibrate with: points, coefficients, or slope and intercept.")
        case _:
            raise order.wrong(sources[0], f"only one of {', '.join(sources)} can be the calibration.")


def _fitted(order: CalibrationOrder, channel: ChannelProfile, method: Method | None, degree: int | None) -> Calibration:
    points = _points(order)
    return fit(
        points,
        method
        or next((method for method in METHODS if method == channel.calibration.method), None)
        or ("linear" if len(points) == 2 else "table"),
        channel=channel.number,
        degree=channel.calibration.degree if degree is None else degree,
        actuator=channel.type == 1,
        tolerance=order.number("tolerance") or 0.0,
    )


def _points(order: CalibrationOrder) -> list[tuple[float, float]]:
    value = order.get("points")
    rows = value if isinstance(value, list | tuple) else []
    points = []
    for number, row in enumerate(rows, 1):
        if not isinstance(row, list | tuple) or len(row) != 2 or not all(map(is_number, row)):
            raise order.wrong("points", f"point {number} is not a pair of numbers [raw, value].")
        points.append((float(row[0]), float(row[1])))
    if not points:
        raise order.wrong("points", "a list of pairs [raw, value] is expected.")
    return points


def _segments(order: CalibrationOrder, channel: ChannelProfile, method: Method | None) -> Calibration:
    rows = _connected(order)
    boundaries = (*(row[0] for row in rows), rows[-1][1])
    degree = len(rows[0]) - 4
    part = CalibrationInput(channel.number, degree, boundaries, tuple(row[2] for row in rows))
    _ascending(order, "", part)
    chosen: Method = method or ("steps" if degree == 0 else "polynomial" if degree > 1 else "table")
    coefficients = tuple(number for row in rows for number in row[3:])
    return Calibration(channel.number, chosen, (part,), coefficients, actuator=channel.type == 1)


def _connected(order: CalibrationOrder) -> list[tuple[float, ...]]:
    """Return rows of the table of segments (from, to, offset, C0, C1 …), each beginning where the last one ends."""
    value, line = order.values["segments"]
    rows = value if isinstance(value, list) else []
    for number, (above, below) in enumerate(pairwise(rows)):
        if above[1] != below[0]:
            raise BadDataError(
                f"{order.file}:{line + number + 1}: from: the segment does not begin where the last one ends."
            )
    return rows


def _with_coefficients(
    order: CalibrationOrder, channel: ChannelProfile, method: Method | None, degree: int | None
) -> Calibration:
    coefficients = order.numbers("coefficients") or ()
    boundaries = order.numbers("boundaries") or _ends(order, channel)
    segments = max(len(boundaries) - 1, 1)
    power = len(coefficients) // segments - 1 if degree is None else degree
    if power < 0:
        raise order.wrong("coefficients", f"{len(coefficients)} are too few for {segments} segments.")
    offsets = order.numbers("offsets") or (0.0,) * segments
    part = CalibrationInput(channel.number, power, boundaries, offsets)
    _ascending(order, "boundaries", part)
    chosen: Method = method or ("table" if segments > 1 else "linear" if power == 1 else "polynomial")
    return Calibration(channel.number, chosen, (part,), coefficients, actuator=channel.type == 1)


def _multinomial(order: CalibrationOrder, channel: ChannelProfile, method: Method | None) -> Calibration:
    value = order.get("inputs")
    if not isinstance(value, tuple) or not all(isinstance(part, TomlTable) for part in value):
        raise order.wrong("inputs", "tables [[inputs]] with channel, degree, boundaries and offsets are expected.")
    parts = tuple(_input(order, table, channel) for table in value)
    coefficients = order.numbers("coefficients") or ()
    return Calibration(channel.number, method or "polynomial", parts, coefficients, actuator=channel.type == 1)


def _input(order: CalibrationOrder, table: TomlTable, channel: ChannelProfile) -> CalibrationInput:
    """Read one ``[[inputs]]`` table."""
    inner = CalibrationOrder(order.file, table.where.line)
    for key, entry in table.entries.items():
        if isinstance(entry, TomlTable) or key not in ("channel", "key", "degree", "boundaries", "offsets"):
            raise BadDataError(f"{entry.where}: inputs.{key}: there is no such key.")
        inner.values[key] = (entry.value, entry.where.line)
    number, degree = inner.number("channel"), _degree(inner)
    part = CalibrationInput(
        channel.number if number is None else int(number),
        1 if degree is None else degree,
        inner.numbers("boundaries") or (),
        inner.numbers("offsets") or (),
        int(inner.number("key") or 0),
    )
    _ascending(inner, "boundaries", part)
    return part


def _ascending(order: CalibrationOrder, key: str, part: CalibrationInput) -> None:
    if not part.ascending:
        raise order.wrong(key, "the boundaries of the segments must ascend.")


def _ends(order: CalibrationOrder, channel: ChannelProfile) -> tuple[float, ...]:
    given = order.numbers("boundaries")
    if given:
        return given
    if channel.type == 1:
        return channel.unit.from_si(channel.low_limit), channel.unit.from_si(channel.high_limit)
    ends = channel.raw_range
    if ends is None:
        raise order.wrong("boundaries", "missing: the data model of the channel sets no raw range.")
    return ends


def _unit(order: CalibrationOrder, channel: ChannelProfile) -> WrittenUnit:
    text = order.get("unit")
    if text is None:
        return channel.unit
    try:
        unit = parse_unit(str(text))
    except BadDataError as error:
        raise order.wrong("unit", f"{error.message} {error.hint}") from error
    if unit.units != channel.unit.units:
        raise order.wrong("unit", f'"{text}" is not of the same kind as "{channel.unit.text}" of the channel.')
    return unit


def _uncertainty(order: CalibrationOrder, unit: WrittenUnit) -> float | None:
    value = order.get("uncertainty")
    if isinstance(value, str) and " " in value.strip():
        number, _, text = value.strip().partition(" ")
        try:
            written = parse_unit(text)
        except BadDataError as error:
            raise order.wrong("uncertainty", f"{error.message} {error.hint}") from error
        if written.units != unit.units:
            raise order.wrong("uncertainty", f'"{text}" is not of the same kind as "{unit.text}".')
        plain = order.as_number("uncertainty", number)
        found: float | None = unit.difference_from_si(written.difference_to_si(plain))
    else:
        found = order.number("uncertainty")
    if found is not None and found < 0:
        raise order.wrong("uncertainty", "it must not be negative.")
    return found


def _method(order: CalibrationOrder) -> Method | None:
    value = order.get("method")
    if value is None:
        return None
    for method in METHODS:
        if value == method:
            return method
    near = get_close_matches(str(value)[:64], METHODS, n=1)
    guess = f'Did you mean "{near[0]}"?' if near else f"One of {', '.join(METHODS)} is expected."
    raise order.wrong("method", f"{value!r} is no method. {guess}")


def _degree(order: CalibrationOrder) -> int | None:
    value = order.number("degree")
    if value is None:
        return None
    if value != int(value) or not 0 <= value <= 255:
        raise order.wrong("degree", f"a whole number from 0 to 255 is expected, not {value:g}.")
    return int(value)


def _date(order: CalibrationOrder) -> datetime | None:
    value = order.get("date")
    if value is None:
        return None
    if isinstance(value, str):
        try:
            value = datetime.fromisoformat(value.strip())
        except ValueError as error:
            raise order.wrong("date", f'"{value}" is not a date; write it like 2026-10-31.') from error
    if isinstance(value, date) and not isinstance(value, datetime):
        value = datetime(value.year, value.month, value.day, tzinfo=UTC)
    if not isinstance(value, datetime):
        raise order.wrong("date", f"a date like 2026-10-31 is expected, not {value!r}.")
    moment = value if value.tzinfo else value.replace(tzinfo=UTC)
    if not 1970 <= moment.year < 2106:
        raise order.wrong("date", f"a TEDS can say the years 1970 to 2105, not {moment.year}.")
    return moment


def _interval(order: CalibrationOrder, channel: ChannelProfile) -> float | None:
    value = order.get("interval")
    if value is None:
        return channel.calibration.interval
    try:
        seconds = parse_seconds(value)
    except BadDataError as error:
        raise order.wrong("interval", f"{error.message} {error.hint}") from error
    if not 0 < seconds < 2**32:
        raise order.wrong("interval", f"{value!r} is not a time that a TEDS can hold.")
    return seconds
