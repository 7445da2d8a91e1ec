"""Description of a wrapped sensor, and the profile and TEDS that follow from it.

A signal keeps its raw number if a sample and a Calibration TEDS can hold it: at most 24 bits, because coefficients are
Float32 and must not move a value by half a step. A signed raw number is moved by half its range, as a sample is
unsigned (offset binary). The sample has a bit to spare, which is set if the channel has no value. Every other signal is
measured as its value in SI units, a float.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.teds.calibration.model import Calibration, CalibrationInput
from teds_provision.teds.image import SECURITY, BlockId
from teds_provision.teds.origin import ORIGIN, Origin
from teds_provision.teds.profile.load import parse_profile
from teds_provision.teds.units import WrittenUnit, parse_unit
from teds_provision.teds.value_table import signal_xml

DEFAULT_PERIOD: Final = 0.1
"""Seconds between frames if the file states none; a note says so."""
PERIODS_LATE: Final = 3
"""A value becomes invalid if the next frame is so many periods late."""
MOST_CHANNELS: Final = 255
_RESOLUTION: Final = 1e-7  # about the resolution of a Float32
_EXACT_BITS: Final = 24
_MOST_BITS: Final = 64
_LARGEST: Final = 1e30
"""Limit of a float that states none: its limits in SI units still fit a Float32."""
_NAME_OCTETS: Final = 120
_DIGITS: Final = 15
"""Decimal digits that every double keeps."""

_ALIASES: Final[Mapping[str, str]] = {
    "": "count",
    "-": "count",
    "counts": "count",
    "cnt": "count",
    "n/a": "count",
    "celsius": "degC",
    "deg c": "degC",
    "degree c": "degC",
    "degrees c": "degC",
    "°c": "degC",
    "degc": "degC",
    "deg f": "degF",
    "n m": "N·m",
    "n-m": "N·m",
    "n.m": "N·m",
    "nm": "N·m",
    "u/min": "rpm",
    "r/min": "rpm",
    "kmh": "km/h",
    "kph": "km/h",
    "ohm": "Ω",
    "ohms": "Ω",
    "m/s2": "m/s²",
    "rad/s2": "rad/s²",
    "sec": "s",
    "msec": "ms",
    "volt": "V",
    "volts": "V",
    "amp": "A",
    "amps": "A",
    "percent": "%",
    "%rh": "%",
    "% rh": "%",
    "%rel": "%",
    "rpm": "rpm",
}
"""How files spell units that our table spells otherwise, in lower case."""
_KEEP_CASE: Final = frozenset({"nm"})
"""Aliases whose case means something: nm is a nanometre, Nm a newton metre."""
_AMBIGUOUS: Final = {
    "C": "coulomb; if it is °C, write degC",
    "g": "gram; if it is the acceleration of free fall, write gn",
    "G": "gauss; if it is the acceleration of free fall, write gn",
}


def written_unit(text: str) -> tuple[str, str]:
    """Return the unit of our table for one of a file, and a note for people ("" if there is nothing to note).

    A unit that nothing knows counts as none: the values are plain numbers, with a note.
    """
    stripped = text.strip()
    if stripped.lower() in _ALIASES and not (stripped.lower() in _KEEP_CASE and stripped != "Nm"):
        return _ALIASES[stripped.lower()], ""
    if stripped == "G":
        return "count", f"the unit {stripped!r} could be {_AMBIGUOUS[stripped]}: values are plain numbers"
    try:
        parse_unit(stripped)
    except BadDataError:
        return "count", f"the unit {stripped!r} is unknown: values are plain numbers"
    return stripped, f"the unit {stripped!r} was read as {_AMBIGUOUS[stripped]}" if stripped in _AMBIGUOUS else ""


@dataclass(frozen=True)
class SampleChoice:
    """The form of samples of a raw number: the profile's sample, and the calibration that turns it into the value.

    ``raw`` samples keep the raw number, increased by ``shift``; others hold the value in SI units as a float.
    """

    model: str
    octets: int
    bits: int
    raw: bool
    shift: int = 0
    coefficients: tuple[float, float] | None = None


@dataclass(frozen=True)
class WrappedChannel:
    """One signal: value = raw × ``scale`` + ``offset``, in ``unit``.

    Raw is an integer of ``bits`` or, if ``is_float``, a float. ``low`` and ``high`` are the range that the file states,
    None for none; ``period`` is in seconds. ``choices`` is the value table: text by raw number. ``comment`` and
    ``note`` are for people; ``note`` reports what was assumed. ``shares_frame``: every frame carries it with all other
    channels of the node, so they are late together.
    """

    name: str
    unit: str
    scale: float = 1.0
    offset: float = 0.0
    bits: int = 16
    signed: bool = False
    is_float: bool = False
    low: float | None = None
    high: float | None = None
    period: float = DEFAULT_PERIOD
    choices: Mapping[int, str] = field(default_factory=dict)
    comment: str = ""
    note: str = ""
    shares_frame: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= _MOST_BITS or not math.isfinite(self.scale) or not math.isfinite(self.offset):
            raise BadDataError(f"The signal {self.name} has a form that cannot be measured.")
        if self.scale == 0:
            raise BadDataError(f"The signal {self.name} has the factor 0, so it has one value only.")
        if not (self.period > 0 and math.isfinite(self.period)):
            raise BadDataError(f"The signal {self.name} has no period.")

    @property
    def written(self) -> WrittenUnit:
        """The unit with its way into SI."""
        return parse_unit(self.unit)

    @property
    def raw_ends(self) -> tuple[int, int]:
        """Lowest and highest raw integer."""
        if self.signed:
            return -(1 << self.bits - 1), (1 << self.bits - 1) - 1
        return 0, (1 << self.bits) - 1

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest valid value in ``unit``: those of the file, else all that the raw number can give."""
        if self.low is not None and self.high is not None and self.low < self.high:
            return self.low, self.high
        if self.is_float:
            return -_LARGEST, _LARGEST
        ends = [decimal(raw * self.scale + self.offset) for raw in self.raw_ends]
        return min(ends), max(ends)

    @property
    def held_limits(self) -> tuple[float, float]:
        """The limits, moved outward if their Float32 in SI units would exclude the value at the limit itself.

        A moved limit has the fewest digits that give that Float32: 120.00002 for 120 °C.
        """
        low, high = self.limits
        return self._outward(low, -math.inf), self._outward(high, math.inf)

    def _outward(self, limit: float, end: float) -> float:
        unit = self.written
        exact = unit.to_si(limit)
        outward = end if unit.scale > 0 else -end
        if abs(exact) >= _LARGEST or (held := _float32(exact)) == exact or (held > exact) == (outward > 0):
            return limit
        octets = struct.unpack(">i", struct.pack(">f", held))[0]
        larger = (held > 0) == (outward > 0)  # the next Float32 away from zero or towards it
        (next_one,) = struct.unpack(">f", struct.pack(">i", octets + (1 if larger else -1)))
        moved = (next_one - unit.offset) / unit.scale
        rounded = (float(f"{moved:.{digits}g}") for digits in range(1, _DIGITS + 1))
        return next((short for short in rounded if _float32(unit.to_si(short)) == next_one), float(moved))

    @property
    def unstated(self) -> tuple[str, ...]:
        """Fields of the TransducerChannel TEDS that nothing states."""
        return ("OError", "LowLimit", "HiLimit") if self.limits[1] >= _LARGEST else ("OError",)

    @property
    def sample(self) -> SampleChoice:
        """How its samples travel."""
        if self.is_float:
            plain = self.bits == 32 and (self.scale, self.offset) == (1.0, 0.0) and self._is_si
            return SampleChoice("float32", 4, 32, raw=False) if plain else SampleChoice("float64", 8, 64, raw=False)
        octets = min(self.bits // 8 + 1, 8)  # a spare bit marks a sample without a value
        shift = -self.raw_ends[0]
        if not shift and (self.scale, self.offset) == (1.0, 0.0) and self.unit == "count":
            return SampleChoice("unsigned", octets, self.bits, raw=True)  # a count needs no conversion
        coefficients = (self.offset - self.scale * shift, self.scale)
        if self.bits <= _EXACT_BITS and self._held_by_float32(coefficients):
            return SampleChoice("unsigned", octets, self.bits, raw=True, shift=shift, coefficients=coefficients)
        return SampleChoice("float64", 8, 64, raw=False)

    @property
    def _is_si(self) -> bool:
        unit = self.written
        return (unit.scale, unit.offset) == (1.0, 0.0)

    def _held_by_float32(self, coefficients: tuple[float, float]) -> bool:
        """Return True if rounding coefficients and SI conversion to Float32 moves no value by half a step."""
        unit = self.written
        exact = (*coefficients, unit.scale, unit.offset)
        try:
            intercept, slope, scale, offset = struct.unpack(">4f", struct.pack(">4f", *exact))
        except (OverflowError, struct.error):
            return False
        top = (1 << self.bits) - 1
        values = [coefficients[0] + coefficients[1] * raw for raw in (0, top)]
        moved = max(abs(intercept + slope * raw - value) for raw, value in zip((0, top), values, strict=True))
        converted = (max(map(abs, values)) * abs(scale - unit.scale) + abs(offset - unit.offset)) / abs(unit.scale)
        return bool(slope != 0 and moved + converted < abs(self.scale) / 2)

    @property
    def raw_limits(self) -> tuple[float, float] | None:
        """Raw numbers, moved as in the sample, that the limits allow; None if samples hold values."""
        form = self.sample
        if not form.raw:
            return None
        ends = sorted((limit - self.offset) / self.scale for limit in self.limits)
        least, most = self.raw_ends
        low, high = max(math.ceil(ends[0] - 1e-9), least), min(math.floor(ends[1] + 1e-9), most)
        if low >= high:
            low, high = least, most
        return float(low + form.shift), float(high + form.shift)

    def value(self, raw: float) -> float:
        """Return the value in ``unit`` of a raw number of the bus."""
        return raw * self.scale + self.offset

    def number(self, raw: float) -> float:
        """Return what a sample holds for a raw number of the bus."""
        form = self.sample
        return raw + form.shift if form.raw else self.written.to_si(self.value(raw))

    def shown(self, raw: float) -> str:
        """Return a value for people: the text of the value table, else the number with its unit."""
        text = self.choices.get(int(raw)) if self.choices and float(raw).is_integer() else None
        return (
            text if text is not None else f"{self.value(raw):.6g} {'' if self.unit == 'count' else self.unit}".strip()
        )

    def calibration(self, number: int) -> Calibration | None:
        """Return the calibration of channel ``number`` that applies factor and offset; None if none is needed."""
        form = self.sample
        if form.coefficients is None:
            return None
        ends = self.raw_limits or (0.0, float((1 << self.bits) - 1))
        part = CalibrationInput(number, 1, ends, (0.0,))
        low, high = self.held_limits
        return Calibration(
            number, "linear", (part,), form.coefficients, self.written, low_limit=low, high_limit=high, raw_range=ends
        )


def _float32(value: float) -> float:
    return float(struct.unpack(">f", struct.pack(">f", value))[0])


def facts(channel: WrappedChannel) -> dict[str, object]:
    """Return what ``node create`` reports of a signal: its range, period, scaling and value table."""
    low, high = channel.limits
    table = {str(raw): text for raw, text in sorted(channel.choices.items())}
    return {
        "low": low,
        "high": high,
        "period": channel.period,
        "factor": channel.scale,
        "offset": channel.offset,
        "raw": channel.sample.raw,
    } | ({"choices": table} if table else {})


@dataclass(frozen=True)
class WrappedSensor:
    """A sensor that a virtual node wraps; ``title`` is what people call it, ``file`` the description it came from."""

    origin: Origin
    title: str
    channels: tuple[WrappedChannel, ...]
    file: str = ""

    def __post_init__(self) -> None:
        if not 1 <= len(self.channels) <= MOST_CHANNELS:
            raise BadDataError(
                f"{self.title} has {len(self.channels)} signals; a node has 1 to {MOST_CHANNELS} channels.",
                hint="Choose another message." if self.origin.kind == "dbc" else "",
            )

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences about what was assumed, for people."""
        return tuple(f"{_printable(channel.name)}: {channel.note}." for channel in self.channels if channel.note)

    def profile_text(self, name: str) -> str:
        """Return the TOML of a transducer type for this sensor."""
        head = [
            f"# Transducer type {name}, made from {_printable(self.file or self.origin.name)} ({self.origin.text}).",
            "# Neither names an uncertainty: each is one step of the raw number. Replace it by that of the data sheet.",
            *(f"# {note}" for note in self.notes),
            "",
            f"title = {_toml(self.title)}",
            f"name = {_toml(_cut(self.title))}",
            'links = ["can"]',
            "",
            "[meta]",
            'operation-timeout = "100 ms"',
            'slow-timeout = "2 s"',
            "self-test-time = 0.0",
        ]
        channels = [line for number, channel in enumerate(self.channels, 1) for line in _channel_lines(number, channel)]
        return "\n".join([*head, *channels, ""])

    def blocks(self, uuid: bytes, name: str = "") -> dict[BlockId, bytes]:
        """Return the TEDS of a node around this sensor, without Security TEDS; raises BadDataError.

        Facts that no file states are NaN: the uncertainty, as a step of the raw number is none, and the limits of
        a float without a range.
        """
        profile = parse_profile(self.profile_text("wrapped"), "wrapped")
        unstated = [dict.fromkeys(channel.unstated, math.nan) for channel in self.channels]
        parts = zip(profile.channels, unstated, strict=True)
        profile = replace(
            profile, channels=tuple(replace(part, fields={**part.fields, **gone}) for part, gone in parts)
        )
        calibrations = {
            number: calibration
            for number, channel in enumerate(self.channels, 1)
            if (calibration := channel.calibration(number)) is not None
        }
        made = profile.build(uuid, calibration=calibrations, name=name or None)
        kept = {place: teds for place, teds in made.blocks.items() if place != SECURITY}
        return {**kept, ORIGIN: self.origin.encode()}


def _channel_lines(number: int, channel: WrappedChannel) -> list[str]:
    form, (low, high) = channel.sample, channel.held_limits
    widest = max(abs(low), abs(high))
    resolution = widest * _RESOLUTION if widest < _LARGEST else _RESOLUTION
    step = resolution if channel.is_float else abs(channel.scale)
    lines = [
        "",
        f"[channel.{number}]",
        f"name = {_toml(_cut(channel.name))}",
        'type = "sensor"',
        f"unit = {_toml(channel.unit)}",
        f"low-limit = {_number(low)}",
        f"high-limit = {_number(high)}",
        f"uncertainty = {_number(step)}",
        f'sample = {{ model = "{form.model}", octets = {form.octets}, bits = {form.bits} }}',
        'sampling = { modes = ["trigger", "continuous"], default = "continuous" }',
        f"update-time = {_number(channel.period)}",
        f"sampling-period = {_number(channel.period)}",
        "read-setup-time = 0.0",
        "read-delay-time = 0.0",
        "warm-up-time = 0.0",
    ]
    if form.coefficients is not None and channel.raw_limits is not None:
        ends = ", ".join(_number(end) for end in channel.raw_limits)
        intercept, slope = form.coefficients
        indication = f"indication = [{_number(slope)}, {_number(intercept)}]"  # for certificates in this unit
        lines += ["", f"[channel.{number}.calibration]", "required = true", f"raw-range = [{ends}]", indication]
    text = _text_of(channel)
    if text:
        lines += ["", "[[text]]", 'kind = "channel-identification"', f"channel = {number}", f"xml = {_toml(text)}"]
    return lines


def _text_of(channel: WrappedChannel) -> str:
    """Return comment and value table as the XML of a Channel Identification TEDS; "" if there is neither."""
    form = channel.sample
    rows = {raw + form.shift: text for raw, text in channel.choices.items()} if form.raw else {}
    return signal_xml(channel.name, channel.comment, {raw: text for raw, text in rows.items() if raw >= 0})


def _printable(text: str) -> str:
    """Return a text without control characters, which no comment of TOML may have."""
    return "".join(letter if letter.isprintable() else " " for letter in text).strip()


def _cut(name: str) -> str:
    """Return a name as a TEDS can hold it: printable, at most 120 octets."""
    return _printable(name).encode()[:_NAME_OCTETS].decode(errors="ignore")


def _toml(text: str) -> str:
    """Return a TOML basic string; JSON escapes are a part of TOML's but for DEL, which it refuses."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _number(value: float) -> str:
    return repr(decimal(value))


def decimal(value: float) -> float:
    """Return a number without the last digits of binary arithmetic: 0.3 for 3 × 0.1, as files and people write it."""
    return float(f"{value:.{_DIGITS}g}")
