"""The board as the rules see it: frames out, replies in, and what is known of it so far."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final

from teds_provision.check import slips
from teds_provision.check.slips import Slip
from teds_provision.errors import BadDataError, GarbledError, MessageTooLongError, NodeSilentError, NotAuthenticError
from teds_provision.links import Contact
from teds_provision.links.ports import Direction, FramedLink, Link, MultiStationLink, ResendLink, Trace
from teds_provision.protocol.datasheet import SignedNodeKey
from teds_provision.protocol.keys import Credentials, SoftwareKey
from teds_provision.protocol.messages.frames import (
    IDENTIFY,
    Command,
    Function,
    Reason,
    Reply,
    decode_list,
    decode_reply,
    read_teds,
    security_command,
)
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.messages.tables import describe_answer, describe_command, describe_reply
from teds_provision.protocol.session import TAG_OCTETS, StationSession, open_mac
from teds_provision.protocol.wire_agreement import AgreedKey, key_id
from teds_provision.provisioning.conversation import BUSY_PAUSE, BUSY_SECONDS
from teds_provision.teds.codec import security
from teds_provision.teds.codec.security import SecurityTeds
from teds_provision.teds.image import SECURITY as SECURITY_TEDS
from teds_provision.teds.image import BlockId
from teds_provision.teds.sheet import ChannelKind

OVER_CAN: Final = "Connect the board's CAN, and add: --via can --can INTERFACE:CHANNEL"
OVER_NFC: Final = "Put the board on an NFC reader, and add: --via nfc"
"""The connection that lets a skipped rule run, as text for the user."""
_LARGEST_TEDS: Final = 1 << 20
_FAR_COUNTER: Final = 1000
"""Of a session in which slips are tried: later than every counter before."""
_STATIONS: Final = range(0xF7, 0xF0, -1)
"""Addresses of base stations, those first that a real one has least often."""


class RuleBrokenError(Exception):
    """The node broke the rule; the text gives what was sent, expected and received.

    ``slip`` is the known slip that explains it, if there is one.
    """

    def __init__(self, text: str, slip: Slip | None = None) -> None:
        super().__init__(text if slip is None else f"{text} {slip.sentence}")
        self.slip = slip


class NotApplicableError(Exception):
    """The rule does not apply to this node, link or state; the node is not at fault.

    The text gives the reason.
    """


@dataclass(frozen=True)
class HeardFrame:
    """One frame: a CAN frame with its ``identifier``, or a block of the NFC link."""

    link: str
    direction: Direction
    octets: bytes
    identifier: int | None
    fd: bool


@dataclass
class TraceRecorder:
    """A trace that remembers the frames and hands everything on to ``further``; see ``links.ports.Trace``."""

    further: Trace | None = None
    frames: list[HeardFrame] = field(default_factory=list)

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
        """Remember a frame."""
        self.frames.append(HeardFrame(link, direction, bytes(octets), identifier, fd))
        if self.further is not None:
            self.further.frame(link, direction, octets, identifier=identifier, fd=fd, at=at)

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
        """Hand a message on."""
        if self.further is not None:
            self.further.message(link, direction, octets, words, uuid=uuid, sealed=sealed, opened=opened)


class Probe:
    """One node under test. ``credentials`` is this station's, ``key`` the link key if there is one.

    ``heard`` are the frames of its link, None if they were not recorded. ``keep`` makes a new key durable here before
    its Confirm leaves; None if no key may change. ``okm`` is that of the agreement that gave ``key``, if this run made
    it. ``line`` is the line of the current rule, by default this station's.
    """

    def __init__(self, contact: Contact, heard: TraceRecorder | None = None) -> None:
        self.contact, self.heard = contact, heard
        self.line: Link = contact.link
        self.uuid = contact.identity.uuid
        self.max_message = contact.identity.max_message
        self.credentials: Credentials | None = None
        self.keep: Callable[[AgreedKey], None] | None = None
        self.key: bytes | None = None
        self.okm = b""
        self.session: StationSession | None = None
        self.no_session = ""
        """The reason why no session opened; empty if none was tried, or the last one did."""
        self.no_agreement = ""
        """The reason why a good Request failed; empty if none was tried, or one succeeded."""
        self._sealed_once = False
        self._shown: SecurityTeds | None = None
        self.home_address, self.moved_at = 0, 0.0
        """The CAN address of the node before a rule moved it, 0 if none did; and the time of the move."""
        self.asked = ""
        """The last command that was sent, in words."""
        self.before_rotation: tuple[Identity, dict[BlockId, bytes]] | None = None
        """Identify and the TEDS of the node before it got another key; None until then."""
        self.channels: dict[int, tuple[ChannelKind, int]] = {}
        """Kind and ModLenth of the channels that can be claimed, by number; empty until that was asked."""
        self.no_channels = ""
        """Why no channel can be claimed; empty if that was not asked, or one can."""
        self.own_blocks: dict[BlockId, bytes] | None = None
        """The board's own TEDS while others are there for trying; None while its own are."""

    # -- frames ----------------------------------------------------------------------------------------------------

    def octets(self, frame: bytes, what: str, *, inside: Command | None = None) -> Reply:
        """Send these octets as a whole command frame. Raises RuleBrokenError if no whole reply frame comes back.

        ``inside`` is the command that is sealed in them. Raises NodeSilentError if not even Identify is answered.
        """
        opened = None if inside is None else inside.encode()
        self.asked = what
        until = self.now() + BUSY_SECONDS
        while True:
            self.contact.note("out", frame, what, sealed=inside is not None, opened=opened)
            try:
                raw = self.line.exchange(frame)
            except NodeSilentError:
                self.listen()
                raise RuleBrokenError(f"{what}: no reply, and every command gets one.") from None
            except MessageTooLongError as refused:
                if len(frame) > self.max_message:
                    raise
                raise RuleBrokenError(
                    f"{what}: {len(frame)} octets are refused on the link; maxMessage is {self.max_message}."
                    f" {refused.message}"
                ) from None
            try:
                reply = decode_reply(raw)
            except GarbledError as error:
                raise RuleBrokenError(f"{what}: {error.message}") from None
            if len(raw) > self.max_message:
                raise RuleBrokenError(f"{what}: {len(raw)} octets came; maxMessage is {self.max_message}.")
            if inside is None or not reply.ok:  # sealed replies are recorded after they are opened
                self.contact.note("in", raw, f"reply to {what}: {describe_reply(reply)}")
            if reply.reason != Reason.BUSY:
                return reply
            if self.now() >= until:
                raise RuleBrokenError(
                    f"{what}: busy (17) for {BUSY_SECONDS:g} s, and nothing here keeps the node busy."
                )
            self.pause(BUSY_PAUSE)

    def listen(self) -> None:
        """Ask Identify and ignore its contents; raises LinkError if no answer comes."""
        self.line.exchange(IDENTIFY.encode())

    def pause(self, seconds: float) -> None:
        """Let time pass."""
        time.sleep(seconds)

    @property
    def bus(self) -> MultiStationLink:
        """The node's line if it is part of a bus; raises NotApplicableError elsewhere."""
        link = self.contact.link
        if not isinstance(link, MultiStationLink):
            raise NotApplicableError(f"Needs a second base station. {OVER_CAN}")
        return link

    @property
    def resending(self) -> ResendLink:
        """The line if a request can be sent again; raises NotApplicableError elsewhere."""
        if not isinstance(self.line, ResendLink):
            raise NotApplicableError(f"This link sends no request twice. {OVER_CAN}")
        return self.line

    @property
    def framed(self) -> FramedLink:
        """The node's line if its frames can be sent one by one; raises NotApplicableError elsewhere."""
        link = self.contact.link
        if not isinstance(link, FramedLink):
            raise NotApplicableError(f"Needs single CAN frames. {OVER_CAN}")
        return link

    def from_station(self, number: int) -> Probe:
        """Return the same node for another base station, ``number`` 1 or 2: with a separate line and session."""
        other = Probe(self.contact, self.heard)
        other.line, other.key, other.okm = self.bus.from_station(self.free_source(number)), self.key, self.okm
        other.credentials = self.credentials
        return other

    def free_source(self, number: int) -> int:
        """Return a base station address on which nothing was heard: the first (1), second or third.

        Raises NotApplicableError if there are not so many.
        """
        frames = self.heard.frames if self.heard is not None else []
        out = [frame.identifier & 0xFF for frame in frames if frame.identifier is not None and frame.direction == "out"]
        taken = {
            frame.identifier & 0xFF for frame in frames if frame.identifier is not None and frame.direction == "in"
        }
        free = [source for source in _STATIONS if source not in taken | set(out[:1])]
        if number > len(free):
            raise NotApplicableError(
                "The other base stations use all addresses, F1 to F7: disconnect one of them from this bus."
            )
        return free[number - 1]

    def now(self) -> float:
        """Return monotonic seconds."""
        return time.monotonic()

    def move(self, address: int) -> None:
        """Ask the node at another CAN address from now on."""
        self.moved_at = self.now()
        if isinstance(self.contact.link, MultiStationLink):
            self.contact.link.address = address
            self.contact = replace(self.contact, address=address)

    def plain(self, command: Command) -> Reply:
        """Send a plain command."""
        return self.octets(command.encode(), describe_command(command))

    def good(self, command: Command) -> bytes:
        """Send a plain command that must succeed; its payload."""
        reply = self.plain(command)
        if not reply.ok:
            raise RuleBrokenError(f"{describe_command(command)}: success is due, {describe_reply(reply)} came.")
        return reply.payload

    def refused(self, command: Command, reason: int, why: str = "") -> str:
        """Send a plain command that must be refused for this reason; what was seen."""
        return demand(self.plain(command), reason, describe_command(command) + (f", {why}" if why else ""))

    # -- sessions --------------------------------------------------------------------------------------------------

    @property
    def link_key(self) -> bytes:
        """The link key; raises NotApplicableError if there is none."""
        if self.key is None:
            raise NotApplicableError("This station holds no key of the node.")
        return self.key

    @property
    def station(self) -> Credentials:
        """The credentials of this station; raises NotApplicableError if the vault was not opened."""
        if self.credentials is None:
            raise NotApplicableError("Needs this station's keys.")
        return self.credentials

    def open(self) -> StationSession:
        """Open a session.

        Raises RuleBrokenError if the node's reply or tag is wrong, NotApplicableError the next time.
        """
        if self.no_session:
            raise NotApplicableError(f"Needs a session, and none opens: {self.no_session}")
        try:
            self.session = self._opened()
        except RuleBrokenError as broken:
            self.no_session = str(broken)
            raise
        return self.session

    def _opened(self) -> StationSession:
        key, one_time = self.link_key, SoftwareKey.generate()
        session = StationSession(key, self.uuid, one_time=one_time)
        command = session.open(self.opening_counter())
        reply = self.plain(command)
        if reply.reason == Reason.BAD_TAG:  # another station may have used up the counter
            command = session.open(self.opening_counter())
            reply = self.plain(command)
        if not reply.ok:
            raise RuleBrokenError(
                f"{describe_command(command)}: success is due, {describe_reply(reply)} came.",
                self._slip_of_open(reply, one_time),
            )
        try:
            session.accept(reply.payload)
        except (GarbledError, NotAuthenticError) as error:
            slip = slips.of_session(key, self.uuid, one_time, reply.payload)
            raise RuleBrokenError(f"Open (128.3): {error.message}", slip) from None
        return session

    def opening_counter(self) -> bytes:
        """Return c of Open, 8 octets; raises RuleBrokenError."""
        counter = self.good(security_command(Function.OPEN))
        holds(len(counter) == 8, f"Open (128.3) without payload: c has {len(counter)} octets, 8 are due.")
        return counter

    def _slip_of_open(self, reply: Reply, one_time: SoftwareKey) -> Slip | None:
        """Return the slip that the node accepts in keyId (after reply 16) or mac (after 12); each is tried in turn."""
        if reply.reason not in (Reason.UNKNOWN_KEY, Reason.BAD_TAG):
            return None
        about_key, key, point = reply.reason == Reason.UNKNOWN_KEY, self.link_key, one_time.point

        def takes(payload: Callable[[bytes], bytes]) -> bool:
            return self.plain(security_command(Function.OPEN, payload(self.opening_counter()))).ok

        # If the node accepts a correct Open, or a mac of zeros, no slip explains its refusal.
        if takes(lambda counter: key_id(key) + point + open_mac(key, self.uuid, counter, point)):
            return None
        if takes(lambda _: (bytes(8) if about_key else key_id(key)) + point + bytes(TAG_OCTETS)):
            return None
        tries = slips.opens(key, self.okm, self.uuid, point, about_key=about_key)
        return next((slip for slip, payload in tries if takes(payload)), None)

    def sealed(self, command: Command) -> Reply:
        """Send a command in the session, opening one if needed, and return the inner reply."""
        session = self.session or self.open()
        try:
            reply = self._sealed(session, command)
        except RuleBrokenError as broken:
            if not self._sealed_once:
                self.no_session = str(broken)
            raise
        self._sealed_once = True
        return reply

    def _sealed(self, session: StationSession, command: Command) -> Reply:
        sealed = session.seal(command)
        outer = self.octets(sealed.encode(), describe_command(command), inside=command)
        if not outer.ok:
            self.session = None
            slip = self._slip_of_sealed(session) if outer.reason == Reason.BAD_TAG else None
            raise RuleBrokenError(
                f"{describe_command(command)}, sealed: a sealed reply is due, {describe_reply(outer)} came.", slip
            )
        try:
            inner = session.unseal(outer.payload)
        except (GarbledError, NotAuthenticError) as error:
            self.contact.note("in", outer.encode(), describe_answer(command, outer), sealed=True)
            self.session = None
            slip = slips.of_sealed_reply(session.keys, outer.payload, int.from_bytes(sealed.payload[:4], "big"))
            raise RuleBrokenError(f"{describe_command(command)}, sealed: {error.message}", slip) from None
        self.contact.note("in", outer.encode(), describe_answer(command, inner), sealed=True, opened=inner.encode())
        return inner

    def _slip_of_sealed(self, session: StationSession) -> Slip | None:
        """Return the slip that explains how the node opens Sealed frames; each is tried under other counters."""

        def takes(payload: bytes) -> bool:
            return self.plain(security_command(Function.SEALED, payload)).ok

        right = session.seal(IDENTIFY, counter=_FAR_COUNTER).payload
        if takes(right) or takes(right[:4] + bytes(len(right) - 4)):
            return None  # it accepts a correct frame now, or any frame: no slip explains either
        tries = enumerate(slips.SEALED, _FAR_COUNTER + 1)
        frame = IDENTIFY.encode()
        return next((slip for counter, (slip, seal) in tries if takes(seal(session.keys, counter, frame))), None)

    def sealed_good(self, command: Command) -> bytes:
        """Send a sealed command that must succeed, and return the inner payload."""
        reply = self.sealed(command)
        if not reply.ok:
            raise RuleBrokenError(f"{describe_command(command)}, sealed: success is due, {describe_reply(reply)} came.")
        return reply.payload

    def sealed_refused(self, command: Command, reason: int, why: str = "") -> str:
        """Send a sealed command that must be refused inside."""
        return demand(
            self.sealed(command), reason, f"{describe_command(command)}, sealed" + (f", {why}" if why else "")
        )

    def close(self) -> None:
        """Close the session; any answer is accepted."""
        if self.session is not None:
            self.plain(self.session.seal(security_command(Function.CLOSE)))
            self.session = None

    # -- facts about the node --------------------------------------------------------------------------------------

    @property
    def noisy(self) -> bool:
        """True if single frames may be lost or disturbed on this link without a fault of the node: a bus."""
        return self.contact.link.capabilities.many

    @property
    def tapped(self) -> bool:
        """True if commands of this link count as tapped in every state of the node."""
        return self.line.capabilities.tapped

    def identity(self) -> Identity:
        """Send Identify now and return the node's answer."""
        try:
            return Identity.decode(self.good(IDENTIFY))
        except BadDataError as error:
            raise RuleBrokenError(f"Identify (128.7): {error.message}") from None

    def require(self, *states: NodeState) -> Identity:
        """Identify; raises NotApplicableError in another state than these."""
        identity = self.identity()
        if identity.state not in states:
            raise NotApplicableError(f"The node is {identity.state.name.lower()}.")
        return identity

    def listed(self) -> list[BlockId]:
        """List, in whatever order the node gives it."""
        payload = self.good(security_command(Function.LIST))
        if len(payload) % 3:
            raise RuleBrokenError(f"List (128.11): {len(payload)} octets are no multiple of 3.")
        try:
            return decode_list(payload)
        except GarbledError:
            cut = range(0, len(payload), 3)
            return [(int.from_bytes(payload[at : at + 2], "big"), payload[at + 2]) for at in cut]

    def teds(self, block: BlockId) -> bytes:
        """Read a whole TEDS, plainly, until Read hands out no more."""
        octets = b""
        while len(octets) < _LARGEST_TEDS:
            payload = self.good(read_teds(*block, len(octets)))
            if payload[:4] != len(octets).to_bytes(4, "big"):
                raise RuleBrokenError(
                    f"Read (1.2) of {block}: offset {len(octets)} was asked, {payload[:4].hex()} came."
                )
            if len(payload) == 4:
                return octets
            octets += payload[4:]
        raise RuleBrokenError(f"Read (1.2) of {block}: no end after {len(octets)} octets.")

    def security(self) -> SecurityTeds:
        """Return the present Security TEDS, decoded; raises RuleBrokenError if it is not canonical."""
        try:
            shown = security.decode(self.teds(SECURITY_TEDS))
        except BadDataError as error:
            raise RuleBrokenError(f"Security TEDS: {error.message}") from None
        self._shown = self._shown or shown
        return shown

    @property
    def node_keys(self) -> SignedNodeKey:
        """Fields 101 and 102, as the first Security TEDS that could be read had them: they never change."""
        shown = self._shown or self.security()
        return SignedNodeKey(self.uuid, shown.node_key, shown.node_key_signature)

    @property
    def node_key(self) -> bytes:
        """P(node), field 101."""
        return self.node_keys.key


def demand(reply: Reply, reason: int, what: str) -> str:
    """Hold a reply against the refusal that is due; raises RuleBrokenError."""
    if reply.ok or reply.payload != bytes([reason]):
        raise RuleBrokenError(f"{what}: refusal {reason} is due, {describe_reply(reply)} came.")
    return f"{what}: {describe_reply(reply)}"


def holds(what: bool, text: str) -> None:
    """Raise RuleBrokenError with this text if the condition is false."""
    if not what:
        raise RuleBrokenError(text)
