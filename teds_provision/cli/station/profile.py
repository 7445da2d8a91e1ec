"""``profile``: datasheets by transducer type."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from teds_provision import node as node_room
from teds_provision.cli.context import App, Console, pass_app
from teds_provision.cli.named_files import read_file
from teds_provision.cli.options import COMMAND_SETTINGS, FileToRead, command, dry_run_option, examples
from teds_provision.cli.rendering import print_table
from teds_provision.errors import BadDataError, StoreError, UsageError
from teds_provision.files import SHARED, holds, write_new
from teds_provision.teds.formats.mapped import profile_from_xml
from teds_provision.teds.profile import (
    ProfileProblem,
    default_folders,
    describe,
    find_profile,
    list_profiles,
    listed,
    load_profile,
    template,
)
from teds_provision.teds.profile import check as check_profile
from teds_provision.teds.profile.load import parse_profile
from teds_provision.teds.show import seconds
from teds_provision.teds.units import short_unit

if TYPE_CHECKING:
    from rich.table import Table

    from teds_provision.node.wrapped.description import WrappedSensor


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples("teds-provision profile list", "teds-provision profile show magnetic-angular-position-sensor"),
)
def profile() -> None:
    """Manage transducer types: one TOML file each, in ./profiles, in the home's profiles, or built in."""


@profile.command("list", context_settings=COMMAND_SETTINGS, epilog=examples("teds-provision profile list"))
@pass_app
def list_(app: App) -> None:
    """List the known types."""
    entries = [listed(entry) for entry in list_profiles(default_folders(app.home))]

    def human(console: Console) -> None:
        from rich.markup import escape
        from rich.table import Table

        table = Table(box=None, pad_edge=False)
        for title in ("Profile", "Channels", "Links"):
            table.add_column(title, no_wrap=True)
        table.add_column("Title", overflow="fold")
        for entry in entries:
            if "error" in entry:
                table.add_row(entry["name"], "", "", escape(f"cannot be read: {entry['error']}"))
            elif not entry["abstract"]:
                title = escape(entry["title"])
                table.add_row(entry["name"], str(entry["channels"]), ", ".join(entry["links"]), title)
        print_table(console, table)

    app.emit({"profiles": entries}, human)


@profile.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Show one type: channels, units, ranges, calibration.",
    epilog=examples("teds-provision profile show tactile-finger-sensor"),
)
@click.argument("name")
@pass_app
def show(app: App, name: str) -> None:
    """Show one type: channels, units, ranges, and calibration requirements."""
    data = describe(load_profile(name, default_folders(app.home)))
    app.emit({"profiles": [data]}, lambda console: _show(console, data))


def _show(console: Console, data: dict[str, Any]) -> None:
    from rich.markup import escape

    console.print(f"[bold]{escape(data['title'])}[/bold]  {escape(data['file'])}")
    if data["extends"]:
        console.print(f"extends {' -> '.join(data['extends'])}", markup=False)
    if data["description"]:
        console.print(data["description"] + "\n", markup=False)
    if data["links"]:
        console.print(f"Links: {', '.join(data['links'])}", markup=False)
    print_table(console, _channels(data["channels"]))
    for warning in data["warnings"]:
        console.print(f"Warning: {warning}", markup=False)


def _channels(channels: list[dict[str, Any]]) -> Table:
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False)
    for title in ("Ch", "Name", "Type", "Range", "Uncertainty", "Period"):
        table.add_column(title, no_wrap=True)
    table.add_column("Calibration")
    for channel, last in _alike(channels):
        unit, period = short_unit(channel["unit"]), channel["sampling_period"]
        several = last is not channel
        row = (
            f"{channel['number']}-{last['number']}" if several else str(channel["number"]),
            f"{channel['name']} to {last['name']}" if several else channel["name"],
            channel["type"],
            f"{channel['low_limit']:.6g} to {channel['high_limit']:.6g} {unit}",
            f"{channel['uncertainty']:.6g} {unit}",
            seconds(period) if period is not None else "",
            _demand(channel["calibration"]),
        )
        table.add_row(*map(Text, row))
    return table


def _alike(channels: list[dict[str, Any]]) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Yield the first and last of each run of channels that differ in number and name only."""

    def same(channel: dict[str, Any]) -> str:
        return str({key: value for key, value in channel.items() if key not in ("number", "name")})

    for _, run in groupby(channels, key=same):
        members = list(run)
        yield members[0], members[-1]


def _demand(demand: dict[str, Any]) -> str:
    parts = ["required" if demand["required"] else "", demand["method"] or "", demand["monotone"] or ""]
    if demand["monotone"] == "either":
        parts[2] = "monotone"
    if demand["interval"]:
        parts.append(f"every {demand['interval'] / 86_400:.0f} d")
    return ", ".join(part for part in parts if part)


@command("teds-provision profile check profiles/tactile-finger-sensor.toml")
@click.argument("names", metavar="NAME...", nargs=-1, required=True)
@pass_app
def check(app: App, names: tuple[str, ...]) -> None:
    """Report every mistake with file, line and field. Exits 8 if there is one."""
    folders = default_folders(app.home)
    results: list[dict[str, Any]] = []
    errors: list[ProfileProblem] = []
    for name in names:
        path = find_profile(name, folders)
        _, problems = check_profile(path, folders)
        wrong = [problem for problem in problems if problem.severity == "error"]
        errors += wrong
        results.append(
            {"name": path.stem, "file": str(path), "ok": not wrong, "problems": list(map(_problem, problems))}
        )
        for problem in problems:
            app.note(f"{problem.severity}: {problem}")  # only without --json, whose object contains them
    if errors:
        more = f" ({len(errors) - 1} more, listed above)" if len(errors) > 1 and not app.json else ""
        raise BadDataError(f"{errors[0]}{more}")
    good = ", ".join(entry["name"] for entry in results)
    app.emit({"profiles": results}, _plain(f"{good}: no mistakes found."))


def _problem(problem: ProfileProblem) -> dict[str, Any]:
    where = {"file": problem.where.file, "line": problem.where.line}
    return {**where, "field": problem.field, "message": problem.message, "severity": problem.severity}


profile.add_command(check)


@command(
    "teds-provision profile new wrist-torque",
    "teds-provision profile new my-finger --extends tactile-finger-sensor",
    "teds-provision profile new lab-angle --from examples/xml/angle.xml --map examples/xml/angle-map.toml",
    "teds-provision profile new torque --from dbc:examples/bench/torque.dbc --message Torque",
)
@click.argument("name")
@click.option("--extends", metavar="PROFILE", help="Start from another type and state only the differences.")
@click.option(
    "--from",
    "source",
    metavar="FILE",
    help="A datasheet XML of your own (needs --map), or a sensor to wrap: dbc:FILE, eds:FILE, iio:DEVICE.",
)
@click.option("--message", metavar="NAME", help="Message of the DBC file (default: the only one).")
@click.option(
    "--map", "mapping", type=FileToRead(), metavar="FILE", help="Place of each key in that XML, and its unit."
)
@click.option(
    "--output",
    "-o",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Where to write it (default: ./profiles if it exists, otherwise the home's profiles).",
)
@dry_run_option
@pass_app
def new(
    app: App,
    name: str,
    extends: str | None,
    source: str | None,
    message: str | None,
    mapping: Path | None,
    output: Path | None,
    dry_run: bool,
) -> None:
    """Write a template for a type, or a type from XML or a sensor.

    The template has every key, commented. A type is read from a datasheet XML of your own by a mapping file;
    docs/formats.md says how that is written. From a DBC file, an EDS or an IIO device come channels, units, ranges
    and scaling (docs/virtual-nodes.md).
    """
    import re

    if not re.fullmatch(r"[a-z0-9][a-z0-9._-]{0,63}", name):
        raise UsageError(
            f'"{name}" is not a valid profile name.',
            hint="Use lower-case letters, digits and dashes, like wrist-torque.",
        )
    sensor = _sensor(source, message, mapping)
    if (sensor is None and (source is None) != (mapping is None)) or (source is not None and extends is not None):
        raise UsageError("--from needs --map, and no --extends.", hint="The mapping may say extends under [values].")
    text = template(name)
    if sensor is not None:
        text = sensor.profile_text(name)
        parse_profile(text, name)
        for note in sensor.notes:
            app.note(note)
    elif source is not None and mapping is not None:
        rules = read_file(mapping).decode(errors="replace")
        text = profile_from_xml(read_file(Path(source)), rules, name=name, file=source, by=str(mapping))
        parse_profile(text, name)  # checks the XML's content like any profile
    elif extends is not None:
        base = find_profile(extends, default_folders(app.home)).stem
        text = (
            f"# Transducer type {name}: like {base}, except for the settings below.\n"
            f'# For all settings: teds-provision profile new --dry-run {name}\n\nextends = "{base}"\ntitle = "{name}"\n'
            f"\n[channel.1]\n# high-limit = 20.0\n"
        )
    folder = Path("profiles") if Path("profiles").is_dir() else app.home / "profiles"
    path = output or folder / f"{name}.toml"
    done = holds(path, text.encode())
    if path.exists() and not done:
        raise UsageError(f"{path} already exists with different content.", hint="Choose another name, or use --output.")
    more = _origin_of(sensor) if sensor is not None else {}
    if dry_run:
        app.emit({"profiles": [{"name": name, "file": str(path)}], "text": text, **more}, _plain(text.rstrip("\n")))
        return
    if not done:
        if output is None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            except OSError as error:
                raise StoreError(f"Cannot create {path.parent}: {error.strerror}.") from error
        write_new(path, text.encode("utf-8"), mode=SHARED)
    sentence = _plain(f"{path} {'already exists' if done else 'written'}.")
    app.emit({"profiles": [{"name": name, "file": str(path)}], **more}, sentence)


def _sensor(source: str | None, message: str | None, mapping: Path | None) -> WrappedSensor | None:
    """Return the sensor that ``--from`` names, None if it names a file of XML or nothing; raises UsageError."""
    if source is None or source.partition(":")[0] not in ("dbc", "eds", "iio"):
        if message is not None:
            raise UsageError("--message needs --from dbc:FILE.")
        return None
    if mapping is not None:
        raise UsageError("--map reads XML.", hint="Omit --map.")
    return node_room.wrapped.reading.describe(source, message)


def _origin_of(sensor: WrappedSensor) -> dict[str, Any]:
    """Return the keys of a type that was read from the description of a sensor."""
    channels = [
        {"channel": number, "name": channel.name, "unit": channel.unit, **node_room.wrapped.description.facts(channel)}
        for number, channel in enumerate(sensor.channels, 1)
    ]
    return {"channels": channels, "origin": sensor.origin.to_json()}


profile.add_command(new)


def _plain(text: str) -> Callable[[Console], None]:
    """Return a function that prints text as it is: brackets are no markup, lines stay whole."""
    return lambda _console: click.echo(text)
