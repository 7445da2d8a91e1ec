"""Global options stand before or after the command: they are brought to the front before click reads the line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Final

import click

_FLAGS: Final = frozenset({"--json", "--verbose", "--quiet", "--debug", "--no-input", "-q", "-v", "-vv", "-vvv"})
_WITH_VALUE: Final = frozenset({"--home", "--passphrase-fd"})


def in_front(arguments: Sequence[str], command_of: Callable[[str], click.Command | None]) -> list[str]:
    """The command line with every global option before the command; what belongs to the command stays in its order.

    ``command_of`` gives a command by its name (None: there is none); it is asked only where a global option comes after
    one, so that nothing is imported without need. An option that the command has itself, and the value of one of its
    options, are left alone; so is all that follows ``--``.
    """
    at = _command_at(arguments)
    if at is None or not any(_name(word) in _FLAGS | _WITH_VALUE for word in arguments[at + 1 :]):
        return list(arguments)
    own, valued = _options(command_of(arguments[at]), arguments[at + 1 :])
    front, rest = list(arguments[:at]), [arguments[at]]
    words = iter(arguments[at + 1 :])
    for word in words:
        if _name(word) in own:
            takes = _name(word) in valued and "=" not in word
            rest += [word, *(_next(words) if takes else [])]
        else:
            moved, kept = _divided(word, words)
            front += moved
            rest += kept
    return front + rest


def _divided(word: str, words: Iterator[str]) -> tuple[list[str], list[str]]:
    """What goes to the front and what stays, of a word that is none of the command's own options and its value."""
    if word == "--":
        return [], [word, *words]
    name = _name(word)
    if name in _FLAGS or (name in _WITH_VALUE and "=" in word):
        return [word], []
    value = _next(words) if name in _WITH_VALUE else []
    return ([word, *value], []) if value else ([], [word])  # where the value is missing, click says so


def _next(words: Iterator[str]) -> list[str]:
    value = next(words, None)
    return [] if value is None else [value]


def _name(word: str) -> str:
    return word.partition("=")[0] if word.startswith("--") else word


def _command_at(arguments: Sequence[str]) -> int | None:
    """Where the command stands: the first word that is neither an option nor the value of one."""
    skip = False
    for at, word in enumerate(arguments):
        if skip:
            skip = False
        elif word == "--":
            return None
        elif word.startswith("-"):
            skip = word in _WITH_VALUE
        else:
            return at
    return None


def _options(command: click.Command | None, words: Sequence[str]) -> tuple[set[str], set[str]]:
    """Options of a command (and of the command within it that is called), and those of them that take a value."""
    own: set[str] = set()
    valued: set[str] = set()
    while command is not None:
        for option in command.params:
            if isinstance(option, click.Option):
                names = {*option.opts, *option.secondary_opts}
                own |= names
                valued |= set() if option.is_flag or option.count else names
        inner = command.commands if isinstance(command, click.Group) else {}
        named = next((word for word in words if word in inner), None)
        command = inner[named] if named is not None else None
    return own, valued
