"""A long transfer on a bus: alone it takes all of it, beside streams what they leave of nine tenths, and it ends."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from teds_provision.links.can.bus import Frame
from teds_provision.links.can.pacing import classic_bits
from teds_provision.links.can.spec import parse_spec
from teds_provision.links.can.transfer_pace import TransferPace

BITRATE = 500_000
COMMAND = Frame(0x18DA21F1, bytes.fromhex("2112345678901234"))
DATA = Frame(0x1CFF2021, bytes.fromhex("0112345678901234"))
DRIVE = Frame(0x18EF22F2, bytes.fromhex("0112345678901234"))
SECONDS = classic_bits(COMMAND.identifier, COMMAND.data) / BITRATE


@dataclass
class Bus:
    """A bus without time of its own, on which frames pass as fast as the wire lets them."""

    now: float = 100.0
    streams: float = 0.0
    frame: Frame = DATA
    command_seconds: float = 0.0
    stream_seconds: float = 0.0
    due: float = 100.0

    def __post_init__(self) -> None:
        self.pace = TransferPace(parse_spec(f"socketcan:can0?bitrate={BITRATE}"), lambda: self.now, self.sleep)

    def sleep(self, seconds: float) -> None:
        """Time passes, and data frames of streams with it."""
        end = self.now + seconds
        if self.streams:
            while self.due < end:
                self.pace.count(self.frame)
                self.stream_seconds += SECONDS
                self.due += SECONDS / self.streams
        self.now = end

    def packet(self, frames: int, latency: float = 0.0) -> bool:
        """Send a packet after its wait; True if streams were seen."""
        seen = self.pace.wait()
        for _ in range(frames):
            self.pace.count(COMMAND)
            self.command_seconds += SECONDS
            self.sleep(SECONDS)
        self.sleep(latency)
        return seen


@pytest.mark.parametrize("frame", [DATA, DRIVE], ids=["measured values", "orders to actuators"])
@pytest.mark.parametrize("streams", [0.3, 0.6])
def test_transfers_and_streams_take_nine_tenths_together(streams: float, frame: Frame) -> None:
    bus = Bus(streams=streams, frame=frame)
    bus.sleep(1.0)
    began, before = bus.now, bus.stream_seconds
    seen = [bus.packet(40) for _ in range(200)]
    passed = bus.now - began
    share = (bus.command_seconds + bus.stream_seconds - before) / passed
    assert 0.8 < share < 0.95
    assert all(seen)


def test_without_streams_a_transfer_does_not_wait_and_with_the_first_it_does() -> None:
    bus = Bus()
    bus.sleep(1.0)
    began = bus.now
    assert not any(bus.packet(40) for _ in range(200))
    assert bus.now - began == pytest.approx(200 * 40 * SECONDS)
    bus.streams, bus.due = 0.5, bus.now
    bus.packet(40)
    assert bus.packet(40)


def test_a_full_bus_still_lets_a_transfer_come_to_its_end() -> None:
    bus = Bus(streams=1.0)
    bus.sleep(1.0)
    began = bus.now
    for _ in range(50):
        assert bus.packet(4)
    assert 0.01 < bus.command_seconds / (bus.now - began) < 0.03


def test_a_slow_board_is_not_made_slower_and_saves_up_no_time() -> None:
    bus = Bus(streams=0.1)
    bus.sleep(1.0)
    bus.packet(40)
    began = bus.now
    for _ in range(20):
        bus.packet(40, latency=SECONDS * 40)
    assert bus.now - began == pytest.approx(20 * 80 * SECONDS, rel=0.02)
    bus.sleep(60.0)
    began, before = bus.now, bus.command_seconds
    for _ in range(50):
        bus.packet(40)
    assert (bus.command_seconds - before) / (bus.now - began) < 0.93


def test_the_first_packet_of_a_transfer_waits_for_what_was_sent_since_the_bus_was_opened() -> None:
    bus = Bus(streams=0.5)
    for _ in range(100):
        bus.pace.count(COMMAND)
        bus.pace.count(DATA)
    before = bus.now
    bus.now += 0.01
    assert bus.pace.wait()
    assert bus.now - before == pytest.approx(100 * SECONDS / (0.9 - 100 * SECONDS / 0.5), rel=0.11)
