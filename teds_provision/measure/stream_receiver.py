"""One thread for each link receives the data messages of all its nodes, checks and calibrates them.

Nothing here waits for a sink, a disk or a node. A stream is received from its registration until its removal; messages
for no stream are dropped.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from teds_provision.errors import LinkError
from teds_provision.links.streaming import DataMessage, MeasuringLink, StreamPieces
from teds_provision.measure.blocks import Block
from teds_provision.measure.clock import ClockMap
from teds_provision.measure.interpreter import StreamInterpreter
from teds_provision.protocol.operation.stream_commands import StreamKind
from teds_provision.protocol.operation.subscription import Receiver, StreamMessage

_log = logging.getLogger(__name__)
SLICE = 0.004  # seconds between checks for frames
REST = 0.003  # seconds for which frames gather on one link: waking for each one costs more than reading it
# seconds for which messages gather, to be opened and calibrated together: part of the 20 ms from tick to sink
GATHER = 0.012
HEARD_OUT = 0.25  # seconds to wait for the last message of a stream
LOOKED_AT = 2.0  # seconds for the listening thread to process what has arrived: a node is released within 4 s
MOST_EARLY = 512  # messages of a stream that are kept until the reply to its Subscribe was processed


@dataclass
class ReceivedStream:
    """A running stream: what opens its messages, and the receiver of its blocks.

    ``pieces`` counts what the link could not put together. ``mapping`` guards the clock map, which the node's own
    thread feeds. ``last_good_at`` is when the last good message came.
    """

    receiver: Receiver
    pieces: StreamPieces
    interpreter: StreamInterpreter
    clock: ClockMap
    mapping: threading.Lock
    deliver: Callable[[Block], None]
    last_good_at: float = field(default_factory=time.monotonic)
    wrong_pattern: int = 0
    samples: int = 0
    bound: float | None = None
    early: deque[DataMessage] = field(default_factory=deque)
    """Messages that came before it was registered; the hearing thread takes them first."""
    _came: deque[tuple[bytes, int]] = field(default_factory=deque)
    _since: float = 0.0
    _order: threading.RLock = field(default_factory=threading.RLock)
    """Held while messages are taken and passed on: the thread that ends the stream does that too."""

    def __post_init__(self) -> None:
        plan = self.receiver.plan
        self._at_once = plan.span >= GATHER * 1e9
        # In a free-running stream, only the first instant of each message is certain.
        self._last_instant = 0 if plan.subscribe.kind == StreamKind.FREE else plan.span - plan.subscribe.period
        self._test_pattern = plan.subscribe.test_pattern

    def queue_message(self, octets: bytes, at: int) -> None:
        """Handle a message of this stream, which came at ``at`` (monotonic ns).

        It waits for others that come soon.
        """
        if self.early:
            self._take_early()
        if not self._came:
            self._since = time.monotonic()
        self._came.append((octets, at))

    def _take_early(self) -> None:
        while self.early:
            message = self.early.popleft()
            if not self._came:
                self._since = time.monotonic()
            self._came.append((message.octets, message.at))

    @property
    def due(self) -> bool:
        """True if a message waits which no other will join soon."""
        return self._at_once and bool(self._came)

    @property
    def holds(self) -> bool:
        """True if messages wait here."""
        return bool(self._came or self.early)

    def begin(self, start: int) -> None:
        """Begin a triggered stream, as its first instant is known: from now on its silence counts."""
        with self._order:
            self.finish()
            self.last_good_at = time.monotonic()
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
        with self._order:
            came = [self._came.popleft() for _ in range(len(self._came))]
            if not came:
                return
            with self.mapping:
                messages = self.receiver.open_messages(came, self.clock.lead_bounds(came[-1][1]))
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
        """Pass on messages whose tag and time are right."""
        if messages:
            self.last_good_at = time.monotonic()
        if self._test_pattern:
            self.wrong_pattern += sum(message.data != self.receiver.expected(message) for message in messages)
        for block in blocks:
            self.samples += block.value.size
            self.bound = block.clock_error
            self.deliver(block)

    def ending(self) -> int:
        """Return how many messages of the run are wanted if the measurement ends now, with the one being filled."""
        with self.mapping:
            return self.receiver.begun(self.clock.tick_at(time.monotonic_ns()))


@dataclass
class EarlyMessages:
    """Messages of a stream whose Subscribe was sent at ``since`` (monotonic ns), and that is not registered yet."""

    since: int = field(default_factory=time.monotonic_ns)
    messages: deque[DataMessage] = field(default_factory=lambda: deque(maxlen=MOST_EARLY))


class HearingThread:
    """The listening thread of one link that carries data."""

    def __init__(self, port: MeasuringLink) -> None:
        self._port = port
        self._streams: dict[tuple[int, int], ReceivedStream] = {}
        self._early: dict[tuple[int, int], EarlyMessages] = {}
        self._new: deque[ReceivedStream] = deque()  # registered, and not processed yet
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._looks = 0
        self.lost_frames = 0
        self.failure: LinkError | None = None
        """The present failure of the link; None if it works."""
        self._thread = threading.Thread(target=self._run, name=f"hearing {port.place}", daemon=True)
        self._thread.start()

    def expect(self, node: int, stream: int, length: int) -> StreamPieces:
        """Keep the messages of a stream whose Subscribe is about to be sent, ``length`` octets each.

        On a busy machine they arrive before the reply to Subscribe is processed.
        """
        with self._lock:
            self._early[node, stream] = EarlyMessages()
            return self._port.open_stream(node, stream, length)

    def register(self, node: int, stream: int, heard: ReceivedStream) -> None:
        """Hear a stream that is expected; in place of the one before."""
        key = (node, stream)
        with self._lock:
            if key in self._early:
                heard.early = self._early[key].messages
            self._streams = {**self._streams, key: heard}
            self._new.append(heard)
            self._early.pop(key, None)

    def hear_out(self, heard: ReceivedStream, wanted: int) -> None:
        """Wait for the last of so many messages of a stream, and hand on what has come.

        It may be on its way, or in the queue of the hearing thread: what has come in time counts, however late that
        thread looks at it.
        """

        def wait(until: float, enough: Callable[[], bool] = lambda: False) -> None:
            while heard.receiver.last < wanted - 1 and not enough() and time.monotonic() < until:
                time.sleep(0.002)

        wait(time.monotonic() + HEARD_OUT)
        looks = self._looks  # the pass in progress may have begun before the last message arrived
        wait(time.monotonic() + LOOKED_AT, lambda: self._looks > looks + 1 or not self._is_hearing)
        heard.finish()

    @property
    def _is_hearing(self) -> bool:
        return self.failure is None and not self._stop.is_set() and self._thread.is_alive()

    def forget(self, node: int, stream: int) -> ReceivedStream | None:
        """Hear it no more, and hand on what is left of it."""
        with self._lock:
            streams = dict(self._streams)
            heard = streams.pop((node, stream), None)
            self._streams = streams
            self._early.pop((node, stream), None)
            self._port.close_stream(node, stream)
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
                # The threads of the nodes get the same failure, report it, and open the link again.
                self.failure = failure
                self._stop.wait(0.5)
            except Exception as bug:  # noqa: BLE001 - one node's message ends the hearing of no other node
                _log.debug("Hearing on %s failed.", self._port.place, exc_info=True)
                self.failure = LinkError(
                    f"Unexpected {type(bug).__name__} in received data.",
                    hint="This is a bug: please report it with -vv.",
                )
                self._stop.wait(0.5)

    def _hear(self) -> None:
        """Hear until the thread is to end; raises LinkError."""
        # streams that may hold messages that were not passed on yet
        waiting = {id(heard): heard for heard in self._streams.values()}
        with self._port.listen() as listener:
            self.failure = None
            looked = time.monotonic()
            while not self._stop.is_set():
                # Get all that is queued: a thread that fell behind then calibrates larger blocks and catches up.
                came = listener.get_all(SLICE)
                touched = {(message.node, message.stream): self._dispatch(message) for message in came}
                for heard in touched.values():
                    if heard is None:
                        continue
                    if heard.due:
                        heard.finish()
                    else:
                        waiting[id(heard)] = heard
                looked = self._flush(waiting, looked, listener.lost)
                self._looks += 1
                time.sleep(REST)

    def _dispatch(self, message: DataMessage) -> ReceivedStream | None:
        key = (message.node, message.stream)
        # read first: a stream registered after this line is found below, and takes the early messages
        early = self._early.get(key)
        heard = self._streams.get(key)
        if heard is not None:
            heard.queue_message(message.octets, message.at)
        elif early is not None and message.at >= early.since:
            early.messages.append(message)
        return heard

    def _flush(self, waiting: dict[int, ReceivedStream], looked: float, lost: int) -> float:
        """Hand on, now and then, what has waited; gives when that was last done."""
        now = time.monotonic()
        if now - looked < SLICE:
            return looked
        self.lost_frames = lost
        while self._new:
            heard = self._new.popleft()
            waiting[id(heard)] = heard
        for key, heard in list(waiting.items()):
            heard.flush(now)
            if not heard.holds:
                del waiting[key]
        return now
