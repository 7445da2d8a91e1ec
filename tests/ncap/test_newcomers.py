"""`ncap run --measure`: every authentic node that comes is measured; it goes, comes back, is carried to another bus."""

from __future__ import annotations

import itertools
import json
import math
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from teds_provision import client
from teds_provision.client import ApiError
from teds_provision.links.ports import free_port
from tests.cli.shell import clean_environment
from tests.e2e.desk import ANGLE, Desk, Node, nothing_lost
from tests.ncap.service import Service, unix, virtual
from tests.pace import best_of, until
from tests.places import free_bus, ros_domain

pytestmark = pytest.mark.link


def lines_of(service: Service) -> list[dict[str, Any]]:
    process = service.process
    assert process is not None
    while process.read(0.1):
        pass
    return [json.loads(line) for line in process.out[: process.out.rfind("\n") + 1].splitlines()]


class Lab:
    """A station with two angle sensors on its bus, and a daemon that measures whoever comes."""

    def __init__(self, desk: Desk) -> None:
        self.desk, self.service = desk, Service(desk, desk.station())
        self.nodes = [self.provisioned(name) for name in ("left", "right")]

    def provisioned(self, name: str) -> Node:
        folder = self.desk.folder / name
        words = ["--profile", ANGLE, "--name", name, "--uuid", self.desk.new_uuid().hex()]
        node = Node(self.desk, folder, self.desk.start("--json", "node", "create", folder, *words).end().json["uuid"])
        self.power(node)
        calibration = self.desk.folder / "angle.csv"
        calibration.write_text("# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,359.9\n")
        words = ["--profile", ANGLE, "--calibration", str(calibration), "--name", name, "--yes"]
        done = self.service.station.ask("provision", node.uuid, *words, *self.desk.links.over("can"))
        assert done["verdict"] == "authentic"
        return node

    def power(self, node: Node, bus: str | None = None) -> None:
        if bus is None:
            node.start("--source", "ramp:2", nfc=False, can=True)
        else:
            node.start("--source", "ramp:2", "--can", bus, nfc=False)

    def start(self, *words: object, rate: int = 20) -> Service:
        return self.service.start("--measure", "all", "--rate", rate, *words)

    def lines(self) -> list[dict[str, Any]]:
        """Return every line of the daemon until now."""
        return lines_of(self.service)

    def events_of(self, uuid: str | None = None) -> list[dict[str, Any]]:
        """Return events of measurements that name a node."""
        every = [line for line in self.lines() if line.get("event") == "measurement" and "uuid" in line]
        return [entry for entry in every if uuid in (None, entry["uuid"])]

    def states(self, node: Node) -> list[str]:
        return [entry["state"] for entry in self.events_of(node.uuid)]

    def comes(self, node: Node, times: int = 1) -> None:
        """Wait until it is measured, for at least the ``times``-th time: a busy machine loses it now and then."""

        def there() -> bool:
            states = self.states(node)
            return states.count("joined") >= times and states[-1] == "joined"

        until(there, lambda: self.events_of(node.uuid))

    def report(self, node: Node) -> dict[str, Any]:
        with self.service.client() as asked:
            return dict(asked.node(node.uuid)["measuring"] or {})

    def flows(self, node: Node) -> None:
        def fresh() -> bool:
            with self.service.client() as asked:
                channels = asked.node(node.uuid)["channels"]
                return bool(channels and channels[0]["last"] and channels[0]["last"]["age"] < 1)

        until(fresh, f"no value of {node.uuid} comes")

    def tidy(self) -> None:
        running = self.service.process
        if running is not None and running.process.poll() is None:  # a test failed: what it began ends with it
            with suppress(Exception), self.service.client() as asked:
                for kept in asked.measurements():
                    asked.end_measurement(kept["id"])
            self.service.kill()
        self.service.process = None
        for node in self.nodes:
            if node.process is None or node.process.process.poll() is not None:
                self.power(node)


@pytest.fixture(scope="module")
def one_lab(tmp_path_factory: pytest.TempPathFactory, prepared: Path) -> Iterator[Lab]:
    desk = Desk(tmp_path_factory.mktemp("newcomers"), prepared)
    try:
        yield Lab(desk)
    finally:
        desk.clear()


@pytest.fixture
def lab(one_lab: Lab) -> Iterator[Lab]:
    yield one_lab
    one_lab.tidy()


def test_what_is_there_is_measured_and_what_goes_comes_back(lab: Lab) -> None:
    left, right = lab.nodes
    lab.start()
    lab.comes(left)
    lab.comes(right)
    lab.flows(right)
    right.kill()
    until(lambda: lab.states(right)[-1] == "left")
    assert lab.events_of(right.uuid)[-1]["why"]
    lab.power(right)
    lab.comes(right, 2)
    lab.flows(right)
    assert lab.states(left) == ["joined"]
    with lab.service.client() as asked:  # the rest of its datasheet is read in the background, and shown as read
        until(lambda: asked.node(right.uuid)["verdict"]["from"] == "session")
    with lab.service.client() as asked:
        [measurement] = asked.measurements()
        assert (measurement["match"], measurement["rate"], sorted(measurement["uuids"])) == (
            "all",
            20,
            sorted([left.uuid, right.uuid]),
        )
    lab.service.end()


@pytest.mark.realtime
def test_who_comes_goes_and_is_written_costs_the_other_no_sample(lab: Lab) -> None:
    left, right = lab.nodes
    lab.start()
    lab.comes(left)
    with nothing_lost(left, lambda: lab.report(left)):
        lab.comes(right)
        right.kill()
        until(lambda: lab.states(right)[-1] == "left")
        lab.power(right)
        lab.comes(right, 2)
        sequence = lab.service.station.ask("history", right.uuid)["history"][0]["sequence"]
        assert lab.service.station.ask("write", right.uuid, "--from", sequence, *lab.desk.links.over("can"))["verified"]
        until(lambda: lab.states(right)[-1] == "joined")
        lab.flows(right)
    assert lab.report(left)["state"] == "running"
    lab.service.end()


def test_a_node_that_is_carried_to_another_bus_of_the_station_goes_on_there_at_once(lab: Lab) -> None:
    """Nobody waits until the bus that it left has given it up: 15 s."""
    left, right = lab.nodes
    other = free_bus()
    lab.start("--can", other)
    lab.comes(left)
    lab.comes(right)
    buses = itertools.cycle((other, None))

    def carried() -> float:
        times, bus = lab.states(right).count("joined"), next(buses)
        right.kill()
        lab.power(right, bus)
        lab.comes(right, times + 1)
        lab.flows(right)
        with lab.service.client() as asked:
            assert str(asked.node(right.uuid)["link"]).startswith(f"can:{bus or lab.desk.links.can}")
        went, came = map(unix, lab.events_of(right.uuid)[-2:])
        present = [unix(line) for line in lab.lines() if line.get("state") == "came" and line["uuid"] == right.uuid]
        return max(went, came) - present[-1]

    best_of(3, 10.0, carried)
    best_of(3, 10.0, carried)
    assert lab.states(left) == ["joined"]
    lab.service.end()


def test_a_node_is_written_while_it_is_matched_and_no_other_is_affected(lab: Lab) -> None:
    """With another datasheet it joins again; two writers at once take turns; recordings take it in."""
    left, right = lab.nodes
    folder = lab.desk.folder / "recorded"
    lab.start("--record", folder)
    lab.comes(left)
    lab.comes(right)
    calibration = lab.desk.folder / "half.csv"
    calibration.write_text("# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,180\n")
    words = ["--profile", ANGLE, "--calibration", calibration, "--yes", *lab.desk.links.over("can")]
    first = lab.service.station.start("--json", "provision", right.uuid, *words)
    assert lab.service.station.ask("provision", right.uuid, *words, code=0)["verdict"] == "authentic"
    assert first.end().code == 0
    until(lambda: lab.states(right)[-1] == "joined")
    assert lab.states(right).count("left") in (1, 2), "one gap, or two where the writers came one after the other"
    assert any(entry["why"] == "let go for provision" for entry in lab.events_of(right.uuid))
    lab.flows(right)
    assert lab.states(left) == ["joined"]
    lab.service.end()
    parts = sorted(folder.glob("run-*.csv"))
    assert len(parts) >= 2, "CSV begins a new part for another datasheet"
    channels = [line for part in parts for line in part.read_text().splitlines() if line.startswith("# channel:")]
    assert len({json.loads(line.removeprefix("# channel: "))["fingerprint"] for line in channels}) == 3


def test_a_sensor_is_zeroed_while_all_nodes_are_measured_and_the_gap_is_reported(lab: Lab) -> None:
    """Let go, zeroed, given back: it reads 0 after; the other goes on."""
    left, right = lab.nodes
    right.kill()
    still = lab.desk.folder / "still.csv"
    still.write_text("t,angle\n0,90\n100000,90\n")
    folder = lab.desk.folder / "zeroed"
    right.start("--source", f"file:{still}", nfc=False, can=True)
    lab.start("--record", folder)
    lab.comes(left)
    lab.comes(right)
    lab.flows(right)
    done = lab.service.station.ask("calibrate", "zero", right.uuid, 1, *lab.desk.links.over("can"))
    assert done["written"]
    assert done["before"] > 0.5, "by whichever calibration it has by now"
    lab.comes(right, 2)
    lab.flows(right)
    assert [(entry["state"], entry["why"]) for entry in lab.events_of(right.uuid)] == [
        ("joined", ""),
        ("left", "let go for calibrate zero"),
        ("joined", ""),
    ]
    with lab.service.client() as asked:
        last = asked.node(right.uuid)["channels"][0]["last"]["value"]
    assert min(last, 2 * math.pi - last) < 1e-3
    assert lab.states(left) == ["joined"]
    lab.service.end()
    recorded = "".join(part.read_text() for part in sorted(folder.glob("run-*.csv")))
    assert "let go for calibrate zero" in recorded
    right.kill()


def test_a_node_that_goes_while_its_writer_has_it_joins_when_it_comes_back(lab: Lab) -> None:
    left, right = lab.nodes
    lab.start()
    lab.comes(left)
    lab.comes(right)
    with client.connect(home=lab.service.station.home).released(right.uuid, "write") as had:
        assert had is True
        right.kill()
    lab.power(right)
    until(lambda: lab.states(right)[-1] == "joined")
    lab.flows(right)
    lab.service.end()


def test_a_node_that_is_written_before_it_is_measured_joins_after_that(lab: Lab) -> None:
    """Else it would be claimed as soon as its key is there, and its writer refused."""
    left, right = lab.nodes
    right.kill()
    lab.start()
    lab.comes(left)
    with client.connect(home=lab.service.station.home).released(right.uuid, "provision") as had:
        assert had is False
        lab.power(right)
        with lab.service.client() as asked:
            until(lambda: asked.node(right.uuid)["present"])
        assert lab.states(right) == []
    lab.comes(right)
    lab.service.end()


def test_whom_a_person_revokes_leaves_and_the_others_stay(lab: Lab) -> None:
    left, right = lab.nodes
    third = lab.provisioned("third")
    lab.nodes.append(third)
    lab.start()
    for node in (left, right, third):
        lab.comes(node)
    lab.service.station.ask("revoke", third.uuid, "--why", "stolen", "--yes")
    until(lambda: lab.states(third)[-1] == "left")
    assert "stolen" in lab.events_of(third.uuid)[-1]["why"]
    assert (lab.states(left), lab.states(right)) == (["joined"], ["joined"])
    with lab.service.client() as asked:
        assert third.uuid not in asked.measurements()[0]["uuids"]
        until(lambda: third.uuid not in [report["uuid"] for report in asked.measurements()[0]["nodes"]])
    lab.service.end()
    third.kill()
    lab.nodes.remove(third)


def test_a_name_stays_while_its_node_is_measured_and_a_node_that_left_may_have_another(lab: Lab) -> None:
    left, right = lab.nodes
    lab.start()
    lab.comes(left)
    lab.comes(right)
    with lab.service.client() as asked:
        with pytest.raises(ApiError) as frozen:
            asked.request("PUT", "/names", {"uuid": right.uuid, "channel": 1, "name": "arm/turn"})
        assert (frozen.value.status, frozen.value.exit_code) == (409, 6)
        right.kill()
        until(lambda: lab.states(right)[-1] == "left")
        asked.request("PUT", "/names", {"uuid": right.uuid, "channel": 1, "name": "arm/turn"})
        lab.power(right)
        lab.comes(right, 2)
        names = [name for node in asked.request("GET", "/names")["names"] for name in [node.get("topic")]]
        assert "/arm/turn" in names
        right.kill()
        until(lambda: lab.states(right)[-1] == "left")
        asked.request("PUT", "/names", {"uuid": right.uuid, "channel": 1, "name": None})
    lab.service.end()


def test_an_expression_on_a_running_station_takes_in_whom_it_means(lab: Lab) -> None:
    """Who is added to its group joins, who is taken out leaves; it is kept over a restart, until it is deleted."""
    left, right = lab.nodes
    station = lab.service.station
    station.ask("group", "create", "arm", left.uuid)
    lab.service.start()
    made = station.ask("ncap", "measure", "arm, name:l*", "--rate", 20)
    assert (made["match"], made["frozen"]) == ("arm, name:l*", False)
    lab.comes(left)
    station.ask("group", "remove", "arm", left.uuid)
    until(lambda: lab.states(left)[-1] == "left")
    assert lab.events_of(left.uuid)[-1]["why"] == "it is not in group arm"
    station.ask("group", "add", "arm", left.uuid, right.uuid)
    lab.comes(left, 2)
    assert lab.states(right) == [], "its name is another one"
    lab.service.end()
    lab.service.start()
    lab.comes(left)
    with lab.service.client() as asked:
        [measurement] = asked.measurements()
        error = station.refuses("ncap", "measure", "leg", "--stop", code=3)
        assert error["hint"] == f"Kept: {measurement['id']} (arm, name:l*)."
        assert station.ask("ncap", "measure", "arm, name:l*", "--stop") == {"stopped": [measurement["id"]]}
        assert station.ask("ncap", "measure", "all", "--stop") == {"stopped": []}
        until(lambda: asked.node(left.uuid)["mode"] == "idle")
        assert lab.events_of(left.uuid)[-1]["why"] == "the measurement ended"
        assert asked.measurements() == []
    lab.service.end()
    station.ask("group", "delete", "arm")


def test_an_unknown_type_is_reported_while_its_measurement_waits(lab: Lab) -> None:
    lab.service.start()
    outcome = lab.service.station.run("ncap", "measure", "type:load-cel")
    assert outcome.code == 0, "a node of that type may come from another station"
    assert "no profile and no known node is called 'load-cel'" in outcome.err
    assert "Did you mean type:load-cell?" in outcome.err
    assert "0 nodes match now." in outcome.out
    assert "its type is magnetic-angular-position-sensor, not load-cel." in outcome.out, outcome.out
    with lab.service.client() as asked:
        [entry] = until(lambda: [measurement for measurement in asked.measurements() if measurement["why"]])
        assert (entry["state"], entry["why"]) == ("waiting", "no profile and no known node is called 'load-cel'")
        asked.end_measurement(entry["id"])
    assert "load-cell" not in lab.service.station.run("ncap", "measure", "type:load-cell").err
    with lab.service.client() as asked:  # it is kept, and would begin with the service of the next test
        asked.end_measurement(
            next(measurement["id"] for measurement in asked.measurements() if measurement["match"] == "type:load-cell")
        )
    lab.service.end()


def test_a_measurement_whose_nodes_are_anothers_says_so(lab: Lab) -> None:
    left, right = lab.nodes
    lab.start()
    lab.comes(left)
    lab.comes(right)
    with lab.service.client() as asked:
        first = asked.measure(match="all")["id"]

        def why(of: str) -> str:
            return next(str(measurement["why"]) for measurement in asked.measurements() if measurement["id"] == of)

        until(lambda: why(first) == "2 matching nodes are measured by another measurement")
        shown = lab.service.station.run("ncap", "status").out
        assert f"measurement {first} of all: waiting: 2 matching nodes are measured" in shown
        nobody = asked.measure(match="name:nobody*")["id"]
        until(lambda: why(nobody) == "no matching node is present")
        asked.end_measurement(nobody)
        asked.end_measurement(first)
    lab.service.end()


def test_one_that_finds_no_room_on_the_bus_waits_until_another_one_leaves(lab: Lab) -> None:
    """50 Hz of one node take half of a bus of 5 kbit/s: two do not fit, and the first is not slowed."""
    left, right = lab.nodes
    right.kill()
    lab.service.desk.links = type(lab.desk.links)(lab.desk.links.nfc, f"{lab.desk.links.can}&bitrate=5000")
    try:
        lab.start(rate=50)
        lab.comes(left)
        lab.power(right)
        until(lambda: lab.states(right)[-1:] == ["waiting"])
        assert lab.events_of(right.uuid)[-1]["why"] == "no room on the bus"
        assert lab.events_of(left.uuid)[-1]["why"] == "", "nobody is slowed"
        with client.connect(home=lab.service.station.home).released(left.uuid, "write"):
            until(lambda: lab.states(left)[-1] == "left")
            time.sleep(1.0)  # who waits would have joined by now
        lab.comes(left, 2)
        assert "joined" not in lab.states(right), "the room of a node that is let go stays its own"
        left.kill()
        until(lambda: lab.states(right)[-1] == "joined")
        lab.service.end()
    finally:
        lab.service.desk.links = type(lab.desk.links)(lab.desk.links.nfc, lab.desk.links.can.partition("&")[0])


def test_one_that_finds_no_room_in_the_budget_of_messages_waits_until_another_one_leaves(lab: Lab) -> None:
    """1000 values and 1000 rows a second of one node are 3000 messages: two nodes are more than the 5000 of a process.

    By MQTT, which carries no rows, both fit.
    """
    left, right = lab.nodes
    right.kill()
    nobody = f"mqtt://127.0.0.1:{free_port()}"
    with ros_domain() as domain:
        own = {**clean_environment(), "ROS_DOMAIN_ID": str(domain)}
        lab.service.start("--mqtt", nobody, "--ros2", environment=own)
        with lab.service.client() as asked:
            asked.request("POST", "/measurements", {"match": "all", "rate": 1000, "scalar_rate": 1000})
        lab.comes(left)
        lab.power(right)
        until(lambda: lab.states(right)[-1:] == ["waiting"], lambda: lab.events_of(right.uuid))
        assert lab.events_of(right.uuid)[-1]["why"] == "no room in the budget of 5000 messages/s"
        assert lab.events_of(left.uuid)[-1]["why"] == "", "nobody is slowed"
        left.kill()
        until(lambda: lab.states(right)[-1] == "joined")
        lab.service.end()
    lab.power(left)
    lab.service.start("--mqtt", nobody)
    lab.comes(left)
    lab.comes(right)
    with lab.service.client() as asked:  # it is kept: the tests after this one have none
        asked.end_measurement(asked.measurements()[0]["id"])
    lab.service.end()


def test_frozen_measures_those_that_were_known_and_lets_none_go(lab: Lab) -> None:
    left, right = lab.nodes
    lab.start("--frozen")
    lab.comes(left)
    lab.comes(right)
    with lab.service.client() as asked:
        [measurement] = asked.measurements()
        assert measurement["frozen"] is True
        assert sorted(measurement["uuids"]) == sorted([left.uuid, right.uuid])
    refused = lab.service.station.refuses("address", left.uuid, 77, *lab.desk.links.over("can"), code=6)
    assert "frozen" in refused["message"]
    assert lab.states(left) == ["joined"]
    lab.service.end()


def test_actuators_of_who_comes_are_never_claimed(desk: Desk) -> None:
    service = Service(desk, desk.station()).start("--measure", "all")
    uuid = virtual(service)
    with service.client() as asked:
        until(lambda: asked.node(uuid)["mode"] == "measuring")
        place = next(link["place"] for link in asked.status()["links"] if link["virtual"])
        bus = place.removeprefix("can:").partition("&source=")[0]

        def claimed() -> dict[int, bool]:
            mode = service.station.ask("mode", uuid, "--via", "can", "--can", bus)
            return {channel["channel"]: bool(channel["claimant"]) for channel in mode["channels"]}

        def measured() -> bool:
            found = claimed()
            assert not found[1], "the actuator"
            return found == {1: False, 2: True, 3: True}

        until(measured)  # a node that was lost on a busy machine has no claims until it joins again
    service.end()


def test_a_node_that_this_very_process_provisions_is_measured_at_once(desk: Desk) -> None:
    """Not when everybody is asked again, half a minute later."""
    service = Service(desk, desk.station()).start("--measure", "all", "--rate", 20)

    names = iter(("first", "second", "third"))

    def provisioned() -> float:
        uuid = virtual(service, name=next(names))
        until(lambda: "joined" in [entry["state"] for entry in lines_of(service) if entry.get("uuid") == uuid])
        mine = {item["state"]: unix(item) for item in reversed(lines_of(service)) if item.get("uuid") == uuid}
        return mine["joined"] - mine["came"]

    best_of(3, 10.0, provisioned)
    service.end()


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--measure", "nosuch"], 3),
        (["--measure", "kind:angle"], 2),
        (["--measure", "type:"], 2),
        (["--measure", "all,name:x"], 2),
        (["--measure", "angle >="], 2),
        (["--rate", "5"], 2),
        (["--frozen"], 2),
    ],
)
def test_what_says_no_nodes_is_refused_at_the_start(lab: Lab, words: list[str], code: int) -> None:
    assert lab.service.station.refuses("ncap", "run", *words, code=code)["message"]


def test_no_group_may_be_called_all(lab: Lab) -> None:
    assert "all" in lab.service.station.refuses("group", "create", "all", lab.nodes[0].uuid, code=2)["message"]
