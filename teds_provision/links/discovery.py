"""Finds nodes on a link for all waiting threads, in one thread.

Fifty threads that search for fifty nodes would each send broadcasts; instead, one discovery does it for all. It sends
one at its start, when a node is missing (at once, again, then after 1 s, doubling to 30 s), and every ``poll`` seconds
if requested (operation.md section 7). Its results are hints: a session proves identity.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import ClassVar, Final, Protocol

from teds_provision.errors import AddressConflictError, LinkError, NoNodeError
from teds_provision.links.ports import Contact, Notice, Port
from teds_provision.protocol.announce import Announce
from teds_provision.protocol.messages.identity import Identity

LEAST: Final = 1.0
MOST: Final = 30.0
"""Seconds between questions while a node is missing: they double from the first to the second."""
LOOK: Final = 0.05
"""Seconds between checks for waiting threads."""
ROUND: Final = 20.0
"""Seconds that one round of a :class:`PolledDiscovery` may take, with a connection to each node."""


class ContactLink(Port, Protocol):
    """A port whose nodes can be talked to once they were seen."""

    def contact(self, node: int, identity: Identity) -> Contact:
        """Return a contact with the node under this number."""


@dataclass(frozen=True)
class Sighting:
    """A node that answered: its place, its Identify, and when (time.monotonic). All of it is unproven.

    ``address`` is its number on the link: its CAN address, over the air the number of its connection.
    """

    identity: Identity
    address: int
    port: ContactLink
    at: float

    @property
    def uuid(self) -> bytes:
        """10 octets."""
        return self.identity.uuid

    def contact(self) -> Contact:
        """Return a link to the node that was seen."""
        return self.port.contact(self.address, self.identity)


class SightingSink(Protocol):
    """Receiver of what the discoveries find. Thread-safe."""

    gone: int
    """How often a node that had been seen, or was never looked for, became missing."""

    def add_sighting(self, sighting: Sighting) -> None:
        """Add a node that was seen, or what is new about one that is known."""

    def conflict(self, place: str, address: int, error: AddressConflictError) -> None:
        """Record that two nodes answer under one address: nothing is opened there."""

    def report(self, text: str) -> None:
        """Report something about addresses to people, once in a while."""

    def announced(self, place: str, announce: Announce) -> None:
        """Take an Announce; a hint that any device can send."""

    def is_awaited(self, announce: Announce) -> bool:
        """Return True if a thread waits for the node that this claims to be."""

    def is_welcome(self, announce: Announce) -> bool:
        """Return True if the node that this claims to be is measured as soon as it comes."""

    def missing(self) -> bool:
        """Return True if a thread waits for a node."""


class BroadcastPace:
    """Decides when to broadcast again: ``asked`` is when that was last done.

    While a node is missing that is after ``first`` seconds, then after LEAST, doubling to MOST. ``first`` is short on a
    bus, because a request or its answer may have been lost.
    """

    def __init__(self, asked: float, *, first: float = LEAST) -> None:
        self.asked = asked
        self._first = self._pause = first

    def is_due(self, *, wanted: bool, missing: bool, poll: float | None) -> bool:
        """Return True if a broadcast is due: requested, for a missing node, or by polling."""
        since = time.monotonic() - self.asked
        if wanted or not missing:
            self._pause = self._first
        if wanted:
            return True
        if (missing and since >= self._pause) or (poll and since >= poll):
            self._pause = min(max(LEAST, 2 * self._pause), MOST)
            return True
        return False


class Discovery:
    """A thread until :meth:`close`. ``failure`` is why the last question failed, None if it did not."""

    LONGEST: ClassVar[float]  # seconds that one round of questions may take

    def __init__(self, place: str, sightings: SightingSink, poll: float | None) -> None:
        self._presence, self._poll = sightings, poll
        self._stop, self._asked = threading.Event(), threading.Event()
        self._begun = self._finished = 0  # counts of rounds
        self._turn = threading.Condition()
        self.failure: LinkError | None = None
        self._thread = threading.Thread(target=self._run, name=f"look-out {place}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._asked.set()
        self._thread.join(self.LONGEST)

    def poll(self, seconds: float | None) -> None:
        """Send a broadcast every so many seconds from now on; None: only while a node is missing."""
        self._poll = seconds

    def discover(self, seconds: float | None = None) -> None:
        """Send a broadcast now, and wait until that is done; raises LinkError if the link has failed."""
        with self._turn:
            wanted = self._begun + 1  # the present round may already have passed the new node
            self._asked.set()
            longest = self.LONGEST if seconds is None else seconds
            self._turn.wait_for(lambda: self._finished >= wanted or self._stop.is_set(), longest)
        if self.failure is not None:
            raise self.failure

    def identify_at(self, address: int, seconds: float) -> None:
        """Ask one address now, on the caller's thread; an answer is reported as any other. Raises LinkError.

        Does nothing on a link that needs a connection for each question.
        """

    def _run(self) -> None:
        """Run the thread, with :meth:`_round_begins` and :meth:`_round_ends` around each round."""
        raise NotImplementedError

    def _round_begins(self) -> None:
        with self._turn:
            self._asked.clear()
            self._begun += 1

    def _round_ends(self) -> None:
        with self._turn:
            self._finished = self._begun
            self._turn.notify_all()


class PolledDiscovery(Discovery):
    """The discovery of a link on which nodes do not announce themselves, a thread until :meth:`close`.

    It searches only while a node is missing, or on request. Every node found gets an Identify, one after the other.
    """

    LONGEST = ROUND

    def __init__(self, port: ContactLink, sightings: SightingSink, *, poll: float | None = None) -> None:
        self._port = port
        super().__init__(port.place, sightings, poll)

    def _run(self) -> None:
        pace = BroadcastPace(0.0)
        while not self._stop.is_set():
            wanted = self._asked.is_set()
            if not pace.is_due(wanted=wanted, missing=self._presence.missing(), poll=self._poll):
                self._asked.wait(LOOK)
                continue
            self._look()
            pace.asked = time.monotonic()

    def _look(self) -> None:
        self._round_begins()
        self.failure = None
        try:
            for contact in self._port.find_all(seconds=2 * LEAST, notice=_ignore):
                sighting = Sighting(contact.identity, contact.line, self._port, time.monotonic())
                self._presence.add_sighting(sighting)
        except NoNodeError:
            pass
        except LinkError as failure:
            self.failure = failure
        self._round_ends()


def _ignore(_notice: Notice) -> None:
    """Ignore notices: discovery reports sightings."""
