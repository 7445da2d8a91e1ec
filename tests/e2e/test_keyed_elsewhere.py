"""A node that has a key of another station: each way out that the error names, by its commands, to the end."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench import make_station

from .desk import ANGLE, Desk, Node, Station

pytestmark = pytest.mark.link
REMEDIES = (
    "--home NEW restore FILE",
    "init --ca FILE",
    "export-keys",
    "import-keys",
    "button for 5 s",
    "node reset DIR",
)


def no_step_is_shown_as_done(station: Station, node: Node) -> None:
    """``provision`` refuses: its lines name no step whose effect was not kept, and nothing was kept."""
    outcome = station.run("--no-input", "provision", "-p", ANGLE, "--yes", *station.desk.links.over("nfc"))
    assert outcome.code == 6, outcome
    assert "✓ identify" in outcome.err
    assert "whitelist  " not in outcome.err
    assert "agree  " not in outcome.err
    assert station.ask("whitelist", "list")["whitelist"] == []
    assert station.keys(node.uuid) == []


def test_another_owners_node_comes_by_backup_by_ca_file_by_handover_or_by_a_reset(desk: Desk) -> None:
    links, node = desk.links.over("nfc"), desk.node()
    node.start()
    lost, rival = desk.station("bench"), desk.station("rival")
    assert lost.provision("nfc", "-p", ANGLE)["verdict"] == "authentic"
    backup, owner_ca = desk.folder / "station.backup", desk.folder / "owner-ca.pem"
    lost.ask("backup", backup)
    lost.ask("trust", "ca", "export", owner_ca)

    # the rival cannot have it, whatever it tries, and each refusal says so at once, with the three ways out
    no_step_is_shown_as_done(rival, node)
    assert "another owner's CA" in rival.refuses("agree", node.uuid, "--rotate", "--yes", *links, code=6)["message"]
    rival.ask("identify", "--add", *links)
    for words in (["provision", "-p", ANGLE, "--yes"], ["agree", node.uuid, "--rotate", "--yes"]):
        error = rival.refuses(*words, *links, code=6)
        assert "another owner's CA" in error["message"]
        assert all(word in error["hint"] for word in REMEDIES), error
    rival.ask("whitelist", "remove", node.uuid, "--yes")

    # a lost station's own backup, in an empty home
    back = Station(desk, desk.folder / "back")
    back.ask("restore", backup)
    assert back.provision("nfc", "-p", ANGLE)["verdict"] == "authentic"

    # only the CA's file is left: the node has a key of the same owner, and is taken over at a tap
    again = Station(desk, desk.folder / "again")
    made = again.ask("init", "--name", "again", "--keystore", "file", "--ca", owner_ca)
    assert made["ca"] == lost.ask("init")["ca"]
    assert again.ask("init", "--ca", owner_ca)["fingerprint"] == made["fingerprint"]
    assert "another CA" in rival.refuses("init", "--ca", owner_ca, code=6)["message"]
    no_step_is_shown_as_done(again, node)
    error = again.refuses("provision", "-p", ANGLE, "--yes", *links, code=6)
    assert error["hint"].endswith(f"identify --add, then agree {node.uuid} --rotate --yes")
    again.ask("identify", "--add", *links)
    again.ask("agree", node.uuid, "--rotate", "--yes", *links)
    assert again.provision("nfc", "-p", ANGLE)["verdict"] == "authentic"
    again.ask("trust", "ca", "sign", _request(desk, "later"), "--output", desk.folder / "later.cert", "--yes")

    # its owner hands it over
    for first, other in ((again, rival), (rival, again)):
        pem = desk.folder / f"{other.home.name}.pem"
        pem.write_text(other.ask("init")["public_key"])
        first.ask("trust", "add", other.home.name, pem, "--yes")
    bundle = desk.folder / "keys.jwe"
    again.ask("export-keys", "--to", "rival", node.uuid, "--output", bundle, "--yes")
    rival.ask("import-keys", bundle, "--yes", *links)
    assert rival.provision("nfc", "-p", ANGLE)["verdict"] == "authentic"

    # nothing of it is left: reset by hand
    make_station(desk.folder / "third", "third").close()
    third = Station(desk, desk.folder / "third")
    no_step_is_shown_as_done(third, node)
    node.press()
    if desk.nodes != "c":  # the virtual node prints what happened to it
        assert node.process is not None
        node.process.wait_for('"event": "reset"')
    assert third.provision("nfc", "-p", ANGLE)["verdict"] == "authentic"


def _request(desk: Desk, name: str) -> Path:
    file = desk.folder / f"{name}.request"
    Station(desk, desk.folder / name).ask("init", "--name", name, "--keystore", "file", "--request", file)
    return file
