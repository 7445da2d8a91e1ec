"""Requirements of a task on a datasheet: ``angle >= 360 deg, uncertainty <= 1 deg, rate >= 1 kHz``.

A requirement names a quantity (or a channel) and bounds on it; it is judged against the channels of a :class:`Sheet`
(``nodes --fits``, ``measure --require``). The quantity itself, ``low`` and ``high`` concern the range: with ``>=`` it
must reach up to the value, with ``<=`` down to it. ``range`` is its width, ``uncertainty`` the worst case (``%`` of the
width, or in the unit), ``rate`` the highest sampling rate. A full turn reaches every angle.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from difflib import get_close_matches
from typing import Final, Literal

from teds_provision.errors import BadDataError
from teds_provision.limits import LIMITS, check_size, load_toml
from teds_provision.teds.channel import ROUNDING
from teds_provision.teds.codec.model import Units
from teds_provision.teds.sheet import Channel, Sheet
from teds_provision.teds.units import NAMED, RATIO, WrittenUnit, format_units, parse_unit

Result = Literal["passed", "failed", "skipped"]

QUANTITIES: Final[Mapping[str, Units]] = {
    name: NAMED[unit]
    for names, unit in (
        ("angle", "rad"),
        ("angular-velocity angular-rate", "rad/s"),
        ("angular-acceleration", "rad/s²"),
        ("length distance position displacement", "m"),
        ("area", "m²"),
        ("volume", "m³"),
        ("velocity speed", "m/s"),
        ("acceleration", "m/s²"),
        ("flow", "m³/s"),
        ("mass", "kg"),
        ("density", "kg/m³"),
        ("time", "s"),
        ("frequency", "1/s"),
        ("current", "A"),
        ("temperature", "K"),
        ("force", "N"),
        ("torque moment energy", "N·m"),
        ("stiffness", "N/m"),
        ("pressure", "Pa"),
        ("power", "W"),
        ("voltage", "V"),
        ("resistance", "Ω"),
        ("capacitance", "F"),
        ("inductance", "H"),
        ("magnetic-field", "T"),
        ("charge", "C"),
        ("illuminance", "lx"),
    )
    for name in names.split()
}
"""Quantities by name: the exponents that a channel's PhyUnits have."""
_PROPERTIES: Final = ("low", "high", "range", "uncertainty", "rate")
_TERM: Final = re.compile(
    r"\s*([A-Za-z][A-Za-z _-]{0,39}?)\s*(>=|<=|>|<)"
    r"\s*([-+]?(?:[0-9]{1,20}(?:\.[0-9]{0,20})?|\.[0-9]{1,20})(?:[eE][-+]?[0-9]{1,3})?)\s*([^\s0-9.].*)?\Z"
)
_HERTZ: Final = NAMED["1/s"]
_UNITLESS: Final = "1"


@dataclass(frozen=True)
class Term:
    """One bound: what is looked at (the quantity, or one of low, high, range, uncertainty, rate), operator, value."""

    what: str
    operator: str
    value: float
    unit: WrittenUnit

    @property
    def text(self) -> str:
        """``angle >= 360 deg``."""
        return f"{self.what} {self.operator} {self.value:g} {self.unit.text}".strip()

    @property
    def upward(self) -> bool:
        """True if it is a lower bound (``>=``, ``>``)."""
        return self.operator[0] == ">"


@dataclass(frozen=True)
class Requirement:
    """Terms that one channel must meet together; ``quantity`` or ``channel`` (a name) selects the channels."""

    terms: tuple[Term, ...]
    quantity: str = ""
    channel: str = ""

    @property
    def subject(self) -> str:
        """The subject of the requirement, in words."""
        return f'the channel "{self.channel}"' if self.channel else self.quantity or "a channel"

    def concerns(self, channel: Channel) -> bool:
        """Return True if a channel is one that this requirement concerns."""
        if self.channel:
            return channel.name == self.channel
        return not self.quantity or channel.units == QUANTITIES[self.quantity]


@dataclass(frozen=True)
class Fit:
    """Result for one channel and one requirement; ``why`` lists the bounds that are not met, or the values."""

    channel: int | None
    name: str
    result: Result
    why: str


def parse_fits(text: str) -> Requirement:
    """Read ``angle >= 360 deg, uncertainty <= 1 deg``; raises BadDataError with the term that is wrong."""
    check_size(len(text.encode()), LIMITS.expression, "the expression")
    parts = [part for part in text.split(",") if part.strip()]
    if not 1 <= len(parts) <= LIMITS.terms:
        raise BadDataError(
            f"An expression has 1 to {LIMITS.terms} terms, this one {len(parts)}.",
            hint='Write it like "angle >= 360 deg, uncertainty <= 1 deg, rate >= 1 kHz".',
        )
    terms = tuple(_term(part) for part in parts)
    quantities = sorted({term.what for term in terms if term.what in QUANTITIES})
    if len(quantities) > 1:
        raise BadDataError(f"One expression asks for one quantity, this one for {' and '.join(quantities)}.")
    return _with_fitting_units(Requirement(terms, quantity=quantities[0] if quantities else ""))


def parse_require(text: str, file: str) -> tuple[Requirement, ...]:
    """Read the TOML of ``--require``: a table for each channel name or quantity; raises BadDataError with the place.

    ``[angle]`` with ``range = ">= 360 deg"``, ``uncertainty = "<= 1 deg"``, ``rate = ">= 1 kHz"``.
    """
    data = load_toml(text, file)
    if not data:
        raise BadDataError(
            f"{file}: it asks for nothing.", hint='Write a table such as [angle] with range = ">= 360 deg".'
        )
    return tuple(_table(name, table, file) for name, table in data.items())


def judge(requirement: Requirement, sheet: Sheet, now: datetime | None = None) -> tuple[Fit, ...]:
    """Judge the channels of a datasheet by a requirement; one line with ``channel`` None if none is concerned.

    ``skipped``: the datasheet has no such value. With ``now`` an overdue calibration meets no bound on the uncertainty.
    """
    concerned = [channel for channel in sheet.channels if requirement.concerns(channel)]
    if not concerned:
        return (Fit(None, "", "failed", f"no channel gives {requirement.subject}."),)
    return tuple(_fit_of(requirement, channel, now) for channel in concerned)


def met(requirement: Requirement, fits: Iterable[Fit]) -> bool:
    """Return True if a group meets a requirement: some channel does, and of a channel that is named every one."""
    results = [fit.result for fit in fits if fit.channel is not None]
    return bool(results) and (all if requirement.channel else any)(result == "passed" for result in results)


def _fit_of(requirement: Requirement, channel: Channel, now: datetime | None) -> Fit:
    short, unknown = [], []
    if channel.value_problem:
        short.append(channel.value_problem)
    for term in requirement.terms:
        has = _has(term, channel)
        if not _is_in_its_unit(term, channel):
            unit = channel.shown.text or "plain numbers"
            short.append(f"{term.what} is in {unit}, asked is {term.operator} {_asked(term)}")
        elif math.isnan(has):
            unknown.append(f"{term.what} is not stated")
        elif not _meets(term, has, channel):
            short.append(f"{term.what} is {_shown(term, has, channel)}, asked is {term.operator} {_asked(term)}")
        elif term.what == "uncertainty" and now is not None and channel.overdue(now):
            short.append(f"its calibration was due on {channel.due:%Y-%m-%d}")
    if short:
        return Fit(channel.number, channel.name, "failed", _sentence(short + unknown))
    if unknown:
        return Fit(channel.number, channel.name, "skipped", _sentence(unknown))
    shown = (f"{term.what} {_shown(term, _has(term, channel), channel)}" for term in requirement.terms)
    return Fit(channel.number, channel.name, "passed", ", ".join(dict.fromkeys(shown)) + ".")


def _sentence(parts: Iterable[str]) -> str:
    """Join half sentences and whole ones into one."""
    return f"{'; '.join(part.removesuffix('.') for part in parts)}."


def _has(term: Term, channel: Channel) -> float:
    """Return a channel's value, in SI units (a rate in Hz, an uncertainty in % as a share of the range)."""
    width = channel.high - channel.low
    match term.what:
        case "rate":
            return 1 / channel.period if channel.period > 0 else math.nan
        case "uncertainty":
            stated = channel.stated_uncertainty
            if not _relative(term):
                return stated
            return stated / width if 0 < width < math.inf else math.nan
        case "range":
            return width
        case "low":
            return channel.low
        case "high":
            return channel.high
        case _:
            return channel.high if term.upward else channel.low


def _is_in_its_unit(term: Term, channel: Channel) -> bool:
    """Return True if a bound is in a unit of the channel's kind; a number without a unit is in SI."""
    if term.what == "rate" or _relative(term) or term.unit.text == _UNITLESS:
        return True
    return term.unit.units == channel.units


def _meets(term: Term, has: float, channel: Channel) -> bool:
    if term.what in QUANTITIES and term.upward and _every_angle(channel):
        return True
    difference = term.what in ("range", "uncertainty")
    asked = term.unit.difference_to_si(term.value) if difference else term.unit.to_si(term.value)
    slack = ROUNDING * max(abs(has), abs(asked))
    # A range reaches down to a value if its low end is not above it; other bounds are compared as written.
    match term.operator:
        case ">=":
            return has >= asked - slack
        case "<=":
            return has <= asked + slack
        case ">":
            return has > asked + slack
        case _:
            return has < asked - slack


def _every_angle(channel: Channel) -> bool:
    """Return True if a channel covers a full turn, which reaches every angle."""
    return channel.units == NAMED["rad"] and channel.high - channel.low >= 2 * math.pi * (1 - ROUNDING)


def _shown(term: Term, has: float, channel: Channel) -> str:
    if term.what == "rate":
        return f"{has:.6g} Hz"
    if term.what == "uncertainty" and _relative(term):
        return f"{100 * has:.3g} %"
    return channel.show(has, difference=term.what in ("range", "uncertainty"))


def _asked(term: Term) -> str:
    return f"{term.value:g} {'' if term.unit.text == _UNITLESS else term.unit.text}".strip()


def _relative(term: Term) -> bool:
    return term.unit.units.interpretation == RATIO and term.what == "uncertainty"


def _term(text: str) -> Term:
    match = _TERM.match(text)
    if match is None:
        raise BadDataError(
            f'"{text.strip()[:60]}" is no bound.', hint='Write a name, one of >= <= > <, and a value: "rate >= 1 kHz".'
        )
    name = match[1].strip().lower().replace(" ", "-").replace("_", "-")
    if name not in _PROPERTIES and name not in QUANTITIES:
        near = get_close_matches(name[:64], [*_PROPERTIES, *QUANTITIES], n=1, cutoff=0.6)
        raise BadDataError(
            f'"{name}" is no quantity that is known here.',
            hint=f'Did you mean "{near[0]}"?' if near else f"Known are {', '.join([*_PROPERTIES, *QUANTITIES])}.",
        )
    value = float(match[3])
    if not math.isfinite(value):
        raise BadDataError(f'"{match[3]}" in "{text.strip()[:60]}" is too large.')
    unit = parse_unit((match[4] or _UNITLESS).strip())
    return Term(name, match[2], value, unit)


def _with_fitting_units(requirement: Requirement) -> Requirement:
    """Check that the unit of every term is one of what it bounds."""
    for term in requirement.terms:
        units = term.unit.units
        if term.what == "rate":
            fits = units == _HERTZ
        elif term.what == "uncertainty" and units.interpretation == RATIO and units == Units(RATIO):
            fits = True
        elif requirement.quantity:
            fits = units == QUANTITIES[requirement.quantity]
        else:
            fits = True
        if not fits:
            asked = "1/s" if term.what == "rate" else format_units(QUANTITIES[requirement.quantity])
            raise BadDataError(
                f'"{term.text}": the unit {term.unit.text or _UNITLESS} does not measure this.',
                hint=f"Write it in {asked}, or in another unit of the same kind.",
            )
    return requirement


def _table(name: str, table: object, file: str) -> Requirement:
    if not isinstance(table, dict) or not table:
        raise BadDataError(f"{file}: [{name[:40]}] is no table of bounds.", hint='[angle] with range = ">= 360 deg"')
    key = name.strip().lower().replace(" ", "-").replace("_", "-")
    quantity = key if key in QUANTITIES else ""
    try:
        terms = tuple(_entry(what, value, quantity) for what, value in table.items())
        return _with_fitting_units(Requirement(terms, quantity, "" if quantity else name))
    except BadDataError as error:
        raise BadDataError(f"{file}: [{name[:40]}]: {error.message}", hint=error.hint) from error


def _entry(what: str, value: object, quantity: str) -> Term:
    if not isinstance(value, str):
        raise BadDataError(f'the bound of {what[:40]} is a text such as ">= 360 deg".')
    check_size(len(value.encode()), LIMITS.expression, f"the bound of {what[:40]}")
    known = (*_PROPERTIES, quantity) if quantity else _PROPERTIES
    if what not in known:
        near = ", ".join(known)
        raise BadDataError(f'there is no bound "{what[:40]}".', hint=f"Known are {near}.")
    text = value if value.strip()[:1] in "<>" and value.strip() else f"{'<=' if what in _DOWN else '>='} {value}"
    return _term(f"{what} {text}")


_DOWN: Final = ("uncertainty", "low")
