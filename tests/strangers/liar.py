"""A node that has its key and lies: of itself, its counters, ticks, runs and sizes, and in how it sends them.

Usage: python -m tests.strangers.liar FILE, as :mod:`tests.strangers.node`; ``fault`` names one of :data:`LIES`.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

from tests.strangers import crypto
from tests.strangers import node as firmware
from tests.strangers.node import Node, Session, Stream
from tests.strangers.wire import frames_of, padded

SECOND = 10**9
LIES = frozenset(
    """
reads nothing
reads one octet
reads another offset
lists what is not there
lists twice
size of 4 GB
run 0
run again
run far ahead
counter far ahead
ticks go back
ticks of tomorrow
ticks at the end of time
clock runs back
clock jumps
clock at the end of time
clock without precision
stops before it began
stops at the end of time
starts at the end of time
no length
mode of half a channel
mode of channels that are not there
power of one octet
sample too long
sample too short
busy for ever
replies of nothing
announces for ever
begins for ever
every message twice
a flood of events
block size 1
long gaps
forms mixed
never safe
replies twice
sealed by another
""".strip().splitlines()
)


class Liar(Node):
    """One lie each; all else is as the contract has it."""

    runs_told = 0

    def lies(self, *what: str) -> bool:
        return self.fault in what

    def list(self, payload: bytes) -> bytes:
        out = super().list(payload)
        if self.lies("lists what is not there"):
            return b"".join(struct.pack(">HB", n // 8, 128 + n % 8) for n in range(600)) + out
        return out + out if self.lies("lists twice") else out

    def read(self, channel: int, function: int, payload: bytes) -> bytes:
        out = super().read(channel, function, payload)
        if function == 1:
            return out[:2] + b"\xff" * 4 + out[6:] if self.lies("size of 4 GB") else out
        if self.lies("reads nothing") and payload[0] != 128:
            return out[:4]
        if self.lies("reads another offset"):
            return b"\0\0\0\1" + out[4:]
        return out[:5] if self.lies("reads one octet") else out

    def clock(self, session: Session, payload: bytes) -> bytes:
        out = super().clock(session, payload)
        if self.lies("clock at the end of time"):
            return struct.pack(">QQQIHI", 2**64 - 2, 2**64 - 1, 2**64 - 1, 2**32 - 1, 65535, 2**32 - 2)
        return out[:24] + b"\xff" * 6 + out[30:] if self.lies("clock without precision") else out

    def subscribe(self, session: Session, payload: bytes) -> bytes:
        out = super().subscribe(session, payload)
        stream = session.streams[payload[0]]
        run = {"run 0": 0, "run again": 1, "run far ahead": 65535}.get(self.fault, stream.run)
        stream.key = session.keys.run(run)
        out = run.to_bytes(2, "big") + out[2:]
        if self.lies("no length"):
            return out[:2] + bytes(2) + out[4:]
        return out[:4] + b"\xff" * 8 if self.lies("starts at the end of time") else out

    def stop(self, session: Session, payload: bytes) -> bytes:
        out = super().stop(session, payload)
        if self.lies("stops before it began"):
            return bytes(4)
        return b"\xff" * 4 if self.lies("stops at the end of time") else out

    def operation(self, session: Session, payload: bytes) -> bytes:
        out = super().operation(session, payload)
        if self.lies("mode of half a channel"):
            return out[:-1]
        if self.lies("mode of channels that are not there"):
            return out[:1] + bytes([0, 255, 255, 9, 255, 255, 9, 255, 255])
        if self.lies("never safe"):
            return out[:1] + b"".join(bytes([out[n], out[n + 1] & ~16, out[n + 2]]) for n in range(1, len(out), 3))
        return out

    def power(self, session: Session, payload: bytes) -> bytes:
        return b"\xff" if self.lies("power of one octet") else super().power(session, payload)

    def sample(self, session: Session, payload: bytes) -> bytes:
        out = super().sample(session, payload)
        return out + b"\0" if self.lies("sample too long") else out[:-1] if self.lies("sample too short") else out

    def value_of(self, session: Session, channel: int, payload: bytes) -> bytes:
        out = super().value_of(session, channel, payload)
        return out + b"\0" if self.lies("sample too long") else out[:-1] if self.lies("sample too short") else out

    def answer(self, peer: int, frame: bytes, session: Session | None = None) -> bytes:
        if self.lies("busy for ever") and frame[2:4] == b"\x80\x04":
            return b"\0\0\1\x11"
        out = super().answer(peer, frame, session)
        if session is not None and self.lies("replies of nothing"):
            return b""
        if self.lies("sealed by another") and frame[2:4] == b"\x80\x04" and len(self.stored) and self.tick() % 3 == 0:
            return out[:-1] + bytes([out[-1] ^ 1])
        return out

    def take(self, peer: int, body: bytes, fd: bool) -> None:
        super().take(peer, body, fd)
        if self.lies("replies twice"):
            super().take(peer, body, fd)

    def due(self, session: Session, number: int, stream: Stream, now: int) -> None:
        before = stream.counter
        super().due(session, number, stream, now)
        if stream.counter == before:
            return
        if self.lies("counter far ahead") and stream.counter == 20:
            stream.counter = 2**32 - 4
            stream.start = now - stream.counter * stream.n * stream.period
        if stream.counter >= 2**32 - 1:
            del session.streams[number]

    def send_data(self, session: Session, number: int, octets: bytes, stream: Stream) -> None:
        super().send_data(session, number, octets, stream)
        if self.lies("every message twice"):
            super().send_data(session, number, octets, stream)

    def loop(self) -> None:
        self.announce()
        last = 0.0
        while True:
            self.wire.turn(0.002)
            self.pump()
            if time.monotonic() - last < 0.005:
                continue
            last = time.monotonic()
            if self.lies("announces for ever"):
                self.announce()
            if self.lies("begins for ever"):
                for station in (0xF1, 0xF2):
                    head = bytes([0x1F, 0xFF]) + os.urandom(6)
                    self.wire.put(0x18DA0000 | station << 8 | self.address, head, False)


class BentWire:
    """A wire that sends its ISO-TP frames in another way."""

    def __init__(self, node: Liar) -> None:
        self.node, self.wire = node, node.wire
        self.flow, self.send_whole = node.wire._flow, node.wire.send
        node.wire._flow = self._flow  # type: ignore[method-assign]
        if node.lies("forms mixed"):
            node.wire.send = self._mixed  # type: ignore[method-assign]

    def _flow(self, peer: int, fd: bool) -> None:
        if self.node.lies("block size 1", "long gaps"):
            flow_control = bytes([0x30, 1, 0]) if self.node.lies("block size 1") else bytes([0x30, 16, 127])
            self.wire.coming[peer].since = 15 if self.node.lies("block size 1") else 0
            self.wire.put(0x18DA0000 | peer << 8 | self.wire.own, padded(flow_control, fd), fd)
        else:
            self.flow(peer, fd)

    def _mixed(self, peer: int, body: bytes, fd: bool) -> None:
        """Every second frame in the other form, none waits for a flow control."""
        for n, data in enumerate(frames_of(body, False)):
            self.wire.put(0x18DA0000 | peer << 8 | self.wire.own, data, bool(n % 2))


def lying_ticks(node: Liar) -> None:
    """Free streams, whose ticks the node makes: shift them in each message."""
    real: Callable[..., bytes] = crypto.message

    def bent(key: bytes, counter: int, plain: bytes) -> bytes:
        if len(plain) >= 11 and node.lies("ticks go back", "ticks of tomorrow", "ticks at the end of time"):
            tick = int.from_bytes(plain[1:9], "big")
            shift = {"ticks go back": -(counter % 5) * 20_000_000, "ticks of tomorrow": 86_400 * SECOND}
            tick = tick + shift[node.fault] if node.fault in shift else 2**64 - 1 - counter
            plain = plain[:1] + tick.to_bytes(8, "big") + plain[9:]
        return real(key, counter, plain)

    vars(firmware)["message"] = bent


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
    node = Liar(json.loads(Path(sys.argv[1]).read_text()))
    assert node.fault in LIES, node.fault
    BentWire(node)
    lying_ticks(node)
    print(json.dumps({"ready": True}), flush=True)
    node.loop()


if __name__ == "__main__":
    main()
