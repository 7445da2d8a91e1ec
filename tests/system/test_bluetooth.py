"""Bluetooth in a machine of its own: the kernel's, real bluetoothd, bleak; the nodes' radio is virtual."""

from __future__ import annotations

import pytest

from tests.firmware import builds

from .machine import Machine, why_not
from .results import result

pytestmark = [pytest.mark.machine, pytest.mark.timeout(1500), pytest.mark.skipif(bool(why_not()), reason=why_not())]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Machine:
    builds.library(2048, 16388)  # the machine inside is too slow to compile
    return Machine("bluetooth_scene", ("hci_vhci",), tmp_path_factory.mktemp("machine"))


def test_bluetoothd_has_the_adapter_on_and_central(scene: Machine) -> None:
    assert result(scene, "power")["adapters"] == [["hci0", True, True]]


def test_a_node_is_provisioned_over_real_bluetoothd(scene: Machine) -> None:
    found = result(scene, "again")
    assert (found["code"], found["verdict"]) == (0, "authentic"), found
    assert found["steps"]["write"] == "done", "it got a name, so it was signed and written anew"


def test_a_finished_node_has_nothing_to_do(scene: Machine) -> None:
    found = result(scene, "first")
    assert (found["code"], found["verdict"]) == (0, "authentic"), found
    assert found["steps"]["write"] == "nothing to do"


def test_a_connection_that_is_cut_is_made_again(scene: Machine) -> None:
    found = result(scene, "reconnect")
    assert (found["code"], found["verdict"]) == (0, "authentic"), found
    assert found["steps"]["write"] == "done"


def test_a_node_in_c_is_provisioned_over_real_bluetoothd(scene: Machine) -> None:
    found = result(scene, "in-c")
    assert (found["code"], found["verdict"]) == (0, "authentic"), found
    assert found["steps"]["write"] == "done"


def test_three_nodes_are_found(scene: Machine) -> None:
    found = result(scene, "all")
    assert found["found"] == found["expected"], found
