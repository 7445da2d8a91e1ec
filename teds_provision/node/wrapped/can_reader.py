"""Reads the frames of wrapped DBC messages from one bus, for all wrapped nodes of the process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from teds_provision.errors import BadDataError, LinkError, NoReaderError
from teds_provision.links.can.sensor_bus import SensorBus, SensorFrame
from teds_provision.links.can.spec import CanSpec
from teds_provision.node.wrapped.dbc_message import DbcMessage, FrameKey, j1939_state, pgn_of
from teds_provision.node.wrapped.description import PERIODS_LATE
from teds_provision.node.wrapped.latest_values import LatestValues

_WAIT: Final = 0.2
_GATHER: Final = 0.002
"""Seconds in which frames gather that the kernel dates: reading each one when it comes costs twice the processor."""
_FIRST_REOPEN, _LAST_REOPEN = 1.0, 30.0
_NOTICE_EVERY: Final = 1000

Notify = Callable[[str], None]


class MessageReader:
    """One wrapped message: decodes its frames into the values of its channels."""

    def __init__(self, message: DbcMessage, notify: Notify) -> None:
        self.message, self._notify = message, notify
        self.values = [LatestValues(channel) for channel in message.sensor.channels]
        self._by_name: Mapping[str, LatestValues] = {part.channel.name: part for part in self.values}
        self._j1939 = message.message.protocol == "j1939"
        self._silence = PERIODS_LATE * min(part.channel.period for part in self.values)
        self._address: int | None = None
        self._heard_at = 0.0
        self._address_reported = False
        self.frames = self.bad = 0

    def handle(self, frame: SensorFrame) -> None:
        """Decode a frame; one that cannot be decoded is counted and reported (the first, then each thousandth)."""
        if self._j1939 and not self._is_ours(frame):
            return
        try:
            numbers = self.message.numbers(frame.data)
        except BadDataError as error:
            self.bad += 1
            if self.bad == 1 or self.bad % _NOTICE_EVERY == 0:
                self._notify(f"{error.message} ({self.bad} so far)")
            return
        self.frames += 1
        for name, raw in numbers.items():
            part = self._by_name[name]
            part.put(frame.at, raw, j1939_state(part.channel.bits, raw) if self._j1939 else "")

    def note_trouble(self, why: str) -> None:
        """Note why nothing comes."""
        for part in self.values:
            part.note_trouble(why)

    def _is_ours(self, frame: SensorFrame) -> bool:
        """Return True if the frame is from the first source address that sent this group, until that one is silent."""
        address = frame.identifier & 0xFF
        if self._address is None or (address != self._address and frame.at - self._heard_at > self._silence):
            self._address = address
        elif address != self._address:
            if not self._address_reported:
                self._address_reported = True
                self._notify(
                    f"{self.message.message.name} also comes from the source address 0x{address:02x}; "
                    f"only 0x{self._address:02x} is read."
                )
            return False
        self._heard_at = frame.at
        return True


class CanReader:
    """One thread that reads a bus for all its messages; a lost bus is opened again, values are invalid until then."""

    def __init__(self, spec: CanSpec, readers: Sequence[MessageReader], notify: Notify) -> None:
        self._spec, self._readers, self._notify = spec, readers, notify
        self._routes: dict[FrameKey, list[MessageReader]] = {}
        for reader in readers:
            self._routes.setdefault(reader.message.key, []).append(reader)
        self._has_groups = any(key.pgn for key in self._routes)
        self._bus: SensorBus | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Open the bus and read; raises NoReaderError or UsageError."""
        self._bus = self._open()
        self._thread = threading.Thread(target=self._run, name="wrapped", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End; never raises."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=3)
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def _open(self) -> SensorBus:
        return SensorBus(self._spec, [key.filter for key in self._routes])

    def _run(self) -> None:
        wait = _FIRST_REOPEN
        while not self._stop.is_set():
            try:
                self._bus = self._bus or self._open()
                self._read(self._bus)
            except (LinkError, NoReaderError) as error:
                self._lost(error.message)
                self._stop.wait(wait)
                wait = min(2 * wait, _LAST_REOPEN)
            else:
                wait = _FIRST_REOPEN

    def _read(self, bus: SensorBus) -> None:
        for reader in self._readers:
            reader.note_trouble("")
        while not self._stop.is_set():
            frame = bus.receive(_WAIT)
            while frame is not None and not self._stop.is_set():
                self._route(frame)
                frame = bus.receive(0.0)
            if bus.stamped:
                time.sleep(_GATHER)

    def _lost(self, why: str) -> None:
        self._notify(f"{why} The values of the wrapped sensors are invalid until the bus is back.")
        for reader in self._readers:
            reader.note_trouble(why.rstrip("."))
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def _route(self, frame: SensorFrame) -> None:
        for reader in self._routes.get(FrameKey(frame.identifier, frame.extended), ()):
            reader.handle(frame)
        if self._has_groups and frame.extended:
            for reader in self._routes.get(FrameKey(pgn_of(frame.identifier), extended=True, pgn=True), ()):
                reader.handle(frame)
