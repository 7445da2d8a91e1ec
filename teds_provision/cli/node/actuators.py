"""What virtual actuators do, as lines on stdout: at most twenty a second each, the last state always.

``time`` of a line is when the state began, not when the line was printed: how long a dead-man took can be read there.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from teds_provision.cli.context import App

if TYPE_CHECKING:
    from teds_provision.node.hardware.board import Shown

_EVERY_SECONDS = 0.05


class ActuatorLines:
    """Prints states in a thread of its own, from :meth:`start` on; the first line says where each one stands."""

    def __init__(self, app: App) -> None:
        self._app = app
        self._news: dict[tuple[str, int], Shown] = {}
        self._told: dict[tuple[str, int], Shown] = {}
        self._condition = threading.Condition()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="actuators", daemon=True)

    def of(self, uuid: str) -> Callable[[Shown], None]:
        """Where the board of a node tells its states."""

        def shown(state: Shown) -> None:
            with self._condition:
                self._news[uuid, state.channel] = state
                self._condition.notify()

        return shown

    def start(self) -> None:
        """Begin to print."""
        self._thread.start()

    def stop(self) -> None:
        """Print what is left, and end."""
        self._stop.set()
        with self._condition:
            self._condition.notify()
        if self._thread.is_alive():
            self._thread.join(timeout=2)

    def _run(self) -> None:
        while not self._stop.is_set():
            with self._condition:
                while not self._news and not self._stop.is_set():
                    self._condition.wait()
            self._tell_news()
            self._stop.wait(_EVERY_SECONDS)
        self._tell_news()

    def _tell_news(self) -> None:
        with self._condition:
            news, self._news = self._news, {}
        for (uuid, channel), state in news.items():
            if self._told.get((uuid, channel)) != state:
                self._told[uuid, channel] = state
                try:
                    self._tell(uuid, state)
                except OSError:  # nobody reads, or the disk is full: the node runs on
                    self._stop.set()
                    return

    def _tell(self, uuid: str, state: Shown) -> None:
        name = state.name or f"channel {state.channel}"
        value = f"{state.value:g} {state.unit}".rstrip() if state.value is not None else f"raw {state.raw:g}"
        self._app.emit(
            {
                "event": "actuator",
                "uuid": uuid,
                "channel": state.channel,
                "name": state.name,
                "value": state.value,
                "unit": state.unit,
                "raw": state.raw if state.raw == state.raw else None,
                "safe": state.safe,
                "time": datetime.fromtimestamp(state.time, UTC)
                .isoformat(timespec="milliseconds")
                .replace("+00:00", "Z"),
            },
            f"{uuid} {name}: {'safe state, ' if state.safe else ''}{value}",
        )
