"""Rooms whose modules and names are loaded at their first use (PEP 562), so that imports stand on top and cost nothing.

A room's ``__init__`` names its modules for type checkers and has them loaded late for everybody else::

    if TYPE_CHECKING:
        from teds_provision.handover import life, trust
    else:
        __getattr__ = lazy(__name__)

Users write ``from teds_provision import handover`` on top and ``handover.trust.spoken(…)`` where they need it; that
call loads the module. ``from teds_provision.handover.trust import spoken`` on top loads it at once, which is right for
what every use of a module needs.

This module stands below every room and imports nothing of ours.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

_NOTHING: Final[Mapping[str, str]] = MappingProxyType({})


def lazy(package: str, names: Mapping[str, str] = _NOTHING) -> Callable[[str], object]:
    """Return the ``__getattr__`` of a package: it gives the package's modules, and names out of them.

    ``names`` says which of its modules has which: ``{"fitting": "fit residuals"}`` is ``package.fit`` and
    ``package.residuals`` of ``package.fitting``. No such name may be a module's too: Python would put the module in
    its place.
    """
    where = {name: module for module, listed in names.items() for name in listed.split()}

    def load(name: str) -> object:
        if name in where:
            value: object = getattr(import_module(f"{package}.{where[name]}"), name)
            setattr(sys.modules[package], name, value)
            return value
        module = f"{package}.{name}"
        try:
            if not name.startswith("_"):
                return import_module(module)
        except ModuleNotFoundError as error:
            if error.name != module:  # it is there, and something that it needs is not
                raise
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return load


class _Late:
    """Stands for a module until something of it is asked for; keeps what was asked for."""

    def __init__(self, module: str) -> None:
        self.__dict__["_module"] = module

    def __getattr__(self, name: str) -> object:
        value: object = getattr(import_module(self.__dict__["_module"]), name)
        self.__dict__[name] = value
        return value


def late(module: str) -> object:
    """Return what stands for a heavy library until its first use, so that its import can stand on top.

    For type checkers: ``if TYPE_CHECKING: import numpy as np``, ``else: np = late("numpy")``.
    """
    return _Late(module)


if TYPE_CHECKING:
    import pathlib
    import shlex
else:
    pathlib, shlex = late("pathlib"), late("shlex")


def how_to_install(*packages: str) -> str:
    """The command that puts packages beside this tool, where it is: pipx keeps it apart, else this Python's own pip."""
    names = " ".join(packages)
    parts = pathlib.Path(sys.prefix).parts
    if "pipx" in parts and "venvs" in parts:
        return f"Install it: pipx inject {parts[-1]} {names}"
    return f"Install it: {shlex.quote(sys.executable)} -m pip install {names}"
