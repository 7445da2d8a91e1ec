"""What the look-outs on a bus and in the air have in common: a thread that asks everybody, and when it asks again."""

from __future__ import annotations

import threading
import time
from typing import ClassVar

from teds_provision.errors import LinkFailure
from teds_provision.measure.finding.sightings import Sightings

LEAST, MOST = 1.0, 30.0  # seconds between questions while somebody is missing


class Pace:
    """When everybody is asked again: ``asked`` is when they were last.

    While somebody is missing that is after ``first`` seconds, then after LEAST, doubling to MOST. ``first`` is short on
    a bus, where a question, or its answer, may have been lost.
    """

    def __init__(self, asked: float, *, first: float = LEAST) -> None:
        self.asked = asked
        self._first = self._pause = first

    def is_due(self, *, wanted: bool, missing: bool, poll: float | None) -> bool:
        """Whether to ask now: somebody wants it, is missing, or polls."""
        since = time.monotonic() - self.asked
        if wanted or not missing:
            self._pause = self._first
        if wanted:
            return True
        if (missing and since >= self._pause) or (poll and since >= poll):
            self._pause = min(max(LEAST, 2 * self._pause), MOST)
            return True
        return False


class Asking:
    """A thread until :meth:`close`. ``failure`` is why the link could not be asked last, None where it could."""

    LONGEST: ClassVar[float]  # seconds that one round of questions may take

    def __init__(self, place: str, sightings: Sightings, poll: float | None) -> None:
        self._sightings, self._poll = sightings, poll
        self._stop, self._asked = threading.Event(), threading.Event()
        self._begun = self._finished = 0  # rounds of questions
        self._turn = threading.Condition()
        self.failure: LinkFailure | None = None
        self._thread = threading.Thread(target=self._run, name=f"look-out {place}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._asked.set()
        self._thread.join(self.LONGEST)

    def poll(self, seconds: float | None) -> None:
        """Ask everybody every so many seconds from now on; None: only while somebody is missing."""
        self._poll = seconds

    def discover(self, seconds: float | None = None) -> None:
        """Ask everybody now, and wait until that is done; raises LinkFailure where the link has failed."""
        with self._turn:
            wanted = self._begun + 1  # a round that is under way may be past the node that has just come
            self._asked.set()
            longest = self.LONGEST if seconds is None else seconds
            self._turn.wait_for(lambda: self._finished >= wanted or self._stop.is_set(), longest)
        if self.failure is not None:
            raise self.failure

    def _run(self) -> None:
        """The thread; it calls :meth:`_begin` and :meth:`_done` around each round."""
        raise NotImplementedError

    def _begin(self) -> None:
        with self._turn:
            self._asked.clear()
            self._begun += 1

    def _done(self) -> None:
        with self._turn:
            self._finished = self._begun
            self._turn.notify_all()
