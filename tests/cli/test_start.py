"""What ``teds-provision`` alone says comes next, and what it takes from a service that runs."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.cli import start
from teds_provision.station.station import Station

ARM = {
    "uuid": "8d",
    "name": "arm",
    "link": "can:x",
    "whitelisted": True,
    "state": "provisioned",
    "verdict": "authentic",
}


def link(place: str, *, state: str = "up", nodes: int = 0) -> dict[str, Any]:
    return {"place": place, "state": state, "nodes": nodes, "why": None}


@pytest.mark.parametrize(
    ("links", "nodes", "following"),
    [
        ([link("can:x")], [], "doctor --can x"),
        ([link("can:y"), link("can:x", nodes=1)], [ARM], "measure arm"),
        ([link("can:y", state="down"), link("can:x", nodes=1)], [ARM], "doctor --can y"),
        ([link("can:x", nodes=1)], [{**ARM, "whitelisted": False}], "identify --add --can x"),
        ([link("can:x", nodes=1)], [{**ARM, "state": "factory"}], "provision --profile PROFILE --can x"),
        ([link("can:x", nodes=1)], [{**ARM, "verdict": None}], "verify arm --can x"),
        ([link("nfc:usb", state="listed")], [], "provision --profile PROFILE"),
        ([link("nfc:usb", state="listed"), link("can:x", state="listed")], [], "doctor"),
        ([], [], "config set can socketcan:can0"),
    ],
)
def test_a_fault_comes_before_new_boards_and_those_before_work(
    links: list[dict[str, Any]], nodes: list[dict[str, Any]], following: str
) -> None:
    """A bus on which nothing answers is a fault only where nothing answers anywhere."""
    assert start._next({"links": links, "nodes": nodes}) == f"teds-provision {following}"


def test_of_a_service_only_the_nodes_that_are_there_are_shown(station: Station) -> None:
    node = {**ARM, "verdict": {"verdict": "authentic"}, "address": 0x21}
    nodes = [{**node, "present": True}, {**node, "uuid": "8e", "present": False}]
    status = {"url": None, "measurements": [], "links": [{"place": "can:x", "nodes": 1, "problem": None}]}
    running = SimpleNamespace(status=lambda: status, nodes=lambda: nodes)
    app: Any = SimpleNamespace(running_service=lambda timeout: nullcontext(running))
    found = start._of_service(app, station)
    assert found is not None
    assert [node["uuid"] for node in found["nodes"]] == ["8d"]
    assert found["known"] == 2
