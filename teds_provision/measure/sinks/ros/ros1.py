"""ROS 1: topics, parameters, latched metadata and actuator subscribers by Debian's rospy, in a child process.

When the master goes, the child is restarted and waits for it.
"""

from __future__ import annotations

import os
from pathlib import Path

from teds_provision.errors import TedsProvisionError
from teds_provision.measure.blocks import ChannelFacts, StationFacts
from teds_provision.measure.sinks.base import CommandTaker
from teds_provision.measure.sinks.ros import child, ros1_child
from teds_provision.measure.sinks.ros.child import ChildSink

PYTHON = "/usr/bin/python3"
NEEDS = "rospy, sensor_msgs.msg, diagnostic_msgs.msg"


class Ros1Sink(ChildSink):
    """``ros1`` or ``ros1:http://HOST:PORT``, the master's URI; else ROS_MASTER_URI."""

    def __init__(self, spec: str, commands: CommandTaker | None = None) -> None:
        super().__init__("ROS 1", "rospy", commands)
        self._master = spec.partition(":")[2]

    def _prepare(self, facts: tuple[ChannelFacts, ...], station: StationFacts) -> None:
        super()._prepare(facts, station)
        if not child.imports(PYTHON, NEEDS, self._environment()):
            raise TedsProvisionError(
                f"{PYTHON} has no rospy.",
                hint="Install it: apt install python3-rospy python3-sensor-msgs python3-diagnostic-msgs",
            )

    def _environment(self) -> dict[str, str]:
        """Return the environment without the virtual environment's paths; a ROS that the user sourced keeps its own."""
        kept = child.environment(sourced="/opt/ros/" in os.environ.get("PYTHONPATH", ""))
        if self._master:
            kept["ROS_MASTER_URI"] = self._master
        return kept

    def _program(self) -> list[str]:
        return [PYTHON, "-s", str(Path(ros1_child.__file__))]
