"""ROS by a child process: topics, parameters, metadata and set points as lines of JSON through two pipes.

A child, because rospy and rclpy need the Python and the libraries that ROS came with, remove log handlers, and block
for ever without a master. If it dies it is started again (1 s, doubling to 30 s), and everything is advertised again.
Values measured meanwhile are counted as dropped; the measurement goes on.
"""

from __future__ import annotations

import json
import math
import os
import select
import signal
import subprocess
import threading
import time
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import count

from teds_provision.measure.blocks import Block, GroupRows
from teds_provision.measure.sinks.base import CommandTaker, Item
from teds_provision.measure.sinks.joints import INTERFACES
from teds_provision.measure.sinks.live import DIAGNOSTICS, JOINT_STATE, STRING, DiagnosticEntry, TopicSink
from teds_provision.measure.sinks.vectors import FieldValue, Meaning
from teds_provision.one_core import every_core

# The Python of a ROS installation, which differs from ours in its version and packages.

PROBING = 60.0  # seconds: importing rospy takes one on an idle machine


def imports(python: str, packages: str, environment: dict[str, str]) -> bool:
    """Return True if this Python can import these packages (``a, b.c``) in this environment."""
    try:
        probe = [python, "-s", "-c", f"import {packages}"]
        with every_core():
            done = subprocess.run(probe, env=environment, capture_output=True, timeout=PROBING, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def environment(*, sourced: bool) -> dict[str, str]:
    """Return the environment without the paths of our own Python; those of a ROS that the user sourced stay."""
    kept = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    if sourced and "PYTHONPATH" in os.environ:
        kept["PYTHONPATH"] = os.environ["PYTHONPATH"]
    return kept


NO_MASTER, NAME_TAKEN = 3, 4  # exit codes of a child: its master is gone, another program took its name
STUCK = 2.0  # seconds without an octet read: then the child counts as dead, whatever its process state is
ENDING = 5.0  # seconds for the child to publish its queue and end
BACK_OFF = (1.0, 30.0)
COMPLAINT = 200  # characters of the last line of stderr that are reported


class ChildSink(TopicSink):
    """The common part of sinks with a child; ``library`` is the Python package that works there."""

    def __init__(self, name: str, library: str, commands: CommandTaker | None) -> None:
        super().__init__(name, commands)
        self._library = library
        self._child: subprocess.Popen[bytes] | None = None
        self._ready = threading.Event()
        self._announced = False  # True if the facts were sent to this child
        self._heard = self._complaint = self._suffix = ""
        self._numbers: dict[str, int] = {}
        self._count_up = count()
        self._named: dict[str, tuple[str, ...]] = {}  # the names that the child knows for a topic of arrays
        self._again = 0.0
        self._pause = BACK_OFF[0]

    @abstractmethod
    def _program(self) -> list[str]:
        """Return the child's command: its Python, and its script."""

    @abstractmethod
    def _environment(self) -> dict[str, str]:
        """Return the environment of the child process."""

    def _begin(self) -> None:
        self._start()

    def _start(self) -> None:
        self._stop(0.0)
        self._numbers, self._named = {}, {}
        self._announced = False
        self._heard = self._complaint = ""
        self._ready.clear()
        with every_core():
            self._child = subprocess.Popen(
                [*self._program(), self._node + self._suffix],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,  # warnings; the last line is reported if the child dies
                env=self._environment(),
                start_new_session=True,  # Ctrl-C in the terminal reaches only the parent, which ends its child in order
            )
        assert self._child.stdin is not None
        os.set_blocking(self._child.stdin.fileno(), False)
        for hear in (self._hear, self._hear_complaints):
            threading.Thread(target=hear, args=(self._child,), name=f"{self.name} child", daemon=True).start()
        self._set_state("waiting", f"{self._library} is starting")

    def _hear(self, child: subprocess.Popen[bytes]) -> None:
        """Read the child's lines, in a thread."""
        assert child.stdout is not None
        for line in child.stdout:
            try:
                words = json.loads(line)
            except ValueError:
                continue
            if words.get("event") == "ready":
                self._ready.set()
            elif words.get("event") == "waiting":
                self._heard = f"waits for a ROS master at {words.get('master')}"
            elif words.get("event") == "command":
                self._command(words["uuid"], words["channel"], float(words["value"]))
            elif words.get("event") == "joints":
                self._joint_command(words["names"], *([float(word) for word in words[kind]] for kind in INTERFACES))
        child.stdout.close()

    def _hear_complaints(self, child: subprocess.Popen[bytes]) -> None:
        """Read its stderr, so that it never blocks; keep the last line."""
        assert child.stderr is not None
        for line in child.stderr:
            self._complaint = line.decode(errors="replace").strip()[:COMPLAINT] or self._complaint
        child.stderr.close()

    def _process_item(self, item: Item) -> None:
        if self._up():
            super()._process_item(item)
        elif isinstance(item, Block | GroupRows):
            self._count(dropped=int(item.value.size))
        else:
            self._learn(item)

    def _idle(self, now: float) -> None:
        if self._up():
            super()._idle(now)

    def _up(self) -> bool:
        """Return True if there is a child with a master; starts one when it is time."""
        now = time.monotonic()
        child = self._child
        if child is not None and child.poll() is None:
            if not self._ready.is_set():
                if self._heard:
                    self._set_state("waiting", self._heard)
                return False
            if not self._announced:
                self._announced = True
                self._set_state("running")
                self._pause = BACK_OFF[0]
                self._announce(self._every_fact())
            return self._child is not None
        if child is not None:
            self._lost(self._cause(child.returncode))
        elif now >= self._again:
            self._start()
        return False

    def _cause(self, code: int) -> str:
        """Return why a child ended; after another program took its name, the next one gets a unique name."""
        if code == NO_MASTER:
            return "the ROS master is gone"
        if code == NAME_TAKEN:
            self._suffix = f"_{os.getpid()}"
            return f"another program took the name /{self._node}"
        return f"{self._library} died" + (f" ({self._complaint})" if self._complaint else "")

    def _lost(self, why: str) -> None:
        self._stop(0.0)
        self._again = time.monotonic() + self._pause
        self._set_state("waiting", f"{why}; tried again in {self._pause:.0f} s")
        self._pause = min(2 * self._pause, BACK_OFF[1])

    def _send(self, **words: object) -> None:
        """Send one line to the child; a child that accepts nothing for STUCK seconds is given up."""
        child = self._child
        if child is None or child.stdin is None:
            return
        octets = memoryview(json.dumps(words, separators=(",", ":")).encode() + b"\n")
        end = time.monotonic() + STUCK
        try:
            while octets:
                left = end - time.monotonic()
                if left <= 0 or not select.select([], [child.stdin], [], left)[1]:
                    self._lost(f"{self._library} takes nothing any more")
                    return
                octets = octets[os.write(child.stdin.fileno(), octets) :]
        except (BrokenPipeError, BlockingIOError):
            self._lost(f"{self._library} died")

    def _number(self, topic: str, kind: str, *, latch: bool = False) -> int:
        """Return the child's number of a topic, which has one publisher for all messages on it."""
        if topic not in self._numbers:
            self._numbers[topic] = next(self._count_up)
            self._send(op="topic", id=self._numbers[topic], topic=topic, type=kind, latch=latch)
        return self._numbers[topic]

    def _advertise(self, topic: str, kind: str) -> None:
        self._number(topic, kind)

    def _array(
        self,
        topic: str,
        stamp: float,
        names: Sequence[str],
        values: Sequence[float],
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
    ) -> None:
        number = self._number(topic, JOINT_STATE)
        if self._named.get(topic) != tuple(names):
            self._named[topic] = tuple(names)
            self._send(op="named", id=number, v=list(names))
        more = {name: list(given) for name, given in (("vel", velocity), ("eff", effort)) if given}
        row = [value if math.isfinite(value) else None for value in values]
        self._send(op="joint", id=number, t=stamp, v=row, **more)

    def _scalar(self, topic: str, meaning: Meaning, stamp: float, frame: str, value: float, variance: float) -> None:
        number = self._number(topic, meaning.type)
        self._send(op="value", id=number, t=stamp, field=meaning.field, frame=frame, v=value, var=variance)

    def _fields(self, topic: str, kind: str, stamp: float, frame: str, fields: Mapping[str, FieldValue]) -> None:
        self._send(op="compound", id=self._number(topic, kind), t=stamp, frame=frame, v=dict(fields))

    def _latched(self, topic: str, words: str) -> None:
        self._send(op="text", id=self._number(topic, STRING, latch=True), v=words)

    def _retire(self, topic: str) -> None:
        number = self._numbers.pop(topic, None)
        if number is not None:
            self._send(op="retire", id=number)

    def _parameter(self, name: str, value: object) -> None:
        self._send(op="param", key=name, value=value)

    def _listen(self, topic: str, uuid: str, channel: int) -> None:
        self._send(op="listen", topic=topic, uuid=uuid, channel=channel)

    def _listen_joints(self, topic: str) -> None:
        self._send(op="listen_joints", topic=topic)

    def _diagnose(self, stamp: float, statuses: Sequence[DiagnosticEntry]) -> None:
        number = self._number("/diagnostics", DIAGNOSTICS)
        entries = [
            [diagnostic.level, diagnostic.name, diagnostic.message, diagnostic.hardware, diagnostic.values]
            for diagnostic in statuses
        ]
        self._send(op="status", id=number, t=stamp, v=entries)

    def _stop(self, patience: float) -> None:
        child, self._child = self._child, None
        if child is None:
            return
        if child.stdin is not None:
            with suppress(OSError):
                child.stdin.close()
        try:
            child.wait(patience)
        except subprocess.TimeoutExpired:
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)
            child.wait()

    def _finish(self) -> None:
        self._stop(ENDING if self._ready.is_set() else 0.5)
