"""A fit of ours as a certificate: DCC 3.2.1 with D-SI 2.1, which states only what file, fit and laboratory state.

A missing fact is written as ``not stated``; the schema demands a name there. It is not signed.
"""

from __future__ import annotations

import hashlib
import re
import xml.etree.ElementTree as ET  # writing only
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from datetime import date
from difflib import get_close_matches
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.limits import load_toml
from teds_provision.teds.calibration.formula import residuals, sentence
from teds_provision.teds.calibration.model import Calibration
from teds_provision.teds.dcc.si_units import write_si_unit
from teds_provision.teds.dcc.xml_tree import DCC, SI
from teds_provision.teds.units import WrittenUnit, parse_unit

VERSION: Final = "3.2.1"
NOT_STATED: Final = "not stated"
UNKNOWN_COUNTRY: Final = "ZZ"
"""ISO 3166-1 leaves this code to its users: no country was stated."""
_VERSION: Final = re.compile(r"[0-9]{1,3}(?:\.[0-9]{1,3}){0,3}")
_REFERENCE: Final = "basic_referenceValue"
_INDICATED: Final = "basic_measuredValue teds_rawValue"
_FITTED: Final = "teds_fittedValue"
_RESIDUAL: Final = "teds_residual"


@dataclass(frozen=True)
class QuantityCondition:
    """A number that describes the circumstances of a calibration."""

    name: str
    value: float
    unit: WrittenUnit


@dataclass(frozen=True)
class Laboratory:
    """Facts about the calibration from the file of ``--laboratory``; "" for those that it lacks."""

    laboratory: str = ""
    country: str = ""
    city: str = ""
    street: str = ""
    postcode: str = ""
    email: str = ""
    phone: str = ""
    person: str = ""
    customer: str = ""
    certificate: str = ""
    device: str = ""
    manufacturer: str = ""
    model: str = ""
    serial: str = ""
    coverage_factor: float = 2.0
    conditions: tuple[QuantityCondition, ...] = ()

    @property
    def missing(self) -> tuple[str, ...]:
        """Keys without which a certificate states too little."""
        wanted = ("laboratory", "country", "person", "customer", "certificate")
        return tuple(key for key in wanted if not getattr(self, key))


def read_laboratory(text: str, file: str) -> Laboratory:
    """Read a file of ``--laboratory``; raises BadDataError naming the key."""
    data = load_toml(text, file)
    texts = {field.name.replace("_", "-"): field.name for field in fields(Laboratory) if field.type == "str"}
    known = [*texts, "coverage-factor", "condition"]
    values: dict[str, object] = {}
    for key, value in data.items():
        if key in texts:
            if not isinstance(value, str) or not value.strip() or not value.isprintable():
                raise BadDataError(f"{file}: {key}: a text of one line is expected.")
            values[texts[key]] = " ".join(value.split())
        elif key == "coverage-factor":
            if type(value) not in (int, float) or not 1 <= value <= 10:
                raise BadDataError(f"{file}: {key}: a number from 1 to 10 is expected.")
            values["coverage_factor"] = float(value)
        elif key == "condition":
            values["conditions"] = _conditions(value, file)
        else:
            near = get_close_matches(key[:64], known, n=1)
            guess = f' Did you mean "{near[0]}"?' if near else f" Known are: {', '.join(known)}."
            raise BadDataError(f"{file}: {key[:64]}: there is no such key.{guess}")
    country = values.get("country")
    if isinstance(country, str) and not (len(country) == 2 and country.isascii() and country.isupper()):
        raise BadDataError(f'{file}: country: a code of ISO 3166-1 is expected, like "AT".')
    return Laboratory(**values)  # type: ignore[arg-type]


def _conditions(value: object, file: str) -> tuple[QuantityCondition, ...]:
    rows = value if isinstance(value, list) else []
    found = []
    for row in rows:
        cells = row if isinstance(row, dict) and set(row) == {"name", "value", "unit"} else {}
        name, number, unit = cells.get("name"), cells.get("value"), cells.get("unit")
        if not isinstance(name, str) or not isinstance(number, int | float) or not isinstance(unit, str):
            raise BadDataError(f"{file}: condition: name, value and unit are expected, the value a number.")
        found.append(QuantityCondition(name, float(number), parse_unit(unit)))
    if not found:
        raise BadDataError(f"{file}: condition: tables [[condition]] with name, value and unit are expected.")
    return tuple(found)


def write_certificate(
    fitted: Mapping[int, Calibration], laboratory: Laboratory, *, node: str, software: str, source: bytes, today: date
) -> str:
    """Return the certificate of fitted points as XML.

    ``node`` is the UUID that the points are of, "" if they name none; ``software`` our version; ``source`` the file of
    points, whose digest makes a number if the laboratory gave none. Raises BadDataError if a calibration has no points.
    """
    dates = [calibration.date.date() for calibration in fitted.values() if calibration.date is not None]
    performed = max(dates, default=today)
    root = ET.Element("dcc:digitalCalibrationCertificate")
    root.attrib |= {"xmlns:dcc": DCC, "xmlns:si": SI, "schemaVersion": VERSION}
    data = ET.SubElement(root, "dcc:administrativeData")
    used = ET.SubElement(ET.SubElement(data, "dcc:dccSoftware"), "dcc:software")
    _name(used, "teds-provision")
    _text(used, "dcc:release", _release(software))
    _core(data, laboratory, performed, today, hashlib.sha256(source).hexdigest())
    _item(data, laboratory, node)
    _contact(ET.SubElement(data, "dcc:calibrationLaboratory"), "dcc:contact", laboratory.laboratory, laboratory)
    responsible = ET.SubElement(ET.SubElement(data, "dcc:respPersons"), "dcc:respPerson")
    _name(ET.SubElement(responsible, "dcc:person"), laboratory.person or NOT_STATED)
    _text(responsible, "dcc:mainSigner", "true")
    _contact(data, "dcc:customer", laboratory.customer, None)
    results = ET.SubElement(root, "dcc:measurementResults")
    for number, calibration in sorted(fitted.items()):
        _result(results, number, calibration, laboratory)
    ET.indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _core(data: ET.Element, laboratory: Laboratory, performed: date, today: date, digest: str) -> None:
    core = ET.SubElement(data, "dcc:coreData")
    _text(core, "dcc:countryCodeISO3166_1", laboratory.country or UNKNOWN_COUNTRY)
    _text(core, "dcc:usedLangCodeISO639_1", "en")
    _text(core, "dcc:mandatoryLangCodeISO639_1", "en")
    _text(core, "dcc:uniqueIdentifier", laboratory.certificate or f"teds-provision-{performed}-{digest[:16]}")
    _text(core, "dcc:beginPerformanceDate", performed.isoformat())
    _text(core, "dcc:endPerformanceDate", performed.isoformat())
    _text(core, "dcc:performanceLocation", "laboratory")
    _text(core, "dcc:issueDate", today.isoformat())


def _item(data: ET.Element, laboratory: Laboratory, node: str) -> None:
    item = ET.SubElement(ET.SubElement(data, "dcc:items"), "dcc:item")
    _name(item, laboratory.device or "smart transducer")
    _name(ET.SubElement(item, "dcc:manufacturer"), laboratory.manufacturer or NOT_STATED)
    _text(item, "dcc:model", laboratory.model or NOT_STATED)
    known = ET.SubElement(item, "dcc:identifications")
    if laboratory.serial:
        _identification(known, "manufacturer", laboratory.serial, "serial number")
    if node or not laboratory.serial:
        _identification(known, "other", node or NOT_STATED, "UUID of the node (IEEE 1451.0)")


def _identification(known: ET.Element, issuer: str, value: str, name: str) -> None:
    one = ET.SubElement(known, "dcc:identification")
    _text(one, "dcc:issuer", issuer)
    _text(one, "dcc:value", value)
    _name(one, name)


def _contact(parent: ET.Element, tag: str, name: str, laboratory: Laboratory | None) -> None:
    contact = ET.SubElement(parent, tag)
    _name(contact, name or NOT_STATED)
    if laboratory is not None and laboratory.email:
        _text(contact, "dcc:eMail", laboratory.email)
    if laboratory is not None and laboratory.phone:
        _text(contact, "dcc:phone", laboratory.phone)
    location = ET.SubElement(contact, "dcc:location")
    if laboratory is None:
        _text(ET.SubElement(location, "dcc:further"), "dcc:content", NOT_STATED)
        return
    for tag_of, text in (
        ("dcc:city", laboratory.city),
        ("dcc:countryCode", laboratory.country or UNKNOWN_COUNTRY),
        ("dcc:postCode", laboratory.postcode),
        ("dcc:street", laboratory.street),
    ):
        if text:
            _text(location, tag_of, text)


def _result(results: ET.Element, number: int, calibration: Calibration, laboratory: Laboratory) -> None:
    found = residuals(calibration)
    if found is None:
        raise BadDataError(f"The calibration of channel {number} has no points to certify.")
    measured = ET.SubElement(results, "dcc:measurementResult")
    _name(measured, f"Calibration of channel {number}")
    used = ET.SubElement(ET.SubElement(measured, "dcc:usedMethods"), "dcc:usedMethod")
    _name(used, "Fit of the curve")
    _text(
        ET.SubElement(used, "dcc:description"),
        "dcc:content",
        f"{sentence(calibration)}. {_formula(calibration)}".strip(),
    )
    if laboratory.conditions:
        _write_conditions(measured, laboratory.conditions)
    result = ET.SubElement(ET.SubElement(measured, "dcc:results"), "dcc:result")
    _name(result, f"Points of channel {number}")
    data = ET.SubElement(
        result, "dcc:data", {"refId": f"channel-{number}"}
    )  # PTB's rules require that each id is referenced
    table = ET.SubElement(data, "dcc:list", {"id": f"channel-{number}"})
    unit = calibration.unit
    uncertainty = calibration.uncertainty
    expanded = None if uncertainty is None else uncertainty * laboratory.coverage_factor
    references = found.references
    _column(table, "Raw value", _INDICATED, [float(value) for value in found.inputs], parse_unit("1"))
    _column(table, "Reference value", _REFERENCE, references, unit, expanded, laboratory.coverage_factor)
    _column(table, "Value of the fitted curve", _FITTED, found.curve, unit)
    _column(table, "Reference value less fitted curve", _RESIDUAL, found.differences, unit, difference=True)


def _formula(calibration: Calibration) -> str:
    """Return the coefficients of a curve of one segment, as text; "" for a table."""
    part = calibration.inputs[0]
    if len(calibration.inputs) != 1 or part.segments != 1:
        return ""
    terms = ", ".join(f"c{power} = {value:.9g}" for power, value in enumerate(calibration.coefficients))
    about = f"x - {part.offsets[0]:.9g}" if part.offsets[0] else "x"
    return f"y = sum of c_i ({about})^i in {calibration.unit.text}, x the raw value: {terms}."


def _write_conditions(measured: ET.Element, conditions: Sequence[QuantityCondition]) -> None:
    holder = ET.SubElement(measured, "dcc:influenceConditions")
    for condition in conditions:
        one = ET.SubElement(holder, "dcc:influenceCondition")
        _name(one, condition.name)
        quantity = ET.SubElement(ET.SubElement(one, "dcc:data"), "dcc:quantity")
        name, scale, offset = write_si_unit(condition.unit)
        real = ET.SubElement(quantity, "si:real")
        _text(real, "si:value", _number(condition.value * scale + offset))
        _text(real, "si:unit", name)


def _column(
    table: ET.Element,
    name: str,
    ref_type: str,
    values: Sequence[float],
    unit: WrittenUnit,
    expanded: float | None = None,
    factor: float = 2.0,
    *,
    difference: bool = False,
) -> None:
    quantity = ET.SubElement(table, "dcc:quantity", {"refType": ref_type})
    _name(quantity, name)
    listed = ET.SubElement(quantity, "si:realListXMLList")
    written, scale, offset = write_si_unit(unit)
    if difference:
        offset = 0.0
        written = r"\kelvin" if written == r"\degreecelsius" else written
    _text(listed, "si:valueXMLList", " ".join(_number(float(value) * scale + offset) for value in values))
    _text(listed, "si:unitXMLList", written)
    if expanded is not None:
        stated = ET.SubElement(listed, "si:expandedUncXMLList")
        _text(stated, "si:uncertaintyXMLList", f"{expanded * abs(scale):.6g}")
        _text(stated, "si:coverageFactorXMLList", _number(factor))
        _text(stated, "si:coverageProbabilityXMLList", "0.95")


def _release(version: str) -> str:
    """Return ``v0.1.0`` for ``0.1.0.dev3``: the form that PTB's rules ask for."""
    found = _VERSION.match(version)
    return f"v{found[0]}" if found is not None else "v0"


def _number(value: float) -> str:
    """Return a number as D-SI writes it, with all its digits; a whole number without a point."""
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else repr(value)


def _name(parent: ET.Element, text: str) -> None:
    _text(ET.SubElement(parent, "dcc:name"), "dcc:content", text)


def _text(parent: ET.Element, tag: str, text: str) -> None:
    ET.SubElement(parent, tag).text = text
