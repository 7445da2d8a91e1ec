"""What a field table is made of, and the names of the TEDS classes (teds.md, "Access codes")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from teds_provision.teds.codec.codes import MANUFACTURER, AccessCode

Need = Literal["R", "R?", "O"]
Confidence = Literal["H", "M", "L", "MEM", "unverified"]

NAMES: Final[Mapping[int, str]] = {
    AccessCode.META: "MetaTEDS",
    AccessCode.META_ID: "MetaIdTEDS",
    AccessCode.CHANNEL: "ChanTEDS",
    AccessCode.CHANNEL_ID: "ChanIdTEDS",
    AccessCode.CALIBRATION: "CalTEDS",
    AccessCode.CALIBRATION_ID: "CalIdTEDS",
    AccessCode.END_USER: "EUASTEDS",
    AccessCode.FREQUENCY_RESPONSE: "FreqRespTEDS",
    AccessCode.TRANSFER: "TransferTEDS",
    AccessCode.COMMANDS: "CommandTEDS",
    AccessCode.TITLE: "TitleTEDS",
    AccessCode.NAME: "XdcrName",
    AccessCode.PHY: "PHYTEDS",
    AccessCode.LOCATION: "GeoLocTEDS",
    AccessCode.UNITS_EXTENSION: "UnitsExtention",
    AccessCode.SECURITY_2024: "SecurityTEDS2024",
    AccessCode.TIME_SYNC: "TimeSyncTEDS",
    AccessCode.SECURITY: "SecurityTEDS",
}

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


ANY_LENGTH: Final = frozenset({"text", "key", "octets"})
"""Kinds of value of which every number of octets can be read."""


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
    any_length: bool = field(init=False, repr=False, compare=False)
    required: frozenset[int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        required = frozenset(child.type for child in self.children if child.need == "R")
        object.__setattr__(self, "required", required)
        object.__setattr__(self, "by_type", {child.type: child for child in self.children})
        object.__setattr__(self, "by_name", {child.name: child for child in self.children})
        object.__setattr__(self, "octets", OCTETS.get(self.kind, ()))
        object.__setattr__(self, "any_length", self.kind in ANY_LENGTH)


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
