"""Drive messages on the station's side: sealed, with the time until which they hold (operation.md section 4)."""

from __future__ import annotations

from typing import Final

from teds_provision.errors import GarbledError, NotAuthenticError
from teds_provision.protocol.operation.datagram import (
    LAST_COUNTER,
    DatagramSealer,
    DriveValues,
    Layout,
    drive_key,
    drive_length,
)
from teds_provision.protocol.operation.stream_commands import DriveReply
from teds_provision.protocol.operation.subscription import TickBounds, require_new_run

MICRO: Final = 1000
_WRAP: Final = 1 << 32


class Driver:
    """Seals the values of one run of Drive; ``layout`` has channels and widths, ``dead_man`` the smallest of them, ms.

    ``after`` is the session's last run of Drive. Raises NotAuthenticError if the reply's length is not the computed
    one, or its run is not a new one.
    """

    def __init__(self, layout: Layout, reply: DriveReply, message_key: bytes, *, dead_man: int, after: int = 0) -> None:
        if reply.length != drive_length(layout.octets):
            raise NotAuthenticError(
                f"The node takes Drive messages of {reply.length} octets; {drive_length(layout.octets)} were computed."
            )
        require_new_run(reply.run, after)
        self.layout, self.run = layout, reply.run
        self.next = 0
        self._dead_man = dead_man * 10**6
        self._sealer = DatagramSealer(drive_key(message_key, reply.run))

    def seal(self, values: tuple[bytes, ...], now: TickBounds, *, hold: int | None = None) -> bytes:
        """Seal one message with these data sets, in the layout's order.

        It holds for ``hold`` ns from the earliest that the node's tick can be now (the dead-man by default, and never
        longer), so that it is never too far ahead for the node. Raises GarbledError if the counters are used up.
        """
        if tuple(map(len, values)) != self.layout.widths:
            raise GarbledError("The data sets of a Drive message do not have the widths of its channels.")
        if self.next > LAST_COUNTER:
            raise GarbledError("This Drive has used up its counters; ask for a new one.")
        until = (now.low + min(self._dead_man, hold or self._dead_man)) // MICRO % _WRAP
        message = self._sealer.seal(self.next, DriveValues(until, b"".join(values)).encode())
        self.next += 1
        return message
