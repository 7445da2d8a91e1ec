"""The answers of all nodes to one functional Identify, put together from raw frames.

Many nodes answer at once, each with its own first frame, flow control and consecutive frames; can-isotp serves one pair
of addresses. Pure: frames in, frames out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from teds_provision.links.can.bus import Frame
from teds_provision.links.can.isotp import BLOCK_SIZE, LONGEST, addresses, padded, physical_id, read_single

_CONTINUE, _OVERFLOW = 0x30, 0x32


@dataclass
class _Partial:
    """What one node has sent so far; ``length`` octets in all."""

    length: int
    octets: bytearray
    number: int = 0
    in_block: int = 0


@dataclass
class Gathering:
    """One functional Identify of station ``own``: ``answers`` by node address, without the transaction octet.

    ``conflicts`` are addresses under which two nodes answered: two first frames within this Identify, two different
    whole answers, or consecutive frames out of sequence (profile: wire, "CAN").
    """

    own: int
    transaction: int
    answers: dict[int, bytes] = field(default_factory=dict)
    conflicts: set[int] = field(default_factory=set)
    _partial: dict[int, _Partial] = field(default_factory=dict)
    _began: set[int] = field(default_factory=set)

    @property
    def busy(self) -> bool:
        """Whether an answer has begun and not ended."""
        return bool(self._partial)

    def take(self, frame: Frame) -> Frame | None:
        """Take any frame of the bus; returns the flow control that it asks for, if any. Never raises."""
        ends = addresses(frame.identifier)
        if ends is None or ends[0] != self.own or len(frame.data) < 2:
            return None
        node, kind = ends[1], frame.data[0] >> 4
        if kind == 0:
            self._single(node, frame.data)
        elif kind == 1:
            return self._first(node, frame)
        elif kind == 2:
            return self._consecutive(node, frame)
        return None

    def _single(self, node: int, data: bytes) -> None:
        body = read_single(data)
        if body and body[0] == self.transaction:
            self._begin(node)
            self._whole(node, body)

    def _first(self, node: int, frame: Frame) -> Frame | None:
        data, start = frame.data, 2
        length = (data[0] & 0xF) << 8 | data[1]
        if not length and len(data) >= 8:
            length, start = int.from_bytes(data[2:6], "big"), 6
        if len(data) < 8 or length <= 7:
            return None
        if length > LONGEST or data[start] != self.transaction:  # too long, or late: of an Identify before this one
            return self._flow(node, _OVERFLOW, fd=frame.fd)
        self._begin(node)
        self._partial[node] = _Partial(length, bytearray(data[start : start + length]))
        return self._flow(node, _CONTINUE, fd=frame.fd)

    def _consecutive(self, node: int, frame: Frame) -> Frame | None:
        partial = self._partial.get(node)
        if partial is None:
            return None
        if frame.data[0] & 0xF != partial.number + 1 & 0xF:
            self.conflicts.add(node)
            del self._partial[node]
            return None
        partial.number += 1
        partial.in_block += 1
        partial.octets += frame.data[1 : 1 + partial.length - len(partial.octets)]
        if len(partial.octets) == partial.length:
            del self._partial[node]
            self._whole(node, bytes(partial.octets))
        elif partial.in_block == BLOCK_SIZE:
            partial.in_block = 0
            return self._flow(node, _CONTINUE, fd=frame.fd)
        return None

    def _begin(self, node: int) -> None:
        if node in self._began:
            self.conflicts.add(node)
        self._began.add(node)

    def _whole(self, node: int, body: bytes) -> None:
        self.answers[node] = body[1:]

    def _flow(self, node: int, status: int, *, fd: bool) -> Frame:
        return Frame(physical_id(node, self.own), padded(bytes([status, BLOCK_SIZE, 0]), fd=fd), fd)
