"""Work with one node on behalf of a request: at its present place, or at its next tap.

The thread of the request meets a node on a bus. For one that comes by NFC the thread of its reader does the work, while
the node is on it; the request waits for that, and reports until when.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar, cast

from teds_provision.errors import FrozenError, InternalError, NodeBusyError, NoNodeError, StoreError, TedsProvisionError
from teds_provision.links import Port
from teds_provision.links.ports import Contact, Notice
from teds_provision.ncap.nodes.directory import NodeDirectory
from teds_provision.provisioning.conversation import Conversation, SessionLostError

# One job at a time with each node: the sessions of this process share one address, and a second Open ends the first. A
# measurement holds the locks of its nodes while it runs; other requests for them go through its session or are refused.
# Against commands of other processes there are the station's node locks and the source addresses.

WAIT = 20.0


class NodeLocks:
    """The user of each node (UUID in hex).

    ``given`` is called with each that is free after other work than measuring.
    """

    def __init__(self) -> None:
        self.given: Callable[[str], None] = lambda _uuid: None
        self._news = threading.Condition()
        self._holders: dict[str, str] = {}
        self._frozen: set[str] = set()

    def holder(self, uuid: str) -> str | None:
        """Return what works on a node now, None if nothing does."""
        with self._news:
            return self._holders.get(uuid)

    def acquire(self, uuid: str, what: str, *, wait: float = WAIT, frozen: bool = False) -> None:
        """Begin; raises FrozenError (a measurement has it) at once, NodeBusyError after ``wait`` seconds."""
        until = time.monotonic() + wait
        with self._news:
            while uuid in self._holders:
                if uuid in self._frozen:
                    raise FrozenError(
                        f"Node {uuid} is being measured ({self._holders[uuid]}) and cannot be changed now.",
                        hint="End the measurement first.",
                    )
                left = until - time.monotonic()
                if left <= 0:
                    raise NodeBusyError(
                        f"Node {uuid} is busy: {self._holders[uuid]}.", hint="Try again when that is done."
                    )
                self._news.wait(left)
            self._holders[uuid] = what
            if frozen:
                self._frozen.add(uuid)

    def release(self, uuid: str) -> None:
        """Release the node for other jobs."""
        with self._news:
            self._holders.pop(uuid, None)
            measured = uuid in self._frozen
            self._frozen.discard(uuid)
            self._news.notify_all()
        if not measured:
            self.given(uuid)

    @contextmanager
    def hold(self, uuid: str, what: str, *, wait: float = WAIT) -> Iterator[None]:
        """Hold one node for work for the length of the block."""
        self.acquire(uuid, what, wait=wait)
        try:
            yield
        finally:
            self.release(uuid)


Result = TypeVar("Result")
FOR_A_TAP: Final = 45.0  # seconds for which a request waits for a tap
ON_A_BUS: Final = 10.0


def as_program_error(error: Exception) -> TedsProvisionError:
    """Return the program's error for a foreign exception of a thread: the disk's, or a bug."""
    if isinstance(error, OSError):
        return StoreError(f"The system refused: {error.strerror or type(error).__name__}.", hint="See the log.")
    return InternalError(f"Unexpected {type(error).__name__}.", hint="This is a bug: see the daemon's log.")


PortOf = Callable[[str], Port | None]


@dataclass
class NodeJob(Generic[Result]):
    """Something to do with a node (None: whichever is tapped next), once. ``done`` is set when it was, or failed."""

    uuid: str | None
    what: str
    work: Callable[[Conversation], Result]
    until: float
    done: threading.Event = field(default_factory=threading.Event)
    result: Result | None = None
    error: TedsProvisionError | None = None

    def run(self, node: Conversation) -> None:
        """Run the job; errors are stored for the waiting thread."""
        try:
            self.result = self.work(node)
        except SessionLostError as lost:
            self.error = lost.cause
        except TedsProvisionError as error:
            self.error = error
        except Exception as error:
            self.error = as_program_error(error)  # otherwise the waiting thread would assume success
            raise
        finally:
            self.done.set()


class NodeJobs:
    """Errands, and the nodes that come. ``port_of`` gives the open port of a place."""

    def __init__(self, roster: NodeDirectory, turns: NodeLocks, port_of: PortOf) -> None:
        self._directory, self._node_locks, self._port_of = roster, turns, port_of
        self._waiting: list[NodeJob[Any]] = []
        self._guard = threading.Lock()

    def with_node(
        self, uuid: str, what: str, work: Callable[[Conversation], Result], *, wait: float = FOR_A_TAP
    ) -> Result:
        """Do ``work`` with a node: at once on a bus, else at its next tap within ``wait`` seconds.

        Raises FrozenError (it is measured), NodeBusyError, NoNodeError, and what the work raises.
        """
        port = self.bus_of(uuid)
        if port is not None:
            with self._node_locks.hold(uuid, what), Conversation(self._find(port, uuid), notice=_quiet) as node:
                try:
                    return work(node)
                except SessionLostError as lost:
                    raise lost.cause from lost
        errand = self.wait_for(uuid, what, work, wait)
        if not errand.done.wait(wait):
            if self.cancel(errand):
                raise NoNodeError(
                    f"Node {uuid} is on no bus of this station and was not placed on a reader within {wait:.0f} s.",
                    hint="Place it on the reader, or connect it to the bus.",
                )
            errand.done.wait()  # the tap came in time, and a job in progress is not cancelled
        if errand.error is not None:
            raise errand.error
        return cast("Result", errand.result)

    def contact(self, uuid: str) -> Contact | None:
        """Return a node that is on a bus now; None if it is not."""
        port = self.bus_of(uuid)
        return None if port is None else self._find(port, uuid)

    def on_a_bus(self, uuid: str) -> bool:
        """Return True if a node is on a bus of this station now."""
        return self.bus_of(uuid) is not None

    def bus_of(self, uuid: str) -> Port | None:
        """Return the open port of the bus on which a node is now; None if it is on none."""
        seen = self._directory.seen(uuid)
        port = self._port_of(seen.place) if seen.present and seen.place else None
        return port if port is not None and port.capabilities.many else None

    def _find(self, port: Port, uuid: str) -> Contact:
        wanted = bytes.fromhex(uuid)
        address = self._directory.seen(uuid).address
        return port.find(lambda identity: identity.uuid == wanted, seconds=ON_A_BUS, notice=_quiet, address=address)

    # -- taps --------------------------------------------------------------------------------------------------------

    def wait_for(
        self, uuid: str | None, what: str, work: Callable[[Conversation], Result], seconds: float
    ) -> NodeJob[Result]:
        """Do ``work`` when the node is tapped; returns at once."""
        errand = NodeJob(uuid, what, work, time.monotonic() + seconds)
        with self._guard:
            self._waiting.append(errand)
        return errand

    def cancel(self, errand: NodeJob[Any]) -> bool:
        """Stop waiting; False if it runs already."""
        with self._guard:
            if errand not in self._waiting:
                return False
            self._waiting.remove(errand)
        return True

    def serve(self, node: Conversation) -> bool:
        """Run what waits for this node, which is on a reader; False if nothing does."""
        if not node.tapped:
            return False
        uuid, now = node.uuid.hex(), time.monotonic()
        with self._guard:  # an expired job is left to its waiting thread, which cancels it
            found = next((job for job in self._waiting if job.uuid in (uuid, None) and job.until > now), None)
            if found is not None:
                self._waiting.remove(found)
        if found is None:
            return False
        found.run(node)
        return True


def _quiet(_notice: Notice) -> None:
    """Ignore notices: requests have their answer."""
