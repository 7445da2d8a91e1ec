"""A plugin of pytest: writes down what each test, and each fixture that several tests share, costs and runs.

Costs are CPU: of this process, of those it started and of those they started, ended or not. What a shared fixture costs
and runs counts for the fixture, not for the test that happens to come first.
"""

from __future__ import annotations

import builtins
import mmap
import os
import pickle
import resource
import sys
import time
import zlib
from collections.abc import Generator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.redundant.probes import HITS, PLACE

RECORDS = "PROBE_RECORDS"
"""The variable of the environment that names the folder of the records; ``size`` in it has the count of the probes."""
_STARTS = frozenset({"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "tests.zygote.run"})
_TICK = 1 / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Record:
    """What one test or shared fixture cost and ran."""

    name: str  # the id of a test, or FILE::fixture FIXTURE
    cpu: float  # seconds
    wall: float
    hits: bytes  # an octet for each probe, compressed
    fixtures: tuple[str, ...]  # names of the shared fixtures that a test has
    failed: bool  # where it failed it may have run less than usual


@dataclass
class _Tree:
    """The CPU of this process and its descendants."""

    known: list[int] = field(default_factory=list)
    stale: bool = True

    def cpu(self) -> float:
        if self.stale:
            self.known, self.stale = self._descendants(), False
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        return time.process_time() + ended.ru_utime + ended.ru_stime + self._running()

    def _running(self) -> float:
        ticks = 0
        for pid in list(self.known):
            try:
                ticks += sum(map(int, _stat(pid)[11:15]))
            except OSError:
                self.known.remove(pid)
        return ticks * _TICK

    def _descendants(self) -> list[int]:
        children: dict[int, list[int]] = {}
        for entry in os.listdir("/proc"):
            if entry.isdigit():
                try:
                    children.setdefault(int(_stat(int(entry))[1]), []).append(int(entry))
                except OSError:
                    continue
        found, left = [], [os.getpid()]
        while left:
            below = children.get(left.pop(), [])
            found += below
            left += below
        return found


def _stat(pid: int) -> list[str]:
    with open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
        return file.read().rpartition(")")[2].split()


class Recorder:
    """Writes the records of one worker."""

    def __init__(self, folder: Path, worker: str) -> None:
        """``folder`` has a file ``size``, the count of the probes."""
        self._tree = _Tree()
        self._failed = False
        self._size = int((folder / "size").read_text())
        place = folder / f"{worker}.hits"
        with place.open("w+b") as file:
            file.truncate(self._size)
            self._map = mmap.mmap(file.fileno(), self._size)
        setattr(builtins, HITS, self._map)
        os.environ[PLACE] = str(place)
        self._out = (folder / f"{worker}.records").open("ab")
        self._taken: list[list[float]] = [[0.0, 0.0]]  # CPU and time of the shared fixtures within what is measured
        sys.addaudithook(self._heard)

    def _heard(self, event: str, _arguments: tuple[object, ...]) -> None:
        if event in _STARTS:
            self._tree.stale = True

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        """Record a test with its own fixtures."""
        self._map[:] = bytes(self._size)
        self._taken, self._failed = [[0.0, 0.0]], False
        cpu, began = self._tree.cpu(), time.monotonic()
        done = yield
        self._tree.stale = self._tree.stale or bool(self._tree.known)
        cpu, wall = self._tree.cpu() - cpu, time.monotonic() - began
        self._write(item.nodeid, cpu - self._taken[0][0], wall - self._taken[0][1], _shared(item))
        return done

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_fixture_setup(
        self, fixturedef: pytest.FixtureDef[object], request: pytest.FixtureRequest
    ) -> Generator[None, object, object]:
        """Record a fixture that several tests share."""
        if fixturedef.scope == "function":
            return (yield)
        kept = self._map[:]
        self._map[:] = bytes(self._size)
        self._taken.append([0.0, 0.0])
        cpu, began = self._tree.cpu(), time.monotonic()
        try:
            return (yield)
        finally:
            inner = self._taken.pop()
            self._tree.stale = True
            cpu, wall = self._tree.cpu() - cpu, time.monotonic() - began
            file = request.node.nodeid.partition("::")[0]
            self._write(f"{file}::fixture {fixturedef.argname}", cpu - inner[0], wall - inner[1], ())
            self._map[:] = kept
            self._taken[-1][0] += cpu
            self._taken[-1][1] += wall

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Notice that a test failed."""
        self._failed = self._failed or report.failed

    def _write(self, name: str, cpu: float, wall: float, fixtures: tuple[str, ...]) -> None:
        record = Record(name, max(0.0, cpu), wall, zlib.compress(self._map[:], 1), fixtures, self._failed)
        pickle.dump(record, self._out)
        self._out.flush()


def _shared(item: pytest.Item) -> tuple[str, ...]:
    found = getattr(item, "_fixtureinfo", None)
    if found is None:
        return ()
    return tuple(
        sorted(
            name for name, defined in found.name2fixturedefs.items() if any(one.scope != "function" for one in defined)
        )
    )


def pytest_configure(config: pytest.Config) -> None:
    """Record in each worker, or in the one process there is."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    if worker or not getattr(config.option, "numprocesses", None):
        config.pluginmanager.register(Recorder(Path(os.environ[RECORDS]), worker or f"alone-{os.getpid()}"), "recorder")
