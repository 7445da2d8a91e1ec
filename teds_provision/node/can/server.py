"""The nodes' end of a CAN bus: one receiving loop for all nodes of the process, and a pool of threads behind it."""

from __future__ import annotations

import functools
import heapq
import itertools
import logging
import random
import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

from teds_provision.errors import LinkError, NoReaderError, TedsProvisionError
from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.isotp import FUNCTIONAL, Pair, Reassembly, addresses, physical_id, read_single, single
from teds_provision.links.can.spec import FIRST_STATION, LAST_NODE, LAST_STATION, parse_spec
from teds_provision.node.can.endpoint import CanEndpoint, EndpointRequest, StationState, link_name
from teds_provision.node.handler import MeasuringHandler, NodeHandler
from teds_provision.node.worker_pool import WorkerPool
from teds_provision.protocol.announce import Announce, is_announce
from teds_provision.protocol.messages.frames import IDENTIFY, Reason, Reply, refusal
from teds_provision.protocol.operation.can_frames import drive_address, trigger_station

# CAN addresses: the nodes of one process, their Announces, and conflicting claims (profile.md, "CAN").
#
# Nothing here is thread-safe: the bus server calls it under its lock.


class EndpointTable:
    """The endpoints of one process by their addresses.

    ``at_time`` runs a job at a moment (monotonic); ``moved`` is called for an endpoint that takes another address,
    before it does; ``notify`` receives messages for people. ``echoes``: the controller gives back what we send.
    """

    def __init__(
        self,
        endpoints: Sequence[CanEndpoint],
        at_time: Callable[[float, Callable[[], None]], None],
        moved: Callable[[CanEndpoint], None],
        notify: Callable[[str], None],
        *,
        echoes: bool,
    ) -> None:
        self._endpoints, self._at_time, self._moved, self._notify, self._echoes = (
            endpoints,
            at_time,
            moved,
            notify,
            echoes,
        )
        self._known: set[int] = set()
        self._at: dict[int, list[CanEndpoint]] = {}
        self._moves_due: dict[CanEndpoint, float] = {}
        self.find()

    def at(self, address: int) -> Sequence[CanEndpoint]:
        """Return the endpoints that have this address; nodes that have just met may be two."""
        return self._at.get(address, ())

    def find(self) -> None:
        """Rebuild the table of addresses."""
        self._at = {}
        for endpoint in self._endpoints:
            self._at.setdefault(endpoint.address, []).append(endpoint)

    def record_use(self, source: int) -> None:
        """Record that an address is in use: a frame came from it."""
        if 1 <= source <= LAST_NODE and source not in self._known:
            self._known.add(source)
            for endpoint in self._endpoints:
                endpoint.claim.hear(source)

    def speaks(self, endpoint: CanEndpoint, identifier: int) -> None:
        """Pass a sent frame of an endpoint to the others of this process, as if received from the bus."""
        source = identifier & 0xFF
        if source not in endpoint.spoken_from:
            endpoint.spoken_from.add(source)
            for other in self._endpoints:
                if other is not endpoint:
                    other.claim.hear(source)

    def announce_all(self) -> None:
        """Schedule every endpoint's Announce after its random wait: the bus is there."""
        for endpoint in self._endpoints:
            endpoint.claim.start(time.monotonic())
            self._announce_when_due(endpoint)

    def announced(self, frame: Frame, speaker: CanEndpoint | None) -> None:
        """Handle an Announce from the bus or from a node of this process (``speaker``)."""
        announce = Announce.decode(frame.identifier, frame.data)
        if announce is None:
            return
        for endpoint in list(self.at(announce.address)):
            own = self._echoes and announce.crc == endpoint.claim.crc  # an echo of our own Announce
            if endpoint is not speaker and not (speaker is None and own):
                self._contested(endpoint, announce)

    def announce_again(self, endpoint: CanEndpoint) -> None:
        """Schedule the Announce of an endpoint that has started again, maybe at another address."""
        self.find()
        endpoint.claim.start(time.monotonic())
        self._announce_when_due(endpoint)

    def _announce_when_due(self, endpoint: CanEndpoint) -> None:
        due = endpoint.claim.due(time.monotonic())
        if due is None:
            return

        def announce() -> None:
            if endpoint.claim.due(due) == due:
                endpoint.announce()

        self._at_time(due, announce)

    def _contested(self, endpoint: CanEndpoint, announce: Announce) -> None:
        now, before, reported = time.monotonic(), endpoint.address, endpoint.claim.conflict
        address = endpoint.claim.handle_announce(announce, before, now, pinned=endpoint.handler.actuator_claimed())
        if (due := endpoint.claim.move_due) is not None and due != self._moves_due.get(endpoint):
            self._moves_due[endpoint] = due
            self._at_time(due, functools.partial(self._give_up_address, endpoint, due))
        if endpoint.claim.conflict and not reported:
            self._notify(
                f"Another node announces the UUID {endpoint.uuid.hex()} (or one of equal CRC-32) "
                f"from the CAN address 0x{before:02x}: disconnect one of them."
            )
        self._go(endpoint, address)

    def _give_up_address(self, endpoint: CanEndpoint, due: float) -> None:
        """Make the move that had to wait, unless the node has left that address meanwhile."""
        if endpoint.claim.move_due == due:
            pinned = endpoint.handler.actuator_claimed()
            self._go(endpoint, endpoint.claim.move(endpoint.address, time.monotonic(), pinned=pinned))

    def _go(self, endpoint: CanEndpoint, address: int) -> None:
        if address != endpoint.address:
            self._moved(endpoint)
            endpoint.move(address)
            self.find()
        self._announce_when_due(endpoint)


_SPREAD_SECONDS: Final = 0.05
_IDLE: Final = 0.02
"""Seconds that the loop waits at most on an interface that cannot be woken."""
_LOOK_ROUND: Final = 0.05
"""Seconds between two looks at transfers that wait for the other side."""
_FLOW_CONTROL: Final = 3
_FIRST_REOPEN, _LAST_REOPEN = 1.0, 30.0
"""Seconds until the node comes back from bus-off, doubling while it recurs (operation.md, section 6)."""
_TOLD: Final = logging.getLogger(__name__)


def _never() -> bool:
    return False


class CanServer:
    """Serves nodes on one CAN bus.

    ``spec_text`` is the value of ``--can``; ``node=`` and ``source=`` mean nothing here, since a node's address is
    ``handler.can_address()`` and every base station is served. ``counts_as_tapped`` returns True if a request from the
    bus counts as one by tap (a node built without NFC, in factory state). ``notify`` receives messages for people.
    """

    def __init__(
        self,
        spec_text: str,
        handler: NodeHandler | None = None,
        *,
        counts_as_tapped: Callable[[], bool] = _never,
        notify: Callable[[str], None] = _TOLD.warning,
    ) -> None:
        self._spec = parse_spec(spec_text)
        self._notify = notify
        self._nodes: list[tuple[NodeHandler, Callable[[], bool], MeasuringHandler | None]] = []
        self._bus: Bus | None = None
        self._workers: WorkerPool | None = None
        self._endpoints: list[CanEndpoint] = []
        self._endpoint_of: dict[int, CanEndpoint] = {}
        self._addresses = self._new_table()
        self._active: set[tuple[CanEndpoint, Pair]] = set()
        self._pushing: set[tuple[CanEndpoint, Pair]] = set()
        self._looked = 0.0
        self._later: list[tuple[float, int, Callable[[], None]]] = []
        self._broadcast_due: dict[StationState, int] = {}
        self._number = itertools.count()
        self._lock = threading.RLock()
        self._sending = threading.Lock()
        self._stop = threading.Event()
        self._wake: socket.socket | None = None
        self._thread: threading.Thread | None = None
        if handler is not None:
            self.add(handler, counts_as_tapped=counts_as_tapped)

    def add(
        self,
        handler: NodeHandler,
        *,
        counts_as_tapped: Callable[[], bool] = _never,
        measuring_handler: MeasuringHandler | None = None,
    ) -> None:
        """Add one more node to this bus, before :meth:`start`; ``measuring_handler`` if it offers operation.md."""
        self._nodes.append((handler, counts_as_tapped, measuring_handler))

    def start(self) -> None:
        """Open the bus and listen; raises NoReaderError or UsageError if it cannot."""
        self._bus = Bus(self._spec)
        self._stop.clear()
        self._workers = WorkerPool()
        self._active, self._pushing, self._later, self._broadcast_due = set(), set(), [], {}
        self._endpoints = [
            CanEndpoint(node, tapped, self._workers, self._out, more) for node, tapped, more in self._nodes
        ]
        self._endpoint_of = {id(endpoint.handler): endpoint for endpoint in self._endpoints}
        self._addresses = self._new_table()
        self._addresses.announce_all()
        self._wake, woken = socket.socketpair()
        self._thread = threading.Thread(target=self._serve, args=(woken,), name="can", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Close the bus and end the state of every station; never raises."""
        self._stop.set()
        if self._thread is not None and self._wake is not None:
            self._wake.close()  # the loop notices this at once
            self._thread.join(timeout=3)
            self._thread = None
        if self._workers is not None:
            self._workers.end()
            self._workers = None
        for endpoint in self._endpoints:
            for state in endpoint.stations.values():
                state.restart()
        self._endpoints = []
        self._addresses = self._new_table()
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def _new_table(self) -> EndpointTable:
        echoes = bool(dict(self._spec.options).get("receive_own_messages"))
        return EndpointTable(self._endpoints, self._at_time, self._moves, self._notify, echoes=echoes)

    def _moves(self, endpoint: CanEndpoint) -> None:
        """End what is under way from an endpoint's old address."""
        for pairs in (self._active, self._pushing):
            pairs.difference_update([entry for entry in pairs if entry[0] is endpoint])

    def send_data(self, handler: NodeHandler, identifier: int, data: bytes, *, fd: bool) -> None:
        """Put a data frame of a node on the bus; raises LinkError if that is lost.

        The bus may take its time over it: frames of others are received meanwhile.
        """
        with self._lock:
            endpoint, bus = self._endpoint_of.get(id(handler)), self._bus
            if endpoint is None or bus is None or self._stop.is_set():
                return
            self._addresses.speaks(endpoint, identifier)
        with self._sending:
            bus.send(Frame(identifier, data, fd))

    def restarted(self, handler: NodeHandler) -> None:
        """Begin again with a node that has restarted."""
        with self._lock:
            endpoint = self._endpoint_of.get(id(handler))
            if endpoint is None or self._stop.is_set():
                return
            self._moves(endpoint)
            endpoint.restart()
            self._addresses.announce_again(endpoint)

    def announce_press(self, handler: NodeHandler) -> None:
        """Announce at once that a node's button was pressed."""
        with self._lock:
            if (endpoint := self._endpoint_of.get(id(handler))) is not None:
                self._at_time(time.monotonic(), endpoint.announce_press)

    # -- the loop --------------------------------------------------------------------------------------------------

    def _serve(self, woken: socket.socket) -> None:
        with woken:
            reopen, came_back = _FIRST_REOPEN, time.monotonic()
            while not self._stop.is_set():
                try:
                    self._serve_one(woken)
                except LinkError:
                    with self._lock:
                        self._lose_stations()
                    if time.monotonic() - came_back > 2 * _LAST_REOPEN:
                        reopen = _FIRST_REOPEN
                    self._reopen(reopen)
                    reopen, came_back = min(2 * reopen, _LAST_REOPEN), time.monotonic()

    def _serve_one(self, woken: socket.socket) -> None:
        assert self._bus is not None
        frame = self._bus.receive(0.0 if self._bus.can_be_waited_for else self._wait())
        if frame is None and self._bus.can_be_waited_for:
            self._bus.wait(self._wait(), woken)
            frame = self._bus.receive(0.0)
        with self._lock:
            if frame is not None:
                self._dispatch(frame)
            now = time.monotonic()
            while self._later and self._later[0][0] <= now:
                heapq.heappop(self._later)[2]()
            self._run_transfers(now)

    def _wait(self) -> float:
        """Return the seconds until a consecutive frame, an answer to a broadcast or an Announce is due."""
        with self._lock:
            wait = _IDLE
            for _, pair in self._pushing:
                wait = pair.due_in(wait)
            if self._later:
                wait = min(wait, max(0.0, self._later[0][0] - time.monotonic()))
            return wait

    def _run_transfers(self, now: float) -> None:
        """Send the consecutive frames that are due; check messages that wait for flow control now and then."""
        look_round = now - self._looked >= _LOOK_ROUND
        if look_round:
            self._looked = now
        for endpoint, pair in list(self._active if look_round else self._pushing):
            if look_round or pair.due_in(1.0) <= 0:
                pair.run()
                self._schedule(endpoint, pair)

    def _schedule(self, endpoint: CanEndpoint, pair: Pair) -> None:
        """Look after a pair while a message of either side is under way, and closely while we send."""
        for pairs, belongs in (
            (self._active, pair.sending or pair.receiving),
            (self._pushing, pair.sending and not pair.waits_for_flow),
        ):
            if belongs:
                pairs.add((endpoint, pair))
            else:
                pairs.discard((endpoint, pair))
        state = endpoint.stations.get(pair.peer)
        if state is not None and state.replying is pair and not pair.sending:
            endpoint.reply_sent(state)

    def _at_time(self, due: float, job: Callable[[], None]) -> None:
        heapq.heappush(self._later, (due, next(self._number), job))

    def _out(self, endpoint: CanEndpoint, frame: Frame) -> None:
        """Put a node's frame on the bus."""
        assert self._bus is not None
        with self._sending:
            self._bus.send(frame)
        self._addresses.speaks(endpoint, frame.identifier)
        if is_announce(frame.identifier):
            self._addresses.announced(frame, endpoint)

    # -- frames ----------------------------------------------------------------------------------------------------

    def _dispatch(self, frame: Frame) -> None:
        source = frame.identifier & 0xFF
        self._addresses.record_use(source)
        if is_announce(frame.identifier):
            self._addresses.announced(frame, None)
        elif FIRST_STATION <= source <= LAST_STATION:
            self._from_station(source, frame)

    def _from_station(self, station: int, frame: Frame) -> None:
        if frame.identifier & 0x1FFFFF00 == FUNCTIONAL:
            body = read_single(frame.data)
            if body is not None and body[1:] == IDENTIFY.encode():  # the only command that is answered to a broadcast
                for endpoint in self._endpoints:
                    self._on_broadcast(endpoint, station, body[:1], fd=frame.fd)
            return
        ends = addresses(frame.identifier)
        if ends is None:
            self._measuring_frame(station, frame)
            return
        own = ends[0]
        for endpoint in self._addresses.at(own):
            state, pair = endpoint.pair(station, own)
            self._command_frame(endpoint, state, pair, frame)
        if frame.data and frame.data[0] >> 4 == _FLOW_CONTROL:
            # A reply in progress from the address before 128.10 still needs its flow control.
            for endpoint, pair in list(self._active):
                if pair.own == own and pair.peer == station and endpoint.address != own and pair.sending:
                    pair.handle_frame(frame)
                    self._schedule(endpoint, pair)

    def _command_frame(self, endpoint: CanEndpoint, state: StationState, pair: Pair, frame: Frame) -> None:
        begun = Reassembly.begin(pair.peer, frame)
        if begun is not None and begun.length > endpoint.max_message + 1:  # refused instead of flow control
            answer = single(bytes(begun.octets[:1]) + refusal(Reason.TOO_LARGE).encode(), fd=frame.fd)
            self._out(endpoint, Frame(physical_id(pair.peer, pair.own), answer, frame.fd))
            return
        pair.handle_frame(frame)
        while (body := pair.received()) is not None:
            if pair.waits_for_flow:
                pair.stop_sending()  # a new request from this station means that it no longer waits for that answer
            received = endpoint.measuring_handler.tick(frame.at) if endpoint.measuring_handler is not None else 0
            state.put(functools.partial(self._run_request, state, pair, EndpointRequest(body, frame.fd, received)))
        self._schedule(endpoint, pair)

    def _measuring_frame(self, station: int, frame: Frame) -> None:
        """Handle a trigger, whose tick is that of its arrival for every node, or a Drive frame."""
        if trigger_station(frame.identifier) == station:
            nodes = [
                endpoint.measuring_handler for endpoint in self._endpoints if endpoint.measuring_handler is not None
            ]
            for node, tick in [(node, node.tick(frame.at)) for node in nodes]:
                node.trigger(link_name(station), frame.data, tick)
        elif (address := drive_address(frame.identifier)) is not None:
            for endpoint in self._addresses.at(address.node):
                if endpoint.measuring_handler is not None:
                    endpoint.measuring_handler.drive(link_name(station), frame.data)

    def _run_request(self, state: StationState, pair: Pair, request: EndpointRequest) -> None:
        """Run one request in its station's queue; VirtualNode lets one command run at a time.

        The reply is sent from the address of the request.
        """
        try:
            reply = state.answer(request)
        except TedsProvisionError:
            return  # a node that fails (its flash file is gone) does not reply
        finally:
            with self._lock:
                state.waiting -= 1
        with self._lock:
            if state.endpoint.address != state.endpoint.handler.can_address():  # command 128.10 changed it
                state.endpoint.address = state.endpoint.handler.can_address()
                state.endpoint.claim.relocated()
                self._addresses.find()
            if self._stop.is_set() or state.gone or state.pairs.get(pair.own) is not pair:
                return  # the station was lost meanwhile
            self._end_broadcast_answer(state, pair)
            try:
                pair.send(reply)
            except LinkError:
                return  # the reading thread gets the same failure and handles it
            state.replying = pair
            self._schedule(state.endpoint, pair)

    # -- broadcasts ------------------------------------------------------------------------------------------------

    def _on_broadcast(self, endpoint: CanEndpoint, station: int, transaction: bytes, *, fd: bool) -> None:
        """Answer a functional Identify after a random wait; a newer one of the same station takes its place."""
        own = endpoint.address
        state, _ = endpoint.pair(station, own)
        number = self._broadcast_due[state] = next(self._number)

        def answer() -> None:
            if self._broadcast_due.get(state) != number or state.gone or endpoint.address != own:
                return
            if state.replying is not None:
                # A reply ends within N_Bs even if its station was killed. Do not queue answers behind it: each would
                # wait for the one before, and the station drops answers to an older broadcast.
                self._at_time(time.monotonic() + _SPREAD_SECONDS, answer)
                return
            del self._broadcast_due[state]
            self._answer_broadcast(endpoint, station, own, transaction, fd=fd)

        self._at_time(time.monotonic() + self._spread(), answer)

    def _spread(self) -> float:
        """Return the seconds to wait before an answer to a broadcast."""
        return random.uniform(0, _SPREAD_SECONDS)

    def _answer_broadcast(self, endpoint: CanEndpoint, station: int, own: int, transaction: bytes, *, fd: bool) -> None:
        """Send the answer; the stored reply stays, and no reply of this station is under way."""
        state, pair = endpoint.pair(station, own)
        self._end_broadcast_answer(state, pair)
        pair.speak(fd=fd)
        pair.send(transaction + Reply(True, endpoint.handler.identify()).encode())
        self._schedule(endpoint, pair)

    def _end_broadcast_answer(self, state: StationState, pair: Pair) -> None:
        """Abandon a broadcast answer without flow control; a reply to this station alone is kept."""
        if pair.waits_for_flow and state.replying is not pair:
            pair.stop_sending()

    # -- losses ----------------------------------------------------------------------------------------------------

    def _lose_stations(self) -> None:
        self._active.clear()
        self._pushing.clear()
        self._later.clear()
        self._broadcast_due.clear()
        for endpoint in self._endpoints:
            endpoint.lose_stations()

    def _reopen(self, seconds: float) -> None:
        if self._bus is not None:
            self._bus.close()
        while not self._stop.wait(seconds):
            try:
                self._bus = Bus(self._spec)
            except (LinkError, NoReaderError):
                continue
            with self._lock:
                self._addresses.announce_all()
            return
