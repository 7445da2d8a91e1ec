"""The command line: global options, lazy commands, and the one place where errors become exit codes."""

from __future__ import annotations

import contextlib
import errno
import gc
import importlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final, cast

import click

from teds_provision import __version__
from teds_provision.cli.config_file import Defaults, anchored, config_path, read_config
from teds_provision.cli.context import App, discard_output, print_message
from teds_provision.cli.option_names import PARAMETERS
from teds_provision.cli.stdout import Purpose
from teds_provision.cli.table import COMMANDS, SECTIONS
from teds_provision.errors import (
    BadDataError,
    IncompleteInstallationError,
    NotFoundError,
    StoreError,
    TedsProvisionError,
)
from teds_provision.lazy import install_command, late, missing_packages, package_of

if TYPE_CHECKING:
    import difflib
    import json
    import pathlib
    from pathlib import Path

    from teds_provision.cli import extending, file_kinds, shell_completion, start
    from teds_provision.shapes import problem
else:
    shell_completion, start = late("teds_provision.cli.shell_completion"), late("teds_provision.cli.start")
    file_kinds = late("teds_provision.cli.file_kinds")  # only for errors about a file
    problem = late("teds_provision.shapes.problem")  # the form of an error as JSON
    extending = late("teds_provision.cli.extending")  # only when a command runs
    difflib, json, pathlib = late("difflib"), late("json"), late("pathlib")  # --help needs none of them

ENVIRONMENT_PREFIX = "TEDS_PROVISION"
INTERRUPTED, BROKEN_PIPE = 130, 141
_OF_A_FILE: Final = (2, 3, 7, 8)
"""Exit codes of errors that a file of another kind can cause."""
_NO_NAMES: Final = frozenset({errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR})
"""Error numbers for names that the system rejects, wherever they are first used."""
_FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EBADF})
_SHOWING: Final = frozenset(
    [
        "check",
        "completion",
        "describe",
        "doctor",
        "history",
        "identify",
        "info",
        "label",
        "list",
        "log",
        "nodes",
        "path",
        "read",
        "sample",
        "show",
        "sql",
        "status",
        "verify",
    ]
)
"""Last words of the names of commands that are called for their output alone."""
COMPLETE = "_TEDS_PROVISION_COMPLETE"
_WIDEST, _NARROWEST = 100, 50


class LazyGroup(click.Group):
    """The top group: commands are imported when they are called, help comes from the table.

    ``teachers`` get each command that is loaded: there is one if a shell completes a command line.
    """

    teachers: ClassVar[list[Callable[[click.Command], None]]] = []

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order of the table."""
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the command's module."""
        entry = COMMANDS.get(cmd_name)
        if entry is None:
            return None
        module = importlib.import_module(f"teds_provision.{entry.room}.{entry.module}")
        command = getattr(module, entry.attribute)
        assert isinstance(command, click.Command)
        extending.extend(cmd_name, command)
        _read_by_name(command, cmd_name)
        for teach in self.teachers:
            teach(command)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Suggest the nearest command if there is none of that name."""
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            near = difflib.get_close_matches(args[0], COMMANDS, n=1)
            if near:
                raise click.UsageError(f"{error.message} Did you mean {near[0]!r}?", ctx) from None
            raise

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections of the table.

        Lines that fit are written unchanged: click would search each of them for places to break it.
        """
        width = max(map(len, COMMANDS))
        for title, entries in SECTIONS.items():
            with formatter.section(title):
                room = formatter.width - formatter.current_indent - width - 2
                for name, entry in entries.items():
                    if len(entry.help) <= room:
                        formatter.write(f"{'':>{formatter.current_indent}}{name:<{width}}  {entry.help}\n")
                    else:
                        formatter.write_dl([(name.ljust(width), entry.help)])


def _read_by_name(command: click.Command, path: str) -> None:
    """Have each option read TEDS_PROVISION_<NAME> if the code has another name for it than the command line."""
    options = {parameter: option for option, parameter in PARAMETERS.get(path, {}).items()}
    for option in command.params:
        if option.name in options and isinstance(option, click.Option):
            option.envvar = f"{ENVIRONMENT_PREFIX}_{options[option.name].replace('-', '_').upper()}"
            option.allow_from_autoenv = False
    for name, inner in command.commands.items() if isinstance(command, click.Group) else ():
        _read_by_name(inner, f"{path} {name}")


class _Folder(click.Path):
    """A folder's path, as ``click.Path(path_type=pathlib.Path)`` gives it."""

    def coerce_path_result(self, value: str | os.PathLike[str]) -> Path:
        """Return the path of a name."""
        return pathlib.Path(os.fsdecode(value))


_BROKEN: Final = "teds_provision.config_error"


def _read_config(ctx: click.Context, _parameter: click.Parameter, home: Path | None) -> Path | None:
    try:
        place = config_path(home)
        values = read_config(place)
    except BadDataError as error:
        ctx.meta[_BROKEN] = error
        return home
    if values is not None:
        ctx.default_map = Defaults(anchored(values, place.parent))
    return home


@click.group(
    cls=LazyGroup,
    invoke_without_command=True,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "auto_envvar_prefix": ENVIRONMENT_PREFIX,
        "max_content_width": _WIDEST,
    },
    epilog="Name a node by its UUID, its first four or more digits, or its name. Every option can also be "
    "set in TEDS_PROVISION_<NAME> or in config.toml in the home directory.\n\nTo try it out: teds-provision demo",
)
@click.option(
    "--home",
    type=_Folder(file_okay=False),
    is_eager=True,
    callback=_read_config,
    help="Directory of the store (default: the platform's user data directory).",
)
@click.option(
    "--json", "as_json", envvar=f"{ENVIRONMENT_PREFIX}_JSON", is_flag=True, help="Print one JSON object to stdout."
)
@click.option("--verbose", "-v", count=True, help="Log progress to stderr; twice: every command and its size.")
@click.option("--quiet", "-q", is_flag=True, help="Print only results and errors.")
@click.option("--debug", is_flag=True, help="Show tracebacks and library logs.")
@click.option("--no-input", is_flag=True, help="Never prompt; fail if input would be needed.")
@click.option("--passphrase-fd", type=int, metavar="N", help="Read the passphrase or PIN from this file descriptor.")
@click.version_option(__version__, prog_name="teds-provision", message="%(prog)s %(version)s")
@click.pass_context
def cli(ctx: click.Context, /, as_json: bool, **options: Any) -> None:
    """Identify smart transducers, key them, and write their IEEE 1451.0 datasheets (TEDS).

    Works over NFC, CAN and Bluetooth; then measures, publishes and drives actuators. Without a command: the station,
    who answers on its links now, what is wrong, and the next command.
    """
    gc.freeze()  # objects made by imports need no more collections
    gc.enable()  # it was disabled while the program was imported
    ctx.obj = App(as_json=as_json, **options)
    if ctx.invoked_subcommand != "doctor":
        require_packages()
    broken = ctx.meta.get(_BROKEN)
    # doctor reports the broken file, and runs its other checks
    if broken is not None and ctx.invoked_subcommand != "doctor":
        raise broken
    if ctx.invoked_subcommand is None:
        start.start(ctx.obj, ctx)


def require_packages() -> None:
    """Raise IncompleteInstallationError if a required package is missing, before a command signs or writes anything."""
    missing = missing_packages()
    if missing:
        raise _incomplete(*missing)


def _incomplete(*packages: str) -> IncompleteInstallationError:
    return IncompleteInstallationError(
        f"The installation is incomplete: {', '.join(packages)} missing.",
        hint=f"Install it: {install_command(*packages)}",
    )


def _lacking(module: str) -> TedsProvisionError:
    """Return the error for a module that could not be imported: of Python itself, or of a package."""
    if module in sys.stdlib_module_names:  # fcntl, which only Unix has
        return TedsProvisionError(
            f"This command needs Linux: this system has no {module}.",
            hint="docs/compatibility.md lists the commands that run on other systems.",
        )
    return _incomplete(package_of(module))


def run(arguments: list[str]) -> int:
    """Run one command line; return the exit code. Every error is printed in at most three lines."""
    asked = os.environ.get(COMPLETE)
    if asked:
        # Answer a shell that completes a command line (``bash_source``, ``bash_complete``; zsh and fish likewise).
        from click.shell_completion import shell_complete

        LazyGroup.teachers.append(shell_completion.teach)
        return shell_complete(cli, {}, "teds-provision", COMPLETE, asked)
    try:
        arguments = in_front(arguments, lambda name: cli.get_command(click.Context(cli), name))
        with cli.make_context("teds-provision", list(arguments), terminal_width=_help_width()) as ctx:
            cli.invoke(ctx)
        return 0
    except click.exceptions.Exit as finished:
        return finished.exit_code
    except (click.Abort, KeyboardInterrupt):
        return _fail(arguments, INTERRUPTED, "interrupted", "Interrupted. Run the same command again to continue.", "")
    except click.ClickException as error:
        return _misused(arguments, error)
    except TedsProvisionError as error:
        _traceback(arguments)
        kind = file_kinds.mistaken_file(arguments) if error.exit_code in _OF_A_FILE else ""
        named = kind.partition(" is ")[2].rstrip(".")
        hint = f"{kind} {error.hint}".rstrip() if kind and named not in error.message else error.hint
        return _fail(arguments, error.exit_code, error.code, error.message, hint)
    except OSError as error:
        return _system_error(arguments, error)
    except Exception as error:  # noqa: BLE001 - the last line of defence: a foreign exception is a bug of ours
        return _bug(arguments, error)
    finally:
        if App.current is not None:
            App.current.close()


def _help_width() -> int:
    """Return the columns of a help text: the terminal's less two, as click computes it, without the archive libraries.

    click asks shutil, which loads bz2 and lzma: a tenth of the time of ``--help``.
    """
    with contextlib.suppress(ValueError):
        if (asked := int(os.environ.get("COLUMNS", "0"))) > 0:
            return max(min(asked, _WIDEST) - 2, _NARROWEST)
    try:
        columns = os.get_terminal_size(sys.__stdout__.fileno() if sys.__stdout__ is not None else 1).columns
    except (OSError, ValueError, AttributeError):  # no terminal
        columns = 0
    return max(min(columns or 80, _WIDEST) - 2, _NARROWEST)


def _misused(arguments: list[str], error: click.ClickException) -> int:
    if isinstance(error, click.exceptions.NoArgsIsHelpError):  # a group without a command: print its help
        if _wants(arguments, "--json"):
            return _fail(arguments, 2, "usage", f"Missing command. (see: {error.ctx.command_path} --help)", "")
        print(error.format_message(), file=sys.stderr)
        return 2
    text, hint = " ".join(error.format_message().split()), ""  # click lists choices one in a line
    if isinstance(error, click.UsageError) and error.ctx is not None:
        text += f" (see: {error.ctx.command_path} --help)"
    if isinstance(error, click.NoSuchOption) and any(error.option_name in option.opts for option in cli.params):
        hint = f"{error.option_name} is a global option: teds-provision {error.option_name} COMMAND …"
    return _fail(arguments, 2, "usage", text, hint)


def _system_error(arguments: list[str], error: OSError) -> int:
    """Handle what the system refused: the reader of stdout has gone, a file's name is invalid, the disk is full."""
    if isinstance(error, BrokenPipeError):
        discard_output(sys.stdout)
        return BROKEN_PIPE
    if error.errno in _NO_NAMES and error.filename is not None:
        name = str(error.filename)
        name = name if len(name) <= 100 else f"{name[:64]}…"
        text = f"{name!r} is not a valid file name: {error.strerror}."
        return _fail(arguments, NotFoundError.exit_code, NotFoundError.code, text, "")
    if error.errno not in _FULL:
        return _bug(arguments, error)
    discard_output(sys.stdout)  # stdout was full; errors of stores and files have their own classes
    text = f"Cannot write the result to stdout: {error.strerror}."
    return _fail(arguments, StoreError.exit_code, StoreError.code, text, "")


def _bug(arguments: list[str], error: Exception) -> int:
    _traceback(arguments)
    if isinstance(error, ModuleNotFoundError) and error.name and not error.name.startswith("teds_provision"):
        lacks = _lacking(error.name)
        return _fail(arguments, lacks.exit_code, lacks.code, lacks.message, lacks.hint)
    hint = "This is a bug. Please report it with the output of --debug."
    return _fail(arguments, 1, "bug", f"Unexpected {type(error).__name__}.", hint)


def purpose_of(arguments: list[str]) -> Purpose:
    """Return what a run of these arguments is for.

    It has failed once its output is lost if that is JSON, which a program reads, or if it only shows what is there.
    Any other has done its work all the same.
    """
    name = _command_name(arguments)
    writes = any(word.startswith(("--output", "-o")) for word in arguments)
    shows = name in _SHOWING or (name == "export" and "-" in arguments)
    only_shows = not name or (shows and not writes)
    return Purpose(only_shows, must_print=only_shows or _wants(arguments, "--json"))


def _command_name(arguments: list[str]) -> str:
    """Return the last word of the command's name, "" without one: ``list`` of ``whitelist list``."""
    context, group, name = click.Context(cli), cast("click.Group", cli), ""
    words = in_front(arguments, lambda word: cli.get_command(context, word))
    at = _command_at(words)
    for word in words[at:] if at is not None else ():
        if word.startswith("-"):
            continue
        found = group.get_command(context, word)
        if found is not None:
            name = word
        if not isinstance(found, click.Group):
            break
        group = found
    return name


def _wants(arguments: list[str], option: str) -> bool:
    name = option.strip("-")
    if App.current is not None and getattr(App.current, name):
        return True
    setting = os.environ.get(f"{ENVIRONMENT_PREFIX}_{name.upper()}", "").lower()
    return option in arguments or (App.current is None and setting in ("1", "true", "yes", "on", "t", "y"))


def _traceback(arguments: list[str]) -> None:
    if _wants(arguments, "--debug"):
        import traceback

        traceback.print_exc()


def _fail(arguments: list[str], exit_code: int, code: str, message: str, hint: str) -> int:
    if App.current is not None:
        App.current.live_line()  # removes it before any other output
    if _wants(arguments, "--json"):
        with contextlib.suppress(OSError):
            print(json.dumps(problem.Error(error=problem.Problem(code=code, message=message, hint=hint))), flush=True)
    else:
        _print_message(message if exit_code == INTERRUPTED else f"Error: {message}")
        if hint:
            _print_message(f"  → {hint}")
    return exit_code


def _print_message(text: str) -> None:
    with contextlib.suppress(OSError):
        print_message(text)


# Global options may be given before or after the command; they are moved to the front before click parses the line.

_FLAGS: Final = frozenset({"--json", "--verbose", "--quiet", "--debug", "--no-input", "-q", "-v", "-vv", "-vvv"})
_WITH_VALUE: Final = frozenset({"--home", "--passphrase-fd"})


def in_front(arguments: Sequence[str], command_of: Callable[[str], click.Command | None]) -> list[str]:
    """Return the command line with every global option before the command.

    The command's own arguments keep their order.

    ``command_of`` returns a command by its name (None: there is none); it is called only if a global option comes after
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
    """Return which parts of a word go to the front and which stay.

    The word is none of the command's own options and its value.
    """
    if word == "--":
        return [], [word, *words]
    name = _name(word)
    if name in _FLAGS or (name in _WITH_VALUE and "=" in word):
        return [word], []
    value = _next(words) if name in _WITH_VALUE else []
    return ([word, *value], []) if value else ([], [word])  # if the value is missing, click reports it


def _next(words: Iterator[str]) -> list[str]:
    value = next(words, None)
    return [] if value is None else [value]


def _name(word: str) -> str:
    return word.partition("=")[0] if word.startswith("--") else word


def _command_at(arguments: Sequence[str]) -> int | None:
    """Return the index of the command: the first word that is neither an option nor the value of one."""
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
    """Return the options of a command and of the command within it that is called, and those that take a value."""
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
