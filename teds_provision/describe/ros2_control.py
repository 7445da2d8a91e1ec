"""A node as joints of ros2_control: a xacro macro for the robot's description, and a controllers.yaml.

The hardware interface is ``topic_based_ros2_control/TopicBasedSystem`` on the topics that the station publishes
(docs/ros.md, "Joints for ros2_control"). Limits come from the datasheet, in rad, m, rad/s, m/s, N·m or N, which are
also ROS's units (REP 103); the update rate is that of the slowest sensor of a joint.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final
from xml.sax.saxutils import quoteattr

from teds_provision.describe.described_node import DescribedNode
from teds_provision.errors import BadDataError
from teds_provision.measure.sinks.joints import Joint, joints_of
from teds_provision.measure.sinks.names import Topics
from teds_provision.measure.verified_session import facts_of

FORM: Final = "ros2_control"


def joints(node: DescribedNode, topics: Topics) -> list[Joint]:
    """Return the joints of a node, named as the station's topics name them; raises BadDataError if it has none."""
    facts = [
        facts_of(node.sheet, channel, name=node.name, fingerprint=node.fingerprint, period=None)
        for channel in node.sheet.channels
    ]
    topics.learn(facts)
    found = joints_of(facts, topics)
    if not found:
        raise BadDataError(
            f"Node {node.uuid.hex()} has no joint.",
            hint="A joint is an actuator of an angle, a length, their speeds, a force or a torque.",
        )
    return found


def xacro(node: DescribedNode, found: Sequence[Joint], topics: Topics) -> str:
    """Return the xacro file of a node: a macro ``teds_NODE``; raises MissingFieldError for a joint without limits."""
    name = topics.node(node.uuid.hex())
    lines = [
        '<?xml version="1.0"?>',
        f"<!-- Node {node.uuid.hex()}, from its signed datasheet {node.fingerprint[:16]}. "
        f"Made by teds-provision describe; change the datasheet instead. -->",
        f"<robot xmlns:xacro={quoteattr('http://www.ros.org/wiki/xacro')}>",
        f"  <xacro:macro name={quoteattr(f'teds_{name}')}>",
        f"    <ros2_control name={quoteattr(name)} type={quoteattr('system')}>",
        "      <hardware>",
        "        <plugin>topic_based_ros2_control/TopicBasedSystem</plugin>",
        f'        <param name="joint_states_topic">/{topics.station}/joint_states</param>',
        f'        <param name="joint_commands_topic">/{topics.station}/joint_commands</param>',
        "        <!-- A command in every cycle: repeated set points keep the actuator alive. -->",
        '        <param name="trigger_joint_command_threshold">-1.0</param>',
        "      </hardware>",
    ]
    for joint in found:
        low, high = _limits(node, joint)
        lines += [
            f"      <joint name={quoteattr(joint.name)}>",
            f"        <command_interface name={quoteattr(joint.command)}>",
            f'          <param name="min">{low!r}</param>',
            f'          <param name="max">{high!r}</param>',
            "        </command_interface>",
            *(f"        <state_interface name={quoteattr(kind)}/>" for kind in _states(joint)),
            "      </joint>",
        ]
    return "\n".join([*lines, "    </ros2_control>", "  </xacro:macro>", "</robot>", ""])


def controllers(node: DescribedNode, found: Sequence[Joint], topics: Topics) -> str:
    """Return controllers.yaml: a broadcaster of the joints' states, and a forward controller for each interface."""
    name = topics.node(node.uuid.hex())
    by_command: dict[str, list[str]] = {}
    for joint in found:
        by_command.setdefault(joint.command, []).append(joint.name)
    manager: dict[str, Any] = {
        "update_rate": _rate(node, found),
        "joint_state_broadcaster": {"type": "joint_state_broadcaster/JointStateBroadcaster"},
    }
    files: dict[str, Any] = {"controller_manager": {"ros__parameters": manager}}
    for command, names in by_command.items():
        controller = f"{name}_{command}_controller"
        manager[controller] = {"type": "forward_command_controller/ForwardCommandController"}
        files[controller] = {"ros__parameters": {"joints": names, "interface_name": command}}
    return "\n".join(_yaml(files)) + "\n"


def _states(joint: Joint) -> list[str]:
    """Return the state interfaces of a joint; the applied set point is the state if no sensor measures it."""
    return [kind for kind in ("position", "velocity", "effort") if kind in joint.state or kind == joint.command]


def _limits(node: DescribedNode, joint: Joint) -> tuple[float, float]:
    channel = node.sheet.channel(joint.actuator)
    assert channel is not None
    for value, field, key in ((channel.low, "LowLimit", "low-limit"), (channel.high, "HiLimit", "high-limit")):
        if not math.isfinite(value):
            raise node.missing(FORM, f"{field} of channel {channel.number}", f"{key} in [channel.{channel.number}]")
    return channel.low, channel.high


def _rate(node: DescribedNode, found: Sequence[Joint]) -> int:
    """Return the update rate in Hz, at least 1: that of the slowest channel that a cycle needs."""
    numbers = {number for joint in found for number in (joint.actuator, *joint.state.values())}
    periods = [
        channel.period
        for channel in node.sheet.channels
        if channel.number in numbers and math.isfinite(channel.period) and channel.period > 0
    ]
    if not periods:
        raise node.missing(FORM, "SPeriod of a joint's channel", f"sampling-period in [channel.{min(numbers)}]")
    return max(1, math.floor(1 / max(periods) + 1e-6))


def _yaml(value: Mapping[str, Any], indent: int = 0) -> list[str]:
    """Return a mapping of mappings, texts, numbers and lists of texts as YAML; its texts need no quotes."""
    lines = []
    for key, part in value.items():
        if isinstance(part, Mapping):
            lines += [f"{' ' * indent}{key}:", *_yaml(part, indent + 2)]
        elif isinstance(part, list):
            lines.append(f"{' ' * indent}{key}: [{', '.join(part)}]")
        else:
            lines.append(f"{' ' * indent}{key}: {part}")
    return lines
