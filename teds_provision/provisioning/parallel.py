"""Work on several boards at once that Ctrl-C ends, however the threads are doing.

``concurrent.futures`` does not survive a KeyboardInterrupt at every point: in ``submit`` or ``as_completed`` it leaves
locks behind which its threads then wait for, and the interpreter waits for the threads. Here the main thread waits for
one queue only, and nothing waits for a thread without a limit.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Generic, TypeVar

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Finished(Generic[T, R]):
    """An item and what came of it: the result, or the exception that ended the work."""

    item: T
    value: R | None
    error: Exception | None

    def result(self) -> R:
        """Return the result; raises the exception that ended the work."""
        if self.error is not None:
            raise self.error
        return self.value  # type: ignore[return-value]  # R may itself include None


class ParallelWork(Generic[T, R]):
    """``work`` on each item, at most ``at_once`` at a time, each in a thread; the first items begin at once.

    The threads are daemons: one that still waits for a mute node does not keep the process.
    """

    def __init__(self, items: Sequence[T], work: Callable[[T], R], *, at_once: int, name: str) -> None:
        self._work = work
        self._waiting: SimpleQueue[T] = SimpleQueue()
        self._finished: SimpleQueue[Finished[T, R]] = SimpleQueue()
        self._left = len(items)
        for item in items:
            self._waiting.put(item)
        self._threads = [
            threading.Thread(target=self._run, name=f"{name} {number}", daemon=True)
            for number in range(max(1, min(at_once, len(items))))
        ]

    def results(self) -> Iterator[Finished[T, R]]:
        """Yield each item as its work ends, in that order; the work begins with the first call."""
        for thread in self._threads:
            thread.start()
        while self._left:
            finished = self._finished.get()
            self._left -= 1
            yield finished

    def drop_waiting(self) -> None:
        """Begin no further item; those that were begun are finished."""
        while True:
            try:
                self._waiting.get_nowait()
            except Empty:
                return
            self._left -= 1

    def wait(self, seconds: float) -> None:
        """Wait until the work that was begun has ended, for ``seconds`` at most."""
        until = time.monotonic() + seconds
        for thread in self._threads:
            if thread.ident is not None:
                thread.join(max(0.0, until - time.monotonic()))

    def _run(self) -> None:
        while True:
            try:
                item = self._waiting.get_nowait()
            except Empty:
                return
            try:
                finished = Finished[T, R](item, self._work(item), None)
            except Exception as error:  # noqa: BLE001 - raised by whoever reads the result
                finished = Finished(item, None, error)
            self._finished.put(finished)
