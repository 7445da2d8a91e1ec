"""The interface of a node towards its link servers (NFC tag, CAN)."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from queue import SimpleQueue
from typing import Final, Protocol


class NodeHandler(Protocol):
    """The node as its links see it. Thread-safe: each link server runs in its own threads."""

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        """Run one whole command frame that arrived on ``link``; always returns a whole reply frame.

        ``link`` names the line (``"nfc"``, ``"can:f1"``): sessions and half-open Opens belong to it.
        ``tapped`` is true when the frame itself arrived over NFC. It may take long (``--crypto-delay``).
        """

    def lost(self, link: str) -> None:
        """End session, half-open Open and pending agreement: the field or link is gone."""

    def identify(self) -> bytes:
        """Return the 23 octets of Identify as they are now (renewed into the NFC id record)."""

    def can_address(self) -> int:
        """Return the node's present CAN address, 1 to 239."""

    def take_can_address(self, address: int) -> None:
        """Have another CAN address until the restart: another node claimed this one (profile.md, "CAN")."""

    def actuator_claimed(self) -> bool:
        """Return True if a session claims an actuator, so that the node keeps its CAN address."""


class MeasuringHandler(Protocol):
    """Events that a bus passes to a measuring node, beside its commands (operation.md, sections 3 to 6).

    Thread-safe.
    """

    def tick(self, at: float = 0.0) -> int:
        """Return the tick of the node's clock, ns: the present one, or that of ``at`` (time.monotonic) a moment ago."""

    def request_received(
        self,
        link: str,
        frame: bytes,
        *,
        tapped: bool,
        received: int,
        fd: bool = False,
        mtu: int = 23,
        hears: bool = True,
    ) -> bytes:
        """As NodeHandler.request, for a frame whose last part came by CAN FD or not, at the tick ``received``.

        ``mtu`` and ``hears`` are those of a BLE connection; see SessionPort.
        """

    def reply_left(self, link: str) -> None:
        """Let data follow: the last reply on this link has left (or will not any more)."""

    def trigger(self, link: str, token: bytes, tick: int) -> None:
        """Handle a trigger frame of this link's station that ended at ``tick``."""

    def drive(self, link: str, data: bytes) -> None:
        """Handle a Drive frame of this link's station."""


class BleHandler(NodeHandler, MeasuringHandler, Protocol):
    """What a node's BLE needs in addition (profile.md, "BLE")."""

    def in_factory_state(self) -> bool:
        """Return True if the node holds no key."""

    def in_session(self, link: str) -> bool:
        """Return True if a session is open on this link."""

    def unheard(self, link: str) -> None:
        """End the streams of this link: the station has disabled data messages on it."""


# A bounded crew of threads for all nodes of a process; what comes by one line is done one after another.
#
# Two hundred nodes on one bus in one process must not be two hundred threads.

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
        self._free = 0  # threads without a job, less the jobs that wait for one
        self._ended = False

    def turns(self) -> JobQueue:
        """Return a new queue whose jobs are run one after another."""
        return JobQueue(self.run)

    def run(self, job: Job) -> None:
        """Have a thread run ``job`` as soon as one is free; nothing happens once the crew has ended."""
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
    """Jobs of one line in the order in which they came. Thread-safe."""

    def __init__(self, run: Callable[[Job], None]) -> None:
        self._run_soon = run
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
            self._run_soon(self._run)  # a turn each, so that no line keeps a thread
