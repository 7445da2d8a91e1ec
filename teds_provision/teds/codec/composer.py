"""Values -> octets: new TEDS from field names (``compose``), and decoded ones back (``encode``, ``recompose``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.teds.codec import values
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.frame import TEDSID, frame, raw_tuple
from teds_provision.teds.codec.model import (
    DecodedTeds,
    Edition,
    Field,
    Finding,
    Severity,
    TimeInstance,
    Units,
)
from teds_provision.teds.codec.tables import ONLY_2024, TEXT_BASED, FieldSpec, Table, table
from teds_provision.teds.codec.values import compose_text, pairs_of

NO_SUBFAMILY: Final = 0xFF
_VERSION: Final = {2007: 1, 2024: 2}
_NOT_CONTENT: Final = frozenset({"TEDSID"})


class LengthOverflowError(Exception):
    """A value needs more length octets than tried."""


def compose(
    access_code: int,
    fields: Mapping[str, object] | Sequence[tuple[str, object]],
    *,
    edition: Edition = 2007,
    width: int | None = None,
) -> bytes:
    """Compose a framed TEDS from values by field name, in ascending order of types.

    ``fields`` is a mapping, or a sequence of pairs if fields repeat; nested structures take either again. A key that is
    a number is a field that the table does not know, its value octets. Units are spelled as nested tuples in the 2007
    edition and packed in that of 2024. ``width`` is the number of length octets of every tuple (1 to 4); without it 1
    is used, or 2 if a field needs it. Text-based TEDS take ``("Text", {"LangCode", "Text", "Compress"})`` once per
    language. Raises BadDataError naming the field.
    """
    if not 1 <= access_code <= 255:
        raise BadDataError(f"An access code goes from 1 to 255, not {access_code}.")
    if edition not in _VERSION:
        raise BadDataError(f"There is no edition {edition}; 2007 and 2024 are known.")
    if width is not None and width not in (1, 2, 3, 4):
        raise BadDataError(f"Tuples have 1 to 4 length octets, not {width}.")
    pairs = pairs_of(f"The TEDS {access_code}", fields)
    for tried in (width,) if width is not None else (1, 2):
        try:
            return frame(Composer(table(access_code), edition, tried).block(pairs))
        except LengthOverflowError as error:
            reason = str(error)
    raise BadDataError(f"{reason} does not fit tuples of {tried} length octets.", hint="Give a greater width, up to 4.")


class Composer:
    """Writes the fields of one table in one edition and one tuple width."""

    def __init__(self, fields: Table, edition: Edition, width: int) -> None:
        self.table = fields
        self.edition = edition
        self.width = width

    def block(self, pairs: list[tuple[str, object]]) -> bytes:
        """Return the data block with its TEDSID."""
        head = self.tedsid(dict(pairs).get("TEDSID"))
        content = [pair for pair in pairs if pair[0] not in _NOT_CONTENT]
        if self.table.access_code in TEXT_BASED:
            return compose_text(head, content, self.tuples, self.width)
        return head + self.tuples(content, self.table.by_name)

    def tedsid(self, given: object) -> bytes:
        """Return the TEDSID tuple; its own length has one octet whatever the width."""
        family, version = self.table.family, _VERSION[self.edition]
        if isinstance(given, Mapping):
            family, version = _octet(given, "family", family), _octet(given, "version", version)
        elif given is not None:
            raise BadDataError("TEDSID is a mapping with family and version; the rest follows from the access code.")
        parts = [family, NO_SUBFAMILY] if self.edition == 2024 else [family]
        if isinstance(given, Mapping) and self.edition == 2024:
            parts[1] = _octet(given, "subfamily", NO_SUBFAMILY)
        value = bytes([*parts, self.table.access_code, version, self.width])
        return raw_tuple(TEDSID, value)

    def tuples(self, pairs: list[tuple[str, object]], known: Mapping[str, FieldSpec]) -> bytes:
        """Return the tuples in ascending order; repeated types keep the given order."""
        done: list[tuple[int, bytes]] = []
        seen: set[int] = set()
        for name, value in _spread(pairs, known):
            number, octets, repeats = self.encode_field(name, value, known)
            if number in seen and not repeats:
                raise BadDataError(f"{name} is given twice.")
            seen.add(number)
            done.append((number, octets))
        done.sort(key=lambda entry: entry[0])
        return b"".join(self.tuple(number, octets) for number, octets in done)

    def encode_field(self, name: str, value: object, known: Mapping[str, FieldSpec]) -> tuple[int, bytes, bool]:
        """Return type, value octets and whether the type may repeat."""
        spec = known.get(name)
        if spec is not None:
            return spec.type, self.value(spec, value), spec.repeats
        if (
            not name.isdecimal()
            or not 0 <= int(name) <= 255
            or (int(name) == TEDSID and self.table.access_code != AccessCode.SECURITY)
        ):
            raise BadDataError(
                f"{self.table.name} has no field {name!r}.", hint=f"It has {', '.join(known) or 'no names'}."
            )
        if not isinstance(value, bytes | bytearray):
            raise BadDataError(f"Field {name} of {self.table.name} is raw octets, not {values.shown(value)}.")
        return int(name), bytes(value), True

    def value(self, spec: FieldSpec, value: object) -> bytes:
        """Return the value octets of one field, with the tuples inside it."""
        if spec.kind == "units":
            units = values.as_units(spec, value)
            packed = values.pack_units(spec, units)
            return packed if self.edition == 2024 else self.nested_units(spec, packed)
        if spec.kind == "tlv":
            return self.tuples(pairs_of(spec.name, value), spec.by_name)
        return values.write(spec, value, self.edition)

    def nested_units(self, spec: FieldSpec, packed: bytes) -> bytes:
        """Return spelling A: tuples without zero exponents and without a missing extension."""
        parts = [self.tuple(50, packed[:1])]
        parts += [self.tuple(50 + n, packed[n : n + 1]) for n in range(1, 10) if packed[n] != 128]
        if packed[10]:
            parts.append(self.tuple(60, packed[10:]))
        return b"".join(parts)

    def tuple(self, number: int, octets: bytes) -> bytes:
        """Return one tuple in this width."""
        if len(octets) >= 1 << 8 * self.width:
            raise LengthOverflowError(f"Field {number} of {self.table.name} has {len(octets)} octets and")
        return raw_tuple(number, octets, width=self.width)


def _spread(pairs: list[tuple[str, object]], known: Mapping[str, FieldSpec]) -> list[tuple[str, object]]:
    """Return one pair per value if a repeated structure is given as a list of mappings."""
    done: list[tuple[str, object]] = []
    for name, value in pairs:
        spec = known.get(name)
        many = spec is not None and spec.repeats and isinstance(value, list | tuple)
        if many and isinstance(value, list | tuple) and all(isinstance(element, Mapping | bytes) for element in value):
            done += [(name, element) for element in value]
        else:
            done.append((name, value))
    return done


def _octet(given: Mapping[str, object], key: str, default: int) -> int:
    value = given.get(key, default)
    if not isinstance(value, int) or not 0 <= value <= 255:
        raise BadDataError(f"The {key} of the TEDSID is an octet, not {values.shown(value)}.")
    return value


def encode(decoded: DecodedTeds) -> bytes:
    """Return exactly the octets that a TEDS was decoded from, with unknown fields, classes and damage."""
    return decoded.octets


def recompose(decoded: DecodedTeds) -> bytes:
    """Encode the fields of a decoded TEDS again, with correct TEDSID, width, order, spelling of units and Length.

    The result is equal to the original for a clean TEDS. Unknown fields keep their octets. A framed TEDS gives a framed
    one with right Length and checksum, a bare data block gives a bare one. Raises BadDataError if there is nothing to
    encode from (malformed octets, a message).
    """
    if decoded.verdict in {"malformed", "message"}:
        raise BadDataError(f"This cannot be encoded again: its verdict is {decoded.verdict}.")
    width = tuple_width(decoded)
    edition: Edition = decoded.edition or 2007
    fields = table(decoded.access_code) if decoded.access_code is not None else None
    known = {**fields.aliases, **fields.by_type} if fields is not None else {}
    parts = [_again(field, known, fields, edition, width) for field in decoded.fields]
    block = b"".join(parts) + _tail(decoded)
    return frame(block) if decoded.framed else block


def tuple_width(decoded: DecodedTeds) -> int:
    """Return the number of length octets of a decoded TEDS's tuples, by its TEDSID; 1 if it has none."""
    for field in decoded.fields:
        if field.name == "TEDSID":
            width = field.raw[-1] if field.raw else 1
            return width if 1 <= width <= 4 else 1
    return 1


def _again(field: Field, known: Mapping[int, FieldSpec], fields: Table | None, edition: Edition, width: int) -> bytes:
    if field.name == "TEDSID":
        return raw_tuple(TEDSID, field.raw)
    spec = known.get(field.type)
    if spec is None and fields is not None:
        spec = fields.inner.get(field.type)
    if field.children and spec is not None:
        inner = b"".join(_again(child, spec.by_type, fields, edition, width) for child in field.children)
        # Octets that do not form a whole tuple have no child: keep them.
        return raw_tuple(field.type, inner + field.raw[len(inner) :], width=width)
    return raw_tuple(field.type, _leaf(field, spec, edition), width=width)


def _leaf(field: Field, spec: FieldSpec | None, edition: Edition) -> bytes:
    """Return value octets from the value; from the raw octets if they gave no value or have another spelling."""
    if spec is None or field.value is None or not field.name:
        return field.raw
    if isinstance(field.value, Units):
        packed = values.pack_units(spec, field.value)
        return packed[: len(field.raw)] if field.raw[10:] in {b"", packed[10:]} else field.raw
    if isinstance(field.value, int) and spec.kind in {"u8", "u16", "u32"}:
        return field.value.to_bytes(len(field.raw), "big")
    if spec.kind in {"uuid", "f32[]", "u16[]"} or (spec.octets and len(field.raw) not in spec.octets):
        return field.raw
    return _written(field, spec, edition)


def _written(field: Field, spec: FieldSpec, edition: Edition) -> bytes:
    form: Edition = 2024 if len(field.raw) == 10 else 2007 if spec.kind == "instant" else edition
    octets = values.write(spec, field.value, form)
    return field.raw if octets != field.raw and field.value != field.value else octets


def _tail(decoded: DecodedTeds) -> bytes:
    """Return the octets behind the tuples of a text-based TEDS, unchanged."""
    if not decoded.text:
        return b""
    last = decoded.fields[-1] if decoded.fields else None
    start = (
        4 * decoded.framed
        if last is None
        else last.offset + (2 if last.name == "TEDSID" else 1 + tuple_width(decoded)) + len(last.raw)
    )
    end = len(decoded.octets) - 2 * decoded.framed
    if any(finding.code == "frame-trailing" for finding in decoded.findings):
        end = int.from_bytes(decoded.octets[:4], "big") + 2
    return decoded.octets[start:end]


# Converts a decoded TEDS to the other edition, with a finding for each value that the other edition cannot represent.

_VERSIONS: Final = {(2007, 1): 2, (2024, 2): 1}
_UUID_OCTETS: Final = {2007: 10, 2024: 16}
_ONE_FORM: Final = frozenset({AccessCode.SECURITY, AccessCode.ORIGIN, AccessCode.CERTIFICATE})


def convert(decoded: DecodedTeds, edition: Edition, *, uuid: bytes | None = None) -> tuple[bytes, list[Finding]]:
    """Convert a decoded TEDS to an edition, framed or bare as it came; findings list what was changed or lost.

    A UUID of one edition does not exist in the other: ``uuid`` gives the new one, else the field is left out (an error
    finding). The profile's own TEDS (access codes 128, 130, 131) have one form only and are returned unchanged. Raises
    BadDataError for octets that have no fields to convert, or no TEDSID.
    """
    if decoded.edition is None or decoded.access_code is None or decoded.verdict in {"malformed", "message"}:
        raise BadDataError(f"This cannot be converted: it is no TEDS of known edition (verdict {decoded.verdict}).")
    if decoded.edition == edition:
        return decoded.octets, []
    conversion = _Conversion(decoded, table(decoded.access_code), edition, uuid)
    if decoded.access_code in _ONE_FORM:
        message = f"The {decoded.name} of the profile has one form in both editions."
        conversion.add_finding("note", "one-form", message, None)
        return decoded.octets, conversion.findings
    return conversion.octets(), conversion.findings


@dataclass
class _Conversion:
    decoded: DecodedTeds
    table: Table
    edition: Edition
    uuid: bytes | None
    findings: list[Finding] = dataclass_field(default_factory=list)

    def add_finding(self, severity: Severity, code: str, message: str, part: Field | None, asked: str = "") -> None:
        offset, name = (part.offset, part.name) if part is not None else (None, "")
        found = part.raw[:32].hex() if part is not None else ""
        self.findings.append(Finding(severity, code, message, offset, name, asked, found))

    def octets(self) -> bytes:
        if self.table.access_code in ONLY_2024 and self.edition == 2007:
            self.add_finding("error", "class", f"The 2007 edition has no {self.table.name}.", None)
        composer = Composer(self.table, self.edition, tuple_width(self.decoded))
        if self.table.access_code in TEXT_BASED:
            return self.text(composer)
        rows = {**self.table.inner, **self.table.aliases, **self.table.by_type}
        block = b"".join(self.part(part, rows, composer) for part in self.decoded.fields)
        return self.framed(block)

    def framed(self, block: bytes) -> bytes:
        return frame(block) if self.decoded.framed else block

    def tedsid(self, part: Field, width: int) -> bytes:
        family, access_code, version = part.raw[0], part.raw[-3], part.raw[-2]
        new = _VERSIONS.get((self.decoded.edition or 0, version), version)
        if new == version:
            self.add_finding("note", "version", f"The TEDSID keeps its version {version}, which has no equal.", part)
        if self.edition == 2007 and part.raw[1] != NO_SUBFAMILY:
            self.add_finding("error", "lost", f"The 2007 edition cannot say the sub-family {part.raw[1]}.", part)
        middle = [NO_SUBFAMILY] if self.edition == 2024 else []
        return raw_tuple(TEDSID, bytes([family, *middle, access_code, new, width]))

    def part(self, part: Field, rows: Mapping[int, FieldSpec], composer: Composer) -> bytes:
        if part.name == "TEDSID":
            return self.tedsid(part, composer.width)
        spec = rows.get(part.type)
        if spec is None or not part.name:
            return self.unknown(part, composer)
        if spec.kind == "uuid":
            return self.identifier(part, composer)
        if spec.kind == "units":
            return composer.tuple(part.type, self.units(part, spec, composer))
        if spec.kind == "instant":
            return self.instant(part, spec, composer)
        if part.children:
            inner = b"".join(self.part(child, spec.by_type, composer) for child in part.children)
            return composer.tuple(part.type, inner + _loose(part, composer.width))
        return composer.tuple(part.type, part.raw)

    def unknown(self, part: Field, composer: Composer) -> bytes:
        if part.type >= 128 or self.table.verified:
            self.add_finding(
                "note", "kept", f"The field {part.type} is unknown; its octets are kept as they are.", part
            )
        return composer.tuple(part.type, part.raw)

    def identifier(self, part: Field, composer: Composer) -> bytes:
        wanted = _UUID_OCTETS[self.edition]
        if self.uuid is not None:
            if len(self.uuid) != wanted:
                raise BadDataError(f"The UUID has {wanted} octets in the {self.edition} edition, not {len(self.uuid)}.")
            return composer.tuple(part.type, self.uuid)
        message = f"A UUID of {len(part.raw)} octets cannot be said in {wanted}; it is left out."
        self.add_finding("error", "lost", message, part, f"{wanted} octets")
        return b""

    def units(self, part: Field, spec: FieldSpec, composer: Composer) -> bytes:
        if not isinstance(part.value, Units):
            return part.raw
        strange = [child.type for child in part.children if child.type not in spec.by_type]
        if strange:
            self.add_finding(
                "error", "lost", f"Packed units have no place for the fields {strange} of {part.name}.", part
            )
        loose = b"" if values.is_packed_units(part.raw) else _loose(part, composer.width)
        if loose:
            message = f"The octets {loose.hex(' ')} of {part.name} form no field; they are left out."
            self.add_finding("error", "lost", message, part)
        return composer.value(spec, part.value)

    def instant(self, part: Field, spec: FieldSpec, composer: Composer) -> bytes:
        if isinstance(part.value, TimeInstance):
            try:
                return composer.tuple(part.type, composer.value(spec, part.value))
            except BadDataError as error:
                self.add_finding("error", "lost", f"{error.message} It is left out.", part)
                return b""
        return composer.tuple(part.type, part.raw)

    def text(self, composer: Composer) -> bytes:
        """Return a text-based TEDS: its directory is rewritten if it describes the texts.

        Else all is kept behind it.
        """
        entries = self.directory()
        if entries:
            pairs: list[tuple[str, object]] = [
                ("Text", {"Text": text, **_directory(entry)})
                for entry, text in zip(entries, self.decoded.text, strict=True)
            ]
            block = composer.block([("TEDSID", {"family": self.decoded.fields[0].raw[0]}), *pairs])
            return self.framed(block)
        first = self.decoded.fields[0]
        if first.name != "TEDSID":
            raise BadDataError("A text-based TEDS whose TEDSID is not first cannot be converted.")
        self.add_finding(
            "warning", "kept", "The directory does not describe the texts; it is kept, Offset and all.", None
        )
        old = recompose(self.decoded)
        block = old[4:-2] if self.decoded.framed else old
        return self.framed(self.tedsid(first, composer.width) + block[2 + len(first.raw) :])

    def directory(self) -> list[Field]:
        """Return one entry for each text.

        None if the directory does not describe them, or holds more than it should.
        """
        fields = self.decoded.fields
        standard = {"TEDSID", "NumLang", "DirBlock", "SubSum"}
        if fields[0].name != "TEDSID" or any(part.name not in standard for part in fields):
            return []
        entries = [part for part in fields if part.name == "DirBlock"]
        return entries if len(entries) == len(self.decoded.text) else []


def _loose(part: Field, width: int) -> bytes:
    """Return the octets of a structure that form no whole tuple: those behind its last child."""
    return part.raw[sum(1 + width + len(child.raw) for child in part.children) :]


def _directory(entry: Field) -> dict[str, object]:
    parts = {child.name: child.value for child in entry.children if child.name in {"LangCode", "Compress"}}
    return {**parts, "Compress": parts.get("Compress", 0), "LangCode": parts.get("LangCode", "en")}
