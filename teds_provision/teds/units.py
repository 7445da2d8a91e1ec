"""Units as people write them, and the standard's exponents of SI units (teds.md, "Data types").

``parse_unit("degC")`` gives the exponents that go into a TEDS together with scale and offset into SI; ``format_units``
is the inverse. Everyday units are in a table here, so that building a datasheet and their products need not load
``pint`` (0.4 s); rare ones go to it (extra ``units``). The tests compare both with it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from fractions import Fraction
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import BadDataError
from teds_provision.lazy import how_to_install
from teds_provision.limits import LIMITS
from teds_provision.teds.codec.model import UNIT_PARTS, Units

if TYPE_CHECKING:
    import pint


# Everyday units: SI exponents and the conversion to SI; tests compare them with ``pint``.

PRODUCT, RATIO, LOG_PRODUCT, LOG_RATIO, DIGITAL, ARBITRARY = range(6)


def from_exponents(interpretation: int, exponents: Mapping[str, Fraction]) -> Units:
    """Return the units of exponents by base name; a base that is left out is absent."""
    rad, sr, m, kg, s, a, k, mol, cd = (exponents.get(base, Fraction(0)) for base in UNIT_PARTS)
    return Units(interpretation, rad, sr, m, kg, s, a, k, mol, cd)


def units_of(interpretation: int = PRODUCT, **exponents: float) -> Units:
    """Return the units of exponents given by keyword."""
    return from_exponents(interpretation, {name: Fraction(value) for name, value in exponents.items()})


_NEWTON = {"meters": 1, "kilograms": 1, "seconds": -2}
_JOULE = {"meters": 2, "kilograms": 1, "seconds": -2}
_WATT = {"meters": 2, "kilograms": 1, "seconds": -3}
_PASCAL = {"meters": -1, "kilograms": 1, "seconds": -2}
_VOLT = {"meters": 2, "kilograms": 1, "seconds": -3, "amperes": -1}
_OHM = {"meters": 2, "kilograms": 1, "seconds": -3, "amperes": -2}
_FARAD = {"meters": -2, "kilograms": -1, "seconds": 4, "amperes": 2}
_HENRY = {"meters": 2, "kilograms": 1, "seconds": -2, "amperes": -2}
_TESLA = {"kilograms": 1, "seconds": -2, "amperes": -1}

NAMED: Final[dict[str, Units]] = {
    "rad": units_of(radians=1),
    "rad/s": units_of(radians=1, seconds=-1),
    "rad/s²": units_of(radians=1, seconds=-2),
    "sr": units_of(steradians=1),
    "m": units_of(meters=1),
    "m²": units_of(meters=2),
    "m³": units_of(meters=3),
    "m/s": units_of(meters=1, seconds=-1),
    "m/s²": units_of(meters=1, seconds=-2),
    "m³/s": units_of(meters=3, seconds=-1),
    "kg": units_of(kilograms=1),
    "kg/m³": units_of(kilograms=1, meters=-3),
    "s": units_of(seconds=1),
    "1/s": units_of(seconds=-1),
    "A": units_of(amperes=1),
    "K": units_of(kelvins=1),
    "mol": units_of(moles=1),
    "cd": units_of(candelas=1),
    "lm": units_of(candelas=1, steradians=1),
    "lx": units_of(candelas=1, steradians=1, meters=-2),
    "N": units_of(**_NEWTON),
    "N·m": units_of(**_JOULE),
    "N/m": units_of(kilograms=1, seconds=-2),
    "Pa": units_of(**_PASCAL),
    "W": units_of(**_WATT),
    "V": units_of(**_VOLT),
    "V/m": units_of(**{**_VOLT, "meters": 1}),
    "Ω": units_of(**_OHM),
    "F": units_of(**_FARAD),
    "H": units_of(**_HENRY),
    "T": units_of(**_TESLA),
    "Wb": units_of(**{**_TESLA, "meters": 2}),
    "C": units_of(amperes=1, seconds=1),
}
NAME_OF: Final = {units: name for name, units in NAMED.items()}

_DEGREE = math.pi / 180
_TURN = 2 * math.pi
ROWS: Final = (
    # Spellings, name in NAMED, scale, offset.
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
TABLE: Final = {text: (name, scale, offset) for texts, name, scale, offset in ROWS for text in texts.split()}
_STRAIN: Final = units_of(RATIO, meters=1)
SPECIAL_ROWS: Final = (
    ("1 count counts LSB", units_of(), 1.0, 0.0),
    ("digital bit bits boolean state", units_of(DIGITAL), 1.0, 0.0),
    ("arbitrary a.u. arb", units_of(ARBITRARY), 1.0, 0.0),
    ("% percent", units_of(RATIO), 0.01, 0.0),
    ("ratio", units_of(RATIO), 1.0, 0.0),
    ("ppm", units_of(RATIO), 1e-6, 0.0),
    ("strain m/m mm/mm", _STRAIN, 1.0, 0.0),
    ("microstrain ustrain µε um/m µm/m", _STRAIN, 1e-6, 0.0),
    ("mV/V", units_of(RATIO, **_VOLT), 1e-3, 0.0),
    ("dB decibel", units_of(LOG_RATIO), 0.1, 0.0),
    ("dBm", units_of(LOG_PRODUCT, **_WATT), 0.1, -3.0),
)
SPECIAL: Final = {
    text: (units, scale, offset) for texts, units, scale, offset in SPECIAL_ROWS for text in texts.split()
}
_FULL_NAMES: Final = {
    name: symbol
    for names, symbol in (
        ("radian rads", "rad"), ("steradian", "sr"), ("degree degs", "degree"), ("turn rotation", "turn"),
        ("meter metre", "m"), ("gram gramme", "g"), ("second sec", "s"), ("minute", "min"), ("hour", "h"),
        ("ampere amp", "A"), ("kelvin", "K"), ("celsius centigrade", "degC"), ("fahrenheit", "degF"), ("mole", "mol"),
        ("candela", "cd"), ("lumen", "lm"), ("lux", "lx"), ("newton", "N"), ("pascal", "Pa"), ("joule", "J"),
        ("watt", "W"), ("volt", "V"), ("ohm", "ohm"), ("farad", "F"), ("henry henries", "H"), ("tesla", "T"),
        ("weber", "Wb"), ("coulomb", "C"), ("hertz", "Hz"), ("percent", "%"), ("count", "count"), ("rpm", "rpm"),
    )
    for name in names.split()
}  # fmt: skip
"""Names as words, for a suggestion: the symbol of each is read everywhere, with or without ``pint``."""
_PREFIXES: Final = {"kilo": "k", "mega": "M", "hecto": "h", "centi": "c", "milli": "m", "micro": "u", "nano": "n",
                    "pico": "p", "femto": "f"}  # fmt: skip
_WORD: Final = re.compile(r"[^\W\d_]{3,}")


__all__ = [
    "LOG_RATIO",
    "PRODUCT",
    "RATIO",
    "WrittenUnit",
    "display_unit",
    "format_units",
    "format_value",
    "in_display_units",
    "name_of_units",
    "parse_seconds",
    "parse_unit",
    "parse_units",
    "recognize",
    "short_unit",
]

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
    """A unit as written: ``SI value = scale × value + offset``."""

    text: str
    units: Units
    scale: float = 1.0
    offset: float = 0.0

    def to_si(self, value: float) -> float:
        """Return the SI value of a value in this unit."""
        return value * self.scale + self.offset

    def from_si(self, value: float) -> float:
        """Return the value in this unit of an SI value."""
        return (value - self.offset) / self.scale

    def difference_to_si(self, value: float) -> float:
        """Return a difference (an uncertainty, a step) in SI units: scaled, without the offset."""
        return value * abs(self.scale)

    def difference_from_si(self, value: float) -> float:
        """Return a difference given in SI units, in this unit."""
        return value / abs(self.scale)


@lru_cache(maxsize=1024)
def parse_unit(text: str) -> WrittenUnit:
    """Read a unit as people write it: ``degree``, ``N``, ``mm``, ``degC``, ``1/s``, ``mV/V``, ``%``, ``count``.

    ``%``, ``mV/V``, ``mm/mm`` become ratios (interpretation 1, exponents of one side), ``dB`` the log of a power ratio
    (3), ``dBm`` the log of a power (2), ``digital`` and ``arbitrary`` interpretations 4 and 5. ``g`` is the gram,
    ``g_n`` the standard acceleration of free fall. Raises BadDataError naming the text and how to write it.
    """
    text = text.strip()
    if len(text) > LIMITS.unit:
        raise BadDataError(f"A unit has at most {LIMITS.unit} characters, this one {len(text)}.")
    if text in SPECIAL:
        return WrittenUnit(text, *SPECIAL[text])
    if text in NAMED:
        return WrittenUnit(text, NAMED[text])
    if text in TABLE:
        name, scale, offset = TABLE[text]
        return WrittenUnit(text, NAMED[name], scale, offset)
    if not text:
        raise _unknown(text)
    return _ratio(text) or _compound(text) or _by_pint(text)


def parse_units(text: str) -> Units:
    """Return only the exponents of a unit as people write it; raises BadDataError."""
    return parse_unit(text).units


def _ratio(text: str) -> WrittenUnit | None:
    """Parse ``mm/m`` or ``mV/V``: both sides of one kind, which ``pint`` would cancel to nothing. None for others."""
    if text.count("/") != 1:
        return None
    upper, lower = (part.strip() for part in text.split("/"))
    try:
        above, below = parse_unit(upper), parse_unit(lower)
    except BadDataError:
        return None
    if above.units != below.units or above.units.interpretation != PRODUCT or above.units == Units():
        return None
    exponents = {base: getattr(above.units, base) for base in UNIT_PARTS}
    return WrittenUnit(text, Units(RATIO, **exponents), above.scale / below.scale)


# Names, products, quotients, and one power each. Nothing that pint would compute, such as 9**9**9.
_PLAIN_POWER: Final = r"(?:\s*(?:\^|\*\*)\s*\(?[-+]?[0-9]{1,3}(?:\.[05]|/2)?\)?|[⁰¹²³⁴⁵⁶⁷⁸⁹⁻]{1,4})?+"
_PLAIN_NAME: Final = r"[^\W\d_]\w*+|[°%Ω]\w*+"
_PLAIN_UNIT: Final = re.compile(
    rf"\(?\s*(?:1|(?:{_PLAIN_NAME}){_PLAIN_POWER})"
    rf"(?:\s*(?:(?:\*(?!\*)|/|·|\bper\b)\s*|\s)\(?\s*(?:1|(?:{_PLAIN_NAME}){_PLAIN_POWER})\)?)*\s*\)?"
)


_FACTOR: Final = re.compile(
    r"\s*(?P<sign>[*·/]?)\s*(?P<name>1|°?[^\W\d_²³¹⁰⁴-⁹]+)\s*(?:(?:\^|\*\*)(?P<power>-?[0-9]{1,2}(?:\.5)?)|(?P<upper>⁻?[¹²³]))?(?=\s|[*·/)]|\Z)"
)
_UPPER: Final = str.maketrans("⁻¹²³", "-123")


def _compound(text: str) -> WrittenUnit | None:
    """Parse products and quotients of units of our own table, from left to right; None for anything else."""
    factors = _factors(text)
    if factors is None:
        return None
    out, scale = dict.fromkeys(UNIT_PARTS, Fraction(0)), 1.0
    for match, side in factors:
        name = match["name"]
        named = TABLE.get(name)
        if named is None and name not in NAMED and name != "1":
            return None
        units = Units() if name == "1" else NAMED[name if named is None else named[0]]
        power = side * Fraction(match["power"] or (match["upper"] or "1").translate(_UPPER))
        for base in UNIT_PARTS:
            out[base] += power * getattr(units, base)
        if named is not None:  # without its offset: in a product, a temperature is a difference
            scale *= named[1] ** float(power)
    _representable(text, out)
    return WrittenUnit(text, from_exponents(PRODUCT, out), scale)


def _factors(text: str) -> list[tuple[re.Match[str], int]] | None:
    """Return each factor of a product with its side (1 above, -1 below); None if it is no product."""
    upper, slash, lower = text.partition("/(")
    # only one denominator in brackets, at the end, and something on either side of the stroke
    if slash and (not upper or lower == ")" or not lower.endswith(")") or "/" in lower):
        return None
    factors: list[tuple[re.Match[str], int]] = []
    for part, side in ((upper, 1), (lower[:-1], -1)) if slash else ((upper, 1),):
        at = 0
        while at < len(part):
            match = _FACTOR.match(part, at)
            if match is None or (at == 0 and match["sign"]):
                return None
            factors.append((match, -side if match["sign"] == "/" else side))
            at = match.end()
    return factors


@cache
def _registry() -> pint.UnitRegistry[Any] | None:
    try:
        import pint
    except ImportError:
        return None
    return pint.UnitRegistry()


def _by_pint(text: str) -> WrittenUnit:
    if _PLAIN_UNIT.fullmatch(text) is None:
        raise _unknown(text)
    registry = _registry()
    if registry is None:
        unknown = _unknown(text)
        raise BadDataError(
            f"{unknown.message[:-1]} that is known without the package pint.",
            hint=f"{unknown.hint} A rare unit needs pint. {how_to_install('units')}",
        )
    try:
        parsed = registry.parse_units(text)
        scale = registry.Quantity(1.0, parsed).to_root_units()
        zero = registry.Quantity(0.0, parsed).to_root_units()
    except Exception as error:  # for text that is not a unit, pint raises its own, tokenizer's and arithmetic errors
        raise _unknown(text) from error
    exponents = _exponents(scale.u._units)
    light = ("steradian", "lumen", "lux")  # pint defines these with rad²
    steradians = sum((n for name, n in _exponents(parsed._units).items() if name.endswith(light)), Fraction(0))
    exponents["radian"] = exponents.get("radian", Fraction(0)) - 2 * steradians
    out = dict.fromkeys(UNIT_PARTS, Fraction(0)) | {"steradians": steradians}
    for name, power in exponents.items():
        if name in _PINT_BASES:
            out[_PINT_BASES[name]] = power
        elif name not in _COUNTS:
            raise BadDataError(
                f'The unit "{text}" holds {name}, which the SI units of a TEDS cannot say.',
                hint='Use "arbitrary" for what has no SI unit, "count" for a number, "digital" for bits.',
            )
    _representable(text, out)
    grams = float(out["kilograms"])  # pint's base unit is the gram
    offset = float(zero.m)
    return WrittenUnit(
        text, from_exponents(PRODUCT, out), (float(scale.m) - offset) * 1000.0**-grams, offset * 1000.0**-grams
    )


def _exponents(container: Mapping[str, Any]) -> dict[str, Fraction]:
    return {name: Fraction(float(power)).limit_denominator(1000) for name, power in container.items()}


def _representable(text: str, exponents: dict[str, Fraction]) -> None:
    for name, power in exponents.items():
        if (2 * power).denominator != 1 or not -128 <= 2 * power <= 127:
            raise BadDataError(
                f'The unit "{text}" has the exponent {power} of {name}; a TEDS can say halves from -64 to 63.5.',
                hint='Describe the channel in another unit, or as "arbitrary".',
            )


def _in_symbols(text: str) -> str:
    """Return a unit in words as one in symbols, such as ``N*m`` for ``Newton-meters``; "" if it is none.

    Words without a symbol stay: ``m/fortnight`` is no suggestion, because it does not parse.
    """
    written = _WORD.sub(lambda word: _symbol(word[0].lower()) or word[0], text).replace("-", "*").strip()
    try:
        parses = written in NAMED or written in TABLE or written in SPECIAL or _compound(written) is not None
    except BadDataError:  # an exponent out of range for a TEDS
        return ""
    return written if parses and written != text else ""


def _symbol(word: str) -> str:
    singular = word if word in _FULL_NAMES else word.removesuffix("s")
    if singular in _FULL_NAMES:
        return _FULL_NAMES[singular]
    prefix = next((prefix for prefix in _PREFIXES if singular.startswith(prefix)), "")
    base = _FULL_NAMES.get(singular.removeprefix(prefix), "") if prefix else ""
    return _PREFIXES[prefix] + base if base else ""


def _unknown(text: str) -> BadDataError:
    nearest = get_close_matches(text[:64], [*NAMED, *TABLE, *SPECIAL], n=1, cutoff=0.6)
    near = _in_symbols(text[:64]) or "".join(nearest)
    guess = f'Did you mean "{near}"? ' if near else ""
    return BadDataError(
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
    exponents = [(symbol, getattr(units, base)) for symbol, base in zip(_SYMBOLS, UNIT_PARTS, strict=True)]
    above = "·".join(symbol + _power(power) for symbol, power in exponents if power > 0)
    below = [symbol + _power(-power) for symbol, power in exponents if power < 0]
    if not below:
        return above
    return f"{above or '1'}/{below[0] if len(below) == 1 else '(' + '·'.join(below) + ')'}"


# Interpretation of physical units (IEEE 1451.0-2007, table of the field): formats for units and for plain numbers.
_INTERPRETATIONS: Final = {
    0: ("{0}", ""),
    1: ("{0}/{0}", "ratio"),
    2: ("log10({0})", "log10(1)"),
    3: ("log10({0}/{0})", "log10(ratio)"),
    4: ("digital", "digital"),
    5: ("arbitrary", "arbitrary"),
}


def format_units(units: Units) -> str:
    """Name of the SI unit as people write it: ``rad``, ``N``, ``m/s²``; ``""`` for plain numbers (counts).

    The joule and the newton metre have the same exponents; it is called N·m here.
    """
    exponents = {base: getattr(units, base) for base in UNIT_PARTS}
    plain = Units(**exponents)
    name = NAME_OF.get(plain) or _product(plain)
    if units.extension not in (0, 128):
        name = f"{name} (unit extension TEDS {units.extension})".strip()
    if units.interpretation not in _INTERPRETATIONS:
        return f"interpretation {units.interpretation} (reserved) {name}".strip()
    of_unit, of_numbers = _INTERPRETATIONS[units.interpretation]
    return of_unit.format(name) if name else of_numbers


def name_of_units(units: Units) -> str:
    """Return the name of the SI unit for people, ``count`` for a plain number: the only place for it."""
    return format_units(units) or "count"


_FRIENDLY: Final = {
    NAMED["rad"]: "degree",
    NAMED["rad/s"]: "degree/s",
    NAMED["K"]: "degC",
    units_of(RATIO): "%",
    units_of(LOG_RATIO): "dB",
    SPECIAL["dBm"][0]: "dBm",
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
    """Return the unit in which to show values of these exponents: the preferred one if it fits.

    Else a friendly one, else SI.
    """
    for text in (preferred, _FRIENDLY.get(units)):
        if text:
            unit = parse_unit(text)
            if unit.units == units:
                return WrittenUnit(_SHORT.get(unit.text, unit.text), units, unit.scale, unit.offset)
    return WrittenUnit(format_units(units), units)


def in_display_units(value: float, units: Units, preferred: str | None = None) -> tuple[float, str]:
    """Return ``(value, unit)`` for people, of a value in SI units."""
    unit = display_unit(units, preferred)
    return unit.from_si(value), unit.text


def format_value(value: float, unit: WrittenUnit, *, difference: bool = False, digits: int = 6) -> str:
    """Show a value given in SI units: ``360 °``, ``0.35 N``; a difference leaves the offset of the unit out."""
    if math.isnan(value):
        return "not available"
    shown = unit.difference_from_si(value) if difference else unit.from_si(value)
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


def _quantity(value: object) -> tuple[float, str]:
    """Return the number and the unit of ``"100 us"``."""
    match = _QUANTITY.match(value) if isinstance(value, str) else None
    if match is None:
        raise BadDataError(
            f"{value!r} is not a time.", hint='Write a number of seconds, or a text like "100 us" or "1 year".'
        )
    return float(match[1]), match[2]


def parse_seconds(value: object) -> float:
    """Return the seconds of ``"100 us"``, ``"1 year"`` (365.2425 days), ``"10 kHz"`` (its period) or a bare number.

    Raises BadDataError.
    """
    if isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300:
        return float(value)
    number, text = _quantity(value)
    if not text or text in _TIMES:
        return number * _TIMES.get(text, 1.0)
    unit = parse_unit(text)
    if unit.units == NAMED["s"]:
        return unit.to_si(number)
    if unit.units == NAMED["1/s"] and number:
        return 1.0 / unit.to_si(number)
    raise BadDataError(
        f'"{value}" is not a time: {text} is no unit of time.', hint='Write it like "100 us", "5 s" or "10 kHz".'
    )


def short_unit(text: str) -> str:
    """Return the symbol of a unit if it has one (``°`` for ``degree``), for showing."""
    return _SHORT.get(text, text)


def recognize(units: Units, scale: float, offset: float) -> WrittenUnit:
    """Return the unit of these exponents with this conversion into SI.

    One without a usual name is called after its scale.
    """
    if _close(scale, 1.0) and offset == 0:
        return WrittenUnit(format_units(units), units)
    for text, of, its_scale, its_offset in _usual_units():
        if of == units and _close(scale, its_scale) and _close(offset, its_offset):
            return WrittenUnit(text, units, its_scale, its_offset)
    name = f"× {scale:.7g} {format_units(units)}".strip()
    return WrittenUnit(f"({name} + {offset:.7g})" if offset else f"({name})", units, scale, offset)


def _close(one: float, other: float) -> bool:
    return math.isclose(one, other, rel_tol=1e-6, abs_tol=1e-30)


def _usual_units() -> Iterator[tuple[str, Units, float, float]]:
    """Sign, exponents, scale and offset of every unit that has a usual name."""
    for texts, name, scale, offset in ROWS:
        yield short_unit(texts.split()[0]), NAMED[name], scale, offset
    for texts, special, scale, offset in SPECIAL_ROWS:
        yield texts.split()[0], special, scale, offset
