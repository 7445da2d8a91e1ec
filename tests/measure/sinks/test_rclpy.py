"""ROS 2 by a sourced rclpy: played by a stand-in that checks names and types, for ROS 2 is not on this machine."""

from __future__ import annotations

import json
import queue
import shlex
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from teds_provision.measure.blocks import ChannelFacts, Command, NodeReport
from teds_provision.measure.sinks import open_sink
from teds_provision.measure.sinks.ros import sourced
from teds_provision.measure.sinks.ros.ros2 import Ros2Sink
from teds_provision.measure.sinks.ros.sourced import RclpySink
from tests.measure.sinks.parts import (
    ANGLE,
    ARM,
    AXES,
    DISTANCE,
    GRIP,
    HAND,
    OIL,
    STATION,
    feed_robot,
    kill_child,
)
from tests.pace import until

STANDIN = Path(__file__).with_name("rclpy_standin")
STORE = get_typestore(Stores.ROS2_JAZZY)


@dataclass
class Sourced:
    """An environment in which a ROS 2 is sourced."""

    folder: Path

    def notes(self, event: str) -> list[dict[str, Any]]:
        file = self.folder / "notes"
        lines = file.read_text().splitlines(keepends=True) if file.exists() else []
        return [
            one for one in map(json.loads, (line for line in lines if line.endswith("\n"))) if one["event"] == event
        ]

    def last(self, topic: str) -> Any:
        found = [one for one in self.notes("message") if one["topic"] == topic]
        return STORE.deserialize_cdr(bytes.fromhex(found[-1]["octets"]), found[-1]["type"]) if found else None


@pytest.fixture
def ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Sourced:
    sourced._python.cache_clear()
    python = tmp_path / "conda" / "bin" / "python3"  # a Python of its own, as RoboStack has one
    python.parent.mkdir(parents=True)
    python.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} "$@"\n')
    python.chmod(0o755)
    for name, value in {
        "AMENT_PREFIX_PATH": "/opt/ros/jazzy", "CONDA_PREFIX": str(tmp_path / "conda"), "PYTHONPATH": str(STANDIN),
        "STANDIN_NOTES": str(tmp_path / "notes"), "STANDIN_COMMANDS": str(tmp_path / "commands"),
    }.items():  # fmt: skip
        monkeypatch.setenv(name, value)
    return Sourced(tmp_path)


def test_without_a_sourced_ros_cyclone_dds_carries_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    assert isinstance(open_sink("ros2"), Ros2Sink)


def test_a_sourced_ros_without_rclpy_is_left_alone(ros: Sourced, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ros.folder))
    monkeypatch.setenv("CONDA_PREFIX", "")
    assert isinstance(open_sink("ros2"), Ros2Sink)


def test_every_message_has_the_fields_and_types_of_ros_2(ros: Sourced) -> None:
    came: queue.Queue[Command] = queue.Queue()
    sink = open_sink("ros2:7", came.put)
    assert isinstance(sink, RclpySink)
    bare = ChannelFacts("8d4d9da65281f7000003", "bare", 1, "angle", unsigned=True)
    sink.open([ANGLE, OIL, GRIP, DISTANCE, *AXES, bare], STATION)
    until(lambda: sink.stats.state == "running")
    sink.report(NodeReport(ARM, "running", lost=2))
    topics = ("angle", "range_finder", "imu")
    k = 0
    while not (all(ros.last(f"/bench/arm/{one}") for one in topics) and ros.last("/bench/crane")):
        k += 1
        assert k < 1200, sink.stats
        feed_robot(sink, k)
        time.sleep(0.05)
    (ros.folder / "commands").write_text("/bench/hand/force/cmd 1.25\n")
    command = came.get(timeout=60)
    assert (command.uuid, command.channel, command.value) == (HAND, 2, 1.25)
    until(lambda: ros.notes("outside"))
    until(lambda: ros.last("/diagnostics"))
    sink.describe([replace(ANGLE, calibrated="2026-09-01")])
    until(lambda: ros.notes("parameter")[-1]["value"] and "2026-09-01" in str(ros.notes("parameter")))
    sink.close()
    assert sink.stats.error == ""
    assert [one["domain"] for one in ros.notes("init")] == ["7"]
    assert ros.last("/bench/hand/oil").temperature == pytest.approx(20.0)
    assert ros.last("/bench/hand/oil").variance == pytest.approx(0.03)
    array = ros.last("/bench/crane")
    assert (list(array.name), array.position[0]) == (["arm/angle", "hand/oil"], 1.0)
    assert np.isnan(array.position[1])
    assert (array.header.stamp.sec, array.header.stamp.nanosec) == (12 + k, 250_000_000)
    assert ros.last("/bench/arm/imu").linear_acceleration.z == pytest.approx(0.3)
    assert ros.last("/bench/arm/range_finder").max_range == 8.0
    levels = [status.level for status in ros.last("/diagnostics").status]
    assert 1 in levels
    latched = {one["topic"]: one["latched"] for one in ros.notes("publisher")}
    assert latched["/bench/arm/teds"] is True
    assert latched["/bench/arm/angle"] is False
    assert json.loads(ros.last("/bench/arm/teds").data)["uuid"] == ARM
    assert ros.notes("subscription") == [{"event": "subscription", "topic": "/bench/hand/force/cmd", "reliable": False}]
    parameters = {one["name"]: one["value"] for one in ros.notes("parameter")}
    assert parameters["bench.arm.angle.uuid"] == ARM
    assert parameters["bench.arm.angle.calibrated"] == "2026-09-01"
    assert parameters["bench.arm.axis_4.vector"] == [4.0, 5.0, 6.0]
    assert all(one["successful"] is False for one in ros.notes("outside")), "facts are not set from outside"
    assert ros.notes("shutdown")


def test_a_child_that_dies_is_started_anew(ros: Sourced) -> None:
    sink = open_sink("ros2")
    assert isinstance(sink, RclpySink)
    sink.open([ANGLE], STATION)
    until(lambda: sink.stats.state == "running")
    kill_child(sink)
    assert "rclpy died" in sink.stats.detail
    until(lambda: sink.stats.state == "running")
    until(lambda: len([one for one in ros.notes("publisher") if one["topic"] == "/bench/arm/teds"]) == 2)
    sink.close()
    assert sink.stats.error == ""
