"""The nodes of one measurement: which it has, which wait, which are lost, and when each is tried again.

Pure: no thread, no lock and no clock; times are ``time.monotonic()`` and handed in. The supervisor of measurements
holds its lock around each call, and does what is decided here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from teds_provision.errors import BadDataError, NoRoomError, NotAuthenticError, PolicyError, TedsProvisionError
from teds_provision.links.discovery import Sighting
from teds_provision.measure.matching import NodeLoad
from teds_provision.measure.node_supervisor import NodeSupervisor
from teds_provision.protocol.messages.identity import NodeState

LOOK: Final = 0.1  # seconds between checks for nodes that have left
# nodes that arrive together are gathered until no other one comes for QUIET seconds, at most GATHERING seconds
QUIET, GATHERING = 0.05, 0.3
FIRST_ROUND: Final = 3.0  # seconds for all nodes to answer at the start, so that each gets its share of the bus
FIRST_ASK, LAST_ASK = 0.2, 16.0  # seconds until a lost node is asked again; the interval doubles
ASKED: Final = 60.0  # seconds for which a lost node is asked
AGAIN: Final = 30.0  # seconds until a node that may not be measured, or has no room, is tried again
SLOWEST: Final = 50.0  # largest factor by which a new node's rate is reduced; beyond that it waits for room
NO_ROOM: Final = "no room on the bus"


@dataclass
class Member:
    """A node of a measurement; ``joined`` is false while it is being decided whether there is room for it.

    ``locked``: no other part of this process works with it. ``stack`` holds what else is taken for it.
    """

    joined: bool = True
    locked: bool = False
    supervisor: NodeSupervisor | None = None
    stack: ExitStack = field(default_factory=ExitStack)
    load: NodeLoad = field(default_factory=NodeLoad)


@dataclass(frozen=True)
class Budget:
    """Messages a second that may go to topics, None if none do; ``rows``: arrays go to them too."""

    limit: float | None = None
    rate: float = 0.0
    rows: bool = False


@dataclass
class _WaitingNode:
    """A node that is not measured now: when it is tried again, and after what share of the bus has become free."""

    at: float
    room: float | None = None


@dataclass
class _LostNode:
    """A lost node: its last place, since when it is lost, and the time of the next Identify to it."""

    sighting: Sighting
    since: float
    at: float
    pause: float = FIRST_ASK


class AfterEnd(Enum):
    """Next state of a node whose session has ended by itself."""

    NOTHING = "nothing"
    ASK = "ask it at its last place"
    TRY = "try it at the place where it was seen meanwhile"


@dataclass
class Membership:
    """The nodes of a measurement that began at ``began``; a node has one of these states at a time, or none.

    ``arrived``: its lock is taken, and it is about to join. ``busy``: another part works with it. ``elsewhere``:
    selected, and another measurement's when it answered.
    """

    began: float
    members: dict[str, Member] = field(default_factory=dict)
    arrived: dict[str, float] = field(default_factory=dict)
    busy: dict[str, float] = field(default_factory=dict)
    elsewhere: set[str] = field(default_factory=set)
    leaving: set[str] = field(default_factory=set)  # former members whose locks are being released
    waits: dict[str, _WaitingNode] = field(default_factory=dict)
    lost: dict[str, _LostNode] = field(default_factory=dict)
    places: dict[str, Sighting] = field(default_factory=dict)  # the last place of each measured node

    def has(self, uuid: str) -> bool:
        """Return True if a node is in."""
        member = self.members.get(uuid)
        return uuid in self.leaving or (member is not None and member.joined)

    @property
    def joined(self) -> tuple[str, ...]:
        """The nodes that are in."""
        return (*(uuid for uuid, member in self.members.items() if member.joined), *self.leaving)

    def may_come(self, uuid: str, *, says_factory: bool) -> bool:
        """Return True if a node that answered is to be considered.

        One without room waits until there is more. One that was refused and reports no key is left to the adopter:
        any device may send that hint, and it costs the half minute until a refused node is tried again anyway.
        """
        waits = self.waits.get(uuid)
        if uuid in self.members or uuid in self.arrived:
            return False
        return waits is None or (waits.room is None and not says_factory)

    def arrive(self, uuid: str, now: float) -> None:
        """Note a node whose lock is taken."""
        self.busy.pop(uuid, None)
        self.elsewhere.discard(uuid)
        self.arrived[uuid] = now

    def gathered(self, now: float) -> bool:
        """Return True if nodes have arrived and no further one is waited for.

        Those that come together join together, so that each gets its fair part.
        """
        if not self.arrived:
            return False
        first, last = min(self.arrived.values()), max(self.arrived.values())
        quiet = QUIET if self.members else 5 * QUIET
        at_the_start = not self.members and first - self.began < FIRST_ROUND
        until = self.began + FIRST_ROUND if at_the_start else first + GATHERING
        return now - last >= quiet or now >= until

    def begin_joining(self) -> list[str]:
        """Return the nodes that arrived, as members that have not joined yet."""
        arrived = self.clear_arrived()
        for uuid in arrived:
            self.members[uuid] = Member(joined=False, locked=True)
        return arrived

    def join(self, uuid: str) -> None:
        """Note that a node is in."""
        self.lost.pop(uuid, None)
        self.waits.pop(uuid, None)
        self.members[uuid].joined = True

    def begin_leaving(self, uuid: str) -> Member | None:
        """Return a member that is to be released; it counts as in until that is done."""
        member = self.members.pop(uuid, None)
        if member is not None and member.joined:
            self.leaving.add(uuid)
        return member

    def clear_arrived(self) -> list[str]:
        """Return the nodes that are locked and do not join any more."""
        arrived, self.arrived = list(self.arrived), {}
        return arrived

    def why_no_room(self, uuid: str, room: float, budget: Budget) -> str:
        """Return why there is no room for a member on a bus with ``room`` left, in half a sentence; "" if there is."""
        load = self.members[uuid].load
        if (load.bus or 0.0) > SLOWEST * room:
            return NO_ROOM
        if budget.limit is None:
            return ""
        rate, rows = budget.rate, budget.rows
        used = sum(member.load.messages(rate, rows) for other, member in self.members.items() if other != uuid)
        over = used + load.messages(rate, rows) > budget.limit
        return f"no room in the budget of {budget.limit:g} messages/s" if over else ""

    def wait(self, uuid: str, at: float, room: float | None) -> bool:
        """Try a node again at ``at``, or if there is more than ``room``; True if it did not wait before."""
        is_news = uuid not in self.waits
        self.waits[uuid] = _WaitingNode(at, room)
        return is_news

    def end(
        self,
        uuid: str,
        now: float,
        error: TedsProvisionError | None,
        *,
        last: Sighting | None,
        seen: Sighting | None,
        room: float,
    ) -> AfterEnd:
        """Decide what follows for a node that was released, with ``room`` left on its bus.

        ``last`` is where it was measured, ``seen`` where it is.
        """
        if last is not None:
            self.places[uuid] = last
        if isinstance(error, NoRoomError) and seen is not None:
            self.wait(uuid, now + AGAIN, room)
        elif isinstance(error, (NotAuthenticError, PolicyError, BadDataError)):
            self.wait(uuid, now + AGAIN, None)
            # the node's lock is free now, so that it can be adopted when it answers
            if last is not None and last.identity.state == NodeState.FACTORY:
                return AfterEnd.ASK
        elif error is not None and seen is not None and seen is not last:
            return AfterEnd.TRY
        elif error is not None and last is not None:
            self.lost[uuid] = _LostNode(last, now, now + FIRST_ASK)
        return AfterEnd.NOTHING

    def free_again(self, now: float) -> list[str]:
        """Return the nodes with which another part may have ended its work."""
        due = [uuid for uuid, at in self.busy.items() if now >= at]
        for uuid in due:
            del self.busy[uuid]
        return due

    def due(self, now: float, room_of: Callable[[str], float]) -> list[str]:
        """Return the waiting nodes that are tried again now."""
        due = [
            uuid
            for uuid, waits in self.waits.items()
            if now >= waits.at or (waits.room is not None and room_of(uuid) > waits.room + 1e-6)
        ]
        for uuid in due:
            del self.waits[uuid]
        return due

    def ask_now(self, now: float) -> list[Sighting]:
        """Return the last places of the lost nodes that are asked now; each is asked for a minute."""
        asked = []
        for uuid, lost in list(self.lost.items()):
            if uuid in self.members or now - lost.since > ASKED:
                del self.lost[uuid]
            elif now >= lost.at:
                lost.at, lost.pause = now + lost.pause, min(2 * lost.pause, LAST_ASK)
                asked.append(lost.sighting)
        return asked

    def select_again(self, seen: Iterable[str]) -> list[str]:
        """Return the nodes to try after a change of the store: those that were refused, and all that are ``seen``.

        Those that wait for room wait on.
        """
        self.elsewhere.clear()
        refused = [uuid for uuid, waits in self.waits.items() if waits.room is None]
        for uuid in refused:
            del self.waits[uuid]
        return [uuid for uuid in dict.fromkeys((*refused, *seen)) if uuid not in self.waits]
