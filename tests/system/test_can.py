"""SocketCAN in a machine of its own: the kernel's CAN, ISO-TP, error frames, and candump."""

from __future__ import annotations

import pytest

from .machine import Machine, why_not
from .results import result

pytestmark = [pytest.mark.machine, pytest.mark.timeout(1500), pytest.mark.skipif(bool(why_not()), reason=why_not())]
EVERYONE = "18DBFFF1#"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Machine:
    return Machine("can_scene", ("vcan", "can_raw", "can_isotp"), tmp_path_factory.mktemp("machine"))


@pytest.mark.parametrize("name", ["provision", "provision-fd"])
def test_a_node_is_provisioned_over_the_kernels_can(scene: Machine, name: str) -> None:
    found = result(scene, name)
    assert (found["code"], found["verdict"]) == (0, "authentic"), found


def test_candump_reads_our_frames(scene: Machine) -> None:
    found = result(scene, "candump")
    frames, node = found["frames"], f"{found['address']:02X}"
    assert found["nodes"] == 2
    assert any(frame.startswith(f"18DA{node}F1#") for frame in frames), frames
    assert any(frame.startswith(f"18DAF1{node}#") for frame in frames), frames
    functional = [frame for frame in frames if frame.startswith(EVERYONE)]
    assert functional
    assert all(bytes.fromhex(frame.split("#")[1])[2:8] == bytes((0, 0, 128, 7, 0, 0)) for frame in functional)
    assert any(frame.endswith("#301000CCCCCCCCCC") for frame in frames), "flow control: 16 frames, no gap, padded"


def test_the_kernels_iso_tp_understands_our_node(scene: Machine) -> None:
    found = result(scene, "kernel-station")
    assert (found["transaction"], found["uuid"], found["ok"]) == (7, found["expected"], 1), found
    assert found["octets"] > 62, "a reply of several frames"


def test_the_kernels_iso_tp_understands_our_station(scene: Machine) -> None:
    found = result(scene, "kernel-node")
    assert found["arrived"]
    assert found["returned"]


def test_a_measurement_over_can_fd(scene: Machine) -> None:
    found = result(scene, "measure-fd")
    assert found["code"] == 0, found
    assert found["samples"] > 50, found
    assert found["bad"] == 0, found  # what is lost depends on a processor that is emulated


def test_a_second_station_asks_while_the_first_measures(scene: Machine) -> None:
    found = result(scene, "two-stations")
    assert (found["code"], found["second"], found["second_saw"]) == (0, 0, found["uuid"]), found
    assert found["samples"] > 20, found
    assert found["bad"] == 0, found


@pytest.mark.parametrize("name", ["down-and-up", "bus-off"])
def test_a_measurement_comes_back_after_the_bus_was_lost(scene: Machine, name: str) -> None:
    found = result(scene, name)
    states = found["states"]
    assert "lost" in states, found
    assert "running" in states[states.index("lost") :], found
    assert found["code"] == 0, found
