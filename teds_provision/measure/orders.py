"""What is to be measured, where news of it goes, and what became of it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from teds_provision.measure.blocks import Block, ChannelFacts, NodeReport
from teds_provision.measure.hearing import HeardStream
from teds_provision.measure.planning import BusTime
from teds_provision.protocol.operation.stream_commands import Kind

LEASE = 10  # seconds
DEAD_MAN = 1000  # milliseconds


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


@dataclass
class Events:
    """Where a node's news goes; each may be called from any thread and returns at once."""

    block: Callable[[Block], None]
    facts: Callable[[Sequence[ChannelFacts]], None]
    report: Callable[[NodeReport], None]


@dataclass
class BusShare:
    """How much of a bus this station's streams take; nodes ask for their share one after another."""

    time: BusTime
    taken: dict[bytes, float] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def others(self, uuid: bytes) -> BusTime:
        """The bus as one node sees it."""
        used = sum(load for key, load in self.taken.items() if key != uuid)
        return BusTime(self.time.bitrate, self.time.data_bitrate, used)
