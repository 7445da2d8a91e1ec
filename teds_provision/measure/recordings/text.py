"""Reads text and CSV as ``sinks/text.py`` and ``sinks/wide.py`` write them."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from teds_provision.arrays import NDArray
from teds_provision.errors import BadDataError
from teds_provision.files import open_to_read
from teds_provision.limits import load_json
from teds_provision.measure.blocks import ChannelFacts, GroupRows, NodeReport, Note, State
from teds_provision.measure.recordings.columns import Rows, Streams, integers, raw_kind
from teds_provision.measure.recordings.source import MOST, ROWS, Entry, Recording, facts_of, station_of, unix_of

FIRST: Final = "# teds-provision measurement, text 1"
_PIECE: Final = 1 << 20
_BEFORE: Final = ["time", "uuid", "index", "clock_error", "note"]
_CLOCK: Final = re.compile(r"; times are unix seconds, clock: (.*)$")
_STATION: Final = re.compile(r"# station: (.*); group: (.*)$")
_TIMED: Final = re.compile(r"# (\d{4}-\d\d-\d\dT[0-9:.]+Z|unknown) (.*)$")
_STATE: Final = re.compile(
    r"([0-9a-f]{20}) (waiting|running|lost|refused|ended): (\d{1,18}) values, "
    r"lost (\d{1,18}), late (\d{1,18}), bad (\d{1,18}), invalid (\d{1,18})(.*)$"
)


class TextRecording(Recording):
    """Text or CSV; see the module."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._known: list[ChannelFacts] = []
        self._comma, self._line = ",", 0
        columns = self._read_head()
        self.form = {",": "CSV", "\t": "text"}[self._comma] + (", wide" if self.wide else "")
        expected = 1 + len(self._known) if self.wide else len(_BEFORE) + 2 * len(self._known)
        if columns and (
            len(columns) != expected or columns[: 1 if self.wide else 5] != _BEFORE[: 1 if self.wide else 5]
        ):
            raise self._bad(f"the columns are not those of the {len(self._known)} channels above")
        self._width = expected

    def _bad(self, why: str) -> BadDataError:
        return BadDataError(
            f"{self.path}:{self._line}: {why}.", hint="It was changed after it was recorded, or is damaged."
        )

    def _lines(self) -> Iterator[str]:
        """Yield whole lines without their ends; a part of a line at the end of the file counts as torn."""
        self._line, rest = 0, b""
        with open_to_read(self.path) as file:
            while piece := file.read(_PIECE):
                *whole, rest = (rest + piece).split(b"\n")
                for line in whole:
                    self._line += 1
                    try:
                        yield line.decode()
                    except UnicodeDecodeError:
                        raise self._bad("the line is not UTF-8") from None
                if len(rest) > MOST.line:
                    self._line += 1
                    raise self._bad(f"the line has more than {MOST.line} octets")
        self.torn = len(rest)

    def _read_head(self) -> list[str]:
        words: dict[str, Any] = {}
        for line in self._lines():
            if not line.startswith("#"):
                self._comma = "\t" if line.startswith("time\t") else ","
                self.station = station_of(words)
                try:
                    [cells] = csv.reader([line], delimiter=self._comma)
                except (csv.Error, ValueError):
                    raise self._bad("the line of column names is damaged") from None
                return cells
            if line.startswith(FIRST):
                self.wide = ", wide;" in line
                words["clock"] = "".join(_CLOCK.findall(line))
            elif found := _STATION.match(line):
                words |= {"station": found[1], "group": "" if found[2] == "none" else found[2]}
            elif line.startswith("# started: "):
                words["started"] = line[len("# started: ") :].partition(";")[0]
            elif line.startswith("# TEST PATTERN"):
                words["test_pattern"] = True
            elif line.startswith("# channel: "):
                where = f"{self.path}:{self._line}"
                facts = facts_of(
                    load_json(line[len("# channel: ") :], f"{where}: the channel", octets=MOST.line), where
                )
                self.know(facts)
                self._known.append(facts)
        self.station = station_of(words)
        return []  # the file ends within its head, as after an early kill

    def _stored_entries(self) -> Iterator[Entry]:
        """See the class above."""
        yield tuple(self._known)
        streams, waiting, headed, first = Streams(), list[str](), False, 0  # ``first``: line of the first waiting row
        for line in self._lines():
            if line.startswith("#"):
                if waiting:
                    yield from self._rows(waiting, first, streams)
                    waiting = []
                if entry := self._commented(line):
                    yield entry
            elif headed:
                first = first if waiting else self._line
                waiting.append(line)
                if len(waiting) >= ROWS:
                    yield from self._rows(waiting, first, streams)
                    waiting = []
            else:
                headed = True
        if waiting:
            yield from self._rows(waiting, first, streams)

    def _commented(self, line: str) -> Entry | None:
        timed = _TIMED.match(line)
        if timed is None:
            return None
        state = _STATE.match(timed[2])
        if state is None:
            return Note(unix_of(timed[1]), timed[2][: MOST.text])
        samples, lost, late, bad, invalid = (int(count) for count in state.groups()[2:7])
        named: dict[str, State] = {
            state_name: state_name for state_name in ("waiting", "running", "lost", "refused", "ended")
        }
        why = _reason(state[8][: 4 * MOST.text])[: MOST.text]
        return NodeReport(state[1], named[state[2]], why, samples, lost, late, bad, invalid, time=unix_of(timed[1]))

    def _rows(self, lines: Sequence[str], first: int, streams: Streams) -> Iterator[Entry]:
        """Yield the blocks of rows, the first of which is line ``first`` of the file."""
        table = [line.split(self._comma) for line in lines]
        for place, cells in enumerate(table):
            if len(cells) != self._width:
                self._line = first + place
                raise self._bad(f"the row has {len(cells)} cells in place of {self._width}")
        try:
            if self.wide:
                yield self._grid(table)
                return
            by_node: dict[str, list[list[str]]] = {}
            for cells in table:
                by_node.setdefault(cells[1], []).append(cells)
            for uuid, rows in by_node.items():
                yield from streams.blocks(self._of_node(uuid, rows))
            yield ()
        except (ValueError, OverflowError):
            self._line = first
            why = f"one of the {len(lines)} rows from here on has a cell that is no number, or too large a one"
            raise self._bad(why) from None

    def _grid(self, table: list[list[str]]) -> GroupRows:
        columns = [np.fromiter(map(_number, cells), np.float64, len(table)) for cells in zip(*table, strict=True)]
        value = np.column_stack(columns[1:]) if columns[1:] else np.empty((len(table), 0))
        keys = tuple(facts.key for facts in self._known)
        return GroupRows(self.station.group or "all", keys, columns[0], value, np.full_like(value, np.nan))

    def _of_node(self, uuid: str, table: list[list[str]]) -> Rows:
        columns, count, width = list(zip(*table, strict=True)), len(table), len(self._known)
        at = len(_BEFORE) + width
        places = [k for k, facts in enumerate(self._known) if facts.uuid == uuid and any(columns[at + k])]
        raws = [columns[at + k] for k in places]
        values = [columns[len(_BEFORE) + k] for k in places]
        index = np.array(list(map(int, columns[2])), dtype=np.int64)
        return Rows(
            uuid,
            tuple(self._known[k].number for k in places),
            np.fromiter(map(_number, columns[0]), np.float64, count),
            index,
            np.zeros(count, dtype=np.uint64),
            np.fromiter(map(_number, columns[3]), np.float64, count),
            np.array([note == "test pattern" for note in columns[4]]),
            [np.fromiter(map(_number, value), np.float64, count) for value in values],
            [_raw(column, self._known[k].sample_form) for k, column in zip(places, raws, strict=True)],
            np.array([[bool(cell) for cell in raw] for raw in raws]).T.reshape(count, len(places)),
        )


def _reason(rest: str) -> str:
    """Return the node's reason behind its counts; parentheses before it hold why values are invalid."""
    depth = 0
    for place, sign in enumerate(rest):
        depth += (sign == "(") - (sign == ")")
        if not depth and rest.startswith("; ", place):
            return rest[place + 2 :]
    return ""


def _number(cell: str) -> float:
    return float(cell) if cell else np.nan


def _raw(cells: Sequence[str], form: str) -> NDArray[Any]:
    """Return a column of raw values, exactly; without a form in the datasheet, by their appearance."""
    if raw_kind(form) != "float":
        try:
            return integers([int(cell) if cell else 0 for cell in cells])
        except ValueError:
            pass
    try:
        return np.array([_number(cell) for cell in cells])
    except ValueError:
        octets = np.empty(len(cells), dtype=object)
        octets[:] = [bytes.fromhex(cell) for cell in cells]
        return octets
