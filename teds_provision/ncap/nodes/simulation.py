"""A simulation that feeds a virtual transducer: what it may feed, and its lines, checked as the node checks them.

The node's process gets the lines by a socket in its folder. They are checked before, so that the simulation learns at
once what is wrong with one; the node skips the same lines.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from teds_provision.node.flash_file import FlashFile
from teds_provision.node.hardware.converter import Converter
from teds_provision.node.sources.base import SourceChannel
from teds_provision.node.sources.lines import LineSource
from teds_provision.teds.sheet import Channel, Sheet

SIMULATION: Final = "simulation"
"""The source of a virtual transducer that waits for a simulation."""
SOCKET: Final = "source.sock"
MOST_OCTETS: Final = 1 << 20
"""Octets a second of one simulation: beyond them its lines are read no faster."""
_BURST: Final = 0.25  # a burst may contain this many seconds of that rate


@dataclass
class Feed:
    """The one simulation of a virtual transducer: who runs it, since when, and what came."""

    by: str
    end: Callable[[], object]
    since: float = field(default_factory=time.time)
    lines: int = 0
    skipped: int = 0

    def as_json(self) -> dict[str, Any]:
        """Return the object of api.md, `/virtual`."""
        return {name: getattr(self, name) for name in ("by", "since", "lines", "skipped")}


@dataclass(frozen=True)
class FedChannel:
    """A sensor that a simulation feeds, with the unit of its values."""

    place: SourceChannel
    unit: str

    def as_json(self) -> dict[str, Any]:
        """Return its facts for the simulation; a range only if the datasheet has one."""
        low, high = self.place.low, self.place.high
        known = low < high
        return {
            "number": self.place.number,
            "name": self.place.name,
            "unit": self.unit,
            "low": low if known else None,
            "high": high if known else None,
        }


def fed_channels(folder: Path) -> list[FedChannel]:
    """Return the sensors of a virtual transducer, from the datasheet that it was made with."""
    sheet = Sheet.from_blocks(FlashFile(folder).hardware)
    return [
        FedChannel(Converter(sheet, channel).place, channel.unit.text) for channel in sheet.channels if _fed(channel)
    ]


def _fed(channel: Channel) -> bool:
    return channel.kind is not None and not channel.actuator


class CheckedLines:
    """Lines of one simulation, in their order. ``limited`` counts values beyond a channel's range."""

    def __init__(self, channels: list[FedChannel]) -> None:
        self._places = {channel.place.number: channel for channel in channels}
        self._source = LineSource([channel.place for channel in channels], lambda _text: None, needs_time=False)
        self._source.begin(_NoClock())
        self.limited = 0

    def check(self, line: bytes) -> tuple[str, str]:
        """Return why the node skips a line, and which value of it is beyond its range; "" for neither."""
        problem = self._source.feed_line(line)
        if problem:
            return problem, ""
        for number, reading in self._source.latest.items():
            channel = self._places[number]
            low, high = channel.place.low, channel.place.high
            if reading is not None and reading.value is not None and not low <= reading.value <= high and low < high:
                self.limited += 1
                unit = f" {channel.unit}" if channel.unit else ""
                beyond = f"{channel.place.name}: {reading.value:g}{unit} is outside {low:g} to {high:g}{unit}"
                return "", f"{beyond}; the sensor gives the nearer limit"
        return "", ""


class _NoClock:
    """The clock of a node that is elsewhere."""

    def now(self) -> float:
        """Return 0: the time of this node never advances here."""
        return 0.0

    def own_clock(self) -> None:
        """Do nothing: there is no clock to stop."""

    def advance(self, seconds: float, change: Callable[[], None]) -> None:
        """Take the new values."""
        change()

    def host_clock(self) -> None:
        """Do nothing: there is no clock to go on with."""


class Pace:
    """Keeps a simulation to :data:`MOST_OCTETS` a second."""

    def __init__(self) -> None:
        self._free = time.monotonic()

    def delay(self, octets: int) -> float:
        """Return the seconds to wait after so many octets, before more are read."""
        now = time.monotonic()
        self._free = max(self._free, now - _BURST) + octets / MOST_OCTETS
        return max(0.0, self._free - now)
