"""A gripper moved as topic_based_ros2_control moves a joint: its part is played in the real rclpy."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from teds_provision.measure.sinks.ros import sourced
from tests.bench import make_station
from tests.e2e.desk import Desk, Running
from tests.measure.sinks.rclpy_scene import PYTHON, Domain, Peer, domain, needs_rclpy
from tests.measure.test_measuring import Bench
from tests.pace import until

__all__ = ["domain"]
pytestmark = needs_rclpy


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    make_station(tmp_path / "stations" / "bench", "bench").close()
    desk = Desk(tmp_path, tmp_path / "stations")
    try:
        yield Bench(desk, only="gripper")
    finally:
        desk.clear()


class Control:
    """What the hardware interface does in each cycle of the controller: it reads the state, it writes the command."""

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        peer.hear("/bench/joint_states", "sensor_msgs/JointState", reliable=False)  # it asks for sensor data

    def cycle(self, position: float) -> None:
        fields = {"name": ["g"], "position": [position]}
        self.peer.send(op="publish", topic="/bench/joint_commands", type="sensor_msgs/JointState", fields=fields)
        time.sleep(0.05)

    @property
    def state(self) -> dict[str, Any] | None:
        heard = self.peer.heard("/bench/joint_states")
        return heard[-1] if heard else None


def moves(control: Control, process: Running, opening: float) -> bool:
    """Run one more cycle of the controller; return True if the gripper is where it was sent by now."""
    control.cycle(opening)
    process.read(0.01)
    return any(abs(entry["value"] - opening) < 1e-4 for entry in acted(process))


def acted(process: Running) -> list[dict[str, Any]]:
    """Return what the virtual gripper says that it did."""
    return [json.loads(line) for line in process.out.splitlines() if '"actuator"' in line]


@pytest.mark.parametrize("way", ["rclpy", "Cyclone DDS"])
def test_a_gripper_is_moved_over_the_topics_of_joints(bench: Bench, domain: Domain, way: str) -> None:
    process = bench.gripper.process
    assert process is not None
    control = Control(domain.peer("controller"))
    words = ["measure", bench.gripper.uuid, "--rate", 20, "--ros2", "--dead-man", 1000, *bench.can]
    around = {"ROS_DOMAIN_ID": str(domain.number), sourced.CHOSEN: str(PYTHON) if way == "rclpy" else ""}
    running = bench.station.start("--json", *words, environment=around)
    running.wait_for('"event":"data"')
    until(lambda: control.state is not None, lambda: control.peer.lines)
    assert control.state is not None
    assert control.state["name"] == ["g"]
    assert len(control.state["position"]) == len(control.state["effort"]) == 1, "opening and force of the grip"
    for opening in (0.05, 0.02):
        until(lambda asked=opening: moves(control, process, asked))
    before = process.out.count('"safe": true')
    until(lambda: (process.read(0.1), process.out.count('"safe": true') > before)[1])  # the controller fell silent
    running.signal(signal.SIGTERM)
    outcome = running.end()
    assert outcome.code == 0, outcome.err
    assert {round(entry["value"], 3) for entry in acted(process)} <= {0.0, 0.05, 0.02}
