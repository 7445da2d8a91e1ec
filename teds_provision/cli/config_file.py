"""``config.toml`` in the home: defaults for options, checked by name before anything runs.

Keys outside of a table serve every command that has such an option; a table serves the command of its name, a table in
it a command of that group. The names are those of the command line, with ``-`` or ``_``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

from teds_provision.cli.option_names import FILES, OPTIONS, PARAMETERS, SEVERAL
from teds_provision.cli.table import COMMANDS, GROUPS
from teds_provision.errors import BadDataError, NotFoundError
from teds_provision.lazy import late

if TYPE_CHECKING:
    import difflib
    from pathlib import Path

    from teds_provision import files, limits
else:
    # loaded only if there is a config.toml
    difflib, files, limits = late("difflib"), late("teds_provision.files"), late("teds_provision.limits")

NEVER_IN_FILE: Final = frozenset({"home", "help", "version", "passphrase-fd"})
BROKERS: Final = "ncap brokers"
"""A table of names and URLs, not of options."""
_BROKER_FILES: Final = ("password-file", "ca", "cert", "key")
_LONGEST: Final = 40
"""More of a name is not shown."""
_MEND: Final = "Fix or remove the file."


class Defaults(dict[str, Any]):
    """Values of config.toml: those outside of a table serve every command, a table the command of its name.

    The same word may be an option and a command (``profile``), so a command is given plain values, never tables, and of
    these the ones that it has options for, under the names of its parameters.
    """

    def __init__(self, values: dict[str, Any], path: str = "") -> None:
        self._values, self._path = {name.replace("_", "-"): value for name, value in values.items()}, path
        super().__init__({parameter_of(path, name): value for name, value in self._values.items()})

    def get(self, key: str, default: Any = None) -> Any:
        """Return the defaults of command ``key``, or the value of global option ``key``."""
        path = f"{self._path} {key}".strip()
        if path in GROUPS or (self._path and path not in OPTIONS and is_command(path)):
            return Defaults({**_common(self._values), **self._own(key)}, path)
        if key in COMMANDS or path in OPTIONS:
            return self._of_command(path, self._own(key))
        return super().get(key, default)

    def _own(self, key: str) -> dict[str, Any]:
        own = self._values.get(key)
        return {name.replace("_", "-"): value for name, value in own.items()} if isinstance(own, dict) else {}

    def _of_command(self, path: str, own: dict[str, Any]) -> dict[str, Any]:
        """Return click's defaults for a command: by parameter, a list for a repeatable one."""
        found = {}
        for name, value in {**_common(self._values), **own}.items():
            if name not in OPTIONS.get(path, ()) or isinstance(value, dict):
                continue
            listed = isinstance(value, list)
            repeats = name in SEVERAL.get(path, ())
            if listed and not repeats and name in own:
                raise BadDataError(f"config.toml: {path} takes one --{name}, and {len(value)} are named.", hint=_MEND)
            if listed and not repeats:
                continue  # a default of several buses applies only to commands that take several
            found[parameter_of(path, name)] = [value] if repeats and not listed else value
        return found


def _common(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if not isinstance(value, dict)}


def is_command(path: str) -> bool:
    """Return True if there is such a command, or a group of commands with options."""
    return path in OPTIONS or any(name.startswith(f"{path} ") for name in OPTIONS)


def parameter_of(path: str, option: str) -> str:
    """Return the parameter name of a command's option, as the command line spells it."""
    return PARAMETERS.get(path, {}).get(option, option.replace("-", "_"))


def anchored(values: dict[str, Any], folder: Path, above: str = "") -> dict[str, Any]:
    """Return the values with absolute paths, relative ones from ``folder``, as commands run in any folder."""
    return {
        name: anchored(value, folder, name) if isinstance(value, dict) else _anchored_value(name, value, folder, above)
        for name, value in values.items()
    }


def _anchored_value(name: str, value: Any, folder: Path, above: str) -> Any:
    plain = name.replace("_", "-")
    if isinstance(value, list):
        return [_anchored_value(name, element, folder, above) for element in value]
    if not isinstance(value, str) or not value:
        return value
    if above == "brokers":
        return re.sub(rf"([?&](?:{'|'.join(_BROKER_FILES)})=)([^&#]+)", lambda m: m[1] + _from(folder, m[2]), value)
    if (
        plain in FILES
        or (plain == "profile" and ("/" in value or value.endswith(".toml")))  # otherwise a profile's name
        or (plain == "to" and above == "backup")
        or (plain == "to" and above == "measure" and not re.match(r"[a-z0-9]+:", value))  # otherwise a service
    ):
        return _from(folder, value)
    return value


def _from(folder: Path, path: str) -> str:
    return os.path.abspath(os.path.join(folder, os.path.expanduser(path)))


def home_of(home: Path | None) -> Path:
    """Return the folder of the store: the option's, else the platform's user data folder."""
    if home is not None:
        return home.expanduser()
    from platformdirs import user_data_path

    return user_data_path("teds-provision")


def config_path(home: Path | None) -> Path:
    """Return the path of a home's file."""
    return home_of(home) / "config.toml"


def read_config_text(path: Path) -> str | None:
    """Return the text of the file, None if there is none; raises BadDataError."""
    if not os.path.lexists(path):  # not exists(): if the home is invalid, opening the file raises the error
        return None
    try:
        return files.read_text(path, limits.LIMITS.text_file, "config.toml", failure=BadDataError)
    except (BadDataError, NotFoundError) as error:
        raise BadDataError(error.message, hint=error.hint or _MEND) from error


def read_config(path: Path) -> dict[str, Any] | None:
    """Return the content of the file, None if there is none; raises BadDataError with the line of the fault."""
    text = read_config_text(path)
    if text is None:
        return None
    try:
        values = limits.load_toml(text, str(path))
    except BadDataError as error:
        raise BadDataError(error.message, hint=_MEND) from error
    for problem in problems(values, text):
        raise BadDataError(f"{path}, {problem}", hint="To list all settings: teds-provision config show")
    return values


def problems(values: dict[str, Any], text: str) -> Iterator[str]:
    """Yield faults in the names of a file, each with its line."""
    anywhere = {option for options in OPTIONS.values() for option in options} - NEVER_IN_FILE
    for name, value in values.items():
        plain = name.replace("_", "-")
        if isinstance(value, dict):
            if plain in COMMANDS:
                yield from _problems_of_command(plain, value, text)
            else:
                yield f"{_line(text, name)}: there is no command {name[:_LONGEST]!r}.{_near(plain, COMMANDS)}"
        elif plain not in anywhere:
            yield f"{_line(text, name)}: no command has an option --{plain[:_LONGEST]}.{_near(plain, anywhere)}"


def _problems_of_command(command: str, values: dict[str, Any], text: str) -> Iterator[str]:
    for name, value in values.items():
        plain = name.replace("_", "-")
        if isinstance(value, dict):
            inner = f"{command} {plain}"
            if inner == BROKERS:
                yield from _problems_of_brokers(value, text)
            elif is_command(inner):
                yield from _problems_of_command(inner, value, text)
            else:
                yield f"{_line(text, name)}: there is no command {inner[:_LONGEST]!r}."
        elif plain in NEVER_IN_FILE or plain not in _options_below(command):
            near = _near(plain, _options_below(command))
            yield f"{_line(text, name)}: {command} has no option --{plain[:_LONGEST]}.{near}"


def _problems_of_brokers(values: dict[str, Any], text: str) -> Iterator[str]:
    for name, url in values.items():
        if not isinstance(url, str):
            yield f'{_line(text, name)}: a broker is named with its URL: {name} = "mqtts://HOST".'


def brokers_of(path: Path) -> dict[str, str]:
    """Return the brokers that requests may name, ``[ncap.brokers]``; raises BadDataError as :func:`read_config`."""
    ncap = anchored(read_config(path) or {}, path.parent).get("ncap", {})
    return dict(ncap.get("brokers", {})) if isinstance(ncap, dict) else {}


def _options_below(command: str) -> set[str]:
    below = (options for name, options in OPTIONS.items() if name == command or name.startswith(f"{command} "))
    return {option for options in below for option in options}


def _near(name: str, known: Any) -> str:
    near = difflib.get_close_matches(name[:_LONGEST], list(known), n=1)
    return f" Did you mean {near[0]!r}?" if near else ""


def _line(text: str, name: str) -> str:
    """Return the line with the first occurrence of a name as a key or a table."""
    for number, line in enumerate(text.splitlines(), 1):
        if re.match(rf"\s*(\[[^\]]*)?['\"]?{re.escape(name)}['\"]?\s*(=|\]|\.)", line):
            return f"line {number}"
    return "line 1"
