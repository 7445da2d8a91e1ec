"""A decoded TEDS in the words of the other edition, with a finding for everything that the other cannot say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from teds_provision.errors import BadData
from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.composer import NO_SUBFAMILY, Composer, recompose, tuple_width
from teds_provision.teds.codec.frame import TEDSID, frame, raw_tuple
from teds_provision.teds.codec.model import Decoded, Edition, Field, Finding, Severity, TimeInstance, Units
from teds_provision.teds.codec.tables import ONLY_2024, TEXT_BASED, FieldSpec, Table, table

_VERSIONS: Final = {(2007, 1): 2, (2024, 2): 1}
_UUID_OCTETS: Final = {2007: 10, 2024: 16}


def convert(decoded: Decoded, edition: Edition, *, uuid: bytes | None = None) -> tuple[bytes, list[Finding]]:
    """Convert a decoded TEDS to an edition, framed or bare as it came; findings say what was changed or lost.

    A UUID of one edition cannot be said in the other: ``uuid`` gives the new one, else the field is left out (an error
    finding). The profile's Security TEDS (access code 128) has one form only and is returned as it is. Raises BadData
    for octets that have no fields to convert, or no TEDSID.
    """
    if decoded.edition is None or decoded.access_code is None or decoded.verdict in {"malformed", "message"}:
        raise BadData(f"This cannot be converted: it is no TEDS of known edition (verdict {decoded.verdict}).")
    if decoded.edition == edition:
        return decoded.octets, []
    conversion = _Conversion(decoded, table(decoded.access_code), edition, uuid)
    if decoded.access_code == AccessCode.SECURITY:
        conversion.say("note", "one-form", "The Security TEDS of the profile has one form in both editions.", None)
        return decoded.octets, conversion.findings
    return conversion.octets(), conversion.findings


@dataclass
class _Conversion:
    decoded: Decoded
    table: Table
    edition: Edition
    uuid: bytes | None
    findings: list[Finding] = field(default_factory=list)

    def say(self, severity: Severity, code: str, message: str, part: Field | None, asked: str = "") -> None:
        offset, name = (part.offset, part.name) if part is not None else (None, "")
        found = part.raw[:32].hex() if part is not None else ""
        self.findings.append(Finding(severity, code, message, offset, name, asked, found))

    def octets(self) -> bytes:
        if self.table.access_code in ONLY_2024 and self.edition == 2007:
            self.say("error", "class", f"The 2007 edition has no {self.table.name}.", None)
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
            self.say("note", "version", f"The TEDSID keeps its version {version}, which has no equal.", part)
        if self.edition == 2007 and part.raw[1] != NO_SUBFAMILY:
            self.say("error", "lost", f"The 2007 edition cannot say the sub-family {part.raw[1]}.", part)
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
            return composer.tuple(part.type, inner)
        return composer.tuple(part.type, part.raw)

    def unknown(self, part: Field, composer: Composer) -> bytes:
        if part.type >= 128 or self.table.verified:
            self.say("note", "kept", f"The field {part.type} is unknown; its octets are kept as they are.", part)
        return composer.tuple(part.type, part.raw)

    def identifier(self, part: Field, composer: Composer) -> bytes:
        wanted = _UUID_OCTETS[self.edition]
        if self.uuid is not None:
            if len(self.uuid) != wanted:
                raise BadData(f"The UUID has {wanted} octets in the {self.edition} edition, not {len(self.uuid)}.")
            return composer.tuple(part.type, self.uuid)
        message = f"A UUID of {len(part.raw)} octets cannot be said in {wanted}; it is left out."
        self.say("error", "lost", message, part, f"{wanted} octets")
        return b""

    def units(self, part: Field, spec: FieldSpec, composer: Composer) -> bytes:
        if not isinstance(part.value, Units):
            return part.raw
        strange = [child.type for child in part.children if child.type not in spec.by_type]
        if strange:
            self.say("error", "lost", f"Packed units have no place for the fields {strange} of {part.name}.", part)
        return composer.value(spec, part.value)

    def instant(self, part: Field, spec: FieldSpec, composer: Composer) -> bytes:
        if isinstance(part.value, TimeInstance):
            try:
                return composer.tuple(part.type, composer.value(spec, part.value))
            except BadData as error:
                self.say("error", "lost", f"{error.message} It is left out.", part)
                return b""
        return composer.tuple(part.type, part.raw)

    def text(self, composer: Composer) -> bytes:
        """Text-based TEDS: the directory is written anew where it describes the texts; else all is kept behind it."""
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
            raise BadData("A text-based TEDS whose TEDSID is not first cannot be converted.")
        self.say("warning", "kept", "The directory does not describe the texts; it is kept, Offset and all.", None)
        old = recompose(self.decoded)
        block = old[4:-2] if self.decoded.framed else old
        return self.framed(self.tedsid(first, composer.width) + block[2 + len(first.raw) :])

    def directory(self) -> list[Field]:
        """One entry for each text; none where the directory does not describe them, or holds more than it should."""
        fields = self.decoded.fields
        standard = {"TEDSID", "NumLang", "DirBlock", "SubSum"}
        if fields[0].name != "TEDSID" or any(part.name not in standard for part in fields):
            return []
        entries = [part for part in fields if part.name == "DirBlock"]
        return entries if len(entries) == len(self.decoded.text) else []


def _directory(entry: Field) -> dict[str, object]:
    parts = {child.name: child.value for child in entry.children if child.name in {"LangCode", "Compress"}}
    return {**parts, "Compress": parts.get("Compress", 0), "LangCode": parts.get("LangCode", "en")}
