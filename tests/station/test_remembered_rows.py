"""Rows that are remembered (docs/store.md, "Durability and cost"): until this process writes or another one has."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from teds_provision.station.store.store import Store

ONE = "SELECT value FROM meta WHERE name = 'one'"


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path / "home", create=True) as opened:
        opened.execute("INSERT INTO meta VALUES('one', '1')")
        yield opened


@pytest.fixture
def made() -> list[str]:
    """Return the values of which a record was made: each is read from the file then."""
    return []


def maker(made: list[str]) -> Callable[[str], str]:
    def make(value: str) -> str:
        made.append(value)
        return value

    return make


def test_a_row_is_read_once_until_this_process_writes(store: Store, made: list[str]) -> None:
    make = maker(made)
    assert [store.recall(make, ONE) for _ in range(3)] == [("1",)] * 3
    assert (store.read_one(make, ONE), made) == ("1", ["1"])
    assert store.recall(make, "SELECT value FROM meta WHERE name = ?", ("one",)) == ("1",)
    assert store.recall(make, "SELECT value FROM meta WHERE name = ?", ("none",)) == ()
    assert made == ["1", "1"], "each statement with its values"
    store.execute("UPDATE meta SET value = '2' WHERE name = 'one'")
    assert (store.recall(make, ONE), made) == (("2",), ["1", "1", "2"])


def test_what_was_taken_back_is_not_remembered(store: Store, made: list[str]) -> None:
    make = maker(made)

    def fail() -> None:
        with store.transaction():
            store.execute("UPDATE meta SET value = '2' WHERE name = 'one'")
            assert store.recall(make, ONE) == ("2",)
            raise KeyError

    assert store.recall(make, ONE) == ("1",)
    with pytest.raises(KeyError):
        fail()
    assert store.recall(make, ONE) == ("1",)
    assert made == ["1", "2", "1"]


def test_what_another_process_wrote_is_read(store: Store, made: list[str]) -> None:
    make = maker(made)
    assert store.recall(make, ONE) == ("1",)
    with Store.open(store.home) as other:
        assert other.read_one(str, ONE) == "1"
        other.execute("UPDATE meta SET value = '2' WHERE name = 'one'")
        assert store.recall(make, ONE) == ("2",)
        other.execute("UPDATE meta SET value = '3' WHERE name = 'one'")
    assert (store.recall(make, ONE), made) == (("3",), ["1", "2", "3"])


def test_no_more_than_a_hundred_are_remembered(store: Store, made: list[str]) -> None:
    make = maker(made)
    for number in range(250):
        assert store.recall(make, "SELECT ? FROM meta LIMIT 1", (str(number),)) == (str(number),)
        assert len(store._remembered) <= 100
    assert store.recall(make, "SELECT ? FROM meta LIMIT 1", ("249",)) == ("249",)
    assert made == [str(number) for number in range(250)]
