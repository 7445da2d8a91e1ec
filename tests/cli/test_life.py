"""``revoke``, ``decommission``, ``replace``, and proving at import, with a virtual node on a real bus."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from teds_provision.station.store.records import KeptMeasurement
from tests.bench import PASSPHRASE, make_station
from tests.e2e.desk import Desk, Node
from tests.handover.desk import trust
from tests.places import free_bus

from .shell import Outcome, spawn

pytestmark = pytest.mark.link
PROFILE = "temperature-sensor"


class Yard:
    """Two stations that trust each other, and nodes without NFC on one bus."""

    def __init__(self, folder: Path) -> None:
        self.desk = Desk(folder, folder)
        self.homes = {name: folder / name for name in ("north", "south")}
        north, south = (make_station(home, name) for name, home in self.homes.items())
        trust(north, south)
        trust(south, north)
        north.close()
        south.close()
        self.bus = ["--via", "can", "--can", self.desk.links.can]
        self.nowhere = ["--via", "can", "--can", free_bus(), "--timeout", "1"]

    def run(self, home: str, *words: object) -> Outcome:
        return spawn("--home", self.homes[home], "--json", *words, passphrase=PASSPHRASE)

    def done(self, home: str, *words: object) -> dict:  # type: ignore[type-arg]
        outcome = self.run(home, *words)
        assert outcome.code == 0, outcome
        return dict(outcome.json)

    def node(self, name: str, **more: str) -> Node:
        return self.desk.node(name, **more).start(nfc=False, can=True)

    def provisioned(self, name: str = "node", *words: str) -> Node:
        node = self.node(name)
        self.done("north", "provision", "--profile", PROFILE, "--yes", *words, *self.bus)
        return node


@pytest.fixture
def yard(tmp_path: Path) -> Iterator[Yard]:
    made = Yard(tmp_path)
    yield made
    made.desk.clear()


def test_a_move_is_proven_and_rotated_at_import(yard: Yard) -> None:
    node = yard.provisioned()
    bundle = yard.desk.folder / "keys.jwe"
    yard.done("north", "export-keys", "--to", "south", "--all", "--mode", "move", "--output", bundle, "--yes")
    taken = yard.done("south", "import-keys", bundle, "--yes", *yard.bus)
    assert (taken["proven"], taken["pending"]) == ([node.uuid], [])
    assert node.flash["epoch"] == 2
    yard.done("north", "handover", "receipt", taken["receipt"])
    verified = yard.done("south", "verify", node.uuid, *yard.bus)
    assert verified["verdict"] == "authentic"
    assert yard.run("north", "agree", node.uuid, *yard.bus).code == 6
    (listed,) = yard.done("south", "nodes")["nodes"]
    assert (listed["epoch"], listed["uuid"]) == (2, node.uuid)


def test_a_node_that_is_not_met_stays_pending(yard: Yard) -> None:
    node = yard.provisioned()
    bundle = yard.desk.folder / "keys.jwe"
    yard.done("north", "export-keys", "--to", "south", "--all", "--output", bundle, "--yes")
    taken = yard.done("south", "import-keys", bundle, "--yes", *yard.nowhere)
    assert (taken["proven"], taken["pending"]) == ([], [node.uuid])
    assert node.uuid in taken["not_proven"]
    assert yard.run("south", "import-keys", bundle, "--yes", "--prove", *yard.nowhere).code == 5
    again = yard.done("south", "import-keys", bundle, "--yes", "--prove", *yard.bus)
    assert again["proven"] == [node.uuid]
    assert node.flash["epoch"] == 1


def test_a_node_that_a_measurement_holds_is_not_taken_out_of_service(yard: Yard) -> None:
    """It answers: neither is it out of reach, nor is anything recorded as unconfirmed, --force or not."""
    node = yard.node("node", type_=PROFILE)
    yard.done("north", "provision", "--profile", PROFILE, "--yes", *yard.bus)
    words = ("measure", node.uuid, "--rate", "5", *yard.bus)
    running = yard.desk.start("--home", yard.homes["north"], "--json", *words, passphrase=PASSPHRASE)
    running.wait_for('"data"')
    for more in ([], ["--force"]):
        outcome = yard.run("north", "decommission", node.uuid, "--yes", *more, *yard.bus)
        assert (outcome.code, outcome.json["error"]["code"]) == (6, "frozen"), outcome
        assert "stays in service" in outcome.json["error"]["message"]
        assert outcome.json["error"]["hint"] == "End that measurement first."
    running.signal(signal.SIGINT)
    assert running.end().code == 0
    assert yard.done("north", "decommission", node.uuid, "--yes", *yard.bus)["confirmed"] is True


def test_out_of_service_with_the_nodes_own_receipt(yard: Yard) -> None:
    node = yard.provisioned()
    plan = yard.done("north", "decommission", node.uuid, "--dry-run")
    assert plan["plan"] == "decommission"
    gone = yard.run("north", "decommission", node.uuid, "--yes", *yard.nowhere)
    assert (gone.code, "--force" in gone.json["error"]["hint"]) == (5, True)
    unconfirmed = yard.done("north", "decommission", node.uuid, "--yes", "--force", *yard.nowhere)
    assert (unconfirmed["confirmed"], unconfirmed["proof"]) == (False, None)
    confirmed = yard.done("north", "decommission", node.uuid, "--yes", *yard.bus)
    assert (confirmed["confirmed"], len(confirmed["proof"]), confirmed["epoch"]) == (True, 128, 1)
    assert node.flash["key"] is None
    assert yard.done("north", "decommission", node.uuid, "--yes")["fresh"] is False


def test_a_spare_in_the_place_of_a_node(yard: Yard) -> None:
    old = yard.provisioned("old", "--name", "elbow")
    old.stop()
    spare = yard.provisioned("spare")
    replaced = yard.done("north", "replace", "elbow", spare.uuid, "--yes")
    assert (replaced["name"], replaced["profile"], replaced["confirmed"]) == ("elbow", PROFILE, False)
    assert replaced["calibration_copied"] is False
    assert yard.done("north", "replace", old.uuid, spare.uuid, "--yes")["fresh"] is False
    (node,) = yard.done("north", "nodes", "elbow")["nodes"]
    assert node["uuid"] == spare.uuid


def test_groups_names_and_measurements_follow_the_spare_and_forget_what_is_gone(yard: Yard) -> None:
    """Groups were stored twice: the group kept the dead node, and `measure` failed for ever."""
    old, spare, other = "8d4d9da65281f70000aa", "8d4d9da65281f70000bb", "8d4d9da65281f70000cc"
    for uuid in (old, spare, other):
        yard.done("north", "whitelist", "add", uuid)
    with closing(make_station(yard.homes["north"], "north")) as station:
        octets = bytes.fromhex(old)
        station.nodes.remember(octets, name="hook")
        station.measurements.rename(octets, 1, "force")
        station.measurements.set_frame(octets, 0, "tool")
        for group, uuids in (("crane", [old, other]), ("single", [old])):
            station.groups.create(group, [bytes.fromhex(uuid) for uuid in uuids])
        for item in ("a", "b"):
            kept = KeptMeasurement(
                item, group="single" if item == "a" else None, uuids=() if item == "a" else (octets,)
            )
            station.measurements.keep(kept)
        station.measurements.rename(bytes.fromhex(spare), 2, "other name")
        station.measurements.rename(octets, 2, "angle")

    moved = yard.done("north", "replace", old, spare, "--yes")["moved"]
    assert moved["groups"] == ["crane", "single"]
    assert (moved["topics"], moved["measurements"], moved["ended"]) == (["force"], ["a", "b"], [])
    assert "'angle' of channel 2" in moved["kept"][0]
    again = yard.done("north", "replace", old, spare, "--yes")
    assert (again["fresh"], again["moved"]["groups"]) == (False, [])
    groups = {group["name"]: group["uuids"] for group in yard.done("north", "group", "list")["groups"]}
    assert groups == {"crane": sorted([spare, other]), "single": [spare]}

    gone = yard.done("north", "decommission", spare, "--force", "--yes", *yard.nowhere)["removed"]
    assert (gone["groups"], gone["measurements"], gone["ended"]) == (["crane", "single"], [], ["a", "b"])
    groups = {group["name"]: group["uuids"] for group in yard.done("north", "group", "list")["groups"]}
    assert groups == {"crane": [other], "single": []}
    with closing(make_station(yard.homes["north"], "north")) as station:
        assert station.measurements.all() == []
        assert station.measurements.names == {}, "the names are free again"


def test_revoked_permanently(yard: Yard) -> None:
    node = yard.provisioned()
    assert yard.run("north", "revoke", node.uuid, "--why", "stolen").code == 6
    assert yard.done("north", "revoke", node.uuid, "--why", "stolen", "--dry-run")["keys"] == 1
    done = yard.done("north", "revoke", node.uuid, "--why", "stolen", "--yes")
    assert (done["why"], done["fresh"], len(done["fingerprint"])) == ("stolen", True, 64)
    assert yard.done("north", "revoke", node.uuid, "--why", "again", "--yes")["fresh"] is False
    refused = yard.run("north", "agree", node.uuid, *yard.bus)
    assert (refused.code, "was revoked: stolen" in refused.json["error"]["message"]) == (6, True)
    verdict = yard.run("north", "verify", node.uuid, *yard.bus)
    assert verdict.code == 4
    assert [c["name"] for c in verdict.json["checks"] if c["result"] == "failed"] == ["not revoked"]
