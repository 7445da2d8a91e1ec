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
from tests.e2e.desk import Desk, Running
from tests.measure.sinks.test_ros1 import Master, master, pytestmark  # noqa: F401  the fixture, and what it needs
from tests.measure.test_measuring import Bench
from tests.pace import best_of, until


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


def stopped_within(process: Running, seconds: float) -> int:
    """How often in so many seconds, and at their end, it is in its safe state: a busy machine starves it at times."""
    process.read(0.1)
    before = process.out.count('"safe": true')
    time.sleep(seconds)
    process.read(0.1)
    last = [line for line in process.out.splitlines() if '"actuator"' in line][-1]
    return process.out.count('"safe": true') - before + ('"safe": true' in last)


@pytest.mark.nightly(
    "tests/measure/test_actuator_safety.py::test_by_topics_consumer_node_and_station_may_die[ros1]: silence; "
    "beyond the limits: tests/ncap/test_by_topics.py::test_beyond_the_limits_nothing_moves_and_the_node_says_why; "
    "what a topic's rate is, no code asks"
)
@pytest.mark.parametrize("rate", [10, 100])
def test_a_topic_drives_an_actuator_until_it_falls_silent(bench: Bench, master: Master, rate: float) -> None:  # noqa: F811
    master.start()
    process = bench.gripper.process
    assert process is not None
    words = ["measure", bench.gripper.uuid, "--rate", 20, "--ros1", "--dead-man", 500, *bench.can]
    environment = {**master.environment, "PYTHONPATH": ""}
    running = bench.station.start("--json", *words, environment=environment)
    running.wait_for('"event":"data"')
    publisher = publish(master, rate, 0.05)
    try:
        process.wait_for('"value": 0.0499')
        running.wait_for('"channel":1')
        why = "a node, a station and a publisher must run in the second, twice the dead-man"
        best_of(10, 1, lambda: stopped_within(process, 1.0), because=why)  # set points keep it alive
        before = process.out.count('"safe": true')
    finally:
        publisher.kill()
        publisher.wait()
    until(lambda: (process.read(0.1), process.out.count('"safe": true') > before)[1])
    too_far = publish(master, rate, 5.0)
    try:
        running.wait_for("exceeds the limits")
    finally:
        too_far.kill()
        too_far.wait()
    running.signal(signal.SIGTERM)
    outcome = running.end()
    assert outcome.code == 0, outcome.err
    shown = [json.loads(line) for line in process.out.splitlines() if '"actuator"' in line]
    assert {round(line["value"], 3) for line in shown} <= {0.0, 0.05}, "nothing beyond the limits was ever applied"
