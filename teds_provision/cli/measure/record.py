"""``record``: what is in a recording, its values, the same in another format."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from teds_provision import measure as measure_room
from teds_provision.cli import rendering
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import (
    COMMAND_SETTINGS,
    ChannelName,
    FileToRead,
    WholeNumber,
    examples,
    file_units_option,
)
from teds_provision.errors import NotFoundError
from teds_provision.lazy import late
from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows
from teds_provision.sanitize import counted

if TYPE_CHECKING:
    from teds_provision.cli.measure import measure_view
    from teds_provision.measure.display_units import FileUnits
    from teds_provision.measure.recordings.source import Entry, Recording
    from teds_provision.measure.recordings.summary import RecordingSummary
else:
    measure_view = late("teds_provision.cli.measure.measure_view")  # imports numpy and the sinks

SHOWN = 20


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples("teds-provision record info run.mcap", "teds-provision record convert run.mcap run.csv"),
)
def record() -> None:
    """Inspect and convert recordings of `measure --to`: CSV, text, MCAP, JSON lines, Parquet.

    The format is detected from the content. A recording that was cut off, or is still being written, is read up to its
    last complete line or chunk. docs/recording.md describes the formats.
    """


@record.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Show a recording's channels, time span and losses.",
    epilog=examples("teds-provision record info run.mcap", "teds-provision --json record info run.csv"),
)
@click.argument("file", type=FileToRead())
@pass_app
def info(app: App, file: Path) -> None:
    """Show a recording's channels and time span, and what is invalid, lost or cut off."""
    recordings = measure_room.recordings
    recording, summary = recordings.opening.open_recording(file), recordings.summary.RecordingSummary()
    for entry in recording.entries():
        summary.add_entry(entry)
    result = summary.to_json(recording)
    app.emit(result, "\n".join(_lines(result, summary, recording)))


def _lines(result: Mapping[str, Any], summary: RecordingSummary, recording: Recording) -> Iterator[str]:
    group = f", group {result['group']}" if result["group"] else ""
    yield f"{result['file']}: {result['format']}, station {result['station'] or 'unknown'}{group}"
    if result["test_pattern"]:
        yield "TEST PATTERN: these are not measurements."
    if result["from"]:
        yield f"From {_local(result['from'])} until {_local(result['until'])}"
    else:
        yield "It contains no values."
    lost = "not recorded" if result["lost"] is None else counted(result["lost"], "message")
    yield (
        f"{counted(result['messages'], 'time stamp')}, {counted(result['samples'], 'value')}, "
        f"{result['invalid']} invalid; "
        f"lost: {lost}, missing: {result['missing']} samples"
    )
    if result["being_written"]:
        yield "It is still being written."
    elif not result["complete"]:
        torn = f", and the last {result['torn']} octets are incomplete" if result["torn"] else ""
        yield f"It was cut off: no end was written{torn}."
    for channel in result["channels"]:
        facts = summary.facts.get((channel["uuid"], channel["channel"])) or recording.facts.get(
            (channel["uuid"], channel["channel"])
        )
        span = _span(channel, facts)
        name = f"{channel.get('node') or channel['uuid']}/{channel.get('name') or channel['channel']}"
        yield f"  {name}: {counted(channel['samples'], 'value')}, {channel['invalid']} invalid{span}"
    for note in result["notes"]:
        yield f"  {_local(note['time'])} {note['why']}"


def _span(channel: Mapping[str, Any], facts: ChannelFacts | None) -> str:
    if channel["lowest"] is None or facts is None:
        return ""
    low, unit = measure_view.value_text(channel["lowest"], facts)
    high, _ = measure_view.value_text(channel["highest"], facts)
    plain = [f"{measure_view.in_peoples_units(channel[end], facts)[0]:.6g}" for end in ("lowest", "highest")]
    # A full turn is shown as 0. As the upper end of a span it is shown as 360, unless both ends are equal.
    return f", {low} to {high if low != plain[0] else plain[1]} {unit}".rstrip()


def _local(text: str) -> str:
    with suppress(ValueError):
        return datetime.fromisoformat(text).astimezone().isoformat(sep=" ", timespec="milliseconds")
    return text


@record.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Show the values of a recording.",
    epilog=examples(
        "teds-provision record show run.mcap --limit 100",
        "teds-provision record show run.csv --channel 2",
        "teds-provision --json record show run.parquet",
    ),
)
@click.argument("file", type=FileToRead())
@click.option(
    "--channel",
    "channels",
    type=ChannelName(),
    multiple=True,
    metavar="CHANNEL",
    help="Show only this channel, by number or name; repeatable.",
)
@click.option(
    "--limit", type=WholeNumber(1), metavar="N", help="Show the first N values (default: 20, or all with --json)."
)
@pass_app
def show(app: App, file: Path, channels: tuple[int | str, ...], limit: int | None) -> None:
    """Show values with time, node and channel, in display units.

    With --json the lines are the events of `measure --json` (SI units). The last one, `end`, has the figures of `record
    info` for the whole file, whatever --channel and --limit select.
    """
    recordings = measure_room.recordings
    recording, summary = recordings.opening.open_recording(file), recordings.summary.RecordingSummary()
    left: float = limit or (math.inf if app.json else SHOWN)
    for entry in recording.entries():
        summary.add_entry(entry)
        wanted = _wanted(entry, summary, channels)
        if left > 0 and (cut := recordings.source.first_instants(entry, wanted, left)) is not None:
            left -= len(cut.time)
            app.lines(list(_events(cut, summary) if app.json else _values(cut, summary)))
    _require_known(file, summary, channels)
    if app.json:
        app.emit({"event": "end", **summary.to_json(recording)})
    elif summary.messages > (limit or SHOWN):
        app.note(f"{summary.messages} time stamps in all; use --limit to show more.")


def _require_known(file: Path, summary: RecordingSummary, channels: Sequence[int | str]) -> None:
    """Raise NotFoundError for a channel that the whole recording does not have."""
    known = {(key[1], facts.name) for key, facts in summary.facts.items()}
    for chosen in channels if known else ():
        fits = [chosen in (number, name) or str(chosen).casefold() == name.casefold() for number, name in known]
        if not any(fits):
            has = ", ".join(f"{number} ({name})" if name else str(number) for number, name in sorted(known))
            which = chosen if isinstance(chosen, int) else repr(chosen)
            raise NotFoundError(f"{file} has no channel {which}.", hint=f"It has {has}.")


def _wanted(entry: Entry, summary: RecordingSummary, channels: Sequence[int | str]) -> set[tuple[str, int]] | None:
    """Return the channels of an entry that are chosen by number or name; None if all are."""
    if not channels or not isinstance(entry, measure_room.blocks.Block | measure_room.blocks.GroupRows):
        return None
    names = {channel.casefold() if isinstance(channel, str) else channel for channel in channels}
    known = {key: summary.facts.get(key) for key in entry.keys}
    return {key for key, facts in known.items() if key[1] in names or (facts and facts.name.casefold() in names)}


def _events(shown: Block | GroupRows, summary: RecordingSummary) -> Iterator[str]:
    lines = measure_room.sinks.json_events
    events = (
        lines.data_lines(shown, summary.facts)
        if isinstance(shown, measure_room.blocks.Block)
        else lines.row_lines(shown, summary.facts)
    )
    return (lines.as_line(event).decode().rstrip() for event in events)


def _values(shown: Block | GroupRows, summary: RecordingSummary) -> Iterator[str]:
    """Yield a line for each instant, in display units."""
    keys = shown.keys
    known = [summary.facts.get(key) or measure_room.blocks.ChannelFacts(key[0], "", key[1], "") for key in keys]
    names = [rendering.shown(f"{facts.node or facts.uuid}/{facts.label}") for facts in known]
    for instant, row in zip(shown.time.tolist(), shown.value.tolist(), strict=True):
        moment = datetime.fromtimestamp(instant).astimezone().isoformat(sep=" ", timespec="milliseconds")
        cells = [f"{name} {_value(value, facts)}" for name, value, facts in zip(names, row, known, strict=True)]
        yield f"{moment}  {', '.join(cells)}"


def _value(value: float, known: ChannelFacts) -> str:
    if not math.isfinite(value):
        return "not valid"
    return " ".join(measure_view.value_text(value, known)).rstrip()


@record.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Convert a recording to another format.",
    epilog=examples(
        "teds-provision record convert run.mcap run.csv",
        "teds-provision record convert run.mcap run.csv --wide",
        "teds-provision record convert run.csv run.parquet",
        "teds-provision record convert run.mcap run.csv --unit shown",
    ),
)
@click.argument("source", type=FileToRead(), metavar="FROM")
@click.argument("target", type=click.Path(path_type=Path), metavar="TO")
@click.option("--wide", is_flag=True, help="Write one table: a row per time, a column per channel, no raw values.")
@file_units_option
@pass_app
def convert(app: App, source: Path, target: Path, wide: bool, file_units: FileUnits) -> None:
    """Write the recording FROM in the format of TO: .csv, .txt, .mcap, .jsonl, or .parquet (needs pyarrow).

    TO appears when it is complete; nothing is overwritten. If datasheets changed midway, CSV and Parquet are split into
    several files (TO, then TO.2 and so on).
    """
    done = measure_room.recordings.converting.convert(source, target, wide=wide, units=file_units)
    result = done.summary.to_json(done.recording)
    what = f"ends at {result['until']}" if result["until"] is not None else "holds no values"
    if result["being_written"]:
        app.warn(f"{source} is still being written: the result {what}.")
    elif not result["complete"]:
        app.warn(f"{source} was cut off: the result {what}.")
    files = [str(path) for path in done.files]
    app.emit(
        {"files": files, "unit": "si" if target.suffix.lower() == ".mcap" else file_units, **result},
        f"{', '.join(files)}: {counted(result['samples'], 'value')} at {counted(result['messages'], 'time stamp')}",
    )
