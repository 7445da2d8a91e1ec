"""Commands and replies over BLE: cut into frames and put together (profile.md, "BLE"). Pure, both roles.

A frame is ``transaction u16 ‖ total u16 ‖ offset u16 ‖ piece``. A station writes them with response, a node notifies
them, in order; data messages go another way (``protocol.operation.can_frames``).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

SERVICE: Final = "d8570001-29b5-44d3-91d4-401ec8a7a4d4"
WRITE: Final = "d8570002-29b5-44d3-91d4-401ec8a7a4d4"
NOTIFY: Final = "d8570003-29b5-44d3-91d4-401ec8a7a4d4"
DATA: Final = "d8570004-29b5-44d3-91d4-401ec8a7a4d4"
MOST_VALUE: Final = 512
"""Octets of an attribute value (Bluetooth Core, Vol 3 Part F, 3.2.9)."""
LEAST_MTU: Final = 23
_HEAD: Final = struct.Struct(">HHH")
_ATT_OCTETS: Final = 3


def piece_octets(mtu: int) -> int:
    """Return the octets of a command or reply in one frame: min(MTU - 3, 512) - 6."""
    return min(max(mtu, LEAST_MTU) - _ATT_OCTETS, MOST_VALUE) - _HEAD.size


def cut(transaction: int, message: bytes, mtu: int) -> Iterator[bytes]:
    """Yield the frames of one command or reply."""
    room = piece_octets(mtu)
    for offset in range(0, max(1, len(message)), room):
        yield _HEAD.pack(transaction, len(message), offset) + message[offset : offset + room]


class ReceivedMessage(NamedTuple):
    """A whole command or reply and its transaction."""

    transaction: int
    message: bytes


class BleAssembly:
    """Puts frames of one connection together; a message longer than ``most`` octets is never begun.

    Offset 0 starts a new message; a frame that does not continue the current one drops it. Neither is answered: the
    other side repeats.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._transaction = self._total = 0
        self._held: bytearray | None = None

    def add_frame(self, frame: bytes) -> ReceivedMessage | None:
        """Add one frame; return the message if it was the last one."""
        if len(frame) < _HEAD.size:
            self._held = None
            return None
        transaction, total, offset = _HEAD.unpack_from(frame)
        piece = frame[_HEAD.size :]
        if offset == 0:
            self._transaction, self._total = transaction, total
            self._held = bytearray() if total <= self._most else None
        held = self._held
        if (
            held is None
            or (transaction, total, offset) != (self._transaction, self._total, len(held))
            or offset + len(piece) > total
            or (not piece and total)
        ):
            self._held = None
            return None
        held += piece
        if len(held) < total:
            return None
        self._held = None
        return ReceivedMessage(transaction, bytes(held))
