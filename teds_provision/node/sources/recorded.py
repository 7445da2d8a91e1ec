"""``file:CSV``: a file played back by the node's clock; after its last row all values are invalid.

The first line names the columns: ``t`` (or ``time``, seconds; the first row is the node's start), then a channel's name
for values in its unit, or ``raw:NAME`` for raw numbers. An empty field is an invalid value. Lines that begin with ``#``
are comments. A value holds until the next row.
"""

from __future__ import annotations

import bisect
import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from teds_provision.errors import BadDataError, UsageError
from teds_provision.files import read_text
from teds_provision.node.sources.base import GeneratedSource, Notify, Reading, SourceChannel

MOST_OCTETS: Final = 256 << 20
_TIME_NAMES: Final = ("t", "time")
_RAW: Final = "raw:"


class RecordedSource(GeneratedSource):
    """Rows of readings: ``times`` ascend from 0, ``rows`` have one entry for each of ``columns`` (channel numbers)."""

    def __init__(
        self,
        places: Sequence[SourceChannel],
        times: list[float],
        columns: dict[int, list[Reading | None]],
        notify: Notify,
    ) -> None:
        super().__init__(places)
        self._times, self._columns, self._notify = times, columns, notify
        # The last row is valid for as long as the one before it.
        self._end = times[-1] + (times[-1] - times[-2] if len(times) > 1 else 0.0)
        self._told = False

    def at(self, channel: int, seconds: float) -> Reading | None:
        """Return the last row that is not newer; None behind the end."""
        column = self._columns.get(channel)
        if seconds > self._end:
            if not self._told:
                self._told = True
                self._notify("The file of values has ended: from now on all values are invalid.")
            return None
        if column is None:
            return None
        return column[max(0, bisect.bisect_right(self._times, seconds) - 1)]


def make(argument: str, places: Sequence[SourceChannel], notify: Notify) -> RecordedSource:
    """Make the source of ``file:run.csv``; raises NotFoundError, and BadDataError with the line that is wrong."""
    if not argument:
        raise UsageError("file: needs a file.", hint="Write --source file:run.csv.")
    return read(Path(argument), places, notify)


def read(path: Path, places: Sequence[SourceChannel], notify: Notify) -> RecordedSource:
    """Read a file of at most 256 MiB whole."""
    lines = _lines(path)
    fields = _fields(path, lines)
    header = [name.strip() for name in fields[0]]
    columns = _columns(path, header, places)
    at = next(index for index, name in enumerate(header) if name.lower() in _TIME_NAMES)
    times: list[float] = []
    readings: dict[int, list[Reading | None]] = {number: [] for number, _, _ in columns}
    for line, row in _rows(path, lines, fields):
        times.append(_time(path, line, row[at], times))
        for number, index, raw in columns:
            readings[number].append(_reading(_number(path, line, row[index]), raw=raw))
    return RecordedSource(places, [time - times[0] for time in times], readings, notify)


def _fields(path: Path, lines: list[tuple[int, str]]) -> list[list[str]]:
    """Return the fields of each line; raises BadDataError for a field that is too long or ends in another line."""
    try:
        fields = list(csv.reader(line for _, line in lines))
    except csv.Error as error:
        raise BadDataError(f"{path} is not CSV: {error}.") from error
    if len(fields) != len(lines):
        raise BadDataError(f"{path} is not CSV: a quotation mark is not closed in its line.")
    return fields


def _rows(path: Path, lines: list[tuple[int, str]], fields: list[list[str]]) -> Iterator[tuple[int, list[str]]]:
    """Yield each row with its line number; raises BadDataError unless it has as many fields as the first line."""
    for (line, _), row in zip(lines[1:], fields[1:], strict=True):
        if len(row) != len(fields[0]):
            raise BadDataError(f"{path}, line {line}: {len(row)} fields, the first line names {len(fields[0])}.")
        yield line, row


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return numbered lines without comments and empty ones: the first line and at least one row."""
    text = read_text(path, MOST_OCTETS, "file of values")
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip() and line[0] != "#"]
    if len(lines) < 2:
        raise BadDataError(
            f"{path} has no rows of values.", hint="First line: t,NAME,NAME …; then a row for each instant."
        )
    return lines


def _time(path: Path, line: int, text: str, before: list[float]) -> float:
    time = _number(path, line, text)
    if time is None or (before and time < before[-1]):
        raise BadDataError(f"{path}, line {line}: times must be ascending numbers.")
    return time


def _reading(number: float | None, *, raw: bool) -> Reading | None:
    if number is None:
        return None
    return Reading(raw=number) if raw else Reading(value=number)


def _columns(path: Path, header: list[str], places: Sequence[SourceChannel]) -> list[tuple[int, int, bool]]:
    """Return (channel, column, raw) of each column that names a channel."""
    numbers = {place.name: place.number for place in places if place.name}
    found: list[tuple[int, int, bool]] = []
    if not any(name.lower() in _TIME_NAMES for name in header):
        raise BadDataError(f"{path}: there is no column t.", hint="First line: t,NAME,NAME …")
    for index, name in enumerate(header):
        raw = name.startswith(_RAW)
        number = numbers.get(name.removeprefix(_RAW))
        if number is not None:
            if any(number == other for other, _, _ in found):
                raise BadDataError(f"{path}: two columns are for the channel {name.removeprefix(_RAW)}.")
            found.append((number, index, raw))
        elif name.lower() not in _TIME_NAMES:
            raise BadDataError(f"{path}: the node has no sensor named {name!r}.", hint=f"It has: {', '.join(numbers)}.")
    return found


def _number(path: Path, line: int, text: str) -> float | None:
    text = text.strip()
    if not text:
        return None
    try:
        number = float(text)
    except ValueError:
        raise BadDataError(f"{path}, line {line}: {text[:40]!r} is not a number.") from None
    return number if math.isfinite(number) else None
