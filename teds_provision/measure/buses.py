"""The buses of this process, each read and searched by one thread for all who measure on it.

Measurements, detection and commands share them: they are opened once, and closed when the process ends.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from types import TracebackType

from teds_provision.errors import LinkError
from teds_provision.links.ble.port import BlePort
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.port import CanPort
from teds_provision.measure.discovery import BleDiscovery, BleStreamReceiver, CanDiscovery, air_time
from teds_provision.measure.planning import BusShare, BusTime
from teds_provision.measure.presence import Presence, Sighting
from teds_provision.measure.stream_receiver import CanStreamReceiver, StreamReceiver
from teds_provision.protocol.messages.ble import LEAST_MTU
from teds_provision.protocol.operation.can_frames import DriveAddress, StreamAssembly, cut


class MeasuredBus:
    """One link that carries data: ``port``, who hears its data messages, how much of it is taken, who is on it."""

    def __init__(
        self, port: CanPort | BlePort, hearing: StreamReceiver, share: BusShare, lookout: CanDiscovery | BleDiscovery
    ) -> None:
        self.port, self.receiver, self.share, self.discovery = port, hearing, share, lookout
        self.reading = threading.Lock()
        """Held while a datasheet is read behind a measurement: one node at a time."""

    @property
    def place(self) -> str:
        """As the port names it."""
        return self.port.place

    def close(self) -> None:
        """End its threads; the port stays open."""
        self.discovery.close()
        self.receiver.close()

    def assembly(self, length: int) -> StreamAssembly:
        """Return the assembler of messages of so many octets."""
        return StreamAssembly(length, fd=isinstance(self.port, CanPort) and self.port.spec.fd)

    def time_for(self, time: BusTime, address: int) -> BusTime:
        """Return the time of this link as the node at ``address`` has it: over the air its connection has an MTU."""
        return air_time(time, self.port.mtu(address)) if isinstance(self.port, BlePort) else time

    def drive(self, address: int, message: bytes) -> None:
        """Send a Drive message to the node at ``address``; raises LinkError."""
        if isinstance(self.port, BlePort):
            self.port.link(address).drive(message)
            return
        identifier = DriveAddress(address, self.port.spec.source).identifier
        for piece in cut(message, fd=self.port.spec.fd, drive=True):
            self.port.send(Frame(identifier, piece.data, self.port.spec.fd))


def bus_at(port: CanPort | BlePort, sightings: Presence, *, poll: float | None) -> MeasuredBus:
    """Return the bus, or the adapter, behind a port."""
    if isinstance(port, BlePort):
        return MeasuredBus(
            port, BleStreamReceiver(port), BusShare(BusTime(mtu=LEAST_MTU)), BleDiscovery(port, sightings, poll=poll)
        )
    time = BusTime(port.spec.bitrate, port.spec.data_bitrate if port.spec.fd else None)
    return MeasuredBus(port, CanStreamReceiver(port), BusShare(time), CanDiscovery(port, sightings, poll=poll))


class Buses:
    """All of them; ``with Buses(ports) as buses:`` ends their threads. The caller closes the ports.

    ``news`` is called with each node that answers, from the discovery's thread.
    """

    def __init__(
        self,
        ports: Iterable[CanPort | BlePort] = (),
        *,
        news: Callable[[Sighting], None] = lambda _sighting: None,
        note: Callable[[str], None] = lambda _text: None,
    ) -> None:
        self.presence = Presence(news, note)
        self._poll: float | None = None
        self._buses: dict[str, MeasuredBus] = {}
        for port in ports:
            self.add(port)

    def __enter__(self) -> Buses:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def add(self, port: CanPort | BlePort) -> MeasuredBus:
        """Hear one more bus."""
        if port.place not in self._buses:
            self._buses[port.place] = bus_at(port, self.presence, poll=self._poll)
        return self._buses[port.place]

    def all(self) -> Sequence[MeasuredBus]:
        """Every bus."""
        return tuple(self._buses.values())

    def bus_of(self, sighting: Sighting) -> MeasuredBus:
        """Return the bus on which a node was seen."""
        return self._buses[sighting.port.place]

    def expect(self, uuids: Iterable[bytes]) -> None:
        """Expect these nodes to be measured: every bus keeps room for them until their place is known."""
        for bus in self.all():
            bus.share.expect(uuids)

    def poll(self, seconds: float | None) -> None:
        """Send a broadcast every ``seconds`` from now on; None (the default): only while a node is missing."""
        self._poll = seconds
        for bus in self.all():
            bus.discovery.poll(seconds)

    def discover(self) -> list[Sighting]:
        """Ask every bus now; who answered until now. A bus that has failed is left out, the last failure raised."""
        failure: LinkError | None = None
        worked = 0
        for bus in self.all():
            try:
                bus.discovery.discover()
                worked += 1
            except LinkError as error:
                failure = error
        if failure is not None and not worked:
            raise failure
        return self.presence.all()

    def close(self) -> None:
        """End the threads of every bus."""
        for bus in self.all():
            bus.close()
        self._buses.clear()
