"""``-`` and ``unix:PATH``: lines of a simulation, whose clock becomes the node's.

A line is a JSON object: ``{"t": seconds, "value": {"NAME": x}}``, or ``"raw"`` in place of ``"value"`` or beside it.
``t`` counts from the simulation's start and never goes back; a value holds until a line gives another, and null makes
it invalid. A simulation on a socket or run by ``exec:`` receives the values of actuators as lines ``{"set": {"NAME":
x}}``.
"""

from __future__ import annotations

import json
import math
import os
import select
import socket
import stat
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO, Final, TypeGuard

from teds_provision.errors import NoReaderError, UsageError
from teds_provision.node.sources.base import Notify, Reading, SimulationClock, SourceChannel

LONGEST_LINE: Final = 1 << 20
_LOOK_AROUND: Final = 0.2
_NOTICE_EVERY: Final = 1000


class LineSource:
    """Readings as the last lines gave them; ``needs_time``: a line must have ``t``.

    Malformed lines are counted and reported (the first, then each thousandth), and change nothing.
    """

    def __init__(self, places: Sequence[SourceChannel], notify: Notify, *, needs_time: bool = True) -> None:
        self._numbers = {place.name: place.number for place in places if place.name}
        self._notify, self._needs_time = notify, needs_time
        self._readings: dict[int, Reading | None] = {}
        self._drive: SimulationClock | None = None
        self._last: float | None = None
        self._offset = 0.0
        self.latest: Mapping[int, Reading | None] = {}  # of the last accepted line
        self.dropped = 0

    def at(self, channel: int, seconds: float) -> Reading | None:
        """Return the value of the last line."""
        return self._readings.get(channel)

    def begin(self, drive: SimulationClock) -> None:
        """Begin a simulation; if it must have times, the clock stops until its first line."""
        self._drive, self._last = drive, None
        if self._needs_time:
            drive.own_clock()

    def feed_line(self, line: bytes) -> str:
        """Take one line; return why it was skipped, "" if it was not."""
        problem = self._taken(line)
        if problem:
            self.dropped += 1
            if self.dropped == 1 or self.dropped % _NOTICE_EVERY == 0:
                self._notify(f"A line of the source was skipped ({self.dropped} so far): {problem}.")
        return problem

    def end(self) -> None:
        """End the source: no value is valid any more, the node stays."""
        self._readings = {}
        if self._drive is not None:
            self._drive.host_clock()

    def _taken(self, line: bytes) -> str:
        try:
            data = json.loads(line)
        except (ValueError, RecursionError):
            return "it is not JSON"
        if not isinstance(data, dict):
            return "it is not a JSON object"
        readings: dict[int, Reading | None] = {}
        for form in ("value", "raw"):
            problem = self._read(form, data.get(form, {}), readings)
            if problem:
                return problem
        return self._at_time(data.get("t"), readings)

    def _read(self, form: str, values: object, readings: dict[int, Reading | None]) -> str:
        if not isinstance(values, dict):
            return f'"{form}" is not an object of channel names and numbers'
        for name, value in values.items():
            number = self._numbers.get(name)
            if number is None:
                return f"the node has no sensor named {str(name)[:40]!r}"
            if value is None:
                readings[number] = None
            elif isinstance(value, bool) or not isinstance(value, int | float) or not _finite(value):
                return f"the value of {str(name)[:40]!r} is no number"
            else:
                readings[number] = Reading(value=float(value)) if form == "value" else Reading(raw=float(value))
        return ""

    def _at_time(self, time: object, readings: dict[int, Reading | None]) -> str:
        assert self._drive is not None

        def change() -> None:
            self.latest = readings
            self._readings = {**self._readings, **readings}

        if time is None and not self._needs_time and self._last is None:
            change()
            return ""
        if not _is_seconds(time):
            return '"t" is not a number of seconds of 0 or more'
        if self._last is None:  # continue from the node's clock if it is ahead
            self._drive.own_clock()
            self._offset = max(0.0, self._drive.now() - time)
        elif time < self._last:
            return f'"t" went back from {self._last} to {time}'
        self._last = float(time)
        self._drive.advance(self._offset + time, change)
        return ""


def _is_seconds(time: object) -> TypeGuard[float]:
    return isinstance(time, int | float) and not isinstance(time, bool) and _finite(time) and time >= 0


def _finite(number: float) -> bool:
    try:
        return math.isfinite(number) and abs(number) < 1e15
    except OverflowError:
        return False


def feed(read: Callable[[], bytes], take: Callable[[bytes], object]) -> None:
    """Cut what is read into lines until nothing comes any more; one beyond 1 MiB is refused."""
    held = b""
    while octets := read():
        *lines, held = (held + octets).split(b"\n")
        for line in lines:
            if line.strip():
                take(line)
        if len(held) > LONGEST_LINE:
            take(held[:64])
            held = b""
    if held.strip():
        take(held)


class StandardInput(LineSource):
    """Lines from a pipe: standard input."""

    def __init__(self, places: Sequence[SourceChannel], notify: Notify, stream: IO[bytes]) -> None:
        super().__init__(places, notify)
        self._stream = stream
        self._stop = threading.Event()

    def start(self, drive: SimulationClock) -> None:
        """Read in a thread."""
        self.begin(drive)
        threading.Thread(target=self._run, name="source", daemon=True).start()

    def acted(self, values: Mapping[str, float]) -> None:
        """Ignore the values of actuators: a pipe has no way back."""

    def stop(self) -> None:
        """Take no more lines."""
        self._stop.set()

    def _run(self) -> None:
        descriptor = self._stream.fileno()
        feed(lambda: b"" if self._stop.is_set() else os.read(descriptor, 65536), self.feed_line)
        if not self._stop.is_set():
            self.end()
            self._notify("Standard input has ended: from now on all values are invalid.")


class UnixSocket(LineSource):
    """Lines from a client of a Unix socket (mode 0600), one simulation after the other."""

    def __init__(self, places: Sequence[SourceChannel], notify: Notify, path: Path, *, needs_time: bool = True) -> None:
        super().__init__(places, notify, needs_time=needs_time)
        self._path = path
        self._listening: socket.socket | None = None
        self._peer: socket.socket | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, drive: SimulationClock) -> None:
        """Listen; a socket that a killed node left is replaced. Raises NoReaderError."""
        try:
            self._listening = self._bound()
        except OSError as error:
            raise NoReaderError(
                f"The node cannot listen on {self._path}: {error.strerror or error}.", hint="Name another path."
            ) from error
        self._thread = threading.Thread(target=self._run, args=(drive,), name="source", daemon=True)
        self._thread.start()

    def acted(self, values: Mapping[str, float]) -> None:
        """Send the values of actuators; a simulation that does not read loses them."""
        peer = self._peer
        if peer is not None:
            try:
                peer.send(json.dumps({"set": dict(values)}).encode() + b"\n", socket.MSG_DONTWAIT)
            except OSError:
                return

    def stop(self) -> None:
        """Close the socket and take its name away."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=2)
        if self._listening is not None:
            self._listening.close()
            self._path.unlink(missing_ok=True)
            self._listening = None

    def _bound(self) -> socket.socket:
        if self._path.exists() and stat.S_ISSOCK(self._path.lstat().st_mode) and not _answers(self._path):
            self._path.unlink()
        listening = socket.socket(socket.AF_UNIX)
        before = os.umask(0o177)
        try:
            listening.bind(str(self._path))
            listening.listen(1)
        except OSError:
            listening.close()
            raise
        finally:
            os.umask(before)
        return listening

    def _run(self, drive: SimulationClock) -> None:
        assert self._listening is not None
        while not self._stop.is_set():
            if not select.select([self._listening], [], [], _LOOK_AROUND)[0]:
                continue
            with self._listening.accept()[0] as peer:
                self._peer = peer
                self.begin(drive)
                feed(lambda: self._receive(peer), self.feed_line)
                self._peer = None
            if not self._stop.is_set():
                self.end()
                self._notify("The simulation disconnected: until the next one connects, all values are invalid.")

    def _receive(self, peer: socket.socket) -> bytes:
        while not self._stop.is_set():
            if select.select([peer], [], [], _LOOK_AROUND)[0]:
                try:
                    return peer.recv(65536)
                except OSError:
                    return b""
        return b""


class Simulation(UnixSocket):
    """A Unix socket whose lines need no ``t``: without one the node's clock is the host's.

    A channel without a value is invalid alone, not with its whole message.
    """

    def __init__(self, places: Sequence[SourceChannel], notify: Notify, path: Path) -> None:
        super().__init__(places, notify, path, needs_time=False)

    def at(self, channel: int, seconds: float) -> Reading | None:
        """Return the value of the last line; None while there is no simulation."""
        return (self._readings.get(channel) or Reading(missing=True)) if self._readings else None


def _answers(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        try:
            probe.connect(str(path))
        except OSError:
            return False
        return True


def make_stream(argument: str, places: Sequence[SourceChannel], notify: Notify) -> StandardInput:
    """Make the source of ``-``, which reads standard input."""
    return StandardInput(places, notify, sys.stdin.buffer)


def make_socket(argument: str, places: Sequence[SourceChannel], notify: Notify) -> UnixSocket:
    """Listen on a socket named as ``unix:/run/user/1000/hand.sock``."""
    if not argument:
        raise UsageError("unix: needs a path.", hint="Write --source unix:/tmp/hand.sock.")
    return UnixSocket(places, notify, Path(argument))


def make_simulation(argument: str, places: Sequence[SourceChannel], notify: Notify) -> Simulation:
    """Make the source of ``simulation:PATH``, which ``ncap`` uses."""
    if not argument:
        raise UsageError("simulation: needs a path.", hint="Write --source simulation:/tmp/hand.sock.")
    return Simulation(places, notify, Path(argument))
