"""Claims of channels: leases, dead-men, safe states (operation.md sections 1 and 2). For the node, in RAM only.

A claim belongs to a session. Times here are real ns (the node's monotonic time, which a simulation's ticks need not
follow): a dead station must silence the node however its ticks run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from teds_provision.protocol.operation.hardware import Hardware
from teds_provision.protocol.session import NodeSession

SECOND: Final = 10**9
MILLI: Final = 10**6


@dataclass
class Actuation:
    """One claimed actuator: its session, its dead-man and when that runs out, ns."""

    session: NodeSession
    dead_man: int
    deadline: int


class Claims:
    """Claims of every session. ``ended`` is called with a session and its channels whenever claims end."""

    def __init__(self, hardware: Hardware, ended: Callable[[NodeSession, frozenset[int]], None]) -> None:
        self._hardware, self._ended = hardware, ended
        self._sensors: dict[int, set[NodeSession]] = {}
        self._leases: dict[NodeSession, int] = {}
        self.actuators: dict[int, Actuation] = {}
        self.safe: set[int] = set()
        self.stopped: set[int] = set()
        for channel, facts in hardware.channels.items():
            if facts.actuator:
                self._go_safe(channel)

    # -- queries ---------------------------------------------------------------------------------------------------

    def channels_of(self, session: NodeSession) -> frozenset[int]:
        """Return the channels that a session claims."""
        sensors = {channel for channel, sessions in self._sensors.items() if session in sessions}
        acting = {channel for channel, held in self.actuators.items() if held.session is session}
        return frozenset(sensors | acting)

    def holds(self, session: NodeSession, channel: int) -> bool:
        """Return True if a session claims a channel."""
        held = self.actuators.get(channel)
        return (held is not None and held.session is session) or session in self._sensors.get(channel, ())

    def holders(self, channel: int) -> set[NodeSession]:
        """Return the sessions that claim a channel."""
        held = self.actuators.get(channel)
        return set(self._sensors.get(channel, ())) | ({held.session} if held is not None else set())

    def sessions(self) -> set[NodeSession]:
        """Return the sessions that claim something."""
        return {held.session for held in self.actuators.values()}.union(*self._sensors.values())

    # -- claim and release -----------------------------------------------------------------------------------------

    def claim_sensors(self, session: NodeSession, channels: Iterable[int], lease: int) -> None:
        """Claim sensors for ``lease`` s; several sessions may."""
        for channel in channels:
            self._sensors.setdefault(channel, set()).add(session)
        self._leases[session] = lease * SECOND

    def claim_actuator(self, session: NodeSession, channel: int, lease: int, dead_man: int, now: int) -> None:
        """Claim an actuator; it stays in its safe state until its first value. ``dead_man`` in ms."""
        self._go_safe(channel)
        self.stopped.discard(channel)
        self.actuators[channel] = Actuation(session, dead_man * MILLI, now + dead_man * MILLI)
        self._leases[session] = lease * SECOND

    def fed(self, channels: Iterable[int], now: int) -> None:
        """Extend the dead-man of these actuators: good values arrived and were applied."""
        for channel in channels:
            held = self.actuators[channel]
            held.deadline = now + held.dead_man
            self.safe.discard(channel)

    def release(self, session: NodeSession, channels: Iterable[int] | None = None, *, stopped: bool = False) -> None:
        """End a session's claims of these channels, None: all; its actuators go safe first."""
        going = self.channels_of(session) if channels is None else self.channels_of(session) & frozenset(channels)
        for channel in going:
            if channel in self.actuators:
                del self.actuators[channel]
                self._go_safe(channel)
                if stopped:
                    self.stopped.add(channel)
            else:
                self._sensors[channel].discard(session)
        if not self.channels_of(session):
            self._leases.pop(session, None)
        if going:
            self._ended(session, going)

    def release_all(self) -> None:
        """End every claim; every actuator goes safe, claimed or not."""
        for session in self.sessions():
            self.release(session)

    def everything_safe(self) -> None:
        """Bring every actuator to its safe state, before something is written to flash."""
        self.release_all()
        for channel, facts in self._hardware.channels.items():
            if facts.actuator and channel not in self.safe:
                self._go_safe(channel)

    def yield_sensors(self, session: NodeSession) -> None:
        """End the claims of all other sessions on sensors."""
        for other in self.sessions() - {session}:
            self.release(other, [channel for channel in self.channels_of(other) if channel not in self.actuators])

    # -- time ------------------------------------------------------------------------------------------------------

    def expire(self, now: int) -> None:
        """End what a dead-man or a lease ends; ``now`` in real ns."""
        late = [(channel, held.session) for channel, held in self.actuators.items() if now >= held.deadline]
        for channel, session in late:
            self.release(session, [channel], stopped=True)
        for session, lease in list(self._leases.items()):
            if now >= _last_sign(session) + lease:
                self.release(session)

    def next_deadline(self) -> int | None:
        """Return when :meth:`expire` is due next, real ns; None if nothing is claimed."""
        due = [held.deadline for held in self.actuators.values()]
        due += [_last_sign(session) + lease for session, lease in self._leases.items()]
        return min(due, default=None)

    def _go_safe(self, channel: int) -> None:
        self._hardware.make_safe(channel)
        self.safe.add(channel)


def _last_sign(session: NodeSession) -> int:
    """Return when the last good Sealed frame of a session arrived, real ns."""
    return round(session.good_at * SECOND)
