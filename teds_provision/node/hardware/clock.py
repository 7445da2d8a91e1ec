"""The clock of a virtual transducer: the host's monotonic one, or the one of a simulation that drives it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Final

NANOSECONDS: Final = 1_000_000_000
_HOST_STEP: Final = 1000
"""ns: what the host's clock is good for from Python, reading to reading."""
_MOST_STEP: Final = 0xFFFFFFFF


class NodeClock:
    """Ticks in ns since the node's start; they never go back. Thread-safe.

    A simulation takes the clock over (:meth:`own_clock`) and moves it on (:meth:`advance`); ``due`` is called for each
    move, twice: with the values before, and with the new ones. A move happens inside ``guard``.
    """

    def __init__(self, host: Callable[[], int] = time.monotonic_ns) -> None:
        self._host = host
        self._lock = threading.RLock()
        self._base, self._since = 0, host()
        self._own = False
        self._step = _HOST_STEP
        self.due: Callable[[], None] = lambda: None
        self.guard: Callable[[], AbstractContextManager[None]] = nullcontext

    def tick(self) -> int:
        """Return the present tick in ns."""
        with self._lock:
            return self._base if self._own else self._base + self._host() - self._since

    @property
    def step(self) -> int:
        """How far one reading of the clock is from the next, in ns: for a simulation the time between two lines."""
        return self._step

    @property
    def runs_by_itself(self) -> bool:
        """True if time passes without :meth:`advance`."""
        return not self._own

    def now(self) -> float:
        """Return the seconds since the start."""
        return self.tick() / NANOSECONDS

    def own_clock(self) -> None:
        """Let a simulation drive the clock from now on."""
        with self._lock:
            if not self._own:
                self._base, self._own = self.tick(), True

    def host_clock(self) -> None:
        """Let the clock go on with the host's, from its present value: the simulation is gone."""
        with self._lock:
            if self._own:
                self._since, self._own, self._step = self._host(), False, _HOST_STEP

    def advance(self, seconds: float, change: Callable[[], None]) -> None:
        """Go to ``seconds`` since the start; see ``sources.base.SimulationClock``."""
        target = round(seconds * NANOSECONDS)
        with self.guard(), self._lock:
            step = target - self._base
            if step > 0:
                self._step = min(step, _MOST_STEP)
                self._base = target - 1
        self.due()
        change()
        with self.guard(), self._lock:
            self._base = max(self._base, target)
        self.due()
