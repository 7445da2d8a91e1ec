r"""Units as the D-SI format writes them: ``\kilo\metre\per\second``, ``\newton\metre``, ``\metre\tothe{2}``.

A unit is a product of factors from left to right; ``\per`` puts the next factor below the line, a prefix multiplies the
unit behind it, ``\tothe{n}`` is the power of the unit before it. The names are those of the D-SI brochure.
"""

from __future__ import annotations

import math
import re
from fractions import Fraction
from functools import lru_cache
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.limits import LIMITS
from teds_provision.teds.codec.model import UNIT_PARTS, Units
from teds_provision.teds.units import PRODUCT, WrittenUnit, from_exponents, parse_unit, recognize

_PREFIXES: Final = {
    name: 10.0**power
    for name, power in {
        "deca": 1,
        "hecto": 2,
        "kilo": 3,
        "mega": 6,
        "giga": 9,
        "tera": 12,
        "peta": 15,
        "exa": 18,
        "deci": -1,
        "centi": -2,
        "milli": -3,
        "micro": -6,
        "nano": -9,
        "pico": -12,
        "femto": -15,
        "atto": -18,
    }.items()
}
# The certificate's name, our unit, and the scale between them.
_UNITS: Final = {
    "one": ("1", 1.0),
    "percent": ("1", 1e-2),
    "ppm": ("1", 1e-6),
    "metre": ("m", 1.0),
    "kilogram": ("kg", 1.0),
    "gram": ("g", 1.0),
    "tonne": ("kg", 1e3),
    "second": ("s", 1.0),
    "minute": ("min", 1.0),
    "hour": ("h", 1.0),
    "day": ("s", 86_400.0),
    "ampere": ("A", 1.0),
    "kelvin": ("K", 1.0),
    "mole": ("mol", 1.0),
    "candela": ("cd", 1.0),
    "radian": ("rad", 1.0),
    "degree": ("deg", 1.0),
    "arcminute": ("deg", 1 / 60),
    "arcsecond": ("deg", 1 / 3600),
    "steradian": ("sr", 1.0),
    "hertz": ("Hz", 1.0),
    "newton": ("N", 1.0),
    "pascal": ("Pa", 1.0),
    "bar": ("bar", 1.0),
    "joule": ("J", 1.0),
    "watt": ("W", 1.0),
    "coulomb": ("C", 1.0),
    "volt": ("V", 1.0),
    "farad": ("F", 1.0),
    "ohm": ("Ω", 1.0),
    "weber": ("Wb", 1.0),
    "tesla": ("T", 1.0),
    "henry": ("H", 1.0),
    "lumen": ("lm", 1.0),
    "lux": ("lx", 1.0),
    "degreecelsius": ("K", 1.0),  # a difference in a product; alone, its zero is handled below
    "litre": ("m³", 1e-3),
    "electronvolt": ("J", 1.602176634e-19),
}
_WRITTEN: Final = {r"newton\metre": ("N·m", 1.0), **_UNITS}
"""Names that are written; the first that fits is taken, so that a torque is no energy."""
_POWERS: Final = {
    "siemens": ("Ω", -1),
    "becquerel": ("s", -1),
}
_TOKEN: Final = re.compile(r"\\(?:tothe\{([-+]?[0-9]{1,2}(?:\.[0-9]{1,2})?)\}|([a-z]+))\s*")
_CELSIUS: Final = r"\degreecelsius"


@lru_cache(maxsize=256)
def parse_si_unit(text: str) -> WrittenUnit:
    r"""Return the unit that a certificate names, with its scale into SI; ``\one`` is a plain number.

    Raises BadDataError for a text that is no D-SI unit, or names one that a TEDS cannot hold.
    """
    plain = text.strip()
    if len(plain) > LIMITS.unit * 4:
        raise BadDataError(f"A unit has at most {LIMITS.unit * 4} characters, this one {len(plain)}.")
    if plain == _CELSIUS:
        celsius = parse_unit("degC")
        return WrittenUnit("°C", celsius.units, celsius.scale, celsius.offset)
    exponents: dict[str, Fraction] = dict.fromkeys(UNIT_PARTS, Fraction(0))
    scale = 1.0
    for name, prefix, power in _factors(plain):
        of, factor, own = _unit_named(name, plain)
        scale *= (prefix * factor * of.scale**own) ** float(power)
        for base in UNIT_PARTS:
            exponents[base] += own * power * getattr(of.units, base)
    if any((2 * power).denominator != 1 or not -128 <= 2 * power <= 127 for power in exponents.values()):
        raise BadDataError(f'The unit "{plain}" has a power that a TEDS cannot hold.')
    return recognize(from_exponents(PRODUCT, exponents), scale, 0.0)


def _unit_named(name: str, text: str) -> tuple[WrittenUnit, float, int]:
    """Return a unit of our table, a factor, and a power of that unit."""
    if name in _POWERS:
        base, power = _POWERS[name]
        return parse_unit(base), 1.0, power
    if name not in _UNITS:
        raise BadDataError(f'"{text}" is not a unit of the D-SI that is known here: \\{name}.')
    base, factor = _UNITS[name]
    return (WrittenUnit("1", Units()) if base == "1" else parse_unit(base)), factor, 1


def _factors(text: str) -> list[tuple[str, float, Fraction]]:
    """Return name, prefix and power of each factor."""
    factors: list[tuple[str, float, Fraction]] = []
    at, prefix, side = 0, 1.0, 1
    powered = True  # True: so far there is no unit that a power could apply to
    pending = False
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            raise _no_unit(text)
        at = match.end()
        power, name = match[1], match[2]
        if power is not None:
            if powered or pending:
                raise _no_unit(text)
            name, before, sign = factors[-1]
            factors[-1] = (name, before, sign * Fraction(power))
            powered = True
        elif name == "per":
            if pending:
                raise _no_unit(text)
            side, pending = -1, True
        elif name in _PREFIXES:
            if prefix != 1.0:
                raise _no_unit(text)
            prefix, pending = _PREFIXES[name], True
        else:
            factors.append((name, prefix, Fraction(side)))
            prefix, side, powered, pending = 1.0, 1, False, False
    if not factors or pending:
        raise _no_unit(text)
    return factors


def _no_unit(text: str) -> BadDataError:
    return BadDataError(
        f'"{text[:60]}" is not a unit of the D-SI.',
        hint=r"A certificate writes units like \degreecelsius, \newton\metre.",
    )


def write_si_unit(unit: WrittenUnit) -> tuple[str, float, float]:
    r"""Return a D-SI unit, and scale and offset from values in ``unit`` to values in that one.

    Temperatures in °C stay so; everything else is written in SI units, so that no name has to be found for it.
    """
    celsius = parse_unit("degC")
    if unit.units == celsius.units and unit.scale == 1.0 and unit.offset == celsius.offset:
        return _CELSIUS, 1.0, 0.0
    for prefix, times in {"": 1.0, **_PREFIXES}.items():
        for name, (base, factor) in _WRITTEN.items():
            known = WrittenUnit("1", Units()) if base == "1" else parse_unit(base)
            scale = known.scale * factor * times
            if known.units == unit.units and unit.offset == 0 and math.isclose(scale, unit.scale, rel_tol=1e-12):
                return f"\\{prefix}\\{name}" if prefix else f"\\{name}", 1.0, 0.0
    parts = [
        f"\\{name}" + ("" if power == 1 else f"\\tothe{{{_decimal(power)}}}")
        for base, name in zip(UNIT_PARTS, _BASES, strict=True)
        if (power := getattr(unit.units, base))
    ]
    return "".join(parts) or r"\one", unit.scale, unit.offset


def _decimal(power: Fraction) -> str:
    return str(power.numerator) if power.denominator == 1 else f"{float(power):g}"


_BASES: Final = ("radian", "steradian", "metre", "kilogram", "second", "ampere", "kelvin", "mole", "candela")
