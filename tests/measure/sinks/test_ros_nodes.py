"""A measurement as a node of ROS: its domain, its name, and the release of its readers."""

from __future__ import annotations

from dataclasses import replace

import pytest

from teds_provision.measure.sinks.ros.ros2 import Ros2Sink
from teds_provision.measure.sinks.ros.sourced import RclpySink
from tests.measure.sinks.parts import ANGLE, ARM, STATION


@pytest.mark.parametrize(("spec", "domain"), [("ros2", 0), ("ros2:7", 7), ("ros2:232", 232)])
def test_the_domain_is_the_one_that_was_named_else_that_of_the_environment(
    spec: str, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    assert Ros2Sink(spec)._domain == domain
    monkeypatch.setenv("ROS_DOMAIN_ID", "5")
    assert Ros2Sink(spec)._domain == (domain or 5)


@pytest.mark.parametrize(
    ("release", "taken"), [(None, "jazzy"), ("humble", "humble"), ("jazzy", "jazzy"), ("noetic", "jazzy")]
)
def test_the_release_of_the_readers_is_jazzy_unless_the_environment_names_another(
    release: str | None, taken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ROS_DISTRO", raising=False)
    if release:
        monkeypatch.setenv("ROS_DISTRO", release)
    assert Ros2Sink("ros2")._distribution == taken


@pytest.mark.parametrize(
    ("instance", "name"),
    [
        ("Left hand", "teds_provision_bench_left_hand"),
        (f"n{ARM}", f"teds_provision_bench_n{ARM}"),
        ("", "teds_provision_bench"),
    ],
)
def test_each_measurement_is_a_node_of_its_own(instance: str, name: str) -> None:
    sink = RclpySink("python3", 0)
    sink._prepare((ANGLE,), replace(STATION, instance=instance))
    assert sink._node == name
