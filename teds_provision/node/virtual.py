"""The virtual transducer: a Tim with its link servers, in real time, with configurable delays."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol

from teds_provision.errors import NodeSilentError, TedsProvisionError
from teds_provision.node.can.endpoint import BUS
from teds_provision.node.firmware.boot_loader import ImageSlots
from teds_provision.node.firmware.manager import ImageManager, ManagedFirmware
from teds_provision.node.flash_file import FlashFile
from teds_provision.node.hardware.board import Board
from teds_provision.node.hardware.clock import NANOSECONDS
from teds_provision.node.realtime_loop import RealtimeLoop
from teds_provision.node.reported_firmware import ReportedFirmware
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import PrivateKey, SoftwareKey, verify
from teds_provision.protocol.messages.firmware import Firmware
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.operation.hardware import port_of
from teds_provision.protocol.operation.streams import DataFrame
from teds_provision.protocol.tim import Tim

_COARSE: Final = 0.001
"""Seconds: samples are taken with their own ticks, so that looking more often than this is of no use."""
_CLOSE: Final = 0.0005
"""Seconds to the next data frame that are waited for on the spot."""
_QUICK: Final = 0.005
"""Seconds that a point operation may take without holding a Sealed frame up (operation.md, section 2)."""
_MOST_BEHIND: Final = 150_000_000
"""ns that sampling may be behind the clock; what is older is lost, and shows as lost.

A station drops what is older than 2 · n · period + 200 ms (operation.md, section 3): what is sent comes in time.
"""
_STEP: Final = 1_000_000
"""ns: the least step of samples that are caught up with."""
_NOTICE_EVERY: Final = 10.0
"""Seconds between two lines about messages that were lost here."""
_EVENTS: Final = 0.005
"""Seconds between two looks at event sensors."""
_SIMULATION_WAITS: Final = 0.5
_TRIAL_SECONDS: Final = 600.0
"""An image that was not confirmed by then has failed: the board restarts, and the boot loader reverts it."""
_READER_SECONDS: Final = 0.5
"""Time for a reader to take the reply to a restart."""
_log = logging.getLogger(__name__)

SendData = Callable[[DataFrame], None]


@dataclass(frozen=True)
class Delays:
    """Seconds that a board needs: for a point operation (signature, its check, ECDH, key pair), for a flash commit."""

    crypto: float = 0.0
    flash: float = 0.0


class LinkServer(Protocol):
    """One link of the node, served in threads."""

    def start(self) -> None:
        """Open the link; raises a LinkError if it cannot."""

    def stop(self) -> None:
        """Close it; never raises."""


class _Core:
    """The one core of a small board: a command at a time, and interrupts while it waits for its chip or its flash."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._state = threading.Lock()

    @contextmanager
    def command(self) -> Iterator[None]:
        """Run a command; others wait for their turn."""
        with self._turn, self._state:
            yield

    @contextmanager
    def interrupt(self) -> Iterator[None]:
        """Do what cannot wait for the command that runs: samples, dead-men, triggers."""
        with self._state:
            yield

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Release the lock inside a command, so that the block delays nothing that cannot wait."""
        self._state.release()
        try:
            yield
        finally:
            self._state.acquire()


@dataclass(frozen=True)
class _SlowKey:
    """A node's key on a slow chip."""

    key: PrivateKey
    work: Callable[[], None]

    @property
    def point(self) -> bytes:
        return self.key.point

    def sign(self, message: bytes) -> bytes:
        self.work()
        return self.key.sign(message)

    def sign_digest(self, digest: bytes) -> bytes:
        self.work()
        return self.key.sign_digest(digest)

    def ecdh(self, peer: bytes) -> bytes:
        self.work()
        return self.key.ecdh(peer)


@dataclass(frozen=True)
class _Flash:
    """The flash of the node; what has to wait for it waits outside the core."""

    file: FlashFile
    core: _Core

    def load(self) -> Flash:
        return self.file.load()

    def commit(self, state: Flash) -> None:
        with self.core.waiting():
            self.file.commit(state)


class VirtualNode:
    """A NodeHandler that measures: one command at a time, whichever link it came by, like the one core of a board.

    ``exclusive`` takes the node for this process; see FlashFile. ``board`` makes the hardware from the flash file,
    None: a node that does not measure. With a ``pulse`` it runs in real time: samples, leases, dead-men, data frames.
    ``has_can`` is False for a board that no bus reaches. ``located`` is called with the seconds for which it blinks.
    """

    def __init__(
        self,
        folder: Path,
        *,
        delays: Delays | None = None,
        clock: Callable[[], float] = time.monotonic,
        exclusive: bool = False,
        board: Callable[[FlashFile], Board | None] = lambda file: None,
        pulse: RealtimeLoop | None = None,
        has_can: bool = True,
        located: Callable[[int], None] = lambda seconds: None,
    ) -> None:
        self._delays = delays or Delays()
        self.flash_file = FlashFile(folder, delay=self._delays.flash, exclusive=exclusive)
        self.board = board(self.flash_file)
        self._core, self._realtime_loop = _Core(), pulse
        self._wire = threading.Lock()
        self._sampled = 0
        self._reported_missed, self._report_at = 0, 0.0
        self._buses: dict[str, SendData] = {}
        self._press_announcers: list[Callable[[], None]] = []
        self._one_time_at = time.monotonic() + self._delays.crypto
        self._clock, self._has_can, self._located = clock, has_can, located
        self._slots: ImageSlots | None = None
        self.manager: ImageManager | None = None
        self._restarted: list[Callable[[], None]] = []
        self._off = False
        if ImageSlots.exist_in(folder):
            self._slots = ImageSlots(folder)
            self.manager = ImageManager(self._slots, self._restart_soon)
        self.tim = self._start()
        if self.board is not None:
            self.board.clock.due, self.board.clock.guard = self._simulated, self._core.interrupt

    def _start(self) -> Tim:
        """Start the board: the boot loader chooses the image, and the RAM is lost."""
        slots = self._slots
        if slots is not None:
            slots.start()
            if slots.behaves("crash") and slots.on_trial:
                slots.start()  # the watchdog restarts it, and the boot loader reverts the image
            if slots.behaves("confirm"):
                slots.confirm()
            self._off = slots.behaves("mute")
            self._end_trial_in_time(slots)
        return Tim(
            _SlowKey(self.flash_file.key, self._work),
            _Flash(self.flash_file, self._core),
            self._clock,
            max_message=self.flash_file.max_message,
            one_time=self._one_time,
            verify=self._verify,
            hardware=self.board,
            quick_points=self._delays.crypto <= _QUICK,
            has_can=self._has_can,
            firmware=self._firmware(),
            manager=self.manager,
        )

    def _firmware(self) -> Firmware | None:
        """Return what reports the firmware: the image that runs, else the description of the node."""
        if self.manager is not None:
            return ManagedFirmware(self.manager, self._located)
        report = self.flash_file.firmware
        return ReportedFirmware(report, self._located) if report is not None else None

    def _end_trial_in_time(self, slots: ImageSlots) -> None:
        """Restart a board whose image is still on trial after ten minutes."""
        if not slots.on_trial:
            return
        image = slots.running

        def look() -> None:
            if slots.on_trial and slots.running is image:
                self.restart()

        timer = threading.Timer(_TRIAL_SECONDS, look)
        timer.daemon = True
        timer.start()

    def _restart_soon(self) -> None:
        """Restart when the command that asks for it is over."""
        threading.Thread(target=self.restart, name="restart", daemon=True).start()

    def restart(self) -> None:
        """Restart the board: end sessions, clear what is in RAM, notify its links.

        A board whose only image does not verify stays silent.
        """
        with self._core.command():
            try:
                self.tim = self._start()
            except TedsProvisionError as error:
                _log.error("The board does not start: %s", error.message)
                self._off = True
        for restarted in self._restarted:
            restarted()
        self._wake()

    def when_restarted(self, restarted: Callable[[], None]) -> None:
        """Have a link called after each restart: its conversations are over."""
        self._restarted.append(restarted)

    # -- called by links -------------------------------------------------------------------------------------------

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        """Run one command frame; see NodeHandler."""
        reply = self.request_received(link, frame, tapped=tapped, received=self.tick())
        if self.tim.restarts_after(link):  # over NFC, nothing reports that the reader has fetched the reply
            timer = threading.Timer(_READER_SECONDS, self.reply_sent, (link,))
            timer.daemon = True
            timer.start()
        return reply

    def request_received(
        self,
        link: str,
        frame: bytes,
        *,
        tapped: bool,
        received: int,
        fd: bool = False,
        mtu: int = 23,
        hears: bool = True,
    ) -> bytes:
        """Run one command frame; see MeasuringHandler."""
        simulated = self.board is not None and not self.board.clock.runs_by_itself
        at = None if simulated else received  # a simulation's tick does not advance while a command runs
        with self._core.command():
            if self._off:
                raise NodeSilentError("The board does not answer.")
            port = port_of(link)._replace(fd=fd, mtu=mtu, hears=hears)
            reply = self.tim.handle(frame, link=link, tapped=tapped, port=port, received=at)
        with self._wire:
            pass  # wait for a data frame that is being sent: no frame of a stream may follow the reply to Stop
        self._wake()
        return reply

    def reply_sent(self, link: str) -> None:
        """Let data follow; see MeasuringHandler."""
        with self._core.interrupt():
            self.tim.reply_sent(link)
        self._wake()

    def lost(self, link: str) -> None:
        """Handle a lost link; see NodeHandler."""
        with self._core.command():
            self.tim.link_lost(link)

    def trigger(self, link: str, token: bytes, tick: int) -> None:
        """Handle a trigger; see MeasuringHandler."""
        with self._core.interrupt():
            self.tim.trigger(link, token, tick)
        self._wake()

    def drive(self, link: str, data: bytes) -> None:
        """Handle a Drive frame; see MeasuringHandler."""
        with self._core.interrupt():
            self.tim.drive(link, data)

    def unheard(self, link: str) -> None:
        """Handle disabled data messages; see BleHandler."""
        with self._core.interrupt():
            self.tim.unheard(link)

    def in_session(self, link: str) -> bool:
        """Return True if a session is open; see BleHandler."""
        with self._core.interrupt():
            return self.tim.in_session(link)

    def identify(self) -> bytes:
        """Identify as it is now; see NodeHandler."""
        return self.tim.identity().encode()

    def can_address(self) -> int:
        """Present CAN address; see NodeHandler."""
        return self.tim.can_address

    def take_can_address(self, address: int) -> None:
        """Move to another CAN address until the restart; see NodeHandler."""
        self.tim.take_can_address(address)

    def actuator_claimed(self) -> bool:
        """Return True if an actuator is claimed; see NodeHandler."""
        return self.tim.actuator_claimed()

    def tick(self, at: float = 0.0) -> int:
        """Return the present tick, or that of ``at`` (see MeasuringHandler); 0 for a node without clock."""
        if self.board is None:
            return 0
        # A simulation's clock advances only with its lines, so its tick does not depend on the time passed.
        passed = time.monotonic() - at if at and self.board.clock.runs_by_itself else 0.0
        return max(0, self.board.clock.tick() - max(0, round(passed * 1e9)))

    # -- by hand, and over time ------------------------------------------------------------------------------------

    def in_factory_state(self) -> bool:
        """Return True if the node holds no key."""
        return self.tim.flash.state == NodeState.FACTORY

    def reset_by_hand(self) -> None:
        """Hold the button 5 s."""
        if self.manager is not None and self.manager.on_trial:
            self.restart()  # an image on trial must not change stored state
        with self._core.command():
            self.tim.reset_by_hand()

    def announces_presses_over(self, announce: Callable[[], None]) -> None:
        """Have a bus announce that the button was pressed."""
        self._press_announcers.append(announce)

    def press_button(self) -> None:
        """Press the button and release it within 2 s: the board shows which one it is."""
        for announce in self._press_announcers:
            announce()

    def streams_over(self, send: SendData, bus: str = BUS) -> None:
        """Give the data frames of a bus to its server."""
        self._buses[bus] = send

    def beat(self) -> float | None:
        """Do what is due in real time; see RealtimeLoop."""
        board = self.board
        if board is None:
            return None
        with self._core.interrupt():
            wait = self._sample(board)
            if wait is not None:
                for channel, tick, reading in board.events():
                    self.tim.event(channel, tick, reading.octets, valid=reading.valid)
        if wait is None:  # no stream is running
            self._report_missed(board)
            return None
        frame = self._send_frames()
        self._report_missed(board)
        wait = max(wait, board.lag / NANOSECONDS / 2)  # a lagging board is sampled in batches of a few instants
        wait = min(max(wait, _COARSE), _EVENTS if board.has_events else wait + _COARSE)
        return wait if frame is None else min(frame, wait)

    def _sample(self, board: Board) -> float | None:
        """Take the samples that are due, in their order, and no more while a full message waits to leave.

        So a host that let the process wait for a moment costs no samples; one that is too slow for long does. Returns
        what Tim.poll returns.
        """
        real = max(0, board.clock.tick() - board.lag)
        at = max(self._sampled, real - _MOST_BEHIND) if board.clock.runs_by_itself else self._sampled
        while True:
            board.sampling = at
            try:
                wait = self.tim.poll()
            finally:
                board.sampling = None
            if at >= real or wait is None:
                self._sampled = real
                return wait
            if self.tim.backlog:
                self._sampled = at
                return 0.0
            at = min(real, at + max(round(wait * NANOSECONDS), _STEP))

    def _report_missed(self, board: Board) -> None:
        """Report now and then how many messages were lost here, and the rest once no stream runs any more."""
        with self._core.interrupt():
            missed, streaming = self.tim.missed, self.tim.streaming
        now = time.monotonic()
        if missed > self._reported_missed and (now >= self._report_at or not streaming):
            more = missed - self._reported_missed
            board.notify(
                f"{more} data messages of node {self.tim.flash.uuid.hex()} could not be sent in time ({missed})."
            )
            self._reported_missed, self._report_at = missed, now + _NOTICE_EVERY

    def _send_frames(self) -> float | None:
        """Send the frames that are due on each bus, and those close after; return the seconds until the next one.

        The 30 frames of a message on a classic bus are 0.2 ms apart: any other work between two of them would take
        longer.
        """
        until = time.monotonic() + _COARSE
        while True:
            for bus, send in self._buses.items():
                with self._wire:
                    with self._core.interrupt():
                        frame = self.tim.next_frame(bus)
                    if frame is not None:
                        send(frame)
            with self._core.interrupt():
                wait = self.tim.next_frame_in()
            if wait is None or wait > _CLOSE or time.monotonic() >= until:
                return wait
            time.sleep(wait)

    def _wake(self) -> None:
        if self._realtime_loop is not None and self.board is not None:
            self._realtime_loop.wake(self)

    # -- background work -------------------------------------------------------------------------------------------

    def _work(self) -> None:
        """Wait as long as the board needs for one operation on the curve."""
        self._sleep(self._delays.crypto)

    def _verify(self, point: bytes, message: bytes, signature: bytes) -> bool:
        self._work()
        return verify(point, message, signature)

    def _sleep(self, seconds: float) -> None:
        if seconds > 0:
            with self._core.waiting():
                time.sleep(seconds)

    def _one_time(self) -> PrivateKey:
        """Return a key pair for one Open; the chip makes the next one while it is idle."""
        self._sleep(self._one_time_at - time.monotonic())
        self._one_time_at = time.monotonic() + self._delays.crypto
        return _SlowKey(SoftwareKey.generate(), self._work)

    def _simulated(self) -> None:
        """Take the samples that fell due when a simulation moved the clock, and let full messages leave first."""
        until = time.monotonic() + _SIMULATION_WAITS
        while (wait := self.beat()) is not None and time.monotonic() < until:
            if self._sampled >= self.tick() and self.tim.next_frame_in() is None:
                return
            time.sleep(min(wait, _COARSE))
