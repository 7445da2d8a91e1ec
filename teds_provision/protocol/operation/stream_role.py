"""Subscribe, Stop, Drive, Clock, Arm and their effects, on the node (operation.md sections 4 and 5). Pure."""

from __future__ import annotations

import hmac
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from teds_provision.protocol.messages.frames import CommandRefusedError, Reason
from teds_provision.protocol.operation import budget
from teds_provision.protocol.operation.can_frames import StreamAssembly
from teds_provision.protocol.operation.claims import Claims
from teds_provision.protocol.operation.commands import channel_list, demand_form
from teds_provision.protocol.operation.datagram import (
    LAST_RUN,
    DatagramSealer,
    DriveValues,
    Layout,
    counter_of,
    drive_key,
    drive_length,
)
from teds_provision.protocol.operation.hardware import Hardware, SessionPort, teds_period
from teds_provision.protocol.operation.stream_commands import (
    MOST_STREAM_CHANNELS,
    NONE,
    SOON,
    WAITS,
    Action,
    ArmCommand,
    ClockReply,
    DriveReply,
    StreamKind,
    SubscribeCommand,
    SubscribeReply,
)
from teds_provision.protocol.operation.streams import MICRO, DataFrame, Sender, Stream
from teds_provision.protocol.operation.timing import START_AFTER_MARK, commitment
from teds_provision.protocol.session import NodeSession
from teds_provision.teds.sheet import ChannelKind

SECOND: Final = 10**9
SOON_NS: Final = 30 * 10**6
"""A stream that may begin when the node likes begins so many ns after Subscribe: its reply has left by then."""
LONGEST_PERIOD: Final = 10**12
LATEST_START: Final = 60 * SECOND
LONGEST_LIFE: Final = 60
_WRAP: Final = 1 << 32


class ArmedTrigger(NamedTuple):
    """A trigger that is awaited: C, and until when (real ns)."""

    commitment: bytes
    until: int


@dataclass
class DriveRun:
    """The Drive of a session: ``last`` is the highest counter with a good tag."""

    layout: Layout
    sealer: DatagramSealer = field(repr=False)
    assembly: StreamAssembly
    last: int | None = None


@dataclass
class _SessionStreams:
    """A session's state besides its claims: the last run, what is armed, the mark, its Drive."""

    run: int = 0
    armed: dict[Action, ArmedTrigger] = field(default_factory=dict)
    mark: int = 0
    drive: DriveRun | None = None


def demand(holds: bool, reason: Reason) -> None:
    """Raise CommandRefusedError unless ``holds``."""
    if not holds:
        raise CommandRefusedError(reason)


class StreamRole:
    """Streams, Drive and triggers of every session. ``teds`` gives a channel's stored TEDS, ``real`` real ns.

    ``room`` is how many streams there may be over all sessions.
    """

    def __init__(
        self,
        hardware: Hardware,
        claims: Claims,
        *,
        teds: Callable[[int], bytes | None],
        real: Callable[[], int],
        address: Callable[[], int],
        room: int,
    ) -> None:
        self._hardware, self._claims = hardware, claims
        self._teds, self._real, self._address, self._room = teds, real, address, room
        self._streams: list[Stream] = []
        self._senders: dict[str, Sender] = {}
        self._sessions: dict[NodeSession, _SessionStreams] = {}
        self._missed = 0

    @property
    def running(self) -> bool:
        """True if a stream runs."""
        return bool(self._streams)

    @property
    def missed(self) -> int:
        """Messages that were full and could not leave in time, since the start."""
        return self._missed + sum(stream.missed for stream in self._streams)

    @property
    def backlog(self) -> bool:
        """True if a full message waits to be begun."""
        return any(stream.waiting is not None and stream.ready for stream in self._streams)

    # -- commands --------------------------------------------------------------------------------------------------

    def subscribe(self, payload: bytes, session: NodeSession, port: SessionPort) -> bytes:
        """Subscribe: every check in the order of section 4, then the stream."""
        asked = SubscribeCommand.decode(payload)
        demand(port.kind != "nfc", Reason.DOES_NOT_FIT)
        demand(port.hears, Reason.WRONG_STATE)
        layout = self._layout(asked.channels, session)
        kinds = [self._hardware.channels[channel].kind for channel in asked.channels]
        demand(ChannelKind.ACTUATOR not in kinds, Reason.NOT_PERMITTED)
        events = [kind is ChannelKind.EVENT_SENSOR for kind in kinds]
        demand(all(events) if asked.kind == StreamKind.EVENT else not any(events), Reason.OUT_OF_RANGE)
        shortest = [self._hardware.channels[channel].shortest for channel in asked.channels]
        shortest += [teds_period(self._teds(channel)) for channel in asked.channels]
        demand(max(1, *shortest) <= asked.period <= LONGEST_PERIOD, Reason.OUT_OF_RANGE)
        demand(self._hardware.keeps(asked.period), Reason.OUT_OF_RANGE)
        length = asked.length(layout.octets)
        most = min(budget.MOST_OCTETS, port.mtu - budget.BLE_OVERHEAD) if port.kind == "ble" else budget.MOST_OCTETS
        demand(length <= most, Reason.TOO_LARGE)
        old = self._find(session, asked.stream)
        others = [stream for stream in self._streams if stream is not old]
        demand(_share(others, asked, length, port) <= budget.MILLION, Reason.DOES_NOT_FIT)
        now = self._hardware.now()
        if asked.start == WAITS:
            demand(port.kind == "can", Reason.DOES_NOT_FIT)
        elif asked.start != SOON:
            demand(now < asked.start <= now + LATEST_START, Reason.TOO_LATE)
        own = self._measuring_of(session)
        demand(own.run < LAST_RUN and len(others) < self._room, Reason.NO_ROOM)
        own.run += 1
        if old is not None:
            self._end(old)
        start = now + SOON_NS if asked.start == SOON else asked.start
        stream = Stream(session, port, asked, layout, own.run, None if start == WAITS else start)
        self._streams.append(stream)
        return SubscribeReply(own.run, length, start).encode()

    def stop(self, payload: bytes, session: NodeSession) -> bytes:
        """Stop: the counter that the next message would have had."""
        demand_form(len(payload) == 1)
        stream = self._find(session, payload[0])
        if stream is None:
            raise CommandRefusedError(Reason.WRONG_STATE)
        if stream.start is not None:
            stream.sample(self._hardware, self._hardware.now())
        self._end(stream)
        return min(stream.counter, NONE).to_bytes(4, "big")

    def drive(self, payload: bytes, session: NodeSession, port: SessionPort) -> bytes:
        """Drive: values for these actuators by message from now on."""
        channels = channel_list(payload, MOST_STREAM_CHANNELS)
        demand(port.kind != "nfc", Reason.DOES_NOT_FIT)
        layout = self._layout(channels, session)
        demand(all(self._hardware.channels[channel].actuator for channel in channels), Reason.NOT_PERMITTED)
        own = self._measuring_of(session)
        demand(own.run < LAST_RUN, Reason.NO_ROOM)
        own.run += 1
        length = drive_length(layout.octets)
        sealer = DatagramSealer(drive_key(session.message_key, own.run))
        own.drive = DriveRun(layout, sealer, StreamAssembly(length, fd=port.fd, drive=True))
        return DriveReply(own.run, length).encode()

    def clock(self, payload: bytes, session: NodeSession, received: int) -> bytes:
        """Reply to Clock; ``received`` is the tick at which the last frame of the request arrived."""
        demand_form(not payload)
        own, hardware = self._measuring_of(session), self._hardware
        last = NONE if own.drive is None or own.drive.last is None else own.drive.last
        return ClockReply(received, hardware.now(), own.mark, hardware.step, hardware.drift, last).encode()

    def arm(self, payload: bytes, session: NodeSession, port: SessionPort) -> bytes:
        """Arm: one trigger per action; life 0 disarms."""
        asked = ArmCommand.decode(payload)
        demand(asked.life <= LONGEST_LIFE and asked.action in set(Action), Reason.OUT_OF_RANGE)
        demand(port.kind == "can", Reason.DOES_NOT_FIT)
        armed = self._measuring_of(session).armed
        armed.pop(Action(asked.action), None)
        if asked.life:
            armed[Action(asked.action)] = ArmedTrigger(asked.commitment, self._real() + asked.life * SECOND)
        return b""

    # -- triggers and events ---------------------------------------------------------------------------------------

    def trigger(self, session: NodeSession, token: bytes, tick: int) -> None:
        """Handle a trigger frame of this session's station; the clock was at ``tick`` at the frame's end."""
        own, seen = self._measuring_of(session), commitment(token)
        for action, armed in list(own.armed.items()):
            if self._real() >= armed.until:
                del own.armed[action]
            elif hmac.compare_digest(armed.commitment, seen):
                del own.armed[action]
                own.mark = tick
                if action == Action.START:
                    for stream in self._streams:
                        if stream.session is session and stream.start is None:
                            stream.start = tick + START_AFTER_MARK
                elif action == Action.STOP:
                    acting = [
                        channel for channel in self._claims.channels_of(session) if channel in self._claims.actuators
                    ]
                    self._claims.release(session, acting, stopped=True)

    def drive_frame(self, session: NodeSession, data: bytes) -> None:
        """Handle one CAN frame of a Drive message."""
        drive = self._measuring_of(session).drive
        message = drive.assembly.add_drive_segment(data) if drive is not None else None
        if message is not None:
            self.drive_message(session, message)

    def drive_message(self, session: NodeSession, message: bytes) -> None:
        """Handle one whole Drive message; a bad one is dropped silently."""
        drive = self._measuring_of(session).drive
        if drive is None or len(message) != drive.assembly.length:
            return
        counter = counter_of(message)
        if drive.last is not None and counter <= drive.last:
            return
        plain = drive.sealer.open(message)
        if plain is None:
            return
        drive.last = counter
        values = DriveValues.decode(plain)
        channels = drive.layout.channels
        data = dict(zip(channels, drive.layout.cut(values.data), strict=True))
        if self._in_time(values.until, channels) and self._can_apply(data):
            self._hardware.apply(data)
            self._claims.fed(channels, self._real())

    def _in_time(self, until: int, channels: Sequence[int]) -> bool:
        """Return True if it is not past (far ahead, mod 2^32), nor further ahead than the shortest dead-man."""
        ahead = (until - self._hardware.now() // MICRO) % _WRAP
        return ahead <= min(self._claims.actuators[channel].dead_man for channel in channels) // MICRO

    def _can_apply(self, data: dict[int, bytes]) -> bool:
        if not all(self._hardware.accepts(channel, octets) for channel, octets in data.items()):
            return False
        return not any(map(self._hardware.fault, data))

    def event(self, channel: int, tick: int, octets: bytes, *, valid: bool) -> None:
        """Record a value of an event sensor."""
        for stream in self._streams:
            stream.event(channel, tick, octets, valid=valid)

    # -- ends ------------------------------------------------------------------------------------------------------

    def claims_ended(self, session: NodeSession, channels: frozenset[int]) -> None:
        """End streams and Drive over any of these channels, whose claims ended; with the last one what is armed."""
        for stream in [s for s in self._streams if s.session is session and channels.intersection(s.channels)]:
            self._end(stream)
        own = self._measuring_of(session)
        if own.drive is not None and channels.intersection(own.drive.layout.channels):
            own.drive = None
        if not self._claims.channels_of(session):
            own.armed.clear()

    def session_ended(self, session: NodeSession) -> None:
        """End the streams of a session that is over, together with its claims."""
        self._sessions.pop(session, None)

    def unheard(self, session: NodeSession) -> None:
        """End the session's streams: the station has disabled data messages on its connection (section 6)."""
        for stream in [stream for stream in self._streams if stream.session is session]:
            self._end(stream)

    # -- time ------------------------------------------------------------------------------------------------------

    def reply_sent(self, session: NodeSession) -> None:
        """Let the session's streams send: the reply to its last command has left."""
        for stream in self._streams:
            if stream.session is session:
                stream.ready = True

    def sample(self, now: int) -> None:
        """Take what is due at tick ``now``."""
        for stream in list(self._streams):
            stream.sample(self._hardware, now)
            if stream.ended and stream.waiting is None and not self._sender(stream.port.bus).sends(stream):
                self._end(stream)  # the message with the last counter was sent

    def next_instant(self) -> int | None:
        """Return the tick of the next sample."""
        due = [stream.next_instant for stream in self._streams]
        return min((tick for tick in due if tick is not None), default=None)

    def frame(self, bus: str) -> DataFrame | None:
        """Return the next data frame of a bus, if one may begin now."""
        return self._sender(bus).frame(self._on(bus), self._real())

    def next_frame(self) -> int | None:
        """Return when the next data frame of any bus may begin, real ns, None for none."""
        due = [self._sender(bus).due(self._on(bus)) for bus in {stream.port.bus for stream in self._streams}]
        return min((at for at in due if at is not None), default=None)

    # -- internals -------------------------------------------------------------------------------------------------

    def _measuring_of(self, session: NodeSession) -> _SessionStreams:
        return self._sessions.setdefault(session, _SessionStreams())

    def _on(self, bus: str) -> list[Stream]:
        return [stream for stream in self._streams if stream.port.bus == bus]

    def _sender(self, bus: str) -> Sender:
        if bus not in self._senders:
            self._senders[bus] = Sender(self._address)
        return self._senders[bus]

    def _find(self, session: NodeSession, number: int) -> Stream | None:
        return next((s for s in self._streams if s.session is session and s.asked.stream == number), None)

    def _layout(self, channels: tuple[int, ...], session: NodeSession) -> Layout:
        """Return the widths of channels; refuses with 2 those that are absent or not claimed by this session."""
        demand(all(self._claims.holds(session, channel) for channel in channels), Reason.WRONG_STATE)
        return Layout(channels, tuple(self._hardware.channels[channel].octets for channel in channels))

    def _end(self, stream: Stream) -> None:
        self._missed += stream.missed
        self._streams.remove(stream)
        self._sender(stream.port.bus).take_back(stream)


def _share(others: list[Stream], asked: SubscribeCommand, length: int, port: SessionPort) -> int:
    """Return the share of the node's budget that the streams of a bus use with one more, in ppm."""
    there = [stream for stream in others if stream.port.bus == port.bus]
    widest = max([1, asked.gap, *(stream.asked.gap for stream in there)])
    shares = [
        budget.share(
            budget.frames(stream.length, link=port.kind, fd=stream.port.fd), widest, stream.asked.n, stream.asked.period
        )
        for stream in there
    ]
    new = budget.frames(length, link=port.kind, fd=port.fd)
    return sum(shares) + budget.share(new, widest, asked.n, asked.period)
