"""The node that a text on the command line means."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from teds_provision.cli.context import Station
from teds_provision.errors import NotFoundError
from teds_provision.optional_rooms import Hook

NODE_NAMES: Final[Hook[Callable[[Station, str], bytes | None]]] = Hook("cli.node.names")
"""Functions that know nodes by other names than this station does: UUID, or None; UsageError if several fit."""


def resolve(station: Station, text: str) -> bytes:
    """Return the UUID that ``text`` means to this station, else to an optional room.

    Raises NotFoundError, or UsageError if several nodes fit.
    """
    try:
        return station.nodes.resolve(text)
    except NotFoundError:
        for find in NODE_NAMES.parts():
            found = find(station, text)
            if found is not None:
                return found
        raise
