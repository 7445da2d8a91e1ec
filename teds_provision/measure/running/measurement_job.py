"""One stored measurement: started, continued after a restart, ended in order.

The way of `measure` and of `ncap run` alike:

* ``station.measurements.keep(KeptMeasurement(...))`` keeps what ``ncap`` measures; ``due()`` is what it carries on
  after a start, ``settings_to_continue(NAME)`` what `measure NAME` continues; ``forget(ID)`` deletes.
* ``Buses(ports)`` hears the buses of the process, once for all measurements.
* ``MeasurementJob(station, kept)`` makes its sinks; ``run(buses, stop)`` measures on this thread until ``stop`` is set,
  or ``start(buses)`` and ``stop()`` in a thread, restarted after an error. While it runs, its nodes
  and its group are held: ``station.measurements.is_running(uuid)``, PolicyError (6) for other users.
* ``job.measurement.session(uuid)`` is the session of a node that is measured, for one more command in between.

A measurement of a command is kept while it runs. The row of one that was killed belongs to no process, and the next
reader removes it; `measure NAME` without options continues with its settings.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from teds_provision.errors import InternalError, TedsProvisionError
from teds_provision.measure.blocks import SetPointCommand, StationFacts
from teds_provision.measure.buses import Buses
from teds_provision.measure.request import MeasurementRequest, Requirements
from teds_provision.measure.running.measurement import Measurement, MeasurementEnd, Watcher
from teds_provision.measure.sinks import CommandTaker, Sink, open_sink
from teds_provision.measure.sinks.foxglove import ARRAYS
from teds_provision.measure.sinks.shown import SHOWN
from teds_provision.measure.sinks.wide import WIDE
from teds_provision.station.measurements import STATION
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeptMeasurement
from teds_provision.teds.fits import parse_require

_log = logging.getLogger(__name__)
AGAIN, LONGEST = 1.0, 30.0  # seconds until a measurement that failed as a whole is started again


def whole_path(spec: str) -> str:
    """Return the string of a sink as it can be stored: a file's absolute path, whatever the folder is next time."""
    if spec.removeprefix(ARRAYS).partition(":")[0] in _SERVICES:
        return spec
    if spec.startswith(ARRAYS):
        return ARRAYS + str(Path(spec.removeprefix(ARRAYS)).absolute())
    shown = SHOWN if spec.startswith(SHOWN) else ""
    wide = WIDE if spec.removeprefix(shown).startswith(WIDE) else ""
    return shown + wide + str(Path(spec.removeprefix(shown + wide)).absolute())


_SERVICES = frozenset({"ros1", "ros2", "mqtt", "mqtts", "foxglove"})


class MeasurementJob:
    """One measurement: ``sinks`` are made (and opened by the run), ``ended`` is how the last run ended.

    ``more`` makes the sinks beside those that are kept, for each run; it gets the receiver of set points from topics.
    ``admits`` decides on each set point; None: none may pass, whatever is kept. ``opened`` makes a sink of a kept
    string. Raises UsageError if a sink cannot be named so.
    """

    def __init__(
        self,
        station: Station,
        kept: KeptMeasurement,
        *,
        more: Callable[[CommandTaker | None], Sequence[Sink]] = lambda _take: (),
        request: MeasurementRequest | None = None,
        admits: Callable[[SetPointCommand], bool] | None = lambda _command: True,
        opened: Callable[[str, CommandTaker | None], Sink] = open_sink,
    ) -> None:
        self.station, self.kept = station, kept
        self._moves = kept.actuators and admits is not None
        self.request = replace(request_of(kept, request or MeasurementRequest(patient=True)), actuators=self._moves)
        self._each_node = self.request.newcomers
        self._more, self._admits, self._opened = more, admits, opened
        self._commands: Callable[[SetPointCommand], None] = lambda _command: None
        self.sinks = self._new_sinks()
        self.measurement: Measurement | None = None
        self.ended: MeasurementEnd | None = None
        self.lent: set[bytes] = set()
        self.error: TedsProvisionError | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def run(
        self,
        buses: Buses,
        stop: threading.Event,
        *,
        watcher: Watcher | None = None,
        duration: float | None = None,
    ) -> MeasurementEnd:
        """Measure until ``stop``, for ``duration`` seconds of data, or to the kept end; nodes and group are held.

        Raises PolicyError if another measurement holds one of them, and what a sink's ``open`` raises.
        """
        uuids = self.station.measurements.nodes_of(self.kept)
        name = self.kept.group or ", ".join(uuid.hex()[:8] for uuid in uuids[:3])
        # Read before this process marks the nodes itself: other measurements of a node share the rate that it can send.
        beside = {uuid: holder for uuid in uuids if (holder := self.station.measurements.holder(uuid)) is not None}
        with ExitStack() as stack:
            stack.enter_context(self.station.measurements.running(uuids, group=self.kept.group, what=f"measure {name}"))
            if self.kept.group is not None:
                self._keep_while_it_runs(stack)
            if duration is None and self.kept.ends is not None:
                duration = max(0.1, self.kept.ends - time.time())
            self.measurement = measurement = Measurement(
                self.station,
                buses,
                uuids,
                replace(self.request, beside=beside),
                self.sinks,
                self._facts(),
                watcher or Watcher(),
                lent=self.lent,
            )
            measurement.began = lambda: self._began(duration)
            self._commands = measurement.command
            try:
                self.ended = measurement.run(stop, duration)
            finally:
                self.measurement = None
        return self.ended

    def _keep_while_it_runs(self, stack: ExitStack) -> None:
        """Keep a command's measurement of a group until ``stack`` closes; one that lasts is kept for longer."""
        kept, measurements = self.kept, self.station.measurements
        if not kept.lasting:
            self.kept = stack.enter_context(measurements.owned_by_command(kept))
        elif not kept.id:
            self.kept = measurements.keep(kept)

    def start(self, buses: Buses, watcher: Watcher | None = None) -> None:
        """Measure in a thread until :meth:`stop`, or to its end; restarted after an error that ends it."""
        self._thread = threading.Thread(
            target=self._carry_on, args=(buses, watcher), name=f"measurement {self.kept.id}", daemon=True
        )
        self._thread.start()

    def stop(self, seconds: float = 15.0) -> None:
        """End it in order: claims released, files closed. Returns when that is done, or after ``seconds``."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(seconds)

    def suspend_node(self, uuid: bytes, why: str, seconds: float) -> bool:
        """Stop measuring a node until :meth:`resume_node`; False if it did not end in order within ``seconds``."""
        self.lent.add(uuid)
        measurement = self.measurement
        return measurement is None or measurement.suspend_node(uuid, why, seconds)

    def resume_node(self, uuid: bytes) -> None:
        """Measure a node again that was let go."""
        measurement = self.measurement
        if measurement is not None:
            measurement.resume_node(uuid)
        self.lent.discard(uuid)

    @property
    def alive(self) -> bool:
        """True if its thread still lives."""
        return self._thread is not None and self._thread.is_alive()

    def _carry_on(self, buses: Buses, watcher: Watcher | None) -> None:
        pause, again = AGAIN, False
        while not self._stop.is_set():
            began = time.monotonic()
            try:
                if again:  # in here: their folder may be gone, or the disk full, for as long as the run fails for that
                    self.sinks = self._new_sinks()
                again = True
                self.ended = self.run(buses, self._stop, watcher=watcher)
                self.error = self.ended.error
                if self.kept.ends is not None and self.kept.ends <= time.time():
                    self.station.measurements.forget(self.kept.id)
                    return
            except TedsProvisionError as error:
                self.error = error
            except Exception as bug:  # noqa: BLE001 - a thread that ends unreported looks like a normal end
                _log.exception("Measurement %s failed.", self.kept.id)
                self.error = InternalError(
                    f"Unexpected {type(bug).__name__}.", hint="This is a bug: please report it with -vv."
                )
            if time.monotonic() - began > LONGEST:
                pause = AGAIN
            self._stop.wait(pause)
            pause = min(2 * pause, LONGEST)

    def _began(self, duration: float | None) -> None:
        """Store the end, which is known from its first value on, so that a restart does not move it."""
        if duration is not None and self.kept.ends is None:
            self.kept = replace(self.kept, ends=time.time() + duration)
            if self.kept.id:
                self.station.measurements.keep(self.kept)

    def _facts(self) -> StationFacts:
        first = next((uuid.hex()[:8] for uuid in self.kept.uuids), "")
        return replace(
            station_facts(self.station),
            group=self.kept.group or "",
            instance=self.kept.group or (first and f"n{first}") or (self._each_node and self.kept.id) or "",
            started=time.time(),
            scalar_rate=self.kept.scalar_rate,
            test_pattern=self.request.test_pattern,
            each_node=self._each_node,
        )

    def _new_sinks(self) -> list[Sink]:
        admit = self._admit if self._moves else None
        return [*(self._opened(spec, admit) for spec in self.kept.sinks), *self._more(admit)]

    def _admit(self, command: SetPointCommand) -> None:
        """Pass on a set point that came by a topic, if it is admitted."""
        if self._admits is not None and self._admits(command):
            self._commands(command)


def request_of(kept: KeptMeasurement, more: MeasurementRequest) -> MeasurementRequest:
    """Return the request for each node; ``more`` has what is not kept: patience, time-out, lease."""
    return replace(
        more,
        **kept.settings(),
        newcomers=kept.match is not None and not kept.frozen,
        requirements=Requirements(parse_require(kept.require, "--require")) if kept.require else None,
    )


def station_facts(station: Station) -> StationFacts:
    """Return the station's facts for the sinks: its name, those of its nodes, and the names that an operator chose."""
    names = {(uuid.hex(), channel): name for (uuid, channel), name in station.measurements.names.items()}
    nodes = {record.uuid.hex(): record.name or "" for record in station.nodes.all()}
    return StationFacts(names.pop((STATION.hex(), 0), station.name), names=names, nodes=nodes)
