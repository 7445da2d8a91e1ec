"""The measurements of the service: kept in the store, carried on after every start, ended in order.

One table has every measurement with its nodes, one lock guards it, and one thread decides: which node joins which
measurement, when one begins, when it is over. Slow work (a selection among all nodes, a question to a node) is
done by workers, and values go through the threads of :class:`MeasurementJob`. Two things happen in other threads: a
node that answers on a bus is locked there, before any other part works on it, and a loan is the borrower's.

A selected node that answers joins: its room on the bus is known from the stored datasheet, and its own supervisor is
started. A lost one leaves, gives its lock and its room back, and joins again when it answers, on whichever bus. Others
are not affected: no running stream is slowed, and a lost node is asked at its own address (ncap.md, "Measure what
comes").
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from teds_provision.errors import (
    FrozenError,
    LinkError,
    NodeBusyError,
    NotFoundError,
    PolicyError,
    StoreError,
    TedsProvisionError,
    UsageError,
)
from teds_provision.handover.life import is_retired
from teds_provision.links.discovery import Sighting
from teds_provision.measure.blocks import ChannelFacts, NodeReport, SetPointCommand, StationFacts
from teds_provision.measure.buses import Buses
from teds_provision.measure.matching import ListedNodes, NodeMatch, UnsignedNodes, load_of
from teds_provision.measure.planning import BusTime, period_of, sensors_of
from teds_provision.measure.rates import RateProposal, Surroundings, propose, this_machine
from teds_provision.measure.request import MeasurementRequest
from teds_provision.measure.running.measurement import Measurement, Watcher
from teds_provision.measure.running.measurement_job import MeasurementJob
from teds_provision.measure.sinks import Sink
from teds_provision.measure.sinks.base import BUDGET
from teds_provision.measure.standing import require_measurable, why_not_measured
from teds_provision.measure.verified_session import DEAD_MAN, VerifiedSession
from teds_provision.ncap.live import Live
from teds_provision.ncap.membership import AGAIN, LOOK, QUIET, AfterEnd, Budget, Member, Membership
from teds_provision.ncap.nodes.directory import NodeDirectory
from teds_provision.ncap.nodes.node_jobs import WAIT, NodeLocks, as_program_error
from teds_provision.ncap.running_measurement import Phase, RunningMeasurement, facts_for_log
from teds_provision.ncap.sinks import DaemonSinks, sink_json
from teds_provision.ncap.waits import USUAL, Waits
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.operation.stream_commands import StreamKind
from teds_provision.shapes.measurement import MeasurementSpec
from teds_provision.shapes.problem import problem_of
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeptMeasurement
from teds_provision.teds.image import Image
from teds_provision.teds.sheet import Sheet

_log = logging.getLogger(__name__)
_ADOPTED: Final = "adopted"
NCAP: Final = "ncap"
_RUN: Final = "run"
_OF_THIS_PROCESS: Final = frozenset({_RUN, _ADOPTED, UnsignedNodes.text})
"""IDs of measurements that options of ``ncap run`` began: they end with it."""
LETTING_GO: Final = 4.0  # seconds for a node's session to end in order
ANSWERING: Final = 1.0  # seconds for the answer of a node whose address has changed
LONGEST_END: Final = 20.0  # seconds for the same, for callers that can wait
_BEGINNING: Final = 0.2  # seconds between checks whether a measurement that holds the node's lock has begun
LONGEST_LOOK: Final = 120.0  # seconds that another inspection of a node may take
# seconds after which a lent node is measured again, even if the borrower has not returned it
LONGEST_LOAN: Final = 900.0
_SLOW_LOOK: Final = 0.5  # seconds between checks of a measurement whose nodes are listed
_SELECTING: Final = 1.0  # seconds between selections of nodes for a frozen expression
_ENDING, _LONGEST_ENDING = 15.0, 20.0  # seconds for a measurement to end in order, and for its caller to wait


@dataclass(eq=False)
class NodeLoan:
    """A node (UUID in hex) that is let go to a writer, and why in half a sentence."""

    uuid: str
    why: str
    ended: bool = False


class MeasurementSupervisor:
    """All measurements of the service. ``admits`` decides whether a set point from a topic may pass.

    ``dead_man`` in ms is for a measurement that is begun without one.
    """

    def __init__(
        self,
        station: Station,
        roster: NodeDirectory,
        live: Live,
        turns: NodeLocks,
        buses: Buses,
        sinks: DaemonSinks,
        admits: Callable[[SetPointCommand], bool],
        *,
        dead_man: int = DEAD_MAN,
        require_firmware: bool = False,
        waits: Waits = USUAL,
    ) -> None:
        self._waits = waits
        self._require_firmware = require_firmware
        self._station, self._directory, self._live, self._node_locks = station, roster, live, turns
        self._unverified: UnsignedNodes | None = None
        self._adopted: set[bytes] = set()
        self._buses, self._sinks, self._admits = buses, sinks, admits
        self._dead_man = dead_man
        self._running: dict[str, RunningMeasurement] = {}
        self._loans: dict[str, list[NodeLoan]] = {}
        self._moving: set[str] = set()  # nodes whose loan is beginning or ending
        self._lock = threading.Condition()
        self._wake = threading.Event()
        self._thread: threading.Thread | None = None
        self._workers = ThreadPoolExecutor(4, thread_name_prefix="ask")
        self._welcomed = 0.0
        self._messages: tuple[float, int] = (time.monotonic(), 0)
        self._rate = 0.0

    # -- start and end -----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Carry on what is kept."""
        for kept in self._station.measurements.due():
            self._log(self._begin(kept), "continued")

    def match(self, expression: str, *, rate: float | None = None, frozen: bool = False) -> None:
        """Measure selected nodes as they come, for the life of this process (``ncap run --measure``).

        Raises UsageError, NotFoundError for an invalid expression, or a group that does not exist.
        """
        NodeMatch.parse(expression).require_groups(self._station)
        same = (expression, rate, frozen)
        if any(
            (measurement.match, measurement.rate, measurement.frozen) == same
            for measurement in self._station.measurements.due()
        ):
            return  # already stored
        kept = KeptMeasurement(_RUN, match=expression, rate=rate, frozen=frozen, dead_man=self._dead_man)
        self._log(self._begin(kept), "begun")

    def unverified(self, *, rate: float | None = None) -> None:
        """Measure every self-describing node by its unsigned datasheet, marked so (``--adopt --unverified``).

        One that is signed meanwhile is measured on as signed, if no other measurement takes it.
        """
        self._unverified = UnsignedNodes()
        for name in (self._unverified.text, _ADOPTED):
            self._log(self._begin(KeptMeasurement(name, match=name, rate=rate, dead_man=self._dead_man)), "begun")

    @contextmanager
    def unmeasured(self, uuid: str, why: str) -> Iterator[None]:
        """Release a node that is measured unverified for the block, in which it may be signed."""
        loan = NodeLoan(uuid, why)
        with self._lock:
            unverified = self._running.get(UnsignedNodes.text)
            mine = unverified.membership.members.get(uuid) if unverified is not None else None
            self._loans.setdefault(uuid, []).append(loan)
        try:
            if mine is not None and mine.supervisor is not None:
                mine.supervisor.stop(why)
            if mine is not None:
                with self._lock:
                    self._lock.wait_for(lambda: self._of(uuid) is None, LETTING_GO)
            yield
        finally:
            self.return_node(loan)

    def on_sighting(self, uuid: str) -> None:
        """Handle a node that answered on a bus; called before any other part works on it."""
        with self._lock:
            every = [running for running in self._running.values() if running.takes_in]
        for running in every:
            self._consider(running, uuid)

    def look_who_is_meant(self) -> None:
        """Select the nodes again, after this process changed a group, a key or a datasheet."""
        with self._lock:
            for running in self._running.values():
                running.asked_anew = True

    def stop(self) -> None:
        """End all of them in order; what is kept stays kept."""
        with self._lock:
            every = list(self._running.values())
        for running in every:
            running.stop.set()
        self._wake.set()
        for running in every:
            self._wait_until_over(running)
            self._log(running, "ended" if running.kept.id in _OF_THIS_PROCESS else "paused")
        self._workers.shutdown(wait=False, cancel_futures=True)

    # -- for the API -------------------------------------------------------------------------------------------------

    def add(self, members: Mapping[str, Any], owner: str = NCAP) -> dict[str, Any]:
        """Measure from now on, also after restarts, until the measurement is deleted; ``owner`` requested it.

        ``members`` are those of a request body; those that are absent or null are as the daemon has them. Raises
        UsageError (no node, a sink that cannot be named so), NotFoundError (the group), NodeBusyError (one of the nodes
        is measured already).
        """
        spec = MeasurementSpec.from_json(members, actuators=True, dead_man=self._dead_man)
        if sum((spec.group is not None, bool(spec.uuids), spec.match is not None)) != 1:
            raise UsageError(
                "A measurement needs a group, nodes, or an expression.", hint='Give "group", "uuids" or "match".'
            )
        if spec.match is not None:
            NodeMatch.parse(spec.match).require_groups(self._station)
            if spec.trigger and not spec.frozen:
                raise UsageError(
                    "Nodes that join one by one cannot start together.", hint='Omit the trigger, or set "frozen".'
                )
        whole = replace(
            spec,
            sinks=tuple(dict.fromkeys(self._sinks.whole(sink) for sink in spec.sinks)),
            # an expression also matches nodes that come later, whose actuators must not be claimed
            actuators=spec.actuators and spec.match is None,
        )
        kept = KeptMeasurement("", **whole.settings(), owner=owner)
        # Refuse what can never be measured before it is stored: it would be retried for ever, also after each restart.
        nodes = self._station.measurements.nodes_of(kept)
        if not nodes and kept.match is None:
            raise UsageError(f"Group {kept.group!r} is empty.", hint="Add a node to it first.")
        for uuid in nodes:
            self._require_unmeasured(uuid)
            self._require_plan(uuid, kept)
        for sink in kept.sinks:
            self._sinks.open(sink)
        with self._station.lock("measure"):  # if two requests at once name one node or group, one of them is refused
            for uuid in self._station.measurements.nodes_of(kept):
                self._require_unmeasured(uuid)
                self._require_plan(uuid, kept)  # the node may have been removed meanwhile
            with self._station.durable("measure"):
                kept = self._station.measurements.keep(kept)
                facts = facts_for_log(kept)
                self._station.audit("measure", None, "begun", **facts, nodes=[node.hex() for node in nodes])
            return self._json(self._begin(kept))

    def proposed_rate(self, *, group: str | None = None, uuids: Sequence[str] = ()) -> RateProposal | None:
        """Return the rate that bus, budget and machine can carry; None if no datasheet of these nodes states one.

        Raises NotFoundError (the group), UsageError (none or both are named).
        """
        if (group is None) == (not uuids):
            raise UsageError("A rate is proposed for a group, or for nodes.", hint='Give "group" or "uuids".')
        kept = KeptMeasurement("", group=group, uuids=tuple(bytes.fromhex(uuid) for uuid in uuids))
        values, busy = this_machine()

        def bus(uuid: bytes) -> tuple[str, BusTime] | None:
            sighting = self._buses.presence.seen_at(uuid)
            if sighting is None:
                return None
            found = self._buses.bus_of(sighting)
            return found.place, found.time_for(found.share.for_node(uuid), sighting.address)

        around = Surroundings(
            bus,
            BUDGET if self._sinks.publish else None,
            rows=self._sinks.publish,
            scalar_rate=MeasurementSpec.scalar_rate,
            values=values,
            busy=busy,
        )
        return propose(self._station, self._station.measurements.nodes_of(kept), MeasurementRequest(), around)

    def _require_unmeasured(self, uuid: bytes) -> None:
        other = self.measurement_of(uuid.hex())
        if other is not None:
            raise NodeBusyError(
                f"Node {uuid.hex()} is already being measured ({other}).", hint="End the measurement first."
            )

    def _require_plan(self, uuid: bytes, kept: KeptMeasurement) -> None:
        """Raise what :func:`require_measurable` does.

        And BadDataError if the known datasheet can never be measured so.
        """
        require_measurable(self._station, uuid)
        image = self._station.datasheets.datasheet(uuid)
        if image is None:
            return
        kind = None if kept.kind is None else StreamKind[kept.kind.upper()]
        channels = Sheet.from_image(image).channels
        if self._sinks.allows_set_points(kept) and channels and all(channel.actuator for channel in channels):
            return  # it has only actuators, which need no plan for samples
        for channel in sensors_of(channels, kept.channels, kind):
            period_of(channel, kept.rate)

    def delete(self, measurement_id: str) -> None:
        """End it, and forget it; raises NotFoundError, PolicyError for one that a command of this home runs."""
        with self._lock:
            one = self._running.get(measurement_id)
            if one is not None and one.deleted:
                one = None
            if one is not None:
                one.deleted = True
        if one is None:
            kept = next((other for other in self._station.measurements.all() if other.id == measurement_id), None)
            if kept is None:
                raise NotFoundError(f"No measurement has the ID {measurement_id!r}.")
            if not kept.lasting:
                raise PolicyError(
                    f"Measurement {measurement_id} belongs to the command measure (process {kept.pid}).",
                    hint="End it there with Ctrl-C.",
                )
        if one is not None:
            one.stop.set()
            self._wake.set()
            self._wait_until_over(one)
        with self._station.durable("measure"):
            if not self._station.measurements.forget(measurement_id) and one is None:
                raise NotFoundError(f"No measurement has the ID {measurement_id!r}.")
            facts = {"id": measurement_id} if one is None else one.log_facts() | one.counts()
            self._station.audit("measure", None, "ended", **facts)
        self._live.event("measurement", state="deleted", id=measurement_id)

    def all(self) -> list[dict[str, Any]]:
        """Return every one: those that run here, then those that commands of this home run."""
        return [self._json(running) for running in (*self._shown(), *self._of_commands())]

    def _shown(self) -> list[RunningMeasurement]:
        """Return those that run here, or try to."""
        with self._lock:
            return [running for running in self._running.values() if not running.deleted]

    def _of_commands(self) -> list[RunningMeasurement]:
        """Return those of commands that live, to be shown; the nodes of one whose group is gone are not known."""
        found = []
        for kept in self._station.measurements.of_commands():
            with suppress(NotFoundError):
                running = RunningMeasurement(kept, self._listed(kept), kept, state="running")
                running.why = f"measured by the command measure (process {kept.pid})"
                found.append(running)
        return found

    def _listed(self, kept: KeptMeasurement) -> Membership:
        """Return a membership of the nodes that a measurement lists; raises NotFoundError (the group)."""
        nodes = self._station.measurements.nodes_of(kept)
        return Membership(time.monotonic(), {uuid.hex(): Member() for uuid in nodes})

    def _of(self, uuid: str) -> RunningMeasurement | None:
        """Return the measurement that has a node."""
        with self._lock:
            every = (running for running in self._running.values() if not running.deleted)
            return next((running for running in every if running.membership.has(uuid)), None)

    def measurement_of(self, uuid: str) -> str | None:
        """Return the ID of the measurement that has a node."""
        running = self._of(uuid)
        return None if running is None else running.kept.id

    def is_measured(self, uuid: str) -> bool:
        """Return True if a node is in a session of a measurement now."""
        job = self._job_of(uuid)
        return job is not None and job.measurement is not None and self._node_locks.holder(uuid) is not None

    def facts_of(self, uuid: str) -> StationFacts | None:
        """Return the station facts that the sinks of a node's running measurement have; None if none runs."""
        job = self._job_of(uuid)
        measurement = job.measurement if job is not None else None
        return measurement.facts if measurement is not None else None

    def measured_as(self, group: str) -> list[str]:
        """Return the IDs of the measurements of a group that run, or try to."""
        return [running.kept.id for running in self._shown() if running.kept.group == group]

    def _job_of(self, uuid: str) -> MeasurementJob | None:
        running = self._of(uuid)
        return None if running is None else running.job

    @contextmanager
    def session(self, uuid: str, *, streaming: bool = False) -> Iterator[VerifiedSession | None]:
        """Give the session in which a node is measured, for one more command; None if there is none now.

        ``streaming``: only once its streams run.
        """
        job = self._job_of(uuid)
        measurement = job.measurement if job is not None else None
        if measurement is None:
            yield None
            return
        with measurement.session(bytes.fromhex(uuid), streaming=streaming) as trusted:
            yield trusted

    # -- lending nodes to commands of this home that write to them ---------------------------------------------------

    def lend_node(self, loan: NodeLoan, seconds: float = LETTING_GO) -> bool:
        """Release a node until :meth:`return_node`, so that a writer can use it; False if it is not measured.

        It may be lent to several at once, who take turns at the node. Raises NodeBusyError if its session did not end
        in order within ``seconds``; then it is measured on. Other borrowers that are served first take as long each.
        """
        with self._one_at_a_time(loan.uuid):
            with self._lock:
                job = self._job_of(loan.uuid)
                if loan.ended:
                    return False
                if job is not None and job.kept.frozen:
                    raise FrozenError(
                        f"Node {loan.uuid} is in a frozen measurement ({job.kept.id}).",
                        hint="End the measurement first.",
                    )
                self._loans.setdefault(loan.uuid, []).append(loan)
                if job is None:  # within the lock, so that no measurement starts meanwhile
                    return False
            if job.suspend_node(bytes.fromhex(loan.uuid), loan.why, seconds):
                return True
        self.return_node(loan)
        raise NodeBusyError(
            f"Node {loan.uuid} is being measured and was not released within {seconds:g} s.", hint="Try again."
        )

    def lent_for(self, uuid: str) -> str | None:
        """Return why a node is let go to a writer now, in half a sentence; None if it is not."""
        with self._lock:
            loans = self._loans.get(uuid)
            return loans[0].why if loans else None

    @contextmanager
    def _one_at_a_time(self, uuid: str) -> Iterator[None]:
        """Wait until nothing else lets this node go or measures it again; without the lock, as both take seconds."""
        with self._lock:
            self._lock.wait_for(lambda: uuid not in self._moving)
            self._moving.add(uuid)
        try:
            yield
        finally:
            with self._lock:
                self._moving.discard(uuid)
                self._lock.notify_all()

    @contextmanager
    def lent(self, uuid: str, why: str) -> Iterator[bool]:
        """Have a node to work on in this process for the block; True if a measurement let it go for that.

        Raises as :meth:`lend_node` does, NodeBusyError if something else works on it.
        """
        with ExitStack() as stack:
            yield self._borrow(stack, uuid, why)

    def _borrow(self, stack: ExitStack, uuid: str, why: str) -> bool:
        until = time.monotonic() + LONGEST_END
        while True:
            with ExitStack() as mine:
                loan = NodeLoan(uuid, why)
                mine.callback(self.return_node, loan)
                was_measured = self.lend_node(loan, LONGEST_END)
                try:
                    self._node_locks.acquire(uuid, why, wait=LONGEST_LOOK)
                    mine.callback(self._node_locks.release, uuid)
                except FrozenError:  # its measurement keeps the lock during the loan, or is about to start
                    if not was_measured and time.monotonic() >= until:
                        raise
                    if not was_measured:
                        time.sleep(_BEGINNING)
                        continue
                stack.push(mine.pop_all())
                return was_measured

    def return_node(self, loan: NodeLoan) -> None:
        """Measure it again, unless another borrower still has it."""
        self._ask_where_it_is(bytes.fromhex(loan.uuid))
        with self._one_at_a_time(loan.uuid):
            with self._lock:
                loan.ended = True
                loans = self._loans.get(loan.uuid, [])
                if loan not in loans:
                    return
                loans.remove(loan)
                if loans:
                    return
                del self._loans[loan.uuid]
                job = self._job_of(loan.uuid)
            if job is not None:
                job.resume_node(bytes.fromhex(loan.uuid))
                self.look_who_is_meant()  # select again: the borrower may have renamed the node, for example
                return
        if self._directory.seen(loan.uuid).present:
            self.on_sighting(loan.uuid)

    def _ask_where_it_is(self, uuid: bytes) -> None:
        """Ask a node that was given another address, which it does not announce, at the store's address."""
        seen, record = self._buses.presence.seen_at(uuid), self._station.nodes.get(uuid)
        if seen is None or record is None or record.can_address in (None, seen.address):
            return
        with suppress(LinkError):
            self._buses.bus_of(seen).discovery.identify_at(record.can_address, ANSWERING)

    def sheet(self, uuid: str) -> Image | None:
        """Return the datasheet of a measured node: the one that its session verified, and that cannot change."""
        with self.session(uuid) as trusted:
            if trusted is None:
                return None
        return self._station.datasheets.datasheet(bytes.fromhex(uuid))

    def sinks(self) -> list[dict[str, Any]]:
        """Return every sink with the counts of what it was given."""
        return [sink_json(key, sink) for key, sink in self._open_sinks()]

    def _open_sinks(self) -> list[tuple[str, Sink]]:
        jobs = [(running.kept.id, running.job) for running in self._shown() if running.job is not None]
        return [(key, sink) for key, job in jobs for sink in job.sinks]

    def budget(self) -> dict[str, Any]:
        """Return the messages a second that go to ROS and MQTT now, and how many are known to be carried."""
        now, sent = time.monotonic(), sum(sink.stats.messages for _, sink in self._open_sinks() if sink.budgeted)
        before, count = self._messages
        if now - before >= 1.0:
            self._rate = max(0, sent - count) / (now - before)
            self._messages = now, sent
        return {"used": round(self._rate, 1), "limit": BUDGET}

    def clock_error(self) -> float | None:
        """Return the worst bound of a node's clock, seconds; None if nothing is measured."""
        with self._lock:
            reports = [report for running in self._shown() for report in running.reports.values()]
        found = [report.get("clock_error") for report in reports if report["state"] == "running"]
        return max((chosen for chosen in found if chosen is not None), default=None)

    def _json(self, running: RunningMeasurement) -> dict[str, Any]:
        kept = running.kept
        with self._lock:
            uuids, reports = running.uuids, dict(running.reports)
            left = [uuid for uuid in reports if uuid not in running.past] if running.takes_in else []
        return kept.to_json() | {
            "id": kept.id,
            "uuids": list(uuids),
            "actuators": self._sinks.allows_set_points(kept),
            "created": kept.created,
            "owner": kept.owner,
            "process": None if kept.pid is None else {"id": kept.pid, "started": kept.started},
            "state": running.state,
            "why": running.why,
            "lower_rate": running.lower_rate(),
            "nodes": [
                reports.get(uuid, {"uuid": uuid, "state": "waiting", "why": ""})
                for uuid in (dict.fromkeys((*uuids, *left)) if kept.lasting else ())
            ],
            "files": [
                str(file) for sink in (running.job.sinks if running.job is not None else ()) for file in sink.files
            ],
        }

    def _log(self, running: RunningMeasurement, outcome: str, uuid: str | None = None) -> None:
        """Add an entry to the audit log; a store that cannot be written ends no measurement."""
        node = None if uuid is None else bytes.fromhex(uuid)
        counts = running.counts() if uuid is None else {}
        with suppress(StoreError):
            self._station.audit("measure", node, outcome, **running.log_facts(), **counts)

    # -- the supervising thread ---------------------------------------------------------------------------------------

    def _begin(self, kept: KeptMeasurement) -> RunningMeasurement:
        running = RunningMeasurement(kept, self._listed(kept), kept, looked=time.monotonic())
        if kept.match is not None and kept.frozen:
            running.phase, running.looked = Phase.SELECTING, -_SELECTING
        with self._lock:
            self._running[kept.id] = running
            if running.takes_in:
                self._welcomed = -self._waits.keys
            if self._thread is None:
                self._thread = threading.Thread(target=self._decide, name="measurements", daemon=True)
                self._thread.start()
        self._wake.set()
        return running

    def _decide(self) -> None:
        """Look at every measurement, again and again; one that fails ends, and the others go on."""
        while True:
            self._wake.wait(self._pause())
            self._wake.clear()
            for running in self._active():
                try:
                    self._look_at(running, time.monotonic())
                except TedsProvisionError as error:
                    if isinstance(error, StoreError) and running.phase is Phase.MEASURING:
                        # Temporary: the next read may succeed.
                        _log.warning("Measurement %s: the store cannot be read: %s", running.kept.id, error.message)
                        running.not_before = time.monotonic() + self._waits.store
                    else:
                        self._fail(running, error)
                except Exception as bug:  # noqa: BLE001 - the thread that decides for all ends for no bug in one
                    _log.exception("Measurement %s failed.", running.kept.id)
                    self._fail(running, as_program_error(bug))

    def _active(self) -> list[RunningMeasurement]:
        with self._lock:
            return [running for running in self._running.values() if running.phase is not Phase.OVER]

    def _pause(self) -> float | None:
        """Return the seconds until the next look, None while nothing runs."""
        pauses = []
        for running in self._active():
            if running.phase is Phase.ENDING or running.membership.arrived:
                pauses.append(QUIET)
            elif running.takes_in or running.phase is Phase.LOCKING:
                pauses.append(LOOK)
            else:
                pauses.append(_SLOW_LOOK)
        return min(pauses, default=None)

    def _look_at(self, running: RunningMeasurement, now: float) -> None:
        if running.phase is Phase.ENDING:
            if running.job is None or not running.job.alive or now >= running.until:
                self._finish(running)
        elif running.stop.is_set():
            self._end(running)
        elif running.phase is Phase.SELECTING:
            self._select(running, now)
        elif running.phase is Phase.LOCKING:
            self._lock_members(running, now)
        elif running.job is None or not running.job.alive:
            self._end(running)
        elif now < running.not_before:
            return
        elif running.takes_in:
            self._take_in(running, running.job, now)
        elif now - running.looked >= _SLOW_LOOK:
            running.looked = now
            with self._lock:
                state, why = running.present_state(running.job, 0)
            self._publish_state(running, state, why)
            if self._has_other_members(running, running.job):
                running.again = True
                self._end(running)

    def _select(self, running: RunningMeasurement, now: float) -> None:
        """Wait until a frozen expression selects any node; then its members stay."""
        if running.selection is None:
            if now - running.looked >= _SELECTING and running.kept.match is not None:
                running.selection = self._workers.submit(self._selected, running.kept.match)
                running.selection.add_done_callback(lambda _selection: self._wake.set())
            return
        if not running.selection.done():
            return
        selection, running.selection, running.looked = running.selection, None, now
        found, why = selection.result()
        with self._lock:
            meant = [uuid for uuid in found if self._of(uuid.hex()) in (None, running)]
            if meant:
                self._set_members(running, replace(running.kept, match=None, uuids=tuple(meant), actuators=False))
        if meant:
            self._lock_members(running, now)
            return
        self._publish_state(running, "waiting", why or "no known node matches")
        with self._lock:  # the members of the selection before
            running.membership.members.clear()
            running.reports.clear()

    def _selected(self, expression: str) -> tuple[list[bytes], str]:
        """Return the known nodes that a frozen expression selects, and why it may select none."""
        match = NodeMatch.parse(expression)
        found = dict.fromkeys(uuid for uuid, *_ in self._station.keys.all_key_names())
        meant = [
            uuid
            for uuid in found
            if not why_not_measured(self._station, uuid)
            and not match.why_not(self._station, uuid)
            and self._station.datasheets.datasheet(uuid) is not None
            and not self._is_retired(uuid.hex())
        ]
        return meant, match.unknown_type(self._station)

    def _lock_members(self, running: RunningMeasurement, now: float) -> None:
        """Lock the nodes one after the other, and begin once all are locked."""
        for uuid, member in running.membership.members.items():
            if member.locked:
                continue
            try:
                self._node_locks.acquire(uuid, f"measurement {running.kept.id}", wait=0.0, frozen=True)
            except TedsProvisionError as error:
                if isinstance(error, FrozenError) or now - running.looked >= WAIT:
                    self._publish_state(running, "waiting", error.message)
                return
            member.locked, running.looked = True, now
            self._directory.note(uuid, measurement=running.kept.id)
        self._start(running, now)

    def _start(self, running: RunningMeasurement, now: float) -> None:
        job = self._new_job(running)
        if running.takes_in:
            live = [sink for sink in job.sinks if sink.budgeted]
            rows = any(sink.wants_rows for sink in live)
            running.budget = Budget(BUDGET if live else None, job.kept.scalar_rate, rows)
            running.who = self._who(running.kept)
            running.unknown_type = NodeMatch.parse(running.kept.match or "").unknown_type(self._station)
        with self._lock:
            job.lent.update(bytes.fromhex(uuid) for uuid in self._loans if running.membership.has(uuid))
            running.job, running.phase = job, Phase.MEASURING
            running.looked = running.membership.began = now
        self._publish_state(running, "starting")
        job.start(self._buses, self._watcher(running))

    def _new_job(self, running: RunningMeasurement) -> MeasurementJob:
        return MeasurementJob(
            self._station,
            running.kept,
            more=lambda take: self._sinks.extra_sinks(running.kept, take),
            admits=self._admits if self._sinks.allows_set_points(running.kept) else None,
            request=MeasurementRequest(
                patient=True,
                by="ncap",
                unverified=running.kept.id == UnsignedNodes.text,
                require_firmware=self._require_firmware,
            ),
            opened=self._sinks.open,
        )

    def _is_retired(self, uuid: str) -> bool:
        return is_retired(self._station.nodes.get(bytes.fromhex(uuid)))

    def _has_other_members(self, running: RunningMeasurement, job: MeasurementJob) -> bool:
        """Return True if `replace` or `decommission` changed the nodes of a measurement in the store."""
        if running.kept.frozen:  # a frozen measurement gets no other nodes; one of its own may be retired
            return any(self._is_retired(uuid) for uuid in running.uuids)
        kept = next((kept for kept in self._station.measurements.all() if kept.id == running.kept.id), None)
        if kept is None:  # `decommission` deleted the row, unless the measurement's time was over
            return job.kept.ends is None and not running.stop.is_set()
        try:
            return {uuid.hex() for uuid in self._station.measurements.nodes_of(kept)} != set(running.uuids)
        except NotFoundError:
            return True

    # -- the end of a measurement ------------------------------------------------------------------------------------

    def _end(self, running: RunningMeasurement) -> None:
        """Begin to end it in order; :meth:`_finish` follows when its threads have ended, or 15 s later."""
        with self._lock:
            running.phase, running.until = Phase.ENDING, time.monotonic() + _ENDING
        if running.job is not None:
            running.job.stop(0.0)

    def _fail(self, running: RunningMeasurement, error: TedsProvisionError) -> None:
        running.failed, running.again = error.message, False
        self._publish_state(running, "failed", error.message)
        if running.phase is Phase.ENDING:
            self._leave_table(running, still_shown=True)
        else:
            self._end(running)

    def _finish(self, running: RunningMeasurement) -> None:
        """Release its nodes; begin again if it has other ones now."""
        membership = running.membership
        if running.takes_in:
            for uuid in list(membership.members):
                self._release(running, uuid)
        with self._lock:
            arrived = membership.clear_arrived()
        for uuid in arrived:
            self._node_locks.release(uuid)
        for uuid, member in membership.members.items():
            if member.locked:
                member.locked = False
                self._node_locks.release(uuid)
                self._directory.note(uuid, "idle", measurement=None, report=None)
        if running.again and not running.stop.is_set():
            running.again = False
            if not self._take_new_members(running):
                self._leave_table(running)
            return
        if running.job is not None and not running.failed:
            self._publish_state(running, "ended")
        by_itself = running.state == "ended" and not running.takes_in and not running.stop.is_set()
        if by_itself:  # its time is over, and its row was deleted
            self._log(running, "ended")
        self._leave_table(running, still_shown=not by_itself)

    def _take_new_members(self, running: RunningMeasurement) -> bool:
        """Read again which nodes a measurement has; False if it is not kept any more, because none is left."""
        try:
            kept = running.asked  # the nodes of a frozen expression are selected again
            if kept.match is not None:
                running.kept, running.phase, running.looked = kept, Phase.SELECTING, -_SELECTING
                return True
            self._set_members(running, self._station.measurements.get(running.kept.id))
        except NotFoundError as error:
            self._publish_state(running, "ended", error.message)
            return False
        return True

    def _set_members(self, running: RunningMeasurement, kept: KeptMeasurement) -> None:
        """Begin with the nodes that are listed now, once they are locked; raises NotFoundError."""
        membership = self._listed(kept)
        with self._lock:
            running.kept, running.membership, running.job = kept, membership, None
            running.reports = {uuid: report for uuid, report in running.reports.items() if membership.has(uuid)}
            running.phase, running.looked = Phase.LOCKING, time.monotonic()

    def _leave_table(self, running: RunningMeasurement, *, still_shown: bool = False) -> None:
        with self._lock:
            running.phase = Phase.OVER
            if not still_shown:
                self._running.pop(running.kept.id, None)
            self._lock.notify_all()
        running.over.set()
        if not still_shown:
            self._live.event("measurement", state="deleted", id=running.kept.id)

    def _wait_until_over(self, running: RunningMeasurement) -> None:
        if running.over.wait(_LONGEST_ENDING):
            with self._lock:
                self._running.pop(running.kept.id, None)

    def _publish_state(self, running: RunningMeasurement, state: str, why: str = "") -> None:
        if (running.state, running.why) != (state, why):
            running.state, running.why = state, why
            self._live.event("measurement", state=state, id=running.kept.id, group=running.kept.group, why=why)

    # -- nodes that come and go --------------------------------------------------------------------------------------

    def _who(self, kept: KeptMeasurement) -> NodeMatch | UnsignedNodes | ListedNodes:
        if self._unverified is not None and kept.id in (UnsignedNodes.text, _ADOPTED):
            return self._unverified if kept.id == UnsignedNodes.text else ListedNodes(self._adopted)
        return NodeMatch.parse(kept.match or "")

    def _why_not(self, running: RunningMeasurement, uuid: str) -> str:
        octets = bytes.fromhex(uuid)
        why = why_not_measured(self._station, octets)
        return why or ("" if running.who is None else running.who.why_not(self._station, octets))

    def _is_for_another(self, running: RunningMeasurement, uuid: str) -> bool:
        """Return True if a node is another measurement's: unsigned nodes belong to the unverified one."""
        if self._unverified is None or running.kept.id == UnsignedNodes.text:
            return False
        return not self._unverified.why_not(self._station, bytes.fromhex(uuid))

    def _is_elsewhere(self, running: RunningMeasurement, uuid: str) -> bool:
        """Return True if a node is measured, lent, or meant for another measurement."""
        return self._of(uuid) is not None or uuid in self._loans or self._is_for_another(running, uuid)

    def _taken(self, running: RunningMeasurement) -> int:
        """Return how many of its nodes are present and belong to another measurement."""
        with self._lock:
            others = list(running.membership.elsewhere)
        return sum(self._directory.seen(uuid).present and self._is_elsewhere(running, uuid) for uuid in others)

    def _says_factory(self, uuid: str) -> bool:
        sighting = self._buses.presence.seen_at(bytes.fromhex(uuid))
        return sighting is not None and sighting.identity.state == NodeState.FACTORY

    def _consider(self, running: RunningMeasurement, uuid: str) -> None:
        """Acquire a node's lock if a measurement selects it and it is free; called from any thread."""
        membership, says_factory = running.membership, self._says_factory(uuid)
        with self._lock:
            may_come = running.phase is Phase.MEASURING and membership.may_come(uuid, says_factory=says_factory)
        if not may_come or self._why_not(running, uuid):
            return
        if self._is_elsewhere(running, uuid):
            with self._lock:
                membership.elsewhere.add(uuid)
            return
        try:
            self._node_locks.acquire(uuid, f"measurement {running.kept.id}", wait=0.0, frozen=True)
        except TedsProvisionError:  # the node is being inspected or provisioned; it joins when that is done
            with self._lock:
                membership.elsewhere.discard(uuid)
                membership.busy[uuid] = time.monotonic() + LOOK
            return
        with self._lock:
            still = running.phase is Phase.MEASURING
            if still:
                membership.arrive(uuid, time.monotonic())
        if still:
            self._wake.set()
        else:
            self._node_locks.release(uuid)

    def _consider_present(self, running: RunningMeasurement, uuid: str) -> bool:
        """Consider a node that is there; False if it is not."""
        if not self._directory.seen(uuid).present:
            return False
        self._consider(running, uuid)
        return True

    def _take_in(self, running: RunningMeasurement, job: MeasurementJob, now: float) -> None:
        """Take in the nodes that have come, see which have gone."""
        measurement, membership = job.measurement, running.membership
        if measurement is not None and measurement.ready.is_set():
            if measurement is not running.measurement:
                # A new Measurement, at the start or after its sinks failed: it has no members yet.
                for uuid in list(membership.members):
                    self._release(running, uuid)
                running.measurement = measurement
                running.version, running.followed = None, -self._waits.selection
            self._follow_the_store(running, now)
            for uuid in list(membership.members):
                self._reap(running, job, uuid, now)
            self._try_again(running, now)
            self._let_join(running, job, measurement)
        taken = self._taken(running)
        with self._lock:
            state, why = running.present_state(job, taken)
        self._publish_state(running, state, why)

    def _let_join(self, running: RunningMeasurement, job: MeasurementJob, measurement: Measurement) -> None:
        membership = running.membership
        with self._lock:
            arrived = membership.begin_joining() if membership.gathered(time.monotonic()) else []
        for uuid in arrived:
            self._reserve(running, job, uuid)
        for uuid in arrived:
            self._join(running, measurement, uuid)

    def _follow_the_store(self, running: RunningMeasurement, now: float) -> None:
        """Select again after a change by another process (a name, a group, a ban, a key)."""
        version, membership = self._station.version(), running.membership
        if now - self._welcomed >= self._waits.keys:
            self._welcomed = now
            self._buses.presence.expect({uuid for uuid, *_ in self._station.keys.all_key_names()})
        changed = version != running.version or running.asked_anew
        if not changed or now - running.followed < self._waits.selection:
            return
        running.asked_anew = False
        running.version, running.followed = None, now  # None until this function completes
        for uuid, member in list(membership.members.items()):
            refused = why_not_measured(self._station, bytes.fromhex(uuid))
            if refused and not running.is_measuring(uuid):
                continue  # its supervisor will notice the refusal and report it
            why = refused or self._why_not(running, uuid)
            if why and member.supervisor is not None:
                member.supervisor.stop(why)
        with self._lock:
            left = [uuid for uuid in running.reports if uuid not in running.past and uuid not in membership.members]
        for uuid in left:
            if self._why_not(running, uuid):
                self._forget_report(running, uuid)
        seen = [sighting.uuid.hex() for sighting in self._buses.presence.all()]
        with self._lock:
            again = membership.select_again(seen)
        for uuid in again:
            self._consider_present(running, uuid)
        running.version = version

    def _reserve(self, running: RunningMeasurement, job: MeasurementJob, uuid: str) -> None:
        """Report a node's share of its bus before the first of those that come together gets its part."""
        membership, sighting = running.membership, self._buses.presence.seen_at(bytes.fromhex(uuid))
        if sighting is None:
            return
        share = self._buses.bus_of(sighting).share
        load = membership.members[uuid].load = load_of(self._station, sighting.uuid, job.request, share.time)
        if not membership.why_no_room(uuid, share.room, running.budget):
            share.expect([sighting.uuid], load.bus)

    def _join(self, running: RunningMeasurement, measurement: Measurement, uuid: str) -> None:
        membership, octets = running.membership, bytes.fromhex(uuid)
        member, sighting = membership.members[uuid], self._buses.presence.seen_at(octets)
        unselected = self._why_not(running, uuid)
        if sighting is None or unselected:
            self._release(running, uuid)
            if unselected:  # it was signed, renamed or banned since it arrived
                self._forget_report(running, uuid)
            # a session failed there: ask at that place, and let the node join if it answers
            if sighting is None and uuid in membership.places:
                self._workers.submit(self._ask, membership.places[uuid])
            return
        room = self._room_of(uuid)
        why = membership.why_no_room(uuid, room, running.budget)
        if why:
            self._wait(running, uuid, why, room)
            return
        try:
            what = f"measure {running.who.text if running.who is not None else ''}"
            member.stack.enter_context(self._station.measurements.running([octets], what=what))
        except PolicyError as error:  # the node is being renamed
            self._wait(running, uuid, error.message, None, 1.0)
            return
        with self._lock:
            lent = uuid in self._loans  # the node may have been lent since it arrived
            if lent:
                membership.elsewhere.add(uuid)
            else:
                membership.join(uuid)
                for other in self._running.values():  # reports of other measurements about it are obsolete now
                    other.past.add(uuid)
                running.past.discard(uuid)
                if running.kept.id == UnsignedNodes.text:
                    # once it is signed, it belongs to the measurement that unverified() began beside this one
                    self._adopted.add(octets)
        if lent:
            self._release(running, uuid)
            return
        self._directory.note(uuid, measurement=running.kept.id)
        member.supervisor = measurement.join(octets)

    def _wait(
        self, running: RunningMeasurement, uuid: str, why: str, room: float | None, seconds: float = AGAIN
    ) -> None:
        self._release(running, uuid)
        with self._lock:
            is_news = running.membership.wait(uuid, time.monotonic() + seconds, room)
            if is_news:
                running.past.discard(uuid)
                running.reports[uuid] = {"uuid": uuid, "state": "waiting", "why": why}
        if is_news:
            self._live.event("measurement", state="waiting", id=running.kept.id, uuid=uuid, why=why)

    def _reap(self, running: RunningMeasurement, job: MeasurementJob, uuid: str, now: float) -> None:
        """Let a node go whose supervisor has ended, unless it is only lent; see why, and when it is tried again."""
        supervisor = running.membership.members[uuid].supervisor
        if supervisor is None or not supervisor.done.is_set() or supervisor.uuid in job.lent:
            return
        error, seen, last = supervisor.error, self._buses.presence.seen_at(supervisor.uuid), supervisor.sighting
        self._release(running, uuid)
        room = self._room_of(uuid)
        with self._lock:
            then = running.membership.end(uuid, now, error, last=last, seen=seen, room=room)
        if then is AfterEnd.ASK and last is not None:
            self._workers.submit(self._ask, last)
        elif then is AfterEnd.TRY:
            self._consider(running, uuid)
        if self._why_not(running, uuid):
            self._forget_report(running, uuid)

    def _release(self, running: RunningMeasurement, uuid: str) -> None:
        membership = running.membership
        with self._lock:
            member = membership.begin_leaving(uuid)
        if member is None:
            return
        member.stack.close()
        for bus in self._buses.all():
            bus.share.remove_node(bytes.fromhex(uuid))
        self._node_locks.release(uuid)
        with self._lock:
            membership.leaving.discard(uuid)
            self._lock.notify_all()
        if member.joined:
            self._directory.note(uuid, "idle", measurement=None, report=None)

    def _forget_report(self, running: RunningMeasurement, uuid: str) -> None:
        """Show a node no more: it is not selected, or it waited and has gone."""
        with self._lock:
            running.past.add(uuid)

    def _try_again(self, running: RunningMeasurement, now: float) -> None:
        membership = running.membership
        with self._lock:
            free = membership.free_again(now)
            due = membership.due(now, self._room_of)
            lost = membership.ask_now(now)
        for uuid in free:
            self._consider_present(running, uuid)
        for uuid in due:
            if not self._consider_present(running, uuid):
                self._forget_report(running, uuid)
        for sighting in lost:
            self._workers.submit(self._ask, sighting)

    def _room_of(self, uuid: str) -> float:
        sighting = self._buses.presence.seen_at(bytes.fromhex(uuid))
        return self._buses.bus_of(sighting).share.room if sighting is not None else 0.0

    def _ask(self, sighting: Sighting) -> None:
        """Ask a lost node at its last place; an answer is a sighting, and so it joins."""
        with suppress(LinkError, KeyError):
            self._buses.bus_of(sighting).discovery.identify_at(sighting.address, ANSWERING)

    # -- callbacks of measurements -----------------------------------------------------------------------------------

    def _watcher(self, running: RunningMeasurement) -> Watcher:
        def report(report: NodeReport) -> None:
            self._report(running, report)

        def facts(facts: Sequence[ChannelFacts]) -> None:
            raw: set[tuple[str, int]] = set()
            for uuid in {fact.uuid for fact in facts}:
                self._directory.show_sheet(uuid, None)
                self._directory.refresh([uuid])
                raw |= {(uuid, number) for number in self._directory.raw_only(uuid)}
            self._live.learn(facts, raw)

        def sink(failed: Sink) -> None:
            self._live.event("sink", **sink_json(running.kept.id, failed))

        def note(text: str) -> None:
            self._live.event("measurement", state="note", id=running.kept.id, why=text)

        def reread_done(uuid: bytes) -> None:
            self._directory.refresh([uuid.hex()])
            self._directory.note(uuid.hex(), "verified", looked=time.time())

        return Watcher(self._live.block, facts, report, sink, note, reread_done)

    def _report(self, running: RunningMeasurement, said: NodeReport) -> None:
        names = ("uuid", "state", "why", "samples", "lost", "late", "bad", "invalid", "clock_error")
        report = {name: getattr(said, name) for name in names}
        report["invalid_why"] = [asdict(invalid) for invalid in said.invalid_why]
        with self._lock:
            before = running.reports.get(said.uuid, {})
            running.reports[said.uuid] = report
        changed = (before.get("state"), before.get("why")) != (said.state, said.why)
        if changed:
            self._report_arrival(running, said, before.get("state"))
        facts: dict[str, Any] = {"report": report}
        if said.state == "running":
            facts |= {"present": True, "seen": time.time(), "problem": None}
            if before.get("state") != "running":
                # verified in a session, so an earlier unauthenticated reading is obsolete
                facts |= {"heard": None, "looked": time.time()}
        elif changed and said.state in ("lost", "refused", "waiting") and said.why and self._is_of(said.uuid, running):
            facts["problem"] = problem_of(TedsProvisionError(said.why))
        if changed:
            self._directory.refresh([said.uuid])
        self._directory.note(said.uuid, said.state if changed else None, **facts)
        if changed and running.job is not None and not running.stop.is_set() and not running.takes_in:
            with self._lock:
                state, why = running.present_state(running.job, 0)
            self._publish_state(running, state, why)

    def _is_of(self, uuid: str, running: RunningMeasurement) -> bool:
        """Return True if a node is this measurement's, or free: reports from one that it has left are obsolete."""
        return self.measurement_of(uuid) in (None, running.kept.id)

    def _report_arrival(self, running: RunningMeasurement, report: NodeReport, before: str | None) -> None:
        """Send an event for each node that starts or stops being measured, or waits, and why."""
        if report.state == "running" and before != "running":
            state = "joined"
        elif report.state != "running" and before == "running":
            state = "left"
        elif report.state in ("waiting", "refused") and report.why:
            state = "waiting"
        else:
            return
        if state == "joined" and report.uuid not in running.logged:  # logged only once, not at each return
            running.logged.add(report.uuid)
            self._log(running, "joined", report.uuid)
        ended = state == "left" and running.stop.is_set()
        why = report.why or ("the measurement ended" if ended else "")
        self._live.event("measurement", state=state, id=running.kept.id, uuid=report.uuid, why=why)
