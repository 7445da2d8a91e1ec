"""The buses of this process, each heard and looked out on by one thread, whoever measures on it.

Measurements, detection and commands share them: they are opened once, and closed when the process ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from types import TracebackType

from teds_provision.errors import LinkFailure
from teds_provision.links.can.port import CanPort
from teds_provision.measure.finding.lookout import Lookout, Sighting, Sightings
from teds_provision.measure.hearing import Hearing
from teds_provision.measure.orders import BusShare
from teds_provision.measure.planning import BusTime


class Bus:
    """One CAN bus: ``port``, who hears its data frames, how much of it is taken, who is on it."""

    def __init__(self, port: CanPort, sightings: Sightings, *, poll: float | None) -> None:
        self.port = port
        self.hearing = Hearing(port)
        self.share = BusShare(BusTime(port.spec.bitrate, port.spec.data_bitrate if port.spec.fd else None))
        self.lookout = Lookout(port, sightings, poll=poll)

    @property
    def place(self) -> str:
        """As the port names it."""
        return self.port.place

    def close(self) -> None:
        """End its threads; the port stays open."""
        self.lookout.close()
        self.hearing.close()


class Buses:
    """All of them; ``with Buses(ports) as buses:`` ends their threads. The ports are the caller's to close.

    ``news`` is told each node that answers, from the look-out's thread; ``poll`` seconds between questions to
    everybody, None: only while somebody is missing.
    """

    def __init__(
        self,
        ports: Iterable[CanPort] = (),
        *,
        poll: float | None = None,
        news: Callable[[Sighting], None] = lambda _sighting: None,
        note: Callable[[str], None] = lambda _text: None,
    ) -> None:
        self.sightings = Sightings(news, note)
        self._poll = poll
        self._buses: dict[str, Bus] = {}
        for port in ports:
            self.add(port)

    def __enter__(self) -> Buses:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def add(self, port: CanPort) -> Bus:
        """Hear one more bus."""
        if port.place not in self._buses:
            self._buses[port.place] = Bus(port, self.sightings, poll=self._poll)
        return self._buses[port.place]

    def all(self) -> Sequence[Bus]:
        """Every bus."""
        return tuple(self._buses.values())

    def of(self, sighting: Sighting) -> Bus:
        """The bus on which a node was seen."""
        return self._buses[sighting.port.place]

    def expect(self, uuids: Iterable[bytes]) -> None:
        """These nodes will be measured: room is kept for them on every bus until it is known where they are."""
        for bus in self.all():
            bus.share.expect(uuids)

    def poll(self, seconds: float | None) -> None:
        """Ask everybody so often from now on."""
        self._poll = seconds
        for bus in self.all():
            bus.lookout.poll(seconds)

    def discover(self) -> list[Sighting]:
        """Ask every bus now; who answered until now. A bus that has failed is left out, the last failure raised."""
        failure: LinkFailure | None = None
        worked = 0
        for bus in self.all():
            try:
                bus.lookout.discover()
                worked += 1
            except LinkFailure as error:
                failure = error
        if failure is not None and not worked:
            raise failure
        return self.sightings.all()

    def close(self) -> None:
        """End the threads of every bus."""
        for bus in self.all():
            bus.close()
        self._buses.clear()
