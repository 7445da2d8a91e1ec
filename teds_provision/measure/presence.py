"""Sightings of nodes on all links of a process: written by the discoveries, read by waiting threads.

A sighting is a hint: a session proves identity.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

from teds_provision.errors import AddressConflictError, LinkError, NoNodeError
from teds_provision.links.discovery import Sighting
from teds_provision.protocol.announce import Announce, uuid_crc

RECENT = 30.0  # seconds for which an address conflict is reported as the reason why a node is not found
# UUIDs kept beside those that are measured: a bus has 239 addresses, but a device at any of them can invent new UUIDs
MOST = 1024
REPEATED = 600.0  # seconds until the same address conflict is reported again
ROUND = 0.7  # seconds of two broadcasts, after which two boards at one address are noticed
TWIN = 0.5  # seconds to wait for the real node after another device used its UUID


Place = tuple[str, int]
_Key = TypeVar("_Key", Place, int, bytes)
_Entry = TypeVar("_Entry", bytes, threading.Condition)


@dataclass
class Presence:
    """Sightings of the discoveries of all buses; :meth:`find` waits for one node. Thread-safe.

    A UUID may answer at two places, as any device can send an Identify: one that turned out wrong is tried last.
    """

    news: Callable[[Sighting], None] = lambda _sighting: None
    note: Callable[[str], None] = lambda _text: None
    _seen: dict[bytes, dict[Place, Sighting]] = field(default_factory=dict)
    _wrong: dict[bytes, dict[Place, float]] = field(default_factory=dict)
    _conflicts: dict[Place, tuple[float, AddressConflictError]] = field(default_factory=dict)
    _announced: dict[bytes, tuple[Place, Callable[[], None], Callable[[], None]]] = field(default_factory=dict)
    _placed: dict[Place, set[bytes]] = field(default_factory=dict)  # UUIDs of _announced, by place
    # and by the CRC of the UUID, which an Announce contains
    _digested: dict[int, set[bytes]] = field(default_factory=dict)
    # for each node that threads wait for: the number of threads
    _missing: Counter[bytes] = field(default_factory=Counter)
    _missing_crcs: Counter[int] = field(default_factory=Counter)  # the same, by the CRC of the UUID
    _unseen: set[bytes] = field(default_factory=set)  # UUIDs that a thread waited for and that have not been seen since
    _welcome: frozenset[int] = frozenset()  # CRCs of UUIDs that are measured as soon as they appear
    _reported: dict[str, float] = field(default_factory=dict)  # notes that were made, with their times
    gone: int = 0  # how often a node became missing that had been seen, or was not searched for before
    _turn: threading.Lock = field(default_factory=threading.Lock)
    # by the node that a thread waits for: a sighting wakes the threads of its own node alone, however many others wait
    _waiting: dict[bytes, set[threading.Condition]] = field(default_factory=dict)

    def add_sighting(self, sighting: Sighting) -> None:
        """Take a sighting; a supervisor that has this node at another place is notified."""
        place = (sighting.port.place, sighting.address)
        with self._turn:
            self._unseen.discard(sighting.uuid)
            places = self._seen.pop(sighting.uuid, {})  # the latest sighting is last
            places[place] = sighting
            self._seen[sighting.uuid] = places
            while len(self._seen) > MOST + len(self._announced):
                del self._seen[next(uuid for uuid in self._seen if uuid not in self._announced)]
            self._wake(sighting.uuid)
            kept = self._announced.get(sighting.uuid)
        if kept is not None and kept[0] != place:
            kept[2]()
        self.news(sighting)

    def conflict(self, place: str, address: int, error: AddressConflictError) -> None:
        """Record that two nodes answer under one address: nothing is opened there."""
        with self._turn:
            self._conflicts[place, address] = time.monotonic(), error
            for places in self._seen.values():
                places.pop((place, address), None)
            for uuid in self._waiting:
                self._wake(uuid)
        self.report(error.message)

    def report(self, text: str) -> None:
        """Note what a look-out found out about addresses; the same again only after :data:`REPEATED` seconds."""
        now = time.monotonic()
        with self._turn:
            known = now - self._reported.get(text, -REPEATED) < REPEATED
            if not known:
                self._reported[text] = now
                while len(self._reported) > MOST:
                    del self._reported[next(iter(self._reported))]
        if not known:
            self.note(text)

    def on_announce(
        self, sighting: Sighting, notify: Callable[[], None], moved: Callable[[], None] | None = None
    ) -> None:
        """Call ``notify``, which returns at once, when something announces itself as this node, or from its address.

        ``moved`` (else ``notify``): when it answers at another place. Both are hints: any device can send them.
        """
        place = (sighting.port.place, sighting.address)
        with self._turn:
            self._drop_announced(sighting.uuid)
            self._announced[sighting.uuid] = (place, notify, moved or notify)
            self._placed.setdefault(place, set()).add(sighting.uuid)
            self._digested.setdefault(uuid_crc(sighting.uuid), set()).add(sighting.uuid)

    def let_announce(self, uuid: bytes) -> None:
        """Stop notices about it."""
        with self._turn:
            self._drop_announced(uuid)

    def _drop_announced(self, uuid: bytes) -> None:
        kept = self._announced.pop(uuid, None)
        if kept is not None:
            _discard(self._placed, kept[0], uuid)
            _discard(self._digested, uuid_crc(uuid), uuid)

    def announced(self, place: str, announce: Announce) -> None:
        """Handle an Announce, which any device can send: a hint."""
        with self._turn:
            named = {uuid for uuid in self._digested.get(announce.crc, ()) if self._announced[uuid][0][0] == place}
            meant = named | self._placed.get((place, announce.address), set())
            notices = [self._announced[uuid][1] for uuid in meant]
        for notify in notices:
            notify()

    def is_awaited(self, announce: Announce) -> bool:
        """Return True if a thread waits for the node that this claims to be."""
        with self._turn:
            return announce.crc in self._missing_crcs

    def expect(self, uuids: Iterable[bytes]) -> None:
        """Name nodes to be asked at once when they announce themselves, although no thread waits for one."""
        self._welcome = frozenset(map(uuid_crc, uuids))

    def is_welcome(self, announce: Announce) -> bool:
        """Return True if this claims to be such a node."""
        return announce.crc in self._welcome

    def seen_at(self, uuid: bytes) -> Sighting | None:
        """Return where a node was seen last; None if it was not, or turned out not to be."""
        with self._turn:
            return max(self._seen.get(uuid, {}).values(), key=lambda sighting: sighting.at, default=None)

    def missing(self) -> bool:
        """Return True if a thread waits for a node."""
        with self._turn:
            return bool(self._missing)

    def all(self) -> list[Sighting]:
        """Return every node with its last place, by UUID."""
        with self._turn:
            return [
                max(places.values(), key=lambda sighting: sighting.at)
                for _, places in sorted(self._seen.items())
                if places
            ]

    def find(self, uuid: bytes, *, seconds: float, stop: threading.Event, fresh: float = 0.0) -> Sighting:
        """Wait for a node that was seen after ``fresh`` (time.monotonic); raises NoNodeError, AddressConflictError."""
        until = time.monotonic() + seconds
        with self._turn, self._waited_for(uuid), self._news_of(uuid) as news:
            while True:
                found = self._best(uuid, fresh)
                if found is not None:
                    return found
                if uuid not in self._unseen:
                    self._unseen.add(uuid)
                    self.gone += 1
                left = until - time.monotonic()
                if left <= 0 or stop.is_set():
                    raise self._nobody(uuid, seconds)
                news.wait(min(left, 0.2))

    @contextmanager
    def _waited_for(self, uuid: bytes) -> Iterator[None]:
        """Count a thread that waits for a node; it has the turn at the beginning and at the end."""
        crc = uuid_crc(uuid)
        self._missing[uuid] += 1
        self._missing_crcs[crc] += 1
        try:
            yield
        finally:
            _take_one(self._missing, uuid)
            _take_one(self._missing_crcs, crc)

    @contextmanager
    def _news_of(self, uuid: bytes) -> Iterator[threading.Condition]:
        """Give a thread that has the turn what news of one node wake."""
        news = threading.Condition(self._turn)
        self._waiting.setdefault(uuid, set()).add(news)
        try:
            yield news
        finally:
            _discard(self._waiting, uuid, news)

    def _wake(self, uuid: bytes) -> None:
        for news in self._waiting.get(uuid, ()):
            news.notify()

    def search_again(self, sighting: Sighting) -> None:
        """Record that it was not that node, or is gone from there, and search again."""
        place = (sighting.port.place, sighting.address)
        with self._turn:
            self._seen.get(sighting.uuid, {}).pop(place, None)
            self._wrong.setdefault(sighting.uuid, {})[place] = time.monotonic()

    def has_other_place(self, uuid: bytes) -> bool:
        """Return True if it answers, or ever answered, at more than one place, or beside another board at its own.

        Waits for the answer of a twin, or until discovery is sure of two boards at one address. A place that was wrong
        counts: the node itself may have been silent for a moment, in which an impostor answered and then refused the
        session.
        """

        def other() -> bool:
            places = self._seen.get(uuid, {}).keys() | self._wrong.get(uuid, {}).keys()
            return len(places) > 1 or any(map(self._conflict_at, places))

        with self._turn, self._news_of(uuid) as news:
            return news.wait_for(other, TWIN + ROUND)

    def conflict_at(self, sighting: Sighting) -> AddressConflictError | None:
        """Return the error if two boards were heard at the address of a sighting a short while ago."""
        with self._turn:
            return self._conflict_at((sighting.port.place, sighting.address))

    def _conflict_at(self, place: Place) -> AddressConflictError | None:
        """Return a new error each time: several threads raise it."""
        at, error = self._conflicts.get(place, (-RECENT, None))
        if error is None or time.monotonic() - at >= RECENT:
            return None
        return AddressConflictError(error.message, hint=error.hint)

    def _best(self, uuid: bytes, fresh: float) -> Sighting | None:
        """Return where to search for a node. A wrong place is not tried while another may answer."""
        wrong, seen = self._wrong.get(uuid, {}), self._seen.get(uuid, {})
        places = [sighting for sighting in seen.values() if sighting.at >= fresh]
        best = min(
            places,
            key=lambda sighting: (wrong.get((sighting.port.place, sighting.address), 0.0), -sighting.at),
            default=None,
        )
        if best is None or (best.port.place, best.address) not in wrong or len(seen) == len(places):
            return best
        return best if time.monotonic() - best.at >= TWIN else None

    def _nobody(self, uuid: bytes, seconds: float) -> LinkError:
        for place in sorted(self._conflicts, key=lambda place: place[1]):
            conflict = self._conflict_at(place)
            if conflict is not None:
                return conflict
        return NoNodeError(
            f"Node {uuid.hex()} did not answer within {seconds:g} s.",
            hint="Check its power, the bit rate and the address; teds-provision identify --via can lists the"
            " nodes that answer.",
        )


def _take_one(counts: Counter[Any], key: object) -> None:
    """Decrement a count, and remove it at zero."""
    counts[key] -= 1
    if not counts[key]:
        del counts[key]


def _discard(index: dict[_Key, set[_Entry]], key: _Key, entry: _Entry) -> None:
    """Remove an entry from an index, and its key if none is left."""
    index[key].discard(entry)
    if not index[key]:
        del index[key]
