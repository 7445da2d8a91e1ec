"""Payloads of claims and single values and their replies: builders and parsers for both roles (operation.md 1, 2).

``encode`` gives the octets of a payload, ``command`` the whole command. ``decode`` of a command (node side) raises
Refused with reason 4 for a wrong form; ``decode`` of a reply (station side) raises GarbledError.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntFlag
from typing import Any, Final

from teds_provision.errors import GarbledError
from teds_provision.protocol.messages.frames import (
    COMMON,
    EITHER,
    OPERATE,
    Command,
    CommandRefusedError,
    Function,
    Reason,
    security_command,
)

DIGEST_OCTETS: Final = 16
OPERATE_FUNCTION, IDLE_FUNCTION = 1, 2
READ_FUNCTION, WRITE_FUNCTION = 1, 2
SELF_TEST_FUNCTION: Final = 5
FIRST_LEASE, LAST_LEASE = 1, 60
FIRST_DEAD_MAN, LAST_DEAD_MAN = 20, 10_000
MOST_SAMPLE_CHANNELS: Final = 64
TEST_PATTERN: Final = 0x80
"""Bit 7 of a stream's kind and of a message's flags."""
NOT_VALID: Final = 0x01
"""Bit 0 of flags: some value is not valid."""


def demand_form(holds: bool) -> None:
    """Raise CommandRefusedError with reason 4 unless ``holds``."""
    if not holds:
        raise CommandRefusedError(Reason.BAD_FORM)


def channel_list(octets: bytes, most: int) -> tuple[int, ...]:
    """Read a list of 1 to ``most`` channels, each 1 to 255 and once; raises CommandRefusedError (4)."""
    demand_form(1 <= len(octets) <= most and 0 not in octets and len(set(octets)) == len(octets))
    return tuple(octets)


# -- claims (section 1) ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OperateCommand:
    """Operate (4.1): claims ``channel`` (0: every sensor); ``lease`` in s, ``dead_man`` in ms for an actuator alone."""

    channel: int
    digest: bytes
    lease: int
    dead_man: int | None = None

    def command(self) -> Command:
        """Return the command."""
        payload = self.digest + bytes([self.lease])
        if self.dead_man is not None:
            payload += struct.pack(">H", self.dead_man)
        return Command(self.channel, EITHER, OPERATE_FUNCTION, payload)

    @classmethod
    def decode(cls, channel: int, payload: bytes, *, actuator: bool) -> OperateCommand:
        """Read the payload for a sensor (or 0) or an actuator."""
        demand_form(len(payload) == DIGEST_OCTETS + (3 if actuator else 1))
        dead_man = int.from_bytes(payload[17:], "big") if actuator else None
        return cls(channel, payload[:DIGEST_OCTETS], payload[DIGEST_OCTETS], dead_man)


def idle(channel: int = 0) -> Command:
    """Return Idle (4.2), which releases one channel, or all for 0."""
    return Command(channel, EITHER, IDLE_FUNCTION)


class ChannelState(IntFlag):
    """State bits of a channel in the reply to Operation."""

    ACTUATOR = 1
    CLAIMED_HERE = 2
    CLAIMED_BY_OTHER = 4
    EVENT_SENSOR = 8
    SAFE = 16
    STOPPED = 32
    TESTING = 64
    FAULT = 128


@dataclass(frozen=True)
class OperationReply:
    """Reply to Operation (128.19): mode, and for each channel its state bits and claimant (source address, 0 none)."""

    measuring: bool
    channels: Mapping[int, tuple[ChannelState, int]]

    def encode(self) -> bytes:
        """Return mode ‖ (channel ‖ state ‖ claimant) …, ascending."""
        rows = (bytes([channel, *self.channels[channel]]) for channel in sorted(self.channels))
        return bytes([self.measuring]) + b"".join(rows)

    @classmethod
    def decode(cls, payload: bytes) -> OperationReply:
        """Read the reply; raises GarbledError."""
        if len(payload) % 3 != 1 or payload[0] > 1:
            raise GarbledError("The node's reply to Operation has a wrong form.")
        numbers = payload[1::3]
        if list(numbers) != sorted(set(numbers)) or 0 in numbers:
            raise GarbledError("The node's reply to Operation does not ascend.")
        states = zip(map(ChannelState, payload[2::3]), payload[3::3], strict=True)
        return cls(payload[0] == 1, dict(zip(numbers, states, strict=True)))


OPERATION: Final = security_command(Function.OPERATION)


# -- one value at a time (section 2) -----------------------------------------------------------------------------------


def read_data_set(channel: int) -> Command:
    """Read data-set segment (3.1) of one channel, from offset 0."""
    return Command(channel, OPERATE, READ_FUNCTION, bytes(4))


def decode_data_set(payload: bytes, octets: int) -> bytes:
    """Return the data set of a reply to 3.1.

    Raises GarbledError if it does not hold ``octets`` octets from offset 0 on.
    """
    if len(payload) != 4 + octets or payload[:4] != bytes(4):
        raise GarbledError(f"A data set of {octets} octets came as {max(0, len(payload) - 4)}.")
    return payload[4:]


def write_data_set(channel: int, data_set: bytes) -> Command:
    """Write data-set segment (3.2) of one actuator, from offset 0."""
    return Command(channel, OPERATE, WRITE_FUNCTION, bytes(4) + data_set)


def sample(channels: Sequence[int]) -> Command:
    """Sample (128.12): these channels together, 1 to 64."""
    return security_command(Function.SAMPLE, bytes(channels))


@dataclass(frozen=True)
class SampleReply:
    """Reply to Sample: ``tick`` (ns) of the first value, flags, the data sets in the order asked."""

    tick: int
    flags: int
    data: bytes

    def encode(self) -> bytes:
        """Return tick ‖ flags ‖ data sets."""
        return struct.pack(">QB", self.tick, self.flags) + self.data

    @classmethod
    def decode(cls, payload: bytes, octets: int) -> SampleReply:
        """Read the reply whose data sets have ``octets`` octets together; raises GarbledError."""
        if len(payload) != 9 + octets:
            raise GarbledError(f"A reply to Sample has {len(payload)} octets, not {9 + octets}.")
        return cls(int.from_bytes(payload[:8], "big"), payload[8], payload[9:])

    @property
    def valid(self) -> bool:
        """True if every value is valid."""
        return not self.flags & NOT_VALID


def set_values(values: Iterable[tuple[int, bytes]]) -> Command:
    """Set (128.13): (channel, data set) of actuators, all of them or none."""
    return security_command(Function.SET, b"".join(bytes([channel]) + octets for channel, octets in values))


def run_self_test(channel: int = 0) -> Command:
    """Run self-test (1.5) of one channel or all (0); the result is in Operation."""
    return Command(channel, COMMON, SELF_TEST_FUNCTION, b"\0")


POWER: Final = security_command(Function.POWER)


def bit_words(kind: type[IntFlag], value: int) -> list[str]:
    """Return the names of the set bits: ``in field``, ``too low``."""
    return [bit.name.lower().replace("_", " ") for bit in kind if value & bit and bit.name]


class PowerFlag(IntFlag):
    """Flags of the reply to Power."""

    BATTERY = 1
    CHARGING = 2
    FULL = 4
    IN_FIELD = 8
    TOO_LOW = 16


@dataclass(frozen=True)
class PowerReply:
    """Reply to Power (128.18); ``flags`` are those of PowerFlag.

    Level in %, voltage in V, current in A (+ charges), temperature in °C; None if unknown.
    """

    flags: int = 0
    level: int | None = None
    voltage: float | None = None
    current: float | None = None
    temperature: int | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the object of the API and of `mode --json`."""
        return {
            "flags": bit_words(PowerFlag, self.flags),
            "level": self.level,
            "voltage": self.voltage,
            "current": self.current,
            "temperature": self.temperature,
        }

    def encode(self) -> bytes:
        """Return the 7 octets: flags ‖ level ‖ mV u16 ‖ mA i16 ‖ °C i8."""
        return struct.pack(
            ">BBHhb",
            self.flags,
            0xFF if self.level is None else self.level,
            0xFFFF if self.voltage is None else round(self.voltage * 1000),
            0x7FFF if self.current is None else round(self.current * 1000),
            0x7F if self.temperature is None else self.temperature,
        )

    @classmethod
    def decode(cls, payload: bytes) -> PowerReply:
        """Read the 7 octets; raises GarbledError."""
        if len(payload) != 7:
            raise GarbledError(f"A reply to Power has 7 octets, this one {len(payload)}.")
        flags, level, voltage, current, temperature = struct.unpack(">BBHhb", payload)
        return cls(
            flags,
            None if level == 0xFF else level,
            None if voltage == 0xFFFF else voltage / 1000,
            None if current == 0x7FFF else current / 1000,
            None if temperature == 0x7F else temperature,
        )
