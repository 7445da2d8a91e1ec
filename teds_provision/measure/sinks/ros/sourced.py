"""ROS 2 by the user's own rclpy, where a ROS 2 is sourced: its middleware, its settings, its parameter services.

``source /opt/ros/jazzy/setup.bash`` sets AMENT_PREFIX_PATH. Then a Python that can import rclpy carries the topics in
a child process; RMW_IMPLEMENTATION, ROS_DOMAIN_ID, ROS_LOCALHOST_ONLY, ROS_AUTOMATIC_DISCOVERY_RANGE are the user's.
Without one, Cyclone DDS does it (:mod:`ros2`).
"""

from __future__ import annotations

import functools
import os
import shutil
from pathlib import Path

from teds_provision.measure.sinks.base import CommandTaker, Sink
from teds_provision.measure.sinks.ros import child, rclpy_child
from teds_provision.measure.sinks.ros.child import ChildSink
from teds_provision.measure.sinks.ros.ros2 import Ros2Sink, domain_of

SYSTEM = "/usr/bin/python3"
NEEDS = "rclpy, std_msgs.msg, sensor_msgs.msg, geometry_msgs.msg, diagnostic_msgs.msg"


def ros2_sink(spec: str, commands: CommandTaker | None = None) -> Sink:
    """The sink of ``ros2`` or ``ros2:DOMAIN``: by the sourced rclpy, else by Cyclone DDS. Raises UsageFailure."""
    domain = domain_of(spec)
    sourced = os.environ.get("AMENT_PREFIX_PATH", "")
    python = _python(sourced, os.environ.get("PYTHONPATH", "")) if sourced else None
    return Ros2Sink(spec, commands) if python is None else RclpySink(python, domain, commands)


@functools.cache
def _python(_sourced: str, _paths: str) -> str | None:
    """The Python that imports rclpy in this environment, None where none does; found out once in a process."""
    around = child.environment(sourced=True)
    conda = os.environ.get("CONDA_PREFIX", "")
    found = [f"{conda}/bin/python3" if conda else "", SYSTEM, shutil.which("python3") or ""]
    return next((one for one in dict.fromkeys(found) if one and child.imports(one, NEEDS, around)), None)


class RclpySink(ChildSink):
    """Carries the topics by rclpy under ``python``; ``domain`` as ROS_DOMAIN_ID has it."""

    def __init__(self, python: str, domain: int, commands: CommandTaker | None = None) -> None:
        super().__init__("ROS 2", "rclpy", commands)
        self._python, self._domain = python, domain

    def _environment(self) -> dict[str, str]:
        return child.environment(sourced=True) | {"ROS_DOMAIN_ID": str(self._domain)}

    def _program(self) -> list[str]:
        return [self._python, "-s", str(Path(rclpy_child.__file__))]
