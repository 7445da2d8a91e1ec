"""Sinks without their packages and servers: what they send, answer and receive. Every peer here is a mock."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from teds_provision.describe.asset_shell import asset_shell
from teds_provision.errors import TedsProvisionError, UsageError
from teds_provision.measure.blocks import Block, GroupRows, NodeReport
from teds_provision.measure.sinks import base
from teds_provision.measure.sinks.base import ThreadedSink
from teds_provision.measure.sinks.foxglove_server import FoxgloveServer, MeasurementTopics, _listener
from teds_provision.measure.sinks.mqtt import MqttSink
from teds_provision.measure.sinks.ros import child
from teds_provision.measure.sinks.ros.ros1 import Ros1Sink
from teds_provision.measure.sinks.ros.ros2 import Ros2Sink
from tests.measure.sinks.parts import ARM, STATION, block

NONE: Any = None


@pytest.mark.parametrize(
    ("package", "use", "message", "extra"),
    [
        ("paho.mqtt.client", lambda: MqttSink("mqtt://127.0.0.1")._prepare((), STATION),
         "MQTT needs the package paho-mqtt.", "[mqtt]"),
        ("cyclonedds.core", lambda: Ros2Sink("ros2:7")._prepare((), STATION),
         "ROS 2 needs the package cyclonedds.", "[ros2]"),
        ("foxglove", lambda: FoxgloveServer("127.0.0.1:0").start("bench"),
         "Foxglove needs the package foxglove-sdk.", "[foxglove]"),
        ("basyx.aas", lambda: asset_shell(NONE),
         "An Asset Administration Shell needs the package basyx-python-sdk.", "[aas]"),
    ],
)  # fmt: skip
def test_what_needs_a_package_names_it_and_how_it_is_installed(
    monkeypatch: pytest.MonkeyPatch, package: str, use: Any, message: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(TedsProvisionError) as refused:
        use()
    assert refused.value.message == message
    assert refused.value.hint.startswith("Install it: ")
    assert extra in refused.value.hint
    assert isinstance(refused.value, UsageError) == (package in ("foxglove", "basyx.aas"))


@pytest.mark.parametrize("there", [True, False])
def test_a_python_without_rospy_is_refused_with_the_packages_to_install(
    monkeypatch: pytest.MonkeyPatch, there: bool
) -> None:
    asked: list[Any] = []
    monkeypatch.setenv("ROS_MASTER_URI", "http://elsewhere:11311")
    monkeypatch.setattr(child, "imports", lambda *words: bool(asked.append(words)) or there)
    sink = Ros1Sink("ros1:http://bench:11311")
    if there:
        sink._prepare((), STATION)
    else:
        with pytest.raises(TedsProvisionError) as refused:
            sink._prepare((), STATION)
        assert refused.value.message == "/usr/bin/python3 has no rospy."
        assert refused.value.hint == (
            "Install it: apt install python3-rospy python3-sensor-msgs python3-diagnostic-msgs"
        )
    [(python, packages, environment)] = asked
    assert (python, packages) == ("/usr/bin/python3", "rospy, sensor_msgs.msg, diagnostic_msgs.msg")
    assert environment["ROS_MASTER_URI"] == "http://bench:11311"


# -- Foxglove ----------------------------------------------------------------------------------------------------------


def served() -> tuple[FoxgloveServer, Any, list[MeasurementTopics]]:
    """Return a server that does not listen, its listener, and the topics of two measurements."""
    sdk: Any = SimpleNamespace(
        websocket=SimpleNamespace(ServerListener=object, Parameter=lambda name, *, value: (name, value))
    )
    server = FoxgloveServer("127.0.0.1:0")
    server._sdk = sdk
    both = [MeasurementTopics(server), MeasurementTopics(server)]
    server._measurements = both
    return server, _listener(sdk, server), both


def test_a_client_of_foxglove_gets_the_parameters_that_it_names_or_all_and_sets_none() -> None:
    _, listener, (first, second) = served()
    first.parameters, second.parameters = {"/a": "1", "/b": "2"}, {"/c": "3"}
    assert listener.on_get_parameters(None, []) == [("/a", "1"), ("/b", "2"), ("/c", "3")]
    assert listener.on_get_parameters(None, ["/c", "/a", "/x"]) == [("/a", "1"), ("/c", "3")]
    given = [SimpleNamespace(name="/b", value="99")]
    assert listener.on_set_parameters(None, given) == [("/b", "2")]
    assert first.parameters == {"/a": "1", "/b": "2"}


def test_a_late_subscriber_of_foxglove_gets_the_last_facts_of_that_topic_alone() -> None:
    _, listener, (first, second) = served()
    logged: list[tuple[str, bytes]] = []

    def channel(name: str) -> Any:
        return SimpleNamespace(log=lambda message, *, log_time: logged.append((name, message)) or log_time)

    first.channels = {"/arm/teds": channel("first"), "/arm/angle": channel("value")}
    second.channels = {"/arm/teds": channel("second")}
    first.latest, second.latest = {"/arm/teds": b"facts", "/gone/teds": b"old"}, {}
    for topic in ("/arm/teds", "/arm/angle", "/gone/teds", "/x"):
        listener.on_subscribe(None, SimpleNamespace(topic=topic))
    assert logged == [("first", b"facts")]


# -- ROS 2 -------------------------------------------------------------------------------------------------------------


def test_a_dds_domain_that_cannot_be_joined_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    core = pytest.importorskip("cyclonedds.core")
    domain = pytest.importorskip("cyclonedds.domain")

    def full(*_words: Any, **_how: Any) -> None:
        raise core.DDSException(core.DDSException.DDS_RETCODE_OUT_OF_RESOURCES)

    monkeypatch.setenv("CYCLONEDDS_URI", "file:///nowhere.xml")
    monkeypatch.setattr(domain, "DomainParticipant", full)
    with pytest.raises(TedsProvisionError, match=r"^DDS domain 7 cannot be joined: .*\.$") as refused:
        Ros2Sink("ros2:7")._prepare((), STATION)
    assert refused.value.hint == "Check CYCLONEDDS_URI, and that not more than 30 programs use the domain."


def test_a_topic_of_ros_2_that_is_taken_back_is_shown_no_more_and_one_that_never_was_changes_nothing() -> None:
    sink = Ros2Sink("ros2:7")
    sink._writers = {"/arm/teds": object()}
    sink._retire("/leg/teds")
    assert (list(sink._writers), sink._unshown) == (["/arm/teds"], False)
    sink._retire("/arm/teds")
    assert (sink._writers, sink._unshown) == ({}, True)


class Float64(SimpleNamespace):
    """A set point of one channel."""


class JointState(SimpleNamespace):
    """Set points of joints."""


def test_set_points_of_ros_2_go_to_their_channel_or_to_the_joints_that_they_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A sample that DDS cannot read yet is read on the next try."""
    core = pytest.importorskip("cyclonedds.core")
    sink = Ros2Sink("ros2:7")
    sink._types = SimpleNamespace(Float64=Float64, JointState=JointState)
    heard: list[Any] = []
    monkeypatch.setattr(sink, "_command", lambda *words: heard.append(words))
    monkeypatch.setattr(sink, "_joint_command", lambda *words: heard.append(words))
    joints = JointState(name=["a"], position=[1.0], velocity=[2.0], effort=[3.0])
    waits = iter([None, core.DDSException(core.DDSException.DDS_RETCODE_ERROR), None])
    batches = {"/cmd": iter([[Float64(data=1.5), object()], []]), "/joints": iter([[joints], [Float64(data=2.5)]])}
    attached: list[object] = []
    paused: list[float] = []

    class WaitSet:
        def __init__(self, _participant: object) -> None:
            pass

        def attach(self, condition: object) -> None:
            attached.append(condition)

        def wait(self, _span: object) -> None:
            step = next(waits, "end")
            if step == "end":
                sink._ending.set()
            elif step is not None:
                raise step

    def take(topic: str) -> Any:
        return lambda *, N: next(batches[topic], [])

    sink._readers = {
        "/cmd": (SimpleNamespace(take=take("/cmd")), "aa", 3),
        "/joints": (SimpleNamespace(take=take("/joints")), "", 0),
    }
    monkeypatch.setattr(core, "WaitSet", WaitSet)
    monkeypatch.setattr(core, "ReadCondition", lambda reader, _state: reader)
    monkeypatch.setattr("teds_provision.measure.sinks.ros.ros2.time", SimpleNamespace(sleep=paused.append))
    sink._hear()
    assert heard == [("aa", 3, 1.5), (["a"], [1.0], [2.0], [3.0]), ("", 0, 2.5)]
    assert len(attached) == len(sink._attached) == 2, "each reader once"
    assert paused == [0.2]


def test_a_topic_of_set_points_is_read_once_by_whoever_publishes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Best effort, as a reader that asks for less than is offered hears every writer; one thread hears all topics."""
    sub = pytest.importorskip("cyclonedds.sub")
    sink = Ros2Sink("ros2:7")
    readers: list[Any] = []
    started: list[Any] = []
    monkeypatch.setattr(
        sub, "DataReader", lambda _participant, topic, *, qos: readers.append((topic, qos)) or len(readers)
    )
    monkeypatch.setattr(sink, "_topic", lambda kind, name: (kind, name))
    monkeypatch.setattr(sink, "_qos", lambda kind, *, latched, reading=False: (kind, latched, reading))
    thread = lambda target, name, daemon: SimpleNamespace(start=lambda: started.append((target, daemon)))  # noqa: E731
    monkeypatch.setattr("teds_provision.measure.sinks.ros.ros2.threading", SimpleNamespace(Thread=thread))
    for _ in range(2):
        sink._listen("/arm/grip/command", "aa", 3)
        sink._listen_joints("/bench/joint_commands")
    double, joints = "std_msgs/Float64", "sensor_msgs/JointState"
    assert readers == [
        ((double, "rt/arm/grip/command"), (double, False, True)),
        ((joints, "rt/bench/joint_commands"), (joints, False, True)),
    ]
    assert sink._readers == {"/arm/grip/command": (1, "aa", 3), "/bench/joint_commands": (2, "", 0)}
    assert started == [(sink._hear, True)]
    assert sink._unshown


# -- the thread of a sink ----------------------------------------------------------------------------------------------


class DeskSink(ThreadedSink):
    """A sink whose thread is the test's own; ``fails`` is raised by the step of that name."""

    def __init__(self, step: str = "", fails: Exception | None = None) -> None:
        super().__init__("desk")
        self.step, self.fails, self.course = step, fails, list[Any]()

    def _does(self, step: str) -> None:
        self.course.append(step)
        if step == self.step and self.fails is not None:
            raise self.fails

    def _prepare(self, facts: Any, station: Any) -> None:
        """Nothing is checked."""

    def _begin(self) -> None:
        self._does("begin")

    def _process_item(self, item: Any) -> None:
        self._does("item")

    def _finish(self) -> None:
        self._does("finish")


@pytest.mark.parametrize("step", ["begin", "item", "finish"])
@pytest.mark.parametrize(
    ("fails", "error", "hint"),
    [
        (TedsProvisionError("It broke.", hint="Mend it."), "It broke.", "Mend it."),
        (OSError(28, "No space"), "desk cannot be written: the disk is full.", "Free some space"),
        (KeyError("x"), "desk: unexpected KeyError.", "This is a bug: please report it with -vv."),
    ],
)
def test_a_sink_whose_step_fails_is_finished_and_keeps_its_error(
    step: str, fails: Exception, error: str, hint: str
) -> None:
    sink = DeskSink(step, fails)
    sink.write(block())
    sink.close()
    sink.write(block())
    assert len(sink._items) == 1, "nothing more is taken"
    sink._work()
    assert sink.course == {"begin": ["begin", "finish"]}.get(step, ["begin", "item", "finish"])
    assert (sink.stats.state, sink.stats.error) == ("failed", error)
    assert sink.stats.hint.startswith(hint)


def test_a_sink_that_ends_in_order_has_no_error_and_one_that_does_not_end_is_named() -> None:
    sink = DeskSink()
    for _ in range(3):
        sink.write(block())
    sink.close()
    sink._work()
    assert sink.course == ["begin", "item", "item", "item", "finish"]
    assert (sink.stats.state, sink.stats.error, sink._owed) == ("ended", "", 0)
    waited: list[float] = []
    for alive in (False, True):
        late: Any = DeskSink()
        late._thread = SimpleNamespace(join=waited.append, is_alive=lambda alive=alive: alive)
        late.close()
        assert late.stats.error == ("desk did not finish within 30 s." if alive else "")
    assert waited == [30.0, 30.0]


def test_if_facts_alone_wait_for_a_live_sink_the_oldest_go_and_no_value_counts_as_dropped() -> None:
    sink = DeskSink()
    for number in range(257):
        sink.report(NodeReport(ARM, "running", samples=number))
    assert (len(sink._items), sink.stats.dropped) == (256, 0)
    [(oldest,), (newest,)] = [(sink._items[place][2],) for place in (0, -1)]
    assert [report.samples for report in (oldest, newest) if isinstance(report, NodeReport)] == [1, 256]


def test_a_recorder_takes_up_to_64_items_at_a_time_and_a_live_sink_one() -> None:
    for recorder, taken in ((True, [64, 36]), (False, [1, 1])):
        sink = DeskSink()
        sink.recorder = recorder
        for number in range(100):
            sink.report(NodeReport(ARM, "running", samples=number))
        found = [sink._next() for _ in range(2)]
        assert [(len(items), done) for items, done in found] == [(count, False) for count in taken]
        sink.close()
        while sink._items:
            sink._next()
        assert sink._next() == ([], True)


def test_what_was_read_of_a_sink_does_not_change_with_it() -> None:
    sink = DeskSink()
    before = sink.stats
    sink._count(written=5, dropped=2, octets=7, messages=1)
    assert (before.written, before.dropped, before.octets, before.messages) == (0, 0, 0, 0)
    after = sink.stats
    assert (after.written, after.dropped, after.octets, after.messages) == (5, 2, 7, 1)


def test_the_oldest_rows_go_as_the_oldest_blocks_do_and_facts_before_them_stay() -> None:
    sink = DeskSink()
    rows = GroupRows("all", ((ARM, 1),), np.array([1.0, 2.0]), np.ones((2, 1)), np.zeros((2, 1)))
    sink.wants_rows = True
    sink.report(NodeReport(ARM, "running"))
    sink.write_group(rows)
    sink.write(block())
    sink._owed = 10
    sink._drop_oldest()
    left = [type(item) for _, _, item in sink._items]
    assert left == [NodeReport, Block]
    values = sink.stats.dropped
    assert (values > 0, sink._owed) == (True, 10 - values)


def test_a_topic_of_foxglove_has_one_channel_that_each_measurement_has_a_part_in() -> None:
    server, _, (first, second) = served()
    made: list[Any] = []

    def channel(topic: str, **how: Any) -> Any:
        made.append((topic, how["schema"], how["message_encoding"], how["metadata"]))
        return SimpleNamespace(topic=topic)

    server._sdk.Schema = lambda **how: how
    server._sdk.Channel = channel
    one, other = (server.channel(topics, "/a", "k/K", "float64 x", {"unit": "rad"}) for topics in (first, second))
    assert one is other
    schema = {"name": "k/K", "encoding": "ros2msg", "data": b"float64 x"}
    assert made == [("/a", schema, "cdr", {"unit": "rad"})]
    assert first.channels == second.channels == {"/a": one}


@pytest.mark.parametrize("recorder", [False, True])
def test_a_live_sink_rests_when_nothing_waits_and_every_sink_looks_at_the_clock_while_items_come(
    monkeypatch: pytest.MonkeyPatch, recorder: bool
) -> None:
    now, rested, looked = [0.0], list[float](), list[float]()
    turns: Any = iter([(["a"], False), (["b"], False), ([], True)])

    def take(_item: Any) -> None:
        now[0] += 0.6 * base.TICK

    monkeypatch.setattr(base, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=rested.append))
    made: Any = SimpleNamespace(
        recorder=recorder, _items=(), _closing=False, _next=lambda: next(turns), _guarded_item=take,
        _guarded_idle=looked.append,
    )  # fmt: skip
    ThreadedSink._run(made)
    assert rested == ([] if recorder else [base.LIVE_REST] * 2)
    assert looked == [pytest.approx(1.2 * base.TICK)] * 2
