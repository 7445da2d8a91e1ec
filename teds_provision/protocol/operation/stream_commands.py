"""Payloads of streams, Drive, Clock and Arm and their replies: builders and parsers for both roles (operation.md 4, 5).

``command`` gives the whole command. ``decode`` of a command (node side) raises CommandRefusedError with reason 4 for a
wrong form; ``decode`` of a reply (station side) raises GarbledError.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from teds_provision.errors import GarbledError
from teds_provision.protocol.messages.frames import Command, Function, security_command
from teds_provision.protocol.operation.commands import TEST_PATTERN, channel_list, demand_form

LAST_STREAM: Final = 3
MOST_STREAM_CHANNELS: Final = 16
WAITS: Final = 0xFFFFFFFFFFFFFFFF
"""``start`` of a stream that waits for a trigger."""
SOON: Final = 0
"""``start`` of a stream that begins when the node likes, within 1 s."""
NONE: Final = 0xFFFFFFFF
"""``last`` of Clock: no Drive message had a good tag yet."""


class StreamKind(IntEnum):
    """Kinds of sampling of a stream: periodic; one message per event; or periodic by the sensor's own clock."""

    PERIODIC = 0
    EVENT = 1
    FREE = 2


@dataclass(frozen=True)
class SubscribeCommand:
    """Subscribe (128.14): ``gap`` in µs, ``period`` and ``start`` in ns of the node's clock (start: SOON, WAITS)."""

    stream: int
    kind: StreamKind
    n: int
    gap: int
    period: int
    start: int
    channels: tuple[int, ...]
    test_pattern: bool = False

    def encode(self) -> bytes:
        """Return the payload."""
        kind = self.kind | (TEST_PATTERN if self.test_pattern else 0)
        head = struct.pack(">BBBHQQ", self.stream, kind, self.n, self.gap, self.period, self.start)
        return head + bytes(self.channels)

    def command(self) -> Command:
        """Return the command."""
        return security_command(Function.SUBSCRIBE, self.encode())

    @classmethod
    def decode(cls, payload: bytes) -> SubscribeCommand:
        """Decode the payload; checks its form by section 4 (form, stream, kind, n: 4)."""
        demand_form(len(payload) > 21)
        stream, kind, n, gap, period, start = struct.unpack_from(">BBBHQQ", payload)
        channels = channel_list(payload[21:], MOST_STREAM_CHANNELS)
        demand_form(stream <= LAST_STREAM and kind & ~TEST_PATTERN in set(StreamKind) and n >= 1)
        made = cls(stream, StreamKind(kind & ~TEST_PATTERN), n, gap, period, start, channels, bool(kind & TEST_PATTERN))
        demand_form(made.kind != StreamKind.EVENT or (n == 1 and len(channels) == 1))
        return made

    def length(self, octets: int) -> int:
        """Return the octets of each data message, if one instant of all channels has ``octets``."""
        return message_length(self.kind, self.n, octets)


def message_length(kind: StreamKind, n: int, octets: int) -> int:
    """Return 13 + n · Σ ModLenth, + 8 for kinds that carry their tick."""
    return 13 + n * octets + (0 if kind == StreamKind.PERIODIC else 8)


@dataclass(frozen=True)
class SubscribeReply:
    """Reply to Subscribe: run, length of each message in octets, first instant in ns (WAITS: not known yet)."""

    run: int
    length: int
    start: int

    def encode(self) -> bytes:
        """Return the 12 octets."""
        return struct.pack(">HHQ", self.run, self.length, self.start)

    @classmethod
    def decode(cls, payload: bytes) -> SubscribeReply:
        """Read the 12 octets; raises GarbledError."""
        if len(payload) != 12:
            raise GarbledError(f"A reply to Subscribe has 12 octets, this one {len(payload)}.")
        return cls(*struct.unpack(">HHQ", payload))


def stop(stream: int) -> Command:
    """Return the command that stops the stream (128.15)."""
    return security_command(Function.STOP, bytes([stream]))


def decode_stopped(payload: bytes) -> int:
    """Return the counter that the next message would have had; raises GarbledError."""
    if len(payload) != 4:
        raise GarbledError(f"A reply to Stop has 4 octets, this one {len(payload)}.")
    return int.from_bytes(payload, "big")


def drive(channels: Sequence[int]) -> Command:
    """Drive (128.20): values for these actuators by message."""
    return security_command(Function.DRIVE, bytes(channels))


@dataclass(frozen=True)
class DriveReply:
    """Reply to Drive: run, and length of each message in octets."""

    run: int
    length: int

    def encode(self) -> bytes:
        """Return the 4 octets."""
        return struct.pack(">HH", self.run, self.length)

    @classmethod
    def decode(cls, payload: bytes) -> DriveReply:
        """Read the 4 octets; raises GarbledError."""
        if len(payload) != 4:
            raise GarbledError(f"A reply to Drive has 4 octets, this one {len(payload)}.")
        return cls(*struct.unpack(">HH", payload))


# -- clock and trigger (section 5) -------------------------------------------------------------------------------------

CLOCK: Final = security_command(Function.CLOCK)


@dataclass(frozen=True)
class ClockReply:
    """Reply to Clock (128.16): ticks in ns, ``step`` in ns, ``drift`` in ppm; ``mark`` 0: none, ``last`` NONE: none."""

    received: int
    sent: int
    mark: int
    step: int
    drift: int
    last: int

    def encode(self) -> bytes:
        """Return the 34 octets."""
        return struct.pack(">QQQIHI", self.received, self.sent, self.mark, self.step, self.drift, self.last)

    @classmethod
    def decode(cls, payload: bytes) -> ClockReply:
        """Read the 34 octets; raises GarbledError."""
        if len(payload) != 34:
            raise GarbledError(f"A reply to Clock has 34 octets, this one {len(payload)}.")
        return cls(*struct.unpack(">QQQIHI", payload))


class Action(IntEnum):
    """Action of a trigger: note the tick, start the streams that wait, bring every actuator to its safe state."""

    MARK = 0
    START = 1
    STOP = 2


@dataclass(frozen=True)
class ArmCommand:
    """Arm (128.17): ``commitment`` C, ``life`` in s (0 disarms), ``action``; the range is the node's to check (19)."""

    commitment: bytes
    life: int
    action: int

    def command(self) -> Command:
        """Return the command."""
        return security_command(Function.ARM, self.commitment + bytes([self.life, self.action]))

    @classmethod
    def decode(cls, payload: bytes) -> ArmCommand:
        """Read the payload; raises CommandRefusedError (4)."""
        demand_form(len(payload) == 18)
        return cls(payload[:16], payload[16], payload[17])
