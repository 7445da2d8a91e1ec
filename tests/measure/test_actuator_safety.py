"""Whatever dies, the actuator is in its safe state within its dead-man: station, consumer, link."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.links.can.port import CanPort
from tests.e2e.desk import Running
from tests.measure.hall import Hall, events
from tests.measure.sinks.test_ros1 import Master, master, pytestmark  # noqa: F401  the fixture, and what it needs

DEAD_MAN = 0.5  # seconds
BUSY = 2.0  # seconds that a busy machine may need to run the node's process and to show its line
SAFE, MOVED = '"safe": true', '"safe": false'


@pytest.fixture
def hall(tmp_path: Path) -> Iterator[Hall]:
    made = Hall(tmp_path, {"g": "gripper"})
    try:
        made.nodes["g"].start()
        yield made
    finally:
        made.close()


def node_of(hall: Hall) -> Running:
    process = hall.nodes["g"].process
    assert process is not None
    process.read(0.05)
    return process


def safe_again(node: Running, before: int, since: float) -> None:
    """Wait for the safe state; within the dead-man of ``since``."""
    while node.out.count(SAFE) == before:
        assert time.monotonic() - since < DEAD_MAN + BUSY, "not in its safe state within its dead-man"
        node.read(0.02)


def moving(node: Running, before: int) -> None:
    """Wait until it has moved."""
    until = time.monotonic() + 60
    while node.out.count(MOVED) == before:
        assert time.monotonic() < until, node.out
        node.read(0.05)


def begin_set(hall: Hall) -> Running:
    node = node_of(hall)
    before = node.out.count(MOVED)
    words = ["set", hall.nodes["g"].uuid, 1, 0.05, "--dead-man", int(DEAD_MAN * 1000), "--can", hall.can]
    acting = hall.station.start("--json", *words)
    acting.wait_for('"applied"')
    moving(node, before)
    return acting


def test_a_station_that_is_killed_leaves_it_safe(hall: Hall) -> None:
    acting, node = begin_set(hall), node_of(hall)
    before = node.out.count(SAFE)
    acting.process.kill()
    safe_again(node, before, time.monotonic())


def test_a_station_that_hangs_leaves_it_safe_and_moves_nothing_when_it_wakes(hall: Hall) -> None:
    acting, node = begin_set(hall), node_of(hall)
    safe, moved = node.out.count(SAFE), node.out.count(MOVED)
    acting.signal(signal.SIGSTOP)
    safe_again(node, safe, time.monotonic())
    acting.signal(signal.SIGCONT)
    outcome = acting.end()
    assert outcome.code in (5, 6), "it says that it lost the actuator"
    node.read(0.3)
    assert node.out.count(MOVED) == moved, "a late order moves nothing"


def publish(master: Master, rate: float) -> subprocess.Popen[bytes]:  # noqa: F811
    words = ["pub", "-r", str(rate), "/bench/g/opening_set_point/cmd", "std_msgs/Float64", "0.05"]
    command = ["/usr/bin/python3", "/usr/bin/rostopic", *words]
    return subprocess.Popen(command, env=master.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def test_by_topics_consumer_link_and_station_may_die(hall: Hall, master: Master) -> None:  # noqa: F811
    master.start()
    node, environment = node_of(hall), {**master.environment, "PYTHONPATH": ""}
    words = [hall.nodes["g"].uuid, "--rate", 20, "--ros1", "--dead-man", int(DEAD_MAN * 1000)]
    running = hall.begin(*words, environment=environment)
    running.wait_for('"event":"data"', 60)
    driven = CanPort(f"{hall.can}&source=0xF6")
    publisher = publish(master, 100)
    try:
        with driven.listen(lambda frame: frame.identifier >> 16 == 0x18EF) as ear:
            moving(node, 0)
            assert ear.get(30) is not None, "100 values a second go as Drive messages"
        # The consumer dies.
        safe = node.out.count(SAFE)
        publisher.kill()
        publisher.wait()
        safe_again(node, safe, time.monotonic())
        # The node is cut off for longer than its dead-man: it is safe, and moves again once the link is back.
        moved = node.out.count(MOVED)
        publisher = publish(master, 100)
        moving(node, moved)
        safe, moved = node.out.count(SAFE), node.out.count(MOVED)
        node.signal(signal.SIGSTOP)
        time.sleep(2 * DEAD_MAN)  # cut off for longer than the dead-man
        node.signal(signal.SIGCONT)
        safe_again(node, safe, time.monotonic())
        moving(node, moved)
        # The station is killed, with its consumer alive.
        node.read(0.05)
        safe = node.out.count(SAFE)
        running.process.kill()
        safe_again(node, safe, time.monotonic())
    finally:
        publisher.kill()
        publisher.wait()
        driven.close()
    values = {line["value"] for line in events(node.out) if line.get("event") == "actuator"}
    assert all(value == pytest.approx(0.0, abs=1e-4) or value == pytest.approx(0.05, abs=1e-4) for value in values)
