"""Finding nodes on a bus for all waiting threads: announcements, and a functional Identify now and then.

Fifty threads that look for fifty nodes would each ask the whole bus; so one discovery asks for all. It asks at its
start, when a node is missing (at once, once more, then after 1 s, doubling to 30 s; sooner if that one announces
itself), and every ``poll`` seconds if requested. Then it also asks each address that announces itself, once in 10 s at
most and five a second over all (operation.md section 7). Its results are hints: a session proves identity.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from dataclasses import replace
from typing import ClassVar

from teds_provision.errors import AddressConflictError, LinkError, NoNodeError
from teds_provision.links.ble.port import BlePort
from teds_provision.links.can.identify_broadcast import (
    LONGEST_SECONDS,
    SILENCE_SECONDS,
    FunctionalAnswers,
    ask_all,
    twice_text,
)
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.port import CanPort
from teds_provision.links.ports import Notice
from teds_provision.measure.planning import BusTime
from teds_provision.measure.presence import Presence, Sighting
from teds_provision.measure.stream_receiver import SLICE, ReceivedStream, StreamReceiver
from teds_provision.protocol.announce import LAST_ADDRESS, Announce, is_announce
from teds_provision.protocol.messages.identity import Identity
from teds_provision.protocol.operation.can_frames import read_ble_frame

# The common part of discovery on a bus and over the air: a thread that broadcasts, and when it does so again.

LEAST, MOST = 1.0, 30.0  # seconds between questions while a node is missing


class BroadcastPace:
    """Decides when to broadcast again: ``asked`` is when that was last done.

    While a node is missing that is after ``first`` seconds, then after LEAST, doubling to MOST. ``first`` is short on a
    bus, where a question, or its answer, may have been lost.
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

    def __init__(self, place: str, sightings: Presence, poll: float | None) -> None:
        self._presence, self._poll = sightings, poll
        self._stop, self._asked = threading.Event(), threading.Event()
        self._begun = self._finished = 0  # rounds of questions
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
            wanted = self._begun + 1  # a round that is under way may be past the node that has just come
            self._asked.set()
            longest = self.LONGEST if seconds is None else seconds
            self._turn.wait_for(lambda: self._finished >= wanted or self._stop.is_set(), longest)
        if self.failure is not None:
            raise self.failure

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


POLL = 30.0  # seconds between broadcasts, if requested (operation.md section 7)
EACH, ALL = 10.0, 0.2  # seconds between questions to one address that announces itself, and to any of them
PATIENCE = 0.5  # seconds for the answer of one that has just announced itself
SOON = 0.05  # seconds from a broadcast, its silence included, to the next: one that missed it costs no more
BELIEVED = 4  # Announces of a missing node in EACH seconds for which a broadcast follows soon: any device can send them
LOOK = 0.05  # seconds between looks at who waits


class CanDiscovery(Discovery):
    """The look-out on one bus, a thread until :meth:`close`."""

    LONGEST = LONGEST_SECONDS + 2.0

    def __init__(self, port: CanPort, sightings: Presence, *, poll: float | None = None) -> None:
        self.port = port
        self._announcers: deque[int] = deque(maxlen=LAST_ADDRESS)
        self._asked_at: dict[int, float] = {}
        self._awaited: dict[int, deque[float]] = {}  # when a missing node (its CRC) was looked for because of Announces
        super().__init__(port.place, sightings, poll)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._watch()
            except LinkError as failure:
                self.failure = failure
                self._round_begins()  # a waiter for the next round learns of the failure now
                self._round_ends()
                self._stop.wait(LEAST)

    def _watch(self) -> None:
        """Ask, and hear announcements, until the bus fails."""
        with self.port.bus().listen(lambda frame: is_announce(frame.identifier), most=256) as listener:
            gone = self._presence.gone
            self._ask()
            pace, soon = BroadcastPace(time.monotonic(), first=SOON), math.inf
            while not self._stop.is_set():
                soon = min(soon, self._heard(listener.get(LOOK)))
                missing = self._presence.missing()
                if missing and self._presence.gone != gone:
                    soon = SOON  # one that goes does not wait for the pause that another one's absence has come to
                wanted = self._asked.is_set() or time.monotonic() - pace.asked >= soon
                if pace.is_due(wanted=wanted, missing=missing, poll=self._poll):
                    soon, gone = math.inf, self._presence.gone
                    self._ask()
                    pace.asked = time.monotonic()
                self._ask_announcer()

    def _heard(self, frame: Frame | None) -> float:
        """Return the seconds after the last broadcast at which the next one is due because of this frame."""
        announce = Announce.decode(frame.identifier, frame.data) if frame is not None else None
        if announce is None:
            return math.inf
        self._presence.announced(self.port.place, announce)
        if self._presence.awaits(announce):
            return SOON if self._believes(announce) else math.inf
        if self._presence.is_welcome(announce) and self._believes(announce):
            self._ask_one(announce.address, PATIENCE)  # it alone: the answers of all would cost the others' data
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
                self._ask_one(address, PATIENCE, once=True)  # any device can announce: the limit holds for torn answers
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
            self._presence.conflict(self.port.place, address)
        for address, identity in sorted(settled.identities.items()):
            if address in found.conflicts | found.unfinished:
                self._saw(address, identity)
        for uuid, addresses in settled.twice.items():
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
            self._presence.conflict(self.port.place, address)
            return
        if identity is not None:
            self._saw(address, identity)

    def _saw(self, address: int, identity: Identity) -> None:
        self._presence.add_sighting(Sighting(identity, address, self.port, time.monotonic()))


# Nodes in the air: their data messages, and the look-out that connects to each and asks who it is (operation.md 6).

ROUND = 20.0  # seconds in which a node must advertise, else the scan restarts


class BleStreamReceiver(StreamReceiver):
    """The listening thread of one Bluetooth adapter; the number of their connection identifies nodes."""

    def __init__(self, port: BlePort) -> None:
        self._air = port
        super().__init__(port.place)

    def register(self, node: int, stream: int, heard: ReceivedStream) -> None:
        """Hear a stream; its connection is kept."""
        super().register(node, stream, heard)
        self._air.keep(node, streaming=True)

    def forget(self, node: int, stream: int) -> ReceivedStream | None:
        """Hear it no more."""
        heard = super().forget(node, stream)
        self._air.keep(node, streaming=any(number == node for number, _ in self._streams))
        return heard

    def _hear(self) -> None:
        with self._air.listen() as listener:
            looked = time.monotonic()
            while not self._stop.is_set():
                came = listener(SLICE)
                read = read_ble_frame(came.octets) if came is not None else None
                if came is not None and read is not None:
                    heard = self._streams.get((came.connection, read[0]))
                    if heard is not None:
                        heard.whole(read[1], came.at)
                looked = self._flush(looked, self._air.lost)


class BleDiscovery(Discovery):
    """The discovery of one adapter, a thread until :meth:`close`.

    It searches only while a node is missing, or on request. Every advertising node is connected to and asked, one after
    the other; those that are in use are left alone.
    """

    LONGEST = ROUND

    def __init__(self, port: BlePort, sightings: Presence, *, poll: float | None = None) -> None:
        self.port = port
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
            for contact in self.port.everyone(seconds=2 * LEAST, notice=_nothing):
                number = contact.connection or 0
                self._presence.add_sighting(Sighting(contact.identity, number, self.port, time.monotonic()))
        except NoNodeError:
            pass
        except LinkError as failure:
            self.failure = failure
        self._round_ends()


def air_time(time_: BusTime, mtu: int) -> BusTime:
    """Return the adapter's time as a node behind a connection of this MTU has it."""
    return replace(time_, mtu=mtu)


def _nothing(_notice: Notice) -> None:
    """Ignore notices: discovery reports sightings."""
