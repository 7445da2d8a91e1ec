"""``provision`` for one node, tap after tap, by a sheet, or for every node of a bus at once."""

from __future__ import annotations

import getpass
import os
import threading
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Final

from teds_provision import __version__
from teds_provision.errors import (
    KeyMismatchError,
    NotAuthenticError,
    NotWhitelistedError,
    PolicyError,
    TedsProvisionError,
    UsageError,
    VaultLockedError,
)
from teds_provision.links import Contact, LinkSettings, Port, open_port
from teds_provision.links.ports import EarlyFinder
from teds_provision.one_core import one_core
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.adoption import read_factory_datasheet
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.batch_sheet import (
    BatchTotals,
    BoardResult,
    Progress,
    ReportHead,
    SheetRow,
    check_report,
    mean_steps,
    read_sheet,
    worse,
    write_report,
)
from teds_provision.provisioning.board_type import WrongBoardError, differences
from teds_provision.provisioning.build import (
    BuildOrder,
    PreparedOrder,
    compose,
    for_several,
    named_for,
    prepare,
    propose,
)
from teds_provision.provisioning.calibration_guard import merged
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.provisioning.early_reading import EarlyReading
from teds_provision.provisioning.identify import IdentifiedNode, examine
from teds_provision.provisioning.meeting import (
    IdleStop,
    continue_over_ble,
    drop_duplicate_uuids,
    meet,
    refuse_duplicate_uuids,
    watch_nodes,
)
from teds_provision.provisioning.operator import Operator
from teds_provision.provisioning.parallel import ParallelWork
from teds_provision.provisioning.progress import NodeReporter, Reporter
from teds_provision.provisioning.provision import ProductionLine, ProvisionResult, provision, verify_only
from teds_provision.provisioning.readings import verdict_of
from teds_provision.provisioning.teds_read import take_snapshot
from teds_provision.provisioning.verify_node import verify_in_session
from teds_provision.station.station import Station
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.image import Image
from teds_provision.teds.profile import default_folders, load_profile

_LEAVING_SECONDS: Final = 10.0
"""Seconds in which boards that are worked on end their durable steps, once their bus is closed."""
_TOKEN_WORKERS: Final = 1
"""A token takes one command at a time."""
_SHOWN: Final = 5
_AT_THE_BOARD: Final = ("numpy",)
"""Libraries that the reading of a sensor needs."""


@dataclass(frozen=True)
class ProvisionRequest:
    """A request to ``provision``: one node (None: the one that is there), or many.

    ``watch``: tap after tap. ``whole_bus``: all unfinished nodes of the bus. ``sheet``: the order for each board.
    ``operator``: who worked, for the report; "" for the user of this account.
    """

    node: str | None = None
    order: BuildOrder = field(default_factory=BuildOrder)
    watch: bool = False
    whole_bus: bool = False
    sheet: Path | None = None
    report: Path | None = None
    operator: str = ""

    @property
    def several(self) -> bool:
        """True if more than one node may be meant."""
        return self.watch or self.whole_bus or self.sheet is not None


_AFTER: Final = ("build", "sign", "write", "verify", "check")
"""Steps behind the key agreement."""


@dataclass(frozen=True)
class ProvisionPlan:
    """Preview of ``provision`` (``--dry-run``): its steps, and the changes in physical units, a sentence each."""

    uuid: bytes
    state: NodeState
    steps: tuple[str, ...]
    changes: tuple[str, ...]
    warnings: tuple[str, ...]


class BatchRun:
    """One run of ``provision``. Everything that was ordered is read, fitted and guarded when this is made.

    Raises UsageError, NotFoundError, BadDataError, PolicyError before any node is waited for.
    """

    def __init__(
        self,
        station: Station,
        links: LinkSettings,
        request: ProvisionRequest,
        reporter: Reporter,
        *,
        line: ProductionLine | None = None,
    ) -> None:
        self._station, self._request, self._reporter = station, request, reporter
        self._links = replace(links, via_chosen=True)  # a new board is tapped, unless a bus is named
        self.line = line
        _require_consistent(request, links)
        check_report(request.report)
        self.node = station.nodes.resolve(request.node) if request.node is not None else None
        wanted = line.base if line is not None else request.order
        order = for_several(wanted) if request.several else wanted
        self.prepared = prepare(station, order, self.node)
        if self.prepared.order.name is not None and self.node is not None:
            named_for(station, self.node, self.prepared)
        self.progress = _progress(station, request, order)
        self.expected = 0  # number of boards on a bus to work on, once found
        taps = self.progress is not None and not request.watch and not request.whole_bus
        self.stop = IdleStop(links.timeout if taps else None)  # a bus is searched once, without waiting for boards
        self._all_done = False
        self._early: EarlyReading | None = None
        self._turn = threading.Lock()
        self._rows: dict[bytes, SheetRow] = {}
        self._boards: list[BoardResult] = []
        self._began = time.monotonic()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the order, or the rows of the sheet, before the first board comes."""
        rows = (*self.progress.sheet.warnings, *self.progress.again) if self.progress is not None else ()
        return (*self.prepared.warnings, *rows)

    def unlock(self) -> None:
        """Open the vault (a passphrase may be asked for), unless nothing is left to do; raises StoreError."""
        if self.progress is None or self.progress.open:
            self._station.unlock()

    # -- one node --------------------------------------------------------------------------------------------------

    def one(self, operator: Operator) -> ProvisionResult:
        """Provision the one node; raises what ends it."""
        _load_ahead()
        with meet(self._station, self._links, self.node, self._reporter, before=self._station.unlock) as node:
            return self._provision(node, operator)

    def plan(self) -> ProvisionPlan:
        """Look at the one node, plainly, and return the preview; changes nothing anywhere."""
        with meet(self._station, self._links, self.node, self._reporter) as node:
            return self._plan_for(node)

    def _plan_for(self, node: Conversation) -> ProvisionPlan:
        who = examine(self._station, node)
        steps = ["identify"]
        steps += [] if who.whitelisted else ["whitelist"]
        steps += ["agree"] if who.state == NodeState.FACTORY or not self._station.keys.held(who.uuid) else []
        found = take_snapshot(node, initial=who.security_teds)
        named = named_for(self._station, who.uuid, self._for(who))
        if named.order.adopt and found.identity.state != NodeState.PROVISIONED:
            brought = read_factory_datasheet(self._station, found.image, name=named.order.name)
            return ProvisionPlan(who.uuid, who.state, (*steps, *_AFTER), (), (*brought.errors, *brought.warnings))
        proposal = propose(self._station, named, found, record=False)
        changes = tuple(change.text for change in proposal.changes)
        other = () if named.order.retype else differences(found.image.blocks, proposal.image)
        steps += _AFTER
        return ProvisionPlan(who.uuid, who.state, tuple(steps), changes, merged((*proposal.warnings, *other)))

    # -- many ------------------------------------------------------------------------------------------------------

    def __len__(self) -> int:
        """Return the number of boards of the sheet or of the job, 0 without either."""
        if self.progress is not None:
            return len(self.progress.rows)
        return self.line.total if self.line is not None else 0

    @property
    def passed(self) -> int:
        """How many boards have passed: of the sheet or job over all runs, else in this one."""
        if self.progress is not None:
            return len(self.progress.rows) - len(self.progress.open)
        if self.line is not None and self.line.total:
            return self.line.passed
        return sum(board.result == "passed" for board in self._boards)

    @property
    def ended(self) -> int:
        """How many boards of this run have ended, well or not."""
        return len(self._boards)

    @property
    def board_warnings(self) -> dict[str, list[bytes]]:
        """The warnings of the boards of this run, each with the UUIDs of those that have it."""
        found: dict[str, list[bytes]] = {}
        for board in self._boards:
            for warning in board.done.warnings if board.done is not None else ():
                found.setdefault(warning, []).append(board.uuid)
        return found

    @property
    def worst(self) -> TedsProvisionError | None:
        """The most important error of the boards of this run."""
        found: TedsProvisionError | None = None
        for board in self._boards:
            found = worse(found, board.failure)
        return found

    @property
    def of_a_job(self) -> bool:
        """True if a job counts the boards, and no sheet."""
        return self.line is not None and self.line.total > 0

    @property
    def next_row(self) -> SheetRow | None:
        """The row that the next board may be of."""
        return self.progress.next_row if self.progress is not None else None

    def board_of(self, row: SheetRow) -> str | None:
        """Return the UUID of the board that had this row before, None if none had."""
        return self.progress.board_of(row) if self.progress is not None else None

    def row(self, number: int) -> SheetRow:
        """Return the row of the sheet with that number, from 1."""
        assert self.progress is not None
        return self.progress.sheet.rows[number - 1]

    def plans(self) -> Iterator[ProvisionPlan | BoardResult]:
        """Yield the plan of every selected node of the bus, one after the other; or the reason for a refused board."""
        port = open_port(self._links)
        try:
            for contact in self._on_the_bus(port)[1]:
                began, uuid = time.monotonic(), contact.identity.uuid
                try:
                    with Conversation(contact, notice=self._reporter.notice) as node:
                        yield self._plan_for(node)
                    continue
                except SessionLostError as lost:
                    error = lost.cause
                except TedsProvisionError as failure:
                    error = failure
                self._boards.append(BoardResult(uuid, time.monotonic() - began, None, error, None, port.place))
                yield self._boards[-1]
        finally:
            port.close()

    def many(self, operator: Operator) -> Iterator[BoardResult]:
        """Provision board after board, or all at once; one that fails does not end it. At the end comes the report."""
        try:
            if self.progress is not None and not self.progress.open:
                return
            _load_ahead()
            self._station.unlock()
            for board in self._all_at_once(operator) if self._request.whole_bus else self._as_they_come(operator):
                self._note(board)
                yield board
        finally:
            if self._request.report is not None and self.progress is not None:
                write_report(self._request.report, self.progress, self._about())

    def _about(self) -> ReportHead:
        operator = self._request.operator or os.environ.get("SUDO_USER") or getpass.getuser()
        station = self._station
        return ReportHead(station.name, station.fingerprint, operator, f"teds-provision {__version__}")

    def totals(self) -> BatchTotals:
        """Return the totals: the whole sheet over all runs, or the nodes of this run."""
        if self.progress is not None:
            if self.stop.ran_out:
                self.progress.ran_out(f"was tapped within {self._links.timeout:.0f} s")
            elif self._request.whole_bus and self._all_done:
                self.progress.ran_out("answered on the bus")
            return self.progress.totals()
        results = [board.result for board in self._boards]
        passed_boards = [board.done for board in self._boards if board.done is not None and board.result == "passed"]
        steps = [{step.name: step.seconds for step in done.steps} for done in passed_boards]
        passed, seconds = results.count("passed"), round(time.monotonic() - self._began, 3)
        firsts: dict[bytes, bool] = {}  # of each board its first try; a "no" of the operator is none
        for board in self._boards:
            if board.result != "skipped":
                firsts.setdefault(board.uuid, board.result == "passed")
        share = round(sum(firsts.values()) / len(firsts), 4) if firsts else None
        skipped = results.count("skipped")
        return BatchTotals(passed, results.count("failed"), skipped, seconds, share, mean_steps(steps), self.worst)

    def _as_they_come(self, operator: Operator) -> Iterator[BoardResult]:
        def work(node: Conversation) -> ProvisionResult:
            with self.stop.working():
                return self._provision(node, operator)

        for arrival in watch_nodes(self._links, work, self._reporter, self.stop):
            row = self._rows.pop(arrival.uuid, None)
            number = row.number if row is not None else None
            board = BoardResult(arrival.uuid, arrival.seconds, arrival.result, arrival.error, number, arrival.place)
            self.stop.renew()
            yield board
            if self.progress is not None and not (self.progress.open if self._request.watch else self.progress.untried):
                self.stop.set()

    def _all_at_once(self, operator: Operator) -> Iterator[BoardResult]:
        with one_core(), closing(open_port(self._links)) as port:
            if isinstance(port, EarlyFinder):
                self._early = EarlyReading(at_once=self._at_once(port))
            answers, contacts = self._on_the_bus(port)
            yield from self._side_by_side(port, contacts, operator)
            if not self.stop.is_asked:
                self._all_done = True
                refuse_duplicate_uuids(answers)  # after the others, so that a conflict does not stop the finished part

    def _at_once(self, port: Port) -> int:
        """Return how many boards are worked on at a time: as many as the bus and the token bear."""
        token = self._station.identity.keystore.startswith("pkcs11:")
        return _TOKEN_WORKERS if token else port.capabilities.max_parallel

    def _on_the_bus(self, port: Port) -> tuple[list[Contact], list[Contact]]:
        """Return the nodes that answer, and those of them that are to be provisioned."""
        if not port.capabilities.many:
            raise UsageError(
                "--all needs a bus: a reader sees one node at a time.",
                hint="Use --watch to provision boards one tap after the other.",
            )
        answers = self._find_all(port)
        found = drop_duplicate_uuids(answers, self._reporter.notice)
        contacts = [contact for contact in found if self._is_meant(contact)]
        if not contacts:
            self._require_known(found)
        return answers, contacts

    def _find_all(self, port: Port) -> list[Contact]:
        """Return every node of the bus; new ones that may be meant are read in plain while others are asked."""
        seconds, notice, listen = self._links.timeout, self._reporter.notice, self._links.listen
        early = self._early
        if early is None or not isinstance(port, EarlyFinder):
            return port.find_all(seconds=seconds, notice=notice, listen=listen)

        def seen(contact: Contact) -> None:
            if self._may_be_meant(contact):
                early.add(contact)

        try:
            return port.find_all_early(seconds=seconds, notice=notice, listen=listen, seen=seen)
        finally:
            early.stop()

    def _may_be_meant(self, contact: Contact) -> bool:
        """Return True if it is on the whitelist, or may be in the sheet or the job."""
        if self.line is not None:
            return not self.line.only_verify
        return self.progress is not None or self._station.pins.entry(contact.identity.uuid) is not None

    def _side_by_side(self, port: Port, contacts: list[Contact], operator: Operator) -> Iterator[BoardResult]:
        """Provision each of these nodes in a thread, as many at a time as the bus and the token bear.

        Once a person asks to stop, no further node is begun; those that are begun are finished and yielded.
        """
        workers = max(1, min(self._at_once(port), len(contacts)))
        self.expected = len(contacts)
        work = ParallelWork(
            contacts, lambda contact: self._board(contact, port.place, operator), at_once=workers, name="node"
        )
        locked: VaultLockedError | None = None
        try:
            for done in work.results():
                if isinstance(done.error, VaultLockedError):  # ends the command after the boards in progress
                    locked = done.error
                else:
                    board = done.result()
                    if board is None:
                        self.expected -= 1
                    else:
                        yield board
                if self.stop.is_asked or locked is not None:
                    work.drop_waiting()
            if locked is not None:
                raise locked
        except BaseException:  # Ctrl-C: without this, a silent node would delay the end by up to a minute
            work.drop_waiting()
            port.close()
            work.wait(_LEAVING_SECONDS)
            raise

    def _require_known(self, found: list[Contact]) -> None:
        """Raise NotWhitelistedError if none of the nodes that answered is one of ours: nothing done is not all done."""
        if self.progress is not None or any(
            self._station.pins.entry(contact.identity.uuid) is not None for contact in found
        ):
            return
        uuids = [contact.identity.uuid.hex() for contact in found]
        raise NotWhitelistedError(
            f"{len(uuids)} node{'s' if len(uuids) > 1 else ''} answered, but none is on the whitelist: "
            f"{', '.join(uuids[:_SHOWN])}{', …' if len(uuids) > _SHOWN else ''}.",
            hint=f"Add them (teds-provision whitelist add {uuids[0]}), or list them in a sheet: --batch FILE.",
        )

    def _is_meant(self, contact: Contact) -> bool:
        """Return True if it is on the whitelist or in the sheet, and not finished yet.

        Reports those that are neither.
        """
        uuid = contact.identity.uuid
        listed = self._station.pins.entry(uuid) is not None
        if self.progress is not None and any(row.uuid in (uuid, None) for row in self.progress.open):
            return True
        if self.progress is not None and self.progress.has_passed(uuid):
            return False
        if self.line is not None and self.line.is_listed(uuid):
            listed = True
        if self.line is not None and self.line.only_verify:
            return listed
        if not listed or self.progress is not None:
            missing = "whitelisted" if self.progress is None else "in the sheet"
            self._station.notice(f"Skipped: node {uuid.hex()} is not {missing}.")
            return False
        judged = verdict_of(self._station, uuid)
        verified = judged is not None and judged.verified.verdict == "authentic"
        if not verified or contact.identity.state != NodeState.PROVISIONED:
            return True
        image = self._station.datasheets.datasheet(uuid)
        return image is not None and self._lacks_calibration(uuid, image) is not None

    def _board(self, contact: Contact, place: str, operator: Operator) -> BoardResult | None:
        """Provision one node of the bus; None if it turns out to be finished already."""
        began, uuid = time.monotonic(), contact.identity.uuid
        done: ProvisionResult | None = None
        error: TedsProvisionError | None = None
        known = self._station.nodes.get(uuid)
        reporter = NodeReporter(self._reporter, known.name if known is not None and known.name else uuid.hex())
        try:
            with Conversation(contact, notice=reporter.notice) as node:
                if self._was_finished_elsewhere(node):
                    return None
                node.early = None if self._early is None else self._early.answers_of(contact)
                done = self._provision(node, operator, reporter)
            error = self._lacks_calibration(uuid, done.image)
        except VaultLockedError:  # concerns the whole command, not one board
            raise
        except TedsProvisionError as failure:
            error = failure
        except SessionLostError as lost:
            error = lost.cause
        row = self._rows.pop(uuid, None)
        return BoardResult(uuid, time.monotonic() - began, done, error, row.number if row is not None else None, place)

    def _was_finished_elsewhere(self, node: Conversation) -> bool:
        """Return True if a node that was never read here has an authentic datasheet, as one whose key was imported.

        It is read in a session, and its datasheet is not signed again by this station.
        """
        uuid, unread = node.uuid, self._station.datasheets.reading(node.uuid) is None
        if not unread or node.identity.state != NodeState.PROVISIONED or not self.prepared.order.names_nothing:
            return False
        if self.progress is not None or self.line is not None or not self._station.keys.held(uuid):
            return False
        try:
            with self._station.node_lock(uuid):
                require_session(self._station, node)
                looked = verify_in_session(self._station, node, by="provision")
        except (PolicyError, NotAuthenticError):  # provisioning will report the reason
            return False
        if looked.verified.verdict != "authentic":
            return False
        self._station.notice(f"Nothing to do: node {uuid.hex()} is authentic, as its datasheet was signed elsewhere.")
        return self._lacks_calibration(uuid, looked.image) is None

    # -- for one and many ------------------------------------------------------------------------------------------

    def _lacks_calibration(self, uuid: bytes, image: Image) -> PolicyError | None:
        """Return an error if the datasheet is authentic but the board's type requires a calibration, else None."""
        record = self._station.nodes.get(uuid)
        profile = self.prepared.profile
        if profile is None and record is not None and record.profile:
            with suppress(TedsProvisionError):
                profile = load_profile(record.profile, default_folders(self._station.home))
        required = (
            [channel.number for channel in profile.channels if channel.calibration.required]
            if profile is not None
            else []
        )
        missing = [str(number) for number in required if (number, AccessCode.CALIBRATION) not in image.blocks]
        if profile is None or not missing:
            return None
        return PolicyError(
            f"Board {uuid.hex()} has no calibration of channel {', '.join(missing)}, which its type requires.",
            hint=f"Calibrate it: teds-provision provision {uuid.hex()} --calibration FILE; for many: --batch SHEET.",
        )

    def _provision(self, node: Conversation, operator: Operator, reporter: Reporter | None = None) -> ProvisionResult:
        if self.line is not None and self.line.only_verify:
            return verify_only(self._station, node, self.line, self._reporter)
        return provision(
            self._station,
            node,
            self._for,
            operator=operator,
            reporter=reporter or self._reporter,
            onward=continue_over_ble(self._links, self._reporter.notice),
            line=self.line,
            named=self._is_named,
        )

    def _is_named(self, who: IdentifiedNode) -> bool:
        """Return True if a sheet or job names this very board, which is a person's word."""
        row = self._rows.get(who.uuid)
        return (self.line is not None and self.line.lists(who)) or not (row is None or row.by_order)

    def _for(self, who: IdentifiedNode) -> PreparedOrder:
        """Return what this board gets.

        Raises PolicyError (the sheet does not know it, its name is another's), KeyMismatchError.

        A board that is refused here has not taken a row.
        """
        if self.line is not None:
            return self.line.order(who)
        if self.progress is None:
            return self.prepared
        with self._turn:
            busy = {row.number for uuid, row in self._rows.items() if uuid != who.uuid}
            row = self.progress.row_for(who.uuid, who.fingerprint, busy=busy)
            if row is None:
                raise PolicyError(f"The sheet has no row left for board {who.uuid.hex()}.", hint="Set it aside.")
            self._rows[who.uuid] = row
            if row.fingerprint is not None and not who.fingerprint.startswith(row.fingerprint):
                raise KeyMismatchError(
                    f"Board {who.uuid.hex()} holds the key {who.fingerprint[:32]}; row {row.number} of the sheet "
                    f"says {row.fingerprint[:32]}.",
                    hint="Compare this board's label; it may be another board with the same UUID.",
                )
            try:
                named_for(self._station, who.uuid, row.prepared)
            except TedsProvisionError:
                self.progress.turn_away(row, who.uuid)
                raise
            self.progress.assign_row(row, who.uuid)
        return row.prepared

    def _note(self, board: BoardResult) -> None:
        self._boards.append(board)
        if self.progress is not None and board.row is not None:
            row = self.row(board.row)
            if isinstance(board.error, WrongBoardError) and row.by_order:
                self.progress.not_this_board(row, board)
            else:
                self.progress.note(row, board)


def _load_ahead() -> threading.Thread:
    """Load what a board needs in a thread, while the vault is opened and a board is waited for; return the thread.

    Loaded at its first use, it would hold up the conversation while the sensors are claimed. Anything that cannot be
    loaded fails there.
    """

    def load() -> None:
        for module in _AT_THE_BOARD:
            with suppress(ImportError):
                import_module(module)

    thread = threading.Thread(target=load, name="loading ahead", daemon=True)
    thread.start()
    return thread


def _progress(station: Station, request: ProvisionRequest, order: BuildOrder) -> Progress | None:
    """Return the sheet with the results of earlier runs; None without one."""
    if request.sheet is None:
        return None
    sheet = read_sheet(station, request.sheet, order)
    if request.whole_bus and any(row.by_order for row in sheet.rows):
        raise UsageError(
            "On a bus, rows cannot follow the order of taps.", hint="Give each row its uuid or fingerprint."
        )
    return Progress(station.home, sheet, lambda row, uuid: _has_it_already(station, row, uuid))


def _has_it_already(station: Station, row: SheetRow, uuid: bytes) -> bool:
    """Return True if the board's last known datasheet is what its row of the sheet gives."""
    image = station.datasheets.datasheet(uuid)
    if image is None:
        return False
    try:
        prepared = named_for(station, uuid, row.prepared)
        made = [compose(station, uuid, prepared, image, edition=edition).blocks for edition in (2007, 2024)]
    except TedsProvisionError:
        return False
    return image.unsigned_blocks() in map(dict, made)


def _require_consistent(request: ProvisionRequest, links: LinkSettings) -> None:
    if request.node is not None and request.several:
        raise UsageError(
            "A single node cannot be combined with --all, --watch or --batch.",
            hint="Give either the node or one of these options.",
        )
    if request.whole_bus and request.watch:
        raise UsageError(
            "--all provisions the nodes that are on the bus now, --watch those that arrive.", hint="Use one of them."
        )
    if request.report is not None and request.sheet is None:
        raise UsageError("--report requires a sheet.", hint="Add --batch FILE.")
    if len(links.places) > 1 and not (request.watch or request.sheet is not None):
        raise UsageError("Several readers require --watch.", hint="Add --watch, or give one reader.")
