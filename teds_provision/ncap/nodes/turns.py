"""One thing at a time with each node: sessions of this process share one address, and a second Open ends the first.

A measurement keeps its nodes for as long as it runs; what else is asked of them meanwhile goes through its session, or
is refused. Commands of other processes are kept apart by the station's own turns, and by their address.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from teds_provision.errors import Frozen, NodeBusy

WAIT = 20.0


class Turns:
    """Who works on which node (UUID in hex)."""

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._holders: dict[str, str] = {}
        self._frozen: set[str] = set()

    def holder(self, uuid: str) -> str | None:
        """What works on a node now, None for nothing."""
        with self._news:
            return self._holders.get(uuid)

    def take(self, uuid: str, what: str, *, wait: float = WAIT, frozen: bool = False) -> None:
        """Begin; raises Frozen (a measurement has it) at once, NodeBusy after ``wait`` seconds."""
        until = time.monotonic() + wait
        with self._news:
            while uuid in self._holders:
                if uuid in self._frozen:
                    raise Frozen(
                        f"Node {uuid} is being measured ({self._holders[uuid]}): it stays as it is.",
                        hint="End that measurement first.",
                    )
                left = until - time.monotonic()
                if left <= 0:
                    raise NodeBusy(
                        f"Node {uuid} is busy: {self._holders[uuid]}.", hint="Try again when that has ended."
                    )
                self._news.wait(left)
            self._holders[uuid] = what
            if frozen:
                self._frozen.add(uuid)

    def give(self, uuid: str) -> None:
        """End."""
        with self._news:
            self._holders.pop(uuid, None)
            self._frozen.discard(uuid)
            self._news.notify_all()

    @contextmanager
    def of(self, uuid: str, what: str, *, wait: float = WAIT) -> Iterator[None]:
        """Work on one node for the length of the block."""
        self.take(uuid, what, wait=wait)
        try:
            yield
        finally:
            self.give(uuid)
