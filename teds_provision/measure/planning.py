"""Planning of a node's streams: channels by period, instants in a message, the gap, the bus's capacity.

Raises PolicyError if a requested rate does not fit, with the fastest that does; without one the datasheet's periods are
slowed to what fits, and ``NodePlans.slowed`` reports it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

from teds_provision.errors import BadDataError, NoRoomError, PolicyError
from teds_provision.links.streaming import Airtime
from teds_provision.protocol.operation.budget import MOST_LOAD, share
from teds_provision.protocol.operation.stream_commands import LAST_STREAM, MOST_STREAM_CHANNELS, SOON, StreamKind
from teds_provision.protocol.operation.subscription import StreamPlan, most_instants
from teds_provision.teds.sheet import Channel, ChannelKind

BLOCK = 20_000_000  # about so many ns of samples in one message: enough to calibrate in blocks, without much delay
UNSTATED = 100_000_000  # ns: assumed for a channel whose datasheet has no period
LONGEST = 10**12  # ns: the longest period that the contract permits
MILLION = 10**6
NODE_SHARE = 0.5  # share of the node's own budget, so that commands fit between data frames
MOST_GAP = 2_000  # µs
SAYING = 1.0  # seconds that a node waits for the others to report their share of the bus


@dataclass(frozen=True)
class BusTime:
    """Capacity of a link: what messages take of it, and the share that the data of others take (``taken``)."""

    airtime: Airtime
    taken: float = 0.0


@dataclass
class BusShare:
    """Share of a bus that this station's streams use; nodes request their share one after another.

    ``others`` gives the share that the data of other stations takes: it counts as taken (operation.md section 4).
    ``expected`` are the nodes of the measurement. The share of those that do not stream yet (``wanted``; a full part if
    it is not known) is reserved, so that the first node does not take the room of the second.
    """

    time: BusTime
    expected: set[bytes] = field(default_factory=set)
    taken: dict[bytes, float] = field(default_factory=dict)
    wanted: dict[bytes, float] = field(default_factory=dict)
    lock: threading.Condition = field(default_factory=threading.Condition)
    others: Callable[[], float] = lambda: 0.0

    def for_node(self, uuid: bytes, *, sharing: bool = False) -> BusTime:
        """Return the bus as one node sees it; ``sharing`` leaves the nodes that are still to come their fair part."""
        used = self._taken_by_others() + sum(load for key, load in self.taken.items() if key != uuid)
        if sharing:
            used += self._kept_for_others(uuid, max(0.0, MOST_LOAD - used))
        return replace(self.time, taken=used)

    def announce_share(self, uuid: bytes, load: float) -> None:
        """Report a node's share of an empty bus, then wait (:data:`SAYING` at most) for the others to do so."""
        with self.lock:
            self.wanted[uuid] = load
            self.lock.notify_all()
            self.lock.wait_for(lambda: self.expected <= self.wanted.keys(), SAYING)

    def expect(self, uuids: Iterable[bytes], load: float | None = None) -> None:
        """Expect more nodes; ``load`` is what each would take of an empty bus, if that is known."""
        with self.lock:
            self.expected.update(uuids)
            if load is not None:
                self.wanted.update(dict.fromkeys(uuids, load))
            self.lock.notify_all()

    @property
    def room(self) -> float:
        """Share of the bus that is free for data now."""
        with self.lock:
            return max(0.0, MOST_LOAD - self._taken_by_others() - sum(self.taken.values()))

    @property
    def nodes(self) -> int:
        """How many nodes this process measures here, or is about to."""
        with self.lock:
            return len(self.expected | self.taken.keys())

    def drop_node(self, uuid: bytes) -> None:
        """Drop the share of a node that ended, or is on another bus."""
        with self.lock:
            self.expected.discard(uuid)
            self.wanted.pop(uuid, None)
            self.lock.notify_all()

    def remove_node(self, uuid: bytes) -> None:
        """Drop the node as :meth:`drop_node` does, and free its share."""
        with self.lock:
            self.taken.pop(uuid, None)
        self.drop_node(uuid)

    def _taken_by_others(self) -> float:
        return self.time.taken + self.others()

    def _kept_for_others(self, uuid: bytes, room: float) -> float:
        """Return the part of ``room`` reserved for others.

        A node that wants less than an equal part gets it, the rest share evenly.
        """
        coming = [self.wanted.get(key, MOST_LOAD) for key in self.expected - {uuid} - self.taken.keys()]
        left, level, kept = room, math.inf, len(coming) + 1
        for want in sorted([*coming, self.wanted.get(uuid, MOST_LOAD)]):
            if want > left / kept:
                level = left / kept
                break
            left, kept = left - want, kept - 1
        return sum(min(want, level) for want in coming)


@dataclass(frozen=True)
class NodePlans:
    """Streams of one node; ``load`` is the share of the bus that they take at worst-case stuffing."""

    streams: tuple[StreamPlan, ...]
    load: float
    slowed: str = ""

    def periods(self) -> dict[int, float]:
        """Return the seconds between the samples of each channel."""
        return {
            number: stream_plan.subscribe.period / 1e9
            for stream_plan in self.streams
            for number in stream_plan.layout.channels
        }


def plan_node(
    channels: Sequence[Channel],
    bus: BusTime,
    *,
    rate: float | None = None,
    kind: StreamKind | None = None,
    test_pattern: bool = False,
    start: int = SOON,
    slower: float = 1.0,
    at_most: bool = False,
) -> NodePlans:
    """Plan streams over these channels of one node; ``rate`` in Hz for all of them, ``slower`` multiplies every period.

    ``at_most``: a channel whose datasheet gives fewer samples than ``rate`` is measured at the datasheet's rate;
    without it the requested rate is refused.
    """
    groups = _groups(channels, rate, kind, at_most=at_most)
    factor = slower
    for _ in range(200):
        paced = [(round(period * factor), how, members) for period, how, members in groups]
        plans = [_plan(number, *group, bus, test_pattern, start) for number, group in enumerate(paced)]
        load = bus.taken + sum(_load(plan, bus) for plan in plans)
        gap = _gap(plans, bus)
        if load <= MOST_LOAD and gap is not None:
            break
        factor *= max(1.02, load / MOST_LOAD)
    else:
        raise NoRoomError(
            "The bus has no capacity left for another node.", hint="Measure fewer nodes, or at a lower rate."
        )
    slowed = _slowed(_fastest(groups), _fastest(paced), rate, by_bus=factor > slower)
    streams = tuple(replace(plan, subscribe=replace(plan.subscribe, gap=gap)) for plan in plans)
    return NodePlans(streams, load - bus.taken, slowed)


def _fastest(groups: Sequence[_Group]) -> int:
    return min(period for period, _, _ in groups)


def _slowed(asked: int, fastest: int, rate: float | None, *, by_bus: bool) -> str:
    """Return the message if the shortest period (ns) became longer than requested; a ``--rate`` is refused instead."""
    if fastest <= asked * 1.000001:
        return ""
    possible = f"{1e9 / fastest:.6g}"
    if rate is not None:
        raise NoRoomError(
            f"{rate:g} Hz does not fit the bus ({MOST_LOAD:.0%} of it for data).",
            hint=f"The maximum is --rate {possible}",
        )
    why = "the bus does not allow more" if by_bus else "the node allows no shorter period"
    return f"slowed from {1e9 / asked:.6g} Hz to {possible} Hz: {why}"


def sensors_of(channels: Sequence[Channel], wanted: Sequence[int], kind: StreamKind | None) -> list[Channel]:
    """Return the sensors to measure: the requested ones, or all; raises BadDataError if one cannot be."""
    fitting = {channel.number: channel for channel in channels if channel.sample and channel.kind in _SENSORS_OF[kind]}
    for number in wanted:
        if number not in fitting:
            known = ", ".join(f"{channel.number} ({channel.name})" for channel in fitting.values())
            raise BadDataError(
                f"Channel {number} is not a sensor that can be measured this way.",
                hint=f"Those that can: {known}." if known else "The node has none.",
            )
    if not fitting:
        raise BadDataError("The datasheet has no sensor that can be measured this way.")
    return [fitting[number] for number in dict.fromkeys(wanted or fitting)]


_SENSORS_OF: dict[StreamKind | None, frozenset[ChannelKind]] = {
    None: frozenset({ChannelKind.SENSOR, ChannelKind.EVENT_SENSOR}),
    StreamKind.EVENT: frozenset({ChannelKind.EVENT_SENSOR}),
    StreamKind.PERIODIC: frozenset({ChannelKind.SENSOR}),
    StreamKind.FREE: frozenset({ChannelKind.SENSOR}),
}
_Paced = dict[tuple[int, StreamKind], list[Channel]]  # channels by period (ns) and kind of stream
_Group = tuple[int, StreamKind, list[Channel]]


def _groups(channels: Sequence[Channel], rate: float | None, kind: StreamKind | None, *, at_most: bool) -> list[_Group]:
    """Return channels by period and kind, at most 16 each; all at the slowest period if that makes too many streams."""
    paced: _Paced = {}
    for channel in channels:
        event = channel.kind == ChannelKind.EVENT_SENSOR
        how = StreamKind.EVENT if event else StreamKind.FREE if kind == StreamKind.FREE else StreamKind.PERIODIC
        paced.setdefault((period_of(channel, rate, at_most=at_most), how), []).append(channel)
    groups = _cut(paced)
    if len(groups) > LAST_STREAM + 1:
        groups = _cut(_at_the_slowest(paced))
    if len(groups) > LAST_STREAM + 1:
        raise PolicyError(
            f"{len(channels)} channels need {len(groups)} streams; a node has {LAST_STREAM + 1}.",
            hint="Select fewer with --channel.",
        )
    return groups


def _at_the_slowest(paced: _Paced) -> _Paced:
    """Return the channels all at the longest period; events, which have none, are unchanged."""
    slowest = max((period for period, how in paced if how != StreamKind.EVENT), default=0)
    together: _Paced = {}
    for (period, how), members in paced.items():
        together.setdefault((period if how == StreamKind.EVENT else slowest, how), []).extend(members)
    return together


def _cut(paced: _Paced) -> list[_Group]:
    groups: list[_Group] = []
    for (period, how), members in paced.items():
        step = 1 if how == StreamKind.EVENT else MOST_STREAM_CHANNELS
        # As evenly as possible: 25 channels as 13 and 12 make shorter messages than 16 and 9.
        parts = math.ceil(len(members) / step)
        size = math.ceil(len(members) / parts)
        groups += [(period, how, members[at : at + size]) for at in range(0, len(members), size)]
    return groups


def period_of(channel: Channel, rate: float | None, *, at_most: bool = False) -> int:
    """Return the ns between samples: of the rate, not below SPeriod; whole microseconds if it has to be."""
    stated = round(channel.period * 1e9) if math.isfinite(channel.period) and channel.period > 0 else 0
    if rate is None:
        return min(stated or UNSTATED, LONGEST)
    period = round(1e9 / rate)
    if at_most:
        period = max(period, stated)
    if period < stated * (1 - 1e-6):
        raise PolicyError(
            f"Channel {channel.number} gives at most {1e9 / stated:g} samples a second.",
            hint=f"Use --rate {1e9 / stated:g}",
        )
    return min(period, LONGEST)


def _plan(
    number: int, period: int, kind: StreamKind, members: list[Channel], bus: BusTime, test_pattern: bool, start: int
) -> StreamPlan:
    widths = tuple((channel.number, channel.sample.octets if channel.sample else 0) for channel in members)
    octets = sum(width for _, width in widths)
    most = most_instants(kind, octets, bus.airtime.most_octets)
    if most < 1:
        raise BadDataError(
            f"One sample of channels {', '.join(str(n) for n, _ in widths)} does not fit into a message."
        )
    n = max(1, min(most, BLOCK // period)) if kind != StreamKind.EVENT else 1
    plan = StreamPlan.for_channels(
        number, widths, n=n, period=period, kind=kind, start=start, test_pattern=test_pattern
    )
    # If the bus is nearly full, put more samples into a message: each message has 13 octets of overhead.
    while n < most and _load(plan, bus) > MOST_LOAD / 2 and kind != StreamKind.EVENT:
        n = min(most, 2 * n)
        plan = StreamPlan.for_channels(
            number, widths, n=n, period=period, kind=kind, start=start, test_pattern=test_pattern
        )
    return plan


def _load(plan: StreamPlan, bus: BusTime) -> float:
    return bus.airtime.load(plan.length, plan.subscribe.n, plan.subscribe.period)


def _gap(plans: Sequence[StreamPlan], bus: BusTime) -> int | None:
    """Return the µs between the node's data frames that spread them and let all leave in time, None for none."""
    unit = sum(share(bus.airtime.frames(plan.length), 1, plan.subscribe.n, plan.subscribe.period) for plan in plans)
    if unit > MILLION:
        return None
    return max(1, min(MOST_GAP, int(MILLION * NODE_SHARE / max(unit, 1))))
