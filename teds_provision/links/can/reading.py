"""Who reads a bus: a loop of its own, or the thread that waits for a reply and so need not be woken by another.

A reply that one thread reads and another one wants costs two wakings and a turn at the interpreter's lock, with every
flow control again. So the thread that waits reads by itself where it is the only one that waits. Where several do,
and when nobody has waited for a moment, the loop reads.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Final, TypeVar

from teds_provision.errors import LinkFailure
from teds_provision.links.can.bus import Bus
from teds_provision.links.can.frame import Frame

_ALIVE_SECONDS: Final = 0.25
_SHORT_SLICE: Final = 0.02
"""How long one receive waits on an interface that cannot be woken."""
_LINGER_SECONDS: Final = 0.005
"""How long after a reply the loop leaves the bus to the thread that got it: most ask on at once."""
_NAP_SECONDS: Final = 0.002

Thing = TypeVar("Thing")


class Reading:
    """Reads ``bus`` until :meth:`stop`; each frame goes to ``take``, the end of the bus to ``failed``.

    ``take`` runs in one thread at a time. ``woken`` can be read once the bus is to be closed.
    """

    def __init__(
        self, bus: Bus, take: Callable[[Frame], None], failed: Callable[[LinkFailure], None], woken: socket.socket
    ) -> None:
        self._bus, self._take, self._failed, self._woken = bus, take, failed, woken
        self._turn = threading.Lock()
        self._counting = threading.Lock()
        self._leaning = 0
        self._helped_until = 0.0
        self._over = False

    def run(self) -> None:
        """The loop; returns after :meth:`stop`, or when the bus has failed."""
        while not self._over:
            if not self._bus.can_be_waited_for:
                self._read(_SHORT_SLICE)
            elif self._is_helped():
                time.sleep(_NAP_SECONDS)
            else:
                self._bus.wait(_ALIVE_SECONDS, self._woken)
                self._read_all()

    def stop(self) -> None:
        """Let nobody read any more; returns when nobody does."""
        self._over = True
        if self._turn.acquire(timeout=2):
            self._turn.release()

    def wait_for(self, queue: SimpleQueue[Thing], seconds: float) -> Thing:
        """The next of a queue that ``take`` or ``failed`` fills; raises Empty after ``seconds``."""
        until = time.monotonic() + seconds
        while True:
            with suppress(Empty):
                return queue.get_nowait()
            left = until - time.monotonic()
            if left <= 0:
                raise Empty
            if self._over or self._leaning or not self._bus.can_be_waited_for or not self._turn.acquire(blocking=False):
                return self._lean(queue, left)
            try:
                self._read_or_wait(min(left, _ALIVE_SECONDS))
            finally:
                self._helped_until = time.monotonic() + _LINGER_SECONDS
                self._turn.release()

    def _lean(self, queue: SimpleQueue[Thing], seconds: float) -> Thing:
        """Have another thread read: the loop, or the one that reads already."""
        with self._counting:
            self._leaning += 1
        try:
            return queue.get(timeout=seconds)
        finally:
            with self._counting:
                self._leaning -= 1

    def _is_helped(self) -> bool:
        return self._turn.locked() or (not self._leaning and time.monotonic() < self._helped_until)

    def _read_or_wait(self, seconds: float) -> None:
        """A frame where there is one, else the wait for it."""
        if not self._read(0.0) and not self._over:
            self._bus.wait(seconds, self._woken)

    def _read_all(self) -> None:
        """The loop's turn: every frame that is there, unless another thread has come to read them."""
        while not self._is_helped() and self._turn.acquire(blocking=False):
            try:
                if not self._read(0.0):
                    return
            finally:
                self._turn.release()

    def _read(self, seconds: float) -> bool:
        """Whether there was a frame."""
        try:
            frame = self._bus.receive(seconds)
        except LinkFailure as failure:
            self._over = True
            self._failed(failure)
            return False
        if frame is None:
            return False
        self._take(frame)
        return True
