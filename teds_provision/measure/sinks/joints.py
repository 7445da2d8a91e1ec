"""Joints: what topic_based_ros2_control sees of actuators and of the sensors that watch them.

That hardware interface of ros2_control reads ``sensor_msgs/JointState`` from one topic and writes it to another. A
joint is an actuator of an angle or a length (commanded by position), of their speeds (velocity), or of a force or
torque (effort), with the sensors of the same node for its state. Its name is the node's part of the topics; with
several such actuators in a node that part, ``_`` and the channel's.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

from teds_provision.measure.blocks import ChannelFacts
from teds_provision.measure.sinks.names import Topics
from teds_provision.teds.codec.model import Units
from teds_provision.teds.units import units_of

Interface = Literal["position", "velocity", "effort"]
INTERFACES: Final[tuple[Interface, ...]] = ("position", "velocity", "effort")
_KINDS: Final[Mapping[Units, Interface]] = {
    units_of(radians=1): "position",
    units_of(meters=1): "position",
    units_of(radians=1, seconds=-1): "velocity",
    units_of(meters=1, seconds=-1): "velocity",
    units_of(meters=1, kilograms=1, seconds=-2): "effort",
    units_of(meters=2, kilograms=1, seconds=-2): "effort",
}


@dataclass(frozen=True)
class Joint:
    """An actuator and what is measured of it; ``state`` has the channel of each interface that a sensor gives."""

    name: str
    uuid: str
    actuator: int
    command: Interface
    state: Mapping[Interface, int]

    def values(self, newest: Mapping[tuple[str, int], float]) -> dict[Interface, float]:
        """Return its state from the newest values; the applied set point is used if there is no sensor."""
        found = {kind: newest.get((self.uuid, number), math.nan) for kind, number in self.state.items()}
        if self.command not in found:
            found[self.command] = newest.get((self.uuid, self.actuator), math.nan)
        return {kind: value for kind, value in found.items() if math.isfinite(value)}


def joints_of(facts: Iterable[ChannelFacts], topics: Topics) -> list[Joint]:
    """Return the joints of some nodes, by name."""
    nodes: dict[str, list[ChannelFacts]] = {}
    for channel_facts in facts:
        if _kind(channel_facts) is not None and not (channel_facts.unsigned or channel_facts.unverified):
            nodes.setdefault(channel_facts.uuid, []).append(channel_facts)
    found = [joint for uuid, channels in nodes.items() for joint in _of_node(uuid, channels, topics)]
    return sorted(found, key=lambda joint: joint.name)


def _kind(facts: ChannelFacts) -> Interface | None:
    return _KINDS.get(facts.units) if facts.units is not None and facts.kind != "event" else None


def _of_node(uuid: str, channels: Sequence[ChannelFacts], topics: Topics) -> list[Joint]:
    by_number = sorted(channels, key=lambda facts: facts.number)
    actuators = [facts for facts in by_number if facts.kind == "actuator"]
    sensors: dict[Interface, list[int]] = {}
    for facts in by_number:
        kind = _kind(facts)
        if facts.kind == "sensor" and kind is not None:
            sensors.setdefault(kind, []).append(facts.number)
    found = []
    for place, facts in enumerate(actuators):
        command = _kind(facts)
        assert command is not None
        name = topics.node(uuid)
        if len(actuators) > 1:
            name = f"{name}_{topics.channel(*facts.key).rpartition('/')[2]}"
        # Sensors are matched to actuators in order; if their numbers differ, the match is unknown.
        state = {kind: own[place] for kind, own in sensors.items() if len(own) == len(actuators)}
        found.append(Joint(name, uuid, facts.number, command, state))
    return found


def state_of(
    joints: Sequence[Joint], newest: Mapping[tuple[str, int], float]
) -> tuple[list[str], list[float], list[float], list[float]]:
    """Return names, positions, velocities and efforts of a JointState.

    A joint without a position is left out: the hardware interface takes one for each name. Velocities and efforts are
    there for all joints or for none, as the message demands.
    """
    known = [(joint.name, values) for joint in joints if "position" in (values := joint.values(newest))]
    velocity = [values["velocity"] for _, values in known if "velocity" in values]
    effort = [values["effort"] for _, values in known if "effort" in values]
    return (
        [name for name, _ in known],
        [values["position"] for _, values in known],
        velocity if len(velocity) == len(known) else [],
        effort if len(effort) == len(known) else [],
    )
