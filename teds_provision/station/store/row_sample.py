"""Samples of large tables for checks: the newest rows and some at random, so that the time of a check does not grow.

Nothing here counts or reads a whole large table. A row of a node with a key, or of a table with numbers, that another
program changed is found with a probability of half of ``SAMPLED / n`` at least by each run; other rows as their keys
are spread, of a batch with neighbouring UUIDs as of others. A pin, a key or a CA is checked whenever it is used anyway.
"""

from __future__ import annotations

import json
import random
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

from teds_provision.station.store.database import Database

SAMPLED: Final = 5_000
"""Rows at random of each large table; a table with no more rows is read whole."""
ALL_ROWS: Final = "1"
_NEWEST: Final = 500
_RUN: Final = 20
"""Rows or entries of a log that are read in one go, from a random one on."""


class RowSample:
    """The rows that one check reads; with ``full`` all of them."""

    def __init__(self, *, full: bool = False) -> None:
        self.full = full
        """True if the check reads everything."""
        self.sampled = False
        """True once a table was too large to be read whole."""

    def rows(self, store: Database, table: str, key: str = "uuid") -> str:
        """Return the condition in SQL for the rows of ``table`` to read, whose primary key begins with this column.

        Of a table that lists nodes: the nodes keyed last, others with a key at random, and runs of neighbours that
        begin anywhere, as a node may have no key.
        """
        if not self._is_large(store, table):
            return ALL_ROWS
        self.sampled = True
        chosen = set(_runs(store, table, [key], SAMPLED // 2))
        if key == "uuid":
            keyed = f"SELECT uuid FROM keys WHERE {self._numbers(store, 'keys', SAMPLED // 2)}"
            chosen.update(uuid for (uuid,) in store.execute(keyed))
        return f"{key} IN ({_listed(chosen)})"

    def newest_keyed(self, store: Database) -> str:
        """Return a query in SQL for the nodes that were keyed last, "" if there are few and all are meant."""
        if not self._is_large(store, "keys"):
            return ""
        self.sampled = True
        return f"SELECT uuid FROM keys WHERE state = 'active' ORDER BY seq DESC LIMIT {SAMPLED}"

    def row_runs(self, store: Database, table: str, key: Sequence[str]) -> bool:
        """Read runs of rows of a large table without numbers, whose primary key are these columns, each row whole.

        False, and nothing is read, if it is not large.
        """
        if not self._is_large(store, table):
            return False
        self.sampled = True
        for _ in _runs(store, table, key, SAMPLED, whole=True):
            pass
        return True

    def _is_large(self, store: Database, table: str) -> bool:
        """Return True if a table has more rows than are read; counts no further."""
        if self.full:
            return False
        counted = store.first_row(f"SELECT count(*) FROM (SELECT 1 FROM {table} LIMIT {SAMPLED + 1})")
        return counted is not None and counted[0] > SAMPLED

    def numbered_rows(self, store: Database, table: str) -> str:
        """Return what :meth:`rows` does for a table whose rows have numbers (SQLite's rowid); reads nothing else."""
        numbers = self._numbers(store, table, SAMPLED)
        self.sampled |= numbers != ALL_ROWS
        return numbers

    def _numbers(self, store: Database, table: str, count: int) -> str:
        last = None if self.full else store.first_row(f"SELECT max(rowid) FROM {table}")
        if last is None or (last[0] or 0) <= SAMPLED:
            return ALL_ROWS
        numbers = [*random.sample(range(1, last[0] + 1), count), *range(last[0] - _NEWEST, last[0] + 1)]
        return f"rowid IN (SELECT value FROM json_each('{json.dumps(numbers)}'))"

    def runs(self, count: int) -> list[tuple[int, int]]:
        """Return which of ``count`` numbered entries of a log to read, as first and last number, ascending."""
        if self.full or count <= 2 * SAMPLED:
            return [(1, count)]
        self.sampled = True
        older = count - SAMPLED
        starts = sorted(random.sample(range(1, older - _RUN + 2), SAMPLED // _RUN))
        return [*((first, first + _RUN - 1) for first in starts), (older + 1, count)]


def _runs(store: Database, table: str, key: Sequence[str], count: int, *, whole: bool = False) -> Iterator[Any]:
    """Yield so many rows in runs of neighbours that begin at random, and the last run: the key's first column of each.

    No row is counted to draw a start. Half of them are drawn between the first and the last value of each column of
    the key in turn, so that a row far from all others is reached. The other half are found by halving that range again
    and again, so that rows close together are reached, however far another one is from them.
    """
    columns, what = ", ".join(key), "*" if whole else key[0]
    places = ", ".join("?" * len(key))
    after = f"SELECT {what} FROM {table} WHERE ({columns}) >= ({places}) ORDER BY {columns} LIMIT {_RUN}"
    for number in range(max(2, count // _RUN)):
        start = _drawn(store, table, key, by_halves=number % 2 == 1)
        yield from (row[0] for row in store.execute(after, start))
    last = ", ".join(f"{column} DESC" for column in key)
    yield from (row[0] for row in store.execute(f"SELECT {what} FROM {table} ORDER BY {last} LIMIT {_RUN}"))


def _drawn(store: Database, table: str, key: Sequence[str], *, by_halves: bool) -> list[Any]:
    """Return the values of a key that is there, drawn column by column."""
    values: list[Any] = []
    for name in key:
        column = _Column(store, table, name, tuple(zip(key, values, strict=False)))
        values.append(column.drawn_by_halves() if by_halves else column.drawn_by_value())
    return values


@dataclass(frozen=True)
class _Column:
    """A column of a key, in the rows that have certain values in the columns before it; there is one row at least."""

    store: Database
    table: str
    name: str
    before: tuple[tuple[str, Any], ...]

    def drawn_by_value(self) -> Any:
        """Return the first value that is there from a random one on."""
        first, last = self._end("ASC"), self._end("DESC")
        found = self._end("ASC", ">=", _between(first, last))
        return found if found is not None else last

    def drawn_by_halves(self) -> Any:
        """Return a value that is there: the range is halved, and one half taken by chance, until one value is left."""
        first, last = self._end("ASC"), self._end("DESC")
        while first != last:
            middle = _between(first, last, random_one=False)
            if not first < middle <= last:  # not a number
                middle = last
            lower = random.random() < 0.5
            found = self._end("DESC", "<", middle) if lower else self._end("ASC", ">=", middle)
            if found is None:  # only in a damaged file
                break
            first, last = (first, found) if lower else (found, last)
        return first

    def _end(self, way: str, compared: str = "IS NOT", value: Any = None) -> Any:
        """Return the first value in this order that compares so with ``value``, None if there is none."""
        fixed = "".join(f"{name} = ? AND " for name, _ in self.before)
        found = self.store.first_row(
            f"SELECT {self.name} FROM {self.table} WHERE {fixed}{self.name} {compared} ?"
            f" ORDER BY {self.name} {way} LIMIT 1",
            [*(value for _, value in self.before), value],
        )
        return found[0] if found is not None else None


def _between(first: Any, last: Any, *, random_one: bool = True) -> Any:
    """Return a random value from ``first`` to ``last``, in SQLite's order, or the middle: integers, blobs or texts."""
    if isinstance(first, int):
        return random.randint(first, last) if random_one else (first + last + 1) // 2
    if isinstance(first, str):
        try:
            low, high = bytes.fromhex(first), bytes.fromhex(last)
        except ValueError:
            return _between(first.encode(), last.encode(), random_one=random_one).decode(errors="ignore")
        return _between(low, high, random_one=random_one).hex()  # such keys are all hex
    size = max(len(first), len(last))
    low_number, high_number = int.from_bytes(first.ljust(size, b"\0")), int.from_bytes(last.ljust(size, b"\xff"))
    return int(_between(low_number, high_number, random_one=random_one)).to_bytes(size)


def _listed(values: Iterable[bytes]) -> str:
    return ", ".join(f"x'{value.hex()}'" for value in values)
