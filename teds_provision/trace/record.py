"""One entry of a trace: a frame as the link carried it, or a whole message with its name."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final, Literal

from teds_provision import __version__
from teds_provision.errors import BadDataError
from teds_provision.links.ports import Direction

Layer = Literal["frame", "message"]


@dataclass(frozen=True)
class Record:
    """A frame or a message.

    ``time`` in unix seconds; ``octets`` as sent (sealed messages sealed); ``opened`` the plain command or reply of a
    sealed one, None if it was not opened; ``identifier`` and ``fd`` of a CAN frame; ``uuid`` of the node, if it is
    known; ``command`` a description.
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
        """Return the record as in a file of lines and in ``trace show --json``, without members that do not apply."""
        members: dict[str, Any] = {
            "time": datetime.fromtimestamp(self.time, UTC).isoformat(timespec="microseconds").replace("+00:00", "Z"),
            "direction": self.direction,
            "link": self.link,
            "layer": self.layer,
            "command": self.command,
            "sealed": self.sealed,
            "octets": self.octets.hex(),
        }
        if self.opened is not None:
            members["opened"] = self.opened.hex()
        if self.identifier is not None:
            members |= {"identifier": f"{self.identifier:08x}", "fd": self.fd}
        if self.uuid:
            members["uuid"] = self.uuid
        return members


# A trace is JSON lines; the first one describes the file. A process that is killed leaves whole lines.

FORMAT: Final = "teds-trace/1"


def head() -> bytes:
    """Return the first line."""
    return json.dumps({"format": FORMAT, "made_by": f"teds-provision {__version__}"}).encode() + b"\n"


def line(record: Record) -> bytes:
    """Return the line of one record."""
    return json.dumps(record.as_json()).encode() + b"\n"


def is_lines(octets: bytes) -> bool:
    """Return True if a file begins as a trace of lines does."""
    return octets[:64].lstrip().startswith(f'{{"format": "{FORMAT}"'.encode())


def read_lines(octets: bytes) -> Iterator[Record]:
    """Yield every record; a last line that was cut off is left out. Raises BadDataError with the line's number."""
    for number, row in enumerate(io.BytesIO(octets), 1):
        if number == 1 or not row.strip():
            continue
        try:
            yield _record(json.loads(row))
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            if not row.endswith(b"\n"):
                return
            raise BadDataError(f"Line {number} of the trace is not a valid record: {error}.") from error


def _record(row: dict[str, Any]) -> Record:
    direction, layer = row["direction"], row["layer"]
    if direction not in ("out", "in") or layer not in ("frame", "message"):
        raise ValueError("direction or layer is none")
    return Record(
        time=datetime.fromisoformat(row["time"]).timestamp(),
        direction=direction,
        link=str(row["link"]),
        layer=layer,
        octets=bytes.fromhex(row["octets"]),
        command=str(row["command"]),
        opened=bytes.fromhex(row["opened"]) if "opened" in row else None,
        sealed=bool(row["sealed"]),
        identifier=int(row["identifier"], 16) if "identifier" in row else None,
        fd=bool(row.get("fd", False)),
        uuid=str(row.get("uuid", "")),
    )
