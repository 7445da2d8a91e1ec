"""TEDS as XML: the field tree with names, described by ``teds_provision/teds/schema/teds-1.xsd``.

Read with defusedxml: no DTD, no entities, nothing external. The rules of the schema are checked by hand when reading,
so that no XML Schema processor is needed to run; the tests hold both against each other.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET  # writing only; reading goes through defusedxml
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.limits import LIMITS, check_count, check_size, check_xml, whole_number
from teds_provision.teds.codec.model import Edition, TimeInstance, Units
from teds_provision.teds.formats.tree import (
    MAX_DEPTH,
    EntryValue,
    Kind,
    Tree,
    TreeEntry,
    from_tree,
    to_tree,
    units_from_parts,
    units_to_parts,
)
from teds_provision.teds.image import TedsBlock

NAMESPACE: Final = "urn:teds-provision:teds:1"
SCHEMA: Final = Path(__file__).resolve().parent.parent / "schema" / "teds-1.xsd"
"""The XML Schema, a file of the package."""

_HEAD: Final = {
    "channel": ("channel", 0xFFFF),
    "access-code": ("access_code", 0xFF),
    "edition": ("edition", 2024),
    "family": ("family", 0xFF),
    "subfamily": ("subfamily", 0xFF),
    "version": ("version", 0xFF),
    "width": ("width", 0xFF),
}


def write_xml(blocks: Sequence[TedsBlock]) -> str:
    """Write blocks as one XML document; nothing is lost."""
    root = ET.Element("teds-set", {"xmlns": NAMESPACE})
    for block in blocks:
        root.append(_teds(to_tree(block)))
    ET.indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _teds(tree: Tree) -> ET.Element:
    attributes = {name: str(getattr(tree, key)) for name, (key, _) in _HEAD.items() if getattr(tree, key) is not None}
    attributes |= {"name": tree.name} if tree.name else {}
    attributes |= {} if tree.framed else {"framed": "false"}
    element = ET.Element("teds", attributes)
    element.extend(_field(entry) for entry in tree.entries)
    if tree.octets is not None:
        ET.SubElement(element, "octets").text = tree.octets.hex()
    return element


def _field(entry: TreeEntry) -> ET.Element:
    attributes = {} if entry.type is None else {"type": str(entry.type)}
    element = ET.Element("field", attributes | ({"name": entry.name} if entry.name else {}))
    value = entry.value
    if entry.kind == "fields":
        element.extend(_field(child) for child in entry.children)
    elif isinstance(value, Units):
        ET.SubElement(element, "units", units_to_parts(value))
    elif isinstance(value, TimeInstance):
        parts = {"seconds": str(value.seconds), "nanoseconds": str(value.nanoseconds)}
        ET.SubElement(element, "time", parts | ({"negative": "true"} if value.negative else {}))
    else:
        ET.SubElement(element, entry.kind).text = _text(value)
    return element


def _text(value: object) -> str:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, tuple):
        return " ".join(_text(part) for part in value)
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "INF" if value > 0 else "-INF"
    return repr(value) if isinstance(value, float) else str(value)


def read_xml(octets: bytes) -> list[TedsBlock]:
    """Read an XML document of this format; raises BadDataError naming what is wrong."""
    root = parse(octets)
    if root.tag != f"{{{NAMESPACE}}}teds-set":
        raise BadDataError(f"This XML is no set of TEDS: its root is {root.tag!r}, not teds-set of {NAMESPACE}.")
    if root.attrib:
        raise BadDataError(f"teds-set has no attribute {min(root.attrib)!r}.")
    check_count(len(root), LIMITS.teds_of_a_file, "TEDS")
    return [from_tree(_tree(element, number)) for number, element in enumerate(root, 1)]


def parse(octets: bytes) -> ET.Element:
    """Parse XML from a stranger: no DTD, no entities, at most what ``limits`` allows. Raises BadDataError."""
    from defusedxml import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    check_size(len(octets), LIMITS.teds_file, "the XML")
    check_xml(octets, "the XML")
    try:
        root: ET.Element = fromstring(octets, forbid_dtd=True)
    except DefusedXmlException as error:
        raise BadDataError("The XML holds a DTD or an entity, which is refused.") from error
    except (ET.ParseError, ValueError, LookupError) as error:
        raise BadDataError(f"This is not XML: {error}.") from error
    return root


def _local(element: ET.Element, where: str) -> str:
    prefix = f"{{{NAMESPACE}}}"
    if not str(element.tag).startswith(prefix):  # a comment's tag is a function
        raise BadDataError(f"{where} holds the foreign element {element.tag!r}.")
    return element.tag.removeprefix(prefix)


def _attributes(element: ET.Element, allowed: set[str], where: str) -> None:
    unknown = set(element.attrib) - allowed
    if unknown:
        raise BadDataError(f"{where} has no attribute {min(unknown)!r}.")


def _integer(element: ET.Element, name: str, limit: int, where: str) -> int | None:
    text = element.get(name)
    if text is None:
        return None
    stripped = text.strip()
    if not (stripped.isascii() and stripped.isdecimal()) or len(stripped) > 20 or int(stripped) > limit:
        raise BadDataError(f"{name} of {where} is not a number from 0 to {limit}: {text!r}.")
    return int(stripped)


def _flag(element: ET.Element, name: str, default: bool, where: str) -> bool:
    text = element.get(name)
    if text is None:
        return default
    if text.strip() not in {"true", "false", "0", "1"}:
        raise BadDataError(f"{name} of {where} is true or false, not {text!r}.")
    return text.strip() in {"true", "1"}


def _tree(element: ET.Element, number: int) -> Tree:
    where = f"TEDS {number}"
    if _local(element, where) != "teds":
        raise BadDataError(f"teds-set holds {_local(element, where)!r} where teds is asked.")
    _attributes(element, {*_HEAD, "name", "framed"}, where)
    head = {key: _integer(element, name, limit, where) for name, (key, limit) in _HEAD.items()}
    given = head.pop("edition")
    if given not in (2007, 2024, None):
        raise BadDataError(f"{where} names the edition {given}; 2007 and 2024 are known.")
    edition: Edition | None = given  # type: ignore[assignment]
    entries: list[TreeEntry] = []
    octets: bytes | None = None
    for child in element:
        if octets is not None:
            raise BadDataError(f"In {where}, octets come last and once.")
        if _local(child, where) == "octets":
            octets = _hex(child, where)
        else:
            entries.append(_entry(child, where, 0))
    framed = _flag(element, "framed", True, where)
    return Tree(**head, edition=edition, framed=framed, entries=tuple(entries), octets=octets)


def _hex(element: ET.Element, where: str) -> bytes:
    try:
        return bytes.fromhex(element.text or "")
    except ValueError as error:
        raise BadDataError(f"The octets of {where} are not hex digits.") from error


def _entry(element: ET.Element, where: str, depth: int) -> TreeEntry:
    if _local(element, where) != "field" or depth > MAX_DEPTH:
        raise BadDataError(f"{where} holds {_local(element, where)!r} where field is asked, or nests too deep.")
    _attributes(element, {"type", "name"}, where)
    number, name = _integer(element, "type", 0xFF, where), element.get("name", "")
    where = f"{where}, {name or f'type {number}'}"
    children = list(element)
    if not children or _local(children[0], where) == "field":
        return TreeEntry(number, name, "fields", children=tuple(_entry(child, where, depth + 1) for child in children))
    if len(children) > 1:
        raise BadDataError(f"{where} holds more than one value.")
    kind, value = _value(children[0], where)
    return TreeEntry(number, name, kind, value)


def _value(element: ET.Element, where: str) -> tuple[Kind, EntryValue]:
    kind = _local(element, where)
    if len(element):
        raise BadDataError(f"The {kind} of {where} holds further elements.")
    if kind == "units":
        return "units", units_from_parts(element.attrib)
    if kind == "time":
        _attributes(element, {"seconds", "nanoseconds", "negative"}, where)
        seconds = _integer(element, "seconds", (1 << 48) - 1, where)
        nanoseconds = _integer(element, "nanoseconds", (1 << 32) - 1, where)
        return "time", TimeInstance(seconds or 0, nanoseconds or 0, _flag(element, "negative", False, where))
    _attributes(element, set(), where)
    reader = _READERS.get(kind)
    if reader is None:
        raise BadDataError(f"{where} holds {kind!r}, which is no kind of value.")
    try:
        return reader[0], reader[1](element.text or "")
    except (ValueError, OverflowError) as error:
        raise BadDataError(f"The {kind} of {where} does not read as one: {(element.text or '')[:40]!r}.") from error


def _whole_value(text: str) -> int:
    return whole_number(text, "the value")


def _list(text: str) -> list[str]:
    check_size(len(text), LIMITS.text_file, "a list of numbers")
    return text.split()


def _float(text: str) -> float:
    return float(text.replace("INF", "inf").strip())


_READERS: Final[dict[str, tuple[Kind, Callable[[str], EntryValue]]]] = {
    "integer": ("integer", _whole_value),
    "number": ("number", _float),
    "text": ("text", str),
    "octets": ("octets", bytes.fromhex),
    "integers": ("integers", lambda text: tuple(_whole_value(part) for part in _list(text))),
    "numbers": ("numbers", lambda text: tuple(_float(part) for part in _list(text))),
}
