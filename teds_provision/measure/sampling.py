"""One reading now: Operate, Sample, Idle, over whichever link the node is on (operation.md section 2)."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from teds_provision.measure.clock import END_OF_TICKS, ClockMap, WallClock
from teds_provision.measure.planning import sensors_of
from teds_provision.measure.sinks.json_events import plain
from teds_provision.measure.verified_session import VerifiedSession, claim, exchange_clock
from teds_provision.protocol.operation.commands import MOST_SAMPLE_CHANNELS, SampleReply, idle, sample
from teds_provision.teds.calibration.interpreter import ChannelInterpreter
from teds_provision.teds.sheet import Channel, Sheet
from teds_provision.teds.units import WrittenUnit

LEASE = 5
ROOM = 180  # octets of data sets in one reply, so that it fits the maxMessage of any node


@dataclass(frozen=True)
class Sample:
    """One value; ``value`` and ``uncertainty`` in ``unit`` (SI), None if not valid or not stated.

    ``shown`` is the display unit, ``turn`` the beginning (in SI units) of the turn that an angle stays within; ``text``
    is that of the value table for this raw number.
    """

    channel: int
    name: str
    value: float | None
    unit: str
    raw: Any
    uncertainty: float | None
    valid: bool
    time: float
    why: str = ""
    shown: WrittenUnit | None = None
    turn: float | None = None
    text: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the object that `sample --json` prints."""
        members = {
            key: getattr(self, key) for key in ("channel", "name", "value", "unit", "raw", "uncertainty", "valid")
        }
        if self.shown is not None:
            members["shown"] = shown_json(self.value, self.uncertainty, self.shown)
        return {
            **members,
            "time": self.time,
            **({"text": self.text} if self.text else {}),
            **({"why": self.why} if self.why else {}),
        }


def shown_json(value: float | None, uncertainty: float | None, unit: WrittenUnit) -> dict[str, Any]:
    """Return a value and its uncertainty, given in SI, in the display unit: ``{"value", "unit", "uncertainty"}``."""
    return {
        "value": None if value is None else unit.from_si(value),
        "unit": unit.text,
        "uncertainty": None if uncertainty is None else abs(unit.difference_from_si(uncertainty)),
    }


def take_samples(trusted: VerifiedSession, numbers: Sequence[int]) -> list[Sample]:
    """Return fresh values of these channels (none: every sensor), sampled together as far as one reply holds them."""
    channels = sensors_of(trusted.sheet.channels, numbers, None)
    interpreters = _interpreters(trusted.sheet, [channel.number for channel in channels])
    clock, wall = ClockMap(), WallClock.now()
    for _ in range(3):
        exchange_clock(trusted.node, clock)
    for number in interpreters:
        claim(trusted, number, lease=LEASE)
    raws: dict[int, np.ndarray] = {}
    times: dict[int, float] = {}
    good: dict[int, bool] = {}
    for part in _parts(interpreters):
        width = sum(interpreters[number].octets for number in part)
        reply = SampleReply.decode(trusted.node.request(sample(part), "to sample"), width)
        at, stamp = 0, _moment(clock, wall, reply.tick)
        for number in part:
            one = interpreters[number]
            raws[number] = one.reader.raw(reply.data[at : at + one.octets])
            times[number], good[number] = stamp, reply.valid
            at += one.octets
    trusted.node.request(idle(0), "to let go")
    return [_sample(interpreters[channel.number], raws, good, times[channel.number]) for channel in channels]


def _moment(clock: ClockMap, wall: WallClock, tick: int) -> float:
    """Return the unix time of a sample that has just come; if the node's clock is dishonest, that of its arrival."""
    if clock.lie or tick >= END_OF_TICKS:
        return time.time()
    return float(wall.unix(np.array([clock.host_of(tick)]))[0])


def _interpreters(sheet: Sheet, asked: Sequence[int]) -> dict[int, ChannelInterpreter]:
    """Return the interpreters of these channels, then of those that their calibration needs."""
    found = {number: ChannelInterpreter(sheet, number) for number in asked}
    more = {other for interpreter in found.values() for other in interpreter.others}
    known = {channel.number for channel in sheet.channels}
    return found | {other: ChannelInterpreter(sheet, other) for other in sorted((more & known) - set(found))}


def _parts(interpreters: dict[int, ChannelInterpreter]) -> list[list[int]]:
    parts: list[list[int]] = [[]]
    size = 0
    for number, interpreter in interpreters.items():
        if parts[-1] and (size + interpreter.octets > ROOM or len(parts[-1]) == MOST_SAMPLE_CHANNELS):
            parts.append([])
            size = 0
        parts[-1].append(number)
        size += interpreter.octets
    return parts


def _missing(interpreter: ChannelInterpreter, raws: dict[int, np.ndarray]) -> str:
    missing = [other for other in interpreter.others if other not in raws]
    return f"channel {missing[0]}, which compensates it, is missing" if missing else ""


def _state(channel: Channel, raw: np.ndarray) -> str:
    """Return the text of a raw number in the channel's value table, "" if it has none."""
    number = raw.tolist()[0]
    return channel.value_table.get(number, "") if isinstance(number, int) else ""


def _sample(
    interpreter: ChannelInterpreter, raws: dict[int, np.ndarray], good: dict[int, bool], stamp: float
) -> Sample:
    channel = interpreter.channel
    why = interpreter.problem or _missing(interpreter, raws)
    value, valid = math.nan, False
    if not why:
        found = interpreter.values(raws[channel.number], {other: raws[other] for other in interpreter.others})
        valid = bool(found.valid[0]) and all(good[other] for other in (channel.number, *interpreter.others))
        value = interpreter.unit.to_si(float(found.value[0]))
        if not valid:
            flagged = not all(good[other] for other in (channel.number, *interpreter.others))
            reasons = interpreter.why_invalid(
                raws[channel.number], {other: raws[other] for other in interpreter.others}
            )
            why = "the node marks it as invalid" if flagged else next(iter(reasons), "")
    uncertainty = channel.stated_uncertainty
    return Sample(
        channel=channel.number,
        name=channel.name,
        value=plain(value) if valid else None,
        unit=channel.si_unit,
        raw=plain(raws[channel.number].tolist()[0]),
        uncertainty=plain(uncertainty),
        valid=valid,
        time=stamp,
        why=why,
        shown=channel.shown,
        text=_state(channel, raws[channel.number]) if valid else "",
        turn=channel.low if channel.full_turn else None,
    )
