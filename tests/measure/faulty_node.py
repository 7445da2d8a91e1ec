"""Nodes with one fault each, written as a stranger's firmware would have it; all of them in one process on one bus.

Usage: python -m tests.measure.faulty_node CAN FAULT=FOLDER … Prints ``{"ready": true}``; runs until it is ended.
"""

from __future__ import annotations

import itertools
import json
import os
import random
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from teds_provision.node.can.endpoint import link_name
from teds_provision.node.can.server import CanServer
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.hardware.board import Board
from teds_provision.node.realtime_loop import RealtimeLoop
from teds_provision.node.virtual import VirtualNode
from teds_provision.protocol.messages.frames import CommandRefusedError, Reason
from teds_provision.protocol.operation.commands import EITHER, OPERATE_FUNCTION
from teds_provision.protocol.operation.hardware import RawReading
from teds_provision.protocol.operation.stream_commands import ClockReply, SubscribeReply
from teds_provision.protocol.operation.streams import DataFrame, Stream
from teds_provision.provisioning.meeting import IdleStop
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.sheet import Sheet

Send = Callable[[DataFrame], None]
LATER = 1.5  # seconds of good data before a fault that comes later
SECOND = 10**9


class FaultyNode(VirtualNode):
    """A node whose data frames go through ``bend``, and whose firmware was spoilt by ``spoil``."""

    def __init__(self, folder: Path, pulse: RealtimeLoop) -> None:
        super().__init__(folder, board=_board, pulse=pulse)
        self.began: float | None = None

    @property
    def role(self) -> Any:
        """Its firmware's streams and clock."""
        return self.tim._role.streams  # type: ignore[union-attr]

    @property
    def late(self) -> bool:
        """Whether it has sent good data for :data:`LATER`."""
        return self.began is not None and time.monotonic() - self.began > LATER


def _board(file: FlashFile) -> Board:
    return Board(Sheet.from_image(Image(file.load().uuid, file.hardware)), source="ramp:2")


# -- faults of data frames: what leaves, given what should -----------------------------------------------------------


def wrong_tag(_node: FaultyNode, frame: DataFrame, send: Send) -> None:
    """Every message is changed in one bit on its way."""
    send(frame._replace(data=frame.data[:8] + bytes([frame.data[8] ^ 1]) + frame.data[9:]))


def replayed(_node: FaultyNode, frame: DataFrame, send: Send) -> None:
    """Every message comes twice."""
    send(frame)
    send(frame)


def gaps(node: FaultyNode, frame: DataFrame, send: Send) -> None:
    """Every fifth message is lost."""
    node.count = getattr(node, "count", 0) + 1
    if node.count % 5:
        send(frame)


def held_back(_node: FaultyNode, frame: DataFrame, send: Send) -> None:
    """Every message is a second late."""
    threading.Timer(1.0, send, [frame]).start()


def swapped(node: FaultyNode, frame: DataFrame, send: Send) -> None:
    """Every second message overtakes the one before."""
    held = node.__dict__.pop("held", None)
    if held is None:
        node.held = frame
        return
    send(frame)
    send(held)


def junk(_node: FaultyNode, frame: DataFrame, send: Send) -> None:
    """Between the messages come frames of random octets, in its own stream and in streams that nobody asked for."""
    for identifier in (frame.identifier, frame.identifier ^ 3 << 11, frame.identifier ^ 5 << 8):
        send(frame._replace(identifier=identifier, data=random.randbytes(random.choice((0, 1, 8, 20, 64)))))
    send(frame)


def cut_short(_node: FaultyNode, frame: DataFrame, send: Send) -> None:
    """Every message lacks its end."""
    send(frame._replace(data=frame.data[:12]))


def falls_silent(node: FaultyNode, frame: DataFrame, send: Send) -> None:
    """Its data stops, its commands are answered."""
    if not node.late:
        send(frame)


def forgets(node: FaultyNode, frame: DataFrame, send: Send) -> None:
    """It loses its sessions once, as in a restart, and says nothing."""
    send(frame)
    if node.late and not hasattr(node, "forgot"):
        node.forgot = True
        threading.Thread(target=lambda: [node.lost(link_name(source)) for source in range(0xF1, 0xF8)]).start()


def another_datasheet(node: FaultyNode, frame: DataFrame, send: Send) -> None:
    """It loses its sessions, and comes back with a datasheet that nobody signed."""
    send(frame)
    if node.late and not hasattr(node, "forgot"):
        node.forgot = True
        flash = node.tim.flash
        signed = flash.blocks[SECURITY]
        changed = signed[:-8] + bytes([signed[-8] ^ 1]) + signed[-7:]  # within the signature
        node.tim._flash = replace(flash, blocks={**flash.blocks, SECURITY: changed})
        threading.Thread(target=lambda: [node.lost(link_name(source)) for source in range(0xF1, 0xF8)]).start()


# -- faults of the firmware ------------------------------------------------------------------------------------------


def too_fast(node: FaultyNode) -> None:
    """It samples a quarter faster than it was asked to."""
    _at_another_pace(node, 3, 4)


def too_slow(node: FaultyNode) -> None:
    """It samples at half of the rate that it was asked for."""
    _at_another_pace(node, 2, 1)


def _at_another_pace(node: FaultyNode, times: int, over: int) -> None:
    """Each period becomes ``times / over`` of what was asked for."""

    class PacedStream(Stream):
        @property
        def next_instant(self) -> int | None:
            due = super().next_instant
            return None if due is None or self.start is None else self.start + (due - self.start) * times // over

    _after_subscribe(node, lambda stream: setattr(stream, "__class__", PacedStream))


def _after_subscribe(node: FaultyNode, change: Callable[[Stream], None]) -> None:
    real = node.role.subscribe

    def subscribe(*words: Any) -> bytes:
        reply: bytes = real(*words)
        change(node.role._streams[-1])
        return reply

    node.role.subscribe = subscribe


def _clock(node: FaultyNode, lie: Callable[[ClockReply], ClockReply]) -> None:
    real = node.role.clock
    node.role.clock = lambda *words: lie(ClockReply.decode(real(*words))).encode()


def jumping_clock(node: FaultyNode) -> None:
    """Its clock says another time at every question."""
    jumps = itertools.cycle((0, 200_000_000, -150_000_000))

    def lie(clock: ClockReply) -> ClockReply:
        jump = next(jumps)
        return replace(clock, received=max(0, clock.received + jump), sent=max(0, clock.sent + jump))

    _clock(node, lie)


def backward_clock(node: FaultyNode) -> None:
    """It says that it answered before it was asked."""
    _clock(node, lambda clock: replace(clock, received=clock.sent, sent=max(0, clock.received - 5_000_000)))


def clock_of_tomorrow(node: FaultyNode) -> None:
    """Its clock is an hour ahead of the ticks of its data."""
    _clock(node, lambda clock: replace(clock, received=clock.received + 3600 * SECOND, sent=clock.sent + 3600 * SECOND))


def _subscribed(node: FaultyNode, lie: Callable[[SubscribeReply], SubscribeReply]) -> None:
    real = node.role.subscribe
    node.role.subscribe = lambda *words: lie(SubscribeReply.decode(real(*words))).encode()


def wrong_length(node: FaultyNode) -> None:
    """It says that its messages have another length than they have to."""
    _subscribed(node, lambda clock: replace(clock, length=clock.length + 2))


def wrong_start(node: FaultyNode) -> None:
    """It says that its stream begins in ten seconds."""
    _subscribed(node, lambda clock: replace(clock, start=clock.start + 10 * SECOND))


def refuses_claims(node: FaultyNode) -> None:
    """It says that somebody else has claimed its channels."""

    def operate(_inner: Any) -> bytes:
        raise CommandRefusedError(Reason.BUSY)

    node.tim._role._commands[EITHER, OPERATE_FUNCTION] = operate  # type: ignore[union-attr]


def _reads(node: FaultyNode, bend: Callable[[RawReading, int], RawReading]) -> None:
    real = node.board.read  # type: ignore[union-attr]
    node.board.read = lambda channel, tick: bend(real(channel, tick), tick)  # type: ignore[union-attr,method-assign]


def out_of_range(node: FaultyNode) -> None:
    """In every second tenth of a second its values are beyond the limits of the datasheet."""
    _reads(node, lambda given, tick: RawReading(b"\xff" * len(given.octets)) if tick // (SECOND // 10) % 2 else given)


def not_valid(node: FaultyNode) -> None:
    """It says of every value that it is not valid."""
    _reads(node, lambda given, _tick: RawReading(given.octets, valid=False))


def test_pattern(node: FaultyNode) -> None:
    """It sends the test pattern, which nobody asked for."""

    def change(stream: Stream) -> None:
        stream.asked = replace(stream.asked, test_pattern=True)

    _after_subscribe(node, change)


def babbles(node: FaultyNode) -> None:
    """Later on its replies are random octets."""
    real = node.request_received

    def answer(*words: Any, **more: Any) -> bytes:
        reply = real(*words, **more)
        return random.randbytes(len(reply)) if node.late else reply

    node.request_received = answer  # type: ignore[method-assign]


def good(_node: FaultyNode) -> None:
    """Nothing is wrong with it."""


BENDING = (
    wrong_tag, replayed, gaps, held_back, swapped, junk, cut_short, falls_silent, forgets, another_datasheet,
)  # fmt: skip
SPOILING = (
    too_fast, too_slow, jumping_clock, backward_clock, clock_of_tomorrow, wrong_length, wrong_start, refuses_claims,
    out_of_range, not_valid, test_pattern, babbles, good,
)  # fmt: skip
FAULTS: dict[str, Callable[..., None]] = {item.__name__: item for item in (*BENDING, *SPOILING)}


def main() -> None:
    can, *given = sys.argv[1:]
    pulse, server = RealtimeLoop(), CanServer(can, notify=lambda text: print(text, file=sys.stderr, flush=True))
    boards = []
    for word in given:
        fault, _, folder = word.partition("=")
        node = FaultyNode(Path(folder), pulse)
        FAULTS[fault](node) if FAULTS[fault] in SPOILING else None
        server.add(node, measuring_handler=node)
        node.streams_over(_sender(server, node, FAULTS[fault] if FAULTS[fault] in BENDING else None))
        boards.append(node.board)
    stop = IdleStop(None)
    signal.signal(signal.SIGTERM, lambda *_: stop.request_stop())
    for part in (pulse, *boards, server):
        part.start()  # type: ignore[union-attr]
    print(json.dumps({"ready": True}, separators=(", ", ": ")), flush=True)
    stop.wait()
    os._exit(0)


def _sender(server: CanServer, node: FaultyNode, bend: Callable[[FaultyNode, DataFrame, Send], None] | None) -> Send:
    def out(frame: DataFrame) -> None:
        server.send_data(node, frame.identifier, frame.data, fd=frame.fd)

    def send(frame: DataFrame) -> None:
        node.began = node.began or time.monotonic()
        if bend is None:
            out(frame)
        else:
            bend(node, frame, out)

    return send


if __name__ == "__main__":
    main()
