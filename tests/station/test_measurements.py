"""Groups of nodes, and what the station measures after a start."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError, FrozenError, NotFoundError, UsageError
from teds_provision.station import measurements as rows
from teds_provision.station.station import Station
from teds_provision.station.store.records import DetectionMode, Group, KeptMeasurement

ONE, TWO, THREE = bytes(range(10)), bytes(range(1, 11)), bytes(range(2, 12))


def test_a_group_has_its_nodes_and_no_node_twice(station: Station) -> None:
    station.groups.put(Group("left hand", (ONE,)))
    station.groups.add("left hand", [ONE, TWO])
    found = station.groups.find("left hand")
    assert found is not None
    assert found.uuids == (ONE, TWO)
    station.groups.remove("left hand", [ONE])
    assert [group.uuids for group in station.groups.all()] == [(TWO,)]


def test_an_empty_group_is_listed(station: Station) -> None:
    station.groups.put(Group("spare"))
    assert [(group.name, group.uuids) for group in station.groups.all()] == [("spare", ())]


def test_a_node_is_added_to_no_group_that_is_not_there(station: Station) -> None:
    with pytest.raises(NotFoundError):
        station.groups.add("nobody", [ONE])


def test_with_a_group_go_its_measurements(station: Station) -> None:
    station.groups.put(Group("hand", (ONE,)))
    wanted = KeptMeasurement("m1", group="hand", rate=1000.0, sinks=("file.mcap",))
    station.measurements.keep(wanted)
    station.measurements.keep(KeptMeasurement("m2", uuids=(ONE, TWO), kind="event", trigger=True))
    assert station.measurements.get("m1") == wanted
    assert [measurement.id for measurement in station.measurements.all()] == ["m1", "m2"]
    assert station.measurements.forget("m3") is False
    assert station.measurements.forget("m2") is True
    assert station.measurements.forget("m2") is False
    station.measurements.keep(KeptMeasurement("m2", uuids=(ONE, TWO), kind="event", trigger=True))
    assert station.groups.delete("hand")
    assert [measurement.id for measurement in station.measurements.all()] == ["m2"]
    assert not station.groups.delete("hand")


@pytest.mark.parametrize("wrong", [KeptMeasurement("m"), KeptMeasurement("m", group="hand", uuids=(ONE,))])
def test_a_measurement_names_a_group_or_nodes(station: Station, wrong: KeptMeasurement) -> None:
    station.groups.put(Group("hand"))
    with pytest.raises(BadDataError):
        station.measurements.keep(wrong)


def test_a_measurement_comes_back_as_it_was_kept(station: Station) -> None:
    wanted = KeptMeasurement(
        "m3", uuids=(ONE,), channels=(1, 4), kind=None, trigger=True, actuators=True, dead_man=200,
        scalar_rate=0.5, sinks=("/r/run.csv", "ros1"), owner="command", pid=4711, started=1_700_000_000,
        ends=1.5e9, test_pattern=True, unsigned=True, require="[angle]\n",
    )  # fmt: skip
    station.measurements.keep(wanted)
    assert station.measurements.get("m3") == wanted


def test_names_of_topics_are_kept_each_once(station: Station) -> None:
    station.measurements.rename(ONE, 1, "crane/angle")
    station.measurements.rename(ONE, 1, "crane/slew")
    assert station.measurements.names == {(ONE, 1): "crane/slew"}
    with pytest.raises(UsageError, match="'crane/slew' is the name of channel 1 of node"):
        station.measurements.rename(TWO, 1, "crane/slew")
    station.measurements.rename(ONE, 1, None)
    assert station.measurements.names == {}


def test_a_node_in_the_place_of_another_has_its_names_and_frames_and_keeps_its_own(station: Station) -> None:
    names = station.measurements
    for uuid, channel, name in ((ONE, 0, "crane"), (ONE, 1, "slew"), (TWO, 1, "boom"), (THREE, 1, "hook")):
        names.rename(uuid, channel, name)
        names.set_frame(uuid, channel, f"{name} frame")
    done = names.hand_on(ONE, TWO)
    assert names.names == {(TWO, 0): "crane", (ONE, 1): "slew", (TWO, 1): "boom", (THREE, 1): "hook"}
    assert names.frames == {(TWO, 0): "crane frame", (TWO, 1): "boom frame", (THREE, 1): "hook frame"}
    assert done.topics == ("crane",)
    assert done.kept == ("The topic name 'slew' of channel 1: the new node has the name 'boom'.",)
    names.hand_on(TWO, None)
    assert names.names == {(ONE, 1): "slew", (THREE, 1): "hook"}
    assert names.frames == {(THREE, 1): "hook frame"}


def test_measurements_go_on_with_the_spare_or_without_the_node_and_end_without_any(station: Station) -> None:
    station.groups.put(Group("alone", (ONE,)))
    station.groups.put(Group("both", (ONE, TWO)))
    station.groups.put(Group("others", (TWO, THREE)))
    kept = [
        KeptMeasurement("m1", uuids=(THREE, ONE, TWO)), KeptMeasurement("m2", uuids=(ONE,)),
        KeptMeasurement("m3", uuids=(TWO,)), KeptMeasurement("m4", match="type:cell"),
        KeptMeasurement("m5", group="alone"), KeptMeasurement("m6", group="both"),
        KeptMeasurement("m7", group="others"),
    ]  # fmt: skip
    for one in kept:
        station.measurements.keep(one)

    def of() -> dict[str, tuple[bytes, ...]]:
        return {one.id: one.uuids for one in station.measurements.all() if one.uuids}

    done = station.measurements.hand_on(ONE, TWO)
    assert (done.groups, done.measurements, done.ended) == (("alone", "both"), ("m1", "m2", "m5", "m6"), ())
    assert of() == {"m1": (THREE, TWO), "m2": (TWO,), "m3": (TWO,)}, "no node twice"
    again = station.measurements.hand_on(ONE, TWO)
    assert (again.groups, again.measurements, again.ended) == ((), (), ())
    gone = station.measurements.hand_on(TWO, None)
    assert (gone.measurements, gone.ended) == (("m1", "m7"), ("m2", "m3", "m5", "m6"))
    assert of() == {"m1": (THREE,)}
    assert [one.id for one in station.measurements.all()] == ["m1", "m4", "m7"]
    assert [(group.name, group.uuids) for group in station.groups.all()] == [
        ("alone", ()), ("both", ()), ("others", (THREE,))
    ]  # fmt: skip


def test_a_command_that_measures_the_old_node_is_named(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    station.groups.put(Group("hand", (ONE, THREE)))
    running = [
        KeptMeasurement("c1", uuids=(TWO, ONE), owner="command", pid=41),
        KeptMeasurement("c2", uuids=(TWO,), owner="command", pid=42),
        KeptMeasurement("c3", group="hand", owner="command", pid=43),
        KeptMeasurement("c4", group="none", owner="command", pid=44),
    ]
    monkeypatch.setattr(station.measurements, "of_commands", lambda: running)
    assert station.measurements.hand_on(ONE, TWO).kept == (
        f"The running command measure {ONE.hex()} (process 41) goes on with the old node until it is started again.",
        "The running command measure hand (process 43) goes on with the old node until it is started again.",
    )
    assert station.measurements.hand_on(bytes(10), TWO).kept == ()


def test_how_nodes_are_detected_is_kept(station: Station, home: Path) -> None:
    assert station.measurements.detection == "whitelist"
    modes: tuple[DetectionMode, ...] = ("transparent", "whitelist")
    for mode in modes:
        station.measurements.detection = mode
        with Station.inspect(home) as again:
            assert again.measurements.detection == mode


def test_of_two_measurements_of_a_group_the_newest_is_continued(station: Station) -> None:
    station.groups.put(Group("hand", (ONE,)))
    for day, rate in ((2, 200.0), (1, 100.0)):
        kept = KeptMeasurement(f"m{day}", group="hand", rate=rate, created=f"2026-10-0{day}T08:00:00Z")
        station.measurements.keep(kept)
    continued = station.measurements.settings_to_continue("hand")
    assert continued is not None
    assert continued.rate == 200.0
    assert station.measurements.settings_to_continue("foot") is None


def test_what_is_continued_is_of_its_group_not_past_its_end_and_of_no_living_command(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    alive = {"running"}
    monkeypatch.setattr(rows, "OwnerLock", lambda _home, id: SimpleNamespace(is_taken=id in alive))
    monkeypatch.setattr(rows, "time", SimpleNamespace(time=lambda: 1000.0))
    for group in ("hand", "foot"):
        station.groups.put(Group(group, (ONE,)))
    kept = [
        ("first", "hand", "command", None), ("of ncap", "hand", "ncap", None), ("cut off", "hand", "command", None),
        ("past", "hand", "page", 1000.0), ("running", "hand", "command", None), ("other", "foot", "ncap", None),
    ]  # fmt: skip
    for day, (id, group, owner, ends) in enumerate(kept, 1):
        process: dict[str, Any] = {"pid": 41, "started": 999} if owner == "command" else {}
        created = f"2026-10-0{day}T08:00:00Z"
        station.measurements.keep(
            KeptMeasurement(id, group=group, rate=day * 100.0, owner=owner, ends=ends, created=created, **process)
        )
    for id, rate in (("cut off", 300.0), ("of ncap", 200.0), ("first", 100.0)):
        found = station.measurements.settings_to_continue("hand")
        assert found is not None
        assert (found.id, found.rate, found.owner, found.pid, found.started) == ("", rate, "command", None, None)
        station.measurements.forget(id)
    assert station.measurements.settings_to_continue("hand") is None


def test_a_command_counts_while_it_lives_and_the_next_reader_removes_a_dead_one(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    alive = {"c1"}
    monkeypatch.setattr(rows, "OwnerLock", lambda _home, id: SimpleNamespace(is_taken=id in alive))
    monkeypatch.setattr(rows, "time", SimpleNamespace(time=lambda: 1000.0))
    kept = [("n", "ncap", None), ("p", "page", 1000.0), ("t", "api:lab", 1000.5), ("c1", "command", None),
            ("c2", "command", None), ("c3", "command", 2000.0)]  # fmt: skip
    for day, (id, owner, ends) in enumerate(kept, 1):
        created = f"2026-10-0{day}T08:00:00Z"
        station.measurements.keep(KeptMeasurement(id, uuids=(ONE,), owner=owner, ends=ends, created=created))

    def ids(found: list[KeptMeasurement]) -> list[str]:
        return [one.id for one in found]

    assert ids(station.measurements.lasting()) == ["n", "p", "t"]
    assert len(station.measurements._rows()) == 6, "who reads them alone removes nothing"
    assert ids(station.measurements.due()) == ["n", "t"], "one that is past its end is kept, and not measured"
    assert ids(station.measurements._rows()) == ["n", "p", "t", "c1"]
    assert ids(station.measurements.of_commands()) == ["c1"]
    alive.clear()
    assert ids(station.measurements.all()) == ["n", "p", "t"]


def test_a_node_is_in_a_group_in_a_measurement_or_has_a_name(station: Station) -> None:
    names = station.measurements
    assert not names.has_node(ONE)
    station.groups.put(Group("hand", (ONE,)))
    names.keep(KeptMeasurement("m", uuids=(THREE, TWO)))
    assert [names.has_node(uuid) for uuid in (ONE, TWO, THREE)] == [True] * 3
    names.forget("m")
    assert not names.has_node(TWO)
    names.rename(TWO, 1, "force")
    names.set_frame(THREE, 0, "tool")
    assert [names.has_node(uuid) for uuid in (TWO, THREE, bytes(9) + b"x")] == [True, True, False]


@pytest.mark.parametrize(
    ("also", "message"),
    [
        ((), "Group 'hand' has 2 kept measurements (m1, m2), which would be deleted with it."),
        (("m1",), "Group 'hand' has 2 kept measurements (m1, m2), which would be deleted with it."),
        (("m3", "m2", "m1"), None),
    ],
)
def test_a_group_goes_only_with_the_measurements_that_may_go_with_it(
    station: Station, also: tuple[str, ...], message: str | None
) -> None:
    for group in ("hand", "arm"):
        station.groups.put(Group(group, (ONE,)))
    for id, group in (("m1", "hand"), ("m2", "hand"), ("m3", "arm")):
        station.measurements.keep(KeptMeasurement(id, group=group))
    if message is None:
        assert station.measurements.delete_group("hand", also=also) == (True, ("m1", "m2"))
        assert [one.id for one in station.measurements.all()] == ["m3"]
        assert station.measurements.delete_group("hand") == (False, ())
        return
    with pytest.raises(FrozenError) as refused:
        station.measurements.delete_group("hand", also=also)
    assert refused.value.message == message
    assert [one.id for one in station.measurements.all()] == ["m1", "m2", "m3"]
    assert station.groups.find("hand") is not None
