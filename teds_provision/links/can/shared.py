"""One CAN bus for many threads: whoever reads it (``reading.py``) hands each frame to those who wait for it.

What nodes send to this station is put together here, whoever asked; the flow control leaves at once from the thread
that reads, so that a busy one holds nobody up. Data frames, announcements and triggers go to those who listen
(:meth:`listen`).
"""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Final

from teds_provision.errors import LinkFailure
from teds_provision.links.can.bus import Bus
from teds_provision.links.can.frame import Frame
from teds_provision.links.can.gathering import Gathering
from teds_provision.links.can.isotp import addresses, read_single
from teds_provision.links.can.reading import Reading, Thing
from teds_provision.links.can.rivals import Rivals
from teds_provision.links.can.transfer import CONTINUE, OVERFLOW, Reassembly, flow

_REMEMBERED: Final = 16
"""Transactions of one node whose late replies are known as such."""
_STRAGGLERS_SECONDS: Final = 0.5
_CLASH_SECONDS: Final = 10.0
_LOSSY_SECONDS: Final = 60.0
_MOST_HELD: Final = 8192


class Ear:
    """A queue of frames for one listener; see :meth:`SharedBus.listen`. ``lost`` counts what did not fit."""

    def __init__(self, bus: SharedBus, wanted: Callable[[Frame], bool], most: int) -> None:
        self._bus, self._wanted, self._most = bus, wanted, most
        self._frames: SimpleQueue[Frame | None] = SimpleQueue()
        self.lost = 0

    def get(self, seconds: float | None = None) -> Frame | None:
        """The next frame, None after ``seconds``; raises LinkFailure once the bus has failed and all is read."""
        try:
            frame = self._frames.get(timeout=None if seconds is None else max(0.0, seconds))
        except Empty:
            frame = None
        if frame is None:
            self._bus.check()
        return frame

    def get_all(self, seconds: float) -> list[Frame]:
        """All frames that wait, in order; where none does, the next one, or none after ``seconds``. Raises as get."""
        first = self.get(seconds)
        if first is None:
            return []
        frames = [first]
        with contextlib.suppress(Empty):
            while (frame := self._frames.get_nowait()) is not None:
                frames.append(frame)
        return frames

    def close(self) -> None:
        """Listen no more; a thread that waits in :meth:`get` returns."""
        self._bus.deaf(self)
        self.wake()

    def wake(self) -> None:
        """Let a thread that waits in :meth:`get` look around."""
        self._frames.put(None)

    def offer(self, frame: Frame) -> None:
        """Take a frame that is wanted; called by the receiving loop."""
        if self._wanted(frame):
            if self._frames.qsize() < self._most:
                self._frames.put(frame)
            else:
                self.lost += 1

    def __enter__(self) -> Ear:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True)
class Event:
    """What became of a reply: ``body`` (transaction first) whole, or it has begun, is torn, or another one began.

    ``at``: when the last frame of a whole one came in (time.monotonic).
    """

    kind: str
    body: bytes = b""
    at: float = 0.0


@dataclass
class Line:
    """What the loop knows of one pair of addresses: the message that comes in, and the thread that has an exchange.

    ``own`` is the station's address; ``transaction`` that of the exchange that runs, -1 for none.
    """

    node: int
    own: int
    turn: threading.Lock = field(default_factory=threading.Lock)
    flows: SimpleQueue[bytes] = field(default_factory=SimpleQueue)
    events: SimpleQueue[Event] = field(default_factory=SimpleQueue)
    transaction: int = -1
    partial: Reassembly | None = None
    gathering: Gathering | None = None
    heard_at: float = 0.0
    gap: int = 0  # ms that the node is asked to leave between the frames of its reply
    asked: deque[int] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))

    @contextmanager
    def exchange(self, transaction: int) -> Iterator[Line]:
        """Wait for this transaction's reply; one exchange with one node at a time."""
        with self.turn:
            for waiting in (self.flows, self.events):
                _empty(waiting)
            self.partial = None
            self.transaction = transaction
            self.asked.append(transaction)
            try:
                yield self
            finally:
                self.transaction = -1
                self.partial = None


@dataclass
class Asked:
    """A functional Identify under way: ``gathering`` is filled by the loop, :meth:`next` waits for news of it.

    ``began`` and ``heard_at``: when it was asked, and when the last frame of an answer came (time.monotonic).
    """

    gathering: Gathering
    heard_at: float
    began: float
    until: float = math.inf
    news: SimpleQueue[int] = field(default_factory=SimpleQueue)

    def next(self, seconds: float) -> int | None:
        """Address of a node that has answered, or in conflict; None after ``seconds``."""
        try:
            return self.news.get(timeout=max(0.0, seconds))
        except Empty:
            return None


class SharedBus:
    """An open bus with its receiving loop, a thread of its own, until :meth:`close`. All methods are thread-safe."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self.spec = bus.spec
        self.own = bus.spec.source
        self.rivals = Rivals(self.own)
        self._failure: LinkFailure | None = None
        self._ears: tuple[Ear, ...] = ()
        self._asked: tuple[Asked, ...] = ()
        self._lines: dict[tuple[int, int], Line] = {}
        self._clashes: dict[int, float] = {}
        self._lost_at = -math.inf
        self._lock = threading.Lock()
        self._sending = threading.Lock()
        self._closing = False
        self._wake, self._woken = socket.socketpair()
        self._reading = Reading(bus, self._take, self._fail, self._woken)
        self._thread = threading.Thread(target=self._reading.run, name=f"can {self.spec.text}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the loop and release the adapter; never raises."""
        if self._closing:
            return
        self._closing = True
        with contextlib.suppress(OSError):
            self._wake.send(b"x")
        self._reading.stop()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=2)
        self._bus.close()
        self._fail(LinkFailure(f"The bus {self.spec.text} was closed."))
        self._wake.close()
        self._woken.close()

    @property
    def failed(self) -> bool:
        """Whether the bus failed, or was closed: it has to be opened anew."""
        return self._failure is not None

    @property
    def busy_seconds(self) -> float:
        """Wire time of all frames sent so far; 0 unless paced."""
        return self._bus.busy_seconds

    @property
    def lossy(self) -> bool:
        """Whether frames were lost here a short while ago."""
        return time.monotonic() - self._lost_at < _LOSSY_SECONDS

    def note_loss(self) -> None:
        """A frame of an exchange was lost."""
        self._lost_at = time.monotonic()

    def check(self) -> None:
        """Raise the LinkFailure that the bus met, if any."""
        if self._failure is not None:
            raise self._failure

    def next_of(self, queue: SimpleQueue[Thing], seconds: float) -> Thing:
        """The next that the bus puts into a line's queue; raises Empty after ``seconds``."""
        return self._reading.wait_for(queue, seconds)

    def send(self, frame: Frame) -> None:
        """Put one frame on the bus; raises LinkFailure."""
        self.check()
        with self._sending:
            self._bus.send(frame)

    def listen(self, wanted: Callable[[Frame], bool], *, most: int = _MOST_HELD) -> Ear:
        """Hear every frame for which ``wanted`` is true, from now on; at most ``most`` wait to be read.

        ``wanted`` runs in the receiving loop: it must be quick and raise nothing.
        """
        ear = Ear(self, wanted, most)
        with self._lock:
            self._ears = (*self._ears, ear)
        return ear

    def deaf(self, ear: Ear) -> None:
        """Take a listener away."""
        with self._lock:
            self._ears = tuple(other for other in self._ears if other is not ear)

    def line(self, node: int, own: int | None = None) -> Line:
        """The line to the node at this address; ``own`` is another address than this station's, to try a node out."""
        pair = node, self.own if own is None else own
        with self._lock:
            return self._lines.setdefault(pair, Line(*pair))

    @contextmanager
    def gather(self, transaction: int) -> Iterator[Asked]:
        """Collect the answers of all nodes to the functional Identify of this transaction.

        The loop goes on with it for a moment afterwards: whoever leaves with the first answer may be told later that a
        second node answered under the same address (:meth:`clash`).
        """
        now = time.monotonic()
        asked = Asked(Gathering(self.own, transaction), now, now)
        with self._lock:
            self._asked = (*(other for other in self._asked if other.until > now), asked)
        try:
            yield asked
        finally:
            asked.until = time.monotonic() + _STRAGGLERS_SECONDS

    def clash(self, node: int) -> bool:
        """Whether two nodes were heard under this address a short while ago, and not one alone since then."""
        return time.monotonic() - self._clashes.get(node, -math.inf) < _CLASH_SECONDS

    # -- the loop, and what runs in it -----------------------------------------------------------------------------

    def _fail(self, failure: LinkFailure) -> None:
        self._failure = self._failure or failure
        with self._lock:
            ears, asked, lines = self._ears, self._asked, list(self._lines.values())
        for ear in ears:
            ear.wake()
        for one in asked:
            one.news.put(-1)
        for line in lines:
            line.events.put(Event("failed"))
            line.flows.put(b"")

    def _take(self, frame: Frame) -> None:
        self.rivals.heard(frame)
        ends = addresses(frame.identifier)
        if ends is not None and len(frame.data) >= 2:
            own, node = ends
            if own == self.own or (node, own) in self._lines:
                self._from_node(self.line(node, own), frame)
        for ear in self._ears:
            ear.offer(frame)

    def _from_node(self, line: Line, frame: Frame) -> None:
        line.heard_at = frame.at
        match frame.data[0] >> 4:
            case 0:
                self._single(line, frame)
            case 1:
                self._first(line, frame)
            case 2:
                self._consecutive(line, frame)
            case 3 if line.transaction >= 0:  # nobody waits for any other: they would only pile up
                line.flows.put(frame.data)

    def _single(self, line: Line, frame: Frame) -> None:
        body = read_single(frame.data)
        if not body:
            return
        if body[0] == line.transaction:
            line.events.put(Event("whole", body, frame.at))
            line.flows.put(b"")  # whoever waits for a flow control has its answer
        elif not self._gathered(line, frame, body[0]) and body[0] not in line.asked:
            self.rivals.unasked(line.node)

    def _first(self, line: Line, frame: Frame) -> None:
        partial = Reassembly.begin(line.node, frame)
        if partial is None:
            return
        transaction = partial.octets[0]
        if transaction == line.transaction:
            if partial.too_long:
                self._reply(flow(line.node, line.own, OVERFLOW, fd=frame.fd))
                return
            other = line.partial
            if other is not None and other.first != partial.first:
                line.events.put(Event("clash"))
            elif other is not None and not other.number:
                return  # the same frame twice
            line.partial, line.gathering = partial, None
            self._reply(flow(line.node, line.own, CONTINUE, fd=frame.fd, gap=line.gap))
            line.events.put(Event("begun"))
        elif self._gathered(line, frame, transaction):
            return
        elif transaction in line.asked:  # a late reply: end it, so that the node is free for the next
            self._reply(flow(line.node, line.own, OVERFLOW, fd=frame.fd))
        else:
            self.rivals.unasked(line.node)

    def _gathered(self, line: Line, frame: Frame, transaction: int) -> bool:
        for asked in self._asked:
            if asked.gathering.transaction == transaction and asked.until > frame.at:
                line.gathering, line.partial = asked.gathering, None
                self._gather(asked, line.node, frame)
                return True
        return False

    def _consecutive(self, line: Line, frame: Frame) -> None:
        if line.gathering is not None:
            for asked in self._asked:
                if asked.gathering is line.gathering:
                    self._gather(asked, line.node, frame)
            return
        partial = line.partial
        if partial is None:
            return
        match partial.take(frame.data):
            case "whole":
                line.partial = None
                line.events.put(Event("whole", bytes(partial.octets), frame.at))
            case "block":
                self._reply(flow(line.node, line.own, CONTINUE, fd=partial.fd, gap=line.gap))
            case "torn":
                line.partial = None
                self._reply(flow(line.node, line.own, OVERFLOW, fd=partial.fd))  # it need not send the rest
                line.events.put(Event("torn"))

    def _gather(self, asked: Asked, node: int, frame: Frame) -> None:
        gathering = asked.gathering
        asked.heard_at = max(asked.heard_at, frame.at)
        before = len(gathering.answers), len(gathering.conflicts)
        answer = gathering.take(frame)
        if answer is not None:
            self._reply(answer)
        if node in gathering.clashes:
            self._clashes[node] = time.monotonic()
        elif node in gathering.answers and self._clashes.get(node, math.inf) < asked.began:
            # One of the two has left, by its Claim: one alone answers here. If both do, it stands again.
            del self._clashes[node]
        if before != (len(gathering.answers), len(gathering.conflicts)):
            asked.news.put(node)

    def _reply(self, frame: Frame) -> None:
        with self._sending:
            self._bus.send(frame)


def _empty(queue: SimpleQueue[bytes] | SimpleQueue[Event]) -> None:
    with contextlib.suppress(Empty):
        while True:
            queue.get_nowait()
