"""Groups of nodes, and what the station measures after a start."""

from __future__ import annotations

import pytest

from teds_provision.errors import BadData, StoreFailure
from teds_provision.store import Group, Measurement, Store

ONE, TWO = bytes(range(10)), bytes(range(1, 11))


def test_a_group_has_its_nodes_and_no_node_twice(store: Store) -> None:
    store.put_group(Group("left hand", (ONE,)))
    store.add_to_group("left hand", [ONE, TWO])
    found = store.group("left hand")
    assert found is not None
    assert found.uuids == (ONE, TWO)
    store.remove_from_group("left hand", [ONE])
    assert [group.uuids for group in store.groups()] == [(TWO,)]
    assert store.groups_of(TWO) == ["left hand"]
    assert store.groups_of(ONE) == []


def test_an_empty_group_is_listed(store: Store) -> None:
    store.put_group(Group("spare"))
    assert [(group.name, group.uuids) for group in store.groups()] == [("spare", ())]


def test_a_node_is_added_to_no_group_that_is_not_there(store: Store) -> None:
    with pytest.raises(StoreFailure):
        store.add_to_group("nobody", [ONE])


def test_with_a_group_go_its_measurements(store: Store) -> None:
    store.put_group(Group("hand", (ONE,)))
    wanted = Measurement("m1", "hand", rate=1000.0, sinks=("file.mcap",))
    store.put_measurement(wanted)
    store.put_measurement(Measurement("m2", uuids=(ONE, TWO), kind="event", trigger=True))
    assert store.measurement("m1") == wanted
    assert [one.id for one in store.measurements()] == ["m1", "m2"]
    assert store.remove_group("hand")
    assert [one.id for one in store.measurements()] == ["m2"]
    assert not store.remove_group("hand")


@pytest.mark.parametrize("wrong", [Measurement("m"), Measurement("m", "hand", (ONE,))])
def test_a_measurement_names_a_group_or_nodes(store: Store, wrong: Measurement) -> None:
    with pytest.raises(BadData):
        store.put_measurement(wrong)
