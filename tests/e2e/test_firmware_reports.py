"""Which board is this, and what runs on it: by command line, on a bus with a board of today and an older one."""

from __future__ import annotations

import json
import signal

import pytest

from tests.e2e.desk import Desk, Node
from tests.terminal import on_terminal

pytestmark = pytest.mark.link


def older(node: Node) -> Node:
    """Make it a node from before 128.21."""
    path = node.folder / "flash.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"firmware": None}))
    return node


def lines(node: Node) -> list[dict[str, object]]:
    assert node.process is not None
    node.process.read(0)
    return [json.loads(line) for line in node.process.out.splitlines()]


def test_the_boards_of_a_bus_say_what_runs_on_them_and_which_they_are(desk: Desk) -> None:
    station, over = desk.station(), desk.links.over("can")
    today = desk.node("today", called="today").start(nfc=False, can=True)
    before = older(desk.node("before")).start(nfc=False, can=True)
    identify = station.start("identify", *over)
    assert today.process is not None
    identify.wait_for("Asking every node")  # the bus is open, and it listens for three seconds
    today.process.signal(signal.SIGUSR2)
    line_of = {line[:20]: line for line in identify.end().out.splitlines()}
    assert "says it was pressed" in line_of[today.uuid]
    assert "pressed" not in line_of[before.uuid]
    found = {node["uuid"]: node for node in station.ask("identify", *over)["nodes"]}
    assert found[today.uuid]["firmware"]["text"] == "virtual/teds-provision"
    assert (found[today.uuid]["firmware"]["from"], found[today.uuid]["firmware"]["state"]) == ("plain", "unjudged")
    assert found[before.uuid]["firmware"]["version"] is None
    assert not any(node["pressed"] for node in found.values())

    done = station.provision("can", today.uuid, "--profile", "limit-switch")
    assert (done["verdict"], done["firmware"]["from"]) == ("authentic", "session")
    assert station.ask("verify", today.uuid, *over)["firmware"] == done["firmware"]
    assert station.provision("can", before.uuid, "--profile", "limit-switch")["firmware"]["version"] is None
    listed = {node["uuid"]: node["firmware"] for node in station.ask("nodes")["nodes"]}
    assert listed == {today.uuid: done["firmware"], before.uuid: listed[before.uuid]}
    shown = station.run("nodes", before.uuid).out
    assert "firmware     firmware not reported" in shown

    assert station.ask("locate", today.uuid, "--for", "7s", *over) == {
        "located": [{"uuid": today.uuid, "name": found[today.uuid]["name"]}]
    }
    today.process.wait_for('"locate"')
    assert {"event": "locate", "uuid": today.uuid, "seconds": 7}.items() <= lines(today)[-1].items()
    refused = station.refuses("locate", before.uuid, *over, code=6)
    assert "cannot blink" in refused["message"]
    assert station.refuses("locate", today.uuid, "--for", "61s", *over, code=2)["code"] == "usage"
    assert station.refuses("identify", "--locate", *over, code=2)["code"] == "usage"

    screen = on_terminal(
        station.home, "identify", "--locate", *over, answers=["left finger"], passphrase=station.passphrase
    )
    assert f"{today.uuid}  left finger" in screen.screen, screen
    assert {node["uuid"]: node["name"] for node in station.ask("nodes")["nodes"]}[today.uuid] == "left finger"
