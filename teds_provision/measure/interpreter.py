"""From the messages of a stream to blocks of values: the papers' interpreter, fed by one stream.

No line here knows a sensor. Messages are gathered for a moment and calibrated in blocks, with everything prepared when
the stream begins.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np

from teds_provision.measure.blocks import Block, InvalidValues
from teds_provision.measure.clock import ClockMap, HostClock, MonotonicStamps
from teds_provision.protocol.operation.stream_commands import StreamKind
from teds_provision.protocol.operation.subscription import StreamMessage, StreamPlan
from teds_provision.teds.calibration.interpreter import ChannelInterpreter
from teds_provision.teds.calibration.vectorized import ManyChannels
from teds_provision.teds.sheet import Sheet

NODE_SAYS_SO = "the node marks them as invalid"
QUICK, BLOCKS = 20, 64
"""Messages a second from which all values of a stream are calibrated beforehand, and after how many of its blocks: the
first value does not wait for that, and two hundred slow nodes have no table of half a megabyte each."""
_SECOND = 1_000_000_000


class StreamInterpreter:
    """Messages of one run in, blocks out. ``problems`` lists channels with raw values only, and why.

    ``raw_only`` is a reason why no channel has values. Used by one thread.
    """

    def __init__(
        self,
        sheet: Sheet,
        plan: StreamPlan,
        run: int,
        clock: ClockMap,
        host: HostClock,
        monotone: MonotonicStamps,
        *,
        raw_only: str = "",
    ) -> None:
        self._plan, self._run, self._clock, self._host = plan, run, clock, host
        self._uuid = sheet.uuid.hex()
        self._monotone = monotone
        self._channels = [ChannelInterpreter(sheet, number) for number in plan.layout.channels]
        places, at = [], 0
        for width in plan.layout.widths:
            places.append(slice(at, at + width))
            at += width
        self._places = places
        self._row = at
        self._period, self._n = plan.subscribe.period, plan.subscribe.n
        self._even = plan.subscribe.kind == StreamKind.PERIODIC
        self._free, self._real = plan.subscribe.kind == StreamKind.FREE, float(self._period)  # ns between its instants
        self._before: StreamMessage | None = None
        self._stream, self._numbers = plan.subscribe.stream, plan.layout.channels
        self._test_pattern = plan.subscribe.test_pattern
        self._steps, self._seconds = np.zeros(0, dtype=np.uint64), np.zeros(0)  # of instants: ns, s after the first
        present = set(plan.layout.channels)
        why = {interpreter.channel.number: raw_only or _why_raw(interpreter, present) for interpreter in self._channels}
        self.problems = {number: reason for number, reason in why.items() if reason}

        usable = [interpreter.channel.number not in self.problems for interpreter in self._channels]
        self._many = ManyChannels.side_by_side(self._channels, usable)
        quick = self._period * self._n * QUICK <= _SECOND
        self._until_calibrated = BLOCKS if quick else 0
        self._invalid: dict[tuple[int, str], int] = {}

    @property
    def invalid(self) -> tuple[InvalidValues, ...]:
        """How many values of the run were not valid, and why. Of any thread."""
        return tuple(InvalidValues(channel, why, count) for (channel, why), count in self._invalid.copy().items())

    def blocks(self, messages: Sequence[StreamMessage]) -> list[Block]:
        """Return messages as blocks: one for each run of consecutive messages, a new one after each gap."""
        if not messages:
            return []
        if len(messages) == 1:
            return [self._block(messages)]
        if self._even and messages[-1].index - messages[0].index == (len(messages) - 1) * self._n:
            return [self._block(messages)]
        done, begin = [], 0
        for end in range(1, len(messages) + 1):
            follows = end < len(messages) and self._even and messages[end].index == messages[end - 1].index + self._n
            if not follows:
                done.append(self._block(messages[begin:end]))
                begin = end
        return done

    def _block(self, messages: Sequence[StreamMessage]) -> Block:
        first, count = messages[0], len(messages) * self._n
        if len(messages) == 1:
            octets, flags = first.data, first.flags
        else:
            octets, flags = (
                b"".join([message.data for message in messages]),
                max([message.flags for message in messages]),
            )
        raws, value, valid = self._values(octets)
        flagged = None
        if flags:
            counted = [message.valid and not message.test_pattern for message in messages]
            flagged = ~np.repeat(counted, self._n)
            valid = valid & ~flagged[:, None]
            value = np.where(valid, value, np.nan)
        if not self._test_pattern and np.count_nonzero(valid) < valid.size:
            self._count_invalid(raws, valid, flagged)
        steps, seconds = self._spaced(first, count)
        span = int(steps[-1])
        # Whole nanoseconds first: as floats, a tick of months and an offset of years would lose microseconds.
        host, rate, bound = self._clock.line(first.tick, first.tick + span)
        times = seconds * rate
        times += host / 1e9
        times = self._monotone.stamp_line(times)
        setting, offset = self._host.present
        return Block(
            uuid=self._uuid,
            stream=self._stream,
            channels=self._numbers,
            index=first.index,
            time=times + offset,
            tick=steps + first.tick,
            raw=raws,
            value=value,
            valid=valid,
            age=time.monotonic() - (host + span * rate) / 1e9,
            clock_error=bound + self._host.apart if bound < math.inf and not self._clock.lie else None,
            test_pattern=self._test_pattern,
            run=self._run,
            clock=setting,
        )

    def _count_invalid(self, raws: np.ndarray, valid: np.ndarray, flagged: np.ndarray | None) -> None:
        """Count why values of a block are not valid; ``flagged`` marks instants that the node itself reports so."""
        places = {number: k for k, number in enumerate(self._numbers)}
        for k, interpreter in enumerate(self._channels):
            bad = ~valid[:, k]
            if not bad.any():
                continue
            found: dict[str, int] = {}
            if interpreter.channel.number in self.problems:
                found[self.problems[interpreter.channel.number].removesuffix(".")] = int(np.count_nonzero(bad))
            else:
                if flagged is not None and flagged.any():
                    found[NODE_SAYS_SO] = int(np.count_nonzero(bad & flagged))
                    bad &= ~flagged
                others = {number: raws[bad, places[number]] for number in interpreter.others}
                found |= interpreter.why_invalid(raws[bad, k], others)
            for why, count in found.items():
                key = interpreter.channel.number, why
                self._invalid[key] = self._invalid.get(key, 0) + count

    def _spaced(self, first: StreamMessage, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return how long after the first one so many instants are, in ns and in seconds.

        The period of a free-running stream follows from its ticks; the requested one is nominal (operation.md 3).
        """
        if self._free:
            before, self._before = self._before, first
            if before is not None:
                real = (first.tick - before.tick) / (first.index - before.index)
                self._real = real if self._period / 2 <= real <= self._period * 2 else self._real
            steps = np.rint(np.arange(count) * self._real).astype(np.uint64)
            return steps, steps / 1e9
        if len(self._steps) < count:
            self._steps = np.arange(count, dtype=np.uint64) * np.uint64(self._period)
            self._seconds = self._steps / 1e9
        return self._steps[:count], self._seconds[:count]

    def _values(self, octets: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return raw values, values (NaN if not valid), and validity of the instants in messages."""
        if self._many is not None:
            if self._until_calibrated:
                self._until_calibrated -= 1
                if not self._until_calibrated:
                    self._many.calibrate_all()
            raws = self._many.raw(octets)
            return raws, *self._many.values(raws)
        rows = np.frombuffer(octets, dtype=np.uint8).reshape(-1, self._row)
        columns = [
            interpreter.reader.raw(rows[:, place])
            for interpreter, place in zip(self._channels, self._places, strict=True)
        ]
        by_number = dict(zip(self._plan.layout.channels, columns, strict=True))
        value = np.full((len(rows), len(columns)), np.nan)
        valid = np.zeros(value.shape, dtype=bool)
        for k, interpreter in enumerate(self._channels):
            if interpreter.channel.number in self.problems:
                continue
            found = interpreter.values(columns[k], {number: by_number[number] for number in interpreter.others})
            value[:, k] = interpreter.unit.to_si(found.value)  # type: ignore[arg-type]  # an array is scaled as a number is
            valid[:, k] = found.valid
        return _together(columns), np.where(valid, value, np.nan), valid


def _why_raw(interpreter: ChannelInterpreter, present: set[int]) -> str:
    if interpreter.problem:
        return interpreter.problem
    missing = [number for number in interpreter.others if number not in present]
    if missing:
        other = missing[0]
        return (
            f"Channel {interpreter.channel.number} is compensated by channel {other}, which is not part of the same "
            "stream."
        )
    return ""


def _exact_as_float(column: np.ndarray) -> bool:
    return bool(column.dtype.kind == "f" or column.max() < 2**53)


def _together(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Return columns as one array of a dtype that holds each raw value exactly."""
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
