"""Summary of a recording: channels, time span, counts, invalid and lost values."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows, NodeReport, Note
from teds_provision.measure.recordings.source import MOST, Entry, Recording
from teds_provision.measure.sinks.json_events import facts_as_json, iso

NOTES = 100
_COUNTED = ("samples", "lost", "late", "bad", "invalid")


@dataclass
class ChannelStatistics:
    """Statistics of a channel; times are unix seconds."""

    samples: int = 0
    invalid: int = 0
    first: float = math.inf
    last: float = -math.inf
    low: float = math.inf
    high: float = -math.inf

    def saw(self, times: Any, values: Any) -> None:
        """Count values (NaN if not valid) at these times."""
        good = values[np.isfinite(values)]
        self.samples += len(values)
        self.invalid += len(values) - len(good)
        self.first, self.last = min(self.first, float(times.min())), max(self.last, float(times.max()))
        if len(good):
            self.low, self.high = min(self.low, float(good.min())), max(self.high, float(good.max()))


@dataclass
class RecordingSummary:
    """Counts entries as they pass. ``missing`` samples are gaps of the sample number within a run of a stream.

    A measurement's counts go on from part to part. Reports about a node with samples before its first sample in this
    file belong to the parts before.
    """

    channels: dict[tuple[str, int], ChannelStatistics] = field(default_factory=dict)
    facts: dict[tuple[str, int], ChannelFacts] = field(default_factory=dict)
    reports: dict[str, NodeReport] = field(default_factory=dict)
    notes: list[Note] = field(default_factory=list)
    messages: int = 0
    missing: int = 0
    _begun: set[str] = field(default_factory=set)  # nodes with samples in this file
    _before: dict[str, NodeReport] = field(default_factory=dict)
    _next: dict[tuple[str, int, tuple[int, ...]], int] = field(default_factory=dict)

    def add_entry(self, entry: Entry) -> None:
        """Count one entry of the recording."""
        if isinstance(entry, Block):
            self._block(entry)
        elif isinstance(entry, GroupRows):
            self.messages += len(entry.time)
            self._begun |= {uuid for uuid, _ in entry.channels}
            for column, key in enumerate(entry.channels):
                self._seen_of(key).saw(entry.time, entry.value[:, column])
        elif isinstance(entry, NodeReport):
            if len(self.reports) < MOST.channels:
                self.reports[entry.uuid] = entry
                if entry.samples and entry.uuid not in self._begun:
                    self._before[entry.uuid] = entry
        elif isinstance(entry, Note):
            self.notes = [*self.notes, entry][:NOTES]
        else:
            self.facts.update((facts.key, facts) for facts in entry if len(self.facts) < MOST.channels)

    def _seen_of(self, key: tuple[str, int]) -> ChannelStatistics:
        return self.channels.setdefault(key, ChannelStatistics())

    def _block(self, block: Block) -> None:
        if not len(block.time):
            return
        self.messages += len(block.time)
        self._begun.add(block.uuid)
        stream = block.uuid, block.stream, block.channels
        due = self._next.get(stream, block.index)
        if block.index > due:
            self.missing += block.index - due
        self._next[stream] = block.index + len(block.time)
        for column, number in enumerate(block.channels):
            self._seen_of((block.uuid, number)).saw(block.time, block.value[:, column])

    def to_json(self, recording: Recording) -> dict[str, Any]:
        """Return the result of ``record info``; ``lost`` counts messages of nodes in this file.

        It comes from the recorder's reports, null without one; times are ISO 8601.
        """
        seen = self.channels.values()
        reports = [self._of_this_file(report) for report in self.reports.values()]
        lost = sum(node.lost for node in reports) if reports else None
        first = min((statistics.first for statistics in seen), default=math.inf)
        last = max((statistics.last for statistics in seen), default=-math.inf)
        return {
            "file": str(recording.path),
            "format": recording.form,
            "station": recording.station.name,
            "group": recording.station.group,
            "started": iso(recording.station.started) if recording.station.started else None,
            "test_pattern": recording.station.test_pattern,
            "complete": recording.complete and not recording.torn,
            "being_written": recording.being_written,
            "torn": recording.torn,
            "from": iso(first) if math.isfinite(first) else None,
            "until": iso(last) if math.isfinite(last) else None,
            "messages": self.messages,
            "samples": sum(statistics.samples for statistics in seen),
            "invalid": sum(statistics.invalid for statistics in seen),
            "lost": lost,
            "missing": self.missing,
            "channels": [self._channel(key, recording) for key in sorted({*recording.facts, *self.channels})],
            "nodes": [
                {"uuid": node.uuid, "state": node.state, "why": node.why, "samples": node.samples, "lost": node.lost,
                 "late": node.late, "bad": node.bad, "invalid": node.invalid}
                for node in reports
            ],
            "notes": [{"time": iso(note.at), "why": note.text} for note in self.notes],
        }  # fmt: skip

    def _of_this_file(self, last: NodeReport) -> NodeReport:
        """Return the counts of a node since this file began."""
        before = self._before.get(last.uuid)
        if before is None:
            return last
        counts = {name: max(0, getattr(last, name) - getattr(before, name)) for name in _COUNTED}
        return replace(last, **counts)

    def _channel(self, key: tuple[str, int], recording: Recording) -> dict[str, Any]:
        facts = self.facts.get(key) or recording.facts.get(key) or ChannelFacts(key[0], "", key[1], "")
        seen = self.channels.get(key, ChannelStatistics())
        return {
            "channel": facts.number,
            **{name: value for name, value in facts_as_json(facts).items() if name != "number"},
            "from": iso(seen.first) if seen.samples else None,
            "until": iso(seen.last) if seen.samples else None,
            "samples": seen.samples,
            "invalid": seen.invalid,
            "lowest": seen.low if math.isfinite(seen.low) else None,
            "highest": seen.high if math.isfinite(seen.high) else None,
        }
