"""Nodes that are wrong in one thing: the reference node behind a link that bends one command, or with one part bent."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from teds_provision.errors import NodeSilentError
from teds_provision.links.ports import BusFrames
from teds_provision.protocol.keys import GROUP_ORDER, SoftwareKey
from teds_provision.protocol.messages.frames import (
    COMMON,
    IDENTIFY,
    SECURITY_CLASS,
    Attribute,
    Function,
    Reason,
    Reply,
    TedsFunction,
    TedsStatus,
    decode_reply,
    refusal,
)
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.repetition import Repetition
from teds_provision.protocol.session import OPEN_OCTETS, open_mac
from teds_provision.teds.codec.frame import frame

from ..bench import Board, MemoryLink
from .memory_bus import MemoryServer

Next = Callable[[bytes], bytes]
"""What the reference node answers to a command frame."""
Fault = Callable[[Board, bytes, Next], bytes]


@dataclass
class FaultyLink(MemoryLink):
    """A link to a node with a fault; over CAN tapped in factory state alone, as on a board without NFC."""

    fault: Fault | None = None
    tapped_when_keyed: bool = False
    runs_again: Callable[[bytes], bool] = lambda _: False
    """Which repeated requests the node runs instead of giving the stored reply."""
    repetition: Repetition = field(default_factory=Repetition)

    @property
    def name(self) -> str:
        """The link as sessions hang on it."""
        return self.via

    def reference(self, octets: bytes) -> bytes:
        """Return what the reference node answers here."""
        factory = self.board.tim.identity().state == NodeState.FACTORY
        tapped = self.via == "nfc" or factory or self.tapped_when_keyed
        return self.board.tim.handle(octets, link=self.name, tapped=tapped)

    def exchange(self, frame: bytes) -> bytes:
        self.frames.append(frame)
        self.count += 1
        return self.answer(frame)

    def resend(self, frame: bytes) -> bytes:
        self.count += self.runs_again(frame)
        return self.answer(frame)

    def answer(self, frame: bytes) -> bytes:
        def run(octets: bytes) -> bytes:
            return self.reference(octets) if self.fault is None else self.fault(self.board, octets, self.reference)

        reply = self.repetition.answer(self.count, frame, run, now=self.board.seconds)
        self.board.tim.reply_sent(self.name)
        return reply


@dataclass
class FaultyBus(FaultyLink):
    """A line of a bus: the node is heard at its address alone, other stations have lines of their own."""

    via: str = "can"
    address: int = 0
    source: int = 0xF1
    moves_too_soon: bool = False
    """Whether the node's reply to Set CAN address waits for its flow control at the new address."""
    stays_at_the_old: bool = False
    everyone_counts: bool = False
    """Whether a functional Identify takes the place of the stored reply."""
    one_buffer: bytes = b"\x30\x10\0"
    """What answers a second station's first frame beside the one of the first."""
    half_sent: int = 0
    end: BusFrames | None = None
    """The node's end of the bus, frame by frame."""
    lines: dict[int, FaultyBus] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.address = self.address or self.board.tim.can_address
        self.lines[self.source] = self
        self._pair = self._first = self.address

    @property
    def name(self) -> str:
        return f"can:{self.source:02x}"

    def exchange(self, frame: bytes) -> bytes:
        now = self.board.tim.can_address
        if self.address != now and not self.stays_at_the_old:
            raise NodeSilentError("Nobody answers at this address.")
        if self._pair != now and self.address == now:
            self._pair = now
            self.board.tim.link_lost(self.name)
            self.repetition.forget()
        reply = super().exchange(frame)
        if self.moves_too_soon and self.board.tim.can_address != now:
            raise NodeSilentError("The reply begins and does not end.")
        return reply

    def from_station(self, source: int) -> FaultyBus:
        if source not in self.lines:
            replace(self, source=source, repetition=Repetition(), frames=[], lines=self.lines)
        return self.lines[source]

    def identify_functional(self) -> bytes:
        if self.everyone_counts:
            self.count += 1
            return self.answer(IDENTIFY.encode())
        return self.reference(IDENTIFY.encode())

    @contextmanager
    def single_frames(self) -> Iterator[BusFrames]:
        own = self.lines[0xF1]
        if own.end is None:
            own.end = getattr(self.board, "frames_of", MemoryServer)(own)
        yield own.end

    def identify_at(self, address: int) -> Identity | None:
        here = address == self.board.tim.can_address or (self.stays_at_the_old and address == self._first)
        return self.board.tim.identity() if here else None

    def begin(self, octets: int) -> bytes:
        self.lines[0xF1].half_sent += 1
        return b"\x30\x10\0" if self.lines[0xF1].half_sent == 1 else self.one_buffer


def _is(octets: bytes, function: int, command_class: int = SECURITY_CLASS) -> bool:
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


def about_of_form_2(_board: Board, octets: bytes, reference: Next) -> bytes:
    reply = decode_reply(reference(octets))
    bent = _is(octets, Function.ABOUT) and reply.ok
    return (Reply(True, b"\2" + reply.payload[1:]) if bent else reply).encode()


def about_with_any_payload(_board: Board, octets: bytes, reference: Next) -> bytes:
    return reference(octets[:4] + b"\0\0") if _is(octets, Function.ABOUT) else reference(octets)


def about_by_radio(board: Board, octets: bytes, reference: Next) -> bytes:
    if _is(octets, Function.ABOUT):
        return board.tim.handle(octets, link="can:f1", tapped=False)
    return reference(octets)


def locates_for_anyone(_board: Board, octets: bytes, reference: Next) -> bytes:
    reply = decode_reply(reference(octets))
    taken = _is(octets, Function.LOCATE) and reply.reason == Reason.NOT_PERMITTED
    return (Reply(True) if taken else reply).encode()


def locates_for_long(_board: Board, octets: bytes, reference: Next) -> bytes:
    return reference(octets[:6] + b"\x3c" if _is(octets, Function.LOCATE) and octets[6:] == b"\x3d" else octets)


def manage_is_unknown(_board: Board, octets: bytes, reference: Next) -> bytes:
    return refusal(Reason.UNKNOWN_COMMAND).encode() if _is(octets, Function.MANAGE) else reference(octets)


def proof_of_another(_board: Board, octets: bytes, reference: Next) -> bytes:
    good = _is(octets, Function.PROVE) and len(octets) == 38
    return Reply(True, SoftwareKey.generate().sign(octets)).encode() if good else reference(octets)


def list_twice(_board: Board, octets: bytes, reference: Next) -> bytes:
    reply = decode_reply(reference(octets))
    return Reply(True, reply.payload * 2).encode() if _is(octets, Function.LIST) and reply.ok else reply.encode()


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
    return reference(octets[:14] + point + open_mac(key, board.uuid, counter, point))


def any_counter(board: Board, octets: bytes, reference: Next) -> bytes:
    for line in board.tim._sessions._links.values():
        if line.session is not None and _is(octets, Function.SEALED):
            line.session.counter = -1
    return reference(octets)


def lower_counters(board: Board, octets: bytes, reference: Next) -> bytes:
    """Refuse the last counter alone."""
    for line in board.tim._sessions._links.values():
        if line.session is not None and _is(octets, Function.SEALED):
            again = int.from_bytes(octets[6:10], "big") == line.session.counter
            line.session.counter = line.session.counter if again else -1
    return reference(octets)


def first_counter_0(board: Board, octets: bytes, reference: Next) -> bytes:
    for line in board.tim._sessions._links.values():
        if line.half_open is not None and _is(octets, Function.SEALED):
            line.half_open.counter = -1
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


def high_s_in_reset(_board: Board, octets: bytes, reference: Next) -> bytes:
    reply = decode_reply(reference(octets))
    if not _is(octets, Function.RESET) or not reply.ok:
        return reply.encode()
    s = GROUP_ORDER - int.from_bytes(reply.payload[32:], "big")
    return Reply(True, reply.payload[:32] + s.to_bytes(32, "big")).encode()


def half_of_max_message(board: Board, octets: bytes, reference: Next) -> bytes:
    return refusal(Reason.TOO_LARGE).encode() if len(octets) > board.max_message // 2 else reference(octets)


def announces(octets: int) -> Fault:
    """Identify announces another maxMessage than the one that is kept."""

    def fault(board: Board, frame: bytes, reference: Next) -> bytes:
        if _is(frame, Function.IDENTIFY) and len(frame) == 6:
            return Reply(True, replace(board.tim.identity(), max_message=octets).encode()).encode()
        return reference(frame)

    return fault


def identify_any_payload(_board: Board, octets: bytes, reference: Next) -> bytes:
    return reference(octets[:4] + b"\0\0" if _is(octets, Function.IDENTIFY) else octets)


def list_long(_board: Board, octets: bytes, reference: Next) -> bytes:
    return Reply(True, bytes(2046)).encode() if _is(octets, Function.LIST) else reference(octets)


def all_text(_board: Board, octets: bytes, reference: Next) -> bytes:
    answer = reference(octets)
    query = _is(octets, TedsFunction.QUERY, COMMON) and answer[:1] == b"\1"
    return answer[:3] + bytes([answer[3] | 0x10]) + answer[4:] if query else answer


def stale_initial(board: Board, octets: bytes, reference: Next) -> bytes:
    if board.state.key is None or board.state.provisioned:
        return reference(octets)
    older = replace(board.state, epoch=board.state.epoch - 1).security_teds()
    return _reads(lambda _: older)(board, octets, reference)
