"""A measurement: nodes in, sinks out. Starts the keepers, the hearing thread and the sinks; ends them in order.

The loop here moves no data. Blocks go from the hearing thread straight into the queues of the sinks; the loop gives out
the rows of the group, reports once a second, and looks whether somebody has ended.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import Any

from teds_provision.errors import NoNode, TedsProvisionError
from teds_provision.links.can.bus import Frame
from teds_provision.links.can.port import CanPort
from teds_provision.measure.blocks import Block, ChannelFacts, Command, NodeReport, StationFacts
from teds_provision.measure.clock import Wall
from teds_provision.measure.grid import Grid
from teds_provision.measure.hearing import Hearing
from teds_provision.measure.keeper import NodeKeeper
from teds_provision.measure.orders import BusShare, Events, Wish
from teds_provision.measure.planning import BusTime
from teds_provision.measure.sinks import Sink
from teds_provision.measure.trusting import Trusted, exchange_clock
from teds_provision.protocol.operation.can_frames import trigger_identifier
from teds_provision.protocol.operation.stream_commands import Action
from teds_provision.protocol.operation.subscription import TickBounds
from teds_provision.protocol.operation.timing import START_AFTER_MARK, Token, mark_is_honest
from teds_provision.station.station import Station
from teds_provision.talk.conversation import SessionLost

BEAT = 0.02  # seconds between rows of the group
REPORTING = 1.0
TOGETHER = 15.0  # seconds that a trigger waits for all nodes
TRIGGER_LIFE = 30  # seconds
ENDING = 10.0  # seconds for all nodes to let go


@dataclass
class Watcher:
    """Who sees what goes on: a live table, lines of JSON. Each is called from the measurement's threads."""

    block: Callable[[Block], None] = lambda _block: None
    facts: Callable[[Sequence[ChannelFacts]], None] = lambda _facts: None
    report: Callable[[NodeReport], None] = lambda _report: None
    sink: Callable[[Sink], None] = lambda _sink: None
    note: Callable[[str], None] = lambda _text: None


@dataclass(frozen=True)
class Ended:
    """How a measurement ended: the ``end`` event (cli.md), and the worst error of a node or sink, None for none."""

    nodes: list[dict[str, Any]]
    files: list[str]
    error: TedsProvisionError | None
    apart: float = 0.0


@dataclass
class Measurement:
    """Nodes of one bus, measured together into sinks. ``run`` does all of it."""

    station: Station
    port: CanPort
    uuids: Sequence[bytes]
    wish: Wish
    sinks: Sequence[Sink]
    facts: StationFacts
    watcher: Watcher = field(default_factory=Watcher)
    keepers: list[NodeKeeper] = field(default_factory=list, init=False)

    def run(self, stop: threading.Event, duration: float | None = None) -> Ended:
        """Measure until ``stop``, for ``duration`` seconds of data, or until no node is left.

        Raises what a sink's ``open`` raises; everything else stands in the result.
        """
        self._wall, self._lock = Wall.now(), threading.Lock()
        self._known: dict[tuple[str, int], ChannelFacts] = {}
        self._grid: Grid | None = None
        self._failed: set[str] = set()
        self._apart = 0.0
        opened: list[Sink] = []
        try:
            for sink in self.sinks:
                sink.open((), self.facts)
                opened.append(sink)
        except BaseException:
            for sink in opened:
                sink.close()
            raise
        hearing = Hearing(self.port)
        share = BusShare(_bus_time(self.port), set(self.uuids))
        events = Events(self._block, self._describe, self._report)
        self.keepers = [
            NodeKeeper(self.station, self.port, hearing, share, uuid, self.wish, self._wall, events)
            for uuid in self.uuids
        ]
        for keeper in self.keepers:
            keeper.start()
        try:
            self._loop(stop, duration)
        finally:
            self._end(hearing)
        return self._ended()

    def _loop(self, stop: threading.Event, duration: float | None) -> None:
        until = math.inf
        reported = 0.0
        triggered = not self.wish.trigger
        while not stop.wait(BEAT):
            now = time.monotonic()
            if self._all_done():
                return
            if not triggered and all(keeper.ready.is_set() for keeper in self.keepers):
                triggered = True
                self._trigger()
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

    def _until(self, now: float, duration: float | None) -> float:
        """When ``duration`` seconds of data are over: they count from the first node's first value."""
        if duration is None or not any(keeper.ever_ran for keeper in self.keepers):
            return math.inf
        return now + duration

    def _all_done(self) -> bool:
        return all(keeper.done.is_set() for keeper in self.keepers)

    def _gave_up(self) -> bool:
        """Whether no node ever ran and each has had its time."""
        return all(not one.ever_ran and isinstance(one.error, NoNode) for one in self.keepers)

    def _look(self) -> None:
        for keeper in self.keepers:
            self._report(keeper.report())
        for sink in self.sinks:
            if sink.stats.error and sink.name not in self._failed:
                self._failed.add(sink.name)
                self.watcher.sink(sink)

    def _rows(self) -> None:
        with self._lock:
            rows = self._grid.rows(time.time()) if self._grid is not None else None
        if rows is not None:
            for sink in self.sinks:
                sink.write_group(rows)

    def command(self, command: Command) -> None:
        """A set point that came by a sink."""
        for keeper in self.keepers:
            if keeper.uuid.hex() == command.uuid:
                keeper.command(command)

    # -- from the threads of nodes and bus ---------------------------------------------------------------------------

    def _block(self, block: Block) -> None:
        for sink in self.sinks:
            sink.write(block)
        if self._grid is not None:
            with self._lock:
                self._grid.take(block)
        self.watcher.block(block)

    def _describe(self, facts: Sequence[ChannelFacts]) -> None:
        with self._lock:
            before = dict(self._known)
            self._known.update((one.key, one) for one in facts)
            if self._known != before and any(sink.wants_rows for sink in self.sinks):
                self._grid = self._new_grid()
        for sink in self.sinks:
            sink.describe(facts)
        self.watcher.facts(facts)

    def _new_grid(self) -> Grid:
        spans = [heard.receiver.plan.span for one in self.keepers for heard in list(one.running.values())]
        patience = max(spans, default=0) / 1e9 + 2 * BEAT
        sensors = [one for _, one in sorted(self._known.items()) if one.kind != "actuator"]
        return Grid(self.facts.group or "all", sensors, patience=patience)

    def _report(self, report: NodeReport) -> None:
        for sink in self.sinks:
            sink.report(report)
        self.watcher.report(report)

    # -- beginning together ------------------------------------------------------------------------------------------

    def _trigger(self) -> None:
        """Arm every node, send one frame, read each node's mark: it must meet the time at which the frame went out."""
        token = Token.draw()
        armed = self._arm(token)
        before = time.monotonic_ns()
        self.port.send(Frame(trigger_identifier(self.port.spec.source), token.octets))
        after = time.monotonic_ns() + 5_000_000  # a controller may hold a frame back while others win arbitration
        marks = []
        for keeper, trusted in armed:
            mark = self._mark(keeper, trusted, before, after)
            if mark is None:
                continue
            marks.append(keeper.clock.host_of(mark))
            for heard in list(keeper.running.values()):
                heard.begin(mark + START_AFTER_MARK)
        self._apart = max(marks) - min(marks) if marks else 0.0

    def _arm(self, token: Token) -> list[tuple[NodeKeeper, Trusted]]:
        """The nodes that wait for the trigger now."""
        armed = []
        for keeper in self.keepers:
            trusted = keeper.trusted
            if trusted is None or not keeper.ever_ran:
                continue
            try:
                with keeper.turn:
                    trusted.node.send(token.arm(Action.START, TRIGGER_LIFE).command(), "to wait for the trigger")
                armed.append((keeper, trusted))
            except (TedsProvisionError, SessionLost) as error:
                self.watcher.note(f"Node {keeper.uuid.hex()} does not take the trigger: {error}")
        return armed

    def _mark(self, keeper: NodeKeeper, trusted: Trusted, before: int, after: int) -> int | None:
        """The tick at which the node saw the trigger, which went out between two times (monotonic ns).

        None where it does not say, or names a moment at which the frame was not on the bus; such a node is stopped.
        """
        try:
            with keeper.turn:
                mark = exchange_clock(trusted.node, keeper.clock).mark
        except (TedsProvisionError, SessionLost) as error:
            self.watcher.note(f"Node {keeper.uuid.hex()} did not say when it saw the trigger: {error}")
            return None
        low, high = keeper.clock.ticks_at(before).low, keeper.clock.ticks_at(after).high
        if not mark or not mark_is_honest(mark, TickBounds(low, high)):
            self.watcher.note(f"Node {keeper.uuid.hex()} names another moment for the trigger: it is not begun.")
            keeper.stop()
            return None
        return mark

    # -- the end -------------------------------------------------------------------------------------------------------

    def _end(self, hearing: Hearing) -> None:
        for keeper in self.keepers:
            keeper.stop()
        end = time.monotonic() + ENDING
        for keeper in self.keepers:
            keeper.join(max(0.1, end - time.monotonic()))
        hearing.close()
        with suppress(TedsProvisionError):
            self._rows()
        for sink in self.sinks:
            sink.close()
        self._look()

    def _ended(self) -> Ended:
        nodes = [_summary(keeper) for keeper in self.keepers]
        errors = [keeper.error for keeper in self.keepers if keeper.error is not None]
        errors += [TedsProvisionError(s.stats.error, hint=s.stats.hint) for s in self.sinks if s.stats.error]
        worst = min(errors, key=_rank) if errors else None
        files = [name for sink in self.sinks for name in sink.files]
        return Ended(nodes, files, worst, self._apart)


def _summary(keeper: NodeKeeper) -> dict[str, Any]:
    """A node of the ``end`` event (cli.md, `measure`)."""
    streams = [asdict(one) | {"channels": list(one.channels)} for _, one in sorted(keeper.totals.items())]
    node: dict[str, Any] = {"uuid": keeper.uuid.hex(), "streams": streams}
    if keeper.error is not None:
        node["error"] = {"code": keeper.error.code, "message": keeper.error.message}
    return node


def _rank(error: TedsProvisionError) -> int:
    """Not authentic before refused before the link before the rest (cli.md, `measure`)."""
    order = (4, 6, 5)
    return order.index(error.exit_code) if error.exit_code in order else len(order)


def _bus_time(port: CanPort) -> BusTime:
    spec = port.spec
    return BusTime(spec.bitrate, spec.data_bitrate if spec.fd else None)
