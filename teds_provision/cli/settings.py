"""Which keys config.toml may have: the options of every command, by the names that the command line gives them."""

from __future__ import annotations

import click

from teds_provision.cli.table import COMMANDS


def known_settings(group: click.Group) -> dict[str, frozenset[str]]:
    """Names that may stand in config.toml: under "" outside of a table, under a command's name in its table.

    A name is that of an option without its dashes, written with ``-`` or ``_``. Loads every command.
    """
    context = click.Context(group)
    of = {name: _names(group.get_command(context, name)) for name in COMMANDS}
    everywhere = frozenset[str]().union(_own(group), *of.values())
    return {"": everywhere, **of}


def _names(command: click.Command | None) -> frozenset[str]:
    if command is None:
        return frozenset()
    inner = command.commands.values() if isinstance(command, click.Group) else ()
    names = frozenset(part.name for part in inner if part.name)
    return _own(command).union(names, *map(_names, inner))


def _own(command: click.Command) -> frozenset[str]:
    options = (option for option in command.params if isinstance(option, click.Option))
    return frozenset(word.lstrip("-") for option in options for word in (*option.opts, *option.secondary_opts))
