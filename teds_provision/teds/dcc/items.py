"""Chooses the result of a certificate that calibrates a channel, and makes the calibration.

A certificate may hold several results that could be meant: two quantities, the state as found beside the state as left.
An item is one of them. Items that fit a channel are found by unit; if more than one fits, the caller chooses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from teds_provision.errors import BadDataError, UsageError
from teds_provision.limits import LIMITS, check_count
from teds_provision.sanitize import counted
from teds_provision.teds.calibration.order import CalibrationOrder
from teds_provision.teds.certificate import CertificateChoice
from teds_provision.teds.codec.model import Units
from teds_provision.teds.dcc.read import DigitalCertificate, Quantity, ResultTable
from teds_provision.teds.profile.model import ChannelProfile
from teds_provision.teds.units import RATIO, WrittenUnit, name_of_units

_REFERENCE: Final = ("referencevalue",)
_INDICATED: Final = ("measuredvalue", "indicatedvalue", "indication")
_ERROR: Final = ("measurementerror", "error", "deviation")
_ASIDE: Final = ("nominalvalue", "calibrationvalue", "correction", "uncertainty", "residual", "fittedvalue")
_FLOATS: Final = (1, 2)
_NO_INDICATION: Final = "nothing states which raw number gives an indication"


class UnclearItemError(UsageError):
    """Several results of a certificate fit a channel, and none was chosen; ``items`` are those that fit."""

    code = "unclear-item"

    def __init__(self, message: str, items: Sequence[CertificateItem], *, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.items = tuple(items)


@dataclass(frozen=True)
class CertificateItem:
    """A result that can calibrate a channel: points of ``indicated`` and ``reference``, or ``coefficients``."""

    id: str
    table: ResultTable
    reference: Quantity
    indicated: Quantity | None = None
    coefficients: tuple[Quantity, ...] = ()

    @property
    def title(self) -> str:
        """Return the item for people: name, state, content."""
        state = f", {self.table.state}" if self.table.state else ""
        name = self.table.name or "(no name)"
        if self.indicated is None:
            return f"{name}{state}: coefficients, {_unit_name(self.reference.unit)}"
        of = f"{_named(self.indicated)} and {_named(self.reference)}"
        return f"{name}{state}: {counted(len(self.reference.values), 'point')}, {of}"

    def to_json(self) -> dict[str, object]:
        """Return the item as ``show`` gives it."""
        return {
            "id": self.id,
            "name": self.table.name,
            "state": self.table.state or None,
            "unit": self.reference.unit.text,
            "indicated_unit": self.indicated.unit.text if self.indicated is not None else None,
            "points": [list(pair) for pair in zip(self.indicated.values, self.reference.values, strict=True)]
            if self.indicated is not None
            else None,
            "coefficients": [value for quantity in self.coefficients for value in quantity.values] or None,
            "uncertainty": _largest_uncertainty(self.table, self.reference.unit),
        }


def items_of(certificate: DigitalCertificate) -> list[CertificateItem]:
    """Return every result that could calibrate a channel of some unit."""
    return [item for table in certificate.tables for item in _items(table)]


def _items(table: ResultTable) -> list[CertificateItem]:
    pairs = list(_pairs(table))
    if not pairs:
        return list(_of_coefficients(table))
    many = len(pairs) > 1
    return [
        CertificateItem(f"{table.id}.{number}" if many else table.id, table, reference, indicated)
        for number, (indicated, reference) in enumerate(pairs, 1)
    ]


def _pairs(table: ResultTable) -> Iterator[tuple[Quantity, Quantity]]:
    """Yield columns that can be indication and reference value: by their reference types, else any two."""
    columns = [q for q in table.quantities if len(q.values) > 1 and not q.has_role(*_ERROR, *_ASIDE)]
    references = [column for column in columns if column.has_role(*_REFERENCE)]
    indicated = [column for column in columns if column.has_role(*_INDICATED)]
    unnamed = [column for column in columns if column not in references and column not in indicated]
    firsts, seconds = references or unnamed, indicated or unnamed
    check_count(len(firsts) * len(seconds), LIMITS.certificate_pairs, "pairs of columns in a table of the certificate")
    for reference in firsts:
        for other in seconds:
            if other is not reference and len(other.values) == len(reference.values):
                yield other, reference


def _of_coefficients(table: ResultTable) -> Iterator[CertificateItem]:
    """Yield coefficients of a polynomial of the raw number: a list c0, c1 …, or slope and intercept."""
    for quantity in table.quantities:
        if quantity.has_role("coefficients"):
            yield CertificateItem(table.id, table, quantity, coefficients=(quantity,))
            return
    named = {role: next((q for q in table.quantities if q.has_role(role)), None) for role in ("intercept", "slope")}
    intercept, slope = named["intercept"], named["slope"]
    if slope is not None and intercept is not None and len(slope.values) == len(intercept.values) == 1:
        yield CertificateItem(table.id, table, intercept, coefficients=(intercept, slope))


def chosen_item(certificate: DigitalCertificate, channel: ChannelProfile, choice: CertificateChoice) -> CertificateItem:
    """Return the item that calibrates a channel.

    Raises UnclearItemError (several fit), UsageError (there is no such item), BadDataError (none fits).
    """
    every = items_of(certificate)
    if choice.item is not None:
        named = [item for item in every if choice.item in (item.id, item.table.id)]
        if not named:
            raise UsageError(
                f"{certificate.file} has no item {choice.item[:60]!r}.",
                hint=f"It has: {_listed(every)}. See: teds-provision show {certificate.file}",
            )
        every = named
    misfits = {item.id: _misfit(item, channel) for item in every}
    fitting = [item for item in every if not misfits[item.id]]
    if len(fitting) == 1:
        return fitting[0]
    if not fitting:
        raise _nothing_fits(certificate, channel, every, misfits)
    if choice.choose is not None:
        question = f"{certificate.file} has {len(fitting)} results for channel {channel.number}"
        wanted = choice.choose(question, [(item.id, item.title) for item in fitting])
        return next(item for item in fitting if item.id == wanted)
    raise UnclearItemError(
        f"{len(fitting)} results of {certificate.file} fit channel {channel.number}: {_listed(fitting)}.",
        fitting,
        hint=f"Choose one: --item ID. See: teds-provision show {certificate.file}",
    )


def _nothing_fits(
    certificate: DigitalCertificate, channel: ChannelProfile, every: Sequence[CertificateItem], why: dict[str, str]
) -> BadDataError:
    if not every:
        return BadDataError(
            f"{certificate.file} holds no table of indications and reference values, and no coefficients.",
            hint="Reference types like basic_measuredValue and basic_referenceValue name the columns of a table.",
        )
    reasons = "; ".join(f"{item.id}: {why[item.id]}" for item in every[:4])
    unit = channel.unit.text or name_of_units(channel.units)
    hint = f"See: teds-provision show {certificate.file}"
    if _NO_INDICATION in why.values():
        hint = (
            f"Say it in the profile, in {unit}: [channel.{channel.number}.calibration] indication = [slope, intercept]"
        )
    return BadDataError(
        f"No result of {certificate.file} fits channel {channel.number} ({unit}): {reasons}.", hint=hint
    )


def _listed(items: Sequence[CertificateItem]) -> str:
    return ", ".join(f"{item.id} ({item.title})" for item in items[:6]) or "none"


def _misfit(item: CertificateItem, channel: ChannelProfile) -> str:
    """Return why an item cannot calibrate a channel; "" if it can."""
    if not _same_kind(item.reference.unit, channel.units):
        return f"its values are in {_unit_name(item.reference.unit)}"
    if item.indicated is None:
        wrong = [part for part in item.coefficients if not _same_kind(part.unit, channel.units)]
        return "its coefficients are not those of a raw number" if wrong else ""
    if _is_raw(item.indicated, channel):
        return ""
    if not _same_kind(item.indicated.unit, channel.units):
        return f"it relates the values to {_unit_name(item.indicated.unit)}, not to raw numbers"
    return "" if _is_float(channel) or channel.calibration.indication else _NO_INDICATION


def _is_raw(quantity: Quantity, channel: ChannelProfile) -> bool:
    """Return True if indications are raw numbers; of a channel without a unit only by their reference type."""
    if not _is_plain(quantity.unit):
        return False
    return _names_raw(quantity) or not (_is_plain(channel.unit) or channel.units.interpretation == RATIO)


def _names_raw(quantity: Quantity) -> bool:
    """Return True if a quantity is one of raw numbers by its reference type."""
    return _is_plain(quantity.unit) and quantity.has_role("rawvalue")


def _is_float(channel: ChannelProfile) -> bool:
    """Return True if the raw number is a value in SI units itself."""
    sample = channel.fields.get("Sample")
    return isinstance(sample, dict) and sample.get("DatModel") in _FLOATS


def _is_plain(unit: WrittenUnit) -> bool:
    return unit.units == Units()


def _same_kind(unit: WrittenUnit, units: Units) -> bool:
    """Return True if values in a unit can be those of a channel; a plain number may be a ratio of anything."""
    if unit.units == units:
        return True
    return _is_plain(unit) and units.interpretation == RATIO


def _unit_name(unit: WrittenUnit) -> str:
    return "plain numbers" if _is_plain(unit) and unit.scale == 1 else unit.text


def _named(quantity: Quantity) -> str:
    return f"{quantity.name or quantity.id or 'values'} [{_unit_name(quantity.unit)}]"


def order_of(certificate: DigitalCertificate, item: CertificateItem, channel: ChannelProfile) -> CalibrationOrder:
    """Return what an item asks for, in the unit of the channel; the uncertainty is a standard one."""
    order = CalibrationOrder(certificate.file, item.table.line)
    line = item.table.line
    order.values |= {
        "date": (certificate.calibrated.isoformat(), line),
        "by": (certificate.laboratory, line),
    }
    if item.indicated is None:
        order.values["coefficients"] = (_coefficients(item, channel), line)
        uncertainty = _largest_uncertainty(item.table, channel.unit)
    else:
        of, is_raw = item.indicated.unit, _is_raw(item.indicated, channel)
        raw = [_raw(value, of, channel, is_raw=is_raw) for value in item.indicated.values]
        values = [_converted(value, item.reference.unit, channel.unit) for value in item.reference.values]
        points = sorted(zip(raw, values, strict=True))
        order.values["points"] = ([list(point) for point in points], line)
        uncertainty = _uncertainty(item, channel, points)
    if uncertainty:
        order.values["uncertainty"] = (uncertainty, line)
    return order


def _raw(value: float, unit: WrittenUnit, channel: ChannelProfile, *, is_raw: bool) -> float:
    """Return the raw number of an indication: a plain number itself, a value by the profile or as a float channel."""
    indication = channel.calibration.indication
    if is_raw or indication is None:
        return value if unit.scale == 1 and unit.offset == 0 else unit.to_si(value)
    slope, intercept = indication
    return (_converted(value, unit, channel.unit) - intercept) / slope


def _converted(value: float, unit: WrittenUnit, to: WrittenUnit) -> float:
    """Return a value in another unit of the same kind; unchanged, to the last digit, in an equal one."""
    if (unit.scale, unit.offset) == (to.scale, to.offset):
        return value
    return to.from_si(unit.to_si(value))


def _difference(value: float, unit: WrittenUnit, to: WrittenUnit) -> float:
    return value if unit.scale == to.scale else to.difference_from_si(unit.difference_to_si(value))


def _coefficients(item: CertificateItem, channel: ChannelProfile) -> list[float]:
    values = [(value, part.unit) for part in item.coefficients for value in part.values]
    (first, unit), *rest = values
    return [_converted(first, unit, channel.unit), *(value * of.scale / channel.unit.scale for value, of in rest)]


def _uncertainty(item: CertificateItem, channel: ChannelProfile, points: Sequence[tuple[float, float]]) -> float | None:
    """Return the largest standard uncertainty that the table states, in the unit of the channel.

    One of the indication counts with the steepest part of the curve, if the indication is a raw number.
    """
    found = [_largest_uncertainty(item.table, channel.unit)]
    indicated = item.indicated
    if indicated is not None and indicated.standard_uncertainty and _is_raw(indicated, channel):
        steps = [(after[0] - before[0], after[1] - before[1]) for before, after in pairwise(points)]
        slopes = [abs(rise / run) for run, rise in steps if run > 0]
        found.append(indicated.standard_uncertainty * indicated.unit.scale * max(slopes, default=0.0))
    return max((value for value in found if value), default=None)


def _largest_uncertainty(table: ResultTable, unit: WrittenUnit) -> float | None:
    """Return the largest standard uncertainty of the quantities of one kind in a table, in this unit.

    One of raw numbers is of another kind, also where the unit is a plain number itself.
    """
    stated = [
        _difference(quantity.standard_uncertainty, quantity.unit, unit)
        for quantity in table.quantities
        if quantity.standard_uncertainty and _same_kind(quantity.unit, unit.units) and not _names_raw(quantity)
    ]
    return max(stated, default=None)
