"""One entry of a trace: a frame as the link carried it, or a whole message with its name."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

from teds_provision.links.ports import Direction

Layer = Literal["frame", "message"]


@dataclass(frozen=True)
class Record:
    """A frame or a message.

    ``time`` in unix seconds; ``octets`` as they went (sealed messages sealed); ``opened`` the plain command or reply of
    a sealed one, None where it was not opened; ``identifier`` and ``fd`` of a CAN frame; ``uuid`` of the node, where it
    is known; ``command`` what it is, in words.
    """

    time: float
    direction: Direction
    link: str
    layer: Layer
    octets: bytes
    command: str = ""
    opened: bytes | None = None
    sealed: bool = False
    identifier: int | None = None
    fd: bool = False
    uuid: str = ""

    def as_json(self) -> dict[str, Any]:
        """As it stands in a file of lines and in ``trace show --json``; what does not apply is left out."""
        told: dict[str, Any] = {
            "time": datetime.fromtimestamp(self.time, UTC).isoformat(timespec="microseconds").replace("+00:00", "Z"),
            "direction": self.direction,
            "link": self.link,
            "layer": self.layer,
            "command": self.command,
            "sealed": self.sealed,
            "octets": self.octets.hex(),
        }
        if self.opened is not None:
            told["opened"] = self.opened.hex()
        if self.identifier is not None:
            told |= {"identifier": f"{self.identifier:08x}", "fd": self.fd}
        if self.uuid:
            told["uuid"] = self.uuid
        return told
