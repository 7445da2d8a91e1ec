"""Groups of nodes, and what the station measures after a start."""

from __future__ import annotations

import pytest

from teds_provision.errors import BadDataError, StoreError, TedsProvisionError
from teds_provision.station.store import Group, KeptMeasurement, Store

ONE, TWO = bytes(range(10)), bytes(range(1, 11))


def test_a_group_has_its_nodes_and_no_node_twice(store: Store) -> None:
    store.put_group(Group("left hand", (ONE,)))
    store.add_to_group("left hand", [ONE, TWO])
    found = store.group("left hand")
    assert found is not None
    assert found.uuids == (ONE, TWO)
    store.remove_from_group("left hand", [ONE])
    assert [group.uuids for group in store.groups()] == [(TWO,)]


def test_an_empty_group_is_listed(store: Store) -> None:
    store.put_group(Group("spare"))
    assert [(group.name, group.uuids) for group in store.groups()] == [("spare", ())]


def test_a_node_is_added_to_no_group_that_is_not_there(store: Store) -> None:
    with pytest.raises(StoreError):
        store.add_to_group("nobody", [ONE])


def test_with_a_group_go_its_measurements(store: Store) -> None:
    store.put_group(Group("hand", (ONE,)))
    wanted = KeptMeasurement("m1", "hand", rate=1000.0, sinks=("file.mcap",))
    store.put_measurement(wanted)
    store.put_measurement(KeptMeasurement("m2", uuids=(ONE, TWO), kind="event", trigger=True))
    assert store.measurement("m1") == wanted
    assert [measurement.id for measurement in store.measurements()] == ["m1", "m2"]
    assert store.remove_group("hand")
    assert [measurement.id for measurement in store.measurements()] == ["m2"]
    assert not store.remove_group("hand")


@pytest.mark.parametrize("wrong", [KeptMeasurement("m"), KeptMeasurement("m", "hand", (ONE,))])
def test_a_measurement_names_a_group_or_nodes(store: Store, wrong: KeptMeasurement) -> None:
    with pytest.raises(BadDataError):
        store.put_measurement(wrong)


def test_a_measurement_comes_back_as_it_was_kept(store: Store) -> None:
    wanted = KeptMeasurement(
        "m3", uuids=(ONE,), channels=(1, 4), kind=None, trigger=True, actuators=True, dead_man=200,
        scalar_rate=0.5, sinks=("/r/run.csv", "ros1"), owner="command", pid=4711, started=1_700_000_000,
        ends=1.5e9, test_pattern=True, unsigned=True, require="[angle]\n",
    )  # fmt: skip
    store.put_measurement(wanted)
    assert store.measurement("m3") == wanted


def test_names_of_topics_are_kept_each_once(store: Store) -> None:
    store.put_topic_name(ONE, 1, "crane/angle")
    store.put_topic_name(ONE, 1, "crane/slew")
    assert store.topic_names() == {(ONE, 1): "crane/slew"}
    with pytest.raises(TedsProvisionError):
        store.put_topic_name(TWO, 1, "crane/slew")
    assert store.remove_topic_name(ONE, 1)
    assert store.topic_names() == {}


def test_how_nodes_are_detected_is_kept(store: Store) -> None:
    assert store.detection() is None
    for mode in ("transparent", "whitelist"):
        store.put_detection(mode)
        assert store.detection() == mode
