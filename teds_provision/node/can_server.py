"""The node's end of a CAN bus: one line for each base station, and the answer to everyone's Identify."""

from __future__ import annotations

import queue
import random
import threading
import time
from collections.abc import Callable
from typing import Final

from teds_provision.errors import LinkFailure, NoReader, TedsProvisionError
from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.isotp import FUNCTIONAL, Pair, addresses, read_single
from teds_provision.links.can.spec import FIRST_STATION, LAST_STATION, parse_spec
from teds_provision.node.handler import NodeHandler
from teds_provision.protocol.messages.frames import Function, Reply, security_command
from teds_provision.protocol.repetition import Repetition

_IDENTIFY: Final = security_command(Function.IDENTIFY).encode()
_SPREAD_SECONDS: Final = 0.05
_IDLE: Final = 0.02
_FLOW_CONTROL: Final = 3
_REOPEN_SECONDS: Final = 1.0


class _Moved:
    """A job: the node has another address now, so that the line to this station is a new one."""


class _Line:
    """One base station's line: its own session (by name), stored reply and worker.

    A link is one pair of addresses: with a new own address it begins anew. ``pairs`` keeps the old Pair as long as it
    still sends.
    """

    def __init__(self, server: CanServer, station: int) -> None:
        self.station = station
        self.name = f"can:{station:02x}"
        self.pairs: dict[int, Pair] = {}
        self.repetition = Repetition()
        self.jobs: queue.Queue[tuple[Pair, bytes] | _Moved | None] = queue.Queue(maxsize=4)
        self.worker = threading.Thread(target=self._work, args=(server,), name=self.name, daemon=True)
        self.worker.start()

    def moved(self) -> None:
        """Begin anew, once what was asked before is done."""
        try:
            self.jobs.put_nowait(_Moved())
        except queue.Full:
            return

    def put(self, pair: Pair, body: bytes) -> None:
        """Queue a request; a station that asks on and on without waiting loses what does not fit."""
        try:
            self.jobs.put_nowait((pair, body))
        except queue.Full:
            return

    def end(self) -> None:
        """Let the worker finish what it does and go."""
        while True:
            try:
                self.jobs.put_nowait(None)
                break
            except queue.Full:
                try:
                    self.jobs.get_nowait()
                except queue.Empty:
                    continue
        self.worker.join(timeout=0.5)

    def _work(self, server: CanServer) -> None:
        while (job := self.jobs.get()) is not None:
            if isinstance(job, _Moved):
                server.begin_anew(self)
            else:
                server.run_request(self, *job)


class CanServer:
    """Serves a node on one CAN bus in threads of its own.

    ``spec_text`` is the value of ``--can``; ``node=`` and ``source=`` mean nothing here, since the node's address is
    ``handler.can_address()`` at any time and every base station is served. ``counts_as_tapped`` says whether a request
    from the bus counts as one by tap (a node built without NFC, in factory state).
    """

    def __init__(
        self, spec_text: str, handler: NodeHandler, *, counts_as_tapped: Callable[[], bool] = lambda: False
    ) -> None:
        self._spec = parse_spec(spec_text)
        self._handler = handler
        self._counts_as_tapped = counts_as_tapped
        self._bus: Bus | None = None
        self._lines: dict[int, _Line] = {}
        self._later: list[tuple[float, _Line, int, bytes, bool]] = []
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Open the bus and listen; raises NoReader or UsageFailure where it cannot."""
        self._bus = Bus(self._spec)
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, name="can", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Close the bus and end every line; never raises."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=3)
            self._thread = None
        self._lose_lines()
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def begin_anew(self, line: _Line) -> None:
        """The pair of addresses is another one: session and stored reply of the old one are gone."""
        line.repetition.forget()
        self._handler.lost(line.name)

    def run_request(self, line: _Line, pair: Pair, body: bytes) -> None:
        """Run one request in the worker of its line and send the reply from the address that was asked."""
        try:
            reply = line.repetition.answer(
                body[0],
                body[1:],
                lambda frame: self._handler.request(line.name, frame, tapped=self._counts_as_tapped()),
                now=time.monotonic(),
            )
        except TedsProvisionError:
            return  # a node in trouble (its flash file is gone) is silent
        with self._lock:
            if self._stop.is_set() or self._lines.get(line.station) is not line:
                return  # lost meanwhile
            try:
                pair.send(body[:1] + reply)
            except LinkFailure:
                return  # the reading thread meets the same failure and deals with it

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                self._serve_one()
            except LinkFailure:
                self._lose_lines()
                self._reopen()

    def _serve_one(self) -> None:
        assert self._bus is not None
        frame = self._bus.receive(self._wait())
        with self._lock:
            if frame is not None:
                self._dispatch(frame)
            self._answer_everyone()
            for line in self._lines.values():
                for pair in line.pairs.values():
                    pair.run()

    def _wait(self) -> float:
        """Seconds until a consecutive frame or an answer to everyone is due."""
        with self._lock:
            wait = _IDLE
            for line in self._lines.values():
                for pair in line.pairs.values():
                    wait = pair.due_in(wait)
            for due, *_ in self._later:
                wait = min(wait, max(0.0, due - time.monotonic()))
            return wait

    def _dispatch(self, frame: Frame) -> None:
        station = frame.identifier & 0xFF
        if not FIRST_STATION <= station <= LAST_STATION:
            return
        if frame.identifier & 0x1FFFFF00 == FUNCTIONAL:
            self._everyone(station, frame)
            return
        ends = addresses(frame.identifier)
        if ends is None:
            return
        own = ends[0]
        line = self._lines.get(station)
        pair = line.pairs.get(own) if line else None
        if own != self._handler.can_address():
            # the address has changed: the reply that is still leaving from the old one needs its flow control
            if pair is None or not pair.sending or not frame.data or frame.data[0] >> 4 != _FLOW_CONTROL:
                return
            pair.take(frame)
            return
        line, pair = self._pair(station, own)
        pair.take(frame)
        while (body := pair.received()) is not None:
            line.put(pair, body)

    def _pair(self, station: int, own: int) -> tuple[_Line, Pair]:
        assert self._bus is not None
        line = self._lines.get(station)
        if line is None:
            line = self._lines[station] = _Line(self, station)
        pair = line.pairs.get(own)
        if pair is None:
            if line.pairs:
                line.moved()
            line.pairs = {at: old for at, old in line.pairs.items() if old.sending}
            pair = line.pairs[own] = Pair(own, station, self._bus.send)
        return line, pair

    def _everyone(self, station: int, frame: Frame) -> None:
        """Note a functional Identify; anything else that is asked of everyone is not answered."""
        body = read_single(frame.data)
        if body is None or body[1:] != _IDENTIFY:
            return
        own = self._handler.can_address()
        line, _ = self._pair(station, own)
        due = time.monotonic() + random.uniform(0, _SPREAD_SECONDS)
        self._later = [entry for entry in self._later if entry[1] is not line]
        self._later.append((due, line, own, body[:1], frame.fd))

    def _answer_everyone(self) -> None:
        """Send the answers to functional Identifies that are due; they leave the stored reply alone."""
        now = time.monotonic()
        for entry in [entry for entry in self._later if entry[0] <= now]:
            self._later.remove(entry)
            _, line, own, transaction, fd = entry
            _, pair = self._pair(line.station, own)
            if pair.waits_for_flow:
                pair.stop_sending()  # nobody has taken the answer before this one
            pair.speak(fd=fd)
            pair.send(transaction + Reply(True, self._handler.identify()).encode())

    def _lose_lines(self) -> None:
        with self._lock:
            lines, self._lines, self._later = self._lines, {}, []
        for line in lines.values():
            line.end()
            line.repetition.forget()
            self._handler.lost(line.name)

    def _reopen(self) -> None:
        if self._bus is not None:
            self._bus.close()
        while not self._stop.wait(_REOPEN_SECONDS):
            try:
                self._bus = Bus(self._spec)
            except (LinkFailure, NoReader):
                continue
            return
