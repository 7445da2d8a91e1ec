"""What the children of the ROS sinks make of their parent's lines, without any ROS; what DDS refuses is counted."""

from __future__ import annotations

import io
import math
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.measure.sinks.ros import rclpy_child, ros1_child
from teds_provision.measure.sinks.ros.ros2 import Ros2Sink
from teds_provision.measure.sinks.vectors import Meaning


class Stamp(SimpleNamespace):
    """The stamp of a header of either ROS."""

    @staticmethod
    def from_sec(seconds: float) -> Stamp:
        """Return a ROS 1 time."""
        return Stamp(sec=int(seconds), nanosec=round(seconds % 1 * 1e9))


class Temperature:
    """A message with a header and a variance."""

    def __init__(self) -> None:
        self.header = SimpleNamespace(stamp=Stamp(), frame_id="nobody's")
        self.temperature, self.variance = 0.0, 0.0


class Float64:
    """A message of a number alone, which may not get any other field."""

    __slots__ = ("data",)


class Joints:
    """A row of a group."""

    def __init__(self) -> None:
        self.header = SimpleNamespace(stamp=Stamp(), frame_id="")
        self.name, self.position, self.velocity, self.effort = [], [], [1.0], [1.0]  # type: ignore[var-annotated]


class Publisher:
    """Keeps what was published."""

    def __init__(self, connections: int = 0) -> None:
        self.sent: list[Any] = []
        self.connections = connections

    def publish(self, message: Any) -> None:
        """Keep it."""
        self.sent.append(message)

    def get_num_connections(self) -> int:
        """Return the number of readers that are there."""
        return self.connections


def child(way: str, kind: type) -> tuple[Any, Publisher]:
    """Return the bridge of a child with one publisher, of number 1, and that publisher."""
    publisher, bridge = Publisher(), None
    if way == "rclpy":
        bridge = rclpy_child.Bridge(None, SimpleNamespace(add_on_set_parameters_callback=lambda _callback: None))
        bridge.publishers[1] = publisher, kind
        return bridge, publisher
    old = ros1_child.Bridge(SimpleNamespace(Time=Stamp), None)
    old.publishers[1] = ros1_child.Outlet(publisher, kind, 0)
    return old, publisher


BOTH = pytest.mark.parametrize("way", ["rclpy", "rospy"])


@BOTH
def test_a_value_goes_with_its_time_its_frame_and_its_variance(way: str) -> None:
    bridge, publisher = child(way, Temperature)
    bridge.value({"id": 1, "t": 12.25, "field": "temperature", "frame": "arm", "v": 21.5, "var": 0.0625})
    (message,) = publisher.sent
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 250_000_000)
    assert (message.header.frame_id, message.temperature, message.variance) == ("arm", 21.5, 0.0625)


@BOTH
def test_a_message_without_header_and_variance_has_the_value_alone(way: str) -> None:
    bridge, publisher = child(way, Float64)
    bridge.value({"id": 1, "t": 12.25, "field": "data", "frame": "arm", "v": 21.5, "var": 0.0625})
    assert [message.data for message in publisher.sent] == [21.5]


@BOTH
def test_a_row_of_joints_has_its_names_and_nan_where_a_value_is_missing(way: str) -> None:
    bridge, publisher = child(way, Joints)
    bridge.named({"id": 1, "v": ["elbow", "wrist"]})
    bridge.joint({"id": 1, "t": 3.5, "v": [0.5, None], "eff": [7.0, 8.0]})
    bridge.joint({"id": 1, "t": 4.5, "v": [0.5, 0.25], "vel": [5.0, 6.0]})
    first, second = publisher.sent
    assert (first.header.stamp.sec, first.header.stamp.nanosec) == (3, 500_000_000)
    assert (first.name, first.velocity, first.effort) == (["elbow", "wrist"], [], [7.0, 8.0])
    assert first.position[0] == 0.5
    assert math.isnan(first.position[1])
    assert (second.position, second.velocity, second.effort) == ([0.5, 0.25], [5.0, 6.0], [])


@BOTH
def test_the_fields_of_a_compound_message_go_by_their_paths_and_one_that_is_unknown_is_left_out(way: str) -> None:
    bridge, publisher = child(way, Temperature)
    bridge.compound({"id": 1, "t": 3.5, "frame": "arm", "v": {"header.seq": 4, "temperature": 2.5, "radiation": 1}})
    (message,) = publisher.sent
    assert (message.header.stamp.sec, message.header.frame_id, message.temperature) == (3, "arm", 2.5)
    assert not hasattr(message, "radiation")
    assert not hasattr(message.header, "seq")


def test_first_messages_wait_for_each_expected_subscriber_but_a_second_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    """A subscriber that the master still lists may be dead."""
    now = [50.0]
    pauses: list[float] = []
    monkeypatch.setattr(ros1_child, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=pauses.append))
    publisher = Publisher()
    outlet = ros1_child.Outlet(publisher, Float64, 2)
    outlet.publish("a")
    now[0], publisher.connections = 50.9, 1
    outlet.publish("b")
    assert (publisher.sent, outlet.met()) == ([], False)
    now[0] = 51.0
    assert outlet.met()
    assert publisher.sent == ["a", "b"]
    outlet.publish("c")
    assert (publisher.sent, pauses) == (["a", "b", "c"], [])


def test_waiting_messages_go_as_soon_as_the_last_subscriber_is_there_in_bursts_of_twenty(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pauses: list[float] = []
    monkeypatch.setattr(ros1_child, "time", SimpleNamespace(monotonic=lambda: 50.0, sleep=pauses.append))
    publisher = Publisher()
    outlet = ros1_child.Outlet(publisher, Float64, 2)
    for number in range(41):
        outlet.publish(number)
    assert publisher.sent == []
    publisher.connections = 2
    outlet.publish(41)
    assert publisher.sent == list(range(42))
    assert pauses == [0.002, 0.002]


def test_the_masters_list_of_subscribers_is_reused_for_a_part_of_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    now, looks = [50.0], [0]

    def state() -> Any:
        looks[0] += 1
        if looks[0] == 3:
            raise OSError("the master is gone")
        return [], [["/arm", ["/a"] * looks[0]]], []

    monkeypatch.setattr(ros1_child, "time", SimpleNamespace(monotonic=lambda: now[0]))
    bridge = ros1_child.Bridge(None, SimpleNamespace(getSystemState=state))
    seen = []
    for now[0] in (50.0, 50.3, 50.5, 50.7, 50.9):
        seen.append((bridge.subscribers("/arm"), bridge.subscribers("/leg")))
    assert seen == [(1, 0), (1, 0), (2, 0), (2, 0), (0, 0)]


def test_what_no_reader_of_dds_takes_counts_with_all_its_values(monkeypatch: pytest.MonkeyPatch) -> None:
    core = pytest.importorskip("cyclonedds.core")

    def full(_message: Any) -> None:
        raise core.DDSException(core.DDSException.DDS_RETCODE_TIMEOUT)

    sink = Ros2Sink("ros2:7")
    monkeypatch.setattr(sink, "_writer", lambda *_topic, **_latched: SimpleNamespace(write=full))
    kinds = pytest.importorskip("teds_provision.measure.sinks.ros.ros2_types")
    sink._types = kinds
    dropped = []
    for write in (
        lambda: sink._array("/arm", 1.0, ["a", "b", "c"], [1.0, 2.0, 3.0]),
        lambda: sink._scalar(
            "/oil", Meaning("sensor_msgs/Temperature", "temperature", 0.0, True), 1.0, "arm", 2.0, 0.5
        ),
        lambda: sink._fields(
            "/hand", "geometry_msgs/WrenchStamped", 1.0, "", {"wrench.force.x": 1.0, "wrench.force.y": 2.0}
        ),
        lambda: sink._latched("/arm/teds", "{}"),
        lambda: sink._diagnose(1.0, []),
    ):
        write()
        dropped.append(sink.stats.dropped)
    assert dropped == [3, 4, 6, 6, 6]


def test_the_counters_of_a_sink_are_those_of_the_moment_when_they_were_asked_for() -> None:
    sink = Ros2Sink("ros2:7")
    sink._count(written=3, dropped=1)
    before = sink.stats
    sink._count(written=2, dropped=5)
    assert (before.written, before.dropped) == (3, 1)
    assert (sink.stats.written, sink.stats.dropped) == (5, 6)


def rclpy_bridge(node: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a child's bridge to a node; rclpy and its messages are named by what they are asked for."""

    def named(name: str) -> Any:
        return lambda *values, **fields: SimpleNamespace(kind=name, values=values, **fields)

    def module(name: str) -> Any:
        return SimpleNamespace(
            Float64="Float64", JointState="JointState", SetParametersResult=named("result"),
            ParameterDescriptor=named("descriptor"),
        )  # fmt: skip

    policies = SimpleNamespace(
        QoSProfile=lambda **profile: tuple(profile[name] for name in ("history", "depth", "reliability", "durability")),
        HistoryPolicy=SimpleNamespace(KEEP_LAST="last"),
        ReliabilityPolicy=SimpleNamespace(BEST_EFFORT="best effort", RELIABLE="reliable"),
        DurabilityPolicy=SimpleNamespace(TRANSIENT_LOCAL="latched", VOLATILE="volatile"),
    )
    parameters = SimpleNamespace(Parameter=lambda name, *, value: (name, value))
    for name, made in (
        ("rclpy", SimpleNamespace(qos=policies)), ("rclpy.qos", policies), ("rclpy.parameter", parameters)
    ):  # fmt: skip
        monkeypatch.setitem(sys.modules, name, made)
    monkeypatch.setattr(rclpy_child, "importlib", SimpleNamespace(import_module=module))
    return rclpy_child.Bridge(None, node)


def test_another_program_of_the_same_name_ends_a_rospy_child_with_its_own_code(monkeypatch: pytest.MonkeyPatch) -> None:
    codes: list[int] = []
    monkeypatch.setattr(ros1_child.os, "_exit", codes.append)
    for reason in ("new node registered with same name", "shutdown request", ""):
        ros1_child.leave(reason)
    assert codes == [4]


def test_a_parameter_that_the_master_does_not_take_is_reported_and_ends_nothing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    held: dict[str, object] = {}

    def put(key: str, value: object) -> None:
        if key == "/gone":
            raise OSError("no master")
        held[key] = value

    bridge = ros1_child.Bridge(SimpleNamespace(set_param=put), None)
    bridge.param({"key": "/bench/arm/angle", "value": {"unit": "rad"}})
    bridge.param({"key": "/gone", "value": 1})
    assert held == {"/bench/arm/angle": {"unit": "rad"}}
    assert capsys.readouterr().out == '{"event": "trouble", "what": "parameter /gone: no master"}\n'


@BOTH
def test_a_set_point_is_passed_on_with_all_its_digits_and_a_topic_is_subscribed_once(
    way: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    heard: list[tuple[str, Any]] = []
    if way == "rclpy":
        node = SimpleNamespace(
            add_on_set_parameters_callback=lambda _callback: None,
            create_subscription=lambda _kind, topic, came, _qos: heard.append((topic, came)) or topic,
        )
        bridge = rclpy_bridge(node, monkeypatch)
    else:
        ros = SimpleNamespace(
            Subscriber=lambda topic, _kind, came, queue_size: heard.append((topic, came)) or (topic, queue_size)
        )
        bridge = ros1_child.Bridge(ros, None)
        monkeypatch.setattr(bridge, "type_of", lambda name: name)
    for _ in range(2):
        bridge.listen({"topic": "/cmd", "uuid": "aa", "channel": 3})
        bridge.listen_joints({"topic": "/joints"})
    assert [topic for topic, _ in heard] == ["/cmd", "/joints"]
    heard[0][1](SimpleNamespace(data=0.1 + 0.2))
    heard[1][1](SimpleNamespace(name=["a", "b"], position=[1, math.nan], velocity=[], effort=[2.5]))
    assert capsys.readouterr().out.splitlines() == [
        '{"event": "command", "uuid": "aa", "channel": 3, "value": "0.30000000000000004"}',
        '{"event": "joints", "names": ["a", "b"], "position": ["1.0", "nan"], "velocity": [], "effort": ["2.5"]}',
    ]


def as_module(monkeypatch: pytest.MonkeyPatch, module: Any, made: dict[str, Any]) -> list[str]:
    """Let a child import these packages; returns what it asks for."""
    asked: list[str] = []

    def load(name: str) -> Any:
        asked.append(name)
        return SimpleNamespace(**made)

    monkeypatch.setattr(module, "importlib", SimpleNamespace(import_module=load))
    return asked


class Diagnostics:
    """A DiagnosticArray."""

    def __init__(self) -> None:
        self.header, self.status = SimpleNamespace(stamp=Stamp(), frame_id=""), []  # type: ignore[var-annotated]


STATUS = {
    "id": 1,
    "t": 3.5,
    "v": [[2, "arm", "It is lost.", "aa", [["lost", "7"], ["late", "0"]]], [0, "x", "", "bb", []]],
}


def test_a_status_goes_to_rospy_with_its_values_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge, publisher = child("rospy", Diagnostics)
    made = {"DiagnosticStatus": lambda *words: words, "KeyValue": lambda *words: words}
    asked = as_module(monkeypatch, ros1_child, made)
    bridge.status(STATUS)
    (message,) = publisher.sent
    assert message.header.stamp.sec == 3
    assert message.status == [
        (2, "arm", "It is lost.", "aa", [("lost", "7"), ("late", "0")]), (0, "x", "", "bb", []),
    ]  # fmt: skip
    assert set(asked) == {"diagnostic_msgs.msg"}
    bridge.status(STATUS)
    assert len(asked) == 2, "each type is looked up once"


def test_a_status_goes_to_rclpy_with_its_level_as_an_octet(monkeypatch: pytest.MonkeyPatch) -> None:
    bridge, publisher = child("rclpy", Diagnostics)
    made = {"DiagnosticStatus": lambda **words: words, "KeyValue": lambda **words: words}
    assert as_module(monkeypatch, rclpy_child, made) == []
    bridge.status(STATUS)
    (message,) = publisher.sent
    assert message.header.stamp.sec == 3
    values = [{"key": "lost", "value": "7"}, {"key": "late", "value": "0"}]
    assert message.status == [
        {"level": b"\2", "name": "arm", "message": "It is lost.", "hardware_id": "aa", "values": values},
        {"level": b"\0", "name": "x", "message": "", "hardware_id": "bb", "values": []},
    ]


def test_a_text_is_a_message_of_its_own() -> None:
    bridge, publisher = child("rclpy", SimpleNamespace)
    bridge.text({"id": 1, "v": "{}"})
    assert publisher.sent == [SimpleNamespace(data="{}")]
    bridge, publisher = child("rospy", lambda data: ("String", data))  # type: ignore[arg-type]
    bridge.text({"id": 1, "v": "{}"})
    assert publisher.sent == [("String", "{}")]


def test_what_rospy_holds_back_or_has_in_its_queues_is_waited_for_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two seconds at most: one for subscribers to come, one for the last messages to leave."""
    now = [50.0]

    def sleep(seconds: float) -> None:
        now[0] += seconds
        if now[0] > 50.5:
            publisher.connections = 1
        if now[0] > 51.0:
            queue.clear()

    monkeypatch.setattr(ros1_child, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
    queue = ["a message"]
    connection = SimpleNamespace(_queue=queue)
    publisher: Any = Publisher()
    publisher.impl = SimpleNamespace(connections=[SimpleNamespace(), connection])
    bridge = ros1_child.Bridge(None, None)
    bridge.publishers[1] = ros1_child.Outlet(publisher, Float64, 1)
    bridge.publishers[1].publish("late")
    bridge.end()
    assert publisher.sent == ["late"]
    assert now[0] == pytest.approx(51.0, abs=0.01)
    queue.append("for a reader that hangs")
    now[0] = 51.1
    monkeypatch.setattr(ros1_child.time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    bridge.end()
    assert now[0] == pytest.approx(53.1, abs=0.01)
    for impl in (None, SimpleNamespace(), SimpleNamespace(connections=[])):
        publisher.impl = impl
        assert bridge.publishers[1].sent(), "it was taken back, or nobody reads"


class Exit(Exception):
    """The end of a process, with its code."""


def runs(monkeypatch: pytest.MonkeyPatch, module: Any, lines: str) -> list[Any]:
    """Run a child's program with these lines; returns what its bridge was given, and the code with which it ended."""
    course: list[Any] = []

    def end(code: int) -> None:
        raise Exit(code)

    class Bridge:
        def __init__(self, ros: Any, other: Any) -> None:
            course.append(("bridge", ros.name, other))

        def param(self, words: dict[str, Any]) -> None:
            course.append(words["value"])

        def end(self) -> None:
            course.append("end")

    monkeypatch.setattr(module, "Bridge", Bridge)
    monkeypatch.setattr(module.os, "_exit", end)
    monkeypatch.setattr(module.sys, "argv", ["child", "bench"])
    monkeypatch.setattr(module.sys, "stdin", io.StringIO(lines))
    monkeypatch.setattr(module.threading, "Thread", lambda target, args=(), daemon=False: SimpleNamespace(
        start=lambda: course.append(("thread", target, args, daemon))))  # fmt: skip
    with pytest.raises(Exit) as ended:
        module.main()
    return [*course, ended.value.args[0]]


LINES = '{"op":"param","value":1}\n{"op":"param","value":2}\n'


def test_a_rospy_child_is_a_node_of_the_given_name_until_its_parent_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    course: list[Any] = []
    core = SimpleNamespace(add_preshutdown_hook=course.append)
    rospy = SimpleNamespace(
        name="rospy", core=core, get_name=lambda: "/bench", signal_shutdown=lambda _why: course.append("shut down"),
        init_node=lambda name, **how: course.append((name, how)),
    )  # fmt: skip
    rosgraph = SimpleNamespace(
        is_master_online=lambda: course.append("online?") or True, Master=lambda name: ["of", name]
    )
    monkeypatch.setitem(sys.modules, "rospy", rospy)
    monkeypatch.setitem(sys.modules, "rosgraph", rosgraph)
    done = runs(monkeypatch, ros1_child, LINES)
    assert course == [
        "online?", ("bench", {"disable_signals": True, "anonymous": False}), ros1_child.leave, "shut down",
    ]  # fmt: skip
    assert done == [
        ("bridge", "rospy", ["of", "/bench"]), ("thread", ros1_child.watch_master, (rosgraph, "/bench"), True),
        1, 2, "end", 0,
    ]  # fmt: skip
    assert capsys.readouterr().out == '{"event": "ready", "node": "/bench"}\n'


@pytest.mark.parametrize(("alone", "domain", "ports"), [
    (True, None, [(7400, 7650), (1, 10_000)]), (True, "3", [(8150, 8400), (1, 10_000)]), (False, "3", []),
])  # fmt: skip
def test_an_rclpy_child_is_a_node_of_the_given_name_until_its_parent_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], alone: bool, domain: str | None, ports: Any
) -> None:
    """Its listening sockets are bound to loopback before anything is published."""
    course: list[Any] = []

    class Executor:
        def add_node(self, node: Any) -> None:
            course.append(node.get_name())

        def spin(self) -> None:
            """Never called here."""

        def shutdown(self, seconds: float) -> None:
            course.append(seconds)

    node = SimpleNamespace(get_name=lambda: "bench", destroy_node=lambda: course.append("destroyed"))
    rclpy = SimpleNamespace(
        name="rclpy", init=lambda: course.append("init"), create_node=lambda name: course.append(name) or node,
        shutdown=lambda: course.append("shut down"),
    )  # fmt: skip
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    monkeypatch.setitem(sys.modules, "rclpy.executors", SimpleNamespace(SingleThreadedExecutor=Executor))
    monkeypatch.setattr(rclpy_child, "on_this_machine_alone", lambda: alone)
    monkeypatch.setattr(rclpy_child, "keep_on_loopback", lambda given: course.append((given.start, given.stop)))
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    if domain is not None:
        monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    done = runs(monkeypatch, rclpy_child, LINES)
    assert course == ["init", "bench", *ports, "bench", 1.0, "destroyed", "shut down"]
    (bridge, (thread, spin, _, daemon), *rest) = done
    assert (bridge, thread, spin.__name__, daemon, rest) == (
        ("bridge", "rclpy", node),
        "thread",
        "spin",
        True,
        [1, 2, 0],
    )
    assert capsys.readouterr().out == '{"event": "ready", "node": "bench"}\n'
