"""One thread for each bus receives the data frames of all its nodes, reassembles messages, checks and calibrates them.

Nothing here waits for a sink, a disk or a node. A stream is received from its registration until its removal; frames
for no stream are dropped.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from teds_provision.errors import LinkError
from teds_provision.links.can.bus import Frame
from teds_provision.links.can.port import CanPort
from teds_provision.measure.blocks import Block
from teds_provision.measure.clock import ClockMap
from teds_provision.measure.interpreter import StreamInterpreter
from teds_provision.protocol.operation.can_frames import DATA, StreamAssembly
from teds_provision.protocol.operation.stream_commands import StreamKind
from teds_provision.protocol.operation.subscription import Receiver, StreamMessage

SLICE = 0.004  # seconds between looks at what waits
REST = 0.003  # seconds that frames gather on one bus: to be woken for each of them costs more than to read it
GATHER = 0.012  # seconds that messages wait to be opened and calibrated together: of a tick's 20 ms to its sink
HEARD_OUT = 0.25  # seconds for the last message that is wanted to come and to be looked at
MOST_HELD = 50_000  # frames: some seconds of a full bus
MOST_EARLY = 512  # frames of a stream that came before the reply to its Subscribe was looked at
_MASK = 0x1FFF0000
_STREAM = 0x18FF  # of an identifier: node and stream


@dataclass
class ReceivedStream:
    """A running stream: what opens its messages, and the receiver of its blocks.

    ``mapping`` guards the clock map, which the node's own thread feeds. ``heard`` is when the last good message came.
    """

    receiver: Receiver
    assembly: StreamAssembly
    interpreter: StreamInterpreter
    clock: ClockMap
    mapping: threading.Lock
    deliver: Callable[[Block], None]
    heard: float = field(default_factory=time.monotonic)
    wrong_pattern: int = 0
    samples: int = 0
    bound: float | None = None
    early: deque[Frame] = field(default_factory=deque)
    """Frames that came before it was registered; the hearing thread takes them first."""
    _came: deque[tuple[bytes, int]] = field(default_factory=deque)
    _since: float = 0.0

    def __post_init__(self) -> None:
        plan = self.receiver.plan
        self._at_once = plan.span >= GATHER * 1e9
        # Of a stream that runs free only the first instant of each message is known for certain.
        self._last_instant = 0 if plan.subscribe.kind == StreamKind.FREE else plan.span - plan.subscribe.period
        self._test_pattern = plan.subscribe.test_pattern

    def handle_frame(self, frame: Frame) -> None:
        """Handle a frame of this stream."""
        self._take_early()
        self._assemble(frame)

    def _take_early(self) -> None:
        while self.early:
            self._assemble(self.early.popleft())

    def _assemble(self, frame: Frame) -> None:
        segment = frame.identifier >> 8 & 7
        octets = self.assembly.add_segment(segment, frame.data)
        if octets is not None:
            self.whole(octets, int((frame.at or time.monotonic()) * 1e9))

    def whole(self, octets: bytes, at: int) -> None:
        """Handle a whole message of this stream, which came at ``at`` (monotonic ns).

        It waits for others that come soon.
        """
        if not self._came:
            self._since = time.monotonic()
        self._came.append((octets, at))

    @property
    def due(self) -> bool:
        """True if a message waits which no other will join soon."""
        return self._at_once and bool(self._came)

    def begin(self, start: int) -> None:
        """Begin a triggered stream, as its first instant is known: from now on its silence counts."""
        self.finish()
        self.heard = time.monotonic()
        with self.mapping:
            messages = self.receiver.begin(start)
            blocks = self.interpreter.blocks(messages)
        self._hand_on(messages, blocks)

    def flush(self, now: float) -> None:
        """Open and hand on what has waited for GATHER."""
        self._take_early()
        if self._came and now - self._since >= GATHER:
            self.finish()

    def finish(self) -> None:
        """Open, check, calibrate and hand on what is left.

        All that waits at once, since most of what that costs does not depend on how much it is.
        """
        came = [self._came.popleft() for _ in range(len(self._came))]
        if not came:
            return
        with self.mapping:
            messages = self.receiver.open_messages(came, self.clock.ahead(came[-1][1]))
            if messages:
                self._note_arrival(came, messages)
            blocks = self.interpreter.blocks(messages)
        self._hand_on(messages, blocks)

    def _note_arrival(self, came: list[tuple[bytes, int]], messages: list[StreamMessage]) -> None:
        """Pass the message that came soonest after its samples to the clock.

        Of a batch with drops the last one will do.
        """
        at, tick = came[-1][1], messages[-1].tick
        if len(messages) == len(came) > 1:
            soonest = at - tick
            for (_, arrived), message in zip(came, messages, strict=True):
                if arrived - message.tick < soonest:
                    at, tick, soonest = arrived, message.tick, arrived - message.tick
        self.clock.arrival(tick + self._last_instant, at)

    def _hand_on(self, messages: list[StreamMessage], blocks: list[Block]) -> None:
        """Messages whose tag and time are right."""
        if messages:
            self.heard = time.monotonic()
        if self._test_pattern:
            self.wrong_pattern += sum(message.data != self.receiver.expected(message) for message in messages)
        for block in blocks:
            self.samples += block.value.size
            self.bound = block.clock_error
            self.deliver(block)

    def ending(self) -> int:
        """End the measurement now: return how many messages of the run are wanted, including the one being filled."""
        with self.mapping:
            return self.receiver.begun(self.clock.tick_at(time.monotonic_ns()))

    def hear_out(self, wanted: int) -> None:
        """Wait for the last of so many messages; it may be on its way, or in the queue of the hearing thread."""
        until = time.monotonic() + HEARD_OUT
        while self.receiver.last < wanted - 1 and time.monotonic() < until:
            time.sleep(0.002)


@dataclass
class EarlyFrames:
    """Frames of a stream that was asked for at ``since`` (monotonic) and is not registered yet."""

    since: float = field(default_factory=time.monotonic)
    frames: deque[Frame] = field(default_factory=lambda: deque(maxlen=MOST_EARLY))


class StreamReceiver:
    """The listening thread of one link that carries data; a kind of link implements :meth:`_hear`."""

    def __init__(self, place: str) -> None:
        self._streams: dict[tuple[int, int], ReceivedStream] = {}
        self._early: dict[tuple[int, int], EarlyFrames] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self.lost_frames = 0
        self.failure: LinkError | None = None
        """Why the bus itself cannot be heard now; None if it can."""
        self._thread = threading.Thread(target=self._run, name=f"hearing {place}", daemon=True)
        self._thread.start()

    def register(self, node: int, stream: int, heard: ReceivedStream) -> None:
        """Hear a stream of the node at this address; in place of the one before."""
        key = (node, stream)
        with self._lock:
            if key in self._early:
                heard.early = self._early[key].frames
            self._streams = {**self._streams, key: heard}
            self._early.pop(key, None)

    def expect(self, node: int, stream: int) -> None:
        """Keep the frames of a stream that is asked for: on a busy machine they come before its reply is looked at."""
        with self._lock:
            self._early[node, stream] = EarlyFrames()

    def forget(self, node: int, stream: int) -> ReceivedStream | None:
        """Hear it no more, and hand on what is left of it."""
        with self._lock:
            streams = dict(self._streams)
            heard = streams.pop((node, stream), None)
            self._streams = streams
            self._early.pop((node, stream), None)
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
            except LinkError as failure:
                # The nodes' own threads meet the same failure, report it, and open the bus again.
                self.failure = failure
                self._stop.wait(0.5)

    def _hear(self) -> None:
        """Hear until the thread is to end; raises LinkError."""
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


class CanStreamReceiver(StreamReceiver):
    """The listening thread of one bus; their address identifies nodes."""

    def __init__(self, port: CanPort) -> None:
        self._port = port
        self._own = port.spec.source
        super().__init__(port.place)

    def _wanted(self, frame: Frame) -> bool:
        return frame.identifier & _MASK == DATA and frame.identifier >> 13 & 7 == self._own & 7

    def _hear(self) -> None:
        with self._port.bus().listen(self._wanted, most=MOST_HELD) as listener:
            self.failure = None
            looked = time.monotonic()
            while not self._stop.is_set():
                # All that wait first: a thread that fell behind calibrates more at once, and catches up.
                touched = {frame.identifier & _STREAM: self._dispatch(frame) for frame in listener.get_all(SLICE)}
                for heard in touched.values():
                    if heard is not None and heard.due:
                        heard.finish()
                looked = self._flush(looked, listener.lost)
                time.sleep(REST)

    def _dispatch(self, frame: Frame) -> ReceivedStream | None:
        # A registered stream has a good address, and other stations' frames do not come here.
        key = (frame.identifier & 0xFF, frame.identifier >> 11 & 3)
        heard = self._streams.get(key)
        if heard is not None:
            heard.handle_frame(frame)
        elif (early := self._early.get(key)) is not None and (frame.at or math.inf) >= early.since:
            early.frames.append(frame)
        return heard
