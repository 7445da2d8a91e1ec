"""The common form of every recording format: facts of channels, blocks of samples, rows of a grid, reports, notes.

A recording may come from any source: sizes and counts are limited (:data:`MOST`), so that memory stays small whatever
the file contains, and malformed content raises BadDataError with the place.
"""

from __future__ import annotations

import math
import os
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, get_args

from teds_provision.errors import BadDataError
from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows, Kind, NodeReport, Note, StationFacts
from teds_provision.measure.display_units import UnitConversion
from teds_provision.portable import CLOSING, NONBLOCK, lock
from teds_provision.teds import Units
from teds_provision.teds.calibration.plain import calibration_from_json
from teds_provision.teds.units import parse_units


@dataclass(frozen=True)
class ReadLimits:
    """The most that is read of a recording at a time."""

    line: int = 8 << 20
    """Octets of a line of text or JSON."""
    chunk: int = 64 << 20
    """Octets of an MCAP chunk, unpacked; of any other record."""
    channels: int = 20_000
    """TransducerChannels, and topics of an MCAP."""
    text: int = 1_000
    """Characters of a name, a unit, a date."""
    columns: int = 40_100


MOST: Final = ReadLimits()
ROWS: Final = 4096
"""Rows that are handed on together: enough for numpy, few enough to keep nodes together in time."""
_LATEST: Final = 1.8e10  # unix seconds; nanoseconds in 64 bits, as MCAP has them, reach to 2554
_HIGHEST: Final = 2**63  # sample numbers are int64 in Parquet


Entry = Block | GroupRows | NodeReport | Note | tuple[ChannelFacts, ...]
"""No facts at all end a batch: everything behind them was recorded after everything before them."""


class Recording(ABC):
    """A recording that is open for reading: its head, then its entries in the order of the file.

    ``facts`` has the first facts of each channel, wherever in the file they are. ``torn`` is known when all entries
    were read: octets at the end that are no whole piece (a killed recorder, or one that still writes).
    """

    form: str
    """Name of the format."""
    wide = False
    """True if it has rows of one grid in place of blocks."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.station = StationFacts("")
        self.facts: dict[tuple[str, int], ChannelFacts] = {}
        self._to_si = UnitConversion(back=True)
        self.torn = 0
        self.complete = True
        """True if the file has its end, in a format that has one."""
        self.being_written = is_locked(path)

    def entries(self) -> Iterator[Entry]:
        """Yield all that is in it, in SI units; each call starts from the beginning.

        Raises BadDataError, NotFoundError.
        """
        return map(self._to_si.convert, map(self._checked, self._stored_entries()))

    def _checked(self, entry: Entry) -> Entry:
        """Return an entry that any format can hold; raises BadDataError for numbers that no recorder writes."""
        if not isinstance(entry, Block | GroupRows):
            return entry
        where = f"{self.path}: node {entry.uuid}" if isinstance(entry, Block) else f"{self.path}: group {entry.group}"
        if not ((entry.time >= 0) & (entry.time <= _LATEST)).all():
            raise BadDataError(f"{where} has a time that is not in the years 1970 to 2540.")
        if isinstance(entry, Block):
            if not 0 <= entry.index < _HIGHEST - len(entry.time):
                raise BadDataError(f"{where} has a sample number that is negative or too large.")
            if entry.clock_error is not None and not math.isfinite(entry.clock_error):
                raise BadDataError(f"{where} has a clock error that is not finite.")
        return entry

    @abstractmethod
    def _stored_entries(self) -> Iterator[Entry]:
        """Yield the entries in the units of the file."""

    def know(self, facts: ChannelFacts) -> None:
        """Keep the first facts of a channel, in SI units; raises BadDataError for more channels than are read."""
        if facts.key in self.facts:
            return
        (facts,) = self._to_si.facts([facts])
        if len(self.facts) >= MOST.channels:
            raise BadDataError(f"{self.path} names more than {MOST.channels} channels.")
        self.facts[facts.key] = facts


def first_instants(entry: Entry, channels: Collection[tuple[str, int]] | None, most: float) -> Block | GroupRows | None:
    """Return the first ``most`` instants of these channels (None: all); None if the entry has none of them."""
    if not isinstance(entry, Block | GroupRows):
        return None
    kept = [column for column, key in enumerate(entry.keys) if channels is None or key in channels]
    if not kept:
        return None
    n = int(min(most, len(entry.time)))
    if isinstance(entry, GroupRows):
        keys = tuple(entry.channels[column] for column in kept)
        return replace(entry, channels=keys, time=entry.time[:n], value=entry.value[:n, kept], age=entry.age[:n, kept])
    return replace(
        entry,
        channels=tuple(entry.channels[column] for column in kept),
        time=entry.time[:n],
        tick=entry.tick[:n],
        raw=entry.raw[:n, kept],
        value=entry.value[:n, kept],
        valid=entry.valid[:n, kept],
    )


def is_locked(path: Path) -> bool:
    """Return True if a recorder holds the file now."""
    try:
        file = os.open(path, os.O_RDONLY | CLOSING | NONBLOCK)
    except OSError:
        return False
    try:
        lock(file, shared=True)
    except BlockingIOError:
        return True
    except OSError:  # a file system without locks
        return False
    finally:
        os.close(file)
    return False


def station_of(words: Mapping[str, Any]) -> StationFacts:
    """Return the station facts of an untrusted head."""
    name, group, clock = (str(words.get(key) or "")[: MOST.text] for key in ("station", "group", "clock"))
    test = words.get("test_pattern") in (True, "true")
    plain = StationFacts(name, group=group, test_pattern=test, started=unix_of(words.get("started")))
    return plain if not clock else StationFacts(**{**vars(plain), "clock": clock})


def unix_of(text: object) -> float:
    """Return unix seconds of an ISO time; 0.0 if it is none."""
    from datetime import datetime

    try:
        return datetime.fromisoformat(str(text)).timestamp()
    except (ValueError, OverflowError):
        return 0.0


TEXT_FACTS: Final = frozenset(
    {"uuid", "node", "name", "unit", "shown_unit", "calibrated", "due", "fingerprint", "sample_form", "quantity"}
    | {"frame", "si_unit", "wrapped"}
)
"""Fields of :class:`ChannelFacts` that are texts."""
_NUMBERS = frozenset({"low", "high", "uncertainty", "period", "deviation", "own_period", "si_factor", "si_offset"})
_FLAGS = frozenset({"overdue", "unsigned", "unverified"})
_FIELDS = frozenset(field.name for field in fields(ChannelFacts))


def facts_of(words: object, where: str) -> ChannelFacts:
    """Return facts of a channel as a recording has them (``lines.facts_as_json``).

    Raises BadDataError that begins with ``where``. The exponents of the unit are parsed from its text: an unknown unit
    (another program's) stays text alone.
    """
    if not isinstance(words, dict):
        raise BadDataError(f"{where}: the facts of a channel are not a JSON object.")
    curve = words.get("calibration")
    members = ((name, value) for name, value in words.items() if name in _FIELDS and name != "calibration")
    kept: dict[str, Any] = {name: _fact(name, value, where) for name, value in members}
    if "uuid" not in kept or "number" not in kept:
        raise BadDataError(f"{where}: a channel has no UUID or no number.")
    try:
        kept["units"] = parse_units(kept["unit"]) if kept.get("unit") else None
    except BadDataError:
        kept["units"] = None
    if curve is not None:
        try:
            kept["calibration"] = calibration_from_json(curve, kept["number"], kept["units"] or Units())
        except BadDataError as error:
            raise BadDataError(f"{where}: the calibration of channel {kept['number']} cannot be read.") from error
    return ChannelFacts(**{"node": "", "name": "", **kept})


def _fact(name: str, value: Any, where: str) -> Any:
    """Return one fact as :class:`ChannelFacts` has it; raises BadDataError if the value is of the wrong kind."""
    if name in TEXT_FACTS and isinstance(value, str) and len(value) <= MOST.text:
        return value
    if name in _NUMBERS and (number := number_of(value)) is not None:
        return _finite(number, name, where)
    if (name in _FLAGS and isinstance(value, bool)) or (name == "kind" and value in get_args(Kind)):
        return value
    if name == "vector" and isinstance(value, list) and len(value) <= MOST.text:
        return tuple(channel_number(element, where) for element in value)
    if name == "number":
        return channel_number(value, where)
    raise BadDataError(f"{where}: {name} of a channel is {_short(value)}.")


def channel_number(value: object, where: str) -> int:
    """Return the number of a TransducerChannel; raises BadDataError."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 0xFFFF:
        what = "the channel number is missing" if value is None else f"{_short(value)} is not a channel number"
        raise BadDataError(f"{where}: {what}.")
    return value


def number_of(value: object) -> float | None:
    """Return a number of an untrusted recording; None if it is none, or an integer beyond the range of a float."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def _finite(value: float, name: str, where: str) -> float:
    if not math.isfinite(value):
        raise BadDataError(f"{where}: {name} of a channel is not finite.")
    return value


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}…"
