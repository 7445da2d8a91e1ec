"""Results of decoding: fields in wire order, findings, one verdict (words of the vectors' index)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from typing import Final, Literal, NamedTuple

from teds_provision.teds.codec.access_code import AccessCode

TEXT_BASED: Final = frozenset(
    {
        AccessCode.META_ID,
        AccessCode.CHANNEL_ID,
        AccessCode.CALIBRATION_ID,
        AccessCode.COMMANDS,
        AccessCode.TITLE,
        AccessCode.LOCATION,
        AccessCode.UNITS_EXTENSION,
    }
)
"""Classes whose content is text behind a directory (teds.md, "Text-based TEDS (2, 4, 6, 10, 11, 14, 15)")."""
ONLY_2024: Final = frozenset({AccessCode.SECURITY_2024, AccessCode.TIME_SYNC})
MANUFACTURER: Final = 128
"""First type and first access code of the manufacturers' range."""


Edition = Literal[2007, 2024]
Severity = Literal["error", "warning", "note"]


FRAME_CODES: Final = frozenset({"frame-length", "frame-checksum", "frame-trailing"})
MALFORMED_CODES: Final = frozenset({"not-closed", "too-short", "too-large", "too-many"})
"""Codes of findings that decide the verdict by themselves."""


class Conformity(StrEnum):
    """The degree to which octets follow the standard; framed TEDS, bare data blocks and messages are distinguished."""

    CLEAN = "clean"
    FRAME_BAD = "frame-bad"
    CONTENT_NONCONFORMANT = "content-nonconformant"
    FRAME_AND_CONTENT_BAD = "frame-and-content-bad"
    MALFORMED = "malformed"
    BLOCK_CLEAN = "block-clean"
    BLOCK_NONCONFORMANT = "block-nonconformant"
    MESSAGE = "message"

    @classmethod
    def from_findings(cls, framed: bool, findings: Iterable[Finding]) -> Conformity:
        """Return the conformity by the errors found; warnings and notes do not count."""
        frame = content = False
        for finding in findings:
            if finding.severity != "error":
                continue
            if finding.code in MALFORMED_CODES:
                return cls.MALFORMED
            if finding.code in FRAME_CODES:
                frame = True
            else:
                content = True
        if not framed:
            return cls.BLOCK_NONCONFORMANT if content else cls.BLOCK_CLEAN
        if frame:
            return cls.FRAME_AND_CONTENT_BAD if content else cls.FRAME_BAD
        return cls.CONTENT_NONCONFORMANT if content else cls.CLEAN


@dataclass(frozen=True)
class Finding:
    """One deviation: its place, the rule, and the actual content.

    ``offset`` counts octets from the first octet given to the decoder; ``field`` is the field's name or ''.
    """

    severity: Severity
    code: str
    message: str
    offset: int | None = None
    field: str = ""
    asked: str = ""
    found: str = ""


@dataclass(frozen=True)
class Units:
    """Physical units (types 12, 46): interpretation 0 to 5 and exponents of rad, sr, m, kg, s, A, K, mol, cd.

    Exponents are multiples of 1/2; on the wire each is 2 × exponent + 128. ``extension`` is the access code of a Units
    Extension TEDS, 0 for none (teds.md, "Data types").
    """

    interpretation: int = 0
    radians: Fraction = Fraction(0)
    steradians: Fraction = Fraction(0)
    meters: Fraction = Fraction(0)
    kilograms: Fraction = Fraction(0)
    seconds: Fraction = Fraction(0)
    amperes: Fraction = Fraction(0)
    kelvins: Fraction = Fraction(0)
    moles: Fraction = Fraction(0)
    candelas: Fraction = Fraction(0)
    extension: int = 0


UNIT_PARTS: Final = (
    "radians",
    "steradians",
    "meters",
    "kilograms",
    "seconds",
    "amperes",
    "kelvins",
    "moles",
    "candelas",
)
"""Names of the exponents of Units, in the order of the wire."""


@dataclass(frozen=True)
class TimeInstance:
    """Seconds and nanoseconds since 1970-01-01, sign of the whole value apart (teds.md, "Data types")."""

    seconds: int
    nanoseconds: int = 0
    negative: bool = False


Value = int | float | str | bytes | Units | TimeInstance | tuple[int, ...] | tuple[float, ...] | None


class Field(NamedTuple):
    """One tuple: its type, name ('' when unknown), decoded value (None when nested or unknown), raw value octets.

    ``offset`` is that of the Type octet; ``children`` are the tuples of a nested structure.
    """

    type: int
    name: str
    value: Value
    raw: bytes
    offset: int
    children: tuple[Field, ...] = ()


@dataclass(frozen=True)
class DecodedTeds:
    """A decoded TEDS: never raised away, always with a verdict and the octets it came from."""

    octets: bytes
    framed: bool
    edition: Edition | None
    access_code: int | None
    name: str
    fields: tuple[Field, ...]
    findings: tuple[Finding, ...]
    verdict: Conformity
    text: tuple[bytes, ...] = ()

    def get(self, name: str) -> Value:
        """Return the value of the first field of that name at any depth, None if absent."""
        found = self.field(name)
        return None if found is None else found.value

    def field(self, name: str) -> Field | None:
        """Return the first field of that name, depth first."""
        pending = list(self.fields)
        while pending:
            first = pending.pop(0)
            if first.name == name:
                return first
            pending = [*first.children, *pending]
        return None
