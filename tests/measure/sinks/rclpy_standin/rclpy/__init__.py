"""A stand-in for rclpy: the names that our child uses, each call checked; what it is told goes to a file.

It is no ROS. The names and types are those of rclpy's documentation (Humble to Jazzy).
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from typing import Any

from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

_TOPIC = re.compile(r"/?([A-Za-z_][A-Za-z0-9_]*)(/[A-Za-z_][A-Za-z0-9_]*)*\Z")
_up: list[bool] = []


def note(**words: Any) -> None:
    """A line for the test."""
    with open(os.environ["STANDIN_NOTES"], "a", encoding="utf-8") as notes:
        notes.write(json.dumps(words) + "\n")


def init(*, args: list[str] | None = None) -> None:
    """Begin."""
    assert not _up
    _up.append(True)
    note(event="init", domain=os.environ.get("ROS_DOMAIN_ID"))


def shutdown() -> None:
    """End."""
    assert _up
    note(event="shutdown")


class Publisher:
    """Takes messages of its own type alone."""

    def __init__(self, kind: type, topic: str) -> None:
        self._kind, self._topic = kind, topic

    def publish(self, message: Any) -> None:
        assert type(message) is self._kind, message
        note(event="message", topic=self._topic, type=message.type_name, octets=message.octets().hex())


class Node:
    """One node."""

    def __init__(self, name: str) -> None:
        assert re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name), name
        self._name = name
        self._parameters: dict[str, Any] = {}
        self._may: list[Callable[[list[Parameter]], Any]] = []
        self.subscriptions_: list[tuple[type, str, Callable[[Any], None]]] = []

    def get_name(self) -> str:
        return self._name

    def create_publisher(self, msg_type: type, topic: str, qos_profile: QoSProfile) -> Publisher:
        assert _TOPIC.match(topic), topic
        latched = qos_profile.durability is DurabilityPolicy.TRANSIENT_LOCAL
        assert qos_profile.reliability is ReliabilityPolicy.RELIABLE
        note(event="publisher", topic=topic, type=msg_type.type_name, latched=latched)  # type: ignore[attr-defined]
        return Publisher(msg_type, topic)

    def create_subscription(
        self, msg_type: type, topic: str, callback: Callable[[Any], None], qos_profile: QoSProfile
    ) -> object:
        assert _TOPIC.match(topic), topic
        note(event="subscription", topic=topic, reliable=qos_profile.reliability is ReliabilityPolicy.RELIABLE)
        self.subscriptions_.append((msg_type, topic, callback))
        return object()

    def add_on_set_parameters_callback(self, callback: Callable[[list[Parameter]], Any]) -> None:
        self._may.append(callback)

    def has_parameter(self, name: str) -> bool:
        return name in self._parameters

    def declare_parameter(self, name: str, value: Any, descriptor: Any) -> None:
        assert name not in self._parameters, "ParameterAlreadyDeclaredException"
        assert descriptor.dynamic_typing is True
        self._set(Parameter(name, value=value))

    def set_parameters(self, parameter_list: list[Parameter]) -> list[Any]:
        for one in parameter_list:
            assert one.name in self._parameters, "ParameterNotDeclaredException"
            self._set(one)
        return []

    def _set(self, one: Parameter) -> None:
        answers = [may([one]) for may in self._may]
        assert all(answer.successful for answer in answers), answers
        self._parameters[one.name] = one.value
        note(event="parameter", name=one.name, value=one.value)

    def from_outside(self) -> None:
        """As `ros2 param set` would."""
        if self._parameters:
            answer = self._may[0]([Parameter(next(iter(self._parameters)), value=1)])
            note(event="outside", successful=answer.successful, reason=answer.reason)

    def destroy_node(self) -> None:
        note(event="destroyed")


def create_node(node_name: str) -> Node:
    """A node."""
    assert _up
    return Node(node_name)
