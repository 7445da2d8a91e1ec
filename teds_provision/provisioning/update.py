"""New firmware for boards: look, upload, restart, prove in the session, confirm; or see the old image come back.

Nothing durable is kept here: after a cut, the next call continues from what the board reports in the session. Which
image may run is the decision of its boot loader, which checks the owner's signature (docs/firmware-update.md).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Final, Literal

from teds_provision.errors import (
    BoardLostError,
    DowngradeError,
    FrozenError,
    GarbledError,
    LinkClosedError,
    LinkError,
    NodeRefusedError,
    NotAuthenticError,
    NoUpdateError,
    PolicyError,
    RevertedError,
    TedsProvisionError,
    WrongImageError,
)
from teds_provision.firmware_image import FirmwareImage, version_text
from teds_provision.links import LinkSettings, open_port
from teds_provision.links.ports import Port
from teds_provision.protocol.messages.firmware import FirmwareFlag, FirmwareReport
from teds_provision.protocol.messages.frames import Function, security_command
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.operation.commands import OPERATION, ChannelState, OperationReply
from teds_provision.provisioning.agree import open_session, require_session, unknown_key
from teds_provision.provisioning.board_type import require_working_hardware
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.provisioning.firmware import keep_firmware, read_firmware
from teds_provision.provisioning.identify import identify, prove
from teds_provision.provisioning.image_manager import ImageManager
from teds_provision.provisioning.meeting import avoid_measuring_source, likely_address, likely_places
from teds_provision.provisioning.parallel import ParallelWork
from teds_provision.provisioning.progress import Reporter, StepResult
from teds_provision.provisioning.sign import require_not_measured
from teds_provision.provisioning.teds_read import read_block, read_identity, read_image
from teds_provision.station.firmware import FirmwareReading
from teds_provision.station.station import Station
from teds_provision.teds.image import SECURITY, Image

WAIT_SECONDS: Final = 180.0
"""Seconds in which a restarted board must be back, by default."""
_SAME_POWER_UP: Final = 1 << 32
"""c of Open grows by less than this between two restarts (profile.md, "Sessions")."""
_MEET_SECONDS: Final = 2.0
_PAUSE: Final = 0.2
_RESTART_SECONDS: Final = 3.0
"""Seconds in which a board has restarted after its reply; then it is asked once more."""

Result = Literal["updated", "already", "reverted", "refused", "lost"]
RESULTS: Final[tuple[Result, ...]] = ("updated", "already", "reverted", "refused", "lost")
Stage = Literal["upload", "restart", "prove", "nothing"]
Release = Callable[[bytes], AbstractContextManager[object]]
"""``with release(uuid) as released:`` no measurement of this station has the node; true if one let it go for this."""


@dataclass(frozen=True)
class UpdateOrder:
    """The image, how long a restarted board is waited for (s), and what a person has allowed.

    ``other_board``: also if the image names another board, or none. ``allow_downgrade``: also an older version.
    """

    image: FirmwareImage
    wait: float = WAIT_SECONDS
    allow_downgrade: bool = False
    other_board: bool = False


@dataclass(frozen=True)
class UpdatePlan:
    """The plan of an update for one board: ``stage`` is its first step. ``question``: asked before, "" for none.

    ``interrupts`` names the measurements that pause; ``octets`` go over the link in about ``seconds``.
    """

    uuid: bytes
    report: FirmwareReport
    stage: Stage
    octets: int
    seconds: float
    interrupts: tuple[str, ...] = ()
    question: str = ""


@dataclass(frozen=True)
class BoardUpdate:
    """Result of the update of one board. ``before`` is the version that ran, None if it is not known."""

    uuid: bytes
    result: Result
    before: str | None
    octets: int
    seconds: float
    error: TedsProvisionError | None = None


def plan_update(
    station: Station, links: LinkSettings, uuid: bytes, order: UpdateOrder, reporter: Reporter
) -> UpdatePlan:
    """Look at one board in its session and return what an update would do; changes nothing.

    Raises NoUpdateError, DowngradeError, PolicyError (other image on trial, claimed actuator), LinkError.
    """
    planned = plan_or_refusal(station, links, uuid, order, reporter)
    if isinstance(planned, BoardUpdate):
        assert planned.error is not None
        raise planned.error
    return planned


def plan_or_refusal(
    station: Station, links: LinkSettings, uuid: bytes, order: UpdateOrder, reporter: Reporter
) -> UpdatePlan | BoardUpdate:
    """Return the plan of :func:`plan_update`, or how the update ends here, with the version that was read first."""
    began, looked = time.monotonic(), None
    try:
        port = _port_of(station, links, uuid)
        try:
            avoid_measuring_source(station, port, uuid)
            looked = _Update(station, port, links.timeout, uuid, order, reporter)
            plan = looked.plan()
            if plan.interrupts and not station.service_runs():  # a command cannot release nodes of another process
                raise FrozenError(
                    f"Node {uuid.hex()} is being measured by {plan.interrupts[0]}.", hint="End that measurement first."
                )
            return plan
        finally:
            port.close()
    except TedsProvisionError as error:
        before = looked.before if looked is not None else None
        return BoardUpdate(uuid, result_of(error), before, 0, time.monotonic() - began, error)


def plan_at(
    station: Station, port: Port, uuid: bytes, order: UpdateOrder, reporter: Reporter, *, timeout: float
) -> UpdatePlan:
    """Do what :func:`plan_update` does, over an open port; no other session of its source address is with the node."""
    return _Update(station, port, timeout, uuid, order, reporter).plan()


def plan_in(station: Station, node: Conversation, order: UpdateOrder) -> UpdatePlan:
    """Do what :func:`plan_update` does, in the session that is open with the node, such as that of a measurement."""
    return _Look(station, node.uuid, order).planned(node)


def update_at(
    station: Station,
    port: Port,
    uuid: bytes,
    order: UpdateOrder,
    reporter: Reporter,
    *,
    timeout: float,
    release: Release | None = None,
    is_ending: Callable[[], bool] = lambda: False,
) -> BoardUpdate:
    """Update one board over an open port; an error is part of the result.

    ``release`` has the board for the update alone, see :data:`Release`; without it ``station.released`` does.
    ``is_ending`` returns True once the caller ends and goes on later: an error is then no result for the log.
    """
    return _Update(station, port, timeout, uuid, order, reporter, release, is_ending).run()


def update_boards(
    station: Station,
    links: LinkSettings,
    orders: Sequence[tuple[bytes, UpdateOrder]],
    reporter_of: Callable[[bytes], Reporter],
    *,
    parallel: int = 1,
) -> Iterator[BoardUpdate]:
    """Update boards, ``parallel`` at a time if their link allows it, and yield how each ended, as they end.

    ``reporter_of`` gives the receiver of a board's progress. An error ends one board only. The vault is open, and
    questions are asked, before.
    """
    places: dict[str, list[tuple[bytes, UpdateOrder]]] = {}
    for uuid, order in orders:
        known = _buses_of(station, links, uuid)
        places.setdefault(known[0] if known else "", []).append((uuid, order))
    for place, there in places.items():
        port = open_port(links.at(place) if place else links)
        try:
            yield from _at_port(station, port, links.timeout, there, reporter_of, parallel)
        finally:
            port.close()


def _at_port(
    station: Station,
    port: Port,
    timeout: float,
    orders: Sequence[tuple[bytes, UpdateOrder]],
    reporter_of: Callable[[bytes], Reporter],
    parallel: int,
) -> Iterator[BoardUpdate]:
    for uuid, _ in orders:
        avoid_measuring_source(station, port, uuid)

    def one(ordered: tuple[bytes, UpdateOrder]) -> BoardUpdate:
        uuid, order = ordered
        return update_at(station, port, uuid, order, reporter_of(uuid), timeout=timeout)

    at_once = min(parallel, len(orders), port.capabilities.max_parallel)
    if at_once < 2:
        yield from map(one, orders)
        return
    work = ParallelWork(orders, one, at_once=at_once, name="update")
    try:
        for done in work.results():
            yield done.result()
    finally:  # after Ctrl-C do not wait: the bus is closed next
        work.drop_waiting()


def read_about(node: Conversation) -> FirmwareReport | None:
    """Read About in the open session; None for a node that does not report its firmware."""
    node.reported_firmware = None  # the report changes within the session
    reading = read_firmware(node)
    return None if reading is None else reading.report


def version_of(report: FirmwareReport) -> str:
    """Return the version of a report as imgtool writes it: 1.2.3+45."""
    return version_text((*report.version, report.build))


def require_free_actuators(node: Conversation) -> None:
    """Raise PolicyError if an actuator of the board is claimed, in this session or another one: a restart ends that."""
    try:
        channels = OperationReply.decode(node.request_idempotent(OPERATION, "to report its mode")).channels
    except NodeRefusedError:
        return  # the node does not measure
    claims = ChannelState.CLAIMED_HERE | ChannelState.CLAIMED_BY_OTHER
    claimed = [number for number, (state, _) in channels.items() if state & ChannelState.ACTUATOR and state & claims]
    if claimed:
        raise PolicyError(
            f"Actuator {claimed[0]} of the board is in use; the restart would end that.",
            hint="Release it first; mode UUID shows which station claims it.",
        )


@dataclass(frozen=True)
class _BeforeRestart:
    """State before the restart: Security TEDS and identity, which must be unchanged after it, and c, which must not."""

    security: bytes
    identity: Identity
    datasheet: Image | None
    c: bytes | None


class _Look:
    """State of one board before its update begins."""

    def __init__(self, station: Station, uuid: bytes, order: UpdateOrder) -> None:
        self._station, self._uuid, self._order = station, uuid, order
        self._digest = order.image.digest
        self._before: str | None = None

    @property
    def before(self) -> str | None:
        """Version that ran when the board was looked at, None if it was not."""
        return self._before

    def planned(self, node: Conversation) -> UpdatePlan:
        """Return what an update would do, as the board reports itself in its open session."""
        report, stage = self._look(node)
        octets = len(self._order.image.octets) if stage == "upload" else 0
        holder = self._station.measurements.holder(self._uuid)
        if stage in ("upload", "restart"):
            require_free_actuators(node)
        return UpdatePlan(
            self._uuid,
            report,
            stage,
            octets,
            _seconds(node, octets),
            () if holder is None or stage == "nothing" else (holder,),
            "" if stage == "nothing" else self._mismatch(report),
        )

    def _look(self, node: Conversation) -> tuple[FirmwareReport, Stage]:
        """Return the board's report in the session, and the first step of the update; raises if it is not permitted."""
        report = read_about(node)
        if report is None:
            raise NoUpdateError(
                "The board does not report its firmware, so it takes none over this link.",
                hint="Program it once by its debug connector with firmware that supports updates.",
            )
        self._before = version_of(report)
        if FirmwareFlag.MANAGE not in report.flags:
            raise NoUpdateError(
                "The board takes no firmware over its session: its boot loader does not check signatures, or cannot"
                " try an image and revert.",
                hint="It needs MCUboot with the owner's key and two slots; see docs/firmware-update.md.",
            )
        on_trial, pending = FirmwareFlag.ON_TRIAL in report.flags, FirmwareFlag.PENDING in report.flags
        if report.image == self._digest:
            return report, "prove" if on_trial else "nothing"
        if on_trial:
            raise PolicyError(
                f"The board is trying another image, {self._before}.",
                hint="Finish that update, or restart the board: it then runs its old firmware again.",
            )
        version = (*report.version, report.build)
        if version > self._order.image.version and not self._order.allow_downgrade:
            raise DowngradeError(
                f"The image is version {self._order.image.version_text}; the board runs {self._before}.",
                hint="To go back on purpose: --allow-downgrade. A board that counts may refuse all the same.",
            )
        if pending:
            waiting = [image for image in ImageManager(node).images() if image.pending]
            if [image.digest for image in waiting] != [self._digest]:
                raise PolicyError(
                    "Another image starts at the next restart of the board.",
                    hint="Finish that update first, or restart the board twice: then its old firmware runs again.",
                )
            return report, "restart"
        return report, "upload"

    def _mismatch(self, report: FirmwareReport) -> str:
        """Return the question about an image that does not name this board; "" if it does."""
        board = self._order.image.board
        if board is not None and board in (report.text, report.board):
            return ""
        named = f"names the board {board!r}" if board is not None else "does not name its board"
        return f"The image {named}; this board is {report.text or 'nameless'!r}."


class _Update(_Look):
    """The update of one board over one port."""

    def __init__(
        self,
        station: Station,
        port: Port,
        timeout: float,
        uuid: bytes,
        order: UpdateOrder,
        reporter: Reporter,
        release: Release | None = None,
        is_ending: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(station, uuid, order)
        self._port, self._timeout, self._reporter, self._is_ending = port, timeout, reporter, is_ending
        self._release: Release = release or (lambda uuid: station.released(uuid, "update"))
        self._octets = 0
        self._point = b""

    # -- public ----------------------------------------------------------------------------------------------------

    def plan(self) -> UpdatePlan:
        """Return what :meth:`run` would do."""
        with self._station.node_lock(self._uuid), self._met(self._timeout) as node:
            return self.planned(node)

    def run(self) -> BoardUpdate:
        """Update the board; an error is part of the result."""
        began, error = time.monotonic(), None
        try:
            with self._station.node_lock(self._uuid), self._release(self._uuid) as released:
                result = self._run(released=bool(released))
        except TedsProvisionError as failure:
            error = failure
        except SessionLostError as lost:
            error = lost.cause
        if error is not None:
            result = "reverted" if isinstance(error, RevertedError) else result_of(error)
        done = BoardUpdate(self._uuid, result, self._before, self._octets, time.monotonic() - began, error)
        cut = isinstance(error, LinkClosedError) or (error is not None and self._is_ending())
        if result != "already" and not cut:  # an interrupted update continues later
            facts = {"from": self._before, "to": self._order.image.version_text, "image": self._digest.hex()}
            with suppress(TedsProvisionError):  # a full disk must not hide what happened
                self._station.audit(
                    "update", self._uuid, result, **facts, **({} if error is None else {"why": error.message})
                )
        return done

    # -- the steps -------------------------------------------------------------------------------------------------

    def _run(self, *, released: bool) -> Result:
        with self._met(self._timeout) as node:
            require_not_measured(self._station, node, released=released)
            report, stage = self._look(node)
            if stage == "nothing":
                self._keep(report)
                return "already"
            if stage != "prove":
                if self._mismatch(report) and not self._order.other_board:
                    raise WrongImageError(self._mismatch(report), hint="If it is right all the same: --other-board")
                require_free_actuators(node)
            before = self._note(node, as_kept=stage == "prove")
            if stage != "prove" and before.identity.state == NodeState.PROVISIONED:
                self._keep_as_signed(report)
            manager = ImageManager(node)
            if stage == "prove":
                return self._proven(node, manager, before)
            self._keep_address(node)
            if stage == "upload":
                self._upload(node, manager)
            began = time.monotonic()
            before = replace(before, c=node.open_counter)
            manager.restart()
        with self._restarted(before) as node:
            self._reporter.finished(StepResult("restart", seconds=time.monotonic() - began))
            manager = ImageManager(node)
            return self._proven(node, manager, before)

    def _note(self, node: Conversation, *, as_kept: bool) -> _BeforeRestart:
        """Return what the board is before its restart; ``as_kept``: it has restarted, and the store knows it."""
        identity, security = read_identity(node), read_block(node, SECURITY)
        datasheet = self._station.datasheets.datasheet(self._uuid) if identity.state == NodeState.PROVISIONED else None
        if as_kept and datasheet is not None and datasheet.security is not None:
            security = datasheet.security
        elif identity.state == NodeState.PROVISIONED and (datasheet is None or datasheet.security != security):
            datasheet = read_image(node)
        return _BeforeRestart(security, identity, datasheet, node.open_counter)

    def _keep_address(self, node: Conversation) -> None:
        """Make an address durable that the node took in a claim: after the restart it is found there."""
        if node.contact.address is None:
            return
        command = security_command(Function.SET_CAN_ADDRESS, bytes([node.contact.address]))
        node.request(command, "to keep its CAN address")

    def _upload(self, node: Conversation, manager: ImageManager) -> None:
        image = self._order.image
        began = time.monotonic()
        self._reporter.started("upload")
        if all(there.running or there.digest != self._digest for there in manager.images()):
            self._octets = manager.upload(image.octets, self._reporter.written)
            images = manager.images()
            if all(there.running or there.digest != self._digest for there in images):
                raise NotAuthenticError(
                    "The board does not show the image that was sent.",
                    hint="Try again. If the error persists, its image manager is defective.",
                )
        manager.start_next(self._digest)
        detail = f"{self._octets} octets" if self._octets else "already on the board"
        self._reporter.finished(StepResult("upload", seconds=time.monotonic() - began, detail=detail))

    def _proven(self, node: Conversation, manager: ImageManager, before: _BeforeRestart) -> Result:
        """Have the new image prove itself in one session and confirm it; or have the board go back to the old one."""
        began = time.monotonic()
        self._reporter.started("prove")
        try:
            self._prove(node, manager, before)
        except (TedsProvisionError, SessionLostError) as error:
            cause = error.cause if isinstance(error, SessionLostError) else error
            self._revert(node, cause)
        self._reporter.finished(StepResult("prove", seconds=time.monotonic() - began))
        return "updated"

    def _prove(self, node: Conversation, manager: ImageManager, before: _BeforeRestart) -> None:
        report = read_about(node)
        if report is None or report.image != self._digest:
            raise RevertedError("The boot loader did not start the new image.", hint=_NOT_STARTED)
        if FirmwareFlag.ON_TRIAL not in report.flags:
            raise NotAuthenticError("The new image confirmed itself before it was proven.")
        prove(node, self._point)
        if read_block(node, SECURITY) != before.security:
            raise NotAuthenticError("The new image shows another datasheet.")
        identity, was = read_identity(node), before.identity
        if (identity.state, identity.epoch, identity.sequence) != (was.state, was.epoch, was.sequence):
            raise NotAuthenticError("The new image lost key, epoch or sequence of the node.")
        if before.datasheet is not None:
            require_working_hardware(node, before.datasheet)
        manager.confirm()
        report = read_about(node)
        if report is None or report.image != self._digest or FirmwareFlag.ON_TRIAL in report.flags:
            raise GarbledError("The board did not keep the new image.")
        self._keep(report)

    def _keep(self, report: FirmwareReport) -> None:
        """Record the firmware that was reported in the session."""
        with self._station.durable("update"):
            keep_firmware(self._station, self._uuid, FirmwareReading(report, sealed=True))

    def _keep_as_signed(self, report: FirmwareReport) -> None:
        """Record the firmware that an update replaces, unless it is known under which one the datasheet was signed.

        An older store, or another station, signed it: without this, no change since the calibration would show.
        """
        known = self._station.firmware_reports.get(self._uuid)
        if known is None or known.signed is None:
            with self._station.durable("update"):
                keep_firmware(self._station, self._uuid, FirmwareReading(report, sealed=True), signed=True)

    # -- revert and retry ------------------------------------------------------------------------------------------

    def _revert(self, node: Conversation, cause: TedsProvisionError) -> None:
        """Restart a board whose new image did not prove itself, and raise how that ended."""
        hint = "The image is at fault, not the board: it runs its old firmware again."
        if isinstance(cause, RevertedError):
            raise cause
        self._reporter.started("revert")
        until = time.monotonic() + self._order.wait
        c = node.open_counter
        with suppress(LinkError, NodeRefusedError, PolicyError, NotAuthenticError):
            ImageManager(node).restart()
        node.contact.link.close()
        while (left := until - time.monotonic()) > 0:
            try:
                with self._in_session(left) as back:
                    report = read_about(back)
                    if report is not None and report.image != self._digest:
                        raise RevertedError(f"The new image did not prove itself: {cause.message}", hint=hint)
                    restarted = not _same_power_up(c, back.open_counter)
                    if report is not None and FirmwareFlag.ON_TRIAL not in report.flags:
                        raise PolicyError(
                            f"The board keeps the new image although it did not prove itself: {cause.message}",
                            hint="Take it out of use, and program it by its debug connector.",
                        )
                    if not restarted:
                        ImageManager(back).restart()
            except LinkClosedError:  # Ctrl-C
                raise
            except (LinkError, SessionLostError):
                time.sleep(_PAUSE)
            except NodeRefusedError:
                time.sleep(_PAUSE)
        raise self._lost()

    def _lost(self) -> BoardLostError:
        return BoardLostError(
            f"The board did not answer within {self._order.wait:g} s after its restart.",
            hint="Switch it off and on: it then runs its old firmware. Then run the same command again.",
        )

    @contextmanager
    def _restarted(self, before: _BeforeRestart) -> Iterator[Conversation]:
        """Wait until c of a session shows the restart, and yield that session; a board that did not is asked again."""
        self._reporter.started("restart")
        until, asked_again = time.monotonic() + self._order.wait, False
        restarts_by = time.monotonic() + _RESTART_SECONDS
        with ExitStack() as stack:
            while True:
                left = until - time.monotonic()
                if left <= 0:
                    raise self._lost()
                try:
                    node = stack.enter_context(self._in_session(left))
                except LinkClosedError:  # Ctrl-C
                    raise
                except LinkError:
                    time.sleep(_PAUSE)
                    continue
                except NodeRefusedError:
                    time.sleep(_PAUSE)
                    continue
                if not _same_power_up(before.c, node.open_counter):
                    break
                if time.monotonic() >= restarts_by:
                    if asked_again:
                        raise PolicyError(
                            "The board does not restart.", hint="Switch it off and on, then run this again."
                        )
                    asked_again, restarts_by = True, time.monotonic() + _RESTART_SECONDS
                    ImageManager(node).restart()
                stack.close()
                time.sleep(_PAUSE)
            yield node

    @contextmanager
    def _met(self, seconds: float) -> Iterator[Conversation]:
        """Meet the board, have it prove its key, and open a session."""
        with self._meeting(seconds) as node:
            self._point = identify(self._station, node).point
            require_session(self._station, node)
            yield node

    @contextmanager
    def _in_session(self, seconds: float) -> Iterator[Conversation]:
        """Meet a board that was identified already, and open a session under the key that is held."""
        with self._meeting(min(seconds, _MEET_SECONDS)) as node:
            if open_session(self._station, node) is None:
                raise unknown_key(self._station, node)
            yield node

    @contextmanager
    def _meeting(self, seconds: float) -> Iterator[Conversation]:
        def wanted(identity: Identity) -> bool:
            return identity.uuid == self._uuid

        address = likely_address(self._station, self._uuid)
        contact = self._port.find(wanted, seconds=seconds, notice=self._reporter.notice, address=address)
        with Conversation(contact, notice=self._reporter.notice) as node:
            yield node


_NOT_STARTED: Final = (
    "Its signature is not by the owner's key, its security counter is lower, or it crashed at once; the board runs its"
    " old firmware."
)


def result_of(error: TedsProvisionError) -> Result:
    """Return the result of a board that an error ended."""
    return "lost" if isinstance(error, LinkError) else "refused"


def _same_power_up(before: bytes | None, after: bytes | None) -> bool:
    """Return True if c of two Opens is of the same power-up."""
    if before is None or after is None:
        return False
    return (int.from_bytes(after, "big") - int.from_bytes(before, "big")) % (1 << 64) < _SAME_POWER_UP


def _seconds(node: Conversation, octets: int) -> float:
    """Return about how long so many octets take over this link."""
    return octets / node.contact.link.capabilities.octets_a_second


def _port_of(station: Station, links: LinkSettings, uuid: bytes) -> Port:
    known = _buses_of(station, links, uuid)
    return open_port(links.at(known[0]) if known else links)


def _buses_of(station: Station, links: LinkSettings, uuid: bytes) -> tuple[str, ...]:
    """Return the buses on which to update a board; none if a reader is configured, which is waited at for hours."""
    return () if links.nfc else likely_places(station, links, [uuid])
