"""Who may key which node: the trust rules of the profile (section 2) as an operator meets them."""

from __future__ import annotations

import json

import pytest

from .desk import ANGLE, Desk, Node, Station, results

pytestmark = [
    pytest.mark.link,
    pytest.mark.both_nodes(nightly_in_c="test_whole_runs.py and tests/firmware/test_host_port.py hold the one in C"),
]

UUID = "8d4d9da65281f7000000"


def test_a_known_uuid_with_another_key_is_refused(desk: Desk, station: Station) -> None:
    """A copy of a tag, with the same UUID and a key of its own: no command talks it into anything."""
    real, copy = desk.node("real", uuid=UUID), desk.node("copy", uuid=UUID)
    real.start()
    station.provision("nfc", "--profile", ANGLE)
    real.stop()
    copy.start(can=True)
    flash, store = copy.octets, station.tables(without=("audit", "steps"))
    links = desk.links.over("nfc")
    for words in (
        ["provision", "--yes", *links],
        ["provision", "--yes", *desk.links.over("can")],
        ["identify", "--add", *links],
        ["agree", UUID, "--rotate", *links],
        ["write", UUID, *links],
        ["verify", UUID, *links],
        ["read", UUID, *links],
        ["reset", UUID, "--yes", *links],
    ):
        error = station.refuses(*words, code=6)
        assert error["code"] == "other-key", words
    assert copy.octets == flash
    assert station.tables(without=("audit", "steps")) == store
    refusals = [entry for entry in station.ask("log", UUID)["entries"] if entry["outcome"] == "other key"]
    assert len(refusals) == 8


def test_a_whitelist_entry_with_a_fingerprint_takes_that_key_alone(station: Station, node: Node) -> None:
    node.start()
    station.ask("whitelist", "add", node.uuid, "--fingerprint", "ab" * 32)
    error = station.refuses("provision", "-p", ANGLE, "--yes", *station.desk.links.over("nfc"), code=6)
    assert error["code"] == "other-key"
    assert node.flash["key"] is None


@pytest.mark.nightly(
    "tests/provisioning/test_agree.py::test_a_board_that_replaces_another_begins_at_its_own_epoch, and "
    "tests/provisioning/test_whitelist_pin.py::test_another_board_under_the_same_uuid_is_refused_until_the_entry_is_removed"
)
def test_a_replaced_board_is_taken_after_the_old_pin_is_removed(desk: Desk, station: Station) -> None:
    """The operator decides: ``whitelist remove`` forgets the pinned key, and the new board may be pinned."""
    old, new = desk.node("old", uuid=UUID), desk.node("new", uuid=UUID)
    old.start()
    station.provision("nfc", "--profile", ANGLE)
    station.ask("agree", UUID, "--rotate", *desk.links.over("nfc"))
    old.stop()
    new.start()
    station.refuses("provision", "--yes", *desk.links.over("nfc"), code=6)
    station.ask("whitelist", "remove", UUID, "--yes")
    done = station.provision("nfc", "--profile", ANGLE)
    assert done["verdict"] == "authentic"
    assert new.flash["provisioned"] is True
    assert station.keys(UUID) == [("active", 1)]
    assert station.ask("agree", UUID, "--rotate", *desk.links.over("nfc"))["epoch"] == 2
    assert station.provision("nfc")["verdict"] == "authentic"
    new.stop()
    old.start()
    assert station.refuses("provision", "--yes", *desk.links.over("nfc"), code=6)["code"] == "other-key"


def test_the_same_board_comes_back_after_it_was_taken_off_the_whitelist(station: Station, node: Node) -> None:
    node.start()
    station.provision("nfc", "--profile", ANGLE)
    station.ask("whitelist", "remove", node.uuid, "--yes")
    sheet = node.octets
    assert results(station.provision("nfc"))["agree"] == "nothing to do"
    assert node.octets == sheet
    assert station.keys(node.uuid) == [("active", 1)]


BY_BUS = pytest.mark.nightly(
    "tests/e2e/test_trust.py::test_a_station_of_another_owner_cannot_take_a_node[python-nfc]; without a tap "
    "tests/provisioning/test_agree.py::test_a_station_of_another_owner_cannot_rekey_a_node"
)


@pytest.mark.parametrize("via", ["nfc", pytest.param("can", marks=BY_BUS)])
def test_a_station_of_another_owner_cannot_take_a_node(desk: Desk, via: str) -> None:
    owner, rival = desk.station(), desk.station("rival")
    node = desk.node().start(nfc=via == "nfc", can=via == "can")
    owner.provision(via, "--profile", ANGLE)
    flash, links = node.octets, desk.links.over(via)
    error = rival.refuses("provision", "--profile", ANGLE, "--yes", *links, code=6)
    assert error["code"] in ("node-refused", "refused")  # by the node, or before it is asked: no tap, no pin
    assert error["hint"]
    for words in (["agree", node.uuid, "--rotate"], ["write", node.uuid], ["reset", node.uuid, "--yes"]):
        rival.refuses(*words, *links, code=6)  # it never came onto the rival's whitelist
    assert node.octets == flash
    assert rival.keys(node.uuid) == []
    outcome = rival.run("verify", node.uuid, *links)
    assert outcome.code == 4
    (line,) = [line for line in outcome.out.splitlines() if line.startswith("signing station")]
    assert line.endswith("is neither trusted here nor certified by a trusted CA")
    assert f"{node.uuid}: not authentic" in outcome.out.splitlines()
    assert owner.ask("verify", node.uuid, *links)["verdict"] == "authentic"


BY_HAND = pytest.mark.nightly(
    "tests/e2e/test_trust.py::test_after_a_reset_a_new_owner_may_take_the_node[python-False]; by hand "
    "tests/provisioning/test_provision.py::test_a_node_reset_by_hand_is_provisioned_again"
)


@pytest.mark.parametrize("by_hand", [pytest.param(True, marks=BY_HAND), False])
def test_after_a_reset_a_new_owner_may_take_the_node(desk: Desk, by_hand: bool) -> None:
    owner, rival = desk.station(), desk.station("rival")
    node = desk.node().start()
    links = desk.links.over("nfc")
    owner.provision("nfc", "--profile", ANGLE)
    sequence = node.flash["sequence"]
    if by_hand:
        node.press()
    else:
        receipt = owner.ask("reset", node.uuid, "--yes", *links)
        assert (receipt["uuid"], receipt["state"]) == (node.uuid, "factory")
        assert owner.keys(node.uuid) == []
    assert node.flash["ca"] is None
    done = rival.provision("nfc", "--profile", ANGLE)
    assert (done["verdict"], results(done)["agree"]) == ("authentic", "done")
    assert node.flash["sequence"] > sequence
    assert owner.refuses("provision", "--yes", *links, code=6)["code"] in ("refused", "node-refused")
    assert rival.ask("verify", node.uuid, *links)["verdict"] == "authentic"


def test_a_node_that_is_not_on_the_whitelist_is_not_keyed(station: Station, node: Node) -> None:
    node.start()
    links = station.desk.links.over("nfc")
    flash = node.octets
    for words in (["agree", node.uuid], ["write", node.uuid], ["sign", node.uuid]):
        error = station.refuses(*words, *links, code=6)
        assert error["code"] == "not-whitelisted"
        assert f"whitelist add {node.uuid}" in error["hint"]
    error = station.refuses("provision", "--profile", ANGLE, *links, code=6)
    assert error["code"] == "not-whitelisted"
    assert "--yes" in error["hint"]
    assert node.octets == flash
    assert station.ask("whitelist", "list")["whitelist"] == []


def test_the_datasheet_of_another_owner_is_no_anchor(desk: Desk, station: Station) -> None:
    """What stands in a TEDS is believed by nobody: a good signature of a stranger is "not authentic"."""
    rival = desk.station("rival")
    node = desk.node().start()
    rival.provision("nfc", "--profile", ANGLE)
    image = rival.ask("read", node.uuid, *desk.links.over("nfc"))
    file = desk.folder / "image.json"
    file.write_text(json.dumps(image))
    reply = station.ask("verify", file, code=4)
    assert reply["verdict"] == "not authentic"
    assert "signing station" in {check["name"] for check in reply["checks"] if check["result"] == "failed"}
