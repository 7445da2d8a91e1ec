"""One run of a line: what its job allows, a unit for each board, and proof at the end (contract/plant.md section 9)."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from typing import Any, Final

from teds_provision.errors import KeyMismatchError, NotFoundError, PolicyError, TedsProvisionError
from teds_provision.files import make_folder, read_limited
from teds_provision.plant.apply_pages import heads_digest
from teds_provision.plant.evidence import TOOL, sign_evidence
from teds_provision.plant.jobs import (
    digest_of_file,
    now_of,
    profile_file,
    require_adopted,
    require_open,
    roster_of,
)
from teds_provision.plant.sign_requests import Office, SignatureOrder, by_office
from teds_provision.protocol.datasheet import SignedNodeKey
from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.plant.evidence import FAILED, PASSED, BoardFacts, EvidenceClaim, blocks_of, firmware_facts
from teds_provision.protocol.plant.job import WORTH, Job
from teds_provision.provisioning.batch_sheet import BoardResult
from teds_provision.provisioning.board_type import WrongBoardError
from teds_provision.provisioning.build import BuildOrder, PreparedOrder, Proposal, prepare, profile_files_digest
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.identify import IdentifiedNode
from teds_provision.provisioning.progress import DONE, StepResult
from teds_provision.provisioning.progress import FAILED as STEP_FAILED
from teds_provision.provisioning.provision import ProvisionResult
from teds_provision.provisioning.sign import SignResult
from teds_provision.provisioning.teds_read import NodeSnapshot
from teds_provision.station.label import label_of, read_label, write_label
from teds_provision.station.plant.line import EvidenceRow, UnitRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry, utc_now
from teds_provision.teds.certificate import certificate_reference_of
from teds_provision.teds.codec import security
from teds_provision.teds.codec.security import SecurityTeds
from teds_provision.teds.image import Image
from teds_provision.teds.origin import origin_of

_MAX_CALIBRATION: Final = 1 << 20
_NO_CALIBRATION: Final = BuildOrder(drop_calibration=True)


@dataclass
class LineRun:
    """State that all boards of a run share: a job, or (``job`` None) only the request for evidence.

    ``order``: what every board gets if there is no job. ``calibrations`` is a folder with a file ``UUID.*`` for each
    board, or one file for a job whose rule is ``one``. Everything that can be refused before a tap is refused when this
    is made: raises PolicyError, NotFoundError, BadDataError.
    """

    station: Station
    job: Job | None
    order_of_all: BuildOrder = field(default_factory=BuildOrder)
    calibrations: Path | None = None
    operator: str | None = None
    office: Office | None = None
    only_verify: bool = False
    label_to: Path | None = None
    """A folder for the labels of boards that passed, and what kind: DIR/x.svg or DIR/x.png."""
    scans: Scans | None = None
    _turn: threading.Lock = field(default_factory=threading.Lock)
    _digests: dict[bytes, str] = field(default_factory=dict)
    _common: dict[str | None, PreparedOrder] = field(default_factory=dict)
    _units_as_json: dict[bytes, dict[str, Any]] = field(default_factory=dict)
    _given: int = 0
    """How many units of the job were given here at least."""
    _restored: bool = False

    def __post_init__(self) -> None:
        if self.job is None:
            return
        self._require_open()
        roster = self.station.plant.roster
        if not self.only_verify and roster is not None and not roster.has(self._own, "line"):
            raise PolicyError(
                "This station may not key new boards: it does not have the role 'line' in the roster.",
                hint="Ask the owner for it: teds-provision registry role NAME line",
            )
        profile_file(self.station, self.job)
        self.order_of_all = replace(_NO_CALIBRATION, profile=self.job.profile)
        if self.job.calibration.rule == "one" and not self.only_verify:
            self._common_calibration()
        self._given = self.station.plant.line.count_units(self.job.id)[0]
        self._restored = self.station.plant.restored

    @property
    def _own(self) -> str:
        return self.station.identity.fingerprint

    def _require_open(self) -> None:
        assert self.job is not None
        require_open(self.station, self.job)

    @property
    def base(self) -> BuildOrder:
        """Settings that are the same for all boards."""
        return self.order_of_all

    @property
    def total(self) -> int:
        """How many boards the job is for, 0 outside one."""
        return self.job.total if self.job is not None else 0

    @property
    def passed(self) -> int:
        """How many units have passed here, over all runs."""
        return self.station.plant.line.count_units(self.job.id)[1] if self.job is not None else 0

    def unit_to_json(self, uuid: bytes) -> dict[str, Any]:
        """Return a board's members beside its steps: job, unit, of how many, attempt, SHA-256 of its evidence."""
        return self._units_as_json.get(uuid, {})

    def is_listed(self, uuid: bytes) -> bool:
        """Return True if the job names this UUID."""
        return self.job is not None and uuid in self.job.boards

    def lists(self, who: IdentifiedNode) -> bool:
        """Return True if the job names this very board: that is a keeper's confirmation of it."""
        return self.is_listed(who.uuid) and self.job is not None and self.job.boards[who.uuid] == who.fingerprint

    # -- the order for a board -------------------------------------------------------------------------------------

    def order(self, who: IdentifiedNode) -> PreparedOrder:
        """Return what this board gets; raises PolicyError (not in the job, its calibration), KeyMismatchError."""
        job = self.job
        if self.scans is not None:
            self.scans.require(who)
        if job is None:
            return self._with_digest(
                self.order_of_all.calibration, who.uuid, lambda: prepare(self.station, self.order_of_all, who.uuid)
            )
        self._require_open()  # the job may have ended since the run began
        if job.boards:
            listed = job.boards.get(who.uuid)
            if listed is None:
                raise PolicyError(f"Board {who.uuid.hex()} is not on the job's list.", hint="Set it aside.")
            if not same_key(listed, who.fingerprint):
                raise KeyMismatchError(
                    f"Board {who.uuid.hex()} holds the key {who.fingerprint[:32]}; the job says {listed[:32]}.",
                    hint="It may be another board under the same UUID. Set it aside.",
                )
        path = None if self.only_verify else self._calibration_of(who.uuid)
        if path is None:
            return self._prepared(None, self.order_of_all)
        digest = digest_of_file(path)
        wanted = job.calibration.wants(who.uuid)
        if wanted is not None and digest != wanted:
            raise PolicyError(f"The calibration {path} is not the one the job specifies for {who.uuid.hex()}.")
        order = replace(self.order_of_all, calibration=path, drop_calibration=False)
        one_for_all = job.calibration.rule == "one"
        prepared = self._with_digest(
            path, who.uuid, lambda: self._prepared(digest, order) if one_for_all else self._read(order, who.uuid)
        )
        if job.calibration.rule == "any":
            self._require_fresh(path, prepared)
        return prepared

    def _with_digest(self, calibration: Path | None, uuid: bytes, read: Callable[[], PreparedOrder]) -> PreparedOrder:
        """Return the result of ``read``, and record the digest of the calibration's file for the evidence.

        Raises PolicyError if the file changed meanwhile: a bench writes calibrations beside the line.
        """
        digest = digest_of_file(calibration) if calibration is not None and calibration.is_file() else None
        prepared = read()
        if calibration is not None and digest_of_file(calibration) != digest:
            raise PolicyError(
                f"The calibration {calibration} changed while it was being read.", hint="Tap the board again."
            )
        if digest is not None:
            with self._turn:
                self._digests[uuid] = digest
        return prepared

    def _prepared(self, calibration: str | None, order: BuildOrder) -> PreparedOrder:
        """Return what all boards get alike, read and guarded once a run; ``calibration`` is the SHA-256 of its file."""
        with self._turn:
            if calibration not in self._common:
                self._common[calibration] = self._read(order)
            return self._common[calibration]

    def _read(self, order: BuildOrder, uuid: bytes | None = None) -> PreparedOrder:
        """Read an order; raises PolicyError if the profile's file was changed since the run began.

        The digest that evidence names must be of what was read, and files are edited beside a run of many hours.
        """
        assert self.job is not None
        prepared = prepare(self.station, order, uuid)
        profile_file(self.station, self.job)
        return prepared

    def _calibration_of(self, uuid: bytes) -> Path | None:
        assert self.job is not None
        rule = self.job.calibration.rule
        if rule == "none":
            return None
        if rule == "one":
            return self._common_calibration()
        folder = self.calibrations
        if folder is None or not folder.is_dir():
            raise NotFoundError(
                "This job requires a calibration for each board.", hint="Give their directory: --calibrations DIR"
            )
        found = sorted(path for path in folder.glob(f"{uuid.hex()}.*") if path.is_file())
        if len(found) != 1:
            there = "no file" if not found else f"{len(found)} files"
            raise NotFoundError(
                f"There is {there} {uuid.hex()}.* in {folder}.", hint="Copy this board's calibration there."
            )
        return found[0]

    def _common_calibration(self) -> Path:
        """Return the one file for all boards, found by its digest."""
        assert self.job is not None
        place = self.calibrations
        files = [] if place is None else [place] if place.is_file() else sorted(place.glob("*"))
        for path in files:
            if path.is_file() and digest_of_file(path) == self.job.calibration.sha256:
                return path
        raise NotFoundError(
            f"The job's calibration (SHA-256 {self.job.calibration.sha256}) was not found.",
            hint="Give its file or directory: --calibrations PATH",
        )

    def _require_fresh(self, path: Path, prepared: PreparedOrder) -> None:
        assert self.job is not None
        days = self.job.calibration.max_age_days or 0
        now = now_of(roster_of(self.station))
        for number, calibration in (prepared.calibrations or {}).items():
            if calibration.date is None or not now - timedelta(days=days) <= calibration.date <= now + timedelta(
                days=1
            ):
                when = "has no date" if calibration.date is None else f"is dated {calibration.date:%Y-%m-%d}"
                raise PolicyError(
                    f"The calibration {path} of channel {number} {when}; the job allows at most {days} days."
                )

    # -- units -----------------------------------------------------------------------------------------------------

    def allot_unit(
        self, node: Conversation, who: IdentifiedNode, prepared: PreparedOrder, entry: WhitelistEntry | None
    ) -> LineUnit:
        """Have the board's unit taken by the run's next durable step, or a further attempt counted.

        Raises PolicyError if none is left, as does that step if another process takes the last one meanwhile.
        """
        job, begun = self.job, utc_now()
        held = entry if entry is not None else who.whitelisted
        assurance = "tap" if node.tapped else held.assurance if held is not None else "uuid"
        if job is None:
            attempt = self.station.plant.line.last_attempt(who.uuid) + 1
            return LineUnit(self, prepared, None, attempt, assurance, begun)
        if self.only_verify:
            line = self.station.plant.line
            mine = sum(1 for _ in line.evidence(uuid=who.uuid, job=job.id))
            with self._turn:
                self._units_as_json[who.uuid] = {"job": job.id, "attempt": mine + 1}
            return LineUnit(self, prepared, line.unit(job.id, who.uuid), mine + 1, assurance, begun)
        if WORTH.get(assurance, 0) < WORTH[job.assurance]:
            raise PolicyError(
                f"The job requires assurance '{job.assurance}'; board {who.uuid.hex()} was identified by"
                f" '{assurance}'.",
                hint="Tap it on the NFC reader." if job.assurance == "tap" else "Connect it to a wired bus, or tap it.",
            )
        self._require_unit_left(job, who.uuid)
        unit = LineUnit(self, prepared, None, 0, assurance, begun)
        unit.wait_for(job, who.uuid)
        return unit

    def unit_kept(self, uuid: bytes, facts: dict[str, Any]) -> None:
        """Take note of a unit that is on the disk now."""
        with self._turn:
            self._units_as_json[uuid] = facts

    def _require_unit_left(self, job: Job, uuid: bytes) -> None:
        """Raise PolicyError before anything is asked of a board that is known to get no unit.

        Units are never taken back, so while there were enough when this was last looked at here, the transaction that
        takes one is soon enough.
        """
        if self._given >= self._allotment(job) or self._restored:
            self.next_row(job, uuid)

    def _allotment(self, job: Job) -> int:
        return job.stations[self._own] if job.count is not None else len(job.boards)

    def next_row(self, job: Job, uuid: bytes) -> UnitRow:
        """Return the unit of this board with one more attempt; raises PolicyError if none is left.

        It counts in the transaction that keeps it.
        """
        line = self.station.plant.line
        kept = line.unit(job.id, uuid)
        if kept is not None:
            return replace(kept, attempts=kept.attempts + 1)
        require_adopted(self.station)
        given, _, greatest = line.count_units(job.id)
        allotment = self._allotment(job)
        self._given = max(self._given, given + 1)
        if given >= allotment:
            raise PolicyError(
                f"All {allotment} units of the job “{job.title}” for this station are assigned: {uuid.hex()} is"
                " one too many.",
                hint="Lay it aside, or ask the keeper for another job.",
            )
        return UnitRow(job.id, uuid, greatest + 1, utc_now())

    def keep(self, document: bytes, claim: EvidenceClaim, finished: str, unit: LineUnit) -> None:
        """Keep the evidence of a claim, whole, and whether the unit passed."""
        digest, uuid, facts = hashlib.sha256(document).hexdigest(), claim.uuid, claim.facts
        passed, line = facts.failure is None, self.station.plant.line
        verdict = PASSED if passed else FAILED
        row = EvidenceRow(digest, uuid, facts.job, facts.unit, facts.attempt, verdict, finished, document)
        with self.station.durable("evidence"):
            line.add_evidence(row)
            self.note(uuid, unit, passed=passed)
            self.station.audit("evidence", uuid, verdict, sha256=digest, attempt=facts.attempt)
            members = {"sha256": digest, "job": facts.job, "unit": facts.unit}
            self.station.plant.record_event(
                "evidence", uuid, **members, verdict=verdict if passed else f"{verdict}: {facts.failure}"
            )
        with self._turn:
            self._units_as_json.setdefault(uuid, {})["evidence"] = digest

    def passed_board(self, uuid: bytes) -> None:
        """Print its label, and wait for the next scan."""
        if self.scans is not None:
            self.scans.clear(uuid)
        if self.label_to is not None:
            make_folder(self.label_to.parent)
            path = self.label_to.with_name(f"{uuid.hex()}{self.label_to.suffix}")
            write_label(label_of(self.station, uuid), path)
            with self._turn:
                self._units_as_json.setdefault(uuid, {})["label"] = str(path)

    def note(self, uuid: bytes, unit: LineUnit, *, passed: bool) -> None:
        """Note the attempt at which the unit passed first; in the caller's transaction."""
        if unit.row is not None and passed and not self.only_verify:
            self.station.plant.line.put_passed(unit.row.job, uuid, unit.attempt)

    def calibration_digest(self, uuid: bytes) -> str | None:
        """Return the SHA-256 of the calibration file that a board got, None for none."""
        return self._digests.get(uuid)


class Scans:
    """Labels that a scanner types, one a line: the next board must be the one that was scanned last."""

    def __init__(self, lines: Iterable[str], notice: Callable[[str], object] = lambda text: None) -> None:
        self._lines, self._notice = lines, notice
        self._expected: tuple[bytes, str | None] | None = None
        self._turn = threading.Lock()

    def listen(self) -> None:
        """Take label after label until there are no more; for a separate thread."""
        for line in self._lines:
            self.add_label(line)

    def add_label(self, text: str) -> None:
        """Take one label; report a malformed one."""
        found: tuple[bytes, str | None] | None = read_label(text)
        digits = text.strip().lower()
        if found is None and len(digits) == 20 and set(digits) <= set("0123456789abcdef"):
            found = bytes.fromhex(digits), None
        if found is None and digits:
            self._notice(f"This is not a board label: {digits[:40]}")
        elif found is not None:
            with self._turn:
                self._expected = found
            self._notice(f"Waiting for board {found[0].hex()}.")

    def require(self, who: IdentifiedNode) -> None:
        """Raise PolicyError if no label was scanned, WrongBoardError if another board's was."""
        with self._turn:
            expected = self._expected
        if expected is None:
            raise PolicyError(f"Scan the label of board {who.uuid.hex()} first.", hint="Then tap it again.")
        uuid, key = expected
        if uuid != who.uuid or (key is not None and not same_key(key, who.fingerprint)):
            raise WrongBoardError(
                f"The scanned label belongs to board {uuid.hex()}, but this is board {who.uuid.hex()}.",
                hint="Use the board with that label, or scan the label of this board.",
            )

    def clear(self, uuid: bytes) -> None:
        """Forget the scan of a board that is done: the next one needs its own."""
        with self._turn:
            if self._expected is not None and self._expected[0] == uuid:
                self._expected = None


@dataclass
class LineUnit:
    """One board of a run; see :class:`teds_provision.provisioning.provision.Unit`."""

    run: LineRun
    _prepared: PreparedOrder
    row: UnitRow | None
    attempt: int
    assurance: str
    begun: str
    _waits: bool = False
    """True from when its unit is to be taken until it is on the disk."""

    @property
    def prepared(self) -> PreparedOrder:
        """The board's order; waits until the unit, on which its name depends, is on the disk."""
        if self._waits:
            self.run.station.write_joining()
        return self._prepared

    def wait_for(self, job: Job, uuid: bytes) -> None:
        """Have the run's next durable step take the unit; raises what that raises if there is no run."""
        station, row = self.run.station, UnitRow(job.id, uuid, 0, "")

        def take() -> None:
            nonlocal row
            row = self.run.next_row(job, uuid)
            station.plant.line.put_unit(row)
            station.audit("unit", uuid, "taken", job=job.id, unit=row.unit, attempt=row.attempts)

        def taken() -> None:
            name = job.name_for(uuid, row.unit)
            if name is not None:
                self._prepared = replace(self._prepared, order=replace(self._prepared.order, name=name))
            self.row, self.attempt, self._waits = row, row.attempts, False
            facts = {"job": job.id, "unit": row.unit, "of": job.total, "attempt": row.attempts}
            self.run.unit_kept(uuid, facts)

        self._waits = True
        station.join_next_step(take, taken)

    def sign(
        self, node: Conversation, keys: SignedNodeKey, proposal: Proposal, present: NodeSnapshot
    ) -> SignResult | None:
        """Return the datasheet signed by the job's office; None if this station signs."""
        job, station = self.run.job, self.run.station
        if job is None or job.office in (None, station.identity.fingerprint):
            return None
        if self.run.office is None:
            raise PolicyError(
                "An office signs for this job, but this station has no way to reach it.",
                hint="Give a transfer folder: --files DIR",
            )
        assert job.office is not None
        path = self.prepared.order.calibration
        wanted = SignatureOrder(
            job.id,
            job.office,
            proposal.image,
            proposal.name,
            read_limited(path, _MAX_CALIBRATION, "calibration") if path is not None else None,
            present.identity.epoch,
            present.identity.sequence,
            proposal.profile,
        )
        intact = present.image.unsigned_blocks() == proposal.image.unsigned_blocks()
        return by_office(station, self.run.office, node, keys, wanted, present.image.security if intact else None)

    def ended(self, node: Conversation, done: ProvisionResult) -> None:
        """Have the board sign the facts, and keep the evidence; without one, note that the unit passed."""
        failure = BoardResult(done.who.uuid, 0.0, done).failure
        teds = done.image.security
        assert teds is not None, "what was verified has a Security TEDS"
        if self._wanted:
            steps = _step_facts(done.steps)
            if failure is not None:
                steps = (*steps, ("verdict", failure.code, 0))
            self._keep(node, done.who.uuid, teds, steps, done.image)
        else:
            with self.run.station.durable("job"):
                self.run.note(done.who.uuid, self, passed=failure is None)
        if failure is None:
            self.run.passed_board(done.who.uuid)

    def failed(
        self, node: Conversation, who: IdentifiedNode, steps: Sequence[StepResult], step: str, error: TedsProvisionError
    ) -> None:
        """Record evidence of the failure, with the board's signature if it still answers; nothing without a unit."""
        if not self._wanted:
            return
        with suppress(PolicyError):  # another process took the last unit
            self.run.station.write_joining()
        if not self._waits:
            steps_so_far = (*_step_facts(steps), (step, error.code, 0))
            last = self.run.station.datasheets.datasheet(who.uuid)
            self._keep(node, who.uuid, who.security_teds, steps_so_far, last)

    @property
    def _wanted(self) -> bool:
        return self.run.job is None or self.run.job.evidence

    def _keep(
        self, node: Conversation, uuid: bytes, teds: bytes, steps: tuple[tuple[str, str, int], ...], image: Image | None
    ) -> None:
        """Have the facts signed, and keep the evidence; ``image`` is what was read of the board last."""
        station, shown = self.run.station, security.decode(teds)
        credentials = station.credentials(uuid)
        certificates, origin = _named_in(image, shown)
        with station.reading():
            job, row = self.run.job, station.nodes.get(uuid)
            heads = heads_digest(station) if station.plant.joined is not None else None
        facts = BoardFacts(
            station=fingerprint(credentials.key.point),
            job=job.id if job is not None else None,
            unit=self.row.unit if self.row is not None else None,
            attempt=self.attempt,
            profile=job.profile if job is not None else row.profile if row is not None else None,
            profile_sha256=job.profile_sha256 if job is not None else profile_files_digest(station, row),
            calibration_sha256=self.run.calibration_digest(uuid),
            epoch=shown.key_epoch,
            sequence=shown.sequence,
            blocks=blocks_of(shown),
            steps=steps,
            assurance=self.assurance,
            tool=TOOL,
            begun=self.begun,
            heads=heads,
            certificates=certificates,
            origin=origin,
            firmware=_firmware_in_session(node),
        )
        claim, finished = EvidenceClaim(uuid, teds, facts), utc_now()
        document = sign_evidence(node, credentials, claim, operator=self.run.operator, finished=finished)
        self.run.keep(document, claim, finished, self)


def _firmware_in_session(node: Conversation) -> tuple[str, str, str, int] | None:
    """Return what the board reported in the session that is open, None for nothing; asks no further question."""
    if not node.sealed or node.reported_firmware is None:
        return None
    session, report = node.reported_firmware
    return None if report is None or session != node.open_counter else firmware_facts(report)


def _named_in(image: Image | None, shown: SecurityTeds) -> tuple[tuple[tuple[int, str], ...], str | None]:
    """Return the certificates by channel and the origin that a board's datasheet names.

    Only TEDS count whose digest the Security TEDS lists: the image is what was read of the board last.
    """
    blocks = {} if image is None else image.blocks
    listed = {
        place: blocks[place]
        for place, digest in shown.signed_blocks.items()
        if place in blocks and hashlib.sha256(blocks[place]).digest() == digest
    }
    found = ((channel, certificate_reference_of(listed, channel)) for channel in sorted({place[0] for place in listed}))
    origin = origin_of(listed)
    named = tuple((channel, reference.sha256) for channel, reference in found if reference is not None)
    return named, origin.lines if origin is not None else None


def _step_facts(steps: Sequence[StepResult]) -> tuple[tuple[str, str, int], ...]:
    """Return name, result and milliseconds of steps; a verdict is a separate step, with the code of its error."""
    return tuple(
        (step.name, DONE if step.result == STEP_FAILED else step.result, round(step.seconds * 1000)) for step in steps
    )
