"""Completions for a node, a group, a profile, a station or a file; quick however many there are.

Names come from foreign nodes, bundles and sheets. The shell itself quotes what it inserts: a name with spaces stays one
word, and one with ``$(…)`` runs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final

import click
from click.shell_completion import (
    BashComplete,
    CompletionItem,
    FishComplete,
    ShellComplete,
    ZshComplete,
    add_completion_class,
)

from teds_provision import teds
from teds_provision.cli.config_file import home_of
from teds_provision.errors import TedsProvisionError
from teds_provision.lazy import late
from teds_provision.sanitize import printable

if TYPE_CHECKING:
    from teds_provision.station import station as stations
else:  # commands, options and files are completed without the store
    stations = late("teds_provision.station.station")

_NODES: Final = frozenset({"uuid", "uuids", "what", "old", "new", "node", "nodes", "text", "names"})
_MOST: Final = 50
_BASH: Final = r"""
%(complete_func)s() {
    local IFS=$'\n' word="${COMP_WORDS[COMP_CWORD]}" response type value
    response=$(env COMP_WORDS="${COMP_WORDS[*]}" COMP_CWORD="$COMP_CWORD" %(complete_var)s=bash_complete "$1")
    COMPREPLY=()
    while IFS=',' read -r type value; do
        case $type in
            dir) COMPREPLY=(); compopt -o dirnames ;;
            file) COMPREPLY=(); compopt -o default ;;
            plain)
                case $word in  # bash inserts it as it stands
                    \'*)
                        value=${value//\'/\'\\\'\'}
                        [[ $value == *\' ]] && value="$value'"  # else bash takes it for the end of the word
                        ;;
                    \"*)
                        value=${value//\\/\\\\}
                        value=${value//\"/\\\"}
                        value=${value//\$/\\\$}
                        value=${value//\`/\\\`}
                        [[ $value == *\" ]] && value="$value\""
                        ;;
                    *) printf -v value '%%q' "$value" ;;
                esac
                COMPREPLY+=("$value")
                ;;
        esac
    done <<< "$response"
    return 0
}

complete -o nosort -F %(complete_func)s %(prog_name)s
"""


class Bash(BashComplete):
    """Bash, which inserts completions unchanged: the script quotes them as the word was begun."""

    name: ClassVar[str] = "bash"
    source_template: ClassVar[str] = _BASH


class Zsh(ZshComplete):
    """zsh, in whose lists a backslash in front of a character means that character."""

    name: ClassVar[str] = "zsh"

    def format_completion(self, item: CompletionItem) -> str:
        """Return one word with its description; without a description nothing needs escaping."""
        if not item.help:
            return super().format_completion(item)
        return super().format_completion(CompletionItem(item.value.replace("\\", "\\\\"), item.type, item.help))


class Fish(FishComplete):
    """fish, with words that have a comma in them."""

    name: ClassVar[str] = "fish"
    source_template: ClassVar[str] = FishComplete.source_template.replace("string split ", "string split --max 1 ")


SHELLS: Final[dict[str, type[ShellComplete]]] = {shell.name: shell for shell in (Bash, Zsh, Fish)}
for _shell in SHELLS.values():
    add_completion_class(_shell)

Offer = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]


def teach(command: click.Command) -> None:
    """Let the parameters of a command complete what they name, by their names."""
    for parameter in command.params:
        offer = _offer_for(parameter)
        if offer is not None:
            parameter._custom_shell_complete = offer
    for inner in command.commands.values() if isinstance(command, click.Group) else ():
        teach(inner)


def _offer_for(parameter: click.Parameter) -> Offer | None:
    if isinstance(parameter, click.Argument):
        if parameter.name in _NODES:
            return _nodes
        return {"files": _files, "name": _named}.get(parameter.name or "")
    return {
        "profile": _profiles,
        "extends": _profiles,
        "group": _groups,
        "receivers": _stations,
        "diff": _files,
        "files": _files,
    }.get(parameter.name or "")


def _home(ctx: click.Context) -> Path:
    return home_of(ctx.find_root().params.get("home"))


def _items(ctx: click.Context, found: Callable[[stations.Station], Iterable[tuple[str, str]]]) -> list[CompletionItem]:
    """Return completions from the store, each with a description; empty without a store, and no word of two lines."""
    try:
        station = stations.Station.open(_home(ctx), ask=_nobody)
    except TedsProvisionError:
        return []
    try:
        words = [(word, what) for word, what in found(station) if word.isprintable()]
    except TedsProvisionError:
        return []
    finally:
        station.close()
    return [CompletionItem(word, help=printable(what)) for word, what in words]


def _nodes(ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return UUIDs and names of known nodes, and groups or files if the parameter accepts them."""
    groups = _groups(ctx, parameter, incomplete) if parameter.name == "what" else []
    nodes = _items(ctx, lambda station: station.nodes.beginning_with(incomplete, _MOST))
    return [*groups, *nodes] or _files(ctx, parameter, incomplete)


def _groups(ctx: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    return _items(
        ctx,
        lambda station: [(group.name, "group") for group in station.groups.all() if group.name.startswith(incomplete)],
    )


def _stations(ctx: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    return _items(
        ctx,
        lambda station: [
            (trusted.name, trusted.role) for trusted in station.policy.listed() if trusted.name.startswith(incomplete)
        ],
    )


def _named(ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return completions for an argument NAME; the command determines the kind of name."""
    path = ctx.command_path.partition(" ")[2]
    if path in ("group add", "group remove", "group delete"):
        return _groups(ctx, parameter, incomplete)
    if path == "trust remove":
        return _stations(ctx, parameter, incomplete)
    return _profiles(ctx, parameter, incomplete) if path == "profile show" else []


def _profiles(ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    listed = teds.profile.list_profiles(teds.profile.default_folders(_home(ctx)))
    names = [CompletionItem(entry.name) for entry in listed if entry.name.startswith(incomplete)]
    return names or _files(ctx, parameter, incomplete)


def _files(_ctx: click.Context, _parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(incomplete, type="file")]


def _nobody(prompt: str, confirm: bool = False) -> str:
    raise AssertionError("completion opens no vault")
