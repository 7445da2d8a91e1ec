"""The measurements of the daemon: kept in the store, carried on after every start, ended in order.

Each is a :class:`MeasurementJob` of the room ``measure``; here it gets its nodes (nothing else is done with them
meanwhile), its watchers (the live channel, the roster), and the sinks that the daemon was started with.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
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
from teds_provision.measure.blocks import ChannelFacts, NodeReport, SetPointCommand, StationFacts
from teds_provision.measure.buses import Buses
from teds_provision.measure.matching import ListedNodes, NodeMatch, UnsignedNodes
from teds_provision.measure.planning import BusTime, period_of, sensors_of
from teds_provision.measure.rates import RateProposal, Surroundings, propose, this_machine
from teds_provision.measure.request import MeasurementRequest
from teds_provision.measure.runner import Watcher
from teds_provision.measure.running.measurement_job import MeasurementJob
from teds_provision.measure.sinks import Sink
from teds_provision.measure.sinks.base import BUDGET
from teds_provision.measure.standing import require_measurable, why_not_measured
from teds_provision.measure.verified_session import DEAD_MAN, VerifiedSession
from teds_provision.ncap.dynamic_membership import DynamicMembership
from teds_provision.ncap.live import Live
from teds_provision.ncap.nodes.directory import NodeDirectory
from teds_provision.ncap.nodes.node_jobs import NodeLocks
from teds_provision.ncap.sinks import DaemonSinks, sink_json
from teds_provision.ncap.waits import USUAL, Waits
from teds_provision.protocol.operation.stream_commands import StreamKind
from teds_provision.shapes.measurement import MeasurementSpec
from teds_provision.shapes.problem import problem_of
from teds_provision.station.station import Station
from teds_provision.station.store import KeptMeasurement
from teds_provision.teds.image import Image
from teds_provision.teds.sheet import Sheet

_ADOPTED: Final = "adopted"
NCAP: Final = "ncap"
_RUN: Final = "run"
_OF_THIS_PROCESS: Final = frozenset({_RUN, _ADOPTED, UnsignedNodes.text})
"""IDs of measurements that options of ``ncap run`` began: they end with it."""
LETTING_GO: Final = 4.0  # seconds for a node's session to end in order; the caller waits 5
ANSWERING: Final = 1.0  # seconds for a node that has another address now
LONGEST_END: Final = 20.0  # the same, for who waits as long as it takes
_BEGINNING: Final = 0.2  # seconds between two looks whether a measurement that takes its nodes has begun
LONGEST_LOOK: Final = 120.0  # seconds that another look at a node may take
LONGEST_LOAN: Final = 900.0  # seconds after which a node is measured again, whatever its writer does


@dataclass
class RunningMeasurement:
    """One measurement that runs, or tries to."""

    kept: KeptMeasurement
    uuids: tuple[str, ...]  # members of one that takes in nodes as they come
    membership: DynamicMembership | None = None
    job: MeasurementJob | None = None
    state: str = "starting"
    why: str = ""
    reports: dict[str, dict[str, Any]] = field(default_factory=dict)
    past: set[str] = field(default_factory=set)  # whose reports are obsolete
    stop: threading.Event = field(default_factory=threading.Event)
    thread: threading.Thread | None = None
    asked: KeptMeasurement | None = None  # as it was asked for; ``kept`` has the nodes of a frozen expression
    logged: set[str] = field(default_factory=set)  # nodes whose first value is in the audit log

    def log_facts(self) -> dict[str, Any]:
        """Return its members of an audit entry: what is measured, and who requested it."""
        kept = self.asked or self.kept
        meant = {"group": kept.group, "match": kept.match, "rate": kept.rate, "owner": kept.owner}
        return {"id": kept.id, **{name: value for name, value in meant.items() if value is not None}}


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
        self._lending = threading.Lock()
        self._guard = threading.Lock()
        self._messages: tuple[float, int] = (time.monotonic(), 0)
        self._rate = 0.0

    # -- its life ----------------------------------------------------------------------------------------------------

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
            return  # it is kept already
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
        with self._guard:
            every = [
                running
                for running in self._running.values()
                if running.membership is not None and uuid in running.uuids
            ]
        mine = [
            running.membership
            for running in every
            if running.kept.id == UnsignedNodes.text and running.membership is not None
        ]
        with self._lending:
            self._loans.setdefault(uuid, []).append(loan)
        try:
            for newcomers in mine:
                newcomers.part(uuid, why)
            until = time.monotonic() + LETTING_GO
            while mine and self.measurement_of(uuid) is not None and time.monotonic() < until:
                time.sleep(0.05)
            yield
        finally:
            self.return_node(loan)

    def on_sighting(self, uuid: str) -> None:
        """Handle a node that answered on a bus; called before any other part works on it."""
        with self._guard:
            every = [running.membership for running in self._running.values() if running.membership is not None]
        for newcomers in every:
            newcomers.on_sighting(uuid)

    def look_who_is_meant(self) -> None:
        """Who may be measured, or what an expression names, changed in this process: a group, a key, a datasheet."""
        with self._guard:
            every = [running.membership for running in self._running.values() if running.membership is not None]
        for newcomers in every:
            newcomers.look_who_is_meant()

    def stop(self) -> None:
        """End all of them in order; what is kept stays kept."""
        with self._guard:
            every = list(self._running.values())
        for running in every:
            running.stop.set()
        for running in every:
            self._end(running)
            self._log(running, "ended" if running.kept.id in _OF_THIS_PROCESS else "paused")

    # -- what the API asks -------------------------------------------------------------------------------------------

    def add(self, members: Mapping[str, Any], owner: str = NCAP) -> dict[str, Any]:
        """Measure from now on, after every restart too, until it is deleted; ``owner`` is who asked for it.

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
            actuators=spec.actuators and spec.match is None,  # actuators are never claimed for nodes as they come
        )
        kept = KeptMeasurement("", **whole.settings(), owner=owner)
        # What can never be measured is refused before it is kept: it would be tried for ever, after each restart too.
        nodes = self._station.measurements.nodes_of(kept)
        if not nodes and kept.match is None:
            raise UsageError(f"Group {kept.group!r} is empty.", hint="Add a node to it first.")
        for uuid in nodes:
            self._require_unmeasured(uuid)
            self._require_plan(uuid, kept)
        for sink in kept.sinks:
            self._sinks.open(sink)
        with self._station.lock("measure"):  # of two requests at once for one node, or its group, one is refused
            for uuid in self._station.measurements.nodes_of(kept):
                self._require_unmeasured(uuid)
                self._require_plan(uuid, kept)  # it may have been removed meanwhile
            with self._station.durable("measure"):
                kept = self._station.measurements.keep(kept)
                facts = RunningMeasurement(kept, ()).log_facts()
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
            return found.place, found.time_for(found.share.others(uuid), sighting.address)

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
        if self._sinks.moves(kept) and channels and all(channel.actuator for channel in channels):
            return  # it has nothing to measure; set points come for it
        for channel in sensors_of(channels, kept.channels, kind):
            period_of(channel, kept.rate)

    def delete(self, measurement_id: str) -> None:
        """End it, and forget it; raises NotFoundError, PolicyError for one that a command of this home runs."""
        with self._guard:
            one = self._running.pop(measurement_id, None)
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
            self._end(one)
        with self._station.durable("measure"):
            if not self._station.measurements.forget(measurement_id) and one is None:
                raise NotFoundError(f"No measurement has the ID {measurement_id!r}.")
            facts = {"id": measurement_id} if one is None else one.log_facts() | _counts(one)
            self._station.audit("measure", None, "ended", **facts)
        self._live.event("measurement", state="deleted", id=measurement_id)

    def all(self) -> list[dict[str, Any]]:
        """Return every one: those that run here, then those that commands of this home run."""
        with self._guard:
            every = list(self._running.values())
        return [*(self._json(running) for running in every), *(self._json(running) for running in self._of_commands())]

    def _of_commands(self) -> list[RunningMeasurement]:
        """Return those of commands that live, to be shown; the nodes of one whose group is gone are not known."""
        found = []
        for kept in self._station.measurements.of_commands():
            with suppress(NotFoundError):
                uuids = tuple(uuid.hex() for uuid in self._station.measurements.nodes_of(kept))
                why = f"measured by the command measure (process {kept.pid})"
                found.append(RunningMeasurement(kept, uuids, state="running", why=why))
        return found

    def measurement_of(self, uuid: str) -> str | None:
        """Return the measurement that has a node."""
        with self._guard:
            return next((key for key, running in self._running.items() if uuid in running.uuids), None)

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
        with self._guard:
            return [key for key, running in self._running.items() if running.kept.group == group]

    def _job_of(self, uuid: str) -> MeasurementJob | None:
        with self._guard:
            return next((running.job for running in self._running.values() if uuid in running.uuids), None)

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

    # -- nodes that a command of this home writes to -----------------------------------------------------------------

    def lend_node(self, loan: NodeLoan, seconds: float = LETTING_GO) -> bool:
        """Release a node until :meth:`return_node`, so that a writer can use it; False if it is not measured.

        It may be lent to several at once, who take turns at the node. Raises NodeBusyError if its session did not end
        in order within ``seconds``; then it is measured on.
        """
        with self._lending:
            if loan.ended:
                return False
            job = self._job_of(loan.uuid)
            if job is None:  # and none begins meanwhile
                self._loans.setdefault(loan.uuid, []).append(loan)
                return False
            if job.kept.frozen:
                raise FrozenError(
                    f"Node {loan.uuid} is in a frozen measurement ({job.kept.id}).", hint="End the measurement first."
                )
            self._loans.setdefault(loan.uuid, []).append(loan)
            if job.suspend_node(bytes.fromhex(loan.uuid), loan.why, seconds):
                return True
        self.return_node(loan)
        raise NodeBusyError(
            f"Node {loan.uuid} is being measured and was not released within {seconds:g} s.", hint="Try again."
        )

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
                except FrozenError:  # its measurement keeps the lock for the time of the loan, or is about to begin
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
        with self._lending:
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
        """Every sink with what became of what it was given."""
        return [sink_json(key, sink) for key, sink in self._open_sinks()]

    def _open_sinks(self) -> list[tuple[str, Sink]]:
        with self._guard:
            jobs = [(key, running.job) for key, running in self._running.items() if running.job is not None]
        return [(key, sink) for key, job in jobs for sink in job.sinks]

    def budget(self) -> dict[str, Any]:
        """Messages a second that go to ROS and MQTT now, and how many are known to be carried."""
        now, sent = time.monotonic(), sum(sink.stats.messages for _, sink in self._open_sinks() if sink.budgeted)
        before, count = self._messages
        if now - before >= 1.0:
            self._rate = max(0, sent - count) / (now - before)
            self._messages = now, sent
        return {"used": round(self._rate, 1), "limit": BUDGET}

    def clock_error(self) -> float | None:
        """Return the worst bound of a node's clock, seconds; None if nothing is measured."""
        with self._guard:
            reports = [report for running in self._running.values() for report in running.reports.values()]
        found = [report.get("clock_error") for report in reports if report["state"] == "running"]
        return max((chosen for chosen in found if chosen is not None), default=None)

    def _json(self, running: RunningMeasurement) -> dict[str, Any]:
        kept = running.kept
        with self._guard:
            left = (
                [uuid for uuid in running.reports if uuid not in running.past] if running.membership is not None else []
            )
        return kept.to_json() | {
            "id": kept.id,
            "uuids": list(running.uuids),
            "actuators": self._sinks.moves(kept),
            "created": kept.created,
            "owner": kept.owner,
            "process": None if kept.pid is None else {"id": kept.pid, "started": kept.started},
            "state": running.state,
            "why": running.why,
            "lower_rate": _lower_rate(running.job),
            "nodes": [
                running.reports.get(uuid, {"uuid": uuid, "state": "waiting", "why": ""})
                for uuid in (dict.fromkeys((*running.uuids, *left)) if kept.lasting else ())
            ],
            "files": [
                str(file) for sink in (running.job.sinks if running.job is not None else ()) for file in sink.files
            ],
        }

    def _log(self, running: RunningMeasurement, outcome: str, uuid: str | None = None) -> None:
        """Add an entry to the audit log; a store that cannot be written ends no measurement."""
        node = None if uuid is None else bytes.fromhex(uuid)
        counts = _counts(running) if uuid is None else {}
        with suppress(StoreError):
            self._station.audit("measure", node, outcome, **running.log_facts(), **counts)

    # -- running -----------------------------------------------------------------------------------------------------

    def _begin(self, kept: KeptMeasurement) -> RunningMeasurement:
        uuids = tuple(uuid.hex() for uuid in self._station.measurements.nodes_of(kept))
        one = RunningMeasurement(kept, uuids, asked=kept)
        comes = kept.match is not None and not kept.frozen
        with self._guard:
            self._running[kept.id] = one
        work = self._run_open if comes else self._run
        one.thread = threading.Thread(target=work, args=(one,), name=f"begin {kept.id}", daemon=True)
        one.thread.start()
        return one

    def _run(self, running: RunningMeasurement) -> None:
        """Measure until it is stopped or its time is over; again from the start after its nodes were replaced."""
        while self._run_with_members(running):
            if not self._take_new_members(running):
                return
        if running.state == "ended" and not running.stop.is_set():  # its time is over, and its row is gone
            self._log(running, "ended")
            with self._guard:
                self._running.pop(running.kept.id, None)
            self._live.event("measurement", state="deleted", id=running.kept.id)

    def _take_new_members(self, running: RunningMeasurement) -> bool:
        """Read again which nodes a measurement has; False if it is not kept any more, because none is left."""
        try:
            kept = running.asked  # of a frozen expression the nodes are looked for again
            if kept is None or kept.match is None:
                kept = self._station.measurements.get(running.kept.id)
            uuids = tuple(uuid.hex() for uuid in self._station.measurements.nodes_of(kept))
        except NotFoundError as error:
            self._publish_state(running, "ended", error.message)
            with self._guard:
                self._running.pop(running.kept.id, None)
            self._live.event("measurement", state="deleted", id=running.kept.id)
            return False
        with self._guard:
            running.kept, running.uuids = kept, uuids
            running.reports = {uuid: report for uuid, report in running.reports.items() if uuid in uuids}
        return True

    def _is_retired(self, uuid: str) -> bool:
        return is_retired(self._station.nodes.get(bytes.fromhex(uuid)))

    def _has_other_members(self, running: RunningMeasurement, job: MeasurementJob) -> bool:
        """Return True if `replace` or `decommission` changed the nodes of a measurement in the store."""
        if running.kept.frozen:  # nobody else joins or leaves
            return any(self._is_retired(uuid) for uuid in running.uuids)
        if running.kept.match is not None:
            return False
        kept = next((kept for kept in self._station.measurements.all() if kept.id == running.kept.id), None)
        if kept is None:  # deleted by `decommission`, unless it came to its end
            return job.kept.ends is None and not running.stop.is_set()
        try:
            return {uuid.hex() for uuid in self._station.measurements.nodes_of(kept)} != set(running.uuids)
        except NotFoundError:
            return True

    def _run_with_members(self, running: RunningMeasurement) -> bool:
        """Take the nodes, then measure; True if the measurement has other nodes now, and is to begin again."""
        taken: list[str] = []
        try:
            self._wait_for_members(running)
            for uuid in running.uuids:
                self._wait_for_turn(running, uuid)
                if running.stop.is_set():
                    return False
                taken.append(uuid)
                self._directory.note(uuid, measurement=running.kept.id)
            job = running.job = self._new_job(running)
            self._publish_state(running, "starting")
            job.start(self._buses, self._watcher(running))
            while job.alive and not running.stop.wait(0.5):
                self._publish_state(running, *_state_of(running, job))
                if self._has_other_members(running, job):
                    job.stop()
                    return True
            job.stop()
            self._publish_state(running, "ended")
        except TedsProvisionError as error:
            self._publish_state(running, "failed", error.message)
        finally:
            for uuid in taken:
                self._node_locks.release(uuid)
                self._directory.note(uuid, "idle", measurement=None, report=None)
        return False

    def _who(self, kept: KeptMeasurement) -> NodeMatch | UnsignedNodes | ListedNodes:
        if self._unverified is not None and kept.id in (UnsignedNodes.text, _ADOPTED):
            return self._unverified if kept.id == UnsignedNodes.text else ListedNodes(self._adopted)
        return NodeMatch.parse(kept.match or "")

    def _is_for(self, uuid: str, running: RunningMeasurement) -> bool:
        """Return True if a node is another measurement's: unsigned nodes belong to the unverified one."""
        if self._unverified is None or running.kept.id == UnsignedNodes.text:
            return False
        return not self._unverified.why_not(self._station, bytes.fromhex(uuid))

    def _new_job(self, running: RunningMeasurement, *, unverified: bool = False) -> MeasurementJob:
        return MeasurementJob(
            self._station,
            running.kept,
            more=lambda take: self._sinks.more(running.kept, take),
            admits=self._admits if self._sinks.moves(running.kept) else None,
            request=MeasurementRequest(
                patient=True, by="ncap", unverified=unverified, require_firmware=self._require_firmware
            ),
            opened=self._sinks.open,
        )

    def _wait_for_members(self, running: RunningMeasurement) -> None:
        """Wait until a frozen expression selects any node; then its members stay."""
        if running.kept.match is None:
            return
        match = NodeMatch.parse(running.kept.match)
        while not running.stop.is_set():
            found = dict.fromkeys(uuid for uuid, *_ in self._station.keys.all_key_names())
            meant = [
                uuid
                for uuid in found
                if not why_not_measured(self._station, uuid)
                and not match.why_not(self._station, uuid)
                and self._station.datasheets.datasheet(uuid) is not None
                and not self._is_retired(uuid.hex())
                and self.measurement_of(uuid.hex()) is None
            ]
            if meant:
                running.uuids = tuple(uuid.hex() for uuid in meant)
                running.kept = replace(running.kept, match=None, uuids=tuple(meant), actuators=False)
                return
            self._publish_state(running, "waiting", match.unknown_type(self._station) or "no known node matches")
            running.stop.wait(1.0)

    def _run_open(self, running: RunningMeasurement) -> None:
        """Measure nodes as they come until it is stopped.

        One measurement whose nodes come and go, so that its recordings and topics go on: one for each node would make a
        file each, and have no budget in common.
        """
        assert running.kept.match is not None

        def joined(uuid: str) -> None:
            with self._guard:
                running.uuids = (*running.uuids, uuid)
                for other in self._running.values():  # it is measured here: what another one reported is over
                    other.past.add(uuid)
                running.past.discard(uuid)
            self._directory.note(uuid, measurement=running.kept.id)
            if unverified:  # signed later, it is measured on by the other of the two that unverified() begins
                self._adopted.add(bytes.fromhex(uuid))

        def left(uuid: str) -> None:
            with self._guard:
                there = uuid in running.uuids
                running.uuids = tuple(other for other in running.uuids if other != uuid)
            if there:
                self._directory.note(uuid, "idle", measurement=None, report=None)

        def past(uuid: str) -> None:
            with self._guard:
                running.past.add(uuid)

        def waiting(uuid: str, why: str) -> None:
            with self._guard:
                running.past.discard(uuid)
            running.reports[uuid] = {"uuid": uuid, "state": "waiting", "why": why}
            self._live.event("measurement", state="waiting", id=running.kept.id, uuid=uuid, why=why)

        try:
            unverified = running.kept.id == UnsignedNodes.text
            job = running.job = self._new_job(running, unverified=unverified)
            live = [sink for sink in job.sinks if sink.budgeted]
            newcomers = DynamicMembership(
                self._station,
                self._directory,
                self._node_locks,
                self._buses,
                job,
                self._who(running.kept),
                elsewhere=lambda uuid: (
                    self.measurement_of(uuid) is not None or uuid in self._loans or self._is_for(uuid, running)
                ),
                joined=joined,
                left=left,
                waiting=waiting,
                past=past,
                budget=BUDGET if live else None,
                rows=any(sink.wants_rows for sink in live),
                waits=self._waits,
            )
            running.membership = newcomers
        except TedsProvisionError as error:
            self._publish_state(running, "failed", error.message)
            return
        self._publish_state(running, "starting")
        job.start(self._buses, self._watcher(running))
        unknown = NodeMatch.parse(running.kept.match).unknown_type(self._station)
        try:
            while job.alive and not running.stop.is_set():
                newcomers.work()
                self._publish_state(running, *_state_of_open(running, job, unknown))
        finally:
            job.stop()
            newcomers.end()
            self._publish_state(running, "ended")

    def _wait_for_turn(self, running: RunningMeasurement, uuid: str) -> None:
        while not running.stop.is_set():
            try:
                self._node_locks.acquire(uuid, f"measurement {running.kept.id}", frozen=True)
                return
            except TedsProvisionError as error:
                self._publish_state(running, "waiting", error.message)
                running.stop.wait(1.0)

    def _end(self, running: RunningMeasurement) -> None:
        thread = running.thread
        if thread is not None:
            thread.join(20.0)
        with self._guard:
            self._running.pop(running.kept.id, None)

    def _publish_state(self, running: RunningMeasurement, state: str, why: str = "") -> None:
        if (running.state, running.why) != (state, why):
            running.state, running.why = state, why
            self._live.event("measurement", state=state, id=running.kept.id, group=running.kept.group, why=why)

    # -- what it hears -----------------------------------------------------------------------------------------------

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

        def read(uuid: bytes) -> None:
            self._directory.refresh([uuid.hex()])
            self._directory.note(uuid.hex(), "verified", looked=time.time())

        return Watcher(self._live.block, facts, report, sink, note, read)

    def _report(self, running: RunningMeasurement, said: NodeReport) -> None:
        names = ("uuid", "state", "why", "samples", "lost", "late", "bad", "invalid", "clock_error")
        report = {name: getattr(said, name) for name in names}
        report["invalid_why"] = [asdict(invalid) for invalid in said.invalid_why]
        before = running.reports.get(said.uuid, {})
        running.reports[said.uuid] = report
        changed = (before.get("state"), before.get("why")) != (said.state, said.why)
        if changed:
            self._report_arrival(running, said, before.get("state"))
        facts: dict[str, Any] = {"report": report}
        if said.state == "running":
            facts |= {"present": True, "seen": time.time(), "problem": None}
            if before.get("state") != "running":
                facts |= {"heard": None, "looked": time.time()}  # in a session: what it sent outside one is obsolete
        elif changed and said.state in ("lost", "refused", "waiting") and said.why and self._is_of(said.uuid, running):
            facts["problem"] = problem_of(TedsProvisionError(said.why))
        if changed:
            self._directory.refresh([said.uuid])
        self._directory.note(said.uuid, said.state if changed else None, **facts)
        if changed and running.job is not None and not running.stop.is_set() and running.membership is None:
            self._publish_state(running, *_state_of(running, running.job))

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
        if state == "joined" and report.uuid not in running.logged:  # not each time that it comes back
            running.logged.add(report.uuid)
            self._log(running, "joined", report.uuid)
        ended = state == "left" and running.stop.is_set()
        why = report.why or ("the measurement ended" if ended else "")
        self._live.event("measurement", state=state, id=running.kept.id, uuid=report.uuid, why=why)


def _state_of_open(running: RunningMeasurement, job: MeasurementJob, unknown: str) -> tuple[str, str]:
    if any(running.reports.get(uuid, {}).get("state") == "running" for uuid in running.uuids):
        return "running", ""
    if job.error is not None:
        return "waiting", job.error.message
    taken = running.membership.taken if running.membership is not None else 0
    if taken:
        return "waiting", f"{taken} matching node{'s are' if taken > 1 else ' is'} measured by another measurement"
    return "waiting", (unknown if not running.reports else "") or "no matching node is present"


def _state_of(running: RunningMeasurement, job: MeasurementJob) -> tuple[str, str]:
    states = {report["state"] for report in running.reports.values()}
    if "running" in states:
        lacking = [uuid for uuid in running.uuids if running.reports.get(uuid, {}).get("state") != "running"]
        return "running", _of_all(len(lacking), running, "missing") if lacking else ""
    if job.error is not None:
        return "waiting", job.error.message
    refused = sum(report["state"] == "refused" for report in running.reports.values())
    if refused:
        return "waiting", _of_all(refused, running, "refused")
    return ("waiting", "no node has answered yet") if states else ("starting", "")


def _of_all(some: int, running: RunningMeasurement, what: str) -> str:
    """Return ``1 of 3 nodes is missing``."""
    every = len(running.uuids)
    return f"{some} of {every} node{'s' if every > 1 else ''} {'is' if some == 1 else 'are'} {what}"


def _counts(running: RunningMeasurement) -> dict[str, int]:
    """Return samples and lost ones of all its nodes, for the audit log; nothing if it never had a node."""
    reports = list(running.reports.values())
    found = {name: sum(int(report.get(name) or 0) for report in reports) for name in ("samples", "lost")}
    return found if reports else {}


def _lower_rate(job: MeasurementJob | None) -> float | None:
    """Return the rate to try if a measurement loses values, for its worst stream; None if it loses none."""
    measurement = job.measurement if job is not None else None
    if measurement is None:
        return None
    streams = [totals for keeper in list(measurement.supervisors) for totals in keeper.streams.summed()]
    return min((rate for totals in streams if (rate := totals.lower_rate) is not None), default=None)
