"""Link keys: pending beside active, promotion, a change of the master key."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest

from teds_provision.errors import NotFoundError, StoreError
from teds_provision.station.store import KeyRecord, NodeRecord, StationRecord, Store

NODE = bytes(range(10))
OTHER = bytes(range(1, 11))


def a_key(number: int, state: str = "pending", uuid: bytes = NODE) -> KeyRecord:
    return KeyRecord(uuid, number, f"{number:016x}", state, number, f"wrapped {number}".encode())  # type: ignore[arg-type]


def numbers(store: Store, uuid: bytes = NODE) -> list[int]:
    return [key.epoch for key in store.keys(uuid)]


def test_the_newest_pending_key_is_tried_first_and_the_active_one_last(store: Store) -> None:
    for key in (a_key(1, "active"), a_key(2), a_key(3), a_key(9, uuid=OTHER)):
        store.add_key(key)
    assert numbers(store) == [3, 2, 1]


def test_a_good_open_makes_one_key_active_and_deletes_the_active_one_before(store: Store) -> None:
    for key in (a_key(1, "active"), a_key(2), a_key(3), a_key(9, uuid=OTHER)):
        store.add_key(key)
    store.activate_key(NODE, f"{2:016x}")
    assert [(key.epoch, key.state) for key in store.keys(NODE)] == [(3, "pending"), (2, "active")]
    assert numbers(store, OTHER) == [9]


def test_promoting_again_changes_nothing(store: Store) -> None:
    store.add_key(a_key(1))
    store.activate_key(NODE, f"{1:016x}")
    before = store.keys(NODE)
    store.activate_key(NODE, f"{1:016x}")
    assert store.keys(NODE) == before


def test_promoting_an_unknown_key_deletes_nothing(store: Store) -> None:
    store.add_key(a_key(1, "active"))
    with pytest.raises(NotFoundError):
        store.activate_key(NODE, "f" * 16)
    assert numbers(store) == [1]


def test_there_is_never_a_second_active_key(store: Store) -> None:
    store.add_key(a_key(1, "active"))
    with pytest.raises(StoreError):
        store.add_key(a_key(2, "active"))
    assert numbers(store) == [1]


def test_the_same_key_again_changes_nothing(store: Store) -> None:
    store.add_key(a_key(1, "active"))
    store.add_key(a_key(1))
    assert [(key.epoch, key.state) for key in store.keys(NODE)] == [(1, "active")]


def test_a_slot_is_never_given_twice(store: Store) -> None:
    first = store.next_slot(NODE)
    store.add_key(KeyRecord(NODE, 1, "0" * 16, "pending", 7, b"w"))
    second = store.next_slot(NODE)
    store.remove_keys(NODE)
    assert (first, second, store.next_slot(NODE), store.next_slot(OTHER)) == (1, 8, 9, 1)


def test_a_master_change_rewraps_all_or_nothing(store: Store) -> None:
    for number in range(1, 1201):
        store.add_key(a_key(number, uuid=number.to_bytes(10, "big")))

    def fails_late(record: KeyRecord) -> bytes:
        if record.epoch == 1100:
            raise ValueError("stop")
        return b"new"

    with pytest.raises(ValueError, match="stop"):
        store.replace_keys(fails_late)
    assert {key.wrapped[:7] for key in store.all_keys()} == {b"wrapped"}
    assert store.replace_keys(lambda record: b"new " + record.wrapped) == 1200
    assert {key.wrapped[:11] for key in store.all_keys()} == {b"new wrapped"}


def test_a_wrapped_key_never_shows_in_a_repr() -> None:
    assert "wrapped" not in repr(a_key(1))


def test_transactions_nest_and_undo_only_what_failed(store: Store) -> None:
    with store.transaction():
        store.put_node(NodeRecord(NODE))
        with suppress(RuntimeError), store.transaction():
            store.put_node(NodeRecord(OTHER))
            raise RuntimeError
    assert [node.uuid for node in store.nodes()] == [NODE]
    with suppress(RuntimeError), store.transaction():
        store.put_facts(StationRecord("lost", "file"))
        with store.transaction():
            store.add_key(a_key(1))
        raise RuntimeError
    assert (store.facts(), store.keys(NODE)) == (None, [])


def test_a_part_of_a_change_that_failed_takes_the_whole_with_it(store: Store) -> None:
    """``together`` sets no savepoint: whoever catches its error and goes on keeps nothing, and is told."""

    def caught() -> None:
        with store.transaction():
            store.put_node(NodeRecord(NODE))
            with suppress(RuntimeError), store.together():
                store.put_node(NodeRecord(OTHER))
                raise RuntimeError

    with pytest.raises(StoreError, match="Part of this change failed"):
        caught()
    assert store.nodes() == []
    with store.transaction():
        store.put_node(NodeRecord(NODE))
        with suppress(NotFoundError), store.together():
            store.activate_key(NODE, "00" * 8)  # nothing was changed before it failed
        with suppress(RuntimeError), store.transaction(), store.together():  # a savepoint around it takes it back
            store.put_node(NodeRecord(OTHER))
            raise RuntimeError
    assert [node.uuid for node in store.nodes()] == [NODE]


def test_what_was_read_a_moment_ago_is_never_older_than_the_store(store: Store, home: Path) -> None:
    """Rows are remembered: another process, an own change, and one that was taken back must be seen."""
    store.put_node(NodeRecord(NODE, name="a"))
    with Store.open(home) as other:
        assert [store.node(NODE), other.node(NODE)] == [NodeRecord(NODE, name="a")] * 2
        other.put_node(NodeRecord(NODE, name="b"))
        assert store.node(NODE) == NodeRecord(NODE, name="b")
        with suppress(RuntimeError), store.transaction():
            store.put_node(NodeRecord(NODE, name="c"))
            assert store.node(NODE) == NodeRecord(NODE, name="c")
            raise RuntimeError
        assert store.node(NODE) == NodeRecord(NODE, name="b")
        with store.reading():
            assert store.node(NODE) == NodeRecord(NODE, name="b")
            other.put_node(NodeRecord(NODE, name="d"))
            assert store.node(NODE) == NodeRecord(NODE, name="b"), "as it was when the block began"
            store.put_node(NodeRecord(OTHER))
            assert store.node(NODE) == NodeRecord(NODE, name="d"), "but for one's own changes"
        assert store.node(NODE) == NodeRecord(NODE, name="d")
