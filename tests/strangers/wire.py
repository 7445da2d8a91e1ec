"""CAN by python-can, ISO-TP by hand (profile.md, "CAN"); nothing of the product."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import can

BLOCK = 16
LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)


def of_spec(spec: str) -> tuple[str, int]:
    """Group and port of ``udp_multicast:GROUP?port=PORT``, with or without more behind."""
    group, _, options = spec.removeprefix("udp_multicast:").partition("?port=")
    return group, int(options.partition("&")[0])


def padded(octets: bytes, fd: bool) -> bytes:
    """With CC to a length that the bus knows."""
    size = next(n for n in LENGTHS if n >= max(8, len(octets))) if fd else 8
    return octets.ljust(size, b"\xcc")


def frames_of(body: bytes, fd: bool) -> list[bytes]:
    """Return the frames of one message."""
    if len(body) <= 7:
        return [padded(bytes([len(body)]) + body, fd)]
    if fd and len(body) <= 62:
        return [padded(bytes([0, len(body)]) + body, fd)]
    room = 62 if fd else 6
    out = [(0x1000 | len(body)).to_bytes(2, "big") + body[:room]]
    rest, room = body[room:], room + 1
    for n, at in enumerate(range(0, len(rest), room), 1):
        out.append(padded(bytes([0x20 | n % 16]) + rest[at : at + room], fd))
    return out


@dataclass
class IncomingMessage:
    """A message that comes in."""

    length: int
    octets: bytes
    number: int = 0
    since: int = 0


@dataclass
class Wire:
    """One address on a bus; ``take`` gets (peer, body, fd) of each whole message, ``other`` every other frame."""

    group: str
    port: int
    own: int
    fd: bool
    take: Callable[[int, bytes, bool], None]
    other: Callable[[can.Message], None]
    coming: dict[int, IncomingMessage] = field(default_factory=dict)
    leaving: dict[int, list[bytes]] = field(default_factory=dict)
    leaving_fd: dict[int, bool] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.bus = can.Bus(interface="udp_multicast", channel=self.group, port=self.port, hop_limit=0, fd=self.fd)

    def put(self, identifier: int, data: bytes, fd: bool = False) -> None:
        """One frame."""
        self.bus.send(
            can.Message(arbitration_id=identifier, data=data, is_extended_id=True, is_fd=fd, bitrate_switch=fd)
        )

    def send(self, peer: int, body: bytes, fd: bool) -> None:
        """Begin to send a message; what is more than a frame goes on when the peer says so."""
        first, *rest = frames_of(body, fd)
        self.leaving[peer], self.leaving_fd[peer] = rest, fd
        self.put(0x18DA0000 | peer << 8 | self.own, first, fd)

    def turn(self, seconds: float) -> None:
        """Take in what comes within so long; at least one look."""
        end = time.monotonic() + seconds
        while True:
            message = self.bus.recv(max(0.0, end - time.monotonic()))
            if message is not None:
                self._sort(message)
            if time.monotonic() >= end:
                return

    def _sort(self, message: can.Message) -> None:
        identifier = message.arbitration_id
        if identifier >> 16 == 0x18DA and identifier >> 8 & 0xFF == self.own and message.data:
            self._iso(identifier & 0xFF, bytes(message.data), message.is_fd)
        else:
            self.other(message)

    def _iso(self, peer: int, data: bytes, fd: bool) -> None:
        kind, low = data[0] >> 4, data[0] & 15
        if kind == 0:
            body = data[1 : 1 + low] if low else data[2 : 2 + data[1]]
            self.take(peer, body, fd)
        elif kind == 1:
            self.coming[peer] = IncomingMessage((low << 8 | data[1]), data[2:])
            self._flow(peer, fd)
        elif kind == 2 and peer in self.coming:
            received = self.coming[peer]
            if low != (received.number + 1) % 16:
                del self.coming[peer]
                return
            received.number, received.since = received.number + 1, received.since + 1
            received.octets += data[1:]
            if len(received.octets) >= received.length:
                del self.coming[peer]
                self.take(peer, received.octets[: received.length], fd)
            elif received.since == BLOCK:
                received.since = 0
                self._flow(peer, fd)
        elif kind == 3 and low == 0 and self.leaving.get(peer):
            rest = self.leaving[peer]
            count = data[1] or len(rest)
            for piece in rest[:count]:
                self.put(0x18DA0000 | peer << 8 | self.own, piece, self.leaving_fd[peer])
            self.leaving[peer] = rest[count:]

    def _flow(self, peer: int, fd: bool) -> None:
        self.put(0x18DA0000 | peer << 8 | self.own, padded(bytes([0x30, BLOCK, 0]), fd), fd)


def pieces(message: bytes, fd: bool, drive: bool = False) -> Iterator[tuple[int, bytes]]:
    """Yield a data message's frames: segment number and octets (operation.md section 6)."""
    room = (64 if fd else 8) - drive
    for n, at in enumerate(range(0, len(message), room)):
        segment = 0 if n == 0 else (n - 1) % 7 + 1
        octets = bytes([segment] * drive) + message[at : at + room]
        size = next(k for k in LENGTHS if k >= len(octets)) if fd else len(octets)
        yield segment, octets.ljust(size, b"\xcc")
