"""``--dry-run`` changes nothing; nobody is asked with ``--no-input``; options come from variables and files too."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.cli.shell import clean_environment
from tests.terminal import on_terminal

from .desk import ANGLE, FINGER, Desk, Node, Station

pytestmark = pytest.mark.link


@pytest.fixture
def finished(station: Station, node: Node) -> Node:
    """Return a node that lies there, provisioned."""
    node.start(can=True)
    station.provision("nfc", "--profile", ANGLE)
    return node


def everything(station: Station, *nodes: Node) -> tuple[Any, ...]:
    """Store and flash to the last row, logs and moments of the last sight included."""
    files = sorted(path.name for path in station.home.iterdir() if not path.name.startswith("store."))
    return station.tables(), [node.octets for node in nodes], files


def test_a_dry_run_on_a_new_node_changes_nothing(station: Station, node: Node, tmp_path: Path) -> None:
    node.start(can=True)
    links = station.desk.links
    before = everything(station, node)
    plan = station.ask("provision", "--profile", ANGLE, "--dry-run", *links.over("nfc"))
    assert plan["uuid"] == node.uuid
    assert plan["plan"] == ["identify", "whitelist", "agree", "build", "sign", "write", "verify", "check"]
    assert everything(station, node) == before
    outcome = station.run("provision", "--profile", ANGLE, "--dry-run", *links.over("nfc"))
    assert (outcome.code, node.uuid in outcome.out) == (0, True)
    station.ask("whitelist", "add", node.uuid, "--dry-run")
    file = tmp_path / "list.csv"
    file.write_text(f"uuid\n{node.uuid}\n")
    station.ask("whitelist", "import", file, "--dry-run")
    station.ask("whitelist", "export", tmp_path / "out.xml", "--dry-run")
    assert not (tmp_path / "out.xml").exists()
    found = station.ask("identify", "--add", "--dry-run", *links.over("nfc"))
    assert (found["uuid"], found["whitelisted"], found["plan"]) == (node.uuid, False, ["whitelist"])
    assert station.ask("identify", "--dry-run", *links.over("can"))["plan"] == []
    assert "would be whitelisted" in station.run("identify", "--add", "--dry-run", *links.over("nfc")).out
    assert everything(station, node) == before
    node.stop()
    assert station.ask("node", "reset", node.folder, "--dry-run") == {"uuid": node.uuid, "plan": "reset"}
    assert everything(station, node) == before


def test_a_dry_run_on_a_finished_node_changes_nothing(station: Station, finished: Node, tmp_path: Path) -> None:
    links = station.desk.links.over("can")
    before = everything(station, finished)
    for words in (
        ["provision", "--name", "renamed", "--dry-run", *links],
        ["agree", finished.uuid, "--dry-run", *links],
        ["agree", finished.uuid, "--rotate", "--dry-run", *links],
        ["build", finished.uuid, "--profile", ANGLE, "--name", "x", "--output", tmp_path / "i.json", "--dry-run"],
        ["sign", finished.uuid, "--output", tmp_path / "i.json", "--dry-run"],
        ["write", finished.uuid, "--dry-run", *links],
        ["reset", finished.uuid, "--dry-run", *links],
        ["whitelist", "remove", finished.uuid, "--dry-run"],
    ):
        assert station.ask(*words), words
        assert everything(station, finished) == before, words
    assert not (tmp_path / "i.json").exists()


def test_no_question_is_asked_with_no_input(station: Station, node: Node) -> None:
    node.start()
    links = station.desk.links.over("nfc")
    before = node.octets
    outcome = station.run("--no-input", "provision", "--profile", ANGLE, *links)
    assert outcome.code == 6
    assert "--yes" in outcome.err
    assert node.octets == before
    station.ask("whitelist", "add", node.uuid)
    for words in (["whitelist", "remove", node.uuid], ["reset", node.uuid, *links]):
        outcome = station.run("--no-input", *words)
        assert outcome.code == 6, outcome
        assert "--yes" in outcome.err
    assert len(station.ask("whitelist", "list")["whitelist"]) == 1
    assert station.run("--no-input", "whitelist", "remove", node.uuid, "--yes").code == 0


def test_a_person_is_asked_on_a_terminal_and_may_say_no(station: Station, node: Node) -> None:
    """On a real pseudo-terminal: the question names UUID and key; "n" ends with 6, node and whitelist as before."""
    node.start()
    before = node.octets
    words = ("provision", "--profile", ANGLE, *station.desk.links.over("nfc"))
    outcome = on_terminal(
        station.home, *words, streams=["stdin", "stderr"], answers=["n"], passphrase=station.passphrase
    )
    assert node.uuid in outcome.screen
    assert outcome.code == 6
    assert outcome.out == ""
    assert node.octets == before
    assert station.ask("whitelist", "list")["whitelist"] == []


def test_options_come_from_variables_and_from_config_toml(station: Station, node: Node) -> None:
    """The command line goes before the variable, the variable before the file."""
    node.start(can=True)
    links = station.desk.links
    (station.home / "config.toml").write_text(
        f'via = "can"\ncan = "{links.can}"\nnfc = "udp:localhost:9"\nprofile = "{FINGER}"\n[identify]\ntimeout = 3.0\n'
    )
    found = station.ask("identify")
    assert (found["uuid"], found["tag_uid"]) == (node.uuid, None)
    variables = clean_environment(TEDS_PROVISION_VIA="nfc", TEDS_PROVISION_NFC=links.nfc)
    tapped = station.ask("identify", "--add", environment=variables)
    assert tapped["tag_uid"]
    variables |= {"TEDS_PROVISION_JSON": "1", "TEDS_PROVISION_HOME": str(station.home), "TEDS_PROVISION_YES": "1"}
    command = station.desk.start("provision", "-p", ANGLE, passphrase=station.passphrase, environment=variables)
    done = command.end()
    assert done.code == 0, done
    assert [channel["name"] for channel in done.json["channels"]] == ["angle"]
    assert station.ask("agree", node.uuid, "--via", "nfc", "--nfc", links.nfc)["epoch"] == 1


def test_a_config_that_is_no_toml_is_8(station: Station) -> None:
    (station.home / "config.toml").write_text("via = can\n")
    error = station.refuses("nodes", code=8)
    assert "config.toml" in error["message"]


@pytest.mark.parametrize(
    "bad", ["home = 3\n", 'timeout = "soon"\n', 'via = "radio"\n', "nmae = 1\n[identify]\nx = 1\n"]
)
def test_nonsense_in_a_config_is_reported_without_a_traceback(station: Station, bad: str) -> None:
    (station.home / "config.toml").write_text(bad)
    outcome = station.run("--json", "identify", "--timeout", "0.5", "--nfc", station.desk.links.nfc)
    assert outcome.code in (2, 5, 8), outcome
    assert outcome.json["error"]["code"] != "bug"


def test_the_whitelist_of_an_ncap_lets_its_nodes_in(desk: Desk, station: Station, tmp_path: Path) -> None:
    """XML with a UUID and nothing more: the node's key is pinned by its first tap, and exported with it."""
    node = desk.node(uuid="8d4d9da65281f7000000").start()
    ncap, out = tmp_path / "ncap.xml", tmp_path / "out.json"
    ncap.write_text("<?xml version='1.0'?><whitelist><uuid>0x8D4D9DA65281F7000000</uuid></whitelist>")
    assert station.ask("whitelist", "import", ncap)["added"] == 1
    done = station.ask("provision", "--profile", ANGLE, *desk.links.over("nfc"))
    assert done["verdict"] == "authentic"
    station.ask("whitelist", "export", out)
    (entry,) = json.loads(out.read_text())["whitelist"]
    assert (entry["fingerprint"], entry["assurance"]) == (done["fingerprint"], "tap")
    assert node.flash["provisioned"] is True
