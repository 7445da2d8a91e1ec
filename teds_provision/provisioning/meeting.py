"""Meeting a node: open the port that the user chose, wait for the node, talk, and leave everything closed."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

from teds_provision.errors import (
    AddressConflictError,
    NoNodeError,
    NoReaderError,
    StoreLockedError,
    TedsProvisionError,
    UsageError,
    VaultLockedError,
)
from teds_provision.links import Contact, LinkSettings, Notice, open_place, open_port, open_ports
from teds_provision.links.ports import NoticeSink, Port
from teds_provision.links.streaming import MeasuringLink
from teds_provision.protocol.announce import default_can_address
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.provisioning.progress import Reporter
from teds_provision.station.station import Station
from teds_provision.station.store.records import utc_now

_log = logging.getLogger(__name__)
_SHOWN = 5
_TRY_SECONDS = 1.5
"""Seconds to search the last known bus before waiting for a tap (one broadcast round plus margin)."""
_GLANCE_SECONDS = 0.4
"""Seconds to look at a configured reader before searching a bus: a node that is on it answers at once."""


@contextmanager
def meet(
    station: Station,
    links: LinkSettings,
    uuid: bytes | None,
    reporter: Reporter,
    *,
    before: Callable[[], object] = lambda: None,
) -> Iterator[Conversation]:
    """Wait for node ``uuid`` (None: any node) on the chosen link and yield a conversation with it.

    Of several nodes on a bus it selects the only one that is not finished yet. ``before`` is called when the link is
    open and the wait has not begun: the time to ask for a passphrase. If no link was chosen, ``uuid`` is searched on
    the named buses, else on the bus of its last contact, and then at the reader; a reader of config.toml is checked
    briefly before the buses as well. Raises NoReaderError, NoNodeError after ``links.timeout`` seconds,
    AddressConflictError, UsageError if several nodes qualify.
    """
    if uuid is None:
        port = open_port(links)
        try:
            before()
            contact = pick_single_node(station, port.find_all(seconds=links.timeout, notice=reporter.notice))
            with Conversation(contact, notice=reporter.notice) as node:
                yield node
        finally:
            port.close()
        return
    known = likely_places(station, links, [uuid])
    if not known:
        with _met_at(station, links, uuid, reporter, before) as node:
            yield node
        return
    with ExitStack() as stack:
        yield _met_somewhere(stack, station, links, known, uuid, reporter, before)


@contextmanager
def _met_at(
    station: Station,
    links: LinkSettings,
    uuid: bytes,
    reporter: Reporter,
    before: Callable[[], object],
    *,
    quietly: bool = False,
) -> Iterator[Conversation]:
    """Meet this one node on the one link that ``links`` name; ``quietly``: without notices during the search."""

    def wanted(identity: Identity) -> bool:
        return identity.uuid == uuid

    try:
        port = open_port(links)
    except NoReaderError as error:
        if links.nfc or not links.names_no_link:
            raise
        raise _no_link(station, uuid, error) from error
    try:
        avoid_measuring_source(station, port, uuid)
        before()
        address = likely_address(station, uuid)
        notice = _ignore if quietly else reporter.notice
        contact = port.find(wanted, seconds=links.timeout, notice=notice, address=address)
        with Conversation(contact, notice=reporter.notice) as node:
            yield node
    finally:
        port.close()


def _ignore(_: Notice) -> None:
    """Show no notice."""


def _met_somewhere(
    stack: ExitStack,
    station: Station,
    links: LinkSettings,
    known: tuple[str, ...],
    uuid: bytes,
    reporter: Reporter,
    before: Callable[[], object],
) -> Conversation:
    """Meet a node: a look at the reader if one is configured, a short search at each known place, then a tap.

    Without a reader there is no tap, and the first place gets all the remaining time.
    """
    asked = False

    def once() -> None:
        nonlocal asked
        if not asked:
            asked = True
            before()

    began = time.monotonic()
    searched = [(links.at(place), _TRY_SECONDS) for place in known]
    if links.nfc:
        searched.insert(0, (replace(links, via_chosen=True), _GLANCE_SECONDS))
    for place, seconds in searched:
        there = replace(place, timeout=min(links.timeout, seconds))
        try:
            return stack.enter_context(_met_at(station, there, uuid, reporter, once, quietly=place.via == "nfc"))
        except (
            NoNodeError,
            NoReaderError,
        ) as error:  # the node is off or elsewhere, or the adapter is not plugged in: go on, a tap may come
            _log.debug("%s is not at %s: %s", uuid.hex(), place.places, error.message)
    left = replace(links, timeout=max(0.1, links.timeout - (time.monotonic() - began)))
    where = " or ".join(place.partition(":")[2] for place in known)
    try:
        return stack.enter_context(_met_at(station, left, uuid, reporter, once))
    except NoNodeError as error:
        raise NoNodeError(f"{error.message} It did not answer on {where} either.", hint=error.hint) from error
    except NoReaderError as no_reader:
        try:
            return stack.enter_context(_met_at(station, left.at(known[0]), uuid, reporter, once))
        except NoNodeError as error:
            raise NoNodeError(
                f"Node {uuid.hex()} did not answer on {where} within {links.timeout:g} s, and there is no NFC reader.",
                hint=error.hint,
            ) from no_reader


def likely_places(station: Station, links: LinkSettings, uuids: Sequence[bytes]) -> tuple[str, ...]:
    """Return the places to search if no link was chosen: the named buses, else the place of each node's last contact.

    Places are ``LINK:PORT``; empty if a link was chosen, or if none is known.
    """
    if not links.names_no_link:
        return ()
    return links.buses or tuple(dict.fromkeys(station.nodes.last_places(uuids).values()))


def _no_link(station: Station, uuid: bytes, error: NoReaderError) -> NoReaderError:
    """Return the error for a missing reader if no link was named, which selects the reader."""
    known = station.nodes.get(uuid)
    met = known is not None and known.can_address
    last = f" It was last met on a CAN bus, at address 0x{known.can_address:02X}." if known and met else ""
    return NoReaderError(
        f"No link to node {uuid.hex()} is named, and no NFC reader can be used: {error.message}",
        hint=f"Give its link: --can socketcan:can0, --ble hci0 or --nfc usb; or set it once in config.toml.{last}",
    )


def likely_address(station: Station, uuid: bytes) -> int:
    """Return the CAN address to try first: that of the last contact, else the node's default. A hint only."""
    known = station.nodes.get(uuid)
    return known.can_address if known is not None and known.can_address else default_can_address(uuid)


def avoid_measuring_source(station: Station, port: Port, uuid: bytes) -> None:
    """Avoid the source address from which a process of this station measures the node.

    A session belongs to a pair of addresses: another one from here would end it. Without a named address the next free
    one is used; raises StoreLockedError if the named one is in use, or none is free.
    """
    if not isinstance(port, MeasuringLink) or (bus := port.shared_bus) is None:
        return
    if not station.measurements.is_running(uuid):
        return
    if station.measurements.source(bus.wire, bus.source).is_taken_alone:
        for source in bus.sources:
            if not station.measurements.source(bus.wire, source).is_taken_alone:
                port.use_source(source)
                return
        other = 0xF2 if bus.source == 0xF1 else 0xF1
        raise StoreLockedError(
            f"Node {uuid.hex()} is being measured from source address 0x{bus.source:02X}.",
            hint=f"Add source=0x{other:02X} to --can, or end that measurement.",
        )


@contextmanager
def meet_all(links: LinkSettings, reporter: Reporter) -> Iterator[list[Conversation]]:
    """Wait for any node and give a conversation with each that is there: the tapped one, or all on the bus."""
    port = open_port(links)
    try:
        answers = port.find_all(seconds=links.timeout, notice=reporter.notice, listen=links.listen)
        contacts = drop_duplicate_uuids(answers, reporter.notice)
        with ExitStack() as stack:
            yield [stack.enter_context(Conversation(contact, notice=reporter.notice)) for contact in contacts]
    finally:
        port.close()


def drop_duplicate_uuids(contacts: list[Contact], notice: NoticeSink) -> list[Contact]:
    """Return the contacts whose UUID answers at one address only; a copied UUID must cost no other node.

    ``notice`` receives the dropped ones; raises AddressConflictError if none is left.
    """
    same: dict[bytes, list[Contact]] = {}
    for contact in contacts:
        same.setdefault(contact.identity.uuid, []).append(contact)
    for uuid, group in same.items():
        try:
            refuse_duplicate_uuids(group)
        except AddressConflictError as conflict:
            notice(Notice("conflict", f"{conflict.message} {conflict.hint}", uuid=uuid))
    return [contact for contact in contacts if len(same[contact.identity.uuid]) == 1] or refuse_duplicate_uuids(
        contacts
    )


def refuse_duplicate_uuids(contacts: list[Contact]) -> list[Contact]:
    """Return the contacts unchanged; raises AddressConflictError if one UUID answers at two addresses."""
    seen: dict[bytes, Contact] = {}
    for contact in contacts:
        twin = seen.setdefault(contact.identity.uuid, contact)
        if twin is not contact:
            raise AddressConflictError(
                f"Node {contact.identity.uuid.hex()} answers at 0x{twin.address or 0:02x} and at "
                f"0x{contact.address or 0:02x}: one of them is an impostor.",
                hint="Disconnect one of them, or select one by node=ADDRESS in --can: its key shows which one"
                " is genuine.",
            )
    return contacts


def pick_single_node(station: Station, contacts: list[Contact]) -> Contact:
    """Return the only contact, or the only one that is not provisioned and verified yet."""
    refuse_duplicate_uuids(contacts)
    unfinished = [contact for contact in contacts if not _finished(station, contact.identity)]
    for choice in (contacts, unfinished):
        if len(choice) == 1:
            return choice[0]
    meant = unfinished or contacts
    listed = ", ".join(f"{contact.identity.uuid.hex()} at 0x{contact.address or 0:02x}" for contact in meant[:_SHOWN])
    which = f"{len(meant)} of them not finished" if len(meant) < len(contacts) else ""
    raise UsageError(
        f"{len(contacts)} nodes answer on the bus{', ' if which else ''}{which}: {listed}"
        f"{', …' if len(meant) > _SHOWN else ''}.",
        hint="Select one by its UUID, or by node=ADDRESS in --can.",
    )


def _finished(station: Station, identity: Identity) -> bool:
    return identity.state == NodeState.PROVISIONED and station.datasheets.reads_well(identity.uuid)


# -- tap first, then over BLE (profile.md, "BLE") ------------------------------------------------------------------


def continue_over_ble(links: LinkSettings, notice: NoticeSink) -> Callable[[Conversation], None] | None:
    """Return how to continue over BLE after the agreement if ``--nfc`` and ``--ble`` are both named, else None.

    The returned function raises NoReaderError, NoNodeError (it does not advertise, or is out of reach), LinkError.
    """
    place = links.onward
    if place is None:
        return None

    def go_on(node: Conversation) -> None:
        if not node.tapped:
            return
        named = node.contact.ble
        at = f"{'&' if '?' in place else '?'}address={named.text}" if named and "address=" not in place else ""
        port = open_place(place + at, links.trace)

        def wanted(identity: Identity) -> bool:
            return identity.uuid == node.uuid

        try:
            node.move_to(lambda: port.find(wanted, seconds=links.timeout, notice=notice), port.close)
        except BaseException:
            port.close()
            raise

    return go_on


# -- node after node: the same work for each until stopped; an error ends only one node ---------------------------

Result = TypeVar("Result")
_LOOK_SECONDS = 0.2
_END_SECONDS = 5.0


@dataclass(frozen=True)
class Arrival(Generic[Result]):
    """One arrived node: the result of the work or the error that ended it, its place, and the seconds it took."""

    uuid: bytes
    place: str
    seconds: float
    result: Result | None = None
    error: TedsProvisionError | None = None
    time: str = field(default_factory=utc_now)


class IdleStop(threading.Event):
    """A stop sign that shows by itself when nothing happened for ``seconds``; None waits for ever."""

    def __init__(self, seconds: float | None) -> None:
        super().__init__()
        self._seconds, self._asked = seconds, False
        self._busy, self._counting = 0, threading.Lock()
        self.renew()

    def request_stop(self) -> None:
        """Request the stop from a signal handler; seen within 0.2 s.

        Takes no lock, since the interrupted thread may hold it.
        """
        self._asked = True

    def renew(self) -> None:
        """Wait the whole time again: something happened."""
        self._until = None if self._seconds is None else time.monotonic() + self._seconds

    @contextmanager
    def working(self) -> Iterator[None]:
        """Suspend the time-out while a board is worked on: it limits the wait for the next board, not the work."""
        with self._counting:
            self._busy += 1
        try:
            yield
        finally:
            self.renew()  # renewed before the count drops, so that the old deadline never applies
            with self._counting:
                self._busy -= 1

    @property
    def is_asked(self) -> bool:
        """True if a person or a signal asked to stop; a time-out does not count."""
        return self._asked or super().is_set()

    @property
    def ran_out(self) -> bool:
        """True if the time is over, rather than a stop requested."""
        return self._is_over() and not self._asked and not super().is_set()

    def _is_over(self) -> bool:
        return not self._busy and self._until is not None and time.monotonic() >= self._until

    def is_set(self) -> bool:
        """Return True if a stop was requested, or the time is over."""
        return self._asked or super().is_set() or self._is_over()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait up to ``timeout`` seconds; return True if a stop was requested or the time is over."""
        end = None if timeout is None else time.monotonic() + timeout
        while not self.is_set():
            left = _LOOK_SECONDS if end is None else min(_LOOK_SECONDS, end - time.monotonic())
            if left <= 0:
                return False
            super().wait(left)
        return True


def watch_nodes(
    links: LinkSettings, work: Callable[[Conversation], Result], reporter: Reporter, stop: threading.Event
) -> Iterator[Arrival[Result]]:
    """Do ``work`` with every node that comes on the chosen links; yield how each of them ended.

    Debounced (one visit, one result); continues when a reader is unplugged and plugged in again. Several readers serve
    several taps at once, each in a thread. Raises NoReaderError only if a reader cannot be opened at the start.
    """
    ports = open_ports(links)
    try:
        if len(ports) == 1:
            yield from _watch(ports[0], work, reporter, stop)
        else:
            yield from _together(ports, work, reporter, stop)
    finally:
        for port in ports:
            port.close()


def _watch(
    port: Port, work: Callable[[Conversation], Result], reporter: Reporter, stop: threading.Event
) -> Iterator[Arrival[Result]]:
    for contact in port.watch(stop=stop, notice=reporter.notice):
        began, uuid = time.monotonic(), contact.identity.uuid
        result: Result | None = None
        error: TedsProvisionError | None = None
        try:
            with Conversation(contact, notice=reporter.notice) as node:
                result = work(node)
        except VaultLockedError:  # concerns the whole command, not one node
            raise
        except TedsProvisionError as failure:
            error = failure
        except SessionLostError as lost:
            error = lost.cause
        yield Arrival(uuid, port.place, time.monotonic() - began, result, error)


def _together(
    ports: list[Port], work: Callable[[Conversation], Result], reporter: Reporter, stop: threading.Event
) -> Iterator[Arrival[Result]]:
    arrivals: queue.Queue[Arrival[Result] | BaseException] = queue.Queue()

    def serve(port: Port) -> None:
        try:
            for arrival in _watch(port, work, reporter, stop):
                arrivals.put(arrival)
        except BaseException as error:  # noqa: BLE001 - raised again by the thread that yields the results
            arrivals.put(error)

    threads = [threading.Thread(target=serve, args=(port,), name=port.place, daemon=True) for port in ports]
    for thread in threads:
        thread.start()
    try:
        while any(thread.is_alive() for thread in threads) or not arrivals.empty():
            with suppress(queue.Empty):
                one = arrivals.get(timeout=_LOOK_SECONDS)
                if isinstance(one, BaseException):
                    raise one
                yield one
    finally:
        stop.set()
        for thread in threads:
            thread.join(_END_SECONDS)
