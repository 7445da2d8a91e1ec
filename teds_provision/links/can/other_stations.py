"""The share of a bus that data for other stations takes: this one grants streams only in what is left.

Every station sees every data frame; the identifier names the station for which it is (operation.md sections 4 and 6).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final

from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.spec import CanSpec
from teds_provision.protocol.operation.budget import classic_bits, fd_seconds
from teds_provision.protocol.operation.can_frames import CLASSIC_OCTETS, DATA, FD_OCTETS, fd_length

_WINDOW: Final = 2.0
"""Seconds over which frames are counted: streams of a slow period take turns within them."""
_PREFIX: Final = 0x1FFF0000


class OtherStationsLoad:
    """Counts the data frames of one bus that are for another station; thread-safe. ``clock`` gives monotonic seconds.

    Each counts with the most stuff bits that it can have.
    """

    def __init__(self, spec: CanSpec, clock: Callable[[], float] = time.monotonic) -> None:
        self._own, self._clock = spec.source & 7, clock
        self._classic = [classic_bits(octets) / spec.bitrate for octets in range(CLASSIC_OCTETS + 1)]
        self._fd = [fd_seconds(fd_length(n), spec.bitrate, spec.data_bitrate) for n in range(FD_OCTETS + 1)]
        self._lock = threading.Lock()
        self._began, self._taken, self._load = clock(), 0.0, 0.0

    def count(self, frame: Frame) -> None:
        """Count a received frame if it is data for another station; Announces are for none."""
        if frame.identifier & _PREFIX != DATA:
            return
        station = frame.identifier >> 13 & 7
        if station in (0, self._own):
            return
        octets = len(frame.data)
        seconds = self._fd[octets] if frame.fd else self._classic[min(octets, CLASSIC_OCTETS)]
        with self._lock:
            self._end_window()
            self._taken += seconds

    @property
    def load(self) -> float:
        """Share of the bus that they took a moment ago."""
        with self._lock:
            self._end_window()
            return max(self._load, self._taken / _WINDOW)  # the first window of a stream is not over yet

    def _end_window(self) -> None:
        now = self._clock()
        passed = now - self._began
        if passed >= _WINDOW:
            self._load, self._taken, self._began = self._taken / passed, 0.0, now
