"""Measures the load of streams on a bus, and delays the messages of long transfers accordingly.

On CAN, commands have priority over data (their identifiers are lower), so a transfer at full speed would delay every
stream. All transfers of a process over one bus share nine tenths of it, minus the load of its streams. On a bus without
streams, transfers are not delayed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final

from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.spec import CanSpec
from teds_provision.protocol.announce import is_announce
from teds_provision.protocol.operation.budget import classic_bits, fd_seconds
from teds_provision.protocol.operation.can_frames import DATA, DRIVE, FD_OCTETS, fd_length

_MOST: Final = 0.9
"""Share of a bus that streams and transfers take together."""
_LEAST: Final = 0.02
"""Share that a transfer gets on a bus that is full: it comes to its end."""
_WINDOW: Final = 0.5
"""Seconds over which the load of streams is counted."""
_CLASSIC_OCTETS: Final = 8


class TransferPace:
    """Counts frames of one bus; thread-safe. ``clock`` gives monotonic seconds, ``sleep`` waits."""

    def __init__(
        self,
        spec: CanSpec,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self._clock, self._sleep = clock, sleep
        worst = False
        self._classic = [classic_bits(n, worst=worst) * 1.1 / spec.bitrate for n in range(_CLASSIC_OCTETS + 1)]
        self._fd = [
            fd_seconds(fd_length(n), spec.bitrate, spec.data_bitrate, worst=worst) * 1.05 for n in range(FD_OCTETS + 1)
        ]
        self._lock = threading.Lock()
        self._streams = self._others = 0.0
        self._began, self._load = clock(), 0.0
        self._free_at, self._counted, self._left = 0.0, 0.0, self._began

    def count(self, frame: Frame) -> None:
        """Count a received or sent frame: of a stream (or a Drive message), or of a command or reply."""
        octets = len(frame.data)
        seconds = self._fd[octets] if frame.fd else self._classic[min(octets, _CLASSIC_OCTETS)]
        kind = frame.identifier & 0x1FFF0000
        if kind == DRIVE or (kind == DATA and not is_announce(frame.identifier)):
            self._streams += seconds
        else:
            self._others += seconds

    @property
    def stream_load(self) -> float:
        """Share of the bus that streams took a moment ago."""
        now = self._clock()
        with self._lock:
            passed = now - self._began
            if passed >= _WINDOW:
                self._load, self._streams, self._began = self._streams / passed, 0.0, now
            elif passed > 0:  # the first window of a stream is not over yet
                return max(self._load, self._streams / _WINDOW)
            return self._load

    def wait(self) -> bool:
        """Wait until commands and replies since the last call have had the time that streams leave them.

        Returns True if streams run; without them there is no wait.
        """
        load = self.stream_load
        with self._lock:
            now = self._clock()
            used, self._counted = self._others - self._counted, self._others
            left = 0.0
            if load > 0:
                # The octets since the last call were sent from then on; unused time before it is not saved up.
                self._free_at = max(self._free_at, self._left) + used / max(_LEAST, _MOST - load)
                left = max(0.0, self._free_at - now)
            self._left = now + left
        if left > 0:
            self._sleep(left)
        return load > 0
