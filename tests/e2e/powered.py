"""What a virtual node and one in C have in common for a test: a process that is powered on, and its datasheet."""

from __future__ import annotations

import signal
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tests.pace import until

if TYPE_CHECKING:
    from tests.e2e.desk import Desk, Running


@dataclass
class PoweredNode(ABC):
    """A node whose process is on the desk's reader or bus; its flash is a file in its folder."""

    desk: Desk
    folder: Path
    uuid: str
    process: Running | None = None

    @property
    @abstractmethod
    def flash(self) -> dict[str, Any]:
        """Return the contents of its flash."""

    def ready(self, process: Running) -> None:
        """Keep its process, and wait until its links are up."""
        self.process = process
        ready = process.wait_for_lines(1)[0]  # an actuator prints its state soon after
        assert ready.get("ready") is True, ready

    def stop(self) -> None:
        """End it with SIGTERM; it must exit with 0."""
        assert self.process is not None
        self.process.signal(signal.SIGTERM)
        assert self.process.end().code == 0

    def kill(self) -> None:
        """Cut its power."""
        assert self.process is not None
        self.process.process.kill()
        self.process.end()

    def press(self) -> None:
        """Hold its button, and wait until it is in factory state."""
        assert self.process is not None
        self.process.signal(signal.SIGUSR1)
        until(lambda: self.flash["key"] is None)

    @property
    def datasheet(self) -> dict[tuple[int, int], bytes]:
        """Return its TEDS by (channel, access code)."""
        return {(channel, code): bytes.fromhex(teds) for channel, code, teds in self.flash["blocks"]}
