"""Broadcasts over CAN: one functional Identify, the answers of all nodes, and their evaluation."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

from teds_provision.errors import AddressConflictError, BadDataError, GarbledError, NodeSilentError, TedsProvisionError
from teds_provision.links.can.bus_multiplexer import BroadcastReplies, BusMultiplexer, PendingBroadcast
from teds_provision.links.can.isotp import FUNCTIONAL, Frame, single
from teds_provision.links.can.link import conflict
from teds_provision.protocol.messages.frames import IDENTIFY, decode_reply
from teds_provision.protocol.messages.identity import Identity

SILENCE_SECONDS: Final = 0.3
LONGEST_SECONDS: Final = 3.0
"""A station listens until 300 ms of silence, 3 s at most (profile.md, "CAN")."""

AskOne = Callable[[int], Identity | None]
"""Ask one address for Identify: None if there is no readable answer; raises AddressConflictError."""


@dataclass
class FunctionalAnswers:
    """Result of one functional Identify: the node at each address, and the unclear ones.

    ``repeated`` are conflicts with two whole beginnings, ``sure`` those with two in two questions: two boards with one
    UUID and one state answer octet for octet alike, so that no answer of one address alone shows them.
    """

    identities: dict[int, Identity] = field(default_factory=dict)
    conflicts: set[int] = field(default_factory=set)
    unfinished: set[int] = field(default_factory=set)
    repeated: set[int] = field(default_factory=set)
    sure: set[int] = field(default_factory=set)

    def combined_with(self, other: FunctionalAnswers) -> FunctionalAnswers:
        """Return the combined result of two questions; an address that one of them settled is settled."""
        identities = self.identities | other.identities
        unfinished = (self.unfinished | other.unfinished) - identities.keys()
        repeated, sure = self.repeated | other.repeated, self.sure | other.sure
        return FunctionalAnswers(identities, self.conflicts | other.conflicts, unfinished, repeated, sure)

    def cleared_by(self, later: FunctionalAnswers) -> FunctionalAnswers:
        """Return the result after a later question: a conflict remains only if it appeared again."""
        identities = {node: who for node, who in self.identities.items() if node not in later.conflicts}
        identities |= later.identities
        unclear = self.unfinished | self.conflicts | later.unfinished
        left = unclear - identities.keys() - later.conflicts
        return FunctionalAnswers(identities, later.conflicts, left, later.repeated, self.repeated & later.repeated)

    @property
    def duplicates(self) -> dict[bytes, list[int]]:
        """UUIDs that answer under more than one address, with these addresses: one of them is an impostor."""
        places: dict[bytes, list[int]] = {}
        for address, identity in sorted(self.identities.items()):
            places.setdefault(identity.uuid, []).append(address)
        return {uuid: addresses for uuid, addresses in places.items() if len(addresses) > 1}


def ask_all(
    bus: BusMultiplexer, transaction: int, *, silence: float, longest: float
) -> Iterator[tuple[int, Identity] | FunctionalAnswers]:
    """Send a functional Identify; yield each node as it answers, and finally the whole result.

    Ends after ``silence`` seconds without a frame of an answer, ``longest`` at most. Torn answers are in ``conflicts``
    or ``unfinished``: two nodes, or a lost frame. Raises LinkError.
    """
    fd = bus.spec.fd
    with bus.gather(transaction) as asked:
        body = bytes([transaction]) + IDENTIFY.encode()
        bus.send(Frame(FUNCTIONAL | bus.own, single(body, fd=fd), fd))
        reported: set[int] = set()
        for node in _news(bus, asked, silence, longest):
            identity = _read(asked.replies, node)
            if identity is not None and node not in reported:
                reported.add(node)
                yield node, identity
        gathering = asked.replies
    yield FunctionalAnswers(
        _identities(gathering),
        set(gathering.conflicts),
        gathering.unfinished | _unreadable(gathering),
        set(gathering.repeated),
    )


def _news(bus: BusMultiplexer, asked: PendingBroadcast, silence: float, longest: float) -> Iterator[int]:
    began = time.monotonic()
    while True:
        now = time.monotonic()
        left = min(asked.heard_at + silence, began + longest) - now
        node = asked.next(left)
        bus.check()
        if node is not None and node >= 0:
            yield node
        elif left <= 0 and time.monotonic() >= min(asked.heard_at + silence, began + longest):
            return


def ask_unclear_again(found: FunctionalAnswers, ask: AskOne, *, until: float) -> FunctionalAnswers:
    """Ask each unclear address separately: two nodes collide again, a lost frame does not recur.

    ``until`` is a monotonic time. Real double answers stay in ``conflicts``, silent addresses in ``unfinished``.
    """
    identities, conflicts, unfinished = dict(found.identities), set[int](), set[int]()
    for address in sorted(found.conflicts | found.unfinished):
        if address in found.sure:
            identities.pop(address, None)
            conflicts.add(address)
            continue
        if time.monotonic() >= until:
            (conflicts if address in found.conflicts else unfinished).add(address)
            continue
        try:
            identity = ask(address)
        except AddressConflictError:
            identities.pop(address, None)
            conflicts.add(address)
            continue
        if identity is not None:
            identities[address] = identity
        else:
            (conflicts if address in found.conflicts else unfinished).add(address)
    return FunctionalAnswers(identities, conflicts, unfinished)


def read_identity(reply: bytes) -> Identity:
    """Read a reply frame to Identify; raises GarbledError or BadDataError."""
    answer = decode_reply(reply)
    if not answer.ok:
        raise GarbledError(
            "The node refuses Identify, which no node is allowed to do.", hint="It does not follow the profile."
        )
    return Identity.decode(answer.payload)


def ask_one(ask: Callable[[bytes], bytes], *, questions: int = 2) -> Identity | None:
    """Return the Identify that ``ask`` gets (from a command frame to its reply); None without a valid answer.

    After an answer with missing frames it is sent again, up to ``questions`` times in all.
    """
    for _ in range(questions):
        try:
            return read_identity(ask(IDENTIFY.encode()))
        except (NodeSilentError, BadDataError):
            return None
        except GarbledError:
            continue
    return None


def conflict_text(node: int) -> str:
    """Return one sentence that names the address."""
    return conflict(node).message


def twice_text(uuid: bytes, addresses: list[int]) -> str:
    """Return one sentence with the UUID and the addresses under which it answers."""
    where = " and ".join(f"0x{address:02X}" for address in addresses)
    return f"Node {uuid.hex()} answers at {where}: one of them is an impostor."


def unfinished_text(nodes: set[int]) -> str:
    """Return one sentence that names the addresses whose answers came in part."""
    where = ", ".join(f"0x{node:02X}" for node in sorted(nodes))
    return f"The answer of {where} was incomplete; try again."


def _read(gathering: BroadcastReplies, node: int) -> Identity | None:
    if node in gathering.conflicts or node not in gathering.answers:
        return None
    try:
        return read_identity(gathering.answers[node])
    except TedsProvisionError:
        return None


def _identities(gathering: BroadcastReplies) -> dict[int, Identity]:
    """Return the identities that could be read by address, without addresses that two nodes share."""
    read = {node: _read(gathering, node) for node in sorted(gathering.answers)}
    return {node: identity for node, identity in read.items() if identity is not None}


def _unreadable(gathering: BroadcastReplies) -> set[int]:
    return {node for node in gathering.answers if node not in gathering.conflicts and _read(gathering, node) is None}
