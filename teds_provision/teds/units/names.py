"""The units people use every day: SI exponents and the way into SI; the tests hold them against ``pint``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from fractions import Fraction
from typing import Final

from teds_provision.teds.codec.model import UNIT_PARTS, Units

PRODUCT, RATIO, LOG_PRODUCT, LOG_RATIO, DIGITAL, ARBITRARY = range(6)


def from_exponents(interpretation: int, exponents: Mapping[str, Fraction]) -> Units:
    """Units of exponents by base name; a base that is left out is absent."""
    rad, sr, m, kg, s, a, k, mol, cd = (exponents.get(base, Fraction(0)) for base in UNIT_PARTS)
    return Units(interpretation, rad, sr, m, kg, s, a, k, mol, cd)


def units_of(interpretation: int = PRODUCT, **exponents: float) -> Units:
    """Units of exponents given by keyword."""
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
    # spellings, name in NAMED, scale, offset
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
