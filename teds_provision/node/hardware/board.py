"""The hardware of a virtual transducer: the channels of the datasheet that it was made with, fed by a source.

It is what :class:`~teds_provision.protocol.operation.hardware.Hardware` asks of a firmware. Whatever datasheet is
written to the node later changes nothing here.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.node import sources
from teds_provision.node.hardware.clock import NANOSECONDS, NodeClock
from teds_provision.node.hardware.converter import Converter
from teds_provision.node.sources.base import Notify, Reading, Source, SourceChannel
from teds_provision.protocol.operation.commands import PowerFlag, PowerReply
from teds_provision.protocol.operation.hardware import ChannelHardware, RawReading
from teds_provision.teds.sheet import Channel, ChannelKind, Sheet

# The battery of a virtual transducer: charged in a reader's field, discharged outside it (operation.md section 7).

TOO_LOW: Final = 5.0
"""Per cent below which the node does not measure."""
_EMPTY_VOLTS, _FULL_VOLTS = 3.3, 4.2
_FULL: Final = 99.5
_CELSIUS: Final = 24


class Battery:
    """``level`` in per cent; ``charge`` and ``drain`` in per cent a minute. Thread-safe."""

    def __init__(
        self, level: float, *, charge: float = 2.0, drain: float = 0.1, host: Callable[[], float] = time.monotonic
    ) -> None:
        self._level, self._charge, self._drain, self._host = min(max(level, 0.0), 100.0), charge, drain, host
        self._at = host()
        self._in_field = False
        self._lock = threading.Lock()

    def field(self, *, present: bool) -> None:
        """Handle a charging field that came or went."""
        with self._lock:
            self._run()
            self._in_field = present

    def power(self) -> PowerReply:
        """Return the present reply to Power (128.18)."""
        with self._lock:
            self._run()
            level, in_field = self._level, self._in_field
        charging = in_field and level < _FULL
        flags = PowerFlag.BATTERY
        flags |= PowerFlag.CHARGING if charging else PowerFlag(0)
        flags |= PowerFlag.FULL if level >= _FULL else PowerFlag(0)
        flags |= PowerFlag.IN_FIELD if in_field else PowerFlag(0)
        flags |= PowerFlag.TOO_LOW if level < TOO_LOW else PowerFlag(0)
        volts = _EMPTY_VOLTS + (_FULL_VOLTS - _EMPTY_VOLTS) * level / 100
        return PowerReply(flags, round(level), volts, 0.05 if charging else -0.002, _CELSIUS)

    def _run(self) -> None:
        now = self._host()
        rate = self._charge if self._in_field else -self._drain
        self._level = min(max(self._level + rate * (now - self._at) / 60, 0.0), 100.0)
        self._at = now


_DRIFT: Final = 50
_DRIFT_OF_SIMULATION: Final = 0xFFFF
_SELF_TEST: Final = 0.1
_LONGEST_SELF_TEST: Final = 10.0
_TOLERANCE: Final = 0.5  # raw numbers of integer channels: limits are rounded to the nearest
_PPM: Final = 1e-6


@dataclass(frozen=True)
class ActuatorReading:
    """State of an actuator: its raw number, the value in ``unit`` (None if unknown), and whether it is safe.

    ``time`` is when it began, unix seconds.
    """

    channel: int
    name: str
    value: float | None
    unit: str
    raw: float
    safe: bool
    time: float = field(default_factory=time.time, compare=False)


class Board:
    """Channels of ``sheet``; ``source`` is the text of ``--source``, or a source that was made already.

    ``lag`` is how many nanoseconds after its tick a sample is taken, for a source that learns of it late. ``shown`` is
    called with the state of actuators, from any thread, and must return at once; ``notify`` receives
    messages for people. Raises BadDataError if a channel cannot be imitated, and errors of the source.
    """

    def __init__(
        self,
        sheet: Sheet,
        *,
        source: str | Source = "noise",
        clock: NodeClock | None = None,
        battery: Battery | None = None,
        lag: int = 0,
        shown: Callable[[ActuatorReading], None] = lambda shown: None,
        notify: Notify = lambda text: None,
    ) -> None:
        self.clock = clock or NodeClock()
        self.battery, self.lag = battery, lag
        self.shown, self.notify = shown, notify
        self.faults: set[int] = set()
        self.sampling: int | None = None
        self._lock = threading.Lock()
        kinds = {channel.number: channel for channel in sheet.channels if channel.kind is not None}
        self._facts = kinds
        self.channels: Mapping[int, ChannelHardware] = {n: _facts(channel) for n, channel in kinds.items()}
        self.converters = {number: Converter(sheet, channel) for number, channel in kinds.items()}
        self._test_seconds = _self_test_seconds(sheet.meta.self_test_time)
        self._seen: dict[int, RawReading | None] = dict.fromkeys(
            [n for n, facts in self.channels.items() if facts.kind is ChannelKind.EVENT_SENSOR]
        )
        self._testing: dict[int, int] = {}
        self._safe_state = {n: self._lowest(n) for n, facts in self.channels.items() if facts.actuator}
        self._bounds = {number: self._raw_limits(number) for number in self._safe_state}
        self._set_points = dict(self._safe_state)
        self.source = sources.make_source(source, self.places, notify) if isinstance(source, str) else source

    @property
    def places(self) -> list[SourceChannel]:
        """The sensors, as sources see them."""
        return [self.converters[n].place for n, facts in self.channels.items() if not facts.actuator]

    def start(self) -> None:
        """Let the source begin."""
        self.source.start(self.clock)

    def stop(self) -> None:
        """Bring every actuator to its safe state, and end the source."""
        for channel in self._safe_state:
            self.make_safe(channel)
        self.source.stop()

    # -- clock -----------------------------------------------------------------------------------------------------

    @property
    def step(self) -> int:
        """Step of the clock, ns."""
        return self.clock.step

    @property
    def drift(self) -> int:
        """Drift in ppm; the rate of a simulation's time is unknown."""
        return _DRIFT if self.clock.runs_by_itself else _DRIFT_OF_SIMULATION

    def now(self) -> int:
        """Return the present tick, or the one up to which samples are being taken."""
        return self.clock.tick() if self.sampling is None else self.sampling

    def keeps(self, period: int) -> bool:
        """Return True for any whole number of nanoseconds: it is kept on average."""
        return period > 0

    # -- sensors ---------------------------------------------------------------------------------------------------

    def read(self, channel: int, tick: int) -> RawReading:
        """Return the source's value for ``tick``; zeros that are not valid if it has none."""
        given = self.source.at(channel, tick / NANOSECONDS)
        converter = self.converters[channel]
        if given is None or channel in self.faults:
            return RawReading(bytes(converter.form.octets), valid=False)
        try:
            return RawReading(converter.octets(given))
        except BadDataError:  # the curve has no inverse here, so there is no sample
            return RawReading(bytes(converter.form.octets), valid=False)

    @property
    def has_events(self) -> bool:
        """True if it has event sensors."""
        return bool(self._seen)

    def events(self) -> Iterator[tuple[int, int, RawReading]]:
        """Yield the event sensors that changed since the last look: channel, tick, reading."""
        tick = self.now()
        for channel, before in list(self._seen.items()):
            reading = self.read(channel, tick)
            if reading != before:
                self._seen[channel] = reading
                if before is not None:
                    yield channel, tick, reading

    # -- actuators -------------------------------------------------------------------------------------------------

    def accepts(self, channel: int, data_set: bytes) -> bool:
        """Return True if a raw value is between those of LowLimit and HiLimit."""
        low, high = self._bounds[channel]
        return low <= self.converters[channel].raw_of(data_set) <= high

    def apply(self, values: Mapping[int, bytes]) -> None:
        """Show the new values of actuators, and pass them to the source."""
        with self._lock:
            self._set_points.update(values)
        for channel in values:
            self._show(channel, safe=False)

    def set_point(self, channel: int) -> bytes:
        """Return the present value of an actuator."""
        return self._set_points[channel]

    def make_safe(self, channel: int) -> None:
        """Bring an actuator to its safe state: LowLimit."""
        with self._lock:
            self._set_points[channel] = self._safe_state[channel]
        self._show(channel, safe=True)

    def _show(self, channel: int, *, safe: bool) -> None:
        facts, converter, octets = self._facts[channel], self.converters[channel], self._set_points[channel]
        value = converter.value(octets)
        self.shown(ActuatorReading(channel, facts.name, value, facts.unit.text, converter.raw_of(octets), safe))
        if facts.name and value is not None:
            self.source.acted({facts.name: value})

    def _lowest(self, channel: int) -> bytes:
        converter = self.converters[channel]
        try:
            return converter.octets(Reading(value=converter.low) if math.isfinite(converter.low) else Reading(raw=0.0))
        except BadDataError:
            return bytes(converter.form.octets)

    def _raw_limits(self, channel: int) -> tuple[float, float]:
        """Return the raw numbers that the hardware accepts, rounded outwards by half a step.

        All if the sheet has none.
        """
        converter = self.converters[channel]
        try:
            ends = sorted(converter.raw(limit) for limit in (converter.low, converter.high))
        except (BadDataError, OverflowError):
            return -math.inf, math.inf
        if not all(map(math.isfinite, ends)):
            return -math.inf, math.inf
        slack = _TOLERANCE if converter.form.integer else _PPM * max(map(abs, ends))
        return ends[0] - slack, ends[1] + slack

    # -- self-test, faults, power ----------------------------------------------------------------------------------

    def self_test(self, channels: Sequence[int]) -> None:
        """Run the self-test: it takes TestTime of the Meta-TEDS, 0.1 s to 10 s, and always passes."""
        end = self.now() + round(self._test_seconds * NANOSECONDS)
        self._testing.update(dict.fromkeys(channels, end))

    def testing(self, channel: int) -> bool:
        """Return True if the channel's self-test runs."""
        return self.now() < self._testing.get(channel, 0)

    def fault(self, channel: int) -> bool:
        """Return True if a test put a fault in (``faults``)."""
        return channel in self.faults

    def power(self) -> PowerReply:
        """Return battery and charge; nothing is known without a battery."""
        return self.battery.power() if self.battery is not None else PowerReply()


def _self_test_seconds(stated: float) -> float:
    return min(max(stated, _SELF_TEST), _LONGEST_SELF_TEST) if math.isfinite(stated) else _SELF_TEST


def _facts(channel: Channel) -> ChannelHardware:
    if channel.sample is None or channel.kind is None:
        raise BadDataError(f"The datasheet does not say how a sample of channel {channel.number} is coded.")
    period = channel.period if math.isfinite(channel.period) and channel.period > 0 else 0.0
    return ChannelHardware(
        ChannelKind(channel.kind),
        channel.sample.octets,
        channel.sample.model,
        channel.halt,
        shortest=max(1, math.floor(period * NANOSECONDS * (1 - _PPM))),
    )
