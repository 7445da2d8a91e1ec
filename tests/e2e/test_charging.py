"""What a node says of its charge: shown at the tap, remembered as a hint with its time, and shown by nodes and mode."""

from __future__ import annotations

import pytest

from .desk import ANGLE, Desk

pytestmark = [pytest.mark.link, pytest.mark.needs("a battery")]


def test_the_charge_is_remembered_and_shown_with_its_time(desk: Desk) -> None:
    station, node = desk.station(), desk.node()
    node.start("--battery", "80", can=True)
    station.provision("nfc", "--profile", ANGLE)
    (known,) = station.ask("nodes", node.uuid)["nodes"]
    assert known["charging"]["battery_percent"] in (80, 81, 82)
    assert known["charging"]["at"].endswith("Z")
    shown = station.run("nodes", node.uuid).out
    assert "reported by the node" in shown
    over_the_bus = station.ask("mode", node.uuid, *desk.links.over("can"))["charging"]
    assert over_the_bus == known["charging"], "the bus says nothing of it: what was said at the tap, and when"
    tapped = station.ask("mode", node.uuid, *desk.links.over("nfc"))["charging"]
    assert tapped["battery_percent"] >= 80


def test_a_node_without_a_battery_has_none(desk: Desk) -> None:
    station, node = desk.station(), desk.node().start()
    station.provision("nfc", "--profile", ANGLE)
    assert station.ask("nodes", node.uuid)["nodes"][0]["charging"] is None
