"""Where the daemon's measurements go: the sinks it was started with, and those that a measurement names itself."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from teds_provision.errors import UsageFailure
from teds_provision.measure.sinks import FILES, CommandTaker, Sink, open_sink
from teds_provision.store import Measurement

RECORDINGS: Final = "recordings"
_ROS: Final = frozenset({"ros1", "ros2"})
_SERVICE: Final = re.compile(r"ros1\Z|ros2\Z|mqtts?://\S+\Z")
_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._ -]{0,80}\Z")


class DaemonSinks:
    """``specs`` are the words of the sinks that take every measurement, ``record`` a folder for recordings of each.

    ``actuators``: whether set points may come by the topics of any of them.
    """

    def __init__(self, home: Path, specs: Sequence[str] = (), record: Path | None = None, *, actuators: bool) -> None:
        self._home, self._specs, self.actuators = home, tuple(specs), actuators
        self._record = record.absolute() if record is not None else None

    def whole(self, spec: str) -> str:
        """The words for a sink: a service, or a file by its bare name, which lies in the folder of recordings.

        Raises UsageFailure.
        """
        if _SERVICE.match(spec):
            return spec
        if not _NAME.match(spec) or Path(spec).suffix.lower() not in FILES:
            raise UsageFailure(
                f"{spec!r} is no sink.", hint=f"Use ros1, ros2, mqtt://HOST, or a file name in {', '.join(FILES)}."
            )
        return str(self._folder() / spec)

    def more(self, kept: Measurement, take: CommandTaker | None) -> list[Sink]:
        """The daemon's own sinks for one run of a measurement, without those that it names itself.

        ``take`` takes set points of topics.
        """
        specs = [spec for spec in self._specs if spec not in kept.sinks]
        if self._record is not None:
            stamp = time.strftime("%Y%m%d-%H%M%S")
            specs.append(str(self._folder() / f"{_plain(kept.group or kept.id)}-{stamp}.csv"))
        return [open_sink(spec, take) for spec in specs]

    def moves(self, kept: Measurement) -> bool:
        """Whether set points may come for this measurement: it allows it, so does the daemon, and a ROS carries it."""
        return self.actuators and kept.actuators and bool(_ROS & {*self._specs, *kept.sinks})

    @property
    def take_set_points(self) -> bool:
        """Whether set points come by topics for a measurement that allows it and names no sink of its own."""
        return self.actuators and bool(_ROS & set(self._specs))

    def _folder(self) -> Path:
        folder = self._record or self._home / RECORDINGS
        folder.mkdir(parents=True, exist_ok=True)
        return folder


def sink_json(measurement: str, sink: Sink) -> dict[str, Any]:
    """A sink as the API shows it, with what became of what it was given."""
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
        "recorder": bool(getattr(sink, "recorder", False)),
        "files": [str(file) for file in sink.files],
    }


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name)[:60] or "measurement"
