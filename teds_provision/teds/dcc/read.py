"""A calibration certificate as typed values: number, laboratory, device, conditions and the tables of its results.

The structure is checked here, element by element, as far as it is read: what a calibration needs must be present and
unambiguous, and numbers must be numbers. The rest of a certificate (comments, documents, statements) is passed over.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.limits import LIMITS, check_count
from teds_provision.teds.dcc.si_units import parse_si_unit
from teds_provision.teds.dcc.xml_tree import ROOT, Node, XmlElement, parse_xml
from teds_provision.teds.units import WrittenUnit

_VERSION: Final = re.compile(r"3\.[0-9]{1,3}\.[0-9]{1,3}")
_NUMBER: Final = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]{1,4})?")
_DIGITS: Final = 64
_DATE: Final = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}")
_TEXT: Final = 200
_STATES: Final = {
    "beforeAdjustment": "as found",
    "afterAdjustment": "as left",
    "beforeRepair": "before repair",
    "afterRepair": "after repair",
}
TRIED: Final = ("3.2.", "3.3.")
"""Versions of the schema that are known to be read; other ones of 3.x are read with a warning."""


@dataclass(frozen=True)
class Quantity:
    """Numbers with a unit; ``uncertainties`` are standard ones in that unit, one for each value or one for all.

    ``coverage`` are the factors k that the certificate states for its expanded uncertainties, None if it states
    standard ones.
    """

    name: str
    ref_types: tuple[str, ...]
    values: tuple[float, ...]
    unit: WrittenUnit
    uncertainties: tuple[float, ...] | None = None
    coverage: tuple[float, ...] | None = None
    id: str = ""
    line: int = 1

    def has_role(self, *words: str) -> bool:
        """Return True if a reference type ends in one of these words, in any namespace: ``basic_referenceValue``."""
        return any(ref.rpartition("_")[2].lower() in words for ref in self.ref_types)

    @property
    def standard_uncertainty(self) -> float | None:
        """Largest standard uncertainty, None if none is stated."""
        return max(self.uncertainties) if self.uncertainties else None


@dataclass(frozen=True)
class ResultTable:
    """A list of quantities with as many values each; ``state`` is ``as found``, ``as left`` or "" ."""

    id: str
    name: str
    state: str
    quantities: tuple[Quantity, ...]
    line: int


@dataclass(frozen=True)
class Condition:
    """A condition during the calibration, as text with its unit."""

    name: str
    text: str


@dataclass(frozen=True)
class Device:
    """A calibrated device; ``identifications`` are (issuer, value)."""

    name: str
    manufacturer: str
    model: str
    identifications: tuple[tuple[str, str], ...]

    @property
    def serial(self) -> str:
        """The manufacturer's identification, "" without one."""
        return next((value for issuer, value in self.identifications if issuer == "manufacturer"), "")


@dataclass(frozen=True)
class DigitalCertificate:
    """A certificate; ``sha256`` is that of the file, ``calibrated`` the last day of the calibration."""

    file: str
    sha256: str
    schema_version: str
    number: str
    calibrated: date
    issued: date | None
    country: str
    laboratory: str
    devices: tuple[Device, ...]
    conditions: tuple[Condition, ...]
    methods: tuple[str, ...]
    tables: tuple[ResultTable, ...]
    signed: bool
    warnings: tuple[str, ...] = ()
    signature: str = field(default="not checked")
    unchecked: tuple[str, ...] = ()


def read_certificate(octets: bytes, file: str) -> DigitalCertificate:
    """Read a certificate without judging its signature; raises BadDataError with file, line and element."""
    return certificate_of(parse_xml(octets, file), octets, file)


def certificate_of(element: XmlElement, octets: bytes, file: str) -> DigitalCertificate:
    """Read the tree of a certificate; ``octets`` are those of the file, for the digest."""
    if element.tag != ROOT:
        raise BadDataError(
            f"{file}: this XML is no calibration certificate: its root is {str(element.tag)[:_TEXT]!r}.",
            hint="A DCC begins with dcc:digitalCalibrationCertificate.",
        )
    root = Node(element, file)
    version = (element.get("schemaVersion") or "").strip()
    if not _VERSION.fullmatch(version):
        raise BadDataError(f"{file}: schemaVersion {version[:20]!r} is not known; DCC 3.x is read.")
    data = root.child("dcc:administrativeData")
    core = data.child("dcc:coreData")
    results = root.child("dcc:measurementResults").children_named("dcc:measurementResult")
    if not results:
        raise root.wrong("it holds no measurement results.")
    language = next((node.text for node in core.children_named("dcc:usedLangCodeISO639_1") if node.text == "en"), None)
    reader = _Reader(language or core.child("dcc:mandatoryLangCodeISO639_1").text)
    contact = data.child("dcc:calibrationLaboratory").child("dcc:contact")
    issued = core.optional_child("dcc:issueDate")
    begun, ended = _day(core.child("dcc:beginPerformanceDate")), _day(core.child("dcc:endPerformanceDate"))
    if ended < begun:
        raise core.wrong("the calibration ends before it begins.")
    tables = [table for result in results for table in reader.tables(result)]
    check_count(len(tables), LIMITS.certificate_tables, f"tables in {file}")
    return DigitalCertificate(
        file=file,
        sha256=hashlib.sha256(octets).hexdigest(),
        schema_version=version,
        number=_bounded(core.child("dcc:uniqueIdentifier")),
        calibrated=ended,
        issued=_day(issued) if issued is not None else None,
        country=core.child("dcc:countryCodeISO3166_1").required_text()[:2],
        laboratory=reader.name(contact, required=True),
        devices=tuple(reader.device(item) for item in data.child("dcc:items").children_named("dcc:item")),
        conditions=tuple(condition for result in results for condition in reader.conditions(result)),
        methods=tuple(
            reader.name(used) for result in results for used in result.all_of("dcc:usedMethods/dcc:usedMethod")
        ),
        tables=_numbered(tables),
        signed=bool(root.children_named("ds:Signature")),
        warnings=reader.warnings + (() if version.startswith(TRIED) else (_untried(version),)),
    )


def _untried(version: str) -> str:
    return f"The certificate is of DCC {version}; only 3.2 and 3.3 were tried."


def _numbered(tables: Sequence[ResultTable]) -> tuple[ResultTable, ...]:
    """Return the tables; those without an id get their number, which no XML id can be."""
    named = [replace(table, id=table.id or str(number)) for number, table in enumerate(tables, 1)]
    seen: set[str] = set()
    for table in named:
        if table.id in seen:
            raise BadDataError(f"The id {table.id[:_TEXT]!r} appears twice in the certificate.")
        seen.add(table.id)
    return tuple(named)


def _bounded(node: Node) -> str:
    text = node.required_text()
    if len(text) > _TEXT or not text.isprintable():
        raise node.wrong(f"it is not one line of at most {_TEXT} printable characters.")
    return text


def _day(node: Node) -> date:
    text = node.required_text()
    try:
        if not _DATE.fullmatch(text[:10]) or (text[10:] and not re.fullmatch(r"Z|[-+][0-9]{2}:[0-9]{2}", text[10:])):
            raise ValueError(text)
        return date.fromisoformat(text[:10])
    except ValueError as error:
        raise node.wrong(f"a date like 2026-10-31 is expected, not {text[:40]!r}.") from error


class _Reader:
    """Reads the parts of one certificate; of names in several languages, one is chosen."""

    def __init__(self, language: str) -> None:
        self.language = language
        self.warnings: tuple[str, ...] = ()

    def name(self, node: Node, *, required: bool = False) -> str:
        """Return the text of ``dcc:name``: in the language, else without one, else the first."""
        holder = node.child("dcc:name") if required else node.optional_child("dcc:name")
        contents = holder.children_named("dcc:content") if holder is not None else []
        by_language = {content.element.get("lang"): content.text for content in reversed(contents)}
        text = by_language.get(self.language) or by_language.get(None) or next(iter(reversed(by_language.values())), "")
        if required and not text:
            raise node.wrong("its name is empty.")
        return "".join(letter for letter in text if letter.isprintable())[:_TEXT]

    def device(self, item: Node) -> Device:
        """Read one calibrated item."""
        maker, model = item.optional_child("dcc:manufacturer"), item.optional_child("dcc:model")
        return Device(
            self.name(item),
            self.name(maker) if maker is not None else "",
            model.text[:_TEXT] if model is not None else "",
            tuple(
                (known.child("dcc:issuer").text[:_TEXT], known.child("dcc:value").text[:_TEXT])
                for known in item.all_of("dcc:identifications/dcc:identification")
            ),
        )

    def conditions(self, result: Node) -> list[Condition]:
        """Read influence conditions with their numbers; a condition with tables is a result, and not listed here."""
        found = []
        for condition in result.all_of("dcc:influenceConditions/dcc:influenceCondition"):
            quantities = condition.all_of("dcc:data/dcc:quantity")
            numbers = [text for quantity in quantities if (text := self._shown(quantity))]
            if numbers:
                found.append(Condition(self.name(condition), ", ".join(numbers)))
        return found

    def _shown(self, node: Node) -> str:
        try:
            quantity = self.quantity(node)
        except BadDataError:
            return ""
        if quantity is None:
            return ""
        unit = "" if quantity.unit.text in ("", "1") else f" {quantity.unit.text}"
        numbers = " ".join(f"{value:.10g}" for value in quantity.values[:8])
        return f"{numbers}{' …' * (len(quantity.values) > 8)}{unit}"

    def tables(self, result: Node) -> list[ResultTable]:
        """Read tables of the results, and of influence conditions that state what was found before an adjustment."""
        found: list[ResultTable] = []
        for holder in (
            *result.all_of("dcc:influenceConditions/dcc:influenceCondition"),
            *result.child("dcc:results").children_named("dcc:result"),
        ):
            status = holder.optional_child("dcc:status")
            state = _STATES.get(status.text, "") if status is not None else ""
            name = self.name(holder)
            data = holder.child("dcc:data")
            state = state or _state_of(holder)
            lists = data.children_named("dcc:list")
            for table in lists:
                found += self._table(table, name, state or _state_of(table))
            if holder.name == "result" and not lists:
                single = self._quantities(data)
                found += [ResultTable(holder.id, name, state, single, holder.line)] if single else []
        return found

    def _quantities(self, node: Node) -> tuple[Quantity, ...]:
        return tuple(
            known for part in node.children_named("dcc:quantity") if (known := self.quantity(part)) is not None
        )

    def _table(self, node: Node, above: str, state: str) -> list[ResultTable]:
        rows = node.children_named("dcc:list")
        name = self.name(node) or above
        line = node.line
        own = self._quantities(node) or (self._rows(rows) if rows else None)
        table = [ResultTable(node.id, name, state, own, line)] if own else []
        if own and not node.children_named("dcc:quantity"):
            return table
        return table + [inner for row in rows for inner in self._table(row, name, state or _state_of(row))]

    def _rows(self, rows: Sequence[Node]) -> tuple[Quantity, ...] | None:
        """Return the columns of a list of points, each of which is a list of single values in the same order."""
        points = []
        for row in rows:
            if row.children_named("dcc:list"):
                return None
            cells = self._quantities(row)
            if not cells or any(len(cell.values) != 1 for cell in cells):
                return None
            points.append(cells)
        first = points[0]
        for cells in points:
            if [(cell.ref_types, cell.unit) for cell in cells] != [(cell.ref_types, cell.unit) for cell in first]:
                return None
        if len(points) < 2:
            return None
        return tuple(_column([cells[at] for cells in points]) for at in range(len(first)))

    def quantity(self, node: Node) -> Quantity | None:
        """Return the numbers of a ``dcc:quantity``; None for text, complex numbers and other things without points."""
        number = _numeric(node)
        if number is None:
            return None
        if node.optional_child("dcc:relativeUncertainty") is not None:
            text = "A relative uncertainty of the certificate is not read; state it with the calibrated values."
            self.warnings += () if text in self.warnings else (text,)
        values, unit = _values(number)
        uncertainties, coverage = _uncertainties(number, len(values))
        return Quantity(
            self.name(node),
            node.ref_types,
            values,
            unit,
            uncertainties,
            coverage,
            node.id,
            node.line,
        )


def _state_of(node: Node) -> str:
    """Return the state that a reference type names: ``basic_beforeAdjustment``."""
    words = {ref.rpartition("_")[2] for ref in node.ref_types}
    return next((text for word, text in _STATES.items() if word in words), "")


def _column(cells: Sequence[Quantity]) -> Quantity:
    stated = [cell.uncertainties[0] for cell in cells if cell.uncertainties]
    factors = [cell.coverage[0] for cell in cells if cell.coverage]
    return replace(
        cells[0],
        values=tuple(cell.values[0] for cell in cells),
        uncertainties=tuple(stated) if len(stated) == len(cells) else (max(stated),) if stated else None,
        coverage=tuple(factors) if factors else None,
    )


_NUMERIC: Final = ("si:real", "si:realListXMLList", "si:constant")


def _numeric(node: Node) -> Node | None:
    """Return the D-SI element with numbers, of several units side by side one that is known here.

    One with an uncertainty is preferred.
    """
    found = node.children_named(*_NUMERIC, "si:hybrid")
    if len(found) > 1:
        raise node.wrong("it holds two values.")
    if not found or found[0].name != "hybrid":
        return found[0] if found else None
    choices = found[0].children_named(*_NUMERIC)
    known = [choice for choice in choices if _is_readable(choice)]
    if choices and not known:
        _values(choices[0])  # raises the error
    certain = [choice for choice in known if _uncertainties(choice, len(_values(choice)[0]))[0]]
    return next(iter([*certain, *known]), None)


def _is_readable(number: Node) -> bool:
    try:
        _values(number)
    except BadDataError:
        return False
    return True


def _values(number: Node) -> tuple[tuple[float, ...], WrittenUnit]:
    listed = number.name == "realListXMLList"
    values = _numbers(number.child("si:valueXMLList" if listed else "si:value"))
    if not listed and len(values) != 1:
        raise number.wrong(f"one value is expected, not {len(values)}.")
    node = number.child("si:unitXMLList" if listed else "si:unit")
    names = set(node.required_text().split(" "))
    if len(names) != 1:
        raise node.wrong("the values have different units, which is not read.")
    try:
        return values, parse_si_unit(names.pop())
    except BadDataError as error:
        raise node.wrong(error.message) from error


def _numbers(node: Node) -> tuple[float, ...]:
    words = node.required_text().split(" ")
    if len(words) > LIMITS.certificate_values:
        raise node.wrong(f"there are {len(words)} values; at most {LIMITS.certificate_values} are read.")
    out = []
    for word in words:
        if len(word) > _DIGITS or not _NUMBER.fullmatch(word) or not math.isfinite(float(word)):
            raise node.wrong(f"{word[:40]!r} is not a number.")
        out.append(float(word))
    return tuple(out)


# Elements with an uncertainty: path, the name of its numbers, and True if it has a factor k.
_STATED: Final = (
    ("si:expandedUnc", "si:uncertainty", True),
    ("si:coverageInterval", "si:standardUnc", False),
    ("si:measurementUncertaintyUnivariate/si:expandedMU", "si:valueExpandedMU", True),
    ("si:measurementUncertaintyUnivariate/si:standardMU", "si:valueStandardMU", False),
    ("si:measurementUncertaintyUnivariate/si:coverageIntervalMU", "si:valueStandardMU", False),
)


def _uncertainties(number: Node, count: int) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """Return the standard uncertainties, and the factors k of expanded ones: U / k is what a TEDS holds."""
    many = "XMLList" if number.name == "realListXMLList" else ""
    found: list[tuple[Node, str, bool]] = []
    for path, value, expanded in _STATED:
        whole = "/".join(f"{step}{many}" for step in path.split("/"))
        found += [(node, value, expanded) for node in number.all_of(whole)]
    single = number.optional_child("si:valueStandardMU")  # of a constant
    if single is not None:
        return _checked(single, _numbers(single), count), None
    if len(found) > 1:
        raise number.wrong("it states two uncertainties.")
    if not found:
        return None, None
    node, value, expanded = found[0]
    stated = _checked(node, _numbers(node.child(f"{value}{many}")), count)
    if not expanded:
        return stated, None
    factors = _checked(node, _numbers(node.child(f"si:coverageFactor{many}")), count)
    if min(factors) < 1:
        raise node.wrong("a coverage factor is at least 1.")
    length = max(len(stated), len(factors))
    pairs = zip(_repeated(stated, length), _repeated(factors, length), strict=True)
    return tuple(large / factor for large, factor in pairs), factors


def _checked(node: Node, numbers: tuple[float, ...], count: int) -> tuple[float, ...]:
    if len(numbers) not in (1, count):
        raise node.wrong(f"there are {len(numbers)} numbers for {count} values.")
    if min(numbers) < 0:
        raise node.wrong("an uncertainty is not negative.")
    return numbers


def _repeated(numbers: tuple[float, ...], length: int) -> tuple[float, ...]:
    return numbers * length if len(numbers) == 1 else numbers
