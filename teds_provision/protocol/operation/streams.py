"""Streams on the node: being filled, being sent, dropped whole (operation.md sections 3 and 4). Pure.

A stream has one message being filled, one that is full and waits, and one being sent. One that waits when the next is
full is dropped, its counter too: newest wins, no queue grows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from teds_provision.protocol.operation.can_frames import DataAddress, Segment, ble_frame, cut
from teds_provision.protocol.operation.commands import NOT_VALID, TEST_PATTERN
from teds_provision.protocol.operation.datagram import LAST_COUNTER, DatagramSealer, Layout, pattern, stream_key
from teds_provision.protocol.operation.hardware import Hardware, SessionPort
from teds_provision.protocol.operation.stream_commands import StreamKind, SubscribeCommand
from teds_provision.protocol.session import NodeSession

MICRO: Final = 1000
_TICK: Final = 8


class FullMessage(NamedTuple):
    """A message that is full and not sealed yet."""

    counter: int
    plain: bytes


class Stream:
    """One run of one stream. ``start`` in ns, None while it waits for a trigger; ``session``'s replies go first."""

    def __init__(
        self,
        session: NodeSession,
        port: SessionPort,
        asked: SubscribeCommand,
        layout: Layout,
        run: int,
        start: int | None,
    ) -> None:
        self.session, self.port, self.asked, self.layout, self.run = session, port, asked, layout, run
        self.start = start
        self.length = asked.length(layout.octets)
        self.span = asked.n * asked.period
        self.counter = 0
        self.missed = 0
        self.ready = False
        self.ended = False
        self.waiting: FullMessage | None = None
        self._sealer = DatagramSealer(stream_key(session.message_key, run))
        self._filling = bytearray()
        self._flags = 0
        self._held = 0
        self._last_event: int | None = None
        self._patterned = 0

    @property
    def channels(self) -> tuple[int, ...]:
        """Channels in the order of Subscribe."""
        return self.layout.channels

    @property
    def next_instant(self) -> int | None:
        """The tick of the next sample, None while waiting for events or a trigger."""
        if self.start is None or self.ended:
            return None
        if self.asked.kind == StreamKind.EVENT:
            return self.start + self._patterned * self.asked.period if self.asked.test_pattern else None
        return self.start + (self.counter * self.asked.n + self._held) * self.asked.period

    def seal(self) -> bytes | None:
        """Take the message that waits, sealed."""
        full, self.waiting = self.waiting, None
        return None if full is None else self._sealer.seal(full.counter, full.plain)

    def sample(self, hardware: Hardware, now: int) -> None:
        """Take every sample that is due at tick ``now``."""
        while not self.ended and (due := self.next_instant) is not None and due <= now:
            if self.asked.kind == StreamKind.EVENT:
                octets = pattern(self.channels[0], self.layout.octets, self._patterned)
                self._patterned += 1
                self._event(due, octets, valid=True)
            elif self._held == 0 and now - due >= 3 * self.span and self.counter < LAST_COUNTER:
                # after a suspend of the host, the missed messages count as lost; the last one is sent
                self._skip((now - due) // self.span - 1)
            else:
                self._instant(hardware, due)

    def event(self, channel: int, tick: int, octets: bytes, *, valid: bool) -> None:
        """Record a value of an event sensor at ``tick``."""
        if self.asked.kind != StreamKind.EVENT or self.asked.test_pattern or self.channels != (channel,) or self.ended:
            return
        if self.start is not None and tick >= self.start:
            self._event(tick, octets, valid=valid)

    def _event(self, tick: int, octets: bytes, *, valid: bool) -> None:
        soon = self._last_event is not None and tick - self._last_event < self.asked.period
        if soon:
            self._count()
            return
        self._last_event = tick
        self._flags = 0 if valid else NOT_VALID
        self._filling = bytearray(tick.to_bytes(_TICK, "big") + octets)
        self._full()

    def _instant(self, hardware: Hardware, tick: int) -> None:
        if self._held == 0 and self.asked.kind == StreamKind.FREE:
            self._filling += tick.to_bytes(_TICK, "big")
        index = self.counter * self.asked.n + self._held
        for channel, width in zip(self.channels, self.layout.widths, strict=True):
            if self.asked.test_pattern:
                self._filling += pattern(channel, width, index)
                continue
            octets, valid = hardware.read(channel, tick)
            self._filling += octets
            if not valid or hardware.testing(channel) or hardware.fault(channel):
                self._flags |= NOT_VALID
        self._held += 1
        if self._held == self.asked.n:
            self._full()

    def _full(self) -> None:
        flags = self._flags | (TEST_PATTERN if self.asked.test_pattern else 0)
        if self.waiting is not None:
            self.missed += 1
        self.waiting = FullMessage(self.counter, bytes([flags]) + bytes(self._filling))
        self._filling, self._flags, self._held = bytearray(), 0, 0
        self._count()

    def _count(self) -> None:
        self.counter += 1
        self.ended = self.counter > LAST_COUNTER

    def _skip(self, messages: int) -> None:
        messages = min(messages, LAST_COUNTER - self.counter)
        self.counter += messages
        self.missed += messages


class DataFrame(NamedTuple):
    """A data frame to send now. CAN: identifier, data, FD or not. BLE: identifier 0, ``data`` is the notification."""

    link_source: int
    identifier: int
    data: bytes
    fd: bool = False


class Sender:
    """Sends the messages of one bus: one frame at a time, at least the gap apart, the shorter n · period first.

    ``gap`` is asked for before each frame, in ns; ``address`` gives the node's CAN address.
    """

    def __init__(self, address: Callable[[], int]) -> None:
        self._address = address
        self._stream: Stream | None = None
        self._pieces: Iterator[Segment] | None = None
        self._next: Segment | None = None
        self._free_at = 0

    def take_back(self, stream: Stream) -> None:
        """Drop the unsent messages of a stream that ended."""
        stream.waiting = None
        if self._stream is stream:
            self._stream, self._pieces, self._next = None, None, None

    def sends(self, stream: Stream) -> bool:
        """Return True if a message of this stream is being sent."""
        return self._stream is stream

    def due(self, streams: list[Stream]) -> int | None:
        """Return when the next frame may begin, real ns; None if there is nothing to send."""
        return self._free_at if self._next is not None or self._choice(streams) is not None else None

    def frame(self, streams: list[Stream], now: int) -> DataFrame | None:
        """Return the frame to send at real time ``now``; None if the gap has not passed or there is none."""
        if now < self._free_at:
            return None
        if self._next is None:
            self._begin(streams)
        stream, piece = self._stream, self._next
        if stream is None or piece is None:
            return None
        self._free_at = now + gap(streams)
        assert self._pieces is not None
        self._next = next(self._pieces, None)
        if self._next is None:
            self._stream = None
        port, number = stream.port, stream.asked.stream
        if port.kind == "ble":
            return DataFrame(port.source, 0, ble_frame(number, piece.data))
        address = DataAddress(port.source, number, piece.segment, self._address())
        return DataFrame(port.source, address.identifier, piece.data, port.fd)

    def _begin(self, streams: list[Stream]) -> None:
        chosen = self._choice(streams)
        message = chosen.seal() if chosen is not None else None
        if chosen is None or message is None:
            return
        self._stream = chosen
        ble = chosen.port.kind == "ble"
        self._pieces = iter([Segment(0, message)]) if ble else cut(message, fd=chosen.port.fd)
        self._next = next(self._pieces)

    def _choice(self, streams: list[Stream]) -> Stream | None:
        waiting = [stream for stream in streams if stream.waiting is not None and stream.ready]
        return min(waiting, key=lambda stream: stream.span, default=None)


def gap(streams: list[Stream]) -> int:
    """Return the largest gap of the streams of a bus, at least 1 µs, in ns."""
    return max([1, *(stream.asked.gap for stream in streams)]) * MICRO
