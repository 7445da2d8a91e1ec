"""The interface of every link: what a port, a contact and a link can do, and the user's link options."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, Literal, NamedTuple, Protocol, runtime_checkable

from teds_provision.lazy import late
from teds_provision.links.hints import BleAddress, Charging
from teds_provision.protocol.messages.identity import Identity

if TYPE_CHECKING:
    import socket
else:
    socket = late("socket")  # most commands open no socket

NoticeKind = Literal[
    "waiting", "foreign-tag", "reader-ready", "reader-lost", "node-left", "conflict", "unfinished", "retry", "pressed"
]


@dataclass(frozen=True)
class Notice:
    """A message for the user while a port works: what it waits for, or a tag that is not a node.

    Units: ``seconds`` is how long this wait may still last, None for as long as it takes. ``uuid`` is the node
    concerned, if there is one.
    """

    kind: NoticeKind
    text: str
    seconds: float | None = None
    uuid: bytes | None = None


NoticeSink = Callable[[Notice], None]
Direction = Literal["out", "in"]
"""To the node, and from it."""


class Trace(Protocol):
    """Recorder of a link's frames and messages (``--trace``). Thread-safe; never raises, whatever the disk does."""

    def frame(
        self,
        link: str,
        direction: Direction,
        octets: bytes,
        *,
        identifier: int | None = None,
        fd: bool = False,
        at: float | None = None,
    ) -> None:
        """Record a frame as the link carried it.

        ``at`` is its arrival in seconds of ``time.monotonic()``, None for now.
        """

    def message(
        self,
        link: str,
        direction: Direction,
        octets: bytes,
        words: str,
        *,
        uuid: bytes,
        sealed: bool = False,
        opened: bytes | None = None,
    ) -> None:
        """Record a whole command or reply with its description, and its plain form if it was sealed."""


@dataclass(frozen=True)
class Capabilities:
    """Features of a link, so that callers never check for its name.

    ``tapped``: a person holds the node to this reader, so that a key that comes this way may be pinned and agreed.
    ``wired``: an answer comes over this very wire, so that a new node's first key may be accepted as its own.
    ``streams``: data messages of measuring nodes can be heard (``links.streaming``), and ``triggers``: one message
    starts them all. ``connectionless``: a question to one node, or to all, needs neither a tap nor a connection.
    ``shared``: each station, and each of its processes, has its own source address (:class:`SharedBus`).
    ``many``: several nodes are there at once, and may be talked to from one thread each, ``max_parallel`` of them at a
    time. ``octets_a_second`` is about how fast a long transfer goes, for an estimate.
    """

    tapped: bool = False
    wired: bool = False
    streams: bool = False
    triggers: bool = False
    connectionless: bool = False
    shared: bool = False
    many: bool = False
    max_parallel: int = 1
    octets_a_second: int = 2_000


NFC = Capabilities(tapped=True)
CAN = Capabilities(
    wired=True,
    streams=True,
    triggers=True,
    connectionless=True,
    shared=True,
    many=True,
    max_parallel=24,
    octets_a_second=24_000,
)
"""While most of 24 nodes calculate, a bus is never idle at 500 kbit/s."""
BLE = Capabilities(streams=True, many=True, octets_a_second=8_000)
"""One node after the other: an adapter holds few connections (notes in docs/hardware.md)."""


class Link(Protocol):
    """One node's line: one request, its one reply, in order. Used by one thread at a time."""

    @property
    def via(self) -> str:
        """Name of the link in the registry: ``nfc``, ``can``. For people; decide by :attr:`capabilities`."""

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of this link."""

    def exchange(self, frame: bytes) -> bytes:
        """Send one whole command frame and return the whole reply frame that belongs to it.

        Repeats as profile.md, "Repetition", allows (at most twice, within 15 s). Raises NodeSilentError, GarbledError,
        AddressConflictError or another LinkError; never returns a reply of another transaction.
        """

    def close(self) -> None:
        """End the talk with the node (NFC: deselect the service); never raises."""


@runtime_checkable
class ResendLink(Protocol):
    """A link on which a request can be sent again on purpose, to see what the node makes of it."""

    def resend(self, frame: bytes) -> bytes:
        """Send the last frame of ``exchange`` once more, under its transaction, as after a lost reply.

        Returns and raises as ``exchange`` does (profile.md, "Repetition").
        """


@runtime_checkable
class MultiStationLink(Protocol):
    """The link to a node on a bus with several stations (CAN), each with its own address.

    ``address`` is the node's; a node that has moved is asked at its new one once this is set.
    """

    address: int

    def from_station(self, source: int) -> Link:
        """Return a link to the same node from another station's address (0xF1 to 0xF7), over the same adapter."""

    def identify_functional(self) -> bytes:
        """Send a functional Identify from this link's own station.

        Return this node's reply frame, empty if none came.
        """

    def identify_at(self, address: int) -> Identity | None:
        """Return the Identify at this address within a second; None if there is no answer."""

    def begin(self, octets: int) -> bytes:
        """Announce a request of so many octets and send nothing of it but its first frame.

        Returns the data of the frame that the node answers with (ISO-TP, its first octet is the type), empty for none.
        """


class BusFrame(NamedTuple):
    """One frame of a bus as it was: identifier, data, and when it came in (seconds of ``time.monotonic()``)."""

    identifier: int
    octets: bytes
    at: float


class BusFrames(Protocol):
    """The frames of a bus, one by one, below every link. Used by one thread.

    ``own`` is the address of this base station on it; ``fd``: commands go by CAN FD here.
    """

    own: int
    fd: bool

    def send(self, identifier: int, octets: bytes, *, fd: bool = False) -> None:
        """Put one frame on the bus; raises LinkError."""

    def next(self, seconds: float) -> BusFrame | None:
        """Return the next frame of a node, Announces and data too; None after ``seconds``. Raises LinkError."""


@runtime_checkable
class FramedLink(Protocol):
    """A link whose single frames can be sent and received, to test a node's handling of them (CAN)."""

    def single_frames(self) -> AbstractContextManager[BusFrames]:
        """Hear every frame of nodes from now on, until the block ends."""


@runtime_checkable
class AnnouncingLink(Protocol):
    """A link on which the node announces its parameters (NFC: the record ``Tp``)."""

    @property
    def announced(self) -> dict[str, int]:
        """``WT_INT``, ``N_wait`` and ``maxNdef``, as profile.md, "NFC" has them."""


@runtime_checkable
class DeadlineLink(Protocol):
    """A link on which a request can be given up soon: what it orders would be too late afterwards."""

    def exchange_within(self, frame: bytes, seconds: float) -> bytes:
        """Exchange as ``exchange`` does; repeat after a quarter and a half of ``seconds``, give up at their end.

        operation.md section 2, "No late orders".
        """


@runtime_checkable
class TimestampedLink(Protocol):
    """A link that records when messages left and came, in seconds of ``time.monotonic()``.

    ``left``: a moment just before the first request left since this was last set to 0. ``came``: when the last reply
    was whole, by the kernel's time stamp if there is one; 0 if none came since.
    """

    left: float
    came: float


@runtime_checkable
class PacedLink(Protocol):
    """A link on which a reply can be asked for with a ``gap`` (ms) between its frames, so that data find room there."""

    gap: int


@runtime_checkable
class TransferLink(Protocol):
    """A link on which a long transfer has to leave room for the streams of other nodes (CAN)."""

    def wait_for_air(self) -> bool:
        """Wait until the next message of a long transfer may leave; True if streams run, so that it should be short."""


@runtime_checkable
class CancellableLink(Protocol):
    """A link whose exchange is abandoned (NodeSilentError) as soon as ``hopeless()`` returns True."""

    hopeless: Callable[[], bool]


@dataclass(frozen=True)
class Contact:
    """A found node: its unauthenticated Identify, its link, and its place.

    ``address`` is its CAN address, ``connection`` the number of its BLE connection. ``charging`` and ``ble`` are hints
    of its initial NFC message, as unauthenticated as the rest. ``trace`` records its messages, ``bus`` is the place of
    the bus or the air (``can:socketcan:can0``), "" at a reader. ``pressed`` returns True if this board alone reports
    that its button was pressed a moment ago, a hint too.
    """

    identity: Identity
    link: Link
    tag_uid: bytes | None = None
    address: int | None = None
    charging: Charging | None = None
    ble: BleAddress | None = None
    trace: Trace | None = None
    connection: int | None = None
    bus: str = ""
    pressed: Callable[[], bool] = field(default=lambda: False, repr=False, compare=False)

    @property
    def line(self) -> int:
        """Identifier of its data messages on its port: CAN address, or number of the connection."""
        return self.address or self.connection or 0

    def note(
        self,
        direction: Direction,
        frame: bytes,
        words: str | Callable[[], str],
        *,
        sealed: bool = False,
        opened: bytes | None = None,
    ) -> None:
        """Write a whole message with this node to the trace, if there is one; see ``Trace.message``.

        ``words`` may be a function, which is called only if there is a trace.
        """
        if self.trace is not None:
            uuid, text = self.identity.uuid, words if isinstance(words, str) else words()
            self.trace.message(self.link.via, direction, frame, text, uuid=uuid, sealed=sealed, opened=opened)


class Port(Protocol):
    """A reader or a bus on which nodes are found.

    Thread-safe: a bus carries exchanges with several nodes at once, each in the thread of its caller; a reader serves
    one tap at a time.
    """

    @property
    def via(self) -> str:
        """Name of the link in the registry: ``nfc``, ``can``. For people; decide by :attr:`capabilities`."""

    @property
    def place(self) -> str:
        """Place of this port, as it was opened: ``nfc:usb:072f:2200``, ``can:socketcan:can0``."""

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of this link."""

    def find(
        self, wanted: Callable[[Identity], bool], *, seconds: float, notice: NoticeSink, address: int | None = None
    ) -> Contact:
        """Wait until a node for which ``wanted`` is true is tapped or answers on the bus.

        ``address`` is the CAN address to try first, a guess (ignored by NFC). Raises NoNodeError after ``seconds``.
        Foreign tags and unwanted nodes are reported through ``notice`` and waited past.
        """

    def find_all(self, *, seconds: float, notice: NoticeSink, listen: float = 0.0) -> list[Contact]:
        """Wait until any node is tapped, or answers on the bus; return all that answer. Raises NoNodeError.

        A link that carries many listens for at least ``listen`` seconds, however soon the first ones answered; a node
        that is named by its address ends the wait.
        """

    def watch(self, *, stop: threading.Event, notice: NoticeSink) -> Iterator[Contact]:
        """Yield every node as it comes, once per visit (debounced), until ``stop`` is set; survives unplugging.

        A node counts as gone when it was removed (NFC) or stayed silent (CAN); the consumer closes the link.
        """

    def close(self) -> None:
        """Release the reader or the bus; never raises."""


ContactSink = Callable[[Contact], object]
"""Takes a node that was found; it must not block."""


@runtime_checkable
class EarlyFinder(Protocol):
    """A port that yields nodes while its search is still running (CAN)."""

    def find_all_early(self, *, seconds: float, notice: NoticeSink, listen: float, seen: ContactSink) -> list[Contact]:
        """Return what ``Port.find_all`` returns; ``seen`` is called with each node as soon as it has answered.

        It is called in the thread that asks, once for each address. Another node may still answer under the same UUID
        or address: until this returns, the node may be read, and nothing may be changed.
        """


class LinkSpec(Protocol):
    """WHERE of a place ``LINK:WHERE``, read."""

    @property
    def text(self) -> str:
        """Name of the bus or adapter in a message."""

    def require_known(self) -> None:
        """Raise UsageError for an option that the bus does not have."""


@runtime_checkable
class SharedBus(LinkSpec, Protocol):
    """A bus on which each station, and each of its processes, has a source address."""

    @property
    def wire(self) -> str:
        """Identity of the bus on this machine."""

    @property
    def source(self) -> int:
        """The source address that is used."""

    @property
    def source_named(self) -> bool:
        """True if the user named it."""

    @property
    def sources(self) -> tuple[int, ...]:
        """The source addresses that may be used, the first choice first."""


LISTEN_SECONDS: Final = 3.0


@dataclass(frozen=True)
class LinkSettings:
    """The user's link options, unparsed: ``--via``, ``--nfc``, ``--can`` (one or several), ``--ble``, ``--timeout``.

    ``timeout`` in seconds; ``listen`` is how long a command that collects nodes listens at least: 3 s, or ``--timeout``
    if that was given. ``nfc`` None or ``auto``: the only reader. ``trace`` is an open one (--trace). ``via_chosen``:
    the kind of link was given, so that no other is searched. ``reader_chosen`` False: ``nfc`` is a setting of this
    machine, not an option of this command, so that a node may be elsewhere as well.
    """

    via: str = "nfc"
    nfc: str | tuple[str, ...] | None = None
    can: str | tuple[str, ...] | None = None
    ble: str | None = None
    timeout: float = 60.0
    trace: Trace | None = None
    listen: float = LISTEN_SECONDS
    via_chosen: bool = False
    reader_chosen: bool = True

    @property
    def names_no_link(self) -> bool:
        """True if neither a link nor a reader was given: any that the node may be on will do."""
        return self.via == "nfc" and not (self.nfc and self.reader_chosen) and not self.via_chosen

    def at(self, place: str) -> LinkSettings:
        """Return the same settings at another place, ``LINK:WHERE``."""
        via, _, where = place.partition(":")
        there = replace(self, via=via, via_chosen=True)
        if via == "can":
            return replace(there, can=where or None)
        return replace(there, ble=where or None) if via == "ble" else replace(there, nfc=where or None)

    def at_places(self, places: Sequence[str]) -> LinkSettings:
        """Return the same settings at other places of the same link."""
        wheres = tuple(place.partition(":")[2] for place in places)
        return replace(self, can=wheres) if self.via == "can" else self.at(places[0])

    @property
    def buses(self) -> tuple[str, ...]:
        """The places of every named bus and of the air, whatever ``via`` is."""
        return tuple(place for via in ("can", "ble") if getattr(self, via) for place in replace(self, via=via).places)

    @property
    def places(self) -> tuple[str, ...]:
        """Every place that ``via`` names, as ``LINK:WHERE``; WHERE is empty if the option was left out."""
        named = getattr(self, self.via, None)
        wheres = (named,) if isinstance(named, str) else named or ("",)
        return tuple(f"{self.via}:{where}" for where in wheres)

    @property
    def onward(self) -> str | None:
        """The place to continue at after the agreement: BLE, if a reader is named beside it; else None."""
        return f"ble:{self.ble}" if self.via == "nfc" and self.nfc and self.ble else None

    def after_agreeing(self) -> LinkSettings:
        """Return the links of a command that needs no tap: BLE, if a reader is named beside it."""
        return replace(self, via="ble") if self.onward else self


# Ports on this machine's loopback: for simulated readers and buses, and for trying out the web page.


def free_port(kind: socket.SocketKind | None = None) -> int:
    """Return a port of 127.0.0.1 that is free now; another program may take it in the next moment."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM if kind is None else kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
