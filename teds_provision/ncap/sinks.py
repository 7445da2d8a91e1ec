"""Sinks of the daemon's measurements: those it was started with, and those that a measurement names itself.

A request names a sink but never its destination: ``ros1``, ``ros2``, a broker by its name (``mqtt``: the one that the
daemon was started with; the others are in config.toml), or a file by its bare name. So a token makes the daemon contact
no host, and read no file, that its owner did not name.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from teds_provision.errors import UsageError
from teds_provision.measure.display_units import FileUnits
from teds_provision.measure.sinks import (
    FILES,
    CommandTaker,
    Sink,
    as_sink_failure,
    in_units,
    open_sink,
    without_scalars,
)
from teds_provision.measure.sinks.foxglove import FoxgloveSink
from teds_provision.measure.sinks.foxglove_server import FoxgloveServer
from teds_provision.station.store.records import KeptMeasurement

RECORDINGS: Final = "recordings"
STARTED: Final = "mqtt"
"""Name of the broker that the daemon was started with."""
_ROS: Final = frozenset({"ros1", "ros2"})
_BROKER: Final = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,40}\Z")
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._ -]{0,80}\Z")
_USER: Final = re.compile(r"([a-z]+://)[^\s/@]*@")
_QUERY: Final = re.compile(r"([a-z]+://[^\s?]*)\?\S*")
_FOLDERS: Final = re.compile(r"(?<![^\s'\"(=:])/(?!api/v1/)(?:[^/\s'\"]+/)+")


class DaemonSinks:
    """``specs`` are the words of the sinks that take every measurement, ``record`` a folder for recordings of each.

    ``units`` are those of values in files. ``brokers``: URLs by the names that config.toml gives them. ``actuators``:
    whether set points may come by the topics of any of the sinks. ``foxglove`` publishes every measurement. Without
    ``scalars`` Foxglove and MCAP have no topics of single channels. Raises UsageError for a name or URL that is none.
    """

    def __init__(
        self,
        home: Path,
        specs: Sequence[str] = (),
        record: Path | None = None,
        *,
        actuators: bool,
        brokers: Mapping[str, str] | None = None,
        units: FileUnits = "si",
        foxglove: FoxgloveServer | None = None,
        scalars: bool = True,
    ) -> None:
        self._foxglove, self._scalars = foxglove, scalars
        self._units: FileUnits = units
        self._home, self._specs, self.actuators = home, tuple(specs), actuators
        self._record = record.absolute() if record is not None else None
        for spec in self._specs:
            open_sink(spec)  # reports a malformed sink at the start, not at the first measurement
        started = [spec for spec in self._specs if urlsplit(spec).scheme.startswith("mqtt")]
        self._brokers: dict[str, str] = {STARTED: started[0]} if started else {}
        for name, url in (brokers or {}).items():
            _require_broker(name, url)
            self._brokers[name] = url

    def whole(self, spec: str) -> str:
        """Return the string of a sink that a request names; a file is in the folder of recordings.

        Raises UsageError.
        """
        if spec in _ROS or spec in self._brokers:
            return spec
        if not _NAME.match(spec) or Path(spec).suffix.lower() not in FILES:
            named = ", ".join(sorted(_ROS | self._brokers.keys()))
            raise UsageError(
                f"{spec!r} is not a sink that a request may name.",
                hint=f"Use {named}, or a file name in {', '.join(FILES)}. Brokers: config.toml, [ncap.brokers]",
            )
        return str(self._folder() / spec)

    def open(self, spec: str, take: CommandTaker | None = None) -> Sink:
        """Return the sink of a kept measurement, not yet opened; raises UsageError, also for a name that is gone."""
        if spec not in self._brokers and _BROKER.match(spec) and spec not in _ROS:
            raise UsageError(
                f"Broker {spec!r} is no longer configured.",
                hint=f'Name it in config.toml: [ncap.brokers], {spec} = "mqtts://HOST".',
            )
        return self._open(self._brokers.get(spec, spec), take)

    def extra_sinks(self, kept: KeptMeasurement, take: CommandTaker | None) -> list[Sink]:
        """Return the daemon's own sinks for one run of a measurement, without those that it names itself.

        ``take`` receives set points of topics.
        """
        own = {self._brokers.get(spec, spec) for spec in kept.sinks}
        specs = [spec for spec in self._specs if spec not in own]
        if self._record is not None:
            stamp = time.strftime("%Y%m%d-%H%M%S")
            name = re.sub(r"[^A-Za-z0-9_-]+", "_", kept.group or kept.id)[:60] or "measurement"
            specs.append(str(self._folder() / f"{name}-{stamp}.csv"))
        sinks = [self._open(spec, take) for spec in specs]
        if self._foxglove is not None:
            sinks.append(FoxgloveSink(self._foxglove, own=False, scalars=self._scalars))
        return sinks

    def _open(self, spec: str, take: CommandTaker | None) -> Sink:
        whole = in_units(spec, self._units)
        return open_sink(whole if self._scalars else without_scalars(whole), take)

    def allows_set_points(self, kept: KeptMeasurement) -> bool:
        """Return True if set points may come for this measurement: it and the daemon allow it, with a ROS sink."""
        return self.actuators and kept.actuators and bool(_ROS & {*self._specs, *kept.sinks})

    @property
    def publish(self) -> bool:
        """True if every measurement goes to topics of ROS or MQTT, which take so many messages a second and no more."""
        return bool(self._specs)

    @property
    def take_set_points(self) -> bool:
        """True if set points come by topics for a measurement that allows it and names no sink."""
        return self.actuators and bool(_ROS & set(self._specs))

    def _folder(self) -> Path:
        folder = self._record or self._home / RECORDINGS
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise as_sink_failure(error, str(folder)) from error
        return folder


def _require_broker(name: str, url: str) -> None:
    if not _BROKER.match(name) or name in _ROS or name == STARTED:
        raise UsageError(
            f"{name!r} is not a valid broker name.",
            hint="Use letters, digits, _ and -, beginning with a letter; not ros1, ros2, mqtt.",
        )
    if urlsplit(url).scheme not in ("mqtt", "mqtts"):
        raise UsageError(f"Broker {name!r} in config.toml has no MQTT URL.", hint='Use "mqtts://USER@HOST".')
    open_sink(url)


def sink_json(measurement: str, sink: Sink) -> dict[str, Any]:
    """Return a sink as the API shows it, with its counters."""
    stats = sink.stats
    return {
        "measurement": measurement,
        "name": sink.name,
        "state": stats.state,
        "detail": stats.detail,
        "error": stats.error,
        "hint": stats.hint,
        "written": stats.written,
        "dropped": stats.dropped,
        "octets": stats.octets,
        "messages": stats.messages,
        "recorder": sink.recorder,
        "files": [str(file) for file in sink.files],
    }


def for_readers(value: Any) -> Any:
    """Return the form for a read-only token: files by their names, brokers without user and query."""
    if isinstance(value, str):
        return _FOLDERS.sub("", _QUERY.sub(r"\1", _USER.sub(r"\1", value))) if "/" in value else value
    if isinstance(value, dict):
        return {key: for_readers(member) for key, member in value.items()}
    return [for_readers(sink) for sink in value] if isinstance(value, list | tuple) else value
