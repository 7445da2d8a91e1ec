"""One CAN bus for many threads: the thread that reads (:class:`BusReader`) passes each frame to the waiting threads.

Messages from nodes to this station are reassembled here for all callers. The reading thread sends flow control at once,
so that a busy caller delays no other. Data frames, Announces and triggers go to listeners (:meth:`listen`).
"""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Final, TypeVar

from teds_provision.errors import LinkClosedError, LinkError
from teds_provision.links.can.bus import Bus
from teds_provision.links.can.isotp import (
    CONTINUE,
    FUNCTIONAL,
    OVERFLOW,
    Frame,
    Reassembly,
    addresses,
    flow,
    read_single,
)
from teds_provision.links.can.other_stations import OtherStationsLoad
from teds_provision.links.can.presses import ButtonPressLog
from teds_provision.links.can.transfer_pace import TransferPace
from teds_provision.protocol.announce import Announce, is_announce

# Which thread reads a bus: a background loop, or the thread that waits for a reply.
#
# If one thread reads a reply that another one waits for, that costs two context switches and a GIL hand-over, and the
# same for each flow control. So a thread that waits alone reads the bus itself. The loop reads if several threads wait,
# and if none has waited for a moment.

_ALIVE_SECONDS: Final = 0.25
_SHORT_SLICE: Final = 0.02
"""How long one receive waits on an interface that cannot be woken."""
_LINGER_SECONDS: Final = 0.005
"""How long after a reply the loop leaves the bus to the thread that got it: most ask on at once."""
_NAP_SECONDS: Final = 0.002

Thing = TypeVar("Thing")


class BusReader:
    """Reads ``bus`` until :meth:`stop`; each frame goes to ``take``, the end of the bus to ``failed``.

    ``take`` runs in one thread at a time. ``woken`` can be read once the bus is to be closed.
    """

    def __init__(
        self, bus: Bus, take: Callable[[Frame], None], failed: Callable[[LinkError], None], woken: socket.socket
    ) -> None:
        self._bus, self._take, self._failed, self._woken = bus, take, failed, woken
        self._turn = threading.Lock()
        self._counting = threading.Lock()
        self._leaning = 0
        self._helped_until = 0.0
        self._over = False

    def run(self) -> None:
        """Run the loop; returns after :meth:`stop`, or when the bus has failed."""
        while not self._over:
            if not self._bus.can_be_waited_for:
                self._read(_SHORT_SLICE)
            elif self._is_helped():
                time.sleep(_NAP_SECONDS)
            else:
                self._bus.wait(_ALIVE_SECONDS, self._woken)
                self._read_all()
                if self._bus.stamps_arrivals and not self._leaning:
                    # No thread waits for a reply: let data frames gather, since a context switch costs more than a
                    # frame. A thread that starts to wait reads by itself, and the kernel stamps the time of arrival.
                    time.sleep(_NAP_SECONDS)

    def stop(self) -> None:
        """Stop all reading; returns when no thread reads."""
        self._over = True
        if self._turn.acquire(timeout=2):
            self._turn.release()

    def wait_for(self, queue: SimpleQueue[Thing], seconds: float) -> Thing:
        """Return the next item of a queue that ``take`` or ``failed`` fills; raises Empty after ``seconds``."""
        until = time.monotonic() + seconds
        while True:
            with suppress(Empty):
                return queue.get_nowait()
            left = until - time.monotonic()
            if left <= 0:
                raise Empty
            if self._over or self._leaning or not self._bus.can_be_waited_for or not self._turn.acquire(blocking=False):
                return self._lean(queue, left)
            try:
                self._read_for(queue, until)
            finally:
                self._helped_until = time.monotonic() + _LINGER_SECONDS
                self._turn.release()

    def _lean(self, queue: SimpleQueue[Thing], seconds: float) -> Thing:
        """Have another thread read: the loop, or the one that reads already."""
        with self._counting:
            self._leaning += 1
        try:
            return queue.get(timeout=seconds)
        finally:
            with self._counting:
                self._leaning -= 1

    def _is_helped(self) -> bool:
        return self._turn.locked() or (not self._leaning and time.monotonic() < self._helped_until)

    def _read_for(self, queue: SimpleQueue[Thing], until: float) -> None:
        """Read frame after frame until the queue has something, or another thread waits for something too.

        A call of the system lets other threads have the interpreter, and then waits for them: there is none too many.
        """
        while queue.empty() and not self._leaning and not self._over:
            left = until - time.monotonic()
            if left <= 0:
                return
            self._bus.wait(min(left, _ALIVE_SECONDS), self._woken)
            self._read(0.0)

    def _read_all(self) -> None:
        """Read every frame that is there, unless another thread has come to read them."""
        while not self._is_helped() and self._turn.acquire(blocking=False):
            try:
                if not self._read(0.0):
                    return
            finally:
                self._turn.release()

    def _read(self, seconds: float) -> bool:
        """Read one frame; return False if there was none."""
        try:
            frame = self._bus.receive(seconds)
        except LinkError as failure:
            self._over = True
            self._failed(failure)
            return False
        if frame is None:
            return False
        self._take(frame)
        return True


# Detects another base station with our source address, from frames that this process neither sent nor requested.
#
# Two stations with one address get each other's replies, so that commands fail in ways that look like noise. Two signs
# count: frames *from* our address that we did not send, and replies to us that we did not request.

_KEPT: Final = 64
_FRAMES_NEEDED: Final = 2
_REPLIES_NEEDED: Final = 4
_LATE_REPLIES_SECONDS: Final = 3.0
"""After the bus was opened: replies of busy nodes to a process that ended just before this one began."""


class AddressConflicts:
    """Detects other stations that use our address ``own``. Thread-safe."""

    def __init__(self, own: int, now: Callable[[], float] = time.monotonic) -> None:
        self._own, self._now = own, now
        self._opened = now()
        self._frames: list[float] = []
        self._replies: list[float] = []
        self._lock = threading.Lock()

    def check_frame(self, frame: Frame) -> None:
        """Look at a frame of the bus that we did not send."""
        if frame.identifier & 0xFF == self._own and _of_a_station(frame.identifier):
            with self._lock:
                self._frames.append(self._now())
                del self._frames[:-_KEPT]

    def record_unsolicited(self, node: int) -> None:
        """Record an unsolicited reply, unless it can be the answer to a process before this one."""
        del node
        now = self._now()
        if now < self._opened + _LATE_REPLIES_SECONDS:
            return
        with self._lock:
            self._replies.append(now)
            del self._replies[:-_KEPT]

    def frames_within(self, *, within: float) -> bool:
        """Return True if another station sent from our address within these seconds; replies do not count."""
        since = self._now() - within
        with self._lock:
            return sum(at >= since for at in self._frames) >= _FRAMES_NEEDED

    def seen_within(self, *, within: float = 10.0) -> bool:
        """Return True if another station used our address within these seconds."""
        since = self._now() - within
        with self._lock:
            replies = sum(at >= since for at in self._replies)
        return self.frames_within(within=within) or replies >= _REPLIES_NEEDED

    @property
    def text(self) -> str:
        """One sentence that names the address."""
        return f"Another base station on this bus uses this station's source address 0x{self._own:02X}."

    @property
    def hint(self) -> str:
        """Return what the user can do about it."""
        free = 0xF2 if self._own == 0xF1 else 0xF1
        return f"Give each station its own address, 0xF1 to 0xF7: add source=0x{free:02X} to --can of one of them."


def _of_a_station(identifier: int) -> bool:
    return identifier & 0x1FFFFF00 == FUNCTIONAL or addresses(identifier) is not None


# The answers of all nodes to one functional Identify, reassembled from raw frames.
#
# Many nodes answer at once, each with its own first frame, flow control and consecutive frames. Pure: frames in, frames
# out.


@dataclass
class BroadcastReplies:
    """One functional Identify of station ``own``: ``answers`` by node address, without the transaction octet.

    ``conflicts`` are addresses under which two nodes answered: two first frames within this Identify, two different
    whole answers, or consecutive frames out of sequence (profile.md, "CAN"). A lost frame has the same effect, so the
    caller sends another broadcast before it reports one. ``clashes`` are certain ones: two different first frames.
    ``repeated`` have two first frames, equal or not, which a lost frame cannot explain.
    """

    own: int
    transaction: int
    answers: dict[int, bytes] = field(default_factory=dict)
    conflicts: set[int] = field(default_factory=set)
    clashes: set[int] = field(default_factory=set)
    repeated: set[int] = field(default_factory=set)
    _partial: dict[int, Reassembly] = field(default_factory=dict)
    _began: dict[int, bytes] = field(default_factory=dict)

    @property
    def busy(self) -> bool:
        """True if an answer has begun and not ended."""
        return bool(self._partial)

    @property
    def unfinished(self) -> set[int]:
        """Addresses of which an answer began and did not end."""
        return set(self._partial)

    def add_frame(self, frame: Frame) -> Frame | None:
        """Process any frame of the bus; return the flow control to send, if any. Never raises."""
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
            self._note_first_piece(node, data)
            self._whole(node, body)

    def _first(self, node: int, frame: Frame) -> Frame | None:
        partial = Reassembly.begin(node, frame)
        if partial is None:
            return None
        # too long, or a late answer to an earlier Identify
        if partial.too_long or partial.octets[0] != self.transaction:
            return flow(node, self.own, OVERFLOW, fd=frame.fd)
        self._note_first_piece(node, frame.data)
        self._partial[node] = partial
        return flow(node, self.own, CONTINUE, fd=frame.fd)

    def _consecutive(self, node: int, frame: Frame) -> Frame | None:
        partial = self._partial.get(node)
        if partial is None:
            return None
        match partial.add_frame(frame.data):
            case "again" | "torn":
                self.conflicts.add(node)
                del self._partial[node]
            case "whole":
                del self._partial[node]
                self._whole(node, bytes(partial.octets))
            case "block":
                return flow(node, self.own, CONTINUE, fd=partial.fd)
        return None

    def _note_first_piece(self, node: int, data: bytes) -> None:
        if node in self._began:
            self.conflicts.add(node)
            self.repeated.add(node)
            if self._began[node] != data:
                self.clashes.add(node)
        self._began[node] = data

    def _whole(self, node: int, body: bytes) -> None:
        self.answers[node] = body[1:]


_REMEMBERED: Final = 16
"""Transactions of one node whose late replies are known as such."""
_STRAGGLERS_SECONDS: Final = 0.5
_CLASH_SECONDS: Final = 10.0
_LOSSY_SECONDS: Final = 60.0
_MOST_HELD: Final = 8192


class Listener:
    """A queue of frames for one listener; see :meth:`BusMultiplexer.listen`. ``lost`` counts what did not fit."""

    def __init__(self, bus: BusMultiplexer, wanted: Callable[[Frame], bool], most: int) -> None:
        self._bus, self._wanted, self._most = bus, wanted, most
        self._frames: SimpleQueue[Frame | None] = SimpleQueue()
        self.lost = 0

    def get(self, seconds: float | None = None) -> Frame | None:
        """Return the next frame, None after ``seconds``; raises LinkError once the bus has failed and all is read."""
        try:
            frame = self._frames.get(timeout=None if seconds is None else max(0.0, seconds))
        except Empty:
            frame = None
        if frame is None:
            self._bus.check()
        return frame

    def get_all(self, seconds: float) -> list[Frame]:
        """Return all waiting frames, in order; if there are none, the next one, or none after ``seconds``.

        Raises as get.
        """
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
        self._bus.forget(self)
        self.wake()

    def wake(self) -> None:
        """Wake a thread that waits in :meth:`get`."""
        self._frames.put(None)

    def offer(self, frame: Frame) -> None:
        """Take a frame that is wanted; called by the receiving loop."""
        if self._wanted(frame):
            if self._frames.qsize() < self._most:
                self._frames.put(frame)
            else:
                self.lost += 1

    def __enter__(self) -> Listener:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@dataclass(frozen=True)
class ReplyEvent:
    """Progress of a reply: ``body`` (transaction first) whole, or it has begun, is torn, or another one began.

    ``at``: when the last frame of a whole one came in (time.monotonic).
    """

    kind: str
    body: bytes = b""
    at: float = 0.0


@dataclass
class AddressPair:
    """State of one pair of addresses: the incoming message, and the thread that has an exchange.

    ``own`` is the station's address; ``transaction`` that of the running exchange, -1 for none. ``heard_at``: when the
    last frame came, or the flow control left that its next ones wait for (time.monotonic).
    """

    node: int
    own: int
    turn: threading.Lock = field(default_factory=threading.Lock)
    flows: SimpleQueue[bytes] = field(default_factory=SimpleQueue)
    events: SimpleQueue[ReplyEvent] = field(default_factory=SimpleQueue)
    transaction: int = -1
    partial: Reassembly | None = None
    replies: BroadcastReplies | None = None
    heard_at: float = 0.0
    gap: int = 0  # ms between consecutive frames that the node is asked to keep
    asked: deque[int] = field(default_factory=lambda: deque(maxlen=_REMEMBERED))

    @contextmanager
    def exchange(self, transaction: int) -> Iterator[AddressPair]:
        """Wait for this transaction's reply; one exchange with one node at a time."""
        with self.turn:
            for waiting in (self.flows, self.events):
                with contextlib.suppress(Empty):
                    while True:
                        waiting.get_nowait()
            self.partial = None
            self.transaction = transaction
            self.asked.append(transaction)
            try:
                yield self
            finally:
                self.transaction = -1
                self.partial = None


@dataclass
class PendingBroadcast:
    """A functional Identify in progress: the loop fills ``replies``, and :meth:`next` waits for news.

    ``began`` and ``heard_at``: when it was sent, and when the last frame of an answer came (time.monotonic).
    """

    replies: BroadcastReplies
    heard_at: float
    began: float
    until: float = math.inf
    news: SimpleQueue[int] = field(default_factory=SimpleQueue)

    def next(self, seconds: float) -> int | None:
        """Return the address of a node that has answered, or is in conflict; None after ``seconds``."""
        try:
            return self.news.get(timeout=max(0.0, seconds))
        except Empty:
            return None


class BusMultiplexer:
    """An open bus with its receiving loop in a thread, until :meth:`close`. All methods are thread-safe."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self.spec = bus.spec
        self.own = bus.spec.source
        self.conflicts = AddressConflicts(self.own)
        self.transfer_pace = TransferPace(bus.spec)
        self.other_stations = OtherStationsLoad(bus.spec)
        self._failure: LinkError | None = None
        self._listeners: tuple[Listener, ...] = ()
        self._asked: tuple[PendingBroadcast, ...] = ()
        self._lines: dict[tuple[int, int], AddressPair] = {}
        self._clashes: dict[int, float] = {}
        self._announced: dict[int, float] = {}
        self.presses = ButtonPressLog()
        self._lost_at = -math.inf
        self._lock = threading.Lock()
        self._sending = threading.Lock()
        self._closing = False
        self._wake, self._woken = socket.socketpair()
        self._reading = BusReader(bus, self._route, self._fail, self._woken)
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
        self._fail(LinkClosedError(f"The bus {self.spec.text} was closed."))
        self._wake.close()
        self._woken.close()

    @property
    def failed(self) -> bool:
        """True if the bus failed, or was closed: it has to be opened again."""
        return self._failure is not None

    @property
    def busy_seconds(self) -> float:
        """Wire time of all frames sent so far; 0 unless paced."""
        return self._bus.busy_seconds

    @property
    def lossy(self) -> bool:
        """True if frames were lost here a short while ago."""
        return time.monotonic() - self._lost_at < _LOSSY_SECONDS

    def note_loss(self) -> None:
        """Record a lost frame of an exchange."""
        self._lost_at = time.monotonic()

    def check(self) -> None:
        """Raise the LinkError that the bus met, if any."""
        if self._failure is not None:
            raise self._failure

    def next_of(self, queue: SimpleQueue[Thing], seconds: float) -> Thing:
        """Return the next item that the bus puts into a queue; raises Empty after ``seconds``."""
        return self._reading.wait_for(queue, seconds)

    def send(self, frame: Frame) -> None:
        """Put one frame on the bus; raises LinkError."""
        self.check()
        self.transfer_pace.count(frame)
        with self._sending:
            self._bus.send(frame)

    def listen(self, wanted: Callable[[Frame], bool], *, most: int = _MOST_HELD) -> Listener:
        """Hear every frame for which ``wanted`` is true, from now on; at most ``most`` wait to be read.

        ``wanted`` runs in the receiving loop: it must be quick and raise nothing.
        """
        listener = Listener(self, wanted, most)
        with self._lock:
            self._listeners = (*self._listeners, listener)
        return listener

    def forget(self, listener: Listener) -> None:
        """Take a listener away."""
        with self._lock:
            self._listeners = tuple(other for other in self._listeners if other is not listener)

    def address_pair(self, node: int, own: int | None = None) -> AddressPair:
        """Return the state for the node at this address; ``own`` is another station address, for testing a node."""
        pair = node, self.own if own is None else own
        # without the lock: a new pair costs more than a frame, and only the first frame needs one
        line = self._lines.get(pair)
        if line is None:
            with self._lock:
                line = self._lines.setdefault(pair, AddressPair(*pair))
        return line

    @contextmanager
    def gather(self, transaction: int) -> Iterator[PendingBroadcast]:
        """Collect the answers of all nodes to the functional Identify of this transaction.

        The loop continues for a moment afterwards: a caller that leaves with the first answer may later learn that a
        second node answered under the same address (:meth:`has_conflict`).
        """
        now = time.monotonic()
        asked = PendingBroadcast(BroadcastReplies(self.own, transaction), now, now)
        with self._lock:
            self._asked = (*(other for other in self._asked if other.until > now), asked)
        try:
            yield asked
        finally:
            asked.until = time.monotonic() + _STRAGGLERS_SECONDS

    def has_conflict(self, node: int) -> bool:
        """Return True if two nodes used this address recently, and no single one since then."""
        return time.monotonic() - self._clashes.get(node, -math.inf) < _CLASH_SECONDS

    # -- the loop and its callbacks --------------------------------------------------------------------------------

    def _fail(self, failure: LinkError) -> None:
        self._failure = self._failure or failure
        with self._lock:
            listeners, asked, lines = self._listeners, self._asked, list(self._lines.values())
        for listener in listeners:
            listener.wake()
        for pending_broadcast in asked:
            pending_broadcast.news.put(-1)
        for line in lines:
            line.events.put(ReplyEvent("failed"))
            line.flows.put(b"")

    def _route(self, frame: Frame) -> None:
        self.conflicts.check_frame(frame)
        self.transfer_pace.count(frame)
        self.other_stations.count(frame)
        if is_announce(frame.identifier):
            self._hear_announce(frame)
        ends = addresses(frame.identifier)
        if ends is not None and len(frame.data) >= 2:
            own, node = ends
            if own == self.own or (node, own) in self._lines:
                self._from_node(self.address_pair(node, own), frame)
        for listener in self._listeners:
            listener.offer(frame)

    def _hear_announce(self, frame: Frame) -> None:
        announce = Announce.decode(frame.identifier, frame.data)
        if announce is not None:
            self.presses.hear(announce)
            if announce.pressed:
                return  # a press is not a restart, so pending commands are not affected
        node = frame.identifier & 0xFF
        self._announced[node] = time.monotonic()
        line = self._lines.get((node, self.own))
        if line is not None and line.transaction >= 0:
            line.events.put(ReplyEvent("announced"))

    def announced_since(self, node: int, moment: float) -> bool:
        """Return True if a node announced itself at this address after ``moment`` (time.monotonic)."""
        return self._announced.get(node, -math.inf) > moment

    def _from_node(self, line: AddressPair, frame: Frame) -> None:
        line.heard_at = frame.at
        match frame.data[0] >> 4:
            case 0:
                self._single(line, frame)
            case 1:
                self._first(line, frame)
            case 2:
                self._consecutive(line, frame)
            # flow control matters only to a thread that sends; otherwise the queue would grow
            case 3 if line.transaction >= 0:
                line.flows.put(frame.data)

    def _single(self, line: AddressPair, frame: Frame) -> None:
        body = read_single(frame.data)
        if not body:
            return
        if body[0] == line.transaction:
            line.events.put(ReplyEvent("whole", body, frame.at))
            line.flows.put(b"")  # wakes a sender that waits for flow control
        elif not self._gathered(line, frame, body[0]) and body[0] not in line.asked:
            self.conflicts.record_unsolicited(line.node)

    def _first(self, line: AddressPair, frame: Frame) -> None:
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
                line.events.put(ReplyEvent("clash"))
            elif other is not None and not other.number:
                return  # the same frame twice
            line.partial, line.replies = partial, None
            self._ask_on(line, fd=frame.fd)
            line.events.put(ReplyEvent("begun"))
        elif self._gathered(line, frame, transaction):
            return
        elif transaction in line.asked:  # a late reply: end it, so that the node is free for the next command
            self._reply(flow(line.node, line.own, OVERFLOW, fd=frame.fd))
        else:
            self.conflicts.record_unsolicited(line.node)

    def _gathered(self, line: AddressPair, frame: Frame, transaction: int) -> bool:
        for asked in self._asked:
            if asked.replies.transaction == transaction and asked.until > frame.at:
                line.replies, line.partial = asked.replies, None
                self._gather(asked, line.node, frame)
                return True
        return False

    def _consecutive(self, line: AddressPair, frame: Frame) -> None:
        if line.replies is not None:
            for asked in self._asked:
                if asked.replies is line.replies:
                    self._gather(asked, line.node, frame)
            return
        partial = line.partial
        if partial is None:
            return
        match partial.add_frame(frame.data):
            case "whole":
                line.partial = None
                line.events.put(ReplyEvent("whole", bytes(partial.octets), frame.at))
            case "block":
                self._ask_on(line, fd=partial.fd)
            case "torn":
                line.partial = None
                self._reply(flow(line.node, line.own, OVERFLOW, fd=partial.fd))  # the rest is not needed
                line.events.put(ReplyEvent("torn"))

    def _gather(self, asked: PendingBroadcast, node: int, frame: Frame) -> None:
        gathering = asked.replies
        asked.heard_at = max(asked.heard_at, frame.at)
        before = len(gathering.answers), len(gathering.conflicts)
        answer = gathering.add_frame(frame)
        if answer is not None:
            self._reply(answer)
        if node in gathering.clashes:
            self._clashes[node] = time.monotonic()
        elif node in gathering.answers and self._clashes.get(node, math.inf) < asked.began:
            # One of the two nodes gave up the address after a Claim, so only one answers here. If both do, the conflict
            # is set again.
            del self._clashes[node]
        if before != (len(gathering.answers), len(gathering.conflicts)):
            asked.news.put(node)

    def _ask_on(self, line: AddressPair, *, fd: bool) -> None:
        """Ask for the next frames of a reply; only when that has left does the wait for them begin (N_Cr)."""
        self._reply(flow(line.node, line.own, CONTINUE, fd=fd, gap=line.gap))
        line.heard_at = time.monotonic()

    def _reply(self, frame: Frame) -> None:
        with self._sending:
            self._bus.send(frame)
