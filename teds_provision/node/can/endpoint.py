"""One node on a CAN bus: a StationState for each base station, its answer to broadcasts, its Announces.

Nothing here is thread-safe: the server of the bus calls it under its lock; only :meth:`StationState.answer` and
:meth:`StationState.restart` run in the jobs of its station.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final, NamedTuple

from teds_provision.links.can.bus import Frame
from teds_provision.links.can.isotp import Pair
from teds_provision.node.handler import MeasuringHandler, NodeHandler
from teds_provision.node.worker_pool import JobQueue, WorkerPool
from teds_provision.protocol.announce import AddressClaim, Announce, ButtonPresses, uuid_crc
from teds_provision.protocol.messages.identity import Identity
from teds_provision.protocol.repetition import Repetition

_MOST_WAITING: Final = 4
"""Requests of one station in the queue: a well-behaved one waits for each reply, so that more are of no use to it."""


BUS: Final = "can"
"""The part before the colon in the names of links: streams of one bus share a node's budget."""


def link_name(station: int) -> str:
    """Name of the link to a station, as sessions hang on it."""
    return f"{BUS}:{station:02x}"


class EndpointRequest(NamedTuple):
    """A whole request: transaction ‖ command; whether it came by CAN FD, and its tick (0 for a node without clock)."""

    body: bytes
    fd: bool
    received: int


class StationState:
    """One base station's link to one node: its session (by name) and stored reply.

    A link is one pair of addresses: with a new own address it starts over. ``pairs`` keeps the old Pair as long as it
    still sends.
    """

    def __init__(self, endpoint: CanEndpoint, station: int, jobs: JobQueue) -> None:
        self.endpoint, self.station, self.jobs = endpoint, station, jobs
        self.name = link_name(station)
        self.pairs: dict[int, Pair] = {}
        self.waiting = 0
        self.gone = False
        self.replying: Pair | None = None
        self._repetition = Repetition()

    def put(self, job: Callable[[], None]) -> None:
        """Queue a request; if a station sends too many without waiting for replies, the excess is dropped."""
        if self.waiting < _MOST_WAITING:
            self.waiting += 1
            self.jobs.put(job)

    def restart(self) -> None:
        """Start over: the pair of addresses is another one, or the bus was lost; session and stored reply are gone."""
        self._repetition.forget()
        self.endpoint.handler.lost(self.name)

    def reply_sent(self) -> None:
        """Handle that the reply is sent, or was abandoned: from now on it is kept for a repeated request."""
        self.replying = None
        self._repetition.reply_sent(time.monotonic())

    def answer(self, request: EndpointRequest) -> bytes:
        """Run a request and return transaction ‖ reply; raises what the node raises."""
        endpoint, body = self.endpoint, request.body

        def run(frame: bytes) -> bytes:
            tapped = endpoint.counts_as_tapped()
            if endpoint.measuring_handler is None:
                return endpoint.handler.request(self.name, frame, tapped=tapped)
            return endpoint.measuring_handler.request_received(
                self.name, frame, tapped=tapped, fd=request.fd, received=request.received
            )

        return body[:1] + self._repetition.answer(body[0], body[1:], run, now=time.monotonic())


class CanEndpoint:
    """One node on the bus. ``send`` puts one of its frames on the bus; ``claim`` is created at each start."""

    def __init__(
        self,
        handler: NodeHandler,
        counts_as_tapped: Callable[[], bool],
        workers: WorkerPool,
        send: Callable[[CanEndpoint, Frame], None],
        measuring_handler: MeasuringHandler | None = None,
    ) -> None:
        self.handler, self.counts_as_tapped, self._workers = handler, counts_as_tapped, workers
        self._send = send
        self.measuring_handler = measuring_handler
        self.address = handler.can_address()
        identity = Identity.decode(handler.identify())
        self.uuid, self.max_message = identity.uuid, identity.max_message
        self.claim = AddressClaim(uuid_crc(identity.uuid))
        self._presses = ButtonPresses()
        self.stations: dict[int, StationState] = {}
        self.spoken_from: set[int] = set()

    def announce(self) -> None:
        """Announce the present address."""
        self._send_announce(pressed=False)
        self.claim.announced(time.monotonic())

    def announce_press(self) -> None:
        """Announce that the button was pressed, unless that was done a moment ago."""
        if self._presses.may_announce(time.monotonic()):
            self._send_announce(pressed=True)

    def _send_announce(self, *, pressed: bool) -> None:
        state = Identity.decode(self.handler.identify()).state
        announce = Announce(self.address, state, self.claim.crc, pressed)
        self._send(self, Frame(announce.identifier, announce.encode()))

    def pair(self, station: int, own: int) -> tuple[StationState, Pair]:
        """Return the pair of ``own`` and ``station``, made if there is none yet."""
        state = self.stations.get(station)
        if state is None:
            state = self.stations[station] = StationState(self, station, self._workers.new_queue())
        pair = state.pairs.get(own)
        if pair is None:
            if state.pairs:
                state.jobs.put(state.restart)
            state.pairs = {at: old for at, old in state.pairs.items() if old.sending}
            pair = state.pairs[own] = Pair(own, station, lambda frame: self._send(self, frame))
        return state, pair

    def reply_sent(self, state: StationState) -> None:
        """Handle that the reply on this link is sent, or was abandoned: data may follow."""
        state.reply_sent()
        if self.measuring_handler is not None:
            self.measuring_handler.reply_sent(state.name)

    def move(self, address: int) -> None:
        """Have another address from now on, because another node claimed this one: sessions of the old one end."""
        self.handler.take_can_address(address)
        self.address = address
        for state in self.stations.values():
            if state.pairs:
                state.pairs.clear()
                state.jobs.put(state.restart)

    def restart(self) -> None:
        """Begin again as after a start of the board: at the durable address, without sessions."""
        self.address = self.handler.can_address()
        self.claim = AddressClaim(self.claim.crc)
        self._presses = ButtonPresses()
        self.lose_stations()

    def lose_stations(self) -> None:
        """Drop sessions and stored replies: the bus is gone."""
        stations, self.stations = self.stations, {}
        for state in stations.values():
            state.gone = True
            state.jobs.put(state.restart)
