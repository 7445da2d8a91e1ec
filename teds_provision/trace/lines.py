"""A trace as lines: one JSON object each, the first says what the file is. Whoever is killed leaves whole lines."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import datetime
from typing import Any, Final

from teds_provision import __version__
from teds_provision.errors import BadData
from teds_provision.trace.record import Record

FORMAT: Final = "teds-trace/1"


def head() -> bytes:
    """The first line."""
    return json.dumps({"format": FORMAT, "made_by": f"teds-provision {__version__}"}).encode() + b"\n"


def line(record: Record) -> bytes:
    """One record."""
    return json.dumps(record.as_json()).encode() + b"\n"


def is_lines(octets: bytes) -> bool:
    """Whether a file begins as a trace of lines does."""
    return octets[:64].lstrip().startswith(b'{"format": "' + FORMAT.encode())


def read_lines(octets: bytes) -> Iterator[Record]:
    """Every record; a last line that was cut short is left out. Raises BadData with the line's number."""
    rows = octets.split(b"\n")
    for number, row in enumerate(rows[1:], 2):
        if not row.strip():
            continue
        try:
            yield _record(json.loads(row))
        except (ValueError, KeyError, TypeError) as error:
            if number == len(rows):
                return
            raise BadData(f"Line {number} of the trace is no record: {error}.") from error


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
