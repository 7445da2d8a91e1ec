"""Write what follows from the command line's own definitions: its option names, docs/configuration.md, the man page.

Usage: python scripts/options.py [--check]. With --check it writes nothing and exits 1 where a file is out of date.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path

import click

from teds_provision.cli.main import ENVIRONMENT_PREFIX, cli

ROOT = Path(__file__).resolve().parent.parent


def commands(group: click.Group = cli, path: str = "") -> Iterator[tuple[str, click.Command]]:
    """Yield every command with its path (``whitelist add``); the program itself under ""."""
    yield path, group
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        inner = f"{path} {name}".strip()
        if isinstance(command, click.Group):
            yield from commands(command, inner)
        else:
            yield inner, command


def options_of(command: click.Command) -> list[click.Option]:
    """Return the options of a command that have a long name."""
    found = [parameter for parameter in command.params if isinstance(parameter, click.Option) and not parameter.hidden]
    return [option for option in found if _long(option)]


def _long(option: click.Option) -> str:
    return next((name[2:] for name in option.opts if name.startswith("--")), "")


def option_names() -> str:
    """Return the module with every option's name, so that config.toml is checked without loading any command."""
    rows = []
    for path, command in commands():
        names = ", ".join(f'"{_long(option)}"' for option in options_of(command))
        if names:
            rows.append(f'    "{path}": frozenset({{{names}}}),')
    parameters, several = parameter_names()
    return (
        '"""The options of every command, by its path ("" for the program). Written by scripts/options.py."""\n\n'
        "from __future__ import annotations\n\nfrom typing import Final\n\n# fmt: off\n"
        "OPTIONS: Final[dict[str, frozenset[str]]] = {\n" + "\n".join(rows) + "\n}\n"
        "FILES: Final = frozenset({" + ", ".join(f'"{name}"' for name in file_names()) + "})\n"
        '"""Options that name a file or a folder, in every command that has them."""\n'
        "PARAMETERS: Final[dict[str, dict[str, str]]] = {\n" + "\n".join(parameters) + "\n}\n"
        '"""Options that the code calls otherwise than the command line does."""\n'
        "SEVERAL: Final[dict[str, frozenset[str]]] = {\n" + "\n".join(several) + "\n}\n"
        '"""Options that may be given several times."""\n'
    ).replace("# fmt: off\n", "# fmt: off\n# ruff: noqa: E501\n")


def parameter_names() -> tuple[list[str], list[str]]:
    """Return rows of the options that have another name in the code, and of those that may be given several times."""
    parameters, several = [], []
    for path, command in commands():
        options = options_of(command)
        names = [option.name for option in options]
        renamed = [  # flags that share a parameter are a choice of the moment, no settings
            f'"{_long(option)}": "{option.name}"'
            for option in options
            if option.name != _long(option).replace("-", "_") and names.count(option.name) == 1
        ]
        repeated = [f'"{_long(option)}"' for option in options if option.multiple]
        if renamed:
            parameters.append(f'    "{path}": {{{", ".join(renamed)}}},')
        if repeated:
            several.append(f'    "{path}": frozenset({{{", ".join(repeated)}}}),')
    return parameters, several


def file_names() -> list[str]:
    """Return the options whose values are paths in every command that has them."""
    kinds: dict[str, set[bool]] = {}
    for _, command in commands():
        for option in options_of(command):
            kinds.setdefault(_long(option), set()).add(isinstance(option.type, click.Path))
    return sorted(name for name, paths in kinds.items() if paths == {True})


_CONFIGURATION_END = (
    "## What can go wrong",
    "",
    "| what you see | cause and remedy |",
    "|---|---|",
    "| `config.toml`, with a line number (8) | the file cannot be read as TOML, or a value has another type; "
    "every command but `doctor` refuses until it is corrected |",
    "| an option has no effect | the command line goes before the variable, the variable before the file: "
    "`config show` names where each value comes from |",
    "",
    "## Next",
    "",
    "[contract/cli.md](contract/cli.md) has exit codes and JSON; the "
    "[command reference](https://teds-provision.github.io/teds-provision/reference/commands.html) has every command.",
    "",
)


def configuration() -> str:
    """Return docs/configuration.md: every option, variable and key on one page."""
    lines = [
        "# Configuration",
        "",
        "**For** anyone who does not want to type `--can` every time, or sets up a station by script.",
        "",
        "Every option can be given on the command line, in an environment variable, or in `config.toml` in the home",
        "(`teds-provision config path` prints its path). The command line goes before the variable, the variable",
        "before the file.",
        "No option and no variable holds a secret: passphrases come from a prompt, the keyring, or `--passphrase-fd`.",
        "",
        "```toml",
        "# config.toml",
        'can = "socketcan:can0?bitrate=500000"   # for every command that has --can',
        "",
        "[provision]                             # for provision alone",
        'via = "can"',
        "",
        "[whitelist.add]                         # for a command of a group",
        "dry-run = true",
        "```",
        "",
        "A key that no command knows is an error that names its line. `teds-provision config show` lists what is set,",
        "and where; `config set` and `config unset` change the file.",
        "Flags are `true` or `false` in the file, `1` or `0` in a variable. Several values are a list in the file",
        '(`can = ["socketcan:can0", "socketcan:can1"]`), divided by blanks in a variable; outside of a table such a',
        "list serves the commands that take several. `make man` writes this page.",
        "",
        "Without `--via` a command uses the link that `--nfc`, `--can` or `--ble` names on the command line. If none",
        "does, it looks for the node on the bus in `config.toml` or the variable, else on the bus where it was last",
        "met, and then waits for a tap. A reader in `config.toml` or the variable is tried first, briefly.",
        "`agree` and `provision` want a tap, unless a bus is named on the command line or by `via`.",
        "",
        "A relative path in `config.toml` starts at the folder of `config.toml`, wherever you type the command;",
        "`config set` writes the path that you gave from the root on.",
        "",
        "**You will see** with `config show` where each value comes from:",
        "",
        "```",
        "$ teds-provision config show",
        "home  h  [--home]",
        "can   udp_multicast:239.74.163.41?port=24141  [h/config.toml]",
        "```",
        "",
    ]
    for path, command in commands():
        options = options_of(command)
        if not options:
            continue
        lines += [f"## {path or 'Global options'}", "", "| option | variable | meaning |", "|---|---|---|"]
        for option in options:
            name = _long(option)
            variable = f"`{ENVIRONMENT_PREFIX}_{name.replace('-', '_').upper()}`"
            help_text = (option.help or "").replace("|", "\\|")
            lines.append(f"| `--{name}` | {variable} | {help_text} |")
        lines.append("")
    return "\n".join([*lines, *_CONFIGURATION_END])


def _roff(text: str) -> str:
    return "\n".join(
        ("\\&" + line if line.startswith((".", "'")) else line) for line in text.replace("\\", "\\e").splitlines()
    ).replace("-", "\\-")


def man_page() -> str:
    """Return one page with every command, in the form of man(7)."""
    out = ['.TH TEDS\\-PROVISION 1 "" "teds\\-provision" "User Commands"', ".SH NAME"]
    out += ["teds\\-provision \\- identify, key, sign and write the datasheets of smart transducers"]
    for path, command in commands():
        title = f"teds-provision {path}".strip()
        context = click.Context(command, info_name=title)
        usage = " ".join(command.collect_usage_pieces(context))
        out += [".SH " + ("SYNOPSIS" if not path else _roff(path.upper())), f".B {_roff(title)}", _roff(usage), ".PP"]
        text = inspect.cleandoc((command.help or "").replace("\b", ""))  # Python 3.13 takes the indentation away itself
        out.append(_roff(text))
        for option in options_of(command):
            names = ", ".join([*option.opts, *option.secondary_opts])
            out += [".TP", f".B {_roff(names)}", _roff(option.help or "")]
        if command.epilog:
            out += [".PP", ".nf", _roff(command.epilog.replace("\b", "").strip()), ".fi"]
    return "\n".join(out) + "\n"


FILES = {
    "teds_provision/cli/option_names.py": option_names,
    "docs/configuration.md": configuration,
    "man/teds-provision.1": man_page,
}


def main(arguments: list[str]) -> int:
    """Write or check the files; return the exit code."""
    stale = []
    for name, make in FILES.items():
        path, text = ROOT / name, make()
        if path.exists() and path.read_text(encoding="utf-8") == text:
            continue
        stale.append(name)
        if "--check" not in arguments:
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
    print(
        "\n".join(f"{name} {'is out of date' if '--check' in arguments else 'written'}" for name in stale)
        or "all up to date"
    )
    return 1 if stale and "--check" in arguments else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
