"""Modules that are loaded at their first use, if a command that people wait for would get slower otherwise.

:func:`late` replaces a heavy library, or one module of ours, until something of it is used. :func:`lazy`
gives the modules of a room (PEP 562): its ``__init__`` names them for type checkers and loads them late for all else::

    if TYPE_CHECKING:
        from teds_provision.measure import blocks, sources
    else:
        __getattr__ = lazy(__name__)

Users write ``from teds_provision import measure`` on top and ``measure.blocks.Block`` in their code; that loads
the module. Both are exceptions, which ``tests/test_house.py`` lists: imports are on top, by name.

This module is below every room and imports nothing of ours.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

_NOTHING: Final[Mapping[str, str]] = MappingProxyType({})


def lazy(package: str, names: Mapping[str, str] = _NOTHING) -> Callable[[str], object]:
    """Return the ``__getattr__`` of a package, which resolves its modules, and names out of them.

    ``names`` maps a module to its names: ``{"fitting": "fit residuals"}`` is ``package.fit`` and ``package.residuals``
    of ``package.fitting``; ``{"running": "job"}`` is the module ``package.running.job``. No such name may be a module's
    of the package too: Python would put the module in its place.
    """
    where = {name: module for module, listed in names.items() for name in listed.split()}

    def load(name: str) -> object:
        if name in where:
            value = _part_of(f"{package}.{where[name]}", name)
            setattr(sys.modules[package], name, value)
            return value
        module = f"{package}.{name}"
        try:
            if not name.startswith("_"):
                return import_module(module)
        except ModuleNotFoundError as error:
            if error.name != module:  # the module exists, and one of its imports is missing
                raise
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return load


def _part_of(module: str, name: str) -> object:
    """Return what a module has under a name, or the module of that name in a room."""
    loaded = import_module(module)
    return getattr(loaded, name) if hasattr(loaded, name) else import_module(f"{module}.{name}")


class _LateModule:
    """A placeholder of a module until its first use; caches what was used."""

    def __init__(self, module: str) -> None:
        self.__dict__["_module"] = module

    def __getattr__(self, name: str) -> object:
        value: object = getattr(import_module(self.__dict__["_module"]), name)
        self.__dict__[name] = value
        return value


def late(module: str) -> object:
    """Return a placeholder of a heavy library until its first use, so that its import can be at the top.

    For type checkers: ``if TYPE_CHECKING: import numpy as np``, ``else: np = late("numpy")``.
    """
    return _LateModule(module)


if TYPE_CHECKING:
    import json
    import pathlib
    import shlex
    import tomllib
    from importlib import metadata, util
    from urllib import request as urllib
else:
    json, pathlib, shlex, tomllib = late("json"), late("pathlib"), late("shlex"), late("tomllib")
    metadata, util, urllib = late("importlib.metadata"), late("importlib.util"), late("urllib.request")

_TOOL: Final = "teds-provision"
REQUIRED: Final[Mapping[str, tuple[str, str]]] = MappingProxyType(
    {
        "click": ("click", "8.4.2"),
        "cryptography": ("cryptography", "44.0.0"),
        "rich": ("rich", "13.7"),
        "nfcpy": ("nfc", "1.0.4"),
        "python-can": ("can", "4.5"),
        "can-isotp": ("isotp", "2.0.6"),
        "msgpack": ("msgpack", "1.0"),
        "keyring": ("keyring", "25.2"),
        "platformdirs": ("platformdirs", "4.2"),
        "numpy": ("numpy", "1.26"),
        "defusedxml": ("defusedxml", "0.7.1"),
    }
    | ({"backports.zstd": ("backports.zstd", "1.0")} if sys.version_info < (3, 14) else {})
)
"""Packages that every installation has, as in pyproject.toml: module and oldest version by name of the package."""


def missing_packages() -> list[str]:
    """Return the names of required packages that are not installed; imports none of them."""
    return [name for name, (module, _) in REQUIRED.items() if not is_installed(module)]


def is_installed(module: str) -> bool:
    """Return True if a module can be found; does not import it."""
    try:
        return util.find_spec(module) is not None
    except (ModuleNotFoundError, ValueError):  # its package is missing, or it was removed from sys.modules
        return False


def package_of(module: str) -> str:
    """Return the name of the required package that brings a module; the module's own name for any other package."""
    return next((name for name, (brought, _) in REQUIRED.items() if brought == module), module)


def how_to_install(extra: str) -> str:
    """Return the command that adds one of our extras to this installation, as a hint."""
    return f"Install it: {install_command(f'{_TOOL}[{extra}]')}"


def install_command(*requirements: str) -> str:
    """Return the command that adds requirements to this installation, wherever it is.

    ``uv tool`` drops at its next upgrade what it was not given, so it is given all again; ``pipx inject`` takes no
    extra of the tool itself from version 1.5 on; an environment of uv's has no pip.
    """
    prefix = pathlib.Path(sys.prefix)
    quoted = " ".join(word for requirement in requirements for word in map(shlex.quote, _as_it_came(requirement)))
    if (prefix / "uv-receipt.toml").is_file():
        return _uv_tool(prefix / "uv-receipt.toml", requirements)
    if "pipx" in prefix.parts and "venvs" in prefix.parts:
        return f"pipx runpip {prefix.name} install {quoted}"
    if util.find_spec("pip") is None:
        return f"uv pip install --python {shlex.quote(sys.executable)} {quoted}"
    return f"{shlex.quote(sys.executable)} -m pip install {quoted}"


def _as_it_came(requirement: str) -> list[str]:
    """Return the words of pip for a requirement; an extra of ours comes from the same source as this installation.

    A package index has the tool only once it is released, so an installation from a folder, a file or a repository
    (PEP 610, direct_url.json) names that one; if it is gone, the packages of the extra are named.
    """
    if not requirement.startswith(f"{_TOOL}["):
        return [requirement]
    extra = requirement[len(_TOOL) + 1 : -1]
    try:
        own = metadata.distribution(_TOOL)
        came: Any = json.loads(own.read_text("direct_url.json") or "{}")
        url = str(came.get("url", ""))
    except (metadata.PackageNotFoundError, ValueError, AttributeError):
        return [requirement]
    if not url:
        return [requirement]
    if "vcs_info" in came:
        commit = came["vcs_info"].get("commit_id", "")
        return [f"{requirement} @ {came['vcs_info'].get('vcs', 'git')}+{url}{'@' if commit else ''}{commit}"]
    path = pathlib.Path(urllib.url2pathname(url.removeprefix("file://"))) if url.startswith("file://") else None
    if path is not None and not path.exists():
        marked = re.compile(rf"\s*;\s*.*extra\s*==\s*['\"]{re.escape(extra)}['\"].*")
        return [marked.sub("", text) for text in own.requires or () if marked.search(text)] or [requirement]
    if path is not None and came.get("dir_info", {}).get("editable"):
        return ["--editable", f"{path}[{extra}]"]
    return [f"{requirement} @ {url}"]


def _uv_tool(receipt: pathlib.Path, requirements: tuple[str, ...]) -> str:
    """Return the ``uv tool install`` command with what its receipt has, plus these requirements."""
    try:
        text = tomllib.loads(receipt.read_text(encoding="utf-8"))["tool"]
        listed = {requirement["name"]: requirement for requirement in text["requirements"]}
    except (OSError, ValueError, KeyError, TypeError):
        text, listed = {}, {}
    ours = listed.pop(_TOOL, {})
    extras = {
        *ours.get("extras", []),
        *(requirement[len(_TOOL) + 1 : -1] for requirement in requirements if requirement.startswith(_TOOL)),
    }
    named = f"{_TOOL}[{','.join(sorted(extras))}]" if extras else _TOOL
    words = ["uv", "tool", "install"]
    if "python" in text:
        words += ["--python", text["python"]]
    if "editable" in ours:
        words += ["--editable", named.replace(_TOOL, ours["editable"], 1)]
    elif "directory" in ours or "path" in ours or "url" in ours:
        words.append(f"{named} @ {ours.get('directory') or ours.get('path') or ours['url']}")
    elif "git" in ours:
        words.append(
            f"{named} @ git+{ours['git'].replace('?rev=', '@').replace('?tag=', '@').replace('?branch=', '@')}"
        )
    else:
        words.append(named + ours.get("specifier", ""))
    for name, requirement in listed.items():
        words += [
            "--with",
            name
            + (f"[{','.join(requirement['extras'])}]" if requirement.get("extras") else "")
            + requirement.get("specifier", ""),
        ]
    for needed in requirements:
        words += ["--with", needed] if not needed.startswith(_TOOL) else []
    return shlex.join(words)
