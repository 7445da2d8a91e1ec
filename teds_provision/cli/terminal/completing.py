"""What a shell is offered where a node, a profile or a station is meant; quick however many nodes there are."""

from __future__ import annotations

from pathlib import Path

import click
from click.shell_completion import CompletionItem

from teds_provision import station as station_room
from teds_provision import teds
from teds_provision.cli.configuration import home_of
from teds_provision.errors import TedsProvisionError

_NODES = frozenset({"uuid", "uuids", "what", "old", "new", "node", "nodes", "text", "names"})
_MOST = 50


def teach(command: click.Command) -> None:
    """Let the parameters of a command complete what they name, by their names."""
    for parameter in command.params:
        if isinstance(parameter, click.Argument) and parameter.name in _NODES:
            parameter._custom_shell_complete = _nodes
        elif isinstance(parameter, click.Option) and parameter.name == "profile":
            parameter._custom_shell_complete = _profiles
    for inner in command.commands.values() if isinstance(command, click.Group) else ():
        teach(inner)


def _home(ctx: click.Context) -> Path:
    return home_of(ctx.find_root().params.get("home"))


def _nodes(ctx: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """UUIDs and names of known nodes, and files where they are taken."""
    try:
        station = station_room.station.Station.open(_home(ctx), ask=_nobody)
    except TedsProvisionError:
        return []
    try:
        found = station.nodes.beginning_with(incomplete, _MOST)
    finally:
        station.close()
    items = [CompletionItem(word, help=what) for word, what in found]
    return items or [CompletionItem(incomplete, type="file")]


def _profiles(ctx: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    listed = teds.profile.list_profiles(teds.profile.default_folders(_home(ctx)))
    names = [CompletionItem(entry.name) for entry in listed if entry.name.startswith(incomplete)]
    return names or [CompletionItem(incomplete, type="file")]


def _nobody(prompt: str, confirm: bool = False) -> str:
    raise AssertionError("completion opens no vault")
