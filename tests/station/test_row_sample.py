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
