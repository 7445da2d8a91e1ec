"""Every argument and option of the command line, with what it takes and what it is if it is left out.

Scripts depend on them (docs/contract/cli.md). ``python -m tests.cli.test_options`` writes ``options.txt`` again; before
it is committed, read its difference line by line: a name that is gone, or another default, breaks scripts.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from teds_provision.cli.main import cli

KEPT = Path(__file__).parent / "options.txt"


def commands(group: click.Group, path: str = "") -> Iterator[tuple[str, click.Command]]:
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield f"{path} {name}".strip(), command
        if isinstance(command, click.Group):
            yield from commands(command, f"{path} {name}".strip())


def described(parameter: click.Parameter) -> str:
    """Return a parameter in one line: names, type, bounds, how many values, default."""
    kind = parameter.type
    words = ["|".join((*parameter.opts, *parameter.secondary_opts)), type(kind).__name__]
    if isinstance(kind, click.Choice):
        words.append("|".join(map(str, kind.choices)))
    if isinstance(kind, click.IntRange | click.FloatRange):
        words.append(f"{kind.min}..{kind.max}")
    if isinstance(parameter, click.Option):
        words += [word for word, is_so in (("flag", parameter.is_flag), ("count", parameter.count)) if is_so]
        words += ["repeatable"] if parameter.multiple else []
    words += [f"nargs {parameter.nargs}"] if parameter.nargs != 1 else []
    words += ["required"] if parameter.required else []
    default = parameter.default
    if isinstance(default, str | int | float) and default is not False:
        words.append(f"default {default}")
    return " ".join(words).rstrip()


def lines() -> Iterator[str]:
    for path, command in (("", cli), *commands(cli)):
        yield f"[{path}]"
        yield from (described(parameter) for parameter in command.params)


@pytest.mark.needs_room("plant", "check")
def test_names_types_and_defaults_of_all_options_are_those_that_scripts_know() -> None:
    assert list(lines()) == KEPT.read_text(encoding="utf-8").splitlines()


def test_every_option_is_shown_in_help() -> None:
    every = (("", cli), *commands(cli))
    assert [
        path for path, command in every for parameter in command.params if getattr(parameter, "hidden", False)
    ] == []


if __name__ == "__main__":
    KEPT.write_text("\n".join(lines()) + "\n", encoding="utf-8")
