"""Measures a group of nodes as long as the robot runs: ros2 launch teds_provision_ros measure.launch.py group:=hand."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration


def generate_launch_description() -> LaunchDescription:
    """Give the arguments and the process."""
    arguments = {
        "program": ("teds-provision", "path of the program, e.g. in a virtual environment of its own"),
        "group": ("hand", "group of nodes, a node's name, or its UUID"),
        "can": ("socketcan:can0", "bus, as --can takes it"),
        "dead_man": ("1000", "milliseconds without a set point after which an actuator is safe"),
    }
    words = [LaunchConfiguration("program"), "--no-input", "measure", LaunchConfiguration("group"), "--ros2"]
    words += ["--can", LaunchConfiguration("can"), "--dead-man", LaunchConfiguration("dead_man")]
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=value, description=says)
                for name, (value, says) in arguments.items()
            ),
            # The first SIGINT ends the measurement in order: streams stopped, actuators safe, files whole.
            ExecuteProcess(cmd=words, output="screen", sigterm_timeout="15"),
        ]
    )
