"""Streams of several nodes that begin together: by one trigger frame, or by a start time (operation.md sections 4, 5).

*Start time*: every node has exchanged Clock; as soon as all are there (:data:`WAITING` after the first at most) one
moment is chosen, and each gets the corresponding tick of its clock. *Trigger*: streams wait for a frame
(``trigger.py``). A node that comes later begins when it comes.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable

from teds_provision.measure.clock import ClockMap
from teds_provision.protocol.operation.stream_commands import SOON, WAITS

WAITING = 2.0  # seconds that the first node waits for the others
NOTICE_AFTER = 1.0  # seconds until the notice that the trigger waits
TOGETHER = 15.0  # seconds that a trigger waits for all nodes, from the first one that is ready
AHEAD, AHEAD_EACH = 0.25, 0.04  # seconds from the choice of a start time until that time, and more for each node


class CommonStart:
    """The one beginning of a measurement; each node asks :meth:`start` before it subscribes. Thread-safe."""

    def __init__(self, uuids: Iterable[bytes], *, trigger: bool = False, waiting: float = WAITING) -> None:
        self._coming = set(uuids)
        self._alone = len(self._coming) < 2
        self._trigger, self._waiting = trigger, waiting
        self._triggered = self._told = False
        self._at: float | None = None  # the start time in monotonic seconds, once it was chosen
        self._first: float | None = None
        self._turn = threading.Condition()
        self._begun: dict[bytes, tuple[ClockMap, int]] = {}

    def start(self, uuid: bytes, clock: ClockMap) -> int:
        """Return the start for the node's Subscribe; waits for the others. ``SOON`` if there are none to wait for."""
        if self._trigger:
            return SOON if self._triggered else WAITS
        if self._alone:
            return SOON
        with self._turn:
            self._coming.discard(uuid)
            if self._at is None:
                self._first = self._first or time.monotonic()
                left = self._first + self._waiting - time.monotonic()
                self._turn.wait_for(lambda: self._at is not None or not self._coming, max(0.0, left))
            if self._at is None:
                self._at = time.monotonic() + AHEAD + AHEAD_EACH * self._waited
                self._turn.notify_all()
            at = self._at
        if time.monotonic() >= at or uuid in self._begun:
            return SOON
        tick = clock.tick_at(round(at * 1e9))
        self._begun[uuid] = (clock, tick)
        return tick

    @property
    def _waited(self) -> int:
        return len(self._begun) + len(self._coming) + 1

    def drop_node(self, uuid: bytes) -> None:
        """Stop waiting for a node that will not come."""
        with self._turn:
            self._coming.discard(uuid)
            self._turn.notify_all()

    def start_by_itself(self, uuid: bytes) -> None:
        """Let a node begin by itself that reported its start as too late."""
        self._begun.pop(uuid, None)

    def seconds_until(self, start: int) -> float:
        """Return seconds from now to a start; 0 if it is soon, or waits."""
        if start in (SOON, WAITS) or self._at is None:
            return 0.0
        return max(0.0, self._at - time.monotonic())

    @property
    def seconds_left(self) -> float | None:
        """Seconds from now until the first values are taken; None if the trigger has not gone out yet."""
        if self._trigger:
            return 0.0 if self._triggered else None
        return max(0.0, (self._at or 0.0) - time.monotonic())

    @property
    def spread(self) -> float:
        """By how many seconds the beginnings differ, by the clocks as they are known now; 0.0 for one node."""
        moments = [clock.host_of(tick) for clock, tick in self._begun.values()]
        return max(moments) - min(moments) if moments else 0.0

    # -- for the trigger -----------------------------------------------------------------------------------------------

    def due(self, ready: int, all_of: int) -> bool:
        """Return True if the trigger has to go out now: all are ready, or the wait for the rest is over."""
        if not self._trigger or self._triggered:
            return False
        if ready and self._first is None:
            self._first = time.monotonic()
        late = self._first is not None and time.monotonic() - self._first > TOGETHER
        return ready == all_of or late

    def notice_due(self) -> bool:
        """Return True once, when the "waiting for" notice is due."""
        long = self._first is not None and time.monotonic() - self._first > NOTICE_AFTER
        tells = self._trigger and not self._triggered and long and not self._told
        self._told |= tells
        return tells

    def triggered(self) -> None:
        """Record that the trigger goes out: later nodes begin by themselves."""
        self._triggered = True

    def record_start(self, uuid: bytes, clock: ClockMap, tick: int) -> None:
        """Record that the node saw the trigger at this tick of its clock."""
        self._begun[uuid] = (clock, tick)
