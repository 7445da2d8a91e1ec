"""Another base station under our own source address: noticed by the frames that nobody here sent or asked for.

Two stations of one address get each other's replies, so that commands fail in ways that look like noise. Seen are
frames *from* our address that we did not send, and replies to us that we did not ask for.
"""

from __future__ import annotations

import threading
import time
from typing import Final

from teds_provision.links.can.frame import Frame
from teds_provision.links.can.isotp import FUNCTIONAL, addresses

_KEPT: Final = 64
_FRAMES_NEEDED: Final = 2
_REPLIES_NEEDED: Final = 4


class Rivals:
    """What speaks for another station at our address ``own``. Thread-safe."""

    def __init__(self, own: int) -> None:
        self._own = own
        self._frames: list[float] = []
        self._replies: list[float] = []
        self._lock = threading.Lock()

    def heard(self, frame: Frame) -> None:
        """Look at a frame of the bus that we did not send."""
        if frame.identifier & 0xFF == self._own and _of_a_station(frame.identifier):
            with self._lock:
                self._frames.append(time.monotonic())
                del self._frames[:-_KEPT]

    def unasked(self, node: int) -> None:
        """Note the beginning of a reply of ``node`` to us that nobody here asked for."""
        del node
        with self._lock:
            self._replies.append(time.monotonic())
            del self._replies[:-_KEPT]

    def seen(self, *, within: float = 10.0) -> bool:
        """Whether another station used our address within these seconds."""
        since = time.monotonic() - within
        with self._lock:
            frames = sum(at >= since for at in self._frames)
            replies = sum(at >= since for at in self._replies)
        return frames >= _FRAMES_NEEDED or replies >= _REPLIES_NEEDED

    @property
    def text(self) -> str:
        """One sentence that names the address."""
        return f"Another base station on this bus uses our source address 0x{self._own:02X}."

    @property
    def hint(self) -> str:
        """The cure."""
        free = 0xF2 if self._own == 0xF1 else 0xF1
        return f"Give each station an address of its own, 0xF1 to 0xF7: add source=0x{free:02X} to --can of one."


def _of_a_station(identifier: int) -> bool:
    return identifier & 0x1FFFFF00 == FUNCTIONAL or addresses(identifier) is not None
