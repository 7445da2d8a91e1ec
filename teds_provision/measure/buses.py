"""The links of this process with streams, each read and searched by one thread for all its measurements.

Measurements, detection and commands share them: they are opened once, and closed when the process ends.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from types import TracebackType

from teds_provision.errors import LinkError
from teds_provision.links.discovery import Sighting, SightingSink
from teds_provision.links.streaming import MeasuringLink
from teds_provision.measure.planning import BusShare, BusTime
from teds_provision.measure.presence import Presence
from teds_provision.measure.stream_receiver import HearingThread


class MeasuredBus:
    """One link that carries data: its ``port``, the thread that receives data messages, its load, and its nodes."""

    def __init__(self, port: MeasuringLink, sightings: SightingSink, *, poll: float | None) -> None:
        self.port = port
        self.hearing = HearingThread(port)
        self.share = BusShare(BusTime(port.airtime()), others=lambda: port.others_load)
        self.discovery = port.discover(sightings, poll=poll)
        self.reading = threading.Lock()
        """Held while a datasheet is read in the background of a measurement: one node at a time."""
        self.beginning: set[bytes] = set()
        """Nodes that are on their way from Open to their first stream; each is put in and taken out by its thread."""

    @property
    def place(self) -> str:
        """As the port names it."""
        return self.port.place

    def close(self) -> None:
        """End its threads; the port stays open."""
        self.discovery.close()
        self.hearing.close()

    def time_for(self, time: BusTime, node: int) -> BusTime:
        """Return the time of this link as a node has it: over the air its connection has an MTU."""
        return replace(time, airtime=self.port.airtime(node))


class Buses:
    """All of them; ``with Buses(ports) as buses:`` ends their threads. The caller closes the ports.

    ``news`` is called with each node that answers, from the discovery's thread.
    """

    def __init__(
        self,
        ports: Iterable[MeasuringLink] = (),
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

    def add(self, port: MeasuringLink) -> MeasuredBus:
        """Hear one more bus; one that was opened again replaces its closed port."""
        known = self._buses.get(port.place)
        if known is not None and known.port is port:
            return known
        if known is not None:
            known.close()
        made = self._buses[port.place] = MeasuredBus(port, self.presence, poll=self._poll)
        return made

    def all(self) -> Sequence[MeasuredBus]:
        """Return every bus."""
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
        """Send a broadcast on every bus; return the nodes seen so far. Skips failed buses; raises if all failed."""
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
