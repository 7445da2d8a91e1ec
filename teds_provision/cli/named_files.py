"""Files that a command line names: read with a limit, written atomically."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final

from teds_provision.files import SHARED, read_limited, write_whole

MAX_INPUT_OCTETS: Final = 32 << 20


def write_file(path: Path, text: str | Iterable[str]) -> None:
    """Write a result file part by part; if anything fails, no file is left."""
    parts = (text,) if isinstance(text, str) else text
    write_whole(path, (part.encode("utf-8") for part in parts), mode=SHARED)


def read_file(path: Path) -> bytes:
    """Read an input file; raises NotFoundError, BadDataError (too large)."""
    return read_limited(path, MAX_INPUT_OCTETS, "image")
