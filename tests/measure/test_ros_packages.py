"""What a colcon workspace takes from examples/ros2 fits the program."""

from __future__ import annotations

import ast
from pathlib import Path

from defusedxml import ElementTree

from teds_provision.cli.measure.measure import measure
from teds_provision.measure.sinks.live import COMMANDS, STATES
from teds_provision.measure.sinks.mcap.recording import SAMPLES, TYPE

PACKAGES = Path(__file__).parents[2] / "examples" / "ros2"


def test_the_message_is_that_of_recordings() -> None:
    package, _, name = TYPE.partition("/msg/")
    assert (PACKAGES / package / "msg" / f"{name}.msg").read_text() == SAMPLES.partition("====")[0]
    assert f"msg/{name}.msg" in (PACKAGES / package / "CMakeLists.txt").read_text()


def test_each_package_is_called_as_its_folder_and_files() -> None:
    for folder in (path for path in PACKAGES.iterdir() if path.is_dir()):
        described = ElementTree.parse(folder / "package.xml").getroot()
        assert described.findtext("name") == folder.name
        assert f"<version>{'0.1.0'}</version>" in (folder / "package.xml").read_text()
    ours = PACKAGES / "teds_provision_ros"
    assert (ours / "resource" / ours.name).exists()
    assert f'NAME = "{ours.name}"' in (ours / "setup.py").read_text()


def test_the_launch_file_says_what_the_command_takes() -> None:
    text = (PACKAGES / "teds_provision_ros" / "launch" / "measure.launch.py").read_text()
    words = {
        node.value
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    options = {name for option in measure.params for name in option.opts}
    asked = {word for word in words if word.startswith("--")} - {"--no-input"}
    assert asked == {"--ros2", "--can", "--dead-man"}
    assert asked <= options


def test_the_robots_description_names_the_topics_of_joints() -> None:
    root = ElementTree.parse(PACKAGES / "teds_provision_ros" / "config" / "gripper.ros2_control.xacro").getroot()
    given = {item.get("name"): item.text for item in root.iter("param")}
    assert given["joint_states_topic"] == f"/${{station}}/{STATES}"
    assert given["joint_commands_topic"] == f"/${{station}}/{COMMANDS}"
    assert float(given["trigger_joint_command_threshold"] or 0) < 0, "commands keep coming, or the dead-man takes over"
