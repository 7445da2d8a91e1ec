"""A node is looked for where it was met last, if nobody says where; the program alone says what is there."""

from __future__ import annotations

import shlex
from typing import Any

import pytest

from tests.places import free_bus

from .desk import ANGLE, Desk, Node, Station

pytestmark = [
    pytest.mark.link,
    pytest.mark.both_nodes(nightly_in_c="test_whole_runs.py and tests/firmware/test_host_port.py hold the one in C"),
]


ARM = "slew's $(arm)"


def alone(station: Station) -> Any:
    """Return what ``teds-provision`` without a command says."""
    return station.ask()


def test_a_node_is_found_where_it_was_met_last_and_the_program_alone_says_who_is_there(
    desk: Desk, station: Station, node: Node
) -> None:
    node.start(nfc=False, can=True)
    at = f"can:{desk.links.can}"
    events = alone(station)
    assert (events["station"]["name"], events["links"], events["nodes"]) == ("bench", [], [])
    assert "config set can" in events["next"]
    station.ask("config", "set", "can", desk.links.can)
    events = alone(station)
    assert [(node["uuid"], node["link"], node["whitelisted"]) for node in events["nodes"]] == [(node.uuid, at, False)]
    assert events["next"].startswith("teds-provision identify --add")
    station.ask("config", "unset", "can")
    station.provision("can", "--profile", ANGLE, "--name", ARM)
    events = alone(station)
    assert [(node["name"], node["verdict"]) for node in events["nodes"]] == [(ARM, "authentic")], "by its last bus"
    assert shlex.split(events["next"]) == ["teds-provision", "measure", ARM], "as it would be typed"
    assert station.ask("verify", ARM)["verdict"] == "authentic", "no link is named"
    # a named bus goes before the remembered one, and is remembered from then on
    node.stop()
    desk.links = type(desk.links)(desk.links.nfc, free_bus())
    node.start(nfc=False, can=True)
    refused = station.refuses("verify", ARM, "--timeout", "2", code=5)
    assert f"did not answer on {at.removeprefix('can:')} within 2 s" in refused["message"]
    assert station.ask("verify", ARM, "--can", desk.links.can)["verdict"] == "authentic", "without --via can"
    assert station.ask("verify", ARM)["verdict"] == "authentic"


def test_a_remembered_bus_prevents_no_tap(desk: Desk, station: Station, node: Node) -> None:
    node.start(nfc=False, can=True)
    station.provision("can", "--profile", ANGLE)
    node.stop()
    node.start()  # it lies on the reader now, and hangs on no bus
    error = station.refuses("verify", node.uuid, "--nfc", desk.links.nfc, "--can", free_bus(), "--via", "can",
                           "--timeout", "0.5", code=5)  # fmt: skip
    assert error["code"] == "no-node"
    assert station.ask("verify", node.uuid, "--nfc", desk.links.nfc)["verdict"] == "authentic", "a reader is named"
    agreed = station.refuses("agree", node.uuid, "--timeout", "1", code=5)
    assert "reader" in agreed["message"], "a key is agreed on by a tap unless a bus is named"


def test_a_reader_and_a_bus_of_config_toml_are_both_searched(desk: Desk, station: Station, node: Node) -> None:
    """Both are stored once; then a board is tapped, mounted, and read on its bus."""
    station.ask("config", "set", "nfc", desk.links.nfc)
    station.ask("config", "set", "can", desk.links.can)
    node.start()
    assert station.ask("provision", "--profile", ANGLE, "--yes")["verdict"] == "authentic", "by a tap"
    assert station.ask("verify", node.uuid)["verdict"] == "authentic", "it is still on the reader"
    node.stop()
    other = desk.node("other").start()
    node.start(nfc=False, can=True)
    done = station.run("--json", "verify", node.uuid)
    assert done.json["verdict"] == "authentic", "another board is on the reader"
    assert other.uuid not in done.err, "it is no matter of this command"
    refused = station.refuses("verify", node.uuid, "--nfc", desk.links.nfc, "--timeout", "1", code=5)
    assert other.uuid in refused["message"], "a reader that is named is the only one"
    other.stop()
    assert station.ask("verify", node.uuid)["verdict"] == "authentic", "nothing is on the reader"
    node.stop()
    refused = station.refuses("verify", node.uuid, "--timeout", "1", code=5)
    assert "was placed on the reader" in refused["message"], "at last a tap is waited for"
    assert f"did not answer on {desk.links.can}" in refused["message"]


def test_an_empty_bus_is_reported_with_the_time_that_was_listened(station: Station) -> None:
    bus = free_bus()
    outcome = station.run("identify", "--can", bus, "--timeout", "1.5")
    assert f"No node answered on {bus.partition(chr(63))[0]} within 1.5 s" in outcome.err
    assert "up to 0 s" not in outcome.err
    hint = outcome.err.partition("→ ")[2]
    assert "bit rate" in hint
    assert "identify" not in hint, "that is what was just run"
