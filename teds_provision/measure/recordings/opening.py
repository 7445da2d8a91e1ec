"""Opens a recording of any format, identified by its first octets and not by its name."""

from __future__ import annotations

from pathlib import Path

from teds_provision.errors import BadDataError
from teds_provision.files import open_to_read
from teds_provision.measure.recordings import json_lines, mcap, parquet, text
from teds_provision.measure.recordings.source import Recording
from teds_provision.measure.sinks.mcap.writer import MAGIC


def open_recording(path: Path) -> Recording:
    """Open a recording.

    Raises NotFoundError, BadDataError (none of ours, damaged), UsageError (Parquet without pyarrow).
    """
    with open_to_read(path) as file:
        begin = file.read(64)
    if begin.startswith(MAGIC):
        return mcap.McapRecording(path)
    if begin.startswith(parquet.MAGIC):
        return parquet.ParquetRecording(path)
    if begin.startswith(json_lines.FIRST):
        return json_lines.JsonLines(path)
    if begin.startswith(text.FIRST.encode()):
        return text.TextRecording(path)
    if not begin:
        raise BadDataError(f"{path} is empty.")
    raise BadDataError(
        f"{path} is not a recording.",
        hint="Recordings are written by `measure --to`: CSV, text, MCAP, JSON lines; or Parquet.",
    )
