"""Reading a trace, in either form; a capture of CAN frames by another program is read as well."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from teds_provision.errors import BadData
from teds_provision.files import read_limited
from teds_provision.trace.lines import is_lines, read_lines
from teds_provision.trace.pcapng import is_pcapng, read_pcapng
from teds_provision.trace.record import Record

_MOST_OCTETS: Final = 1 << 30


def read_trace(path: Path) -> Iterator[Record]:
    """Every record of a file. Raises NotFound, and BadData where it is no trace (told before the first record)."""
    octets = read_limited(path, _MOST_OCTETS, "trace")
    if is_lines(octets):
        return read_lines(octets)
    if is_pcapng(octets):
        return read_pcapng(octets)
    raise BadData(f"{path} is no trace.", hint="Traces are what --trace FILE wrote, or pcapng with CAN frames.")
