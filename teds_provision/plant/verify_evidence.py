"""Evidence checked with nothing but files: no station, no store, no network (``evidence verify``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import BadDataError, NotAuthenticError, TedsProvisionError
from teds_provision.files import read_limited
from teds_provision.lazy import late
from teds_provision.portable import cores_to_share
from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.plant import evidence as codec
from teds_provision.protocol.plant.evidence import CheckedEvidence, Evidence, Signatures
from teds_provision.provisioning.forked_workers import map_ranges
from teds_provision.shapes.problem import failure_of
from teds_provision.teds.codec import security

if TYPE_CHECKING:
    from teds_provision.protocol.plant import document
    from teds_provision.protocol.plant import roster as rosters
    from teds_provision.protocol.plant.roster import Roster
    from teds_provision.provisioning import whitelist
else:  # a list of pins needs the store, a roster needs the signed documents; nothing else here does
    document, rosters = late("teds_provision.protocol.plant.document"), late("teds_provision.protocol.plant.roster")
    whitelist = late("teds_provision.provisioning.whitelist")

_FEW: Final = 50
"""So many are judged sooner than another process is ready."""
_CHUNK: Final = 64


@dataclass(frozen=True)
class EvidenceAnchors:
    """Trust anchors of evidence: the owner's CA key (65 octets); the roster; the key of each board."""

    ca: bytes
    pins: Mapping[bytes, str] | None = None
    roster: Roster | None = None

    @classmethod
    def from_files(cls, ca: bytes, pins: Path | None = None, roster: Path | None = None) -> EvidenceAnchors:
        """Read ``pins``, a whitelist file, and a roster that this CA signed.

        Raises NotFoundError, NotAuthenticError, BadDataError.
        """
        listed = (
            None
            if pins is None
            else {listed.uuid: listed.fingerprint or "" for listed in whitelist.read_whitelist(pins)}
        )
        named = (
            None if roster is None else rosters.open_roster(read_limited(roster, document.ROSTER.most, "roster"), ca)
        )
        return cls(ca, listed, named)

    def faults(self, evidence: Evidence) -> list[str]:
        """Return the faults of a document, a sentence each; empty for a good one."""
        one = codec.ready(evidence)
        return self.faults_of(one, codec.check_signatures(one))

    def faults_of(self, checked: CheckedEvidence, signatures: Signatures) -> list[str]:
        """Return the same as :meth:`faults`, for signatures that were checked already."""
        evidence = checked.evidence
        found = codec.faults_of(checked, signatures, self.ca)
        if self.roster is not None:
            found += _wrong_members(evidence, self.roster)
        if self.pins is not None:
            pinned = self.pins.get(evidence.uuid)
            if not pinned:
                found.append("its UUID is not in the pins file")
            elif not same_key(pinned, fingerprint(evidence.node)):
                found.append("its key differs from the one in the pins file")
        return found


def _wrong_members(evidence: Evidence, roster: Roster) -> Iterator[str]:
    """Yield a document's faults by the roster. A file cannot show when a lost or stolen station signed it."""
    station = evidence.facts.station
    yield from _gone(roster, station, "its station")
    if roster.by_key.get(station) is not None and not roster.roles_of(station) - {"audit"}:
        yield "its station has no role for working on boards"
    if evidence.verdict != codec.PASSED:
        return
    try:
        shown = security.decode(evidence.teds)
    except BadDataError:
        return  # reported elsewhere
    signer = fingerprint(shown.station_key) if shown.station_key is not None else ""
    if signer != station:
        yield from _gone(roster, signer, "the station that signed the datasheet")
    found = roster.by_key.get(signer)
    if found is not None and "sign" not in found.roles and not (found.signed and found.signed[0]):
        yield "the station that signed the datasheet does not have the role 'sign'"


def _gone(roster: Roster, station: str, what: str) -> Iterator[str]:
    left = roster.removed_one(station)
    if left is not None and left.why != "retired":
        yield f"{what} was removed: {left.why}"
    elif left is None and roster.member(station) is None:
        yield f"{what} is not in the roster"


@dataclass(frozen=True)
class JudgedEvidence:
    """Result of one file: its content and faults; ``exit_code`` of a command for it alone."""

    file: str
    evidence: Evidence | None = None
    faults: tuple[str, ...] = ()
    error: TedsProvisionError | None = None

    @property
    def path(self) -> Path:
        """The file's path."""
        return Path(self.file)

    @property
    def good(self) -> bool:
        """True if everything is valid, also of an attempt that failed."""
        return self.evidence is not None and not self.faults

    @property
    def exit_code(self) -> int:
        """0, 4 (not authentic), 3 (no such file), 8 (unreadable)."""
        if self.error is not None:
            return self.error.exit_code
        return NotAuthenticError.exit_code if self.faults else 0

    @property
    def word(self) -> str:
        """One word for the totals."""
        if self.evidence is None:
            return "unreadable"
        return self.evidence.verdict if self.good else "not authentic"

    def to_json(self) -> dict[str, Any]:
        """Return the members of one line of the result."""
        members: dict[str, Any] = {"file": self.file, "good": self.good, "faults": list(self.faults)}
        if self.evidence is not None:
            facts = self.evidence.facts
            members |= {
                "uuid": self.evidence.uuid.hex(),
                "verdict": self.evidence.verdict,
                "station": facts.station,
                "job": facts.job,
                "unit": facts.unit,
                "attempt": facts.attempt,
                "finished": self.evidence.finished,
            }
        if self.error is not None:
            members["error"] = failure_of(self.error)
        return members


@dataclass
class EvidenceTotals:
    """Numbers of files by verdict; ``exit_code`` is that of the worst."""

    files: int = 0
    words: dict[str, int] = field(default_factory=dict)
    exit_code: int = 0

    def add(self, judged: JudgedEvidence) -> None:
        """Count one in."""
        self.files += 1
        word = judged.word
        self.words[word] = self.words.get(word, 0) + 1
        if judged.exit_code:
            self.exit_code = max(self.exit_code, judged.exit_code, key=_WORST.index)

    def join(self, others: EvidenceTotals) -> None:
        """Count in what was counted elsewhere."""
        self.files += others.files
        for word, count in others.words.items():
            self.words[word] = self.words.get(word, 0) + count
        self.exit_code = max(self.exit_code, others.exit_code, key=_WORST.index)

    def to_json(self) -> dict[str, Any]:
        """Return the last line."""
        return {"totals": {"files": self.files, **dict(sorted(self.words.items()))}}


_WORST: Final = (0, 7, 3, 8, 1, 4)
RowFormatter = Callable[[JudgedEvidence], str]
"""The line of one file, as it is shown; called in whichever process judged it."""


def verify_evidence(
    grounds: EvidenceAnchors, files: Sequence[str], format_row: RowFormatter, *, processes: int | None = None
) -> Iterator[tuple[list[str], EvidenceTotals]]:
    """Judge every file, in order: yield the lines of ``format_row`` for each, and their totals.

    A fault of one stops no other.

    More than a few files are shared among ``processes`` (as many as there are cores).
    """
    work = _Work(grounds, format_row, files)
    workers = min(processes or cores_to_share(), (len(files) + _CHUNK - 1) // _CHUNK)
    if len(files) <= _FEW or workers <= 1:
        yield from (work.judge(range(at, min(at + _CHUNK, len(files)))) for at in range(0, len(files), _CHUNK))
        return
    yield work.judge(range(1))  # loads the late modules before the fork
    size = min(_CHUNK, max(1, (len(files) - 1) // (4 * workers)))
    ranges = [range(at, min(at + size, len(files))) for at in range(1, len(files), size)]
    yield from map_ranges(work.judge, ranges, workers)


@dataclass(frozen=True)
class _Work:
    grounds: EvidenceAnchors
    format_row: RowFormatter
    files: Sequence[str]

    def judge(self, places: range) -> tuple[list[str], EvidenceTotals]:
        lines, totals = [], EvidenceTotals()
        for judged in judge_files(self.grounds, [self.files[place] for place in places]):
            totals.add(judged)
            lines.append(self.format_row(judged))
        return lines, totals


def judge_file(grounds: EvidenceAnchors, path: Path) -> JudgedEvidence:
    """Judge one file; the result contains all faults."""
    return judge_files(grounds, [str(path)])[0]


def judge_files(grounds: EvidenceAnchors, files: Sequence[str]) -> list[JudgedEvidence]:
    """Judge some files: all are read, then all signatures are checked in a row."""
    read = [_read(file) for file in files]
    checked = [codec.check_signatures(event) if isinstance(event, CheckedEvidence) else None for event in read]
    found = []
    for file, judged, signatures in zip(files, read, checked, strict=True):
        if isinstance(judged, CheckedEvidence) and signatures is not None:
            found.append(JudgedEvidence(file, judged.evidence, tuple(grounds.faults_of(judged, signatures))))
        elif isinstance(judged, TedsProvisionError):
            found.append(JudgedEvidence(file, error=judged))
    return found


def _read(file: str) -> CheckedEvidence | TedsProvisionError:
    try:
        return codec.ready(codec.read(read_limited(file, codec.MAX_OCTETS, "evidence", failure=BadDataError)))
    except TedsProvisionError as error:
        return error
