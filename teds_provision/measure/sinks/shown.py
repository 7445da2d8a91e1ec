"""Text and JSON lines in display units: ``--unit shown``. The recorders of SI units, with a conversion in front."""

from __future__ import annotations

from teds_provision.measure.blocks import ChannelFacts, StationFacts
from teds_provision.measure.display_units import FileUnits, UnitConversion
from teds_provision.measure.sinks.base import Item
from teds_provision.measure.sinks.files import FileSink
from teds_provision.measure.sinks.json_lines import JsonLinesSink
from teds_provision.measure.sinks.text import TextSink
from teds_provision.measure.sinks.wide import WideSink

SHOWN = "shown:"
"""Prefix of the path of such a file in a sink's string, before that of a wide one."""


class _InDisplayUnits(FileSink):
    """Converts what a recorder gets, on its thread."""

    units: FileUnits = "shown"

    def _prepare(self, facts: tuple[ChannelFacts, ...], station: StationFacts) -> None:
        self._conversion = UnitConversion()
        super()._prepare(self._conversion.facts(facts), station)

    def _process_item(self, item: Item) -> None:
        super()._process_item(self._conversion.convert(item))  # type: ignore[safe-super]  # the recorder behind it


class ShownTextSink(_InDisplayUnits, TextSink):
    """Recorder of text in display units."""


class ShownWideSink(_InDisplayUnits, WideSink):
    """Recorder of rows in display units."""


class ShownJsonLinesSink(_InDisplayUnits, JsonLinesSink):
    """Recorder of JSON lines in display units."""
