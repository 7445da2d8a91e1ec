"""Runs on a Python that has rclpy, as a child of the sink: lines of JSON become rclpy messages.

Nothing of this package is imported here, and nothing but rclpy and its messages beside the standard library. The lines
are those of :mod:`ros1_child`. It ends when stdin closes. API of rclpy from Humble on: https://docs.ros.org/en/jazzy/p/rclpy/
"""

from __future__ import annotations

import importlib
import json
import os
import socket
import sys
import threading
from typing import Any

LO = b"lo"
PORTS, FIRST_PORT = 250, 7400  # of a DDS domain; of domain 0
HISTORY = 100  # messages that a reader may lag behind, enough for a burst of rows

INTERFACES = ("position", "velocity", "effort")  # of sensor_msgs/JointState


def send_line(**words: object) -> None:
    """Send one line to the parent."""
    with _OUT:
        sys.stdout.write(json.dumps(words) + "\n")
        sys.stdout.flush()


_OUT = threading.Lock()


def plain(value: Any) -> Any:
    """Return a value as a parameter may have it: lists of one type, no null, no table."""
    if isinstance(value, list):
        kinds = {type(element) for element in value}
        if kinds <= {int, float}:
            return [float(element) for element in value]
        return value if kinds in ({str}, {bool}) else json.dumps(value)
    return value if isinstance(value, bool | int | float | str) else json.dumps(value)


def ports_of(domain: int, count: int = PORTS) -> range:
    """Return the first so many ports of a DDS domain; a participant has two of them."""
    first = FIRST_PORT + PORTS * domain
    return range(first, first + count)


def keep_on_loopback(ports: range) -> None:
    """Bind those ports on which this process listens to the loopback device.

    Cyclone DDS and Fast DDS can be restricted to announce themselves on loopback alone, but listen on every address:
    any host on the network could send them set points. Linux 5.7 and later let a process do so without privileges.
    """
    for name in os.listdir("/proc/self/fd"):
        try:
            is_socket = os.readlink(f"/proc/self/fd/{name}").startswith("socket:")
            one = socket.socket(fileno=os.dup(int(name))) if is_socket else None
        except OSError:  # closed meanwhile
            continue
        if one is None:
            continue
        with one:
            if one.family == socket.AF_INET and one.type == socket.SOCK_DGRAM:
                address, port = one.getsockname()
                if address == "0.0.0.0" and port in ports:
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, LO)


def on_this_machine_alone() -> bool:
    """Return True if the environment keeps ROS 2 on this machine; ROS_LOCALHOST_ONLY is its older name."""
    local = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() in ("LOCALHOST", "OFF")
    return (local and not os.environ.get("ROS_STATIC_PEERS")) or os.environ.get("ROS_LOCALHOST_ONLY") == "1"


class Bridge:
    """Publishers, subscriptions and parameters of one node, by the parent's numbers."""

    def __init__(self, rclpy: Any, node: Any) -> None:
        self.rclpy, self.node = rclpy, node
        self.publishers: dict[int, tuple[Any, Any]] = {}
        self.names: dict[int, list[str]] = {}
        self.types: dict[str, Any] = {}
        self.listening: dict[str, Any] = {}
        self._own = False
        node.add_on_set_parameters_callback(self._may_set)

    def _may_set(self, _parameters: Any) -> Any:
        """Refuse parameters from outside: they are facts of datasheets."""
        answer = importlib.import_module("rcl_interfaces.msg").SetParametersResult()
        answer.successful = self._own
        answer.reason = "" if self._own else "a fact of a signed datasheet"
        return answer

    def type_of(self, name: str) -> Any:
        """Return the message class of ``package/Type``."""
        if name not in self.types:
            package, _, kind = name.partition("/")
            self.types[name] = getattr(importlib.import_module(package + ".msg"), kind)
        return self.types[name]

    def qos(self, *, latched: bool, reading: bool = False) -> Any:
        """Return the QoS: latched for metadata, else reliable with a short history; set points: best effort."""
        from rclpy import qos

        return qos.QoSProfile(
            history=qos.HistoryPolicy.KEEP_LAST,
            depth=1 if latched or reading else HISTORY,
            reliability=qos.ReliabilityPolicy.BEST_EFFORT if reading else qos.ReliabilityPolicy.RELIABLE,
            durability=qos.DurabilityPolicy.TRANSIENT_LOCAL if latched else qos.DurabilityPolicy.VOLATILE,
        )

    def topic(self, line: dict[str, Any]) -> None:
        """Create the publisher of a topic."""
        kind = self.type_of(line["type"])
        made = self.node.create_publisher(kind, line["topic"], self.qos(latched=line["latch"]))
        self.publishers[line["id"]] = made, kind

    def retire(self, line: dict[str, Any]) -> None:
        """Take a publisher back, and what it keeps for late comers with it."""
        self.node.destroy_publisher(self.publishers.pop(line["id"])[0])

    def message(self, line: dict[str, Any]) -> tuple[Any, Any]:
        """Return the publisher of a line, and an empty message with its header."""
        publisher, kind = self.publishers[line["id"]]
        message = kind()
        if hasattr(message, "header"):
            nanoseconds = round(line["t"] * 1e9)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
            message.header.frame_id = line.get("frame", "")
        return publisher, message

    def named(self, line: dict[str, Any]) -> None:
        """Store the names for the values of the next rows."""
        self.names[line["id"]] = line["v"]

    def joint(self, line: dict[str, Any]) -> None:
        """Publish a row of a group."""
        publisher, message = self.message(line)
        message.name = self.names[line["id"]]
        message.position = [float("nan") if value is None else float(value) for value in line["v"]]
        message.velocity, message.effort = line.get("vel", []), line.get("eff", [])
        publisher.publish(message)

    def value(self, line: dict[str, Any]) -> None:
        """Publish one value of a channel."""
        publisher, message = self.message(line)
        setattr(message, line["field"], float(line["v"]))
        if hasattr(message, "variance"):
            message.variance = float(line["var"])
        publisher.publish(message)

    def compound(self, line: dict[str, Any]) -> None:
        """Publish a message of several values, its fields by path; fields that this distribution lacks are left out."""
        publisher, message = self.message(line)
        for path, value in line["v"].items():
            *way, last = path.split(".")
            part = message
            for name in way:
                part = getattr(part, name)
            if hasattr(part, last):
                setattr(part, last, value)
        publisher.publish(message)

    def text(self, line: dict[str, Any]) -> None:
        """Publish a text on a topic."""
        publisher, message = self.message(line)
        message.data = line["v"]
        publisher.publish(message)

    def status(self, line: dict[str, Any]) -> None:
        """Publish a DiagnosticArray; rclpy has an octet as bytes of length 1."""
        publisher, message = self.message(line)
        entry, pair = self.type_of("diagnostic_msgs/DiagnosticStatus"), self.type_of("diagnostic_msgs/KeyValue")
        message.status = [
            entry(
                level=bytes([level]), name=name, message=text, hardware_id=hardware,
                values=[pair(key=key, value=value) for key, value in values],
            )
            for level, name, text, hardware, values in line["v"]
        ]  # fmt: skip
        publisher.publish(message)

    def param(self, line: dict[str, Any]) -> None:
        """Set the facts of a channel as parameters ``station.node.channel.fact`` of this node."""
        from rclpy.parameter import Parameter

        descriptor = importlib.import_module("rcl_interfaces.msg").ParameterDescriptor(dynamic_typing=True)
        self._own = True
        try:
            for fact, given in line["value"].items():
                name, value = f"{line['key'].strip('/').replace('/', '.')}.{fact}", plain(given)
                if self.node.has_parameter(name):
                    self.node.set_parameters([Parameter(name, value=value)])
                else:
                    self.node.declare_parameter(name, value, descriptor)
        finally:
            self._own = False

    def listen(self, line: dict[str, Any]) -> None:
        """Set points of an actuator, newest only."""
        uuid, channel = line["uuid"], line["channel"]
        if line["topic"] in self.listening:
            return

        def came(message: Any) -> None:
            send_line(event="command", uuid=uuid, channel=channel, value=repr(message.data))

        kind, asked = self.type_of("std_msgs/Float64"), self.qos(latched=False, reading=True)
        self.listening[line["topic"]] = self.node.create_subscription(kind, line["topic"], came, asked)

    def listen_joints(self, line: dict[str, Any]) -> None:
        """Set points of joints, newest only; numbers as texts, for JSON has no NaN."""
        if line["topic"] in self.listening:
            return

        def came(message: Any) -> None:
            given = {name: [repr(float(number)) for number in getattr(message, name)] for name in INTERFACES}
            send_line(event="joints", names=list(message.name), **given)

        kind, asked = self.type_of("sensor_msgs/JointState"), self.qos(latched=False, reading=True)
        self.listening[line["topic"]] = self.node.create_subscription(kind, line["topic"], came, asked)


def main() -> None:
    """Run the ROS node: publish the lines of the parent."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    rclpy.init()
    node = rclpy.create_node(sys.argv[1])
    if on_this_machine_alone():
        keep_on_loopback(ports_of(int(os.environ.get("ROS_DOMAIN_ID", "0"))))
        keep_on_loopback(range(1, 10_000))  # Fast DDS uses one more port, 7000
    bridge = Bridge(rclpy, node)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    send_line(event="ready", node=node.get_name())
    for line in sys.stdin:
        words = json.loads(line)
        getattr(bridge, words["op"])(words)
    executor.shutdown(1.0)
    node.destroy_node()
    rclpy.shutdown()
    # Threads of the middleware may hang on a peer that is gone, and all output has been sent.
    os._exit(0)


if __name__ == "__main__":
    main()
