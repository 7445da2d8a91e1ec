"""Samples of large tables: runs of neighbours from anywhere, whatever the key consists of, and never more."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.station.store import row_sample
from teds_provision.station.store.row_sample import ALL_ROWS, RowSample
from teds_provision.station.store.store import Store


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    monkeypatch.setattr(row_sample, "SAMPLED", 40)
    monkeypatch.setattr(row_sample, "_RUN", 4)
    with Store.open(tmp_path / "home", create=True) as opened:
        yield opened


def filled(store: Store, table: str, count: int) -> None:
    """Fill a table without numbers: its key is integers, a blob, or texts."""
    for number in range(count):
        values = {
            "event_ids": (number % 3, number * 7919 % 10007),
            "key_slots": (number.to_bytes(2) * 5, 1),
            "lifted": (hashlib.sha256(bytes([number % 256, number >> 8])).hexdigest(), "x", None),
        }[table]
        store.execute(f"INSERT INTO {table} VALUES({', '.join('?' * len(values))})", values)


def numbered(store: Store, count: int) -> None:
    """Fill a table whose rows have numbers."""
    store.execute("CREATE TABLE numbered(number INTEGER)")
    for number in range(count):
        store.execute("INSERT INTO numbered VALUES(?)", (number,))


@pytest.mark.parametrize(
    ("table", "key"), [("event_ids", ["chain", "id"]), ("key_slots", ["uuid"]), ("lifted", ["statement"])]
)
def test_runs_of_a_table_begin_anywhere_and_reach_its_end(store: Store, table: str, key: list[str]) -> None:
    filled(store, table, 600)
    columns = ", ".join(key)
    rows = store.execute(f"SELECT {columns} FROM {table} ORDER BY {columns}")
    seen: set[object] = set()
    for _ in range(30):
        found = list(row_sample._runs(store, table, key, 40))
        assert 4 <= len(found) <= 44
        assert rows[-1][0] in found
        seen.update(found)
    assert len(seen) == 3 if table == "event_ids" else len(seen) > 200  # three chains: of each row its first column


def test_a_small_table_is_read_whole_and_a_full_check_reads_all(store: Store) -> None:
    filled(store, "key_slots", 30)
    sample = RowSample()
    assert (sample.rows(store, "key_slots"), sample.row_runs(store, "key_slots", ["uuid"])) == (ALL_ROWS, False)
    assert not sample.sampled
    for number in range(30, 100):
        store.execute("INSERT INTO key_slots VALUES(?, 1)", (number.to_bytes(2) * 5,))
    assert RowSample(full=True).rows(store, "key_slots") == ALL_ROWS
    chosen = sample.rows(store, "key_slots")
    assert sample.sampled
    (count,) = store.execute(f"SELECT count(*) FROM key_slots WHERE {chosen}")[0]
    assert 4 <= count <= 24


@pytest.mark.parametrize(("rows", "sampled"), [(40, False), (41, True)])
def test_a_table_is_large_above_the_bound(store: Store, rows: int, sampled: bool) -> None:
    filled(store, "key_slots", rows)
    numbered(store, rows)
    for read in (
        lambda sample: sample.rows(store, "key_slots") == ALL_ROWS,
        lambda sample: sample.numbered_rows(store, "numbered") == ALL_ROWS,
        lambda sample: not sample.row_runs(store, "key_slots", ["uuid"]),
    ):
        sample = RowSample()
        assert (read(sample), sample.sampled) == (not sampled, sampled)


def test_of_rows_with_numbers_the_newest_and_others_at_random_are_read(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(row_sample, "_NEWEST", 5)
    numbered(store, 200)
    seen: set[int] = set()
    for _ in range(30):
        chosen = RowSample().numbered_rows(store, "numbered")
        numbers = {number for (number,) in store.execute(f"SELECT rowid FROM numbered WHERE {chosen}")}
        assert set(range(195, 201)) <= numbers
        assert 40 <= len(numbers) <= 46
        seen |= numbers
    assert {1, 2, 3, 4, 5} & seen


@pytest.mark.parametrize("entries", [1, 79, 80])
def test_a_short_log_is_checked_whole(store: Store, entries: int) -> None:
    sample = RowSample()
    assert (sample.runs(entries), sample.sampled) == ([(1, entries)], False)


def test_of_a_long_log_the_newest_and_as_many_at_random_are_checked(store: Store) -> None:
    assert RowSample(full=True).runs(81) == [(1, 81)]
    seen: set[int] = set()
    for _ in range(200):
        sample = RowSample()
        *older, newest = sample.runs(81)
        assert (newest, sample.sampled) == ((42, 81), True)
        assert len(older) == 10
        assert older == sorted(older)
        assert all(last - first == 3 and first >= 1 and last <= 41 for first, last in older)
        seen.update(number for first, last in older for number in range(first, last + 1))
    assert seen == set(range(1, 42)), "any of them may be drawn"
