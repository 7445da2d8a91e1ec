"""One node: routing of commands, and those that need little (profile.md, "Which command when")."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from teds_provision.protocol.announce import LAST_ADDRESS
from teds_provision.protocol.flash import ChipError, Flash, FlashError, FlashMemory, in_factory_state
from teds_provision.protocol.keys import (
    CHALLENGE_OCTETS,
    PrivateKey,
    SoftwareKey,
    Verify,
    prove_message,
    reset_message,
    verify,
)
from teds_provision.protocol.messages.firmware import LOCATE_SECONDS, Firmware, FirmwareFlag, FirmwareReport
from teds_provision.protocol.messages.frames import (
    COMMAND_HEADER,
    SECURITY_CLASS,
    Command,
    CommandRefusedError,
    Function,
    Reason,
    Reply,
    TedsFunction,
    refusal,
)
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.operation.can_frames import TOKEN_OCTETS
from teds_provision.protocol.operation.hardware import Hardware, SessionPort, port_of
from teds_provision.protocol.operation.role import InnerCommand, OperationRole
from teds_provision.protocol.operation.streams import DataFrame
from teds_provision.protocol.session import LAST_COUNTER, NodeSession, OneTime
from teds_provision.protocol.tim.manage import ManageFilter, Manager
from teds_provision.protocol.tim.node_agreement import AgreementSlot
from teds_provision.protocol.tim.node_sessions import Sessions
from teds_provision.protocol.tim.permission import Origin, Permission, of_teds
from teds_provision.protocol.tim.teds_access import Staging, TedsAccess

_ADDRESS_SECONDS: Final = 10.0
"""Seconds between two writes of the address to flash: taps or sessions could wear it out."""


@dataclass
class Tim:
    """One transducer interface module.

    ``max_message`` octets (512 to 4094); ``clock`` gives monotonic seconds; ``random`` gives that many octets, good
    from the first moment after a start; ``one_time`` makes the key pair of one Open or one Request (a board may have
    one ready), ``verify`` checks a signature.
    ``sessions`` and ``streams`` are its room for them; ``hardware`` is what it measures and acts with, None: nothing.
    ``firmware`` reports what runs on it and makes it blink, None: it reports nothing, as nodes before 128.21;
    ``manager`` is the SMP server behind 128.23, None: it takes no firmware.
    ``quick_points``: its point arithmetic holds no Sealed frame up by more than 5 ms. Without CAN (``has_can``) it
    reports the address 0 and does not know 128.10.
    """

    key: PrivateKey
    memory: FlashMemory
    clock: Callable[[], float]
    max_message: int = 2048
    max_teds: int = 16384
    random: Callable[[int], bytes] = os.urandom
    one_time: OneTime = SoftwareKey.generate
    verify: Verify = verify
    hardware: Hardware | None = None
    sessions: int = 8
    streams: int = 8
    quick_points: bool = True
    has_can: bool = True
    firmware: Firmware | None = None
    manager: Manager | None = None

    def __post_init__(self) -> None:
        self._flash = self.memory.load()
        self._taken_address: int | None = None
        self._ending: list[Callable[[], None]] = []
        self._address_written_at: float | None = None
        self._staging = Staging()
        self._teds = TedsAccess(self.max_message, self.max_teds, self.verify)
        self._agreeing = AgreementSlot(self.key, self.clock, self.random, self.one_time, self.verify)
        self._sessions = Sessions(
            self.clock,
            self.random,
            self.one_time,
            room=self.sessions,
            claims=lambda session: self._role is not None and bool(self._role.claims.channels_of(session)),
            ended=self._session_ended,
        )
        self._role: OperationRole | None = None
        if self.hardware is not None:
            self._role = OperationRole(
                self.hardware,
                flash=lambda: self._flash,
                clock=self.clock,
                address=lambda: self.can_address,
                max_message=self.max_message,
                streams=self.streams,
            )
        self._manage: ManageFilter | None = None
        if self.manager is not None:
            self._manage = ManageFilter(
                self.manager,
                self.clock,
                self.max_message,
                claimed=lambda: self._role is not None and bool(self._role.claims.sessions()),
                staged_elsewhere=self._staging.require,
            )
        self._permission = Permission(
            lambda: self._flash.state == NodeState.FACTORY,
            self._sessions.any_on,
            self.clock,
            self._role,
            self.quick_points,
            self.has_can,
            self.firmware is not None,
            self._manage,
        )
        self._security: dict[int, Callable[[bytes, Origin], bytes]] = {
            Function.REQUEST: self._request,
            Function.CONFIRM: self._confirm,
            Function.OPEN: self._open,
            Function.SEALED: self._sealed,
            Function.CLOSE: self._close,
            Function.IDENTIFY: self._identify,
            Function.PROVE: self._prove,
            Function.RESET: self._reset,
            Function.SET_CAN_ADDRESS: self._set_can_address,
            Function.LIST: self._list,
            Function.ABOUT: self._about,
            Function.LOCATE: self._locate,
            Function.MANAGE: self._manage_packet,
        }

    # -- called by links -------------------------------------------------------------------------------------------

    @property
    def flash(self) -> Flash:
        """The durable state as it is."""
        return self._flash

    def identity(self) -> Identity:
        """Return the present Identify reply."""
        flash = self._flash
        address = self.can_address if self.has_can else 0
        return Identity(flash.uuid, flash.state, flash.epoch, flash.sequence, self.max_message, address)

    @property
    def can_address(self) -> int:
        """The present CAN address: the durable one, or one taken in a claim of addresses, which lasts till restart."""
        return self._flash.can_address if self._taken_address is None else self._taken_address

    def take_can_address(self, address: int) -> None:
        """Move to another CAN address because another node claimed this one (profile.md, "CAN")."""
        self._taken_address = address

    def handle(
        self, frame: bytes, *, link: str, tapped: bool, port: SessionPort | None = None, received: int | None = None
    ) -> bytes:
        """Run one whole command frame and return the whole reply frame. Never raises on any octets.

        ``port`` adds to the link's name (CAN FD, MTU); ``received`` is the tick at the frame's last octet, by default
        now. When the reply has left, call :meth:`reply_sent`.
        """
        tick = received if received is not None else self._role.now() if self._role is not None else 0
        # first end what expired before this frame, so that it cannot renew an expired lease or hide a dead-man
        self.poll()
        reply = self._run(frame, Origin(link, tapped, port or port_of(link), tick)).encode()
        while self._ending:  # sessions that end after the reply to Close, Confirm or Reset
            self._ending.pop()()
        return reply

    def link_lost(self, link: str) -> None:
        """End session, half-open Open and pending agreement of a link whose field or connection is lost."""
        self._sessions.lose(link)
        self._agreeing.forget(link)

    def reset_by_hand(self) -> None:
        """Reset by hand (button, pad or magnet held 5 s), to the same effect as Reset."""
        self._commit(in_factory_state(self._flash), safe=True)
        self._end_everything()

    # -- also called by links that carry data ----------------------------------------------------------------------

    def reply_sent(self, link: str) -> None:
        """Handle that the reply to the last command of this link has left: its session's streams may follow."""
        session = self._sessions.on(link)
        if self._role is not None and session is not None:
            self._role.streams.reply_sent(session)
        if self._manage is not None:
            self._manage.reply_sent(link)

    def poll(self) -> float | None:
        """Take samples, run leases and dead-men; gives seconds until one is due again, None: none is known.

        When a data frame may begin is :meth:`next_frame_in`'s.
        """
        return self._role.poll() if self._role is not None else None

    def next_frame(self, bus: str) -> DataFrame | None:
        """Return the next data frame of a bus (the link's name without its last part), if one may begin now.

        Call again when the frame before has left, after :meth:`next_frame_in`.
        """
        return self._role.frame(bus) if self._role is not None else None

    def next_frame_in(self) -> float | None:
        """Return seconds until the next data frame of any bus may begin; None if none is waiting."""
        return self._role.next_frame_in() if self._role is not None else None

    @property
    def streaming(self) -> bool:
        """True if a stream runs."""
        return self._role is not None and self._role.streams.running

    @property
    def missed(self) -> int:
        """Data messages that could not leave in time, since the start."""
        return self._role.streams.missed if self._role is not None else 0

    @property
    def backlog(self) -> bool:
        """True if a full message waits for the one before it: a new sample may overwrite it."""
        return self._role is not None and self._role.streams.backlog

    def event(self, channel: int, tick: int, octets: bytes, *, valid: bool = True) -> None:
        """Record a value of an event sensor at ``tick``."""
        if self._role is not None:
            self._role.streams.event(channel, tick, octets, valid=valid)

    def trigger(self, link: str, token: bytes, tick: int) -> None:
        """Handle a trigger frame of the station of this link; ``tick`` is that of the frame's end."""
        session = self._sessions.on(link)
        if self._role is not None and session is not None and len(token) == TOKEN_OCTETS:
            self._role.streams.trigger(session, token, tick)

    def drive(self, link: str, octets: bytes) -> None:
        """Handle a Drive frame from CAN, or a whole Drive message from BLE (without its first octet)."""
        session = self._sessions.on(link)
        if self._role is None or session is None:
            return
        self._role.poll()
        if port_of(link).kind == "can":
            self._role.streams.drive_frame(session, octets)
        else:
            self._role.streams.drive_message(session, octets)

    def unheard(self, link: str) -> None:
        """End the streams of this link: its station has disabled data messages there (BLE)."""
        session = self._sessions.on(link)
        if self._role is not None and session is not None:
            self._role.streams.unheard(session)

    def restarts_after(self, link: str) -> bool:
        """Return True if the node restarts when the reply on this link has left."""
        return self._manage is not None and self._manage.restart_link == link

    def in_session(self, link: str) -> bool:
        """Return True if a session is open on this link."""
        return self._sessions.on(link) is not None

    def actuator_claimed(self) -> bool:
        """Return True if a session claims an actuator."""
        return self._role is not None and bool(self._role.claims.actuators)

    # -- routing ---------------------------------------------------------------------------------------------------

    def _run(self, frame: bytes, origin: Origin) -> Reply:
        try:
            if len(frame) > self.max_message:
                raise CommandRefusedError(Reason.TOO_LARGE)
            if len(frame) < COMMAND_HEADER:
                raise CommandRefusedError(Reason.BAD_FORM)
            length = int.from_bytes(frame[4:6], "big")
            command = Command(int.from_bytes(frame[:2], "big"), frame[2], frame[3], frame[COMMAND_HEADER:])
            self._permission.check(command, origin)
            if length != len(command.payload):
                raise CommandRefusedError(Reason.BAD_FORM)
            return self._dispatch(command, origin)
        except CommandRefusedError as refused:
            return refusal(refused.reason)
        except (FlashError, ChipError):
            return refusal(Reason.FLASH_FAILURE)

    def _dispatch(self, command: Command, origin: Origin) -> Reply:
        """Run a command that is permitted and whose length is right."""
        if of_teds(command):
            return self._common(command, origin)
        security = self._security.get(command.function) if command.command_class == SECURITY_CLASS else None
        if security is not None:
            return Reply(True, security(command.payload, origin))
        if self._role is None or origin.session is None or not self._role.knows(command):
            raise CommandRefusedError(Reason.UNKNOWN_COMMAND)
        return self._role.run(InnerCommand(command, origin.session, origin.port, origin.received))

    # -- class 128: each method returns the payload of its reply ---------------------------------------------------

    def _request(self, payload: bytes, origin: Origin) -> bytes:
        return self._agreeing.request(payload, origin, self._flash)

    def _confirm(self, payload: bytes, origin: Origin) -> bytes:
        self._commit(self._agreeing.confirm(payload, origin, self._flash), safe=True)
        self._agreeing.forget()
        self._ending.append(self._end_everything)
        return b""

    def _open(self, payload: bytes, origin: Origin) -> bytes:
        return self._sessions.open(payload, origin.link, self._flash)

    def _close(self, payload: bytes, origin: Origin) -> bytes:
        _length(payload, 0)
        self._end_with_reply(origin)
        return b""

    def _identify(self, payload: bytes, origin: Origin) -> bytes:
        _length(payload, 0)
        return self.identity().encode()

    def _prove(self, payload: bytes, origin: Origin) -> bytes:
        _length(payload, CHALLENGE_OCTETS)
        return self.key.sign(prove_message(self._flash.uuid, payload))

    def _list(self, payload: bytes, origin: Origin) -> bytes:
        _length(payload, 0)
        entries = [channel.to_bytes(2, "big") + bytes([code]) for channel, code in self._flash.present()]
        return b"".join(entries)

    def _reported_firmware(self) -> FirmwareReport:
        report = self.firmware.about() if self.firmware is not None else None
        if report is None:
            raise CommandRefusedError(Reason.UNKNOWN_COMMAND)
        return report

    def _about(self, payload: bytes, origin: Origin) -> bytes:
        report = self._reported_firmware()
        _length(payload, 0)
        return report.encode()

    def _locate(self, payload: bytes, origin: Origin) -> bytes:
        if self.firmware is None or FirmwareFlag.LOCATE not in self._reported_firmware().flags:
            raise CommandRefusedError(Reason.UNKNOWN_COMMAND)
        _length(payload, 1)
        if payload[0] > LOCATE_SECONDS:
            raise CommandRefusedError(Reason.BAD_FORM)
        self.firmware.locate(payload[0])
        return b""

    def _manage_packet(self, payload: bytes, origin: Origin) -> bytes:
        if self._manage is None:
            raise CommandRefusedError(Reason.UNKNOWN_COMMAND)
        assert origin.session is not None
        return self._manage.run(payload, origin.session, origin.link)

    # -- sessions --------------------------------------------------------------------------------------------------

    def _sealed(self, payload: bytes, origin: Origin) -> bytes:
        taken = self._sessions.open_frame(payload, origin.link)
        if not taken.room:
            return taken.session.seal(taken.counter, refusal(Reason.NO_ROOM).encode())
        sealed_from = replace(origin, session=taken.session)
        if taken.counter == LAST_COUNTER:
            self._end_with_reply(sealed_from)
        return taken.session.seal(taken.counter, self._run(taken.inner, sealed_from).encode())

    def _end_with_reply(self, origin: Origin) -> None:
        session = origin.session
        assert session is not None
        self._ending.append(lambda: self._sessions.end(origin.link, session))

    def _session_ended(self, session: NodeSession) -> None:
        self._staging.end(session)
        if self._manage is not None:
            self._manage.session_ended(session)
        if self._role is not None:
            self._role.session_ended(session)

    def _end_everything(self) -> None:
        self._sessions.end_all()
        self._agreeing.forget()

    # -- other commands --------------------------------------------------------------------------------------------

    def _common(self, command: Command, origin: Origin) -> Reply:
        flash, teds, session = self._flash, self._teds, origin.session
        match TedsFunction(command.function):
            case TedsFunction.QUERY:
                return teds.query(flash, command)
            case TedsFunction.READ:
                return teds.read(flash, command)
            case TedsFunction.WRITE:
                assert session is not None
                reply = teds.write(flash, command, self._staging, session, now=self.clock())
                if self._role is not None and origin.port.kind == "nfc":
                    self._role.claims.yield_sensors(session)
                return reply
            case TedsFunction.UPDATE:
                assert session is not None
                reply, state = teds.update(flash, command, self._staging, session, now=self.clock())
                if state is not None:
                    self._commit(state)
                    self._staging.end()
                return reply

    def _reset(self, payload: bytes, origin: Origin) -> bytes:
        _length(payload, CHALLENGE_OCTETS)
        flash = self._flash
        proof = self.key.sign(reset_message(flash.uuid, flash.epoch, payload))
        if flash.state == NodeState.FACTORY:
            self._agreeing.forget()
        else:
            self._commit(in_factory_state(flash), safe=True)
            self._ending.append(self._end_everything)
        return proof

    def _set_can_address(self, payload: bytes, origin: Origin) -> bytes:
        _length(payload, 1)
        if not 1 <= payload[0] <= LAST_ADDRESS:
            raise CommandRefusedError(Reason.BAD_FORM)
        if payload[0] != self._flash.can_address:  # an equal value is not written again
            now, last = self.clock(), self._address_written_at
            if last is not None and now - last < _ADDRESS_SECONDS:
                raise CommandRefusedError(Reason.BUSY)
            self._commit(replace(self._flash, can_address=payload[0]))
            self._address_written_at = now
        self._taken_address = None
        return b""

    def _commit(self, state: Flash, *, safe: bool = False) -> None:
        """Put the new state; ``safe``: every actuator goes to its safe state before that."""
        if safe and self._role is not None:
            self._role.claims.everything_safe()
        self.memory.commit(state)
        if self.memory.load() != state:
            raise FlashError  # the memory stored something else: keep the present state
        self._flash = state


def _length(payload: bytes, octets: int) -> None:
    if len(payload) != octets:
        raise CommandRefusedError(Reason.BAD_FORM)
