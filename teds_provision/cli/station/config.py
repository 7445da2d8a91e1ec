"""``config``: show and change settings, with their origin; ``completion``: the lines for a shell."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from teds_provision.cli import shell_completion
from teds_provision.cli.config_file import (
    BROKERS,
    anchored,
    config_path,
    parameter_of,
    problems,
    read_config,
    read_config_text,
)
from teds_provision.cli.context import App, Console, pass_app, to_json
from teds_provision.cli.main import COMPLETE
from teds_provision.cli.option_names import OPTIONS
from teds_provision.cli.options import COMMAND_SETTINGS, command, examples
from teds_provision.errors import BadDataError, UsageError
from teds_provision.files import write_whole
from teds_provision.limits import load_toml
from teds_provision.links.can import spec
from teds_provision.station.store.database import prepare_home
from teds_provision.station.store.lock import StoreLock

_PREFIX = "TEDS_PROVISION_"
_BARE = re.compile(r"[A-Za-z0-9_-]+")
"""Names that TOML takes without quotes."""


@click.group(
    context_settings=COMMAND_SETTINGS, epilog=examples("teds-provision config show", "teds-provision config path")
)
def config() -> None:
    """Show and change the settings in config.toml and the environment. docs/configuration.md lists them all."""


@config.command(
    "path",
    context_settings=COMMAND_SETTINGS,
    short_help="Print the path of config.toml.",
    epilog=examples("teds-provision config path"),
)
@pass_app
def path_(app: App) -> None:
    """Print the path of this home's config.toml, whether or not it exists."""
    place = config_path(app.home)
    app.emit({"path": str(place), "exists": place.is_file()}, str(place))


@config.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Show all settings and their sources.",
    epilog=examples("teds-provision config show"),
)
@click.pass_context
@pass_app
def show(app: App, ctx: click.Context) -> None:
    """Show every setting, its value and its source; an invalid value is an error (exit 8)."""
    place = config_path(app.home)
    values = read_config(place) or {}
    root = ctx.find_root()
    assert isinstance(root.command, click.Group)
    check_values(root, values, place)
    home = "--home" if root.get_parameter_source("home") == click.core.ParameterSource.COMMANDLINE else "default"
    source = f"environment ({_PREFIX}HOME)" if os.environ.get(f"{_PREFIX}HOME") and home == "default" else home
    settings = [{"name": "home", "value": str(app.home), "source": source}]
    settings += [
        _from_environment(name, app)
        for name in sorted(os.environ)
        if name.startswith(_PREFIX) and name != f"{_PREFIX}HOME"
    ]
    settings += [{"name": name, "value": value, "source": str(place)} for name, value in _flat(values)]
    app.emit({"settings": settings}, lambda console: _table(console, settings))


def check_values(root: click.Context, values: Mapping[str, Any], place: Path) -> None:
    """Have click read every value of config.toml as its command would.

    Raises BadDataError for the first that is bad.
    """
    for name, value in _flat(anchored(dict(values), place.parent)):
        _check_value(root, name, value, place)


def _from_environment(name: str, app: App) -> dict[str, Any]:
    option = name.removeprefix(_PREFIX).lower().replace("_", "-")
    if not any(option in options for options in OPTIONS.values()):
        app.warn(f"{name} is set, but no command has an option --{option}.")
    return {"name": option, "value": os.environ[name], "source": f"environment ({name})"}


def _flat(values: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{name}.")
        else:
            yield f"{above}{name}", value


def _check_value(root: click.Context, name: str, value: Any, place: Path) -> None:
    """Have click read a value as the command would; raises BadDataError."""
    found = _parameter(root, name, several=isinstance(value, list))
    if found is None:
        return
    path, command, option = found
    if option.multiple and not isinstance(value, list):
        value = [value]
    if isinstance(value, list) and not option.multiple:
        raise BadDataError(f"{place}: {name} takes one value, not {len(value)}.", hint="Fix that line.")
    try:
        option.process_value(click.Context(command, parent=root, info_name=path), value)
    except click.BadParameter as error:
        reason = error.message.rstrip(".")
        raise BadDataError(f"{place}: {name} = {value!r}: {reason}.", hint="Fix that line.") from error


def _parameter(
    root: click.Context, name: str, *, several: bool = False
) -> tuple[str, click.Command, click.Option] | None:
    """Return the first command that a setting serves, with its path and the option; None for a broker.

    ``several``: prefer a command that takes several values of it.
    """
    *words, option = name.replace("_", "-").split(".")
    found = None
    for path, options in OPTIONS.items():
        if option not in options or path.split()[: len(words)] != words:
            continue
        command, wanted = _command(root, path), parameter_of(path, option)
        for parameter in command.params:
            if parameter.name == wanted and isinstance(parameter, click.Option):
                found = found or (path, command, parameter)
                if parameter.multiple or not several:
                    return path, command, parameter
    return found


def _command(root: click.Context, path: str) -> click.Command:
    found = root.command
    for word in path.split():
        assert isinstance(found, click.Group)
        inner = found.get_command(root, word)
        assert inner is not None
        found = inner
    return found


def _table(console: Console, settings: list[dict[str, Any]]) -> None:
    width = max(len(str(setting["name"])) for setting in settings)
    for setting in settings:
        console.print(f"{setting['name']:{width}}  {setting['value']}  [{setting['source']}]", markup=False)


@config.command(
    "set",
    context_settings=COMMAND_SETTINGS | {"ignore_unknown_options": True},
    short_help="Write a setting to config.toml.",
    epilog=examples(
        "teds-provision config set can 'socketcan:can0?bitrate=500000'",
        "teds-provision config set provision.via can",
        "teds-provision config set whitelist.add.dry-run true",
    ),
)
@click.argument("name")
@click.argument("value")
@click.pass_context
@pass_app
def set_(app: App, ctx: click.Context, name: str, value: str) -> None:
    """Write a setting to config.toml, as NAME for every command that has this option, or COMMAND.NAME for one.

    Comments and the other settings stay. A flag takes true or false; several values are written ["a", "b"].
    """
    root, place = ctx.find_root(), config_path(app.home)
    typed = _from_here(name, _typed(root, name, value))
    changed = _edit(app, "config set", name, typed)
    verb = "Set" if changed else "Nothing to do:"
    app.emit({"settings": [{"name": name, "value": typed, "source": str(place)}]}, f"{verb} {name} = {_toml(typed)}")


@config.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Remove a setting from config.toml.",
    epilog=examples("teds-provision config unset provision.via"),
)
@click.argument("name")
@pass_app
def unset(app: App, name: str) -> None:
    """Remove a setting from config.toml; comments and the other settings stay."""
    changed = _edit(app, "config unset", name, None)
    text = f"Removed {name}." if changed else f"Nothing to do: {name} is not set in config.toml."
    app.emit({"settings": [], "removed": name if changed else None}, text)


def _typed(root: click.Context, name: str, value: str) -> Any:
    """Return the value as the option parses it, typed as in TOML; raises UsageError for an invalid name or value."""
    *words, option = name.replace("_", "-").split(".")
    listed: Any = None
    if value.startswith("["):
        with suppress(BadDataError):
            listed = load_toml(f"x = {value}", name)["x"]
    nested: dict[str, Any] = {option: value if listed is None else listed}
    for word in reversed(words):
        nested = {word: nested}
    for problem in problems(nested, ""):
        raise UsageError(f"{name}: {problem.partition(': ')[2]}", hint="See docs/configuration.md.")
    parameter = _parameter(root, name, several=listed is not None)
    if parameter is None:  # the URL of a broker
        return value if listed is None else listed
    path, command, option_ = parameter
    if listed is not None and not option_.multiple:
        raise UsageError(f"{name} takes one value, not {len(listed)}.")
    given = [value] if listed is None else listed
    try:
        context = click.Context(command, parent=root, info_name=path)
        read = option_.process_value(context, given if option_.multiple else value)
    except click.BadParameter as error:
        raise UsageError(f"{name}: {error.message.rstrip('.')}.") from error
    if option_.name == "can":
        for bus in given:
            spec.parse_spec(bus)  # a wrong value would make every command fail
    if listed is not None:
        return listed
    return read if isinstance(read, bool | int | float) else value


def _from_here(name: str, value: Any) -> Any:
    """Return the value with its path as the user meant it, from the folder in which the command was typed."""
    nested: dict[str, Any] = {}
    inner = nested
    *words, option = name.split(".")
    for word in words:
        inner = inner.setdefault(word, {})
    inner[option] = value
    whole: Any = anchored(nested, Path.cwd())
    for word in (*words, option):
        whole = whole[word]
    return whole


def _edit(app: App, command: str, name: str, value: Any) -> bool:
    """Set or (None) remove one setting under the store's lock; False if nothing had to change.

    TOML has more spellings than this edit knows (inline tables, dotted keys): the result is parsed again, and written
    only if it has exactly the wanted content. Otherwise raises BadDataError, with nothing changed.
    """
    place = config_path(app.home)
    *table, key = name.split(".")
    table = [word.replace("_", "-") for word in table]
    if " ".join(table) != BROKERS:
        key = key.replace("_", "-")
    if value is not None:
        prepare_home(app.home, create=True)  # a setting may come before init
    elif not place.exists():
        return False
    with StoreLock(app.home, command=command, notice=app.note):
        text = read_config_text(place) or ""
        wanted = _plain(load_toml(text, str(place)))
        inner = wanted
        for word in table:
            inner = inner.setdefault(word, {})
        if inner.get(key) == value:
            return False
        inner.pop(key, None)
        if value is not None:
            inner[key] = value
        edited = _edited(text, table, key, value)
        with suppress(BadDataError):
            if _pruned(_plain(load_toml(edited, str(place)))) == _pruned(wanted):
                write_whole(place, edited.encode())
                return True
    raise BadDataError(
        f"{place} writes {name} in a way that this command cannot edit.", hint=f"Edit it by hand: {place}"
    )


def _edited(text: str, table: list[str], key: str, value: Any) -> str:
    """Return the text with one key of one table set, or (None) without its line; a comment behind the value stays."""
    lines = text.splitlines()
    there = _lines_of(lines, table)
    start, end = there or (len(lines), len(lines))
    pattern = re.escape(key) if " ".join(table) == BROKERS else re.escape(key).replace(r"\-", "[-_]")
    line = f"{key if _BARE.fullmatch(key) else to_json(key)} = {_toml(value)}"
    for number in range(start, end):
        found = re.match(rf"(\s*(['\"]?){pattern}\2\s*=\s*)(.*)", lines[number])
        if found is None:
            continue
        if value is None:
            del lines[number]
        else:
            lines[number] = f"{found[1]}{_toml(value)}{_comment(found[3])}"
        return "\n".join([*lines, ""])
    if value is None:
        return text
    if there is None:
        lines += [*([""] if lines else []), f"[{'.'.join(table)}]", line]
        return "\n".join([*lines, ""])
    set_lines = [n for n in range(start, end) if lines[n].strip() and not lines[n].lstrip().startswith("#")]
    first = next((n for n in range(start, end) if not lines[n].startswith("#")), end) if not table else start
    lines.insert(set_lines[-1] + 1 if set_lines else first, line)
    return "\n".join([*lines, ""])


def _lines_of(lines: list[str], table: list[str]) -> tuple[int, int] | None:
    """Return the lines between which the keys of a table (the last of its name) are, None without one."""
    found = None if table else (0, len(lines))
    inside = not table
    for number, line in enumerate(lines):
        header = re.match(r"\s*\[([^\[\]]+)\]", line)
        if header is not None and inside and found is not None:
            found, inside = (found[0], number), False
        elif header is not None and [w.strip().strip("'\"").replace("_", "-") for w in header[1].split(".")] == table:
            found, inside = (number + 1, len(lines)), True
    return found


def _comment(rest: str) -> str:
    """Return what follows the value of a line, with the blanks before it: "" if there is no comment."""
    for at in (n for n, character in enumerate(rest) if character == "#"):
        with suppress(BadDataError):
            load_toml(f"x = {rest[:at]}", "")
            return rest[len(rest[:at].rstrip()) :]
    return ""


def _toml(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_toml, value))}]"
    return str(value) if isinstance(value, int | float) and not isinstance(value, bool) else to_json(value)


def _plain(values: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Return the settings with dashes in all names, so that both spellings are one setting; brokers keep theirs."""
    plain = {}
    for name, value in values.items():
        key = name if above == BROKERS else name.replace("_", "-")
        plain[key] = _plain(value, f"{above} {key}".strip()) if isinstance(value, dict) else value
    return plain


def _pruned(values: dict[str, Any]) -> dict[str, Any]:
    """Return the settings without empty tables: they set nothing."""
    inner = {name: _pruned(value) if isinstance(value, dict) else value for name, value in values.items()}
    return {name: value for name, value in inner.items() if value != {}}


@command("teds-provision completion bash", "teds-provision completion fish")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@pass_app
def completion(app: App, shell: str) -> None:
    """Print the shell script that completes commands, options, names, UUIDs, profiles and files.

    In bash: eval "$(teds-provision completion bash)"
    """
    root = click.get_current_context().find_root().command
    script = shell_completion.SHELLS[shell](root, {}, "teds-provision", COMPLETE).source()
    app.emit({"shell": shell, "script": script}, lambda console: print(script))
