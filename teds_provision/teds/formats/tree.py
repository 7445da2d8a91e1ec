"""The field tree that JSON and XML share: a TEDS by field names, lossless.

An entry holds one value of a named kind, or further entries. If the entries alone give back the octets exactly, the
octets are left out; else they are kept beside the entries and count alone when the tree is read.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Final, Literal

from teds_provision.errors import BadDataError
from teds_provision.teds.codec.composer import compose
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.model import UNIT_PARTS, DecodedTeds, Edition, Field, TimeInstance, Units
from teds_provision.teds.codec.tables import TEXT_BASED, FieldSpec, name_of, table
from teds_provision.teds.image import TedsBlock

Kind = Literal["integer", "number", "text", "octets", "units", "time", "integers", "numbers", "fields"]
EntryValue = int | float | str | bytes | Units | TimeInstance | tuple[int, ...] | tuple[float, ...] | None

_EXPONENT_CHARACTERS: Final = 8
MAX_DEPTH: Final = 8
_F32: Final = struct.Struct(">f")
_FLOAT32_MAXIMUM: Final = 3.4028234663852886e38
_UNFIT_FOR_XML: Final = re.compile("[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class TreeEntry:
    """One field: tuple type (None for a text of a text-based TEDS), name, and a value of ``kind`` or ``children``."""

    type: int | None
    name: str
    kind: Kind
    value: EntryValue = None
    children: tuple[TreeEntry, ...] = ()


@dataclass(frozen=True)
class Tree:
    """One TEDS as a tree: its place, its TEDSID, its entries, and its octets if they are needed."""

    channel: int | None
    access_code: int | None
    edition: Edition | None
    framed: bool = True
    family: int | None = None
    subfamily: int | None = None
    version: int | None = None
    width: int | None = None
    entries: tuple[TreeEntry, ...] = ()
    octets: bytes | None = None

    @property
    def name(self) -> str:
        """Name of the class."""
        return "" if self.access_code is None else name_of(self.access_code)


def to_tree(block: TedsBlock) -> Tree:
    """Turn a block into a tree; the octets are kept if the entries would not give them back."""
    decoded = decode(block.octets)
    tree = _described(block, decoded)
    try:
        again = from_tree(tree)
    except BadDataError:
        return replace(tree, octets=block.octets)
    return tree if again == block else replace(tree, octets=block.octets)


def from_tree(tree: Tree) -> TedsBlock:
    """Turn a tree back into a block: its octets if it has them, else composed from its entries; raises BadDataError."""
    if tree.octets is not None:
        return TedsBlock(tree.channel, tree.access_code, tree.octets)
    if tree.access_code is None or not tree.entries:
        raise BadDataError("A TEDS without octets needs an access code and fields.")
    parts = {"family": tree.family, "version": tree.version, "subfamily": tree.subfamily}
    given = {key: value for key, value in parts.items() if value is not None}
    pairs = [*([("TEDSID", given)] if given else []), *(_pair(entry, tree.access_code, 0) for entry in tree.entries)]
    octets = compose(tree.access_code, pairs, edition=tree.edition or 2007, width=tree.width)
    return TedsBlock(tree.channel, tree.access_code, octets if tree.framed else octets[4:-2])


def _described(block: TedsBlock, decoded: DecodedTeds) -> Tree:
    tedsid = next((field.raw for field in decoded.fields if field.name == "TEDSID"), b"")
    long = len(tedsid) == 5
    known = len(tedsid) in (4, 5)
    return Tree(
        block.channel,
        block.access_code,
        decoded.edition,
        decoded.framed,
        tedsid[0] if known else None,
        tedsid[1] if long else None,
        tedsid[-2] if known else None,
        tedsid[-1] if known else None,
        tuple(_entries(decoded)),
    )


def _entries(decoded: DecodedTeds) -> Iterator[TreeEntry]:
    if decoded.access_code in TEXT_BASED and decoded.text:
        yield from _texts(decoded)
        return
    known: Mapping[int, FieldSpec] = table(decoded.access_code).by_type if decoded.access_code is not None else {}
    for field in decoded.fields:
        if field.name != "TEDSID":
            yield _entry(field, known)


def _texts(decoded: DecodedTeds) -> Iterator[TreeEntry]:
    """Yield one entry per language; the directory follows from them."""
    languages = [field for field in decoded.fields if field.name == "DirBlock"]
    for number, text in enumerate(decoded.text):
        parts = languages[number].children if number < len(languages) else ()
        children = [_entry(part, {}) for part in parts if part.name in {"LangCode", "Compress"}]
        yield TreeEntry(None, "Text", "fields", children=(*children, _text(None, "Text", text)))


def _text(number: int | None, name: str, octets: bytes) -> TreeEntry:
    try:
        text = octets.decode()
    except UnicodeDecodeError:
        return TreeEntry(number, name, "octets", octets)
    return (
        TreeEntry(number, name, "octets", octets)
        if _UNFIT_FOR_XML.search(text)
        else TreeEntry(number, name, "text", text)
    )


def _entry(field: Field, known: Mapping[int, FieldSpec]) -> TreeEntry:
    value = field.value
    if isinstance(value, Units):
        return TreeEntry(field.type, field.name, "units", value)
    if field.children:
        spec = known.get(field.type)
        inner = spec.by_type if spec is not None else {}
        return TreeEntry(
            field.type, field.name, "fields", children=tuple(_entry(child, inner) for child in field.children)
        )
    if isinstance(value, str):
        return _text(field.type, field.name, value.encode())
    if not field.name or value is None or isinstance(value, bytes):
        return TreeEntry(field.type, field.name, "octets", field.raw)
    kind = _kind(value)
    return TreeEntry(field.type, field.name, kind, _shortest_of(kind, value))


def _shortest_of(kind: Kind, value: EntryValue) -> EntryValue:
    """Return the value with each float in it in the fewest digits."""
    if isinstance(value, float):
        return shortest(value)
    return tuple(map(shortest, value)) if kind == "numbers" and isinstance(value, tuple) else value


def shortest(value: float) -> float:
    """Return the fewest decimal digits that give the same Float32: 233.15 for 233.14999389648438."""
    if not math.isfinite(value) or abs(value) > _FLOAT32_MAXIMUM:
        return value
    wanted = _F32.pack(value)
    for digits in range(1, 10):
        short = float(f"{value:.{digits}g}")
        if abs(short) <= _FLOAT32_MAXIMUM and _F32.pack(short) == wanted:
            return short
    return value


def _kind(value: object) -> Kind:
    if isinstance(value, TimeInstance):
        return "time"
    if isinstance(value, tuple):
        return "numbers" if any(isinstance(part, float) for part in value) else "integers"
    return "number" if isinstance(value, float) else "integer"


def _pair(entry: TreeEntry, access_code: int, depth: int) -> tuple[str, object]:
    if depth > MAX_DEPTH:
        raise BadDataError(f"The field {entry.name} nests deeper than {MAX_DEPTH} levels.")
    key = entry.name or str(entry.type)
    if entry.kind == "fields":
        return key, tuple(_pair(child, access_code, depth + 1) for child in entry.children)
    return key, entry.value


def units_to_parts(units: Units) -> dict[str, str]:
    """Return interpretation, exponents other than 0 and the extension, as texts ("1", "-2", "1/2")."""
    parts = {"interpretation": str(units.interpretation)}
    parts |= {name: str(getattr(units, name)) for name in UNIT_PARTS if getattr(units, name)}
    return parts | ({"extension": str(units.extension)} if units.extension else {})


def _short(value: object) -> str:
    """Return the text of an exponent; raises ValueError for powers of ten, whose number could have any size."""
    text = str(value)
    if len(text) > _EXPONENT_CHARACTERS or "e" in text.lower():
        raise ValueError(text[:_EXPONENT_CHARACTERS])
    return text


def units_from_parts(parts: Mapping[str, object]) -> Units:
    """Return units from those parts, texts or numbers; raises BadDataError."""
    unknown = set(parts) - {"interpretation", "extension", *UNIT_PARTS}
    if unknown:
        raise BadDataError(f"Units have no part {min(unknown)!r}.")
    try:
        exponents = {name: Fraction(_short(parts.get(name, 0))) for name in UNIT_PARTS}
        interpretation, extension = (int(_short(parts.get(name, 0))) for name in ("interpretation", "extension"))
    except (ValueError, ZeroDivisionError) as error:
        raise BadDataError("The units hold an exponent that is not a number.") from error
    if not all(abs(exponent) <= 64 and (2 * exponent).denominator == 1 for exponent in exponents.values()):
        raise BadDataError("Exponents of units are multiples of 1/2 from -64 to 63.5.")
    return Units(interpretation, **exponents, extension=extension)
