"""Destinations of measured values: text, MCAP and JSON-line files, ROS 1, ROS 2, MQTT. One file each, one line below.

:func:`open_sink` makes a sink from the string of the command line. A new sink is a module with a class that follows
:class:`Sink` (most easily a :class:`ThreadedSink`), and a line in FILES or SERVICES.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from teds_provision.errors import UsageError
from teds_provision.measure.display_units import FileUnits
from teds_provision.measure.exposure import Exposure
from teds_provision.measure.sinks import foxglove_server, json_events, mcap, names
from teds_provision.measure.sinks.base import CommandTaker, Sink, ThreadedSink, as_sink_failure
from teds_provision.measure.sinks.foxglove import ARRAYS, foxglove_sink
from teds_provision.measure.sinks.json_lines import JsonLinesSink
from teds_provision.measure.sinks.mcap.recording import McapSink
from teds_provision.measure.sinks.mqtt import MqttSink
from teds_provision.measure.sinks.ros.ros1 import Ros1Sink
from teds_provision.measure.sinks.ros.sourced import ros2_sink
from teds_provision.measure.sinks.shown import SHOWN, ShownJsonLinesSink, ShownTextSink, ShownWideSink
from teds_provision.measure.sinks.text import TextSink
from teds_provision.measure.sinks.wide import WIDE, WideSink

__all__ = [
    "CommandTaker",
    "Sink",
    "ThreadedSink",
    "as_sink_failure",
    "foxglove_server",
    "in_units",
    "json_events",
    "mcap",
    "names",
    "open_sink",
    "without_scalars",
]

TEXT = frozenset({".csv", ".txt"})
FILES: dict[str, Callable[[Path], Sink]] = {
    ".csv": TextSink,
    ".txt": TextSink,
    ".jsonl": JsonLinesSink,
    ".mcap": McapSink,
}
SHOWN_FILES: dict[str, Callable[[Path], Sink]] = {
    ".csv": ShownTextSink,
    ".txt": ShownTextSink,
    ".jsonl": ShownJsonLinesSink,
}
"""Formats that can have display units; MCAP is always in SI."""
SERVICES: dict[str, Callable[[str, CommandTaker | None], Sink]] = {
    "ros1": Ros1Sink,
    "ros2": ros2_sink,
    "mqtt": MqttSink,
    "mqtts": MqttSink,
    "foxglove": foxglove_sink,
}


def without_scalars(spec: str) -> str:
    """Return the string of a sink without topics of single channels; of one that never has them unchanged."""
    plain = is_foxglove(spec) or (spec.partition(":")[0] not in SERVICES and Path(spec).suffix.lower() == ".mcap")
    return f"{ARRAYS}{spec}" if plain and not spec.startswith(ARRAYS) else spec


def is_foxglove(spec: str) -> bool:
    """Return True for ``foxglove`` and ``foxglove:HOST:PORT``."""
    return spec.partition(":")[0] == "foxglove"


def in_units(spec: str, units: FileUnits) -> str:
    """Return the string of a sink whose file has these units; of one that is always in SI unchanged."""
    text = units == "shown" and spec.partition(":")[0] not in SERVICES and Path(spec).suffix.lower() in SHOWN_FILES
    return f"{SHOWN}{spec}" if text and not spec.startswith(SHOWN) else spec


def open_sink(spec: str, commands: CommandTaker | None = None, exposure: Exposure | None = None) -> Sink:
    """Return the sink of a spec, not yet opened.

    A file, ``wide:FILE``, either of them behind ``shown:`` for display units, ``ros1[:URL]``, ``ros2[:DOMAIN]``,
    ``mqtt://HOST`` or ``foxglove[:HOST:PORT]``; MCAP and Foxglove behind ``arrays:`` have no topics of single channels.
    ``commands`` receives set points that come by the sink; None if no actuator may be moved. ``exposure`` protects a
    server beyond loopback. Raises UsageError.
    """
    if spec.startswith(ARRAYS):
        bare = spec.removeprefix(ARRAYS)
        return (
            foxglove_sink(bare, scalars=False, exposure=exposure)
            if is_foxglove(bare)
            else McapSink(Path(bare), scalars=False)
        )
    if is_foxglove(spec):
        return foxglove_sink(spec, exposure=exposure)
    service = spec.partition(":")[0]
    if service in SERVICES:
        return SERVICES[service](spec, commands)
    shown, spec = spec.startswith(SHOWN), spec.removeprefix(SHOWN)
    if spec.startswith(WIDE) and Path(spec).suffix.lower() in TEXT:
        return (ShownWideSink if shown else WideSink)(Path(spec.removeprefix(WIDE)))
    path = Path(spec)
    if shown and path.suffix.lower() in SHOWN_FILES:
        return SHOWN_FILES[path.suffix.lower()](path)
    if path.suffix.lower() not in FILES:
        raise UsageError(
            f"Unsupported format: {spec!r}.",
            hint=f"Name a file that ends in {', '.join(FILES)}, or {', '.join(SERVICES)}.",
        )
    return FILES[path.suffix.lower()](path)
