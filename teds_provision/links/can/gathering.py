"""The answers of all nodes to one functional Identify, put together from raw frames.

Many nodes answer at once, each with its own first frame, flow control and consecutive frames. Pure: frames in, frames
out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from teds_provision.links.can.frame import Frame
from teds_provision.links.can.isotp import addresses, read_single
from teds_provision.links.can.transfer import CONTINUE, OVERFLOW, Reassembly, flow


@dataclass
class Gathering:
    """One functional Identify of station ``own``: ``answers`` by node address, without the transaction octet.

    ``conflicts`` are addresses under which two nodes answered: two first frames within this Identify, two different
    whole answers, or consecutive frames out of sequence (profile.md, "CAN"). A frame that was lost looks the same,
    so whoever asks looks again before it says so. ``clashes`` are those where it is sure: two different beginnings.
    """

    own: int
    transaction: int
    answers: dict[int, bytes] = field(default_factory=dict)
    conflicts: set[int] = field(default_factory=set)
    clashes: set[int] = field(default_factory=set)
    _partial: dict[int, Reassembly] = field(default_factory=dict)
    _began: dict[int, bytes] = field(default_factory=dict)

    @property
    def busy(self) -> bool:
        """Whether an answer has begun and not ended."""
        return bool(self._partial)

    @property
    def unfinished(self) -> set[int]:
        """Addresses of which an answer began and did not end."""
        return set(self._partial)

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
            self._begin(node, data)
            self._whole(node, body)

    def _first(self, node: int, frame: Frame) -> Frame | None:
        partial = Reassembly.begin(node, frame)
        if partial is None:
            return None
        if partial.too_long or partial.octets[0] != self.transaction:  # or late: of an Identify before this one
            return flow(node, self.own, OVERFLOW, fd=frame.fd)
        self._begin(node, frame.data)
        self._partial[node] = partial
        return flow(node, self.own, CONTINUE, fd=frame.fd)

    def _consecutive(self, node: int, frame: Frame) -> Frame | None:
        partial = self._partial.get(node)
        if partial is None:
            return None
        match partial.take(frame.data):
            case "again" | "torn":
                self.conflicts.add(node)
                del self._partial[node]
            case "whole":
                del self._partial[node]
                self._whole(node, bytes(partial.octets))
            case "block":
                return flow(node, self.own, CONTINUE, fd=partial.fd)
        return None

    def _begin(self, node: int, data: bytes) -> None:
        if node in self._began:
            self.conflicts.add(node)
            if self._began[node] != data:
                self.clashes.add(node)
        self._began[node] = data

    def _whole(self, node: int, body: bytes) -> None:
        self.answers[node] = body[1:]
