"""The file of the store, and sqlite3 at its first use: ``--help`` opens no store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from teds_provision.lazy import late

__all__ = ["FILE_NAME", "has_store", "sqlite3"]

if TYPE_CHECKING:
    import sqlite3
else:
    sqlite3 = late("sqlite3")

FILE_NAME: Final = "store.sqlite3"


def has_store(home: Path) -> bool:
    """Return True if there is a store here, usable or not."""
    return (home / FILE_NAME).exists()
