"""The station's port on a CAN bus: finds nodes by Identify, exchanges messages with many, and serves listeners."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import partial
from shlex import quote
from typing import Final

from teds_provision.errors import AddressConflictError, LinkClosedError, LinkError, NoNodeError
from teds_provision.links.can.airtime import CanAirtime
from teds_provision.links.can.arrivals import Arrivals
from teds_provision.links.can.bus import Bus
from teds_provision.links.can.bus_multiplexer import BusMultiplexer, Listener
from teds_provision.links.can.data_streams import CanStreams, rival_measures
from teds_provision.links.can.discovery import CanDiscovery
from teds_provision.links.can.identify_broadcast import (
    LONGEST_SECONDS,
    SILENCE_SECONDS,
    FunctionalAnswers,
    ask_all,
    ask_one,
    ask_unclear_again,
    conflict_text,
    twice_text,
    unfinished_text,
)
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.link import CanLink, conflict
from teds_provision.links.can.spec import LAST_NODE, CanSpec, parse_spec
from teds_provision.links.discovery import SightingSink
from teds_provision.links.ports import CAN, Capabilities, Contact, ContactSink, Notice, NoticeSink, Trace
from teds_provision.links.streaming import DataListener, MeasuringLink, StreamPieces
from teds_provision.protocol.announce import uuid_crc
from teds_provision.protocol.messages.identity import Identity
from teds_provision.protocol.operation.can_frames import DriveAddress, cut, trigger_identifier

_HELLO_SECONDS: Final = 1.0
_GUESS_SECONDS: Final = 0.1
"""Seconds to wait for a node at its last address before all are asked."""
_MANY: Final = 8
_ROUNDS_OF_MANY: Final = 3
"""Number of answers from which all are asked again until no new one answers.

A lost first frame of an answer leaves no trace of its node, and is likelier with each node more.
"""
_ROUND_SECONDS: Final = 1.0
_BUSY_SECONDS: Final = 1.5
"""Seconds that a node may take for its answer when nodes are collected: a key agreement blocks a small one."""
_REOPEN_SECONDS: Final = 1.0


_Shown = Callable[[int, Identity], object]


def _ignore(*_: object) -> None:
    """Show no node."""


def _patience(left: float, known: int) -> float:
    """Return the seconds of silence after which the answers to a broadcast count as complete.

    ``left`` are the seconds until the search may end. If many nodes are ``known``, leave time for a last broadcast: the
    first frame of an answer may have been lost, and a node may have started meanwhile.
    """
    if known >= _MANY and left > 2 * SILENCE_SECONDS:
        left -= SILENCE_SECONDS
    return max(SILENCE_SECONDS, min(_BUSY_SECONDS, left))


def open_port(where: str, trace: Trace | None = None) -> CanPort:
    """Open the bus that ``where`` names, as ``--can`` does; raises NoReaderError, UsageError."""
    return CanPort(where, trace)


class CanPort(MeasuringLink):
    """Finds nodes on one CAN bus, and measures; see ``links.ports.Port``.

    ``spec_text`` is the value of ``--can``. Thread-safe.
    """

    via = "can"
    poll_seconds = 30.0

    def __init__(self, spec_text: str, trace: Trace | None = None) -> None:
        self.spec = parse_spec(spec_text)
        self.place = f"can:{spec_text}"
        self.trace = trace
        self._bus: BusMultiplexer | None = BusMultiplexer(Bus(self.spec, trace))
        self._closed = False
        self._transaction = secrets.randbelow(256)
        self._lock = threading.Lock()
        self._rival_reported = False
        self._streams = CanStreams()

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of a bus."""
        return CAN

    def bus(self) -> BusMultiplexer:
        """Return the open bus with its receiving loop; opens it again after it was lost.

        Raises LinkClosedError after :meth:`close`: another thread may still be talking to a node, and must end.
        """
        with self._lock:
            if self._closed:
                raise LinkClosedError(f"The bus {self.spec.text} was closed.")
            if self._bus is None or self._bus.failed:
                if self._bus is not None:
                    self._bus.close()
                    self._bus = None
                self._bus = BusMultiplexer(Bus(self.spec, self.trace))
            return self._bus

    def use_source(self, source: int) -> None:
        """Use another source address from now on; the bus is opened again at its next use."""
        self._release()
        self.spec = replace(self.spec, source=source)

    def listen_frames(self, wanted: Callable[[Frame], bool]) -> Listener:
        """Hear every frame for which ``wanted`` is true; see BusMultiplexer."""
        return self.bus().listen(wanted)

    def send(self, frame: Frame) -> None:
        """Put one frame on the bus; raises LinkError."""
        self.bus().send(frame)

    def link(self, node: int) -> CanLink:
        """Return the link to the node at this address, whichever it is."""
        return CanLink(self.bus, self.next_transaction, node)

    def contact(self, node: int, identity: Identity) -> Contact:
        """Return a contact with the node at this address."""
        pressed = partial(self.bus().presses.marks, node, uuid_crc(identity.uuid))
        return Contact(identity, self.link(node), address=node, trace=self.trace, bus=self.place, pressed=pressed)

    def next_transaction(self) -> int:
        """Return a transaction number, 0 to 255; the first of a process is random."""
        with self._lock:
            self._transaction = (self._transaction + 1) & 0xFF
            return self._transaction

    def close(self) -> None:
        """Release the bus; never raises. An exchange of another thread ends with LinkClosedError."""
        with self._lock:
            self._closed = True
        self._release()

    def _release(self) -> None:
        with self._lock:
            bus, self._bus = self._bus, None
        if bus is not None:
            bus.close()

    def identify(
        self, node: int, *, seconds: float = _HELLO_SECONDS, until_announced: bool = False, once: bool = False
    ) -> Identity | None:
        """Ask one address for Identify; None if there is no answer. Raises AddressConflictError, LinkError.

        ``until_announced``: stop as soon as a node announces itself there, since it missed the request; a caller
        that asks because of the Announce need not wait for this one.
        ``once``: send one question, even if frames of its answer are missing.
        """
        link = self.link(node)
        if until_announced:
            link.hopeless = partial(self.bus().announced_since, node, time.monotonic())
        return ask_one(partial(link.exchange_limited, tries=1, seconds=seconds), questions=1 if once else 2)

    # -- measuring and acting --------------------------------------------------------------------------------------

    def open_stream(self, node: int, stream: int, length: int) -> StreamPieces:
        """Take data messages of a stream from now on; see MeasuringLink."""
        return self._streams.open(node, stream, length, fd=self.spec.fd)

    def close_stream(self, node: int, stream: int) -> None:
        """Take them no more."""
        self._streams.close(node, stream)

    def listen(self) -> AbstractContextManager[DataListener]:
        """Hear the data messages for this station; opens the bus again after it was lost."""
        return self._streams.listen(self.bus())

    def airtime(self, node: int | None = None) -> CanAirtime:
        """Return the airtime of the bus: it is the same for every node."""
        del node
        return CanAirtime(self.spec.bitrate, self.spec.data_bitrate if self.spec.fd else None)

    @property
    def others_load(self) -> float:
        """Share of the bus that data for other stations takes now; 0 while the bus is not open."""
        bus = self._bus
        return bus.other_stations.load if bus is not None else 0.0

    def drive(self, node: int, message: bytes) -> None:
        """Send a Drive message; raises LinkError."""
        identifier = DriveAddress(node, self.spec.source).identifier
        for piece in cut(message, fd=self.spec.fd, drive=True):
            self.send(Frame(identifier, piece.data, self.spec.fd))

    def trigger(self, token: bytes) -> bool:
        """Send the trigger frame; raises LinkError."""
        self.send(Frame(trigger_identifier(self.spec.source), token))
        return True

    def discover(self, sightings: SightingSink, *, poll: float | None = None) -> CanDiscovery:
        """Begin to find nodes: by announcements, and by a broadcast now and then."""
        return CanDiscovery(self, sightings, poll=poll)

    @property
    def shared_bus(self) -> CanSpec:
        """The bus as it was named, with this station's address."""
        return self.spec

    def require_sole_source(self) -> None:
        """Raise AddressConflictError if data comes for our address, and another station sends from it."""
        bus = self.bus()
        if rival_measures(bus):
            raise AddressConflictError(bus.conflicts.text, hint=bus.conflicts.hint)

    # -- finding ---------------------------------------------------------------------------------------------------

    def find(
        self, wanted: Callable[[Identity], bool], *, seconds: float, notice: NoticeSink, address: int | None = None
    ) -> Contact:
        """Return the node for which ``wanted`` holds: at ``address`` or ``node=``, else whichever answers first.

        Raises NoNodeError after ``seconds``, AddressConflictError when two nodes answer under one address and the
        wanted one is not found elsewhere, LinkError when the bus fails.
        """
        until = time.monotonic() + seconds
        reported: set[bytes] = set()
        notice(Notice("waiting", f"Looking for the node on {self.spec.text}.", seconds))
        if self.spec.node is None and address is not None and 1 <= address <= LAST_NODE:
            # Ask at the node's last address first: unlike a broadcast, this has no random delay.
            identity = self.identify(address, seconds=_GUESS_SECONDS)
            guessed = self.contact(address, identity) if identity is not None and wanted(identity) else None
            if guessed is not None:
                return guessed
        while (left := until - time.monotonic()) > 0:
            round_ends = time.monotonic() + min(_ROUND_SECONDS, left)
            if self.spec.node is not None:
                contact = self._at(self.spec.node, wanted, notice, reported)
            else:
                contact = self._among_all(wanted, left, notice, reported)
            if contact is not None:
                return contact
            time.sleep(max(0.0, round_ends - time.monotonic()))
        raise self._nobody(seconds, reported)

    def _nobody(self, seconds: float, reported: set[bytes]) -> NoNodeError:
        where = f"at 0x{self.spec.node:02X} on {self.spec.text}" if self.spec.node else f"on {self.spec.text}"
        others = f"; others did: {', '.join(sorted(uuid.hex() for uuid in reported))}" if reported else ""
        return NoNodeError(
            f"The node did not answer {where} within {seconds:g} s{others}.",
            hint="Check its power, the bit rate and the address; teds-provision identify --via can lists the"
            " nodes that answer.",
        )

    def find_all(self, *, seconds: float, notice: NoticeSink, listen: float = 0.0) -> list[Contact]:
        """Return every node that answers a broadcast: for identify and provision.

        Listens until 300 ms of silence, 3 s at most, and then sends an Identify to each address whose answer was torn;
        unclear ones are reported through ``notice``. With ``listen``, broadcasts are repeated for that time, with 1.5 s
        for each answer: a node may be busy with another station, or still starting. Raises NoNodeError after
        ``seconds``, AddressConflictError, LinkError.
        """
        return self.find_all_early(seconds=seconds, notice=notice, listen=listen, seen=_ignore)

    def find_all_early(self, *, seconds: float, notice: NoticeSink, listen: float, seen: ContactSink) -> list[Contact]:
        """Return every node as :meth:`find_all`, and show each as soon as it has answered; see ``EarlyFinder``."""
        began = time.monotonic()
        until, enough = began + seconds, began + min(listen, seconds)
        notice(Notice("waiting", f"Asking every node on {self.spec.text}.", seconds))
        found, reported = FunctionalAnswers(), set[str]()
        answered = set[int]()

        def show(node: int, identity: Identity) -> None:
            if node not in answered:
                answered.add(node)
                seen(self.contact(node, identity))

        def once(shown: Notice) -> None:
            if shown.text not in reported:
                reported.add(shown.text)
                notice(shown)

        while self.spec.node is None and (left := until - time.monotonic()) > 0:
            silence = _patience(enough - time.monotonic(), len(found.identities))
            found = self._broadcast(found, min(LONGEST_SECONDS, left), once, silence, show)
            if found.conflicts:
                raise conflict(min(found.conflicts))
            if found.identities and time.monotonic() >= enough:
                break
        if found.identities:
            return [self.contact(node, identity) for node, identity in sorted(found.identities.items())]
        if self.spec.node is None:
            raise NoNodeError(
                f"No node answered on {self.spec.text} within {seconds:g} s.",
                hint="Check the nodes' power, the wiring, both terminators and the bit rate; to test the adapter:"
                f" teds-provision doctor --can {quote(self.spec.text)}",
            )
        return [self.find(lambda _: True, seconds=seconds, notice=notice)]

    def _broadcast(
        self, known: FunctionalAnswers, longest: float, notice: NoticeSink, silence: float, show: _Shown
    ) -> FunctionalAnswers:
        """Ask all nodes, of many until no new one answers; return ``known`` with those that answered."""
        began = time.monotonic()
        found = known
        for number in range(_ROUNDS_OF_MANY):
            before = len(found.identities)
            found = found.combined_with(self._asked_once(longest, SILENCE_SECONDS if number else silence, show))
            count = len(found.identities)
            if count < _MANY or count == before or time.monotonic() - began >= longest:
                break
        found = self.settled(found, began + LONGEST_SECONDS + _HELLO_SECONDS)
        if found.unfinished:
            notice(Notice("unfinished", unfinished_text(found.unfinished)))
        for uuid, addresses in found.duplicates.items():
            notice(Notice("conflict", twice_text(uuid, addresses)))
        self.report_rivals(notice)
        return found

    def _asked_once(
        self, longest: float, silence: float = SILENCE_SECONDS, show: _Shown = _ignore
    ) -> FunctionalAnswers:
        found = FunctionalAnswers()
        for news in ask_all(self.bus(), self.next_transaction(), silence=silence, longest=longest):
            if isinstance(news, FunctionalAnswers):
                found = news
            else:
                show(*news)
        return found

    def settled(self, found: FunctionalAnswers, until: float) -> FunctionalAnswers:
        """Check unclear answers again: apparent conflicts by another broadcast.

        A late reply to another station, by chance with our transaction number, looks like a second node; but it comes
        only once, while a second node answers each time.
        """
        left = until - time.monotonic()
        if found.conflicts and left > 0:
            found = found.cleared_by(self._asked_once(min(LONGEST_SECONDS, left)))
        return ask_unclear_again(found, self.identify, until=until)

    def watch(self, *, stop: threading.Event, notice: NoticeSink) -> Iterator[Contact]:
        """Yield each node once: when it first answers, when it comes back, and when it is in factory state again.

        The first that answers is yielded while others still answer. An Announce brings a node at once.
        """
        arrivals = Arrivals(self, notice)
        notice(Notice("waiting", f"Watching {self.spec.text} for nodes."))
        lost = False
        while not stop.is_set():
            try:
                for address, identity in arrivals.round(stop):
                    if lost:
                        lost = False
                        notice(Notice("reader-ready", f"The bus {self.spec.text} is back."))
                    yield self.contact(address, identity)
                    if stop.is_set():
                        return
                if lost:
                    lost = False
                    notice(Notice("reader-ready", f"The bus {self.spec.text} is back."))
                arrivals.pause(stop)
                for uuid in arrivals.pressed():
                    notice(Notice("pressed", f"Node {uuid.hex()} says it was pressed.", uuid=uuid))
            except LinkError as error:
                arrivals.lost()
                if not lost:
                    lost = True
                    notice(Notice("reader-lost", f"{error.message} Waiting for it."))
                stop.wait(_REOPEN_SECONDS)

    def report_rivals(self, notice: NoticeSink) -> None:
        """Report another station under our source address, once."""
        rivals = self.bus().conflicts
        if not self._rival_reported and rivals.seen_within():
            self._rival_reported = True
            notice(Notice("conflict", f"{rivals.text} {rivals.hint}"))

    def _at(
        self, node: int, wanted: Callable[[Identity], bool], notice: NoticeSink, reported: set[bytes]
    ) -> Contact | None:
        """Ask one address who is there."""
        identity = self.identify(node)
        if identity is None:
            return None
        if wanted(identity):
            return self.contact(node, identity)
        _report_unwanted(notice, reported, node, identity)
        return None

    def _among_all(
        self, wanted: Callable[[Identity], bool], seconds: float, notice: NoticeSink, reported: set[bytes]
    ) -> Contact | None:
        """Send a broadcast; ends with the first answer that is wanted."""
        found = FunctionalAnswers()
        for news in ask_all(
            self.bus(), self.next_transaction(), silence=SILENCE_SECONDS, longest=min(LONGEST_SECONDS, seconds)
        ):
            if isinstance(news, FunctionalAnswers):
                found = news
            elif wanted(news[1]):
                return self.contact(*news)
        found = self.settled(found, time.monotonic() + min(LONGEST_SECONDS, seconds))
        for node in sorted(found.conflicts):
            notice(Notice("conflict", conflict_text(node)))
        for node, identity in sorted(found.identities.items()):
            if wanted(identity):
                return self.contact(node, identity)
            _report_unwanted(notice, reported, node, identity)
        self.report_rivals(notice)
        if found.conflicts:
            raise conflict(min(found.conflicts))
        return None


def _report_unwanted(notice: NoticeSink, reported: set[bytes], node: int, identity: Identity) -> None:
    if identity.uuid not in reported:
        reported.add(identity.uuid)
        text = f"Node {identity.uuid.hex()} answers at 0x{node:02X}, but it is not the node that was requested."
        notice(Notice("foreign-tag", text))
