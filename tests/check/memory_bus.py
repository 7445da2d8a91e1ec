"""The frames of a bus in memory: the reference node's own end of CAN without sockets, threads and waits.

What the node does with a frame is the code of ``node.can`` as it runs on a real bus. Its random waits pass at once, the
gaps between the frames of a reply as they are.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from teds_provision.links.can.isotp import Frame
from teds_provision.links.ports import BusFrame
from teds_provision.node.can.endpoint import CanEndpoint
from teds_provision.node.can.server import CanServer
from teds_provision.node.worker_pool import JobQueue
from teds_provision.protocol.messages.identity import NodeState

if TYPE_CHECKING:
    from .faulty import FaultyBus

_LEAST: Final = 1e-6
"""Seconds by which the board's time goes on at least."""


class _SynchronousPool:
    """Workers that have done their job when it is given to them."""

    def new_queue(self) -> JobQueue:
        return JobQueue(lambda job: job())


class _Outbox:
    """The bus as the node's end sends to it."""

    def __init__(self) -> None:
        self.frames: list[BusFrame] = []

    def send(self, frame: Frame) -> None:
        self.frames.append(BusFrame(frame.identifier, frame.data, time.monotonic()))


class _Handler:
    """The board as its end of CAN sees it; see ``NodeHandler`` and ``MeasuringHandler``."""

    def __init__(self, bus: FaultyBus) -> None:
        self._bus, self._board = bus, bus.board

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        def reference(octets: bytes) -> bytes:
            return self._board.tim.handle(octets, link=link, tapped=tapped)

        fault = self._bus.fault
        return reference(frame) if fault is None else fault(self._board, frame, reference)

    def request_received(self, link: str, frame: bytes, *, tapped: bool, **_more: Any) -> bytes:
        return self.request(link, frame, tapped=tapped)

    def lost(self, link: str) -> None:
        self._board.tim.link_lost(link)

    def identify(self) -> bytes:
        return self._board.tim.identity().encode()

    def can_address(self) -> int:
        return self._board.tim.can_address

    def take_can_address(self, address: int) -> None:
        self._board.tim.take_can_address(address)

    def actuator_claimed(self) -> bool:
        return self._board.tim.actuator_claimed()

    def tick(self, at: float = 0.0) -> int:
        del at
        hardware = self._board.tim.hardware
        return 0 if hardware is None else hardware.now()

    def reply_sent(self, link: str) -> None:
        self._board.tim.reply_sent(link)

    def trigger(self, link: str, token: bytes, tick: int) -> None:
        self._board.tim.trigger(link, token, tick)

    def drive(self, link: str, data: bytes) -> None:
        self._board.tim.drive(link, data)


class MemoryServer(CanServer):
    """The node's end of CAN, run by whoever takes its frames."""

    def __init__(self, bus: FaultyBus) -> None:
        super().__init__("virtual:memory")
        self._line, self._handler, self._outbox = bus, _Handler(bus), _Outbox()
        self._bus = self._outbox  # type: ignore[assignment]
        self._workers = _SynchronousPool()  # type: ignore[assignment]
        tapped: Callable[[], bool] = lambda: bus.board.tim.identity().state == NodeState.FACTORY  # noqa: E731
        self._endpoints = [CanEndpoint(self._handler, tapped, self._workers, self._out, self._handler)]  # type: ignore[arg-type]
        self._endpoint_of = {id(self._handler): self._endpoints[0]}
        self._addresses = self._new_table()
        self.own, self.fd = bus.source, False

    def send(self, identifier: int, octets: bytes, *, fd: bool = False) -> None:
        self._settle()
        self._dispatch(Frame(identifier, octets, fd))

    def next(self, seconds: float) -> BusFrame | None:
        board, frames = self._line.board, self._outbox.frames
        until, real = board.seconds + seconds, time.monotonic() + seconds
        while True:
            self._settle()
            waits = [board.tim.poll()]
            while (sent := board.tim.next_frame("can")) is not None:
                frames.append(BusFrame(sent.identifier, sent.data, time.monotonic()))
            if frames:
                return frames.pop(0)
            if self._pushing and time.monotonic() < real:
                time.sleep(0.001)  # the gap that this station asked for
                continue
            waits.append(board.tim.next_frame_in())
            wait = min((wait for wait in waits if wait is not None), default=seconds)
            if board.seconds + wait >= until:
                board.seconds = max(board.seconds, until)
                return None
            board.seconds += max(wait, _LEAST)

    def pass_time(self, seconds: float) -> None:
        """Let time pass while no frame is looked at: what comes meanwhile waits to be taken."""
        until, heard = self._line.board.seconds + seconds, list[BusFrame]()
        while (left := until - self._line.board.seconds) > 0:
            if (frame := self.next(left)) is not None:
                heard.append(frame)
        self._outbox.frames[:0] = heard

    def _settle(self) -> None:
        """Do what is due; random waits are over."""
        seat = self._endpoints[0]
        if seat.address != self._handler.can_address():  # by a command that came without frames
            seat.address = self._handler.can_address()
            self._addresses.find()
        due, self._later = self._later, []
        while due:
            heapq.heappop(due)[2]()
        self._looked = 0.0
        self._run_transfers(time.monotonic())
