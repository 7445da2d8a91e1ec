"""The node's half of measurement operation: every command of operation.md inside a session. Pure.

``Tim`` passes unknown commands to :meth:`OperationRole.run`, reports sessions that end, and checks here before commands
that a claim forbids. Checks run in the order of operation.md.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Final, NamedTuple

from teds_provision.protocol.flash import Flash
from teds_provision.protocol.messages.frames import (
    COMMON,
    EITHER,
    OPERATE,
    READ_OVERHEAD,
    SECURITY_CLASS,
    Command,
    CommandRefusedError,
    Function,
    Reason,
    Reply,
)
from teds_provision.protocol.operation.claims import SECOND, Claims
from teds_provision.protocol.operation.commands import (
    DIGEST_OCTETS,
    FIRST_DEAD_MAN,
    FIRST_LEASE,
    IDLE_FUNCTION,
    LAST_DEAD_MAN,
    LAST_LEASE,
    MOST_SAMPLE_CHANNELS,
    NOT_VALID,
    OPERATE_FUNCTION,
    READ_FUNCTION,
    SELF_TEST_FUNCTION,
    WRITE_FUNCTION,
    ChannelState,
    OperateCommand,
    OperationReply,
    PowerFlag,
    SampleReply,
    channel_list,
    demand_form,
)
from teds_provision.protocol.operation.hardware import ChannelHardware, Hardware, SessionPort, teds_fits
from teds_provision.protocol.operation.stream_role import StreamRole, demand
from teds_provision.protocol.operation.streams import DataFrame
from teds_provision.protocol.session import NodeSession
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.sheet import ChannelKind

_OFFSET_OCTETS: Final = 4


class InnerCommand(NamedTuple):
    """An inner command: its session, the port of its link, and the tick at which its last frame came."""

    command: Command
    session: NodeSession
    port: SessionPort
    received: int


class OperationRole:
    """Measurement operation of one node.

    ``flash`` gives the durable state, ``clock`` monotonic seconds, ``address`` the CAN address; ``streams`` is room.
    """

    def __init__(
        self,
        hardware: Hardware,
        *,
        flash: Callable[[], Flash],
        clock: Callable[[], float],
        address: Callable[[], int],
        max_message: int,
        streams: int = 8,
    ) -> None:
        self._hardware, self._flash, self._clock, self._max_message = hardware, flash, clock, max_message
        self.claims = Claims(hardware, self._claims_ended)
        self.streams = StreamRole(
            hardware, self.claims, teds=self._channel_teds, real=self._real, address=address, room=streams
        )
        self._ports: dict[NodeSession, SessionPort] = {}
        self._commands: dict[tuple[int, int], Callable[[InnerCommand], bytes]] = {
            (EITHER, OPERATE_FUNCTION): self._operate,
            (EITHER, IDLE_FUNCTION): self._idle,
            (OPERATE, READ_FUNCTION): self._read,
            (OPERATE, WRITE_FUNCTION): self._write,
            (COMMON, SELF_TEST_FUNCTION): self._self_test,
            (SECURITY_CLASS, Function.SAMPLE): self._sample,
            (SECURITY_CLASS, Function.SET): self._set,
            (SECURITY_CLASS, Function.SUBSCRIBE): lambda inner: self.streams.subscribe(_payload(inner), *inner[1:3]),
            (SECURITY_CLASS, Function.STOP): lambda inner: self.streams.stop(_payload(inner), inner.session),
            (SECURITY_CLASS, Function.CLOCK): lambda inner: self.streams.clock(
                _payload(inner), inner.session, inner.received
            ),
            (SECURITY_CLASS, Function.ARM): lambda inner: self.streams.arm(_payload(inner), *inner[1:3]),
            (SECURITY_CLASS, Function.POWER): self._power,
            (SECURITY_CLASS, Function.OPERATION): self._operation,
            (SECURITY_CLASS, Function.DRIVE): lambda inner: self.streams.drive(_payload(inner), *inner[1:3]),
        }

    # -- called by Tim ---------------------------------------------------------------------------------------------

    def now(self) -> int:
        """Return the present tick."""
        return self._hardware.now()

    def knows(self, command: Command) -> bool:
        """Return True if a command is one of operation.md."""
        return (command.command_class, command.function) in self._commands

    def run(self, inner: InnerCommand) -> Reply:
        """Run one inner command that it knows; raises CommandRefusedError."""
        self.poll()  # first end expired leases and dead-men, and take samples that are due, for example before a Stop
        self._ports[inner.session] = inner.port
        return Reply(True, self._commands[inner.command.command_class, inner.command.function](inner))

    def demand_configuration(self, session: NodeSession | None, *, writes_over_nfc: bool = False) -> None:
        """Check 1.3, 1.4, 128.10: reason 2 in a session with a claim, 17 if another session has one (section 1).

        ``writes_over_nfc``: 1.3 over NFC, which ends the claims of others on sensors once it is good.
        """
        self.poll()
        claiming = self.claims.sessions()
        demand(session is None or session not in claiming, Reason.WRONG_STATE)
        demand(not claiming or (writes_over_nfc and not self.claims.actuators), Reason.BUSY)

    def session_ended(self, session: NodeSession) -> None:
        """End the claims, streams and arms of a session that is over."""
        self.claims.release(session)
        self.streams.session_ended(session)
        self._ports.pop(session, None)

    # -- events, and queries of links ------------------------------------------------------------------------------

    def poll(self) -> float | None:
        """Take what is due; return seconds until a sample, lease or dead-man is due again, None if none is known.

        :meth:`next_frame_in` reports waiting frames: only the link knows when its controller is free for one.
        """
        if self.claims.sessions() and self._hardware.power().flags & PowerFlag.TOO_LOW:
            self.claims.release_all()
        self.claims.expire(self._real())
        now = self._hardware.now()
        self.streams.sample(now)
        waits = [at - now for at in (self.streams.next_instant(),) if at is not None]
        waits += [at - self._real() for at in (self.claims.next_deadline(),) if at is not None]
        return max(0, min(waits)) / SECOND if waits else None

    def next_frame_in(self) -> float | None:
        """Return seconds until the next data frame of any bus may begin; None if none is waiting."""
        due = self.streams.next_frame()
        return None if due is None else max(0, due - self._real()) / SECOND

    def frame(self, bus: str) -> DataFrame | None:
        """Return the next data frame of a bus, if one may begin now."""
        return self.streams.frame(bus)

    # -- claims ----------------------------------------------------------------------------------------------------

    def _operate(self, inner: InnerCommand) -> bytes:
        number, session = inner.command.channel, inner.session
        channels = self._hardware.channels
        sensors = [channel for channel, facts in self._hardware.channels.items() if not facts.actuator]
        demand(number in channels or (number == 0 and bool(sensors)), Reason.UNKNOWN_COMMAND)
        acting = number != 0 and channels[number].actuator
        asked = OperateCommand.decode(number, inner.command.payload, actuator=acting)
        digest = hashlib.sha256(self._flash().security_teds()).digest()[:DIGEST_OCTETS]
        demand(asked.digest == digest, Reason.DIGEST_MISMATCH)
        wanted = [number] if number else [number for number in sensors if not self._hardware.fault(number)]
        wanted = list(filter(self._fits, wanted))
        demand(bool(wanted), Reason.DIGEST_MISMATCH)
        demand(FIRST_LEASE <= asked.lease <= LAST_LEASE, Reason.OUT_OF_RANGE)
        if asked.dead_man is not None:
            demand(FIRST_DEAD_MAN <= asked.dead_man <= LAST_DEAD_MAN, Reason.OUT_OF_RANGE)
        # An actuator has one claim: refuse with 2 if it is this session's, with 17 if it is another one's.
        held = self.claims.actuators.get(number)
        if held is not None:
            raise CommandRefusedError(Reason.WRONG_STATE if held.session is session else Reason.BUSY)
        low = self._hardware.power().flags & PowerFlag.TOO_LOW
        demand(not low and not any(map(self._hardware.fault, wanted)), Reason.FAULT)
        if asked.dead_man is not None:
            self.claims.claim_actuator(session, number, asked.lease, asked.dead_man, self._real())
        else:
            self.claims.claim_sensors(session, wanted, asked.lease)
        return b""

    def _idle(self, inner: InnerCommand) -> bytes:
        number = inner.command.channel
        demand(number == 0 or number in self._hardware.channels, Reason.UNKNOWN_COMMAND)
        demand_form(not inner.command.payload)
        self.claims.release(inner.session, None if number == 0 else [number])
        return b""

    def _operation(self, inner: InnerCommand) -> bytes:
        demand_form(not inner.command.payload)
        rows = {channel: self._state(channel, inner.session) for channel in self._hardware.channels}
        return OperationReply(bool(self.claims.sessions()), rows).encode()

    def _state(self, channel: int, session: NodeSession) -> tuple[ChannelState, int]:
        holders = self.claims.holders(channel)
        kind = self._hardware.channels[channel].kind
        bits = {
            ChannelState.ACTUATOR: kind is ChannelKind.ACTUATOR,
            ChannelState.CLAIMED_HERE: session in holders,
            ChannelState.CLAIMED_BY_OTHER: bool(holders - {session}),
            ChannelState.EVENT_SENSOR: kind is ChannelKind.EVENT_SENSOR,
            ChannelState.SAFE: channel in self.claims.safe,
            ChannelState.STOPPED: channel in self.claims.stopped,
            ChannelState.TESTING: self._hardware.testing(channel),
            ChannelState.FAULT: self._hardware.fault(channel),
        }
        state = ChannelState(sum(bit for bit, holds in bits.items() if holds))
        return state, max((self._ports[holder].source for holder in holders), default=0)

    # -- one value at a time ---------------------------------------------------------------------------------------

    def _read(self, inner: InnerCommand) -> bytes:
        channel, facts = self._addressed(inner)
        payload = inner.command.payload
        demand_form(len(payload) == _OFFSET_OCTETS)
        self._demand_claimed(inner.session, channel)
        demand(payload == bytes(_OFFSET_OCTETS), Reason.OUT_OF_RANGE)
        self._demand_sound(channel)
        return payload + self._value(channel, facts, self._hardware.now())[0]

    def _sample(self, inner: InnerCommand) -> bytes:
        channels = channel_list(inner.command.payload, MOST_SAMPLE_CHANNELS)
        self._demand_claimed(inner.session, *channels)
        facts = [self._hardware.channels[channel] for channel in channels]
        demand(9 + sum(channel.octets for channel in facts) <= self._max_message - READ_OVERHEAD, Reason.TOO_LARGE)
        self._demand_sound(*channels)
        tick = self._hardware.now()
        values = [self._value(channel, hardware, tick) for channel, hardware in zip(channels, facts, strict=True)]
        flags = 0 if all(valid for _, valid in values) else NOT_VALID
        return SampleReply(tick, flags, b"".join(octets for octets, _ in values)).encode()

    def _write(self, inner: InnerCommand) -> bytes:
        channel, facts = self._addressed(inner)
        payload = inner.command.payload
        demand_form(len(payload) == _OFFSET_OCTETS + facts.octets)
        self._demand_claimed(inner.session, channel)
        demand(facts.actuator, Reason.NOT_PERMITTED)
        demand(payload[:_OFFSET_OCTETS] == bytes(_OFFSET_OCTETS), Reason.OUT_OF_RANGE)
        self._apply({channel: payload[_OFFSET_OCTETS:]})
        return b""

    def _set(self, inner: InnerCommand) -> bytes:
        values = self._pairs(inner.command.payload)
        self._demand_claimed(inner.session, *values)
        demand(all(self._hardware.channels[channel].actuator for channel in values), Reason.NOT_PERMITTED)
        self._apply(values)
        return b""

    def _pairs(self, payload: bytes) -> dict[int, bytes]:
        """Parse (channel, data set) … to the end; after an absent channel, which has no width, nothing is read."""
        demand_form(bool(payload))
        values: dict[int, bytes] = {}
        at = 0
        while at < len(payload):
            channel = payload[at]
            demand_form(channel != 0 and channel not in values)
            facts = self._hardware.channels.get(channel)
            if facts is None:
                raise CommandRefusedError(Reason.WRONG_STATE)
            octets = payload[at + 1 : at + 1 + facts.octets]
            demand_form(len(octets) == facts.octets)
            values[channel] = octets
            at += 1 + facts.octets
        return values

    def _apply(self, values: dict[int, bytes]) -> None:
        demand(all(self._hardware.accepts(channel, octets) for channel, octets in values.items()), Reason.OUT_OF_RANGE)
        self._demand_sound(*values)
        self._hardware.apply(values)
        self.claims.fed(values, self._real())

    def _self_test(self, inner: InnerCommand) -> bytes:
        number, channels = inner.command.channel, self._hardware.channels
        demand(number == 0 or number in channels, Reason.UNKNOWN_COMMAND)
        demand_form(len(inner.command.payload) == 1)
        demand(inner.command.payload == b"\0", Reason.OUT_OF_RANGE)
        wanted = sorted(channels) if number == 0 else [number]
        demand(all(self.claims.holders(channel) <= {inner.session} for channel in wanted), Reason.BUSY)
        self._hardware.self_test(wanted)
        return b""

    def _power(self, inner: InnerCommand) -> bytes:
        demand_form(not inner.command.payload)
        return self._hardware.power().encode()

    # -- internals -------------------------------------------------------------------------------------------------

    def _addressed(self, inner: InnerCommand) -> tuple[int, ChannelHardware]:
        facts = self._hardware.channels.get(inner.command.channel)
        if facts is None:
            raise CommandRefusedError(Reason.UNKNOWN_COMMAND)
        return inner.command.channel, facts

    def _demand_claimed(self, session: NodeSession, *channels: int) -> None:
        demand(all(self.claims.holds(session, channel) for channel in channels), Reason.WRONG_STATE)

    def _demand_sound(self, *channels: int) -> None:
        demand(not any(map(self._hardware.fault, channels)), Reason.FAULT)

    def _value(self, channel: int, facts: ChannelHardware, tick: int) -> tuple[bytes, bool]:
        if facts.actuator:
            return self._hardware.set_point(channel), True
        octets, valid = self._hardware.read(channel, tick)
        return octets, valid and not self._hardware.testing(channel)

    def _channel_teds(self, channel: int) -> bytes | None:
        return self._flash().teds((channel, AccessCode.CHANNEL))

    def _fits(self, channel: int) -> bool:
        return teds_fits(self._hardware.channels[channel], self._channel_teds(channel))

    def _claims_ended(self, session: NodeSession, channels: frozenset[int]) -> None:
        self.streams.claims_ended(session, channels)

    def _real(self) -> int:
        return round(self._clock() * SECOND)


def _payload(inner: InnerCommand) -> bytes:
    return inner.command.payload
