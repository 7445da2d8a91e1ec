"""One thread for each bus hears the data frames of all its nodes, puts messages together, checks and calibrates them.

Nothing here waits for a sink, a disk or a node. A stream is heard from the moment when it is registered until it is
taken away; what comes for nobody is dropped.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from teds_provision.errors import LinkFailure
from teds_provision.links.can.bus import Frame
from teds_provision.links.can.port import CanPort
from teds_provision.measure.blocks import Block
from teds_provision.measure.clock import ClockMap
from teds_provision.measure.interpreter import StreamInterpreter
from teds_provision.protocol.operation.can_frames import Assembly, data_address
from teds_provision.protocol.operation.subscription import Message, Receiver

SLICE = 0.01  # seconds between looks at what waits
GATHER = 0.02  # seconds that messages wait to be calibrated together
HEARD_OUT = 0.25  # seconds for what was received before Stop's reply to be looked at
MOST_HELD = 50_000  # frames: some seconds of a full bus
_DATA, _MASK = 0x1CFF0000, 0x1FFF0000


@dataclass
class HeardStream:
    """A running stream: what opens its messages, and where its blocks go.

    ``mapping`` guards the clock map, which the node's own thread feeds. ``heard`` is when the last good message came.
    """

    receiver: Receiver
    assembly: Assembly
    interpreter: StreamInterpreter
    clock: ClockMap
    mapping: threading.Lock
    deliver: Callable[[Block], None]
    heard: float = field(default_factory=time.monotonic)
    wrong_pattern: int = 0
    samples: int = 0
    invalid: int = 0
    bound: float | None = None

    def take(self, segment: int, frame: Frame) -> None:
        """A frame of this stream."""
        octets = self.assembly.take(segment, frame.data)
        if octets is not None:
            self.whole(octets, int((frame.at or time.monotonic()) * 1e9))

    def whole(self, octets: bytes, at: int) -> None:
        """A whole message of this stream, which came at ``at`` (monotonic ns)."""
        with self.mapping:
            message = self.receiver.take(octets, self.clock.ticks_at(at))
            if message is not None:
                last = message.tick + self.receiver.plan.span - self.receiver.plan.subscribe.period
                self.clock.arrival(last, at)
        if message is not None:
            self.good(message)

    def begin(self, start: int) -> None:
        """The first instant of a stream that waited for a trigger is known."""
        with self.mapping:
            messages = self.receiver.begin(start)
        for message in messages:
            self.good(message)

    def good(self, message: Message) -> None:
        """A message whose tag and time are right."""
        self.heard = time.monotonic()
        if message.test_pattern and message.data != self.receiver.expected(message):
            self.wrong_pattern += 1
        with self.mapping:
            block = self.interpreter.take(message)
        self._deliver(block)

    def flush(self, now: float) -> None:
        """Hand on what has waited for GATHER."""
        since = self.interpreter.waiting_since
        if since and now - since >= GATHER:
            self.finish()

    def finish(self) -> None:
        """Hand on what is left."""
        with self.mapping:
            block = self.interpreter.flush()
        self._deliver(block)

    def hear_out(self, counter: int) -> None:
        """Wait for the hearing thread: frames that came before Stop's reply may still lie in its queue."""
        until = time.monotonic() + HEARD_OUT
        while self.receiver.last < counter - 1 and time.monotonic() < until:
            time.sleep(0.002)

    def _deliver(self, block: Block | None) -> None:
        if block is not None:
            self.samples += block.value.size
            if not block.test_pattern:
                self.invalid += block.valid.size - int(np.count_nonzero(block.valid))
            self.bound = block.clock_error
            self.deliver(block)


class Hearing:
    """The listening thread of one link that carries data; a kind of link says in :meth:`_hear` how it hears."""

    def __init__(self, place: str) -> None:
        self._streams: dict[tuple[int, int], HeardStream] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self.lost_frames = 0
        self._thread = threading.Thread(target=self._run, name=f"hearing {place}", daemon=True)
        self._thread.start()

    def register(self, node: int, stream: int, heard: HeardStream) -> None:
        """Hear a stream of the node at this address; in place of the one before."""
        with self._lock:
            self._streams = {**self._streams, (node, stream): heard}

    def forget(self, node: int, stream: int) -> HeardStream | None:
        """Hear it no more, and hand on what is left of it."""
        with self._lock:
            streams = dict(self._streams)
            heard = streams.pop((node, stream), None)
            self._streams = streams
        if heard is not None:
            heard.finish()
        return heard

    def close(self) -> None:
        """End the thread."""
        self._stop.set()
        self._thread.join(2.0)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._hear()
            except LinkFailure:
                # The nodes' own threads meet the same failure, tell it, and open the bus again.
                self._stop.wait(0.5)

    def _hear(self) -> None:
        """Hear until the thread is to end; raises LinkFailure."""
        raise NotImplementedError

    def _flush(self, looked: float, lost: int) -> float:
        """Hand on, now and then, what has waited; gives when that was last done."""
        now = time.monotonic()
        if now - looked < SLICE:
            return looked
        self.lost_frames = lost
        for heard in self._streams.values():
            heard.flush(now)
        return now


class CanHearing(Hearing):
    """The listening thread of one bus; nodes are told apart by their address."""

    def __init__(self, port: CanPort) -> None:
        self._port = port
        self._own = port.spec.source
        super().__init__(port.place)

    def _wanted(self, frame: Frame) -> bool:
        return frame.identifier & _MASK == _DATA and frame.identifier >> 13 & 7 == self._own & 7

    def _hear(self) -> None:
        with self._port.bus().listen(self._wanted, most=MOST_HELD) as ear:
            looked = time.monotonic()
            while not self._stop.is_set():
                frame = ear.get(SLICE)
                if frame is not None:
                    self._take(frame)
                looked = self._flush(looked, ear.lost)

    def _take(self, frame: Frame) -> None:
        address = data_address(frame.identifier)
        heard = self._streams.get((address.node, address.stream)) if address is not None else None
        if address is not None and heard is not None:
            heard.take(address.segment, frame)
