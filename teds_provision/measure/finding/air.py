"""Nodes in the air: their data messages, and the look-out that connects to each and asks who it is (operation.md 6)."""

from __future__ import annotations

import time
from dataclasses import replace

from teds_provision.errors import LinkFailure, NoNode
from teds_provision.links.ble.port import BlePort
from teds_provision.links.ports import Notice
from teds_provision.measure.finding.asking import LEAST, Asking, Pace
from teds_provision.measure.finding.lookout import LOOK
from teds_provision.measure.finding.sightings import Sighting, Sightings
from teds_provision.measure.hearing import SLICE, HeardStream, Hearing
from teds_provision.measure.planning import BusTime
from teds_provision.protocol.operation.can_frames import read_ble_frame

ROUND = 20.0  # seconds in which somebody must advertise, else the look-out begins anew


class AirHearing(Hearing):
    """The listening thread of one Bluetooth adapter; nodes are told apart by the number of their connection."""

    def __init__(self, port: BlePort) -> None:
        self._air = port
        super().__init__(port.place)

    def register(self, node: int, stream: int, heard: HeardStream) -> None:
        """Hear a stream; its connection is kept."""
        super().register(node, stream, heard)
        self._air.keep(node, streaming=True)

    def forget(self, node: int, stream: int) -> HeardStream | None:
        """Hear it no more."""
        heard = super().forget(node, stream)
        self._air.keep(node, streaming=any(number == node for number, _ in self._streams))
        return heard

    def _hear(self) -> None:
        with self._air.listen() as ear:
            looked = time.monotonic()
            while not self._stop.is_set():
                came = ear(SLICE)
                read = read_ble_frame(came.octets) if came is not None else None
                if came is not None and read is not None:
                    heard = self._streams.get((came.connection, read[0]))
                    if heard is not None:
                        heard.whole(read[1], came.at)
                looked = self._flush(looked, self._air.lost)


class AirLookout(Asking):
    """The look-out of one adapter, a thread until :meth:`close`: it looks only while somebody is missing, or on asking.

    Every node that advertises is connected to and asked, one after the other; those that are in use are left alone.
    """

    LONGEST = ROUND

    def __init__(self, port: BlePort, sightings: Sightings, *, poll: float | None = None) -> None:
        self.port = port
        super().__init__(port.place, sightings, poll)

    def _run(self) -> None:
        pace = Pace(0.0)
        while not self._stop.is_set():
            wanted = self._asked.is_set()
            if not pace.is_due(wanted=wanted, missing=self._sightings.missing(), poll=self._poll):
                self._asked.wait(LOOK)
                continue
            self._look()
            pace.asked = time.monotonic()

    def _look(self) -> None:
        self._begin()
        self.failure = None
        try:
            for contact in self.port.everyone(seconds=2 * LEAST, notice=_nothing):
                number = contact.connection or 0
                self._sightings.saw(Sighting(contact.identity, number, self.port, time.monotonic()))
        except NoNode:
            pass
        except LinkFailure as failure:
            self.failure = failure
        self._done()


def air_time(time_: BusTime, mtu: int) -> BusTime:
    """The adapter's time as a node behind a connection of this MTU has it."""
    return replace(time_, mtu=mtu)


def _nothing(_notice: Notice) -> None:
    """What the look-out sees is told as sightings."""
