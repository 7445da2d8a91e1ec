"""The node in C beside the reference: the same frames, the same keys and dice, the same replies octet for octet.

A random station talks sense and nonsense over three links: it agrees, opens, writes, commits, resets, measures, loses
links, lets time pass and power fail. This finds what no list of cases thought of.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import pytest
from cryptography.hazmat.primitives.ciphers.aead import AESCCM

from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import GROUP_ORDER, SoftwareKey, fingerprint, node_key_message, station_key_message
from teds_provision.protocol.messages.frames import Command, Function, decode_reply, security_command
from teds_provision.protocol.operation.can_frames import cut
from teds_provision.protocol.operation.commands import PowerReply
from teds_provision.protocol.operation.datagram import DatagramSealer, Layout, drive_key
from teds_provision.protocol.operation.hardware import ChannelHardware, RawReading, SessionPort, port_of
from teds_provision.protocol.operation.stream_commands import Action, DriveReply
from teds_provision.protocol.operation.timing import TriggerToken
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.tim import Tim
from teds_provision.protocol.wire_agreement import StationAgreement
from teds_provision.teds.image import SECURITY
from teds_provision.teds.sheet import ChannelKind
from tests.firmware.memory_node import MemoryNode
from tests.protocol.desk import CREDENTIALS, META, NAME, NODE, UUID, Desk
from tests.protocol.memory import RamFlash
from tests.protocol.operation.bench import channel_teds

pytestmark = pytest.mark.system

CHANNELS = {
    1: ChannelHardware(ChannelKind.SENSOR, 2, shortest=100_000),
    2: ChannelHardware(ChannelKind.SENSOR, 3, shortest=1_000_000),
    7: ChannelHardware(ChannelKind.ACTUATOR, 2, halt=0),
    8: ChannelHardware(ChannelKind.ACTUATOR, 5, halt=0),
    9: ChannelHardware(ChannelKind.EVENT_SENSOR, 2),
}
SHEET = {(0, 1): META, (1, 12): NAME} | {
    (number, 3): channel_teds(facts, period=0.001 if number == 2 else None) for number, facts in CHANNELS.items()
}
LINKS = ("nfc", "can:f1", "can:f2")
MS = 1_000_000
TOKEN = bytes(range(8))


@dataclass
class Hardware:
    """What ``tests/firmware/c/memory.c`` imitates."""

    tick: int = 0
    channels: Mapping[int, ChannelHardware] = field(default_factory=lambda: dict(CHANNELS))
    step: int = 1
    drift: int = 50
    points: dict[int, bytes] = field(default_factory=dict)

    def now(self) -> int:
        return self.tick

    def keeps(self, period: int) -> bool:
        return True

    def read(self, channel: int, tick: int) -> RawReading:
        width = self.channels[channel].octets
        return RawReading(((tick // MS + channel) % (1 << 8 * width)).to_bytes(width, "big"))

    def accepts(self, channel: int, data_set: bytes) -> bool:
        return data_set[0] < 0xF0

    def apply(self, values: Mapping[int, bytes]) -> None:
        self.points |= values

    def set_point(self, channel: int) -> bytes:
        return self.points[channel]

    def make_safe(self, channel: int) -> None:
        self.points[channel] = bytes(self.channels[channel].octets)

    def self_test(self, channels: Sequence[int]) -> None:
        pass

    def testing(self, channel: int) -> bool:
        return False

    def fault(self, channel: int) -> bool:
        return False

    def power(self) -> PowerReply:
        return PowerReply()


class Twins:
    """Both nodes on one set of links; what one answers the other has to."""

    def __init__(self, seed: int) -> None:
        self.hardware = Hardware()
        self.dice = {"py": random.Random(seed), "c": random.Random(seed)}
        flash = Flash(UUID, NODE.point, NODE.sign(node_key_message(UUID, NODE.point)), can_address=192)
        self.memory = RamFlash(flash)
        self.c = MemoryNode(
            lambda kind, size: NODE.secret() if kind == "i" else self._draw("c", kind, size), self.now, uuid=UUID
        )
        for number, facts in CHANNELS.items():
            self.c.add_channel(number, int(facts.kind), facts.octets, shortest=facts.shortest)
        self.compared = 0
        self.restart()

    def now(self) -> float:
        return self.hardware.tick / 1e9

    def _draw(self, whose: str, kind: str, size: int) -> bytes:
        if kind == "o":
            return self.dice[whose].randrange(1, GROUP_ORDER - (1 << 224)).to_bytes(32, "big")
        return self.dice[whose].randbytes(size)

    def restart(self) -> None:
        self.hardware.points.clear()
        self.py = Tim(
            NODE,
            self.memory,
            self.now,
            max_message=1024,
            max_teds=4092,
            random=lambda size: self._draw("py", "n", size),
            one_time=lambda: SoftwareKey(int.from_bytes(self._draw("py", "o", 32), "big")),
            hardware=self.hardware,
            sessions=2,
            streams=2,
        )
        assert self.c.start() == 0

    @property
    def flash(self) -> Flash:
        return self.memory.state

    def handle(self, frame: bytes, *, link: str, tapped: bool) -> bytes:
        self.hardware.tick += 7_000  # which of two is older is never a matter of taste
        mine = self.py.handle(frame, link=link, tapped=tapped, port=self.port(link))
        theirs = self.c.handle(frame, link=link, tapped=tapped)
        if theirs != mine and frame[3:4] == b"\x04":
            print("C:", self.peek(link, theirs), "Python:", self.peek(link, mine))
        assert theirs.hex() == mine.hex(), f"{frame.hex()} on {link} at {self.hardware.tick}"
        self.compared += 1
        self.py.reply_sent(link)
        self.c.reply_sent(link)
        self.frames()
        return mine

    def port(self, link: str) -> SessionPort:
        """Return what the reference is told of a link."""
        return port_of(link)

    def peek(self, link: str, reply: bytes) -> str:
        """Return what a sealed reply says, for whoever looks for a difference."""
        session = self.py._sessions.on(link)
        if session is None:
            return reply.hex()
        nonce = bytes(9) + reply[3:7]
        return AESCCM(session._keys.to_station, tag_length=16).decrypt(nonce, reply[7:], None).hex()

    def lost(self, link: str) -> None:
        self.py.link_lost(link)
        self.c.link_lost(link)

    def pass_time(self, ns: int) -> None:
        """In steps that neither node has to catch up on."""
        until = self.hardware.tick + ns
        while self.hardware.tick < until:
            self.hardware.tick = min(until, self.hardware.tick + (MS // 4 if self.py.streaming else ns))
            self.py.poll()
            self.c.poll()
            self.frames()

    def drive(self, link: str, data: bytes, *, fd: bool = False) -> None:
        """A Drive frame of a station; both actuators do the same afterwards."""
        self.py.drive(link, data)
        self.c.take_frame(0x18EF0000 | 192 << 8 | int(link[4:], 16), data, fd=fd)
        self.hold()

    def trigger(self, link: str, token: bytes) -> None:
        """A trigger frame."""
        self.py.trigger(link, token, self.hardware.tick)
        self.c.take_frame(0x18FF0000 | int(link[4:], 16), token)

    def event(self, octets: bytes, *, valid: bool) -> None:
        """The event sensor has seen something."""
        self.py.poll()
        self.py.event(9, self.hardware.tick, octets, valid=valid)
        self.c.event(9, self.hardware.tick, octets, valid=valid)
        self.frames()

    def hold(self) -> None:
        """What the actuators do."""
        for channel, point in self.hardware.points.items():
            assert self.c.set_point(channel, len(point)) == point

    def frames(self) -> None:
        """Data frames that may leave now."""
        while True:
            mine, theirs = self.py.next_frame("can"), self.c.next_frame()
            if mine is None or theirs is None:
                assert mine is None
                assert theirs is None
                return
            assert theirs == (mine.identifier, mine.data, mine.fd)


class Station:
    """Sense and nonsense from one seed."""

    drivers: Sequence[str] = ("can:f1", "can:f2")

    def __init__(self, twins: Twins, seed: int) -> None:
        self.twins, self.dice = twins, random.Random(seed)
        self.key = b""
        self.counter = 0
        self.driven: dict[str, tuple[Layout, DatagramSealer]] = {}
        self.sessions: dict[str, StationSession] = {}
        self.desk = Desk.__new__(Desk)
        self.desk.memory = twins.memory

    def begin_measuring(self, link: str = "can:f1") -> None:
        """A node that is provisioned, its channels claimed: where most moves are refused otherwise."""
        self.agree("nfc", good=True)
        self.open(link, good=True)
        self.write(link, good=True)
        self.open(link, good=True)
        digest = Operation.digest(self.twins.flash)
        assert self.sealed(Command(0, 4, 1, digest + b"\x3c"), link)[0]
        for channel in (7, 8):
            assert self.sealed(Command(channel, 4, 1, digest + b"\x3c" + (5000).to_bytes(2, "big")), link)[0]
        self.measure(security_command(Function.DRIVE, b"\x07\x08"), link)
        assert link in self.driven

    # -- moves -----------------------------------------------------------------------------------------------------

    def move(self) -> None:
        moves = [self.plain, self.agree, self.open, self.inner, self.inner, self.inner, self.write, self.measure]
        moves += [self.measure, self.measure, self.drive, self.trigger, self.event]
        moves += [self.disturb, self.nonsense, self.wait]
        self.dice.choice(moves)()

    def send(self, command: Command, link: str) -> tuple[bool, bytes]:
        tapped = link == "nfc" or self.twins.flash.key is None
        reply = decode_reply(self.twins.handle(command.encode(), link=link, tapped=tapped))
        return reply.ok, reply.payload

    def sealed(self, command: Command, link: str) -> tuple[bool, bytes]:
        session = self.sessions[link]
        try:
            ok, payload = self.send(session.seal(command), link)
        except AssertionError as differ:
            raise AssertionError(f"{command} on {link}") from differ
        if not ok:
            return False, payload
        inner = session.unseal(payload)
        return inner.ok, inner.payload

    def link(self) -> str:
        return self.dice.choice(LINKS)

    def opened(self) -> str | None:
        return self.dice.choice(list(self.sessions)) if self.sessions else None

    def plain(self) -> None:
        """Any function of class 1 and 128, with a payload of a length that it may have."""
        size = self.dice.choice([0, 1, 1, 4, 5, 16, 32, 89, 259, self.dice.randrange(300)])
        payload = self.dice.choice([bytes(size), self.dice.randbytes(size), b"\x80" + bytes(max(0, size - 1))])
        function = self.dice.choice([1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 12, 14, 16, 19, 20, 21, 99])
        channel = self.dice.choice([0, 0, 0, 1, 255, 256, 65535])
        self.send(Command(channel, self.dice.choice([1, 1, 128, 128, 3, 4, 77]), function, payload), self.link())

    def agree(self, link: str = "", *, good: bool = False) -> None:
        link = link or self.link()
        flash = self.twins.flash
        credentials = CREDENTIALS
        if not good and self.dice.random() < 0.2:
            other = SoftwareKey(11)
            credentials = type(CREDENTIALS)(
                CREDENTIALS.key, other.sign(station_key_message(CREDENTIALS.key.point)), other.point
            )
        one_time = SoftwareKey(self.dice.randrange(1, 1 << 200))
        agreement = StationAgreement(credentials, UUID, one_time=one_time)
        ok, payload = self.send(agreement.request(), link)
        if not ok:
            return
        epoch = flash.epoch
        agreed = agreement.accept(payload, flash.security_teds(), pinned=fingerprint(NODE.point), epoch=epoch)
        if not good and self.dice.random() < 0.15:
            self.send(security_command(Function.CONFIRM, self.dice.randbytes(16)), link)
        if self.send(agreed.confirm, link if good else self.dice.choice([link, link, self.link()]))[0]:
            self.key = agreed.key
            self.sessions.clear()

    def open(self, link: str = "", *, good: bool = False) -> None:
        link = link or self.link()
        if not self.key:
            return
        session = StationSession(self.key, UUID, one_time=SoftwareKey(self.dice.randrange(1, 1 << 200)))
        ok, counter = self.send(session.request_counter(), link)
        if not ok:
            return
        command = session.open(counter)
        if not good and self.dice.random() < 0.2:
            spoilt = bytearray(command.payload)
            spoilt[self.dice.randrange(len(spoilt))] ^= 1 << self.dice.randrange(8)
            self.send(security_command(Function.OPEN, bytes(spoilt)), link)
        ok, payload = self.send(command, link)
        if ok:
            session.accept(payload)
            self.sessions[link] = session

    def inner(self) -> None:
        link = self.opened()
        if link is None:
            return
        size = self.dice.choice([0, 0, 1, 5, 16, 17, 32, self.dice.randrange(200)])
        payload = self.dice.choice([bytes(size), self.dice.randbytes(size), b"\x80" + bytes(max(0, size - 1))])
        function = self.dice.choice([1, 2, 3, 4, 5, 7, 8, 9, 11, 12, 13, 14, 15, 17, 18, 19, 20, 23])
        if function in (5, 9) and self.dice.random() < 0.8:
            function = 7
        channel = self.dice.choice([0, 0, 0, 1, 2, 7, 9, 256])
        group = self.dice.choice([1, 128, 128, 3, 4, 5])
        self.sealed(Command(channel, group, function, payload), link)

    def write(self, link: str | None = None, *, good: bool = False) -> None:
        """A datasheet, good or with one thing wrong."""
        link = link or self.opened()
        if link is None:
            return
        blocks = dict(SHEET)
        if not good and self.dice.random() < 0.3:
            blocks.pop(self.dice.choice(list(blocks)))
        wrong = not good and self.dice.random() < 0.3
        changes: dict[str, object] = {}
        if wrong:
            changes = self.dice.choice([{"sequence": 0}, {"key_epoch": 77}, {"sequence": 1 << 31}, {}])
        security = self.desk.signed(blocks, **changes)
        if wrong and not changes:
            spoilt = bytearray(security)
            spoilt[self.dice.randrange(len(spoilt))] ^= 1 << self.dice.randrange(8)
            security = bytes(spoilt)
        for (channel, code), teds in {**blocks, SECURITY: security}.items():
            for at in range(0, len(teds), 200):
                piece = bytes([code]) + at.to_bytes(4, "big") + teds[at : at + 200]
                self.sealed(Command(channel, 1, 3, piece), link)
        if self.dice.random() < 0.5:
            self.sealed(Command(0, 1, 4, b"\x01"), link)
        self.sealed(Command(0, 1, 4, b"\x80"), link)
        if link in self.sessions and (good or self.dice.random() < 0.7):
            self.sealed(security_command(Function.CLOSE), link)
            del self.sessions[link]

    def measure(self, asked: Command | None = None, link: str | None = None) -> None:
        link = link or self.opened()
        if link is None:
            return
        digest = Operation.digest(self.twins.flash)
        channels = self.dice.choice([b"\x01", b"\x02", b"\x01\x02", b"\x07", b"\x01\x01", b"\x09", b"\x0a", b""])
        period = self.dice.choice([1, 3]) * MS * self.dice.choice([1, 1, 5])
        subscribe = bytes([self.dice.randrange(5), self.dice.choice([0, 0x80, 2, 0x82, 1, 0x81, 3])])
        subscribe += bytes([1 if channels == b"\x09" else self.dice.randrange(12)])
        subscribe += self.dice.choice([0, 100]).to_bytes(2, "big") + period.to_bytes(8, "big")
        subscribe += self.dice.choice([bytes(8), bytes(8), b"\xff" * 8]) + channels
        commands = [
            Command(self.dice.choice([0, 0, 1, 2, 9]), 4, 1, digest + bytes([self.dice.choice([0, 1, 10, 60, 61])])),
            Command(0, 4, 1, digest + b"\x0a"),
            Command(7, 4, 1, digest + b"\x0a" + self.dice.choice([19, 20, 500, 10001]).to_bytes(2, "big")),
            Command(self.dice.choice([0, 1, 7]), 4, 2),
            Command(1, 3, 1, bytes(4)),
            Command(7, 3, 2, bytes(4) + self.dice.choice([b"\x12\x34", b"\xff\xff"])),
            security_command(Function.SAMPLE, channels),
            security_command(Function.SET, b"\x07" + self.dice.randbytes(2)),
            security_command(Function.SUBSCRIBE, subscribe),
            security_command(Function.SUBSCRIBE, subscribe),
            security_command(Function.STOP, bytes([self.dice.randrange(4)])),
            security_command(Function.CLOCK),
            security_command(Function.OPERATION),
            security_command(Function.POWER),
            Command(8, 4, 1, digest + b"\x0a" + (2000).to_bytes(2, "big")),
            TriggerToken(TOKEN).arm(self.dice.choice(list(Action)), self.dice.choice([0, 5, 60])).command(),
            security_command(Function.ARM, self.dice.randbytes(16) + bytes([61, 1])),
            security_command(Function.DRIVE, self.dice.choice([b"\x07", b"\x07\x08", b"\x08", b"\x01", b""])),
        ]
        asked = asked or self.dice.choice(commands)
        ok, payload = self.sealed(asked, link)
        self.twins.hold()
        if ok and asked.function == Function.DRIVE and asked.command_class == 128:
            layout = Layout(tuple(asked.payload), tuple(CHANNELS[number].octets for number in asked.payload))
            key = drive_key(self.sessions[link].message_key, DriveReply.decode(payload).run)
            self.driven[link] = (layout, DatagramSealer(key))
            self.counter = 0

    def drive(self) -> None:
        """Messages in time and not, in order and not, whole and not."""
        link = self.dice.choice(self.drivers)
        if link not in self.driven:
            return
        layout, sealer = self.driven[link]
        ahead = self.dice.choice([0, 10_000, 19_000, 3_000_000, -1000])
        until = (self.twins.hardware.tick // 1000 + ahead) % (1 << 32)
        plain = until.to_bytes(4, "big") + bytes(self.dice.choice([0x11, 0x22, 0xF1]) for _ in range(layout.octets))
        self.counter += self.dice.choice([0, 1, 1, 1, 5])
        message = bytearray(sealer.seal(self.counter, plain))
        if self.dice.random() < 0.1:
            message[-1] ^= 1
        self.hand_over(link, bytes(message))

    def hand_over(self, link: str, message: bytes) -> None:
        """A Drive message in its frames."""
        pieces = [piece.data for piece in cut(message, fd=False, drive=True)]
        if self.dice.random() < 0.2:
            self.dice.shuffle(pieces)
        for piece in pieces:
            self.twins.drive(link, piece)

    def trigger(self) -> None:
        """The token that was armed, or another."""
        link = self.dice.choice(["can:f1", "can:f2"])
        self.twins.trigger(link, self.dice.choice([TOKEN, TOKEN, bytes(8)]))

    def event(self) -> None:
        self.twins.event(self.dice.randbytes(2), valid=self.dice.random() < 0.8)

    def disturb(self) -> None:
        """A link goes, power fails."""
        if self.dice.random() < 0.15:
            self.twins.restart()
            self.sessions.clear()
        elif self.dice.random() < 0.3:
            link = self.link()
            self.twins.lost(link)
            self.sessions.pop(link, None)

    def nonsense(self) -> None:
        """Octets that are no frame, and a sealed one that is spoilt."""
        link = self.link()
        frame = self.dice.randbytes(self.dice.randrange(40))
        if link in self.sessions and self.dice.random() < 0.5:
            spoilt = bytearray(self.sessions[link].seal(security_command(Function.IDENTIFY)).encode())
            spoilt[self.dice.randrange(6, len(spoilt))] ^= 1 << self.dice.randrange(8)
            frame = bytes(spoilt)
        self.twins.handle(frame, link=link, tapped=False)

    def wait(self) -> None:
        self.twins.pass_time(self.dice.choice([MS, 20 * MS, 100 * MS]))
        if self.dice.random() < 0.1 and not self.twins.py.streaming:
            self.twins.pass_time(self.dice.choice([1_000, 59_000, 61_000, 601_000]) * MS)


class Operation:
    """What Operate wants to have been read."""

    @staticmethod
    def digest(flash: Flash) -> bytes:
        import hashlib

        return hashlib.sha256(flash.security_teds()).digest()[:16]


class HalfSentStream:
    """The node in C alone, in the middle of the sixth message of a stream: 20 samples of 1 ms each, 7 frames."""

    def __init__(self) -> None:
        self.twins = Twins(7)
        station = Station(self.twins, 7)
        station.begin_measuring()
        asked = bytes([0, 0, 20]) + (100).to_bytes(2, "big") + MS.to_bytes(8, "big") + bytes(8) + b"\x01"
        assert station.sealed(security_command(Function.SUBSCRIBE, asked), "can:f1")[0]
        self.counters: list[int] = []
        self.frames = 0
        while self.frames < 7 * 5 + 3:
            self.turn()

    def turn(self, *, bus: bool = True) -> None:
        """A turn of the board's loop, every 0.1 ms; ``bus``: its controller takes frames."""
        self.twins.hardware.tick += MS // 10
        self.twins.c.poll()
        while bus and (frame := self.twins.c.next_frame()) is not None:
            self.frames += 1
            if frame[0] >> 8 & 7 == 0:
                self.counters.append(int.from_bytes(frame[1][:4], "big"))

    def lost_after(self, turns: int = 2000) -> int:
        """Return messages that never left."""
        for _ in range(turns):
            self.turn()
        self.twins.c.close()
        assert self.counters == sorted(self.counters)
        return self.counters[-1] + 1 - len(self.counters)


@pytest.mark.parametrize(("held_up", "lost"), [(19, 0), (41, 0), (65, 0), (180, 0), (400, 18)])
def test_a_loop_held_up_in_the_middle_of_a_message_loses_none_before_it_sleeps(held_up: int, lost: int) -> None:
    """Two messages' time and 150 ms: that long a station waits for what is late."""
    node = HalfSentStream()
    node.twins.hardware.tick += held_up * MS
    assert node.lost_after() == lost


def test_of_a_slow_bus_the_newest_message_wins() -> None:
    node = HalfSentStream()
    for _ in range(1000):
        node.turn(bus=False)
    assert node.lost_after() == 4


@pytest.mark.parametrize("seed", range(12))
def test_both_nodes_answer_the_same(seed: int) -> None:
    twins = Twins(seed)
    station = Station(twins, 1000 + seed)
    if seed % 2:
        station.begin_measuring()
    for _ in range(150):
        station.move()
    assert twins.compared > 50
    assert not twins.c.misused
    blocks = {**twins.flash.blocks, SECURITY: twins.flash.security_teds()}
    assert twins.c.blocks() == blocks
    twins.c.close()
