"""Firmware updates on request: one image, many boards, one action at a time; it outlives a restart of the service.

Each board is planned and updated by ``steps.update``, as by the command ``update``. The request, the result of each
board, and the image until the action has ended are stored in ``updates/`` of the home. After a restart the same action
continues with the boards without a result: the step at which a board continues follows from its report.
"""

from __future__ import annotations

import contextvars
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from teds_provision.errors import (
    BadDataError,
    FrozenError,
    NodeBusyError,
    NoNodeError,
    NotFoundError,
    PolicyError,
    StoreError,
    TedsProvisionError,
    UsageError,
)
from teds_provision.firmware_image import FirmwareImage, read_firmware_image
from teds_provision.lazy import how_to_install, is_installed
from teds_provision.links import Port
from teds_provision.links.ports import Notice
from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.ncap.live import Live
from teds_provision.ncap.nodes.directory import NodeDirectory
from teds_provision.ncap.nodes.node_jobs import NodeLocks, as_program_error
from teds_provision.ncap.nodes.update_actions import (
    KEPT,
    BoardRow,
    UpdateAction,
    UpdateFolder,
    UpdateRequest,
    by_age,
)
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.provisioning.parallel import ParallelWork
from teds_provision.provisioning.progress import SilentReporter, StepResult
from teds_provision.provisioning.update import (
    BoardUpdate,
    UpdateOrder,
    UpdatePlan,
    plan_at,
    plan_in,
    require_free_actuators,
    result_of,
    update_at,
    version_of,
)
from teds_provision.shapes.problem import problem_of
from teds_provision.station.station import Station
from teds_provision.station.store.audit import ACTOR, acting_for

_log = logging.getLogger(__name__)
_WAITED_FOR: Final = 60.0
"""Seconds for which a board is waited for that is on no bus, as after a restart of the service, and for its answer."""
_PLANNED_WITHIN: Final = 20.0
"""Seconds for which the plan waits for a board's answer."""
_LOOK: Final = 0.1
_REPORT_EVERY: Final = 0.5
"""Seconds between two events about the upload to one board."""


Measured = Callable[[str], AbstractContextManager[VerifiedSession | None]]
Lent = Callable[[str, str], AbstractContextManager[bool]]


class Updates:
    """The updates of one daemon.

    ``bus_of`` gives the open port on which a node is now, ``measured`` the session of a node that is being measured,
    ``lent`` has a node for the block, which a measurement lets go (True), ``held`` names the actuators that requests
    hold.
    """

    def __init__(
        self,
        station: Station,
        roster: NodeDirectory,
        live: Live,
        turns: NodeLocks,
        *,
        bus_of: Callable[[str], Port | None],
        measured: Measured,
        lent: Lent,
        held: Callable[[str], list[int]],
    ) -> None:
        self._station, self._directory, self._live, self._node_locks = station, roster, live, turns
        self._bus_of, self._measured, self._lent, self._held = bus_of, measured, lent, held
        self._kept = UpdateFolder(Path(station.home))
        self._actions: dict[str, UpdateAction] = {}
        self._work: ParallelWork[str, BoardUpdate] | None = None
        self._guard = threading.RLock()
        self._closing = threading.Event()
        self._slots: dict[str, threading.Semaphore] = {}
        self._told: dict[str, float] = {}

    # -- start and end -----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Read what is kept, and go on with the action that was cut."""
        self._actions = {action.id: action for action in self._kept.read()}
        running = [action for action in self._actions.values() if action.state == "running"]
        for action in running[1:]:  # only one action runs at a time, so a second one comes from a copied file
            self._end(action, "stopped")
        if running:
            try:
                image = self._kept.image_of(running[0])
            except TedsProvisionError as error:
                for row in running[0].rows.values():
                    if row.result is None and row.state != "skipped":
                        row.state, row.result, row.error = "ended", "refused", problem_of(error)
                self._end(running[0], "stopped")
            else:
                self._begin(running[0], image)
        self._sweep()

    def stop(self) -> None:
        """Begin no further board; the action goes on at the next start of the service."""
        self._closing.set()
        with self._guard:
            if self._work is not None:
                self._work.drop_waiting()

    # -- for the API -------------------------------------------------------------------------------------------------

    def all(self) -> list[dict[str, Any]]:
        """Return every action that is known, the newest first."""
        with self._guard:
            return [action.as_json() for action in sorted(self._actions.values(), key=by_age, reverse=True)]

    def get(self, action_id: str) -> dict[str, Any]:
        """Return an action; raises NotFoundError."""
        with self._guard:
            return self._get(action_id).as_json()

    def plan(self, octets: bytes, request: UpdateRequest, *, owner: str) -> dict[str, Any]:
        """Return what an update would do with each board; changes nothing.

        Raises NotFoundError (the extra ``update`` is missing), BadDataError (no image), UsageError.
        """
        image = _image_of(octets)
        action = _action_of("", request, image, owner, state="planned")
        order = _order_of(request, image)

        def work(row: BoardRow) -> None:
            began = time.monotonic()
            row.state = "planned"
            try:
                self._put_plan(row, self._planned(row.uuid, order))
            except TedsProvisionError as error:
                self._put_end(row, _ended(row.uuid, error, began))
            except Exception as error:  # noqa: BLE001 - one board's bug is that board's
                _log.exception("Planning the update of node %s failed.", row.uuid)
                self._put_end(row, _ended(row.uuid, as_program_error(error), began))

        planning = ParallelWork(list(action.rows.values()), work, at_once=request.parallel, name="plan")
        for _ in planning.results():
            pass
        action.ended = time.time()
        return action.as_json()

    def begin(self, octets: bytes, request: UpdateRequest, *, owner: str) -> dict[str, Any]:
        """Begin an update; returns at once.

        Raises as :meth:`plan` does, NodeBusyError while another update runs, StoreError if the disk refuses.
        """
        image = _image_of(octets)
        action = _action_of(secrets.token_hex(4), request, image, owner)
        with self._guard:
            self._require_none()
            self._actions[action.id] = action
        try:
            self._kept.keep_new(action, octets)
            facts = {"id": action.id, "to": image.version_text, "image": image.digest.hex(), "boards": len(action.rows)}
            self._station.audit("update", None, "begun", **facts, **_allowed(request))
        except BaseException:
            with self._guard:
                del self._actions[action.id]
            self._kept.forget(action)
            raise
        self._begin(action, image)
        return action.as_json()

    def cancel(self, action_id: str) -> dict[str, Any]:
        """Begin no further board of a running action; those that were begun are finished. Raises NotFoundError."""
        with self._guard:
            action = self._get(action_id)
            if action.state == "running" and self._work is not None:
                self._work.drop_waiting()
                for row in action.rows.values():
                    if row.state == "waiting":
                        row.state = "skipped"
                        self._publish(action, row)
                self._kept.keep(action)
            return action.as_json()

    def _require_none(self) -> None:
        running = next((action for action in self._actions.values() if action.state == "running"), None)
        if running is not None:
            done = sum(row.result is not None for row in running.rows.values())
            raise NodeBusyError(
                f"{running.owner} is updating {len(running.rows)} boards to {running.image['version']}"
                f" ({done} of them done).",
                hint=f"Wait until that is over: /updates/{running.id}.",
            )

    def _get(self, action_id: str) -> UpdateAction:
        if action_id not in self._actions:
            raise NotFoundError(f"No update has the ID {action_id!r}.", hint="See /updates.")
        return self._actions[action_id]

    # -- the plan of one board ---------------------------------------------------------------------------------------

    def _planned(self, uuid: str, order: UpdateOrder) -> UpdatePlan:
        node = bytes.fromhex(uuid)
        self._station.policy.require_whitelisted(node)
        self._require_unheld(uuid)
        try:
            with self._measured(uuid) as trusted:
                if trusted is not None and trusted.node.sealed:
                    return plan_in(self._station, trusted.node, order)
        except SessionLostError as lost:
            raise lost.cause from lost
        port = self._bus_of(uuid)
        if port is None:
            raise _on_no_bus(uuid)
        try:
            with self._node_locks.hold(uuid, "its update is planned"), self._slot(port):
                plan = plan_at(self._station, port, node, order, SilentReporter(), timeout=_PLANNED_WITHIN)
        except SessionLostError as lost:
            raise lost.cause from lost
        if plan.interrupts:  # measured by another process, which does not release nodes
            raise FrozenError(
                f"Node {uuid} is being measured by {plan.interrupts[0]}.", hint="End that measurement first."
            )
        return plan

    def _require_unheld(self, uuid: str) -> None:
        held = self._held(uuid)
        if held:
            raise PolicyError(
                f"Actuator {held[0]} of the board is in use; the restart would end that.",
                hint="Release it first: it is held by the page or a program.",
            )

    def require_free(self, uuid: str) -> None:
        """Raise PolicyError if a request or a topic holds an actuator of a node that is measured here."""
        self._require_unheld(uuid)
        try:
            with self._measured(uuid) as trusted:
                if trusted is not None and trusted.node.sealed:
                    require_free_actuators(trusted.node)
        except FrozenError:
            return  # it is suspended, so no set points arrive either
        except SessionLostError as lost:
            raise lost.cause from lost

    # -- the update of one board -------------------------------------------------------------------------------------

    def _begin(self, action: UpdateAction, image: FirmwareImage) -> None:
        left = [row.uuid for row in action.rows.values() if row.result is None and row.state != "skipped"]
        for uuid in left:
            action.rows[uuid].state, action.rows[uuid].step = "waiting", None

        def one(uuid: str) -> BoardUpdate:
            with acting_for(action.actor):  # the actor for the audit log
                return self._update(action, image, uuid)

        work = self._work = ParallelWork(left, one, at_once=action.request.parallel, name="update")
        threading.Thread(
            target=contextvars.copy_context().run, args=(self._follow, action, work), name="updates", daemon=True
        ).start()

    def _follow(self, action: UpdateAction, work: ParallelWork[str, BoardUpdate]) -> None:
        self._publish(action)
        for finished in work.results():
            if finished.error is not None and not self._closing.is_set():
                _log.error("Updating node %s failed.", finished.item, exc_info=finished.error)
                done = _ended(finished.item, as_program_error(finished.error), time.monotonic())
            elif finished.error is not None:
                continue
            else:
                done = finished.result()
            if self._closing.is_set() and done.error is not None:
                continue  # the failure comes from closing the links; the update continues at the next start
            with self._guard:
                row = action.rows[finished.item]
                self._put_end(row, done)
                self._kept.keep(action)
                self._publish(action, row)
            self._look_again(finished.item)
        if self._closing.is_set():
            return
        skipped = any(row.state == "skipped" for row in action.rows.values())
        self._end(action, "stopped" if skipped else "done")
        totals = {name: count for name, count in action.as_json()["totals"].items() if count and name != "seconds"}
        with acting_for(action.actor), suppress(StoreError):  # a full disk must not hide what happened
            self._station.audit("update", None, "ended", id=action.id, to=action.image["version"], **totals)
        self._publish(action)

    def _update(self, action: UpdateAction, image: FirmwareImage, uuid: str) -> BoardUpdate:
        began, row = time.monotonic(), action.rows[uuid]
        order = _order_of(action.request, image, other_board=uuid in action.request.other_board)
        row.state = "running"
        self._kept.keep(action)
        self._publish(action, row)
        try:
            self._station.policy.require_whitelisted(bytes.fromhex(uuid))
            port = self._waited_for(uuid)
            with self._slot(port):
                return update_at(
                    self._station,
                    port,
                    bytes.fromhex(uuid),
                    order,
                    _RowReporter(row, lambda: self._publish_progress(action, row), lambda: self._publish(action, row)),
                    timeout=_WAITED_FOR,
                    release=self._alone,
                    is_ending=self._closing.is_set,
                )
        except TedsProvisionError as error:
            return _ended(uuid, error, began)

    @contextmanager
    def _alone(self, uuid: bytes) -> Iterator[bool]:
        """Have a board for the block: its measurement lets it go, and nothing else of this process works on it."""
        node = uuid.hex()
        self.require_free(node)
        with self._lent(node, "let go for update") as lent:
            yield lent

    def _waited_for(self, uuid: str) -> Port:
        until = time.monotonic() + _WAITED_FOR
        while (port := self._bus_of(uuid)) is None:
            if time.monotonic() >= until or self._closing.wait(_LOOK):
                raise _on_no_bus(uuid)
        return port

    def _slot(self, port: Port) -> threading.Semaphore:
        """Return what limits the boards of a link that are worked on at once."""
        with self._guard:
            return self._slots.setdefault(port.place, threading.Semaphore(port.capabilities.max_parallel))

    def _look_again(self, uuid: str) -> None:
        self._directory.refresh([uuid])
        self._directory.note(uuid, "updated", problem=None)

    # -- rows --------------------------------------------------------------------------------------------------------

    @staticmethod
    def _put_plan(row: BoardRow, plan: UpdatePlan) -> None:
        row.before, row.board, row.plan = version_of(plan.report), plan.report.text or None, plan.stage
        row.octets, row.seconds, row.interrupts = plan.octets, plan.seconds, list(plan.interrupts)
        row.question = plan.question
        if plan.stage == "nothing":
            row.result = "already"

    @staticmethod
    def _put_end(row: BoardRow, done: BoardUpdate) -> None:
        row.before = done.before or row.before
        row.octets, row.seconds, row.result = done.octets, done.seconds, done.result
        row.error = None if done.error is None else problem_of(done.error)
        row.step = None
        if row.state != "planned":
            row.state = "ended"

    def _publish(self, action: UpdateAction, row: BoardRow | None = None) -> None:
        facts = {} if row is None else {"uuid": row.uuid, "board": row.as_json(action.image["version"])}
        self._live.event("update", id=action.id, state=action.state, owner=action.owner, **facts)

    def _publish_progress(self, action: UpdateAction, row: BoardRow) -> None:
        now = time.monotonic()
        if now - self._told.get(row.uuid, -_REPORT_EVERY) >= _REPORT_EVERY:
            self._told[row.uuid] = now
            self._publish(action, row)

    def _end(self, action: UpdateAction, state: str) -> None:
        with self._guard:
            action.state, action.ended = state, time.time()
            self._kept.keep(action)
            self._told.clear()
            self._sweep()

    def _sweep(self) -> None:
        """Forget the oldest actions, and each image that is not needed any more."""
        over = sorted((action for action in self._actions.values() if action.state != "running"), key=by_age)
        for action in over[:-KEPT]:
            del self._actions[action.id]
            self._kept.forget(action)
        self._kept.sweep([action for action in self._actions.values() if action.state == "running"])


class _RowReporter(SilentReporter):
    """The progress of one board in its row."""

    def __init__(self, row: BoardRow, progress: Callable[[], None], news: Callable[[], None]) -> None:
        self._row, self._progress, self._news = row, progress, news

    def started(self, step: str) -> None:
        """Show the step."""
        self._row.step = step
        self._news()

    def finished(self, step: StepResult) -> None:
        """Leave the row as it is: the next step begins."""

    def notice(self, notice: Notice) -> None:
        """Ignore what the link reports: the step is shown."""

    def written(self, octets: int, total: int) -> None:
        """Show how much is on the board."""
        self._row.written, self._row.octets = octets, total
        self._progress()


def _image_of(octets: bytes) -> FirmwareImage:
    if not octets:
        raise BadDataError("The request contains no image.", hint="Send the file that imgtool sign wrote as the body.")
    for module in ("imgtool", "smp"):
        if not is_installed(module):
            raise NotFoundError(f"Firmware updates need the package {module}.", hint=how_to_install("update"))
    return read_firmware_image(octets)


def _action_of(
    action_id: str, request: UpdateRequest, image: FirmwareImage, owner: str, *, state: str = "running"
) -> UpdateAction:
    if not request.uuids:
        raise UsageError("No board is named.", hint="Name nodes, or select them with match.")
    members = {
        "version": image.version_text,
        "digest": image.digest.hex(),
        "board": image.board,
        "octets": len(image.octets),
        "security_counter": image.security_counter,
    }
    rows = {uuid: BoardRow(uuid) for uuid in request.uuids}
    return UpdateAction(action_id, request, members, rows, owner, ACTOR.get(), time.time(), state)


def _order_of(request: UpdateRequest, image: FirmwareImage, *, other_board: bool = False) -> UpdateOrder:
    return replace(
        UpdateOrder(image), wait=request.wait, allow_downgrade=request.allow_downgrade, other_board=other_board
    )


def _allowed(request: UpdateRequest) -> dict[str, Any]:
    other = {"other_board": sorted(request.other_board)} if request.other_board else {}
    return other | ({"allow_downgrade": True} if request.allow_downgrade else {})


def _ended(uuid: str, error: TedsProvisionError, began: float) -> BoardUpdate:
    return BoardUpdate(bytes.fromhex(uuid), result_of(error), None, 0, time.monotonic() - began, error)


def _on_no_bus(uuid: str) -> NoNodeError:
    return NoNodeError(
        f"Node {uuid} is on no bus of this station.",
        hint="Connect it to the bus. At a reader, the command update takes it.",
    )
