"""Runs on Debian's Python: prints the first value of each JointState of a topic, a line each: TOPIC."""

from __future__ import annotations

import sys
from typing import Any

import rospy
from sensor_msgs.msg import JointState


def came(message: Any) -> None:
    """One row."""
    print(int(message.position[0]), flush=True)


rospy.init_node("listener", disable_signals=True)
rospy.Subscriber(sys.argv[1], JointState, came)
print("ready", flush=True)
rospy.spin()
