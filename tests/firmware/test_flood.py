"""Strangers flood a bus beside a measurement: it loses nothing but air time, with either node."""

from __future__ import annotations

import re
import threading
from dataclasses import dataclass, field

import pytest

from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.isotp import FUNCTIONAL, addresses, consecutive_frames, first_frame, physical_id, single
from teds_provision.links.can.spec import FIRST_STATION, LAST_STATION, parse_spec
from teds_provision.protocol.announce import default_can_address
from teds_provision.protocol.messages.frames import IDENTIFY, Function, security_command
from tests.e2e.desk import ANGLE, Desk, Station
from tests.firmware.conftest import CNode

pytestmark = pytest.mark.system

STATION = FIRST_STATION
"""The address of the station that measures."""


@dataclass
class Flood:
    """Stations that ask and never take an answer up, each of them four times a second.

    ``stations`` ask everyone; those of them that do not measure ask each of ``nodes`` as well.
    """

    can: str
    stations: range
    nodes: list[int]
    rounds: int = 0
    answers: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Flood:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(30)

    def _run(self) -> None:
        bus = Bus(parse_spec(self.can))
        try:
            while not self._stop.is_set():
                self.rounds += 1
                for station in self.stations:
                    self._stop.wait(0.25 / len(self.stations))
                    for frame in self._asked(station):
                        bus.send(frame)
                    while (heard := bus.receive(0.0)) is not None:
                        self._count(heard)
        finally:
            bus.close()

    def _count(self, heard: Frame) -> None:
        ends = addresses(heard.identifier)
        if ends is not None and ends[0] in self.stations and ends[0] != STATION and heard.data[0] >> 4 <= 1:
            self.answers[ends[1]] = self.answers.get(ends[1], 0) + 1

    def _asked(self, station: int) -> list[Frame]:
        """Return what a station asks in one round; the one that measures asks everyone alone."""
        transaction = bytes([0xA0 + self.rounds % 64])
        ask = single(transaction + IDENTIFY.encode())
        frames = [Frame(FUNCTIONAL | station, ask)]
        if station == STATION:
            return frames
        unknown = transaction + security_command(Function.OPEN, bytes(89)).encode()
        for node in self.nodes:
            whole, rest = first_frame(unknown, fd=False)
            asked = [ask, whole, *(consecutive_frames(rest, fd=False) if self.rounds % 2 else ())]
            frames += [Frame(physical_id(node, station), data) for data in asked]
        return frames


EVERYONE = pytest.param(
    True,
    id="of everyone",
    marks=pytest.mark.nightly(
        "tests/firmware/test_flood.py::test_a_measurement_of_both_nodes_loses_nothing_while_strangers_ask: the other "
        "case asks everyone too"
    ),
)


@pytest.mark.realtime
@pytest.mark.parametrize("everyone_alone", [EVERYONE, pytest.param(False, id="of everyone and of the node")])
def test_a_measurement_of_both_nodes_loses_nothing_while_strangers_ask(
    desk: Desk, station: Station, node: CNode, everyone_alone: bool
) -> None:
    """Functional and physical Identify, first frames without their rest, and Open with a key that no station has."""
    node.start()
    other = desk.node(type_=ANGLE).start(nfc=False, can=True)
    links = desk.links.over("can")
    uuids = (node.uuid, other.uuid)
    home = [default_can_address(bytes.fromhex(uuid)) for uuid in uuids]
    where = [[*links[:-1], f"{links[-1]}&node={address}"] for address in home]
    for uuid, link in zip(uuids, where, strict=True):
        assert station.ask("provision", "--profile", ANGLE, "--yes", *link)["verdict"] == "authentic", uuid
    stations = range(LAST_STATION - 3 if everyone_alone else FIRST_STATION, LAST_STATION + 1)
    with Flood(desk.links.can, stations, [] if everyone_alone else home) as flood:
        assert station.ask("verify", node.uuid, *where[0])["verdict"] == "authentic"
        request = ["--rate", "200", "--duration", "2", "--test-pattern"]
        measured = station.run("measure", *uuids, *request, *links)
    assert measured.code == 0, measured
    counted = re.findall(
        r"(\d+) values in (\d+) messages, lost (\d+), late (\d+), bad (\d+)", measured.out + measured.err
    )
    assert sum(int(values) for values, *_ in counted) >= 2 * 330, measured
    assert {tuple(map(int, rest)) for _, _, *rest in counted} == {(0, 0, 0)}, measured
    assert all(flood.answers.get(address, 0) > flood.rounds for address in home), "strangers are answered, too"
