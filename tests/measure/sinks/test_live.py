"""Names of topics, which message fits a channel, and when what goes out; the carriers have tests of their own."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.errors import UsageError
from teds_provision.measure.blocks import (
    ECHO,
    Block,
    ChannelFacts,
    ClockSet,
    GroupRows,
    InvalidValues,
    NodeReport,
    SetPointCommand,
    StationFacts,
    why_invalid,
)
from teds_provision.measure.sinks import live, names
from teds_provision.measure.sinks.base import LIVE_WAITING, ROWS
from teds_provision.measure.sinks.joints import joints_of, state_of
from teds_provision.measure.sinks.live import ERROR, JOINT_STATE, OK, WARN, DiagnosticEntry, TopicSink
from teds_provision.measure.sinks.names import Topics, slug
from teds_provision.measure.sinks.vectors import (
    VARIANCE_NOTE,
    FieldValue,
    Meaning,
    compounds_of,
    is_range,
    meaning_of,
    variance_of,
)
from teds_provision.teds.calibration.formula import evaluate
from teds_provision.teds.calibration.model import Calibration, CalibrationInput
from teds_provision.teds.calibration.plain import calibration_from_json
from teds_provision.teds.units import parse_unit, parse_units
from tests.measure.sinks.parts import ANGLE, ARM, FORCE, HAND, STATION, block, fill

ROS_TOPIC = re.compile(r"/[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")


@given(st.text(), st.text(), st.text())
def test_any_names_make_a_topic_that_ros_takes(station: str, node: str, channel: str) -> None:
    topics = Topics(StationFacts(station))
    topics.learn([ChannelFacts(ARM, node, 3, channel)])
    topic = topics.channel(ARM, 3)
    assert ROS_TOPIC.fullmatch(topic)
    assert "__" not in topic
    assert all(not part.endswith("_") for part in topic.split("/"))
    assert len(topic.split("/")) == 4


def test_namesakes_get_topics_of_their_own() -> None:
    topics = Topics(STATION)
    topics.learn([ANGLE, replace(ANGLE, number=2), replace(FORCE, node="Arm"), replace(ANGLE, number=3, name="")])
    names = {topics.channel(*key) for key in ((ARM, 1), (ARM, 2), (ARM, 3), (HAND, 2))}
    assert len(names) == 4, names


def test_a_node_has_its_name_before_it_was_asked() -> None:
    """Its state is told while it is waited for: under the same topic, in MQTT for ever, as later."""
    topics = Topics(replace(STATION, nodes={ARM: "arm", HAND: "Arm"}))
    assert {topics.node(ARM), topics.node(HAND)} == {f"arm_{ARM}", f"arm_{HAND}"}
    topics.learn([replace(ANGLE, node="arm"), replace(FORCE, node="Arm")])
    assert {topics.node(ARM), topics.node(HAND)} == {f"arm_{ARM}", f"arm_{HAND}"}
    assert Topics(replace(STATION, nodes={ARM: "arm", HAND: ""})).node(ARM) == "arm"


def test_a_chosen_name_goes_before_a_made_one_and_must_be_one() -> None:
    topics = Topics(replace(STATION, names={(ARM, 1): "crane/boom", (HAND, 0): "gripper"}))
    topics.learn([ANGLE, FORCE])
    assert topics.channel(ARM, 1) == "/crane/boom"
    assert topics.channel(HAND, 2) == "/bench/gripper/force"
    for wrong in ("two words", "a__b", "9lives", "end_", ""):
        with pytest.raises(UsageError):
            Topics(replace(STATION, names={(ARM, 1): wrong}))


WORDS = st.sampled_from(
    ["arm", "Arm", "arm_8d4d9da6", "n8d4d9da6", "hand", "all", "reports", "status", "", "angle", "angle_2", "angle_ch2",
     "ch1", "ch2", "teds", "imu", "imu_2", "stream_0", "state", "cmd", "age", "bench", "wrench_1", "unverified"]
)  # fmt: skip
UUIDS = ["8d4d9da65281f7000001", "8d4d9da65281f7000002", "8d4d9da75281f7000003", "0123456789abcdef0000"]
CHOSEN = st.sampled_from(
    ["arm", "hand", "bench/arm/angle", "bench/arm/angle_2", "bench/hand/ch2", "bench/arm/imu", "bench/hand",
     "bench/all", "crane/boom", "bench/arm/angle/cmd", "diagnostics", "angle", "n8d4d9da6", "arm_8d4d9da6",
     "bench/reports", "status", "bench/arm_8d4d9da6/angle", "bench/hand/age", "bench/all/age"]
)  # fmt: skip
NODES = st.dictionaries(st.sampled_from(UUIDS), WORDS, min_size=2)
CHANNELS = st.dictionaries(
    st.tuples(st.sampled_from(UUIDS), st.sampled_from([1, 2, 3, 12])), WORDS, min_size=2, max_size=10
)
WISHES = st.lists(st.tuples(st.sampled_from(UUIDS), st.sampled_from([0, 1, 2, 3]), CHOSEN), max_size=6)


@settings(max_examples=300, deadline=None)
@given(nodes=NODES, channels=CHANNELS, wishes=WISHES, measured=st.sets(st.sampled_from(UUIDS), min_size=1))
def test_no_two_topics_are_equal_whatever_was_chosen_and_made(
    nodes: dict[str, str], channels: dict[tuple[str, int], str], wishes: list[tuple[str, int, str]], measured: set[str]
) -> None:
    """Also: a measurement of some nodes, of some of their channels, makes the very names that /names shows."""
    facts = []
    for (uuid, number), name in channels.items():
        if uuid in nodes:
            siblings = tuple((other, text) for (whose, other), text in channels.items() if whose == uuid)
            facts.append(ChannelFacts(uuid, nodes[uuid], number, name, siblings=siblings))
    station = StationFacts("bench", nodes=nodes)
    for uuid, number, name in wishes:
        there = uuid in nodes and (not number or (uuid, number) in channels)
        if not there or name in station.names.values() or (not number and "/" in name):
            continue  # as store and command refuse it
        now = Topics(station)
        now.learn(facts)
        with suppress(UsageError):
            now.require_free(uuid, number, name)
            station = replace(station, names={**station.names, (uuid, number): name})
    topics = Topics(station)
    topics.learn(facts)
    every = [topics.channel(*channel_facts.key) for channel_facts in facts]
    every += [f"{topic}/cmd" for topic in every]
    of_nodes = ("teds", "state", "imu", "imu_2", "magnetic_field", "wrench", "wrench_1", "stream_0")
    every += [topics.of_node(uuid, what) for uuid in nodes for what in of_nodes]
    every += [f"/bench/{topics.node(uuid)}" for uuid in nodes]
    every += ["/bench/reports", "/bench/status", "/bench/all", "/bench/all/age", "/diagnostics"]
    assert sorted(every) == sorted(set(every))
    some = Topics(station)
    some.learn(
        [channel_facts for channel_facts in facts if channel_facts.uuid in measured and channel_facts.number != 2]
    )
    mine = [channel_facts for channel_facts in facts if channel_facts.uuid in measured and channel_facts.number != 2]
    assert [some.channel(*facts.key) for facts in mine] == [topics.channel(*facts.key) for facts in mine]
    assert all(some.node(uuid) == topics.node(uuid) for uuid in measured & nodes.keys())


def test_who_is_named_as_a_namesake_is_published_never_gets_its_topics() -> None:
    """A running measurement keeps its topics when the other namesake goes, and a third one may then be called so."""
    arm, other, third = "8d4d9da65281f7000001", "0123456789abcdef0000", "8d4d9da75281f7000003"
    running = Topics(StationFacts("bench", nodes={arm: "arm", other: "arm"})).node(arm)
    later = Topics(StationFacts("bench", nodes={arm: "arm", third: running}))
    assert running == f"arm_{arm[:8]}"
    assert later.node(third) == f"{running}_{third[:8]}"
    assert Topics(StationFacts("bench", nodes={third: "crane_20260101"})).node(third) == "crane_20260101"


def test_a_stranger_takes_no_name_of_a_node_that_is_known() -> None:
    topics = Topics(replace(STATION, nodes={ARM: "arm"}))
    topics.learn([ANGLE, replace(FORCE, node="arm")])
    assert topics.node(ARM) == "arm"
    assert topics.node(HAND) != "arm"


def test_words_become_plain_letters() -> None:
    assert slug("Drehwinkel (Größe)") == "drehwinkel_grosse"
    assert slug("3. axis") == "n_3_axis"
    assert slug("角度") == ""


@pytest.mark.parametrize(
    ("unit", "name", "quantity", "type_"),
    [
        ("degC", "oil", "", "sensor_msgs/Temperature"),
        ("kPa", "supply", "", "sensor_msgs/FluidPressure"),
        ("MPa", "shear stress", "", "std_msgs/Float64"),
        ("MPa", "tensile strength", "", "std_msgs/Float64"),
        ("GPa", "Young's modulus", "", "std_msgs/Float64"),
        ("kPa", "ch1", "wall_stress", "std_msgs/Float64"),
        ("lx", "light", "", "sensor_msgs/Illuminance"),
        ("%", "relative_humidity", "", "sensor_msgs/RelativeHumidity"),
        ("%", "ch1", "relative-humidity", "sensor_msgs/RelativeHumidity"),
        ("1", "relative humidity", "", "sensor_msgs/RelativeHumidity"),
        ("dB", "relative humidity", "", "std_msgs/Float64"),
        ("digital", "relative humidity, alarm", "", "std_msgs/Float64"),
        ("arbitrary", "relative humidity", "", "std_msgs/Float64"),
        ("%", "humidity", "", "std_msgs/Float64"),
        ("degC", "relative humidity, its sensor", "", "sensor_msgs/Temperature"),
        ("%", "throttle", "", "std_msgs/Float64"),
        ("m", "height", "", "std_msgs/Float64"),
        ("degree", "angle", "", "std_msgs/Float64"),
        ("N", "force", "", "std_msgs/Float64"),
        ("count", "steps", "", "std_msgs/Float64"),
    ],
)
def test_a_typed_message_only_if_unit_and_meaning_fit(unit: str, name: str, quantity: str, type_: str) -> None:
    facts = ChannelFacts(ARM, "arm", 1, name, units=parse_units(unit), quantity=quantity)
    assert meaning_of(facts).type == type_
    assert meaning_of(replace(facts, kind="actuator")).type == "std_msgs/Float64"


def test_a_temperature_goes_out_in_degrees_celsius_with_its_variance() -> None:
    facts = ChannelFacts(ARM, "arm", 1, "oil", unit="K", units=parse_units("K"), uncertainty=0.3)
    assert meaning_of(facts).field_value(293.15) == pytest.approx(20.0)
    assert variance_of(facts) == pytest.approx(0.03)
    assert variance_of(replace(facts, uncertainty=None)) == 0.0, "0 means unknown"


def axes(unit: str, first: int, **more: Any) -> list[ChannelFacts]:
    """Return three channels that the Meta-TEDS calls one vector."""
    members = (first, first + 1, first + 2)
    return [
        ChannelFacts(ARM, "arm", n, f"c{n}", units=parse_units(unit), uncertainty=0.3, vector=members, **more)
        for n in members
    ]


def test_a_vector_group_is_one_message_if_its_unit_tells_what_it_is() -> None:
    def kinds(*facts: ChannelFacts) -> list[tuple[str, str]]:
        return [(compound.type, compound.name) for compound in compounds_of(facts)]

    assert kinds(*axes("T", 1)) == [("sensor_msgs/MagneticField", "magnetic_field")]
    assert kinds(*axes("m/s^2", 1)) == [("sensor_msgs/Imu", "imu")]
    assert kinds(*axes("rad/s", 1)) == [("sensor_msgs/Imu", "imu")]
    assert kinds(*axes("m/s^2", 1), *axes("rad/s", 4)) == [("sensor_msgs/Imu", "imu")]
    assert kinds(*axes("m/s^2", 1), *axes("m/s^2", 4)) == [("sensor_msgs/Imu", "imu_1"), ("sensor_msgs/Imu", "imu_4")]
    assert kinds(*axes("N", 1), *axes("N m", 4)) == [("geometry_msgs/WrenchStamped", "wrench")]
    assert kinds(*axes("N", 1)) == [], "a force alone is no wrench"
    assert kinds(*axes("degC", 1)) == [], "three temperatures are no vector that ROS has a message for"
    assert kinds(*axes("T", 1)[:2]) == [], "an axis is not in the stream"
    assert kinds(*(replace(facts, vector=()) for facts in axes("T", 1))) == [], "nobody said that they are one vector"
    assert kinds(*axes("T", 1)[:2], *axes("m/s^2", 1)[2:]) == [], "axes of two units"
    assert kinds(*axes("m/s^2", 1, kind="actuator")) == []


def test_half_a_vector_is_none() -> None:
    [imu] = compounds_of(axes("m/s^2", 1))
    assert imu.fields({1: 1.0, 2: float("nan"), 3: 3.0}) is None
    fields = imu.fields({1: 1.0, 2: 2.0, 3: 3.0})
    assert fields is not None
    assert fields["linear_acceleration.y"] == 2.0
    assert fields["angular_velocity_covariance"] == fields["orientation_covariance"] == [-1.0, *[0.0] * 8]


def test_a_range_finder_is_one_by_name_and_has_no_plain_number_beside() -> None:
    facts = ChannelFacts(ARM, "arm", 1, "range finder", units=parse_units("m"), low=0.5, high=8.0)
    assert is_range(facts)
    assert [is_range(replace(facts, name=name)) for name in ("Rangefinder", "distance_sensor", "Range-Finder 2")] == [
        True
    ] * 3
    assert not is_range(replace(facts, name="height"))
    assert is_range(replace(facts, name="height", quantity="range_finder")), "its profile calls it so"
    assert not is_range(replace(facts, kind="actuator"))
    assert not is_range(replace(facts, units=parse_units("s")))
    sink = carried([block([[10]])], facts=[facts])
    assert sink.scalars == []
    [(topic, kind, fields)] = sink.compounds
    assert (topic, kind) == ("/bench/arm/range_finder", "sensor_msgs/Range")
    assert (fields["range"], fields["min_range"], fields["max_range"]) == (1.0, 0.5, 8.0)


class Carrier(TopicSink):
    """Keeps what went out."""

    def __init__(self, commands: list[SetPointCommand] | None = None) -> None:
        super().__init__("carrier", None if commands is None else commands.append)
        self.arrays: list[tuple[str, float, list[str], list[float]]] = []
        self.scalars: list[tuple[str, str, float, float]] = []
        self.frames: set[str] = set()
        self.frame_of_a_vector = ""
        self.joints: list[tuple[list[str], list[float], list[float], list[float]]] = []
        self.compounds: list[tuple[str, str, Mapping[str, FieldValue]]] = []
        self.words: dict[str, str] = {}
        self.parameters: dict[str, object] = {}
        self.listens: list[tuple[str, str, int]] = []
        self.statuses: list[DiagnosticEntry] = []
        self.advertised: list[tuple[str, str]] = []

    def _advertise(self, topic: str, kind: str) -> None:
        self.advertised.append((topic, kind))

    def _array(
        self,
        topic: str,
        stamp: float,
        names: Sequence[str],
        values: Sequence[float],
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
    ) -> None:
        if topic.endswith("joint_states"):
            self.joints.append((list(names), list(values), list(velocity), list(effort)))
        else:
            self.arrays.append((topic, stamp, list(names), list(values)))

    def _scalar(self, topic: str, meaning: Meaning, stamp: float, frame: str, value: float, variance: float) -> None:
        self.scalars.append((topic, meaning.type, value, variance))
        self.frames.add(frame)

    def _fields(self, topic: str, kind: str, stamp: float, frame: str, fields: Mapping[str, FieldValue]) -> None:
        self.compounds.append((topic, kind, fields))
        self.frames.add(frame)
        self.frame_of_a_vector = frame

    def _latched(self, topic: str, words: str) -> None:
        self.words[topic] = words

    def _retire(self, topic: str) -> None:
        del self.words[topic]

    def _parameter(self, name: str, value: object) -> None:
        self.parameters[name] = value

    def _listen(self, topic: str, uuid: str, channel: int) -> None:
        self.listens.append((topic, uuid, channel))

    def _listen_joints(self, topic: str) -> None:
        self.listens.append((topic, "", 0))

    def _diagnose(self, stamp: float, statuses: Sequence[DiagnosticEntry]) -> None:
        self.statuses = list(statuses)

    def _finish(self) -> None:
        self._second = 0.0
        self._idle(time.monotonic())


def carried(
    items: Sequence[Block | GroupRows | NodeReport | list[ChannelFacts]],
    facts: Sequence[ChannelFacts] = (ANGLE, FORCE),
    station: StationFacts = STATION,
    commands: list[SetPointCommand] | None = None,
) -> Carrier:
    sink = Carrier(commands)
    sink.open(facts, station)
    fill(sink, items)
    return sink


def test_scalars_go_out_at_their_rate_with_the_newest_value() -> None:
    sink = carried([block([[k], [k + 1]]) for k in range(50)], station=replace(STATION, scalar_rate=0.5))
    assert sink.scalars == [("/bench/arm/angle", "std_msgs/Float64", pytest.approx(0.1), pytest.approx(0.0087**2 / 3))]
    assert carried([block()], station=replace(STATION, scalar_rate=0)).scalars == []


@pytest.mark.parametrize(("rate", "messages"), [(10.0, 30), (20.0, 60), (1e6, 101)])
def test_the_rate_of_scalars_is_kept_on_average_whatever_the_beat_of_the_blocks(
    monkeypatch: pytest.MonkeyPatch, rate: float, messages: int
) -> None:
    """A block each 30 ms for 3 s: counted from the last message, 10 Hz became 8.3 Hz, as each waits for a block."""
    now = [100.0]
    monkeypatch.setattr(live, "time", SimpleNamespace(monotonic=lambda: now[0], time=time.time))
    sink = Carrier()
    sink.open([ANGLE], replace(STATION, scalar_rate=rate))
    for number in range(101):
        now[0] = 100.0 + 0.03 * number
        sink._block(block([[number]], channels=(1,)))
    assert len(sink.scalars) == pytest.approx(messages, abs=1)
    now[0] += 60  # a long silence is not made up for
    before = len(sink.scalars)
    for number in range(5):
        now[0] += 0.0001
        sink._block(block([[number]], channels=(1,)))
    assert len(sink.scalars) - before == (5 if rate > 1e5 else 1)


def test_an_invalid_value_has_no_scalar_message_and_is_nan_in_the_array() -> None:
    rows = GroupRows(
        "crane", ((ARM, 1), (HAND, 2)), np.array([1.0]), np.array([[1.0, np.nan]]), np.array([[0.0, np.nan]])
    )
    sink = carried([block([[1]], valid=[[False]]), rows])
    assert sink.scalars == []
    [(topic, stamp, names, values), (ages, *_)] = sink.arrays
    assert (topic, ages) == ("/bench/crane", "/bench/crane/age")
    assert (stamp, names) == (1.0, ["arm/angle", "hand/force"])
    assert values[0] == 1.0
    assert np.isnan(values[1])


def test_each_channel_has_its_own_frame_and_the_deviation_of_its_profile() -> None:
    tip = replace(ANGLE, frame="{node}_tip", deviation=0.002)
    base = [replace(facts, frame="base") for facts in axes("m/s^2", 4)]
    sink = carried([block([[1, 2, 3, 4]], channels=(1, 4, 5, 6))], facts=[tip, *base])
    assert sink.frames == {"arm_tip", "base"}
    apart = [replace(facts, frame=f"axis_{facts.number}") for facts in base]
    vector = carried([block([[2, 3, 4]], channels=(4, 5, 6))], facts=apart)
    [(_, kind, _)] = vector.compounds
    assert (kind, vector.frame_of_a_vector) == ("sensor_msgs/Imu", "axis_4"), "that of its first channel"
    [angle] = [pair for pair in sink.scalars if pair[0] == "/bench/arm/angle"]
    assert angle[3] == pytest.approx(0.002**2), "the standard deviation goes before the worst case"


def gripper() -> list[ChannelFacts]:
    """Return an opening that is commanded and measured, and the force of the grip."""
    opening = replace(FORCE, unit="m", units=parse_units("m"))
    return [
        replace(opening, number=1, name="opening set point", kind="actuator"),
        replace(opening, number=2, name="opening"),
        replace(FORCE, number=3, name="grip force", units=parse_units("N")),
    ]


def test_a_gripper_is_a_joint_whose_state_goes_out_and_whose_set_points_come_in() -> None:
    keys = ((HAND, 2), (HAND, 3))
    rows = GroupRows("crane", keys, np.array([1.0, 2.0]), np.array([[0.05, 4.0], [np.nan, 5.0]]), np.zeros((2, 2)))
    came: list[SetPointCommand] = []
    sink = carried([rows], facts=[ANGLE, *gripper()], commands=came)
    assert sink.joints == [(["hand"], [0.05], [], [4.0])], "without a position there is no state"
    assert ("/bench/joint_states", "sensor_msgs/JointState") in sink.advertised
    assert ("/bench/joint_commands", "", 0) in sink.listens
    sink._joint_command(["stranger", "hand"], [9.0, 0.02], [], [])
    sink._joint_command(["hand"], [], [1.0], [])
    sink._joint_command(["hand"], [float("nan")], [], [])
    assert [(command.uuid, command.channel, command.value) for command in came] == [(HAND, 1, 0.02)]
    assert sink.refused_commands == 3


@pytest.mark.parametrize("each_node", [False, True])
def test_the_set_point_that_was_applied_is_the_state_of_a_joint_without_a_sensor(each_node: bool) -> None:
    """It had no state at all, unless another of its sensors was of a joint, too."""
    actuator, *_ = gripper()
    warm = replace(FORCE, name="motor", units=parse_units("K"))
    station = replace(STATION, each_node=each_node)

    def row(stamp: float, group: str, key: tuple[str, int]) -> GroupRows:
        value = np.array([[3.0]])
        return GroupRows(group if each_node else "crane", (key,), np.array([stamp]), value, 0 * value)

    applied = replace(block([[7]], [[0.05]], uuid=HAND), stream=ECHO)
    items = [row(1.0, HAND, (HAND, 2)), applied, row(2.0, ARM, (ARM, 1)), row(3.0, HAND, (HAND, 2))]
    sink = carried(items, facts=[ANGLE, actuator, warm], station=station)
    assert sink.joints == [(["hand"], [0.05], [], [])] * (1 if each_node else 2), "with the rows of its own node"


@pytest.mark.parametrize("each_node", [False, True])
@pytest.mark.parametrize("scalar_rate", [0.0, 50.0])
def test_a_joint_of_a_node_without_sensors_has_its_state_with_each_set_point(
    each_node: bool, scalar_rate: float
) -> None:
    """Such a node sends no rows, with which states went out; without scalars the set point was not even kept."""
    actuator, *_ = gripper()
    station = replace(STATION, each_node=each_node, scalar_rate=scalar_rate)

    def applied(stamp: float, value: float) -> Block:
        return replace(block([[7]], [[value]], uuid=HAND), stream=ECHO, time=np.array([stamp]))

    sink = carried(
        [applied(1.0, 0.05), applied(1.0 + 0.5 / ROWS, 0.06), applied(2.0, 0.07)], facts=[actuator], station=station
    )
    assert sink.joints == [(["hand"], [value], [], []) for value in (0.05, 0.07)], "not above the rate of rows"


@pytest.mark.parametrize(
    ("unit", "interface"),
    [("rad", "position"), ("m", "position"), ("rad/s", "velocity"), ("m/s", "velocity"), ("N", "effort"),
     ("N m", "effort"), ("K", None), ("m/s^2", None)],
)  # fmt: skip
def test_a_joint_is_commanded_by_what_its_unit_says_and_by_nothing_else(unit: str, interface: str | None) -> None:
    came: list[SetPointCommand] = []
    sink = carried([], facts=[replace(gripper()[0], units=parse_units(unit))], commands=came)
    assert [joint.command for joint in sink._joints] == ([interface] if interface else [])
    numbers = {"position": 0.01, "velocity": 0.02, "effort": 0.03}
    sink._joint_command(["hand"], *([number] for number in numbers.values()))
    assert [command.value for command in came] == ([numbers[interface]] if interface else [])
    unsigned = [replace(facts, unsigned=True) for facts in gripper()]
    assert joints_of(unsigned, Topics(STATION)) == []


def test_sensors_alone_are_no_joint_and_their_owner_is_not_guessed() -> None:
    topics = Topics(STATION)
    assert joints_of([ANGLE, FORCE], topics) == []
    second = replace(gripper()[0], number=4, name="thumb")
    joints = joints_of([*gripper(), second], topics)
    assert [(joint.actuator, dict(joint.state)) for joint in joints] == [(1, {}), (4, {})]
    assert len({joint.name for joint in joints}) == 2
    twice = [*gripper(), replace(gripper()[1], number=5, name="opening, coarse")]
    assert [dict(joint.state) for joint in joints_of(twice, topics)] == [{"effort": 3}], "which of them is not known"


def test_sensors_belong_to_actuators_in_the_order_of_their_numbers_however_they_came() -> None:
    actuator, position, force = gripper()
    second = [
        replace(facts, number=facts.number + 3, name=f"thumb {facts.name}") for facts in (actuator, position, force)
    ]
    first = [actuator, position, force]
    wanted = [(1, {"position": 2, "effort": 3}), (4, {"position": 5, "effort": 6})]
    crossed = [first[0], second[0], second[1], first[1], first[2], second[2]]
    for facts in ([*first, *second], [*second, *first], crossed, crossed[::-1]):
        joints = joints_of(facts, Topics(STATION))
        assert sorted((joint.actuator, dict(joint.state)) for joint in joints) == wanted


def test_the_datasheet_is_on_a_topic_whole() -> None:
    curve = Calibration(
        1, "linear", (CalibrationInput(1, 1, (0.0, 65535.0), (0.0,)),), (0.5, 0.25), parse_unit("degree")
    )
    facts = replace(ANGLE, units=parse_units("rad"), own_period=1e-4, deviation=0.002, calibration=curve)
    sheet = json.loads(carried([], facts=[facts]).words["/bench/arm/teds"])
    [channels] = sheet["channels"]
    assert (channels["low"], channels["high"], channels["unit"], channels["uncertainty"]) == (
        0.0,
        6.283185,
        "rad",
        0.0087,
    )
    assert (channels["deviation"], channels["own_period"], channels["due"]) == (0.002, 1e-4, "2027-03-01")
    assert channels["calibration"]["method"] == "linear"
    assert channels["calibration"]["coefficients"] == [0.5, 0.25]
    again = calibration_from_json(channels["calibration"], 1, parse_units("rad"))
    assert evaluate(again, 100.0).value == evaluate(curve, 100.0).value


def test_a_node_under_another_name_leaves_no_datasheet_under_the_old_one() -> None:
    renamed = replace(ANGLE, chosen=((0, "left_arm"),))
    sink = carried([[renamed]], facts=[replace(ANGLE, chosen=())])
    assert list(sink.words) == ["/bench/left_arm/teds"]


def test_a_namesake_that_joins_leaves_each_datasheet_under_the_name_that_its_node_has_now() -> None:
    other = "f" * 20
    sink = carried([[replace(ANGLE, uuid=other)]], facts=[ANGLE], station=replace(STATION, nodes={}))
    assert list(sink.words) == [f"/bench/arm_{other[:8]}/teds", f"/bench/arm_{ARM[:8]}/teds"]


def test_what_is_announced_anew_is_what_changed_and_every_channel_of_a_node_with_another_name() -> None:
    second, other = replace(ANGLE, number=2, name="speed"), replace(ANGLE, uuid="f" * 20)
    sink = carried([], facts=[ANGLE, second, FORCE], station=replace(STATION, nodes={}))
    assert sink._learn((ANGLE, FORCE)) == []
    warmer = replace(ANGLE, high=7.0)
    assert sink._learn((warmer, second)) == [warmer]
    assert sink._learn((other,)) == [other, warmer, second], "two nodes of one name: the first gets another one, too"
    named = replace(other, chosen=((0, "left_arm"),))
    assert sink._learn((named,))[0] == named
    assert len(sink._learn((replace(named, low=0.5),))) == 1


def test_an_unsigned_datasheet_is_reported_in_diagnostics_and_metadata() -> None:
    bare = ChannelFacts(ARM, "arm", 1, "angle", unsigned=True)
    sink = carried([block([[1]], [[np.nan]], [[False]])], facts=[bare, FORCE])
    assert sink.scalars == []
    assert json.loads(sink.words["/bench/arm/teds"])["channels"][0]["unsigned"] is True
    assert "unsigned" not in json.loads(sink.words["/bench/hand/teds"])["channels"][0]
    [diagnostic] = [diagnostic for diagnostic in sink.statuses if diagnostic.message.startswith("unsigned:")]
    assert (diagnostic.level, diagnostic.hardware) == (1, ARM)


def test_rows_faster_than_a_thousand_a_second_are_thinned_out() -> None:
    times = np.arange(100) / 10_000
    rows = GroupRows("crane", ((ARM, 1),), times, np.ones((100, 1)), np.zeros((100, 1)))
    assert len({stamp for _, stamp, _, _ in carried([rows]).arrays}) == 10


def test_the_array_is_there_before_its_first_row_but_none_for_a_test_pattern() -> None:
    assert carried([]).advertised == [("/bench/crane", JOINT_STATE), ("/bench/crane/age", JOINT_STATE)]
    assert carried([], station=replace(STATION, test_pattern=True)).advertised == []
    joints = carried([], facts=gripper(), station=replace(STATION, test_pattern=True), commands=[])
    assert (joints.advertised, joints.listens[1:]) == ([], []), "nor of joints"


def test_a_test_pattern_reaches_no_topic() -> None:
    rows = GroupRows("crane", ((ARM, 1),), np.array([1.0]), np.array([[1.0]]), np.array([[0.0]]), test_pattern=True)
    sink = carried([block(valid=[[False]] * 3, test_pattern=True), rows])
    assert sink.scalars == sink.arrays == []


def test_metadata_and_parameters_say_what_the_datasheet_says() -> None:
    sink = carried([])
    words = json.loads(sink.words["/bench/arm/teds"])
    assert words["channels"][0]["topic"] == "/bench/arm/angle"
    assert words["channels"][0]["fingerprint"] == "ab" * 32
    assert sink.parameters["/bench/arm/angle"] == {k: v for k, v in words["channels"][0].items() if k != "topic"}


def test_the_metadata_of_a_node_are_held_whole() -> None:
    """What is not known is left out; the frame has the node's name in it."""
    bare = ChannelFacts(ARM, "arm", 2, "", frame="{node}_base")
    sink = carried([], facts=[bare], station=replace(STATION, test_pattern=True))
    assert json.loads(sink.words["/bench/arm/teds"]) == {
        "uuid": ARM,
        "station": "bench",
        "clock": STATION.clock,
        "test_pattern": True,
        "variance": VARIANCE_NOTE,
        "channels": [
            {
                "uuid": ARM, "node": "arm", "number": 2, "kind": "sensor", "frame": "arm_base",
                "topic": "/bench/arm/ch2",
            }
        ],
    }  # fmt: skip


def test_only_actuators_listen_and_only_if_commands_are_accepted() -> None:
    grip = replace(FORCE, kind="actuator")
    assert carried([], [ANGLE, grip], commands=[]).listens == [("/bench/hand/force/cmd", HAND, 2)]
    assert carried([], [ANGLE, grip]).listens == []
    assert carried([], gripper()).listens == [], "a joint that may not be moved has a state alone"


def test_a_command_that_is_no_number_moves_nothing() -> None:
    commands: list[SetPointCommand] = []
    sink = Carrier(commands)
    for value in (float("nan"), float("inf"), 1.5):
        sink._command(HAND, 2, value)
    assert [command.value for command in commands] == [1.5]
    assert sink.refused_commands == 2


@pytest.mark.parametrize(
    ("report", "level"),
    [
        (NodeReport(ARM, "running"), OK),
        (NodeReport(ARM, "running", lost=1), WARN),
        (NodeReport(ARM, "running", "its clock is inconsistent"), WARN),
        (NodeReport(ARM, "waiting"), WARN),
        (NodeReport(ARM, "lost", "no frame for 1 s"), ERROR),
        (NodeReport(ARM, "refused", "another key"), ERROR),
    ],
)
def test_diagnostics_report_what_is_wrong(report: NodeReport, level: int) -> None:
    sink = carried([report], [replace(ANGLE, overdue=True, due="2026-01-01")])
    status, overdue, own = sink.statuses
    assert status.level == level
    assert status.message == (report.why or report.state)
    assert overdue.level == WARN
    assert "2026-01-01" in overdue.message
    assert own.hardware == "bench"


def test_a_slow_carrier_loses_the_oldest_and_says_how_much() -> None:
    class SlowCarrier(Carrier):
        def _scalar(self, *_: object) -> None:
            time.sleep(0.3)

    sink = SlowCarrier()
    sink.open([ANGLE], replace(STATION, scalar_rate=1e6))
    for k in range(600):
        sink.write(block([[k]], index=k))
    dropped = sink.stats.dropped
    sink._closing = True
    sink._items.clear()
    sink.close()
    assert dropped >= 300


@pytest.mark.parametrize(("rate", "every"), [(1000, 1), (2000, 2)])
def test_a_thousand_rows_a_second_go_out_and_no_more(rate: int, every: int) -> None:
    times = 1_800_000_000 + np.arange(100) / rate
    rows = GroupRows("crane", ((ARM, 1),), times, np.zeros((100, 1)), np.zeros((100, 1)))
    sink = carried([rows])
    assert [stamp for topic, stamp, *_ in sink.arrays if topic == "/bench/crane"] == times[::every].tolist()


def test_a_name_that_others_wish_for_is_given_to_none_of_those_who_would_make_do_with_it() -> None:
    """Else names would follow from the order in which nodes are known, and change with the next start."""
    wishes = {1: ("x",), 2: ("x",), 3: ("x_1",), 4: ("x_1",), 5: ("y",), 6: ("taken",)}
    more = {number: (f"{name}_{number}",) for number, (name,) in wishes.items()}
    found = names._apart(wishes, more, {"taken"})
    assert found == {1: "x_1_2", 2: "x_2", 3: "x_1_3", 4: "x_1_4", 5: "y", 6: "taken_6"}
    backwards = dict(reversed(wishes.items()))
    assert names._apart(backwards, more, {"taken"}) == found


@pytest.mark.parametrize("name", ["unverified", "unverified/arm", "status", "all", "joint_states"])
def test_no_node_is_called_as_a_part_of_the_stations_own_topics(name: str) -> None:
    topics = Topics(STATION)
    topics.learn([ANGLE, FORCE])
    with pytest.raises(UsageError, match="is the topic of something else already"):
        topics.require_free(ARM, 0, name)
    topics.require_free(ARM, 0, "left/arm")
    with pytest.raises(UsageError, match=f"is the topic of node {HAND} already"):
        topics.require_free(ARM, 0, topics.node(HAND))


def test_a_sink_that_is_closed_takes_nothing_and_so_drops_nothing() -> None:
    sink = Carrier()
    sink.open([ANGLE], STATION)
    sink.close()
    for _ in range(2 * LIVE_WAITING):
        sink.write(block())
    assert sink.stats.dropped == 0
    assert not sink._items


def test_diagnostics_of_a_station_are_held_whole() -> None:
    """One entry for each report, each datasheet that is not signed, each calibration that is due, and the sink."""
    facts = [
        replace(ANGLE, overdue=True, due="2026-01-01"),
        replace(ANGLE, number=2, unsigned=True),
        replace(FORCE, unverified=True),
    ]
    sink = Carrier()
    sink._prepare(tuple(facts), STATION)
    reports = (
        NodeReport(
            ARM, "running", samples=100, lost=4, late=3, bad=2, invalid=1, clock_error=0.00123,
            invalid_why=(InvalidValues(1, "above its high limit", 1), InvalidValues(2, "not a number", 7)),
        ),
        NodeReport(HAND, "ended", samples=5),
    )  # fmt: skip
    for report in reports:
        sink._process_item(report)
    sink._count(dropped=9)
    sink._set_state("running", "12 messages/s")
    assert sink._statuses(12.4) == [
        DiagnosticEntry(
            1, "arm: measurement", "running", ARM,
            (("samples", "100"), ("lost", "4"), ("late", "3"), ("bad", "2"), ("invalid", "1"),
             ("why invalid", "7 of channel 2: not a number; 1 of channel 1: above its high limit"),
             ("clock error [s]", "0.0012")),
        ),
        DiagnosticEntry(
            0, "unverified/hand: measurement", "ended", HAND,
            (("samples", "5"), ("lost", "0"), ("late", "0"), ("bad", "0"), ("invalid", "0")),
        ),
        DiagnosticEntry(1, "arm: datasheet", "unsigned: raw values only, not published on any topic", ARM),
        DiagnosticEntry(
            1, "unverified/hand: datasheet", "unverified: values are calibrated by an unsigned datasheet", HAND
        ),
        DiagnosticEntry(1, "arm: calibration of angle", "due since 2026-01-01", ARM),
        DiagnosticEntry(
            1, "bench: carrier", "12 messages/s", "bench", (("messages per second", "12"), ("dropped values", "9"))
        ),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("sent", "dropped", "detail", "level"),
    [
        (0, 0, "0 messages/s", 0),
        (8000, 0, "4000 messages/s", 0),
        (10000, 0, "5000 messages/s", 0),
        (10002, 0, "5001 messages/s, above the 5000 that one process can handle: lower --scalar-rate", 1),
        (8000, 1, "4000 messages/s", 1),
    ],
)
def test_a_sink_says_once_a_second_how_much_it_sends_and_when_that_is_too_much(
    sent: int, dropped: int, detail: str, level: int
) -> None:
    sink = Carrier()
    sink._prepare((), STATION)
    sink._set_state("running")
    sink._second = 100.0
    sink._went(3, messages=sent)
    sink._count(dropped=dropped)
    sink._idle(100.9)
    assert sink.statuses == []
    sink._idle(102.0)
    [own] = sink.statuses
    assert (sink.stats.detail, own.message, own.level) == (detail, detail, level)
    sink._idle(103.5)
    assert sink.stats.detail == "0 messages/s", "each second is counted anew"


def test_of_many_reasons_the_three_most_frequent_are_named() -> None:
    found = [
        InvalidValues(number, f"why {number}", count) for number, count in ((1, 2), (2, 9), (3, 1), (4, 5), (5, 3))
    ]
    assert why_invalid(found) == "9 of channel 2: why 2; 5 of channel 4: why 4; 3 of channel 5: why 5; 3 more"
    assert why_invalid(found[:3]) == "9 of channel 2: why 2; 2 of channel 1: why 1; 1 of channel 3: why 3"
    assert why_invalid([]) == ""


def test_a_name_that_two_joints_have_moves_neither_and_each_goes_with_its_own_node() -> None:
    """A node that is called as another one's joint: the set point would have moved whichever joined last."""
    other = "f" * 20
    two = [*gripper(), replace(gripper()[0], number=4, name="turn", units=parse_units("rad"))]
    namesake = [replace(facts, uuid=other, node="hand_turn") for facts in gripper()[:1]]
    came: list[SetPointCommand] = []
    sink = Carrier(came)
    sink._prepare((*two, *namesake), STATION)
    assert [(joint.name, joint.uuid) for joint in sink._joints] == [
        ("hand_opening_set_point", HAND), ("hand_turn", HAND), ("hand_turn", other),
    ]  # fmt: skip
    sink._joint_command(["hand_turn", "hand_opening_set_point"], [0.1, 0.02], [], [])
    assert ([(command.uuid, command.channel) for command in came], sink.refused_commands) == ([(HAND, 1)], 1)
    sink._process_item(tuple(replace(facts, chosen=((0, "claw"),)) for facts in namesake))
    assert [(joint.name, joint.uuid) for joint in sink._joints] == [
        ("claw", other), ("hand_opening_set_point", HAND), ("hand_turn", HAND),
    ]  # fmt: skip
    sink._joint_command(["hand_turn", "claw"], [0.1, 0.2], [], [])
    assert [(command.uuid, command.channel) for command in came[1:]] == [(HAND, 4), (other, 1)]


def test_messages_of_several_channels_are_held_whole() -> None:
    """What is not measured has -1 as its first covariance, what is not known 0 (sensor_msgs)."""
    known = [replace(facts, deviation=0.5) for facts in axes("m/s^2", 1)]
    [imu] = compounds_of(known)
    assert imu.fields({1: 1.0, 2: 2.0, 3: 3.0, 9: 9.0}) == {
        "orientation_covariance": [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        "orientation.w": 1.0,
        "angular_velocity_covariance": [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        "linear_acceleration_covariance": [0.25, 0.0, 0.0, 0.0, 0.25, 0.0, 0.0, 0.0, 0.25],
        "linear_acceleration.x": 1.0,
        "linear_acceleration.y": 2.0,
        "linear_acceleration.z": 3.0,
    }
    blind = [replace(facts, uncertainty=None) for facts in axes("rad/s", 4)]
    [both] = compounds_of([*known, *blind])
    fields = both.fields(dict(zip(range(1, 7), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), strict=True)))
    assert fields is not None
    assert (fields["angular_velocity.z"], fields["angular_velocity_covariance"]) == (6.0, [0.0] * 9)
    [magnetic] = compounds_of(axes("T", 7))
    diagonal = pytest.approx([0.03, 0.0, 0.0, 0.0, 0.03, 0.0, 0.0, 0.0, 0.03])
    assert magnetic.fields({7: 1.0, 8: 2.0, 9: 3.0}) == {
        "magnetic_field_covariance": diagonal,
        "magnetic_field.x": 1.0,
        "magnetic_field.y": 2.0,
        "magnetic_field.z": 3.0,
    }
    [wrench] = compounds_of([*axes("N", 1), *axes("N m", 4)])
    assert wrench.parts == (
        ("wrench.force.x", 1), ("wrench.force.y", 2), ("wrench.force.z", 3),
        ("wrench.torque.x", 4), ("wrench.torque.y", 5), ("wrench.torque.z", 6),
    )  # fmt: skip
    finder = ChannelFacts(ARM, "arm", 1, "Range-Finder", units=parse_units("m"), deviation=0.1)
    [far] = compounds_of([finder])
    assert far.fields({1: 2.0}) == {
        "radiation_type": 1, "min_range": 0.0, "max_range": float("inf"), "variance": pytest.approx(0.01), "range": 2.0,
    }  # fmt: skip
    [near] = compounds_of([replace(finder, low=0.2, high=4.0)])
    assert (near.fixed["min_range"], near.fixed["max_range"]) == (0.2, 4.0)


def test_the_state_of_joints_is_what_their_sensors_or_else_their_set_points_say() -> None:
    topics = Topics(STATION)
    pair = [
        replace(facts, number=facts.number + shift, name=f"{facts.name} {shift}")
        for shift in (0, 10)
        for facts in gripper()
    ]
    topics.learn(pair)
    first, second = joints_of(pair, topics)
    assert [(joint.name, joint.actuator, dict(joint.state)) for joint in (first, second)] == [
        ("hand_opening_set_point_0", 1, {"position": 2, "effort": 3}),
        ("hand_opening_set_point_10", 11, {"position": 12, "effort": 13}),
    ]
    newest = {(HAND, 1): 0.09, (HAND, 2): 0.05, (HAND, 3): 4.0, (HAND, 12): 0.06}
    assert state_of([first, second], newest) == ([first.name, second.name], [0.05, 0.06], [], [])
    assert state_of([first], newest) == ([first.name], [0.05], [], [4.0])
    assert joints_of(list(reversed(pair)), topics) == [first, second], "by number, in whatever order they are known"
    bare = replace(first, state={})
    assert state_of([bare], newest) == ([first.name], [0.09], [], []), "what was applied"
    assert state_of([replace(first, command="effort", state={"effort": 3})], newest) == ([], [], [], [])
    marked = [replace(facts, unverified=True) for facts in gripper()]
    assert joints_of(marked, topics) == [], "no set point moves what is not signed"


def processed(sink: Carrier, *items: Any) -> Carrier:
    """Give a sink items on this thread."""
    for item in items:
        sink._process_item(item)
    return sink


def row_at(stamp: float, *values: float) -> GroupRows:
    """Return one row of angle and force, which are a second and two seconds old."""
    keys = (ANGLE.key, FORCE.key)[: len(values)]
    return GroupRows("crane", keys, np.array([stamp]), np.array([values]), np.array([[1.0, 2.0][: len(values)]]))


def prepared(*facts: ChannelFacts, station: StationFacts = STATION, commands: Any = None) -> Carrier:
    """Return a carrier without its thread."""
    sink = Carrier(commands)
    sink._prepare(facts, station)
    return sink


def test_rows_go_on_when_the_clock_was_set_back() -> None:
    sink = processed(prepared(ANGLE, FORCE), row_at(2000.0, 1.0, 2.0), row_at(1500.0, 1.0, 2.0))
    assert [(topic, stamp) for topic, stamp, *_ in sink.arrays] == [
        ("/bench/crane", 2000.0),
        ("/bench/crane/age", 2000.0),
    ]
    processed(sink, ClockSet(1000.0, -1000.0), row_at(1001.0, 3.0, 4.0))
    assert sink.arrays[2:] == [
        ("/bench/crane", 1001.0, ["arm/angle", "hand/force"], [3.0, 4.0]),
        ("/bench/crane/age", 1001.0, ["arm/angle", "hand/force"], [1.0, 2.0]),
    ]


@pytest.mark.parametrize("each_node", [False, True])
def test_a_channel_that_is_called_otherwise_is_called_so_in_every_message_from_then_on(each_node: bool) -> None:
    sink = prepared(ANGLE, station=replace(STATION, each_node=each_node))
    row = replace(row_at(1.0, 1.0), group=ARM if each_node else "crane")
    processed(sink, block(), row, (replace(ANGLE, name="elbow", units=parse_units("K")),), block())
    processed(sink, replace(row, time=np.array([2.0])))
    assert [(topic, kind) for topic, kind, *_ in sink.scalars] == [
        ("/bench/arm/angle", "std_msgs/Float64"), ("/bench/arm/elbow", "sensor_msgs/Temperature"),
    ]  # fmt: skip
    assert [names for _, _, names, _ in sink.arrays] == [["arm/angle"]] * 2 + [["arm/elbow"]] * 2
    assert {topic for topic, *_ in sink.arrays} == (
        {"/bench/arm/array", "/bench/arm/array/age"} if each_node else {"/bench/crane", "/bench/crane/age"}
    )


def test_metadata_has_every_channel_of_its_node_and_each_frame_filled_in_also_if_one_alone_changed() -> None:
    second = replace(ANGLE, number=2, name="other", frame="{node}_tip")
    station = replace(STATION, name="Bench 1", clock="a clock of its own", test_pattern=False)
    sink = processed(prepared(ANGLE, second, station=station), (replace(ANGLE, name="elbow"),))
    words = json.loads(sink.words["/bench_1/arm/teds"])
    assert [(one["name"], one["topic"], one.get("frame")) for one in words["channels"]] == [
        ("elbow", "/bench_1/arm/elbow", None), ("other", "/bench_1/arm/other", "arm_tip"),
    ]  # fmt: skip
    assert (words["uuid"], words["station"], words["clock"]) == (ARM, "Bench 1", "a clock of its own")
    assert words["test_pattern"] is False
    assert set(sink.parameters) == {"/bench_1/arm/elbow", "/bench_1/arm/other"}
    before = dict(sink.words)
    sink.words.clear()
    assert processed(sink, (replace(ANGLE, name="elbow"),)).words == {}, "nothing is new"
    assert before


def test_scalars_keep_their_beat_and_what_is_not_due_is_not_even_queued(monkeypatch: pytest.MonkeyPatch) -> None:
    """A delay shifts no later message; after a pause the beat begins anew."""
    now = [0.0]
    monkeypatch.setattr(
        "teds_provision.measure.sinks.live.time", SimpleNamespace(monotonic=lambda: now[0], time=time.time)
    )
    sink, sent, queued = prepared(ANGLE), [], []
    for now[0] in (100.0, 100.05, 100.1, 100.19, 100.2, 100.25, 101.0, 101.05, 101.1):
        before = len(sink._items), len(sink.scalars)
        sink.write(block())
        queued.append(len(sink._items) - before[0])
        processed(sink, block())
        sent.append(len(sink.scalars) - before[1])
    assert sent == queued == [1, 0, 1, 0, 1, 0, 1, 0, 1]
    sink.write(replace(block(), stream=ECHO))
    sink.write(replace(block(), stream=1))
    assert len(sink._items) == sum(queued) + 2, "each stream has its own beat"
    quiet = prepared(ANGLE, station=replace(STATION, scalar_rate=0.0))
    quiet.write(block())
    quiet.write(replace(block(), stream=ECHO))
    assert not quiet._items, "and a set point goes to joints alone"


def test_a_sink_counts_the_values_that_went_out_and_each_message() -> None:
    vector = axes("m/s^2", 4)
    sink = prepared(ANGLE, FORCE, *vector)
    processed(sink, block([[1, 2]], [[0.5, np.nan]], [[True, False]], channels=(1, 9)))
    assert (sink.stats.written, sink.stats.messages) == (1, 1)
    processed(sink, row_at(1.0, 1.0, np.nan))
    assert (sink.stats.written, sink.stats.messages) == (2, 3), "the row, and its age"
    processed(sink, replace(block([[1, 2, 3]], channels=(4, 5, 6)), stream=1))
    assert (sink.stats.written, sink.stats.messages) == (8, 7), "three values, and once more together"
    hand = prepared(*gripper())
    rows = GroupRows("crane", ((HAND, 2),), np.array([1.0]), np.array([[0.05]]), np.zeros((1, 1)))
    processed(hand, rows)
    assert (hand.stats.written, hand.stats.messages) == (1, 3), "the joints' state holds no value of its own"


def test_a_message_of_set_points_that_is_too_short_moves_the_joints_that_it_has_a_value_for() -> None:
    came: list[SetPointCommand] = []
    sink = prepared(*gripper(), replace(gripper()[0], uuid=ARM, node="arm"), commands=came)
    sink._joint_command(["hand", "arm"], [0.01], [], [])
    assert ([(command.uuid, command.value) for command in came], sink.refused_commands) == ([(HAND, 0.01)], 1)


def test_each_node_that_comes_and_goes_has_the_state_of_its_own_joints_alone() -> None:
    station = replace(STATION, each_node=True)
    sink = prepared(*gripper(), *(replace(facts, uuid=ARM, node="arm") for facts in gripper()), station=station)
    rows = GroupRows(HAND, ((HAND, 2),), np.array([1.0]), np.array([[0.05]]), np.zeros((1, 1)))
    processed(sink, rows, replace(rows, group=ARM, channels=((ARM, 2),), value=np.array([[0.06]])))
    assert sink.joints == [(["hand"], [0.05], [], []), (["arm"], [0.06], [], [])]


@pytest.mark.parametrize("vector", [(4, 5), (4, 5, 6, 7), (5, 6, 4)])
def test_a_vector_has_three_members_in_the_order_of_the_meta_teds(vector: tuple[int, ...]) -> None:
    known = [replace(facts, vector=vector) for facts in [*axes("T", 4), replace(axes("T", 7)[0], number=7)]]
    found = compounds_of(facts for facts in known if facts.number in vector)
    assert [compound.parts for compound in found] == (
        [(("magnetic_field.x", 5), ("magnetic_field.y", 6), ("magnetic_field.z", 4))] if len(vector) == 3 else []
    )


def test_more_vectors_of_one_kind_than_of_the_other_make_a_message_each() -> None:
    found = compounds_of([*axes("m/s^2", 1), *axes("m/s^2", 4), *axes("rad/s", 7)])
    assert [(compound.name, [number for _, number in compound.parts]) for compound in found] == [
        ("imu_1", [1, 2, 3, 7, 8, 9]), ("imu_4", [4, 5, 6]),
    ]  # fmt: skip
    assert found[1].fixed["angular_velocity_covariance"] == [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    mixed = [*axes("T", 1)[:2], replace(axes("N", 1)[2])]
    assert compounds_of(mixed) == [], "its axes have one unit"
    assert compounds_of(replace(facts, kind="actuator") for facts in axes("T", 1)) == []


@pytest.mark.parametrize("kind", ["velocity", "effort"])
def test_a_set_point_stands_for_the_state_that_it_commands_and_for_no_other(kind: Any) -> None:
    [joint] = joints_of(gripper(), Topics(STATION))
    state = replace(joint, command=kind, state={"position": 2})
    given = state_of([state], {(HAND, 1): 0.3, (HAND, 2): 0.05})
    assert given == ([joint.name], [0.05], *(([0.3], []) if kind == "velocity" else ([], [0.3])))


# -- names -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "part"),
    [("a" * 59 + " b", "a" * 59), ("a" * 61, "a" * 60), ("3 axes", "n_3_axes"), ("--", ""), ("A__b-", "a_b")],
)
def test_a_name_is_cut_after_sixty_letters_and_begins_with_one(text: str, part: str) -> None:
    assert slug(text) == part


@pytest.mark.parametrize(
    ("frame", "is_one"),
    [("a" * 60, True), ("a" * 61, False), ("base_link", True), ("map/arm_1", True), ("1a", False), ("a//b", False),
     ("a/", False), ("", False), ("a b", False)],
)  # fmt: skip
def test_a_frame_is_a_name_of_sixty_letters_at_most(frame: str, is_one: bool) -> None:
    assert names.is_frame(frame) is is_one


@pytest.mark.parametrize(
    ("name", "own"),
    [("array", "array_1"), ("teds", "teds_1"), ("state", "state_1"), ("status", "status_1"), ("age", "age_1"),
     ("cmd", "cmd_1"), ("stream", "stream_ch1"), ("stream_0", "stream_0_1"), ("imu", "imu_ch1"), ("imu_2", "imu_2_1"),
     ("magnetic_field", "magnetic_field_ch1"), ("wrench_12", "wrench_12_1"), ("images", "images")],
)  # fmt: skip
def test_a_channel_with_a_reserved_name_has_its_number_behind_it(name: str, own: str) -> None:
    topics = Topics(STATION)
    topics.learn([replace(ANGLE, name=name)])
    assert topics.channel(ARM, 1) == f"/bench/arm/{own}"


@pytest.mark.parametrize("name", ["all", "reports", "status", "unverified", "joint_states", "joint_commands"])
def test_a_node_with_a_reserved_name_has_its_digits_behind_it(name: str) -> None:
    topics = Topics(replace(STATION, nodes={ARM: name}))
    assert topics.node(ARM) == f"{name}_8d4d9da6"
    group = topics.of_group(name)
    assert group == (f"/bench/{name}_group" if name.startswith("joint_") else f"/bench/{name}")
    assert (topics.of_group(""), Topics(StationFacts("--")).of_group("x")) == ("/bench/all", "/station/x")


def test_names_that_are_chosen_while_a_node_is_measured_count_until_they_are_taken_back() -> None:
    topics = Topics(STATION)
    topics.learn([ANGLE, replace(ANGLE, number=2, name="boom"), FORCE])
    for chosen, first, second in (
        (((1, "bench/arm/boom"),), "/bench/arm/boom", "/bench/arm/boom_2"),
        (((1, "crane/boom"),), "/crane/boom", "/bench/arm/boom"),
        (((1, "/crane/jib/"),), "/crane/jib", "/bench/arm/boom"),
        (((0, "left"), (1, "crane/jib")), "/crane/jib", "/bench/left/boom"),
        ((), "/bench/arm/angle", "/bench/arm/boom"),
    ):
        touched = topics.learn([replace(ANGLE, chosen=chosen)])
        assert (topics.channel(ARM, 1), topics.channel(ARM, 2), touched) == (first, second, {ARM})
    assert topics.channel(HAND, 2) == "/bench/hand/force"


def test_a_stranger_that_joins_renames_its_namesake_and_both_are_reported() -> None:
    topics = Topics(STATION)
    other = "f" * 20
    assert topics.learn([replace(ANGLE, siblings=((7, "tip"),))]) == {ARM}
    assert (topics.channel(ARM, 1), topics.channel(ARM, 7)) == ("/bench/arm/angle", "/bench/arm/tip")
    assert topics.learn([replace(ANGLE, uuid=other)]) == {ARM, other}
    assert (topics.channel(ARM, 1), topics.channel(other, 1)) == (
        "/bench/arm_8d4d9da6/angle", "/bench/arm_ffffffff/angle",
    )  # fmt: skip
    claw = replace(FORCE, uuid="c" * 20)
    assert topics.learn([replace(claw, unverified=True, node="arm")]) == {claw.uuid}
    assert topics.channel(*claw.key) == "/bench/unverified/arm/force"
    assert topics.learn([replace(claw, node="claw")]) == {claw.uuid}
    assert topics.channel(*claw.key) == "/bench/claw/force", "it is signed by now"


@pytest.mark.parametrize(
    ("name", "by"),
    [
        ("diagnostics", "something else"), ("tf/x", "something else"), ("clock", "something else"),
        ("bench/crane", "something else"), ("bench/x/teds", "something else"), ("bench/x/imu_3", "something else"),
        ("bench/x/cmd", "something else"), ("bench/hand/force", f"channel 2 of node {HAND}"),
        ("/bench/hand/force/", f"channel 2 of node {HAND}"), ("crane/jib", f"channel 3 of node {HAND}"),
        ("crane/jib/cmd", f"channel 3 of node {HAND}"), ("bench/arm/other", f"channel 2 of node {ARM}"),
        ("bench/arm/angle", ""), ("bench/x/teds_1", ""), ("other/crane", ""), ("crane/jib_2", ""),
    ],
)  # fmt: skip
def test_what_stands_for_something_else_cannot_be_chosen_for_a_channel(name: str, by: str) -> None:
    topics = Topics(replace(STATION, names={(HAND, 3): "crane/jib"}))
    topics.learn([ANGLE, replace(ANGLE, number=2, name="other"), FORCE, replace(FORCE, number=3)])
    if not by:
        topics.require_free(ARM, 1, name)
        return
    with pytest.raises(UsageError, match=f"is the topic of {by} already"):
        topics.require_free(ARM, 1, name)


def test_an_end_with_its_reason_is_in_order_and_a_clock_error_of_0_is_one() -> None:
    sink = Carrier()
    sink._prepare((ANGLE,), STATION)
    entry = sink._status(NodeReport(ARM, "ended", "by pid 5", samples=7, clock_error=0.0))
    assert (entry.level, entry.message) == (OK, "by pid 5")
    assert ("clock error [s]", "0") in entry.values
    assert sink._status(NodeReport(ARM, "ended", "by pid 5", late=1)).level == WARN
    assert sink._status(NodeReport(ARM, "running", "its clock is inconsistent")).level == WARN


def test_facts_that_give_their_node_another_name_are_announced_once() -> None:
    sink = Carrier()
    sink._prepare((ANGLE,), STATION)
    sink._announce([ANGLE])
    renamed = replace(ANGLE, chosen=((0, "left"),))
    assert sink._learn((renamed,)) == [renamed]


def test_of_a_block_its_last_instant_is_published_with_its_time() -> None:
    sent: list[Any] = []
    made: Any = SimpleNamespace(
        _joints=["a joint"], _newest={}, _scalar=lambda *words: sent.append(words), _went=lambda _values: None
    )
    scalars: Any = SimpleNamespace(channels=[(0, "/bench/arm/angle", meaning_of(ANGLE), "arm", 0.5)], compounds=[])
    given = block([[1], [2], [3]], start=100.0)
    TopicSink._publish(made, given, scalars)
    assert [(topic, stamp, value, variance) for topic, _, stamp, _, value, variance in sent] == [
        ("/bench/arm/angle", float(given.time[2]), pytest.approx(0.3), 0.5)
    ]
    assert made._newest == {(ARM, 1): pytest.approx(0.3)}


def test_a_node_with_another_name_gives_its_channels_the_names_that_are_free_there() -> None:
    topics = Topics(replace(STATION, names={(HAND, 2): "bench/arm/angle"}))
    topics.learn([ANGLE, FORCE])
    assert topics.channel(ARM, 1) == "/bench/arm/angle_1"
    topics.learn([replace(ANGLE, uuid="f" * 20)])
    assert topics.channel(ARM, 1) == f"/bench/arm_{ARM}/angle"
