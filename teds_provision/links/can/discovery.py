"""Finds nodes on a CAN bus for all waiting threads: by Announces, and by broadcasts (functional Identify).

If a missing node announces itself, the next broadcast is sent sooner. With ``poll`` the discovery also sends an
Identify to each address that announces itself, at most once in 10 s each and five a second in all (operation.md
section 7).
"""

from __future__ import annotations

import math
import time
from collections import deque
from typing import Final, Protocol

from teds_provision.errors import AddressConflictError, LinkError
from teds_provision.links.can.bus_multiplexer import BusMultiplexer
from teds_provision.links.can.identify_broadcast import (
    LONGEST_SECONDS,
    SILENCE_SECONDS,
    FunctionalAnswers,
    ask_all,
    twice_text,
)
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.link import conflict
from teds_provision.links.can.spec import CanSpec
from teds_provision.links.discovery import LEAST, LOOK, BroadcastPace, ContactLink, Discovery, Sighting, SightingSink
from teds_provision.protocol.announce import LAST_ADDRESS, Announce, is_announce
from teds_provision.protocol.messages.identity import Identity

EACH: Final = 10.0
ALL: Final = 0.2
"""Seconds between questions to one address that announces itself, and to any of them."""
PATIENCE: Final = 0.5
"""Seconds for the answer of one that has just announced itself."""
SOON: Final = 0.05
"""Seconds from a broadcast, its silence included, to the next: one that missed it costs no more."""
BELIEVED: Final = 4
"""Announces of a missing node in EACH seconds for which a broadcast follows soon: any device can send them."""


class SearchedPort(ContactLink, Protocol):
    """The port of a bus on which nodes are searched."""

    spec: CanSpec

    def bus(self) -> BusMultiplexer:
        """Return the open bus with its receiving loop."""

    def next_transaction(self) -> int:
        """Return a transaction number, 0 to 255."""

    def identify(
        self, node: int, *, seconds: float, until_announced: bool = False, once: bool = False
    ) -> Identity | None:
        """Ask one address for Identify; None if it does not answer."""

    def settled(self, found: FunctionalAnswers, until: float) -> FunctionalAnswers:
        """Check unclear answers again."""


class CanDiscovery(Discovery):
    """The discovery of one bus; see :class:`Discovery`."""

    LONGEST = LONGEST_SECONDS + 2.0

    def __init__(self, port: SearchedPort, sightings: SightingSink, *, poll: float | None = None) -> None:
        self.port = port
        self._announcers: deque[int] = deque(maxlen=LAST_ADDRESS)
        self._asked_at: dict[int, float] = {}
        # per missing node (CRC of its UUID): when Announces led to a search for it
        self._awaited: dict[int, deque[float]] = {}
        super().__init__(port.place, sightings, poll)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._watch()
            except LinkError as failure:
                self.failure = failure
                self._round_begins()  # so that a thread that waits for the next round gets this failure now
                self._round_ends()
                self._stop.wait(LEAST)

    def _watch(self) -> None:
        """Send broadcasts and receive Announces until the bus fails."""
        with self.port.bus().listen(lambda frame: is_announce(frame.identifier), most=256) as listener:
            gone = self._presence.gone
            self._ask()
            pace, soon = BroadcastPace(time.monotonic(), first=SOON), math.inf
            while not self._stop.is_set():
                soon = min(soon, self._heard(listener.get(LOOK)))
                missing = self._presence.missing()
                if missing and self._presence.gone != gone:
                    soon = SOON  # the pause has grown for another missing node; this one is looked for soon
                wanted = self._asked.is_set() or time.monotonic() - pace.asked >= soon
                if pace.is_due(wanted=wanted, missing=missing, poll=self._poll):
                    soon, gone = math.inf, self._presence.gone
                    self._ask()
                    pace.asked = time.monotonic()
                self._ask_announcer()

    def _heard(self, frame: Frame | None) -> float:
        """Return the seconds after the last broadcast at which the next one is due because of this frame."""
        announce = Announce.decode(frame.identifier, frame.data) if frame is not None else None
        if announce is None or announce.pressed:
            return math.inf
        self._presence.announced(self.port.place, announce)
        if self._presence.is_awaited(announce):
            return SOON if self._believes(announce) else math.inf
        if self._presence.is_welcome(announce) and self._believes(announce):
            self._ask_one(announce.address, PATIENCE)  # a broadcast's answers would delay the data of other nodes
            return math.inf
        if self._poll and announce.address not in self._announcers:
            self._announcers.append(announce.address)
        return math.inf

    def _believes(self, announce: Announce) -> bool:
        now, before = time.monotonic(), self._awaited.setdefault(announce.crc, deque(maxlen=BELIEVED))
        if len(before) == BELIEVED and now - before[0] < EACH:
            return False
        before.append(now)
        return True

    def _ask_announcer(self) -> None:
        """Ask one address that announced itself, if its turn has come; one that was asked too recently is left out."""
        now = time.monotonic()
        if now - max(self._asked_at.values(), default=-math.inf) < ALL:
            return
        while self._announcers:
            address = self._announcers.popleft()
            if now - self._asked_at.get(address, -math.inf) >= EACH:
                self._asked_at[address] = now
                # any device can send an Announce, so torn answers count too
                self._ask_one(address, PATIENCE, once=True)
                return

    def _ask(self) -> None:
        """Send one broadcast (or ask ``node=`` alone); report each node as soon as it answers."""
        self._round_begins()
        port, began = self.port, time.monotonic()
        if port.spec.node is not None:
            self._ask_one(port.spec.node, LEAST)
        else:
            found = FunctionalAnswers()
            bus, transaction = port.bus(), port.next_transaction()
            for news in ask_all(bus, transaction, silence=SILENCE_SECONDS, longest=LONGEST_SECONDS):
                if isinstance(news, FunctionalAnswers):
                    found = news
                else:
                    self._saw(*news)
                if self._stop.is_set():
                    return
            self._settle(found, began)
        self.failure = None
        self._round_ends()

    def _settle(self, found: FunctionalAnswers, began: float) -> None:
        settled = self.port.settled(found, began + 2 * LONGEST_SECONDS)
        for address in sorted(settled.conflicts):
            self._presence.conflict(self.port.place, address, conflict(address))
        for address, identity in sorted(settled.identities.items()):
            if address in found.conflicts | found.unfinished:
                self._saw(address, identity)
        for uuid, addresses in settled.duplicates.items():
            self._presence.report(twice_text(uuid, addresses))

    def identify_at(self, address: int, seconds: float) -> None:
        """Ask one address now, on the caller's thread; an answer is reported as any other. Raises LinkError.

        An Announce from there ends it: discovery asks because of that itself.
        """
        self._ask_one(address, seconds, until_announced=True)

    def _ask_one(self, address: int, seconds: float, *, until_announced: bool = False, once: bool = False) -> None:
        try:
            identity = self.port.identify(address, seconds=seconds, until_announced=until_announced, once=once)
        except AddressConflictError:
            self._presence.conflict(self.port.place, address, conflict(address))
            return
        if identity is not None:
            self._saw(address, identity)

    def _saw(self, address: int, identity: Identity) -> None:
        self._presence.add_sighting(Sighting(identity, address, self.port, time.monotonic()))
