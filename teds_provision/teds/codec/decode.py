"""Octets -> values and findings; nothing that comes in can raise anything here (teds.md, "Frame, tuples, verdicts").

Memory stays in proportion to the octets: a TEDS is refused beyond ``MAX_OCTETS``, a walk stops at ``MAX_TUPLES``, and
structures nest only as deep as the field tables do (four levels).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.frame import MINIMUM_OCTETS, TEDSID, checksum, shape_of
from teds_provision.teds.codec.model import (
    MALFORMED_CODES,
    Conformity,
    DecodedTeds,
    Edition,
    Field,
    Finding,
    Severity,
    Value,
)
from teds_provision.teds.codec.plausibility import check
from teds_provision.teds.codec.tables import MANUFACTURER, ONLY_2024, TEXT_BASED, FieldSpec, Table, name_of, table
from teds_provision.teds.codec.values import READERS, is_packed_units, split_text, units_of

# The start of decoding: Length and checksum, TEDSID, and the list of findings.

MAX_OCTETS: Final = 16 << 20
MAX_TUPLES: Final = 32768
MAX_FINDINGS: Final = 1000


class Head:
    """Facts about some octets before their tuples are walked: frame, edition, class, width."""

    def __init__(self, octets: bytes, *, framed: bool) -> None:
        self.octets = octets
        self.framed = framed
        self.findings: list[Finding] = []
        self.errors = self.others = 0
        self.edition: Edition | None = None
        self.access_code: int | None = None
        self.table: Table | None = None
        self.width = 1
        self.left = MAX_TUPLES
        self.text: tuple[bytes, ...] = ()
        self.tedsid_at: int | None = None

    def find(
        self,
        severity: Severity,
        code: str,
        message: str,
        offset: int | None = None,
        field: str = "",
        asked: object = "",
        found: object = "",
    ) -> None:
        """Note a finding: up to ``MAX_FINDINGS`` errors and as many others; what decides the verdict always."""
        if severity == "error":
            self.errors += 1
            if self.errors > MAX_FINDINGS and code not in MALFORMED_CODES:
                return
        else:
            self.others += 1
            if self.others > MAX_FINDINGS:
                return
        self.findings.append(Finding(severity, code, message, offset, field, str(asked), str(found)))

    def frame(self) -> tuple[int, int]:
        """Check Length and checksum; return start and end of the data block."""
        octets, size = self.octets, len(self.octets)
        if size > MAX_OCTETS:
            self.find("error", "too-large", f"This has {size} octets; {MAX_OCTETS} are read at most.", 0)
            return 0, 0
        if not self.framed:
            return 0, size
        if size < MINIMUM_OCTETS - 6:
            self.find("error", "too-short", f"A TEDS has {MINIMUM_OCTETS} octets or more, this one {size}.", 0)
            return 0, 0
        length = int.from_bytes(octets[:4], "big")
        end = size - 2
        if length != size - 4:
            if self.trailing(length):
                return 4, length + 2
            message = f"Length says {length} octets follow, {size - 4} do."
            self.find("error", "frame-length", message, 0, "Length", size - 4, length)
        stated, right = int.from_bytes(octets[end:], "big"), checksum(octets[:end])
        if stated != right:
            message = f"The checksum is {stated:04X}, the octets give {right:04X}."
            self.find("error", "frame-checksum", message, end, "Checksum", f"{right:04X}", f"{stated:04X}")
        return 4, end

    def trailing(self, length: int) -> bool:
        """Accept trailing bytes (flash dumps): a whole TEDS is decoded up to its checksum."""
        end = length + 4
        if not MINIMUM_OCTETS <= end < len(self.octets):
            return False
        if int.from_bytes(self.octets[end - 2 : end], "big") != checksum(self.octets[: end - 2]):
            return False
        more = len(self.octets) - end
        self.find("error", "frame-trailing", f"{more} octets follow the checksum of this TEDS.", end, "", 0, more)
        return True

    def tedsid(self, start: int, end: int) -> None:
        """Take edition, class and tuple width from the TEDSID, at any position."""
        at = start if self.octets[start] == TEDSID else self.search_tedsid(start, end)
        self.tedsid_at = at
        if at != start:
            first = f"type {self.octets[start]}"
            self.find("error", "tedsid-first", "The TEDSID tuple is not first.", start, "TEDSID", "type 3", first)
        if at is None:
            self.find("note", "no-class", "There is no TEDSID, so the meaning of the fields is unknown.", start)
            return
        size = self.octets[at + 1] if at + 1 < end else 0
        if size not in (4, 5) or at + 2 + size > end:
            if at + 2 + size <= end:
                message = f"The TEDSID has {size} octets; 4 (2007) or 5 (2024) are known."
                self.find("error", "tedsid-length", message, at, "TEDSID", "4 or 5", size)
            return
        value = self.octets[at + 2 : at + 2 + size]
        self.edition = 2007 if size == 4 else 2024
        self.access_code = value[-3]
        self.table = table(self.access_code)
        self.width = self.width_of(value[-1], at + 1 + size) if at == start else 1
        self.check_class(self.table, value, at)

    def width_of(self, width: int, place: int) -> int:
        """Return the length octets of all later tuples, 1 if the TEDSID has an impossible value."""
        if 1 <= width <= 4:
            return width
        message = f"The TEDSID asks for tuples of {width} length octets."
        self.find("error", "tuple-width", message, place, "TEDSID", "1 to 4", width)
        return 1

    def check_class(self, known: Table, value: bytes, at: int) -> None:
        """Note what is unusual about the class, family and version that a TEDSID names."""
        size, code, family, version = len(value), value[-3], value[0], value[-2]
        if size == 4 and code in ONLY_2024:
            self.find("note", "class", f"The 2007 edition has no {known.name}.", at + 3, "TEDSID")
        elif code == 0 or AccessCode.TIME_SYNC < code < MANUFACTURER:
            self.find("note", "class", f"The class {code} is reserved.", at, "TEDSID", "", code)
        if family != known.family:
            self.find("note", "family", f"The TEDSID names family {family}.", at + 2, "TEDSID", known.family, family)
        usual = 1 if size == 4 else 2
        if version != usual:
            what = "0 (prototype)" if version == 0 else str(version)
            self.find("note", "version", f"The TEDSID names version {what}.", at + size, "TEDSID", usual, what)

    def search_tedsid(self, start: int, end: int) -> int | None:
        """Return the offset of the first tuple of type 3 with 4 or 5 octets (lengths of one octet), None for none."""
        octets, at = self.octets, start
        while at + 1 < end:
            if octets[at] == TEDSID and octets[at + 1] in (4, 5):
                return at
            at += 2 + octets[at + 1]
        return None


SUB_SUM: Final = 12
_ELEMENT_OCTETS: Final = {"f32[]": 4, "u16[]": 2}
_made: Final[Callable[[tuple[object, ...]], Field]] = partial(tuple.__new__, Field)
"""A Field from its six values in their order: what its own constructor does, without a call of Python's for each."""


def decode(octets: bytes, *, strict: bool = False) -> DecodedTeds:
    """Decode a framed TEDS or a bare data block, 2007 or 2024 edition (by the length of the TEDSID).

    Never raises, whatever the octets, unless ``strict``: then BadDataError with the first finding of severity error. A
    message is recognised and not taken apart here. Offsets in findings and fields count from the first octet given.
    """
    octets = bytes(octets)
    shape = shape_of(octets)
    if shape == "message":
        return DecodedTeds(octets, False, None, None, "message", (), (), Conformity.MESSAGE)
    walk = _Walk(octets, framed=shape == "framed")
    decoded = walk.decode()
    if strict:
        for finding in decoded.findings:
            if finding.severity == "error":
                where = "" if finding.offset is None else f" (octet {finding.offset})"
                raise BadDataError(f"{finding.message}{where}", hint=f"The verdict of this TEDS is {decoded.verdict}.")
    return decoded


class _Walk(Head):
    """One decoding: what the head gave, then tuple for tuple."""

    def decode(self) -> DecodedTeds:
        start, end = self.frame()
        fields: tuple[Field, ...] = ()
        if end > start:
            self.tedsid(start, end)
            fields = self.block(start, end)
        if self.table is not None and fields:
            check(self.table, fields, self.find, self.octets, self.framed)
        name = name_of(self.access_code) if self.access_code is not None else ""
        findings = tuple(self.findings)
        return DecodedTeds(
            self.octets,
            self.framed,
            self.edition,
            self.access_code,
            name,
            fields,
            findings,
            Conformity.from_findings(self.framed, findings),
            self.text,
        )

    def block(self, start: int, end: int) -> tuple[Field, ...]:
        """Walk the data block; the first tuple of type 3 is the TEDSID."""
        spec_of: Mapping[int, FieldSpec] = self.table.by_type if self.table is not None else {}
        fields: list[Field] = []
        seen: set[int] = set()
        at, last, octets, tedsid_at = start, 0, self.octets, self.tedsid_at
        while at < end:
            kind = octets[at]
            is_tedsid = at == tedsid_at
            body, stop = self.extent(at, end, 1 if is_tedsid else self.width)
            if stop > end or self.left <= 0:
                self.stopped(kind, at, body, stop - body, end, fields)
                break
            self.left -= 1
            raw = octets[body:stop]
            if is_tedsid:
                fields.append(Field(kind, "TEDSID", tuple(raw), raw, at))
            else:
                spec = spec_of.get(kind)
                if kind < last or kind in seen:
                    self.order(kind, last, spec, at, seen)
                last = kind
                seen.add(kind)
                fields.append(self.field(kind, spec, raw, at, body))
            at = stop
            if kind == SUB_SUM and self.text_based():
                self.text_area(fields, at, end)
                break
        self.missing(seen, start)
        return tuple(fields)

    def text_based(self) -> bool:
        return self.table is not None and self.table.access_code in TEXT_BASED

    def extent(self, at: int, end: int, width: int) -> tuple[int, int]:
        """Return where the value of the tuple at ``at`` begins and ends; its Length has ``width`` octets."""
        body = at + 1 + width
        if width == 1 and body <= end:
            return body, body + self.octets[at + 1]
        return body, body + int.from_bytes(self.octets[at + 1 : body], "big")

    def field(self, kind: int, spec: FieldSpec | None, raw: bytes, at: int, body: int) -> Field:
        if spec is None or spec.children or not (spec.any_length or len(raw) in spec.octets):
            return self.special(kind, spec, raw, at, body)
        return _made((kind, spec.name, READERS[spec.kind](raw), raw, at, ()))

    def stopped(self, kind: int, at: int, body: int, size: int, end: int, fields: list[Field]) -> None:
        """End the walk: a tuple runs past the end, or there are too many."""
        if self.left <= 0:
            self.find("error", "too-many", f"There are more than {MAX_TUPLES} tuples; the rest is not read.", at)
        elif self.access_code == AccessCode.END_USER:
            self.text = (self.octets[at:end],)
            self.find("note", "free-form", "The end user's part is no run of tuples; it is kept as it stands.", at)
        elif body > end:
            self.find(
                "error", "not-closed", f"The header of a tuple of type {kind} runs past the end.", at, "", "", kind
            )
        else:
            message = f"The tuple of type {kind} needs {size} octets, {end - body} are left."
            self.find("error", "not-closed", message, at, "", end - body, size)

    def order(self, kind: int, last: int, spec: FieldSpec | None, at: int, seen: set[int]) -> None:
        name = spec.name if spec is not None else ""
        which = f"The field {kind} {name}".rstrip()
        if kind in seen and not (spec is not None and spec.repeats) and kind < MANUFACTURER:
            self.find("warning", "repeated", f"{which} occurs more than once.", at, name, "once", "again")
        if kind < last:
            message = f"{which} comes after {last}."
            self.find("warning", "order", message, at, name, "ascending types", f"{kind} behind {last}")

    def missing(self, seen: set[int], start: int) -> None:
        known = self.table
        if known is None or known.required <= seen:
            return
        present = {known.aliases[kind].name for kind in seen if kind in known.aliases}
        for kind in sorted(known.required - seen):
            name = known.by_type[kind].name
            if name not in present:
                self.find(
                    "warning", "missing", f"The required field {kind} {name} is missing.", start, name, "present", ""
                )

    def special(self, kind: int, spec: FieldSpec | None, raw: bytes, at: int, body: int) -> Field:
        """Return a field that is nested, of variable or wrong length, or not in the table."""
        if spec is None:
            return self.stranger(kind, raw, at, body)
        if spec.kind == "units":
            return self.units(spec, raw, at, body)
        if spec.children:
            return Field(kind, spec.name, None, raw, at, self.nested(spec, body, body + len(raw)))
        return Field(kind, spec.name, self.value(spec, raw, body), raw, at)

    def value(self, spec: FieldSpec, raw: bytes, body: int) -> Value:
        """Return the value of a leaf whose length has to be checked."""
        size, kind = len(raw), spec.kind
        if kind == "uuid":
            wanted = 16 if self.edition == 2024 else 10
            if size != wanted:
                self.length(spec, size, (wanted,), body, "error")
        elif kind in _ELEMENT_OCTETS and size % _ELEMENT_OCTETS[kind]:
            self.length(spec, size, (f"a multiple of {_ELEMENT_OCTETS[kind]}",), body, "error")
        elif spec.octets and size not in spec.octets:
            return self.wrong_length(spec, raw, body)
        return READERS[kind](raw)

    def wrong_length(self, spec: FieldSpec, raw: bytes, body: int) -> Value:
        """Return the value of a wrong length: an integer of another width is still one; all else has no value."""
        tolerated = len(raw) in spec.also or not self.firm()
        self.length(spec, len(raw), spec.octets, body, "warning" if tolerated else "error")
        return int.from_bytes(raw, "big") if spec.kind in {"u8", "u16", "u32"} and 0 < len(raw) <= 8 else None

    def firm(self) -> bool:
        """Return True if a wrong length is an error: not in an unverified table or a maker's own class."""
        return self.table is not None and self.table.verified and self.table.access_code != AccessCode.SECURITY

    def length(self, spec: FieldSpec, size: int, asked: tuple[object, ...], body: int, severity: Severity) -> None:
        wanted = " or ".join(str(number) for number in asked)
        message = f"{spec.name} ({spec.type}) has {size} octets, the table says {wanted}."
        self.find(severity, "length", message, body, spec.name, wanted, size)

    def stranger(self, kind: int, raw: bytes, at: int, body: int) -> Field:
        """Return a field of a type that the table of this class does not have at top level."""
        known = self.table
        if known is None or not known.by_type:
            return Field(kind, "", None, raw, at)
        if kind == TEDSID:
            message = f"The type 3 occurs again with {len(raw)} octets (clash with the TEDSID)."
            self.find("error", "tedsid-again", message, at, "TEDSID", "once", "again")
            return Field(kind, "", None, raw, at)
        alias = known.aliases.get(kind)
        if alias is not None:
            message = f"{alias.name} has the number {kind} of the clause's text, not that of its table."
            self.find("warning", "numbering", message, at, alias.name, "4 or 5", kind)
            return Field(kind, alias.name, self.value(alias, raw, body), raw, at)
        inner = known.inner.get(kind)
        if inner is not None:
            parent = known.parents[kind]
            message = (
                f"The sub-field {kind} {inner.name} is at top level; it belongs inside {parent.type} {parent.name}."
            )
            self.find("error", "top-level", message, at, inner.name, f"inside {parent.name}", "at top level")
            return self.special(kind, inner, raw, at, body)
        self.unknown(kind, at)
        return Field(kind, "", None, raw, at)

    def unknown(self, kind: int, at: int) -> None:
        known = self.table
        if kind >= MANUFACTURER and known is not None and known.access_code != AccessCode.SECURITY:
            self.find("note", "manufacturer", f"The field {kind} is in the manufacturers' range.", at, "", "", kind)
        elif self.firm():
            self.find("error", "unknown", f"The field {kind} is not in the table of this class.", at, "", "", kind)
        else:
            self.find(
                "note", "unknown", f"The field {kind} has no name that we know; it is kept as it is.", at, "", "", kind
            )

    def units(self, spec: FieldSpec, raw: bytes, at: int, body: int) -> Field:
        """Return physical units in any of three spellings."""
        if is_packed_units(raw):
            return Field(spec.type, spec.name, units_of(raw), raw, at)
        packed = bytearray([0, *[128] * 9, 0])
        children = self.nested(spec, body, body + len(raw))
        for child in children:
            if 50 <= child.type <= 60 and len(child.raw) == 1:
                packed[child.type - 50] = child.raw[0]
        if not any(child.type == 50 for child in children):
            self.find(
                "warning", "units", f"{spec.name} does not say its interpretation.", body, spec.name, "UnitType", ""
            )
        return Field(spec.type, spec.name, units_of(bytes(packed)), raw, at, children)

    def nested(self, parent: FieldSpec, start: int, end: int) -> tuple[Field, ...]:
        """Return the tuples inside a structure, only those of its table."""
        octets, width, by_type = self.octets, self.width, parent.by_type
        fields: list[Field] = []
        seen: set[int] = set()
        at = start
        while at < end:
            kind = octets[at]
            body, stop = self.extent(at, end, width)
            if body > end or stop > end or self.left <= 0:
                self.nested_stopped(parent, kind, at, end - at, stop - at)
                break
            self.left -= 1
            raw = octets[body:stop]
            spec = by_type.get(kind)
            if spec is not None and len(raw) in spec.octets and kind not in seen:
                fields.append(_made((kind, spec.name, READERS[spec.kind](raw), raw, at, ())))
            else:
                fields.append(self.nested_special(parent, kind, spec, raw, at, body, kind in seen))
            seen.add(kind)
            at = stop
        if not parent.required <= seen:
            self.nested_missing(parent, seen, start)
        return tuple(fields)

    def nested_stopped(self, parent: FieldSpec, kind: int, at: int, left: int, needed: int) -> None:
        what = "too many tuples" if self.left <= 0 else f"a tuple of type {kind} that runs past the end"
        self.find("error", "nested", f"{parent.name} holds {what}.", at, parent.name, left, needed)

    def nested_missing(self, parent: FieldSpec, seen: set[int], start: int) -> None:
        for kind in sorted(parent.required - seen):
            name = parent.by_type[kind].name
            self.find("warning", "missing", f"{parent.name} holds no {name}.", start, name, "present", "")

    def nested_special(
        self, parent: FieldSpec, kind: int, spec: FieldSpec | None, raw: bytes, at: int, body: int, again: bool
    ) -> Field:
        if again:
            self.find(
                "warning", "repeated", f"{parent.name} holds the field {kind} twice.", at, parent.name, "once", "again"
            )
        if spec is not None:
            return self.special(kind, spec, raw, at, body)
        known = self.table
        other = known.inner.get(kind) or known.by_type.get(kind) if known is not None else None
        if other is not None:
            message = f"{other.name} ({kind}) does not belong inside {parent.name}."
            self.find("error", "misplaced", message, at, other.name, "elsewhere", f"inside {parent.name}")
            if not other.children:
                return Field(kind, other.name, self.value(other, raw, body), raw, at)
            return Field(kind, other.name, None, raw, at)
        self.unknown(kind, at)
        return Field(kind, "", None, raw, at)

    def text_area(self, fields: list[Field], at: int, end: int) -> None:
        """Decode what follows the directory of a text-based TEDS."""
        self.text = split_text(fields, self.octets[at:end], at, self.find)
