"""ROS 1 by Debian's own master, rostopic and rosparam; masters and children that die."""

from __future__ import annotations

import os
import queue
import socket
import subprocess
import sys
import time
import xmlrpc.client
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from teds_provision.measure.blocks import GroupRows, NodeReport, SetPointCommand
from teds_provision.measure.sinks import open_sink
from teds_provision.measure.sinks.ros import ros1_child
from teds_provision.measure.sinks.ros.ros1 import Ros1Sink
from teds_provision.teds.units import parse_units
from tests.measure.sinks.parts import ANGLE, ARM, FORCE, GRIP, HAND, OIL, STATION, block, kill_child
from tests.pace import until
from tests.places import free_tcp_port

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(not Path("/usr/bin/rosmaster").exists(), reason="python3-rosmaster is not installed"),
    pytest.mark.skipif(not Path("/usr/bin/rostopic").exists(), reason="python3-rostopic is not installed"),
]


class Master:
    """Debian's rosmaster on a free port, with its own files."""

    def __init__(self, folder: Path) -> None:
        self.port = free_tcp_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.environment = {
            "PATH": "/usr/bin:/bin",
            "ROS_MASTER_URI": self.uri,
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": str(folder),
            "ROS_LOG_DIR": str(folder),
            "HOME": str(folder),
        }
        self.process: subprocess.Popen[bytes] | None = None
        self.echoes: list[subprocess.Popen[str]] = []

    def start(self) -> None:
        command = ["/usr/bin/python3", "/usr/bin/rosmaster", "--core", "-p", str(self.port)]
        self.process = subprocess.Popen(
            command, env=self.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        until(self._listens, "rosmaster does not listen")

    def _listens(self) -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None

    def echo(self, topic: str) -> subprocess.Popen[str]:
        """Return the first message of a topic, as Debian's tool prints it; ended with the master."""
        command = ["/usr/bin/python3", "/usr/bin/rostopic", "echo", "-n", "1", topic]
        self.echoes.append(subprocess.Popen(command, env=self.environment, stdout=subprocess.PIPE, text=True))
        return self.echoes[-1]

    def published(self) -> dict[str, list[str]]:
        """Return the published topics and the names of their publishers, as the master has them."""
        return self._topics(0)

    def heard(self) -> dict[str, list[str]]:
        """Return the subscribed topics and the names of their subscribers, as the master has them."""
        return self._topics(1)

    def _topics(self, which: int) -> dict[str, list[str]]:
        state: Any = xmlrpc.client.ServerProxy(self.uri).getSystemState("/test")
        return dict(state[2][which])

    def tool(self, *words: str) -> str:
        command = ["/usr/bin/python3", f"/usr/bin/{words[0]}", *words[1:]]
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True, timeout=60, check=False)
        return done.stdout


@pytest.fixture
def master(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Master]:
    """Yield a master of this test alone, not started yet."""
    running = Master(tmp_path)
    with _visited(running, monkeypatch):
        yield running
    running.stop()


@pytest.fixture(scope="module")
def _standing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Master]:
    running = Master(tmp_path_factory.mktemp("master"))
    running.start()
    yield running
    running.stop()


@pytest.fixture
def shared(_standing: Master, monkeypatch: pytest.MonkeyPatch) -> Iterator[Master]:
    """Yield a master that runs for all tests that end none: what a closed sink published is gone from it."""
    with _visited(_standing, monkeypatch):
        yield _standing


@contextmanager
def _visited(master: Master, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for name in ("ROS_IP", "ROS_HOME", "ROS_LOG_DIR"):
        monkeypatch.setenv(name, master.environment[name])
    try:
        yield
    finally:
        for echo in master.echoes:
            echo.kill()
            echo.wait()
        master.echoes.clear()


def ros1(master: Master, commands: Callable[[SetPointCommand], None] | None = None) -> Ros1Sink:
    sink = open_sink(f"ros1:{master.uri}", commands)
    assert isinstance(sink, Ros1Sink)
    return sink


def feed(sink: Ros1Sink, k: int) -> None:
    sink.write(block([[10 + k]], index=k, start=time.time()))
    sink.write(block([[2931.5, 5]], [[293.15, 0.5]], uuid=HAND, channels=(3, 2), index=k, start=time.time()))
    values = np.array([[1.0, np.nan]])
    sink.write_group(GroupRows("crane", ((ARM, 1), (HAND, 3)), np.array([time.time()]), values, values * 0))


def test_debians_tools_see_topics_values_metadata_and_parameters(shared: Master) -> None:
    sink = ros1(shared)
    sink.open([ANGLE, OIL, GRIP], STATION)
    sink.report(NodeReport(ARM, "running", lost=2))
    until(lambda: sink.stats.state == "running")
    feed(sink, 0)
    reader, array = shared.echo("/bench/hand/oil"), shared.echo("/bench/crane")
    k = 0
    while reader.poll() is None or array.poll() is None:
        k += 1
        assert k < 1200
        feed(sink, k)
        time.sleep(0.05)
    assert reader.stdout is not None
    assert array.stdout is not None
    temperature, row = reader.stdout.read(), array.stdout.read()
    reader.stdout.close()
    array.stdout.close()
    assert "temperature: 20.0" in temperature
    assert "variance: 0.03" in temperature
    assert "- arm/angle" in row
    assert "[1.0, nan]" in row
    topics = set(shared.tool("rostopic", "list").split())
    assert {"/bench/arm/angle", "/bench/hand/oil", "/bench/crane", "/bench/arm/teds", "/diagnostics"} <= topics
    assert "/bench/hand/force/cmd" not in topics, "nobody takes commands here"
    assert shared.tool("rostopic", "type", "/bench/arm/angle").strip() == "std_msgs/Float64"
    latched = shared.tool("rostopic", "echo", "-n", "1", "/bench/arm/teds")
    assert ANGLE.fingerprint in latched, "a late comer gets the metadata"
    assert f"uuid: {ARM}" in shared.tool("rosparam", "get", "/bench/arm/angle")
    diagnostics = shared.tool("rostopic", "echo", "-n", "1", "/diagnostics")
    assert 'key: "lost"' in diagnostics
    sink.close()
    assert sink.stats.error == ""


def test_the_datasheet_of_a_node_that_got_another_name_is_found_under_that_alone(shared: Master) -> None:
    """As of an adopted board: its topics begin under the trusted name, and nobody finds the old datasheet any more."""
    sink = ros1(shared)
    sink.open([replace(ANGLE, unverified=True)], STATION)
    until(lambda: "/bench/unverified/arm/teds" in shared.published())
    sink.describe([ANGLE])
    until(lambda: "/bench/arm/teds" in shared.published())
    until(lambda: "/bench/unverified/arm/teds" not in shared.published())
    assert ANGLE.fingerprint in shared.tool("rostopic", "echo", "-n", "1", "/bench/arm/teds")
    sink.close()


def test_a_vector_and_a_wrench_are_messages_of_their_own(shared: Master) -> None:
    forces = [
        replace(ANGLE, number=n, name=f"f{n}", units=parse_units("N" if n < 4 else "N m"), vector=members)
        for members in ((1, 2, 3), (4, 5, 6))
        for n in members
    ]
    sink = ros1(shared)
    sink.open(forces, STATION)
    until(lambda: sink.stats.state == "running")
    echo = shared.echo("/bench/arm/wrench")
    k = 0
    while echo.poll() is None:
        k += 1
        assert k < 1200
        sink.write(block([[10, 20, 30, 40, 50, 60]], channels=(1, 2, 3, 4, 5, 6), index=k, start=time.time()))
        time.sleep(0.05)
    assert echo.stdout is not None
    output = echo.stdout.read()
    echo.stdout.close()
    sink.close()
    assert "force:" in output
    assert "torque:" in output
    assert "x: 4.0" in output
    assert sink.stats.error == ""


def test_a_command_topic_moves_an_actuator(shared: Master) -> None:
    came: queue.Queue[SetPointCommand] = queue.Queue()
    sink = ros1(shared, came.put)
    sink.open([GRIP], STATION)
    until(lambda: sink.stats.state == "running")
    topic = "/bench/hand/force/cmd"
    words = ["/usr/bin/rostopic", "pub", "-r", "5", topic, "std_msgs/Float64", "1.25"]
    command = ["/usr/bin/python3", *words]
    publisher = subprocess.Popen(command, env=shared.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        message = came.get(timeout=60)
    finally:
        publisher.kill()
        publisher.wait()
        sink.close()
    assert (message.uuid, message.channel, message.value) == (HAND, 2, 1.25)


def test_without_a_master_it_waits_and_says_for_what_then_carries_on(master: Master) -> None:
    sink = ros1(master)
    sink.open([ANGLE], STATION)
    until(lambda: str(master.port) in sink.stats.detail)
    assert sink.stats.state == "waiting"
    sink.write(block())
    until(lambda: sink.stats.dropped == 3)
    master.start()
    until(lambda: sink.stats.state == "running")
    until(lambda: "/bench/arm/teds" in master.published())
    sink.close()


def test_a_master_and_a_child_that_die_are_survived(master: Master) -> None:
    master.start()
    sink = ros1(master)
    sink.open([ANGLE], STATION)
    until(lambda: sink.stats.state == "running")
    kill_child(sink)
    until(lambda: sink.stats.state == "running")
    master.stop()
    until(lambda: sink.stats.state == "waiting")
    master.start()
    until(lambda: sink.stats.state == "running")
    until(lambda: (sink.write(block(start=time.time())), "/bench/arm/angle" in master.published())[1])
    sink.close()
    assert sink.stats.error == ""


def test_nothing_of_the_child_outlives_the_sink(shared: Master) -> None:
    sink = ros1(shared)
    sink.open([ANGLE], STATION)
    until(lambda: sink.stats.state == "running")
    child = sink._child
    assert child is not None
    sink.close()
    assert child.poll() is not None


def test_a_child_that_waits_for_a_master_ends_when_its_parent_was_killed() -> None:
    child = Path(ros1_child.__file__)
    code = (
        "import subprocess, sys, time;"
        f"p = subprocess.Popen(['/usr/bin/python3', '-s', {str(child)!r}, 'orphan'], stdin=subprocess.PIPE,"
        " stdout=subprocess.PIPE, env={'ROS_MASTER_URI': 'http://127.0.0.1:9', 'PATH': '/usr/bin', 'HOME': '/tmp'});"
        "p.stdout.readline(); print(p.pid, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        orphan = int(parent.stdout.readline())
        parent.kill()
    until(lambda: not Path(f"/proc/{orphan}").exists(), "the child outlives its parent")


def test_two_stations_of_one_name_do_not_end_each_other(shared: Master) -> None:
    """The master ends the node whose name another one takes: it comes back under a name of its own, and both stay."""
    sinks = [ros1(shared), ros1(shared)]
    try:
        for sink in sinks:
            sink.open([ANGLE, FORCE], STATION)
        until(lambda: len(shared.published().get("/bench/crane", [])) == 2)
        publishers = shared.published()["/bench/crane"]
        assert sorted(publishers) == ["/teds_provision_bench", f"/teds_provision_bench_{os.getpid()}"]
    finally:
        for sink in sinks:
            sink.close()


@pytest.fixture
def subscriber(shared: Master) -> Iterator[subprocess.Popen[str]]:
    """Yield a node that subscribed the group's rows before anybody published them."""
    command = ["/usr/bin/python3", "-s", str(Path(__file__).with_name("ros1_subscriber.py")), "/bench/crane"]
    reader = subprocess.Popen(command, env=shared.environment, stdout=subprocess.PIPE, text=True)
    yield reader
    reader.kill()
    reader.wait()


def test_a_subscriber_gets_every_row_from_the_first_on(shared: Master, subscriber: subprocess.Popen[str]) -> None:
    """Rows come in bursts of 20, as a thousand a second do, the first before he has connected; then it ends at once."""
    assert subscriber.stdout is not None
    while subscriber.stdout.readline() != "ready\n":  # before it stands that it waited for the master
        assert subscriber.poll() is None
    until(lambda: "/listener" in shared.heard().get("/bench/crane", []))
    sink = ros1(shared)
    sink.open([ANGLE, FORCE], STATION)
    until(lambda: sink.stats.state == "running")
    sent = list(range(400))
    for burst in range(0, len(sent), 20):
        values = np.array([[k, 1.0] for k in sent[burst : burst + 20]])
        stamps = time.time() + 0.001 * np.arange(len(values))
        sink.write_group(GroupRows("crane", ((ARM, 1), (HAND, 2)), stamps, values, values * 0))
        time.sleep(0.02)
    sink.close()
    assert [int(subscriber.stdout.readline()) for _ in sent] == sent
    assert sink.stats.dropped == 0
