"""``whitelist``: the nodes that may be keyed and written."""

from __future__ import annotations

import sys
from itertools import chain
from pathlib import Path
from typing import Any

import click

from teds_provision import provisioning
from teds_provision.cli.context import App, Station, pass_app
from teds_provision.cli.named_files import write_file
from teds_provision.cli.node.node_names import resolve
from teds_provision.cli.options import COMMAND_SETTINGS, dry_run_option, examples, fingerprint_option, yes_option
from teds_provision.cli.rendering import local_time, print_json_list, shown
from teds_provision.errors import NotFoundError, UsageError
from teds_provision.protocol.fingerprints import same_key
from teds_provision.sanitize import counted
from teds_provision.station.label import read_label


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples(
        "teds-provision whitelist add 8d4d9da65281f7000000 --name finger-1",
        "teds-provision whitelist import ncap.xml",
        "teds-provision whitelist export whitelist.csv",
    ),
)
def whitelist() -> None:
    """Manage the nodes that may be keyed and written, by UUID and key fingerprint.

    An entry without a fingerprint is pinned at the first tap in which the node proves its key.
    """


@whitelist.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Whitelist one node.",
    epilog=examples("teds-provision whitelist add 8d4d9da65281f7000000 --name finger-1"),
)
@click.argument("uuid", metavar="UUID|LABEL")
@fingerprint_option("Fingerprint of the node's key: the first 32 to 64 digits.")
@click.option("--name", help="Name of the node.")
@dry_run_option
@pass_app
def add(app: App, uuid: str, fingerprint: str | None, name: str | None, dry_run: bool) -> None:
    """Whitelist one node; a pinned key is never replaced (exit 6).

    Instead of the UUID you can pass the scanned text of a label (see: label), which also pins the key.
    """
    station = app.station()
    scanned = read_label(uuid)
    octets = _meant(station, uuid) if scanned is None else scanned[0]
    if scanned is not None:
        if fingerprint is not None and not same_key(fingerprint, scanned[1]):
            raise click.BadParameter("the label carries a different key.", param_hint="--fingerprint")
        fingerprint = scanned[1]
    provisioning.whitelist.require_name(name)
    wanted = provisioning.whitelist.ListedNode(0, octets, fingerprint, name)
    plan = provisioning.whitelist.plan_addition(station, [wanted], rename=True)
    if dry_run or not plan.write:
        _emit_plan(app, station, plan, dry_run=dry_run)
        return
    station.unlock()
    with station.lock("whitelist add", app.note):
        plan = provisioning.whitelist.plan_addition(station, [wanted], rename=True)
        provisioning.whitelist.add(station, plan)
    _emit_plan(app, station, plan, dry_run=False)


def _meant(station: Station, uuid: str) -> bytes:
    """Return the UUID, or that of an EUI-64 if its first digits match no known node."""
    try:
        return resolve(station, uuid)
    except NotFoundError:
        by_rule = provisioning.whitelist.uuid_of_eui64(uuid)
        if by_rule == uuid:
            raise
        return station.nodes.resolve(by_rule)


@whitelist.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Remove a node and forget its pinned key.",
    epilog=examples("teds-provision whitelist remove 8d4d --yes"),
)
@click.argument("uuid")
@yes_option
@dry_run_option
@pass_app
def remove(app: App, uuid: str, yes: bool, dry_run: bool) -> None:
    """Remove a node from the whitelist and forget its pinned key, so that a replaced board can be pinned again."""
    station = app.station()
    octets = resolve(station, uuid)
    entry = station.pins.entry(octets)
    sentence = f"{octets.hex()}{f' ({entry.name})' if entry and entry.name else ''}"
    pinned = entry.fingerprint if entry is not None else None
    if entry is None and not provisioning.whitelist.is_pinned(station, octets):
        text = f"{sentence} is not on the whitelist (nothing to do)."
    elif dry_run:
        text = f"Plan: remove {sentence} from the whitelist and forget its key {(pinned or 'as last seen')[:32]}."
    else:
        app.confirm(f"Remove {sentence} from the whitelist and forget its pinned key?", yes=yes)
        station.unlock()
        with station.lock("whitelist remove", app.note):
            provisioning.whitelist.remove(station, octets)
        text = (
            f"{sentence} is {'no longer on the whitelist' if entry else 'not on the whitelist; its key is forgotten'}."
        )
    _emit(app, station, text, removed=entry is not None and not dry_run)


@whitelist.command(
    "list",
    context_settings=COMMAND_SETTINGS,
    short_help="List every entry.",
    epilog=examples("teds-provision whitelist list"),
)
@pass_app
def list_entries(app: App) -> None:
    """List every entry: UUID, pinned key, how it was proven, when it was added, and the name."""
    station = app.station()
    entries = provisioning.whitelist.named(station, station.pins.all_entries())
    if app.json:
        print_json_list("whitelist", map(provisioning.whitelist.as_dict, entries))
        return
    first = next(entries, None)
    if first is None:
        print("The whitelist is empty.")
        return
    print(f"{'UUID':<20}  {'key':<16}  {'assurance':<9}  {'added':<25}  name")
    for entry in chain([first], entries):
        key = entry.fingerprint[:16] if entry.fingerprint else "not pinned yet"
        line = (
            f"{entry.uuid.hex()}  {key:<16}  {entry.assurance:<9}  {local_time(entry.added):<25}  {shown(entry.name)}"
        )
        sys.stdout.write(f"{line.rstrip()}\n")
    sys.stdout.flush()


@whitelist.command(
    "import",
    context_settings=COMMAND_SETTINGS,
    epilog=examples("teds-provision whitelist import ncap.xml --dry-run", "teds-provision whitelist import ncap.xml"),
)
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--format", "form", type=click.Choice(["xml", "csv", "json"]), help="Default: from extension or content.")
@dry_run_option
@pass_app
def import_file(app: App, file: Path, form: str | None, dry_run: bool) -> None:
    """Add every entry of an XML (NCAP), CSV or JSON file, or none.

    One invalid line rejects the whole file (exit 8), and so does a UUID pinned to a different key (exit 6). UUID,
    fingerprint and name are imported; this station sets the date and the assurance.
    """
    station = app.station()
    listed = provisioning.whitelist.read_whitelist(file, form)
    if dry_run:
        _emit_plan(app, station, provisioning.whitelist.plan_addition(station, listed), dry_run=True)
        return
    station.unlock()
    with station.lock("whitelist import", app.note):
        plan = provisioning.whitelist.plan_addition(station, listed)
        provisioning.whitelist.add(station, plan, source=str(file))
    _emit_plan(app, station, plan, dry_run=False)


@whitelist.command(
    "export",
    context_settings=COMMAND_SETTINGS,
    short_help="Write every entry to a file.",
    epilog=examples("teds-provision whitelist export whitelist.csv", "teds-provision whitelist export - --format csv"),
)
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False, allow_dash=True))
@click.option(
    "--format", "form", type=click.Choice(["xml", "csv", "json"]), help="Default: from the extension, otherwise xml."
)
@dry_run_option
@pass_app
def export_file(app: App, file: Path, form: str | None, dry_run: bool) -> None:
    """Write all entries, sorted, to a file (- for stdout); an existing file is replaced in one step."""
    station = app.station()
    to_stdout = str(file) == "-"
    if to_stdout and app.json:
        raise UsageError("--json prints the whitelist itself.", hint="Omit --json, or name a file.")
    form = provisioning.whitelist.form_of(file, form)
    entries = list(provisioning.whitelist.named(station, station.pins.all_entries()))
    if to_stdout and not dry_run:
        for text in provisioning.whitelist.render(entries, form):
            click.echo(text, nl=False)
        return
    if not dry_run:
        write_file(file, provisioning.whitelist.render(entries, form))
    listed = [provisioning.whitelist.as_dict(entry) for entry in entries] if app.json else []
    count = len(entries)
    verb = "Would write" if dry_run else "Wrote"
    app.emit(
        {"whitelist": listed, "file": str(file), "format": form},
        f"{verb} {counted(count, 'entry', 'entries')} as {form} to {file}.",
    )


def _emit_plan(app: App, station: Station, plan: provisioning.whitelist.WhitelistPlan, *, dry_run: bool) -> None:
    changed = len(plan.write) - plan.new
    what = f"{plan.new} new, {changed} changed, {plan.unchanged} unchanged"
    text = f"Plan: {what}." if dry_run else f"Whitelist: {what}{'' if plan.write else ' (nothing to do)'}."
    _emit(app, station, text, added=plan.new, changed=changed, unchanged=plan.unchanged, dry_run=dry_run)


def _emit(app: App, station: Station, text: str, **more: Any) -> None:
    """Print a change in one line; with --json the whole whitelist as it is now."""
    listed = [provisioning.whitelist.as_dict(entry) for entry in station.pins.whitelist()] if app.json else []
    app.emit({"whitelist": listed, **more}, lambda console: console.print(text, markup=False))
