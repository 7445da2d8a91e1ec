"""Text and CSV: a header that says what a reader needs, then a row for each instant of a stream.

The header is lines that begin with ``#``; each channel's facts are one JSON object. Columns: ``time`` (unix seconds),
``uuid``, ``index`` (sample number in the run of the stream), ``clock_error`` (seconds, empty where no bound is known),
``note`` (``test pattern``, else empty), the value of each channel in its SI unit (empty where it is not valid), and the
raw value of each. Cells of channels that another node or stream measures are empty. A ``.csv`` has commas, a ``.txt``
tabs. Channels that come later, or another datasheet, begin a new part: each file is complete in itself.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from teds_provision.harmless import printable
from teds_provision.measure.blocks import Block, ChannelFacts, NodeReport
from teds_provision.measure.sinks.base import Item
from teds_provision.measure.sinks.files import FileSink
from teds_provision.measure.sinks.lines import facts_as_json, iso

EXACT = 2.0**53  # the integers below it are floats without loss
FORMULA = ("=", "+", "-", "@")  # a cell that begins so would be computed by a spreadsheet


class TextSink(FileSink):
    """Recorder of text; see the module."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._comma = "," if path.suffix.lower() == ".csv" else "\t"
        self._columns: dict[tuple[str, int], int] = {}
        self._templates: dict[tuple[str, tuple[int, ...], bool], str] = {}
        self._not_a_number = re.compile(f"(?<={self._comma})nan(?=[{self._comma}\n])")

    def _take(self, item: Item) -> None:
        if isinstance(item, Block):
            self._block(item)
        elif isinstance(item, tuple):
            if self._news(item) and self._columns:
                self._new_part()
        elif isinstance(item, NodeReport) and item.state != "running" and self._columns:
            self._line(f"# {iso(item.time)} {item.uuid} {item.state}: {printable(item.why)}")

    def _begin(self) -> None:
        if self.facts:
            self._header()

    def _line(self, text: str) -> None:
        octets = (text + "\n").encode()
        self.part.add(octets)
        self._count(octets=len(octets))

    def _header(self) -> None:
        known = [self.facts[key] for key in sorted(self.facts)]
        self._columns = {one.key: place for place, one in enumerate(known)}
        self._templates = {}
        station = self.station
        self._line(f"# teds-provision measurement, text 1; times are unix seconds, clock: {station.clock}")
        self._line(f"# station: {printable(station.name)}; group: {printable(station.group) or 'none'}")
        self._line(f"# started: {iso(station.started)}; part {len(self.files)}")
        if station.test_pattern:
            self._line("# TEST PATTERN: no line of this file is a measurement")
        for one in known:
            self._line("# channel: " + json.dumps(facts_as_json(one)))
        self._line(self._comma.join(map(self._cell, _heads(known))))

    def _cell(self, text: str) -> str:
        """A name from a datasheet as a cell: quoted where needed, never a formula of a spreadsheet."""
        text = printable(text)
        if text.startswith(FORMULA):
            text = "'" + text
        if self._comma in text or '"' in text:
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
        self.part.add(octets)
        self._count(written=block.value.size, octets=len(octets), messages=len(block.time))

    def _rows(self, block: Block) -> str:
        n, c = block.value.shape
        raw, integral = block.raw, block.raw.dtype.kind in "uib"
        if raw.dtype.kind == "O" or (integral and raw.size and np.abs(raw.astype(np.float64)).max() >= EXACT):
            return self._slow_rows(block)
        template = self._template(block, integral)
        cells = np.empty((n, 3 + 2 * c))
        cells[:, 0] = block.time
        cells[:, 1] = np.arange(block.index, block.index + n)
        cells[:, 2] = np.nan if block.clock_error is None else block.clock_error
        order = _order(block)
        cells[:, 3 : 3 + c] = np.where(block.valid, block.value, np.nan)[:, order]
        cells[:, 3 + c :] = raw[:, order]
        text = (template * n) % tuple(cells.ravel().tolist())
        return self._not_a_number.sub("", text) if np.isnan(cells).any() else text

    def _template(self, block: Block, integral: bool) -> str:
        key = (f"{block.uuid}{block.test_pattern:d}", block.channels, integral)
        if key not in self._templates:
            self._templates[key] = self._row(block, "%.6f", "%d", "%.3g", "%.12g", "%d" if integral else "%.17g")
        return self._templates[key]

    def _row(self, block: Block, time: str, index: str, error: str, value: str, raw: str) -> str:
        """A row of formats in the columns' order, which is that of _order()."""
        width = len(self._columns)
        cells = [""] * (2 * width)
        for number in block.channels:
            place = self._columns[block.uuid, number]
            cells[place], cells[width + place] = value, raw
        unsigned = any(self.facts[block.uuid, number].unsigned for number in block.channels)
        note = "test pattern" if block.test_pattern else "unsigned datasheet" if unsigned else ""
        return self._comma.join([time, block.uuid, index, error, note, *cells]) + "\n"

    def _slow_rows(self, block: Block) -> str:
        """Raw values beyond 53 bits, or octet strings: cell by cell."""
        template = self._row(block, "%.6f", "%d", "%s", "%s", "%s")
        error = "" if block.clock_error is None else f"{block.clock_error:.3g}"
        rows, order = [], _order(block)
        value, valid, raw = block.value[:, order], block.valid[:, order], block.raw[:, order]
        for k, instant in enumerate(block.time.tolist()):
            values = [
                f"{value:.12g}" if good else ""
                for value, good in zip(value[k].tolist(), valid[k].tolist(), strict=True)
            ]
            raws = [one.hex() if isinstance(one, bytes) else str(one) for one in raw[k].tolist()]
            rows.append(template % (instant, block.index + k, error, *values, *raws))
        return "".join(rows)


def _heads(known: Sequence[ChannelFacts]) -> list[str]:
    names = [f"{one.node or one.uuid}/{one.label}" for one in known]
    values = [f"{name} [{one.unit}]" if one.unit else name for name, one in zip(names, known, strict=True)]
    return ["time", "uuid", "index", "clock_error", "note", *values, *(f"{name} raw" for name in names)]


def _order(block: Block) -> list[int]:
    """Columns of a block in the order of the file's: by channel number."""
    return sorted(range(len(block.channels)), key=block.channels.__getitem__)
