"""Sources of a virtual transducer's values: one file each, one line each in the table below."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from teds_provision.errors import UsageError
from teds_provision.node.sources import command, lines, noise, ramp, recorded, sine
from teds_provision.node.sources.base import Notify, Source, SourceChannel

Maker = Callable[[str, Sequence[SourceChannel], Notify], Source]

SOURCES: Final[dict[str, Maker]] = {
    "noise": noise.make,
    "sine": sine.make,
    "ramp": ramp.make,
    "file": recorded.make,
    "-": lines.make_stream,
    "unix": lines.make_socket,
    "simulation": lines.make_simulation,
    "exec": command.make,
}
ONE_NODE_ONLY: Final = frozenset({"-", "unix", "simulation"})
"""Sources of which there is one, so that several nodes of a process cannot share them."""


def kind_of(text: str) -> str:
    """Return the word before the colon of ``--source``; raises UsageError for an unknown one."""
    kind = text.partition(":")[0]
    if kind not in SOURCES:
        raise UsageError(
            f"--source {text!r} is not known.",
            hint="Use noise, sine:PERIOD, ramp:PERIOD, file:CSV, -, unix:PATH or exec:COMMAND; for a wrapped node"
            " dbc:FILE, canopen:FILE or iio:DEVICE.",
        )
    return kind


def make_source(text: str, places: Sequence[SourceChannel], notify: Notify) -> Source:
    """Return the source that ``--source`` names, for these sensors.

    Raises UsageError, NotFoundError or BadDataError.
    """
    kind = kind_of(text)
    return SOURCES[kind](text.partition(":")[2], places, notify)
