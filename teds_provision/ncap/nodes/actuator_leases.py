"""Actuator leases: a set point is held for the requested time, then released, and the node confirms its safe state.

An actuator keeps moving only while requests keep coming. Each request holds it for some tenths of a second or some
seconds; when the next one does not come (the page is closed, the browser died, the network is gone) the daemon releases
it, and when the daemon dies the node's dead-man does (operation.md section 2). One thread for each held actuator.
"""

from __future__ import annotations

import contextvars
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, Final

from teds_provision.api.bodies import LONGEST_HOLD
from teds_provision.errors import (
    LinkError,
    NodeBusyError,
    NodeRefusedError,
    NoNodeError,
    StoreError,
    TedsProvisionError,
)
from teds_provision.links.ports import Notice
from teds_provision.measure.blocks import SetPointCommand
from teds_provision.measure.held_actuator import HeldActuator
from teds_provision.measure.standing import NodeStanding, require_whitelisted
from teds_provision.measure.verified_session import DEAD_MAN, VerifiedSession, open_trusted
from teds_provision.ncap.live import Live
from teds_provision.ncap.nodes.node_jobs import NodeJobs, NodeLocks, as_program_error
from teds_provision.protocol.messages.frames import Reason
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.station.station import Station

_log = logging.getLogger(__name__)
HOLD: Final = 1.0  # seconds, if a request has none
_STARTING: Final = 15.0
_OPENING, _LOOK = 5.0, 0.05  # seconds to wait for a session that is being opened, and between checks of it
Measured = Callable[[str], AbstractContextManager[VerifiedSession | None]]


@dataclass
class _SetPointOrder:
    value: float
    unit: str | None
    number: int


@dataclass
class _HeldActuator:
    uuid: str
    channel: int
    until: float
    order: _SetPointOrder
    news: threading.Condition = field(default_factory=threading.Condition)
    applied: dict[str, Any] | None = None
    answered: int = 0
    error: TedsProvisionError | None = None
    safe: bool | None = None
    ended: bool = False
    let_go: bool = False  # the actuator is being released: new set points need a new lease
    crossed: bool = False
    before: _HeldActuator | None = None  # the lease before on the same actuator, which is still being released


@dataclass
class _SharedSession:
    """The session of a node that is not measured, for all of its actuators that are held."""

    turn: threading.RLock = field(default_factory=threading.RLock)
    users: int = 0
    verified: VerifiedSession | None = None
    stack: ExitStack = field(default_factory=ExitStack)

    @contextmanager
    def session(self, _uuid: str) -> Iterator[VerifiedSession | None]:
        """Yield the session for one exchange at a time."""
        with self.turn:
            yield self.verified


class ActuatorLeases:
    """The actuators that are held now, with a ``dead_man`` in ms.

    ``measured`` gives the session of a node that is being measured, ``lent_for`` why a node is let go to a writer.
    """

    def __init__(
        self,
        station: Station,
        live: Live,
        desk: NodeJobs,
        turns: NodeLocks,
        measured: Measured,
        is_measured: Callable[[str], bool],
        lent_for: Callable[[str], str | None],
        *,
        dead_man: int = DEAD_MAN,
    ) -> None:
        self._station, self._live, self._node_jobs, self._node_locks = station, live, desk, turns
        self._measured, self._is_measured, self._lent_for = measured, is_measured, lent_for
        self._dead_man = dead_man
        self._held: dict[tuple[str, int], _HeldActuator] = {}
        self._shared: dict[str, _SharedSession] = {}
        self._last: dict[tuple[str, int], dict[str, Any]] = {}
        self._guard = threading.Lock()

    def state(self, uuid: str, channel: int) -> dict[str, Any] | None:
        """Return an actuator's last set point, and whether it is known to be safe."""
        return self._last.get((uuid, channel))

    def held(self, uuid: str) -> list[int]:
        """Return the actuators of a node that requests hold now."""
        with self._guard:
            return sorted(number for (node, number), held in self._held.items() if node == uuid and not held.ended)

    def admits(self, command: SetPointCommand) -> bool:
        """Return False for a set point from a topic while a request holds its actuator. Reported once."""
        with self._guard:
            held = self._held.get((command.uuid, command.channel))
        if held is None or held.ended:
            return True
        if not held.crossed:
            held.crossed = True
            self._live.event("actuator", uuid=command.uuid, state="refused", channel=command.channel,
                             why="A set point arrived by topic while a request holds the actuator.")  # fmt: skip
        return False

    def put(self, uuid: str, channel: int, value: float, unit: str | None, hold: float | None) -> dict[str, Any]:
        """Set and hold for ``hold`` seconds; again before they are over, it is held on. Returns when it was applied.

        Raises PolicyError (whitelist, limits of the datasheet), NodeRefusedError (claimed by another), NoNodeError,
        BadDataError.
        """
        try:
            require_whitelisted(self._station, bytes.fromhex(uuid))
        except TedsProvisionError as error:
            with suppress(StoreError):
                facts = {"channel": channel, "value": value, "unit": unit or "", "why": error.message}
                self._station.audit("set", bytes.fromhex(uuid), error.code, **facts)
            raise
        seconds = HOLD if hold is None else min(hold, LONGEST_HOLD)
        held, mine = self._ordered(uuid, channel, value, unit, seconds)
        with held.news:
            held.news.wait_for(lambda: held.answered >= mine or held.ended, _STARTING)
            return self._answer(held, mine, seconds)

    def _ordered(
        self, uuid: str, channel: int, value: float, unit: str | None, seconds: float
    ) -> tuple[_HeldActuator, int]:
        """Give the order to this actuator's thread, a new one if there is none; return both thread and order number."""
        while True:
            held, fresh = self._held_for(uuid, channel, value, unit)
            with held.news:
                if held.let_go and not fresh:
                    continue  # released since _held_for returned it
                held.until = time.monotonic() + seconds + (_STARTING if fresh else 0.0)
                held.order = _SetPointOrder(value, unit, held.order.number + (not fresh))
                held.news.notify_all()
                if fresh:
                    who = contextvars.copy_context()  # keeps the actor for the audit log
                    work = (self._run, held, value, unit)
                    threading.Thread(target=who.run, args=work, name=f"hold {held.uuid[:8]}", daemon=True).start()
                return held, held.order.number

    def _held_for(self, uuid: str, channel: int, value: float, unit: str | None) -> tuple[_HeldActuator, bool]:
        """Return the actuator as it is held now, or a new one; and whether it is new."""
        key = (uuid, channel)
        with self._guard:
            held = self._held.get(key)
            if held is not None and not held.let_go:
                return held, False
            held = self._held[key] = _HeldActuator(uuid, channel, 0.0, _SetPointOrder(value, unit, 1), before=held)
            return held, True

    @staticmethod
    def _answer(held: _HeldActuator, mine: int, seconds: float) -> dict[str, Any]:
        if held.error is not None and held.answered <= mine:
            raise held.error
        if held.let_go and held.answered < mine:
            raise NodeBusyError("The actuator was released before it took this value.", hint="Set it again.")
        if held.answered < mine or held.applied is None:
            raise LinkError("The actuator did not answer in time.", hint="Its dead-man takes it to its safe state.")
        held.until = time.monotonic() + seconds
        return {"applied": held.applied, "until": time.time() + seconds, "safe": False}

    def release_actuator(self, uuid: str, channel: int) -> dict[str, Any]:
        """Release it now; ``safe`` is the node's own report, None without one."""
        with self._guard:
            held = self._held.get((uuid, channel))
        if held is None:
            last = self._last.get((uuid, channel))
            return {"applied": None, "until": None, "safe": last["safe"] if last else None}
        with held.news:
            held.let_go = True
            held.news.notify_all()
            held.news.wait_for(lambda: held.ended, _STARTING)
            return {"applied": held.applied, "until": None, "safe": held.safe}

    def end(self) -> None:
        """Let go of all of them, in order."""
        with self._guard:
            every = list(self._held)
        for uuid, channel in every:
            self.release_actuator(uuid, channel)

    # -- the thread of one lease -------------------------------------------------------------------------------------

    def _run(self, held: _HeldActuator, value: float, unit: str | None) -> None:
        node, facts = bytes.fromhex(held.uuid), {"channel": held.channel}
        try:
            self._station.audit("set", node, "begun", value=value, unit=unit or "", **facts)
            with self._session(held.uuid) as session:
                self._wait_for_the_one_before(held)
                self._hold(held, session)
        except SessionLostError as lost:
            held.error = LinkError(f"The session was lost: {lost.cause.message}", hint="It goes to its safe state.")
        except TedsProvisionError as error:
            held.error = error
        except Exception as bug:  # noqa: BLE001 - a thread has no caller to raise to, and this is no end in order
            _log.exception("Holding actuator %d of node %s failed.", held.channel, held.uuid)
            held.error = as_program_error(bug)
        finally:
            outcome = "done" if held.error is None else held.error.code
            with suppress(StoreError):  # a full disk must not keep callers waiting
                asked = {"value": held.order.value, "unit": held.order.unit or ""}
                why = {} if held.error is None else {"why": held.error.message}
                self._station.audit("set", node, outcome, safe=held.safe, **asked, **why, **facts)
            self._publish_state(held, safe=held.safe)
            with self._guard:
                if self._held.get((held.uuid, held.channel)) is held:  # unless a later lease has taken its place
                    del self._held[held.uuid, held.channel]
            with held.news:
                held.ended = held.let_go = True
                held.news.notify_all()

    @contextmanager
    def _session(self, uuid: str) -> Iterator[Measured]:
        """Yield access to the node's session for repeated use: the measurement's, or one of our own."""
        if self._is_measured(uuid):
            yield self._measured
            return
        with self._guard:
            shared = self._shared.setdefault(uuid, _SharedSession())
        with shared.turn:
            if not shared.users:
                shared.verified = shared.stack.enter_context(self._own_session(uuid))
            shared.users += 1
        try:
            yield shared.session
        finally:
            with shared.turn:
                shared.users -= 1
                if shared.users == 0:
                    shared.verified = None
                    shared.stack.close()

    @contextmanager
    def _own_session(self, uuid: str) -> Iterator[VerifiedSession]:
        writer = self._lent_for(uuid)
        if writer is not None:  # its datasheet may change, and a claim is bound to the datasheet
            raise NodeBusyError(f"Node {uuid} is busy: {writer}.", hint="Try again when that is done.")
        contact = self._node_jobs.contact(uuid)
        if contact is None:
            raise NoNodeError(f"Node {uuid} is not on any bus of this station.", hint="Connect it to a bus.")
        with self._node_locks.hold(uuid, "its actuators are held"), Conversation(contact, notice=_quiet) as node:
            yield open_trusted(self._station, node, by="ncap")

    def _hold(self, held: _HeldActuator, session: Measured) -> None:
        """Claim, feed until it is released or no request follows, release."""
        actuator: HeldActuator | None = None
        unit: str | None = None
        answered = 0
        standing = NodeStanding(self._station, bytes.fromhex(held.uuid))
        standing.drives = True
        self._until_there(held, session)
        try:
            while True:
                with held.news:
                    order = held.order
                    if time.monotonic() >= held.until and answered >= order.number:
                        held.let_go = True
                    if held.let_go:  # a later request claims the actuator again
                        return
                standing.require()
                with session(held.uuid) as trusted:
                    if trusted is None:
                        raise LinkError("The node is not connected now.", hint="Connect it to a bus.")
                    if actuator is None or order.unit != unit:
                        actuator, unit = self._claimed(trusted, held, order, again=actuator is not None), order.unit
                    applied = actuator.apply(order.value)
                answered = order.number
                with held.news:
                    held.applied, held.answered = applied.as_json(), order.number
                    held.news.notify_all()
                self._publish_state(held, safe=False)
                self._until_news(held, answered, actuator.pause)
        finally:
            if actuator is not None:
                with session(held.uuid):
                    actuator.__exit__(None, None, None)
                held.safe = actuator.safe

    @staticmethod
    def _wait_for_the_one_before(held: _HeldActuator) -> None:
        """Wait for the end of an earlier claim: two of one session cannot have an actuator.

        That end reports the safe state.
        """
        before, held.before = held.before, None
        if before is not None:
            with before.news:
                before.news.wait_for(lambda: before.ended, _STARTING)

    @staticmethod
    def _until_there(held: _HeldActuator, session: Measured) -> None:
        """Wait for a measurement that has just begun to open its session."""
        end = time.monotonic() + _OPENING
        while time.monotonic() < end and not held.let_go:
            with session(held.uuid) as trusted:
                if trusted is not None:
                    return
            with held.news:
                held.news.wait_for(lambda: held.let_go, _LOOK)

    def _claimed(
        self, trusted: VerifiedSession, held: _HeldActuator, order: _SetPointOrder, *, again: bool
    ) -> HeldActuator:
        """Return the claimed actuator; the limits are checked before anything is claimed."""
        actuator = HeldActuator(trusted, held.channel, unit=order.unit, dead_man=self._dead_man)
        actuator.octets_of(order.value)
        if not again:
            try:
                actuator.__enter__()
            except NodeRefusedError as refusal:
                if refusal.reason != Reason.WRONG_STATE:
                    raise
                # This session has already claimed the channel, for set points from a topic; only a measurement does
                # this.
                raise NodeBusyError(
                    f"Channel {held.channel} is controlled by set points from a topic.",
                    hint="Stop the publisher, then try again.",
                ) from refusal
        return actuator

    @staticmethod
    def _until_news(held: _HeldActuator, answered: int, pause: float) -> None:
        """Wait until the value has to be sent again, there is another one, or it is to be let go."""
        with held.news:
            left = max(0.0, min(pause, held.until - time.monotonic()))
            held.news.wait_for(lambda: held.let_go or held.order.number != answered, left)

    def _publish_state(self, held: _HeldActuator, *, safe: bool | None) -> None:
        applied = held.applied or {}
        facts = {"value": applied.get("value"), "unit": applied.get("unit"), "safe": safe}
        self._last[held.uuid, held.channel] = facts
        self._live.event("actuator", uuid=held.uuid, state="held" if safe is False else "released",
                         channel=held.channel, **facts)  # fmt: skip


def _quiet(_notice: Notice) -> None:
    """Ignore notices: the request has the answer."""
