"""From the messages of a stream to blocks of values: the papers' interpreter, fed by one stream.

No line here knows a sensor. Messages are gathered for a moment and calibrated in blocks, with everything prepared when
the stream begins.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from teds_provision.measure.blocks import Block
from teds_provision.measure.clock import ClockMap, Monotone, Wall
from teds_provision.protocol.operation.stream_commands import Kind
from teds_provision.protocol.operation.subscription import Message, Plan
from teds_provision.teds.calibration.interpreter import ChannelInterpreter
from teds_provision.teds.calibration.together import Together
from teds_provision.teds.sheet import Sheet


class StreamInterpreter:
    """Messages of one run in, blocks out. ``problems`` says of which channels there are raw values only, and why.

    ``raw_only`` is a reason for which no channel has values. Used by one thread.
    """

    def __init__(
        self, sheet: Sheet, plan: Plan, run: int, clock: ClockMap, wall: Wall, monotone: Monotone, *, raw_only: str = ""
    ) -> None:
        self._plan, self._run, self._clock, self._wall = plan, run, clock, wall
        self._uuid = sheet.uuid.hex()
        self._monotone = monotone
        self._channels = [ChannelInterpreter(sheet, number) for number in plan.layout.channels]
        places, at = [], 0
        for width in plan.layout.widths:
            places.append(slice(at, at + width))
            at += width
        self._places = places
        self._row = at
        self._steps = np.arange(plan.subscribe.n, dtype=np.uint64) * np.uint64(plan.subscribe.period)
        self._waiting: list[Message] = []
        self._since = 0.0
        present = set(plan.layout.channels)
        why = {one.channel.number: raw_only or _why_raw(one, present) for one in self._channels}
        self.problems = {number: reason for number, reason in why.items() if reason}

        usable = [one.channel.number not in self.problems for one in self._channels]
        self._together = Together.of(self._channels, usable)

    @property
    def waiting_since(self) -> float:
        """Monotonic time since which a message waits; 0 where none does."""
        return self._since if self._waiting else 0.0

    def take(self, message: Message) -> Block | None:
        """A message; gives the block before it where this one does not follow on from it."""
        done = None
        if self._waiting:
            last = self._waiting[-1]
            if message.index != last.index + self._plan.subscribe.n or self._plan.subscribe.kind != Kind.PERIODIC:
                done = self.flush()
        if not self._waiting:
            self._since = time.monotonic()
        self._waiting.append(message)
        return done

    def flush(self) -> Block | None:
        """What waits, as one block."""
        messages, self._waiting = self._waiting, []
        if not messages:
            return None
        plan, n = self._plan, self._plan.subscribe.n
        octets = np.frombuffer(b"".join(message.data for message in messages), dtype=np.uint8)
        rows = octets.reshape(len(messages) * n, self._row)
        first = np.array([message.tick for message in messages], dtype=np.uint64)
        ticks = (first[:, None] + self._steps).ravel()
        host = self._clock.host(ticks)
        raws, value, valid = self._values(rows)
        told = [message.valid and not message.test_pattern for message in messages]
        if not all(told):
            valid = valid & np.repeat(told, n)[:, None]
            value = np.where(valid, value, np.nan)
        bound = self._clock.bound(int(ticks[-1]))
        return Block(
            uuid=self._uuid,
            stream=plan.subscribe.stream,
            channels=plan.layout.channels,
            index=messages[0].index,
            time=self._monotone(self._wall.unix(host)),
            tick=ticks,
            raw=raws,
            value=value,
            valid=valid,
            age=time.monotonic() - float(host[-1]),
            clock_error=bound if np.isfinite(bound) else None,
            test_pattern=plan.subscribe.test_pattern,
            run=self._run,
        )

    def _values(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Raw values, values (NaN where not valid), and which are valid, of instants as they stand in messages."""
        if self._together is not None:
            raws = self._together.raw(rows)
            return raws, *self._together.values(raws)
        columns = [one.reader.raw(rows[:, place]) for one, place in zip(self._channels, self._places, strict=True)]
        by_number = dict(zip(self._plan.layout.channels, columns, strict=True))
        value = np.full((len(rows), len(columns)), np.nan)
        valid = np.zeros(value.shape, dtype=bool)
        for k, one in enumerate(self._channels):
            if one.channel.number in self.problems:
                continue
            found = one.values(columns[k], {number: by_number[number] for number in one.others})
            value[:, k] = one.unit.to_si(found.value)  # type: ignore[arg-type]  # an array is scaled as a number is
            valid[:, k] = found.valid
        return _together(columns), np.where(valid, value, np.nan), valid


def _why_raw(one: ChannelInterpreter, present: set[int]) -> str:
    if one.problem:
        return one.problem
    missing = [number for number in one.others if number not in present]
    if missing:
        return f"Channel {one.channel.number} is compensated by channel {missing[0]}, which is not in the same stream."
    return ""


def _exact_as_float(column: np.ndarray) -> bool:
    return bool(column.dtype.kind == "f" or column.max() < 2**53)


def _together(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Columns as one array of a dtype that holds each raw value exactly."""
    kinds = {column.dtype for column in columns}
    numbers = all(kind.kind != "O" for kind in kinds)
    if numbers and len(kinds) == 1:
        return np.column_stack(columns)
    if numbers and all(map(_exact_as_float, columns)):
        return np.column_stack([column.astype(np.float64) for column in columns])
    mixed = np.empty((len(columns[0]), len(columns)), dtype=object)
    for k, column in enumerate(columns):
        mixed[:, k] = column.tolist()
    return mixed
