"""A part of what a recording holds: some channels, the first instants."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from teds_provision.measure.blocks import Block, GroupRows
from teds_provision.measure.recordings.source import Entry


def first(entry: Entry, channels: Collection[int], most: float) -> Block | GroupRows | None:
    """The first ``most`` instants of these channels (all where empty); None where the entry has none of them."""
    if not isinstance(entry, Block | GroupRows):
        return None
    kept = [column for column, (_, number) in enumerate(entry.keys) if not channels or number in channels]
    if not kept:
        return None
    n = int(min(most, len(entry.time)))
    if isinstance(entry, GroupRows):
        keys = tuple(entry.channels[column] for column in kept)
        return replace(entry, channels=keys, time=entry.time[:n], value=entry.value[:n, kept], age=entry.age[:n, kept])
    return replace(
        entry,
        channels=tuple(entry.channels[column] for column in kept),
        time=entry.time[:n],
        tick=entry.tick[:n],
        raw=entry.raw[:n, kept],
        value=entry.value[:n, kept],
        valid=entry.valid[:n, kept],
    )
