"""``group``: which nodes are measured together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import COMMAND_SETTINGS, command, dry_run_option, examples, yes_option
from teds_provision.station.groups import Groups
from teds_provision.station.store.records import Group


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples("teds-provision group create hand 8d4d 91aa", "teds-provision group list"),
)
def group() -> None:
    """Manage groups of nodes that are measured together. A group cannot change while it is measured."""


def _print_groups(app: App, groups: Sequence[Group], *, ended: Sequence[str] = ()) -> None:
    lines = [f"{group.name}: {', '.join(uuid.hex() for uuid in group.uuids) or 'no nodes yet'}" for group in groups]
    found = [{"name": group.name, "uuids": [uuid.hex() for uuid in group.uuids]} for group in groups]
    app.emit(
        {"groups": found} | ({"ended": list(ended)} if ended else {}),
        "\n".join(lines) or "There are no groups yet. To create one: teds-provision group create NAME UUID …",
    )


@group.command("list", context_settings=COMMAND_SETTINGS, epilog=examples("teds-provision group list"))
@pass_app
def list_groups(app: App) -> None:
    """List all groups."""
    _print_groups(app, app.station().groups.all())


class _PlannedError(Exception):
    """Rolls a change back that was tried out."""

    def __init__(self, group: Group) -> None:
        super().__init__(group.name)
        self.group = group


def _change(app: App, act: str, change: Callable[[Groups], Group], *, dry_run: bool) -> None:
    """Change a group and print it; ``dry_run`` prints it as it would be, and raises what the change would raise."""
    station = app.station()
    with station.lock(f"group {act}", app.note):
        if not dry_run:
            _print_groups(app, [change(station.groups)])
            return
        try:
            with station.transaction():
                raise _PlannedError(change(station.groups))
        except _PlannedError as planned:
            app.note("Plan, nothing is changed:")
            _print_groups(app, [planned.group])


def _uuids(app: App, nodes: Sequence[str]) -> list[bytes]:
    station = app.station()
    return [station.nodes.resolve(text) for text in nodes]


@command("teds-provision group create hand 8d4d 91aa", name="create")
@click.argument("name")
@click.argument("nodes", nargs=-1, metavar="[UUID …]")
@dry_run_option
@pass_app
def create(app: App, name: str, nodes: Sequence[str], *, dry_run: bool) -> None:
    """Create a group of these nodes."""
    uuids = _uuids(app, nodes)
    _change(app, "create", lambda groups: groups.create(name, uuids), dry_run=dry_run)


@command("teds-provision group add hand 77f0", name="add")
@click.argument("name")
@click.argument("nodes", nargs=-1, required=True, metavar="UUID …")
@dry_run_option
@pass_app
def add(app: App, name: str, nodes: Sequence[str], *, dry_run: bool) -> None:
    """Add nodes to a group."""
    uuids = _uuids(app, nodes)
    _change(app, "add", lambda groups: groups.add(name, uuids), dry_run=dry_run)


@command("teds-provision group remove hand 77f0", name="remove")
@click.argument("name")
@click.argument("nodes", nargs=-1, required=True, metavar="UUID …")
@dry_run_option
@pass_app
def remove(app: App, name: str, nodes: Sequence[str], *, dry_run: bool) -> None:
    """Remove nodes from a group."""
    uuids = _uuids(app, nodes)
    _change(app, "remove", lambda groups: groups.remove(name, uuids), dry_run=dry_run)


@command("teds-provision group delete hand", "teds-provision group delete hand --yes", name="delete")
@click.argument("name")
@yes_option
@dry_run_option
@pass_app
def delete(app: App, name: str, *, yes: bool, dry_run: bool) -> None:
    """Delete a group; its nodes are not affected.

    If measurements are kept for the group (by the page or the API), they are deleted with it, after a question.
    """
    station = app.station()
    kept = [measurement.id for measurement in station.measurements.of_group(name)]
    what = f"measurement{'s' if len(kept) > 1 else ''} {', '.join(kept)}"
    if dry_run:
        if kept or station.groups.find(name) is not None:
            app.note(f"Would delete group {name}{f' and its {what}' if kept else ''}.")
        else:
            app.note(f"Nothing to do: there is no group {name!r}.")
        _print_groups(app, station.groups.all(), ended=kept)
        return
    asked = yes or (bool(kept) and app.interactive)
    if asked and kept:
        app.confirm(f"Delete group {name} and its {what}?", yes=yes)
    with station.lock("group delete", app.note), station.transaction():
        found, ended = station.measurements.delete_group(name, also=kept if asked else ())
        for measurement_id in ended:
            station.audit("measure", None, "ended", id=measurement_id, group=name)
        if found:
            station.audit("group", None, "deleted", group=name, measurements=list(ended))
    if ended:
        app.note(f"Also deleted: {what}.")
    if not found:
        app.note(f"Nothing to do: there is no group {name!r}.")
    _print_groups(app, station.groups.all(), ended=ended)


for subcommand in (create, add, remove, delete):
    group.add_command(subcommand)
