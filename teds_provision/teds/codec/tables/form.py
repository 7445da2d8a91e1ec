"""What a field table is made of, and the names of the TEDS classes (ieee-1451.0.md sections 3 and 4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

Need = Literal["R", "R?", "O"]
Confidence = Literal["H", "M", "L", "MEM", "unverified"]

NAMES: Final[Mapping[int, str]] = {
    1: "MetaTEDS",
    2: "MetaIdTEDS",
    3: "ChanTEDS",
    4: "ChanIdTEDS",
    5: "CalTEDS",
    6: "CalIdTEDS",
    7: "EUASTEDS",
    8: "FreqRespTEDS",
    9: "TransferTEDS",
    10: "CommandTEDS",
    11: "TitleTEDS",
    12: "XdcrName",
    13: "PHYTEDS",
    14: "GeoLocTEDS",
    15: "UnitsExtention",
    16: "SecurityTEDS2024",
    17: "TimeSyncTEDS",
    128: "SecurityTEDS",
}
TEXT_BASED: Final = frozenset({2, 4, 6, 10, 11, 14, 15})
ONLY_2024: Final = frozenset({16, 17})
MANUFACTURER: Final = 128
"""First type and first access code of the manufacturers' range."""

# Octets of the kinds of value that have a fixed number of them; UUID, TEDSID and TimeInstance depend on the edition.
OCTETS: Final[Mapping[str, tuple[int, ...]]] = {
    "u8": (1,),
    "u16": (2,),
    "u32": (4,),
    "f32": (4,),
    "f32x2": (8,),
    "lang": (2,),
    "instant": (8, 10),
    "duration": (8,),
    "block id": (35,),
}


@dataclass(frozen=True)
class FieldSpec:
    """One row of a field table.

    ``kind`` is the data type: u8, u16, u32, f32, f32x2, u16[], f32[], text, key, lang, uuid, units, instant, duration,
    tlv, block id, octets. ``need`` is R (required), R? (carried by every full example) or O. ``weak`` are the values of
    ``enumeration`` that no new TEDS may use. ``also`` are further octet counts that are met in the wild and read.
    """

    type: int
    name: str
    kind: str
    need: Need = "O"
    confidence: Confidence = "H"
    meaning: str = ""
    unit: str = ""
    enumeration: Mapping[int, str] = field(default_factory=dict)
    enumeration_confidence: Confidence = "M"
    children: tuple[FieldSpec, ...] = ()
    repeats: bool = False
    also: tuple[int, ...] = ()
    weak: frozenset[int] = frozenset()
    by_type: Mapping[int, FieldSpec] = field(init=False, repr=False, compare=False)
    by_name: Mapping[str, FieldSpec] = field(init=False, repr=False, compare=False)
    octets: tuple[int, ...] = field(init=False, repr=False, compare=False)
    required: frozenset[int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        required = frozenset(child.type for child in self.children if child.need == "R")
        object.__setattr__(self, "required", required)
        object.__setattr__(self, "by_type", {child.type: child for child in self.children})
        object.__setattr__(self, "by_name", {child.name: child for child in self.children})
        object.__setattr__(self, "octets", OCTETS.get(self.kind, ()))


@dataclass(frozen=True)
class Table:
    """All rows of one TEDS class; ``verified`` is False where rows come from memory or from one weak source."""

    access_code: int
    name: str
    rows: tuple[FieldSpec, ...] = ()
    verified: bool = True
    family: int = 0
    source: str = ""
    aliases: Mapping[int, FieldSpec] = field(default_factory=dict)
    by_type: Mapping[int, FieldSpec] = field(init=False, repr=False, compare=False)
    by_name: Mapping[str, FieldSpec] = field(init=False, repr=False, compare=False)
    required: frozenset[int] = field(init=False, repr=False, compare=False)
    parents: Mapping[int, FieldSpec] = field(init=False, repr=False, compare=False)
    inner: Mapping[int, FieldSpec] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        inner: dict[int, FieldSpec] = {}
        parents: dict[int, FieldSpec] = {}
        for row in self.rows:
            for child in row.children:
                inner.setdefault(child.type, child)
                parents.setdefault(child.type, row)
        object.__setattr__(self, "by_type", {row.type: row for row in self.rows})
        object.__setattr__(self, "by_name", {row.name: row for row in self.rows})
        object.__setattr__(self, "required", frozenset(row.type for row in self.rows if row.need == "R"))
        object.__setattr__(self, "inner", inner)
        object.__setattr__(self, "parents", parents)


def name_of(access_code: int) -> str:
    """Name of a TEDS class, e.g. 3 -> ``ChanTEDS``; 'reserved' or 'manufacturer' where the standard names none."""
    known = NAMES.get(access_code)
    if known is not None:
        return known
    return f"manufacturer {access_code}" if access_code >= MANUFACTURER else f"reserved {access_code}"
