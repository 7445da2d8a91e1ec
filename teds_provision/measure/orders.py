"""What is to be measured, where news of it goes, and what became of it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

from teds_provision.measure.blocks import Block, ChannelFacts, NodeReport
from teds_provision.measure.hearing import HeardStream
from teds_provision.measure.planning import BusTime
from teds_provision.measure.running.requirements import Requirements
from teds_provision.protocol.operation.budget import MOST_LOAD
from teds_provision.protocol.operation.stream_commands import Kind

LEASE = 10  # seconds
DEAD_MAN = 1000  # milliseconds
SAYING = 1.0  # seconds that a node waits for the others to say what they want of the bus


@dataclass(frozen=True)
class Wish:
    """What is to be measured of each node; ``channels`` empty: every sensor. ``rate`` in Hz, None: the datasheet's."""

    channels: tuple[int, ...] = ()
    rate: float | None = None
    kind: Kind | None = None
    trigger: bool = False
    test_pattern: bool = False
    lease: int = LEASE
    timeout: float = 60.0
    actuators: bool = False  # whether set points may come for actuators of nodes on the whitelist
    dead_man: int = DEAD_MAN
    patient: bool = False  # whether a node is waited for, and tried again, for ever: no refusal is final
    unsigned: bool = False  # whether raw values of a node are wanted whose datasheet nobody has signed
    require: Requirements | None = None


@dataclass
class StreamTotals:
    """What became of one stream over all its runs."""

    channels: tuple[int, ...]
    period: float
    messages: int = 0
    samples: int = 0
    lost: int = 0
    late: int = 0
    bad: int = 0
    invalid: int = 0
    clock_error: float | None = None

    def add(self, heard: HeardStream) -> None:
        """Count a run."""
        counts = heard.receiver.counts
        self.messages += counts.good
        self.samples += heard.samples
        self.lost += counts.lost
        self.late += counts.late + counts.stale + counts.overflow
        self.bad += counts.bad + counts.junk + counts.future + counts.unasked + heard.wrong_pattern
        self.invalid += heard.invalid
        self.clock_error = heard.bound if heard.bound is not None else self.clock_error

    def with_run(self, heard: HeardStream | None) -> StreamTotals:
        """These totals with those of the run that still goes on; themselves stay as they are."""
        sums = replace(self)
        if heard is not None:
            sums.add(heard)
        return sums


@dataclass
class Events:
    """Where a node's news goes; each may be called from any thread and returns at once."""

    block: Callable[[Block], None]
    facts: Callable[[Sequence[ChannelFacts]], None]
    report: Callable[[NodeReport], None]


@dataclass
class BusShare:
    """How much of a bus this station's streams take; nodes ask for their share one after another.

    ``expected`` are the nodes of the measurement. What those that do not stream yet want (``wanted``; a full part where
    it is not known) is kept free for them, so that the first node does not take the room of the second.
    """

    time: BusTime
    expected: set[bytes] = field(default_factory=set)
    taken: dict[bytes, float] = field(default_factory=dict)
    wanted: dict[bytes, float] = field(default_factory=dict)
    lock: threading.Condition = field(default_factory=threading.Condition)

    def others(self, uuid: bytes, *, sharing: bool = False) -> BusTime:
        """The bus as one node sees it; ``sharing`` leaves the nodes that are still to come their fair part."""
        used = sum(load for key, load in self.taken.items() if key != uuid)
        if sharing:
            used += self._kept(uuid, MOST_LOAD - used)
        return replace(self.time, taken=used)

    def want(self, uuid: bytes, load: float) -> None:
        """Say what a node would take of an empty bus, then wait (:data:`SAYING` at most) for the others to say it."""
        with self.lock:
            self.wanted[uuid] = load
            self.lock.notify_all()
            self.lock.wait_for(lambda: self.expected <= self.wanted.keys(), SAYING)

    def expect(self, uuids: Iterable[bytes]) -> None:
        """More nodes are to come."""
        with self.lock:
            self.expected.update(uuids)

    def gone(self, uuid: bytes) -> None:
        """A node that ended for good, or is on another bus, wants nothing any more."""
        with self.lock:
            self.expected.discard(uuid)
            self.wanted.pop(uuid, None)
            self.lock.notify_all()

    def _kept(self, uuid: bytes, room: float) -> float:
        """What is kept for others of ``room``: whoever wants less than an equal part gets it, the rest share evenly."""
        coming = [self.wanted.get(key, MOST_LOAD) for key in self.expected - {uuid} - self.taken.keys()]
        left, level, kept = room, math.inf, len(coming) + 1
        for want in sorted([*coming, self.wanted.get(uuid, MOST_LOAD)]):
            if want > left / kept:
                level = left / kept
                break
            left, kept = left - want, kept - 1
        return sum(min(want, level) for want in coming)
