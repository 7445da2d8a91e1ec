"""ROS 2 by rclpy: the one that the user sourced, or the one that is installed from PyPI beside this tool.

``source /opt/ros/jazzy/setup.bash`` sets AMENT_PREFIX_PATH. Then a Python that can import rclpy carries the topics in a
child process, and RMW_IMPLEMENTATION, ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE are the user's. Without it the
Python that TEDS_PROVISION_ROS_PYTHON names does so, or our own if rclpy is installed in it; that one stays on this
machine unless the user's environment differs. Without rclpy, Cyclone DDS does it (:mod:`ros2`).
"""

from __future__ import annotations

import functools
import os
import shutil
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from teds_provision.errors import UsageError
from teds_provision.measure.sinks.base import CommandTaker, Sink
from teds_provision.measure.sinks.ros import child, rclpy_child
from teds_provision.measure.sinks.ros.child import ChildSink
from teds_provision.measure.sinks.ros.ros2 import Ros2Sink, domain_of

SYSTEM = "/usr/bin/python3"
NEEDS = "rclpy, std_msgs.msg, sensor_msgs.msg, geometry_msgs.msg, diagnostic_msgs.msg"
CHOSEN: Final = "TEDS_PROVISION_ROS_PYTHON"
_REACH: Final = frozenset(
    {"ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY", "ROS_DISCOVERY_SERVER"}
    | {"FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE", "CYCLONEDDS_URI", "ZENOH_SESSION_CONFIG_URI"}
)
"""Variables by which a user limits the reach; if one is set, it is left alone."""


def ros2_sink(spec: str, commands: CommandTaker | None = None) -> Sink:
    """Return the sink of ``ros2`` or ``ros2:DOMAIN``: by an rclpy, else by Cyclone DDS. Raises UsageError."""
    domain = domain_of(spec)
    sourced = os.environ.get("AMENT_PREFIX_PATH", "")
    if sourced and (python := _python(sourced, os.environ.get("PYTHONPATH", ""))) is not None:
        return RclpySink(python, domain, commands)
    if (python := os.environ.get(CHOSEN, "")) or (find_spec("rclpy") is not None and (python := sys.executable)):
        _require_rclpy(python)
        return RclpySink(python, domain, commands, own=True)
    return Ros2Sink(spec, commands)


@functools.cache
def _python(_sourced: str, _paths: str) -> str | None:
    """Return the Python that imports rclpy in this environment, None if none does; found out once in a process."""
    around = child.environment(sourced=True)
    conda = os.environ.get("CONDA_PREFIX", "")
    found = [f"{conda}/bin/python3" if conda else "", SYSTEM, shutil.which("python3") or ""]
    return next(
        (
            interpreter
            for interpreter in dict.fromkeys(found)
            if interpreter and child.imports(interpreter, NEEDS, around)
        ),
        None,
    )


@functools.cache
def _require_rclpy(python: str) -> None:
    if not child.imports(python, NEEDS, child.environment(sourced=False)):
        raise UsageError(
            f"{python} cannot import rclpy and its messages.",
            hint="Install what docs/ros.md lists: ros-jazzy-rclpy[fastrtps] and four packages of messages.",
        )


class RclpySink(ChildSink):
    """Carries the topics by rclpy under ``python``; ``domain`` as ROS_DOMAIN_ID has it.

    ``own``: it belongs to no ROS that the user sourced, so nothing leaves this machine unless the environment allows
    it.
    """

    def __init__(self, python: str, domain: int, commands: CommandTaker | None = None, *, own: bool = False) -> None:
        super().__init__("ROS 2", "rclpy", commands)
        self._python, self._domain, self._own = python, domain, own

    def _environment(self) -> dict[str, str]:
        around = child.environment(sourced=not self._own) | {"ROS_DOMAIN_ID": str(self._domain)}
        if self._own and not _REACH & around.keys():
            around["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        if not ({"ROS_LOG_DIR", "ROS_HOME"} & around.keys() or os.access(around.get("HOME", ""), os.W_OK)):
            around["ROS_LOG_DIR"] = tempfile.gettempdir()  # rclpy needs a folder for logs, and a service has no home
        return around

    def _program(self) -> list[str]:
        return [self._python, "-s", str(Path(rclpy_child.__file__))]
