"""An actuator that a ROS topic drives: within its limits, safe when the topic falls silent, echoed as applied."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.bench import make_station
from tests.e2e.desk import Desk
from tests.measure.sinks.test_ros1 import Master, master, pytestmark  # noqa: F401  the fixture, and what it needs
from tests.measure.test_measuring import Bench


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    make_station(tmp_path / "stations" / "bench", "bench").close()
    desk = Desk(tmp_path, tmp_path / "stations")
    try:
        yield Bench(desk, only="gripper")
    finally:
        desk.clear()


def publish(master: Master, rate: float, value: float) -> subprocess.Popen[bytes]:  # noqa: F811
    words = ["pub", "-r", str(rate), "/bench/g/opening_set_point/cmd", "std_msgs/Float64", str(value)]
    command = ["/usr/bin/python3", "/usr/bin/rostopic", *words]
    return subprocess.Popen(command, env=master.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


@pytest.mark.parametrize("rate", [10, 100])
def test_a_topic_drives_an_actuator_until_it_falls_silent(bench: Bench, master: Master, rate: float) -> None:  # noqa: F811
    master.start()
    process = bench.gripper.process
    assert process is not None
    words = ["measure", bench.gripper.uuid, "--rate", 20, "--ros1", "--dead-man", 500, *bench.can]
    environment = {**master.environment, "PYTHONPATH": ""}
    running = bench.station.start("--json", *words, environment=environment)
    running.wait_for('"event":"data"', 60)
    publisher = publish(master, rate, 0.05)
    try:
        process.wait_for('"value": 0.0499', 60)
        running.wait_for('"channel":1', 30)
        before = process.out.count('"safe": true')
        time.sleep(1.0)  # longer than the dead-man: set points that go on keep it alive
        process.read(0.1)
        assert process.out.count('"safe": true') == before
    finally:
        publisher.kill()
        publisher.wait()
    until = time.monotonic() + 20
    while process.out.count('"safe": true') == before:
        assert time.monotonic() < until
        process.read(0.1)
    too_far = publish(master, rate, 5.0)
    try:
        running.wait_for("beyond the limits", 60)
    finally:
        too_far.kill()
        too_far.wait()
    running.signal(signal.SIGTERM)
    outcome = running.end(60)
    assert outcome.code == 0, outcome.err
    shown = [json.loads(line) for line in process.out.splitlines() if '"actuator"' in line]
    assert {round(line["value"], 3) for line in shown} <= {0.0, 0.05}, "nothing beyond the limits was ever applied"
