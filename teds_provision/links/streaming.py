"""Measuring and driving over a link: :class:`MeasuringLink`, which every port with ``capabilities.streams`` is.

A link that streams derives its port from it. Nothing above this package asks which link it is (docs/extending.md,
"A link that streams").
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple, Protocol

from teds_provision.links.discovery import Discovery, PolledDiscovery, SightingSink
from teds_provision.links.ports import Contact, Link, NoticeSink, Port, SharedBus, Trace
from teds_provision.protocol.messages.identity import Identity


class DataMessage(NamedTuple):
    """A whole data message as it came: ``node`` is its number on the link, ``at`` its arrival (monotonic ns)."""

    node: int
    stream: int
    octets: bytes
    at: int


class DataListener(Protocol):
    """The data messages of a link, received by one thread. ``lost`` counts those that were dropped for lack of time."""

    @property
    def lost(self) -> int:
        """Frames or messages that were dropped, as they came faster than they were taken."""

    def get_all(self, seconds: float) -> Sequence[DataMessage]:
        """Return the messages that wait, in their order; if there are none, wait ``seconds`` for some.

        Raises LinkError if the link has failed.
        """


class StreamPieces(Protocol):
    """The pieces of one stream's messages; ``wrong`` counts pieces of a length that their place does not have."""

    wrong: int


class Airtime(Protocol):
    """The share of a link that the data messages of a node use (operation.md sections 4 and 6)."""

    @property
    def most_octets(self) -> int:
        """Octets of the longest data message."""

    def load(self, length: int, n: int, period: int) -> float:
        """Return a stream's share of the link: messages of ``length`` octets, one every n · period ns."""

    def frames(self, length: int) -> int:
        """Return how many frames a message of ``length`` octets is in the node's own budget."""


class MeasuringLink(Port, ABC):
    """A port whose nodes measure and act: streams, Drive, trigger, discovery. Thread-safe.

    ``node`` is a node's number on this link: ``Contact.line``. The defaults are those of a link on which each node has
    a connection, and which no other station shares.
    """

    via: str = ""
    place: str = ""
    trace: Trace | None = None
    poll_seconds: float = 15.0
    """Seconds between two questions of a service to all nodes."""

    @abstractmethod
    def link(self, node: int) -> Link:
        """Return the link to the node under this number; raises NoNodeError if there is none."""

    def contact(self, node: int, identity: Identity) -> Contact:
        """Return a contact with the node under this number."""
        return Contact(identity, self.link(node), connection=node, trace=self.trace, bus=self.place)

    # -- streams ---------------------------------------------------------------------------------------------------

    @abstractmethod
    def open_stream(self, node: int, stream: int, length: int) -> StreamPieces:
        """Accept messages of this stream from now on, ``length`` octets each, instead of an earlier one.

        Called before Subscribe is sent, because messages may arrive before the reply is processed.
        """

    @abstractmethod
    def close_stream(self, node: int, stream: int) -> None:
        """Stop accepting messages of this stream."""

    @abstractmethod
    def listen(self) -> AbstractContextManager[DataListener]:
        """Hear the messages of every open stream, until the block ends; raises LinkError."""

    @abstractmethod
    def airtime(self, node: int | None = None) -> Airtime:
        """Return what messages of this node take of the link; None: of any node, at worst."""

    @property
    def others_load(self) -> float:
        """Share of this link that data for other stations takes now."""
        return 0.0

    # -- actuators -------------------------------------------------------------------------------------------------

    @abstractmethod
    def drive(self, node: int, message: bytes) -> None:
        """Send a Drive message to a node; raises LinkError."""

    def trigger(self, token: bytes) -> bool:
        """Send the trigger to every node; False if this link has none. Raises LinkError."""
        del token
        return False

    # -- discovery -------------------------------------------------------------------------------------------------

    def discover(self, sightings: SightingSink, *, poll: float | None = None) -> Discovery:
        """Begin to find nodes, in another thread: while one is missing, and every ``poll`` seconds."""
        return PolledDiscovery(self, sightings, poll=poll)

    def identify(self, node: int, *, seconds: float, until_announced: bool = False) -> Identity | None:
        """Ask one node for Identify; None if it does not answer, or if the link is not ``connectionless``.

        ``until_announced``: stop as soon as a node announces itself there. Raises AddressConflictError, LinkError.
        """
        del node, seconds, until_announced
        return None

    # -- other stations on the bus ---------------------------------------------------------------------------------

    @property
    def shared_bus(self) -> SharedBus | None:
        """The bus and this station's address on it; None if no other station shares this link."""
        return None

    def use_source(self, source: int) -> None:
        """Use another source address of :attr:`shared_bus` from now on."""
        del source

    def require_sole_source(self) -> None:
        """Raise AddressConflictError if another station is heard to measure under our source address."""

    def report_rivals(self, notice: NoticeSink) -> None:
        """Report another station under our source address, once."""
        del notice


def measuring_links(ports: Sequence[object]) -> Iterator[MeasuringLink]:
    """Yield those of these ports that stream."""
    return (port for port in ports if isinstance(port, MeasuringLink))
