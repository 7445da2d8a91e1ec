"""Who is on a bus, asked once for everybody who waits: announcements, and a functional Identify now and then.

Fifty nodes that are looked for by fifty threads would each ask the whole bus; so one look-out asks for all. It asks at
its start, when somebody is missing (after 1 s, doubling to 30 s), at most once a second upon announcements, and every
``poll`` seconds where it was asked to (operation.md section 7). What it hears is a hint: a session says who it is.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from teds_provision.errors import AddressConflict, LinkFailure, NoNode
from teds_provision.links.ble.port import BlePort
from teds_provision.links.can.finding import (
    LONGEST_SECONDS,
    SILENCE_SECONDS,
    Found,
    ask_all,
    conflict_text,
    settle,
    twice_text,
)
from teds_provision.links.can.frame import Frame
from teds_provision.links.can.link import conflict
from teds_provision.links.can.port import CanPort
from teds_provision.links.ports import Contact
from teds_provision.protocol.announce import Announce, is_announce, uuid_crc
from teds_provision.protocol.messages.identity import Identity

POLL = 30.0  # seconds between questions to everybody, where that was asked for
LEAST, MOST = 1.0, 30.0  # seconds between questions while somebody is missing
ANNOUNCED = 1.0  # seconds between questions that announcements cause
AWAITED = 0.25  # the same, where something announces itself as a node that is missing
LOOK = 0.05  # seconds between looks at who waits


@dataclass(frozen=True)
class Sighting:
    """A node that answered: where, as what it says it is, and when (time.monotonic). Nobody has proven any of it.

    ``address`` is its CAN address, over the air the number of its connection.
    """

    identity: Identity
    address: int
    port: CanPort | BlePort
    at: float

    @property
    def uuid(self) -> bytes:
        """10 octets."""
        return self.identity.uuid

    def contact(self) -> Contact:
        """A line to it."""
        if isinstance(self.port, BlePort):
            return Contact(self.identity, self.port.link(self.address), connection=self.address)
        return Contact(self.identity, self.port.link(self.address), address=self.address)


Place = tuple[str, int]


@dataclass
class Sightings:
    """What the look-outs of all buses saw; :meth:`find` waits for one node. Thread-safe.

    A UUID may answer at two places, as anyone can send an Identify: one that turned out wrong goes behind the others.
    """

    news: Callable[[Sighting], None] = lambda _sighting: None
    note: Callable[[str], None] = lambda _text: None
    _seen: dict[bytes, dict[Place, Sighting]] = field(default_factory=dict)
    _wrong: dict[bytes, dict[Place, float]] = field(default_factory=dict)
    _conflicts: dict[Place, float] = field(default_factory=dict)
    _announced: dict[bytes, tuple[Place, Callable[[], None]]] = field(default_factory=dict)
    _missing: dict[bytes, int] = field(default_factory=dict)
    _turn: threading.Condition = field(default_factory=threading.Condition)

    def saw(self, sighting: Sighting) -> None:
        """Take what a look-out saw."""
        with self._turn:
            self._seen.setdefault(sighting.uuid, {})[sighting.port.place, sighting.address] = sighting
            self._turn.notify_all()
        self.news(sighting)

    def conflict(self, place: str, address: int) -> None:
        """Two nodes answer under one address: nothing is opened there."""
        with self._turn:
            self._conflicts[place, address] = time.monotonic()
            for places in self._seen.values():
                places.pop((place, address), None)
            self._turn.notify_all()
        self.note(conflict_text(address))

    def on_announce(self, sighting: Sighting, tell: Callable[[], None]) -> None:
        """Call ``tell``, which returns at once, when something announces itself as this node, or from its address."""
        with self._turn:
            self._announced[sighting.uuid] = ((sighting.port.place, sighting.address), tell)

    def let_announce(self, uuid: bytes) -> None:
        """Tell no more of it."""
        with self._turn:
            self._announced.pop(uuid, None)

    def announced(self, place: str, announce: Announce) -> None:
        """Take what a look-out heard; a hint that anyone can send."""
        with self._turn:
            told = [
                tell
                for uuid, (where, tell) in self._announced.items()
                if where == (place, announce.address) or (where[0] == place and uuid_crc(uuid) == announce.crc)
            ]
        for tell in told:
            tell()

    def awaits(self, announce: Announce) -> bool:
        """Whether somebody waits for the node that this says it is."""
        with self._turn:
            return any(uuid_crc(uuid) == announce.crc for uuid in self._missing)

    def missing(self) -> bool:
        """Whether somebody waits for a node."""
        with self._turn:
            return bool(self._missing)

    def all(self) -> list[Sighting]:
        """Every node that was seen, where it was seen last, by UUID."""
        with self._turn:
            return [max(places.values(), key=lambda one: one.at) for _, places in sorted(self._seen.items()) if places]

    def find(self, uuid: bytes, *, seconds: float, stop: threading.Event, fresh: float = 0.0) -> Sighting:
        """Wait for a node that was seen after ``fresh`` (time.monotonic); raises NoNode, AddressConflict."""
        until = time.monotonic() + seconds
        with self._turn:
            self._missing[uuid] = self._missing.get(uuid, 0) + 1
            try:
                while True:
                    found = self._best(uuid, fresh)
                    if found is not None:
                        return found
                    left = until - time.monotonic()
                    if left <= 0 or stop.is_set():
                        raise self._nobody(uuid, seconds)
                    self._turn.wait(min(left, 0.2))
            finally:
                self._missing[uuid] -= 1
                if not self._missing[uuid]:
                    del self._missing[uuid]

    def wrong(self, sighting: Sighting) -> None:
        """It was not that node, or it is gone from there: look again."""
        place = (sighting.port.place, sighting.address)
        with self._turn:
            self._seen.get(sighting.uuid, {}).pop(place, None)
            self._wrong.setdefault(sighting.uuid, {})[place] = time.monotonic()

    def _best(self, uuid: bytes, fresh: float) -> Sighting | None:
        wrong = self._wrong.get(uuid, {})
        places = [one for one in self._seen.get(uuid, {}).values() if one.at >= fresh]
        return min(places, key=lambda one: (wrong.get((one.port.place, one.address), 0.0), -one.at), default=None)

    def _nobody(self, uuid: bytes, seconds: float) -> LinkFailure:
        recent = [address for (_, address), at in self._conflicts.items() if time.monotonic() - at < MOST]
        if recent:
            return conflict(min(recent))
        return NoNode(
            f"Node {uuid.hex()} did not answer within {seconds:g} s.",
            hint="Check its power, the bit rate and the address; teds-provision identify --via can lists who answers.",
        )


class _Pace:
    """When everybody is asked again: ``asked`` is when they were last, ``_pause`` how long it is till the next time."""

    def __init__(self) -> None:
        self.asked = time.monotonic()
        self._pause = LEAST

    def is_due(self, since: float, *, wanted: bool, missing: bool, poll: float | None) -> bool:
        """Whether to ask now, ``since`` seconds after the last time: somebody wants it, is missing, or polls."""
        if wanted or not missing:
            self._pause = LEAST
        if wanted:
            return True
        if (missing and since >= self._pause) or (poll and since >= poll):
            self._pause = min(2 * self._pause, MOST)
            return True
        return False


class Lookout:
    """The look-out on one bus, a thread until :meth:`close`."""

    def __init__(self, port: CanPort, sightings: Sightings, *, poll: float | None = None) -> None:
        self.port, self._sightings, self._poll = port, sightings, poll
        self._stop, self._asked = threading.Event(), threading.Event()
        self._rounds = 0
        self._turn = threading.Condition()
        self.failure: LinkFailure | None = None
        self._thread = threading.Thread(target=self._run, name=f"look-out {port.place}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._asked.set()
        self._thread.join(LONGEST_SECONDS + 2.0)

    def poll(self, seconds: float | None) -> None:
        """Ask everybody every so many seconds from now on; None: only while somebody is missing."""
        self._poll = seconds

    def discover(self, seconds: float = LONGEST_SECONDS + 2.0) -> None:
        """Ask everybody now, and wait until that is done; raises LinkFailure where the bus has failed."""
        with self._turn:
            before = self._rounds
            self._asked.set()
            self._turn.wait_for(lambda: self._rounds > before + 1 or self._stop.is_set(), seconds)
        if self.failure is not None:
            raise self.failure

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._watch()
            except LinkFailure as failure:
                self.failure = failure
                self._done()
                self._stop.wait(LEAST)

    def _watch(self) -> None:
        """Ask, and hear announcements, until the bus fails."""
        with self.port.bus().listen(lambda frame: is_announce(frame.identifier), most=256) as ear:
            self._ask()
            pace, soon = _Pace(), math.inf
            while not self._stop.is_set():
                soon = min(soon, self._heard(ear.get(LOOK)))
                since = time.monotonic() - pace.asked
                wanted = self._asked.is_set() or since >= soon
                if pace.is_due(since, wanted=wanted, missing=bool(self._sightings.missing()), poll=self._poll):
                    soon = math.inf
                    self._asked.clear()
                    self._ask()
                    pace.asked = time.monotonic()

    def _heard(self, frame: Frame | None) -> float:
        """Seconds after the last question at which everybody is asked because of this frame."""
        announce = Announce.decode(frame.identifier, frame.data) if frame is not None else None
        if announce is None:
            return math.inf
        self._sightings.announced(self.port.place, announce)
        return AWAITED if self._sightings.awaits(announce) else ANNOUNCED

    def _ask(self) -> None:
        """One question to everybody (or to ``node=`` alone); each is told of as soon as it answers."""
        port, began = self.port, time.monotonic()
        if port.spec.node is not None:
            self._ask_one(port.spec.node)
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

    def _ask_one(self, address: int) -> None:
        try:
            identity = self.port.identify(address)
        except AddressConflict:
            self._sightings.conflict(self.port.place, address)
            return
        if identity is not None:
            self._saw(address, identity)

    def _saw(self, address: int, identity: Identity) -> None:
        self._sightings.saw(Sighting(identity, address, self.port, time.monotonic()))

    def _done(self) -> None:
        with self._turn:
            self._rounds += 1
            self._turn.notify_all()
