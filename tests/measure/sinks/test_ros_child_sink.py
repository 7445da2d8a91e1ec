"""A ROS sink and its child on the desk: the lines that it sends, when it starts anew, and in which environment.

No process is started and no ROS is there.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from teds_provision.errors import UsageError
from teds_provision.measure.blocks import GroupRows, NodeReport, SetPointCommand
from teds_provision.measure.sinks.base import Sink
from teds_provision.measure.sinks.live import DiagnosticEntry, TopicSink
from teds_provision.measure.sinks.ros import child, rclpy_child, ros1_child, sourced
from teds_provision.measure.sinks.ros.child import ChildSink
from teds_provision.measure.sinks.ros.ros1 import Ros1Sink
from teds_provision.measure.sinks.ros.ros2 import Ros2Sink
from teds_provision.measure.sinks.ros.sourced import RclpySink, ros2_sink
from teds_provision.measure.sinks.vectors import Meaning
from tests.measure.sinks.parts import ANGLE, ARM, GRIP, HAND, STATION, block

JOINTS = "sensor_msgs/JointState"
NAN = float("nan")


class DeskChildSink(ChildSink):
    """Keeps its lines; ``starts`` counts the children that it would have started."""

    def __init__(self, commands: list[SetPointCommand] | None = None) -> None:
        super().__init__("ROS", "rospy", None if commands is None else commands.append)
        self.lines: list[dict[str, Any]] = []
        self.starts = 0

    def _program(self) -> list[str]:
        return []

    def _environment(self) -> dict[str, str]:
        return {}

    def _start(self) -> None:
        self.starts += 1

    def _send(self, **words: object) -> None:
        self.lines.append(json.loads(json.dumps(words, allow_nan=False)))


def test_each_topic_has_one_publisher_and_names_go_again_only_if_they_are_others() -> None:
    sink = DeskChildSink()
    sink._advertise("/row", JOINTS)
    sink._array("/row", 1.5, ["a", "b"], [1.0, NAN])
    sink._array("/row", 2.5, ["a", "b"], [1.0, 2.0], [0.5, 0.25], [7.0, 8.0])
    sink._array("/row", 3.5, ["b", "a"], [1.0, float("inf")])
    sink._scalar("/oil", Meaning("sensor_msgs/Temperature", "temperature", 0.0, True), 4.5, "arm", 20.0, 0.25)
    sink._fields("/field", "sensor_msgs/MagneticField", 5.5, "base", {"magnetic_field.x": 0.5})
    assert sink.lines == [
        {"op": "topic", "id": 0, "topic": "/row", "type": JOINTS, "latch": False},
        {"op": "named", "id": 0, "v": ["a", "b"]},
        {"op": "joint", "id": 0, "t": 1.5, "v": [1.0, None]},
        {"op": "joint", "id": 0, "t": 2.5, "v": [1.0, 2.0], "vel": [0.5, 0.25], "eff": [7.0, 8.0]},
        {"op": "named", "id": 0, "v": ["b", "a"]},
        {"op": "joint", "id": 0, "t": 3.5, "v": [1.0, None]},
        {"op": "topic", "id": 1, "topic": "/oil", "type": "sensor_msgs/Temperature", "latch": False},
        {"op": "value", "id": 1, "t": 4.5, "field": "temperature", "frame": "arm", "v": 20.0, "var": 0.25},
        {"op": "topic", "id": 2, "topic": "/field", "type": "sensor_msgs/MagneticField", "latch": False},
        {"op": "compound", "id": 2, "t": 5.5, "frame": "base", "v": {"magnetic_field.x": 0.5}},
    ]


def test_metadata_is_latched_and_a_topic_that_was_taken_back_is_made_anew() -> None:
    sink = DeskChildSink()
    for words in ("one", "two"):
        sink._latched("/teds", words)
    sink._retire("/teds")
    sink._retire("/never")
    sink._latched("/teds", "three")
    sink._parameter("/bench/arm/angle", {"unit": "rad"})
    sink._listen("/bench/hand/force/cmd", HAND, 2)
    sink._listen_joints("/bench/joint_commands")
    sink._diagnose(9.5, [DiagnosticEntry(1, "arm: measurement", "lost", ARM, (("samples", "3"),))])
    assert sink.lines == [
        {"op": "topic", "id": 0, "topic": "/teds", "type": "std_msgs/String", "latch": True},
        {"op": "text", "id": 0, "v": "one"},
        {"op": "text", "id": 0, "v": "two"},
        {"op": "retire", "id": 0},
        {"op": "topic", "id": 1, "topic": "/teds", "type": "std_msgs/String", "latch": True},
        {"op": "text", "id": 1, "v": "three"},
        {"op": "param", "key": "/bench/arm/angle", "value": {"unit": "rad"}},
        {"op": "listen", "topic": "/bench/hand/force/cmd", "uuid": HAND, "channel": 2},
        {"op": "listen_joints", "topic": "/bench/joint_commands"},
        {"op": "topic", "id": 2, "topic": "/diagnostics", "type": "diagnostic_msgs/DiagnosticArray", "latch": False},
        {"op": "status", "id": 2, "t": 9.5, "v": [[1, "arm: measurement", "lost", ARM, [["samples", "3"]]]]},
    ]


def test_everything_is_advertised_to_each_child_and_what_came_before_it_is_dropped_and_counted() -> None:
    came: list[SetPointCommand] = []
    sink = DeskChildSink(came)
    sink._prepare((ANGLE,), STATION)
    running: Any = SimpleNamespace(poll=lambda: None)
    sink._child = running
    rows = GroupRows("crane", (ANGLE.key,), np.array([1.0, 2.0]), np.array([[1.0], [2.0]]), np.zeros((2, 1)))
    for item in (block(), rows, (GRIP,), NodeReport(ARM, "lost", "no frame")):
        sink._process_item(item)
    assert (sink.stats.dropped, sink.lines) == (5, []), "files have it"
    sink._heard = "waits for a ROS master at http://lab:11311"
    sink._idle(0.0)
    assert (sink.stats.state, sink.stats.detail) == ("waiting", "waits for a ROS master at http://lab:11311")
    for _ in range(2):
        sink.lines.clear()
        sink._announced = False
        sink._ready.set()
        assert sink._up()
        assert sink._up()
        assert sink.stats.state == "running"
        texts = [json.loads(line["v"])["uuid"] for line in sink.lines if line["op"] == "text"]
        assert texts == [ARM, HAND], "what was learned meanwhile, too; once for each child"
        assert [line["topic"] for line in sink.lines if line["op"] == "listen"] == ["/bench/hand/force/cmd"]
    assert sink._reports[ARM].why == "no frame"


def test_a_child_that_died_is_started_again_after_a_pause_that_doubles_to_half_a_minute(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [100.0]
    monkeypatch.setattr(child, "time", SimpleNamespace(monotonic=lambda: now[0]))
    sink = DeskChildSink()
    sink._prepare((), STATION)
    waits = []
    for _ in range(7):
        dead: Any = SimpleNamespace(poll=lambda: 3, returncode=3, stdin=None, wait=lambda _patience: 3)
        sink._child = dead
        assert not sink._up()
        assert sink._child is None
        waits.append(sink.stats.detail)
        began, before = now[0], sink.starts
        pause = sink._again - began
        now[0] = began + pause - 0.01
        assert (sink._up(), sink.starts) == (False, before)
        now[0] = began + pause
        assert (sink._up(), sink.starts) == (False, before + 1)
    seconds = (1, 2, 4, 8, 16, 30, 30)
    assert waits == [f"the ROS master is gone; tried again in {second} s" for second in seconds]
    alive: Any = SimpleNamespace(poll=lambda: None)
    sink._child = alive
    sink._ready.set()
    assert sink._up()
    sink._child = None
    sink._lost("rospy died")
    assert sink.stats.detail == "rospy died; tried again in 1 s", "it worked in between"


def test_why_a_child_ended_is_in_its_words_and_a_name_that_was_taken_gets_a_number() -> None:
    sink = DeskChildSink()
    sink._prepare((), replace(STATION, instance="left arm"))
    assert sink._cause(1) == "rospy died"
    sink._complaint = "No module named rospy"
    assert (sink._cause(1), sink._cause(-9)) == ("rospy died (No module named rospy)",) * 2
    assert (sink._cause(3), sink._suffix) == ("the ROS master is gone", "")
    assert sink._cause(4) == "another program took the name /teds_provision_bench_left_arm"
    assert sink._suffix == f"_{os.getpid()}"


def test_a_child_that_starts_is_called_as_the_measurement_and_no_longer_waits_for_the_master_of_the_last_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """While rospy started, a sink whose child had died went on to say that there was no master."""
    reading, writing = os.pipe()
    began: list[tuple[list[str], dict[str, Any]]] = []

    class Popen:
        def __init__(self, command: list[str], **more: Any) -> None:
            began.append((command, more))
            self.stdin, self.stdout, self.stderr = os.fdopen(writing, "wb"), io.BytesIO(), io.BytesIO()

        def poll(self) -> None:
            return None

    monkeypatch.setattr(child, "subprocess", SimpleNamespace(Popen=Popen, PIPE=-1))
    sink = Ros1Sink("ros1:http://lab:11311")
    TopicSink._prepare(sink, (), replace(STATION, instance="left arm"))
    sink._heard, sink._suffix = "waits for a ROS master at http://lab:11311", "_77"
    sink._numbers["/row"] = 4
    ChildSink._start(sink)
    sink._idle(0.0)
    [(command, more)] = began
    assert (command[0], command[-1]) == ("/usr/bin/python3", "teds_provision_bench_left_arm_77")
    assert (more["env"]["ROS_MASTER_URI"], more["start_new_session"]) == ("http://lab:11311", True)
    assert [more[pipe] for pipe in ("stdin", "stdout", "stderr")] == [-1] * 3, "what it complains of is heard"
    assert (sink.stats.state, sink.stats.detail, sink._numbers) == ("waiting", "rospy is starting", {})
    assert sink._child is not None
    assert sink._child.stdin is not None
    sink._child.stdin.close()
    os.close(reading)


def test_what_a_child_says_is_heard_line_by_line_and_what_is_no_line_is_left_out() -> None:
    came: list[SetPointCommand] = []
    sink = DeskChildSink(came)
    sink._prepare((replace(GRIP, units=None),), STATION)
    said = [
        b"no JSON\n",
        b'{"event": "waiting", "master": "http://lab:11311"}\n',
        b'{"event": "command", "uuid": "%s", "channel": 2, "value": "1.5"}\n' % HAND.encode(),
        b'{"event": "command", "uuid": "%s", "channel": 2, "value": "nan"}\n' % HAND.encode(),
        b'{"event": "joints", "names": ["x"], "position": ["1.0"], "velocity": [], "effort": []}\n',
    ]

    class Lines(list[bytes]):
        def close(self) -> None:
            """Do nothing."""

    heard: Any = SimpleNamespace(stdout=Lines(said), stderr=Lines([b"first\n", b"the cause \xff" + b"x" * 300, b" \n"]))
    sink._hear(heard)
    assert not sink._ready.is_set()
    assert sink._heard == "waits for a ROS master at http://lab:11311"
    assert [(command.uuid, command.channel, command.value) for command in came] == [(HAND, 2, 1.5)]
    assert sink.refused_commands == 2, "no number, and no joint"
    sink._hear_complaints(heard)
    assert sink._complaint.startswith("the cause \ufffdxx")
    assert len(sink._complaint) == 200
    heard.stdout = Lines([b'{"event": "ready", "node": "/x"}\n'])
    sink._hear(heard)
    assert sink._ready.is_set()


# -- environment -------------------------------------------------------------------------------------------------------


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> pytest.MonkeyPatch:
    """Leave nothing of ROS in the environment."""
    for name in [name for name in os.environ if name.startswith(("ROS_", "CYCLONEDDS", "FAST", "AMENT", "PYTHON"))]:
        monkeypatch.delenv(name)
    monkeypatch.delenv("CONDA_PREFIX", raising=False)
    monkeypatch.delenv("TEDS_PROVISION_ROS_PYTHON", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return monkeypatch


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET"), ("ROS_STATIC_PEERS", "10.0.0.1"), ("ROS_LOCALHOST_ONLY", "0"),
        ("ROS_DISCOVERY_SERVER", "10.0.0.1:11811"), ("FASTDDS_DEFAULT_PROFILES_FILE", "/x.xml"),
        ("FASTRTPS_DEFAULT_PROFILES_FILE", "/x.xml"), ("CYCLONEDDS_URI", "/x.xml"),
        ("ZENOH_SESSION_CONFIG_URI", "/x.json5"),
    ],
)  # fmt: skip
def test_an_rclpy_of_no_installation_stays_on_this_machine_unless_something_else_is_set(
    name: str, value: str, bare: pytest.MonkeyPatch
) -> None:
    bare.setenv("PYTHONPATH", "/elsewhere")
    own = RclpySink("/x/python3", 7, own=True)._environment()
    assert (own["ROS_AUTOMATIC_DISCOVERY_RANGE"], own["ROS_DOMAIN_ID"], "PYTHONPATH" in own) == (
        "LOCALHOST",
        "7",
        False,
    )
    theirs = RclpySink("/x/python3", 7)._environment()
    assert ("ROS_AUTOMATIC_DISCOVERY_RANGE" in theirs, theirs["ROS_DOMAIN_ID"]) == (False, "7")
    assert theirs["PYTHONPATH"] == "/elsewhere", "of the ROS that was sourced"
    assert ("ROS_LOG_DIR" in own, "ROS_LOG_DIR" in theirs) == (False, False)
    bare.setenv(name, value)
    own = RclpySink("/x/python3", 7, own=True)._environment()
    assert (own[name], own.get("ROS_AUTOMATIC_DISCOVERY_RANGE", value)) == (value, value)


@pytest.mark.parametrize(("variable", "given"), [("ROS_LOG_DIR", "/logs"), ("ROS_HOME", "/home/ros"), ("", "")])
def test_a_service_without_a_home_has_a_place_for_logs(variable: str, given: str, bare: pytest.MonkeyPatch) -> None:
    bare.setenv("HOME", "/nonexistent")
    if variable:
        bare.setenv(variable, given)
    around = RclpySink("/x/python3", 0, own=True)._environment()
    assert ("ROS_LOG_DIR" in around, around.get("ROS_LOG_DIR") in (given, None)) == (
        (variable != "ROS_HOME"), bool(variable)
    )  # fmt: skip


@pytest.mark.parametrize(
    ("spec", "variable", "master"),
    [
        ("ros1", "", None),
        ("ros1", "http://own:11311", "http://own:11311"),
        ("ros1:http://lab:11312", "http://own:11311", "http://lab:11312"),
    ],
)
def test_the_master_is_the_one_that_is_named_else_that_of_the_environment(
    spec: str, variable: str, master: str | None, bare: pytest.MonkeyPatch
) -> None:
    if variable:
        bare.setenv("ROS_MASTER_URI", variable)
    bare.setenv("PYTHONPATH", "/work/venv")
    around = Ros1Sink(spec)._environment()
    assert (around.get("ROS_MASTER_URI"), "PYTHONPATH" in around) == (master, False)
    bare.setenv("PYTHONPATH", "/opt/ros/noetic/lib/python3/dist-packages")
    assert Ros1Sink(spec)._environment()["PYTHONPATH"] == "/opt/ros/noetic/lib/python3/dist-packages"


def python_of(sink: Sink) -> tuple[str, bool]:
    """Return the Python that carries a sink, and whether it belongs to no ROS that was sourced."""
    assert isinstance(sink, RclpySink)
    return sink._python, sink._own


def test_the_rclpy_of_a_sourced_ros_goes_before_a_named_one_and_that_before_cyclone_dds(
    bare: pytest.MonkeyPatch,
) -> None:
    """The Python of conda, then the system's, then the first in PATH."""
    can: set[str] = set()
    asked: list[str] = []

    def imports(python: str, packages: str, _around: dict[str, str]) -> bool:
        asked.append(python)
        assert "rclpy" in packages
        return python in can

    bare.setattr(child, "imports", imports)
    bare.setattr(sourced.shutil, "which", lambda _name: "/path/python3")
    bare.setattr(sourced, "find_spec", lambda _name: None)

    def found(*pythons: str) -> Sink:
        sourced._python.cache_clear()
        sourced._require_rclpy.cache_clear()
        can.clear()
        can.update(pythons)
        return ros2_sink("ros2:7")

    try:
        assert isinstance(found("/usr/bin/python3"), Ros2Sink)
        assert asked == [], "no ROS was sourced"
        bare.setenv("TEDS_PROVISION_ROS_PYTHON", "/named/python3")
        assert python_of(found("/named/python3")) == ("/named/python3", True)
        bare.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")
        bare.setenv("CONDA_PREFIX", "/conda")
        asked.clear()
        assert python_of(found("/named/python3")) == ("/named/python3", True)
        assert asked == ["/conda/bin/python3", "/usr/bin/python3", "/path/python3", "/named/python3"]
        assert python_of(found("/path/python3", "/named/python3")) == ("/path/python3", False)
        assert python_of(found("/usr/bin/python3", "/path/python3")) == ("/usr/bin/python3", False)
        assert python_of(found("/conda/bin/python3", "/usr/bin/python3")) == ("/conda/bin/python3", False)
        with pytest.raises(UsageError, match="/named/python3 cannot import rclpy"):
            found()
        bare.delenv("TEDS_PROVISION_ROS_PYTHON")
        assert isinstance(found(), Ros2Sink)
        bare.setattr(sourced, "find_spec", lambda _name: True)
        assert python_of(found(sys.executable)) == (sys.executable, True)
    finally:
        sourced._python.cache_clear()
        sourced._require_rclpy.cache_clear()


@pytest.mark.parametrize(
    ("around", "alone"),
    [
        ({}, False),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}, True),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "off"}, True),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, False),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"}, False),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": "10.0.0.1"}, False),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": ""}, True),
        ({"ROS_LOCALHOST_ONLY": "1"}, True),
        ({"ROS_LOCALHOST_ONLY": "0"}, False),
        ({"ROS_LOCALHOST_ONLY": "1", "ROS_STATIC_PEERS": "10.0.0.1"}, True),
    ],
)
def test_ports_are_bound_to_loopback_if_the_environment_keeps_ros_there(
    around: dict[str, str], alone: bool, bare: pytest.MonkeyPatch
) -> None:
    for name, value in around.items():
        bare.setenv(name, value)
    assert rclpy_child.on_this_machine_alone() is alone


def test_the_ports_of_a_domain_are_those_of_dds() -> None:
    assert (rclpy_child.ports_of(0).start, rclpy_child.ports_of(0).stop) == (7400, 7650)
    assert (rclpy_child.ports_of(7, 74).start, rclpy_child.ports_of(7, 74).stop) == (9150, 9224)


# -- children ----------------------------------------------------------------------------------------------------------


class Parameters:
    """The node of rclpy as far as its parameters go; mock."""

    def __init__(self) -> None:
        self.held: dict[str, Any] = {}
        self.may: Any = None
        self.callback: Any = None

    def add_on_set_parameters_callback(self, callback: Any) -> None:
        self.callback = callback

    def has_parameter(self, name: str) -> bool:
        return name in self.held

    def declare_parameter(self, name: str, value: object, _descriptor: object) -> None:
        assert self.callback([]).successful
        self.held[name] = value

    def set_parameters(self, given: Sequence[Any]) -> None:
        assert self.callback([]).successful
        self.held |= {parameter.name: parameter.value for parameter in given}


def test_facts_are_parameters_that_nobody_sets_from_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    """``<station>.<node>.<channel>.<fact>``; lists are of one type, and what no parameter can hold is JSON."""
    messages: Any = ModuleType("rcl_interfaces.msg")
    messages.SetParametersResult = SimpleNamespace
    messages.ParameterDescriptor = SimpleNamespace
    parameters: Any = ModuleType("rclpy.parameter")
    parameters.Parameter = lambda name, value: SimpleNamespace(name=name, value=value)
    monkeypatch.setitem(sys.modules, "rcl_interfaces.msg", messages)
    monkeypatch.setitem(sys.modules, "rclpy", ModuleType("rclpy"))
    monkeypatch.setitem(sys.modules, "rclpy.parameter", parameters)
    node = Parameters()
    bridge = rclpy_child.Bridge(None, node)
    facts = {
        "unit": "rad", "low": 0, "overdue": True, "vector": [1, 2.5], "words": ["a"], "mixed": [1, "a"], "none": None,
        "calibration": {"method": "linear"}, "flags": [True, False],
    }  # fmt: skip
    bridge.param({"key": "/bench/arm/angle", "value": facts})
    bridge.param({"key": "/bench/arm/angle", "value": {"unit": "°"}})
    assert {name.removeprefix("bench.arm.angle."): value for name, value in node.held.items()} == {
        "unit": "°", "low": 0, "overdue": True, "vector": [1.0, 2.5], "words": ["a"], "mixed": '[1, "a"]',
        "none": "null", "calibration": '{"method": "linear"}', "flags": [True, False],
    }  # fmt: skip
    refused = node.callback([])
    assert (refused.successful, refused.reason) == (False, "a fact of a signed datasheet")


def test_what_rclpy_offers_and_asks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reliable, the last hundred; metadata for late comers; set points of whoever publishes them."""
    rclpy: Any = ModuleType("rclpy")
    rclpy.qos = SimpleNamespace(
        QoSProfile=lambda **said: said,
        HistoryPolicy=SimpleNamespace(KEEP_LAST="last"),
        ReliabilityPolicy=SimpleNamespace(BEST_EFFORT="best effort", RELIABLE="reliable"),
        DurabilityPolicy=SimpleNamespace(TRANSIENT_LOCAL="transient", VOLATILE="volatile"),
    )
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    made: list[tuple[object, ...]] = []
    node = SimpleNamespace(
        add_on_set_parameters_callback=lambda _callback: None,
        create_publisher=lambda *words: made.append(words) or "publisher",
        create_subscription=lambda kind, topic, _came, asked: made.append((kind, topic, asked)),
        destroy_publisher=lambda publisher: made.append((publisher,)),
    )
    bridge = rclpy_child.Bridge(None, node)
    bridge.types = {"std_msgs/String": "String", "std_msgs/Float64": "Float64", JOINTS: "JointState"}
    bridge.topic({"id": 4, "topic": "/row", "type": JOINTS, "latch": False})
    bridge.topic({"id": 5, "topic": "/teds", "type": "std_msgs/String", "latch": True})
    for _ in range(2):
        bridge.listen({"topic": "/cmd", "uuid": HAND, "channel": 2})
        bridge.listen_joints({"topic": "/joint_commands"})
    bridge.retire({"id": 5})
    live, last, asked = (
        {"history": "last", "depth": depth, "reliability": reliability, "durability": durability}
        for depth, reliability, durability in (
            (100, "reliable", "volatile"), (1, "reliable", "transient"), (1, "best effort", "volatile")
        )
    )  # fmt: skip
    assert made == [
        ("JointState", "/row", live), ("String", "/teds", last), ("Float64", "/cmd", asked),
        ("JointState", "/joint_commands", asked), ("publisher",),
    ]  # fmt: skip
    assert list(bridge.publishers) == [4]


def test_what_rospy_publishes_waits_for_known_subscribers_and_metadata_waits_for_none(
    capsys: pytest.CaptureFixture[str],
) -> None:
    made: list[tuple[object, ...]] = []

    class Publishes:
        def __init__(self, topic: str, kind: object, *, queue_size: int, latch: bool) -> None:
            made.append((topic, kind, queue_size, latch))

        def get_num_connections(self) -> int:
            return 0

        def unregister(self) -> None:
            made.append(("unregistered",))

    def subscriber(topic: str, kind: object, came: Any, *, queue_size: int) -> Any:
        made.append((topic, kind, queue_size))
        return came

    def set_param(key: str, value: object) -> None:
        if value is None:
            raise OSError("no master")
        made.append((key, value))

    rospy = SimpleNamespace(Publisher=Publishes, Subscriber=subscriber, set_param=set_param)
    master = SimpleNamespace(getSystemState=lambda: ([], [["/row", ["/a"]], ["/teds", ["/a"]]], []))
    bridge = ros1_child.Bridge(rospy, master)
    bridge.types = {"std_msgs/String": "String", "std_msgs/Float64": "Float64", JOINTS: "JointState"}
    for number, topic, kind, latch in ((1, "/row", JOINTS, False), (2, "/teds", "std_msgs/String", True)):
        bridge.topic({"id": number, "topic": topic, "type": kind, "latch": latch})
    bridge.topic({"id": 3, "topic": "/nobodys", "type": JOINTS, "latch": False})
    assert [bridge.publishers[number].met() for number in (1, 2, 3)] == [False, True, True]
    for _ in range(2):
        bridge.listen({"topic": "/cmd", "uuid": HAND, "channel": 2})
        bridge.listen_joints({"topic": "/joint_commands"})
    bridge.retire({"id": 2})
    bridge.param({"key": "/a", "value": 1})
    bridge.param({"key": "/b", "value": None})
    assert made == [
        ("/row", "JointState", 1000, False), ("/teds", "String", 1000, True), ("/nobodys", "JointState", 1000, False),
        ("/cmd", "Float64", 1), ("/joint_commands", "JointState", 1), ("unregistered",), ("/a", 1),
    ]  # fmt: skip
    assert sorted(bridge.publishers) == [1, 3]
    bridge.listening["/cmd"](SimpleNamespace(data=1.5))
    bridge.listening["/joint_commands"](
        SimpleNamespace(name=("elbow",), position=(0.5,), velocity=(), effort=(float("nan"),))
    )
    said = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert said == [
        {"event": "trouble", "what": "parameter /b: no master"},
        {"event": "command", "uuid": HAND, "channel": 2, "value": "1.5"},
        {"event": "joints", "names": ["elbow"], "position": ["0.5"], "velocity": [], "effort": ["nan"]},
    ]


def test_what_cyclone_dds_offers_and_asks_for(bare: pytest.MonkeyPatch) -> None:
    qos = pytest.importorskip("cyclonedds.qos")
    kinds = pytest.importorskip("teds_provision.measure.sinks.ros.ros2_types")
    policy = qos.Policy
    for distribution, kind, code in (
        ("jazzy", "sensor_msgs/Range", kinds.TYPE_HASHES["sensor_msgs/Range"]),
        ("unheard-of", "sensor_msgs/Range", kinds.TYPE_HASHES["sensor_msgs/Range"]),
        ("humble", "sensor_msgs/Range", kinds.HUMBLE_HASHES["sensor_msgs/Range"]),
        ("humble", JOINTS, kinds.TYPE_HASHES[JOINTS]),
    ):
        bare.setenv("ROS_DISTRO", distribution)
        sink = Ros2Sink("ros2:7")
        sink._types = kinds
        live, last, asked = (
            sink._qos(kind, latched=latched, reading=reading)
            for latched, reading in ((False, False), (True, False), (False, True))
        )
        assert policy.Userdata(f"typehash=RIHS01_{code};".encode()) in live
        assert policy.Reliability.BestEffort in asked
        assert policy.Reliability.BestEffort not in live
        assert policy.Reliability.BestEffort not in last
        assert [policy.History.KeepLast(count) in one for count, one in ((100, live), (1, last), (10, asked))] == [
            True, True, True
        ]  # fmt: skip
        assert [policy.Durability.TransientLocal in one for one in (live, last, asked)] == [False, True, False]
        assert sink._header(12.9999999999).stamp == kinds.Time(13, 0)


def test_a_python_imports_what_it_can_in_its_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Any, ...]] = []

    def run(words: list[str], *, env: dict[str, str], timeout: float, **_how: Any) -> Any:
        asked.append((words, env, timeout))
        if words[0] == "/no/python":
            raise FileNotFoundError
        if words[0] == "/slow/python":
            raise subprocess.TimeoutExpired(words, timeout)
        return SimpleNamespace(returncode=0 if words[0] == "/good/python" else 1)

    monkeypatch.setattr(child.subprocess, "run", run)
    found = [child.imports(f"/{name}/python", "rospy, a.b", {"A": "1"}) for name in ("good", "bare", "no", "slow")]
    assert found == [True, False, False, False]
    assert asked[0] == (["/good/python", "-s", "-c", "import rospy, a.b"], {"A": "1"}, 60.0)


class Child:
    """A process: ``ends`` False if it ends only when it is killed, with all that it started."""

    pid = 4711
    returncode = 0

    def __init__(self, course: list[Any], *, ends: bool, stdin: Any = None) -> None:
        self.course, self.ends, self.stdin = course, ends, stdin

    def wait(self, patience: float | None = None) -> None:
        self.course.append(patience)
        if patience is not None and not self.ends:
            raise subprocess.TimeoutExpired("child", patience)


@pytest.mark.parametrize("gone", [False, True])
def test_a_child_that_does_not_end_with_its_input_is_killed_with_all_that_it_started(
    monkeypatch: pytest.MonkeyPatch, gone: bool
) -> None:
    course: list[Any] = []

    def kill(group: int, number: int) -> None:
        course.append((group, number))
        if gone:
            raise ProcessLookupError

    monkeypatch.setattr(child.os, "killpg", kill)
    sink = DeskChildSink()
    sink._stop(5.0)
    for ends in (True, False):
        stdin = SimpleNamespace(close=lambda: course.append("closed"))
        sink._child = Child(course, ends=ends, stdin=stdin)  # type: ignore[assignment]
        sink._stop(5.0)
        assert sink._child is None
    assert course == ["closed", 5.0, "closed", 5.0, (4711, 9), None]


def test_the_last_messages_of_a_ready_child_have_five_seconds_to_leave() -> None:
    course: list[Any] = []
    sink = DeskChildSink()
    for ready in (False, True):
        if ready:
            sink._ready.set()
        sink._child = Child(course, ends=True)  # type: ignore[assignment]
        sink._finish()
    assert course == [0.5, 5.0]


@pytest.mark.parametrize(
    ("failure", "why"),
    [
        (None, ""),
        ("full", "rospy takes nothing any more"),
        (BrokenPipeError, "rospy died"),
        (BlockingIOError, "rospy died"),
    ],
)
def test_a_child_that_takes_no_line_is_given_up(monkeypatch: pytest.MonkeyPatch, failure: Any, why: str) -> None:
    """Two seconds without room in its pipe, whatever the state of its process is; a line goes in parts."""
    waited: list[float] = []
    got = bytearray()

    def select(_read: Any, write: list[Any], _error: Any, left: float) -> tuple[Any, ...]:
        waited.append(left)
        return [], [] if failure == "full" else write, []

    def write(_file: int, octets: memoryview) -> int:
        if failure:
            raise failure
        got.extend(octets[:7])
        return min(7, len(octets))

    monkeypatch.setattr(child, "select", SimpleNamespace(select=select))
    monkeypatch.setattr(child.os, "write", write)
    monkeypatch.setattr(child, "time", SimpleNamespace(monotonic=lambda: 100.0))
    sink = DeskChildSink()
    lost: list[str] = []
    monkeypatch.setattr(sink, "_lost", lost.append)
    ChildSink._send(sink, op="text")
    assert waited == [], "there is no child"
    sink._child = Child([], ends=True, stdin=SimpleNamespace(fileno=lambda: 9))  # type: ignore[assignment]
    ChildSink._send(sink, op="text", v="ä")
    assert waited[0] == 2.0
    assert lost == ([why] if why else [])
    if not why:
        assert got == b'{"op":"text","v":"\\u00e4"}\n'
