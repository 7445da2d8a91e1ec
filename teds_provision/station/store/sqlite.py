"""sqlite3 at its first use: ``--help`` opens no store."""

from __future__ import annotations

from typing import TYPE_CHECKING

from teds_provision.lazy import late

__all__ = ["sqlite3"]

if TYPE_CHECKING:
    import sqlite3
else:
    sqlite3 = late("sqlite3")
