"""The nodes of one measurement that takes in nodes as they come (ncap.md, "Measure what comes").

A selected node that answers on a bus joins: its lock is taken at once, before any other part works on it, its room on
the bus is known from the stored datasheet, and its supervisor is started. A lost one leaves, gives its lock and its
room back, and joins again when it answers, on whichever bus. Others are not affected: no running stream is slowed, and
a lost node is asked at its own address.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from typing import Final

from teds_provision.errors import (
    BadDataError,
    LinkError,
    NoRoomError,
    NotAuthenticError,
    PolicyError,
    TedsProvisionError,
)
from teds_provision.links.discovery import Sighting
from teds_provision.measure.buses import Buses
from teds_provision.measure.matching import ListedNodes, NodeLoad, NodeMatch, UnsignedNodes, load_of
from teds_provision.measure.node_supervisor import NodeSupervisor
from teds_provision.measure.runner import Measurement
from teds_provision.measure.running.measurement_job import MeasurementJob
from teds_provision.measure.standing import why_not_measured
from teds_provision.ncap.nodes.directory import NodeDirectory
from teds_provision.ncap.nodes.node_jobs import NodeLocks
from teds_provision.ncap.waits import Waits
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.station.station import Station

LOOK: Final = 0.1  # seconds between looks at who has gone
QUIET, GATHERING = 0.05, 0.3  # seconds without another arrival, and at most, in which those that come together gather
FIRST_ROUND: Final = 3.0  # seconds for all to answer at the beginning, so that all get their fair part
FIRST_ASK, LAST_ASK, ASKED = (
    0.2,
    16.0,
    60.0,
)  # seconds until a lost node is asked again, doubling, and how long that goes
ANSWERING: Final = 1.0
AGAIN: Final = 30.0  # seconds until one that may not be measured, or has no room, is tried again without other news
SLOWEST: Final = 50.0  # a newcomer is slowed down so many times at most; then it waits for room
NO_ROOM: Final = "no room on the bus"


@dataclass
class _WaitingNode:
    """A node that is not measured now: when it is tried again, and after what share of the bus has become free."""

    at: float
    room: float | None = None


@dataclass
class _LostNode:
    """A lost node: where it is asked, when next, and since when."""

    sighting: Sighting
    since: float
    at: float
    pause: float = FIRST_ASK


@dataclass
class _Member:
    supervisor: NodeSupervisor | None = None
    stack: ExitStack = field(default_factory=ExitStack)
    load: NodeLoad = field(default_factory=NodeLoad)


class DynamicMembership:
    """Who is in, who waits, and why; the measurement's thread calls :meth:`work` repeatedly.

    ``joined`` and ``left`` receive each node (UUID in hex), ``waiting`` each that cannot join, and why; ``past`` each
    that is no longer selected, or waited and has gone: earlier notices about it are obsolete. ``elsewhere`` returns
    True if another measurement has a node. ``budget`` is how many messages a second may go to topics, None if none do;
    ``rows``: arrays go to them too.
    """

    def __init__(
        self,
        station: Station,
        roster: NodeDirectory,
        turns: NodeLocks,
        buses: Buses,
        job: MeasurementJob,
        match: NodeMatch | UnsignedNodes | ListedNodes,
        *,
        elsewhere: Callable[[str], bool],
        joined: Callable[[str], None],
        left: Callable[[str], None],
        waiting: Callable[[str, str], None],
        past: Callable[[str], None],
        budget: float | None,
        rows: bool,
        waits: Waits,
    ) -> None:
        self._pauses = waits
        self._station, self._directory, self._node_locks, self._buses, self._job = station, roster, turns, buses, job
        self._match, self._elsewhere, self._budget = match, elsewhere, budget
        self._rows = rows
        self._told_joined, self._told_left, self._told_waiting = joined, left, waiting
        self._told_past = past
        self.news, self._anew = threading.Event(), threading.Event()
        self._guard = threading.Lock()
        self._members: dict[str, _Member] = {}
        self._arrived: dict[str, float] = {}  # whose turn is taken, and who is to be started
        self._busy: dict[str, float] = {}  # nodes that another part works with, and when to look again
        self._waits: dict[str, _WaitingNode] = {}
        self._lost: dict[str, _LostNode] = {}
        self._others: set[str] = set()  # who is meant, and was another measurement's when it answered
        self._left: set[str] = set()  # nodes that are not members, and about which there was a notice
        self._places: dict[str, Sighting] = {}  # where each was measured, or was to be
        self._version: object = None
        self._welcomed, self._followed = -waits.keys, -waits.selection
        self._began = time.monotonic()
        self._measurement: Measurement | None = None
        self._askers = ThreadPoolExecutor(4, thread_name_prefix="ask")

    # -- from the threads of the look-outs ---------------------------------------------------------------------------

    def on_sighting(self, uuid: str) -> None:
        """Handle a node that answered on a bus: take its lock if it is selected and free."""
        with self._guard:
            known = uuid in self._members or uuid in self._arrived
            waits = self._waits.get(uuid)
        if known or (waits is not None and (waits.room is not None or self._says_factory(uuid))):
            return
        if self._why_not(uuid):
            return
        if self._elsewhere(uuid):
            self._others.add(uuid)
            return
        self._others.discard(uuid)
        self._arrive(uuid)

    @property
    def taken(self) -> int:
        """How many nodes that are meant and there are another measurement's."""
        return sum(self._directory.seen(uuid).present and self._elsewhere(uuid) for uuid in list(self._others))

    def _says_factory(self, uuid: str) -> bool:
        """Return True if its Identify reports no key: a node that was refused here a moment ago is left to the adopter.

        That is a hint, as any device may send it: it costs the half minute until a refused node is tried again anyway.
        """
        sighting = self._buses.presence.seen_at(bytes.fromhex(uuid))
        return sighting is not None and sighting.identity.state == NodeState.FACTORY

    def _why_not(self, uuid: str) -> str:
        octets = bytes.fromhex(uuid)
        return why_not_measured(self._station, octets) or self._match.why_not(self._station, octets)

    def _arrive(self, uuid: str) -> None:
        try:
            self._node_locks.acquire(uuid, f"measurement {self._job.kept.id}", wait=0.0, frozen=True)
        except TedsProvisionError:  # it is looked at, or provisioned: it joins when that is done
            with self._guard:
                self._busy[uuid] = time.monotonic() + LOOK
            return
        with self._guard:
            self._busy.pop(uuid, None)
            self._arrived[uuid] = time.monotonic()
        self.news.set()

    def look_who_is_meant(self) -> None:
        """Re-evaluate the selection, as after a change by another process; from any thread."""
        self._anew.set()

    def part(self, uuid: str, why: str) -> None:
        """Remove a node; it may come again."""
        with self._guard:
            member = self._members.get(uuid)
        if member is not None and member.supervisor is not None:
            member.supervisor.stop(why)

    # -- the measurement's thread ------------------------------------------------------------------------------------

    def work(self) -> None:
        """Take in who has come, see who has gone; waits :data:`LOOK` seconds for news at most."""
        if self.news.wait(LOOK):
            self._gather()
        measurement = self._job.measurement
        if measurement is None or not measurement.ready.is_set():
            return
        if measurement is not self._measurement:
            # It began, or restarted after its sinks had failed: it has no members.
            for uuid in list(self._members):
                self._release(uuid)
            self._measurement = measurement
            self._version, self._followed = None, -self._pauses.selection
        now = time.monotonic()
        self._follow_the_store(now)
        for uuid in list(self._members):
            self._reap(uuid, now)
        self._try_again(now)
        with self._guard:
            arrived, self._arrived = list(self._arrived), {}
            for uuid in arrived:
                self._members[uuid] = _Member()
        for uuid in arrived:
            self._reserve(uuid)
        for uuid in arrived:
            self._join(uuid, measurement)

    def end(self) -> None:
        """Release all locks; the measurement has ended, or ends."""
        for uuid in list(self._members):
            self._release(uuid)
        with self._guard:
            arrived, self._arrived = list(self._arrived), {}
        for uuid in arrived:
            self._node_locks.release(uuid)
        self._askers.shutdown(wait=False, cancel_futures=True)

    def _gather(self) -> None:
        """Wait for those that come together, so that each gets its fair part."""
        until = time.monotonic() + GATHERING
        if not self._members and time.monotonic() - self._began < FIRST_ROUND:
            until = self._began + FIRST_ROUND
        quiet = QUIET if self._members else 5 * QUIET
        while time.monotonic() < until:
            self.news.clear()
            if not self.news.wait(quiet):
                break
        self.news.clear()

    def _follow_the_store(self, now: float) -> None:
        """Re-evaluate the selection after a change by another process (a name, a group, a ban, a key)."""
        version = self._station.version()
        if now - self._welcomed >= self._pauses.keys:
            self._welcomed = now
            held = {uuid for uuid, *_ in self._station.keys.all_key_names()}
            self._buses.presence.welcome(held)
        changed = version != self._version or self._anew.is_set()
        if not changed or now - self._followed < self._pauses.selection:
            return
        self._anew.clear()
        self._version, self._followed = version, now
        self._others.clear()  # nodes that are still selected are seen again below
        for uuid, member in list(self._members.items()):
            why = self._why_not(uuid)
            if why and member.supervisor is not None:
                member.supervisor.stop(why)
        for uuid in [uuid for uuid in self._left if self._why_not(uuid)]:
            self._is_past(uuid)
        mended = [
            uuid for uuid, waits in self._waits.items() if waits.room is None
        ]  # it may be, what it was refused for
        for uuid in mended:
            del self._waits[uuid]
        for uuid in dict.fromkeys((*mended, *(sighting.uuid.hex() for sighting in self._buses.presence.all()))):
            if uuid not in self._waits and self._directory.seen(uuid).present:
                self.on_sighting(uuid)

    def _reserve(self, uuid: str) -> None:
        """Report a node's share of its bus before the first of those that come together gets its part."""
        sighting = self._buses.presence.seen_at(bytes.fromhex(uuid))
        if sighting is None:
            return
        share = self._buses.bus_of(sighting).share
        load = self._members[uuid].load = load_of(self._station, sighting.uuid, self._job.request, share.time)
        if not self._lacks_room(uuid, share.room):
            share.expect([sighting.uuid], load.bus)

    def _lacks_room(self, uuid: str, room: float) -> str:
        load = self._members[uuid].load
        if (load.bus or 0.0) > SLOWEST * room:
            return NO_ROOM
        if self._budget is None:
            return ""
        rate = self._job.kept.scalar_rate
        used = sum(member.load.messages(rate, self._rows) for key, member in self._members.items() if key != uuid)
        over = used + load.messages(rate, self._rows) > self._budget
        return f"no room in the budget of {self._budget:g} messages/s" if over else ""

    def _join(self, uuid: str, measurement: Measurement) -> None:
        member, octets = self._members[uuid], bytes.fromhex(uuid)
        sighting = self._buses.presence.seen_at(octets)
        unselected = self._why_not(uuid)
        if sighting is None or unselected:
            self._release(uuid)
            if unselected:  # since it arrived: it was signed, renamed or banned
                self._is_past(uuid)
            if sighting is None and uuid in self._places:  # a session failed there: a node that answers there joins
                self._askers.submit(self._ask, self._places[uuid])
            return
        room = self._buses.bus_of(sighting).share.room
        why = self._lacks_room(uuid, room)
        if why:
            self._wait(uuid, why, room)
            return
        try:
            member.stack.enter_context(self._station.measurements.running([octets], what=f"measure {self._match.text}"))
        except PolicyError as error:  # it is being renamed
            self._wait(uuid, error.message, None, 1.0)
            return
        self._lost.pop(uuid, None)
        self._waits.pop(uuid, None)
        self._left.discard(uuid)
        self._told_joined(uuid)
        member.supervisor = measurement.join(octets)

    def _wait(self, uuid: str, why: str, room: float | None, seconds: float = AGAIN) -> None:
        self._release(uuid)
        if uuid not in self._waits:
            self._left.add(uuid)
            self._told_waiting(uuid, why)
        self._waits[uuid] = _WaitingNode(time.monotonic() + seconds, room)

    def _reap(self, uuid: str, now: float) -> None:
        """Let a node go whose keeper has ended, unless it is only lent; see why, and when it is tried again."""
        keeper = self._members[uuid].supervisor
        if keeper is None or not keeper.done.is_set() or keeper.uuid in self._job.lent:
            return
        error, sighting = keeper.error, self._buses.presence.seen_at(keeper.uuid)
        last = keeper.sighting
        if last is not None:
            self._places[uuid] = last
        self._release(uuid)
        if isinstance(error, NoRoomError) and sighting is not None:
            self._waits[uuid] = _WaitingNode(now + AGAIN, self._buses.bus_of(sighting).share.room)
        elif isinstance(error, (NotAuthenticError, PolicyError, BadDataError)):
            self._waits[uuid] = _WaitingNode(now + AGAIN)
            if last is not None and last.identity.state == NodeState.FACTORY:  # the adopter hears it, now it is free
                self._askers.submit(self._ask, last)
        elif error is not None and sighting is not None and sighting is not last:  # it was seen elsewhere meanwhile
            self.on_sighting(uuid)
        elif error is not None and last is not None:
            self._lost[uuid] = _LostNode(last, now, now + FIRST_ASK)
        if self._why_not(uuid):
            self._is_past(uuid)

    def _release(self, uuid: str) -> None:
        with self._guard:
            member = self._members.pop(uuid, None)
        if member is None:
            return
        member.stack.close()
        for bus in self._buses.all():
            bus.share.leave(bytes.fromhex(uuid))
        self._node_locks.release(uuid)
        self._left.add(uuid)
        self._told_left(uuid)

    def _is_past(self, uuid: str) -> None:
        self._left.discard(uuid)
        self._told_past(uuid)

    def _try_again(self, now: float) -> None:
        with self._guard:
            busy = [uuid for uuid, at in self._busy.items() if now >= at]
            for uuid in busy:
                del self._busy[uuid]
        for uuid in busy:
            if self._directory.seen(uuid).present:
                self.on_sighting(uuid)
        for uuid, waits in list(self._waits.items()):
            if now >= waits.at or (waits.room is not None and self._room_of(uuid) > waits.room + 1e-6):
                del self._waits[uuid]
                if self._directory.seen(uuid).present:
                    self.on_sighting(uuid)
                else:
                    self._is_past(uuid)
        for uuid, lost in list(self._lost.items()):
            if uuid in self._members or now - lost.since > ASKED:
                del self._lost[uuid]
            elif now >= lost.at:
                lost.at, lost.pause = now + lost.pause, min(2 * lost.pause, LAST_ASK)
                self._askers.submit(self._ask, lost.sighting)

    def _room_of(self, uuid: str) -> float:
        sighting = self._buses.presence.seen_at(bytes.fromhex(uuid))
        return self._buses.bus_of(sighting).share.room if sighting is not None else 0.0

    def _ask(self, sighting: Sighting) -> None:
        """Ask a lost node at its last place; an answer is a sighting, and so it joins."""
        with suppress(LinkError, KeyError):
            self._buses.bus_of(sighting).discovery.identify_at(sighting.address, ANSWERING)
