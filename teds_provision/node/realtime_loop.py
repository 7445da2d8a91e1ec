"""The real-time loop of all nodes of a process: it calls each one when it wants to be called.

One thread and a heap of times, so that two hundred nodes that rest cost nothing.
"""

from __future__ import annotations

import heapq
import itertools
import logging
import threading
import time
from typing import Protocol

from teds_provision.errors import LinkError
from teds_provision.links.can.pacing import sharp_timers


class RealtimeNode(Protocol):
    """A node that wants to be called at its times."""

    def beat(self) -> float | None:
        """Do what is due; seconds until the next call, None: not before :meth:`RealtimeLoop.wake`."""


class RealtimeLoop:
    """Calls ``beat`` of nodes; :meth:`wake` is thread-safe and quick."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._heap: list[tuple[float, int, RealtimeNode]] = []
        self._due: dict[RealtimeNode, int] = {}
        self._number = itertools.count()
        self._stopped = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the loop in its thread."""
        self._thread = threading.Thread(target=self._run, name="pulse", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End, after the beat that runs; never raises."""
        with self._condition:
            self._stopped = True
            self._condition.notify()
        if self._thread is not None:
            self._thread.join(timeout=3)

    def wake(self, node: RealtimeNode) -> None:
        """Call a node as soon as possible."""
        self._at(time.monotonic(), node)

    def _at(self, due: float, node: RealtimeNode) -> None:
        with self._condition:
            number = self._due[node] = next(self._number)
            heapq.heappush(self._heap, (due, number, node))
            self._condition.notify()

    def _run(self) -> None:
        sharp_timers()
        while (node := self._next()) is not None:
            try:
                wait = node.beat()
            except LinkError:
                wait = None  # the reading thread of that bus gets the same failure and ends its sessions
            except Exception:
                logging.getLogger(__name__).exception("A node's measuring failed.")
                wait = None
            with self._condition:
                woken = node in self._due
            if wait is not None and not woken:
                self._at(time.monotonic() + wait, node)

    def _next(self) -> RealtimeNode | None:
        """Wait for the next node that is due; None at the end."""
        with self._condition:
            while not self._stopped:
                while self._heap and self._due.get(self._heap[0][2]) != self._heap[0][1]:
                    heapq.heappop(self._heap)  # an old entry: the node was woken or called meanwhile
                wait = self._heap[0][0] - time.monotonic() if self._heap else None
                if wait is not None and wait <= 0:
                    node = heapq.heappop(self._heap)[2]
                    del self._due[node]
                    return node
                self._condition.wait(wait)
        return None
