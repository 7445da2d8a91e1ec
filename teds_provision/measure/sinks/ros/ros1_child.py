"""Runs on Debian's own Python, as a child of the ROS 1 sink: lines of JSON on stdin become rospy messages.

Nothing of this package is imported here, and nothing but rospy beside the standard library: that Python has other
versions of everything. Out go lines of JSON too: ready, and set points of actuators. It ends when stdin closes, and
with exit code 3 when the master is gone or has been started anew (the parent then starts another one).

Lines in: ``{"op": "topic", "id": 1, "topic": "/a", "type": "std_msgs/Float64", "latch": false, "names": […]}``,
``{"op": "joint", "id": 1, "t": seconds, "v": […]}``, ``{"op": "value", "id", "t", "field", "frame", "v", "var"}``,
``{"op": "text", "id", "v"}``, ``{"op": "status", "id", "t", "v": […]}``, ``{"op": "param", "key", "value"}``,
``{"op": "listen", "topic", "uuid", "channel"}``.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import threading
import time
from typing import Any

WATCH = 1.0  # seconds between looks at the master
NO_MASTER = 3


def say(**words: object) -> None:
    """One line to the parent."""
    with _OUT:
        sys.stdout.write(json.dumps(words) + "\n")
        sys.stdout.flush()


_OUT = threading.Lock()


def wait_for_master(rosgraph: Any) -> None:
    """Until there is a master: init_node without one would block for ever, and say nothing that we could pass on."""
    told, parent = False, os.getppid()
    while not rosgraph.is_master_online():
        if os.getppid() != parent:
            os._exit(0)  # a parent that was killed closes our stdin, which nobody reads yet
        if not told:
            say(event="waiting", master=os.environ.get("ROS_MASTER_URI", "http://localhost:11311"))
            told = True
        time.sleep(WATCH)


def watch_master(rosgraph: Any, name: str) -> None:
    """End when the master is gone, or is another one that does not know this node."""
    master = rosgraph.Master(name)
    missed = 0
    while True:
        time.sleep(WATCH)
        try:
            known = master.lookupNode(name)
            missed = 0 if known else missed + 1
        except Exception:  # noqa: BLE001  whatever a socket, or the master itself, throws at an XML-RPC client
            missed += 1
        if missed >= 2:
            os._exit(NO_MASTER)


class Bridge:
    """Publishers and subscribers by the parent's numbers."""

    def __init__(self, rospy: Any) -> None:
        self.rospy = rospy
        self.publishers: dict[int, tuple[Any, Any]] = {}
        self.names: dict[int, list[str]] = {}
        self.types: dict[str, Any] = {}
        self.listening: dict[str, Any] = {}

    def type_of(self, name: str) -> Any:
        """Message class of ``package/Type``."""
        if name not in self.types:
            package, _, kind = name.partition("/")
            self.types[name] = getattr(importlib.import_module(package + ".msg"), kind)
        return self.types[name]

    def stamp(self, seconds: float) -> Any:
        """Unix seconds as ROS takes them."""
        return self.rospy.Time.from_sec(seconds)

    def topic(self, line: dict[str, Any]) -> None:
        """Advertise; a queue of 10, so that one slow subscriber holds up nobody."""
        kind = self.type_of(line["type"])
        self.publishers[line["id"]] = (
            self.rospy.Publisher(line["topic"], kind, queue_size=10, latch=line["latch"]),
            kind,
        )
        self.names[line["id"]] = line.get("names", [])

    def joint(self, line: dict[str, Any]) -> None:
        """A row of a group."""
        publisher, kind = self.publishers[line["id"]]
        message = kind()
        message.header.stamp = self.stamp(line["t"])
        message.name = self.names[line["id"]]
        message.position = [float("nan") if value is None else value for value in line["v"]]
        publisher.publish(message)

    def value(self, line: dict[str, Any]) -> None:
        """One value of a channel."""
        publisher, kind = self.publishers[line["id"]]
        message = kind()
        setattr(message, line["field"], line["v"])
        if hasattr(message, "header"):
            message.header.stamp = self.stamp(line["t"])
            message.header.frame_id = line["frame"]
        if hasattr(message, "variance"):
            message.variance = line["var"]
        publisher.publish(message)

    def compound(self, line: dict[str, Any]) -> None:
        """A message of several values, its fields by path; what this distribution's type has not is left out."""
        publisher, kind = self.publishers[line["id"]]
        message = kind()
        message.header.stamp = self.stamp(line["t"])
        message.header.frame_id = line["frame"]
        for path, value in line["v"].items():
            *way, last = path.split(".")
            part = message
            for name in way:
                part = getattr(part, name)
            if hasattr(part, last):
                setattr(part, last, value)
        publisher.publish(message)

    def text(self, line: dict[str, Any]) -> None:
        """Words."""
        publisher, kind = self.publishers[line["id"]]
        publisher.publish(kind(line["v"]))

    def status(self, line: dict[str, Any]) -> None:
        """A DiagnosticArray."""
        publisher, kind = self.publishers[line["id"]]
        message = kind()
        message.header.stamp = self.stamp(line["t"])
        entry, pair = self.type_of("diagnostic_msgs/DiagnosticStatus"), self.type_of("diagnostic_msgs/KeyValue")
        for level, name, text, hardware, values in line["v"]:
            pairs = [pair(key, value) for key, value in values]
            message.status.append(entry(level, name, text, hardware, pairs))
        publisher.publish(message)

    def param(self, line: dict[str, Any]) -> None:
        """A parameter; the master may be gone just now, which is found out elsewhere."""
        try:
            self.rospy.set_param(line["key"], line["value"])
        except Exception as error:  # noqa: BLE001  rospy lets sockets' and XML-RPC's exceptions through
            say(event="trouble", what=f"parameter {line['key']}: {error}")

    def listen(self, line: dict[str, Any]) -> None:
        """Set points of an actuator, newest only."""
        uuid, channel = line["uuid"], line["channel"]
        if line["topic"] in self.listening:
            return

        def came(message: Any) -> None:
            say(event="command", uuid=uuid, channel=channel, value=repr(message.data))

        kind = self.type_of("std_msgs/Float64")
        self.listening[line["topic"]] = self.rospy.Subscriber(line["topic"], kind, came, queue_size=1)


def main() -> None:
    """Wait for a master, be a node, carry lines."""
    import rosgraph
    import rospy

    wait_for_master(rosgraph)
    rospy.init_node(sys.argv[1], disable_signals=True, anonymous=False)
    bridge = Bridge(rospy)
    threading.Thread(target=watch_master, args=(rosgraph, rospy.get_name()), daemon=True).start()
    say(event="ready", node=rospy.get_name())
    for line in sys.stdin:
        words = json.loads(line)
        getattr(bridge, words["op"])(words)
    rospy.signal_shutdown("the parent has ended")
    # Threads of rospy may hang on a subscriber that is gone; everything that had to go out has gone out.
    os._exit(0)


if __name__ == "__main__":
    main()
