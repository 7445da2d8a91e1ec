"""Runs on Debian's own Python, as a child of the ROS 1 sink: lines of JSON on stdin become rospy messages.

Nothing of this package is imported here, and nothing but rospy beside the standard library: that Python has other
versions of everything. Out go lines of JSON too: ready, and set points of actuators. It ends when stdin closes, and
with exit code 3 when the master is gone or was restarted, 4 when another program took the node's name (the
parent then starts another one).

Lines in: ``{"op": "topic", "id": 1, "topic": "/a", "type": "std_msgs/Float64", "latch": false}``,
``{"op": "named", "id": 1, "v": [names]}``,
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
from contextlib import suppress
from typing import Any

WATCH = 1.0  # seconds between checks of the master
NO_MASTER, NAME_TAKEN = 3, 4
QUEUE = 1000  # messages that one subscriber may lag behind: enough for bursts of rows and delays of a busy machine
MEETING = 1.0  # seconds for the subscribers that the master lists to connect
KNOWN = 0.3  # seconds for which the master's list of subscribers is reused
BURST, PAUSE = 20, 0.002  # messages sent at once, and the pause after them: more would overflow a queue
LEAVING = 1.0  # seconds for the last messages to leave

INTERFACES = ("position", "velocity", "effort")  # of sensor_msgs/JointState


def send_line(**words: object) -> None:
    """Send one line to the parent."""
    with _OUT:
        sys.stdout.write(json.dumps(words) + "\n")
        sys.stdout.flush()


_OUT = threading.Lock()


def wait_for_master(rosgraph: Any) -> None:
    """Wait for a master: init_node without one would block for ever, without any message to pass on."""
    reported, parent = False, os.getppid()
    while not rosgraph.is_master_online():
        if os.getppid() != parent:
            os._exit(0)  # reading stdin would show that the parent was killed, but it is not read yet
        if not reported:
            send_line(event="waiting", master=os.environ.get("ROS_MASTER_URI", "http://localhost:11311"))
            reported = True
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


def leave(reason: str) -> None:
    """End with the reason when another node takes our name; rospy would go on without a connection."""
    if "same name" in reason:
        os._exit(NAME_TAKEN)


class Outlet:
    """A publisher. Its first messages wait for subscribers that the master knows of, MEETING seconds at most.

    A subscriber connects some tenths of a second after it learned of the publisher; rows of that time would be lost.
    """

    def __init__(self, publisher: Any, kind: Any, expected: int) -> None:
        self.publisher, self.kind, self._expected = publisher, kind, expected
        self._until = time.monotonic() + MEETING
        self._waiting: list[Any] | None = [] if expected else None

    def publish(self, message: Any) -> None:
        """Publish now, or after the messages that wait."""
        if self._waiting is None:
            self.publisher.publish(message)
            return
        self._waiting.append(message)
        self.met()

    def met(self) -> bool:
        """Return True if no subscriber is waited for any more; then the waiting messages have gone."""
        if self._waiting is None:
            return True
        if time.monotonic() < self._until and self.publisher.get_num_connections() < self._expected:
            return False
        waiting, self._waiting = self._waiting, None
        for k, message in enumerate(waiting, start=1):
            self.publisher.publish(message)
            if not k % BURST:
                time.sleep(PAUSE)
        return True

    def sent(self) -> bool:
        """Return True if its connections have taken all of it; their queues are rospy's own."""
        connections = getattr(self.publisher.impl, "connections", ()) if self.publisher.impl else ()
        return not any(getattr(connection, "_queue", ()) for connection in connections)


class Bridge:
    """Publishers and subscribers by the parent's numbers; ``master`` knows who subscribes."""

    def __init__(self, rospy: Any, master: Any) -> None:
        self.rospy, self.master = rospy, master
        self.publishers: dict[int, Outlet] = {}
        self.names: dict[int, list[str]] = {}
        self.types: dict[str, Any] = {}
        self.listening: dict[str, Any] = {}
        self._subscribed: tuple[float, dict[str, int]] = (0.0, {})

    def subscribers(self, topic: str) -> int:
        """Return how many nodes subscribe to a topic, as the master knows it; some of them may be dead."""
        if time.monotonic() > self._subscribed[0] + KNOWN:
            found = {}
            with suppress(Exception):  # an XML-RPC client raises errors of the socket and of the master
                found = {name: len(nodes) for name, nodes in self.master.getSystemState()[1]}
            self._subscribed = time.monotonic(), found
        return self._subscribed[1].get(topic, 0)

    def end(self) -> None:
        """Wait until what came has gone."""
        end = time.monotonic() + MEETING + LEAVING
        for ready in (Outlet.met, Outlet.sent):
            while not all(map(ready, self.publishers.values())) and time.monotonic() < end:
                time.sleep(PAUSE)

    def type_of(self, name: str) -> Any:
        """Return the message class of ``package/Type``."""
        if name not in self.types:
            package, _, kind = name.partition("/")
            self.types[name] = getattr(importlib.import_module(package + ".msg"), kind)
        return self.types[name]

    def stamp(self, seconds: float) -> Any:
        """Return unix seconds as a ROS time."""
        return self.rospy.Time.from_sec(seconds)

    def topic(self, line: dict[str, Any]) -> None:
        """Advertise; each subscriber has a separate queue, so that a slow one delays no other."""
        kind, latch = self.type_of(line["type"]), line["latch"]
        made = self.rospy.Publisher(line["topic"], kind, queue_size=QUEUE, latch=latch)
        self.publishers[line["id"]] = Outlet(made, kind, 0 if latch else self.subscribers(line["topic"]))

    def retire(self, line: dict[str, Any]) -> None:
        """Take a publisher back, and what it keeps for late comers with it."""
        self.publishers.pop(line["id"]).publisher.unregister()

    def named(self, line: dict[str, Any]) -> None:
        """Store the names for the values of the next rows."""
        self.names[line["id"]] = line["v"]

    def joint(self, line: dict[str, Any]) -> None:
        """Publish a row of a group."""
        publisher = self.publishers[line["id"]]
        message = publisher.kind()
        message.header.stamp = self.stamp(line["t"])
        message.name = self.names[line["id"]]
        message.position = [float("nan") if value is None else value for value in line["v"]]
        message.velocity, message.effort = line.get("vel", []), line.get("eff", [])
        publisher.publish(message)

    def value(self, line: dict[str, Any]) -> None:
        """Publish one value of a channel."""
        publisher = self.publishers[line["id"]]
        message = publisher.kind()
        setattr(message, line["field"], line["v"])
        if hasattr(message, "header"):
            message.header.stamp = self.stamp(line["t"])
            message.header.frame_id = line["frame"]
        if hasattr(message, "variance"):
            message.variance = line["var"]
        publisher.publish(message)

    def compound(self, line: dict[str, Any]) -> None:
        """Publish a message of several values, its fields by path; fields that this distribution lacks are left out."""
        publisher = self.publishers[line["id"]]
        message = publisher.kind()
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
        """Publish a text on a topic."""
        publisher = self.publishers[line["id"]]
        publisher.publish(publisher.kind(line["v"]))

    def status(self, line: dict[str, Any]) -> None:
        """Publish a DiagnosticArray."""
        publisher = self.publishers[line["id"]]
        message = publisher.kind()
        message.header.stamp = self.stamp(line["t"])
        entry, pair = self.type_of("diagnostic_msgs/DiagnosticStatus"), self.type_of("diagnostic_msgs/KeyValue")
        for level, name, text, hardware, values in line["v"]:
            pairs = [pair(key, value) for key, value in values]
            message.status.append(entry(level, name, text, hardware, pairs))
        publisher.publish(message)

    def param(self, line: dict[str, Any]) -> None:
        """Set a parameter; the master may be gone just now, which is detected elsewhere."""
        try:
            self.rospy.set_param(line["key"], line["value"])
        except Exception as error:  # noqa: BLE001  rospy lets sockets' and XML-RPC's exceptions through
            send_line(event="trouble", what=f"parameter {line['key']}: {error}")

    def listen(self, line: dict[str, Any]) -> None:
        """Set points of an actuator, newest only."""
        uuid, channel = line["uuid"], line["channel"]
        if line["topic"] in self.listening:
            return

        def came(message: Any) -> None:
            send_line(event="command", uuid=uuid, channel=channel, value=repr(message.data))

        kind = self.type_of("std_msgs/Float64")
        self.listening[line["topic"]] = self.rospy.Subscriber(line["topic"], kind, came, queue_size=1)

    def listen_joints(self, line: dict[str, Any]) -> None:
        """Set points of joints, newest only; numbers as texts, for JSON has no NaN."""
        if line["topic"] in self.listening:
            return

        def came(message: Any) -> None:
            given = {name: [repr(float(number)) for number in getattr(message, name)] for name in INTERFACES}
            send_line(event="joints", names=list(message.name), **given)

        kind = self.type_of("sensor_msgs/JointState")
        self.listening[line["topic"]] = self.rospy.Subscriber(line["topic"], kind, came, queue_size=1)


def main() -> None:
    """Wait for a master, be a node, carry lines."""
    import rosgraph
    import rospy

    wait_for_master(rosgraph)
    rospy.init_node(sys.argv[1], disable_signals=True, anonymous=False)
    rospy.core.add_preshutdown_hook(leave)
    bridge = Bridge(rospy, rosgraph.Master(rospy.get_name()))
    threading.Thread(target=watch_master, args=(rosgraph, rospy.get_name()), daemon=True).start()
    send_line(event="ready", node=rospy.get_name())
    for line in sys.stdin:
        words = json.loads(line)
        getattr(bridge, words["op"])(words)
    bridge.end()
    rospy.signal_shutdown("the parent has ended")
    # Threads of rospy may hang on a subscriber that is gone, and all output has been sent.
    os._exit(0)


if __name__ == "__main__":
    main()
