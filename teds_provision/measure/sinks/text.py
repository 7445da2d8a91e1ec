"""Text and CSV: a header for readers, then a row for each instant of a stream.

The header is lines that begin with ``#``; each channel's facts are one JSON object. Columns: ``time`` (unix seconds),
``uuid``, ``index`` (sample number in the run of the stream), ``clock_error`` (seconds, empty if no bound is known),
``note`` (``test pattern``, else empty), the value of each channel in its SI unit (empty if it is not valid), and the
raw value of each. Cells of channels that another node or stream measures are empty. A ``.csv`` has commas, a ``.txt``
tabs. Channels that come later, or another datasheet, begin a new part: each file is complete in itself.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any, Final

from teds_provision.measure.blocks import Block, ChannelFacts, NodeReport, why_invalid
from teds_provision.measure.display_units import FileUnits
from teds_provision.measure.sinks.base import Item
from teds_provision.measure.sinks.files import FileSink
from teds_provision.measure.sinks.json_events import facts_as_json, iso
from teds_provision.sanitize import printable

_UNITS: Final = {"si": "SI", "shown": "as shown to people; each channel states the way to SI"}
FORMULA = ("=", "+", "-", "@")  # a spreadsheet would evaluate a cell that begins with one of these


class TextSink(FileSink):
    """Recorder of text; see the module."""

    layout = "text 1"
    units: FileUnits = "si"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._comma = "," if path.suffix.lower() == ".csv" else "\t"
        self._columns: dict[tuple[str, int], int] = {}
        self._headed = False  # True if this part has its head
        self._states: dict[str, str] = {}
        """State of each unmeasured node in this part: repeated tries get no line each."""
        self._templates: dict[tuple[str, tuple[int, ...], bool, str], tuple[str, list[int]]] = {}
        self._not_a_number = re.compile(f"(?<={self._comma})nan(?=[{self._comma}\n])")

    def _process_item(self, item: Item) -> None:
        if isinstance(item, Block):
            self._block(item)
        elif isinstance(item, tuple):
            if self._learn(item) and self._columns:
                self._new_part()
        elif isinstance(item, NodeReport):
            if item.state == "running":
                self._states.pop(item.uuid, None)
            elif self._columns:
                self._state(item)

    def _state(self, item: NodeReport) -> None:
        why = f"; {printable(item.why)}" if item.why else ""
        text = f"{item.state}: {counted(item)}{why}"
        without_when = text.rpartition("; again in ")[0] or text
        if self._states.get(item.uuid) != without_when:
            self._states[item.uuid] = without_when
            self._line(f"# {iso(item.time)} {item.uuid} {text}")

    def _begin(self) -> None:
        self._headed = False
        if self.facts:
            self._header()

    def _write_counts(self, report: NodeReport) -> None:
        if self._headed:
            self._state(report)

    def _close_part(self) -> None:
        """Add the reason to a file without a value, and the counts of its nodes to each."""
        if self._part is not None:
            if not self._headed:
                self._header()
            for report in self.reports.values():
                self._state(report)
        super()._close_part()

    def _line(self, text: str) -> None:
        octets = (text + "\n").encode()
        self.part.add(octets)
        self._count(octets=len(octets))

    def _note(self, at: float, text: str) -> None:
        if self._columns:
            self._line(f"# {iso(at)} {printable(text)}")

    def _header(self) -> None:
        known = [self.facts[key] for key in sorted(self.facts)]
        self._columns = {facts.key: place for place, facts in enumerate(known)}
        self._templates = {}
        heads = heads_of(known)
        columns = ["time", "uuid", "index", "clock_error", "note", *heads, *(f"{name} raw" for name in names_of(known))]
        self._preamble(known, columns)

    def _preamble(self, known: Sequence[ChannelFacts], columns: Sequence[str]) -> None:
        self._states, self._headed = {}, True
        station = self.station
        clock = printable(station.clock)
        self._line(f"# teds-provision measurement, {self.layout}; times are unix seconds, clock: {clock}")
        self._line(f"# station: {printable(station.name)}; group: {printable(station.group) or 'none'}")
        self._line(f"# started: {iso(station.started)}; part {len(self.files)}")
        self._line(f"# units: {_UNITS[self.units]}")
        if station.test_pattern:
            self._line("# TEST PATTERN: no line of this file is a measurement")
        for facts in known:
            self._line("# channel: " + json.dumps(facts_as_json(facts)))
        self._line(self._comma.join(map(self._cell, columns)))

    def _cell(self, text: str) -> str:
        """Return a name from a datasheet as a cell: quoted if needed, never a formula of a spreadsheet.

        A # outside quotes would begin a comment for readers that skip the lines above (pandas).
        """
        text = printable(text)
        if text.startswith(FORMULA):
            text = "'" + text
        if self._comma in text or '"' in text or "#" in text:
            return '"' + text.replace('"', '""') + '"'
        return text

    def _block(self, block: Block) -> None:
        keys = [(block.uuid, number) for number in block.channels]
        strangers = [key for key in keys if key not in self.facts]
        self.facts.update({key: ChannelFacts(key[0], "", key[1], "") for key in strangers})
        if strangers and self._columns:
            self._new_part()
        if not self._columns:
            self._header()
        text = self._rows(block)
        octets = text.encode()
        self._count(written=block.value.size, octets=len(octets), messages=len(block.time))
        self.part.add(octets, block.value.size)

    def _rows(self, block: Block) -> str:
        raw, values, kind = _raw_values(block), block.value.tolist(), block.raw.dtype.kind
        template, order = self._template(block, kind)
        if order:
            raw, values = ([[row[place] for place in order] for row in rows] for rows in (raw, values))
        error = math.nan if block.clock_error is None else block.clock_error
        text = "".join(
            [
                template % (instant, index, error, *row, *raws)
                for index, instant, row, raws in zip(count(block.index), block.time.tolist(), values, raw, strict=False)
            ]
        )
        return self._not_a_number.sub("", text) if "nan" in text else text

    def _template(self, block: Block, kind: str) -> tuple[str, list[int]]:
        """Return formats of a row, and the order of the block's columns in it if that differs."""
        key = (block.uuid, block.channels, block.test_pattern, kind)
        if key not in self._templates:
            form = {"f": "%.17g", "O": "%s"}.get(kind, "%d")
            order = sorted(range(len(block.channels)), key=block.channels.__getitem__)
            self._templates[key] = self._row(block, form), order if order != sorted(order) else []
        return self._templates[key]

    def _row(self, block: Block, raw: str) -> str:
        """Return a row of formats in the columns' order, which is by channel number."""
        width = len(self._columns)
        cells = [""] * (2 * width)
        for number in block.channels:
            place = self._columns[block.uuid, number]
            cells[place], cells[width + place] = "%.12g", raw
        note = "test pattern" if block.test_pattern else note_of([self.facts[block.uuid, n] for n in block.channels])
        return self._comma.join(["%.6f", block.uuid, "%d", "%.3g", note, *cells]) + "\n"


def note_of(facts: Sequence[ChannelFacts]) -> str:
    """Return the note beside unproven values, "" for others."""
    if any(channel_facts.unverified for channel_facts in facts):
        return "unverified datasheet"
    return "unsigned datasheet" if any(channel_facts.unsigned for channel_facts in facts) else ""


def counted(report: NodeReport) -> str:
    """Return the counts of a node's values for the lines at the file's end."""
    text = (
        f"{report.samples} values, lost {report.lost}, late {report.late}, bad {report.bad}, invalid {report.invalid}"
    )
    return f"{text} ({printable(why_invalid(report.invalid_why))})" if report.invalid_why else text


def _raw_values(block: Block) -> list[list[Any]]:
    rows: list[list[Any]] = block.raw.tolist()
    if block.raw.dtype.kind == "O":  # integers of more than 64 bits, or octet strings
        return [[cell.hex() if isinstance(cell, bytes) else cell for cell in row] for row in rows]
    return rows


def names_of(known: Sequence[ChannelFacts]) -> list[str]:
    """Return ``NODE/CHANNEL`` of each channel; equal names get their UUID and number appended."""
    names = [f"{facts.node or facts.uuid}/{facts.label}" for facts in known]
    count = Counter(names)
    return [
        name if count[name] == 1 else f"{name} {facts.uuid}:{facts.number}"
        for name, facts in zip(names, known, strict=True)
    ]


def heads_of(known: Sequence[ChannelFacts]) -> list[str]:
    """Return columns of values: the name of each channel, and its unit if it has one."""
    return [
        f"{name} [{facts.unit}]" if facts.unit else name for name, facts in zip(names_of(known), known, strict=True)
    ]
