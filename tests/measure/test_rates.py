"""The rate that is proposed: of the slowest of datasheet, bus, budget and machine; after losses a lower one."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from teds_provision.links.can.airtime import CanAirtime
from teds_provision.measure import rates
from teds_provision.measure.planning import BusTime
from teds_provision.measure.rates import (
    RateProposal,
    Surroundings,
    lower_rate,
    propose,
    rounded_down,
    this_machine,
)
from teds_provision.measure.request import MeasurementRequest
from teds_provision.protocol.operation.budget import MOST_LOAD
from teds_provision.station.station import Station
from teds_provision.teds.channel import Channel
from tests.bench import make_station
from tests.e2e.desk import ANGLE
from tests.measure.rig import FAULTY, Rig, provisioned
from tests.measure.test_planning import channels

HIGH = 1e9


@pytest.fixture(scope="module")
def station(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Station, bytes, bytes]]:
    """Yield a station with an angle sensor of 10 kHz and a gripper with two sensors of 100 Hz."""
    folder = tmp_path_factory.mktemp("rates")
    with_keys = make_station(folder / "bench", "bench")
    try:
        angle, hand = (
            provisioned(with_keys, folder / name, type_, name) for name, type_ in (("a", ANGLE), ("h", "gripper"))
        )
        yield with_keys, bytes.fromhex(angle), bytes.fromhex(hand)
    finally:
        with_keys.close()


def proposed(station: tuple[Station, bytes, bytes], around: Surroundings, *which: int) -> RateProposal:
    found = propose(station[0], [station[number] for number in which], MeasurementRequest(), around)  # type: ignore[misc]
    assert found is not None
    return found


def test_rates_are_rounded_down_and_a_loss_leaves_room() -> None:
    exact = [10_000, 9_999, 3_846, 2_000, 1_999, 100, 99.9, 7, 0.35, 0.01]
    assert [rounded_down(rate) for rate in exact] == [10_000, 5_000, 2_000, 2_000, 1_000, 100, 50, 5, 0.2, 0.1]
    assert lower_rate(10_000, messages=900, lost=100) == 5_000
    assert lower_rate(100, messages=1, lost=99) == 0.5
    assert lower_rate(100, messages=0, lost=9) == 0.1


def test_what_is_slowest_decides(station: tuple[Station, bytes, bytes]) -> None:
    idle = Surroundings(values=HIGH)
    whole = proposed(station, idle, 1)
    assert (whole.limit, whole.rate) == ("datasheet", whole.stated)
    fastest = whole.stated
    assert fastest >= 1_000
    busy = proposed(station, replace(idle, values=fastest / 2.6, busy="this machine is busy (load 5 on 2 cores)"), 1)
    assert (busy.limit, busy.rate, busy.why) == (
        "machine",
        rounded_down(fastest / 2.6),
        "this machine is busy (load 5 on 2 cores)",
    )
    slow = BusTime(CanAirtime(20_000, None))
    narrow = proposed(station, replace(idle, bus=lambda _uuid: ("can0", slow)), 1)
    assert narrow.limit == "bus"
    assert narrow.rate < fastest
    taken = proposed(station, replace(idle, bus=lambda _uuid: ("can0", replace(slow, taken=0.55))), 1)
    assert taken.rate < narrow.rate, "others use the bus too"
    topics = proposed(station, replace(idle, budget=1_000, rows=True), 1)
    assert (topics.limit, topics.rate) == ("budget", 200), "two messages a row, and 10 a second of the channel"


def test_what_others_have_of_a_bus_counts_once_for_all_nodes_on_it(station: tuple[Station, bytes, bytes]) -> None:
    where = {station[1]: "can0", station[2]: "can0"}
    beside = BusTime(CanAirtime(50_000), taken=MOST_LOAD / 2)
    around = Surroundings(lambda uuid: (where[uuid], beside), values=HIGH)
    together = proposed(station, around, 1, 2)
    where[station[1]] = "can1"
    apart = proposed(station, around, 1, 2)
    assert (together.limit, apart.limit) == ("bus", "bus")
    assert together.rate < apart.rate


def test_one_rate_for_all_is_no_faster_than_the_slowest_channel(station: tuple[Station, bytes, bytes]) -> None:
    both = proposed(station, Surroundings(values=1_000), 1, 2)
    assert (both.limit, both.rate) == ("machine", 100), "else it would be refused"
    assert propose(station[0], [bytes(10)], MeasurementRequest(), Surroundings()) is None, "nothing is known of it"


@pytest.mark.parametrize(
    ("cores", "load", "free", "busy"),
    [
        (2, 0.0, 50_000.0, ""),
        (2, 1.0, 50_000.0, ""),
        (2, 3.0, 25_000.0, "this machine is busy (load 3 on 2 cores)"),
        (8, 31.0, 12_500.0, "this machine is busy (load 31 on 8 cores)"),
        (None, 1.0, 25_000.0, "this machine is busy (load 1 on 1 core)"),
        (2, None, 50_000.0, ""),
    ],
)
def test_a_machine_has_room_for_50_000_values_a_second_as_far_as_its_processors_are_free(
    cores: int | None, load: float | None, free: float, busy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def loads() -> tuple[float, float, float]:
        if load is None:
            raise OSError
        return load, 99.0, 99.0

    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    monkeypatch.setattr(os, "getloadavg", loads)
    assert this_machine() == (free, busy)


def test_only_requested_sensors_that_have_a_rate_count(station: tuple[Station, bytes, bytes]) -> None:
    """The gripper: an actuator (1) and two sensors of 100 Hz (2 and 3)."""
    hand = [station[2]]

    def machine(values: float, *numbers: int) -> RateProposal | None:
        return propose(station[0], hand, MeasurementRequest(channels=numbers), Surroundings(values=values))

    for numbers, values in (((), 200.0), ((2,), 100.0), ((2, 3), 200.0), ((1, 2), 100.0)):
        whole = machine(values, *numbers)
        assert whole == RateProposal(100.0, 100.0, "datasheet", ""), numbers
        less = machine(values - 0.5, *numbers)
        assert less is not None
        assert (less.limit, less.rate, less.why) == (
            "machine",
            50.0,
            f"this machine records about {values - 0.5:.0f} values/s",
        )
    assert machine(HIGH, 1) is None, "an actuator alone"
    assert machine(HIGH, 9) is None


def test_messages_to_topics_count_with_the_fastest_channel_of_each_node(
    station: tuple[Station, bytes, bytes],
) -> None:
    """Two channels with 10 messages a second each, and two messages for each of 100 rows."""
    for budget, rate in ((220.0, 100.0), (219.0, 50.0), (119.0, 20.0)):
        found = proposed(station, Surroundings(values=HIGH, budget=budget, rows=True), 2)
        assert found.rate == rate
        assert (found.limit, found.why) == (
            ("datasheet", "") if rate == 100 else ("budget", f"topics take {budget:g} messages/s")
        )
    assert proposed(station, Surroundings(values=HIGH, budget=20.0), 2).limit == "datasheet", "without rows"


@pytest.mark.link
def test_a_run_that_lost_values_gives_the_command_for_a_lower_rate(tmp_path: Path) -> None:
    rig = Rig(tmp_path, {"gaps": "gripper"})
    try:
        node = rig.nodes["gaps"]
        rig.desk.start(rig.can, f"gaps={node.folder}", program=FAULTY).wait_for('"ready": true')
        lines = rig.measure(node.uuid, "--rate", 50, "--duration", 2)
        end = lines[-1]
        assert end["nodes"][0]["streams"][0]["lost"] > 0
        assert end["lower_rate"]["rate"] == 20, "four fifths of what came through"
        words = shlex.split(end["lower_rate"]["command"])
        assert words[0] == "teds-provision"
        assert words[-2:] == ["--rate", "20"]
        assert words.count("--rate") == 1, "the one that lost values is gone"
        outcome = rig.station.start(*words[1:-2], "--rate", 20).end()  # and it works
        assert outcome.code == 0, outcome
        again = [word for word in words[1:-2] if word != "--json"]
        human = rig.station.start(*again, "--rate=20").end()
        assert re.search(
            r"Values were lost\. A lower rate may help: teds-provision .*measure .* --rate 10", human.out
        ), human
    finally:
        rig.close()


def test_a_slower_channel_keeps_its_rate_and_the_fastest_one_of_a_node_makes_its_rows() -> None:
    """One channel of 100 Hz and one of 10 Hz, asked for at 1 kHz; each bus, and each limit, in its turn."""
    sensors = {bytes(10): channels(0.01, 0.1)}

    def limit(sensors: dict[bytes, list[Channel]] = sensors, **around: Any) -> str | None:
        return rates._limit(sensors, 1000.0, Surroundings(**{"values": HIGH, **around}))

    assert (limit(values=110.0), limit(values=109.9)) == (None, "machine")
    assert (limit(budget=220.0, rows=True), limit(budget=219.9, rows=True)) == (None, "budget")
    full = BusTime(CanAirtime(1_000_000), taken=MOST_LOAD)
    two = {bytes([number]) * 10: channels(0.01) for number in (0, 1)}
    for on_it in (0, 1):
        assert limit(two, bus=lambda uuid, on_it=on_it: ("can0", full) if uuid[0] == on_it else None) == "bus"
    assert limit(two) is None
