"""A measurement: nodes in, sinks out. Starts the supervisors, the receiver thread and the sinks; ends them in order.

The loop here moves no data. Blocks go from the receiver thread straight into the queues of the sinks; the loop emits
the rows of the group, reports once a second, and checks for ended nodes and sinks.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from teds_provision.errors import LinkError, NoNodeError, StoreError, TedsProvisionError
from teds_provision.measure.blocks import (
    Block,
    ChannelFacts,
    ClockSet,
    GroupRows,
    NodeReport,
    SetPointCommand,
    StationFacts,
)
from teds_provision.measure.buses import Buses
from teds_provision.measure.clock import HostClock
from teds_provision.measure.grid import Grid
from teds_provision.measure.node_supervisor import NodeSupervisor
from teds_provision.measure.request import Events, MeasurementRequest
from teds_provision.measure.running import trigger
from teds_provision.measure.running.common_start import TOGETHER, CommonStart
from teds_provision.measure.sinks import Sink
from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.shapes.problem import failure_of
from teds_provision.station.station import Station

BEAT = 0.02  # seconds between rows of the group
REPORTING = 1.0
WAITING = 3.0  # seconds without a ROS master or a broker before a notice; rospy needs 2 to start
ENDING = 10.0  # seconds for all nodes to be released


@dataclass
class Watcher:
    """Callbacks for a live table or JSON lines, called from the measurement's threads."""

    block: Callable[[Block], None] = lambda _block: None
    facts: Callable[[Sequence[ChannelFacts]], None] = lambda _facts: None
    report: Callable[[NodeReport], None] = lambda _report: None
    sink: Callable[[Sink], None] = lambda _sink: None
    note: Callable[[str], None] = lambda _text: None
    reread_done: Callable[[bytes], None] = lambda _uuid: None  # the datasheet of a measured node was read completely


@dataclass(frozen=True)
class MeasurementEnd:
    """The end of a measurement: the ``end`` event of ``measure --json``, and the worst error, None for none."""

    nodes: list[dict[str, Any]]
    files: list[str]
    error: TedsProvisionError | None
    apart: float = 0.0
    sinks: list[dict[str, Any]] = field(default_factory=list)
    lower_rate: float | None = None  # Hz to try, if messages were lost


@dataclass
class Measurement:
    """Nodes of one bus or several, measured together into sinks. ``run`` does all of it."""

    station: Station
    buses: Buses
    uuids: Sequence[bytes]
    request: MeasurementRequest
    sinks: Sequence[Sink]
    facts: StationFacts
    watcher: Watcher = field(default_factory=Watcher)
    began: Callable[[], None] = lambda: None
    lent: set[bytes] = field(default_factory=set)
    supervisors: list[NodeSupervisor] = field(default_factory=list, init=False)
    _by_uuid: dict[bytes, NodeSupervisor] = field(default_factory=dict, init=False)
    ready: threading.Event = field(default_factory=threading.Event, init=False)  # nodes may join

    def run(self, stop: threading.Event, duration: float | None = None) -> MeasurementEnd:
        """Measure until ``stop``, for ``duration`` seconds of data, or until no node is left.

        Raises what a sink's ``open`` raises; everything else is in the result.
        """
        self._host, self._lock = HostClock(), threading.Lock()
        # held while the clock is set: no block is passed on meanwhile; taken after _lock
        self._setting = threading.Lock()
        self._known: dict[str, dict[int, ChannelFacts]] = {}  # by node and channel
        self._chosen: dict[str, dict[int, str]] = {}  # chosen names of topics, by node and channel
        for (uuid, number), name in self.facts.names.items():
            self._chosen.setdefault(uuid, {})[number] = name
        self._grids: dict[str, Grid] = {}  # "": all nodes together; otherwise one grid per UUID
        self._for_grid: deque[Block] = deque()
        self._shown: dict[int, str] = {}  # last notice about each sink, by id(), since two sinks may have the same name
        self._waits: dict[int, float] = {}  # when each waiting sink began to wait, by id()
        self._common_start = CommonStart(self.uuids, trigger=self.request.trigger)
        self._ending = False
        opened: list[Sink] = []
        try:
            for sink in self.sinks:
                sink.open((), self.facts)
                opened.append(sink)
        except BaseException:
            for sink in opened:
                sink.close()
                if sink.recorder:  # nothing was recorded: remove the file, so that the next try can use the name
                    for name in sink.files:
                        Path(name).unlink(missing_ok=True)
            raise
        self.buses.expect(self.uuids)
        if self.request.requirements is not None:
            self.request.requirements.expect(self.uuids)
        events = self._events = Events(self._block, self._describe, self._report, self._reread_done)
        self.supervisors = [
            NodeSupervisor(self.station, self.buses, uuid, self.request, self._host, events, self._common_start)
            for uuid in self.uuids
        ]
        self._by_uuid = {supervisor.uuid: supervisor for supervisor in self.supervisors}
        for supervisor in self.supervisors:
            if supervisor.uuid not in self.lent:
                supervisor.start()
        try:
            self.ready.set()
            self._loop(stop, duration)
        finally:
            self._end()
        if not stop.is_set():
            self._note_who_never_came()
        return self._ended()

    def _loop(self, stop: threading.Event, duration: float | None) -> None:
        until = math.inf
        reported = 0.0
        while not stop.wait(BEAT):
            now = time.monotonic()
            if self._all_done():
                return
            self._trigger()
            if self._host.was_set():
                self._follow_the_clock()
            if until == math.inf:
                until = self._until(now, duration)
            if now >= until:
                return
            self._rows()
            if now - reported >= REPORTING:
                reported = now
                self._look()
                if self._gave_up():
                    return

    def _trigger(self) -> None:
        """Send the trigger when it is due; report the nodes that it waits for, and how long."""
        if not self.request.trigger:
            return
        late = [supervisor for supervisor in self.supervisors if not supervisor.ready.is_set()]
        if self._common_start.due(len(self.supervisors) - len(late), len(self.supervisors)):
            trigger.pull(self._common_start, self.supervisors, self.watcher.note)
        elif late and len(late) < len(self.supervisors) and self._common_start.notice_due():
            names = ", ".join(supervisor.uuid.hex() for supervisor in late[:3]) + (" …" if len(late) > 3 else "")
            self.watcher.note(f"Waiting for {names} before the trigger, up to {TOGETHER:.0f} s.")

    def _until(self, now: float, duration: float | None) -> float:
        """Return the time at which ``duration`` seconds of data are over; they count from the first values."""
        left = self._common_start.seconds_left
        if duration is None or left is None or not any(supervisor.ever_ran for supervisor in self.supervisors):
            return math.inf
        self.began()
        # A stream that starts on its own has its first sample a moment after Subscribe.
        first = [supervisor.streams.first_sample() for supervisor in self.supervisors]
        return max(now + left, *first) + duration

    def _all_done(self) -> bool:
        return not self._open and not self.lent and all(supervisor.done.is_set() for supervisor in self.supervisors)

    def _gave_up(self) -> bool:
        """Return True if no node ever ran and each has had its time."""
        return not self._open and all(
            not supervisor.ever_ran and isinstance(supervisor.error, NoNodeError) for supervisor in self.supervisors
        )

    def _look(self) -> None:
        for supervisor in self.supervisors:
            self._report(supervisor.report())
        for sink in self.sinks:
            if self._is_news(sink):
                self.watcher.sink(sink)

    def _is_news(self, sink: Sink) -> bool:
        """Return True if a sink failed, waits for its consumers for long or its disk for room, or goes on again."""
        stats, now, recorder = sink.stats, time.monotonic(), sink.recorder
        state = "failed" if stats.error else str(stats.state)
        since = self._waits.setdefault(id(sink), now)
        if state != "waiting":
            del self._waits[id(sink)]
        before = self._shown.get(id(sink), "running")
        # the detail matters: a recorder may have waited and continued between two checks
        news = f"{state} {stats.detail}".strip() if recorder else state
        if news == before or state not in ("failed", "running", "waiting"):
            return False
        if state == "waiting" and not recorder and now - since < WAITING:
            return False
        self._shown[id(sink)] = news
        return True

    def _rows(self) -> None:
        with self._lock:
            found = self._synchronized()
        for rows in found:
            for sink in self.sinks:
                sink.write_group(rows)

    def _synchronized(self) -> list[GroupRows]:
        while self._for_grid:
            block = self._for_grid.popleft()
            grid = self._grids.get(block.uuid if self._open else "")
            if grid is not None:
                grid.add_block(block)
        now = self._host.now()
        return [rows for grid in self._grids.values() if (rows := grid.rows(now)) is not None]

    def _follow_the_clock(self) -> None:
        """Handle a change of the system's clock: data until now are passed on by the old one, the rest by the new one.

        Without it a clock that was wrong when the daemon began would be wrong in every stamp until its end.
        """
        with self._lock, self._setting:
            found = self._synchronized()
            news = ClockSet(by=self._host.set_anew(), time=self._host.now())
            for sink in self.sinks:
                for rows in found:
                    sink.write_group(rows)
                sink.clock_set(news)
            self._grids = {uuid: self._new_grid(uuid) for uuid in self._grids}
        self.watcher.note(news.words)

    @contextmanager
    def session(self, uuid: bytes, *, streaming: bool = False) -> Iterator[VerifiedSession | None]:
        """Give the session in which a node is measured now, for one more command; None if there is none.

        The node's other exchanges wait meanwhile: be brief. ``streaming``: only once its streams run. Raises no error
        by itself.
        """
        supervisor = self._supervisor_of(uuid)
        if supervisor is None:
            yield None
            return
        with supervisor.turn:
            yield supervisor.verified if supervisor.state == "running" or not streaming else None

    @property
    def _open(self) -> bool:
        """True if nodes come and go."""
        return self.request.newcomers

    def join(self, uuid: bytes) -> NodeSupervisor:
        """Take in a node that has come, or come back; no other node notices.

        Its counts go on from their last values.
        """
        supervisor = self._supervisor_of(uuid)
        if supervisor is None:
            supervisor = NodeSupervisor(
                self.station, self.buses, uuid, self.request, self._host, self._events, self._common_start
            )
            self.supervisors = [*self.supervisors, supervisor]
            self._by_uuid[uuid] = supervisor
        if not self._ending:
            supervisor.start()
        return supervisor

    def leave(self, uuid: bytes, why: str) -> None:
        """End one node in order; its counts stay."""
        supervisor = self._supervisor_of(uuid)
        if supervisor is not None and supervisor.begun:
            supervisor.stop(why)
            supervisor.join(ENDING)

    def suspend_node(self, uuid: bytes, why: str, seconds: float) -> bool:
        """End one node in order while a command works on it; False if that took longer."""
        self.lent.add(uuid)
        supervisor = self._supervisor_of(uuid)
        if supervisor is None or not supervisor.begun:
            return True
        supervisor.stop(why, comes_back=True)
        return supervisor.done.wait(seconds)

    def resume_node(self, uuid: bytes) -> None:
        """Measure a node again that was let go."""
        supervisor = self._supervisor_of(uuid)
        if supervisor is None or uuid not in self.lent:
            return
        self.buses.expect([uuid])
        if not self._ending:
            supervisor.start()
        self.lent.discard(uuid)

    def _supervisor_of(self, uuid: bytes) -> NodeSupervisor | None:
        return self._by_uuid.get(uuid)

    def command(self, command: SetPointCommand) -> None:
        """Pass on a set point that came by a sink."""
        supervisor = self._supervisor_of(bytes.fromhex(command.uuid))
        if supervisor is not None:
            supervisor.command(command)

    # -- from the threads of nodes and bus ---------------------------------------------------------------------------

    def _block(self, block: Block) -> None:
        with self._setting:
            setting, _ = self._host.present
            # its time was computed just before the clock was set
            if block.clock is not None and block.clock != setting:
                block = replace(block, time=block.time + self._host.since(block.clock), clock=setting)
            for sink in self.sinks:
                sink.write(block)
            if self._grids:
                self._for_grid.append(block)  # without _lock: the listening thread must not wait while rows are made
        self.watcher.block(block)

    def _with_names(self, facts: Sequence[ChannelFacts]) -> Sequence[ChannelFacts]:
        """Return the facts of a node that joins, with the present names of its topics: they may be newer than ours."""
        uuids = {channel_facts.uuid for channel_facts in facts}
        chosen = {uuid: self.station.measurements.names_of(bytes.fromhex(uuid)) for uuid in uuids}
        if any(self._chosen.get(uuid, {}) != names for uuid, names in chosen.items()):
            self._chosen |= chosen
            every = {(uuid, number): name for uuid, names in self._chosen.items() for number, name in names.items()}
            self.facts = replace(self.facts, names=every)
        return [replace(channel_facts, chosen=tuple(chosen[channel_facts.uuid].items())) for channel_facts in facts]

    def _describe(self, facts: Sequence[ChannelFacts]) -> None:
        if self._open:
            facts = self._with_names(facts)
        with self._lock:
            changed = False
            for channel_facts in facts:
                known = self._known.setdefault(channel_facts.uuid, {})
                changed = changed or known.get(channel_facts.number) != channel_facts
                known[channel_facts.number] = channel_facts
            if changed and any(sink.wants_rows for sink in self.sinks):
                for uuid in {channel_facts.uuid for channel_facts in facts} if self._open else {""}:
                    self._grids[uuid] = self._new_grid(uuid)
        for sink in self.sinks:
            sink.describe(facts)
        self.watcher.facts(facts)

    def _new_grid(self, uuid: str) -> Grid:
        """Return a grid for the streams of one node, or of all of them (``""``)."""
        supervisor = self._supervisor_of(bytes.fromhex(uuid))
        chosen = [supervisor] if supervisor is not None else [] if uuid else self.supervisors
        spans = [
            heard.receiver.plan.span for supervisor in chosen for heard in list(supervisor.streams.running.values())
        ]
        patience = max(spans, default=0) / 1e9 + 2 * BEAT
        nodes = [self._known.get(uuid, {})] if uuid else [known for _, known in sorted(self._known.items())]
        sensors = [facts for node in nodes for _, facts in sorted(node.items()) if facts.kind != "actuator"]
        return Grid(uuid or self.facts.group or "all", sensors, patience=patience)

    def _report(self, report: NodeReport) -> None:
        for sink in self.sinks:
            sink.report(report)
        self.watcher.report(report)

    def _reread_done(self, uuid: bytes) -> None:
        self.watcher.reread_done(uuid)

    # -- the end -------------------------------------------------------------------------------------------------------

    def _end(self) -> None:
        self._ending = True
        for supervisor in self.supervisors:
            supervisor.give_room_up()
            supervisor.stop()
        end = time.monotonic() + ENDING
        for supervisor in self.supervisors:
            supervisor.join(max(0.1, end - time.monotonic()))
        with suppress(TedsProvisionError):
            self._rows()
        for sink in self.sinks:
            sink.close()
        self._look()

    def _note_who_never_came(self) -> None:
        for supervisor in self.supervisors:
            if not supervisor.ever_ran and supervisor.error is None:
                supervisor.error = NoNodeError(
                    f"Node {supervisor.uuid.hex()} did not answer before the measurement ended.",
                    hint="Check its power, the bit rate and the address.",
                )

    def _ended(self) -> MeasurementEnd:
        nodes = [_summary(supervisor) for supervisor in self.supervisors]
        errors = [supervisor.error for supervisor in self.supervisors if supervisor.error is not None]
        errors += [error for sink in self.sinks if (error := _as_error(sink)) is not None]
        worst = min(errors, key=_rank) if errors else None
        files = [name for sink in self.sinks for name in sink.files]
        sinks = [
            {"sink": sink.name, "written": sink.stats.written, "dropped": sink.stats.dropped} for sink in self.sinks
        ]
        totals = [totals for supervisor in self.supervisors for totals in supervisor.streams.totals.values()]
        rates = [rate for stream in totals if (rate := stream.lower_rate) is not None]
        return MeasurementEnd(nodes, files, worst, self._common_start.spread, sinks, min(rates, default=None))


def _summary(supervisor: NodeSupervisor) -> dict[str, Any]:
    """Return a node of the ``end`` event of ``measure --json``."""
    streams = [
        asdict(totals) | {"channels": list(totals.channels)} for _, totals in sorted(supervisor.streams.totals.items())
    ]
    node: dict[str, Any] = {"uuid": supervisor.uuid.hex(), "streams": streams}
    if supervisor.error is not None:
        node["error"] = failure_of(supervisor.error)
    return node


def _as_error(sink: Sink) -> TedsProvisionError | None:
    """Return the error that ended a sink: of a recording the disk (7), of one that took nothing its transport (5)."""
    stats, recorder = sink.stats, sink.recorder
    if stats.dropped and not stats.written and not recorder:
        why = stats.error or f"{sink.name} accepted nothing: all {stats.dropped} values were dropped."
        return LinkError(why, hint=stats.hint or "Check that it is running, and where it listens.")
    kind = StoreError if recorder else TedsProvisionError
    return kind(stats.error, hint=stats.hint) if stats.error else None


def _rank(error: TedsProvisionError) -> int:
    """Return the rank of an error: not authentic first, then refused, the link, all others."""
    order = (4, 6, 5)
    return order.index(error.exit_code) if error.exit_code in order else len(order)
