"""Optional rooms, without which the program works, and the interface through which they extend it.

An optional room is a folder of the package above all others: it may import every room, and none imports it. Its module
``room.py`` has ``ROOM``, an :class:`OptionalRoom`, which names what the room adds, each as ``"module:attribute"`` below
the room. Nothing of that is imported before it is used. The core uses it in three places:

====================  ==============================================================================================
``sections``          its commands and their lines in ``--help`` (``cli/table.py``)
``extends``           changes of the core's commands: options and acts that they gain (``cli/extending.py``)
``hooks``             what it brings to a :class:`Hook`: a place that the core defines, with the type of what it takes
====================  ==============================================================================================

There are no package entry points: foreign code would run with the keys of the station, and a search through all
installed packages at each start costs more than the start itself. A room that is not in :data:`OPTIONAL` is never
loaded, and one that is in it may be absent: its folder is left out of the base wheel (docs/extending.md).

This module is below every room and imports nothing of ours.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import Any, Final, Generic, NamedTuple, TypeVar

OPTIONAL: Final = ("plant", "check")
"""The folders; their order is that of what they add."""

Part = TypeVar("Part")
_NOTHING: Final[Mapping[str, Any]] = MappingProxyType({})


class CommandRow(NamedTuple):
    """Place of a command (module below the folder of its room, attribute) and its one-line help."""

    module: str
    attribute: str
    help: str
    room: str = "cli"


class OptionalRoom(NamedTuple):
    """Additions of a room; every place is ``"module:attribute"`` below its folder."""

    sections: Mapping[str, Mapping[str, CommandRow]] = _NOTHING
    """Sections of ``--help``, after those of the core, and before the last one."""
    groups: frozenset[str] = frozenset()
    """The commands among them that have commands of their own."""
    helps: Mapping[str, str] = _NOTHING
    """Lines of ``--help`` of core commands that do more with this room, by the command's name."""
    extends: Mapping[str, str] = _NOTHING
    """Functions that are given a core command, by its name, and change it; called once, when it is first used."""
    hooks: Mapping[str, str] = _NOTHING
    """Parts for hooks, by the hook's name."""


@cache
def rooms() -> Mapping[str, OptionalRoom]:
    """Return the rooms that are present, by name."""
    found = {}
    for name in OPTIONAL:
        package = f"{__package__}.{name}"
        try:
            found[name] = import_module(f"{package}.room").ROOM
        except ModuleNotFoundError as error:
            if error.name not in (package, f"{package}.room"):  # the room exists, and one of its imports is missing
                raise
    return found


def load(room: str, place: str) -> Any:
    """Return what a room has at a place, ``"module:attribute"``."""
    module, _, attribute = place.partition(":")
    return getattr(import_module(f"{__package__}.{room}.{module}"), attribute)


class Hook(Generic[Part]):
    """A place of the core at which optional rooms take part.

    The core defines it beside its use, with the type of what it takes: ``NODE_NAMES: Hook[NodeNames] = Hook("…")``.
    """

    def __init__(self, name: str) -> None:
        self.name: Final = name

    def parts(self) -> list[Part]:
        """Return what each room that is present brings; loads its modules. Empty if no room brings anything."""
        return [load(name, room.hooks[self.name]) for name, room in rooms().items() if self.name in room.hooks]
