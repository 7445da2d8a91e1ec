"""Many images at once: each judged as ``verify IMAGE`` judges one, on every core (``verify FILES…|DIR``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from teds_provision import teds
from teds_provision.errors import BadDataError, PolicyError, TedsProvisionError
from teds_provision.files import read_limited
from teds_provision.limits import LIMITS
from teds_provision.portable import cores_to_share
from teds_provision.provisioning.forked_workers import map_ranges
from teds_provision.provisioning.verify import TrustSource, require_authentic, snapshot_trust, verify_images
from teds_provision.shapes.problem import Failure, failure_of
from teds_provision.shapes.verdict import Check, Verification
from teds_provision.station.station import Station
from teds_provision.teds.codec import security
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.image import Image

_FEW: Final = 50
"""So many are judged sooner than another process is ready."""
_CHUNK: Final = 64
_TOGETHER: Final = 1 << 20
"""Octets of image files that are held at a time."""
_UNREADABLE: Final[dict[str, object]] = {"uuid": None, "scope": "image", "verdict": None, "checks": []}


@dataclass(frozen=True)
class FileVerdict:
    """Result of one file: its checks, or why it could not be read; ``exit_code`` of a command for it alone."""

    file: str
    verified: Verification | None = None
    warnings: tuple[str, ...] = ()
    exit_code: int = 0
    error: Failure | None = None

    @property
    def path(self) -> Path:
        """The file's path."""
        return Path(self.file)

    @property
    def word(self) -> str:
        """The verdict, or that there is none."""
        return self.verified.verdict if self.verified is not None else "unreadable"

    def to_json(self) -> dict[str, object]:
        """Return one object of the result."""
        judged = _UNREADABLE if self.verified is None else self.verified.to_json()
        out = {"file": self.file, **judged, "warnings": list(self.warnings)}
        if self.error is not None:
            out["error"] = self.error
        return out


@dataclass
class VerdictTotals:
    """Numbers of files by verdict; ``exit_code`` is that of the worst."""

    files: int = 0
    verdicts: dict[str, int] = field(default_factory=dict)
    exit_code: int = 0

    def add(self, verdict: FileVerdict) -> None:
        """Count one in."""
        self.files += 1
        word = verdict.word
        self.verdicts[word] = self.verdicts.get(word, 0) + 1
        if verdict.exit_code:
            self.exit_code = max(self.exit_code, verdict.exit_code, key=_WORST.index)

    def join(self, others: VerdictTotals) -> None:
        """Count in what was counted elsewhere."""
        self.files += others.files
        for word, count in others.verdicts.items():
            self.verdicts[word] = self.verdicts.get(word, 0) + count
        self.exit_code = max(self.exit_code, others.exit_code, key=_WORST.index)

    def to_json(self) -> dict[str, object]:
        """Return the last line."""
        return {"totals": {"files": self.files, **dict(sorted(self.verdicts.items()))}}


RowFormatter = Callable[[FileVerdict], str]
"""The line of one file, as it is shown; called in whichever process judged it."""

# From good to bad: a harmful calibration, a file that is missing or is not an image, one that is not authentic.
_WORST: Final = (0, 6, 7, 3, 8, 1, 4)


def verify_files(
    station: Station, files: Sequence[str], format_row: RowFormatter, *, processes: int | None = None
) -> Iterator[tuple[list[str], VerdictTotals]]:
    """Judge every file, in order, some at a time: yield the lines of ``format_row`` for each, and their totals.

    A fault of one is its verdict and stops no other. More than a few files are shared among ``processes`` (as many as
    there are cores), which format them too: lines are quicker to send than verdicts with all their checks.
    """
    workers = min(processes or cores_to_share(), (len(files) + _CHUNK - 1) // _CHUNK)
    work = _Work(snapshot_trust(station), format_row, files)
    if len(files) <= _FEW or workers <= 1:
        yield from (work.judge(range(at, at + 1)) for at in range(len(files)))
        return
    yield work.judge(range(1))  # loads the late modules before the fork
    size = min(_CHUNK, max(1, (len(files) - 1) // (4 * workers)))
    yield from map_ranges(
        work.judge, [range(at, min(at + size, len(files))) for at in range(1, len(files), size)], workers
    )


@dataclass(frozen=True)
class _Work:
    """Data that a process needs to judge files and to report them."""

    judging: TrustSource
    format_row: RowFormatter
    files: Sequence[str]

    def judge(self, places: range) -> tuple[list[str], VerdictTotals]:
        """Judge the files at these places of the list, which every process has."""
        lines, totals = [], VerdictTotals()
        for some in _some([self.files[place] for place in places]):
            for found in _judged(self.judging, some):
                totals.add(found)
                lines.append(self.format_row(found))
        return lines, totals


_Read = tuple[str, Image | TedsProvisionError]


def _some(files: Sequence[str]) -> Iterator[list[_Read]]:
    """Read images in chunks that are small enough for memory."""
    some: list[_Read] = []
    octets = 0
    for file in files:
        try:
            text = read_limited(file, LIMITS.teds_file, "image", failure=BadDataError)
            octets += len(text)
            some.append((file, security.require_our_wire(Image.from_json(text))))
        except TedsProvisionError as error:
            some.append((file, error))
        if octets > _TOGETHER:
            yield some
            some, octets = [], 0
    if some:
        yield some


def _judged(judging: TrustSource, some: Sequence[_Read]) -> Iterator[FileVerdict]:
    """Yield the verdicts of files that were read, in their order."""
    checks = iter(verify_images(judging, (image for _, image in some if isinstance(image, Image))))
    for file, image in some:
        if isinstance(image, Image):
            yield _verdict(file, image, next(checks))
        else:
            yield FileVerdict(file, exit_code=image.exit_code, error=failure_of(image))


def _verdict(file: str, image: Image, checks: Sequence[Check]) -> FileVerdict:
    verified = Verification(image.uuid, tuple(checks), scope="image")
    result = FileVerdict(file, verified)
    try:
        if verified.verdict != "authentic":
            require_authentic(verified)
        return _with_warnings(result, image)
    except TedsProvisionError as error:
        return _ended(result, error)


def _with_warnings(result: FileVerdict, image: Image) -> FileVerdict:
    """Look at the calibrations, as every command does before it trusts a datasheet."""
    if not any(code == AccessCode.CALIBRATION for _, code in image.blocks):
        return result  # saves loading the guard
    findings = teds.guard.check_calibration(image.unsigned_blocks())
    texts = tuple(f"channel {finding.channel}: {finding.message}" for finding in findings)
    harmful = [text for text, finding in zip(texts, findings, strict=True) if finding.severity == "error"]
    whole = replace(result, warnings=texts)
    return _ended(whole, PolicyError(f"The calibration is refused: {harmful[0]}.")) if harmful else whole


def _ended(result: FileVerdict, error: TedsProvisionError) -> FileVerdict:
    return replace(result, exit_code=error.exit_code, error=failure_of(error))
