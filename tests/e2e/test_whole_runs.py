"""From tap to flash by command line: in one command and step by step, over both tag types and over CAN."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from .desk import ANGLE, FINGER, Desk, Node, Station, results

pytestmark = [
    pytest.mark.link,
    pytest.mark.both_nodes(nightly_in_c="the first test here and tests/firmware/test_host_port.py hold the one in C"),
]

SECURITY = 128
CHANGING = ("audit", "nodes", "datasheets", "drafts", "readings", "last_places")
STEPS = ["identify", "whitelist", "agree", "build", "sign", "write", "verify", "check"]
NODE_KEYS = {"uuid", "fingerprint", "tag_uid", "state", "whitelisted", "channels", "name"}
CALIBRATION = """raw,value [degree]
0,0
16384,91.2
32768,179.9
49152,269.6
65535,359.9
"""


def settled(node: Node) -> dict[str, Any]:
    """Return what of a node's flash does not depend on chance: no key, no signature."""
    flash = node.flash
    blocks = {(channel, code): teds for channel, code, teds in flash["blocks"] if code != SECURITY}
    return {name: flash[name] for name in ("provisioned", "epoch", "sequence", "read_only")} | {"blocks": blocks}


@pytest.mark.both_nodes
@pytest.mark.parametrize("tag", ["4", pytest.param("2", marks=pytest.mark.needs("type 2 tag"))])
def test_a_tapped_node_is_provisioned_and_a_second_run_finds_nothing_to_do(
    station: Station, node: Node, tag: str
) -> None:
    node.start("--tag", tag)
    done = station.provision("nfc", "--profile", FINGER, "--name", "left index")
    assert list(results(done)) == STEPS
    ended = results(done)
    assert ended.pop("check") == "skipped"  # it does not measure: its hardware is not asked
    assert set(ended.values()) == {"done"}
    assert done["uuid"] == node.uuid
    assert done["verdict"] == "authentic"
    assert done["name"] == "left index"
    assert len(done["channels"]) == 12
    assert all(step["seconds"] >= 0 for step in done["steps"])
    written = node.octets

    again = station.provision("nfc")
    assert {name for name, result in results(again).items() if result == "done"} == {"identify", "verify"}
    assert again["verdict"] == "authentic"
    assert node.octets == written


def test_a_node_that_has_only_a_bus_is_provisioned_from_factory_state(station: Station, node: Node) -> None:
    node.start(nfc=False, can=True)
    done = station.provision("can", "--profile", ANGLE)
    ended = results(done)
    assert ended.pop("check") == "skipped"  # it does not measure: its hardware is not asked
    assert set(ended.values()) == {"done"}
    assert done["verdict"] == "authentic"
    (entry,) = station.ask("whitelist", "list")["whitelist"]
    assert (entry["uuid"], entry["assurance"]) == (node.uuid, "bus")
    written = node.octets
    assert station.provision("can")["verdict"] == "authentic"
    assert node.octets == written


def test_a_node_that_was_tapped_is_written_over_the_bus(station: Station, node: Node) -> None:
    """A bus node with an NFC antenna is not keyed without a tap; after that either link will do."""
    node.start(can=True)
    links = station.desk.links
    before = node.octets
    assert "tap" in station.refuses("provision", "-p", ANGLE, "--yes", *links.over("can"), code=6)["hint"].lower()
    assert node.octets == before
    assert station.ask("identify", "--add", *links.over("nfc"))["whitelisted"] is True
    assert station.ask("agree", node.uuid[:4], *links.over("nfc"))["epoch"] == 1
    done = station.provision("can", "--profile", ANGLE)
    assert results(done)["agree"] == "nothing to do"
    assert results(done)["write"] == "done"
    assert station.ask("verify", node.uuid, *links.over("nfc"))["verdict"] == "authentic"


BY_BUS = pytest.mark.nightly(
    "tests/e2e/test_whole_runs.py::test_every_step_by_hand_ends_where_provision_does[python-nfc]; on a bus "
    "tests/e2e/test_whole_runs.py::test_each_step_again_changes_nothing"
)


@pytest.mark.parametrize("via", ["nfc", pytest.param("can", marks=BY_BUS)])
def test_every_step_by_hand_ends_where_provision_does(desk: Desk, tmp_path: Path, via: str) -> None:
    """Each command alone, with the JSON keys of the contract; the node's state is that after ``provision``."""
    station, uuid = desk.station(), "8d4d9da65281f7000000"
    calibration = tmp_path / "angle.csv"
    calibration.write_text(CALIBRATION)
    order = ["--profile", ANGLE, "--calibration", calibration, "--name", "slew angle"]
    links = desk.links.over(via)
    by_hand = desk.node("by-hand", uuid=uuid).start(nfc=via == "nfc", can=via == "can")

    found = station.ask("identify", *links)
    assert set(found) >= NODE_KEYS
    assert (found["uuid"], found["state"], found["whitelisted"]) == (uuid, "factory", False)
    assert (found["tag_uid"] is not None) == (via == "nfc")
    added = station.ask("whitelist", "add", uuid, "--fingerprint", found["fingerprint"])["whitelist"]
    assert set(added[0]) >= {"uuid", "fingerprint", "added", "assurance"}
    agreed = station.ask("agree", "0x8D4D", *links)
    assert set(agreed) >= {"uuid", "epoch", "key_id"}
    built = station.ask("build", uuid, *order, "--output", tmp_path / "built.json")
    assert set(built) >= {"uuid", "blocks", "warnings"}
    assert all(set(block) >= {"access_code", "channel", "octets", "sha256"} for block in built["blocks"])
    signed = station.ask("sign", "slew angle", "--output", tmp_path / "signed.json")
    assert set(signed) >= {"uuid", "sequence", "signature", "signed_by"}
    written = station.ask("write", uuid, *links)
    assert set(written) >= {"uuid", "octets_written", "verified", "seconds"}
    assert written["verified"] is True
    assert written["octets_written"] == sum(map(len, by_hand.datasheet.values()))
    verified = station.ask("verify", uuid, *links)
    assert set(verified) >= {"uuid", "verdict", "checks"}
    assert all(set(check) == {"name", "result", "why"} for check in verified["checks"])
    assert verified["verdict"] == "authentic"
    image = station.ask("read", uuid, *links)
    assert (image["format"], image["uuid"]) == ("teds-image/1", uuid)
    assert {(b["channel"], b["access_code"]): bytes.fromhex(b["teds"]) for b in image["blocks"]} == by_hand.datasheet
    assert station.ask("verify", tmp_path / "signed.json")["verdict"] == "authentic"
    node_state = settled(by_hand)
    by_hand.stop()

    other = desk.station("rival")
    in_one = desk.node("in-one", uuid=uuid).start(nfc=via == "nfc", can=via == "can")
    assert other.provision(via, *order)["verdict"] == "authentic"
    assert settled(in_one) == node_state


def test_each_step_again_changes_nothing(station: Station, node: Node, tmp_path: Path) -> None:
    node.start(can=True)
    links = station.desk.links.over("can")
    station.provision("nfc", "--profile", ANGLE)
    sheet, signature = node.octets, station.ask("sign", node.uuid)["signature"]
    store = station.tables(without=CHANGING)
    assert station.ask("agree", node.uuid, *links)["epoch"] == 1
    assert station.ask("build", node.uuid)["uuid"] == node.uuid
    again = station.ask("sign", node.uuid)
    assert again["signature"] == signature
    assert station.ask("write", node.uuid, *links)["octets_written"] == 0
    assert station.ask("whitelist", "add", node.uuid)["added"] == 0
    assert node.octets == sheet
    assert station.tables(without=CHANGING) == store


@pytest.mark.nightly("tests/provisioning/test_agree.py::test_rotation_gives_a_new_key_over_any_link")
def test_a_key_is_rotated_over_either_link_and_the_node_stays_authentic(station: Station, node: Node) -> None:
    node.start(can=True)
    station.provision("nfc", "--profile", ANGLE)
    for epoch, via in ((2, "can"), (3, "nfc")):
        assert station.ask("agree", node.uuid, "--rotate", *station.desk.links.over(via))["epoch"] == epoch
        assert node.flash["epoch"] == epoch
        assert station.ask("verify", node.uuid, *station.desk.links.over(via))["verdict"] == "authentic"
    assert station.keys(node.uuid) == [("active", 3)]


def test_people_see_steps_on_stderr_and_a_summary_on_stdout(station: Station, node: Node) -> None:
    node.start()
    done = station.run("provision", "--profile", ANGLE, "--yes", *station.desk.links.over("nfc"))
    assert done.code == 0
    for shown in (node.uuid, "angle", "0 ° to 360 °", "authentic"):
        assert shown in done.out
    for name in STEPS:
        assert name in done.err
        assert f"✓ {name}" not in done.out
    fingerprint = station.ask("nodes", node.uuid)["nodes"][0]["fingerprint"]
    assert fingerprint[:16] in done.out
    assert fingerprint not in done.out + done.err
    assert "\x1b" not in done.out + done.err
    again = station.run("provision", *station.desk.links.over("nfc"))
    assert again.code == 0
    assert again.err.count("nothing to do") == 5
    quiet = station.run("--quiet", "provision", *station.desk.links.over("nfc"))
    assert quiet.err == ""
    assert "authentic" in quiet.out


def test_the_log_has_every_act_and_no_secret(station: Station, node: Node) -> None:
    node.start()
    station.provision("nfc", "--profile", ANGLE)
    outcome = station.run("--json", "log")
    log = outcome.json
    assert node.flash["key"] not in outcome.out
    assert bytes.fromhex(node.flash["key"]) not in b"".join(path.read_bytes() for path in station.home.iterdir())
    assert log["intact"] is True
    assert [entry["act"] for entry in log["entries"]] == [
        "init",
        "whitelist",
        "agree",
        "agree",
        "sign",
        "write",
        "verify",
    ]
    assert all(set(entry) >= {"seq", "at", "who", "act", "uuid", "outcome"} for entry in log["entries"])


def test_a_fresh_home_needs_only_init(desk: Desk, tmp_path: Path) -> None:
    station = Station(desk, tmp_path / "new" / "home", "another long passphrase")
    hint = station.refuses("provision", "-p", ANGLE, *desk.links.over("nfc"), code=3)["hint"]
    assert "teds-provision init" in hint
    assert not station.home.exists()
    made = station.ask("init", "--name", "crane", "--keystore", "file")
    assert set(made) >= {"name", "public_key", "fingerprint", "ca", "keystore"}
    assert set(made["ca"]) >= {"public_key", "fingerprint"}
    assert made["public_key"].startswith("-----BEGIN PUBLIC KEY-----")
    again = station.ask("init")
    assert {**again, "why": made["why"]} == made
    assert station.home.stat().st_mode & 0o777 == 0o700
    everything = b"".join(path.read_bytes() for path in station.home.rglob("*") if path.is_file())
    assert b"another long passphrase" not in everything
    node = desk.node().start()
    assert station.provision("nfc", "--profile", ANGLE)["verdict"] == "authentic"
    (nodes,) = station.ask("nodes")["nodes"]
    assert (nodes["uuid"], nodes["verdict"], nodes["state"]) == (node.uuid, "authentic", "provisioned")


@pytest.mark.needs("its own datasheet")
def test_the_summary_states_limits_and_readings_in_one_unit(station: Station, desk: Desk, tmp_path: Path) -> None:
    node = desk.node("hand", type_="gripper").start()
    file = tmp_path / "hand.csv"
    file.write_text("channel,raw,value [mm]\n" + "".join(f"{n},0,0\n{n},4095,110\n" for n in (1, 2)))
    done = station.run(
        "provision", "--profile", "gripper", "--calibration", file, "--yes", *station.desk.links.over("nfc")
    )
    assert done.code == 0, done.err
    line = next(line for line in done.out.splitlines() if line.startswith("channel 2"))
    assert "0 mm to 110 mm, calibrated, reads " in line
    assert line.endswith(" mm")
    assert node.uuid in done.out


def test_a_draft_renames_no_node_until_it_is_written(station: Station, desk: Desk, node: Node) -> None:
    """`build --name` renamed the node in every list and topic, and it kept that name when the draft was dropped."""
    node.start(nfc=False, can=True)
    other = desk.node("other").start(nfc=False, can=True)
    links = desk.links.over("can")

    def named() -> str:
        return str(station.ask("nodes", node.uuid)["nodes"][0]["name"])

    station.ask("provision", node.uuid, "--profile", FINGER, "--name", "thumb", "--yes", *links)
    station.ask("provision", other.uuid, "--profile", FINGER, "--name", "ring", "--yes", *links)
    station.ask("build", node.uuid, "--name", "index")
    assert named() == "thumb"
    assert station.ask("names", "list")["names"][0]["topic"].split("/")[2] in ("thumb", "ring")
    station.ask("draft", "drop", node.uuid, "--yes")
    assert station.ask("provision", node.uuid, "--yes", *links)["name"] == "thumb"
    station.ask("build", node.uuid, "--name", "index")
    station.ask("build", node.uuid)  # nothing else is asked for: what lies ready keeps its name
    station.ask("build", other.uuid, "--name", "index")
    for known_node in (node, other):
        station.ask("sign", known_node.uuid)
    station.ask("write", node.uuid, *links)
    assert named() == "index"
    assert "already has the name 'index'" in station.refuses("write", other.uuid, *links, code=6)["message"]
