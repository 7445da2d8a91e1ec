"""The node's half of the profile: every command, every state, every refusal (profile sections 3 to 5).

This is the reference for firmware authors: pure code, no I/O. A link server gives whole command frames and gets whole
reply frames; flash, clock and randomness are injected. One :class:`Tim` serves all links of a node.
"""

from __future__ import annotations

import hmac
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from teds_provision.protocol.agreement import (
    LAST_EPOCH,
    REQUEST_OCTETS,
    TAG_OCTETS,
    NodeAgreement,
    RequestPayload,
    good_point,
    key_id,
)
from teds_provision.protocol.flash import Flash, FlashFailure, FlashMemory
from teds_provision.protocol.keys import (
    PrivateKey,
    SoftwareKey,
    prove_message,
    reset_message,
    station_key_message,
    verify,
)
from teds_provision.protocol.messages.frames import (
    COMMAND_HEADER,
    COMMON,
    SECURITY,
    Command,
    Function,
    Reason,
    Refused,
    Reply,
    TedsFunction,
    refusal,
)
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.session import (
    BLOCK_OCTETS,
    COUNTER_OCTETS,
    KEY_ID_OCTETS,
    LAST_COUNTER,
    OPEN_OCTETS,
    SEALED_HEAD_OCTETS,
    NodeSession,
    OneTime,
    open_mac,
)
from teds_provision.protocol.tim_teds import TedsAccess

HALF_OPEN_SECONDS = 60.0
PENDING_SECONDS = 60.0
IDLE_SECONDS = 600.0
CHALLENGE_OCTETS = 32
LAST_CAN_ADDRESS = 239
_SESSION_ONLY = {Function.CLOSE, *range(Function.SAMPLE, Function.DRIVE + 1)}


@dataclass
class _Line:
    """One link: at most one session and one half-open Open."""

    session: NodeSession | None = None
    half_open: NodeSession | None = None
    half_open_at: float = 0.0


@dataclass
class _Pending:
    """What a good Request left in RAM, and where its Confirm must come from."""

    agreement: NodeAgreement = field(repr=False)
    link: str
    session: NodeSession | None
    at: float


@dataclass(frozen=True)
class _Origin:
    """Where a command came from: its link, whether it counts as tapped, and the session that it was sealed in."""

    link: str
    tapped: bool
    session: NodeSession | None = None


@dataclass
class Tim:
    """One transducer interface module.

    ``max_message`` octets (1024 to 4094); ``clock`` gives monotonic seconds; ``random`` gives that many octets, good
    from the first moment after a start; ``one_time`` makes the key pair of one Open (a board may have one ready).
    """

    key: PrivateKey
    memory: FlashMemory
    clock: Callable[[], float]
    max_message: int = 2048
    max_teds: int = 16384
    random: Callable[[int], bytes] = os.urandom
    one_time: OneTime = SoftwareKey.generate

    def __post_init__(self) -> None:
        # c of Open: random at the start, so that no mac from before a restart is good again
        self._opens = int.from_bytes(self.random(COUNTER_OCTETS), "big")
        self._flash = self.memory.load()
        self._lines: dict[str, _Line] = {}
        self._pending: _Pending | None = None
        self._ending: list[Callable[[], None]] = []
        self._teds = TedsAccess(self.max_message, self.max_teds)
        self._taken_address: int | None = None

    # -- what links call -------------------------------------------------------------------------------------------

    @property
    def flash(self) -> Flash:
        """The durable state as it is."""
        return self._flash

    def identity(self) -> Identity:
        """What Identify says now."""
        flash = self._flash
        return Identity(flash.uuid, flash.state, flash.epoch, flash.sequence, self.max_message, self.can_address)

    @property
    def can_address(self) -> int:
        """The present CAN address: the durable one, or one taken in a claim of addresses, which lasts till restart."""
        return self._flash.can_address if self._taken_address is None else self._taken_address

    def take_can_address(self, address: int) -> None:
        """Move to another CAN address because another node claimed this one (profile: wire, "Claim")."""
        self._taken_address = address

    def handle(self, frame: bytes, *, link: str, tapped: bool) -> bytes:
        """Run one whole command frame and return the whole reply frame. Never raises on any octets."""
        reply = self._run(frame, _Origin(link, tapped)).encode()
        while self._ending:  # what ends with the reply: sessions after Close, Confirm, Reset
            self._ending.pop()()
        return reply

    def link_lost(self, link: str) -> None:
        """Loss of the field or link: its session, half-open Open and pending agreement go."""
        self._lines.pop(link, None)
        if self._pending is not None and self._pending.link == link:
            self._pending = None

    def reset_by_hand(self) -> None:
        """Button, pad or magnet held 5 s: the effect of Reset."""
        self._commit(_factory(self._flash))
        self._end_everything()

    # -- routing ---------------------------------------------------------------------------------------------------

    def _run(self, frame: bytes, origin: _Origin) -> Reply:
        try:
            if len(frame) < COMMAND_HEADER:
                raise Refused(Reason.BAD_FORM)
            length = int.from_bytes(frame[4:6], "big")
            command = Command(int.from_bytes(frame[:2], "big"), frame[2], frame[3], frame[COMMAND_HEADER:])
            self._permit(command, origin)
            if length != len(command.payload):
                raise Refused(Reason.BAD_FORM)
            if command.command_class == COMMON:
                return self._common(command, origin)
            return self._security(Function(command.function), command.payload, origin)
        except Refused as refused:
            return refusal(refused.reason)
        except FlashFailure:
            return refusal(Reason.FLASH_FAILURE)

    def _permit(self, command: Command, origin: _Origin) -> None:
        """State and permission: the table of section 4."""
        inside = origin.session is not None
        if command.command_class == SECURITY:
            if command.channel != 0 or command.function not in set(Function):
                raise Refused(Reason.UNKNOWN_COMMAND)
            self._permit_security(Function(command.function), origin)
        elif command.command_class == COMMON and command.function in set(TedsFunction):
            if command.function not in (TedsFunction.QUERY, TedsFunction.READ) and not inside:
                raise Refused(Reason.NOT_PERMITTED)
        else:
            raise Refused(Reason.UNKNOWN_COMMAND if inside else Reason.NOT_PERMITTED)

    def _permit_security(self, function: Function, origin: _Origin) -> None:
        factory = self._flash.state == NodeState.FACTORY
        if origin.session is not None:
            if function in (Function.OPEN, Function.SEALED):
                raise Refused(Reason.NOT_PERMITTED)
            return
        if function in (Function.REQUEST, Function.CONFIRM, Function.SET_CAN_ADDRESS):
            if not origin.tapped:
                raise Refused(Reason.NOT_PERMITTED)
        elif function in _SESSION_ONLY or (function == Function.RESET and not factory):
            raise Refused(Reason.NOT_PERMITTED)
        elif (function == Function.OPEN and factory) or (
            function == Function.SEALED and not self._has_session(origin.link)
        ):
            raise Refused(Reason.WRONG_STATE)

    def _security(self, function: Function, payload: bytes, origin: _Origin) -> Reply:
        match function:
            case Function.REQUEST:
                return self._request(payload, origin)
            case Function.CONFIRM:
                return self._confirm(payload, origin)
            case Function.OPEN:
                return self._open(payload, origin)
            case Function.SEALED:
                return self._sealed(payload, origin)
            case Function.CLOSE:
                _length(payload, 0)
                self._ending.append(lambda: self._end_session(origin))
                return Reply(True)
            case Function.IDENTIFY:
                _length(payload, 0)
                return Reply(True, self.identity().encode())
            case Function.PROVE:
                _length(payload, CHALLENGE_OCTETS)
                return Reply(True, self.key.sign(prove_message(self._flash.uuid, payload)))
            case Function.RESET:
                return self._reset(payload)
            case Function.SET_CAN_ADDRESS:
                return self._set_can_address(payload)
            case Function.LIST:
                _length(payload, 0)
                entries = [channel.to_bytes(2, "big") + bytes([code]) for channel, code in self._flash.present()]
                return Reply(True, b"".join(entries))
            case _:
                raise Refused(Reason.UNKNOWN_COMMAND)

    # -- key agreement ---------------------------------------------------------------------------------------------

    def _request(self, payload: bytes, origin: _Origin) -> Reply:
        flash = self._flash
        _length(payload, REQUEST_OCTETS)
        request = RequestPayload.decode(payload)
        for point in (request.station, request.ca, request.one_time):
            if not good_point(point, flash.node_key):
                raise Refused(Reason.BAD_POINT)
        if flash.ca is not None and request.ca != flash.ca:
            raise Refused(Reason.UNTRUSTED_STATION)
        if not verify(request.ca, station_key_message(request.station), request.station_signature):
            raise Refused(Reason.BAD_SIGNATURE)
        if flash.epoch == LAST_EPOCH:
            raise Refused(Reason.WRONG_EPOCH)
        agreement = NodeAgreement.answer(
            self.key, flash.uuid, payload, epoch=flash.epoch + 1, teds=flash.security_teds(), nonce=self.random(16)
        )
        self._pending = _Pending(agreement, origin.link, origin.session, self.clock())
        return Reply(True, agreement.reply)

    def _confirm(self, payload: bytes, origin: _Origin) -> Reply:
        pending = self._pending
        if (
            pending is None
            or self.clock() - pending.at >= PENDING_SECONDS
            or pending.link != origin.link
            or pending.session is not origin.session
        ):
            raise Refused(Reason.WRONG_STATE)
        _length(payload, TAG_OCTETS)
        agreement = pending.agreement
        if not hmac.compare_digest(payload, agreement.station_tag):
            self._pending = None
            raise Refused(Reason.BAD_TAG)
        ca = agreement.ca if self._flash.ca is None else self._flash.ca
        keyed = replace(self._flash, key=agreement.key, epoch=agreement.epoch, station=agreement.station, ca=ca)
        self._commit(keyed)
        self._pending = None
        self._ending.append(self._end_everything)
        return Reply(True)

    # -- sessions --------------------------------------------------------------------------------------------------

    def _open(self, payload: bytes, origin: _Origin) -> Reply:
        counter = self._opens.to_bytes(COUNTER_OCTETS, "big")
        if not payload:
            return Reply(True, counter)
        _length(payload, OPEN_OCTETS)
        key, station = self._flash.key, payload[KEY_ID_OCTETS:-TAG_OCTETS]
        if key is None or not hmac.compare_digest(payload[:KEY_ID_OCTETS], key_id(key)):
            raise Refused(Reason.UNKNOWN_KEY)
        # The mac before the point: a stranger costs no point arithmetic, and each Open is good once.
        if not hmac.compare_digest(payload[-TAG_OCTETS:], open_mac(key, self._flash.uuid, counter, station)):
            raise Refused(Reason.BAD_TAG)
        self._opens = (self._opens + 1) % (1 << 8 * COUNTER_OCTETS)
        if not good_point(station, self._flash.node_key):
            raise Refused(Reason.BAD_POINT)
        line = self._lines.setdefault(origin.link, _Line())
        line.half_open = NodeSession(key, self._flash.uuid, station, self.one_time())
        line.half_open_at = self.clock()
        return Reply(True, line.half_open.reply)

    def _sealed(self, payload: bytes, origin: _Origin) -> Reply:
        if len(payload) < SEALED_HEAD_OCTETS + BLOCK_OCTETS:
            raise Refused(Reason.BAD_FORM)
        line = self._lines[origin.link]
        for session in (line.session, line.half_open):
            inner = session.unseal(payload) if session is not None else None
            if session is not None and inner is not None:
                break
        else:
            raise Refused(Reason.BAD_TAG)
        counter = int.from_bytes(payload[:4], "big")
        if counter <= session.counter:
            raise Refused(Reason.REPLAY)
        if session is line.half_open:
            line.session, line.half_open = session, None
        session.counter, session.good_at = counter, self.clock()
        sealed_from = replace(origin, session=session)
        if counter == LAST_COUNTER:
            self._ending.append(lambda: self._end_session(sealed_from))
        return Reply(True, session.seal(counter, self._run(inner, sealed_from).encode()))

    def _has_session(self, link: str) -> bool:
        """Whether a session or half-open Open of this link lives; drops those whose time is over."""
        line = self._lines.get(link)
        if line is None:
            return False
        now = self.clock()
        if line.session is not None and now - line.session.good_at >= IDLE_SECONDS:
            line.session = None
        if line.half_open is not None and now - line.half_open_at >= HALF_OPEN_SECONDS:
            line.half_open = None
        return line.session is not None or line.half_open is not None

    def _end_session(self, origin: _Origin) -> None:
        line = self._lines.get(origin.link)
        if line is not None and line.session is origin.session:
            line.session = None

    def _end_everything(self) -> None:
        self._lines.clear()
        self._pending = None

    # -- the rest --------------------------------------------------------------------------------------------------

    def _common(self, command: Command, origin: _Origin) -> Reply:
        flash, teds = self._flash, self._teds
        match TedsFunction(command.function):
            case TedsFunction.QUERY:
                return teds.query(flash, command)
            case TedsFunction.READ:
                return teds.read(flash, command)
            case TedsFunction.WRITE:
                assert origin.session is not None
                return teds.write(flash, command, origin.session.staging)
            case TedsFunction.UPDATE:
                assert origin.session is not None
                reply, state = teds.update(flash, command, origin.session.staging)
                if state is not None:
                    self._commit(state)
                    origin.session.staging.clear()
                return reply

    def _reset(self, payload: bytes) -> Reply:
        _length(payload, CHALLENGE_OCTETS)
        flash = self._flash
        proof = self.key.sign(reset_message(flash.uuid, flash.epoch, payload))
        if flash.state != NodeState.FACTORY:
            self._commit(_factory(flash))
            self._ending.append(self._end_everything)
        return Reply(True, proof)

    def _set_can_address(self, payload: bytes) -> Reply:
        _length(payload, 1)
        if not 1 <= payload[0] <= LAST_CAN_ADDRESS:
            raise Refused(Reason.BAD_FORM)
        self._commit(replace(self._flash, can_address=payload[0]))
        self._taken_address = None
        return Reply(True)

    def _commit(self, state: Flash) -> None:
        self.memory.commit(state)
        self._flash = state


def _factory(flash: Flash) -> Flash:
    """Factory state: no key, no CA, no station, initial Security TEDS; identity, epoch and sequence stay."""
    blocks = {block: teds for block, teds in flash.blocks.items() if block != (0, SECURITY)}
    return replace(flash, key=None, ca=None, station=None, provisioned=False, blocks=blocks)


def _length(payload: bytes, octets: int) -> None:
    if len(payload) != octets:
        raise Refused(Reason.BAD_FORM)
