"""``show``: decode TEDS, images, profiles, bundle headers and messages; turn TEDS from any format into any other."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from teds_provision import teds
from teds_provision.cli import show_files, show_table
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.context import to_json as dumps
from teds_provision.cli.options import command
from teds_provision.errors import BadData, UsageFailure
from teds_provision.harmless import harmless

if TYPE_CHECKING:
    from teds_provision.cli.show_files import ShownFile
    from teds_provision.teds.codec.model import Edition
    from teds_provision.teds.formats import Block, Format

CHOICES = ["table", "json", "xml", "hex", "ihex", "toml", "binary", "image"]
_BAD_DATA = BadData.exit_code
_POLICY = 6


@command(
    "teds-provision show meta.hex",
    "teds-provision show image.json --format xml > image.xml",
    "teds-provision show image.json --edition 2024",
    "teds-provision show --diff before.json after.json",
    "teds-provision show image.json --plot curve.svg",
)
@click.argument("files", metavar="FILE…", nargs=-1)
@click.option("--format", "form", type=click.Choice(CHOICES), default="table", show_default=True, help="Of the output.")
@click.option(
    "--edition", type=click.Choice(["2007", "2024"]), help="Convert to this edition; say what it cannot hold."
)
@click.option("--diff", nargs=2, metavar="A B", help="Say in physical terms what changes from A to B.")
@click.option("--plot", metavar="FILE", type=click.Path(path_type=Path), help="Draw the calibrations, .png or .svg.")
@click.option("--strict", is_flag=True, help="Exit 8 for any error finding, 6 for a calibration that would hurt.")
@pass_app
def show(
    app: App,
    files: tuple[str, ...],
    form: str,
    edition: str | None,
    diff: tuple[str, str] | None,
    plot: Path | None,
    strict: bool,
) -> None:
    """Decode TEDS (binary, hex, Intel HEX, JSON, XML), images, profiles, bundle headers and messages.

    A file of - is standard input. Exits 0 where it could decode, 8 where not even the tuples close, 3 for no such file.
    """
    plain = form in {"table", "json"}
    if diff is not None:
        _require_nothing_else(files, plot, plain)
        _diff(app, *diff, as_json=form == "json")
        return
    if not files:
        raise UsageFailure("There is nothing to show.", hint="Name a file, or - for standard input.")
    if app.json and not plain:
        raise UsageFailure("--json and --format ask for different outputs.", hint="Leave one of them out.")
    wanted = cast("Edition", int(edition)) if edition else None
    shown = [show_files.load(name, wanted) for name in files]
    if plot is not None:
        _plot(app, shown, plot)
    _tell(app, shown, form)
    _judge(shown, strict)


def _require_nothing_else(files: tuple[str, ...], plot: Path | None, plain: bool) -> None:
    if files or plot or not plain:
        raise UsageFailure("--diff compares two files and goes with nothing else.")


def _tell(app: App, files: Sequence[ShownFile], form: str) -> None:
    for file in files:
        for note in file.notes:
            app.note(f"{file.name}: {note}")
    if app.json or form == "json":
        result = show_files.to_json(files)
        print(dumps(result, indent=None if app.json else 1), flush=True)
    elif form == "table":
        show_table.print_files(app.console(), files)
    else:
        _convert(app, files, cast("Format", form))


def _convert(app: App, files: Sequence[ShownFile], form: Format) -> None:
    for file in files:
        if file.bundle is not None:
            raise BadData(f"{file.name} holds no TEDS that could be written as {form}.")
        for finding in chain.from_iterable(file.conversions.values()):
            if finding.severity == "error":
                app.warn(f"{file.name}: {finding.message}")
    _write(app, [block for file in files for block in file.blocks], form)


def _write(app: App, blocks: Sequence[Block], form: Format) -> None:
    written = teds.formats.write_blocks(blocks, form)
    if isinstance(written, bytes) and sys.stdout.isatty():
        raise UsageFailure("Octets are not for a terminal.", hint="Send them to a file: … --format binary > FILE")
    for sentence in teds.formats.lost(blocks, form):
        app.warn(f"{form} cannot hold {sentence}")
    if isinstance(written, str) and sys.stdout.isatty():
        written = harmless(written)
    octets = written if isinstance(written, bytes) else written.encode()
    sys.stdout.buffer.write(octets)
    sys.stdout.flush()


def _judge(files: Sequence[ShownFile], strict: bool) -> None:
    """Exit code after everything has been told."""
    if any(file.malformed for file in files) or (strict and any(map(_has_errors, files))):
        raise click.exceptions.Exit(_BAD_DATA)
    if strict and any(guarded.severity == "error" for file in files for guarded in file.guard):
        raise click.exceptions.Exit(_POLICY)


def _has_errors(file: ShownFile) -> bool:
    found = [finding for shown in file.teds for finding in shown.decoded.findings]
    found += file.message.findings if file.message is not None else ()
    return any(finding.severity == "error" for finding in found)


def _diff(app: App, before: str, after: str, *, as_json: bool) -> None:
    old, new = (show_files.placed(show_files.load(name).blocks) for name in (before, after))
    changes = teds.diff.diff_blocks(old, new)
    judged = teds.guard.check_calibration(new, old)
    result = {
        "changes": [asdict(change) for change in changes],
        "guard": [show_files.guard_to_json(finding) for finding in judged],
    }
    if as_json and not app.json:
        print(dumps(result, indent=1), flush=True)
        return
    lines = [change.text for change in changes] or ["no difference"]
    lines += [f"{finding.severity}: guard, channel {finding.channel}: {finding.message}" for finding in judged]
    app.emit(result, lambda console: console.print("\n".join(lines), markup=False))


def _plot(app: App, files: Sequence[ShownFile], path: Path) -> None:
    if len(files) != 1:
        raise UsageFailure("A plot shows the calibrations of one file.", hint="Call show once for each.")
    channels = teds.plot.plot_blocks(show_files.placed(files[0].blocks), path)
    app.note(f"Drawn in {path}: channel {', '.join(map(str, channels))}.")
