"""A station sees what data for other stations takes of a bus, and grants its own streams only in the rest."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.other_stations import OtherStationsLoad
from teds_provision.links.can.port import CanPort
from teds_provision.links.can.spec import parse_spec
from teds_provision.measure import buses
from teds_provision.measure.buses import MeasuredBus
from teds_provision.measure.presence import Presence
from tests.links.can.hub import Hub
from tests.pace import until

EIGHT = bytes(8)
FOR_F2 = 0x1CFF4021
"""Data of node 21 for station F2, stream 0, segment 0."""


class Bus:
    """Its clock is the test's. A classic frame of 8 octets has 160 bits at most: 0.32 ms at 500 kbit/s."""

    def __init__(self, options: str = "bitrate=500000") -> None:
        self.now = 100.0
        self.load = OtherStationsLoad(parse_spec(f"socketcan:can0?{options}&source=0xf1"), lambda: self.now)

    def take(self, frames: int, identifier: int = FOR_F2, data: bytes = EIGHT, *, fd: bool = False) -> None:
        for _ in range(frames):
            self.load.count(Frame(identifier, data, fd))


def test_a_frame_counts_with_the_most_stuff_bits_that_it_can_have() -> None:
    bus = Bus()
    bus.take(1250)
    bus.now += 1.0
    assert bus.load.load == pytest.approx(1250 * 160 / 500_000 / 2), "0.4 s of the 2 s that are counted"
    bus = Bus("bitrate=250000")
    bus.take(625, data=b"")
    assert bus.load.load == pytest.approx(625 * 80 / 250_000 / 2)
    bus = Bus("bitrate=500000&data_bitrate=2000000&fd=true")
    bus.take(1000, data=bytes(64), fd=True)
    whole = 1000 * ((36 + 8 + 13) / 500_000 + (517 + 129 + 32) / 2_000_000)
    assert bus.load.load == pytest.approx(whole / 2, rel=0.01)


@pytest.mark.parametrize(
    ("identifier", "counts"),
    [
        (0x1CFF2021, False),  # for this station, F1
        (0x1CFF4021, True),
        (0x1CFF5F01, True),  # F2, stream 3, segment 7
        (0x1CFFE021, True),  # F7
        (0x1CFF0021, False),  # an Announce
        (0x18DA21F2, False),  # a command
        (0x18DAF221, False),
        (0x18EF21F2, False),  # Drive
        (0x18FF00F2, False),  # a trigger
        (0x1CFE4021, False),
    ],
)
def test_data_for_another_station_alone_counts(identifier: int, counts: bool) -> None:
    bus = Bus()
    bus.take(10, identifier)
    assert (bus.load.load > 0) == counts


def test_the_load_follows_the_last_two_seconds() -> None:
    bus = Bus()
    for _ in range(40):
        bus.take(125)
        bus.now += 0.1
    assert bus.load.load == pytest.approx(0.4, rel=0.06)
    bus.now += 2.0
    assert bus.load.load < 0.41
    bus.now += 2.0
    assert bus.load.load == 0, "they have ended"
    bus.now += 3600
    bus.take(1250)
    assert bus.load.load == pytest.approx(0.2), "a stream that begins after an hour is not spread over it"


def test_a_bus_keeps_of_its_60_percent_what_other_stations_leave(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(buses, "HearingThread", lambda _port: None)
    port: Any = SimpleNamespace(airtime=lambda: None, others_load=0.25, discover=lambda _sightings, *, poll: poll)
    share = MeasuredBus(port, Presence(), poll=None).share
    assert share.room == pytest.approx(0.35)
    share.taken = {b"a": 0.1, b"b": 0.05}
    assert share.room == pytest.approx(0.2)
    assert share.for_node(b"a").taken == pytest.approx(0.3)
    share.expect([b"c"], 0.15)
    assert share.for_node(b"a", sharing=True).taken == pytest.approx(0.45), "c wants half of what is left, and no more"
    port.others_load = 0.7
    assert share.room == 0.0
    assert share.for_node(b"a", sharing=True).taken == pytest.approx(0.75), "nothing is left to be shared"


@pytest.mark.link
def test_a_port_counts_what_it_receives() -> None:
    hub = Hub()
    port = CanPort(hub.spec)
    try:
        assert port.others_load == 0.0
        until(lambda: bool(hub._clients))
        hub.send(0x1CFF2021, EIGHT)  # for this station
        hub.send(FOR_F2, EIGHT)
        until(lambda: port.others_load > 0)
        assert port.others_load <= 160 / 500_000 / 2 + 1e-9, "one of the two"
    finally:
        port.close()
        hub.close()
    assert port.others_load == 0.0
