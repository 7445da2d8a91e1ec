"""Packages whose names are loaded at their first use (PEP 562), so that imports stand on top and start-up stays quick.

A package says where its names are: ``__getattr__ = lazy(__name__, {"fit": "fitting"})`` gives ``package.fit`` from
``package.fitting`` when somebody first asks for it. Users write ``from … import package`` on top and ``package.fit(…)``
where they need it; ``from … import package.fit`` loads at once.

This module stands below every room and imports nothing of ours.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module


def lazy(package: str, where: Mapping[str, str]) -> Callable[[str], object]:
    """Return the ``__getattr__`` of a package: ``where`` says in which of its modules each name stands.

    A module that is named after nothing ("" for the value) is given itself: ``{"curve": ""}`` is ``package.curve``.
    """

    def load(name: str) -> object:
        if name not in where:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if not where[name]:
            return import_module(f"{package}.{name}")
        value: object = getattr(import_module(f"{package}.{where[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

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
