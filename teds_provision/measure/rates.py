"""The rate that bus, budget and machine can carry: proposed before a measurement, and after a run that lost values."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from teds_provision.errors import NoRoomError
from teds_provision.measure.matching import NodeLoad
from teds_provision.measure.planning import BusTime, period_of, plan_node
from teds_provision.measure.request import MeasurementRequest
from teds_provision.protocol.operation.budget import MOST_LOAD
from teds_provision.sanitize import counted
from teds_provision.station.station import Station
from teds_provision.teds.sheet import Channel, ChannelKind, Sheet

VALUES: Final = 50_000.0
"""Values a second that an idle machine with two cores recorded without losing one (docs/speed.md)."""
SPARE: Final = 0.8  # share of the rate that arrived in a run with losses
LEAST: Final = 0.1  # Hz
BELOW: Final = 0.999  # factor below a rate; the next lower step is searched for from there
_STEPS: Final = (5.0, 2.0, 1.0)
Limit = Literal["datasheet", "bus", "budget", "machine"]


@dataclass(frozen=True)
class RateProposal:
    """``rate`` in Hz for all channels; ``stated`` is the fastest that the datasheets give, ``limit`` what is slower."""

    rate: float
    stated: float
    limit: Limit
    why: str


@dataclass(frozen=True)
class Surroundings:
    """Limits around a measurement: the node's link (None: not known), messages to topics, values of this machine."""

    bus: Callable[[bytes], tuple[str, BusTime] | None] = lambda _uuid: None
    budget: float | None = None
    rows: bool = False
    scalar_rate: float = 10.0
    values: float = VALUES
    busy: str = ""


def this_machine() -> tuple[float, str]:
    """Return the values a second that this machine has room for, and why if it is busy: it shares its processors."""
    cores = os.cpu_count() or 1
    try:
        load = os.getloadavg()[0]
    except OSError:  # the system does not report it
        return VALUES, ""
    free = min(1.0, cores / (1.0 + load))
    return VALUES * free, f"this machine is busy (load {load:.0f} on {counted(cores, 'core')})" if free < 1.0 else ""


def lower_rate(rate: float, messages: int, lost: int) -> float:
    """Return the rate to try after so many messages came and so many were lost."""
    return rounded_down(SPARE * rate * messages / max(1, messages + lost))


def rounded_down(rate: float) -> float:
    """Return the next lower of 1, 2, 5, 10, 20, 50 … (:data:`LEAST` at least)."""
    decade = 1e6
    while decade >= LEAST:
        for step in _STEPS:
            if step * decade <= rate * (1 + 1e-9):
                return step * decade
        decade = round(decade / 10, 6)
    return LEAST


def propose(
    station: Station, uuids: Sequence[bytes], request: MeasurementRequest, around: Surroundings
) -> RateProposal | None:
    """Return the rate that can be carried; None if no datasheet of these nodes states one."""
    sensors = {uuid: found for uuid in uuids if (found := _sensors(station, uuid, request))}
    if not sensors:
        return None
    rates = [rate for own in sensors.values() for rate in _rates(own)]
    stated, slowest = max(rates), min(rates)
    limit = _limit(sensors, stated, around)
    if limit is None:
        return RateProposal(stated, stated, "datasheet", "")
    rate = min(slowest, rounded_down(BELOW * stated))
    while rate > LEAST and _limit(sensors, rate, around) is not None:
        rate = rounded_down(BELOW * rate)
    return RateProposal(rate, stated, limit, _why(limit, around))


def _why(limit: Limit, around: Surroundings) -> str:
    if limit == "machine":
        return around.busy or f"this machine records about {around.values:.0f} values/s"
    if limit == "budget":
        return f"topics take {around.budget:g} messages/s"
    return f"data may take {MOST_LOAD:.0%} of the bus"


def _sensors(station: Station, uuid: bytes, request: MeasurementRequest) -> list[Channel]:
    """Return the sensors of a node that are sampled at a rate, and requested."""
    image = station.datasheets.datasheet(uuid)
    channels = Sheet.from_image(image).channels if image is not None else ()
    wanted = request.channels
    return [
        channel
        for channel in channels
        if channel.kind is ChannelKind.SENSOR and channel.sample and (not wanted or channel.number in wanted)
    ]


def _rates(sensors: Sequence[Channel]) -> list[float]:
    return [1e9 / period_of(sensor, None) for sensor in sensors]


def _limit(sensors: Mapping[bytes, Sequence[Channel]], rate: float, around: Surroundings) -> Limit | None:
    """Return what cannot carry this rate, None if all can; a slower channel keeps its rate."""
    own = {uuid: _rates(channels) for uuid, channels in sensors.items()}
    if sum(min(rate, own_rate) for rates in own.values() for own_rate in rates) > around.values:
        return "machine"
    if around.budget is not None:
        loads = [NodeLoad(None, len(rates), min(rate, max(rates))) for rates in own.values()]
        if sum(load.messages(around.scalar_rate, around.rows) for load in loads) > around.budget:
            return "budget"
    used: dict[str, float] = {}
    for uuid, channels in sensors.items():
        place = around.bus(uuid)
        if place is None:
            continue
        name, time = place
        try:
            used[name] = used.get(name, time.taken) + plan_node(channels, time, rate=rate, at_most=True).load
        except NoRoomError:
            return "bus"
    return "bus" if any(share > MOST_LOAD for share in used.values()) else None
