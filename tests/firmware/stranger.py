"""A station written from docs/profile.md alone: nothing of this package, and a bus with whims between it and its nodes.

Time is a number: whoever waits jumps to what is due next. Frames may be lost, come twice or late; what a station does
about that is what the page allows it: two repetitions within 15 s, a new try 100 ms after a 17.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import itertools
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Protocol

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import decode_dss_signature, encode_dss_signature
from cryptography.hazmat.primitives.ciphers.aead import AESCCM
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

SECOND = 10**9
MS = 10**6
ORDER = 0xFFFFFFFF00000000FFFFFFFFFFFFFFFFBCE6FAADA7179E84F3B9CAC2FC632551
NEVER = (1 << 64) - 1
Frame = tuple[int, bytes, bool]
"""Identifier, data, FD."""


class Node(Protocol):
    """What a node in this process gives to its bus."""

    def poll(self) -> int: ...
    def next_frame(self) -> Frame | None: ...
    def take_frame(self, identifier: int, data: bytes, *, fd: bool = False) -> None: ...


Ask = Callable[..., Iterator[None]]
"""Sends a command, plain or sealed."""


class NoReplyError(Exception):
    """No reply, and no more repetitions."""


class RefusalError(Exception):
    def __init__(self, reason: int) -> None:
        super().__init__(f"refusal {reason}")
        self.reason = reason


# -- keys and labels ---------------------------------------------------------------------------------------------------


class Key:
    """A P-256 key."""

    def __init__(self, dice: random.Random) -> None:
        self._key = ec.derive_private_key(dice.randrange(1, ORDER), ec.SECP256R1())
        self.point = self._key.public_key().public_bytes(Encoding.X962, PublicFormat.UncompressedPoint)

    def sign(self, message: bytes) -> bytes:
        r, s = decode_dss_signature(self._key.sign(message, ec.ECDSA(hashes.SHA256())))
        return r.to_bytes(32, "big") + min(s, ORDER - s).to_bytes(32, "big")

    def shared(self, point: bytes) -> bytes:
        return self._key.exchange(ec.ECDH(), ec.EllipticCurvePublicKey.from_encoded_point(ec.SECP256R1(), point))


def verify(point: bytes, message: bytes, signature: bytes) -> None:
    r, s = int.from_bytes(signature[:32], "big"), int.from_bytes(signature[32:], "big")
    assert s <= ORDER // 2
    key = ec.EllipticCurvePublicKey.from_encoded_point(ec.SECP256R1(), point)
    key.verify(encode_dss_signature(r, s), message, ec.ECDSA(hashes.SHA256()))


def sha(octets: bytes) -> bytes:
    return hashlib.sha256(octets).digest()


def mac(key: bytes, message: bytes) -> bytes:
    return hmac.digest(key, message, "sha256")[:16]


def hkdf(ikm: bytes, salt: bytes, info: bytes, length: int) -> bytes:
    return HKDF(hashes.SHA256(), length, salt, info).derive(ikm)


def teds(block: bytes) -> bytes:
    whole = (len(block) + 2).to_bytes(4, "big") + block
    return whole + (0xFFFF - sum(whole) & 0xFFFF).to_bytes(2, "big")


def tuple_of(kind: int, value: bytes) -> bytes:
    return bytes((kind, len(value))) + value


def fields(block: bytes) -> Iterator[tuple[int, bytes]]:
    at = 6
    while at < len(block):
        yield block[at], block[at + 2 : at + 2 + block[at + 1]]
        at += 2 + block[at + 1]


def meta(uuid: bytes) -> bytes:
    return teds(bytes.fromhex("030400010101") + tuple_of(4, uuid) + bytes.fromhex("0d020001"))


def name(text: str) -> bytes:
    return teds(bytes.fromhex("0304000c0101040100") + tuple_of(5, text.encode()))


# -- the bus -----------------------------------------------------------------------------------------------------------


@dataclass
class Whims:
    """How often, of a thousand frames, one is lost, comes twice, or comes behind later ones."""

    lost: int = 0
    doubled: int = 0
    late: int = 0


@dataclass
class Bus:
    """Nodes and stations; ``now`` in ns."""

    seed: int
    whims: Whims = field(default_factory=Whims)
    now: int = SECOND
    nodes: list[Node] = field(default_factory=list)
    stations: list[Station] = field(default_factory=list)
    flying: list[tuple[int, int, Frame, object]] = field(default_factory=list)
    frames_sent: int = 0

    def __post_init__(self) -> None:
        self.dice = random.Random(self.seed)
        self._order = itertools.count()

    def seconds(self) -> float:
        return self.now / SECOND

    def send(self, frame: Frame, sender: object) -> None:
        """Put a frame on the wire; it takes a quarter of a millisecond."""
        self.frames_sent += 1
        chance = self.dice.randrange(1000)
        whims = self.whims
        if chance < whims.lost:
            return
        at = self.now + MS // 4
        if chance < whims.lost + whims.late:
            at += self.dice.randrange(1, 4) * MS
        self.flying.append((at, next(self._order), frame, sender))
        if whims.lost + whims.late <= chance < whims.lost + whims.late + whims.doubled:
            self.flying.append((at, next(self._order), frame, sender))

    def turn(self, until: int) -> None:
        """Jump to what is due next, at most ``until``, and do it."""
        due = [until, *(at for at, *_ in self.flying), *(station.due for station in self.stations)]
        due += [node.poll() for node in self.nodes]
        self.now = max(self.now + 1000, min(due))
        arrived = sorted(pair for pair in self.flying if pair[0] <= self.now)
        self.flying = [pair for pair in self.flying if pair[0] > self.now]
        for _, _, frame, sender in arrived:
            for node in self.nodes:
                if node is not sender:
                    node.take_frame(frame[0], frame[1], fd=frame[2])
            for station in self.stations:
                if station is not sender:
                    station.take(frame)
        for node in self.nodes:
            node.poll()
            while (out := node.next_frame()) is not None:
                self.send(out, node)
        for station in self.stations:
            station.work()


# -- ISO-TP and repetition, a station's side ---------------------------------------------------------------------------


@dataclass
class Station:
    """One source address; ``conversation`` is run beside those of others, by what it waits for."""

    bus: Bus
    source: int
    target: int
    fd: bool = False
    due: int = NEVER
    body: bytes = b""
    at: int = 0
    number: int = 0
    block: int = 0
    flows: bool = False
    came: bytearray = field(default_factory=bytearray)
    length: int = 0
    expected: int = 0
    asked: int = 0
    replies: list[bytes] = field(default_factory=list)
    everyone: list[tuple[int, bytes]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.bus.stations.append(self)
        self.transaction = self.bus.dice.randrange(256)

    @property
    def room(self) -> int:
        return 64 if self.fd else 8

    def _put(self, data: bytes) -> None:
        sizes = (8, 12, 16, 20, 24, 32, 48, 64) if self.fd else (8,)
        size = next(size for size in sizes if size >= len(data))
        self.bus.send((0x18DA0000 | self.target << 8 | self.source, data.ljust(size, b"\xcc"), self.fd), self)

    def begin(self, body: bytes) -> None:
        """Send a message, and listen for one."""
        self.body, self.at, self.number, self.flows, self.due = body, 0, 1, False, NEVER
        self.came.clear()
        self.length = 0
        if len(body) <= 7:
            self._put(bytes((len(body),)) + body)
            self.body = b""
        elif self.fd and len(body) <= 62:
            self._put(bytes((0, len(body))) + body)
            self.body = b""
        else:
            self.at = self.room - 2
            self._put((0x1000 | len(body)).to_bytes(2, "big") + body[: self.at])

    def work(self) -> None:
        """The next frames of a block that may leave now."""
        while self.flows and self.bus.now >= self.due and self.at < len(self.body):
            piece = self.body[self.at : self.at + self.room - 1]
            self._put(bytes((0x20 | self.number & 15,)) + piece)
            self.at, self.number, self.block = self.at + len(piece), self.number + 1, self.block - 1
            self.due = self.bus.now + self.gap
            if self.block == 0:
                self.flows, self.due = False, NEVER
        if self.at >= len(self.body):
            self.flows, self.due = False, NEVER

    def take(self, frame: Frame) -> None:
        identifier, data, _ = frame
        if identifier & 0x1FFFFF00 != 0x18DA0000 | self.source << 8:
            return
        kind, node = data[0] >> 4, identifier & 0xFF
        if node != self.target:
            return
        if kind == 0:
            start = 1 if data[0] else 2
            self._whole(data[start : start + (data[0] or data[1])])
        elif kind == 1:
            self.length = (data[0] & 15) << 8 | data[1]
            self.came, self.expected, self.asked = bytearray(data[2:]), 1, 0
            self._put(b"\x30\x10\0")
        elif kind == 2 and self.length:
            if data[0] & 15 == self.expected - 1 & 15:
                return
            if data[0] & 15 != self.expected & 15:
                self.length = 0
                return
            self.came += data[1:]
            self.expected, self.asked = self.expected + 1, self.asked + 1
            if len(self.came) >= self.length:
                self._whole(bytes(self.came[: self.length]))
            elif self.asked % 16 == 0:
                self._put(b"\x30\x10\0")
        elif kind == 3 and data[0] == 0x30 and self.body:
            self.flows, self.block = True, data[1] or 1 << 30
            self.gap = data[2] * MS if data[2] < 0x80 else MS
            self.due = self.bus.now
            self.work()

    def _whole(self, body: bytes) -> None:
        self.length = 0
        self.replies.append(body)

    # -- one exchange --------------------------------------------------------------------------------------------------

    def exchange(self, frame: bytes) -> Iterator[None]:
        """Yield while waiting; ``self.reply`` afterwards. Raises Silent."""
        self.transaction = self.transaction + 1 & 0xFF
        body = bytes((self.transaction,)) + frame
        first = self.bus.now
        for attempt in range(3):
            again, until = True, 0
            while again:
                again = False
                self.replies.clear()
                self.begin(body)
                until = self.bus.now + 5 * SECOND
                while self.bus.now < until:
                    mine = [reply for reply in self.replies if reply[:1] == body[:1]]
                    if mine and mine[0][1:] == b"\0\0\1\x11" and self.at < len(self.body):
                        pause = self.bus.now + 100 * MS  # in place of a flow control
                        while self.bus.now < pause:
                            yield
                        again = self.bus.now < first + 10 * SECOND
                        break
                    if mine:
                        self.reply = mine[0][1:]
                        self.body = b""
                        return
                    yield
            if self.bus.now > first + 15 * SECOND or attempt == 2:
                break
        raise NoReplyError(frame[:6].hex())


def run(bus: Bus, *conversations: Iterator[None]) -> None:
    """Let them go on beside each other, until all have ended."""
    live = list(conversations)
    until = bus.now + 3600 * SECOND
    while live:
        assert bus.now < until, "it never ends"
        for iterator in list(live):
            try:
                next(iterator)
            except StopIteration:
                live.remove(iterator)
        if live:
            bus.turn(bus.now + 50 * MS)


# -- the profile -------------------------------------------------------------------------------------------------------


@dataclass
class Owner:
    """The keys of a station, and what it knows of one node."""

    station: Station
    dice: random.Random
    ca: Key
    key: Key = field(init=False)
    keys: list[bytes] = field(default_factory=list)
    """Link keys that may count, the newest first."""
    uuid: bytes = b""
    point: bytes = b""
    counter: int = 0
    payload: bytes = b""

    def __post_init__(self) -> None:
        self.key = Key(self.dice)
        self.certified = self.ca.sign(b"TEDS1 station key\0" + self.key.point)

    def plain(self, function: int, payload: bytes = b"", *, group: int = 128, channel: int = 0) -> Iterator[None]:
        frame = channel.to_bytes(2, "big") + bytes((group, function)) + len(payload).to_bytes(2, "big") + payload
        yield from self.station.exchange(frame)
        self._judge(self.station.reply)

    def _judge(self, reply: bytes) -> None:
        assert len(reply) == 3 + int.from_bytes(reply[1:3], "big"), reply.hex()
        if not reply[0]:
            raise RefusalError(reply[3])
        self.payload = reply[3:]

    def identify(self, ask: Ask | None = None) -> Iterator[None]:
        yield from (ask or self.plain)(7)
        self.uuid, self.state = self.payload[1:11], self.payload[11]
        self.epoch, self.sequence = (int.from_bytes(self.payload[at : at + 4], "big") for at in (12, 16))

    def read(self, channel: int, code: int, ask: Ask | None = None) -> Iterator[None]:
        """Yield the octets of a TEDS: ``self.teds``. One that another station replaced meanwhile is read again."""
        self.teds = b""
        while True:
            payload = bytes((code,)) + len(self.teds).to_bytes(4, "big")
            yield from (ask or self.plain)(2, payload, group=1, channel=channel)
            self.teds += self.payload[4:]
            if len(self.payload) == 4 and self.teds == teds(self.teds[4:-2]):
                return
            if len(self.payload) == 4:
                self.teds = b""

    def agree(self, ask: Ask | None = None) -> Iterator[None]:
        """Request and Confirm; the new key is kept as pending before tagS leaves."""
        ask = ask or self.plain
        yield from self.identify(ask)
        yield from self.read(0, 128, ask)
        security = self.teds
        members = dict(fields(security[4:-2]))
        self.point = base64.b64decode(members[101])
        verify(self.point, b"TEDS1 node key\0" + self.uuid + self.point, base64.b64decode(members[102]))
        one_time = Key(self.dice)
        request = self.key.point + self.certified + self.ca.point + one_time.point
        yield from ask(1, request)
        reply = self.payload
        nonce, epoch, en, tag, signature = reply[:16], reply[16:20], reply[20:85], reply[85:101], reply[101:]
        script = sha(b"TEDS1 transcript\0" + request + nonce + epoch + en + self.uuid + self.point + sha(security))
        okm = hkdf(one_time.shared(en) + self.key.shared(en), nonce, b"TEDS1 link key\0" + script, 48)
        assert mac(okm[16:], b"node" + script) == tag
        verify(self.point, b"TEDS1 agree\0" + script, signature)
        assert int.from_bytes(epoch, "big") == self.epoch + 1
        self.keys.insert(0, okm[:16])
        yield from ask(2, mac(okm[16:], b"station" + script))

    def open(self) -> Iterator[None]:
        """Open a session under the newest key that the node knows; the others go."""
        for key in list(self.keys):
            yield from self.plain(3)
            c, one_time = self.payload, Key(self.dice)
            key_id = sha(b"TEDS1 key id\0" + key)[:8]
            try:
                yield from self.plain(
                    3, key_id + one_time.point + mac(key, b"station open" + self.uuid + c + one_time.point)
                )
            except RefusalError as refused:
                if refused.reason == 16:
                    continue
                raise
            en, tag = self.payload[:65], self.payload[65:]
            okm = hkdf(one_time.shared(en), key, b"TEDS1 session\0" + self.uuid + one_time.point + en, 96)
            assert mac(okm[32:64], b"node open" + key_id + one_time.point + en) == tag
            self.to_node, self.to_station, self.counter = okm[:16], okm[16:32], 0
            self.keys = [key]
            return
        raise RefusalError(16)

    def sealed(self, function: int, payload: bytes = b"", *, group: int = 128, channel: int = 0) -> Iterator[None]:
        frame = channel.to_bytes(2, "big") + bytes((group, function)) + len(payload).to_bytes(2, "big") + payload
        self.counter += 1
        counter = self.counter.to_bytes(4, "big")
        nonce, pad = bytes(9) + counter, 16 - len(frame) % 16
        sealed = counter + AESCCM(self.to_node, 16).encrypt(nonce, frame + bytes((pad,)) * pad, None)
        yield from self.plain(4, sealed)
        assert self.payload[:4] == counter
        try:
            inner = AESCCM(self.to_station, 16).decrypt(nonce, self.payload[4:], None)
        except InvalidTag:
            raise AssertionError("a reply under another key") from None
        assert inner[-1] <= 16
        assert inner[-inner[-1] :] == inner[-1:] * inner[-1]
        self._judge(inner[: -inner[-1]])

    def datasheet(self, blocks: dict[tuple[int, int], bytes]) -> Iterator[None]:
        """Yield the signed Security TEDS over these blocks, for the state as it is: ``self.teds``."""
        yield from self.sealed(7)
        epoch, sequence = (int.from_bytes(self.payload[at : at + 4], "big") for at in (12, 16))
        yield from self.read(0, 128, self.sealed)
        members = dict(fields(self.teds[4:-2]))
        listed = b"".join(
            tuple_of(108, channel.to_bytes(2, "big") + bytes((code,)) + sha(octets))
            for (channel, code), octets in sorted(blocks.items())
        )
        head = bytes.fromhex("030400800101")
        before = b"".join(tuple_of(number, bytes((value,))) for number, value in ((1, 4), (2, 2), (3, 0), (4, 1)))
        before += tuple_of(5, b"stranger:" + sha(self.ca.point).hex()[:16].encode()) + tuple_of(6, bytes(8))
        after = tuple_of(101, members[101]) + tuple_of(102, members[102])
        after += tuple_of(103, base64.b64encode(self.key.point)) + tuple_of(104, base64.b64encode(self.certified))
        after += tuple_of(105, b"\1") + tuple_of(106, (sequence + 1).to_bytes(4, "big"))
        after += tuple_of(107, epoch.to_bytes(4, "big")) + listed + tuple_of(109, b"\2") + tuple_of(110, b"\2")
        signature = self.key.sign(b"TEDS1 datasheet\0" + self.uuid + head + before + after)
        self.teds = teds(head + before + tuple_of(100, base64.b64encode(signature)) + after)

    def write(self, blocks: dict[tuple[int, int], bytes]) -> Iterator[None]:
        """Stage and commit; a reply to Update that was lost shows in what is read afterwards."""
        yield from self.datasheet(blocks)
        security = self.teds
        for (channel, code), octets in {**blocks, (0, 128): security}.items():
            for at in range(0, len(octets), 400):
                piece = bytes((code,)) + at.to_bytes(4, "big") + octets[at : at + 400]
                yield from self.sealed(3, piece, group=1, channel=channel)
        yield from self.sealed(4, b"\x80", group=1)
        self.wrote = security

    def check(self, blocks: dict[tuple[int, int], bytes]) -> Iterator[None]:
        """Yield what it holds is what was written."""
        yield from self.sealed(11)
        listed = {
            (int.from_bytes(self.payload[at : at + 2], "big"), self.payload[at + 2])
            for at in range(0, len(self.payload), 3)
        }
        assert listed == {*blocks, (0, 128)}
        for (channel, code), octets in {**blocks, (0, 128): self.wrote}.items():
            yield from self.read(channel, code, self.sealed)
            assert self.teds == octets, f"TEDS {code} of channel {channel}"
