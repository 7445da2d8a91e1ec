"""Who has which address on a CAN bus: nodes of one process, their Announces, claims that meet (profile.md, "CAN").

Nothing here is thread-safe: the server of the bus calls it under its lock.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from teds_provision.links.can.bus import Frame
from teds_provision.links.can.spec import LAST_NODE
from teds_provision.node.can.seat import Seat
from teds_provision.protocol.announce import Announce


class Addresses:
    """The seats of one process by their addresses.

    ``at_time`` runs a job at a moment (monotonic); ``moved`` is told of a seat that takes another address, before it
    does; ``tell`` is given what a person should know. ``echoes``: the controller gives back what we send.
    """

    def __init__(
        self,
        seats: Sequence[Seat],
        at_time: Callable[[float, Callable[[], None]], None],
        moved: Callable[[Seat], None],
        tell: Callable[[str], None],
        *,
        echoes: bool,
    ) -> None:
        self._seats, self._at_time, self._moved, self._tell, self._echoes = seats, at_time, moved, tell, echoes
        self._known: set[int] = set()
        self._at: dict[int, list[Seat]] = {}
        self.find()

    def at(self, address: int) -> Sequence[Seat]:
        """The seats that have this address; nodes that have just met may be two."""
        return self._at.get(address, ())

    def find(self) -> None:
        """Look anew who has which."""
        self._at = {}
        for seat in self._seats:
            self._at.setdefault(seat.address, []).append(seat)

    def heard(self, source: int) -> None:
        """A frame came from this address: it is taken."""
        if 1 <= source <= LAST_NODE and source not in self._known:
            self._known.add(source)
            for seat in self._seats:
                seat.claim.hear(source)

    def speaks(self, seat: Seat, identifier: int) -> None:
        """A frame of one of them leaves: the others of this process hear it as they hear those of the bus."""
        source = identifier & 0xFF
        if source not in seat.spoken_from:
            seat.spoken_from.add(source)
            for other in self._seats:
                if other is not seat:
                    other.claim.hear(source)

    def announce_all(self) -> None:
        """The bus is there: each announces itself after its random wait."""
        for seat in self._seats:
            seat.claim.start(time.monotonic())
            self._announce_when_due(seat)

    def announced(self, frame: Frame, speaker: Seat | None) -> None:
        """An Announce was heard, from the bus or from a node of this process (``speaker``)."""
        announce = Announce.decode(frame.identifier, frame.data)
        if announce is None:
            return
        for seat in list(self.at(announce.address)):
            own = self._echoes and announce.crc == seat.claim.crc  # given back by a controller that does so
            if seat is not speaker and not (speaker is None and own):
                self._contested(seat, announce)

    def _announce_when_due(self, seat: Seat) -> None:
        due = seat.claim.due(time.monotonic())
        if due is None:
            return

        def announce() -> None:
            if seat.claim.due(due) == due:
                seat.announce()

        self._at_time(due, announce)

    def _contested(self, seat: Seat, announce: Announce) -> None:
        now, before, told = time.monotonic(), seat.address, seat.claim.conflict
        address = seat.claim.take(announce, before, now, pinned=seat.handler.actuator_claimed())
        if seat.claim.conflict and not told:
            self._tell(
                f"Another node announces the UUID {seat.uuid.hex()} (or one of equal CRC-32) "
                f"from the CAN address 0x{before:02x}: take one of the two from the bus."
            )
        if address != before:
            self._moved(seat)
            seat.move(address)
            self.find()
        self._announce_when_due(seat)
