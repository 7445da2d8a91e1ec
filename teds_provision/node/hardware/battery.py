"""The battery of a virtual transducer: charged in a reader's field, emptied outside it (operation.md section 7)."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final

from teds_provision.protocol.operation.commands import Power, PowerFlag

TOO_LOW: Final = 5.0
"""Per cent below which the node does not measure."""
_EMPTY_VOLTS, _FULL_VOLTS = 3.3, 4.2
_FULL: Final = 99.5
_CELSIUS: Final = 24


class Battery:
    """``level`` in per cent; ``charge`` and ``drain`` in per cent a minute. Thread-safe."""

    def __init__(
        self, level: float, *, charge: float = 2.0, drain: float = 0.1, host: Callable[[], float] = time.monotonic
    ) -> None:
        self._level, self._charge, self._drain, self._host = min(max(level, 0.0), 100.0), charge, drain, host
        self._at = host()
        self._in_field = False
        self._lock = threading.Lock()

    def field(self, *, present: bool) -> None:
        """A charging field came or went."""
        with self._lock:
            self._run()
            self._in_field = present

    def power(self) -> Power:
        """What Power (128.18) says now."""
        with self._lock:
            self._run()
            level, in_field = self._level, self._in_field
        charging = in_field and level < _FULL
        flags = PowerFlag.BATTERY
        flags |= PowerFlag.CHARGING if charging else PowerFlag(0)
        flags |= PowerFlag.FULL if level >= _FULL else PowerFlag(0)
        flags |= PowerFlag.IN_FIELD if in_field else PowerFlag(0)
        flags |= PowerFlag.TOO_LOW if level < TOO_LOW else PowerFlag(0)
        volts = _EMPTY_VOLTS + (_FULL_VOLTS - _EMPTY_VOLTS) * level / 100
        return Power(flags, round(level), volts, 0.05 if charging else -0.002, _CELSIUS)

    def _run(self) -> None:
        now = self._host()
        rate = self._charge if self._in_field else -self._drain
        self._level = min(max(self._level + rate * (now - self._at) / 60, 0.0), 100.0)
        self._at = now
