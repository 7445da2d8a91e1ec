"""Reassembles data messages of open streams on a CAN bus (operation.md section 6)."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final

from teds_provision.links.can.bus_multiplexer import BusMultiplexer, Listener
from teds_provision.links.can.isotp import Frame
from teds_provision.links.streaming import DataMessage
from teds_provision.protocol.operation.can_frames import DATA, StreamAssembly

MOST_HELD: Final = 50_000
"""Frames: some seconds of a full bus."""
LISTENING: Final = 0.25
"""Seconds in which the data of another station's streams to our address is heard."""
SIGN_OF_LIFE: Final = 4.0
"""Seconds in which a station that reads them sends something: lease / 3 is 3.3 s unless it asks for another."""
_MASK: Final = 0x1FFF0000
_STREAM: Final = 0x18FF
"""Of an identifier: node and stream."""


@dataclass
class _OpenStream:
    """One stream; frames from before ``since`` (time.monotonic) belong to a run before it."""

    assembly: StreamAssembly
    since: float = field(default_factory=time.monotonic)


class CanDataListener:
    """See ``links.streaming.DataListener``."""

    def __init__(self, listener: Listener, streams: dict[int, _OpenStream]) -> None:
        self._listener, self._streams = listener, streams

    @property
    def lost(self) -> int:
        """Frames that did not fit into the queue."""
        return self._listener.lost

    def get_all(self, seconds: float) -> list[DataMessage]:
        """Return the messages that are whole now; waits ``seconds`` for the first frame."""
        messages, streams = [], self._streams
        for frame in self._listener.get_all(seconds):
            identifier = frame.identifier
            stream = streams.get(identifier & _STREAM)  # only valid addresses are open
            if stream is None or (frame.at or math.inf) < stream.since:
                continue
            octets = stream.assembly.add_segment(identifier >> 8 & 7, frame.data)
            if octets is not None:
                at = int((frame.at or time.monotonic()) * 1e9)
                messages.append(DataMessage(identifier & 0xFF, identifier >> 11 & 3, octets, at))
        return messages


class CanStreams:
    """The open streams of one bus; they outlive a bus that is lost and opened again."""

    def __init__(self) -> None:
        self.opened: dict[int, _OpenStream] = {}

    def open(self, node: int, stream: int, length: int, *, fd: bool) -> StreamAssembly:
        """Take frames of a stream from now on."""
        opened = _OpenStream(StreamAssembly(length, fd=fd))
        self.opened[stream << 11 | node] = opened
        return opened.assembly

    def close(self, node: int, stream: int) -> None:
        """Take them no more."""
        self.opened.pop(stream << 11 | node, None)

    @contextmanager
    def listen(self, bus: BusMultiplexer) -> Iterator[CanDataListener]:
        """Hear the data frames for this station."""
        own = bus.own & 7
        with bus.listen(lambda frame: _is_data_for(frame, own), most=MOST_HELD) as listener:
            yield CanDataListener(listener, self.opened)


def rival_measures(bus: BusMultiplexer) -> bool:
    """Return True if data comes for our source address, and another station sends from it; takes 4 s at most.

    Replies that this process did not request are no sign: nodes that go on streaming after a process ended may still
    answer its last requests.
    """
    own = bus.own & 7
    with bus.listen(lambda frame: _is_data_for(frame, own), most=64) as listener:
        if listener.get(LISTENING) is None:
            return False
    until = time.monotonic() + SIGN_OF_LIFE
    while time.monotonic() < until:
        if bus.conflicts.frames_within(within=LISTENING + SIGN_OF_LIFE):
            return True
        time.sleep(0.05)
    return False


def _is_data_for(frame: Frame, own: int) -> bool:
    return frame.identifier & _MASK == DATA and frame.identifier >> 13 & 7 == own
