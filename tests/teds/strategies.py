"""Values for every field of every table, drawn after the tables themselves."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

from hypothesis import strategies as st

from teds_provision import teds

HALVES = st.integers(-64, 63).map(lambda doubled: Fraction(doubled, 2))
FLOATS = st.floats(width=32, allow_nan=False, allow_infinity=False)
NAMES = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=40)


@st.composite
def units(draw: st.DrawFn) -> teds.Units:
    interpretation = draw(st.integers(0, 3))
    exponents = draw(st.lists(HALVES, min_size=9, max_size=9))
    return teds.Units(interpretation, *exponents, draw(st.sampled_from([0, 15, 130])))


def value_of(row: teds.FieldSpec, edition: int) -> st.SearchStrategy[Any]:
    if row.kind == "units":
        return units()
    if row.kind == "tlv":
        return fields_of(row.children, edition).filter(bool)
    if row.enumeration:
        return st.sampled_from(sorted(set(row.enumeration) - row.weak))
    whole = st.integers(0, 0xFFFFFFFF)
    nanoseconds = st.integers(0, 999_999_999)
    negative = st.booleans() if edition == 2007 or row.kind == "duration" else st.just(False)
    return {
        "u8": st.integers(0, 0xFF),
        "u16": st.integers(0, 0xFFFF),
        "u32": whole,
        "f32": FLOATS,
        "f32x2": st.tuples(FLOATS, FLOATS),
        "f32[]": st.lists(FLOATS, max_size=90).map(tuple),
        "u16[]": st.lists(st.integers(0, 0xFFFF), max_size=150).map(tuple),
        "text": NAMES,
        "key": st.binary(max_size=300).map(lambda octets: b"\xff" + octets),
        "lang": st.sampled_from(["en", "de", "pt"]),
        "uuid": st.binary(min_size=16, max_size=16) if edition == 2024 else st.binary(min_size=10, max_size=10),
        "instant": st.builds(teds.TimeInstance, whole, nanoseconds, negative),
        "duration": st.builds(teds.TimeInstance, whole, nanoseconds, negative),
        "block id": st.binary(min_size=35, max_size=35),
        "octets": st.binary(max_size=20),
    }[row.kind]


@st.composite
def fields_of(draw: st.DrawFn, rows: tuple[teds.FieldSpec, ...], edition: int) -> list[tuple[str, Any]]:
    """Pairs for all required and some other rows, repeated ones up to three times."""
    pairs: list[tuple[str, Any]] = []
    for row in rows:
        most = 3 if row.repeats else 1
        for _ in range(draw(st.integers(1 if row.need == "R" else 0, most))):
            pairs.append((row.name, draw(value_of(row, edition))))
    limits = sorted(value for name, value in pairs if name in {"LowLimit", "HiLimit"})
    if len(limits) == 2:
        right = {"LowLimit": limits[0], "HiLimit": limits[1]}
        pairs = [(name, right.get(name, value)) for name, value in pairs]
    return pairs


@st.composite
def texts(draw: st.DrawFn) -> list[tuple[str, Any]]:
    entry = st.fixed_dictionaries(
        {
            "LangCode": st.sampled_from(["en", "de", "pt"]),
            "Text": st.binary(max_size=300),
            "Compress": st.integers(0, 1),
        }
    )
    return [("Text", item) for item in draw(st.lists(entry, min_size=1, max_size=4))]


def some_fields(access_code: int, edition: int) -> st.SearchStrategy[list[tuple[str, Any]]]:
    """Fields of one class, with unknown ones in the manufacturers' range where the class has such a range."""
    table = teds.table(access_code)
    if access_code in (2, 4, 6, 10, 11, 14, 15):
        return texts()
    known = fields_of(table.rows, edition)
    if access_code == 128:
        return known.map(lambda pairs: [pair for pair in pairs if pair[0] != "ProfileVersion"])
    first = 200 if table.rows else 10
    strange = st.dictionaries(st.integers(first, 255), st.binary(max_size=20), max_size=3)
    return st.builds(lambda pairs, more: pairs + [(str(n), v) for n, v in more.items()], known, strange)
