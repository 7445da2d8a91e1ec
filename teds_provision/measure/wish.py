"""What is wished for: what is to be measured of each node, and where news of it goes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from teds_provision.measure.blocks import Block, ChannelFacts, NodeReport
from teds_provision.measure.running.requirements import Requirements
from teds_provision.measure.trusting import DEAD_MAN, LEASE
from teds_provision.protocol.operation.stream_commands import Kind


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
    by: str = "measure"  # the command that a reading of the datasheet is put down to


@dataclass
class Events:
    """Where a node's news goes; each may be called from any thread and returns at once."""

    block: Callable[[Block], None]
    facts: Callable[[Sequence[ChannelFacts]], None]
    report: Callable[[NodeReport], None]
