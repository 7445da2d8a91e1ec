"""What a group measures is kept and carried on; several buses and measurements beside each other."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from teds_provision.links.can.frame import Frame
from teds_provision.links.can.port import CanPort
from teds_provision.measure.sinks.mcap.recover import recover
from tests.e2e.desk import ANGLE, free_port
from tests.measure.hall import Hall, events, killed, of, ran

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    made = Hall(tmp_path_factory.mktemp("hall"), {"a": ANGLE, "g": "gripper", "b": ANGLE})
    try:
        for name in ("a", "g"):
            made.nodes[name].start()
        yield made
    finally:
        made.close()


def assert_whole(streams: list[dict[str, Any]]) -> None:
    """Nothing wrong came, and of what was sent nearly all: a node on a machine that is busy sends some too late."""
    for one in streams:
        assert (one["late"], one["bad"]) == (0, 0), one
        assert one["lost"] <= 0.1 * one["messages"], one


@pytest.fixture(autouse=True)
def nothing_left(hall: Hall) -> Iterator[None]:
    """A test that fails leaves no measurement to the next one."""
    yield
    nodes = [node.process for node in hall.nodes.values()]
    for process in hall.desk.running:
        if process not in nodes:
            process.close()
    hall.desk.running[:] = [process for process in hall.desk.running if process in nodes]


def test_a_group_that_was_killed_is_carried_on_by_the_same_command(hall: Hall) -> None:
    a, g = hall.nodes["a"].uuid, hall.nodes["g"].uuid
    hall.station.ask("group", "create", "crane", a, g)
    file = hall.folder / "crane.mcap"
    first = hall.begin("crane", "--rate", 40, "--to", file)
    first.wait_for('"index":20')
    killed(first)
    second = hall.begin("crane")
    second.wait_for('"index":20')
    assert hall.station.refuses("group", "add", "crane", hall.nodes["b"].uuid, code=6)["code"] == "frozen"
    assert hall.station.refuses("group", "delete", "crane", code=6)["code"] == "frozen"
    second.signal(signal.SIGTERM)
    outcome = second.end()
    assert outcome.code == 0, outcome.err
    lines = events(outcome.out)
    end = lines[-1]
    assert {node["uuid"] for node in end["nodes"]} == {a, g}
    assert {stream["period"] for node in end["nodes"] for stream in node["streams"]} == {0.025}
    [recording] = end["files"]
    assert recording != str(file), "the cut recording is not written over"
    recover(file)
    plain = hall.begin("crane")
    plain.wait_for('"index":0')
    plain.signal(signal.SIGTERM)
    ended = events(plain.end().out)[-1]
    assert ended["files"] == [], "what ended in order is not carried on"
    assert hall.station.tables()["measurements"] == []
    hall.station.ask("group", "delete", "crane")


def test_the_end_of_a_duration_is_not_moved_by_a_restart(hall: Hall) -> None:
    hall.station.ask("group", "create", "short", hall.nodes["g"].uuid)
    began = time.monotonic()
    first = hall.begin("short", "--rate", 20, "--duration", 6, "--channel", 2)
    first.wait_for('"event":"data"')
    killed(first)
    lines = hall.measure("short")
    assert of(lines, channel=2)
    assert not of(lines, channel=3), "the channel that was named, and no other"
    assert time.monotonic() - began < 25
    assert sum(len(line["time"]) for line in of(lines, channel=2)) < 6 * 20, "the rest of six seconds, not six more"
    hall.station.ask("group", "delete", "short")


def test_a_second_measurement_from_one_source_address_is_refused_and_named(hall: Hall) -> None:
    a, g = hall.nodes["a"].uuid, hall.nodes["g"].uuid
    first = hall.begin(g, "--rate", 50)
    first.wait_for('"event":"data"')
    for words in (["measure", g], ["measure", a], ["set", g, 1, 0.05, "--hold", 0.1]):  # each would open sessions
        refused = hall.ask(*words, code=7)["error"]
        assert refused["code"] == "store-locked"
        assert f"pid {first.process.pid} (measure {g})" in refused["message"]
        assert "source=0xF2" in refused["hint"]
    for words in (["sample", g], ["verify", g, "--via", "can"]):
        refused = hall.ask(*words, code=7)["error"]
        assert "is being measured from source address 0xF1" in refused["message"]
    assert hall.ask("sample", a)["samples"], "a node that nobody measures"
    first.signal(signal.SIGTERM)
    lines = events(first.end().out)
    assert ran(lines) == ["running", "ended"], "nothing disturbed it"
    assert_whole(lines[-1]["nodes"][0]["streams"])


def test_two_stations_on_one_bus_measure_one_node_side_by_side(hall: Hall) -> None:
    g, other = hall.nodes["g"].uuid, hall.copy("copy")
    first = hall.begin(g, "--rate", 50)
    first.wait_for('"event":"data"')
    second = hall.begin(g, "--rate", 20, can=f"{hall.can}&source=0xF2", station=other)
    second.wait_for('"index":20')
    before = first.out.count('"event":"data"')
    first.wait_for('"index":100')
    for running in (second, first):
        running.signal(signal.SIGTERM)
        lines = events(running.end().out)
        assert ran(lines) == ["running", "ended"], lines[-1]
        [streams] = [node["streams"] for node in lines[-1]["nodes"]]
        assert_whole(streams)
    assert first.out.count('"event":"data"') > before


def test_another_machine_under_our_source_address_is_heard_and_named(hall: Hall) -> None:
    g, other = hall.nodes["g"].uuid, hall.copy("twin")
    first = hall.begin(g, "--rate", 50)
    first.wait_for('"event":"data"')
    refused = events(hall.begin(g, station=other).end(30).out)[-1]["error"]
    assert refused["code"] == "address-conflict"
    assert "source=0xF2" in refused["hint"]
    first.signal(signal.SIGTERM)
    assert ran(events(first.end().out)) == ["running", "ended"]


def test_one_measurement_over_two_buses(hall: Hall) -> None:
    b = hall.nodes["b"]
    other = f"udp_multicast:239.74.163.2?port={free_port()}"  # classic frames
    b.start(can=other)
    names = (hall.nodes["a"].uuid, b.uuid)
    lines = hall.measure(*names, "--can", other, "--rate", 50, "--duration", 2)
    end = lines[-1]
    for node in end["nodes"]:
        [stream] = node["streams"]
        assert stream["samples"] + stream["lost"] >= 90, node
        assert_whole([stream])
    if "began_apart" in end:  # on a machine so busy that one was not there in time it began by itself
        firsts = [next(line["time"][0] for line in of(lines, uuid) if line["index"] == 0) for uuid in names]
        assert abs(firsts[0] - firsts[1]) < 0.05, "by start time they began together, each on its bus"
        assert end["began_apart"] < 0.05


def test_an_announcement_that_a_stranger_sends_ends_nothing(hall: Hall) -> None:
    g = hall.nodes["g"]
    address = next(node["can_address"] for node in hall.station.ask("nodes")["nodes"] if node["uuid"] == g.uuid)
    first = hall.begin(g.uuid, "--rate", 50)
    first.wait_for('"event":"data"')
    stop, stranger = threading.Event(), CanPort(f"{hall.can}&source=0xF6")
    try:
        until = time.monotonic() + 2.5
        while time.monotonic() < until:
            stranger.send(Frame(0x1CFF0000 | address, bytes([1, 2]) + b"\xff" * 4 + bytes(2)))
            stop.wait(0.01)
    finally:
        stranger.close()
    first.signal(signal.SIGTERM)
    lines = events(first.end().out)
    assert ran(lines) == ["running", "ended"]
    assert_whole(lines[-1]["nodes"][0]["streams"])


def test_a_node_that_a_stranger_moves_to_another_address_is_measured_on(hall: Hall) -> None:
    g = hall.nodes["g"]
    address = next(node["can_address"] for node in hall.station.ask("nodes")["nodes"] if node["uuid"] == g.uuid)
    first = hall.begin(g.uuid, "--rate", 50)
    first.wait_for('"event":"data"')
    stranger = CanPort(f"{hall.can}&source=0xF6")
    try:
        stranger.send(Frame(0x1CFF0000 | address, bytes([1, 2]) + bytes(6)))  # the smaller CRC keeps the address
        moved = time.monotonic()
        first.wait_for('"state":"lost"')
        first.wait_for('"index":0', 10)
        until = time.monotonic() + 10
        while first.out.count('"state":"running"') < 2:
            assert time.monotonic() < until
            first.read(0.1)
        assert time.monotonic() - moved < 4
    finally:
        stranger.close()
    first.signal(signal.SIGTERM)
    assert ran(events(first.end().out)) == ["running", "lost", "running", "ended"]


def test_a_set_point_holds_its_source_address_too(hall: Hall) -> None:
    g = hall.nodes["g"].uuid
    acting = hall.station.start("--json", "set", g, 1, 0.05, "--can", hall.can)
    acting.wait_for('"applied"')
    refused = events(hall.begin(g, "--rate", 10).end().out)[-1]["error"]
    assert refused["code"] == "store-locked"
    assert f"(set {g})" in refused["message"]
    acting.signal(signal.SIGTERM)
    assert acting.end().out.splitlines()[-1] == '{"event": "end", "safe": true}'


def test_a_home_shows_no_measurement_that_is_over(hall: Hall) -> None:
    marks = list((Path(hall.station.home) / "measuring").iterdir())
    assert marks
    assert hall.station.ask("group", "list") == {"groups": []}
