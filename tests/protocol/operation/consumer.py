"""A station's end of one stream, for the node's tests."""

from __future__ import annotations

from teds_provision.protocol.operation.can_frames import StreamAssembly, data_address
from teds_provision.protocol.operation.stream_commands import (
    CLOCK,
    ClockReply,
    decode_stopped,
    stop,
)
from teds_provision.protocol.operation.subscription import Receiver, StreamMessage, StreamPlan, TickBounds

from .bench import MS, Bench

WIDTHS = {1: 2, 2: 2, 3: 4, 4: 2, 5: 1, 6: 2}


class Consumer:
    """A station's end of one stream: subscribes and takes every frame that the bench has sent since."""

    def __init__(self, bench: Bench, stream: int = 0, channels: tuple[int, ...] = (1,), *, link: str = "can:f1",
                 left: bool = True, **more: object) -> None:  # fmt: skip
        asked = {"n": 2, "period": 10 * MS} | more
        self.bench, self.link = bench, link
        self.plan = StreamPlan.for_channels(stream, tuple((channel, WIDTHS[channel]) for channel in channels), **asked)  # type: ignore[arg-type]
        reply = bench.send(self.plan.command(), link, left=left)
        assert reply.ok, reply.reason
        self.reply = self.plan.accept(reply.payload, TickBounds(bench.hardware.tick, bench.hardware.tick))
        self.receiver = Receiver(self.plan, self.reply, bench.sessions[link].message_key, oldest=1 << 62)
        self.assembly = StreamAssembly(self.plan.length, fd=False)
        self.taken = len(bench.frames)

    def messages(self) -> list[StreamMessage]:
        """Return messages that came whole since the last call."""
        found = []
        for tick, frame in self.bench.frames[self.taken :]:
            address = data_address(frame.identifier)
            if address is None or (f"can:{address.station:02x}", address.stream) != (
                self.link,
                self.plan.subscribe.stream,
            ):
                continue
            whole = self.assembly.add_segment(address.segment, frame.data)
            message = self.receiver.open_message(whole, TickBounds(tick, tick)) if whole is not None else None
            if message is not None:
                found.append(message)
        self.taken = len(self.bench.frames)
        return found

    def stop(self) -> int:
        """Stop, and tell the receiver what the count was."""
        counter = decode_stopped(self.bench.send(stop(self.plan.subscribe.stream), self.link).payload)
        self.receiver.finish(counter)
        return counter


def values(message: StreamMessage, width: int = 2) -> list[int]:
    return [int.from_bytes(message.data[at : at + width], "big") for at in range(0, len(message.data), width)]


def clock(bench: Bench, link: str = "can:f1") -> ClockReply:
    return ClockReply.decode(bench.send(CLOCK, link).payload)
