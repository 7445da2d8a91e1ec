"""The common part of ROS 1 and ROS 2: the topics, and when each message is published.

The cost of a topic is its messages, not its values (notes of measurements in docs/ros.md). So a group's rows go out as
one array at full rate, each channel on its topic at ``StationFacts.scalar_rate``, and the sink counts its
messages per second and reports when that is more than one process can carry.

| topic | type | when |
|---|---|---|
| ``/<station>/<group>`` | sensor_msgs/JointState (name, position = value) | each row of the grid |
| ``/<station>/<group>/age`` | sensor_msgs/JointState (name, position = age in seconds) | each row |
| ``/<station>/joint_states`` | the same of all joints, for ros2_control | each row, if there is a joint |
| ``/<station>/joint_commands`` | the same, subscribed | if there is a joint that may be moved |
| ``/<station>/<node>/array`` and ``/age`` | the same of one node, if nodes come and go | each row of its grid |
| ``/<station>/<node>/<channel>`` | by :func:`meaning_of` | at the scalar rate |
| ``/<station>/<node>/imu`` and the like | by :mod:`vectors` | at the scalar rate |
| ``/<station>/<node>/teds`` | std_msgs/String, JSON, latched | when the facts are known |
| ``/<station>/<node>/<channel>/cmd`` | std_msgs/Float64, subscribed | actuators only |
| ``/diagnostics`` | diagnostic_msgs/DiagnosticArray | once a second |
"""

from __future__ import annotations

import json
import math
import time
from abc import abstractmethod
from bisect import bisect_left, insort
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from teds_provision.measure.blocks import (
    ECHO,
    Block,
    ChannelFacts,
    ClockSet,
    GroupRows,
    NodeReport,
    SetPointCommand,
    StationFacts,
    why_invalid,
)
from teds_provision.measure.sinks.base import BUDGET, ROWS, CommandTaker, Item, ThreadedSink
from teds_provision.measure.sinks.joints import INTERFACES, Joint, joints_of, state_of
from teds_provision.measure.sinks.json_events import facts_as_json
from teds_provision.measure.sinks.names import Topics, slug
from teds_provision.measure.sinks.vectors import (
    VARIANCE_NOTE,
    Compound,
    FieldValue,
    Meaning,
    compounds_of,
    is_range,
    meaning_of,
    variance_of,
)

NODE = "teds_provision"
STATES, COMMANDS = "joint_states", "joint_commands"  # topics of the station
OK, WARN, ERROR, STALE = range(4)  # of diagnostic_msgs/DiagnosticStatus
JOINT_STATE, STRING, DIAGNOSTICS = "sensor_msgs/JointState", "std_msgs/String", "diagnostic_msgs/DiagnosticArray"


@dataclass(frozen=True)
class DiagnosticEntry:
    """One entry of /diagnostics."""

    level: int
    name: str
    message: str
    hardware: str
    values: tuple[tuple[str, str], ...] = ()


@dataclass
class _Scalars:
    """Scalar topics of one stream, and when they are due."""

    channels: list[tuple[int, str, Meaning, str, float]]  # column, topic, meaning, frame, variance
    compounds: list[tuple[str, Compound, str]]  # topic, message, frame
    due: float = 0.0


class TopicSink(ThreadedSink):
    """Decides what goes out; subclasses carry it: six steps, all on the sink's thread."""

    wants_rows = True
    budgeted = True

    def __init__(self, name: str, commands: CommandTaker | None) -> None:
        super().__init__(name)
        self._commands = commands
        self._station = StationFacts("")
        # Nested by node, so that a joining node does not require a pass over all others.
        self._facts: dict[str, dict[int, ChannelFacts]] = {}
        self._topics = Topics(self._station)
        self._scalars: dict[str, dict[tuple[int, tuple[int, ...]], _Scalars]] = {}
        self._reports: dict[str, NodeReport] = {}
        self._arrays: dict[tuple[tuple[str, int], ...], float] = {}  # time of the last published row
        self._labels: dict[str, dict[tuple[tuple[str, int], ...], list[str]]] = {}  # by GroupRows.group
        self._joints: list[Joint] = []  # sorted by name; replaced at each change, because other threads read it
        self._joints_of: dict[str, list[Joint]] = {}
        self._newest: dict[tuple[str, int], float] = {}  # the newest values, for joints
        self._described: dict[str, str] = {}  # topic of each node's published datasheet
        self._sent = 0
        self._second = 0.0
        self.refused_commands = 0

    @abstractmethod
    def _advertise(self, topic: str, kind: str) -> None:
        """Advertise a topic before its first message, so that waiting subscribers connect in time."""

    @abstractmethod
    def _array(
        self,
        topic: str,
        stamp: float,
        names: Sequence[str],
        values: Sequence[float],
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
    ) -> None:
        """Publish one JointState; NaN for a missing value."""

    @abstractmethod
    def _scalar(self, topic: str, meaning: Meaning, stamp: float, frame: str, value: float, variance: float) -> None:
        """Publish one value as the message of its quantity."""

    @abstractmethod
    def _fields(self, topic: str, kind: str, stamp: float, frame: str, fields: Mapping[str, FieldValue]) -> None:
        """Publish one message of type ``kind`` with a header, its fields by path (``magnetic_field.x``)."""

    @abstractmethod
    def _latched(self, topic: str, words: str) -> None:
        """Publish a String that late subscribers receive too."""

    @abstractmethod
    def _retire(self, topic: str) -> None:
        """Remove a topic made by :meth:`_latched`, so that new subscribers no longer get its message."""

    @abstractmethod
    def _parameter(self, name: str, value: object) -> None:
        """Set a parameter on a parameter server, if there is one."""

    @abstractmethod
    def _listen(self, topic: str, uuid: str, channel: int) -> None:
        """Subscribe to set points of an actuator; each goes to :meth:`_command`."""

    @abstractmethod
    def _listen_joints(self, topic: str) -> None:
        """Subscribe to JointState of set points; each goes to :meth:`_joint_command`."""

    @abstractmethod
    def _diagnose(self, stamp: float, statuses: Sequence[DiagnosticEntry]) -> None:
        """Publish the states of the nodes as one DiagnosticArray."""

    @property
    def _node(self) -> str:
        """Name of the ROS node. ROS 1 ends a node whose name another one takes, so each measurement has its own."""
        return "_".join(filter(None, (NODE, self._topics.station, slug(self._station.instance))))

    def _prepare(self, facts: tuple[ChannelFacts, ...], station: StationFacts) -> None:
        self._station = station
        self._topics = Topics(station)
        self._take_facts(facts)
        self._topics.learn(facts)
        self._find_joints(self._facts)

    def _begin(self) -> None:
        self._announce(self._every_fact())

    def _every_fact(self) -> list[ChannelFacts]:
        return [facts for channels in self._facts.values() for facts in channels.values()]

    def _take_facts(self, facts: Iterable[ChannelFacts]) -> None:
        for channel_facts in facts:
            self._facts.setdefault(channel_facts.uuid, {})[channel_facts.number] = channel_facts

    def write(self, block: Block) -> None:
        """Queue samples of one stream; those before their topics are due are left out here, but for set points."""
        if block.stream == ECHO and self._joints_of.get(block.uuid):
            super().write(block)
            return
        if self._station.scalar_rate <= 0:
            return
        streams = self._scalars.get(block.uuid)
        scalars = None if streams is None else streams.get((block.stream, block.channels))
        if scalars is None or time.monotonic() >= scalars.due:
            super().write(block)

    def _process_item(self, item: Item) -> None:
        if isinstance(item, Block):
            self._block(item)
        elif isinstance(item, GroupRows):
            self._rows(item)
        elif changed := self._learn(item):
            self._announce(changed)

    def _learn(self, item: NodeReport | ClockSet | tuple[ChannelFacts, ...]) -> list[ChannelFacts]:
        """Keep a report or facts; gives the facts that are new, and those of nodes that have another name now."""
        if isinstance(item, ClockSet):
            self._arrays.clear()  # if the clock was set back, no row would be published until it had caught up
            return []
        if isinstance(item, NodeReport):
            self._reports[item.uuid] = item
            return []
        changed = [facts for facts in item if self._facts.get(facts.uuid, {}).get(facts.number) != facts]
        self._take_facts(changed)
        touched, own = self._topics.learn(changed), {facts.uuid for facts in changed}
        for uuid in touched:
            topic = self._described.get(uuid)
            if topic is not None and topic != self._topics.of_node(uuid, "teds"):  # remove the old datasheet
                del self._described[uuid]
                self._retire(topic)
                if uuid not in own:
                    changed += self._facts[uuid].values()
            self._scalars.pop(uuid, None)
            self._labels.pop(uuid, None)
        if not self._station.each_node:
            self._labels.clear()
        self._find_joints(touched)
        return changed

    def _find_joints(self, uuids: Iterable[str]) -> None:
        """Find the joints of some nodes again."""
        found = {uuid: joints_of(self._facts.get(uuid, {}).values(), self._topics) for uuid in uuids}
        changed = [uuid for uuid, joints in found.items() if joints != self._joints_of.get(uuid, [])]
        if not changed:
            return
        joints = self._joints.copy()
        for uuid in changed:
            for joint in self._joints_of.pop(uuid, ()):
                place = bisect_left(joints, joint.name, key=_name_of)
                while joints[place] != joint:  # another node's joint may have the same name
                    place += 1
                del joints[place]
        for uuid in changed:
            self._joints_of[uuid] = found[uuid]
            for joint in found[uuid]:
                insort(joints, joint, key=_name_of)
        self._joints = joints

    def _announce(self, facts: Sequence[ChannelFacts]) -> None:
        """Publish metadata, parameters and command topics of channels; again after a reconnection."""
        whole = {channel_facts.uuid for channel_facts in facts} if self._station.each_node else {self._station.group}
        for array in () if self._station.test_pattern else map(self._array_topic, sorted(whole)):
            for topic in (array, f"{array}/age"):
                self._advertise(topic, JOINT_STATE)
        if self._joints and not self._station.test_pattern:
            self._advertise(self._topics.of_station(STATES), JOINT_STATE)
            if self._commands is not None:
                self._listen_joints(self._topics.of_station(COMMANDS))
        for uuid in dict.fromkeys(channel_facts.uuid for channel_facts in facts):
            channels = list(self._facts[uuid].values())
            topic = self._described[uuid] = self._topics.of_node(uuid, "teds")
            self._latched(topic, json.dumps(self._metadata(uuid, channels)))
            for channel_facts in channels:
                self._parameter(self._topics.channel(*channel_facts.key), facts_as_json(channel_facts))
                if channel_facts.kind == "actuator" and self._commands is not None:
                    self._listen(
                        f"{self._topics.channel(*channel_facts.key)}/cmd", channel_facts.uuid, channel_facts.number
                    )

    def _metadata(self, uuid: str, channels: Sequence[ChannelFacts]) -> dict[str, Any]:
        """Return what a consumer has to know of a node's values, as plain data."""
        return {
            "uuid": uuid,
            "station": self._station.name,
            "clock": self._station.clock,
            "test_pattern": self._station.test_pattern,
            "variance": VARIANCE_NOTE,
            "channels": [
                {**facts_as_json(replace(facts, frame=self._frame(facts))), "topic": self._topics.channel(*facts.key)}
                for facts in channels
            ],
        }

    def _block(self, block: Block) -> None:
        if block.stream == ECHO and len(block.time):
            self._applied(block)
        rate = self._station.scalar_rate
        # A test pattern is not a measurement: recorders mark it, but topics cannot, so it is not published.
        if rate <= 0 or block.test_pattern or not len(block.time):
            return
        streams, key = self._scalars.setdefault(block.uuid, {}), (block.stream, block.channels)
        if key not in streams:
            streams[key] = self._scalars_of(block)
        scalars = streams[key]
        now = time.monotonic()
        if now < scalars.due:
            return
        # The next beat, not "now + period": otherwise each delay would slow the topic down permanently.
        scalars.due = scalars.due + 1 / rate if now < scalars.due + 1 / rate else now + 1 / rate
        self._publish(block, scalars)

    def _publish(self, block: Block, scalars: _Scalars) -> None:
        """Publish the last instant of a block: each single channel, and the compounds of several."""
        if self._joints:
            self._newest |= dict(zip(block.keys, block.value[-1].tolist(), strict=True))
        stamp = float(block.time[-1])
        for column, topic, meaning, frame, variance in scalars.channels:
            value = float(block.value[-1, column])
            if math.isfinite(value):
                self._scalar(topic, meaning, stamp, frame, meaning.field_value(value), variance)
                self._went(1)
        values = dict(zip(block.channels, block.value[-1].tolist(), strict=True)) if scalars.compounds else {}
        for topic, compound, frame in scalars.compounds:
            fields = compound.fields(values)
            if fields is not None:
                self._fields(topic, compound.type, stamp, frame, fields)
                self._went(len(compound.parts))

    def _scalars_of(self, block: Block) -> _Scalars:
        channels = []
        own = self._facts.get(block.uuid, {})
        known = [own.get(number) or ChannelFacts(block.uuid, "", number, "") for number in block.channels]
        for column, facts in enumerate(known):
            if not is_range(facts):
                topic = self._topics.channel(block.uuid, facts.number)
                channels.append((column, topic, meaning_of(facts), self._frame(facts), variance_of(facts)))
        frames = {facts.number: self._frame(facts) for facts in known}
        compounds = [
            (self._compound_topic(block.uuid, compound), compound, frames[compound.parts[0][1]])
            for compound in compounds_of(known)
        ]
        return _Scalars(channels, compounds)

    def _frame(self, facts: ChannelFacts) -> str:
        return facts.frame.replace("{node}", self._topics.node(facts.uuid))

    def _compound_topic(self, uuid: str, compound: Compound) -> str:
        return (
            self._topics.of_node(uuid, compound.name)
            if compound.name
            else self._topics.channel(uuid, compound.parts[0][1])
        )

    def _array_topic(self, whole: str) -> str:
        """Return the topic of a group, or of a node (its UUID) if each has one."""
        return self._topics.of_node(whole, "array") if self._station.each_node else self._topics.of_group(whole)

    def _rows(self, rows: GroupRows) -> None:
        if rows.test_pattern:
            return
        topic = self._array_topic(rows.group)
        labels = self._labels.setdefault(rows.group, {})
        names = labels.get(rows.channels)
        if names is None:
            prefix = f"/{self._topics.station}/"
            names = labels[rows.channels] = [self._topics.channel(*key).removeprefix(prefix) for key in rows.channels]
        last = self._arrays.get(rows.channels, -math.inf)
        for k, stamp in enumerate(rows.time.tolist()):
            if stamp - last < 1 / ROWS - 1e-6:
                continue
            last = stamp
            self._array(topic, stamp, names, rows.value[k].tolist())
            if self._joints:
                self._joint_states(rows.group, stamp, dict(zip(rows.channels, rows.value[k].tolist(), strict=True)))
            self._array(f"{topic}/age", stamp, names, rows.age[k].tolist())
            self._went(int(np.isfinite(rows.value[k]).sum()), messages=2)
        self._arrays[rows.channels] = last

    def _applied(self, block: Block) -> None:
        """Take a set point that was applied; the state of a joint whose node sends no rows goes out with it."""
        if not self._joints_of.get(block.uuid):
            return
        stamp, values = float(block.time[-1]), dict(zip(block.keys, block.value[-1].tolist(), strict=True))
        group = block.uuid if self._station.each_node else self._station.group
        if self._labels.get(group) or stamp - self._arrays.get(block.keys, -math.inf) < 1 / ROWS - 1e-6:
            self._newest |= values
        else:
            self._arrays[block.keys] = stamp
            self._joint_states(group, stamp, values)

    def _joint_states(self, group: str, stamp: float, values: Mapping[tuple[str, int], float]) -> None:
        self._newest |= values
        mine = [joint for joint in self._joints if joint.uuid == group] if self._station.each_node else self._joints
        names, *states = state_of(mine, self._newest)
        if names:
            self._array(self._topics.of_station(STATES), stamp, names, *states)
            self._went(0)

    def _joint_command(self, names: Sequence[str], *values: Sequence[float]) -> None:
        """Set points of joints came: positions, velocities, efforts; from any thread.

        Names of no joint, or of two, are refused.
        """
        given = dict(zip(INTERFACES, values, strict=True))
        joints: dict[str, Joint | None] = {}
        for joint in self._joints:  # a name that two joints have means neither: the wrong one would move
            joints[joint.name] = None if joint.name in joints else joint
        for place, name in enumerate(names):
            meant = joints.get(name)
            if meant is not None and place < len(given[meant.command]):
                self._command(meant.uuid, meant.actuator, float(given[meant.command][place]))
            else:
                self.refused_commands += 1

    def _went(self, values: int, messages: int = 1) -> None:
        self._sent += messages
        self._count(written=values, messages=messages)

    def _idle(self, now: float) -> None:
        if now - self._second < 1.0:
            return
        rate = self._sent / (now - self._second) if self._second else 0.0
        self._sent, self._second = 0, now
        if self.stats.state == "running":
            over = f", above the {BUDGET} that one process can handle: lower --scalar-rate" if rate > BUDGET else ""
            self._set_state("running", f"{rate:.0f} messages/s{over}")
        self._diagnose(time.time(), self._statuses(rate))

    def _statuses(self, rate: float) -> list[DiagnosticEntry]:
        found = [self._status(report) for report in self._reports.values()]
        every = self._every_fact()
        for uuid in sorted({facts.uuid for facts in every if facts.unsigned}):
            name = f"{self._topics.node(uuid)}: datasheet"
            found.append(DiagnosticEntry(WARN, name, "unsigned: raw values only, not published on any topic", uuid))
        for uuid in sorted({facts.uuid for facts in every if facts.unverified}):
            name = f"{self._topics.node(uuid)}: datasheet"
            found.append(
                DiagnosticEntry(WARN, name, "unverified: values are calibrated by an unsigned datasheet", uuid)
            )
        for facts in every:
            if facts.overdue:
                name = f"{self._topics.node(facts.uuid)}: calibration of {facts.label}"
                found.append(DiagnosticEntry(WARN, name, f"due since {facts.due}", facts.uuid))
        stats = self.stats
        values = (("messages per second", f"{rate:.0f}"), ("dropped values", str(stats.dropped)))
        level = WARN if rate > BUDGET or stats.dropped else OK
        found.append(
            DiagnosticEntry(level, f"{self._topics.station}: {self.name}", stats.detail, self._topics.station, values)
        )
        return found

    def _status(self, report: NodeReport) -> DiagnosticEntry:
        counters = {"lost": report.lost, "late": report.late, "bad": report.bad, "invalid": report.invalid}
        level = {"running": OK, "waiting": WARN, "ended": OK}.get(report.state, ERROR)
        with_reason = report.state == "running" and report.why
        if level == OK and (with_reason or any(counters.values())):
            level = WARN
        values = [("samples", str(report.samples)), *((name, str(count)) for name, count in counters.items())]
        if report.invalid_why:
            values.append(("why invalid", why_invalid(report.invalid_why)))
        if report.clock_error is not None:
            values.append(("clock error [s]", f"{report.clock_error:.2g}"))
        message = report.why or report.state
        return DiagnosticEntry(
            level, f"{self._topics.node(report.uuid)}: measurement", message, report.uuid, tuple(values)
        )

    def _command(self, uuid: str, channel: int, value: float) -> None:
        """Handle a set point; non-finite numbers are refused here, and limits applied later, with the unit."""
        if self._commands is None or not math.isfinite(value):
            self.refused_commands += 1
            return
        self._commands(SetPointCommand(uuid, channel, value, time.monotonic()))


def _name_of(joint: Joint) -> str:
    return joint.name
