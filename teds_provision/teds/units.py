"""Units as people write them, and the standard's exponents of SI units (ieee-1451.0.md section 4.3).

``parse_unit("degC")`` gives the exponents that go into a TEDS together with scale and offset into SI;
``format_units`` gives the way back. The units people use every day stand in a table here, so that building a datasheet
need not load ``pint`` (0.4 s); every other spelling goes to ``pint``. The tests hold the table against ``pint``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from fractions import Fraction
from functools import cache
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import BadData
from teds_provision.teds.model import Units

if TYPE_CHECKING:
    import pint

PRODUCT, RATIO, LOG_PRODUCT, LOG_RATIO, DIGITAL, ARBITRARY = range(6)

BASES: Final = ("radians", "steradians", "meters", "kilograms", "seconds", "amperes", "kelvins", "moles", "candelas")
_SYMBOLS: Final = ("rad", "sr", "m", "kg", "s", "A", "K", "mol", "cd")
_PINT_BASES: Final = {
    "radian": "radians",
    "meter": "meters",
    "gram": "kilograms",
    "second": "seconds",
    "ampere": "amperes",
    "kelvin": "kelvins",
    "mole": "moles",
    "candela": "candelas",
}
_COUNTS: Final = {"count", "bit", "number", "dimensionless"}


@dataclass(frozen=True)
class WrittenUnit:
    """A unit as somebody wrote it: ``SI value = scale × value + offset``."""

    text: str
    units: Units
    scale: float = 1.0
    offset: float = 0.0

    def to_si(self, value: float) -> float:
        """Value in SI units of a value in this unit."""
        return value * self.scale + self.offset

    def from_si(self, value: float) -> float:
        """Value in this unit of a value in SI units."""
        return (value - self.offset) / self.scale

    def difference_to_si(self, value: float) -> float:
        """A difference (an uncertainty, a step) in SI units: scaled, the offset left out."""
        return value * abs(self.scale)

    def difference_from_si(self, value: float) -> float:
        """A difference given in SI units, in this unit."""
        return value / abs(self.scale)


def _from_exponents(interpretation: int, exponents: Mapping[str, Fraction]) -> Units:
    rad, sr, m, kg, s, a, k, mol, cd = (exponents.get(base, Fraction(0)) for base in BASES)
    return Units(interpretation, rad, sr, m, kg, s, a, k, mol, cd)


def _units(interpretation: int = PRODUCT, **exponents: float) -> Units:
    return _from_exponents(interpretation, {name: Fraction(value) for name, value in exponents.items()})


_NEWTON = {"meters": 1, "kilograms": 1, "seconds": -2}
_JOULE = {"meters": 2, "kilograms": 1, "seconds": -2}
_WATT = {"meters": 2, "kilograms": 1, "seconds": -3}
_PASCAL = {"meters": -1, "kilograms": 1, "seconds": -2}
_VOLT = {"meters": 2, "kilograms": 1, "seconds": -3, "amperes": -1}
_OHM = {"meters": 2, "kilograms": 1, "seconds": -3, "amperes": -2}
_FARAD = {"meters": -2, "kilograms": -1, "seconds": 4, "amperes": 2}
_HENRY = {"meters": 2, "kilograms": 1, "seconds": -2, "amperes": -2}
_TESLA = {"kilograms": 1, "seconds": -2, "amperes": -1}

_NAMED: Final[dict[str, Units]] = {
    "rad": _units(radians=1),
    "rad/s": _units(radians=1, seconds=-1),
    "rad/s²": _units(radians=1, seconds=-2),
    "sr": _units(steradians=1),
    "m": _units(meters=1),
    "m²": _units(meters=2),
    "m³": _units(meters=3),
    "m/s": _units(meters=1, seconds=-1),
    "m/s²": _units(meters=1, seconds=-2),
    "m³/s": _units(meters=3, seconds=-1),
    "kg": _units(kilograms=1),
    "kg/m³": _units(kilograms=1, meters=-3),
    "s": _units(seconds=1),
    "1/s": _units(seconds=-1),
    "A": _units(amperes=1),
    "K": _units(kelvins=1),
    "mol": _units(moles=1),
    "cd": _units(candelas=1),
    "lm": _units(candelas=1, steradians=1),
    "lx": _units(candelas=1, steradians=1, meters=-2),
    "N": _units(**_NEWTON),
    "N·m": _units(**_JOULE),
    "N/m": _units(kilograms=1, seconds=-2),
    "Pa": _units(**_PASCAL),
    "W": _units(**_WATT),
    "V": _units(**_VOLT),
    "V/m": _units(**{**_VOLT, "meters": 1}),
    "Ω": _units(**_OHM),
    "F": _units(**_FARAD),
    "H": _units(**_HENRY),
    "T": _units(**_TESLA),
    "Wb": _units(**{**_TESLA, "meters": 2}),
    "C": _units(amperes=1, seconds=1),
}
_NAME_OF: Final = {units: name for name, units in _NAMED.items()}

_DEGREE = math.pi / 180
_TURN = 2 * math.pi
_ROWS: Final = (
    # spellings, name in _NAMED, scale, offset
    ("degree degrees deg °", "rad", _DEGREE, 0.0),
    ("degree/s deg/s °/s", "rad/s", _DEGREE, 0.0),
    ("turn revolution rev", "rad", _TURN, 0.0),
    ("mrad", "rad", 1e-3, 0.0),
    ("rpm", "rad/s", _TURN / 60, 0.0),
    ("rad/s^2", "rad/s²", 1.0, 0.0),
    ("kN", "N", 1e3, 0.0),
    ("mN", "N", 1e-3, 0.0),
    ("kgf", "N", 9.80665, 0.0),
    ("Nm N*m J", "N·m", 1.0, 0.0),
    ("mNm mN*m mN·m", "N·m", 1e-3, 0.0),
    ("nm", "m", 1e-9, 0.0),
    ("um µm μm", "m", 1e-6, 0.0),
    ("mm", "m", 1e-3, 0.0),
    ("cm", "m", 1e-2, 0.0),
    ("km", "m", 1e3, 0.0),
    ("mm/s", "m/s", 1e-3, 0.0),
    ("m/s^2 m/s**2", "m/s²", 1.0, 0.0),
    ("g_n gn", "m/s²", 9.80665, 0.0),
    ("g", "kg", 1e-3, 0.0),
    ("mg", "kg", 1e-6, 0.0),
    ("degC °C celsius", "K", 1.0, 273.15),
    ("degF °F", "K", 5 / 9, 459.67 * 5 / 9),
    ("ms", "s", 1e-3, 0.0),
    ("us µs μs", "s", 1e-6, 0.0),
    ("ns", "s", 1e-9, 0.0),
    ("min", "s", 60.0, 0.0),
    ("h", "s", 3600.0, 0.0),
    ("Hz", "1/s", 1.0, 0.0),
    ("kHz", "1/s", 1e3, 0.0),
    ("MHz", "1/s", 1e6, 0.0),
    ("mV", "V", 1e-3, 0.0),
    ("uV µV μV", "V", 1e-6, 0.0),
    ("mA", "A", 1e-3, 0.0),
    ("mW", "W", 1e-3, 0.0),
    ("kW", "W", 1e3, 0.0),
    ("ohm", "Ω", 1.0, 0.0),
    ("kohm kΩ", "Ω", 1e3, 0.0),
    ("pF", "F", 1e-12, 0.0),
    ("fF", "F", 1e-15, 0.0),
    ("mT", "T", 1e-3, 0.0),
    ("uT µT μT", "T", 1e-6, 0.0),
    ("hPa mbar", "Pa", 1e2, 0.0),
    ("kPa", "Pa", 1e3, 0.0),
    ("MPa", "Pa", 1e6, 0.0),
    ("bar", "Pa", 1e5, 0.0),
)
_TABLE: Final = {text: (name, scale, offset) for texts, name, scale, offset in _ROWS for text in texts.split()}
_STRAIN: Final = _units(RATIO, meters=1)
_SPECIAL_ROWS: Final = (
    ("1 count counts LSB", _units(), 1.0, 0.0),
    ("digital bit bits boolean state", _units(DIGITAL), 1.0, 0.0),
    ("arbitrary a.u. arb", _units(ARBITRARY), 1.0, 0.0),
    ("% percent", _units(RATIO), 0.01, 0.0),
    ("ratio", _units(RATIO), 1.0, 0.0),
    ("ppm", _units(RATIO), 1e-6, 0.0),
    ("strain m/m mm/mm", _STRAIN, 1.0, 0.0),
    ("microstrain ustrain µε um/m µm/m", _STRAIN, 1e-6, 0.0),
    ("mV/V", _units(RATIO, **_VOLT), 1e-3, 0.0),
    ("dB decibel", _units(LOG_RATIO), 0.1, 0.0),
    ("dBm", _units(LOG_PRODUCT, **_WATT), 0.1, -3.0),
)
_SPECIAL: Final = {
    text: (units, scale, offset) for texts, units, scale, offset in _SPECIAL_ROWS for text in texts.split()
}


@cache
def parse_unit(text: str) -> WrittenUnit:
    """Read a unit as people write it: ``degree``, ``N``, ``mm``, ``degC``, ``1/s``, ``mV/V``, ``%``, ``count``.

    ``%``, ``mV/V``, ``mm/mm`` become ratios (interpretation 1, exponents of one side), ``dB`` the log of a power ratio
    (3), ``dBm`` the log of a power (2), ``digital`` and ``arbitrary`` interpretations 4 and 5. ``g`` is the gram,
    ``g_n`` the standard acceleration of free fall. Raises BadData naming the text and how to write it.
    """
    text = text.strip()
    if text in _SPECIAL:
        return WrittenUnit(text, *_SPECIAL[text])
    if text in _NAMED:
        return WrittenUnit(text, _NAMED[text])
    if text in _TABLE:
        name, scale, offset = _TABLE[text]
        return WrittenUnit(text, _NAMED[name], scale, offset)
    if not text:
        raise _unknown(text)
    return _ratio(text) or _by_pint(text)


def parse_units(text: str) -> Units:
    """Exponents alone of a unit as people write it; raises BadData."""
    return parse_unit(text).units


def _ratio(text: str) -> WrittenUnit | None:
    """``mm/m``, ``mV/V``: both sides of the same kind, which ``pint`` would cancel to nothing."""
    if text.count("/") != 1:
        return None
    upper, lower = (part.strip() for part in text.split("/"))
    try:
        above, below = parse_unit(upper), parse_unit(lower)
    except BadData:
        return None
    if above.units != below.units or above.units.interpretation != PRODUCT or above.units == Units():
        return None
    exponents = {base: getattr(above.units, base) for base in BASES}
    return WrittenUnit(text, Units(RATIO, **exponents), above.scale / below.scale)


@cache
def _registry() -> pint.UnitRegistry[Any]:
    import pint

    return pint.UnitRegistry()


def _by_pint(text: str) -> WrittenUnit:
    registry = _registry()
    try:
        parsed = registry.parse_units(text)
        scale = registry.Quantity(1.0, parsed).to_root_units()
        zero = registry.Quantity(0.0, parsed).to_root_units()
    except Exception as error:  # pint raises its own, tokenizer's and arithmetic errors on a text that is no unit
        raise _unknown(text) from error
    exponents = _exponents(scale.u._units)
    light = ("steradian", "lumen", "lux")  # pint counts these as rad²
    steradians = sum((n for name, n in _exponents(parsed._units).items() if name.endswith(light)), Fraction(0))
    exponents["radian"] = exponents.get("radian", Fraction(0)) - 2 * steradians
    out = dict.fromkeys(BASES, Fraction(0)) | {"steradians": steradians}
    for name, power in exponents.items():
        if name in _PINT_BASES:
            out[_PINT_BASES[name]] = power
        elif name not in _COUNTS:
            raise BadData(
                f'The unit "{text}" holds {name}, which the SI units of a TEDS cannot say.',
                hint='Use "arbitrary" for what has no SI unit, "count" for a number, "digital" for bits.',
            )
    _representable(text, out)
    grams = float(out["kilograms"])  # pint's root unit is the gram
    offset = float(zero.m)
    return WrittenUnit(
        text, _from_exponents(PRODUCT, out), (float(scale.m) - offset) * 1000.0**-grams, offset * 1000.0**-grams
    )


def _exponents(container: Mapping[str, Any]) -> dict[str, Fraction]:
    return {name: Fraction(float(power)).limit_denominator(1000) for name, power in container.items()}


def _representable(text: str, exponents: dict[str, Fraction]) -> None:
    for name, power in exponents.items():
        if (2 * power).denominator != 1 or not -128 <= 2 * power <= 127:
            raise BadData(
                f'The unit "{text}" has the exponent {power} of {name}; a TEDS can say halves from -64 to 63.5.',
                hint='Describe the channel in another unit, or as "arbitrary".',
            )


def _unknown(text: str) -> BadData:
    near = get_close_matches(text, [*_NAMED, *_TABLE, *_SPECIAL], n=1, cutoff=0.6)
    guess = f'Did you mean "{near[0]}"? ' if near else ""
    return BadData(
        f'"{text}" is not a unit.', hint=f'{guess}Write it like "degree", "N", "mm", "degC", "m/s²", "mV/V" or "count".'
    )


_SUPER: Final = str.maketrans("0123456789-/.", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻ᐟ·")


def _power(exponent: Fraction) -> str:
    if exponent == 1:
        return ""
    if exponent.denominator == 1:
        return str(exponent.numerator).translate(_SUPER)
    return f"^{float(exponent):g}"


def _product(units: Units) -> str:
    exponents = [(symbol, getattr(units, base)) for symbol, base in zip(_SYMBOLS, BASES, strict=True)]
    above = "·".join(symbol + _power(power) for symbol, power in exponents if power > 0)
    below = [symbol + _power(-power) for symbol, power in exponents if power < 0]
    if not below:
        return above
    return f"{above or '1'}/{below[0] if len(below) == 1 else '(' + '·'.join(below) + ')'}"


def format_units(units: Units) -> str:
    """Name of the SI unit as people write it: ``rad``, ``N``, ``m/s²``; ``""`` for plain numbers (counts).

    The joule and the newton metre have the same exponents; it is called N·m here.
    """
    exponents = {base: getattr(units, base) for base in BASES}
    plain = Units(**exponents)
    name = _NAME_OF.get(plain) or _product(plain)
    if units.extension not in (0, 128):
        name = f"{name} (unit extension TEDS {units.extension})".strip()
    match units.interpretation:
        case 0:
            return name
        case 1:
            return f"{name}/{name}" if name else "ratio"
        case 2:
            return f"log10({name or '1'})"
        case 3:
            return f"log10({name}/{name})" if name else "log10(ratio)"
        case 4:
            return "digital"
        case 5:
            return "arbitrary"
        case other:
            return f"interpretation {other} (reserved) {name}".strip()


_FRIENDLY: Final = {
    _NAMED["rad"]: "degree",
    _NAMED["rad/s"]: "degree/s",
    _NAMED["K"]: "degC",
    _units(RATIO): "%",
    _units(LOG_RATIO): "dB",
    _SPECIAL["dBm"][0]: "dBm",
}
_SHORT: Final = {
    "degree": "°",
    "degrees": "°",
    "deg": "°",
    "degree/s": "°/s",
    "deg/s": "°/s",
    "degC": "°C",
    "degF": "°F",
}


def display_unit(units: Units, preferred: str | None = None) -> WrittenUnit:
    """Unit in which to show values of these exponents: the preferred one where it fits, else friendly, else SI."""
    for text in (preferred, _FRIENDLY.get(units)):
        if text:
            unit = parse_unit(text)
            if unit.units == units:
                return WrittenUnit(_SHORT.get(unit.text, unit.text), units, unit.scale, unit.offset)
    return WrittenUnit(format_units(units), units)


def in_display_units(value: float, units: Units, preferred: str | None = None) -> tuple[float, str]:
    """``(value, unit)`` for people, of a value in SI units."""
    unit = display_unit(units, preferred)
    return unit.from_si(value), unit.text


def format_value(value: float, unit: WrittenUnit, *, difference: bool = False, digits: int = 6) -> str:
    """Show a value given in SI units: ``360 °``, ``0.35 N``; a difference leaves the offset of the unit out."""
    if math.isnan(value):
        return "not available"
    shown = unit.difference_from_si(value) if difference else unit.from_si(value)
    if difference and value < 0:
        shown = -abs(shown)
    text = f"{shown:.{digits}g}"
    return f"{text} {unit.text}".strip()


_QUANTITY: Final = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*\Z")
_TIMES: Final = {
    "d": 86_400.0,
    "day": 86_400.0,
    "days": 86_400.0,
    "week": 604_800.0,
    "weeks": 604_800.0,
    "month": 2_629_746.0,
    "months": 2_629_746.0,
    "year": 31_556_952.0,
    "years": 31_556_952.0,
    "hours": 3600.0,
    "hour": 3600.0,
    "minutes": 60.0,
    "minute": 60.0,
    "seconds": 1.0,
    "second": 1.0,
}


def parse_seconds(value: object) -> float:
    """Seconds of ``"100 us"``, ``"1 year"`` (365.2425 days), ``"10 kHz"`` (its period) or a bare number of seconds.

    Raises BadData.
    """
    if isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300:
        return float(value)
    match = _QUANTITY.match(value) if isinstance(value, str) else None
    if match is None:
        raise BadData(
            f"{value!r} is not a time.", hint='Write a number of seconds, or a text like "100 us" or "1 year".'
        )
    number, text = float(match[1]), match[2]
    if not text or text in _TIMES:
        return number * _TIMES.get(text, 1.0)
    unit = parse_unit(text)
    if unit.units == _NAMED["s"]:
        return unit.to_si(number)
    if unit.units == _NAMED["1/s"] and number:
        return 1.0 / unit.to_si(number)
    raise BadData(
        f'"{value}" is not a time: {text} is no unit of time.', hint='Write it like "100 us", "5 s" or "10 kHz".'
    )


def short_unit(text: str) -> str:
    """Sign of a unit where it has one (``°`` for ``degree``), for showing."""
    return _SHORT.get(text, text)


def recognize(units: Units, scale: float, offset: float) -> WrittenUnit:
    """Unit of these exponents that converts into SI this way; one without a usual name is called after its scale."""

    def close(one: float, other: float) -> bool:
        return math.isclose(one, other, rel_tol=1e-6, abs_tol=1e-30)

    if close(scale, 1.0) and offset == 0:
        return WrittenUnit(format_units(units), units)
    for texts, name, its_scale, its_offset in _ROWS:
        if _NAMED[name] == units and close(scale, its_scale) and close(offset, its_offset):
            return WrittenUnit(_SHORT.get(texts.split()[0], texts.split()[0]), units, its_scale, its_offset)
    for texts, special, its_scale, its_offset in _SPECIAL_ROWS:
        if special == units and close(scale, its_scale) and close(offset, its_offset):
            return WrittenUnit(texts.split()[0], units, its_scale, its_offset)
    name = f"× {scale:.7g} {format_units(units)}".strip()
    return WrittenUnit(f"({name} + {offset:.7g})" if offset else f"({name})", units, scale, offset)
