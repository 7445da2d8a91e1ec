"""The whitelist: which nodes may be keyed and written, each by UUID and by the fingerprint of its key.

A pinned key is never replaced by a command that adds; the entry has to be removed first (profile.md, "Keys and trust").

Whitelist files of other tools are XML in the style of the NCAP, CSV or JSON; a file with a mistake changes nothing.
XML is read with defusedxml, without a DTD: neither entity bombs nor external entities. It is read liberally: an element
is an entry if it has an attribute ``uuid``, a child ``uuid`` beside its other fields, or a UUID as its text.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from teds_provision.errors import BadDataError, KeyMismatchError, PolicyError, UsageError
from teds_provision.files import read_text
from teds_provision.limits import check_count, load_json
from teds_provision.protocol.fingerprints import read_fingerprint, same_key
from teds_provision.station.station import Station
from teds_provision.station.store.database import chunks
from teds_provision.station.store.records import UUID_OCTETS, WhitelistEntry

MAX_FILE_OCTETS: Final = 64 * 1024 * 1024
MAX_ENTRIES: Final = 250_000
FORMATS: Final = ("xml", "csv", "json")
EUI64_PREFIX: Final = "fffe"
FIELDS: Final = ("uuid", "fingerprint", "added", "assurance", "name")

_SHOWN = 5
_SHOWN_MISTAKES = 10
_MAX_NAME = 200
_MAX_DEPTH = 16
_MAX_TAG = 65_536
_MOST_TAGS = 12 * MAX_ENTRIES  # start and end tags of an entry with five elements
_MOST_LINES = 4 * MAX_ENTRIES
_UUID_DIGITS = 2 * UUID_OCTETS
_NAME_RULE = f"a name is printable and has at most {_MAX_NAME} characters"
_ENTRY_ELEMENTS = frozenset({"transducer", "tim", "node", "entry", "item", "device", "uuid"})
_ALIASES = {"id": "uuid", "uid": "uuid"}


@dataclass(frozen=True)
class ListedNode:
    """One entry of a file: the UUID, and key and name if it has them."""

    line: int
    uuid: bytes
    fingerprint: str | None = None
    name: str | None = None


@dataclass
class _WhitelistReader:
    """State of reading a whitelist, with every mistake by line and field."""

    file: str
    entries: dict[bytes, ListedNode] = field(default_factory=dict)
    mistakes: list[str] = field(default_factory=list)
    count: int = 0

    def wrong(self, line: int, what: str, why: str) -> None:
        self.mistakes.append(f"{self.file}:{line}: {what}: {why}")

    def add(self, line: int, values: dict[str, str]) -> None:
        """Take one entry in, or note what is wrong with it."""
        self.count += 1
        if self.count > MAX_ENTRIES:
            raise BadDataError(f"{self.file}:{line}: there are more than {MAX_ENTRIES} entries.")
        before = len(self.mistakes)
        uuid = self._digits(line, "uuid", uuid_of_eui64(values.get("uuid", "")), _UUID_DIGITS)
        print_text = values.get("fingerprint", "").strip()
        pin = self._fingerprint(line, print_text) if print_text else None
        name = values.get("name", "").strip() or None
        if not _is_name(name):
            self.wrong(line, "name", _NAME_RULE)
        if len(self.mistakes) == before and uuid is not None:
            self._join(ListedNode(line, bytes.fromhex(uuid), pin, name))

    def _digits(self, line: int, what: str, text: str, length: int) -> str | None:
        digits = re.sub(r"[\s:-]", "", text).lower().removeprefix("0x")
        if len(digits) == length and re.fullmatch("[0-9a-f]+", digits):
            return digits
        shown = ascii(text[:48]) if text else "nothing"
        self.wrong(line, what, f"expected {length} hex digits, not {shown}")
        return None

    def _fingerprint(self, line: int, text: str) -> str | None:
        digits = read_fingerprint(text)
        if digits is None:
            self.wrong(line, "fingerprint", f"expected 32 to 64 hex digits, not {text[:80]!a}")
        return digits

    def _join(self, entry: ListedNode) -> None:
        known = self.entries.get(entry.uuid)
        pins = [listed.fingerprint for listed in (known, entry) if listed is not None and listed.fingerprint]
        if known is not None and len(pins) == 2 and not same_key(*pins):
            self.wrong(entry.line, "fingerprint", f"line {known.line} has the same UUID with another key")
            return
        if known is not None:
            entry = ListedNode(known.line, known.uuid, max(pins, key=len, default=None), known.name or entry.name)
        self.entries[entry.uuid] = entry


def uuid_of_eui64(text: str) -> str:
    """Return the UUID for an EUI-64 (16 hex digits): FF FE before its octets; other text unchanged.

    A UUID of IEEE 1451.0-2007 that begins so would be at 291 degrees north, so the two cannot collide.
    """
    digits = re.sub(r"[\s:-]", "", text).lower().removeprefix("0x")
    return f"{EUI64_PREFIX}{digits}" if re.fullmatch("[0-9a-f]{16}", digits) else text


def read_whitelist(path: Path, form: str | None = None) -> list[ListedNode]:
    """Read a whitelist file; the format is ``form``, else the file's extension, else what its content looks like.

    Raises NotFoundError, or BadDataError that names file, line and field of every mistake (the first ten in full).
    """
    text = read_text(path, MAX_FILE_OCTETS, "whitelist")
    if not text.strip():
        raise BadDataError(f"{path} is empty.", hint="Supported: XML, CSV (with column names in line 1) and JSON.")
    form = form or _form_of(path, text)
    reading = _WhitelistReader(str(path))
    readers: dict[str, Callable[[str, _WhitelistReader], None]] = {
        "xml": _read_xml,
        "csv": _read_csv,
        "json": _read_json,
    }
    readers[form](text, reading)
    if reading.mistakes:
        shown = "; ".join(reading.mistakes[:_SHOWN_MISTAKES])
        more = len(reading.mistakes) - _SHOWN_MISTAKES
        raise BadDataError(
            f"{shown}{f'; and {more} more' if more > 0 else ''}.",
            hint="Nothing was imported. Fix these lines and import again.",
        )
    return list(reading.entries.values())


def require_name(name: str | None) -> None:
    """Raise BadDataError for what cannot be a node's name."""
    if not _is_name(name):
        raise BadDataError(f"{_NAME_RULE[0].upper()}{_NAME_RULE[1:]}.")


def _is_name(name: str | None) -> bool:
    return name is None or (len(name) <= _MAX_NAME and name.isprintable())


def _form_of(path: Path, text: str) -> str:
    suffix = path.suffix.lower().removeprefix(".")
    if suffix in FORMATS:
        return suffix
    first = text.lstrip()[:1]
    return "xml" if first == "<" else "json" if first in ("{", "[") else "csv"


# -- XML ---------------------------------------------------------------------------------------------------------------


@dataclass
class _Element:
    """An element that is still open: its own fields, and the UUIDs among its children."""

    tag: str
    line: int
    fields: dict[str, str]
    text: list[str] = field(default_factory=list)
    uuids: list[tuple[int, str]] = field(default_factory=list)
    entries: int = 0

    @property
    def whitelist_fields(self) -> dict[str, str]:
        """Those of its fields that a whitelist has."""
        return {key: value for key, value in self.fields.items() if key in FIELDS}

    def take_field(self, line: int, tag: str, text: str) -> None:
        """Take a child that is one field of this element."""
        if tag == "uuid":
            self.uuids.append((line, text))
        else:
            self.fields[tag] = text


def _read_xml(text: str, reading: _WhitelistReader) -> None:
    from xml.sax import SAXException, SAXParseException
    from xml.sax.handler import ContentHandler

    from defusedxml.common import DefusedXmlException
    from defusedxml.expatreader import DefusedExpatParser

    class Handler(ContentHandler):
        """Feeds elements into the reading as they close."""

        def __init__(self) -> None:
            super().__init__()
            self.open: list[_Element] = []

        def startElement(self, name: str, attrs: Any) -> None:
            if len(self.open) >= _MAX_DEPTH:
                raise BadDataError(f"{reading.file}:{parser.getLineNumber()}: elements are nested too deeply.")
            fields = {_field_name(key): value for key, value in attrs.items()}
            self.open.append(_Element(_field_name(name), parser.getLineNumber(), fields))

        def characters(self, content: str) -> None:
            self.open[-1].text.append(content)

        def endElement(self, name: str) -> None:
            element = self.open.pop()
            _close_element(element, self.open[-1] if self.open else None, reading)

    check_count(text.count("<"), _MOST_TAGS, f"tags in {reading.file}")
    _refuse_long(text, "<", reading.file, "a tag or text")  # a million attributes would all be in memory at once
    parser = DefusedExpatParser(forbid_dtd=True)
    handler = Handler()
    parser.setContentHandler(handler)
    try:
        parser.parse(io.StringIO(text))
    except DefusedXmlException as error:
        raise BadDataError(
            f"{reading.file}: the XML has a DTD or entities, which are not allowed.", hint="Remove the DOCTYPE."
        ) from error
    except SAXParseException as error:
        raise BadDataError(f"{reading.file}:{error.getLineNumber()}: this is not XML: {error.getMessage()}.") from error
    except SAXException as error:
        raise BadDataError(f"{reading.file}: this is not XML: {error.getMessage()}.") from error


def _refuse_long(text: str, separator: str, file: str, what: str) -> None:
    """Raise BadDataError if two separators are too far apart; linear in the text, unlike a regex with a count."""
    at = 0
    while at < len(text):
        end = text.find(separator, at, at + _MAX_TAG)
        if end < 0 and at + _MAX_TAG <= len(text):
            line = text.count("\n", 0, at) + 1
            raise BadDataError(f"{file}:{line}: {what} of more than {_MAX_TAG} characters.")
        at = end + 1 if end >= 0 else len(text)


def _field_name(name: str) -> str:
    local = name.rpartition(":")[2].lower()
    return _ALIASES.get(local, local)


def _close_element(element: _Element, parent: _Element | None, reading: _WhitelistReader) -> None:
    text = "".join(element.text).strip()
    leaf = not element.uuids and not element.entries
    if parent is not None and leaf and text and not element.fields and element.tag in FIELDS:
        # <fingerprint>…</fingerprint>: the text of an element with a field's name is a field of the element around it.
        parent.take_field(element.line, element.tag, text)
        return
    entries = element.entries + _entry_of(element, text, leaf, parent is None, reading)
    if parent is not None:
        parent.entries += entries
    elif entries == 0 and element.tag != "whitelist" and not reading.mistakes:
        reading.wrong(element.line, element.tag, "there is no UUID in this document")


def _entry_of(element: _Element, text: str, leaf: bool, root: bool, reading: _WhitelistReader) -> int:
    """Take in what the element holds by itself; returns how many entries that were."""
    own = element.whitelist_fields
    if "uuid" in own:
        reading.add(element.line, own)
        return 1
    if len(element.uuids) == 1 and (own or not root):
        line, uuid = element.uuids[0]
        reading.add(line, {**own, "uuid": uuid})
        return 1
    if element.uuids:
        return _add_several(element, own, reading)
    if not leaf or not _is_entry_text(element, text, root):
        return 0
    for part in _parts(text):
        reading.add(element.line, {**own, "uuid": part})
    return 1


def _add_several(element: _Element, own: dict[str, str], reading: _WhitelistReader) -> int:
    if len(element.uuids) > 1 and "fingerprint" in own:
        reading.wrong(element.line, "fingerprint", "it is beside several UUIDs and belongs to none")
    for line, uuid in element.uuids:
        reading.add(line, {"uuid": uuid})
    return len(element.uuids)


def _is_entry_text(element: _Element, text: str, root: bool) -> bool:
    """Return True if the text of an element is a UUID by its position or its form."""
    if element.tag in _ENTRY_ELEMENTS:
        return True
    return bool(text) and (root or text[:2].lower() == "0x")


def _parts(text: str) -> list[str]:
    """Split a text of several whole UUIDs; any other text is returned whole."""
    words = re.split(r"[\s,;]+", text.strip())
    whole = all(len(uuid_of_eui64(word).lower().removeprefix("0x")) == _UUID_DIGITS for word in words)
    return words if whole else [text]


# -- CSV ---------------------------------------------------------------------------------------------------------------


def _read_csv(text: str, reading: _WhitelistReader) -> None:
    check_count(text.count("\n"), _MOST_LINES, f"lines in {reading.file}")
    _refuse_long(text, "\n", reading.file, "a line")
    first = next((line for line in text[:_MAX_TAG].splitlines() if line.strip() and not line.startswith("#")), "")
    rows = csv.reader(io.StringIO(text, newline=""), delimiter=max(",;\t", key=first.count), strict=True)
    columns: list[str] | None = None
    try:
        for row in rows:
            cells = [cell.strip() for cell in row]
            if not any(cells) or cells[0].startswith("#"):
                continue
            if columns is None:
                named = [_field_name(cell) for cell in cells]
                columns, is_header = (named, True) if "uuid" in named else (["uuid", "fingerprint", "name"], False)
                if is_header:
                    continue
            if any(cells[len(columns) :]):
                reading.wrong(rows.line_num, "row", f"{len(cells)} cells for {len(columns)} columns")
                continue
            reading.add(rows.line_num, dict(zip(columns, cells, strict=False)))
    except csv.Error as error:
        raise BadDataError(f"{reading.file}:{rows.line_num}: this is not CSV: {error}.") from error


# -- JSON --------------------------------------------------------------------------------------------------------------


def _read_json(text: str, reading: _WhitelistReader) -> None:
    value = load_json(text, "the whitelist", octets=MAX_FILE_OCTETS, file=reading.file)
    listed = value.get("whitelist") if isinstance(value, dict) else value
    if not isinstance(listed, list):
        raise BadDataError(f'{reading.file}:1: whitelist: expected a list, or an object with "whitelist": […].')
    for line, item in _with_lines(text, inside=isinstance(value, dict)):
        if isinstance(item, str):
            reading.add(line, {"uuid": item})
        elif not isinstance(item, dict):
            reading.wrong(line, "entry", "expected an object, or a UUID as a string")
        else:
            _add_object(line, item, reading)


def _add_object(line: int, item: dict[str, Any], reading: _WhitelistReader) -> None:
    values: dict[str, str] = {}
    for key, value in item.items():
        name = _field_name(key)
        if name in FIELDS and not isinstance(value, str | None):
            reading.wrong(line, name, "expected a string")
            return
        if name in FIELDS and value is not None:
            values[name] = value
    reading.add(line, values)


def _with_lines(text: str, *, inside: bool) -> Iterator[tuple[int, Any]]:
    """Give the elements of the list again, each with the line it begins in; the text is known to be JSON."""
    decoder, blank = json.JSONDecoder(), re.compile(r"[\s,:]*")

    def skip(at: int) -> int:
        found = blank.match(text, at)
        return found.end() if found else at

    at = skip(0)
    if inside:
        at, start = skip(at + 1), None
        while text[at] != "}":
            key, at = decoder.raw_decode(text, at)
            at = skip(at)
            start = at if key == "whitelist" else start
            _, at = decoder.raw_decode(text, at)
            at = skip(at)
        assert start is not None
        at = start
    line, counted, at = 1, 0, skip(at + 1)
    while text[at] != "]":
        line, counted = line + text.count("\n", counted, at), at
        item, at = decoder.raw_decode(text, at)
        yield line, item
        at = skip(at)


# -- adding, removing, writing out -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WhitelistPlan:
    """Preview of an addition: the entries to write, how many of them are new, and how many stay."""

    write: tuple[WhitelistEntry, ...]
    new: int
    unchanged: int


def plan_addition(station: Station, listed: Sequence[ListedNode], *, rename: bool = False) -> WhitelistPlan:
    """Check entries against the store; changes nothing. With ``rename`` their names replace those that are known.

    Raises KeyMismatchError if a UUID is pinned to another key, PolicyError for a revoked node: then none may be added.
    """
    revoked = {revocation.uuid: revocation.why for revocation in station.policy.revocations()}
    uuids = [entry.uuid for entry in listed if entry.uuid in revoked]
    if uuids:
        shown = ", ".join(f"{uuid.hex()} ({revoked[uuid]})" for uuid in uuids[:_SHOWN])
        raise PolicyError(f"Revoked nodes cannot be whitelisted: {shown}{_more(uuids)}.", hint="Nothing was added.")
    write: list[WhitelistEntry] = []
    conflicts: list[tuple[ListedNode, str]] = []
    new = 0
    for chunk in chunks(listed):
        uuids = [entry.uuid for entry in chunk]
        present, nodes = station.pins.get_many(uuids), station.nodes.get_many(uuids)
        pinned = station.pins.pinned_among(nodes.values(), present.values())
        for entry in chunk:
            known, pin = present.get(entry.uuid), pinned.get(entry.uuid)
            if pin is not None and entry.fingerprint is not None and not same_key(pin, entry.fingerprint):
                conflicts.append((entry, pin))
                continue
            node = nodes.get(entry.uuid)
            # lists and exports show the node's own name where the entry has none: such a name changes nothing
            is_own_name = known is not None and node is not None and entry.name == node.name
            wanted = _merged(known, replace(entry, name=None) if is_own_name else entry)
            if rename and entry.name is not None and wanted.name is not None:
                wanted = replace(wanted, name=entry.name)
            if wanted != known:
                write.append(wanted)
                new += known is None
    _refuse_conflicts(conflicts)
    return WhitelistPlan(tuple(write), new, len(listed) - len(write))


def _merged(known: WhitelistEntry | None, entry: ListedNode) -> WhitelistEntry:
    if known is None:
        assurance = "uuid" if entry.fingerprint is None else "import"
        return WhitelistEntry(entry.uuid, entry.fingerprint, assurance=assurance, name=entry.name)  # type: ignore[arg-type]
    gains = known.fingerprint is None and entry.fingerprint is not None
    pin = max(known.fingerprint or "", entry.fingerprint or "", key=len) or None
    return replace(
        known,
        fingerprint=pin,
        assurance="import" if gains and known.assurance == "uuid" else known.assurance,
        name=known.name or entry.name,
    )


def _refuse_conflicts(conflicts: list[tuple[ListedNode, str]]) -> None:
    if conflicts:
        shown = "; ".join(
            f"{entry.uuid.hex()} is pinned to the key {pin[:32]}, not {str(entry.fingerprint)[:32]}"
            for entry, pin in conflicts[:_SHOWN]
        )
        first = conflicts[0][0].uuid.hex()
        raise KeyMismatchError(
            f"{shown}{_more(conflicts)}.",
            hint=f"Nothing was added. If a board was really replaced: teds-provision whitelist remove {first}",
        )


def _more(items: Sequence[object]) -> str:
    return f" and {len(items) - _SHOWN} more" if len(items) > _SHOWN else ""


def add(station: Station, plan: WhitelistPlan, *, source: str | None = None) -> None:
    """Carry out a plan in one transaction, with one entry of the audit log; ``source`` is the file it came from."""
    if not plan.write:
        return
    with station.transaction():
        station.pins.put(*plan.write)
        if source is None:
            (entry,) = plan.write
            station.audit("whitelist", entry.uuid, "added", fingerprint=entry.fingerprint, assurance=entry.assurance)
        else:
            station.audit("whitelist", None, "imported", file=source, entries=len(plan.write), new=plan.new)


def remove(station: Station, uuid: bytes) -> bool:
    """Take a node off the whitelist and forget its pinned key; False if there was neither.

    Epoch, sequence and link keys stay: they still count when the node comes back. A replaced board under the same UUID
    can then be pinned again.
    """
    with station.transaction():
        pinned = is_pinned(station, uuid)
        station.pins.unpin(uuid)
        removed = station.pins.remove(uuid)
        if removed or pinned:
            station.audit("whitelist", uuid, "removed" if removed else "unpinned")
    return removed or pinned


def is_pinned(station: Station, uuid: bytes) -> bool:
    """Return True if a key of this UUID is known, whitelisted or not."""
    return station.pins.pinned(uuid) is not None


def as_dict(entry: WhitelistEntry) -> dict[str, Any]:
    """Return one entry as the command-line contract shows it."""
    return {
        "uuid": entry.uuid.hex(),
        "fingerprint": entry.fingerprint,
        "added": entry.added,
        "assurance": entry.assurance,
        "name": entry.name,
    }


def named(station: Station, entries: Iterable[WhitelistEntry]) -> Iterator[WhitelistEntry]:
    """Yield the entries with the names that people see: the node's own if the entry has none."""
    names = station.nodes.names()
    for entry in entries:
        yield entry if entry.name else replace(entry, name=names.get(entry.uuid))


def form_of(path: Path, form: str | None) -> str:
    """Format to write: ``form``, else by extension, else XML; raises UsageError for an extension that is none."""
    suffix = path.suffix.lower().removeprefix(".")
    if form is not None or suffix in FORMATS:
        return form or suffix
    if suffix:
        raise UsageError(f"Cannot tell the format from the name {path.name}.", hint="Add --format xml, csv or json.")
    return "xml"


def render(entries: Iterable[WhitelistEntry], form: str) -> Iterator[str]:
    """Yield the whitelist as text, a line or more at a time.

    XML of the NCAP with our attributes, CSV with a header, or JSON.
    """
    rows = map(as_dict, entries)
    if form == "json":
        yield json.dumps({"whitelist": list(rows)}, indent=1, ensure_ascii=False) + "\n"
    elif form == "csv":
        yield _csv_line(dict.fromkeys(FIELDS), names=True)
        yield from map(_csv_line, rows)
    else:
        yield '<?xml version="1.0" encoding="UTF-8"?>\n<whitelist>\n'
        yield from map(_xml_line, rows)
        yield "</whitelist>\n"


def _csv_line(row: Mapping[str, Any], *, names: bool = False) -> str:
    out = io.StringIO(newline="")
    writer = csv.DictWriter(out, FIELDS, lineterminator="\n")
    if names:
        writer.writeheader()
    else:
        writer.writerow(row)
    return out.getvalue()


def _xml_line(row: Mapping[str, Any]) -> str:
    attributes = {**row, "uuid": f"0x{row['uuid']}"}
    shown = " ".join(f"{key}={_quoted(_legal(value))}" for key, value in attributes.items() if value is not None)
    return f"  <transducer {shown}/>\n"


def _quoted(text: str) -> str:
    """Return an attribute's value with its quotes (XML 1.0 section 2.3)."""
    for character, entity in (("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"), ('"', "&quot;")):
        text = text.replace(character, entity)
    return f'"{text}"'


def _legal(text: str) -> str:
    """Return text that XML 1.0 can hold; a node's or an older version's name may have control characters."""
    return "".join(character if character.isprintable() else "\ufffd" for character in text)
