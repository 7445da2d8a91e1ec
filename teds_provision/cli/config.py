"""``config``: what is set, where, and to what; ``completion``: the lines that a shell wants."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from teds_provision.cli import completing
from teds_provision.cli.configuration import as_parameters, config_path, read_config
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.main import COMPLETE
from teds_provision.cli.option_names import OPTIONS
from teds_provision.cli.options import COMMAND_SETTINGS, command, examples
from teds_provision.errors import BadData

if TYPE_CHECKING:
    from rich.console import Console

_PREFIX = "TEDS_PROVISION_"


@click.group(
    context_settings=COMMAND_SETTINGS, epilog=examples("teds-provision config show", "teds-provision config path")
)
def config() -> None:
    """Show the settings in config.toml and the environment. docs/configuration.md lists every option and variable."""


@config.command("path", context_settings=COMMAND_SETTINGS, epilog=examples("teds-provision config path"))
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
    settings += [_from_environment(name, app) for name in sorted(os.environ) if _is_ours(name)]
    settings += [{"name": name, "value": value, "source": str(place)} for name, value in _flat(values)]
    app.emit({"settings": settings}, lambda console: _table(console, settings))


def check_values(root: click.Context, values: Mapping[str, Any], place: Path) -> None:
    """Have click read every value of config.toml as its command would; raises BadData for the first that is bad."""
    for name, value in _flat(values):
        _check_value(root, name, value, place)


def _is_ours(name: str) -> bool:
    return name.startswith(_PREFIX) and name != f"{_PREFIX}HOME"


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
    """Have click read a value as the command would; raises BadData."""
    *words, option = name.replace("_", "-").split(".")
    for path, options in OPTIONS.items():
        if option in options and path.split()[: len(words)] == words:
            found = _command(root, path)
            parameter = next(iter(as_parameters({option: value})))
            for each in found.params:
                if each.name == parameter:
                    try:
                        each.process_value(click.Context(found, parent=root, info_name=path), value)
                    except click.BadParameter as error:
                        said = error.message.rstrip(".")
                        raise BadData(f"{place}: {name} = {value!r}: {said}.", hint="Fix that line.") from error
            return


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


@command("teds-provision completion bash", "teds-provision completion fish")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@pass_app
def completion(app: App, shell: str) -> None:
    """Print the shell script that completes commands, options, names, UUIDs, profiles and files.

    In bash: eval "$(teds-provision completion bash)"
    """
    root = click.get_current_context().find_root().command
    script = completing.SHELLS[shell](root, {}, "teds-provision", COMPLETE).source()
    app.emit({"shell": shell, "script": script}, lambda console: print(script))
