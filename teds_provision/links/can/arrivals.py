"""Arrivals and departures of nodes on a watched bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Final, Protocol

from teds_provision.errors import AddressConflictError
from teds_provision.links.can.bus_multiplexer import BusMultiplexer, Listener
from teds_provision.links.can.identify_broadcast import FunctionalAnswers, ask_all, ask_unclear_again, conflict_text
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.spec import CanSpec
from teds_provision.links.ports import Notice, NoticeSink
from teds_provision.protocol.announce import Announce, is_announce, uuid_crc
from teds_provision.protocol.messages.identity import Identity, NodeState

_GONE_SECONDS: Final = 3.0
"""A node that has been silent for so long has left."""
_SILENCE_SECONDS: Final = 0.055
"""Nodes answer within 50 ms; a later one is found in the next round."""
_UNCLEAR_SECONDS: Final = 0.1
"""Seconds to wait for a node whose answer was torn.

It was usually pulled in the middle of it, and no other node is found during the wait. The next round asks all again.
"""
_LONGEST_SECONDS: Final = 3.0
_MOST_PAUSE: Final = 1.0
_CHANGE_SECONDS: Final = 0.015
"""Seconds for a machine to change the board that was just served.

Asked at once, there is no new board yet, and the silence after that question takes longer.
"""
_PAUSE_PER_NODE: Final = 0.03
"""Seconds from one question to the next for each node that answered: its six frames take 1.6 ms, 5 % of a bus."""


@dataclass
class _SeenNode:
    """Last knowledge about one node: the last ``round`` that it answered in, and since when it is ``silent``."""

    address: int
    state: NodeState
    round: int
    silent: float | None = None


class WatchedPort(Protocol):
    """The port of a watched bus."""

    spec: CanSpec

    def bus(self) -> BusMultiplexer:
        """Return the open bus with its receiving loop."""

    def next_transaction(self) -> int:
        """Return a transaction number, 0 to 255."""

    def identify(self, node: int, *, seconds: float = ...) -> Identity | None:
        """Ask one address for Identify; None if there is no answer within ``seconds``."""

    def report_rivals(self, notice: NoticeSink) -> None:
        """Report other stations that use our source address."""


def _is_start(frame: Frame) -> bool:
    """Return True for an Announce of a node that started; a pressed button is no reason to ask."""
    announce = Announce.decode(frame.identifier, frame.data) if is_announce(frame.identifier) else None
    return announce is not None and not announce.pressed


class Arrivals:
    """The nodes of one bus; :meth:`round` sends one broadcast and yields what is new."""

    def __init__(self, port: WatchedPort, notice: NoticeSink) -> None:
        self._port, self._notice = port, notice
        self._seen: dict[bytes, _SeenNode] = {}
        self._conflicts: set[int] = set()
        self._round = 0
        self._asked_at = self._served_at = 0.0
        self._served: set[int] = set()
        self._listener: Listener | None = None
        self._bus: BusMultiplexer | None = None

    def lost(self) -> None:
        """Handle a failed bus: its listener is useless from now on."""
        self._listener = self._bus = None

    def round(self, stop: threading.Event) -> Iterator[tuple[int, Identity]]:
        """Send a broadcast (or ask ``node=`` alone) and yield address and identity of each node that is new."""
        self._round += 1
        self._asked_at = time.monotonic()
        self._served.clear()
        bus = self._port.bus()
        if bus is not self._bus:
            self._bus = bus
            self._listener = bus.listen(_is_start, most=256)
        clashing: set[int] = set()
        address = self._port.spec.node
        for news in self._all(stop, clashing) if address is None else self._one(address, clashing):
            yield news
            self._served_at = time.monotonic()
            self._served.add(uuid_crc(news[1].uuid))
        for node in sorted(clashing - self._conflicts):
            self._notice(Notice("conflict", conflict_text(node)))
        self._conflicts = clashing
        if not stop.is_set():
            self._say_who_left(clashing)
            self._port.report_rivals(self._notice)

    def pressed(self) -> list[bytes]:
        """Return the UUIDs of nodes that report a press of their button, each press once, a second later."""
        crcs = self._bus.presses.news() if self._bus is not None else []
        return [uuid for uuid in self._seen if uuid_crc(uuid) in crcs]

    def pause(self, stop: threading.Event) -> None:
        """Wait until the next broadcast may be sent, or a node announces itself; the time of the round counts.

        A finished board may be replaced meanwhile; its Announces while it was worked on do not count.
        """
        if self._listener is not None and not all(map(self._was_served, self._listener.get_all(0.0))):
            return
        answered = sum(last.round == self._round for last in self._seen.values())
        until = self._asked_at + min(_MOST_PAUSE, _PAUSE_PER_NODE * answered)
        until = max(until, self._served_at + _CHANGE_SECONDS)
        while (left := until - time.monotonic()) > 0 and not stop.is_set():
            if self._listener is None:
                stop.wait(left)
            elif self._listener.get(min(left, 0.1)) is not None:
                return

    def _was_served(self, frame: Frame) -> bool:
        """Return True if an Announce is of a node that this round brought."""
        announce = Announce.decode(frame.identifier, frame.data)
        return announce is not None and announce.crc in self._served

    def _one(self, address: int, clashing: set[int]) -> Iterator[tuple[int, Identity]]:
        try:
            identity = self._port.identify(address)
        except AddressConflictError:
            clashing.add(address)
            return
        if identity is not None and self._is_news(address, identity):
            yield address, identity

    def _all(self, stop: threading.Event, clashing: set[int]) -> Iterator[tuple[int, Identity]]:
        found = FunctionalAnswers()
        bus, transaction = self._port.bus(), self._port.next_transaction()
        for news in ask_all(bus, transaction, silence=_SILENCE_SECONDS, longest=_LONGEST_SECONDS):
            if stop.is_set():
                return
            if isinstance(news, FunctionalAnswers):
                found = news
            elif self._is_news(*news):
                yield news
        ask_again = partial(self._port.identify, seconds=_UNCLEAR_SECONDS)
        settled = ask_unclear_again(found, ask_again, until=time.monotonic() + _LONGEST_SECONDS)
        clashing |= settled.conflicts
        for address in found.conflicts | found.unfinished:
            identity = settled.identities.get(address)
            if identity is not None and self._is_news(address, identity):
                yield address, identity

    def _is_news(self, address: int, identity: Identity) -> bool:
        """Return True if the node is new, back after silence, or reset to factory state.

        A new address alone does not make a node new.
        """
        before = self._seen.get(identity.uuid)
        self._seen[identity.uuid] = _SeenNode(address, identity.state, self._round)
        factory = NodeState.FACTORY
        return before is None or (identity.state is factory and before.state is not factory)

    def _say_who_left(self, clashing: set[int]) -> None:
        """Report nodes that have been silent for so long that they count as gone, and forget them."""
        now = time.monotonic()
        for uuid, last in list(self._seen.items()):
            if last.round == self._round or last.address in clashing:
                continue
            last.silent = last.silent or now
            if now - last.silent >= _GONE_SECONDS:
                del self._seen[uuid]
                name = uuid.hex()
                text = f"Node {name} at 0x{last.address:02X} no longer answers."
                self._notice(Notice("node-left", text, uuid=uuid))
