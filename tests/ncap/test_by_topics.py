"""The daemon and ROS: set points by topics with the safety of `measure`, and several measurements side by side."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from teds_provision import client
from teds_provision.trace.recorder import read_trace
from tests.e2e.desk import ROOT
from tests.measure.rig import Rig
from tests.measure.sinks.test_ros1 import Master, master, pytestmark  # noqa: F401  the fixture, and what it needs
from tests.measure.test_actuator_safety import DEAD_MAN, TOPIC, Journal, Ros1, Ros2, children, rig_on, ros_of
from tests.ncap.service import Service, verdict, verified
from tests.pace import until

Publishers = list[subprocess.Popen[bytes]]


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with rig_on(tmp_path) as made:
        yield made


OTHER_ROS = pytest.mark.nightly(
    "tests/ncap/test_by_topics.py::test_set_points_move_it_and_whatever_dies_it_is_safe[ros2]; by ROS 1 "
    "tests/measure/test_actuator_safety.py::test_by_topics_consumer_node_and_station_may_die[ros1]"
)
OFF_THE_LIST = pytest.mark.nightly("tests/ncap/test_by_topics.py::test_off_the_whitelist_it_is_let_go_and_measured_on")


@pytest.fixture(params=[pytest.param("ros1", marks=OTHER_ROS), "ros2"])
def ros(request: pytest.FixtureRequest, master: Master) -> Iterator[Ros1 | Ros2]:  # noqa: F811
    with ros_of(request.param, master) as made:
        yield made


@pytest.fixture(params=[pytest.param("ros1", marks=pytest.mark.soak), "ros2"])
def either_ros(request: pytest.FixtureRequest, master: Master) -> Iterator[Ros1 | Ros2]:  # noqa: F811
    """Yield one ROS for rules of the daemon, which are the same code with both; make test-all has the other."""
    with ros_of(request.param, master) as made:
        yield made


@pytest.fixture
def publishers() -> Iterator[Publishers]:
    """Publishers that a test starts; none outlives it."""
    started: Publishers = []
    yield started
    for process in started:
        process.kill()
        process.wait()


@contextmanager
def listening(rig: Rig, ros: Ros1 | Ros2, *words: object, measured: bool = True, **more: Any) -> Iterator[Service]:
    """Yield a daemon that publishes to this ROS, and measures the gripper with a dead-man of half a second."""
    rig.desk.links = type(rig.desk.links)(rig.desk.links.nfc, rig.can)
    service = Service(rig.desk, rig.station, (*ros.words, *words)).start(environment=ros.environment)
    uuid = rig.nodes["g"].uuid
    assert verdict(verified(service, uuid)) == "authentic"
    if measured:
        with service.client() as asked:
            body = {"uuids": [uuid], "rate": 20, "dead_man": int(DEAD_MAN * 1000), **more}
            body = {key: value for key, value in body.items() if value is not None}
            asked.request("POST", "/measurements", body)
            until(lambda: (asked.node(uuid)["measuring"] or {}).get("state") == "running", "it is not measured")
    yield service


def set_points(ros: Ros1 | Ros2, value: float) -> subprocess.Popen[bytes]:
    """Return a publisher of another value than the usual one, ten times a second."""
    if isinstance(ros, Ros2):
        module = [sys.executable, "-m", "tests.measure.sinks.ros2_publisher", str(ros.domain), TOPIC, str(value)]
        return subprocess.Popen(module, env=ros.environment, cwd=ROOT)
    words = ["pub", "-r", "10", TOPIC, "std_msgs/Float64", str(value)]
    command = ["/usr/bin/python3", "/usr/bin/rostopic", *words]
    return subprocess.Popen(command, env=ros.master.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


@pytest.mark.realtime
def test_set_points_move_it_and_whatever_dies_it_is_safe(rig: Rig, ros: Ros1 | Ros2, publishers: Publishers) -> None:
    with listening(rig, ros) as service:
        journal = Journal.of(rig)
        publishers.append(ros.publish())
        journal.moves()
        # The consumer dies.
        died = time.time()
        publishers[-1].kill()
        journal.is_safe(died)
        # The node hangs for longer than its dead-man; what was sent meanwhile moves nothing when it wakes.
        publishers.append(ros.publish())
        journal.moves(died)
        lives = journal.forgets_while_it_hangs(publishers[-1])
        # The daemon is killed, with its consumer alive.
        publishers.append(ros.publish())
        journal.moves(lives)
        killed = time.time()
        service.kill()
        journal.is_safe(killed)


def test_beyond_the_limits_nothing_moves_and_the_node_says_why(
    rig: Rig, either_ros: Ros1 | Ros2, publishers: Publishers
) -> None:
    with listening(rig, either_ros) as service, service.client() as asked:
        publishers.append(set_points(either_ros, 5.0))
        until(lambda: "limits" in (asked.node(rig.nodes["g"].uuid)["measuring"] or {}).get("why", ""), "no word of it")
        assert all(line["safe"] for line in Journal.of(rig).states())
        service.end()


def test_a_request_and_a_topic_do_not_pull_at_one_actuator(
    rig: Rig, either_ros: Ros1 | Ros2, publishers: Publishers
) -> None:
    """Who came first has it: the other one is refused and told, and has it when the first one lets go."""
    path = f"/nodes/{rig.nodes['g'].uuid}/channels/1"
    with listening(rig, either_ros) as service, service.client() as asked:
        journal = Journal.of(rig)
        asked.request("PUT", path, {"value": 0.02, "hold": 60})
        journal.moves()
        publishers.append(set_points(either_ros, 0.05))
        assert service.process is not None
        service.process.wait_for('"state": "refused"', 60)
        time.sleep(DEAD_MAN)
        assert {round(line["value"], 2) for line in journal.states() if not line["safe"]} == {0.02}
        asked.request("PUT", path, {"hold": 0})
        until(lambda: any(round(line["value"], 2) == 0.05 for line in journal.states()), "the topic has it now")

        def refused() -> client.ApiError | None:  # a publisher that stands still for a dead-man has lost its claim
            try:
                asked.request("PUT", path, {"value": 0.03, "hold": 0.1})
            except client.ApiError as error:
                return error
            return None

        error = until(refused, "a request takes it from a topic")
        assert (error.status, "set points from a topic" in error.message) == (423, True), error
        service.end()


def test_off_the_whitelist_it_is_let_go_and_measured_on(
    rig: Rig, either_ros: Ros1 | Ros2, publishers: Publishers
) -> None:
    """A person takes it off the list by a command beside the daemon, while a topic drives it."""
    uuid = rig.nodes["g"].uuid
    with listening(rig, either_ros, "--detection", "transparent") as service, service.client() as asked:
        journal = Journal.of(rig)
        publishers.append(either_ros.publish())
        journal.moves()
        rig.station.ask("whitelist", "remove", uuid, "--yes")
        until(lambda: journal.states()[-1]["safe"], "it still moves")
        until(lambda: (asked.node(uuid)["measuring"] or {}).get("state") == "running", "it is not measured on")
        time.sleep(2 * DEAD_MAN)
        assert journal.states()[-1]["safe"]
        service.end()


@pytest.mark.parametrize("how", ["daemon", "measurement", pytest.param("whitelist", marks=OFF_THE_LIST)])
def test_without_leave_no_topic_is_listened_to(rig: Rig, master: Master, how: str) -> None:  # noqa: F811
    master.start()
    ros = Ros1(master)
    if how == "whitelist":
        rig.station.ask("whitelist", "remove", rig.nodes["g"].uuid, "--yes")
    words = {"daemon": ["--no-actuators"], "whitelist": ["--detection", "transparent"]}.get(how, [])
    more = {"actuators": False} if how == "measurement" else {}
    with listening(rig, ros, *words, **more) as service:
        until(lambda: "/bench/g/opening" in master.published(), "no topic")
        until(lambda: service.client().status()["sinks"][0]["written"] > 40, "values of a second")
        assert TOPIC not in master.heard()
        service.end()


@pytest.mark.nightly(
    "tests/measure/test_actuator_safety.py::test_the_dead_man_of_a_daemon_is_the_one_that_it_was_started_with; that a "
    "measurement has it: "
    "tests/page/test_flows.py::test_who_measures_says_whether_topics_may_move_actuators_and_when_these_are_safe"
)
def test_a_measurement_without_a_dead_man_has_the_daemons(rig: Rig, master: Master) -> None:  # noqa: F811
    master.start()
    with listening(rig, Ros1(master), "--dead-man", 700, dead_man=None) as service, service.client() as asked:
        [measurement] = asked.request("GET", "/measurements")["measurements"]
        assert (measurement["actuators"], measurement["dead_man"]) == (True, 700)
        status = asked.request("GET", "/status")
        assert (status["actuators"], status["dead_man"]) == (True, 700)
        service.end()


def test_two_measurements_are_two_nodes_of_ros_and_neither_ends_the_other(tmp_path: Path, master: Master) -> None:  # noqa: F811
    """ROS 1 shuts a node down whose name another one takes."""
    master.start()
    ros = Ros1(master)
    rig = Rig(tmp_path, {"g": "gripper", "h": "gripper"})
    try:
        for node in rig.nodes.values():
            node.start()
        with listening(rig, ros, measured=False) as service, service.client() as asked:
            for name, node in rig.nodes.items():
                verified(service, node.uuid)
                asked.request("POST", "/groups", {"name": f"group {name}", "uuids": [node.uuid]})
                asked.request("POST", "/measurements", {"group": f"group {name}", "rate": 20})

            def sinks() -> list[dict[str, Any]]:
                return [sink for sink in asked.request("GET", "/status")["sinks"] if sink["written"] > 40]

            until(lambda: len(sinks()) == 2, "both publish", 60)
            assert service.process is not None
            began = children(service.process.process.pid, "ros1_child.py")
            nodes = {name for publishers in master.published().values() for name in publishers}
            assert {"/teds_provision_bench_group_g", "/teds_provision_bench_group_h"} <= nodes
            before = {sink["measurement"]: sink["written"] for sink in sinks()}
            until(lambda: all(sink["written"] > before[sink["measurement"]] + 40 for sink in sinks()), "both go on", 60)
            assert children(service.process.process.pid, "ros1_child.py") == began
            assert len(began) == 2
            service.end()
    finally:
        rig.close()


def test_a_trace_has_frames_and_opened_messages_of_every_session(rig: Rig, tmp_path: Path) -> None:
    file = tmp_path / "daemon.trace"
    rig.desk.links = type(rig.desk.links)(rig.desk.links.nfc, rig.can)
    service = Service(rig.desk, rig.station, ("--trace", file)).start()
    uuid = rig.nodes["g"].uuid
    verified(service, uuid)
    with service.client() as asked:
        asked.request("POST", "/measurements", {"uuids": [uuid], "rate": 20})
        until(lambda: (asked.node(uuid)["measuring"] or {}).get("state") == "running", "it is not measured")
    service.end()
    assert file.stat().st_mode & 0o777 == 0o600
    records = list(read_trace(file))
    opened = {record.command.partition(" (")[0] for record in records if record.sealed and record.opened is not None}
    assert {"Subscribe", "Clock", "Stop"} <= opened, opened
    assert any(record.layer == "frame" for record in records)
    refused = rig.station.refuses("ncap", "run", "--trace", file, code=2)
    assert str(file) in refused["message"], "a trace is never written over"
