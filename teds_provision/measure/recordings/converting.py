"""A recording in another format: read by its reader, written by the recorder of the other format.

The result gets its name when all of it is on the disk: until then it is in a private folder beside it, which the next
conversion to that name removes if a killed one left it. Nothing is overwritten.
"""

from __future__ import annotations

import math
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from teds_provision.errors import UsageError
from teds_provision.files import require_new, sync_folder
from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows
from teds_provision.measure.display_units import FileUnits, UnitConversion
from teds_provision.measure.grid import Grid
from teds_provision.measure.recordings.columns import part_of
from teds_provision.measure.recordings.opening import open_recording
from teds_provision.measure.recordings.parquet import ParquetWriter
from teds_provision.measure.recordings.source import Entry, Recording
from teds_provision.measure.recordings.summary import RecordingSummary
from teds_provision.measure.sinks import FILES, SHOWN_FILES, TEXT, as_sink_failure
from teds_provision.measure.sinks.files import FileSink
from teds_provision.measure.sinks.shown import ShownWideSink
from teds_provision.measure.sinks.wide import WideSink
from teds_provision.portable import CLOSING, NOFOLLOW, OPENS_FOLDERS, is_mine, lock

PARQUET: Final = ".parquet"
_PATIENCE: Final = 5.0  # seconds beyond two periods, after which a silent stream is not waited for
_BURST: Final = 5000  # rows of a grid at a time


@dataclass(frozen=True)
class ConversionResult:
    """Result of a conversion: the files, oldest part first, and what went into them."""

    recording: Recording
    files: tuple[Path, ...]
    summary: RecordingSummary


def convert(source: Path, target: Path, *, wide: bool = False, units: FileUnits = "si") -> ConversionResult:
    """Write a recording in the format of ``target``'s suffix. ``wide``: as rows of one grid (text and Parquet).

    ``units``: values in SI or as they are shown to people; MCAP is always in SI.

    Of a recording that is still being written, or was cut off, what is whole by now is taken. Raises UsageError
    (``target`` exists, no such format), NotFoundError, BadDataError, StoreError (disk).
    """
    suffix = target.suffix.lower()
    if suffix not in FILES and suffix != PARQUET:
        raise UsageError(f"Unsupported format: {target.name!r}.", hint=f"Use {', '.join([*FILES, PARQUET])}.")
    if wide and suffix not in TEXT and suffix != PARQUET:
        raise UsageError("--wide only works with text files and Parquet.", hint="Name a FILE.csv or FILE.parquet.")
    require_new(target)
    recording = open_recording(source)
    if recording.wide and not (suffix in TEXT or suffix == PARQUET):
        raise UsageError(
            f"{source} was written with --wide: it has no raw values and sample numbers, which {suffix} needs.",
            hint="Convert the original recording, or choose .csv or .parquet.",
        )
    wide = wide or recording.wide
    summary = RecordingSummary()
    try:
        with _folder_for(target) as folder:
            entries = _counted(recording, summary)
            if wide and not recording.wide:
                entries = _gridded(entries, recording)
            if suffix == PARQUET:
                made = _as_parquet(folder / target.name, entries, recording, wide=wide, units=units)
            else:
                kinds = SHOWN_FILES if units == "shown" and suffix in SHOWN_FILES else FILES
                rows = ShownWideSink if kinds is SHOWN_FILES else WideSink
                sink = rows(folder / target.name) if wide else kinds[suffix](folder / target.name)
                assert isinstance(sink, FileSink)
                made = sink.copy(entries, tuple(recording.facts.values()), recording.station)
            files = tuple(_published(path, target.parent) for path in made)
            sync_folder(target.parent)
    except OSError as error:
        raise as_sink_failure(error, str(target)) from error
    return ConversionResult(recording, files, summary)


def _as_parquet(
    path: Path, entries: Iterator[Entry], recording: Recording, *, wide: bool, units: FileUnits
) -> list[Path]:
    """Write one file for each set of facts: another datasheet begins a new file, as with CSV."""
    known = dict(recording.facts)
    if units == "shown":
        conversion = UnitConversion()
        known = {facts.key: facts for facts in conversion.facts(known.values())}
        entries = map(conversion.convert, entries)
    made = [path]
    writer = ParquetWriter(path, list(known.values()), recording.station, wide=wide)
    try:
        for entry in entries:
            if isinstance(entry, tuple):
                changed = {facts.key: facts for facts in entry if known.get(facts.key) != facts}
                if changed:
                    known |= changed
                    writer.finish()
                    made.append(path.with_suffix(f".{len(made) + 1}{path.suffix}"))
                    writer = ParquetWriter(made[-1], list(known.values()), recording.station, wide=wide)
            writer.add_entry(entry)
        writer.finish()
    finally:
        writer.close()
    for made_path in made:
        file = os.open(made_path, os.O_RDWR | CLOSING)
        try:
            os.fsync(file)
        finally:
            os.close(file)
    return made


def _counted(recording: Recording, summary: RecordingSummary) -> Iterator[Entry]:
    """Yield the entries, each counted; a channel that no head named is added to the facts."""
    for entry in recording.entries():
        summary.add_entry(entry)
        if isinstance(entry, Block):
            for number in entry.channels:
                if (entry.uuid, number) not in recording.facts:
                    recording.know(ChannelFacts(entry.uuid, "", number, ""))
                    yield (recording.facts[entry.uuid, number],)
        yield entry


def _gridded(entries: Iterator[Entry], recording: Recording) -> Iterator[Entry]:
    """Yield the same as rows of one grid, of every sensor. A row is made when no stream can bring a value before it."""
    facts = [facts for _, facts in sorted(recording.facts.items()) if facts.kind != "actuator"]
    periods = {channel_facts.key: channel_facts.period for channel_facts in facts if channel_facts.period}
    grid = Grid(recording.station.group or "all", facts, patience=0.0)
    waiting, newest = list[Block](), dict[tuple[str, int], tuple[float, float]]()
    for entry in entries:
        if isinstance(entry, Block):
            waiting.append(entry)
            slowest = max((periods.get(key, 0.0) for key in entry.keys), default=0.0)
            newest[entry.uuid, entry.stream] = float(entry.time[-1]), 2 * slowest + _PATIENCE
        elif entry:
            yield entry
        elif newest:
            now = max(time for time, _ in newest.values())
            until = min(time for time, keeps in newest.values() if time >= now - keeps)
            waiting, rows = _rows_until(until, waiting, grid)
            yield from rows
    yield from _rows_until(math.inf, waiting, grid)[1]


def _rows_until(until: float, waiting: list[Block], grid: Grid) -> tuple[list[Block], list[GroupRows]]:
    """Return the blocks that are left, and the rows that are due; times without any value are left out."""
    made: list[GroupRows] = []
    while waiting and (begin := min(float(block.time[0]) for block in waiting)) <= until:
        end = min(until, begin + _BURST * grid.period, max(float(block.time[-1]) for block in waiting))
        left = []
        for block in waiting:
            count = int(np.searchsorted(block.time, end, "right"))
            if count:
                grid.add_block(part_of(block, slice(None, count)))
            if count < len(block.time):
                left.append(part_of(block, slice(count, None)))
        waiting = left
        if (rows := grid.rows(end)) is not None:
            made.append(rows)
    return waiting, made


# -- the folder ------------------------------------------------------------------------------------------------------

_SUFFIX: Final = ".teds-part"


@contextmanager
def _folder_for(target: Path) -> Iterator[Path]:
    """Make a private folder beside the file, locked while it is used; it is removed with its content."""
    _sweep(target)
    folder = target.with_name(f".{target.name}.{secrets.token_hex(8)}{_SUFFIX}")
    folder.mkdir(mode=0o700)
    held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | CLOSING) if OPENS_FOLDERS else None
    try:
        if held is not None:
            with suppress(OSError):
                lock(held)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if held is not None:
            os.close(held)


def _sweep(target: Path) -> None:
    """Remove what a killed conversion to this name left: a folder of such a name, ours, without a lock."""
    if not OPENS_FOLDERS:  # without locks on folders, a running conversion cannot be recognized
        return
    name = re.compile(re.escape(f".{target.name}.") + "[0-9a-f]{16}" + re.escape(_SUFFIX))
    left = list[str]()
    with suppress(OSError):
        left = [file_name for file_name in os.listdir(target.parent) if name.fullmatch(file_name)]
    for found in left:
        folder = target.with_name(found)
        with suppress(OSError):  # one that is held, or cannot be removed, keeps no other one
            held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | NOFOLLOW | CLOSING)
            try:
                if is_mine(os.fstat(held)):
                    lock(held)
                    shutil.rmtree(folder)
            finally:
                os.close(held)


def _published(path: Path, folder: Path) -> Path:
    """Give a whole file its name, never over another."""
    target = folder / path.name
    try:
        os.link(path, target)
    except FileExistsError:
        raise UsageError(f"{target} already exists and is not overwritten.", hint="Choose another name.") from None
    except OSError:  # a file system without hard links
        require_new(target)
        os.rename(path, target)
    return target
