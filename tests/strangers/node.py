"""A stranger's node: a firmware written from the contract alone, in one loop, on CAN.

Usage: python -m tests.strangers.node FILE. FILE is JSON: bus (group, port, fd, address), uuid, key, epoch, sequence,
identity (private scalar), teds {"channel,code": hex}, channels {number: {kind, octets, shortest, bears}}, fault, and
pause, the seconds that each turn takes longer.
"""

from __future__ import annotations

import hashlib
import json
import os
import signal
import struct
import sys
import time
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import can
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.asymmetric import ec

from tests.strangers.crypto import CURVE, Keys, key_id, mac, message, opened, point, seal, signature, unseal
from tests.strangers.wire import Wire, pieces

MAX = 2048
SENSOR, EVENT, ACTUATOR = "sensor", "event sensor", "actuator"
DRIFT, STEP = 50, 1000
HURRY, HURRIED = 10**10, 50
"""A node that sends from the future is ahead by so many ns at most, and sends so many messages a turn until it is."""


class RefusalError(Exception):
    """A refusal."""

    def __init__(self, reason: int) -> None:
        super().__init__(reason)
        self.reason = reason


def need(good: object, reason: int) -> None:
    if not good:
        raise RefusalError(reason)


@dataclass
class Stream:
    """One run."""

    kind: int
    n: int
    gap: int
    period: int
    start: int | None
    channels: list[int]
    run: int
    key: bytes
    length: int
    pattern: bool
    counter: int = 0
    sent: int = 0


@dataclass
class Session:
    """One session of a station; claims by channel: until when its dead-man runs, 0 for a sensor."""

    station: int
    keys: Keys
    last: int = 0
    claims: dict[int, int] = field(default_factory=dict)
    dead_men: dict[int, int] = field(default_factory=dict)
    lease: int = 10
    heard: int = 0
    streams: dict[int, Stream] = field(default_factory=dict)
    runs: int = 0
    mark: int = 0
    armed: dict[int, tuple[bytes, int]] = field(default_factory=dict)
    drive: tuple[list[int], bytes, int] | None = None
    driven: int = -1
    coming: bytes = b""
    segment: int = 0


class Node:
    """The whole of it."""

    def __init__(self, given: dict[str, Any]) -> None:
        self.given = given
        self.uuid, self.key = bytes.fromhex(given["uuid"]), bytes.fromhex(given["key"])
        self.identity = ec.derive_private_key(int(given["identity"], 16), CURVE)
        self.teds = {
            tuple(map(int, name.split(","))): bytes.fromhex(content) for name, content in given["teds"].items()
        }
        self.channels = {int(number): facts for number, facts in given["channels"].items()}
        self.fault = given.get("fault", "")
        self.began = time.monotonic_ns() - 10**9
        self.c = int.from_bytes(os.urandom(8), "big")
        self.sessions: dict[int, Session] = {}
        self.half: dict[int, Session] = {}
        self.stored: dict[int, tuple[bytes, bytes]] = {}
        self.points = {n: bytes(item["octets"]) for n, item in self.channels.items() if item["kind"] == ACTUATOR}
        self.safe = dict.fromkeys(self.points, True)
        self.stopped = dict.fromkeys(self.points, False)
        self.fresh: Session | None = None
        bus = given["bus"]
        self.address, self.fd = bus["address"], bus["fd"]
        self.wire = Wire(bus["group"], bus["port"], self.address, self.fd, self.take, self.other)

    def tick(self) -> int:
        return time.monotonic_ns() - self.began

    # -- frames --------------------------------------------------------------------------------------------------------

    def announce(self) -> None:
        crc = zlib.crc32(self.uuid).to_bytes(4, "big")
        self.wire.put(0x1CFF0000 | self.address, bytes([1, 2]) + crc + bytes(2))

    def take(self, peer: int, body: bytes, fd: bool) -> None:
        if peer in self.stored and self.stored[peer][0] == body:
            self.wire.send(peer, self.stored[peer][1], fd)
            return
        reply = body[:1] + self.answer(peer, body[1:])
        if body[3:4] == b"\x80" and body[4:5] not in (b"\7", b"\x08", b"\x0b"):
            self.stored[peer] = (body, reply)
        self.wire.send(peer, reply, fd)

    def other(self, frame: can.Message) -> None:
        identifier, data = frame.arbitration_id, bytes(frame.data)
        if identifier >> 8 == 0x18DBFF and data[:1] == b"\7":
            self.wire.turn(int.from_bytes(os.urandom(1), "big") / 256 * 0.05)
            self.wire.send(identifier & 0xFF, data[1:2] + self.answer(identifier & 0xFF, data[2:8]), frame.is_fd)
        elif identifier >> 8 == 0x18FF00 and len(data) == 8:
            self.triggered(identifier & 0xFF, data, frame.timestamp)
        elif identifier >> 8 == 0x18EF00 | self.address:
            self.drive_frame(identifier & 0xFF, data)

    def answer(self, peer: int, frame: bytes, session: Session | None = None) -> bytes:
        try:
            need(len(frame) >= 6 and len(frame) - 6 == int.from_bytes(frame[4:6], "big"), 4)
            channel, class_, function = struct.unpack(">HBB", frame[:4])
            answer = self.run(peer, channel, class_, function, frame[6:], session)
        except RefusalError as refusal:
            return bytes([0, 0, 1, refusal.reason])
        return b"\1" + len(answer).to_bytes(2, "big") + answer

    def run(
        self, peer: int, channel: int, class_: int, function: int, payload: bytes, session: Session | None
    ) -> bytes:
        if class_ == 1 and function in (1, 2):
            return self.read(channel, function, payload)
        if class_ == 128:
            need(channel == 0, 1)
            plain = {7: self.hello, 8: self.prove, 11: self.list}
            if function in plain:
                return plain[function](payload)
            if session is None:
                need(function in (3, 4), 3 if function in (1, 2, 5, 9, 10, *range(12, 21)) else 1)
                return self.open(peer, payload) if function == 3 else self.sealed(peer, payload)
        need(session is not None, 3)
        assert session is not None
        return self.inner(session, channel, class_, function, payload)

    # -- what needs no session -----------------------------------------------------------------------------------------

    def hello(self, payload: bytes) -> bytes:
        need(not payload, 4)
        numbers = struct.pack(">BIIHB", 2, self.given["epoch"], self.given["sequence"], MAX, self.address)
        return b"\1" + self.uuid + numbers

    def prove(self, payload: bytes) -> bytes:
        need(len(payload) == 32, 4)
        return signature(self.identity, b"TEDS1 prove\0" + self.uuid + payload)

    def list(self, _payload: bytes) -> bytes:
        return b"".join(struct.pack(">HB", *name) for name in sorted(self.teds))

    def read(self, channel: int, function: int, payload: bytes) -> bytes:
        need(len(payload) == (1 if function == 1 else 5), 4)
        octets = self.teds.get((channel, payload[0]))
        if function == 1:
            there = octets is not None
            attributes = (0 if there else 2) | (64 if payload[0] == 128 else 0)
            size, check = (len(octets), int.from_bytes(octets[-2:], "big")) if octets is not None else (0, 0)
            return struct.pack(">BBIHI", attributes, 0, size, check, MAX)
        need(octets is not None, 18)
        assert octets is not None
        offset = min(int.from_bytes(payload[1:], "big"), len(octets))
        return offset.to_bytes(4, "big") + octets[offset : offset + 900]

    def open(self, peer: int, payload: bytes) -> bytes:
        need(len(payload) in (0, 89), 4)
        c = self.c.to_bytes(8, "big")
        if not payload:
            return c
        es, proof = payload[8:73], payload[73:]
        need(payload[:8] == key_id(self.key), 16)
        need(proof == mac(self.key, b"station open", self.uuid, c, es), 12)
        self.c = (self.c + 1) % 2**64
        own = ec.generate_private_key(CURVE)
        en = point(own)
        keys = Keys.of(self.key, self.uuid, own, es, es, en)
        self.half[peer] = Session(peer, keys)
        return en + keys.tag(self.key, es, en)

    def sealed(self, peer: int, payload: bytes) -> bytes:
        tried = [item for item in (self.sessions.get(peer), self.half.get(peer)) if item is not None]
        need(tried, 2)
        need(len(payload) >= 36, 4)
        for session in tried:
            try:
                counter, inner = unseal(session.keys.down, payload)
            except (InvalidTag, ValueError):
                continue
            need(counter > session.last, 13)
            if session is self.half.get(peer):
                if peer in self.sessions:
                    self.end(self.sessions[peer])
                self.sessions[peer] = self.half.pop(peer)
            session.last, session.heard = counter, self.tick()
            return seal(session.keys.up, counter, self.answer(peer, inner, session))
        raise RefusalError(12)

    # -- inner commands ------------------------------------------------------------------------------------------------

    def inner(self, session: Session, channel: int, class_: int, function: int, payload: bytes) -> bytes:
        does = {
            (4, 1): self.operate, (4, 2): self.idle, (3, 1): self.value_of, (3, 2): self.set_one,
            (1, 5): self.self_test,
        }.get((class_, function))  # fmt: skip
        if does is not None:
            return does(session, channel, payload)
        need(class_ == 128, 1)
        named = {
            5: self.close, 12: self.sample, 13: self.set_many, 14: self.subscribe, 15: self.stop, 16: self.clock,
            17: self.arm, 18: self.power, 19: self.operation, 20: self.begin_drive,
        }.get(function)  # fmt: skip
        need(named is not None, 1)
        assert named is not None
        return named(session, payload)

    def close(self, session: Session, _payload: bytes) -> bytes:
        self.end(session)
        return b""

    def end(self, session: Session) -> None:
        """The session is over: its claims and streams with it."""
        self.let_go(session, list(session.claims))
        self.sessions = {peer: other for peer, other in self.sessions.items() if other is not session}

    def let_go(self, session: Session, channels: list[int]) -> None:
        for channel in channels:
            if session.claims.pop(channel, None) is not None and channel in self.points:
                self.make_safe(channel)
        session.streams = {n: s for n, s in session.streams.items() if set(s.channels) <= session.claims.keys()}
        if session.drive is not None and not set(session.drive[0]) <= session.claims.keys():
            session.drive = None

    def make_safe(self, channel: int) -> None:
        self.safe[channel], self.points[channel] = True, bytes(len(self.points[channel]))
        self.print_state(channel)

    def print_state(self, channel: int) -> None:
        print(
            json.dumps({"channel": channel, "raw": self.points[channel].hex(), "safe": self.safe[channel]}), flush=True
        )

    def operate(self, session: Session, channel: int, payload: bytes) -> bytes:
        sensors = [n for n, facts in self.channels.items() if facts["kind"] != ACTUATOR]
        need(channel in self.channels or (channel == 0 and sensors), 1)
        actuator = channel in self.points
        need(len(payload) == (19 if actuator else 17), 4)
        need(payload[:16] == hashlib.sha256(self.teds[0, 128]).digest()[:16], 6)
        lease, dead_man = payload[16], int.from_bytes(payload[17:], "big")
        need(1 <= lease <= 60 and (not actuator or 20 <= dead_man <= 10_000), 19)
        if actuator:
            for other in self.sessions.values():
                need(channel not in other.claims, 2 if other is session else 17)
            session.dead_men[channel] = dead_man * 10**6
            self.stopped[channel] = False
            self.make_safe(channel)
        for n in [channel] if channel else sensors:
            session.claims[n] = self.tick() if actuator else 0
        session.lease = lease
        return b""

    def idle(self, session: Session, channel: int, payload: bytes) -> bytes:
        need(not payload, 4)
        self.let_go(session, [channel] if channel else list(session.claims))
        return b""

    def raw(self, channel: int, tick: int) -> bytes:
        """Return a sensor's sample: the milliseconds of the tick."""
        octets = self.channels[channel]["octets"]
        return (tick // 10**6 % 2 ** (8 * octets)).to_bytes(octets, "big")

    def value_of(self, session: Session, channel: int, payload: bytes) -> bytes:
        need(len(payload) == 4, 4)
        need(channel in session.claims, 2)
        need(payload == bytes(4), 19)
        return payload + (self.points[channel] if channel in self.points else self.raw(channel, self.tick()))

    def sample(self, session: Session, payload: bytes) -> bytes:
        need(0 < len(payload) <= 64 and len(set(payload)) == len(payload) and 0 not in payload, 4)
        need(set(payload) <= session.claims.keys(), 2)
        need(not set(payload) & self.points.keys(), 3)
        tick = self.tick()
        return tick.to_bytes(8, "big") + b"\0" + b"".join(self.raw(n, tick) for n in payload)

    def set_one(self, session: Session, channel: int, payload: bytes) -> bytes:
        need(channel not in self.points or len(payload) == 4 + len(self.points[channel]), 4)
        need(channel in session.claims, 2)
        need(channel in self.points, 3)
        need(payload[:4] == bytes(4) and self.bears(channel, payload[4:]), 19)
        self.apply(session, {channel: payload[4:]})
        return b""

    def bears(self, channel: int, octets: bytes) -> bool:
        low, high = self.channels[channel]["bears"]
        return bool(low <= int.from_bytes(octets, "big") <= high)

    def apply(self, session: Session, values: dict[int, bytes]) -> None:
        for channel, octets in values.items():
            self.points[channel], self.safe[channel] = octets, False
            session.claims[channel] = self.tick()
            self.print_state(channel)

    def set_many(self, session: Session, payload: bytes) -> bytes:
        values: dict[int, bytes] = {}
        while payload:
            need(payload[0] in self.channels, 2)
            need(payload[0] in self.points, 3)
            size = len(self.points[payload[0]])
            need(payload[0] not in values and len(payload) > size, 4)
            values[payload[0]], payload = payload[1 : 1 + size], payload[1 + size :]
        need(values, 4)
        need(values.keys() <= session.claims.keys(), 2)
        need(all(self.bears(n, octets) for n, octets in values.items()), 19)
        self.apply(session, values)
        return b""

    def self_test(self, _one: Session, _channel: int, payload: bytes) -> bytes:
        need(len(payload) == 1, 4)
        need(payload == b"\0", 19)
        return b""

    def power(self, _one: Session, payload: bytes) -> bytes:
        need(not payload, 4)
        return struct.pack(">BBHhb", 0, 0xFF, 0xFFFF, 0x7FFF, 0x7F)

    def operation(self, session: Session, payload: bytes) -> bytes:
        need(not payload, 4)
        out = b""
        for n, facts in sorted(self.channels.items()):
            others = [other for other in self.sessions.values() if other is not session and n in other.claims]
            state = 1 * (n in self.points) | 2 * (n in session.claims) | 4 * bool(others) | 8 * (facts["kind"] == EVENT)
            state |= 16 * self.safe.get(n, False) | 32 * self.stopped.get(n, False)
            by = max([other.station for other in others] + [session.station] * (n in session.claims), default=0)
            out += bytes([n, state, by])
        return bytes([any(other.claims for other in self.sessions.values())]) + out

    def clock(self, session: Session, payload: bytes) -> bytes:
        need(not payload, 4)
        now = self.tick()
        lie = 10**9 if self.fault == "clock jumps" and now > 4 * 10**9 else 0
        sent = now - 10**8 if self.fault == "clock runs back" else now + lie
        return struct.pack(">QQQIHI", now + lie, sent, session.mark, STEP, DRIFT, session.driven % 2**32)

    def arm(self, session: Session, payload: bytes) -> bytes:
        need(len(payload) == 18, 4)
        need(payload[16] <= 60 and payload[17] <= 2, 19)
        session.armed.pop(payload[17], None)
        if payload[16]:
            session.armed[payload[17]] = (payload[:16], self.tick() + payload[16] * 10**9)
        return b""

    def triggered(self, station: int, token: bytes, at: float) -> None:
        # The mark is the tick at the frame's end: by the kernel's time stamp, not by when this thread came to it.
        now, session = self.tick() - max(0, round((time.time() - at) * 1e9)), self.sessions.get(station)
        if session is None:
            return
        c = hashlib.sha256(b"TEDS1 trigger\0" + token).digest()[:16]
        for action, (wanted, until) in list(session.armed.items()):
            if wanted != c or now > until:
                continue
            del session.armed[action]
            session.mark = now
            for stream in session.streams.values():
                if action == 1 and stream.start is None:
                    stream.start = now + 10**7
            if action == 2:
                moving = [n for n in session.claims if n in self.points]
                self.stopped |= dict.fromkeys(moving, True)
                self.let_go(session, moving)

    # -- streams -------------------------------------------------------------------------------------------------------

    def subscribe(self, session: Session, payload: bytes) -> bytes:
        need(len(payload) > 21, 4)
        number, kind, n, gap, period, start = struct.unpack(">BBBHQQ", payload[:21])
        channels, pattern, kind = list(payload[21:]), bool(kind & 128), kind & 127
        need(number <= 3 and kind <= 2 and n and len(channels) <= 16 and len(set(channels)) == len(channels), 4)
        need(0 not in channels and (kind != 1 or (n == 1 and len(channels) == 1)), 4)
        need(set(channels) <= session.claims.keys(), 2)
        need(not set(channels) & self.points.keys(), 3)
        need(all((self.channels[c]["kind"] == EVENT) == (kind == 1) or kind == 2 for c in channels), 19)
        need(max(self.channels[c]["shortest"] for c in channels) <= period <= 10**12, 19)
        length = 13 + n * sum(self.channels[c]["octets"] for c in channels) + 8 * (kind > 0)
        need(length <= 240, 10)
        count = sum(1 for _ in pieces(bytes(length), self.fd))
        need(count * max(gap, 1) * 10**9 <= 10**6 * n * period, 21)
        now = self.tick()
        need(start in (0, 2**64 - 1) or now < start <= now + 60 * 10**9, 20)
        session.runs += 1
        began = start or now + 5 * 10**6
        session.streams[number] = Stream(
            kind, n, gap, period, None if start == 2**64 - 1 else began, channels, session.runs,
            session.keys.run(session.runs), length, pattern,
        )  # fmt: skip
        self.fresh = session
        extra = {"another length": (1, 0), "another start": (0, 5 * 10**9)}.get(self.fault, (0, 0))
        return struct.pack(">HHQ", session.runs, length + extra[0], (began + extra[1]) % 2**64)

    def stop(self, session: Session, payload: bytes) -> bytes:
        need(len(payload) == 1, 4)
        need(payload[0] in session.streams, 2)
        return session.streams.pop(payload[0]).counter.to_bytes(4, "big")

    def pump(self) -> None:
        """Send what is due, and end what has run out."""
        now = self.tick()
        for session in list(self.sessions.values()):
            late = [n for n, since in session.claims.items() if n in self.points and now - since >= session.dead_men[n]]
            self.stopped |= dict.fromkeys(late, True)
            self.let_go(session, late)
            if now - session.heard > session.lease * 10**9:
                self.let_go(session, list(session.claims))
            for number, stream in list(session.streams.items()):
                for _ in range(HURRIED if self.fault == "from the future" else 1):
                    if stream.start is not None:
                        self.due(session, number, stream, now)

    def due(self, session: Session, number: int, stream: Stream, now: int) -> None:
        assert stream.start is not None
        first = stream.start + stream.counter * stream.n * stream.period
        last = first + (stream.n - 1) * stream.period
        hurry = HURRY if self.fault == "from the future" else 0
        if now + hurry < last:
            return
        instants = [first + i * stream.period for i in range(stream.n)]
        body = bytes([128 * stream.pattern | (0x3E if self.fault == "reserved flags" else 0)])
        body += instants[0].to_bytes(8, "big") if stream.kind else b""
        for i, tick in enumerate(instants):
            for c in stream.channels:
                size = self.channels[c]["octets"]
                k = stream.counter * stream.n + i
                body += ((k + c) % 2 ** (8 * size)).to_bytes(size, "big") if stream.pattern else self.raw(c, tick)
        octets = message(stream.key, stream.counter, body)
        if self.fault == "wrong tag" and stream.counter % 2:
            octets = octets[:-1] + bytes([octets[-1] ^ 1])
        self.send_data(session, number, octets, stream)
        stream.counter += 1

    def send_data(self, session: Session, number: int, octets: bytes, stream: Stream) -> None:
        for segment, data in pieces(octets, self.fd):
            if self.fault == "a segment is missing" and stream.counter % 3 == 1 and segment == 1:
                continue
            identifier = 0x1CFF0000 | ((session.station & 7) * 32 + number * 8 + segment) << 8 | self.address
            self.wire.put(identifier, data, self.fd)
            if self.fault != "from the future":  # a pause is as long as the machine is busy: it would not get ahead
                time.sleep(stream.gap / 10**6)
        if self.fault == "replay" and stream.counter == 5:
            self.kept = octets
        if self.fault == "replay" and stream.counter > 5 and stream.counter % 4 == 0:
            for segment, data in pieces(self.kept, self.fd):
                identifier = 0x1CFF0000 | ((session.station & 7) * 32 + number * 8 + segment) << 8 | self.address
                self.wire.put(identifier, data, self.fd)

    # -- Drive ---------------------------------------------------------------------------------------------------------

    def begin_drive(self, session: Session, payload: bytes) -> bytes:
        need(0 < len(payload) <= 16 and len(set(payload)) == len(payload) and 0 not in payload, 4)
        need(set(payload) <= session.claims.keys(), 2)
        need(set(payload) <= self.points.keys(), 3)
        session.runs += 1
        length = 16 + sum(len(self.points[n]) for n in payload)
        session.drive, session.driven = (list(payload), session.keys.run(session.runs, drive=True), length), -1
        return struct.pack(">HH", session.runs, length)

    def drive_frame(self, station: int, data: bytes) -> None:
        session = self.sessions.get(station)
        if session is None or session.drive is None or not data:
            return
        channels, key, length = session.drive
        if data[0] == 0:
            session.coming, session.segment = b"", 0
        elif data[0] != session.segment:
            session.segment = -1
        if session.segment < 0:
            return
        session.coming += data[1:]
        session.segment = session.segment % 7 + 1
        if len(session.coming) < length:
            return
        octets, session.coming, session.segment = session.coming[:length], b"", -1
        try:
            counter, plain = opened(key, octets)
        except InvalidTag:
            return
        if counter <= session.driven:
            return
        session.driven = counter
        left = (int.from_bytes(plain[:4], "big") - self.tick() // 1000) % 2**32
        if left * 1000 > min(session.dead_men[n] for n in channels):
            return
        values, rest = {}, plain[4:]
        for n in channels:
            size = len(self.points[n])
            values[n], rest = rest[:size], rest[size:]
        if all(self.bears(n, octets) for n, octets in values.items()):
            self.apply(session, values)

    def loop(self) -> None:
        """Until it is ended."""
        announced = False
        while True:
            self.wire.turn(0.002)
            time.sleep(self.given.get("pause", 0.0))
            self.pump()
            if not announced:
                self.announce()
                announced = True


def main() -> None:
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
    node = Node(json.loads(Path(sys.argv[1]).read_text()))
    print(json.dumps({"ready": True}), flush=True)
    node.loop()


if __name__ == "__main__":
    main()
