"""A node in C that measures and acts: the bench of ``tests.protocol.operation`` with the other node on it."""

from __future__ import annotations

import ctypes
import random
from dataclasses import dataclass, field
from typing import ClassVar

from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import GROUP_ORDER
from teds_provision.protocol.operation.hardware import SessionPort
from teds_provision.protocol.operation.streams import DataFrame
from tests.firmware.memory_node import MemoryNode, link_number
from tests.protocol.operation import bench as reference
from tests.protocol.operation.bench import NODE_KEY, SECOND, FakeHardware
from tests.protocol.operation.kat import KAT, UUID

ADDRESS = KAT["node_can_address"]
_NEVER = (1 << 64) - 1
_PREPARED = {"max_message": 2048, "max_teds": 16384}


@dataclass
class Hooks:
    """What the board asks, asked of :class:`FakeHardware`."""

    hardware: FakeHardware
    timers: list[tuple[int, int | None]] = field(default_factory=list)
    """What the hardware timers of dead-men were told: a channel and ms (0: off), None for a kick."""

    def _note(self, channel: int, value: int) -> None:
        """Values of one command are one entry of the log."""
        last = self.hardware.log[-1] if self.hardware.log else ("", None)
        if last[0] == "apply" and isinstance(last[1], dict) and channel not in last[1]:
            last[1][channel] = value
        else:
            self.hardware.log.append(("apply", {channel: value}))

    def __call__(self, what: str, channel: int, argument: int, octets: bytes) -> int | tuple[bytes, int]:
        own = self.hardware
        match what:
            case "s":
                reading = own.read(channel, argument)
                return reading.octets, reading.valid
            case "b":
                return own.accepts(channel, octets)
            case "a":
                own.points[channel] = octets
                self._note(channel, int.from_bytes(octets, "big"))
            case "g":
                return own.points[channel], 1
            case "f":
                own.make_safe(channel)
            case "m":
                self.timers.append((channel, argument))
            case "k":
                self.timers.append((channel, None))
            case "t":
                own.self_test([channel])
            case "T":
                return own.testing(channel)
            case "F":
                return own.fault(channel)
            case "p":
                return own.power().encode(), 1
        return 0


class MeasuringMemoryNode(MemoryNode):
    """What a Tim that measures is asked, asked of the node in C."""

    def __init__(self, hardware: FakeHardware, *, max_message: int, max_teds: int, **sizes: int) -> None:
        dice = random.Random(1)
        self.loaded: dict[str, list[bytes]] = {}

        def draw(kind: str, size: int) -> bytes:
            if self.loaded.get(kind):
                return self.loaded[kind].pop()
            if kind == "i":
                return NODE_KEY.secret()
            return (
                dice.randrange(1, GROUP_ORDER - (1 << 224)).to_bytes(32, "big") if kind == "o" else dice.randbytes(size)
            )

        super().__init__(draw, lambda: 0.0, uuid=UUID, max_message=max_message, max_teds=max_teds, sizes=sizes)
        self.hardware, self.connected, self.spins = hardware, set[int](), 0
        self.hooks = Hooks(hardware)
        self.hook_up(self.hooks)
        self._library.memory_clock(self._board, ctypes.c_uint32(hardware.step), ctypes.c_uint16(hardware.drift))

    def _now(self) -> None:
        self._library.memory_at(self._board, ctypes.c_uint64(self.hardware.tick))

    def set_channels(self) -> None:
        """Those of the hardware; before a start."""
        self._library.memory_no_channels(self._board)
        for number, facts in sorted(self.hardware.channels.items()):
            self._library.memory_channel(
                self._board, ctypes.c_uint8(number), ctypes.c_uint8(int(facts.kind)), ctypes.c_uint8(facts.model),
                ctypes.c_uint8(facts.octets), ctypes.c_uint32(facts.shortest),
            )  # fmt: skip
            if facts.halt is not None:
                self.halts(number, facts.halt)

    def slow(self, slow: bool) -> None:
        """Whether its point arithmetic takes its time; before a start."""
        self._library.memory_slow(self._board, ctypes.c_bool(slow))

    def handle(
        self, frame: bytes, *, link: str, tapped: bool, port: SessionPort | None = None, received: int | None = None
    ) -> bytes:
        number, kind = link_number(link)
        if kind == 3 and number not in self.connected:
            assert port is not None
            self.connected.add(number)
            self.ble_connected(number - 2, port.mtu)
            self.ble_hears(number - 2, port.hears)
        self._library.memory_by_fd(self._board, ctypes.c_bool(port is not None and port.fd))
        return super().handle(frame, link=link, tapped=tapped)

    def poll(self) -> float | None:  # type: ignore[override]
        due = super().poll()
        self.spins = self.spins + 1 if due <= self.hardware.tick else 0
        assert self.spins < 1000, "it wants to be called again and again, and nothing moves"
        return None if due == _NEVER else max(0, due - self.hardware.tick) / SECOND

    def next_frame(self, bus: str = "can") -> DataFrame | None:  # type: ignore[override]
        if bus == "ble":
            packet = self.ble_data()
            return None if packet is None else DataFrame(packet[0] + 2, 0, packet[1])
        frame = super().next_frame()
        return None if frame is None else DataFrame((frame[0] >> 13 & 7) | 0xF0, *frame)

    def next_frame_in(self) -> None:
        """When a data frame may begin is told by poll."""

    def drive(self, link: str, octets: bytes) -> None:
        """A Drive frame from CAN, or a message from BLE."""
        number, kind = link_number(link)
        if kind == 3:
            self.ble_driven(number - 2, b"\0" + octets)
        else:
            self.take_frame(0x18EF0000 | ADDRESS << 8 | number, octets, fd=len(octets) > 8)

    def trigger(self, link: str, token: bytes, tick: int) -> None:
        """A trigger frame whose end was at this tick."""
        self._now()
        self._library.memory_can_rx_at(
            self._board, ctypes.c_uint32(0x18FF0000 | link_number(link)[0]), token, ctypes.c_uint8(len(token)),
            ctypes.c_bool(False), ctypes.c_uint64(tick),
        )  # fmt: skip

    def event(self, channel: int, tick: int, octets: bytes, *, valid: bool = True) -> None:
        self._now()
        super().event(channel, tick, octets, valid=valid)

    def unheard(self, link: str) -> None:
        """A station disables data messages."""
        self.ble_hears(link_number(link)[0] - 2, False)

    def actuator_claimed(self) -> bool:
        """Return True if a session claims an actuator."""
        return bool(self._library.memory_acts(self._board))

    @property
    def streaming(self) -> bool:
        """Whether a stream runs."""
        return bool(self._library.memory_streams(self._board))

    def set_run(self, link: str, run: int) -> None:
        """As if so many runs had been."""
        self._library.memory_set_run(self._board, ctypes.c_uint8(link_number(link)[0]), ctypes.c_uint16(run))

    def set_counter(self, counter: int, start: int) -> None:
        """As if its one stream had sent so many messages."""
        self._library.memory_set_counter(self._board, ctypes.c_uint32(counter), ctypes.c_uint64(start % (1 << 64)))


class CBench(reference.Bench):
    """One node in C; ``limits`` as the reference has them."""

    made: ClassVar[list[MeasuringMemoryNode]] = []

    @classmethod
    def close_all(cls) -> None:
        """Give the memory of every node of a test back."""
        while cls.made:
            cls.made.pop().close()

    def restart(self) -> None:
        limits = {**_PREPARED, **self.limits}
        flash: Flash = self.memory.state
        slow = not limits.pop("quick_points", True)
        firmware = limits.pop("firmware", None)
        room = {} if {"sessions", "streams"} & limits.keys() else {"sessions": 8, "streams": 8}
        assert limits.pop("sessions", 2) == limits.pop("streams", 2) == 2
        if not hasattr(self, "tim"):
            self.tim = MeasuringMemoryNode(self.hardware, **limits, **room)  # type: ignore[assignment]
            self.made.append(self.tim)  # type: ignore[arg-type]
            self._put: object = None
        node: MeasuringMemoryNode = self.tim  # type: ignore[assignment]
        node.slow(slow)
        if firmware is not None:
            report = firmware.about().encode()[1:]
            node.has_firmware(lambda what, _argument, _octets: report if what == "a" else b"")
        node.connected.clear()
        node.set_channels()
        assert node.start() == 0
        if self._put is not flash.blocks:
            self._put = flash.blocks
            node.put(flash)
