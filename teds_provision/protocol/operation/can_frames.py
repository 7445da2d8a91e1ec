"""Data, Drive and trigger frames on CAN, data messages on BLE: identifiers, cutting (operation.md section 6).

Data: ``0x1CFF‖S‖node``, S = low 3 bits of the station · 32 + stream · 8 + segment; all octets are message.
Drive: ``0x18EF‖node‖station``, the first octet is the segment. Trigger: ``0x18FF00‖station``, data T.
Segment 0 begins a message, then come 1 to 7, 1 to 7 …. There is no flow control: a receiver knows the length.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

DATA: Final = 0x1CFF0000
DRIVE: Final = 0x18EF0000
TRIGGER: Final = 0x18FF0000
_PREFIX: Final = 0x1FFF0000
CLASSIC_OCTETS, FD_OCTETS = 8, 64
PADDING: Final = 0xCC
TOKEN_OCTETS: Final = 8
FIRST_STATION, LAST_STATION = 0xF1, 0xF7
FIRST_NODE, LAST_NODE = 0x01, 0xEF
_FD_LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)
_SEGMENTS: Final = 7


class DataAddress(NamedTuple):
    """The fields of a data frame's identifier; ``station`` and ``node`` are source addresses."""

    station: int
    stream: int
    segment: int
    node: int

    @property
    def identifier(self) -> int:
        """The 29-bit identifier."""
        return DATA | ((self.station & 7) << 5 | self.stream << 3 | self.segment) << 8 | self.node


class DriveAddress(NamedTuple):
    """The fields of a Drive frame's identifier."""

    node: int
    station: int

    @property
    def identifier(self) -> int:
        """The 29-bit identifier."""
        return DRIVE | self.node << 8 | self.station


def data_address(identifier: int) -> DataAddress | None:
    """Read the identifier of a data frame; None for any other (Announce, station 0, no node)."""
    node, s = identifier & 0xFF, identifier >> 8 & 0xFF
    if identifier & _PREFIX != DATA or not s >> 5 or not FIRST_NODE <= node <= LAST_NODE:
        return None
    return DataAddress(0xF0 | s >> 5, s >> 3 & 3, s & 7, node)


def drive_address(identifier: int) -> DriveAddress | None:
    """Read the identifier of a Drive frame; None for any other."""
    node, station = identifier >> 8 & 0xFF, identifier & 0xFF
    good = FIRST_NODE <= node <= LAST_NODE and FIRST_STATION <= station <= LAST_STATION
    return DriveAddress(node, station) if identifier & _PREFIX == DRIVE and good else None


def trigger_identifier(station: int) -> int:
    """Return the identifier of a station's trigger frame."""
    return TRIGGER | station


def trigger_station(identifier: int) -> int | None:
    """Return the station of a trigger frame; None for any other."""
    station = identifier & 0xFF
    good = identifier & 0x1FFFFF00 == TRIGGER and FIRST_STATION <= station <= LAST_STATION
    return station if good else None


def fd_length(octets: int) -> int:
    """Return the shortest CAN FD length that holds so many octets, at most 64."""
    return int(next(length for length in _FD_LENGTHS if length >= octets))


def next_segment(segment: int) -> int:
    """Return the segment that follows: 0, 1 to 7, 1 to 7 …."""
    return segment % _SEGMENTS + 1


class Segment(NamedTuple):
    """One frame's share of a message: its segment, and the frame's data (Drive: the segment comes first in it)."""

    segment: int
    data: bytes


def cut(message: bytes, *, fd: bool, drive: bool = False) -> Iterator[Segment]:
    """Cut a message into the data of its frames; the last one of CAN FD is padded with CC."""
    room = (FD_OCTETS if fd else CLASSIC_OCTETS) - drive
    segment = 0
    for at in range(0, len(message), room):
        data = (bytes([segment]) if drive else b"") + message[at : at + room]
        if fd:
            data = data.ljust(fd_length(len(data)), bytes([PADDING]))
        yield Segment(segment, data)
        segment = next_segment(segment)


def frames_of(length: int, *, fd: bool, drive: bool = False) -> int:
    """Return how many frames a message of ``length`` octets takes."""
    return -(-length // ((FD_OCTETS if fd else CLASSIC_OCTETS) - drive))


class StreamAssembly:
    """Puts the messages of one stream (or of Drive) together; ``length`` octets each.

    ``broken`` counts messages that were begun and not finished, because a frame is missing; ``wrong`` frames of another
    length than their place in a message has, each of which ends its message.
    """

    def __init__(self, length: int, *, fd: bool, drive: bool = False) -> None:
        self.length, self.fd, self.drive = length, fd, drive
        self.broken = self.wrong = 0
        self._room = (FD_OCTETS if fd else CLASSIC_OCTETS) - drive
        self._held: bytearray | None = None
        self._next = 0

    def add_segment(self, segment: int, data: bytes) -> bytes | None:
        """Add one frame (Drive: :meth:`add_drive_segment`); return the whole message if it was the last one."""
        if segment == 0:
            if self._held is not None:
                self.broken += 1
            self._held = bytearray()
        elif self._held is None or segment != self._next:
            # A segment is missing, so the message is lost; it counts once until the next segment 0.
            if self._held is not None:
                self.broken += 1
                self._held = None
            return None
        due = min(self._room, self.length - len(self._held))
        if len(data) != (fd_length(due + self.drive) - self.drive if self.fd else due):
            self.wrong += 1
            self._held = None
            return None
        self._held += data[:due]
        self._next = next_segment(segment)
        if len(self._held) < self.length:
            return None
        message, self._held = bytes(self._held), None
        return message

    def add_drive_segment(self, data: bytes) -> bytes | None:
        """Take one Drive frame, whose first octet is the segment."""
        return self.add_segment(data[0], data[1:]) if data and data[0] <= _SEGMENTS else None

    def forget(self) -> None:
        """Drop what was begun."""
        self._held = None


def ble_frame(stream: int, message: bytes) -> bytes:
    """Return a data message as one notification: stream ‖ message. A Drive message is written under 0."""
    return bytes([stream]) + message


def read_ble_frame(octets: bytes) -> tuple[int, bytes] | None:
    """Return stream and message of a notification; None if it is malformed."""
    return (octets[0], octets[1:]) if len(octets) > 1 and octets[0] <= 3 else None
