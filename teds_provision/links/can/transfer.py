"""The frames of one ISO-TP message, cut and put together: octets to frames and back (ISO 15765-2, section 9).

What a base station uses for many nodes at once; a node uses can-isotp (:mod:`teds_provision.links.can.isotp`), so that
each exchange is also one between two implementations. Pure: no bus, no clock.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

from teds_provision.links.can.frame import Frame
from teds_provision.links.can.isotp import BLOCK_SIZE, LONGEST, padded, physical_id

CONTINUE, WAIT, OVERFLOW = 0x30, 0x31, 0x32
"""First octet of a flow control frame."""
_LONGEST_GAP: Final = 0.127

Taken = Literal["more", "block", "whole", "again", "torn"]


@dataclass
class Reassembly:
    """One message of ``peer`` while its frames come in; ``length`` octets in all, ``fd`` the form of its frames.

    ``asked`` frames have come since the last flow control.
    """

    peer: int
    length: int
    octets: bytearray
    first: bytes
    fd: bool
    number: int = 0
    asked: int = 0
    last: bytes = b""

    @classmethod
    def begin(cls, peer: int, frame: Frame) -> Reassembly | None:
        """Start with a first frame; None where it is none, or announces a length that needs none."""
        data, start = frame.data, 2
        if len(data) < 8 or data[0] >> 4 != 1:
            return None
        length = (data[0] & 0xF) << 8 | data[1]
        if not length:  # the escape for more than 4095 octets
            length, start = int.from_bytes(data[2:6], "big"), 6
        if length <= 7:
            return None
        return cls(peer, length, bytearray(data[start : start + length]), data, frame.fd)

    @property
    def too_long(self) -> bool:
        """Whether no message of the profile has that length."""
        return self.length > LONGEST

    def take(self, data: bytes) -> Taken:
        """Take a consecutive frame.

        ``block`` asks for a flow control, ``again`` is the frame before once more, ``torn`` one out of sequence.
        """
        if data[0] & 0xF != self.number + 1 & 0xF:
            return "again" if data == self.last else "torn"
        self.number += 1
        self.asked += 1
        self.last = data
        self.octets += data[1 : 1 + self.length - len(self.octets)]
        if len(self.octets) == self.length:
            return "whole"
        if self.asked == BLOCK_SIZE:
            self.asked = 0
            return "block"
        return "more"


def flow(peer: int, own: int, status: int, *, fd: bool, gap: int = 0) -> Frame:
    """A flow control frame to ``peer``: 16 frames a block, and ``gap`` ms (0 to 127) between them (profile.md, "CAN").

    Without a gap a reply takes the bus, as it goes before all data; with one the data find room between its frames.
    """
    return Frame(physical_id(peer, own), padded(bytes([status, BLOCK_SIZE, gap]), fd=fd), fd)


def first_frame(body: bytes, *, fd: bool) -> tuple[bytes, bytes]:
    """The first frame of a message that no single frame holds, and the octets that are left."""
    room = 62 if fd else 6
    return (0x1000 | len(body)).to_bytes(2, "big") + body[:room], body[room:]


def consecutive_frames(rest: bytes, *, fd: bool) -> Iterator[bytes]:
    """The frames after the first one, padded."""
    room = 63 if fd else 7
    for number, at in enumerate(range(0, len(rest), room), 1):
        yield padded(bytes([0x20 | number & 0xF]) + rest[at : at + room], fd=fd)


def gap_seconds(octet: int) -> float:
    """STmin of a flow control in seconds; a reserved value counts as 127 ms (ISO 15765-2, table of STmin)."""
    if octet <= 0x7F:
        return octet / 1000
    if 0xF1 <= octet <= 0xF9:
        return (octet - 0xF0) / 10_000
    return _LONGEST_GAP
