"""Keep all threads of a process on one processor core, and leave that core when other processes need it.

Because of the GIL, one thread of an interpreter runs at a time. On several cores, the threads hand the GIL from core to
core, and each hand-over wakes a sleeping core: a station with 200 nodes then takes two to three times the processor
time for the same work (docs/internals/speed.md).

The core is one that the process may use (``taskset``, ``CPUAffinity=``, a cpuset), of the fastest kind, with little
load from other processes; that load is checked every two or three seconds. If it becomes too high, the threads move to
a free core, or to all cores if none is free: on a busy machine, a thread that is bound to one core waits twice as long
for its turn as one that may run on any, and busy cores need no waking. If another process changes this one's affinity
meanwhile, that setting is kept. Start child processes in ``with every_core():``, so that they may use all cores. Linux
only; if the kernel's figures cannot be read, nothing is changed.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Iterator, Mapping, Set
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Final, Protocol

_log = logging.getLogger(__name__)

FIRST_LOOK: Final = 0.3  # seconds
LOOK_SECONDS: Final = 2.0
FREE: Final = 0.35
"""A core counts as free if other processes use at most this share of it."""
TAKEN: Final = 0.5
"""The threads leave their core if other processes use more than this share of it."""


class Kernel(Protocol):
    """The kernel's figures of cores and threads; methods raise OSError, or ValueError for unknown figures."""

    def allowed(self) -> Set[int]:
        """Return the cores that the calling thread may run on."""

    def fastest(self, cores: Set[int]) -> Set[int]:
        """Return those of the cores that are of the fastest kind."""

    def waits(self) -> bool:
        """Return True if this process's threads wait while others' work runs; those of real-time processes do not."""

    def place(self, thread: int, cores: Set[int]) -> None:
        """Let a thread (0: the calling one) run on these cores alone."""

    def threads(self) -> Set[int]:
        """Return the numbers of this process's threads."""

    def busy(self) -> Mapping[int, float]:
        """Return for how many seconds each core has worked since the machine started."""

    def own(self) -> float:
        """Return the processor time of this process so far."""

    def now(self) -> float:
        """Return a clock that never goes back, in seconds."""


class LinuxKernel:
    """:class:`Kernel` of this machine."""

    def allowed(self) -> Set[int]:
        """Return the cores that the calling thread may run on."""
        return os.sched_getaffinity(0)

    def fastest(self, cores: Set[int]) -> Set[int]:
        """Return those of the cores that are of the fastest kind."""
        speeds = {core: _capacity(core) for core in cores}
        return {core for core in cores if speeds[core] == max(speeds.values())}

    def waits(self) -> bool:
        """Return True if this process's threads wait while others' work runs (sched(7): real-time ones do not)."""
        return os.sched_getscheduler(0) not in (os.SCHED_FIFO, os.SCHED_RR)

    def place(self, thread: int, cores: Set[int]) -> None:
        """Let a thread (0: the calling one) run on these cores alone."""
        os.sched_setaffinity(thread, cores)

    def threads(self) -> Set[int]:
        """Return the numbers of this process's threads."""
        return {int(name) for name in os.listdir("/proc/self/task")}

    def busy(self) -> Mapping[int, float]:
        """Return for how many seconds each core has worked since the machine started (proc(5), /proc/stat)."""
        ticks = os.sysconf("SC_CLK_TCK")
        found: dict[int, float] = {}
        with open("/proc/stat", encoding="ascii") as lines:
            for line in lines:
                name, *fields = line.split()
                if not name.startswith("cpu"):
                    break
                if name != "cpu":
                    user, nice, system, _idle, _waits, *interrupts = map(int, fields[:8])
                    found[int(name[3:])] = (user + nice + system + sum(interrupts)) / ticks
        return found

    def own(self) -> float:
        """Return the processor time of this process so far."""
        return time.process_time()

    def now(self) -> float:
        """Return a clock that never goes back, in seconds."""
        return time.monotonic()


def _capacity(core: int) -> int:
    """Return the speed of a core among those of its machine, 0 if all are alike."""
    try:
        return int(Path(f"/sys/devices/system/cpu/cpu{core}/cpu_capacity").read_text())
    except (OSError, ValueError):
        return 0


class OneCore:
    """Keeps the threads of this process on one core while one is free; raises OSError, ValueError if that fails.

    ``core`` is their present core; None while they may run on all.
    """

    def __init__(self, kernel: Kernel) -> None:
        self._kernel = kernel
        self._cores = frozenset(kernel.allowed())
        self._fit = kernel.fastest(self._cores)
        self._guard = threading.Lock()
        self._elsewhere: set[int] = set()
        self._left = False
        self._end = threading.Event()
        self._busy, self._own, self._since = kernel.busy(), kernel.own(), kernel.now()
        if not self._busy.keys() >= self._cores:
            raise ValueError("the kernel's figures are of other cores")
        self.core: int | None = None

    @property
    def left(self) -> bool:
        """True once the threads' cores are no longer decided here."""
        return self._left

    def look(self) -> None:
        """Move to a free core; stay if another process has placed the threads."""
        with self._guard:
            if self._left:
                return
            if self._kernel.allowed() != self._placed:
                self._left = True
                _log.info("The cores of this process were changed from outside; its threads stay on them.")
                return
            others = self._others()
            if self.core is not None and others[self.core] <= TAKEN:
                return
            best = min(others, key=lambda core: (others[core], core))
            if others[best] <= FREE:
                found: int | None = best
            elif self._kernel.waits():
                found = None
            else:
                found = best if self.core is None else self.core
            if found != self.core:
                _log.info("Threads on core %s; others take %.0f %% of the least busy core.", found, 100 * others[best])
                self._place_all(self._cores if found is None else {found})
                self.core = found

    def _others(self) -> dict[int, float]:
        """Return the share of each core that other processes used since the last call."""
        busy, own, now = self._kernel.busy(), self._kernel.own(), self._kernel.now()
        seconds = max(now - self._since, 1e-3)
        mine = (own - self._own) / seconds
        others = {core: (busy[core] - self._busy[core]) / seconds for core in self._fit}
        for core in others if self.core is None else [self.core]:
            others[core] = max(0.0, others[core] - mine / (len(others) if self.core is None else 1))
        self._busy, self._own, self._since = busy, own, now
        return others

    @property
    def _placed(self) -> Set[int]:
        """The cores on which the threads are."""
        return self._cores if self.core is None else {self.core}

    def leave(self) -> None:
        """Give every thread all cores back that the process had, unless another process has placed it."""
        self._end.set()
        with self._guard:
            if not self._left:
                self._left = True
                with suppress(OSError):
                    self._place_all(self._cores)

    def watch(self) -> None:
        """Look every two or three seconds, in a thread, until :meth:`leave`."""
        threading.Thread(target=self._run, name="core", daemon=True).start()

    @contextmanager
    def on_every_core(self) -> Iterator[None]:
        """Let the calling thread run on every core for the length of the block: what it starts inherits them."""
        thread = threading.get_native_id()
        with self._guard:
            if self._left or thread in self._elsewhere:
                thread = 0
            else:
                self._elsewhere.add(thread)
                self._kernel.place(0, self._cores)
        try:
            yield
        finally:
            if thread:
                with self._guard:
                    self._elsewhere.discard(thread)
                    if not self._left:
                        self._kernel.place(0, self._placed)

    def _run(self) -> None:
        # stations with different process ids do not move at the same moment
        pause, apart = FIRST_LOOK, 1 + os.getpid() % 8 / 16
        while not self._end.wait(pause):
            pause = LOOK_SECONDS * apart
            try:
                self.look()
            except (OSError, ValueError, KeyError):  # a core was taken offline
                self.leave()
            if self._left:
                return

    def _place_all(self, cores: Set[int]) -> None:
        """Place every thread; those that are started meanwhile by one that was not placed yet, too."""
        placed = set(self._elsewhere)
        while late := self._kernel.threads() - placed:
            for thread in late:
                with suppress(ProcessLookupError):
                    self._kernel.place(thread, cores)
            placed |= late


_IN_FORCE: Final[list[OneCore]] = []
"""The one of this process, if there is one: what cores its threads have is a fact of the process as a whole."""


@contextmanager
def one_core(kernel: Kernel | None = None) -> Iterator[OneCore | None]:
    """Keep all threads of this process on one core for the length of the block, while one is free.

    Yields None if nothing is changed: a single core, a system other than Linux, a kernel that refuses or has no
    figures, or a nested block.
    """
    kept = None if _IN_FORCE else _keep(kernel or LinuxKernel())
    if kept is None:
        yield None
        return
    _IN_FORCE.append(kept)
    kept.watch()
    try:
        yield kept
    finally:
        _IN_FORCE.remove(kept)
        kept.leave()


def _keep(kernel: Kernel) -> OneCore | None:
    """Return the OneCore; None if nothing is changed."""
    if not hasattr(os, "sched_setaffinity"):
        return None
    with suppress(OSError, ValueError):
        return OneCore(kernel) if len(kernel.allowed()) > 1 else None
    return None


@contextmanager
def every_core() -> Iterator[None]:
    """Let the calling thread run on every core for the length of the block, in which it starts a process."""
    with _IN_FORCE[0].on_every_core() if _IN_FORCE else nullcontext():
        yield
