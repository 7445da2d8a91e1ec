"""Firmware updates by command line, on real links, of the node in Python and of the one in C."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import pytest

from tests.firmware_images import make_key, public, sign
from tests.pace import until

from .desk import ANGLE, Desk, Node, Station

pytestmark = [pytest.mark.link]
PROVISIONED = ("--profile", ANGLE)


class Owner:
    """An owner's key and the images that it signed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.key = folder, make_key(folder / "owner.pem")
        self.public = public(self.key, "pem")
        self.old, self.new = self.image("1.0.0"), self.image("1.1.0")

    def image(self, version: str, **more: Any) -> Path:
        return sign(self.folder, version, more.pop("key", self.key), **{"counter": 1, **more})


@pytest.fixture(scope="module")
def owner(tmp_path_factory: pytest.TempPathFactory) -> Owner:
    return Owner(tmp_path_factory.mktemp("owner"))


def board(desk: Desk, owner: Owner, name: str = "node", **start: Any) -> Node:
    return desk.node(name, firmware=(owner.old, owner.key)).start(nfc=False, can=True, **start)


def update(station: Station, *words: object, code: int = 0) -> tuple[list[Any], dict[str, Any]]:
    """Run ``update --json``; its lines, and the totals."""
    outcome = station.run("--json", "update", *words, "--yes", *station.desk.links.over("can"))
    assert outcome.code == code, outcome
    *lines, last = map(json.loads, outcome.out.splitlines())
    return lines, last["totals"]


@pytest.mark.both_nodes(nightly_in_c="tests/firmware/test_host_updates.py updates the one in C")
def test_a_board_gets_new_firmware_and_keeps_everything_else(desk: Desk, owner: Owner) -> None:
    station, node = desk.station(), board(desk, owner)
    station.provision("can", *PROVISIONED)
    before, over = node.octets, desk.links.over("can")

    plan = station.ask("update", node.uuid, owner.new, "--key", owner.public, "--dry-run", *over)
    assert (plan["from"], plan["to"], plan["plan"], plan["octets"]) == (
        "1.0.0",
        "1.1.0",
        "upload",
        owner.new.stat().st_size,
    )
    assert node.octets == before
    (line,), totals = update(station, node.uuid, owner.new, "--key", owner.public)
    assert {name: line[name] for name in ("uuid", "from", "to", "octets", "result", "image")} == {
        "uuid": node.uuid,
        "from": "1.0.0",
        "to": "1.1.0",
        "octets": owner.new.stat().st_size,
        "result": "updated",
        "image": plan["image"],
    }
    assert {name: totals[name] for name in ("updated", "already", "reverted", "refused", "lost")} == {
        "updated": 1,
        "already": 0,
        "reverted": 0,
        "refused": 0,
        "lost": 0,
    }
    assert node.octets == before, "key, datasheet, address, epoch and sequence"
    assert station.ask("verify", node.uuid, *over)["verdict"] == "authentic"
    (line,), _ = update(station, node.uuid, owner.new)
    assert (line["result"], line["octets"]) == ("already", 0)

    (line,), _ = update(station, node.uuid, owner.old, code=6)
    assert (line["result"], line["error"]["code"]) == ("refused", "downgrade")
    other = owner.image("1.2.0", board="other/board")
    (line,), _ = update(station, node.uuid, other, code=6)
    assert (line["result"], line["error"]["code"]) == ("refused", "wrong-image"), "--yes is not enough"
    rival = owner.image("3.0.0", key=make_key(owner.folder / f"{node.uuid}.pem"))
    assert station.refuses("update", node.uuid, rival, "--key", owner.public, *over, code=4)["code"] == "not-authentic"
    (line,), _ = update(station, node.uuid, rival, code=6)
    assert (line["result"], line["error"]["code"]) == ("reverted", "reverted")
    torn = owner.folder / f"{node.uuid}.bin"
    torn.write_bytes(owner.new.read_bytes()[:-9])
    assert station.refuses("update", node.uuid, torn, *over, code=8)["code"] == "bad-data"
    assert station.ask("verify", node.uuid, *over)["verdict"] == "authentic"
    (line,), _ = update(station, node.uuid, owner.old, "--allow-downgrade")
    assert line["result"] == "updated"
    assert station.log_is_whole()


@pytest.mark.both_nodes(nightly_in_c="tests/firmware/test_host_updates.py updates the one in C")
def test_an_image_that_crashes_does_not_speak_or_confirms_itself(desk: Desk, owner: Owner) -> None:
    station, node = desk.station(), board(desk, owner)
    station.provision("can", *PROVISIONED)
    before = node.octets
    (line,), _ = update(station, node.uuid, owner.image("2.0.0", behaves="crash"), code=6)
    assert (line["result"], line["error"]["code"]) == ("reverted", "reverted")
    (line,), totals = update(station, node.uuid, owner.image("2.1.0", behaves="mute"), "--wait", "2", code=5)
    assert (line["result"], line["error"]["code"], totals["lost"]) == ("lost", "lost", 1)
    node.kill()
    node.start(nfc=False, can=True)
    assert node.octets == before
    (line,), _ = update(station, node.uuid, owner.new)
    assert (line["from"], line["result"]) == ("1.0.0", "updated"), "its old firmware runs after power off and on"
    (line,), _ = update(station, node.uuid, owner.image("2.2.0", behaves="confirm"), "--wait", "5", code=6)
    assert line["result"] == "refused"
    assert "confirmed itself" in line["error"]["message"]
    assert node.octets == before


@pytest.mark.both_nodes(nightly_in_c="tests/firmware/test_host_updates.py updates the one in C")
def test_kill_9_of_either_end_in_an_upload_and_the_same_command_goes_on(desk: Desk, owner: Owner) -> None:
    station, node = desk.station(), board(desk, owner)
    station.provision("can", *PROVISIONED)
    before, over = node.octets, desk.links.over("can")
    long = owner.image("1.3.0", octets=60_000)
    words = ("--json", "update", node.uuid, long, "--yes", *over)

    running = station.start(*words)
    until(lambda: _octets_there(node) > 4000)
    running.process.kill()
    running.end()
    (line,), _ = update(station, node.uuid, long)
    assert line["result"] == "updated"
    assert 0 < line["octets"] < long.stat().st_size - 2000, "it went on at the offset of the board"

    longer = owner.image("1.4.0", octets=60_000)
    running = station.start("--json", "update", node.uuid, longer, "--yes", *over)
    until(lambda: _octets_there(node) > 4000)
    node.kill()
    node.start(nfc=False, can=True)
    done = running.end()
    assert json.loads(done.out.splitlines()[0])["result"] == "updated", done
    assert node.octets == before


def _octets_there(node: Node) -> int:
    """Return octets of the slot that is written now, as far as its file shows them."""
    slots = [path for path in node.folder.glob("**/*") if path.is_file() and path.parent.name in ("firmware", "images")]
    newest = max(slots, key=lambda path: path.stat().st_mtime_ns, default=None)
    return 0 if newest is None else len(newest.read_bytes().rstrip(b"\xff"))


def test_many_boards_at_once_and_one_that_takes_no_firmware(desk: Desk, owner: Owner) -> None:
    station = desk.station()
    boards = [board(desk, owner, f"board{number}") for number in range(3)]
    plain = desk.node("plain").start(nfc=False, can=True)
    over = desk.links.over("can")
    for node in (*boards, plain):
        station.ask("whitelist", "add", node.uuid)
    station.run(
        "provision", "--all", *PROVISIONED, "--yes", *over
    )  # 6: the type wants a calibration, which is no matter
    planned = station.run("--json", "update", "--match", f"type:{ANGLE}", owner.new, "--dry-run", *over)
    assert planned.code == 6, planned
    *plans, last = map(json.loads, planned.out.splitlines())
    assert sorted(plan.get("plan", plan.get("result")) for plan in plans) == ["refused", "upload", "upload", "upload"]
    octets = owner.new.stat().st_size
    assert {name: count for name, count in last["totals"].items() if name != "seconds" and count} == {
        "planned": 3, "refused": 1, "octets": 3 * octets,
    }  # fmt: skip
    shown = station.run("update", boards[0].uuid, boards[1].uuid, owner.new, "--dry-run", *over)
    assert f"2 planned; {2 * octets} octets, about " in shown.out
    older = station.run("--json", "update", boards[0].uuid, owner.image("0.9.0"), "--yes", *over)
    assert (older.code, json.loads(older.out.splitlines()[0])["from"]) == (6, "1.0.0"), "it was read"
    lines, totals = update(station, "--match", f"type:{ANGLE}", owner.new, "--parallel", "3", code=6)
    results = {line["uuid"]: line["result"] for line in lines}
    assert results == {**{node.uuid: "updated" for node in boards}, plain.uuid: "refused"}
    assert next(line["error"]["code"] for line in lines if line["uuid"] == plain.uuid) == "no-update"
    assert (totals["updated"], totals["refused"]) == (3, 1)
    _, totals = update(station, *(node.uuid for node in boards), owner.new)
    assert totals["already"] == 3
    assert (
        station.refuses("update", "--match", "name:nothing*", owner.new, "--yes", *over, code=3)["code"] == "not-found"
    )
    assert station.refuses("update", owner.new, "--yes", *over, code=2)["code"] == "usage"
    swapped = station.refuses("update", owner.new, boards[0].uuid, "--yes", *over, code=2)
    assert swapped["hint"] == f"teds-provision update {boards[0].uuid} {owner.new}"
    shown = station.run("update", boards[0].uuid, owner.new, "--yes", *over)
    assert "already" in shown.out
    asked = station.run("update", boards[0].uuid, owner.image("1.9.0"), *over)
    assert asked.code == 6
    assert "--yes" in asked.err


def test_provision_installs_the_firmware_first(desk: Desk, owner: Owner) -> None:
    station, node = desk.station(), board(desk, owner)
    over = desk.links.over("can")
    words = ("--firmware", owner.new, "--firmware-key", owner.public)
    assert (
        station.refuses("provision", "--firmware", owner.new, "--all", *PROVISIONED, *over, code=2)["code"] == "usage"
    )
    done = station.provision("can", *PROVISIONED, *words)
    assert done["verdict"] == "authentic"
    assert done["firmware"]["version"] == "1.1.0"
    (known,) = station.ask("nodes", node.uuid)["nodes"]
    assert (known["firmware"]["version"], known["firmware"]["state"]) == ("1.1.0", "unjudged")
    (line,), _ = update(station, node.uuid, owner.new)
    assert line["result"] == "already"


def test_without_a_link_the_firmware_of_a_new_board_waits_for_the_tap_too(desk: Desk, owner: Owner) -> None:
    station, node = desk.station(), board(desk, owner)
    station.ask("identify", *desk.links.over("can"))
    station.ask("config", "set", "can", desk.links.can)
    refused = station.refuses("provision", node.uuid, "--firmware", owner.new, *PROVISIONED, "--yes", code=5)
    assert "No NFC reader" in refused["message"]
    (known,) = station.ask("nodes", node.uuid)["nodes"]
    assert (known["keys"], known["whitelisted"]) == ([], False), "nothing was done over the bus that it was met on"


def test_update_over_nfc_says_that_it_is_slow(desk: Desk, owner: Owner) -> None:
    station = desk.station()
    node = desk.node(firmware=(owner.old, owner.key)).start()
    station.provision("nfc", *PROVISIONED)
    done = station.run("update", node.uuid, owner.new, "--yes", *desk.links.over("nfc"))
    assert done.code == 0, done
    assert "this link is slow" in done.err
    assert "1.0.0 → 1.1.0  updated" in done.out


def test_the_plan_for_a_board_that_another_command_measures_refuses_what_the_update_would(
    desk: Desk, owner: Owner
) -> None:
    """It named the measurement as one that pauses, and the update then ended with 6."""
    station = desk.station()
    sensor = desk.node("sensor", type_=ANGLE, firmware=(owner.old, owner.key)).start(nfc=False, can=True)
    over = desk.links.over("can")
    station.ask("whitelist", "add", sensor.uuid)
    station.run("provision", sensor.uuid, *PROVISIONED, "--yes", *over)
    measuring = station.start("--json", "measure", sensor.uuid, "--rate", "10", *over)
    measuring.wait_for('"data"')
    for more in ("--dry-run", "--yes"):
        done = station.run("--json", "update", sensor.uuid, owner.image("1.5.0"), "--other-board", more, *over)
        assert (done.code, json.loads(done.out.splitlines()[0])["error"]["code"]) == (6, "frozen"), done
    measuring.signal(signal.SIGINT)
    measuring.end()


@pytest.mark.realtime
def test_a_measurement_beside_an_update_loses_nothing(desk: Desk, owner: Owner) -> None:
    station, node = desk.station(), board(desk, owner)
    sensor = desk.node("sensor", type_=ANGLE).start("--source", "ramp:5", nfc=False, can=True)
    over = desk.links.over("can")
    for subject in (node, sensor):
        station.ask("whitelist", "add", subject.uuid)
    station.run("provision", "--all", *PROVISIONED, "--yes", *over)
    measuring = station.start("--json", "measure", sensor.uuid, "--test-pattern", "--rate", "100", *over)
    measuring.wait_for('"data"')
    (line,), _ = update(station, node.uuid, owner.image("1.5.0", octets=20_000))
    assert line["result"] == "updated"
    measuring.signal(signal.SIGINT)
    done = measuring.end()
    end = json.loads(done.out.splitlines()[-1])
    (stream,) = end["nodes"][0]["streams"]
    assert stream["bad"] == 0, end
    until(lambda: sensor.missed() >= stream["lost"], end)  # what its process had no processor for is no loss
    assert stream["samples"] > 50
