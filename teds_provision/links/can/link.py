"""The link to one node on CAN: requests, replies, and recovery from lost frames (profile.md, "CAN")."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from queue import Empty
from typing import Final

from teds_provision.errors import (
    AddressConflictError,
    BadDataError,
    GarbledError,
    LinkError,
    MessageTooLongError,
    NodeSilentError,
)
from teds_provision.links.can.bus_multiplexer import AddressPair, BusMultiplexer, Listener
from teds_provision.links.can.isotp import (
    FUNCTIONAL,
    OVERFLOW,
    WAIT,
    Frame,
    consecutive_frames,
    first_frame,
    gap_seconds,
    physical_id,
    single,
)
from teds_provision.links.can.spec import LAST_NODE
from teds_provision.links.ports import CAN, BusFrame, Capabilities
from teds_provision.protocol.messages.frames import IDENTIFY, Reason, decode_reply, refusal
from teds_provision.protocol.messages.identity import Identity
from teds_provision.protocol.repetition import REPEAT_SECONDS, REPLY_SECONDS, TRIES

_SHARES: Final = (0.3, 0.7, 1.0)
_LOSSY_SHARES: Final = (0.06, 0.24, 1.0)
"""Parts of the 5 s after which a request goes out again, on a bus that loses nothing and on one that lost a frame in
the last minute: a lost request costs 1.5 s or 0.3 s, and a slow node still has its 5 s."""
_PROMPT_SHARES: Final = (0.25, 0.25, 0.5)
"""Parts of the time that an order may take (operation.md section 2, "No late orders")."""
_FLOW_SECONDS: Final = (0.25, 0.5, 1.0)
"""The wait for a flow control, try after try, at most N_Bs of ISO 15765-2: a lost one ends it early."""
_GAP_SECONDS: Final = 1.0
"""The wait for the next consecutive frame (N_Cr, profile.md, "CAN"): a node that is slower has given up its reply."""
_PROMPT_GAP_SECONDS: Final = 0.5
"""The same for an order: the next one is due soon."""
_HELLO_SECONDS: Final = 1.0
_BUSY: Final = refusal(Reason.BUSY).encode()
BUSY_SECONDS: Final = 10.0
BUSY_PAUSE: Final = 0.1
"""A node that cannot take a long request now is sent it again after each pause, for so long (profile.md, "CAN")."""
_HOPE_SECONDS: Final = 0.1
"""Seconds between two checks whether the caller still expects a reply."""
_LONGEST_TRY: Final = 120.0
"""Seconds: 4095 octets at the longest gap (127 ms) that a node may ask for take 75 s."""


def conflict(node: int) -> AddressConflictError:
    """Return the error for two nodes under one address."""
    return AddressConflictError(
        f"Two nodes answer at CAN address 0x{node:02X}.",
        hint="If they have one UUID, disconnect the copy (a virtual one: make it again with --new-uuid)."
        " Otherwise tap one of them, or connect it alone, then run: teds-provision address UUID NEW.",
    )


class _EarlyReplyError(Exception):
    """The reply came as a single frame in place of a flow control: most of the request was not sent."""

    def __init__(self, reply: tuple[bytes, float]) -> None:
        super().__init__()
        self.reply = reply


class _NoFlowControlError(Exception):
    """The node did not accept our first frame, or a block; ``begun`` is true if it accepted any."""

    def __init__(self, *, begun: bool) -> None:
        super().__init__()
        self.begun = begun


def _is_of_a_node(frame: Frame) -> bool:
    return 1 <= frame.identifier & 0xFF <= LAST_NODE


class SingleFrames:
    """The frames of an open bus, one by one; see ``links.ports.BusFrames``."""

    def __init__(self, bus: BusMultiplexer, heard: Listener, own: int) -> None:
        self._bus, self._heard, self.own, self.fd = bus, heard, own, bus.spec.fd

    def send(self, identifier: int, octets: bytes, *, fd: bool = False) -> None:
        """Put one frame on the bus."""
        self._bus.send(Frame(identifier, octets, fd))

    def next(self, seconds: float) -> BusFrame | None:
        """Return the next frame of a node; None after ``seconds``."""
        until = time.monotonic() + seconds
        while (frame := self._heard.get(max(0.0, until - time.monotonic()))) is None:
            if time.monotonic() >= until:
                return None
        return BusFrame(frame.identifier, frame.data, frame.at)


class CanLink:
    """One node's line: the pair of its address and ours. ``bus`` gives the open bus, ``number`` a transaction."""

    via: Final = "can"

    def __init__(
        self,
        bus: Callable[[], BusMultiplexer],
        number: Callable[[], int],
        address: int,
        *,
        reply_seconds: float | None = None,
        source: int | None = None,
    ) -> None:
        self._bus, self._number, self._source = bus, number, source
        self.address = address
        self._last = 0
        self.left = self.came = 0.0  # see links.ports.DeadlineLink, TimestampedLink
        self.gap = 0  # see links.ports.PacedLink
        self.hopeless: Callable[[], bool] = lambda: False  # see links.ports.CancellableLink
        self._reply_seconds = REPLY_SECONDS if reply_seconds is None else reply_seconds

    @property
    def capabilities(self) -> Capabilities:
        """Capabilities of a node on a bus."""
        return CAN

    def exchange(self, frame: bytes) -> bytes:
        """Send one command frame and return its reply; see ``Link.exchange``."""
        return self.exchange_limited(frame, tries=TRIES, seconds=self._reply_seconds)

    def exchange_within(self, frame: bytes, seconds: float) -> bytes:
        """Send one command frame that is of no use after ``seconds``; see ``DeadlineLink.exchange_within``."""
        self._last = self._number()
        return self._ask(frame, self._last, tries=TRIES, seconds=seconds, prompt=True)

    def resend(self, frame: bytes) -> bytes:
        """Send the last frame once more under its transaction; see ``ResendLink.resend``."""
        return self._ask(frame, self._last, tries=TRIES, seconds=self._reply_seconds)

    def wait_for_air(self) -> bool:
        """Wait until a long transfer may go on; see ``TransferLink.wait_for_air``."""
        return self._bus().transfer_pace.wait()

    def close(self) -> None:
        """Do nothing: CAN has no connection to end."""

    # -- for testing a node, see links.ports.MultiStationLink

    def from_station(self, source: int) -> CanLink:
        """Return a link to the same node from another station's address."""
        return CanLink(self._bus, self._number, self.address, reply_seconds=self._reply_seconds, source=source)

    def identify_functional(self) -> bytes:
        """Send a functional Identify; return the reply frame of this node, empty if none came."""
        bus, transaction = self._bus(), self._number()
        with bus.gather(transaction) as asked:
            until, fd = time.monotonic() + _HELLO_SECONDS, bus.spec.fd
            bus.send(Frame(FUNCTIONAL | bus.own, single(bytes([transaction]) + IDENTIFY.encode(), fd=fd), fd))
            while (left := until - time.monotonic()) > 0 and self.address not in asked.replies.answers:
                asked.next(left)
                bus.check()
            return asked.replies.answers.get(self.address, b"")

    def identify_at(self, address: int) -> Identity | None:
        """Return the identity of the node that answers Identify at this address, None for none."""
        link = CanLink(self._bus, self._number, address, source=self._source)
        try:
            reply = decode_reply(link.exchange_limited(IDENTIFY.encode(), tries=1, seconds=_HELLO_SECONDS))
            return Identity.decode(reply.payload)
        except (NodeSilentError, GarbledError, BadDataError):
            return None

    def begin(self, octets: int) -> bytes:
        """Send the first frame of a request of so many octets; return the frame by which the node answers it."""
        bus, transaction = self._bus(), self._number()
        with bus.address_pair(self.address, self._source).exchange(transaction) as line:
            head, _ = first_frame(bytes([transaction]).ljust(octets, b"\0"), fd=bus.spec.fd)
            bus.send(Frame(physical_id(line.node, line.own), head, bus.spec.fd))
            until = time.monotonic() + _HELLO_SECONDS
            while time.monotonic() < until:
                with suppress(Empty):
                    if flow := bus.next_of(line.flows, 0.01):  # an empty item only means that a reply has come
                        return flow
                with suppress(Empty):
                    event = bus.next_of(line.events, 0.01)
                    return single(event.body, fd=bus.spec.fd) if event.kind == "whole" else b"\x10"
        return b""

    @contextmanager
    def single_frames(self) -> Iterator[SingleFrames]:
        """Return the frames of the bus, one by one; see ``links.ports.FramedLink``."""
        bus = self._bus()
        with bus.listen(_is_of_a_node) as heard:
            yield SingleFrames(bus, heard, self._source or bus.own)

    def exchange_limited(self, frame: bytes, *, tries: int, seconds: float) -> bytes:
        """Exchange as ``exchange`` does, at most ``tries`` times, each with ``seconds`` of silence allowed."""
        self._last = self._number()
        return self._ask(frame, self._last, tries=tries, seconds=seconds)

    def _ask(self, frame: bytes, transaction: int, *, tries: int, seconds: float, prompt: bool = False) -> bytes:
        bus = self._bus()
        try:
            with bus.address_pair(self.address, self._source).exchange(transaction) as line:
                line.gap = self.gap
                body = bytes([transaction]) + frame
                exchange = _Exchange(bus, line, body, tries, seconds, prompt=prompt, hopeless=self.hopeless)
                self.left = self.left or time.monotonic()
                reply, self.came = exchange.run()
        except LinkError as failure:
            if bus.conflicts.seen_within() and not bus.failed:
                raise type(failure)(f"{failure.message} {bus.conflicts.text}", hint=bus.conflicts.hint) from failure
            raise
        if bus.has_conflict(self.address):
            raise conflict(self.address)
        return reply[1:]


class _Exchange:
    """One request and its reply, repeated as needed. Runs in the caller's thread."""

    def __init__(
        self,
        bus: BusMultiplexer,
        line: AddressPair,
        body: bytes,
        tries: int,
        seconds: float,
        *,
        prompt: bool,
        hopeless: Callable[[], bool],
    ) -> None:
        self._bus, self._line, self._body = bus, line, body
        self._tries, self._seconds, self._prompt, self._hopeless = tries, seconds, prompt, hopeless
        self._longest = seconds if prompt else REPEAT_SECONDS
        self._gap = _PROMPT_GAP_SECONDS if prompt else _GAP_SECONDS
        self._fd = bus.spec.fd
        self._torn = False
        self._clash = False

    def run(self) -> tuple[bytes, float]:
        """Return the whole reply, transaction first, and when it was whole (time.monotonic).

        Raises NodeSilentError, GarbledError, AddressConflictError, LinkError.
        """
        began = time.monotonic()
        whole = refused = 0
        while whole < self._tries and not self._hopeless():
            try:
                seconds = _FLOW_SECONDS[min(refused, len(_FLOW_SECONDS) - 1)]
                self._send(min(seconds, self._seconds * _PROMPT_SHARES[0]) if self._prompt else seconds)
            except _EarlyReplyError as answered:
                busy = answered.reply[0][1:] == _BUSY and not self._prompt
                if not busy or time.monotonic() - began >= BUSY_SECONDS:
                    return answered.reply
                # the node cannot receive a long request yet: send the same octets again, not counted as a repetition
                time.sleep(BUSY_PAUSE)
                continue
            except _NoFlowControlError as lost:
                refused += 1
                if lost.begun:
                    self._bus.note_loss()
                if not self._worth_another(began, refused, begun=lost.begun):
                    break
                continue
            share = self._share(whole)
            whole += 1
            reply = self._reply(self._seconds * share)
            if reply is not None:
                return reply
            # drops the partial reply, so that a repeated first frame is not taken for a doubled one
            self._line.partial = None
            if time.monotonic() - began >= self._longest:
                break
        raise self._failed()

    def _share(self, whole: int) -> float:
        """Return the part of the time for which the reply to the next sending is waited for."""
        if self._prompt:
            return _PROMPT_SHARES[whole]
        shares = _LOSSY_SHARES if self._bus.lossy else _SHARES
        return shares[max(0, len(shares) - self._tries + whole)] if self._tries > 1 else 1.0

    def _worth_another(self, began: float, refused: int, *, begun: bool) -> bool:
        """Return True if a request that never went out whole is worth another try.

        At once, while the node may only be busy.
        """
        passed = time.monotonic() - began
        if begun or self._prompt:
            return passed < self._longest
        return self._tries > 1 and (refused < self._tries or passed < self._seconds)

    def _send(self, patience: float) -> None:
        """Send the request.

        Raises _NoFlowControlError if the node does not take it up, GarbledError if it is too long for it.
        """
        if len(self._body) <= (62 if self._fd else 7):
            self._put(single(self._body, fd=self._fd))
            return
        while not self._line.flows.empty():
            self._line.flows.get_nowait()
        head, rest = first_frame(self._body, fd=self._fd)
        self._put(head)
        left, begun = 0, False
        block, gap = 0, 0.0
        end = time.monotonic() + _LONGEST_TRY
        for data in consecutive_frames(rest, fd=self._fd):
            if not left:
                block, gap = self._flow(patience, end, begun=begun)
                left, begun = block or len(self._body), True
            elif gap:
                time.sleep(gap)
            self._put(data)
            left -= 1

    def _flow(self, patience: float, end: float, *, begun: bool) -> tuple[int, float]:
        """Wait for a flow control; return its block size (0: no limit) and gap in seconds.

        A node may send Wait for as long as a request is repeated, and not beyond ``end`` (monotonic).
        """
        until = time.monotonic() + patience
        end = min(end, time.monotonic() + REPEAT_SECONDS)
        while (left := min(until, end) - time.monotonic()) > 0:
            try:
                data = self._bus.next_of(self._line.flows, left)
            except Empty:
                break
            if len(data) < 3:
                self._bus.check()
                with suppress(Empty):
                    event = self._line.events.get_nowait()
                    if event.kind == "whole":
                        raise _EarlyReplyError((event.body, event.at))
                continue
            if data[0] == OVERFLOW:
                raise MessageTooLongError(
                    f"The node at 0x{self._line.node:02X} refuses {len(self._body)} octets (flow control: overflow).",
                    hint="It announces a longer maxMessage than it can handle.",
                )
            if data[0] == WAIT:
                until = time.monotonic() + 1.0
            elif data[0] & 0xF == 0:
                return data[1], gap_seconds(data[2])
        raise _NoFlowControlError(begun=begun)

    def _put(self, data: bytes) -> None:
        self._bus.send(Frame(physical_id(self._line.node, self._line.own), data, self._fd))

    def _reply(self, seconds: float) -> tuple[bytes, float] | None:
        """Wait for the reply; None after ``seconds`` without a beginning, or if it is torn."""
        until = time.monotonic() + seconds
        end = time.monotonic() + _LONGEST_TRY
        while (left := min(until, end) - time.monotonic()) > 0:
            try:
                event = self._bus.next_of(self._line.events, min(left, _HOPE_SECONDS))
            except Empty:
                self._bus.check()
                if self._line.partial is None:
                    if self._hopeless():
                        return None
                    continue
                until = self._line.heard_at + self._gap  # more frames came, or the reply is torn
                self._torn = self._torn or until <= time.monotonic()
                continue
            match event.kind:
                case "whole":
                    return event.body, event.at
                case "begun":
                    until = time.monotonic() + self._gap
                case "clash":
                    self._clash = True
                case "torn":
                    self._torn = True
                    self._bus.note_loss()
                    return None
                case _:  # the bus failed, or a node announced itself at this address
                    self._bus.check()
                    if self._hopeless():
                        return None
        return None

    def _failed(self) -> LinkError:
        where = f"The node at 0x{self._line.node:02X} on {self._bus.spec.text}"
        if self._clash or self._bus.has_conflict(self._line.node):
            return conflict(self._line.node)
        if self._torn:
            return GarbledError(
                f"{where} answers, but frames of its replies are missing.", hint="Check wiring, bit rate, bus load."
            )
        return NodeSilentError(f"{where} no longer answers.", hint="Check its power, its wiring and its address.")
