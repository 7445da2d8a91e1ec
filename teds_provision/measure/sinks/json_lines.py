"""JSON lines: the first describes the station, then the events of ``measure --json``, one line each."""

from __future__ import annotations

from teds_provision.measure.blocks import Block, NodeReport
from teds_provision.measure.display_units import FileUnits
from teds_provision.measure.sinks.base import Item
from teds_provision.measure.sinks.files import FileSink
from teds_provision.measure.sinks.json_events import as_line, data_lines, facts_as_json, iso, status_line


class JsonLinesSink(FileSink):
    """Recorder of JSON lines; see the module."""

    units: FileUnits = "si"

    def _begin(self) -> None:
        station = self.station
        head = {
            "event": "recording",
            "format": "teds-provision/measurement-1",
            "station": station.name,
            "group": station.group,
            "started": iso(station.started),
            "clock": station.clock,
            "test_pattern": station.test_pattern,
            "units": self.units,
        }
        self._add(as_line(head))
        self._channels(tuple(self.facts.values()))

    def _channels(self, item: Item) -> None:
        if isinstance(item, tuple):
            for facts in item:
                self.facts[facts.key] = facts
                self._add(as_line({"event": "channel", **facts_as_json(facts)}))

    def _process_item(self, item: Item) -> None:
        if isinstance(item, Block):
            self._count(written=item.value.size, messages=len(item.channels))
            self._add(b"".join(as_line(line) for line in data_lines(item, self.facts)), item.value.size)
        elif isinstance(item, NodeReport):
            self._add(as_line(status_line(item)))
        else:
            self._channels(item)

    def _note(self, at: float, text: str) -> None:
        self._add(as_line({"event": "note", "time": at, "why": text}))

    def _add(self, lines: bytes, values: int = 0) -> None:
        self._count(octets=len(lines))
        self.part.add(lines, values)
