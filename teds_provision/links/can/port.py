"""The station's end of a CAN bus: finds nodes by Identify and exchanges frames with one at a time."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from teds_provision.errors import (
    AddressConflict,
    BadData,
    Garbled,
    LinkFailure,
    NodeSilent,
    NoNode,
    TedsProvisionError,
)
from teds_provision.links.can.bus import Bus
from teds_provision.links.can.finding import IDENTIFY, ask_all, conflict_text, read_identity
from teds_provision.links.can.gathering import Gathering
from teds_provision.links.can.isotp import Pair
from teds_provision.links.can.spec import LAST_NODE, parse_spec
from teds_provision.links.ports import Contact, Notice, NoticeSink
from teds_provision.protocol.messages.identity import Identity, NodeState

REPLY_SECONDS: Final = 5.0
REPEAT_SECONDS: Final = 15.0
TRIES: Final = 3
"""A reply is awaited 5 s; a request is repeated at most twice, within 15 s (profile: wire)."""
_ROUND_SECONDS: Final = 1.0
_HELLO_SECONDS: Final = 1.0
_SETTLE_SECONDS: Final = 0.08
"""Nodes answer a functional Identify after up to 50 ms; a second one under the same address shows by then."""
_EVERYONE_SECONDS: Final = 0.3
"""How long everyone is waited for: 50 ms of random wait, and time for a few dozen answers to pass."""
_GONE_ROUNDS: Final = 3
_SLICE: Final = 0.05
_LONGEST_TRY: Final = 120.0
"""Seconds: 4095 octets at the longest gap (127 ms) that a node may ask for take 75 s."""


class CanLink:
    """One node's line: the pair of its address and ours."""

    via: Final = "can"

    def __init__(self, port: CanPort, address: int) -> None:
        self._port = port
        self.address = address
        self._pair: Pair | None = None
        self._bus: Bus | None = None

    def exchange(self, frame: bytes) -> bytes:
        """Send one command frame and return its reply; see ``Link.exchange``."""
        return self.ask(frame, tries=TRIES, seconds=REPLY_SECONDS)

    def close(self) -> None:
        """Nothing to leave behind on CAN."""

    def ask(self, frame: bytes, *, tries: int, seconds: float) -> bytes:
        """As ``exchange``, at most ``tries`` times, each with ``seconds`` of silence allowed."""
        bus, pair = self._ready()
        transaction = self._port.next_transaction()
        body = bytes([transaction]) + frame
        began = time.monotonic()
        torn = ""
        for number in range(tries):
            if number and time.monotonic() - began >= REPEAT_SECONDS:
                break
            if number == 2 and _no_flow(torn):  # perhaps it is busy and will come to it
                time.sleep(max(0.0, began + seconds - time.monotonic()))
            pair.abandon()
            pair.speak(fd=bus.spec.fd)
            bus.drain()
            pair.send(body)
            reply = _await(bus, pair, transaction, seconds)
            if reply is not None:
                return reply
            if pair.overflow:
                raise Garbled(
                    f"The node at 0x{self.address:02X} refuses {len(body)} octets (flow control: overflow).",
                    hint="Its Identify announces a longer maxMessage than it keeps; write in smaller pieces.",
                )
            torn = pair.error
        raise self._failed(torn)

    def _failed(self, torn: str) -> LinkFailure:
        where = f"The node at 0x{self.address:02X} on {self._port.spec.text}"
        if torn and not _no_flow(torn):
            return Garbled(
                f"{where} answers, but the transfer breaks: {torn}", hint="Check wiring, bit rate, bus load."
            )
        return NodeSilent(f"{where} does not answer any more.", hint="Check its power, its wiring and its address.")

    def _ready(self) -> tuple[Bus, Pair]:
        bus = self._port.bus()
        if self._pair is None or self._bus is not bus:
            self._bus, self._pair = bus, Pair(bus.spec.source, self.address, bus.send, fd=bus.spec.fd)
        return bus, self._pair


def _no_flow(torn: str) -> bool:
    """Whether a transfer ended because the node never took up our first frame or block."""
    return "FlowControl timed out" in torn


def _await(bus: Bus, pair: Pair, transaction: int, seconds: float) -> bytes | None:
    """Work until the reply to ``transaction`` is here; None after ``seconds`` without progress or when it is torn."""
    until = time.monotonic() + seconds
    end = time.monotonic() + _LONGEST_TRY
    while True:
        while (body := pair.received()) is not None:
            if body[:1] == bytes([transaction]) and len(body) > 1:
                return body[1:]
        left = until - time.monotonic()
        if pair.error or left <= 0:
            return None
        frame = bus.receive(pair.due_in(min(left, _SLICE)))
        ours = frame is not None and pair.take(frame)
        pair.run()
        if pair.sending or (ours and pair.receiving):
            until = min(end, time.monotonic() + seconds)


@dataclass
class _Seen:
    """What ``watch`` last knew of one node; ``silent`` rounds without an answer."""

    address: int
    state: NodeState
    silent: int = 0


class CanPort:
    """Finds nodes on one CAN bus; see ``links.ports.Port``. ``spec_text`` is the value of ``--can``."""

    via: Final = "can"

    def __init__(self, spec_text: str) -> None:
        self.spec = parse_spec(spec_text)
        self._bus: Bus | None = Bus(self.spec)
        self._transaction = secrets.randbelow(256)

    def bus(self) -> Bus:
        """The open bus; opens it again after it was lost."""
        if self._bus is None:
            self._bus = Bus(self.spec)
        return self._bus

    def next_transaction(self) -> int:
        """A transaction number, 0 to 255; the first of a process is random."""
        self._transaction = (self._transaction + 1) & 0xFF
        return self._transaction

    def close(self) -> None:
        """Release the bus; never raises."""
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def find(
        self, wanted: Callable[[Identity], bool], *, seconds: float, notice: NoticeSink, address: int | None = None
    ) -> Contact:
        """Return the node for which ``wanted`` holds: at ``address`` or ``node=``, else whichever answers.

        Raises NoNode after ``seconds``, AddressConflict when two nodes answer under one address and the wanted one is
        not found elsewhere, LinkFailure when the bus fails.
        """
        until = time.monotonic() + seconds
        told: set[bytes] = set()
        notice(Notice("waiting", f"Looking for the node on {self.spec.text}.", seconds))
        if address is not None and 1 <= address <= LAST_NODE:
            contact = self._at(address, wanted, min(_HELLO_SECONDS, seconds), notice, told)
            if contact is not None:
                return contact
        while True:
            left = until - time.monotonic()
            if left <= 0:
                break
            round_ends = time.monotonic() + min(_ROUND_SECONDS, left)
            if self.spec.node is not None:
                contact = self._at(self.spec.node, wanted, min(_HELLO_SECONDS, left), notice, told)
            else:
                contact = self._among_all(wanted, min(_ROUND_SECONDS, left), notice, told)
            if contact is not None:
                return contact
            time.sleep(max(0.0, round_ends - time.monotonic()))
        where = f"at 0x{self.spec.node:02X} on {self.spec.text}" if self.spec.node else f"on {self.spec.text}"
        others = f"; others did: {', '.join(sorted(uuid.hex() for uuid in told))}" if told else ""
        raise NoNode(
            f"No such node answered {where} within {seconds:g} s{others}.",
            hint="Check its power, the bit rate and the address; teds-provision identify --via can lists who answers.",
        )

    def everyone(self, *, seconds: float, notice: NoticeSink) -> list[Contact]:
        """Every node that answers, as soon as one does: what identify shows, and provision chooses from.

        Raises NoNode after ``seconds``, AddressConflict, LinkFailure.
        """
        until = time.monotonic() + seconds
        notice(Notice("waiting", f"Asking every node on {self.spec.text}.", seconds))
        while self.spec.node is None and (left := until - time.monotonic()) > 0:
            gathering = self._new_gathering()
            ask_all(self.bus(), gathering, min(_EVERYONE_SECONDS, left), enough=lambda: False, settle=0.0)
            if gathering.conflicts:
                raise _conflict(gathering)
            found = _identities(gathering)
            if found:
                return [self._contact(node, identity) for node, identity in found]
        return [self.find(lambda _: True, seconds=max(0.1, until - time.monotonic()), notice=notice)]

    def watch(self, *, stop: threading.Event, notice: NoticeSink) -> Iterator[Contact]:
        """Yield each node once: when it first answers, when it comes back, and when it is in factory state again."""
        seen: dict[bytes, _Seen] = {}
        conflicts: set[int] = set()
        notice(Notice("waiting", f"Watching {self.spec.text} for nodes."))
        lost = False
        while not stop.is_set():
            round_ends = time.monotonic() + _ROUND_SECONDS
            try:
                found, clashing = self._round(stop)
                if lost:
                    lost = False
                    notice(Notice("reader-ready", f"The bus {self.spec.text} is back."))
            except LinkFailure as error:
                self.close()
                if not lost:
                    lost = True
                    notice(Notice("reader-lost", f"{error.message} Waiting for it."))
                stop.wait(_ROUND_SECONDS)
                continue
            for node in sorted(clashing - conflicts):
                notice(Notice("conflict", conflict_text(node)))
            conflicts = clashing
            for contact in _news(seen, found):
                if stop.is_set():
                    return
                yield self._contact(contact[0], contact[1])
            for uuid, node in _gone(seen, found, clashing):
                notice(Notice("node-left", f"Node {uuid.hex().upper()} at 0x{node:02X} does not answer any more."))
            stop.wait(max(0.0, round_ends - time.monotonic()))

    def _contact(self, node: int, identity: Identity) -> Contact:
        return Contact(identity, CanLink(self, node), address=node)

    def _at(
        self, node: int, wanted: Callable[[Identity], bool], seconds: float, notice: NoticeSink, told: set[bytes]
    ) -> Contact | None:
        """Ask one address who is there."""
        try:
            reply = CanLink(self, node).ask(IDENTIFY, tries=1, seconds=seconds)
            identity = read_identity(reply)
        except (NodeSilent, Garbled, BadData):
            return None
        if wanted(identity):
            return self._contact(node, identity)
        _tell(notice, told, node, identity)
        return None

    def _among_all(
        self, wanted: Callable[[Identity], bool], seconds: float, notice: NoticeSink, told: set[bytes]
    ) -> Contact | None:
        """Ask everyone; settles as soon as the wanted node and all that answer beside it are in."""
        gathering = self._new_gathering()

        def chosen() -> list[tuple[int, Identity]]:
            return [pair for pair in _identities(gathering) if wanted(pair[1])]

        ask_all(self.bus(), gathering, seconds, enough=lambda: bool(chosen()), settle=_SETTLE_SECONDS)
        for node in sorted(gathering.conflicts):
            notice(Notice("conflict", conflict_text(node)))
        for node, identity in chosen():
            return self._contact(node, identity)
        for node, identity in _identities(gathering):
            _tell(notice, told, node, identity)
        if gathering.conflicts:
            raise _conflict(gathering)
        return None

    def _round(self, stop: threading.Event) -> tuple[dict[int, Identity], set[int]]:
        """Ask everyone, or ``node=`` alone; returns who answered and where two did."""
        if self.spec.node is not None:
            contact = self._at(self.spec.node, lambda _: True, _HELLO_SECONDS, lambda _: None, set())
            return ({self.spec.node: contact.identity} if contact else {}), set()
        gathering = self._new_gathering()
        ask_all(self.bus(), gathering, _ROUND_SECONDS / 2, enough=stop.is_set, settle=0.0)
        return dict(_identities(gathering)), gathering.conflicts

    def _new_gathering(self) -> Gathering:
        return Gathering(self.spec.source, self.next_transaction())


def _conflict(gathering: Gathering) -> AddressConflict:
    return AddressConflict(
        conflict_text(min(gathering.conflicts)),
        hint="Tap one of them, or connect it alone, and: teds-provision address UUID NEW.",
    )


def _identities(gathering: Gathering) -> list[tuple[int, Identity]]:
    """Who answered in a way that can be read, addresses with two nodes left out."""
    found = []
    for node, reply in sorted(gathering.answers.items()):
        if node in gathering.conflicts:
            continue
        try:
            found.append((node, read_identity(reply)))
        except TedsProvisionError:
            continue
    return found


def _tell(notice: NoticeSink, told: set[bytes], node: int, identity: Identity) -> None:
    if identity.uuid not in told:
        told.add(identity.uuid)
        text = f"Node {identity.uuid.hex().upper()} answers at 0x{node:02X}, but it is not the one looked for."
        notice(Notice("foreign-tag", text))


def _news(seen: dict[bytes, _Seen], found: dict[int, Identity]) -> list[tuple[int, Identity]]:
    """Nodes to announce: new, back after silence, or reset to factory state. A new address alone is no news."""
    news = []
    for node, identity in found.items():
        before = seen.get(identity.uuid)
        reset = identity.state is NodeState.FACTORY
        if before is None or (reset and before.state is not NodeState.FACTORY):
            news.append((node, identity))
        seen[identity.uuid] = _Seen(node, identity.state)
    return news


def _gone(seen: dict[bytes, _Seen], found: dict[int, Identity], clashing: set[int]) -> list[tuple[bytes, int]]:
    """Nodes that have been silent for so long that they count as gone, with their addresses; forgets them."""
    here = {identity.uuid for identity in found.values()}
    for uuid, last in seen.items():
        if uuid not in here and last.address not in clashing:
            last.silent += 1
    gone = [(uuid, last.address) for uuid, last in seen.items() if last.silent >= _GONE_ROUNDS]
    for uuid, _ in gone:
        del seen[uuid]
    return gone
