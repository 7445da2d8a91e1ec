"""Our own frames, given back by an interface that cannot tell them from those of others: udp_multicast, SocketCAN.

A frame is taken for our own once for each time that it was sent, within three seconds.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from typing import Final

from teds_provision.links.can.frame import Frame

_SECONDS: Final = 3.0
_KEPT: Final = 4096


class Echoes:
    """What was sent and has not come back yet. Thread-safe."""

    def __init__(self) -> None:
        self._sent: OrderedDict[tuple[int, bytes], list[float]] = OrderedDict()
        self._lock = threading.Lock()

    def sent(self, frame: Frame) -> None:
        """Note a frame before it leaves."""
        key = (frame.identifier, frame.data)
        with self._lock:
            self._sent.setdefault(key, []).append(time.monotonic())
            self._sent.move_to_end(key)
            if len(self._sent) > _KEPT:  # some were lost on their way back
                self._sent.popitem(last=False)

    def take(self, frame: Frame) -> bool:
        """Whether this is one of them; it will not be another time."""
        key = (frame.identifier, frame.data)
        with self._lock:
            times = self._sent.get(key)
            if times is None:
                return False
            oldest = time.monotonic() - _SECONDS
            while times and times[0] < oldest:
                times.pop(0)
            known = bool(times)
            if known:
                times.pop(0)
            if not times:
                del self._sent[key]
            return known
