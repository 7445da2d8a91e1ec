"""ROS 2 by the real rclpy, seen by another rclpy; and which of the two ways to ROS 2 is taken."""

from __future__ import annotations

import json
import math
import os
import queue
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import UsageError
from teds_provision.measure.blocks import NodeReport, SetPointCommand
from teds_provision.measure.sinks import open_sink
from teds_provision.measure.sinks.ros import sourced
from teds_provision.measure.sinks.ros.ros2 import Ros2Sink
from teds_provision.measure.sinks.ros.sourced import RclpySink
from tests.measure.sinks.parts import ANGLE, ARM, AXES, DISTANCE, GRIP, HAND, OIL, STATION, feed_robot, kill_child
from tests.measure.sinks.rclpy_scene import PYTHON, Domain, domain, needs_rclpy
from tests.pace import until

__all__ = ["domain"]


def test_without_an_rclpy_cyclone_dds_carries_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    monkeypatch.delenv(sourced.CHOSEN, raising=False)
    assert isinstance(open_sink("ros2"), Ros2Sink)


def test_a_sourced_ros_without_rclpy_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sourced._python.cache_clear()
    for name, value in {"AMENT_PREFIX_PATH": "/opt/ros/jazzy", "PYTHONPATH": str(tmp_path), "CONDA_PREFIX": ""}.items():
        monkeypatch.setenv(name, value)
    assert isinstance(open_sink("ros2"), Ros2Sink)


def test_a_python_that_was_named_and_has_no_rclpy_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    monkeypatch.setenv(sourced.CHOSEN, sys.executable)
    with pytest.raises(UsageError, match="cannot import rclpy"):
        open_sink("ros2")


def test_the_python_that_was_named_comes_before_the_one_that_runs_this(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both could: this one has rclpy as well."""
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    asked: list[str] = []
    monkeypatch.setattr(sourced, "find_spec", lambda _name: object())
    monkeypatch.setattr(sourced, "_require_rclpy", asked.append)
    monkeypatch.setenv(sourced.CHOSEN, "/opt/python-with-rclpy")
    assert sourced.ros2_sink("ros2")._python == "/opt/python-with-rclpy"  # type: ignore[attr-defined]
    monkeypatch.delenv(sourced.CHOSEN)
    assert sourced.ros2_sink("ros2")._python == sys.executable  # type: ignore[attr-defined]
    assert asked == ["/opt/python-with-rclpy", sys.executable]


def ports_of(process: int) -> list[str]:
    """Local addresses of the UDP sockets of a process, as ``ss`` tells them: ``0.0.0.0%lo:7410``."""
    output = subprocess.run(["ss", "-Hulpn"], capture_output=True, text=True, check=True).stdout
    return [line.split()[3] for line in output.splitlines() if f"pid={process}," in line]


@pytest.fixture(params=["rclpy", "Cyclone DDS"])
def sink(request: pytest.FixtureRequest, domain: Domain, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Yield a sink of each way, open, running, with what takes its set points."""
    if request.param != "rclpy":
        monkeypatch.delenv(sourced.CHOSEN)
    came: queue.Queue[SetPointCommand] = queue.Queue()
    made = open_sink(f"ros2:{domain.number}", came.put)
    assert isinstance(made, RclpySink if request.param == "rclpy" else Ros2Sink)
    made.came = came  # type: ignore[attr-defined]
    yield made
    made.close()
    assert made.stats.error == ""


def open_and_feed(sink: Any, ready: Any, facts: Any = (ANGLE, OIL, GRIP, DISTANCE, *AXES)) -> int:
    """Open it and feed it until ``ready``; how often that was."""
    sink.open(list(facts), STATION)
    until(lambda: sink.stats.state == "running")
    for k in range(1, 1200):
        feed_robot(sink, k)
        time.sleep(0.05)
        if ready():
            return k
    raise AssertionError(sink.stats)


class TestSeenByRclpy:
    pytestmark = needs_rclpy

    def test_a_foreign_node_gets_every_message_and_moves_an_actuator(self, domain: Domain, sink: Any) -> None:
        peer = domain.peer()
        topics = {
            "/bench/crane": "sensor_msgs/JointState",
            "/bench/hand/oil": "sensor_msgs/Temperature",
            "/bench/arm/imu": "sensor_msgs/Imu",
            "/bench/arm/range_finder": "sensor_msgs/Range",
            "/bench/arm/angle": "std_msgs/Float64",
            "/diagnostics": "diagnostic_msgs/DiagnosticArray",
        }
        for topic, kind in topics.items():
            peer.hear(topic, kind, reliable=topic != "/bench/arm/angle")
        sink.report(NodeReport(ARM, "running", lost=2))
        open_and_feed(sink, lambda: all(peer.heard(topic) for topic in topics))
        array = peer.heard("/bench/crane")[-1]
        assert array["name"] == ["arm/angle", "hand/oil"]
        assert array["position"][0] == 1.0
        assert math.isnan(array["position"][1])
        oil = peer.heard("/bench/hand/oil")[-1]
        assert oil["temperature"] == pytest.approx(20.0)
        assert oil["variance"] == pytest.approx(0.03)
        assert peer.heard("/bench/arm/imu")[-1]["linear_acceleration"]["z"] == pytest.approx(0.3)
        assert peer.heard("/bench/arm/range_finder")[-1]["max_range"] == 8.0
        peer.graph(lambda entry: bool(entry["topics"].get("/bench/hand/force/cmd", {}).get("subscribers")))
        until(
            lambda: (
                peer.send(op="publish", topic="/bench/hand/force/cmd", type="std_msgs/Float64", fields={"data": 1.25}),
                time.sleep(0.2),
                not sink.came.empty(),
            )[2]
        )
        command = sink.came.get()
        assert (command.uuid, command.channel, command.value) == (HAND, 2, 1.25)

    def test_each_topic_has_one_publisher_which_is_the_same_node_both_ways(self, domain: Domain, sink: Any) -> None:
        peer = domain.peer()
        open_and_feed(sink, lambda: sink.stats.messages > 60)
        graph = peer.graph(
            lambda entry: (
                "/teds_provision_bench" in entry["nodes"]
                and {"/diagnostics", "/bench/arm/range_finder"} <= entry["topics"].keys()
                and not any("_UNKNOWN_" in text for text in map(str, entry["topics"].values()))
            )
        )
        ours = {
            topic: item["publishers"]
            for topic, item in graph["topics"].items()
            if topic.startswith(("/bench", "/diag"))
        }
        ours.pop("/bench/hand/force/cmd", None)
        for topic, publishers in ours.items():
            durability = "TRANSIENT_LOCAL" if topic.endswith("/teds") else "VOLATILE"
            assert publishers == [["/teds_provision_bench", "RELIABLE", durability]], topic

    def test_who_comes_later_gets_the_datasheet_and_its_changes(self, domain: Domain, sink: Any) -> None:
        sink.open([ANGLE], STATION)
        until(lambda: sink.stats.state == "running")
        peer = domain.peer()
        peer.hear("/bench/arm/teds", "std_msgs/String", latched=True)
        until(lambda: peer.heard("/bench/arm/teds"))
        assert json.loads(peer.heard("/bench/arm/teds")[0]["data"])["channels"][0]["calibrated"] == "2026-03-01"
        sink.describe([replace(ANGLE, calibrated="2026-09-01")])
        until(lambda: "2026-09-01" in peer.heard("/bench/arm/teds")[-1]["data"])

    @pytest.mark.skipif(not Path("/usr/bin/ss").exists(), reason="iproute2 is not installed")
    def test_its_ports_are_unreachable_from_outside(self, domain: Domain, sink: Any) -> None:
        sink.open([ANGLE], STATION)
        until(lambda: sink.stats.state == "running")
        child = getattr(sink, "_child", None)
        first = 7400 + 250 * domain.number
        here = ports_of(child.pid if child else os.getpid())
        mine = [name for name in here if first <= int(name.rpartition(":")[2]) < first + 250 or name.endswith(":7000")]
        assert mine
        assert all("%lo:" in name for name in mine), here

    def test_facts_are_read_only_parameters(self, domain: Domain) -> None:
        sink = open_sink(f"ros2:{domain.number}")
        sink.open([ANGLE, *AXES], STATION)
        until(lambda: sink.stats.state == "running")
        peer, node = domain.peer(), "/teds_provision_bench"
        names = ["bench.arm.angle.uuid", "bench.arm.angle.calibrated", "bench.arm.axis_4.vector"]
        until(
            lambda: (
                peer.send(op="parameters", node=node, names=names),
                time.sleep(0.3),
                [entry for entry in peer.of("parameters") if len(entry["values"]) == 3 and entry["values"][2]["type"]],
            )[2]
        )
        uuid, calibrated, vector = peer.of("parameters")[-1]["values"]
        assert (uuid["string_value"], calibrated["string_value"]) == (ARM, "2026-03-01")
        assert vector["double_array_value"] == [4.0, 5.0, 6.0]
        peer.send(op="set", node=node, name="bench.arm.angle.uuid", value="mine")
        until(lambda: peer.of("set"))
        assert peer.of("set")[0]["results"][0]["successful"] is False
        sink.close()

    def test_a_child_that_dies_is_restarted_and_repeats_everything(self, domain: Domain) -> None:
        sink = open_sink(f"ros2:{domain.number}")
        assert isinstance(sink, RclpySink)
        sink.open([ANGLE], STATION)
        until(lambda: sink.stats.state == "running")
        kill_child(sink)
        assert "rclpy died" in sink.stats.detail
        until(lambda: sink.stats.state == "running")
        peer = domain.peer()
        peer.hear("/bench/arm/teds", "std_msgs/String", latched=True)
        until(lambda: peer.heard("/bench/arm/teds"))
        sink.close()
        assert sink.stats.error == ""

    def test_two_stations_of_one_name_are_both_heard(self, domain: Domain) -> None:
        """ROS 2 lets two nodes have one name; topics tell them apart by their nodes' names."""
        sinks = [open_sink(f"ros2:{domain.number}") for _ in range(2)]
        for sink, facts in zip(sinks, ([ANGLE], [replace(OIL, name="oil")]), strict=True):
            sink.open(facts, STATION)
        until(lambda: all(sink.stats.state == "running" for sink in sinks))
        peer = domain.peer()
        for node in ("arm", "hand"):
            peer.hear(f"/bench/{node}/teds", "std_msgs/String", latched=True)
        until(lambda: peer.heard("/bench/arm/teds") and peer.heard("/bench/hand/teds"))
        graph = peer.graph(lambda entry: entry["nodes"].count("/teds_provision_bench") == 2)
        assert len(graph["topics"]["/bench/crane"]["publishers"]) == 2
        for sink in sinks:
            sink.close()
            assert sink.stats.error == ""

    def test_messages_of_an_installation_without_them_are_asked_for(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
        monkeypatch.setenv(sourced.CHOSEN, str(PYTHON))
        monkeypatch.setattr(sourced, "NEEDS", "rclpy, no_such_msgs.msg")
        sourced._require_rclpy.cache_clear()
        with pytest.raises(UsageError, match="its messages"):
            open_sink("ros2")
        sourced._require_rclpy.cache_clear()
