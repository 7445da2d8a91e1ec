"""A station of the tests' own: a session over a real bus, and what the node's streams bring."""

from __future__ import annotations

import hashlib
import time
from dataclasses import replace
from pathlib import Path

from teds_provision.errors import NodeRefusedError
from teds_provision.links.can.bus import Frame
from teds_provision.links.can.bus_multiplexer import Listener
from teds_provision.links.can.port import CanPort
from teds_provision.links.ports import Link
from teds_provision.node import node_template
from teds_provision.node.flash_file import FlashFile
from teds_provision.protocol.messages.frames import Command, Function, Reply, decode_reply, security_command
from teds_provision.protocol.operation.can_frames import StreamAssembly, cut, data_address, trigger_identifier
from teds_provision.protocol.operation.commands import OperateCommand, OperationReply
from teds_provision.protocol.operation.stream_commands import CLOCK, ClockReply, SubscribeReply
from teds_provision.protocol.operation.subscription import Receiver, StreamMessage, StreamPlan, TickBounds
from teds_provision.protocol.operation.timing import ClockSample
from teds_provision.protocol.session import StationSession
from tests.pace import PATIENCE

KEY = bytes(range(16))


def keyed_node(folder: Path, **order: object) -> FlashFile:
    """Return a node made from a datasheet that has a link key already; nothing is signed."""
    made = node_template.create(folder, **order)  # type: ignore[arg-type]
    flash = made.load()
    made.commit(replace(flash, key=KEY, epoch=1))
    return made


class SealedLine:
    """One session over any link (an object with ``exchange``)."""

    def __init__(self, link: Link, uuid: bytes) -> None:
        self.link = link
        self.session = StationSession(KEY, uuid)
        counter = self._plain(self.session.request_counter()).payload
        self.session.accept(self._plain(self.session.open(counter)).payload)
        self.digest = hashlib.sha256(self.teds()).digest()[:16]

    def _plain(self, command: Command) -> Reply:
        return decode_reply(self.link.exchange(command.encode()))

    def send(self, command: Command) -> bytes:
        """Send sealed; the payload of a good reply, NodeRefusedError for a refusal."""
        reply = self.session.unseal(self._plain(self.session.seal(command)).payload)
        if not reply.ok:
            raise NodeRefusedError("refused", reason=reply.payload[0])
        return reply.payload

    def teds(self) -> bytes:
        """Return the Security TEDS, which is short enough for one Read."""
        return self._plain(Command(0, 1, 2, b"\x80" + bytes(4))).payload[4:]

    def operate(self, channel: int = 0, *, lease: int = 10, dead_man: int | None = None) -> None:
        self.send(OperateCommand(channel, self.digest, lease, dead_man).command())

    def states(self) -> OperationReply:
        return OperationReply.decode(self.send(security_command(Function.OPERATION)))


class MeasuringStation(SealedLine):
    """A session with the node at an address of a CAN bus; ``fd`` as in ``--can``."""

    def __init__(self, spec: str, uuid: bytes, address: int) -> None:
        self.port = CanPort(spec)
        self.address, self.fd = address, "fd=1" in spec
        self.ear: Listener = self.port.listen_frames(lambda frame: data_address(frame.identifier) is not None)
        super().__init__(self.port.link(address), uuid)
        self.clock = self.read_clock()

    def close(self) -> None:
        self.port.close()

    def read_clock(self) -> ClockSample:
        left = time.monotonic_ns()
        reply = ClockReply.decode(self.send(CLOCK))
        self.last_clock = reply
        return ClockSample(left, time.monotonic_ns(), reply)

    def now(self) -> TickBounds:
        return self.clock.tick(time.monotonic_ns())

    def subscribe(self, plan: StreamPlan) -> tuple[Receiver, SubscribeReply]:
        reply = plan.accept(self.send(plan.command()), self.now())
        return Receiver(plan, reply, self.session.message_key), reply

    def hear(self, receiver: Receiver, messages: int, seconds: float = PATIENCE) -> list[StreamMessage]:
        """Return the next messages of one stream."""
        assembly = StreamAssembly(receiver.plan.length, fd=self.fd)
        heard: list[StreamMessage] = []
        until = time.monotonic() + seconds
        while len(heard) < messages:
            left = until - time.monotonic()
            assert left > 0, (heard, receiver.counts)
            frame = self.ear.get(left)
            address = data_address(frame.identifier) if frame is not None else None
            if frame is None or address is None:
                continue
            if address[:2] != (self.port.spec.source, receiver.plan.subscribe.stream) or address.node != self.address:
                continue
            octets = assembly.add_segment(address.segment, frame.data)
            message = receiver.open_message(octets, self.now()) if octets is not None else None
            if message is not None:
                heard.append(message)
        return heard

    def drive(self, message: bytes) -> None:
        for piece in cut(message, fd=self.fd, drive=True):
            self.port.send(Frame(0x18EF0000 | self.address << 8 | 0xF1, piece.data, self.fd))

    def trigger(self, token: bytes) -> int:
        """Send a trigger frame; the host's time when it left."""
        self.port.send(Frame(trigger_identifier(0xF1), token))
        return time.monotonic_ns()
