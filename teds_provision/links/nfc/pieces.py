"""The payload record and its pieces: a command frame and its reply, cut to one NDEF message each (profile.md, "NFC").

``version u8 = 1 ‖ flags u8 ‖ transaction u16 ‖ total u16 ‖ offset u16 ‖ CRC-32 u32 ‖ body``, big endian; the CRC-32
(IEEE 802.3) covers the 8 octets before it and the body. :class:`Requester` is the station's half of one transaction,
:class:`Responder` the node's half of all of them. Pure state machines: no I/O, no clock.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass

from teds_provision.errors import GarbledError
from teds_provision.links.nfc.tnep import TIM_TYPE

_HEAD = struct.Struct(">BBHHH")
_ANSWER, _MORE = 1, 2
_PIECE_HEAD = _HEAD.size + 4  # 12 octets before the body
LONGEST_FRAME = 4094  # octets: the largest maxMessage (profile.md, "Command frames")


@dataclass(frozen=True)
class Piece:
    """One payload record: ``body`` is the part at ``offset`` of a whole of ``total`` octets.

    ``answer``: the node sent it; ``more``: parts follow.
    """

    transaction: int
    total: int
    offset: int
    body: bytes
    answer: bool = False
    more: bool = False

    def encode(self) -> bytes:
        """Return the payload of the record."""
        flags = (_ANSWER if self.answer else 0) | (_MORE if self.more else 0)
        head = _HEAD.pack(1, flags, self.transaction, self.total, self.offset)
        return head + zlib.crc32(head + self.body).to_bytes(4, "big") + self.body

    @classmethod
    def decode(cls, payload: bytes) -> Piece:
        """Read the payload of the record; raises GarbledError when it is torn, corrupt or does not add up."""
        if len(payload) < _PIECE_HEAD:
            raise GarbledError(f"A payload record needs at least {_PIECE_HEAD} octets; this one has {len(payload)}.")
        version, flags, transaction, total, offset = _HEAD.unpack_from(payload)
        if version != 1:
            raise GarbledError(f"Received a payload record of version {version}; this program supports version 1.")
        body = bytes(payload[_PIECE_HEAD:])
        if zlib.crc32(payload[: _HEAD.size] + body) != int.from_bytes(payload[_HEAD.size : _PIECE_HEAD], "big"):
            raise GarbledError("A payload record is damaged: its CRC-32 does not match.")
        if body and offset + len(body) > total:
            raise GarbledError(f"A payload record ends at {offset + len(body)} of {total} octets.")
        return cls(transaction, total, offset, body, bool(flags & _ANSWER), bool(flags & _MORE))


def room(max_ndef: int, others: int = 0) -> int:
    """Return how many octets of body one message of at most ``max_ndef`` octets holds beside ``others`` octets.

    ``others`` counts the whole records in the same message. At least 1 when the profile can work; 0 or less when
    it cannot.
    """
    left = max_ndef - others - 3 - len(TIM_TYPE)  # for a short record: flags, type length, payload length
    if left > 255:
        left = max(255, left - 3)  # a payload length of 4 octets
    return left - _PIECE_HEAD


class Requester:
    """The station's half of one transaction: what to write next, and what became of what was read."""

    def __init__(self, transaction: int, frame: bytes, room_octets: int) -> None:
        self._transaction = transaction
        self._frame = frame
        self._room = room_octets
        self._held = 0
        self._total: int | None = None
        self._reply = b""

    @property
    def reply(self) -> bytes | None:
        """The whole reply frame, None until all of it is here."""
        return self._reply if self._total is not None and len(self._reply) == self._total else None

    @property
    def steps_allowed(self) -> int:
        """How many messages a well-behaved node may need at most; more of them go nowhere.

        A node may give as few as 8 octets of its reply at a time.
        """
        return len(self._frame) // self._room + (self._total or 0) // 8 + 16

    def next(self) -> Piece:
        """Return the piece to write now: of the request, or an empty one that asks for more of the answer."""
        if self._total is not None:
            return Piece(self._transaction, self._total, len(self._reply), b"")
        total, body = len(self._frame), self._frame[self._held : self._held + self._room]
        more = self._held + len(body) < total
        return Piece(self._transaction, total, self._held if body else 0, body, more=more and bool(body))

    def handle_piece(self, piece: Piece) -> bool:
        """Take in what the node wrote; False when it is not an answer of this transaction and must be dropped.

        Raises GarbledError when the pieces do not fit together.
        """
        if not piece.answer or piece.transaction != self._transaction:
            return False
        if piece.body:
            self._take_reply(piece)
        elif self._total is None:
            if piece.offset > len(self._frame):
                raise GarbledError(f"The node holds {piece.offset} octets of a command of {len(self._frame)}.")
            self._held = piece.offset
        return True

    def _take_reply(self, piece: Piece) -> None:
        if piece.total > LONGEST_FRAME:
            raise GarbledError(
                f"The node announces a reply of {piece.total} octets; at most {LONGEST_FRAME} are allowed."
            )
        if self._total is None:
            self._total = piece.total
        if piece.total != self._total:
            raise GarbledError(f"The reply had {self._total} octets and now has {piece.total}.")
        if piece.offset > len(self._reply):
            raise GarbledError(f"The reply goes on at octet {piece.offset}, after {len(self._reply)}.")
        if piece.offset == len(self._reply):
            self._reply += piece.body


class Responder:
    """The node's half: puts the pieces of a request together, runs it once, and hands its reply out piece by piece.

    ``run`` gets transaction and whole frame and returns the whole reply frame; it is called again for a repeated last
    piece, so it is the place for the stored reply (protocol.repetition).
    """

    def __init__(self, run: Callable[[int, bytes], bytes]) -> None:
        self._run = run
        self.forget()

    def forget(self) -> None:
        """Drop every half of a request and every reply: the field is gone."""
        self._request: tuple[int, int] | None = None
        self._held = b""
        self._answered: int | None = None
        self._reply = b""

    def answer(self, piece: Piece, room_octets: int) -> Piece:
        """Return the record that answers ``piece``, its body at most ``room_octets``.

        Raises GarbledError for an answer.
        """
        if piece.answer:
            raise GarbledError("A station sent a record that is marked as an answer.")
        if not piece.body:
            if piece.transaction == self._answered:
                return self._part(piece.offset, room_octets)
            held = len(self._held) if self._request == (piece.transaction, piece.total) else 0
            return Piece(piece.transaction, piece.total, held, b"", answer=True)
        return self._collect(piece, room_octets)

    def _collect(self, piece: Piece, room_octets: int) -> Piece:
        key = (piece.transaction, piece.total)
        if key != self._request:
            self._request, self._held = key, b""
        if piece.offset <= len(self._held):
            self._held = self._held[: piece.offset] + piece.body
            self._answered = None
        if len(self._held) < piece.total:
            return Piece(piece.transaction, piece.total, len(self._held), b"", answer=True)
        if self._answered is None:
            self._reply = self._run(piece.transaction, self._held)
            self._answered = piece.transaction
        return self._part(0, room_octets)

    def _part(self, offset: int, room_octets: int) -> Piece:
        transaction, total = self._answered or 0, len(self._reply)
        offset = min(offset, total)
        body = self._reply[offset : offset + room_octets]
        return Piece(transaction, total, offset, body, answer=True, more=offset + len(body) < total)
