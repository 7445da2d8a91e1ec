"""Wide CSV: one grid of times for all channels, one row a time, a column for each channel with its unit in the name.

For spreadsheets and data frames. A cell holds the last value that is not newer than the row and not older than two
periods of its channel (``grid.py``); it is empty if there is none. Raw values, sample numbers and the bounds of the
clock do not fit a grid: they are in the other formats. The header is that of ``text.py``.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows
from teds_provision.measure.sinks.base import Item
from teds_provision.measure.sinks.json_events import iso
from teds_provision.measure.sinks.text import TextSink, heads_of
from teds_provision.sanitize import printable

WIDE = "wide:"
"""Prefix of the path of such a file in a sink's string."""


class WideSink(TextSink):
    """Recorder of rows; see the module."""

    wants_rows = True
    layout = "text 1, wide"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._form = ""
        self._changed = False
        self._unwritten: list[tuple[float, str]] = []  # notes that wait until their part has a head
        self._nan = re.compile(f"(?<=[{self._comma}])nan(?=[{self._comma}\n])")

    def _process_item(self, item: Item) -> None:
        if isinstance(item, GroupRows):
            self._rows_of(item)
        elif isinstance(item, tuple):
            if self._learn(item):  # the columns or the datasheet changed: the next rows begin another part
                self._changed = bool(self._columns)
        elif not isinstance(item, Block):
            super()._process_item(item)

    def _begin(self) -> None:
        """Begin with the first row, which determines the channels."""
        self._columns, self._changed, self._headed = {}, False, False

    def _header(self) -> None:
        """Write the header of a part without a row."""
        self._head_of([self.facts[key] for key in sorted(self.facts)])

    def _head_of(self, known: list[ChannelFacts]) -> None:
        self._preamble(known, ["time", *heads_of(known)])
        # rows lag behind, so reports in the first part would count samples of rows that are still to come
        if len(self.files) > 1:
            for report in self.reports.values():
                self._state(report)
        notes, self._unwritten = self._unwritten, []
        for at, text in notes:
            self._line(f"# {iso(at)} {printable(text)}")

    def _note(self, at: float, text: str) -> None:
        if self._columns:
            super()._note(at, text)
        else:
            self._unwritten.append((at, text))

    def _rows_of(self, rows: GroupRows) -> None:
        if not rows.channels:
            return
        if self._columns and (self._changed or tuple(self._columns) != rows.channels):
            self._new_part()
        if not self._columns:
            self._columns = {key: place for place, key in enumerate(rows.channels)}
            known = [self.facts.get(key) or ChannelFacts(key[0], "", key[1], "") for key in rows.channels]
            self._head_of(known)
            self._form = self._comma.join(["%.6f", *["%.12g"] * len(known)]) + "\n"
        table = np.column_stack([rows.time, rows.value]).tolist()
        text = "".join([self._form % tuple(row) for row in table])
        octets = (self._nan.sub("", text) if "nan" in text else text).encode()
        self._count(written=rows.value.size, octets=len(octets), messages=len(rows.time))
        self.part.add(octets, rows.value.size)
