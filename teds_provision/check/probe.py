"""The board as the rules see it: frames out, replies in, and what is known of it so far."""

from __future__ import annotations

import time
from typing import Final

from teds_provision.check.heard import Heard
from teds_provision.check.outcome import NotApplicable, RuleBroken
from teds_provision.errors import BadData, Garbled, NodeSilent, NotAuthentic
from teds_provision.links import Contact
from teds_provision.protocol.agreement import Credentials
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
from teds_provision.protocol.messages.words import answered, named, told
from teds_provision.protocol.session import StationSession
from teds_provision.talk.conversation import BUSY_PAUSE, BUSY_SECONDS
from teds_provision.teds.codec import security
from teds_provision.teds.codec.security import SecurityTeds
from teds_provision.teds.image import SECURITY as SECURITY_TEDS
from teds_provision.teds.image import BlockId

_LARGEST_TEDS: Final = 1 << 20


class Probe:
    """One node under test. ``credentials`` is this station's, ``key`` the link key where one is held.

    ``heard`` are the frames of its link, None where nobody listened.
    """

    def __init__(self, contact: Contact, heard: Heard | None = None) -> None:
        self.contact, self.heard = contact, heard
        self.uuid = contact.identity.uuid
        self.max_message = contact.identity.max_message
        self.credentials: Credentials | None = None
        self.key: bytes | None = None
        self.session: StationSession | None = None
        self.asked = ""
        """The last command that was sent, in words."""

    # -- frames ----------------------------------------------------------------------------------------------------

    def octets(self, frame: bytes, what: str, *, inside: Command | None = None) -> Reply:
        """Send these octets as a whole command frame. Raises RuleBroken where no whole reply frame comes back.

        ``inside`` is the command that is sealed in them. Raises NodeSilent where not even Identify is answered.
        """
        opened = None if inside is None else inside.encode()
        self.asked = what
        until = time.monotonic() + BUSY_SECONDS
        while True:
            self.contact.note("out", frame, what, sealed=inside is not None, opened=opened)
            try:
                raw = self.contact.link.exchange(frame)
            except NodeSilent:
                self.listen()
                raise RuleBroken(f"{what}: no reply, and every command gets one.") from None
            try:
                reply = decode_reply(raw)
            except Garbled as error:
                raise RuleBroken(f"{what}: {error.message}") from None
            if len(raw) > self.max_message:
                raise RuleBroken(f"{what}: {len(raw)} octets came; maxMessage is {self.max_message}.")
            if inside is None or not reply.ok:  # what is sealed is told when it is opened
                self.contact.note("in", raw, f"reply to {what}: {told(reply)}")
            if reply.reason != Reason.BUSY:
                return reply
            if time.monotonic() >= until:
                raise NotApplicable(f"{what}: the node is busy (17).")
            time.sleep(BUSY_PAUSE)

    def listen(self) -> None:
        """Ask Identify, whatever it says; raises LinkFailure where nothing comes."""
        self.contact.link.exchange(IDENTIFY.encode())

    def plain(self, command: Command) -> Reply:
        """Send a plain command."""
        return self.octets(command.encode(), named(command))

    def good(self, command: Command) -> bytes:
        """Send a plain command that must succeed; its payload."""
        reply = self.plain(command)
        if not reply.ok:
            raise RuleBroken(f"{named(command)}: success is due, {told(reply)} came.")
        return reply.payload

    def refused(self, command: Command, reason: int, why: str = "") -> str:
        """Send a plain command that must be refused for this reason; what was seen."""
        return demand(self.plain(command), reason, named(command) + (f", {why}" if why else ""))

    # -- sessions --------------------------------------------------------------------------------------------------

    @property
    def link_key(self) -> bytes:
        """The link key; raises NotApplicable where none is held."""
        if self.key is None:
            raise NotApplicable("This station holds no key of the node.")
        return self.key

    @property
    def station(self) -> Credentials:
        """What this station shows; raises NotApplicable where the vault was not opened."""
        if self.credentials is None:
            raise NotApplicable("Needs this station's keys.")
        return self.credentials

    def open(self) -> StationSession:
        """Open a session; raises RuleBroken where the node's reply or tag is wrong."""
        session = StationSession(self.link_key, self.uuid)
        try:
            session.accept(self.good(session.open(self.good(session.ask()))))
        except (Garbled, NotAuthentic) as error:
            raise RuleBroken(f"Open (128.3): {error.message}") from None
        self.session = session
        return session

    def sealed(self, command: Command) -> Reply:
        """Send a command in the session, which is opened where none is; the inner reply."""
        session = self.session or self.open()
        sealed = session.seal(command)
        outer = self.octets(sealed.encode(), named(command), inside=command)
        if not outer.ok:
            self.session = None
            raise RuleBroken(f"{named(command)}, sealed: a sealed reply is due, {told(outer)} came.")
        try:
            inner = session.unseal(outer.payload)
        except (Garbled, NotAuthentic) as error:
            self.contact.note("in", outer.encode(), answered(command, outer), sealed=True)
            self.session = None
            raise RuleBroken(f"{named(command)}, sealed: {error.message}") from None
        self.contact.note("in", outer.encode(), answered(command, inner), sealed=True, opened=inner.encode())
        return inner

    def sealed_good(self, command: Command) -> bytes:
        """A sealed command that must succeed; the inner payload."""
        reply = self.sealed(command)
        if not reply.ok:
            raise RuleBroken(f"{named(command)}, sealed: success is due, {told(reply)} came.")
        return reply.payload

    def sealed_refused(self, command: Command, reason: int, why: str = "") -> str:
        """A sealed command that must be refused inside."""
        return demand(self.sealed(command), reason, f"{named(command)}, sealed" + (f", {why}" if why else ""))

    def close(self) -> None:
        """Leave the session, whatever the node says."""
        if self.session is not None:
            self.plain(self.session.seal(security_command(Function.CLOSE)))
            self.session = None

    # -- what the node says ----------------------------------------------------------------------------------------

    @property
    def noisy(self) -> bool:
        """Whether single frames may be lost or disturbed here without anybody's fault: a bus."""
        return self.contact.link.capabilities.many

    @property
    def tapped(self) -> bool:
        """Whether commands of this link count as tapped whatever the node's state."""
        return self.contact.link.capabilities.tapped

    def identity(self) -> Identity:
        """Identify, asked now."""
        try:
            return Identity.decode(self.good(IDENTIFY))
        except BadData as error:
            raise RuleBroken(f"Identify (128.7): {error.message}") from None

    def require(self, *states: NodeState) -> Identity:
        """Identify; raises NotApplicable in another state than these."""
        identity = self.identity()
        if identity.state not in states:
            raise NotApplicable(f"The node is {identity.state.name.lower()}.")
        return identity

    def listed(self) -> list[BlockId]:
        """List, in whatever order the node gives it."""
        payload = self.good(security_command(Function.LIST))
        if len(payload) % 3:
            raise RuleBroken(f"List (128.11): {len(payload)} octets are no multiple of 3.")
        try:
            return decode_list(payload)
        except Garbled:
            cut = range(0, len(payload), 3)
            return [(int.from_bytes(payload[at : at + 2], "big"), payload[at + 2]) for at in cut]

    def teds(self, block: BlockId) -> bytes:
        """Read a whole TEDS, plainly, until Read hands out no more."""
        octets = b""
        while len(octets) < _LARGEST_TEDS:
            payload = self.good(read_teds(*block, len(octets)))
            if payload[:4] != len(octets).to_bytes(4, "big"):
                raise RuleBroken(f"Read (1.2) of {block}: offset {len(octets)} was asked, {payload[:4].hex()} came.")
            if len(payload) == 4:
                return octets
            octets += payload[4:]
        raise RuleBroken(f"Read (1.2) of {block}: no end after {len(octets)} octets.")

    def security(self) -> SecurityTeds:
        """The Security TEDS, decoded; raises RuleBroken where it is not canonical."""
        try:
            return security.decode(self.teds(SECURITY_TEDS))
        except BadData as error:
            raise RuleBroken(f"Security TEDS: {error.message}") from None


def demand(reply: Reply, reason: int, what: str) -> str:
    """Hold a reply against the refusal that is due; raises RuleBroken."""
    if reply.ok or reply.payload != bytes([reason]):
        raise RuleBroken(f"{what}: refusal {reason} is due, {told(reply)} came.")
    return f"{what}: {told(reply)}"


def holds(what: bool, text: str) -> None:
    """Raise RuleBroken with this text where it does not hold."""
    if not what:
        raise RuleBroken(text)
