"""Command and reply frames of IEEE 1451.0-2007 (profile.md, "Command frames"), and the profile's own class 128."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from teds_provision.errors import GarbledError

COMMAND_HEADER: Final = 6
REPLY_HEADER: Final = 3
COMMON, OPERATE, EITHER, SECURITY_CLASS = 1, 3, 4, 128
"""Command classes: CommonCmd, XdcrOperate and XdcrEither of the standard, and the profile's own."""


class Function(IntEnum):
    """Functions of class 128 (profile.md, "Command frames"; 12 to 20: operation.md; 21 to 23: the firmware)."""

    REQUEST = 1
    CONFIRM = 2
    OPEN = 3
    SEALED = 4
    CLOSE = 5
    IDENTIFY = 7
    PROVE = 8
    RESET = 9
    SET_CAN_ADDRESS = 10
    LIST = 11
    SAMPLE = 12
    SET = 13
    SUBSCRIBE = 14
    STOP = 15
    CLOCK = 16
    ARM = 17
    POWER = 18
    OPERATION = 19
    DRIVE = 20
    ABOUT = 21
    LOCATE = 22
    MANAGE = 23


class TedsFunction(IntEnum):
    """Functions of class 1 that deal with TEDS (profile.md, "Writing to flash")."""

    QUERY = 1
    READ = 2
    WRITE = 3
    UPDATE = 4


class Reason(IntEnum):
    """Reasons of refusals: the u8 of a reply with status 0 (profile.md, "Reasons")."""

    UNKNOWN_COMMAND = 1
    WRONG_STATE = 2
    NOT_PERMITTED = 3
    BAD_FORM = 4
    BAD_SIGNATURE = 5
    DIGEST_MISMATCH = 6
    STALE_SEQUENCE = 7
    WRONG_EPOCH = 8
    WRONG_UUID = 9
    TOO_LARGE = 10
    FLASH_FAILURE = 11
    BAD_TAG = 12
    REPLAY = 13
    UNTRUSTED_STATION = 14
    BAD_POINT = 15
    UNKNOWN_KEY = 16
    BUSY = 17
    NO_SUCH_TEDS = 18
    OUT_OF_RANGE = 19
    TOO_LATE = 20
    DOES_NOT_FIT = 21
    NO_ROOM = 22
    FAULT = 23


class CommandRefusedError(Exception):
    """A command is refused for ``reason``; nothing was changed. Raised and caught inside the node."""

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason.name)
        self.reason = reason


@dataclass(frozen=True)
class Command:
    """destination channel u16 ‖ class u8 ‖ function u8 ‖ length u16 ‖ payload."""

    channel: int
    command_class: int
    function: int
    payload: bytes = b""

    def encode(self) -> bytes:
        """Return the whole command frame."""
        head = struct.pack(">HBBH", self.channel, self.command_class, self.function, len(self.payload))
        return head + self.payload


@dataclass(frozen=True)
class Reply:
    """success flag u8 ‖ length u16 ‖ payload; a refusal is flag 0 with the reason as its first octet."""

    ok: bool
    payload: bytes = b""

    @property
    def reason(self) -> int | None:
        """The refusal's reason, None for a success or if the node gave none."""
        return self.payload[0] if not self.ok and self.payload else None

    def encode(self) -> bytes:
        """Return the whole reply frame."""
        return struct.pack(">BH", self.ok, len(self.payload)) + self.payload


def decode_reply(frame: bytes) -> Reply:
    """Decode a whole reply frame; raises GarbledError if its length differs from its length field."""
    if len(frame) < REPLY_HEADER:
        raise GarbledError(f"A reply frame has at least {REPLY_HEADER} octets, this one {len(frame)}.")
    flag, length = struct.unpack_from(">BH", frame)
    if length != len(frame) - REPLY_HEADER:
        raise GarbledError(f"A reply frame announces {length} octets and carries {len(frame) - REPLY_HEADER}.")
    return Reply(flag != 0, frame[REPLY_HEADER:])


def refusal(reason: Reason) -> Reply:
    """Return the reply that refuses for ``reason``."""
    return Reply(False, bytes([reason]))


READ_OVERHEAD: Final = 46
"""Octets of a longest message that a reply to Read in a session does not carry: its frame, its seal, its offset."""
LIST_OVERHEAD: Final = 42
"""The same for a reply to List or Operation, which has no offset."""


def security_command(function: Function, payload: bytes = b"") -> Command:
    """Return a command of class 128; they all go to channel 0."""
    return Command(0, SECURITY_CLASS, function, payload)


IDENTIFY: Final = security_command(Function.IDENTIFY)
"""128.7: requests the node's identity. Changes nothing; used for broadcasts, and to find out which node answers."""


def query_teds(channel: int, access_code: int) -> Command:
    """Query TEDS (1.1)."""
    return Command(channel, COMMON, TedsFunction.QUERY, bytes([access_code]))


def read_teds(channel: int, access_code: int, offset: int) -> Command:
    """Read TEDS segment (1.2) from ``offset`` on."""
    return Command(channel, COMMON, TedsFunction.READ, struct.pack(">BI", access_code, offset))


def write_teds(channel: int, access_code: int, offset: int, octets: bytes) -> Command:
    """Write TEDS segment (1.3): ``octets`` into the staged image at ``offset``."""
    return Command(channel, COMMON, TedsFunction.WRITE, struct.pack(">BI", access_code, offset) + octets)


def update_teds(channel: int, access_code: int) -> Command:
    """Update TEDS (1.4); of access code 128 on channel 0 it commits."""
    return Command(channel, COMMON, TedsFunction.UPDATE, bytes([access_code]))


class Attribute(IntEnum):
    """Bits of the attributes octet of a Query TEDS reply (profile.md, "Writing to flash")."""

    READ_ONLY = 0x01
    NOT_AVAILABLE = 0x02
    TEXT = 0x10
    MANUFACTURER = 0x40


@dataclass(frozen=True)
class TedsStatus:
    """Query TEDS reply, 12 octets: attributes ‖ status ‖ TEDSSize u32 ‖ TEDSCkSum u16 ‖ MaxTEDSSize u32.

    ``size`` is the full number of octets that Read hands out.
    """

    attributes: int
    size: int
    checksum: int
    max_size: int
    status: int = 0

    def encode(self) -> bytes:
        """Return the 12 octets."""
        return struct.pack(">BBIHI", self.attributes, self.status, self.size, self.checksum, self.max_size)

    @classmethod
    def decode(cls, octets: bytes) -> TedsStatus:
        """Read the 12 octets; raises GarbledError."""
        if len(octets) != 12:
            raise GarbledError(f"A Query TEDS reply has 12 octets, this one {len(octets)}.")
        attributes, status, size, checksum, max_size = struct.unpack(">BBIHI", octets)
        return cls(attributes, size, checksum, max_size, status)


def decode_list(payload: bytes) -> list[tuple[int, int]]:
    """Read the reply to List: (channel, access code) ascending; raises GarbledError."""
    if len(payload) % 3:
        raise GarbledError(f"A List reply has a multiple of 3 octets, this one {len(payload)}.")
    keys = [(int.from_bytes(payload[i : i + 2], "big"), payload[i + 2]) for i in range(0, len(payload), 3)]
    if keys != sorted(set(keys)):
        raise GarbledError("A List reply is not in ascending order.")
    return keys
