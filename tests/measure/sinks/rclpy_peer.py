"""Runs under a Python with the real rclpy: another node, controlled by lines of JSON, printing what it hears.

``{"op": "hear", "topic", "type", "latched"}``, ``{"op": "publish", "topic", "type", "fields"}``, ``{"op": "graph"}``,
``{"op": "parameters", "node", "names"}``, ``{"op": "set", "node", "name", "value"}``. It ends when stdin closes.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import threading
from typing import Any

import rclpy
from rclpy import qos
from rclpy.executors import SingleThreadedExecutor

_OUT = threading.Lock()


def show(**words: Any) -> None:
    with _OUT:
        print(json.dumps(words), flush=True)


def plain(value: Any) -> Any:
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        return list(value)
    if hasattr(value, "tolist"):  # arrays of numpy and of the standard library
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def kind_of(name: str) -> Any:
    package, _, kind = name.partition("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def profile(*, latched: bool, reliable: bool = True) -> Any:
    return qos.QoSProfile(
        depth=10,
        durability=qos.DurabilityPolicy.TRANSIENT_LOCAL if latched else qos.DurabilityPolicy.VOLATILE,
        reliability=qos.ReliabilityPolicy.RELIABLE if reliable else qos.ReliabilityPolicy.BEST_EFFORT,
    )


def _kinds(offered: Any) -> tuple[Any, Any]:
    return offered.reliability, offered.durability


class Peer:
    def __init__(self, node: Any) -> None:
        self.node = node
        self.publishers: dict[str, Any] = {}

    def hear(self, line: dict[str, Any]) -> None:
        topic = line["topic"]
        self.node.create_subscription(
            kind_of(line["type"]),
            topic,
            lambda message: show(event="message", topic=topic, message=plain(message)),
            profile(latched=line.get("latched", False), reliable=line.get("reliable", True)),
        )

    def publish(self, line: dict[str, Any]) -> None:
        kind = kind_of(line["type"])
        if line["topic"] not in self.publishers:
            self.publishers[line["topic"]] = self.node.create_publisher(kind, line["topic"], profile(latched=False))
        self.publishers[line["topic"]].publish(kind(**line["fields"]))

    def graph(self, _line: dict[str, Any]) -> None:
        topics = {
            topic: {
                "types": types,
                "publishers": [
                    [f"{item.node_namespace}{item.node_name}", *(kind.name for kind in _kinds(item.qos_profile))]
                    for item in self.node.get_publishers_info_by_topic(topic)
                ],
                "subscribers": [
                    f"{item.node_namespace}{item.node_name}"
                    for item in self.node.get_subscriptions_info_by_topic(topic)
                ],
            }
            for topic, types in self.node.get_topic_names_and_types()
        }
        nodes = [f"{space}{name}" for name, space in self.node.get_node_names_and_namespaces()]
        show(event="graph", nodes=nodes, topics=topics)

    def parameters(self, line: dict[str, Any]) -> None:
        service = importlib.import_module("rcl_interfaces.srv").GetParameters
        client = self.node.create_client(service, f"{line['node']}/get_parameters")
        client.wait_for_service(30.0)
        answer = client.call_async(service.Request(names=line["names"]))
        answer.add_done_callback(lambda done: show(event="parameters", values=plain(done.result().values)))

    def set(self, line: dict[str, Any]) -> None:
        service = importlib.import_module("rcl_interfaces.srv").SetParameters
        messages = importlib.import_module("rcl_interfaces.msg")
        value = messages.ParameterValue(type=4, string_value=line["value"])
        client = self.node.create_client(service, f"{line['node']}/set_parameters")
        client.wait_for_service(30.0)
        asked = service.Request(parameters=[messages.Parameter(name=line["name"], value=value)])
        answer = client.call_async(asked)
        answer.add_done_callback(lambda done: show(event="set", results=plain(done.result().results)))


def main() -> None:
    rclpy.init()
    node = rclpy.create_node(sys.argv[1])
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    peer = Peer(node)
    show(event="ready")
    for line in sys.stdin:
        words = json.loads(line)
        getattr(peer, words["op"])(words)
    os._exit(0)


if __name__ == "__main__":
    main()
