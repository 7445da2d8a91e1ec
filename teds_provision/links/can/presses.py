"""Finds the board on a bus whose button was pressed: a hint for the operator beside it.

If two boards are pressed within a second, or two CRCs come from one address, none is marked: any device can send an
Announce.
"""

from __future__ import annotations

import threading
import time
from typing import Final, NamedTuple

from teds_provision.protocol.announce import Announce

_APART: Final = 1.0
_MOST: Final = 256


class _Press(NamedTuple):
    at: float
    address: int
    crc: int


class ButtonPressLog:
    """Presses heard on one bus; times are monotonic seconds. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._presses: list[_Press] = []
        self._crcs: dict[int, set[int]] = {}
        self._told = 0.0

    def hear(self, announce: Announce) -> None:
        """Record an Announce of any kind."""
        with self._lock:
            crcs = self._crcs.setdefault(announce.address, set())
            if len(crcs) < _MOST:
                crcs.add(announce.crc)
            if announce.pressed:
                self._presses.append(_Press(time.monotonic(), announce.address, announce.crc))
                del self._presses[:-_MOST]

    def marks(self, address: int, crc: int) -> bool:
        """Return True if only the board at this address, with this CRC of its UUID, reports a press."""
        with self._lock:
            return any(press[1:] == (address, crc) and self._is_clear(press) for press in self._presses)

    def news(self) -> list[int]:
        """Return the CRCs of the boards that were pressed since the last call, once a second has shown them clear."""
        with self._lock:
            until = time.monotonic() - _APART
            found = [press for press in self._presses if self._told < press.at <= until]
            self._told = max([self._told, *(press.at for press in found)])
            return list(dict.fromkeys(press.crc for press in found if self._is_clear(press)))

    def _is_clear(self, press: _Press) -> bool:
        if len(self._crcs[press.address]) > 1:
            return False
        return all(other[1:] == press[1:] or abs(other.at - press.at) >= _APART for other in self._presses)
