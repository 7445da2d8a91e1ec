"""Node after node: the same work for each that comes, until someone says stop; one that fails does not end it."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from teds_provision.errors import TedsProvisionError
from teds_provision.links import LinkSettings, Port, open_ports
from teds_provision.store import utc_now
from teds_provision.talk.conversation import Conversation, SessionLost
from teds_provision.talk.progress import Reporter

Result = TypeVar("Result")
_LOOK_SECONDS = 0.2
_END_SECONDS = 5.0


@dataclass(frozen=True)
class Came(Generic[Result]):
    """One node that came: the result of the work, or the error that ended it; where it came, seconds it took."""

    uuid: bytes
    place: str
    seconds: float
    result: Result | None = None
    error: TedsProvisionError | None = None
    time: str = field(default_factory=utc_now)


class Patience(threading.Event):
    """A stop sign that shows by itself when nothing happened for ``seconds``; None waits for ever."""

    def __init__(self, seconds: float | None) -> None:
        super().__init__()
        self._seconds, self._asked = seconds, False
        self.renew()

    def ask(self) -> None:
        """Say stop from a signal handler: takes no lock, which the interrupted thread may hold; seen within 0.2 s."""
        self._asked = True

    def renew(self) -> None:
        """Something happened: wait the whole time again."""
        self._until = None if self._seconds is None else time.monotonic() + self._seconds

    @property
    def ran_out(self) -> bool:
        """Whether the time is over, and not somebody said stop."""
        return self._is_over() and not self._asked and not super().is_set()

    def _is_over(self) -> bool:
        return self._until is not None and time.monotonic() >= self._until

    def is_set(self) -> bool:
        """Whether somebody said stop, or the time is over."""
        return self._asked or super().is_set() or self._is_over()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for either."""
        end = None if timeout is None else time.monotonic() + timeout
        while not self.is_set():
            left = _LOOK_SECONDS if end is None else min(_LOOK_SECONDS, end - time.monotonic())
            if left <= 0:
                return False
            super().wait(left)
        return True


def watch_nodes(
    links: LinkSettings, work: Callable[[Conversation], Result], reporter: Reporter, stop: threading.Event
) -> Iterator[Came[Result]]:
    """Do ``work`` with every node that comes on the chosen links; yields how each of them ended.

    Debounced (one visit, one result); goes on when a reader is unplugged and plugged in again. Several readers serve
    several taps at once, each in a thread of its own. Raises NoReader only where one cannot be opened at the start.
    """
    ports = open_ports(links)
    try:
        if len(ports) == 1:
            yield from _watch(ports[0], work, reporter, stop)
        else:
            yield from _together(ports, work, reporter, stop)
    finally:
        for port in ports:
            port.close()


def _watch(
    port: Port, work: Callable[[Conversation], Result], reporter: Reporter, stop: threading.Event
) -> Iterator[Came[Result]]:
    for contact in port.watch(stop=stop, notice=reporter.notice):
        began, uuid = time.monotonic(), contact.identity.uuid
        result: Result | None = None
        error: TedsProvisionError | None = None
        try:
            with Conversation(contact, notice=reporter.notice) as node:
                result = work(node)
        except TedsProvisionError as failure:
            error = failure
        except SessionLost as lost:
            error = lost.cause
        yield Came(uuid, port.place, time.monotonic() - began, result, error)


def _together(
    ports: list[Port], work: Callable[[Conversation], Result], reporter: Reporter, stop: threading.Event
) -> Iterator[Came[Result]]:
    came: queue.Queue[Came[Result] | BaseException] = queue.Queue()

    def serve(port: Port) -> None:
        try:
            for one in _watch(port, work, reporter, stop):
                came.put(one)
        except BaseException as error:  # noqa: BLE001 - told by the thread that gives the results
            came.put(error)

    threads = [threading.Thread(target=serve, args=(port,), name=port.place, daemon=True) for port in ports]
    for thread in threads:
        thread.start()
    try:
        while any(thread.is_alive() for thread in threads) or not came.empty():
            with suppress(queue.Empty):
                one = came.get(timeout=_LOOK_SECONDS)
                if isinstance(one, BaseException):
                    raise one
                yield one
    finally:
        stop.set()
        for thread in threads:
            thread.join(_END_SECONDS)
