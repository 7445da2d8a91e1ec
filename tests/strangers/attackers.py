"""Attackers on a CAN bus, written from the contract's pages alone: they have no key, and say and send what they like.

Each is a thread with a bus of its own (python-can), so the program under attack is another process.
"""

from __future__ import annotations

import itertools
import os
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import can

from tests.strangers.wire import padded

STATIONS = range(0xF1, 0xF8)
IDENTIFY = bytes([0, 0, 128, 7, 0, 0])


def identity(uuid: bytes, *, state: int = 2, epoch: int = 1, sequence: int = 1, most: int = 2048, can_at: int) -> bytes:
    """Return the reply frame to Identify."""
    octets = b"\1" + uuid + bytes([state]) + epoch.to_bytes(4, "big") + sequence.to_bytes(4, "big")
    octets += most.to_bytes(2, "big") + bytes([can_at])
    return b"\1" + len(octets).to_bytes(2, "big") + octets


@dataclass
class Air:
    """A bus that an attacker hangs on."""

    group: str
    port: int
    bus: can.BusABC = field(init=False)
    stop: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self.bus = can.Bus(interface="udp_multicast", channel=self.group, port=self.port, hop_limit=0, fd=True)

    def put(self, identifier: int, data: bytes, *, fd: bool = False) -> None:
        """One frame."""
        self.bus.send(
            can.Message(arbitration_id=identifier, data=data, is_extended_id=True, is_fd=fd, bitrate_switch=fd)
        )

    def to(self, station: int, node: int, data: bytes, *, fd: bool = False) -> None:
        """One ISO-TP frame of a node to a station."""
        self.put(0x18DA0000 | station << 8 | node, data, fd=fd)

    def hear(self, seconds: float) -> can.Message | None:
        """Return the next frame."""
        return self.bus.recv(seconds)

    def every(self, seconds: float) -> bool:
        """Wait; False at the end."""
        return not self.stop.wait(seconds)


Attack = Callable[["Air"], None]


class Attacker:
    """Runs one attack until it is left."""

    def __init__(self, group: str, port: int, attack: Attack) -> None:
        self.air = Air(group, port)
        self._thread = threading.Thread(target=self._run, args=(attack,), daemon=True)
        self.error: BaseException | None = None

    def _run(self, attack: Attack) -> None:
        try:
            attack(self.air)
        except BaseException as error:  # noqa: BLE001 - shown by the test
            if not self.air.stop.is_set():
                self.error = error

    def __enter__(self) -> Attacker:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.air.stop.set()
        self._thread.join(5)
        self.air.bus.shutdown()
        if self.error is not None:
            raise self.error


def whole(air: Air, station: int, node: int, body: bytes, *, fd: bool, gap: float = 0.0) -> None:
    """Send a message without waiting for any flow control."""
    if fd and len(body) <= 62:
        air.to(station, node, padded(bytes([0, len(body)]) + body, True), fd=True)
        return
    room = 62 if fd else 6
    air.to(station, node, (0x1000 | len(body)).to_bytes(2, "big") + body[:room], fd=fd)
    for n, at in enumerate(range(room, len(body), room + 1), 1):
        if gap:
            time.sleep(gap)
        air.to(station, node, padded(bytes([0x20 | n % 16]) + body[at : at + room + 1], fd), fd=fd)


def requests(air: Air, nodes: range) -> Iterator[tuple[int, int, bytes, bool]]:
    """Yield what stations ask of these nodes: node, station, the frame's data, whether it is FD."""
    while not air.stop.is_set():
        frame = air.hear(0.1)
        if frame is None:
            continue
        high, low, data = frame.arbitration_id >> 8, frame.arbitration_id & 0xFF, bytes(frame.data)
        if low not in STATIONS or not data:
            continue
        if high == 0x18DBFF:
            for node in nodes:
                yield node, low, data, frame.is_fd
        elif high >> 8 == 0x18DA and high & 0xFF in nodes:
            yield high & 0xFF, low, data, frame.is_fd


def body_of(data: bytes) -> bytes | None:
    """Return a single frame's body."""
    if data[0] >> 4 or not data[0]:
        return data[2 : 2 + data[1]] if data[0] == 0 and len(data) > 8 else None
    return data[1 : 1 + data[0]]


def posing(air: Air, nodes: range, uuid_of: Callable[[int], bytes]) -> Iterator[tuple[int, int, bytes, bool]]:
    """Answer Identify at these addresses as the node of that UUID; give station, node, data, FD of all else."""
    for node, station, data, fd in requests(air, nodes):
        body = body_of(data)
        if body is not None and body[1:7] == IDENTIFY:
            whole(air, station, node, body[:1] + identity(uuid_of(node), can_at=node), fd=fd)
        else:
            yield station, node, data, fd


def always_new(nodes: range, replies: list[bytes]) -> Attack:
    """Answer each time with a new UUID, which is added to ``replies``, and announce it, at each of these addresses."""

    def attack(air: Air) -> None:
        def announce() -> None:
            while air.every(0.05):
                for node in nodes[:40]:
                    air.put(0x1CFF0000 | node, bytes([1, 0]) + os.urandom(4) + bytes(2))

        def new(_node: int) -> bytes:
            replies.append(os.urandom(10))
            return replies[-1]

        threading.Thread(target=announce, daemon=True).start()
        for _ in posing(air, nodes, new):
            pass

    return attack


def silent_strangers(nodes: range) -> Attack:
    """At each of these addresses a node that answers Identify and nothing else."""
    uuids = {node: os.urandom(10) for node in nodes}

    def attack(air: Air) -> None:
        for _ in posing(air, nodes, uuids.__getitem__):
            pass

    return attack


def copy_cat(node: int, uuid: bytes, *, mute: bool = True) -> Attack:
    """Says that it is another one's node, and knows nothing else."""

    def attack(air: Air) -> None:
        for station, _, data, fd in posing(air, range(node, node + 1), lambda _: uuid):
            body = body_of(data)
            if body is not None and not mute:
                whole(air, station, node, body[:1] + bytes([0, 0, 1, 16]), fd=fd)

    return attack


def waits_for_ever(node: int, uuid: bytes) -> Attack:
    """Takes up every longer request with Wait, again and again."""

    def attack(air: Air) -> None:
        asked: set[int] = set()

        def wait() -> None:
            while air.every(0.2):
                for station in list(asked):
                    air.to(station, node, padded(bytes([0x31, 16, 0]), False))

        threading.Thread(target=wait, daemon=True).start()
        for station, _, data, fd in posing(air, range(node, node + 1), lambda _: uuid):
            body = body_of(data)
            if data[0] >> 4 == 1:
                asked.add(station)
            elif body is not None:
                whole(air, station, node, body[:1] + b"\1\0\x08" + bytes(8), fd=fd)

    return attack


def flood(make: Callable[[int], tuple[int, bytes]], *, pause: float = 0.002, burst: int = 10) -> Attack:
    """Frames without end."""

    def attack(air: Air) -> None:
        for n in itertools.count():
            for k in range(burst):
                identifier, data = make(n * burst + k)
                air.put(identifier, data)
            if not air.every(pause):
                return

    return attack


def flows(node: int) -> Attack:
    """Flow controls that nobody waits for, to every station."""
    return flood(lambda n: (0x18DA0000 | (0xF1 + n % 7) << 8 | node, bytes([0x30 + n % 3, 16, 0]) + b"\xcc" * 5))


def first_frames() -> Attack:
    """Return messages that begin and never go on."""
    return flood(
        lambda n: (
            0x18DA0000 | (0xF1 + n % 7) << 8 | (1 + n % 239),
            b"\x1f\xff" + bytes([n // 7 % 256]) + os.urandom(5),
        )
    )


def giants() -> Attack:
    """First frames of 4 GB."""
    return flood(
        lambda n: (
            0x18DA0000 | (0xF1 + n % 7) << 8 | (1 + n % 239),
            b"\x10\0\xff\xff\xff\xff" + bytes([n // 7 % 256, 1]),
        )
    )


def announces(address: int | None = None, crc: int | None = None) -> Attack:
    """Announcements without end."""

    def make(n: int) -> tuple[int, bytes]:
        at = 1 + n % 239 if address is None else address
        crc_octets = os.urandom(4) if crc is None else crc.to_bytes(4, "big")
        return 0x1CFF0000 | at, bytes([1, n % 3]) + crc_octets + bytes(2)

    return flood(make)


def data_frames(node: int, station: int) -> Attack:
    """Forged data frames of every stream and segment."""
    return flood(lambda n: (0x1CFF0000 | ((station & 7) * 32 + n % 32) << 8 | node, os.urandom(8)))


def crc_of(uuid: bytes) -> int:
    return zlib.crc32(uuid)
