"""Talking to one node: plain or sealed commands over whichever link, and what refusals mean for a person."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import TracebackType

from teds_provision.errors import GarbledError, LinkError, NodeRefusedError, NodeSilentError, TedsProvisionError
from teds_provision.links import Contact, Notice
from teds_provision.links.ports import DeadlineLink, Link, NoticeSink
from teds_provision.protocol.messages.firmware import FirmwareReport
from teds_provision.protocol.messages.frames import (
    IDENTIFY,
    Command,
    Function,
    Reason,
    Reply,
    decode_reply,
    security_command,
)
from teds_provision.protocol.messages.identity import Identity
from teds_provision.protocol.messages.tables import describe_answer, describe_request
from teds_provision.protocol.session import StationSession
from teds_provision.teds.image import BlockId

_log = logging.getLogger(__name__)
BUSY_PAUSE, BUSY_SECONDS = 0.25, 10.0
"""A node that is busy is asked again, after a pause, and not for ever; a conversation may have less patience."""
_REOPENINGS = 2
_REPEATS = 5
"""How often a command that does no harm is sent again on a link that loses frames."""
_TORN_REPEATS = 40
"""Tries of a command whose reply is torn: with 3 % loss a long reply usually loses a frame; a try costs 20 ms."""
_REPEATING_SECONDS = 60.0
"""Limit of that in seconds: a node that answers only Identify must not block the run."""
_OPENING = "to open a session"

_MEANING = {
    Reason.UNKNOWN_COMMAND: "it does not know the command",
    Reason.WRONG_STATE: "its state does not allow that now",
    Reason.NOT_PERMITTED: "this is not permitted here (a tap or a session is needed)",
    Reason.BAD_FORM: "length, checksum or form is wrong",
    Reason.BAD_SIGNATURE: "a signature does not verify",
    Reason.DIGEST_MISMATCH: "a TEDS does not match its signed digest",
    Reason.STALE_SEQUENCE: "the datasheet's sequence is not newer than its own, or too far ahead",
    Reason.WRONG_EPOCH: "the datasheet was signed for another key epoch",
    Reason.WRONG_UUID: "the Meta-TEDS names another UUID",
    Reason.TOO_LARGE: "the TEDS is too large for it",
    Reason.FLASH_FAILURE: "its flash or a chip of it failed",
    Reason.BAD_TAG: "a tag is wrong",
    Reason.REPLAY: "a counter was used before",
    Reason.UNTRUSTED_STATION: "it belongs to another owner's CA",
    Reason.BAD_POINT: "a public key is not a valid point",
    Reason.UNKNOWN_KEY: "it does not know this station's key",
    Reason.BUSY: "it is busy, or another station claims what is asked for",
    Reason.NO_SUCH_TEDS: "it has no such TEDS",
    Reason.OUT_OF_RANGE: "a value is out of the range that it takes",
    Reason.TOO_LATE: "the start is past, or too far ahead",
    Reason.DOES_NOT_FIT: "it does not fit the link, or the node's budget there",
    Reason.NO_ROOM: "it has no room for one more",
    Reason.FAULT: "a hardware fault, or too little power",
}
OTHER_OWNER_REMEDY = (
    "If a lost station of yours keyed it, bring that one back in an empty home: teds-provision --home NEW restore FILE"
    " (or init --ca FILE, with its exported CA key). If it is another owner's: export-keys there, import-keys here."
    " Otherwise reset it by hand: hold its button for 5 s (a virtual node: node reset DIR)."
)
"""Remedies for a node that belongs to another CA, which accepts no key from this station."""
_CURE = {
    Reason.UNTRUSTED_STATION: OTHER_OWNER_REMEDY,
    Reason.NOT_PERMITTED: "Tap the node on the NFC reader (--via nfc), or reset it by hand.",
    Reason.UNKNOWN_KEY: "Try it on the reader. If another station rotated the key, tap the node: agree UUID --rotate.",
    Reason.STALE_SEQUENCE: "Sign again against the node: sign UUID --read-node.",
    Reason.WRONG_EPOCH: "Sign again after the key agreement: sign UUID --read-node.",
    Reason.TOO_LARGE: "Use a smaller calibration table, or a node with more flash.",
    Reason.DOES_NOT_FIT: "Use a lower rate or CAN FD; NFC and BLE do not support everything.",
    Reason.NO_ROOM: "End another measurement of this node first.",
    Reason.BUSY: "Try again in a moment; mode UUID shows which station claims what.",
    Reason.FAULT: "Check its power and self-test: sample UUID, mode UUID.",
    Reason.FLASH_FAILURE: "Try again. If the error persists, the board is defective.",
}


HEARD = "Not verified: "
"""First words about a refusal outside a session: any device on the link may have sent it."""


def refused(reason: int | None, doing: str, *, sealed: bool = False) -> NodeRefusedError:
    """Return the error for a refusal of ``doing``; outside a session (not ``sealed``) it is marked as a hint."""
    heard = "The node refused" if sealed else f"{HEARD}the node refuses"
    try:
        known = Reason(reason if reason is not None else 0)
    except ValueError:
        return NodeRefusedError(
            f"{heard} {doing} without a known reason ({reason}).", reason=reason or 0, sealed=sealed
        )
    return NodeRefusedError(
        f"{heard} {doing}: {_MEANING[known]} (reason {int(known)}).",
        reason=int(known),
        hint=_CURE.get(known, ""),
        sealed=sealed,
    )


def is_busy(error: TedsProvisionError) -> bool:
    """Return True if a node refused because it is busy (17), which only time resolves."""
    return isinstance(error, NodeRefusedError) and error.reason == Reason.BUSY


# Refusals of an Open that was disturbed on the bus; if the node repeats one, it counts.
_DISTURBED = (Reason.UNKNOWN_KEY, Reason.BAD_FORM, Reason.BAD_POINT)


class SessionLostError(Exception):
    """The session is gone at the node; ``cause`` is the error to raise if re-opening fails."""

    def __init__(self, cause: TedsProvisionError) -> None:
        super().__init__(cause.message)
        self.cause = cause


def came_under_key(error: BaseException) -> bool:
    """Return True if an error of an open session has its cause in what the node's key vouches for.

    False for silence, a refusal that was not sealed, and a reply that did not open: any device on the link can cause
    each of them, a second board at the same address among others.
    """
    if isinstance(error, (LinkError, SessionLostError)) or isinstance(error.__context__, SessionLostError):
        return False  # with this context: the session was lost and could not be opened again
    return not isinstance(error, NodeRefusedError) or error.sealed


@dataclass(frozen=True)
class ShownKey:
    """P(node) that a node shows in plain and proved a moment ago, its SIG102, and the Security TEDS with both."""

    point: bytes
    signature: bytes
    security_teds: bytes


@dataclass(frozen=True)
class EarlyAnswers:
    """Answers of a new board outside a session: its key, which it proved, and the TEDS that it lists."""

    key: ShownKey
    listed: tuple[BlockId, ...]


class Conversation:
    """One node on one link. Commands go plain until :meth:`open` succeeded, sealed from then on."""

    def __init__(self, contact: Contact, *, notice: NoticeSink, busy_seconds: float | None = None) -> None:
        self.contact = contact
        self.identity = contact.identity
        self.uuid = contact.identity.uuid
        self.proven: Identity | None = None
        """The last Identify reply in a session under the key of the open one, None if it was not requested yet.

        :meth:`reopen` keeps it: under one key a node's epoch stays and its sequence only grows, so it stays a bound.
        """
        self.charging = contact.charging
        """The charge that its initial NFC message reported, also after the conversation moved to another link."""
        self._notice, self._busy_seconds = notice, busy_seconds
        self._key: bytes | None = None
        self._session: StationSession | None = None
        self._statics: tuple[bytes, ...] = ()
        self.open_counter: bytes | None = None
        """c of the Open of this session, 8 octets; a change shows that the node has restarted."""
        self.reported_firmware: tuple[bytes | None, FirmwareReport | None] | None = None
        """Last answer to About, and the c of its session (None: plain); see provisioning/firmware.py."""
        self.early: EarlyAnswers | None = None
        """What it answered on this link a moment ago, and is not asked again; see provisioning/early_reading.py."""
        self._release: Callable[[], object] = _nothing

    def __enter__(self) -> Conversation:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.leave()
        self.contact.link.close()
        self._release()

    @property
    def tapped(self) -> bool:
        """True if commands of this conversation arrive over NFC."""
        return self.contact.link.capabilities.tapped

    @property
    def wired(self) -> bool:
        """True if the node is on a wired bus."""
        return self.contact.link.capabilities.wired

    @property
    def sealed(self) -> bool:
        """True if a session is open."""
        return self._session is not None

    @property
    def message_key(self) -> bytes:
        """k_m of the open session, 32 octets: the root of the keys of streams and of Drive (operation.md section 3)."""
        assert self._session is not None, "message_key without a session"
        return self._session.message_key

    # -- sessions --------------------------------------------------------------------------------------------------

    def open(self, key: bytes, *, statics: tuple[bytes, ...] = ()) -> None:
        """Open a session under a link key.

        Raises NodeRefusedError (16: unknown key) or NotAuthenticError (wrong node tag).

        ``statics``: P(station) and P(node), if they are at hand; the node's one-time key is neither.
        """
        self._statics = statics or self._statics
        session, reply = self._open(key)
        # The counter was used up by another station's Open, or a frame was disturbed on the bus: try once more.
        if reply.reason == Reason.BAD_TAG or (self._is_noisy and reply.reason in _DISTURBED):
            session, reply = self._open(key)
        if not reply.ok:
            raise refused(reply.reason, _OPENING)
        session.accept(reply.payload)
        self._session, self._key, self.open_counter = session, key, session.open_counter

    def _open(self, key: bytes) -> tuple[StationSession, Reply]:
        """Request c and send one Open; each has a one-time key."""
        session = StationSession(key, self.uuid, statics=self._statics)
        return session, self._exchange(session.open(self.request_plain(session.request_counter(), _OPENING)))

    def reopen(self) -> None:
        """Open a new session under the same key, after the old one was lost."""
        assert self._key is not None, "reopen() before open()"
        self._session = None
        self.open(self._key)

    def move_to(self, find: Callable[[], Contact], release: Callable[[], object]) -> None:
        """Go on with the same node on another link: close the session here, open one there under the same key.

        ``find`` meets it there; ``release`` is called when the conversation is over.
        """
        assert self._key is not None, "move_to() before open()"
        key = self._key
        self.leave()
        self.contact.link.close()
        self.contact = find()
        self.identity, self._release = self.contact.identity, release
        self.open(key)

    def forget(self) -> None:
        """Drop the session, which the node has ended (Confirm, Reset), and go on in plain."""
        self._session = self._key = self.proven = None

    def leave(self) -> None:
        """Close the session politely; a node that does not answer any more is left as it is."""
        if self._session is None:
            return
        try:
            self.request(security_command(Function.CLOSE), "to close the session")
        except (LinkError, SessionLostError, NodeRefusedError):
            pass
        finally:
            self.forget()

    # -- commands --------------------------------------------------------------------------------------------------

    def request_plain(self, command: Command, doing: str) -> bytes:
        """Send a plain command and return its payload; raises NodeRefusedError, LinkError."""
        reply = self._exchange(command)
        if not reply.ok:
            raise refused(reply.reason, doing)
        return reply.payload

    def request(self, command: Command, doing: str, *, within: float | None = None) -> bytes:
        """Send sealed if a session is open, else plain. Raises SessionLostError if the session is gone.

        ``within``: seconds after which the order is of no use; then it is abandoned (NodeSilentError).
        """
        session = self._session
        if session is None:
            return self.request_plain(command, doing)
        outer = self._exchange(session.seal(command), command, within)
        if not outer.ok:
            raise SessionLostError(refused(outer.reason, doing))
        try:
            inner = session.unseal(outer.payload)
        except TedsProvisionError as error:
            self.contact.note("in", outer.encode(), lambda: describe_answer(command, outer), sealed=True)
            raise SessionLostError(error) from error
        if self.contact.trace is not None:
            words, opened = describe_answer(command, inner), inner.encode()
            self.contact.note("in", outer.encode(), words, sealed=True, opened=opened)
        if not inner.ok:
            raise refused(inner.reason, doing, sealed=True)
        return inner.payload

    def request_retry_once(self, command: Command, doing: str) -> bytes:
        """Send; a refusal on a bus outside a session is asked for once more: a disturbed frame may have made it.

        For commands that may run twice. Raises what :meth:`request` raises.
        """
        try:
            return self.request(command, doing)
        except NodeRefusedError:
            if self.sealed or not self._is_noisy:
                raise
        return self.request(command, doing)

    def request_idempotent(self, command: Command, doing: str) -> bytes:
        """Send an idempotent command, over a new session if the old one was lost.

        A command is abandoned if the node was too busy for it: a new session would meet the same node.
        """
        reopenings = repeats = torn = 0
        until = time.monotonic() + _REPEATING_SECONDS
        while True:
            try:
                return self.request_retry_once(command, doing)
            except SessionLostError as lost:
                reopenings += 1
                if reopenings > _REOPENINGS or is_busy(lost.cause):
                    raise lost.cause from lost
                self.reopen()
            except (NodeSilentError, GarbledError) as failure:
                torn += isinstance(failure, GarbledError)
                repeats += isinstance(failure, NodeSilentError)
                if repeats > _REPEATS or torn > _TORN_REPEATS or time.monotonic() > until or not self.is_alive():
                    raise

    @property
    def _patience_with_busy(self) -> float:
        return BUSY_SECONDS if self._busy_seconds is None else self._busy_seconds

    @property
    def _is_noisy(self) -> bool:
        """True if only the checksums of single frames protect commands and replies: a bus."""
        return self.contact.link.capabilities.many

    def is_alive(self) -> bool:
        """Return True if a node that a message did not reach still answers.

        On a bus single frames are lost, nodes are not. Never True at a reader: a node that does not answer there has
        left the field.
        """
        if not self._is_noisy:
            return False
        try:
            self._exchange(IDENTIFY)
        except LinkError:
            return False
        return True

    def _exchange(self, command: Command, inside: Command | None = None, within: float | None = None) -> Reply:
        """Send a command, again while the node is busy; ``inside`` is what is sealed in it."""
        until = time.monotonic() + (self._patience_with_busy if within is None else 0.0)
        while True:
            frame = command.encode()
            if self.contact.trace is not None:
                opened = None if inside is None else inside.encode()
                self.contact.note(
                    "out", frame, describe_request(inside or command), sealed=inside is not None, opened=opened
                )
            raw = _carry(self.contact.link, frame, within)
            _log.debug("%d.%d: %d octets out, %d back", command.command_class, command.function, len(frame), len(raw))
            reply = decode_reply(raw)
            if inside is None or not reply.ok:  # sealed replies are recorded after they are opened
                self.contact.note("in", raw, partial(describe_answer, command, reply))
            if reply.ok or reply.reason != Reason.BUSY or time.monotonic() >= until:
                return reply
            self._notice(Notice("retry", "The node is busy with another station", until - time.monotonic()))
            time.sleep(BUSY_PAUSE)


def _carry(link: Link, frame: bytes, within: float | None) -> bytes:
    if within is not None and isinstance(link, DeadlineLink):
        return link.exchange_within(frame, within)
    return link.exchange(frame)


def _nothing() -> None:
    """Do nothing: there is no second port to close."""
