"""Values -> octets: new TEDS from field names (``compose``), and decoded ones back (``encode``, ``recompose``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from teds_provision.errors import BadData
from teds_provision.teds.codec import values
from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.frame import TEDSID, frame, raw_tuple
from teds_provision.teds.codec.model import Decoded, Edition, Field, Units
from teds_provision.teds.codec.tables import TEXT_BASED, FieldSpec, Table, table
from teds_provision.teds.codec.text import compose_text
from teds_provision.teds.codec.values import pairs_of

NO_SUBFAMILY: Final = 0xFF
_VERSION: Final = {2007: 1, 2024: 2}
_NOT_CONTENT: Final = frozenset({"TEDSID"})


class Wider(Exception):
    """A value needs more length octets than tried."""


def compose(
    access_code: int,
    fields: Mapping[str, object] | Sequence[tuple[str, object]],
    *,
    edition: Edition = 2007,
    width: int | None = None,
) -> bytes:
    """Compose a framed TEDS from values by field name, in ascending order of types.

    ``fields`` is a mapping, or a sequence of pairs where fields repeat; nested structures take either again. A key
    that is a number is a field that the table does not know, its value octets. Units are spelled as nested tuples in
    the 2007 edition and packed in that of 2024. ``width`` is the number of length octets of every tuple (1 to 4);
    without it 1 is taken, or 2 where a field needs it. Text-based TEDS take ``("Text", {"LangCode", "Text",
    "Compress"})`` once per language. Raises BadData naming the field.
    """
    if not 1 <= access_code <= 255:
        raise BadData(f"An access code goes from 1 to 255, not {access_code}.")
    if edition not in _VERSION:
        raise BadData(f"There is no edition {edition}; 2007 and 2024 are known.")
    if width is not None and width not in (1, 2, 3, 4):
        raise BadData(f"Tuples have 1 to 4 length octets, not {width}.")
    pairs = pairs_of(f"The TEDS {access_code}", fields)
    for tried in (width,) if width is not None else (1, 2):
        try:
            return frame(Composer(table(access_code), edition, tried).block(pairs))
        except Wider as error:
            reason = str(error)
    raise BadData(f"{reason} does not fit tuples of {tried} length octets.", hint="Give a greater width, up to 4.")


class Composer:
    """Writes the fields of one table in one edition and one tuple width."""

    def __init__(self, fields: Table, edition: Edition, width: int) -> None:
        self.table = fields
        self.edition = edition
        self.width = width

    def block(self, pairs: list[tuple[str, object]]) -> bytes:
        """Data block with its TEDSID."""
        head = self.tedsid(dict(pairs).get("TEDSID"))
        content = [pair for pair in pairs if pair[0] not in _NOT_CONTENT]
        if self.table.access_code in TEXT_BASED:
            return compose_text(head, content, self.tuples, self.width)
        return head + self.tuples(content, self.table.by_name)

    def tedsid(self, given: object) -> bytes:
        """TEDSID tuple; its own length has one octet whatever the width."""
        family, version = self.table.family, _VERSION[self.edition]
        if isinstance(given, Mapping):
            family, version = _octet(given, "family", family), _octet(given, "version", version)
        elif given is not None:
            raise BadData("TEDSID is a mapping with family and version; the rest follows from the access code.")
        parts = [family, NO_SUBFAMILY] if self.edition == 2024 else [family]
        if isinstance(given, Mapping) and self.edition == 2024:
            parts[1] = _octet(given, "subfamily", NO_SUBFAMILY)
        value = bytes([*parts, self.table.access_code, version, self.width])
        return raw_tuple(TEDSID, value)

    def tuples(self, pairs: list[tuple[str, object]], known: Mapping[str, FieldSpec]) -> bytes:
        """Tuples in ascending order; repeated types keep the order given."""
        done: list[tuple[int, bytes]] = []
        seen: set[int] = set()
        for name, value in _spread(pairs, known):
            number, octets, repeats = self.one(name, value, known)
            if number in seen and not repeats:
                raise BadData(f"{name} is given twice.")
            seen.add(number)
            done.append((number, octets))
        done.sort(key=lambda entry: entry[0])
        return b"".join(self.tuple(number, octets) for number, octets in done)

    def one(self, name: str, value: object, known: Mapping[str, FieldSpec]) -> tuple[int, bytes, bool]:
        """Type, value octets and whether the type may repeat."""
        spec = known.get(name)
        if spec is not None:
            return spec.type, self.value(spec, value), spec.repeats
        if (
            not name.isdecimal()
            or not 0 <= int(name) <= 255
            or (int(name) == TEDSID and self.table.access_code != AccessCode.SECURITY)
        ):
            raise BadData(f"{self.table.name} has no field {name!r}.", hint=f"It has {', '.join(known) or 'no names'}.")
        if not isinstance(value, bytes | bytearray):
            raise BadData(f"Field {name} of {self.table.name} is raw octets, not {values.shown(value)}.")
        return int(name), bytes(value), True

    def value(self, spec: FieldSpec, value: object) -> bytes:
        """Value octets of one field, tuples inside included."""
        if spec.kind == "units":
            units = values.as_units(spec, value)
            packed = values.pack_units(spec, units)
            return packed if self.edition == 2024 else self.nested_units(spec, packed)
        if spec.kind == "tlv":
            return self.tuples(pairs_of(spec.name, value), spec.by_name)
        return values.write(spec, value, self.edition)

    def nested_units(self, spec: FieldSpec, packed: bytes) -> bytes:
        """Spelling A: tuples, zero exponents and a missing extension left out."""
        parts = [self.tuple(50, packed[:1])]
        parts += [self.tuple(50 + n, packed[n : n + 1]) for n in range(1, 10) if packed[n] != 128]
        if packed[10]:
            parts.append(self.tuple(60, packed[10:]))
        return b"".join(parts)

    def tuple(self, number: int, octets: bytes) -> bytes:
        """One tuple in this width."""
        if len(octets) >= 1 << 8 * self.width:
            raise Wider(f"Field {number} of {self.table.name} has {len(octets)} octets and")
        return raw_tuple(number, octets, width=self.width)


def _spread(pairs: list[tuple[str, object]], known: Mapping[str, FieldSpec]) -> list[tuple[str, object]]:
    """One pair per value where a repeated structure is given as a list of mappings."""
    done: list[tuple[str, object]] = []
    for name, value in pairs:
        spec = known.get(name)
        many = spec is not None and spec.repeats and isinstance(value, list | tuple)
        if many and isinstance(value, list | tuple) and all(isinstance(each, Mapping | bytes) for each in value):
            done += [(name, each) for each in value]
        else:
            done.append((name, value))
    return done


def _octet(given: Mapping[str, object], key: str, default: int) -> int:
    value = given.get(key, default)
    if not isinstance(value, int) or not 0 <= value <= 255:
        raise BadData(f"The {key} of the TEDSID is an octet, not {values.shown(value)}.")
    return value


def encode(decoded: Decoded) -> bytes:
    """Octets that a TEDS was decoded from, exactly: unknown fields and classes, damage and all."""
    return decoded.octets


def recompose(decoded: Decoded) -> bytes:
    """Encode the fields of a decoded TEDS anew: TEDSID, width, order, spelling of units and Length as they should be.

    The result is equal to the original for a clean TEDS. Unknown fields keep their octets. A framed TEDS gives a framed
    one with right Length and checksum, a bare data block gives a bare one. Raises BadData where there is nothing to
    encode from (malformed octets, a message).
    """
    if decoded.verdict in {"malformed", "message"}:
        raise BadData(f"This cannot be encoded anew: its verdict is {decoded.verdict}.")
    width = tuple_width(decoded)
    edition: Edition = decoded.edition or 2007
    fields = table(decoded.access_code) if decoded.access_code is not None else None
    known = {**fields.aliases, **fields.by_type} if fields is not None else {}
    parts = [_again(field, known, fields, edition, width) for field in decoded.fields]
    block = b"".join(parts) + _tail(decoded)
    return frame(block) if decoded.framed else block


def tuple_width(decoded: Decoded) -> int:
    """How many length octets the tuples of a decoded TEDS have, as its TEDSID says; 1 where it does not say."""
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
        # Octets that are no whole tuple made no child: keep them.
        return raw_tuple(field.type, inner + field.raw[len(inner) :], width=width)
    return raw_tuple(field.type, _leaf(field, spec, edition), width=width)


def _leaf(field: Field, spec: FieldSpec | None, edition: Edition) -> bytes:
    """Value octets from the value; from the raw octets where no value came of them or it has other spellings."""
    if spec is None or field.value is None or not field.name:
        return field.raw
    if isinstance(field.value, Units):
        return _packed(field, spec, field.value)
    if isinstance(field.value, int) and spec.kind in {"u8", "u16", "u32"}:
        return field.value.to_bytes(len(field.raw), "big")
    if spec.kind in {"uuid", "f32[]", "u16[]"} or (spec.octets and len(field.raw) not in spec.octets):
        return field.raw
    return _written(field, spec, edition)


def _packed(field: Field, spec: FieldSpec, units: Units) -> bytes:
    packed = values.pack_units(spec, units)
    return packed[: len(field.raw)] if field.raw[10:] in {b"", packed[10:]} else field.raw


def _written(field: Field, spec: FieldSpec, edition: Edition) -> bytes:
    form: Edition = 2024 if len(field.raw) == 10 else 2007 if spec.kind == "instant" else edition
    octets = values.write(spec, field.value, form)
    return field.raw if octets != field.raw and field.value != field.value else octets


def _tail(decoded: Decoded) -> bytes:
    """What stands behind the tuples of a text-based TEDS, octet for octet."""
    if not decoded.text:
        return b""
    last = decoded.fields[-1] if decoded.fields else None
    start = 4 * decoded.framed if last is None else last.offset + _header(decoded, last) + len(last.raw)
    end = len(decoded.octets) - 2 * decoded.framed
    if any(finding.code == "frame-trailing" for finding in decoded.findings):
        end = int.from_bytes(decoded.octets[:4], "big") + 2
    return decoded.octets[start:end]


def _header(decoded: Decoded, field: Field) -> int:
    return 2 if field.name == "TEDSID" else 1 + tuple_width(decoded)
