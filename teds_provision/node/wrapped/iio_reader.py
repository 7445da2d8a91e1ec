"""Reads an IIO device: from its buffer if it has one that this user may use, else file by file from sysfs."""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

from teds_provision.node.wrapped.iio_device import IioChannel, IioDevice, ScanElement
from teds_provision.node.wrapped.latest_values import LatestValues

_LEAST_POLL: Final = 0.001
_WAIT: Final = 0.2
_LENGTH: Final = 256
"""Scans that the kernel's buffer holds."""
_LARGEST: Final = 1 << 16

Notify = Callable[[str], None]


def layout(scans: Sequence[ScanElement]) -> tuple[list[int], int]:
    """Return the octet at which each element of a scan begins, and the octets of a scan.

    Elements are in the order of their index, each aligned to its own size, the scan to its largest element.
    """
    places, at = [], 0
    for scan in scans:
        size = scan.storage // 8
        at = -(-at // size) * size
        places.append(at)
        at += size
    largest = max(scan.storage // 8 for scan in scans)
    return places, -(-at // largest) * largest


def raw_of(scan: ScanElement, octets: bytes) -> int:
    """Return the raw number of an element: shifted right, and with its sign."""
    number = int.from_bytes(octets, "big" if scan.order == "be" else "little") >> scan.shift
    number &= (1 << scan.bits) - 1
    return number - (1 << scan.bits) if scan.signed and number >> scan.bits - 1 else number


class IioReader:
    """One thread that reads a device into the values of its channels."""

    def __init__(self, device: IioDevice, notify: Notify) -> None:
        self._device, self._notify = device, notify
        self.values = [LatestValues(channel, "reading") for channel in device.describe().channels]
        self._parts = list(zip(device.channels, self.values, strict=True))
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._descriptor = -1
        self._enabled: list[Path] = []

    def start(self) -> None:
        """Begin to read: the buffer if it can be used, the files of sysfs otherwise."""
        buffered = [(channel, part) for channel, part in self._parts if channel.scan is not None]
        target = self._poll
        if len(buffered) == len(self._parts) and self._open_buffer([channel for channel, _ in buffered]):
            target = self._read_buffer
        self._thread = threading.Thread(target=target, name="wrapped", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End, and leave the buffer as it was; never raises."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=3)
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
        for path in reversed(self._enabled):
            with contextlib.suppress(OSError):
                path.write_text("0")

    # -- file by file ----------------------------------------------------------------------------------------------

    def _poll(self) -> None:
        period = max(self._device.period, _LEAST_POLL)
        due = time.monotonic()
        while not self._stop.wait(max(0.0, due - time.monotonic())):
            for channel, part in self._parts:
                self._read_file(channel, part)
            due = max(due + period, time.monotonic())

    def _read_file(self, channel: IioChannel, part: LatestValues) -> None:
        at = time.monotonic()
        try:
            raw = float(channel.file.read_text())
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it holds no number"
            part.note_trouble(f"{channel.file.name} cannot be read: {reason}")
            return
        part.note_trouble("")
        part.put(at, raw)

    # -- buffer ----------------------------------------------------------------------------------------------------

    def _open_buffer(self, channels: Sequence[IioChannel]) -> bool:
        """Enable the scan elements and the buffer; False, with everything as it was, if that cannot be done."""
        device = self._device
        elements = next((folder for folder in ("scan_elements", "buffer0") if (device.folder / folder).is_dir()), None)
        buffer = next(
            (folder for folder in ("buffer0", "buffer") if (device.folder / folder / "enable").exists()), None
        )
        if elements is None or buffer is None or not device.character.exists():
            return False
        try:
            for channel in channels:
                self._enable(device.folder / elements / f"in_{channel.name}_en")
            if (device.folder / buffer / "length").exists():
                (device.folder / buffer / "length").write_text(str(_LENGTH))
            self._enable(device.folder / buffer / "enable")
            self._descriptor = os.open(device.character, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            self._notify(
                f"The buffer of {device.name} cannot be used ({error.strerror}): its files are read one by one."
            )
            for path in reversed(self._enabled):
                with contextlib.suppress(OSError):
                    path.write_text("0")
            self._enabled = []
            return False
        return True

    def _enable(self, path: Path) -> None:
        path.write_text("1")
        self._enabled.append(path)

    def _read_buffer(self) -> None:
        scans = [channel.scan for channel, _ in self._parts if channel.scan is not None]
        places, size = layout(scans)
        parts = list(zip(scans, places, [part for _, part in self._parts], strict=True))
        for octets in self._chunks(size):
            newest, count = time.monotonic(), len(octets) // size
            for number in range(count):
                at = newest - (count - 1 - number) * self._device.period
                for scan, place, part in parts:
                    begin = number * size + place
                    part.put(at, raw_of(scan, octets[begin : begin + scan.storage // 8]))

    def _chunks(self, size: int) -> Iterator[bytes]:
        """Yield whole scans as they come."""
        poll = select.poll()
        poll.register(self._descriptor, select.POLLIN)
        held = b""
        while not self._stop.is_set():
            if not poll.poll(_WAIT * 1000):
                continue
            try:
                octets = os.read(self._descriptor, _LARGEST)
            except BlockingIOError:
                continue
            except OSError as error:
                self._trouble(f"the buffer cannot be read: {error.strerror}")
                return
            if not octets:  # end of the buffer
                self._trouble("the buffer has ended")
                self._stop.wait(_WAIT)
                continue
            held += octets
            whole = len(held) // size * size
            yield held[:whole]
            held = held[whole:]

    def _trouble(self, why: str) -> None:
        for _, part in self._parts:
            part.note_trouble(why)
