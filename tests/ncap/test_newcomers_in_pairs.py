"""`ncap run --measure` and something else at once: commands that write, a service that is killed, a board that lies."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from teds_provision.client import ApiError
from tests.e2e.desk import Desk, Node
from tests.ncap.test_newcomers import Lab
from tests.ncap.test_written_while_measured import HOLDER
from tests.pace import until

pytestmark = pytest.mark.link
WRITER = """
import sys, time
from pathlib import Path
from teds_provision import client
from teds_provision.station.store.lock import NodeLock
home, uuid = Path(sys.argv[1]), sys.argv[2]
with NodeLock(home, bytes.fromhex(uuid)), client.connect(home=home).released(uuid, "write") as had:
    print(had, flush=True)
    sys.stdin.read()
"""


@pytest.fixture(scope="module")
def one_lab(tmp_path_factory: pytest.TempPathFactory, prepared: Path) -> Iterator[Lab]:
    desk = Desk(tmp_path_factory.mktemp("pairs"), prepared)
    try:
        yield Lab(desk)
    finally:
        desk.clear()


@pytest.fixture
def lab(one_lab: Lab) -> Iterator[Lab]:
    yield one_lab
    one_lab.tidy()


def whys(lab: Lab, node: Node) -> list[tuple[str, str]]:
    return [(entry["state"], entry["why"]) for entry in lab.events_of(node.uuid)]


def spoilt(node: Node, block: tuple[int, int]) -> bytes:
    """Change an octet of a TEDS in the flash of a node that is off; gives the flash as it was."""
    before = node.octets
    record = json.loads(before)
    for item in record["flash"]["blocks"]:
        if tuple(item[:2]) == block:
            octets = bytearray.fromhex(item[2])
            octets[len(octets) // 2] ^= 1
            item[2] = octets.hex()
    (node.folder / "flash.json").write_text(json.dumps(record))
    assert node.octets != before
    return before


def test_a_node_whose_signature_is_not_good_is_refused_with_why_and_joins_when_it_is_mended(lab: Lab) -> None:
    left, right = lab.nodes
    right.kill()
    before = spoilt(right, (0, 128))
    lab.start()
    lab.comes(left)
    lab.power(right)
    until(lambda: lab.states(right)[-1:] == ["waiting"])
    assert "not authentic" in whys(lab, right)[-1][1]
    with lab.service.client() as asked:
        assert right.uuid not in asked.measurements()[0]["uuids"]
    shown = lab.service.station.run("ncap", "status").out.splitlines()
    assert "not authentic" in next(line for line in shown if line.startswith(right.uuid)).partition(": ")[2]
    right.kill()
    (right.folder / "flash.json").write_bytes(before)
    lab.power(right)
    until(lambda: lab.states(right)[-1] == "joined")
    assert lab.states(left) == ["joined"]
    lab.service.end()


def test_a_node_whose_other_teds_was_changed_is_found_out_behind_its_measurement(lab: Lab) -> None:
    """It is measured by the signed copy until its own is read; then it leaves, and everyone hears why."""
    left, right = lab.nodes
    right.kill()
    blocks = [(channel, code) for channel, code, _ in right.flash["blocks"]]
    before = spoilt(right, next(block for block in blocks if block[0] == 1))
    lab.start()
    lab.comes(left)
    lab.power(right)
    until(lambda: "left" in lab.states(right) or lab.states(right)[-1:] == ["waiting"])
    assert any("not the one used for the measurement" in why for _, why in whys(lab, right)), whys(lab, right)
    with lab.service.client() as asked:
        until(lambda: asked.node(right.uuid)["verdict"]["verdict"] == "not authentic")
    right.kill()
    (right.folder / "flash.json").write_bytes(before)
    lab.power(right)
    until(lambda: lab.states(right)[-1] == "joined")
    assert lab.states(left) == ["joined"]
    lab.service.end()


def test_a_new_key_is_agreed_while_it_is_measured(lab: Lab) -> None:
    left, right = lab.nodes
    station, over = lab.service.station, lab.desk.links.over("can")
    lab.start()
    lab.comes(left)
    lab.comes(right)
    assert station.ask("agree", right.uuid, "--rotate", "--yes", *over)["epoch"] == 2
    until(lambda: lab.states(right).count("joined") == 2)
    assert whys(lab, right)[1] == ("left", "let go for agree")
    lab.flows(right)
    lab.service.end()


def test_a_reset_node_leaves_and_joins_again_once_it_is_provisioned(lab: Lab) -> None:
    left, right = lab.nodes
    third = lab.provisioned("third")
    station, over = lab.service.station, lab.desk.links.over("can")
    lab.start()
    for node in (left, right, third):
        lab.comes(node)
    station.ask("reset", third.uuid, "--yes", *over)
    until(lambda: lab.states(third)[-1] == "waiting" and "holds no key" in whys(lab, third)[-1][1])
    with lab.service.client() as asked:
        until(lambda: third.uuid not in asked.measurements()[0]["uuids"])
    words = ["--profile", "magnetic-angular-position-sensor", "--calibration", lab.desk.folder / "angle.csv"]
    assert station.ask("provision", third.uuid, *words, "--yes", *over)["verdict"] == "authentic"
    until(lambda: lab.states(third)[-1] == "joined")
    assert (lab.states(left), lab.states(right)) == (["joined"], ["joined"])
    lab.service.end()
    third.kill()


def test_a_station_that_is_killed_while_a_node_is_let_go_leaves_it_to_its_writer(lab: Lab) -> None:
    """The new one measures the others at once, and this one when its writer has done."""
    left, right = lab.nodes
    lab.start()
    lab.comes(left)
    lab.comes(right)
    words = [sys.executable, "-c", WRITER, str(lab.service.station.home), right.uuid]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        assert writer.stdout.readline() == "True\n"
        lab.service.kill()
        lab.start()
        until(lambda: ("waiting", "a command of this station is using it") in whys(lab, right))
        lab.comes(left)
        assert "joined" not in lab.states(right)
        writer.communicate("")
    until(lambda: lab.states(right)[-1] == "joined")
    lab.flows(right)
    lab.service.end()


def test_a_writer_that_is_killed_gives_a_matched_node_back(lab: Lab) -> None:
    left, right = lab.nodes
    lab.start()
    lab.comes(left)
    lab.comes(right)
    words = [sys.executable, "-c", HOLDER, str(lab.service.station.home), right.uuid]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "True\n"
        until(lambda: lab.states(right)[-1] == "left")
        holder.kill()
    until(lambda: lab.states(right)[-1] == "joined")
    assert lab.states(left) == ["joined"]
    lab.service.end()


def test_a_node_that_left_its_group_while_a_command_had_it_is_not_measured_on(lab: Lab) -> None:
    """The measurement followed the store while the node was away: what it was told then ended with its return."""
    left, right = lab.nodes
    station = lab.service.station
    station.ask("group", "create", "leaving", left.uuid, right.uuid)
    lab.service.start("--measure", "leaving", "--rate", 20)
    lab.comes(left)
    lab.comes(right)
    words = [sys.executable, "-c", HOLDER, str(station.home), right.uuid]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "True\n"
        station.ask("group", "remove", "leaving", right.uuid, left.uuid)
        until(lambda: lab.states(left)[-1] == "left")  # in the same look at the store
        assert right.uuid in running(lab)["uuids"], "its place is kept for it"
        holder.kill()
    until(lambda: right.uuid not in running(lab)["uuids"], lambda: f"{lab.states(right)} {running(lab)}")
    assert lab.states(right)[-1] == "left"
    lab.service.end()


def test_who_is_renamed_leaves_or_joins_a_measurement_of_names(lab: Lab) -> None:
    left, right = lab.nodes
    station, over = lab.service.station, lab.desk.links.over("can")
    lab.service.start("--measure", "name:arm-*", "--rate", 20)
    with lab.service.client() as asked:
        until(lambda: asked.node(right.uuid)["present"] and asked.node(left.uuid)["present"])
    assert lab.events_of() == []
    words = ["--profile", "magnetic-angular-position-sensor", "--name", "arm-1", "--yes", *over]
    assert station.ask("provision", right.uuid, *words)["verdict"] == "authentic"
    lab.comes(right)
    words[3] = "right"
    assert station.ask("provision", right.uuid, *words)["verdict"] == "authentic"
    until(
        lambda: lab.states(right)[-1] == "left" and right.uuid not in running(lab)["uuids"],
        lambda: f"{lab.states(right)} {running(lab)}",
    )
    assert lab.states(left) == []
    lab.service.end()


def running(lab: Lab) -> dict[str, Any]:
    with lab.service.client() as asked:
        return dict(asked.measurements()[0])


def test_a_group_that_is_started_by_hand_and_measured_as_it_comes_has_each_node_once(lab: Lab) -> None:
    """Who is in the one is not in the other; when the one ends, the other takes its nodes in."""
    left, right = lab.nodes
    station = lab.service.station
    station.ask("group", "create", "both", left.uuid, right.uuid)
    lab.service.start("--measure", "both", "--rate", 20)
    lab.comes(left)
    lab.comes(right)
    with lab.service.client() as asked:
        with pytest.raises(ApiError) as refused:
            asked.measure(group="both", rate=20)
        assert refused.value.status == 423, "NodeBusyError"
        right.kill()
        until(lambda: lab.states(right)[-1] == "left")
        by_hand = asked.measure(right.uuid, rate=20)["id"]
        lab.power(right)
        until(
            lambda: (
                [entry["id"] for entry in lab.events_of(right.uuid) if entry["state"] == "joined"] == ["run", by_hand]
            )
        )
        asked.end_measurement(by_hand)
        until(
            lambda: lab.events_of(right.uuid)[-1]["state"] == "joined" and lab.events_of(right.uuid)[-1]["id"] == "run"
        )
    assert lab.states(left) == ["joined"]
    lab.service.end()
    station.ask("group", "delete", "both")
