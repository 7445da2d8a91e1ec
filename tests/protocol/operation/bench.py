"""A node that measures and acts, in memory: hardware whose clock and values the test holds, and stations on it."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import SoftwareKey, node_key_message
from teds_provision.protocol.messages.frames import Command, Reply, decode_reply
from teds_provision.protocol.operation.commands import OperateCommand, OperationReply, PowerReply, idle
from teds_provision.protocol.operation.hardware import ChannelHardware, RawReading, SessionPort
from teds_provision.protocol.operation.streams import DataFrame
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.tim import Tim
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.image import SECURITY, BlockId
from teds_provision.teds.sheet import ChannelKind

from ..memory import RamFlash
from .kat import KAT, UUID

MS = 1_000_000
SECOND = 1000 * MS
K = bytes.fromhex(KAT["open"]["K"])
NODE_KEY = SoftwareKey(7)
DIGEST = bytes.fromhex(KAT["digest"])
KINDS = {"sensor": ChannelKind.SENSOR, "actuator": ChannelKind.ACTUATOR, "event sensor": ChannelKind.EVENT_SENSOR}
LOW, HIGH = 100, 4000
SAFE_VALUE = (100).to_bytes(2, "big")


def channels() -> dict[int, ChannelHardware]:
    """Return those of the vectors: sensors 1, 2, 3, actuators 4 and 6, event sensor 5."""
    return {
        int(number): ChannelHardware(KINDS[facts["kind"]], facts["octets"], halt=1 if "act" in facts["kind"] else None)
        for number, facts in KAT["channels"].items()
    }


def channel_teds(facts: ChannelHardware, *, period: float | None = None, **changes: int | None) -> bytes:
    """Return a TransducerChannel TEDS that says what the hardware is, or something else."""
    values = {"kind": int(facts.kind), "model": facts.model, "octets": facts.octets, "halt": facts.halt, **changes}
    block = bytes.fromhex("030400030101") + bytes([11, 1, values["kind"] or 0])
    block += bytes([18, 9, 40, 1, values["model"] or 0, 41, 1, values["octets"] or 0, 42, 1, 8])
    if period is not None:
        block += bytes([23, 4]) + struct.pack(">f", period)
    if values["halt"] is not None:
        block += bytes([36, 1, values["halt"]])
    return frame(block)


@dataclass
class FakeHardware:
    """Channel c gives c · ms of the tick, cut to its width. ``log`` is what actuators were told."""

    channels: Mapping[int, ChannelHardware] = field(default_factory=channels)
    step: int = 1000
    drift: int = 50
    tick: int = 62_300_000
    log: list[tuple[str, object]] = field(default_factory=list)
    faults: set[int] = field(default_factory=set)
    tests: set[int] = field(default_factory=set)
    invalid: set[int] = field(default_factory=set)
    charge: PowerReply = field(default_factory=lambda: PowerReply(1, 87, 3.7, -0.012, 23))
    points: dict[int, bytes] = field(default_factory=dict)
    unkept: set[int] = field(default_factory=set)

    def now(self) -> int:
        return self.tick

    def keeps(self, period: int) -> bool:
        return period not in self.unkept

    def value(self, channel: int, tick: int) -> bytes:
        width = self.channels[channel].octets
        return (channel * (tick // MS) % (1 << 8 * width)).to_bytes(width, "big")

    def read(self, channel: int, tick: int) -> RawReading:
        return RawReading(self.value(channel, tick), channel not in self.invalid)

    def accepts(self, channel: int, data_set: bytes) -> bool:
        return LOW <= int.from_bytes(data_set, "big") <= HIGH

    def apply(self, values: Mapping[int, bytes]) -> None:
        self.points |= values
        self.log.append(("apply", {channel: int.from_bytes(octets, "big") for channel, octets in values.items()}))

    def set_point(self, channel: int) -> bytes:
        return self.points[channel]

    def make_safe(self, channel: int) -> None:
        self.points[channel] = SAFE_VALUE
        self.log.append(("safe", channel))

    def self_test(self, channels: Sequence[int]) -> None:
        self.tests |= set(channels)

    def testing(self, channel: int) -> bool:
        return channel in self.tests

    def fault(self, channel: int) -> bool:
        return channel in self.faults

    def power(self) -> PowerReply:
        return self.charge


class Bench:
    """One node with hardware and any number of stations by link; real time and ticks run together."""

    def __init__(self, *, teds: dict[BlockId, bytes] | None = None, **limits: Any) -> None:
        self.hardware = FakeHardware()
        own = {(number, 3): channel_teds(facts) for number, facts in self.hardware.channels.items()}
        blocks = {SECURITY: bytes.fromhex(KAT["security_teds"]), **own, **(teds or {})}
        flash = Flash(
            UUID, NODE_KEY.point, NODE_KEY.sign(node_key_message(UUID, NODE_KEY.point)), blocks=blocks, epoch=1,
            sequence=1, key=K, station=SoftwareKey(5).point, ca=SoftwareKey(3).point, provisioned=True,
            can_address=KAT["node_can_address"],
        )  # fmt: skip
        self.memory = RamFlash(flash)
        self.limits = limits
        self.sessions: dict[str, StationSession] = {}
        self.ports: dict[str, SessionPort] = {}
        self.frames: list[tuple[int, DataFrame]] = []
        self.buses = {"can"}
        self.restart()

    def restart(self) -> None:
        """Power off and on; the tick goes on from where the test has it."""
        self.tim = Tim(
            NODE_KEY,
            self.memory,
            lambda: self.hardware.tick / SECOND,
            hardware=self.hardware,
            **self.limits,
        )

    # -- stations --------------------------------------------------------------------------------------------------

    def plain(self, command: Command, link: str = "can:f1", *, left: bool = True) -> Reply:
        """A plain command; ``left``: its reply has left at once."""
        reply = self.tim.handle(command.encode(), link=link, tapped=link == "nfc", port=self.ports.get(link))
        if left:
            self.tim.reply_sent(link)
        return decode_reply(reply)

    def open(self, link: str = "can:f1", port: SessionPort | None = None) -> Bench:
        """Open a session on a link; its first good frame is the next command."""
        if port is not None:
            self.ports[link] = port
            self.buses.add(port.bus)
        session = StationSession(K, UUID)
        opened = self.plain(session.open(self.plain(session.request_counter(), link).payload), link)
        assert opened.ok, opened.reason
        session.accept(opened.payload)
        self.sessions[link] = session
        return self

    def send(self, command: Command, link: str = "can:f1", *, left: bool = True) -> Reply:
        """Return an inner command."""
        session = self.sessions[link]
        outer = self.plain(session.seal(command), link, left=left)
        assert outer.ok, f"outer refusal {outer.reason}"
        return session.unseal(outer.payload)

    def reason(self, command: Command, link: str = "can:f1") -> int | None:
        """Return the reason of an inner refusal, None if it is good."""
        reply = self.send(command, link)
        return None if reply.ok else reply.reason

    def operate(self, *channels: int, link: str = "can:f1", lease: int = 60, dead_man: int = 10_000) -> Bench:
        """Claim channels (0: all sensors)."""
        for channel in channels:
            facts = self.hardware.channels.get(channel)
            acting = facts is not None and facts.actuator
            asked = OperateCommand(channel, DIGEST, lease, dead_man if acting else None)
            assert self.reason(asked.command(), link) is None
        return self

    def operation(self, link: str = "can:f1") -> OperationReply:
        """Return what Operation says."""
        return OperationReply.decode(self.send(Command(0, 128, 19), link).payload)

    def idle(self, channel: int = 0, link: str = "can:f1") -> None:
        assert self.send(idle(channel), link).ok

    # -- time ------------------------------------------------------------------------------------------------------

    def until(self, tick: int) -> Bench:
        """Let time pass as a server does: at each moment at which the node wants to be called, and at ``tick``."""
        while True:
            waits = [self.tim.poll()]
            for bus in self.buses:
                while (sent := self.tim.next_frame(bus)) is not None:
                    self.frames.append((self.hardware.tick, sent))
                waits.append(self.tim.next_frame_in())
            wait = min((wait for wait in waits if wait is not None), default=None)
            due = tick if wait is None else self.hardware.tick + max(1, round(wait * SECOND))
            if due >= tick:
                break
            self.hardware.tick = due
        self.hardware.tick = tick
        self.tim.poll()
        return self

    def later(self, ns: int) -> Bench:
        """Let so many ns pass."""
        return self.until(self.hardware.tick + ns)
