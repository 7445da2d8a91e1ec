"""Which rows of a large table a check reads: the newest and some at random, so that its time does not grow with them.

A row that another program changed in a table of n rows is found with a probability of ``SAMPLED / n`` by each run; a
pin, a key or a CA is checked whenever it is used anyway.
"""

from __future__ import annotations

import json
import random
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from teds_provision.station.store.database import Database

SAMPLED: Final = 5_000
"""Rows at random of each large table; a table with no more rows is read whole."""
ALL_ROWS: Final = "1"
_NEWEST: Final = 500
_RUN: Final = 50
"""Entries of a log that are read in one go, from a random one on."""


class RowSample:
    """The rows that one check reads; with ``full`` all of them."""

    def __init__(self, *, full: bool = False) -> None:
        self.full = full
        """True if the check reads everything."""
        self.sampled = False
        """True once a table was too large to be read whole."""

    def rows(self, store: Database, table: str, key: str = "uuid") -> str:
        """Return the condition in SQL for the rows of ``table`` to read, whose key are these columns.

        Of a table that lists nodes, the nodes keyed last are always among them.
        """
        counted = None if self.full else store.one(f"SELECT count(*) FROM {table}")
        if counted is None or counted[0] <= SAMPLED:
            return ALL_ROWS
        self.sampled = True
        chosen = f"SELECT {key} FROM {table} WHERE (random() & 0x7fffffffffff) % {counted[0]} < {SAMPLED}"
        if key == "uuid":
            chosen += f" UNION SELECT uuid FROM (SELECT uuid FROM keys ORDER BY seq DESC LIMIT {_NEWEST})"
        return f"({key}) IN ({chosen})"

    def numbered_rows(self, store: Database, table: str) -> str:
        """Return what :meth:`rows` does for a table whose rows have numbers (SQLite's rowid); reads nothing else."""
        last = None if self.full else store.one(f"SELECT max(rowid) FROM {table}")
        if last is None or (last[0] or 0) <= SAMPLED:
            return ALL_ROWS
        self.sampled = True
        numbers = [*random.sample(range(1, last[0] + 1), SAMPLED), *range(last[0] - _NEWEST, last[0] + 1)]
        return f"rowid IN (SELECT value FROM json_each('{json.dumps(numbers)}'))"

    def runs(self, count: int) -> list[tuple[int, int]]:
        """Return which of ``count`` numbered entries of a log to read, as first and last number, ascending."""
        if self.full or count <= 2 * SAMPLED:
            return [(1, count)]
        self.sampled = True
        older = count - SAMPLED
        starts = sorted(random.sample(range(1, older - _RUN + 2), SAMPLED // _RUN))
        return [*((first, first + _RUN - 1) for first in starts), (older + 1, count)]
