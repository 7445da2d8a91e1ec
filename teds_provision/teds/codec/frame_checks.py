"""The head of a decoding: Length and checksum, TEDSID, and the list of findings."""

from __future__ import annotations

from typing import Final

from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.frame import MINIMUM_OCTETS, TEDSID, checksum
from teds_provision.teds.codec.model import MALFORMED_CODES, Edition, Finding, Severity
from teds_provision.teds.codec.tables import MANUFACTURER, ONLY_2024, Table, table

MAX_OCTETS: Final = 16 << 20
MAX_TUPLES: Final = 32768
MAX_FINDINGS: Final = 1000


class Head:
    """What is known of some octets before their tuples are walked: frame, edition, class, width."""

    def __init__(self, octets: bytes, *, framed: bool) -> None:
        self.octets = octets
        self.framed = framed
        self.findings: list[Finding] = []
        self.errors = 0
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
        elif len(self.findings) - self.errors >= MAX_FINDINGS:
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
        """A whole TEDS with more octets behind it, as a dump of flash gives: decoded up to its checksum."""
        end = length + 4
        if not MINIMUM_OCTETS <= end < len(self.octets):
            return False
        if int.from_bytes(self.octets[end - 2 : end], "big") != checksum(self.octets[: end - 2]):
            return False
        more = len(self.octets) - end
        self.find("error", "frame-trailing", f"{more} octets stand behind the checksum of this TEDS.", end, "", 0, more)
        return True

    def tedsid(self, start: int, end: int) -> None:
        """Take edition, class and tuple width from the TEDSID, wherever it stands."""
        at = start if self.octets[start] == TEDSID else self.search_tedsid(start, end)
        self.tedsid_at = at
        if at != start:
            first = f"type {self.octets[start]}"
            self.find("error", "tedsid-first", "The TEDSID tuple is not first.", start, "TEDSID", "type 3", first)
        if at is None:
            self.find("note", "no-class", "There is no TEDSID: nothing says what the fields mean.", start)
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
        """Octets of the length part of all later tuples, 1 where the TEDSID asks for something impossible."""
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
        """Offset of the first tuple of type 3 with 4 or 5 octets, tuples having one length octet."""
        octets, at = self.octets, start
        while at + 1 < end:
            if octets[at] == TEDSID and octets[at + 1] in (4, 5):
                return at
            at += 2 + octets[at + 1]
        return None
