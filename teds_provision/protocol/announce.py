"""Announce on CAN, and how nodes that meet on one address resolve the conflict (profile.md, "CAN"). Pure.

An Announce carries a node's presence, its state, and the CRC-32 of its UUID. If two nodes have one address, the one
with the smaller CRC keeps it, the other takes the next address from which it has heard nothing.
"""

from __future__ import annotations

import random
import struct
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from teds_provision.protocol.messages.identity import NodeState

ANNOUNCE: Final = 0x1CFF0000
"""Identifier of an Announce without the node's address in its low octet."""
LAST_ADDRESS: Final = 239
START_SPREAD: Final = 0.5
"""An Announce after start or bus-off waits a random time of up to so many seconds."""
CLAIM_SPREAD: Final = 0.05
MOVES_AT_ONCE: Final = 3
"""Moves after a start that wait for nothing; each further one waits 1, 2, 4 … :data:`LONGEST_STAY` seconds."""
LONGEST_STAY: Final = 60.0
QUIET: Final = 600.0
"""After so many seconds without a conflict moves are immediate again."""
A_MINUTE: Final = 60.0
MOST_A_MINUTE: Final = 20
PRESSES_APART: Final = 1.0
"""Seconds between two Announces of a pressed button; more presses are left out, as those beyond 20 a minute."""
_LAYOUT: Final = struct.Struct(">BBIBB")
_VERSION: Final = 1


def uuid_crc(uuid: bytes) -> int:
    """Return the CRC-32 (IEEE 802.3) of a UUID."""
    return zlib.crc32(uuid)


def default_can_address(uuid: bytes) -> int:
    """Return a node's default address: 1 + CRC-32(UUID) mod 239 (profile.md, "CAN")."""
    return 1 + uuid_crc(uuid) % LAST_ADDRESS


@dataclass(frozen=True)
class Announce:
    """An Announce: ``address`` 1 to 239, ``crc`` = CRC-32 of the UUID. A hint, proves nothing.

    ``pressed``: sent because the node's button was pressed, which shows a person the board and moves no address.
    """

    address: int
    state: int
    crc: int
    pressed: bool = False

    @property
    def identifier(self) -> int:
        """The 29-bit identifier."""
        return ANNOUNCE | self.address

    def encode(self) -> bytes:
        """Return the 8 octets: 1 ‖ state ‖ CRC ‖ pressed ‖ 00."""
        return _LAYOUT.pack(_VERSION, self.state, self.crc, self.pressed, 0)

    @classmethod
    def decode(cls, identifier: int, data: bytes) -> Announce | None:
        """Read a frame; None for what is no Announce of version 1 of a node."""
        address = identifier & 0xFF
        if identifier & 0x1FFFFF00 != ANNOUNCE or not 1 <= address <= LAST_ADDRESS or len(data) != _LAYOUT.size:
            return None
        version, state, crc, pressed, _ = _LAYOUT.unpack(data)
        if version != _VERSION or state > NodeState.PROVISIONED:
            return None
        return cls(address, state, crc, pressed == 1)  # any other value counts as 0


def is_announce(identifier: int) -> bool:
    """Return True if a frame's identifier is that of an Announce."""
    return identifier & 0x1FFFFF00 == ANNOUNCE


@dataclass
class ButtonPresses:
    """Limits the Announces of button presses: once a second, 20 a minute; times in monotonic seconds."""

    _sent: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_A_MINUTE))

    def may_announce(self, now: float) -> bool:
        """Return True, and count it, if the press at ``now`` is announced."""
        if self._sent and now - self._sent[-1] < PRESSES_APART:
            return False
        if len(self._sent) == MOST_A_MINUTE and now - self._sent[0] < A_MINUTE:
            return False
        self._sent.append(now)
        return True


@dataclass
class AddressClaim:
    """One node's part: when to announce, and when to move. Times are monotonic seconds.

    ``crc`` of the node's UUID; ``uniform`` gives a random number between two bounds. Call :meth:`due` before each wait,
    and :meth:`announced` after each Announce that left.
    """

    crc: int
    uniform: Callable[[float, float], float] = random.uniform
    conflict: bool = False
    """Another node with the same CRC has announced itself from the same address: a matter for a person."""
    _heard: set[int] = field(default_factory=set)
    _due: float | None = None
    _move_due: float | None = None
    _moves: int = 0
    _conflict_at: float | None = None
    _sent: deque[float] = field(default_factory=deque)

    def start(self, now: float) -> None:
        """Start after power-up or bus-off: announce after a random 0 to 500 ms."""
        self._due = now + self.uniform(0, START_SPREAD)

    def hear(self, source: int) -> None:
        """Record a frame of any kind from this address."""
        self._heard.add(source)

    def handle_announce(self, announce: Announce, own: int, now: float, *, pinned: bool = False) -> int:
        """Handle a received Announce; return the address that the node has from now on, ``own`` if it stays.

        ``pinned``: an actuator of the node is claimed, so it stays and goes on announcing. An Announce proves nothing,
        and a move ends the sessions: after a few, the next waits until :meth:`move_due`. One of a pressed button claims
        nothing.
        """
        self._heard.add(announce.address)
        if announce.address != own or announce.pressed:
            return own
        if announce.crc == self.crc:
            self.conflict = True
            return own
        if self._conflict_at is not None and now - self._conflict_at >= QUIET:
            self._moves = 0
        self._conflict_at = now
        if announce.crc > self.crc or pinned:
            self._due = now + self.uniform(0, CLAIM_SPREAD)
            return own
        if self._moves < MOVES_AT_ONCE:
            return self.move(own, now)
        if self._move_due is None:
            self._move_due = now + min(LONGEST_STAY, 2.0 ** min(self._moves - MOVES_AT_ONCE, 10))
        return own

    @property
    def move_due(self) -> float | None:
        """Monotonic time at which the node leaves its address to the one that claims it, None for no such time."""
        return self._move_due

    def move(self, own: int, now: float, *, pinned: bool = False) -> int:
        """Return the address that the node moves to, and announce there; ``own`` if it stays."""
        self._move_due = None
        self._due = now + self.uniform(0, CLAIM_SPREAD)
        if pinned:
            return own
        self._moves += 1
        return self._next(own)

    def relocated(self) -> None:
        """Give up a move that waits: the node has left the contested address by command."""
        self._move_due = None

    def due(self, now: float) -> float | None:
        """Return the monotonic time at which the next Announce is due, None for none.

        One beyond the twenty of a minute is left out.
        """
        if self._due is None:
            return None
        while self._sent and self._sent[0] <= self._due - A_MINUTE:
            self._sent.popleft()
        if len(self._sent) >= MOST_A_MINUTE:
            self._due = None
        return self._due

    def announced(self, now: float) -> None:
        """Record that the due Announce has left."""
        self._sent.append(now)
        self._due = None

    def _next(self, own: int) -> int:
        for step in range(1, LAST_ADDRESS):
            address = (own - 1 + step) % LAST_ADDRESS + 1
            if address not in self._heard:
                return address
        return own  # every address is in use, so keep the own one
