"""Nodes that are wrong in one thing: the reference node behind a link that bends one command, or with one part bent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from teds_provision.protocol.agreement import key_id
from teds_provision.protocol.keys import GROUP_ORDER, SoftwareKey
from teds_provision.protocol.messages.frames import (
    COMMON,
    SECURITY,
    Attribute,
    Function,
    Reason,
    Reply,
    TedsFunction,
    TedsStatus,
    decode_reply,
    refusal,
)
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.session import OPEN_OCTETS, open_mac
from teds_provision.teds.codec.frame import frame

from ..bench import Board, MemoryLink

Next = Callable[[bytes], bytes]
"""What the reference node answers to a command frame."""
Fault = Callable[[Board, bytes, Next], bytes]


@dataclass
class FaultyLink(MemoryLink):
    """A link to a node with a fault; over CAN tapped in factory state alone, as on a board without NFC."""

    fault: Fault | None = None
    tapped_when_keyed: bool = False
    runs_again: bool = False
    """Whether the node runs a repeated request instead of giving the stored reply."""

    def exchange(self, frame: bytes) -> bytes:
        def reference(octets: bytes) -> bytes:
            factory = self.board.state.state == NodeState.FACTORY
            tapped = self.via == "nfc" or factory or self.tapped_when_keyed
            return self.board.tim.handle(octets, link=self.via, tapped=tapped)

        self.frames.append(frame)
        self.count += 1
        return self.answer(frame, reference)

    def again(self, frame: bytes) -> bytes:
        self.count += self.runs_again
        return self.answer(frame, lambda octets: self.board.tim.handle(octets, link=self.via, tapped=self.via == "nfc"))

    def answer(self, frame: bytes, reference: Next) -> bytes:
        def run(octets: bytes) -> bytes:
            return reference(octets) if self.fault is None else self.fault(self.board, octets, reference)

        return self.board.repetition.answer(self.count, frame, run, now=self.board.seconds)


def _is(octets: bytes, function: int, command_class: int = SECURITY) -> bool:
    return octets[2:4] == bytes([command_class, function])


def unknown_is_silent(_board: Board, octets: bytes, reference: Next) -> bytes:
    return b"" if _is(octets, 99) else reference(octets)


def long_refusal(_board: Board, octets: bytes, reference: Next) -> bytes:
    reply = decode_reply(reference(octets))
    return reply.encode() if reply.ok else Reply(False, reply.payload + b"\0").encode()


def length_before_state(_board: Board, octets: bytes, reference: Next) -> bytes:
    empty = _is(octets, TedsFunction.WRITE, COMMON) and len(octets) == 6
    return refusal(Reason.BAD_FORM).encode() if empty else reference(octets)


def header_length_ignored(_board: Board, octets: bytes, reference: Next) -> bytes:
    return reference(octets[:4] + max(0, len(octets) - 6).to_bytes(2, "big") + octets[6:])


def high_s(_board: Board, octets: bytes, reference: Next) -> bytes:
    reply = decode_reply(reference(octets))
    if not _is(octets, Function.PROVE) or not reply.ok:
        return reply.encode()
    s = GROUP_ORDER - int.from_bytes(reply.payload[32:], "big")
    return Reply(True, reply.payload[:32] + s.to_bytes(32, "big")).encode()


def any_challenge(_board: Board, octets: bytes, reference: Next) -> bytes:
    return reference(octets[:4] + b"\0\x20" + octets[6:].ljust(32, b"\0")[:32]) if _is(octets, 8) else reference(octets)


def proof_of_another(_board: Board, octets: bytes, reference: Next) -> bytes:
    good = _is(octets, Function.PROVE) and len(octets) == 38
    return Reply(True, SoftwareKey.generate().sign(octets)).encode() if good else reference(octets)


def list_twice(_board: Board, octets: bytes, reference: Next) -> bytes:
    reply = decode_reply(reference(octets))
    return Reply(True, reply.payload * 2).encode() if _is(octets, Function.LIST) else reply.encode()


def absent_is_available(_board: Board, octets: bytes, reference: Next) -> bytes:
    reply = decode_reply(reference(octets))
    if not _is(octets, TedsFunction.QUERY, COMMON) or not reply.ok:
        return reply.encode()
    status = TedsStatus.decode(reply.payload)
    return Reply(True, replace(status, attributes=status.attributes & ~Attribute.NOT_AVAILABLE).encode()).encode()


def _reads(teds: Callable[[bytes], bytes]) -> Fault:
    """Read of the Security TEDS gives it bent by ``teds``."""

    def fault(board: Board, octets: bytes, reference: Next) -> bytes:
        if not _is(octets, TedsFunction.READ, COMMON) or octets[:2] != b"\0\0" or octets[6:7] != b"\x80":
            return reference(octets)
        whole = teds(board.tim.flash.security_teds())
        at = min(int.from_bytes(octets[7:11], "big"), len(whole))
        return Reply(True, at.to_bytes(4, "big") + whole[at : at + 900]).encode()

    return fault


wrong_checksum = _reads(lambda teds: teds[:-1] + bytes([teds[-1] ^ 1]))
not_canonical = _reads(lambda teds: frame(teds[4:-2] + b"\x6e\x01\x01"))
other_suite = _reads(lambda teds: frame(teds[4:-2].replace(b"\x6d\x01\x02", b"\x6d\x01\x01")))


def end_refused(board: Board, octets: bytes, reference: Next) -> bytes:
    past = int.from_bytes(octets[7:11], "big") > len(board.tim.flash.security_teds())
    reading = _is(octets, TedsFunction.READ, COMMON) and len(octets) == 11 and past
    return refusal(Reason.NO_SUCH_TEDS).encode() if reading else reference(octets)


def write_anywhere(_board: Board, octets: bytes, reference: Next) -> bytes:
    return Reply(True).encode() if _is(octets, TedsFunction.WRITE, COMMON) else reference(octets)


def any_mac(board: Board, octets: bytes, reference: Next) -> bytes:
    key = board.state.key
    if key is None or not _is(octets, Function.OPEN) or len(octets) != 6 + OPEN_OCTETS:
        return reference(octets)
    counter = decode_reply(reference(octets[:4] + b"\0\0")).payload
    point = octets[14:79]
    return reference(octets[:6] + key_id(key) + point + open_mac(key, board.uuid, counter, point))


def any_counter(board: Board, octets: bytes, reference: Next) -> bytes:
    for line in board.tim._sessions._links.values():
        if line.session is not None and _is(octets, Function.SEALED):
            line.session.counter = -1
    return reference(octets)


def close_is_ignored(board: Board, octets: bytes, reference: Next) -> bytes:
    lines = [(line, line.session) for line in board.tim._sessions._links.values()]
    reply = reference(octets)
    for line, session in lines:
        line.session = line.session or session
    return reply


def keeps_pending(board: Board, octets: bytes, reference: Next) -> bytes:
    pending = board.tim._agreeing._pending
    reply = reference(octets)
    if _is(octets, Function.CONFIRM) and not decode_reply(reply).ok:
        board.tim._agreeing._pending = pending
    return reply


def _bent_flash(bend: Callable[[Any], Any], function: int) -> Fault:
    """For this one command the node believes another flash."""

    def fault(board: Board, octets: bytes, reference: Next) -> bytes:
        if not _is(octets, function):
            return reference(octets)
        flash = board.tim._flash
        board.tim._flash = bend(flash)
        reply = reference(octets)
        board.tim._flash = flash
        return reply

    return fault


any_ca = _bent_flash(lambda flash: replace(flash, ca=None), Function.REQUEST)
epoch_stands_still = _bent_flash(lambda flash: replace(flash, epoch=max(0, flash.epoch - 1)), Function.REQUEST)


def reset_forgets_epoch(board: Board, octets: bytes, reference: Next) -> bytes:
    keyed = board.state.key is not None
    reply = reference(octets)
    if keyed and board.state.key is None:
        board.flash.state = board.tim._flash = replace(board.state, epoch=0)
    return reply
