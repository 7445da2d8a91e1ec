"""Children that carry ROS: which Python, in which environment, under which name, and when one is started again."""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.measure.sinks.ros import child, sourced
from teds_provision.measure.sinks.ros.ros1 import Ros1Sink
from teds_provision.measure.sinks.ros.ros2 import Ros2Sink
from teds_provision.measure.sinks.ros.sourced import RclpySink
from tests.measure.sinks.parts import ANGLE, ARM, STATION

REACH = [
    "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY", "ROS_DISCOVERY_SERVER",
    "FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE", "CYCLONEDDS_URI", "ZENOH_SESSION_CONFIG_URI",
]  # fmt: skip


@pytest.fixture(autouse=True)
def _no_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [*REACH, "AMENT_PREFIX_PATH", "ROS_DOMAIN_ID", "ROS_MASTER_URI", sourced.CHOSEN]:
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("chosen", ["", *REACH])
def test_an_rclpy_of_our_own_stays_on_this_machine_unless_the_user_said_more(
    chosen: str, own: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if chosen:
        monkeypatch.setenv(chosen, "as the user wants")
    around = RclpySink("python3", 7, own=own)._environment()
    limit = "as the user wants" if chosen == REACH[0] else "LOCALHOST" if own and not chosen else None
    assert (around.get(REACH[0]), around["ROS_DOMAIN_ID"]) == (limit, "7")


@pytest.mark.parametrize(
    ("able", "taken"),
    [
        ({"/conda/bin/python3", "/usr/bin/python3", "/first/python3"}, "/conda/bin/python3"),
        ({"/usr/bin/python3", "/first/python3"}, "/usr/bin/python3"),
        ({"/first/python3"}, "/first/python3"),
    ],
)
def test_a_sourced_ros_is_carried_by_the_first_python_that_imports_it(
    able: set[str], taken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if another Python was named, and rclpy is installed in ours: what was sourced goes first."""
    sourced._python.cache_clear()
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")
    monkeypatch.setenv("CONDA_PREFIX", "/conda")
    monkeypatch.setenv(sourced.CHOSEN, sys.executable)
    monkeypatch.setattr(shutil, "which", lambda _name: "/first/python3")
    monkeypatch.setattr(child, "imports", lambda python, _packages, _environment: python in able)
    sink = sourced.ros2_sink("ros2:9")
    sourced._python.cache_clear()
    assert isinstance(sink, RclpySink)
    assert (sink._python, sink._own, sink._domain) == (taken, False, 9)


@pytest.mark.parametrize(("spec", "domain"), [("ros2", 0), ("ros2:7", 7), ("ros2:232", 232)])
def test_the_domain_is_the_one_that_was_named_else_that_of_the_environment(
    spec: str, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_the_master_is_the_one_that_was_named_else_that_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", "http://127.0.0.1:1")
    masters = [Ros1Sink(spec)._environment()["ROS_MASTER_URI"] for spec in ("ros1", "ros1:http://127.0.0.1:2")]
    assert masters == ["http://127.0.0.1:1", "http://127.0.0.1:2"]


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


def test_a_child_that_dies_is_started_again_after_a_second_doubling_to_thirty_and_all_is_announced_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sink: Any = RclpySink("python3", 0)
    sink._prepare((ANGLE,), STATION)
    clock, started, announced = [100.0], list[float](), list[int]()
    dead = SimpleNamespace(poll=lambda: 1, returncode=1, stdin=None, wait=lambda _patience: None)
    lives = SimpleNamespace(poll=lambda: None, returncode=None, stdin=None, wait=lambda _patience: None)

    def start() -> None:
        started.append(clock[0])
        sink._child, sink._announced = dead, False

    monkeypatch.setattr(child, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr(sink, "_start", start)
    monkeypatch.setattr(sink, "_announce", lambda facts: announced.append(len(facts)))
    pauses = []
    start()
    for _ in range(7):
        assert not sink._up()
        pauses.append(sink._again - clock[0])
        assert sink.stats.detail == f"rclpy died; tried again in {pauses[-1]:.0f} s"
        clock[0] = sink._again - 0.01
        assert not sink._up()
        assert len(started) == len(pauses)
        clock[0] = sink._again
        assert not sink._up()
    assert pauses == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    sink._child, sink._complaint = lives, "ImportError: x"
    sink._ready.set()
    assert sink._up()
    assert sink._up()
    assert (announced, sink.stats.state) == ([1], "running")
    sink._child = dead
    assert not sink._up()
    assert sink.stats.detail == "rclpy died (ImportError: x); tried again in 1 s"


def test_why_a_child_ended_and_under_which_name_the_next_one_comes() -> None:
    sink = RclpySink("python3", 0)
    sink._prepare((ANGLE,), STATION)
    assert sink._cause(child.NO_MASTER) == "the ROS master is gone"
    assert sink._suffix == ""
    assert sink._cause(child.NAME_TAKEN) == "another program took the name /teds_provision_bench"
    assert sink._suffix == f"_{os.getpid()}"
