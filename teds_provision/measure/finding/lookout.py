"""Who is on a bus, asked once for everybody who waits: announcements, and a functional Identify now and then.

Fifty nodes that are looked for by fifty threads would each ask the whole bus; so one look-out asks for all. It asks at
its start, when somebody is missing (at once, once more, then after 1 s, doubling to 30 s; sooner where that one
announces itself), and every ``poll`` seconds where it was asked to. Then it also asks each address that announces
itself, once in 10 s at most and five a second over all (operation.md section 7). What it hears is a hint: a session
says who it is.
"""

from __future__ import annotations

import math
import time
from collections import deque

from teds_provision.errors import AddressConflict, LinkFailure
from teds_provision.links.can.finding import LONGEST_SECONDS, SILENCE_SECONDS, Found, ask_all, settle, twice_text
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.port import CanPort
from teds_provision.measure.finding.asking import LEAST, Asking, Pace
from teds_provision.measure.finding.sightings import Sighting, Sightings
from teds_provision.protocol.announce import LAST_ADDRESS, Announce, is_announce
from teds_provision.protocol.messages.identity import Identity

POLL = 30.0  # seconds between questions to everybody, where that was asked for (operation.md section 7)
EACH, ALL = 10.0, 0.2  # seconds between questions to one address that announces itself, and to any of them
PATIENCE = 0.5  # seconds for the answer of one that has just announced itself
SOON = 0.05  # seconds from a question to everybody, its silence included, to the next: one that missed it costs no more
BELIEVED = 4  # Announces of a missing node in EACH seconds for which everybody is asked soon: anyone can send them
LOOK = 0.05  # seconds between looks at who waits


class Lookout(Asking):
    """The look-out on one bus, a thread until :meth:`close`."""

    LONGEST = LONGEST_SECONDS + 2.0

    def __init__(self, port: CanPort, sightings: Sightings, *, poll: float | None = None) -> None:
        self.port = port
        self._announcers: deque[int] = deque(maxlen=LAST_ADDRESS)
        self._asked_at: dict[int, float] = {}
        self._awaited: dict[int, deque[float]] = {}  # when a missing node (its CRC) was looked for because of Announces
        super().__init__(port.place, sightings, poll)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._watch()
            except LinkFailure as failure:
                self.failure = failure
                self._begin()  # whoever waits for the next round hears of the failure now
                self._done()
                self._stop.wait(LEAST)

    def _watch(self) -> None:
        """Ask, and hear announcements, until the bus fails."""
        with self.port.bus().listen(lambda frame: is_announce(frame.identifier), most=256) as ear:
            gone = self._sightings.gone
            self._ask()
            pace, soon = Pace(time.monotonic(), first=SOON), math.inf
            while not self._stop.is_set():
                soon = min(soon, self._heard(ear.get(LOOK)))
                missing = self._sightings.missing()
                if missing and self._sightings.gone != gone:
                    soon = SOON  # one that goes does not wait for the pause that another one's absence has come to
                wanted = self._asked.is_set() or time.monotonic() - pace.asked >= soon
                if pace.is_due(wanted=wanted, missing=missing, poll=self._poll):
                    soon, gone = math.inf, self._sightings.gone
                    self._ask()
                    pace.asked = time.monotonic()
                self._ask_announcer()

    def _heard(self, frame: Frame | None) -> float:
        """Seconds after the last question to everybody at which they are asked again because of this frame."""
        announce = Announce.decode(frame.identifier, frame.data) if frame is not None else None
        if announce is None:
            return math.inf
        self._sightings.announced(self.port.place, announce)
        if self._sightings.awaits(announce):
            return SOON if self._believes(announce) else math.inf
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
        """Ask one address that announced itself, where its turn has come; who is asked too soon is left out."""
        now = time.monotonic()
        if now - max(self._asked_at.values(), default=-math.inf) < ALL:
            return
        while self._announcers:
            address = self._announcers.popleft()
            if now - self._asked_at.get(address, -math.inf) >= EACH:
                self._asked_at[address] = now
                self._ask_one(address, PATIENCE)
                return

    def _ask(self) -> None:
        """One question to everybody (or to ``node=`` alone); each is told of as soon as it answers."""
        self._begin()
        port, began = self.port, time.monotonic()
        if port.spec.node is not None:
            self._ask_one(port.spec.node, LEAST)
        else:
            found = Found()
            bus, transaction = port.bus(), port.next_transaction()
            for news in ask_all(bus, transaction, silence=SILENCE_SECONDS, longest=LONGEST_SECONDS):
                if isinstance(news, Found):
                    found = news
                else:
                    self._saw(*news)
                if self._stop.is_set():
                    return
            self._settle(found, began)
        self.failure = None
        self._done()

    def _settle(self, found: Found, began: float) -> None:
        settled = settle(found, self.port.identify, until=began + 2 * LONGEST_SECONDS)
        for address in sorted(settled.conflicts):
            self._sightings.conflict(self.port.place, address)
        for address, identity in sorted(settled.identities.items()):
            if address in found.conflicts | found.unfinished:
                self._saw(address, identity)
        for uuid, addresses in settled.twice.items():
            self._sightings.note(twice_text(uuid, addresses))

    def _ask_one(self, address: int, seconds: float) -> None:
        try:
            identity = self.port.identify(address, seconds=seconds)
        except AddressConflict:
            self._sightings.conflict(self.port.place, address)
            return
        if identity is not None:
            self._saw(address, identity)

    def _saw(self, address: int, identity: Identity) -> None:
        self._sightings.saw(Sighting(identity, address, self.port, time.monotonic()))
