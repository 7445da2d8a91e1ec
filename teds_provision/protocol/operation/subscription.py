"""A stream on the station's side: its request, and which messages it accepts (operation.md sections 3 and 4).

:class:`StreamPlan` builds Subscribe and checks its reply; :class:`Receiver` opens messages, drops those that section 3
excludes and counts each cause separately. It has no clock: the caller passes the bounds of the node's present tick.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

from teds_provision.errors import NotAuthenticError
from teds_provision.protocol.messages.frames import Command
from teds_provision.protocol.operation.budget import MOST_OCTETS
from teds_provision.protocol.operation.commands import NOT_VALID, TEST_PATTERN
from teds_provision.protocol.operation.datagram import (
    COUNTER_OCTETS,
    DatagramSealer,
    Layout,
    pattern,
    stream_key,
)
from teds_provision.protocol.operation.stream_commands import (
    SOON,
    WAITS,
    StreamKind,
    SubscribeCommand,
    SubscribeReply,
    message_length,
)

START_WITHIN: Final = 10**9
"""A stream that was asked to begin soon begins within so many ns after the reply's tick."""
LATE_AFTER: Final = 200 * 10**6
"""A message may be 2 · n · period + so many ns old."""
MOST_HELD: Final = 64
"""Messages of a stream that waits for its trigger which are held until the mark is read; the oldest goes first."""
_TICK: Final = 8


class TickBounds(NamedTuple):
    """Bounds of the node's present tick in ns, from the clock map and its error."""

    low: int
    high: int


@dataclass(frozen=True)
class StreamPlan:
    """A stream that a station wants.

    ``subscribe`` is the command, ``layout`` the channels' widths (from the signed TEDS).
    """

    subscribe: SubscribeCommand
    layout: Layout

    @classmethod
    def for_channels(
        cls,
        stream: int,
        channels: tuple[tuple[int, int], ...],
        *,
        n: int,
        period: int,
        kind: StreamKind = StreamKind.PERIODIC,
        gap: int = 0,
        start: int = SOON,
        test_pattern: bool = False,
    ) -> StreamPlan:
        """Return a plan over (channel, ModLenth) pairs; ``period`` and ``start`` in ns, ``gap`` in µs."""
        numbers, widths = tuple(c for c, _ in channels), tuple(w for _, w in channels)
        return cls(
            SubscribeCommand(stream, kind, n, gap, period, start, numbers, test_pattern), Layout(numbers, widths)
        )

    @property
    def length(self) -> int:
        """Octets of each data message."""
        return message_length(self.subscribe.kind, self.subscribe.n, self.layout.octets)

    @property
    def fits(self) -> bool:
        """True if a message has at most 240 octets (on BLE the MTU may require less)."""
        return self.length <= MOST_OCTETS

    @property
    def span(self) -> int:
        """N · period in ns: what one message covers."""
        return self.subscribe.n * self.subscribe.period

    def command(self) -> Command:
        """Return the Subscribe command."""
        return self.subscribe.command()

    def accept(self, payload: bytes, now: TickBounds, *, after: int = 0) -> SubscribeReply:
        """Decode the reply; ``now`` bounds the node's tick when it came (it may have been made up to 1 s before).

        ``after`` is the session's last run. Raises GarbledError, or NotAuthenticError if length or start differ from
        the request, or the run is not a new one: end and report the stream.
        """
        reply, asked = SubscribeReply.decode(payload), self.subscribe.start
        if reply.length != self.length:
            raise NotAuthenticError(f"The node streams {reply.length} octets a message; {self.length} were computed.")
        good = now.low <= reply.start + START_WITHIN and reply.start <= now.high + START_WITHIN
        if reply.start != asked and not (asked == SOON and good):
            raise NotAuthenticError("The node's stream begins at another time than was asked.")
        require_new_run(reply.run, after)
        return reply


def require_new_run(run: int, after: int) -> None:
    """Raise NotAuthenticError if a session's run is not above the last one: two runs would have one key."""
    if run <= after:
        text = f"run {run} after run {after}" if after else f"run {run}; runs begin at 1"
        raise NotAuthenticError(f"The node names {text}.", hint="Its firmware does not keep to the profile.")


def most_instants(kind: StreamKind, octets: int, most: int = MOST_OCTETS) -> int:
    """Return the largest n whose message has at most ``most`` octets, one instant having ``octets``; 0 if none fits."""
    room = most - message_length(kind, 0, 0)
    return max(0, min(255, room // octets, 1 if kind == StreamKind.EVENT else 255)) if octets else 0


class StreamMessage(NamedTuple):
    """One good data message: ``index`` of its first sample, ``tick`` of that (ns), n instants one after another.

    Sample i of it was taken at ``tick`` + i · period (kinds periodic and free). For events ``index`` counts events.
    """

    # A NamedTuple, for speed: one is made for every message. It hides tuple.index, which no caller needs.
    counter: int
    index: int  # type: ignore[assignment]
    tick: int
    flags: int
    data: bytes

    @property
    def valid(self) -> bool:
        """True if every value in it is valid."""
        return not self.flags & NOT_VALID

    @property
    def test_pattern(self) -> bool:
        """True if it is a test pattern and no measurement."""
        return bool(self.flags & TEST_PATTERN)


@dataclass
class Counts:
    """Counters of messages; each counts once.

    ``lost``: gaps of the counter, to the count that Stop gave. ``late``: counter not above the last good one (late,
    doubled, replayed). ``bad``: wrong tag. ``junk``: wrong length, or frames that make no message. ``future``: its
    first tick is later than now. ``stale``: too old. ``back``: its tick is not later than that of the good one before,
    though ticks never go back. ``unasked``: a test pattern that was not requested, or the other way round.
    ``overflow``: held for a mark for too long. ``cut``: begun after the end that the station wanted, and withdrawn by
    Stop before it had left.
    """

    good: int = 0
    lost: int = 0
    late: int = 0
    bad: int = 0
    junk: int = 0
    future: int = 0
    stale: int = 0
    back: int = 0
    unasked: int = 0
    overflow: int = 0
    cut: int = 0


class Receiver:
    """Opens the messages of one run of a stream.

    ``message_key`` is k_m of the session; ``previous`` the receiver of the same stream's run before, whose messages may
    still be under way: they are dropped and not counted. ``oldest`` in ns replaces the age up to which one counts.
    """

    def __init__(
        self,
        plan: StreamPlan,
        reply: SubscribeReply,
        message_key: bytes,
        *,
        previous: Receiver | None = None,
        oldest: int | None = None,
    ) -> None:
        self.plan, self.run = plan, reply.run
        self.start: int | None = None if reply.start == WAITS else reply.start
        self.counts = Counts()
        self.last = -1
        self._sealer = DatagramSealer(stream_key(message_key, reply.run))
        self._before = previous._sealer if previous is not None else None
        self._length = plan.length
        self._n, self._period = plan.subscribe.n, plan.subscribe.period
        # The limit applies to the last instant, and a message has the time of its first one.
        self._oldest = (2 * plan.span + LATE_AFTER if oldest is None else oldest) + plan.span - self._period
        self._timed = plan.subscribe.kind != StreamKind.PERIODIC
        self._tick = -1  # tick of the last good message
        self._pattern = TEST_PATTERN if plan.subscribe.test_pattern else 0
        self._held: deque[tuple[StreamMessage, TickBounds]] = deque()

    def open_message(self, octets: bytes, now: TickBounds) -> StreamMessage | None:
        """Open one message; None if it is dropped (see ``counts``) or held until :meth:`begin`."""
        found = self.open_messages(((octets, 0),), now)
        return found[0] if found else None

    def open_messages(self, came: Iterable[tuple[bytes, int]], ahead: TickBounds) -> list[StreamMessage]:
        """Open messages in the order in which they came, each with its time of arrival by the host's clock (ns).

        ``ahead`` bounds what the node's tick is ahead of that clock. Gives the good ones that are not held.
        """
        good, length, opened, pattern = [], self._length, self._sealer.open, self._pattern
        dated = self.start is not None or self._timed
        for octets, at in came:
            plain = opened(octets) if len(octets) == length else None
            if plain is None:
                # Wrong length, or a tag that does not verify under this run's key.
                if len(octets) != self._length:
                    self.counts.junk += 1
                elif self._before is None or self._before.open(octets) is None:
                    self.counts.bad += 1
                continue
            counter = int.from_bytes(octets[:COUNTER_OCTETS], "big")
            if counter != self.last + 1 and not self._jumps(counter):
                continue
            self.last = counter
            message = self._read(counter, plain)
            if message.flags & TEST_PATTERN != pattern:
                self.counts.unasked += 1
            elif not dated:
                # Hold the message, because the clock or the start is not known yet; if there are too many, drop the
                # oldest.
                if len(self._held) == MOST_HELD:
                    self._held.popleft()
                    self.counts.overflow += 1
                self._held.append((message, TickBounds(at + ahead.low, at + ahead.high)))
            elif self._fresh(message.tick, at + ahead.low, at + ahead.high):
                good.append(message)
        self.counts.good += len(good)
        return good

    def _jumps(self, counter: int) -> bool:
        """Return True if a counter that does not follow is a later one: the messages between are lost."""
        if counter <= self.last:
            self.counts.late += 1
            return False
        self.counts.lost += counter - self.last - 1
        return True

    def _read(self, counter: int, plain: bytes) -> StreamMessage:
        index = counter * self._n
        if self._timed:
            return StreamMessage(
                counter, index, int.from_bytes(plain[1 : 1 + _TICK], "big"), plain[0], plain[1 + _TICK :]
            )
        return StreamMessage(counter, index, index * self._period + (self.start or 0), plain[0], plain[1:])

    def begin(self, start: int) -> list[StreamMessage]:
        """Begin a stream that waited, at its first instant (mark + 10 ms); return the held messages that are fresh."""
        self.start = start
        held, self._held = self._held, deque()
        dated = ((message._replace(tick=start + message.tick), now) for message, now in held)
        good = [message for message, now in dated if self._fresh(message.tick, now.low, now.high)]
        self.counts.good += len(good)
        return good

    def begun(self, tick: int) -> int:
        """Return how many messages of this run had begun by a tick (ns), by period and start.

        0 if that is not known.
        """
        if self.start is None or self.plan.subscribe.kind == StreamKind.EVENT:
            return 0
        return max(0, (tick - self.start) // self.plan.span + 1)

    def finish(self, counter: int, wanted: int | None = None) -> None:
        """Stop gave the counter that the next message would have had: what is missing up to there was lost.

        Of the last ones only so far as the station wanted them, the first ``wanted`` of the run: what Stop itself took
        back after the end of the measurement is ``cut``.
        """
        due = counter if wanted is None else min(counter, wanted)
        self.counts.lost += max(0, due - self.last - 1)
        self.counts.cut += counter - max(due, self.last + 1) if counter > self.last + 1 else 0
        self.last = max(self.last, counter - 1)

    def expected(self, message: StreamMessage) -> bytes:
        """Return the test pattern that this message must hold."""
        layout, n = self.plan.layout, self.plan.subscribe.n
        rows = (
            pattern(channel, width, message.index + i)
            for i in range(n)
            for channel, width in zip(layout.channels, layout.widths, strict=True)
        )
        return b"".join(rows)

    def _fresh(self, tick: int, low: int, high: int) -> bool:
        """Return True if it is after the one before, neither from the future nor too old; else count it.

        The node's tick is between ``low`` and ``high``.
        """
        if tick > high:
            self.counts.future += 1
            return False
        if tick < low - self._oldest:
            self.counts.stale += 1
            return False
        if tick <= self._tick:
            self.counts.back += 1
            return False
        self._tick = tick
        return True
