"""The streams of one node, with the clock for their time stamps: subscribing, receiving, stopping, totals."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain

from teds_provision.errors import TedsProvisionError
from teds_provision.measure.blocks import Block, InvalidValues
from teds_provision.measure.buses import MeasuredBus
from teds_provision.measure.clock import ClockMap, HostClock, MonotonicStamps
from teds_provision.measure.interpreter import StreamInterpreter
from teds_provision.measure.rates import lower_rate
from teds_provision.measure.stream_receiver import ReceivedStream
from teds_provision.measure.verified_session import VerifiedSession, ask_clock
from teds_provision.protocol.operation.stream_commands import ClockReply, StreamKind, decode_stopped, stop
from teds_provision.protocol.operation.subscription import Receiver, StreamPlan
from teds_provision.provisioning.conversation import SessionLostError

UNSIGNED = "the datasheet is unsigned: raw values only"
SILENT = 2.0  # seconds without a good message, in addition to three messages' time, after which the node counts as lost


@dataclass
class StreamTotals:
    """Totals of one stream over all its runs."""

    channels: tuple[int, ...]
    period: float
    messages: int = 0
    samples: int = 0
    lost: int = 0
    late: int = 0
    bad: int = 0
    invalid: int = 0
    clock_error: float | None = None
    invalid_why: tuple[InvalidValues, ...] = ()

    def add(self, heard: ReceivedStream) -> None:
        """Count a run."""
        counts = heard.receiver.counts
        self.messages += counts.good
        self.samples += heard.samples
        self.lost += counts.lost
        self.late += counts.late + counts.stale + counts.overflow
        self.bad += counts.bad + counts.junk + counts.future + counts.back + counts.unasked + heard.wrong_pattern
        self.bad += heard.pieces.wrong
        self.invalid_why = added(self.invalid_why, heard.interpreter.invalid)
        self.invalid = sum(invalid.count for invalid in self.invalid_why)
        self.clock_error = heard.bound if heard.bound is not None else self.clock_error

    @property
    def lower_rate(self) -> float | None:
        """The rate to try if messages were lost; None if none was, or none came."""
        if not self.lost or not self.messages or self.period <= 0:
            return None
        return lower_rate(1 / self.period, self.messages, self.lost)

    def with_run(self, heard: ReceivedStream | None) -> StreamTotals:
        """Return these totals plus those of the current run; the object itself stays unchanged."""
        sums = replace(self)
        if heard is not None:
            sums.add(heard)
        return sums


def added(*parts: Sequence[InvalidValues]) -> tuple[InvalidValues, ...]:
    """Return counts of the same channel and reason added up."""
    counts: Counter[tuple[int, str]] = Counter()
    for invalid in chain.from_iterable(parts):
        counts[invalid.channel, invalid.why] += invalid.count
    return tuple(InvalidValues(channel, why, count) for (channel, why), count in counts.items())


class NodeStreams:
    """``running`` are the streams that are heard now, ``totals`` what became of all runs, ``clock`` the present map.

    ``mapping`` guards the clock's map, which the hearing thread reads and feeds.
    """

    def __init__(self, host: HostClock, deliver: Callable[[Block], None]) -> None:
        self.clock = ClockMap()
        self.mapping = threading.Lock()
        self.running: dict[int, ReceivedStream] = {}
        self.totals: dict[int, StreamTotals] = {}
        self._host, self._on_block = host, deliver
        self._held: list[Block] | None = None  # blocks that arrived before their channels were described
        self._gate = threading.Lock()
        self._run = 0  # number of the last run in the session
        self._monotone: dict[int, MonotonicStamps] = {}

    def new_session(self) -> None:
        """Start with an unknown clock: the node may have restarted. Runs begin at 1 again.

        Values are held back until :meth:`described`.
        """
        self._run = 0
        with self._gate:
            self._held = []
        with self.mapping:
            self.clock = ClockMap()

    def described(self) -> None:
        """Release held values, and all that come: every sink knows the channels.

        On a busy machine values come before the thread that subscribed has described them. They were recorded without
        unit and calibration then, and published without the mark of an unsigned datasheet.
        """
        with self._gate:
            held, self._held = self._held or [], None
            for block in held:
                self._on_block(block)

    def _deliver(self, block: Block) -> None:
        with self._gate:
            if self._held is None:
                self._on_block(block)
            else:
                self._held.append(block)

    def tell_time(self, trusted: VerifiedSession) -> ClockReply:
        """Send one Clock and record the exchange.

        It waits without the map's lock, which the receiver thread needs.
        """
        reply, exchange = ask_clock(trusted.node)
        with self.mapping:
            self.clock.exchange(exchange)
        return reply

    def subscribe(
        self, bus: MeasuredBus, trusted: VerifiedSession, plan: StreamPlan, address: int, *, ahead: float = 0.0
    ) -> None:
        """Subscribe to a stream and receive it; its first sample is taken ``ahead`` seconds from now."""
        number = plan.subscribe.stream
        before = self.running.get(number)
        pieces = bus.hearing.expect(address, number, plan.length)
        try:
            payload = trusted.node.request(plan.command(), "to stream")
            with self.mapping:
                reply = plan.accept(payload, self.clock.ticks_at(time.monotonic_ns()), after=self._run)
        except BaseException:
            if before is None:
                bus.hearing.forget(address, number)
            raise
        self._run = reply.run
        receiver = Receiver(
            plan, reply, trusted.node.message_key, previous=before.receiver if before is not None else None
        )
        monotone = self._monotone.setdefault(number, MonotonicStamps())
        interpreter = StreamInterpreter(
            trusted.sheet,
            plan,
            reply.run,
            self.clock,
            self._host,
            monotone,
            raw_only=UNSIGNED if trusted.unsigned else "",
        )
        stream = ReceivedStream(receiver, pieces, interpreter, self.clock, self.mapping, self._deliver)
        stream.last_good_at += ahead
        self.running[number] = stream
        self.totals.setdefault(number, StreamTotals(plan.layout.channels, plan.subscribe.period / 1e9))
        bus.hearing.register(address, number, stream)

    def stop(self, bus: MeasuredBus, trusted: VerifiedSession | None, address: int) -> None:
        """Stop each in order, so that its counter shows what was lost at the end.

        Without a session just stop listening.

        First wait for the messages that are being filled: the samples until now are all wanted, and Stop withdraws what
        has not left (operation.md section 4).
        """
        wanted = {number: heard.ending() for number, heard in self.running.items()} if trusted is not None else {}
        for number, due in wanted.items():
            bus.hearing.hear_out(self.running[number], due)
        for number, heard in list(self.running.items()):
            if trusted is not None:
                with suppress(TedsProvisionError, SessionLostError):
                    counter = decode_stopped(trusted.node.request(stop(number), "to stop a stream"))
                    due = min(counter, wanted[number]) if wanted[number] else counter
                    bus.hearing.hear_out(heard, due)
                    heard.receiver.finish(counter, due)
            bus.hearing.forget(address, number)
            self.totals[number].add(heard)
        self.running.clear()

    def first_sample(self) -> float:
        """Return when the last of its streams takes its first sample (monotonic seconds); 0.0 if none has a start."""
        with self.mapping:
            starts = [stream.receiver.start for stream in list(self.running.values())]
            return max((self.clock.host_of(start) for start in starts if start is not None), default=0.0)

    def summed(self) -> list[StreamTotals]:
        """Return the totals of each stream until now."""
        return [past.with_run(self.running.get(number)) for number, past in self.totals.items()]

    # -- checking that the node still sends --------------------------------------------------------------------------

    def _steady(self) -> list[ReceivedStream]:
        """Return streams that have messages all the time: events, and streams waiting for a trigger, may be silent."""
        return [
            stream
            for stream in self.running.values()
            if stream.receiver.plan.subscribe.kind != StreamKind.EVENT and stream.receiver.start is not None
        ]

    def every(self) -> float | None:
        """Return the seconds in which a message certainly comes while the node is there; None if unknown."""
        return min((3 * stream.receiver.plan.span / 1e9 for stream in self._steady()), default=None)

    def heard_since(self, moment: float) -> bool:
        """Return True if a good message came after ``moment`` (time.monotonic)."""
        return any(stream.last_good_at > moment for stream in self.running.values())

    def silent(self, now: float) -> float:
        """Return seconds of silence if that is too long, else 0.0."""
        for stream in self._steady():
            if now - stream.last_good_at > SILENT + 3 * stream.receiver.plan.span / 1e9:
                return now - stream.last_good_at
        return 0.0
