"""A stranger's station: one session with one node over CAN, every command of operation.md by hand."""

from __future__ import annotations

import hashlib
import os
import struct
import time
from dataclasses import dataclass, field
from typing import Any

import can
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.asymmetric import ec

from tests.strangers.crypto import CURVE, Keys, key_id, mac, message, opened, point, seal, unseal
from tests.strangers.wire import Wire, pieces


class NodeRefusalError(Exception):
    """The node's reason."""

    def __init__(self, reason: int, outer: bool = False) -> None:
        super().__init__(f"{'outer ' if outer else ''}reason {reason}")
        self.reason, self.outer = reason, outer


@dataclass
class Run:
    """A stream that runs: what Subscribe said, and what came."""

    stream: int
    kind: int
    n: int
    period: int
    widths: list[int]
    run: int
    length: int
    start: int
    key: bytes
    messages: list[tuple[int, bytes]] = field(default_factory=list)
    bad: int = 0
    whole: bytearray = field(default_factory=bytearray)
    expected: int = 0

    def frame(self, segment: int, data: bytes) -> None:
        if segment == 0:
            self.whole, self.expected = bytearray(), 0
        elif segment != self.expected:
            self.expected = -1
        if self.expected < 0:
            return
        self.whole += data
        self.expected = self.expected % 7 + 1
        if len(self.whole) >= self.length:
            octets, self.expected = bytes(self.whole[: self.length]), -1
            try:
                self.messages.append(opened(self.key, octets))
            except InvalidTag:
                self.bad += 1


class Station:
    """``spec``: group and port of the bus; ``own`` F1 to F7."""

    def __init__(
        self, group: str, port: int, node: int, uuid: bytes, key: bytes, *, own: int = 0xF1, fd: bool = False
    ) -> None:
        self.node, self.uuid, self.key, self.fd = node, uuid, key, fd
        self.replies: list[bytes] = []
        self.runs: dict[int, Run] = {}
        self.data_frames: list[can.Message] = []
        self.wire = Wire(group, port, own, fd, self._came, self._other)
        self.transaction = os.urandom(1)[0]
        self.keys: Keys | None = None
        self.counter = 0

    def _came(self, peer: int, body: bytes, _fd: bool) -> None:
        if peer == self.node:
            self.replies.append(body)

    def _other(self, frame: can.Message) -> None:
        identifier = frame.arbitration_id
        if identifier >> 16 != 0x1CFF or identifier & 0xFF != self.node:
            return
        low, stream, segment = identifier >> 13 & 7, identifier >> 11 & 3, identifier >> 8 & 7
        if low == self.wire.own & 7:
            self.data_frames.append(frame)
            if stream in self.runs:
                self.runs[stream].frame(segment, bytes(frame.data))

    # -- commands ------------------------------------------------------------------------------------------------------

    def raw(self, frame: bytes, *, again: bool = False, seconds: float = 10.0) -> bytes:
        """Send one command frame and return its reply frame; ``again``: under the transaction of the one before."""
        if not again:
            self.transaction = (self.transaction + 1) % 256
        for _ in range(3):
            self.replies.clear()
            self.wire.send(self.node, bytes([self.transaction]) + frame, self.fd)
            end = time.monotonic() + seconds / 3
            while time.monotonic() < end:
                self.wire.turn(0.002)
                for body in self.replies:
                    if body[0] == self.transaction:
                        return body[1:]
        raise TimeoutError("no reply")

    @staticmethod
    def command(channel: int, class_: int, function: int, payload: bytes = b"") -> bytes:
        return struct.pack(">HBBH", channel, class_, function, len(payload)) + payload

    @staticmethod
    def payload(reply: bytes, outer: bool = False) -> bytes:
        status, length = reply[0], int.from_bytes(reply[1:3], "big")
        assert length == len(reply) - 3, reply.hex()
        if not status:
            raise NodeRefusalError(reply[3], outer)
        return reply[3:]

    def plain(self, channel: int, class_: int, function: int, payload: bytes = b"") -> bytes:
        return self.payload(self.raw(self.command(channel, class_, function, payload)), True)

    def open(self) -> None:
        c = self.plain(0, 128, 3)
        own = ec.generate_private_key(CURVE)
        es = point(own)
        proof = mac(self.key, b"station open", self.uuid, c, es)
        answer = self.plain(0, 128, 3, key_id(self.key) + es + proof)
        en, tag = answer[:65], answer[65:]
        keys = Keys.of(self.key, self.uuid, own, en, es, en)
        assert tag == keys.tag(self.key, es, en)
        self.keys, self.counter = keys, 0
        self.runs.clear()

    def sealed(self, inner: bytes, counter: int | None = None) -> bytes:
        """Return the frame of a sealed command."""
        assert self.keys is not None
        self.counter = self.counter + 1 if counter is None else counter
        return self.command(0, 128, 4, seal(self.keys.down, self.counter, inner))

    def do(self, channel: int, class_: int, function: int, payload: bytes = b"") -> bytes:
        """Send an inner command; return its payload, or raise NodeRefusalError."""
        assert self.keys is not None
        frame = self.sealed(self.command(channel, class_, function, payload))
        counter, inner = unseal(self.keys.up, self.payload(self.raw(frame), True))
        assert counter == self.counter
        return self.payload(inner)

    def teds(self, channel: int, code: int) -> bytes:
        size = int.from_bytes(self.do(channel, 1, 1, bytes([code]))[2:6], "big")
        out = b""
        while len(out) < size:
            piece = self.do(channel, 1, 2, bytes([code]) + len(out).to_bytes(4, "big"))
            assert int.from_bytes(piece[:4], "big") == len(out)
            out += piece[4:]
        return out

    @property
    def digest(self) -> bytes:
        return hashlib.sha256(self.teds(0, 128)).digest()[:16]

    # -- operation -----------------------------------------------------------------------------------------------------

    def operate(
        self, channel: int, *, lease: int = 10, dead_man: int | None = None, digest: bytes | None = None
    ) -> None:
        tail = b"" if dead_man is None else dead_man.to_bytes(2, "big")
        self.do(channel, 4, 1, (digest or self.digest) + bytes([lease]) + tail)

    def idle(self, channel: int = 0) -> None:
        self.do(channel, 4, 2)

    def states(self) -> tuple[int, dict[int, tuple[int, int]]]:
        reply = self.do(0, 128, 19)
        rest = reply[1:]
        return reply[0], {rest[at]: (rest[at + 1], rest[at + 2]) for at in range(0, len(rest), 3)}

    def clock(self) -> dict[str, int]:
        names = ("received", "sent", "mark", "step", "drift", "last")
        return dict(zip(names, struct.unpack(">QQQIHI", self.do(0, 128, 16)), strict=True))

    def subscribe(
        self, stream: int, kind: int, n: int, period: int, channels: dict[int, int], *, gap: int = 200, start: int = 0
    ) -> Run:
        words = struct.pack(">BBBHQQ", stream, kind, n, gap, period, start) + bytes(channels)
        run, length, began = struct.unpack(">HHQ", self.do(0, 128, 14, words))
        assert self.keys is not None
        made = Run(stream, kind, n, period, list(channels.values()), run, length, began, self.keys.run(run))
        self.runs[stream] = made
        return made

    def stop(self, stream: int) -> int:
        return int.from_bytes(self.do(0, 128, 15, bytes([stream])), "big")

    def hear(self, run: Run, count: int, seconds: float = 20.0) -> list[tuple[int, bytes]]:
        end = time.monotonic() + seconds
        while len(run.messages) < count:
            assert time.monotonic() < end, (len(run.messages), run.bad)
            self.wire.turn(0.01)
        return run.messages

    def drive(self, channels: list[int]) -> tuple[int, int, bytes]:
        run, length = struct.unpack(">HH", self.do(0, 128, 20, bytes(channels)))
        assert self.keys is not None
        return run, length, self.keys.run(run, drive=True)

    def drive_message(self, key: bytes, counter: int, until_us: int, values: bytes) -> bytes:
        return message(key, counter, (until_us % 2**32).to_bytes(4, "big") + values)

    def put_drive(self, octets: bytes) -> None:
        for _, data in pieces(octets, self.fd, drive=True):
            self.wire.put(0x18EF0000 | self.node << 8 | self.wire.own, data, self.fd)

    def trigger(self, token: bytes) -> None:
        self.wire.put(0x18FF0000 | self.wire.own, token)

    def close(self) -> None:
        self.wire.bus.shutdown()


def identify(group: str, port: int, *, fd: bool, own: int = 0xF7, seconds: float = 1.0) -> list[dict[str, Any]]:
    """Return a functional Identify: who is there."""
    found: list[dict[str, Any]] = []

    def take(peer: int, body: bytes, _fd: bool) -> None:
        reply = body[4:]
        found.append({"address": peer, "uuid": reply[1:11], "state": reply[11], "can": reply[22]})

    wire = Wire(group, port, own, fd, take, lambda _frame: None)
    wire.put(0x18DBFF00 | own, bytes([7, 0x42]) + Station.command(0, 128, 7))
    wire.turn(seconds)
    wire.bus.shutdown()
    return found
