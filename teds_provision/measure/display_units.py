"""Values of a recording in display units in place of SI, and the way back.

In a file of ``--unit shown`` each channel with another display unit states ``si_unit`` and the way there: SI =
number × ``si_factor`` + ``si_offset``. Whatever reads such a file has SI again.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Final, Literal, TypeVar

import numpy as np

from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows
from teds_provision.teds.units import WrittenUnit, display_unit

FileUnits = Literal["si", "shown"]
FILE_UNITS: Final[tuple[FileUnits, ...]] = ("si", "shown")
_SI: Final = (1.0, 0.0)
Entry = TypeVar("Entry")


def in_display_units(facts: ChannelFacts) -> ChannelFacts:
    """Return the facts of a channel whose values are in its display unit; unchanged if that is the SI unit."""
    if facts.units is None or facts.si_unit:
        return facts
    unit = display_unit(facts.units, facts.shown_unit)
    if (unit.scale, unit.offset) == _SI:
        return facts
    return replace(
        _converted(facts, unit, back=False),
        unit=unit.text,
        si_unit=facts.unit,
        si_factor=unit.scale,
        si_offset=unit.offset,
    )


def in_si_units(facts: ChannelFacts) -> ChannelFacts:
    """Return the facts of a channel in SI units again."""
    way = way_to_si(facts)
    if facts.units is None or way == _SI:
        return facts
    unit = WrittenUnit(facts.unit, facts.units, *way)
    return replace(_converted(facts, unit, back=True), unit=facts.si_unit, si_unit="", si_factor=None, si_offset=None)


def way_to_si(facts: ChannelFacts) -> tuple[float, float]:
    """Return factor and offset from a channel's values to SI units; (1, 0) if they are in SI."""
    if not facts.si_unit or not facts.si_factor:
        return _SI
    return facts.si_factor, facts.si_offset or 0.0


def _converted(facts: ChannelFacts, unit: WrittenUnit, *, back: bool) -> ChannelFacts:
    value = unit.to_si if back else unit.from_si
    difference = unit.difference_to_si if back else unit.difference_from_si
    return replace(
        facts,
        low=None if facts.low is None else value(facts.low),
        high=None if facts.high is None else value(facts.high),
        uncertainty=None if facts.uncertainty is None else difference(facts.uncertainty),
        deviation=None if facts.deviation is None else difference(facts.deviation),
    )


class UnitConversion:
    """Converts facts and values of channels into display units or, with ``back``, into SI units."""

    def __init__(self, *, back: bool = False) -> None:
        self._back = back
        self._ways: dict[tuple[str, int], tuple[float, float]] = {}

    def facts(self, facts: Iterable[ChannelFacts]) -> tuple[ChannelFacts, ...]:
        """Return the converted facts; values of these channels are converted from now on."""
        known = tuple(facts)
        made = tuple((in_si_units if self._back else in_display_units)(channel_facts) for channel_facts in known)
        for stated, key in zip(
            known if self._back else made, (channel_facts.key for channel_facts in known), strict=True
        ):
            self._ways[key] = way_to_si(stated)
        return made

    def convert(self, entry: Entry) -> Entry:
        """Return an entry with converted facts or values; any other one unchanged."""
        if isinstance(entry, tuple):
            return self.facts(entry)  # type: ignore[return-value]
        if not isinstance(entry, Block | GroupRows):
            return entry
        ways = [self._ways.get(key, _SI) for key in entry.keys]
        if all(way == _SI for way in ways):
            return entry
        factor, offset = np.array([way[0] for way in ways]), np.array([way[1] for way in ways])
        value = entry.value * factor + offset if self._back else (entry.value - offset) / factor
        return replace(entry, value=value)
