"""Clock and trigger on the station's side: offset, its bound, dishonest clocks, tokens (operation.md section 5)."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from typing import Final, NamedTuple

from teds_provision.errors import NotAuthenticError
from teds_provision.protocol.operation.can_frames import TOKEN_OCTETS
from teds_provision.protocol.operation.stream_commands import Action, ArmCommand, ClockReply
from teds_provision.protocol.operation.subscription import TickBounds

START_AFTER_MARK: Final = 10 * 10**6
"""Streams start so many ns after the mark, the same on all nodes."""
MILLION: Final = 10**6


@dataclass(frozen=True)
class ClockSample:
    """One exchange of Clock.

    Station times in ns: ``asked`` when the first copy left, ``answered`` when all had arrived.

    Raises NotAuthenticError if the node's two ticks are impossible: its clock is dishonest.
    """

    asked: int
    answered: int
    reply: ClockReply

    def __post_init__(self) -> None:
        inside = self.reply.sent - self.reply.received
        if not 0 <= inside <= self.answered - self.asked:
            raise NotAuthenticError("The node's clock lies: its answer took longer than the exchange.")

    @property
    def offset(self) -> float:
        """Node's tick minus station's time, in ns: ((received - asked) + (sent - answered)) / 2."""
        return ((self.reply.received - self.asked) + (self.reply.sent - self.answered)) / 2

    def error(self, at: int, *, own_drift: float = 0.0) -> float:
        """Return the bound of the offset's error, ns, at station time ``at``; ``own_drift``: the station's, in ppm."""
        reply = self.reply
        round_trip = (self.answered - self.asked) - (reply.sent - reply.received)
        age = max(0, at - self.answered)
        return round_trip / 2 + reply.step + (reply.drift + own_drift) * age / MILLION

    def tick(self, at: int, *, own_drift: float = 0.0) -> TickBounds:
        """Return the bounds of the node's tick at station time ``at``."""
        middle, error = at + self.offset, self.error(at, own_drift=own_drift)
        return TickBounds(int(middle - error), int(middle + error) + 1)


class TriggerToken(NamedTuple):
    """T of one trigger, 8 octets that only the station knows; its commitment C goes to the nodes, T on the bus."""

    octets: bytes

    @classmethod
    def draw(cls) -> TriggerToken:
        """Return a new one; each is for one use."""
        return cls(os.urandom(TOKEN_OCTETS))

    @property
    def commitment(self) -> bytes:
        """C = SHA-256("TEDS1 trigger" ‖ 00 ‖ T)[0:16]."""
        return commitment(self.octets)

    def arm(self, action: Action, life: int) -> ArmCommand:
        """Arm (send ``.command()`` in each node's session); ``life`` 1 to 60 s."""
        return ArmCommand(self.commitment, life, action)


def commitment(token: bytes) -> bytes:
    """Return C of a token T."""
    return hashlib.sha256(b"TEDS1 trigger\0" + token).digest()[:16]


def mark_is_honest(mark: int, seen: TickBounds) -> bool:
    """Return True if a node's mark matches the time, in its ticks, at which the station sent the trigger frame."""
    return seen.low <= mark <= seen.high
