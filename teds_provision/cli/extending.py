"""Lets an optional room extend a command of the core: with options, examples, and their handling.

A room registers a function by the command's name (``extends`` of its ``ROOM``). The function is given the command when
it is first used, and changes it with what is here. The options of a room that is absent do not exist.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from teds_provision.optional_rooms import load, rooms


def extend(name: str, command: click.Command) -> None:
    """Have each room that is present change a command of the core, once."""
    if name in _EXTENDED:
        return
    _EXTENDED.add(name)
    for room, registered in rooms().items():
        if name in registered.extends:
            load(room, registered.extends[name])(command)


_EXTENDED: set[str] = set()


def option_of(command: click.Command, name: str) -> click.Option:
    """Return an option of a command by its long name."""
    return next(option for option in command.params if isinstance(option, click.Option) and name in option.opts)


def add_options(command: click.Command, after: str, *options: click.Option) -> None:
    """Put options behind the one of that long name, in this order."""
    place = command.params.index(option_of(command, after)) + 1
    command.params[place:place] = options


def add_examples(command: click.Command, after: str, *lines: str) -> None:
    """Put lines into the examples of a command's help, behind the last one that ends with ``after``."""
    rows = (command.epilog or "").split("\n")
    place = max(number for number, row in enumerate(rows) if row.endswith(after)) + 1
    rows[place:place] = [f"  {line}" for line in lines]
    command.epilog = "\n".join(rows)


def callback_of(command: click.Command) -> Callable[..., Any]:
    """Return the function that a command calls with its options."""
    assert command.callback is not None
    return command.callback
