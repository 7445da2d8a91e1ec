"""Output of a running ``measure``: lines of JSON, a live table on a terminal, plain lines in a pipe."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from teds_provision import measure as measure_room
from teds_provision.cli.context import App
from teds_provision.cli.rendering import shown, tidy
from teds_provision.measure.blocks import Block, ChannelFacts, NodeReport, StationFacts, why_invalid
from teds_provision.measure.running.measurement import Watcher
from teds_provision.measure.sinks import Sink, ThreadedSink
from teds_provision.measure.sinks.base import Item
from teds_provision.measure.sinks.json_events import as_line, data_lines, status_line
from teds_provision.sanitize import counted
from teds_provision.station.station import Station
from teds_provision.teds import units
from teds_provision.teds.channel import within_turn

if TYPE_CHECKING:
    from rich.table import Table


PER_SECOND = 4
ROWS = 40


@contextmanager
def watcher_for(app: App, station: Station, sinks: Sequence[Sink], stop: threading.Event) -> Iterator[Watcher]:
    """Yield the watcher of a measurement: JSON lines, a table, or lines on stderr."""
    if app.json:
        lines = StdoutEvents(stop)
        lines.open((), measure_room.blocks.StationFacts(station.name))
        try:
            yield Watcher(lines.write, lines.describe, lines.report_change, lines.sink, app.warn)
        finally:
            lines.close()
    elif sys.stdout.isatty() and not app.quiet:
        with LiveTable(app, sinks).shown() as table:
            yield Watcher(table.block, table.facts, table.report, table.sink, app.warn)
    else:
        plain = PlainLines(app)
        yield Watcher(report=plain.report, sink=plain.sink, note=app.warn)


class StdoutEvents(ThreadedSink):
    """Events on stdout, written by a thread: a slow pipe stops no measurement. It drops nothing."""

    recorder = True

    def __init__(self, stop: threading.Event) -> None:
        super().__init__("stdout")
        self._stop = stop
        self._facts: dict[tuple[str, int], ChannelFacts] = {}
        self._last: dict[str, tuple[str, str]] = {}
        self._printed: dict[str, str] = {}  # the last printed state of each node
        self._events: list[dict[str, Any]] = []
        self._guard = threading.Lock()

    def report_change(self, report: NodeReport) -> None:
        """Print a changed state as a line."""
        with self._guard:
            before = self._last.get(report.uuid)
            self._last[report.uuid] = (report.state, report.why)
        if before != (report.state, report.why):
            self.report(report)

    def sink(self, sink: Sink) -> None:
        """Print a sink that failed, waits for its consumers, or has them again."""
        stats = sink.stats
        why = stats.error or stats.detail
        with self._guard:
            self._events.append(
                {"event": "sink", "sink": sink.name, "state": stats.state, "why": why, "hint": stats.hint,
                 "dropped": stats.dropped}
            )  # fmt: skip

    def _prepare(self, facts: tuple[ChannelFacts, ...], station: StationFacts) -> None:
        """Do nothing: a screen needs no preparation."""

    def _process_item(self, item: Item) -> None:
        if isinstance(item, Block):
            self._put_out(b"".join(as_line(line) for line in data_lines(item, self._facts)))
        elif isinstance(item, NodeReport):
            self._put_out(as_line(status_line(item)))
            # only now, so that it follows the node's last values
            if self._printed.get(item.uuid) == "running" and item.state == "refused":
                self._put_out(as_line({"event": "left", "uuid": item.uuid, "why": item.why}))
            self._printed[item.uuid] = item.state
        elif isinstance(item, tuple):
            self._facts.update((facts.key, facts) for facts in item)
        self._idle(time.monotonic())

    def _idle(self, now: float) -> None:
        with self._guard:
            events, self._events = self._events, []
        for event in events:
            self._put_out(as_line(event))

    def _put_out(self, octets: bytes) -> None:
        try:
            sys.stdout.buffer.write(octets)
            sys.stdout.buffer.flush()
        except BrokenPipeError:
            self._stop.set()  # the reader is gone: end in order, so that the nodes are released
            raise

    def _finish(self) -> None:
        self._idle(time.monotonic())


class PlainLines:
    """Changes of state, one line each, on stderr."""

    def __init__(self, app: App) -> None:
        self._app = app
        self._last: dict[str, tuple[str, str]] = {}

    def report(self, report: NodeReport) -> None:
        """Print a changed state."""
        if self._last.get(report.uuid) != (report.state, report.why):
            self._last[report.uuid] = (report.state, report.why)
            self._app.note(f"{report.uuid}: {report.state}{f': {report.why}' if report.why else ''}")

    def sink(self, sink: Sink) -> None:
        """Print a sink that failed, waits for its consumers, or has them again."""
        stats = sink.stats
        text = f"{stats.error} {stats.hint}" if stats.error else f"{sink.name}: {stats.state}, {stats.detail}"
        self._app.warn(text.strip())


class LiveTable:
    """A table of the newest values, and a line for each node and sink, redrawn four times a second."""

    def __init__(self, app: App, sinks: Sequence[Sink]) -> None:
        self._app, self._sinks = app, sinks
        self._facts: dict[tuple[str, int], ChannelFacts] = {}
        self._newest: dict[tuple[str, int], tuple[float | None, float, int, float]] = {}
        self._reports: dict[str, NodeReport] = {}
        self._guard = threading.Lock()
        self._end = threading.Event()

    def block(self, block: Block) -> None:
        """Keep the newest value of each channel."""
        now = time.monotonic()
        with self._guard:
            for column, number in enumerate(block.channels):
                _, _, count, since = self._newest.get((block.uuid, number), (None, 0.0, 0, now))
                value = float(block.value[-1, column]) if block.valid[-1, column] else None
                self._newest[block.uuid, number] = (value, float(block.time[-1]), count + len(block.time), since)

    def facts(self, facts: Sequence[ChannelFacts]) -> None:
        """Show the names and units of a node's channels."""
        with self._guard:
            self._facts.update((channel_facts.key, channel_facts) for channel_facts in facts)

    def report(self, report: NodeReport) -> None:
        """Show the state of a node."""
        with self._guard:
            self._reports[report.uuid] = report

    def sink(self, sink: Sink) -> None:
        """Print a failed sink as a line that stays; the states of the others are below the table."""
        if sink.stats.error:
            self._app.warn(f"{sink.stats.error} {sink.stats.hint}".strip())

    @contextmanager
    def shown(self) -> Iterator[LiveTable]:
        """Draw it until the block ends."""
        from rich.live import Live

        with Live(self._table(), console=self._app.console(), auto_refresh=False, transient=True) as live:
            drawing = threading.Thread(target=self._draw, args=(live,), daemon=True)
            drawing.start()
            try:
                yield self
            finally:
                self._end.set()
                drawing.join(2.0)

    def _draw(self, live: Any) -> None:
        while not self._end.wait(1 / PER_SECOND):
            with suppress(OSError):
                live.update(self._table(), refresh=True)

    def _table(self) -> Table:
        from rich.markup import escape
        from rich.table import Table

        table = Table("node", "channel", "value", "unit", "age", "rate", box=None, pad_edge=False)
        with self._guard:
            newest, facts, reports = dict(self._newest), dict(self._facts), dict(self._reports)
        now, monotonic = time.time(), time.monotonic()
        for key, (value, when, count, since) in sorted(newest.items())[:ROWS]:
            known = facts.get(key, ChannelFacts(key[0], "", key[1], ""))
            rate = count / max(monotonic - since, 1e-3)
            text, unit = value_text(value, known)
            table.add_row(
                escape(shown(known.node or key[0][:8])),
                escape(shown(known.label)),
                text,
                escape(unit),
                f"{max(0.0, now - when):.2f} s",
                f"{rate:.4g} Hz",
            )
        table.caption = "\n".join(
            [*(_line(report) for report in reports.values()), *(_sink_line(sink) for sink in self._sinks)]
        )
        table.caption_justify = "left"
        return table


def in_peoples_units(value: float | None, known: ChannelFacts) -> tuple[float | None, str]:
    """Return a value in SI units in its display unit."""
    if value is None or known.units is None:
        return value, known.unit
    number, unit = units.in_display_units(value, known.units, known.shown_unit)
    return number, units.short_unit(unit)


def value_text(value: float | None, known: ChannelFacts) -> tuple[str, str]:
    """Return a value in SI units as people read it, and its display unit; an angle over a full turn within its turn."""
    number, unit = in_peoples_units(None if value is None else tidy(value, known.uncertainty), known)
    if number is None:
        return "not valid", unit
    if known.full_turn and known.units is not None and known.low is not None:
        return within_turn(number, units.display_unit(known.units, known.shown_unit), known.low), unit
    return f"{number:.6g}", unit


def _line(report: NodeReport) -> str:
    clock = f", clock ±{report.clock_error * 1e3:.2g} ms" if report.clock_error is not None else ""
    reasons = f" ({shown(why_invalid(report.invalid_why))})" if report.invalid_why else ""
    counts = f"lost {report.lost}, late {report.late}, bad {report.bad}, invalid {report.invalid}{reasons}{clock}"
    why = f" ({report.why})" if report.why else ""
    return f"{report.uuid} {report.state}{why}: {counts}".replace("[", "(")


def _sink_line(sink: Sink) -> str:
    stats = sink.stats
    detail = stats.error or stats.detail
    return f"{sink.name}: {stats.state}, {counted(stats.written, 'value')}, {stats.dropped} dropped. {detail}".replace(
        "[", "("
    )
