"""A bounded pool of threads for all nodes of a process; the jobs of one link are run one after another.

Two hundred nodes on one bus in one process must not be two hundred threads.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from queue import SimpleQueue
from typing import Final

MOST_THREADS: Final = 48
"""A node on a slow chip sleeps in its thread, so more threads than cores are of use."""

Job = Callable[[], None]


class WorkerPool:
    """At most ``most`` threads, made as they are needed.

    Not concurrent.futures: no caller waits for the end of a request, and the cost of a Future would be added between
    each request and its reply.
    """

    def __init__(self, most: int = MOST_THREADS) -> None:
        self._most = most
        self._lock = threading.Lock()
        self._work: SimpleQueue[Job | None] = SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._free = 0  # idle threads minus queued jobs
        self._ended = False

    def new_queue(self) -> JobQueue:
        """Return a new queue whose jobs are run one after another."""
        return JobQueue(self.run)

    def run(self, job: Job) -> None:
        """Have a thread run ``job`` as soon as one is free; nothing happens after :meth:`end`."""
        with self._lock:
            if self._ended:
                return
            if self._free <= 0 and len(self._threads) < self._most:
                thread = threading.Thread(target=self._serve, name=f"node {len(self._threads)}", daemon=True)
                self._threads.append(thread)
                thread.start()
            else:
                self._free -= 1
            self._work.put(job)

    def end(self) -> None:
        """Let the jobs that run finish, drop those that wait."""
        with self._lock:
            self._ended = True
            threads, self._threads = self._threads, []
            while not self._work.empty():
                self._work.get()
            for _ in threads:
                self._work.put(None)
        for thread in threads:
            if thread is not threading.current_thread():
                thread.join()

    def _serve(self) -> None:
        while (job := self._work.get()) is not None:
            try:
                job()
            except Exception:
                logging.getLogger(__name__).exception("A node's command failed.")
            with self._lock:
                self._free += 1


class JobQueue:
    """Jobs of one link in the order in which they came. Thread-safe."""

    def __init__(self, run: Callable[[Job], None]) -> None:
        self._run_soon = run
        self._lock = threading.Lock()
        self._jobs: deque[Job] = deque()
        self._busy = False

    def put(self, job: Job) -> None:
        """Run ``job`` after those that wait; nothing happens after the pool has ended."""
        with self._lock:
            self._jobs.append(job)
            if self._busy:
                return
            self._busy = True
        self._run_soon(self._run)

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
            self._run_soon(self._run)  # one job at a time, so that no link occupies a thread for long
