"""How long something takes, on a machine that does other things as well.

A rule about time is held by what a busy machine cannot change: the CPU that the work costs, or the best of some tries.
Whoever waits for something that has to come waits ``PATIENCE``.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")

PATIENCE = 120.0  # seconds; what comes at all comes by then, on any machine
TRIES = 3
"""Tries that need no reason."""


class FailedTryWarning(UserWarning):
    """A try of :func:`best_of` or :func:`succeeds` that failed."""


@contextmanager
def costs_at_most(seconds: float) -> Iterator[None]:
    """Yield what is done under it takes no more of this process's CPU than that; what others take is not counted."""
    began = time.process_time()
    yield
    elapsed = time.process_time() - began
    assert elapsed < seconds, f"{elapsed:.3f} s of CPU"


def best_of(tries: int, limit: float, attempt: Callable[[], float], *, because: str = "") -> None:
    """Try until ``attempt``, which returns the seconds that it took, took less than ``limit``; once if all is quiet.

    Each failed try is a warning of the run. More than three tries must say what a busy machine spoils (``because``).
    """
    _require_reason(tries, because)
    durations: list[float] = []
    while not durations or durations[-1] >= limit:
        assert len(durations) < tries, f"{durations} s, never less than {limit} s"
        durations.append(attempt())
        if durations[-1] >= limit:
            _report_failed_try(len(durations), tries, f"{durations[-1]:.3f} s, not less than {limit} s")


def succeeds(tries: int, attempt: Callable[[], object], *, because: str = "") -> None:
    """Try until ``attempt`` finds nothing wrong (it gives something false), ``tries`` times at most.

    For what a busy machine may spoil, once: a defect spoils it each time. Failed tries and ``because``: as for best_of.
    """
    _require_reason(tries, because)
    wrong: list[object] = []
    while not wrong or wrong[-1]:
        assert len(wrong) < tries, wrong
        wrong.append(attempt())
        if wrong[-1]:
            _report_failed_try(len(wrong), tries, str(wrong[-1]))


def _require_reason(tries: int, because: str) -> None:
    assert because or tries <= TRIES, f"{tries} tries: say what a busy machine spoils (because=)"


def _report_failed_try(number: int, tries: int, why: str) -> None:
    """Warn, so that the summary of the run lists each failed try with its test, even if the next one passed."""
    warnings.warn(f"try {number} of {tries} failed: {why}", FailedTryWarning, stacklevel=3)


def until(found: Callable[[], T], why: object = "", seconds: float = PATIENCE) -> T:
    """Wait until ``found`` gives something true, and return it; ``why`` (or what it gives) is what to say if not."""
    end = time.monotonic() + seconds
    while not (value := found()):
        assert time.monotonic() < end, (why() if callable(why) else why) or f"still {value!r}"
        time.sleep(0.02)
    return value
