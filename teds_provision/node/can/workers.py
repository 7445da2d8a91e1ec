"""A bounded crew of threads for all nodes of a process; what comes by one line is done one after another.

Two hundred nodes on one bus in one process must not be two hundred threads.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Final

MOST_THREADS: Final = 48
"""A node on a slow chip sleeps in its thread, so more threads than cores are of use."""

Job = Callable[[], None]


class Crew:
    """At most ``most`` threads, made as they are needed."""

    def __init__(self, most: int = MOST_THREADS) -> None:
        self._pool = ThreadPoolExecutor(most, thread_name_prefix="node")

    def turns(self) -> Turns:
        """Return a new queue whose jobs are run one after another."""
        return Turns(self._pool)

    def end(self) -> None:
        """Let the jobs that run finish, drop those that wait."""
        self._pool.shutdown(wait=True, cancel_futures=True)


class Turns:
    """Jobs of one line in the order in which they came. Thread-safe."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self._pool = pool
        self._lock = threading.Lock()
        self._jobs: deque[Job] = deque()
        self._busy = False

    def put(self, job: Job) -> None:
        """Run ``job`` after those that wait; nothing happens once the crew has ended."""
        with self._lock:
            self._jobs.append(job)
            if self._busy:
                return
            self._busy = True
        self._next()

    def _next(self) -> None:
        try:
            self._pool.submit(self._run)
        except RuntimeError:  # the crew has ended
            return

    def _run(self) -> None:
        with self._lock:
            job = self._jobs.popleft()
        try:
            job()
        except Exception:
            logging.getLogger(__name__).exception("A node's command failed.")
        with self._lock:
            self._busy = bool(self._jobs)
            more = self._busy
        if more:
            self._next()  # a turn each, so that no line keeps a thread
