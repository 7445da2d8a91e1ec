"""Reads JSON lines as ``sinks/json_lines.py`` writes them; what ``measure --json`` printed is read as well."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, get_args

import numpy as np

from teds_provision.arrays import NDArray
from teds_provision.errors import BadDataError
from teds_provision.files import open_to_read
from teds_provision.measure.blocks import Block, InvalidValues, NodeReport, Note, State
from teds_provision.measure.recordings.columns import BlockJoiner, integers, stacked
from teds_provision.measure.recordings.source import (
    MOST,
    Entry,
    Recording,
    channel_number,
    facts_of,
    number_of,
    station_of,
)

FIRST: Final = b'{"event":'
_PIECE: Final = 1 << 20
_DATA: Final = re.compile(rb'{"event":"data",(?:(?!"index":).)*')
_COUNTS: Final = ("samples", "lost", "late", "bad", "invalid")
_STATES: Final[tuple[State, ...]] = get_args(State)


class JsonLines(Recording):
    """JSON lines; see the module."""

    form = "JSON lines"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._line = 0
        reported: set[bytes] = set()
        for line in self._lines():
            if line.startswith(b'{"event":"channel"'):
                self.know(self._channel(self._event(line)))
            elif (data := _DATA.match(line)) and data[0] not in reported and len(reported) < MOST.channels:
                reported.add(data[0])
                event = self._event(line)
                names = ("uuid", "name", "unit", "uncertainty", "unsigned", "unverified")
                facts = {name: event[name] for name in names if event.get(name) is not None}
                self.know(self._channel({**facts, "number": event.get("channel")}))
            elif line.startswith(b'{"event":"recording"'):
                self.station = station_of(self._event(line))

    def _bad(self, why: str) -> BadDataError:
        return BadDataError(
            f"{self.path}:{self._line}: {why}.", hint="It was changed after it was recorded, or is damaged."
        )

    def _lines(self) -> Iterator[bytes]:
        self._line, rest = 0, b""
        with open_to_read(self.path) as file:
            while piece := file.read(_PIECE):
                *whole, rest = (rest + piece).split(b"\n")
                for line in whole:
                    self._line += 1
                    yield line
                if len(rest) > MOST.line:
                    self._line += 1
                    raise self._bad(f"the line has more than {MOST.line} octets")
        self.torn = len(rest)

    def _event(self, line: bytes) -> dict[str, Any]:
        try:
            event = json.loads(line)
        except (ValueError, RecursionError):
            raise self._bad("the line is not JSON") from None
        if not isinstance(event, dict):
            raise self._bad("the line is not a JSON object")
        return event

    def _channel(self, event: dict[str, Any]) -> Any:
        return facts_of({name: value for name, value in event.items() if name != "event"}, f"{self.path}:{self._line}")

    def _stored_entries(self) -> Iterator[Entry]:
        """See the class above."""
        joined, numbers = BlockJoiner(), dict[str, dict[tuple[int, ...], int]]()
        together: list[dict[str, Any]] = []  # lines of one block: a line for each channel
        for line in self._lines():
            event = self._event(line)
            if together and not _goes_with(together, event):
                yield from joined.add_block(self._block(together, numbers))
                together = []
            if event.get("event") == "data":
                together.append(event)
            elif (entry := self._other(event)) is not None:
                yield from joined.flush()
                yield entry
        if together:
            yield from joined.add_block(self._block(together, numbers))
        yield from joined.flush()

    def _other(self, event: dict[str, Any]) -> Entry | None:
        kind = event.get("event")
        if kind == "channel":
            return (self._channel(event),)
        if kind == "note":
            return Note(number_of(event.get("time")) or 0.0, str(event.get("why"))[: MOST.text])
        if kind == "status":
            return report_of(event)
        return None

    def _block(self, lines: list[dict[str, Any]], numbers: dict[str, dict[tuple[int, ...], int]]) -> Block:
        first = lines[0]
        try:
            uuid, index = str(first["uuid"]), int(first["index"])
            time = np.array(first["time"], dtype=np.float64)
            value = np.column_stack([np.array(line["value"], dtype=np.float64) for line in lines])
            raw = stacked([_raw(line["raw"]) for line in lines])
            error = first.get("clock_error")
            error = None if error is None else float(error)
        except (KeyError, TypeError, ValueError, OverflowError):
            raise self._bad("the values in or above the line are not those of a recording") from None
        if time.ndim != 1 or not value.shape == raw.shape == (len(time), len(lines)) or len(uuid) > MOST.text:
            raise self._bad("the lists in or above the line are not of one length")
        channels = tuple(channel_number(line.get("channel"), f"{self.path}:{self._line}") for line in lines)
        streams = numbers.setdefault(uuid, {})
        stream = streams.setdefault(channels, len(streams))
        valid = np.isfinite(value)
        test = first.get("test_pattern") is True
        ticks = np.zeros(len(time), dtype=np.uint64)
        return Block(uuid, stream, channels, index, time, ticks, raw, value, valid, 0.0, error, test)


def _goes_with(lines: list[dict[str, Any]], event: dict[str, Any]) -> bool:
    """Return True if a line is another channel of the block that began with these lines."""
    first = lines[0]
    return (
        event.get("event") == "data"
        and all(event.get(name) == first.get(name) for name in ("uuid", "index", "time"))
        and all(event.get("channel") != line.get("channel") for line in lines)
    )


def _raw(values: list[Any]) -> NDArray[Any]:
    kinds = {type(value) for value in values}
    if kinds <= {int}:
        return integers(values)
    if kinds <= {int, float, type(None)}:
        return np.array(values, dtype=np.float64)
    found = np.empty(len(values), dtype=object)
    found[:] = [bytes.fromhex(value) if isinstance(value, str) else value for value in values]
    return found


def report_of(words: dict[str, Any]) -> NodeReport | None:
    """Return the state of a node as a recording has it; None if it is malformed."""
    uuid, state = words.get("uuid"), words.get("state")
    if not isinstance(uuid, str) or state not in _STATES or len(uuid) > MOST.text:
        return None
    counts = {name: words.get(name) for name in _COUNTS}
    reasons = words.get("invalid_why")
    why: list[InvalidValues] = []
    for reason in reasons[: MOST.text] if isinstance(reasons, list) else ():
        if isinstance(reason, dict) and isinstance(reason.get("channel"), int) and isinstance(reason.get("count"), int):
            why.append(InvalidValues(reason["channel"], str(reason.get("why"))[: MOST.text], reason["count"]))
    return NodeReport(
        uuid,
        state,
        str(words.get("why") or "")[: MOST.text],
        **{name: value if isinstance(value, int) else 0 for name, value in counts.items()},
        clock_error=number_of(words.get("clock_error")),
        time=number_of(words.get("time")) or 0.0,
        invalid_why=tuple(why),
    )
