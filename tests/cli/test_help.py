"""Help is written for every command, its examples can be typed as they stand, and showing it loads nothing heavy."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import click
import pytest

from teds_provision.cli import extending
from teds_provision.cli.main import cli
from teds_provision.cli.table import COMMANDS, GROUPS
from teds_provision.optional_rooms import OptionalRoom

from .shell import clean_environment, python, spawn

HEAVY = ("nfc", "can", "isotp", "keyring", "rich", "cryptography", "pint", "numpy", "matplotlib", "pkcs11", "sqlite3")
PROGRAM = "teds-provision"
WIDTH, TERMINAL = 100, 80


def walk(group: click.Group, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Yield every command under a group, with the words that call it."""
    with click.Context(group) as context:
        for name in group.list_commands(context):
            command = group.get_command(context, name)
            assert command is not None
            yield (*path, name), command
            if isinstance(command, click.Group):
                yield from walk(command, (*path, name))


ALL = dict(walk(cli, ()))
every_command = pytest.mark.parametrize(("words", "command"), ALL.items(), ids=[" ".join(words) for words in ALL])


def examples(command: click.Command) -> list[str]:
    """Return the lines under "Examples:" in a command's help."""
    lines = (command.epilog or "").splitlines()
    return [line.strip() for line in lines[lines.index("Examples:") + 1 :]] if "Examples:" in lines else []


def chain(stack: ExitStack, words: list[str]) -> list[click.Context]:
    """Parse a command line as the program does, and run nothing of it."""
    contexts = [cli.make_context(PROGRAM, words)]
    while True:
        context = stack.enter_context(contexts[-1])
        if not isinstance(context.command, click.Group):
            return contexts
        rest = [*context._protected_args, *context.args]
        name, command, rest = context.command.resolve_command(context, rest)
        assert command is not None
        contexts.append(command.make_context(name, rest, parent=context))


def test_the_table_says_which_commands_have_commands_of_their_own() -> None:
    assert {words[0] for words in ALL if len(words) > 1} == GROUPS
    assert {words[0] for words in ALL} == set(COMMANDS)


@every_command
def test_every_command_says_in_a_sentence_what_it_does(words: tuple[str, ...], command: click.Command) -> None:
    first = (command.help or "").split("\n\n")[0].strip()
    assert first.endswith((".", "!")), f"{words}: {first!r}"
    assert first[0].isupper()


@every_command
def test_the_line_in_its_groups_help_is_whole(words: tuple[str, ...], command: click.Command) -> None:
    longest = max(len(other[-1]) for other in ALL if other[:-1] == words[:-1])
    if len(words) == 1:
        assert len(COMMANDS[words[0]].help) < WIDTH - longest - 4
        return
    room = TERMINAL - 2 - longest - 6  # as click counts
    line = command.get_short_help_str(room)
    assert not line.endswith("..."), line
    assert len(line) <= room


@every_command
def test_every_option_is_explained(words: tuple[str, ...], command: click.Command) -> None:
    options = [parameter for parameter in command.params if isinstance(parameter, click.Option)]
    unexplained = [option.opts[-1] for option in options if not (option.help or "").strip()]
    assert not unexplained
    for option in options:  # INTEGER or PATH alone would say nothing of what is meant
        if not option.is_flag and not isinstance(option.type, click.Choice) and option.name != "name":
            assert option.metavar, f"{words}: {option.opts[-1]}"


@every_command
def test_every_command_has_an_example_of_itself(words: tuple[str, ...], command: click.Command) -> None:
    lines = examples(command)
    assert lines
    for line in lines:
        with ExitStack() as stack:
            contexts = chain(stack, shlex.split(line.partition(" > ")[0])[1:])
            assert line.split()[0] == PROGRAM
            assert tuple(context.info_name for context in contexts[1:])[: len(words)] == words, line


@every_command
def test_help_fits_the_width_it_is_written_for(words: tuple[str, ...], command: click.Command) -> None:
    with click.Context(command, info_name=" ".join((PROGRAM, *words)), max_content_width=WIDTH) as context:
        shown = command.get_help(context)
    prose = [line for line in shown.splitlines() if PROGRAM not in line]
    assert max(map(len, prose)) <= WIDTH


def test_examples_fit_on_a_line() -> None:
    assert {line for command in ALL.values() for line in examples(command) if len(line) > WIDTH + 10} == set()


def test_the_help_of_no_command_loads_anything_heavy() -> None:
    code = (
        "import sys\n"
        "from teds_provision.cli.main import run\n"
        f"for words in {[list(words) for words in ALL]!r}:\n"
        "    assert run([*words, '--help']) == 0, words\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)\n"
    )
    done = python(code)
    assert done.err.strip() == "[]"
    assert done.out.count("Usage: ") == len(ALL)


def test_a_command_that_is_missing_in_a_group_shows_its_help() -> None:
    path = f"{PROGRAM} trust"
    shown = spawn("trust")
    assert (shown.code, shown.out) == (2, "")
    assert shown.err.startswith(f"Usage: {path} [OPTIONS] COMMAND")
    outcome = spawn("--json", "trust")
    assert outcome.code == 2
    assert outcome.json["error"]["message"] == f"Missing command. (see: {path} --help)"


def test_the_program_alone_says_what_comes_first(tmp_path: Path) -> None:
    shown = spawn("--home", tmp_path / "new")
    assert (shown.code, shown.err) == (0, "")
    assert "Next: teds-provision init" in shown.out
    assert not (tmp_path / "new").exists(), "it only looks"


@pytest.mark.parametrize(
    ("typed", "offered"),
    [("teds-provision pro", ["provision", "profile"]), ("teds-provision provision --via c", ["can"])],
)
def test_a_shell_is_told_how_a_line_goes_on(typed: str, offered: list[str]) -> None:
    asked = {"_TEDS_PROVISION_COMPLETE": "bash_complete", "COMP_WORDS": typed}
    outcome = spawn(environment=clean_environment(**asked, COMP_CWORD=str(len(typed.split()) - 1)))
    assert outcome.code == 0
    assert outcome.out.splitlines() == [f"plain,{word}" for word in offered]
    assert (
        "_teds_provision_completion" in spawn(environment=clean_environment(_TEDS_PROVISION_COMPLETE="bash_source")).out
    )


def test_every_output_file_is_named_by_o_too() -> None:
    without = {
        words
        for words, command in ALL.items()
        for option in command.params
        if "--output" in option.opts and "-o" not in option.opts
    }
    assert without == set()


def test_examples_of_a_room_stand_behind_the_last_one_of_the_core() -> None:
    command = click.Command("x", epilog="Examples:\n  x a\n  x b\n  y a\nEnd.")
    extending.add_examples(command, " a", "x c", "x d")
    assert command.epilog == "Examples:\n  x a\n  x b\n  y a\n  x c\n  x d\nEnd."


def test_every_room_extends_a_command_that_it_names_once(monkeypatch: pytest.MonkeyPatch) -> None:
    course: list[tuple[str, str, click.Command]] = []
    present = {
        "one": OptionalRoom(extends={"nodes": "a:f", "log": "a:g"}),
        "two": OptionalRoom(),
        "three": OptionalRoom(extends={"nodes": "b:h"}),
    }
    monkeypatch.setattr(extending, "rooms", lambda: present)
    monkeypatch.setattr(extending, "load", lambda room, place: lambda command: course.append((room, place, command)))
    monkeypatch.setattr(extending, "_EXTENDED", set())
    nodes, other = click.Command("nodes"), click.Command("groups")
    for command in (nodes, other, nodes):
        extending.extend(str(command.name), command)
    assert course == [("one", "a:f", nodes), ("three", "b:h", nodes)]


def test_options_of_a_room_stand_behind_one_of_the_core_in_their_order() -> None:
    given = [click.Option(["--a"]), click.Argument(["b"]), click.Option(["-c", "--long"])]
    command = click.Command("x", params=[*given])
    more = [click.Option(["--d"]), click.Option(["--e"])]
    extending.add_options(command, "--a", *more)
    assert command.params == [given[0], *more, given[1], given[2]]
    assert extending.option_of(command, "--long") is given[2]
