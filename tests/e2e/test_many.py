"""More than one: several nodes on one bus, two stations on one node, one station run twice at a time."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from .desk import ANGLE, Desk, Node, Station, results

pytestmark = [
    pytest.mark.link,
    pytest.mark.both_nodes(nightly_in_c="test_whole_runs.py and tests/firmware/test_host_port.py hold the one in C"),
]

UUIDS = ("8d4d9da65281f7000000", "8d4d9da65281f7000001", "00112233445566778899")


@pytest.fixture
def bus(desk: Desk) -> list[Node]:
    """Return three nodes that have only a bus, in factory state."""
    return [desk.node(f"node{at}", uuid=uuid).start(nfc=False, can=True) for at, uuid in enumerate(UUIDS)]


def test_several_nodes_on_the_bus_are_listed_and_named(station: Station, bus: list[Node]) -> None:
    links = station.desk.links.over("can")
    found = station.ask("identify", *links)
    assert sorted(node["uuid"] for node in found["nodes"]) == sorted(UUIDS)
    assert len({node["can_address"] for node in found["nodes"]}) == 3
    flashes = [node.octets for node in bus]
    error = station.refuses("provision", "--profile", ANGLE, "--yes", *links, code=2)
    assert all(uuid in error["message"] for uuid in UUIDS)
    assert [node.octets for node in bus] == flashes


def test_each_node_of_a_bus_is_provisioned_by_its_name(station: Station, bus: list[Node]) -> None:
    links = station.desk.links.over("can")
    for node, words in ((bus[0], [UUIDS[0]]), (bus[2], ["0x00112233445566778899"]), (bus[1], [])):
        done = station.ask("provision", *words, "--profile", ANGLE, "--yes", *links)
        assert (done["uuid"], done["verdict"]) == (node.uuid, "authentic")
    assert [node.flash["provisioned"] for node in bus] == [True] * 3
    assert {len(node.flash["key"]) for node in bus} == {32}
    assert len({node.flash["key"] for node in bus}) == 3


def test_one_node_of_the_bus_is_met_by_its_address(station: Station, bus: list[Node]) -> None:
    address = bus[1].flash["can_address"]
    spec = f"{station.desk.links.can}&node={address:#04x}"
    found = station.ask("identify", "--via", "can", "--can", spec)
    assert (found["uuid"], found["can_address"]) == (UUIDS[1], address)
    assert [node["uuid"] for node in found["nodes"]] == [UUIDS[1]], "all that answered, as without node="


def test_two_runs_of_one_station_at_once_end_well_one_after_the_other(station: Station, bus: list[Node]) -> None:
    """The store is held by one; the other waits. Both get a source address of their own choice."""
    words = ["--json", "provision", "--profile", ANGLE, "--yes", "--via", "can", "--can"]
    first = station.start(*words, f"{station.desk.links.can}&source=0xF1", UUIDS[0])
    second = station.start(*words, f"{station.desk.links.can}&source=0xF2", UUIDS[1])
    for command, uuid in ((first, UUIDS[0]), (second, UUIDS[1])):
        outcome = command.end()
        assert outcome.code == 0, outcome
        assert (outcome.json["uuid"], outcome.json["verdict"]) == (uuid, "authentic")
    assert station.log_is_whole()


def test_the_same_command_twice_at_once_provisions_once(station: Station, bus: list[Node]) -> None:
    words = ["--json", "provision", UUIDS[0], "--profile", ANGLE, "--yes", "--via", "can", "--can"]
    commands = [station.start(*words, f"{station.desk.links.can}&source={source}") for source in ("0xF1", "0xF2")]
    outcomes = [command.end() for command in commands]
    assert [outcome.code for outcome in outcomes] == [0, 0], outcomes
    written = sorted(results(outcome.json)["write"] for outcome in outcomes)
    assert written == ["done", "nothing to do"]
    assert bus[0].flash["epoch"] == 1
    assert station.keys(UUIDS[0]) == [("active", 1)]


def test_a_dry_run_plans_every_node_of_the_bus_that_is_meant(station: Station, bus: list[Node], tmp_path: Path) -> None:
    links = station.desk.links.over("can")
    station.ask("provision", UUIDS[0], "--profile", ANGLE, "--yes", *links)
    station.ask("whitelist", "add", UUIDS[1])
    message = station.refuses("provision", *links, code=2)["message"]
    assert message.startswith("3 nodes answer on the bus, 2 of them not finished: ")
    flashes, store = [node.octets for node in bus], station.tables()
    done = station.run("--json", "provision", "--all", "--profile", ANGLE, "--dry-run", *links)
    objects = [json.loads(line) for line in done.out.splitlines()]
    assert (done.code, objects.pop()) == (0, {"totals": {"planned": 2, "failed": 0}})  # the first lacks its calibration
    plans = {item["uuid"]: item["plan"] for item in objects}
    rest = ["build", "sign", "write", "verify", "check"]
    assert plans == {UUIDS[0]: ["identify", *rest], UUIDS[1]: ["identify", "agree", *rest]}
    sheet = tmp_path / "boards.csv"
    sheet.write_text(f"uuid,profile\n{UUIDS[1]},{ANGLE}\n{UUIDS[2]},{ANGLE}\n")
    done = station.run("provision", "--all", "--batch", sheet, "--dry-run", *links)
    assert (done.code, done.out.count("Plan for")) == (0, 2), done.err
    assert done.out.endswith("2 nodes would be provisioned.\n")
    assert ([node.octets for node in bus], station.tables()) == (flashes, store)


AT_ONCE = pytest.mark.nightly("tests/e2e/test_many.py::test_two_owners_race_for_a_new_node_and_one_has_it[python-200]")


@pytest.mark.needs("a slow chip")
@pytest.mark.parametrize("delay", [pytest.param("0", marks=AT_ONCE), "200"])
def test_two_owners_race_for_a_new_node_and_one_has_it(desk: Desk, delay: str) -> None:
    node = desk.node(uuid=UUIDS[0]).start("--crypto-delay", delay, nfc=False, can=True)
    owners = desk.station(), desk.station("rival")
    words = ["--json", "provision", node.uuid, "--profile", ANGLE, "--yes", "--via", "can", "--can"]
    commands = [
        owner.start(*words, f"{desk.links.can}&source={source}")
        for owner, source in zip(owners, ("0xF1", "0xF2"), strict=True)
    ]
    outcomes = [command.end() for command in commands]
    assert sorted(outcome.code for outcome in outcomes) == [0, 6], outcomes
    won = [outcome.code for outcome in outcomes].index(0)
    assert owners[won].ask("verify", node.uuid, *desk.links.over("can"))["verdict"] == "authentic"
    flash = node.octets
    error = owners[1 - won].refuses("provision", "--profile", ANGLE, "--yes", *desk.links.over("can"), code=6)
    assert error["code"] in ("node-refused", "refused")  # the latter where it holds the key of its unconfirmed attempt
    assert node.octets == flash


def test_a_bus_on_which_no_node_is_ours_is_no_success(station: Station, bus: list[Node]) -> None:
    """--all, and nothing whitelisted: 6 with the nodes and the cure, and not "0 passed"."""
    done = station.run("--json", "provision", "--all", "--yes", "-p", ANGLE, *station.desk.links.over("can"))
    assert done.code == 6, done
    assert all(uuid in done.out for uuid in UUIDS)
    assert "whitelist add" in done.out
    assert all(node.flash["key"] is None for node in bus)


def test_a_board_that_is_authentic_but_not_finished_has_its_error_on_its_line(
    station: Station, bus: list[Node]
) -> None:
    """Its type requires a calibration: the line of JSON says why the board counts as failed, as the words do."""
    links = station.desk.links.over("can")
    station.ask("whitelist", "add", UUIDS[0])
    profile = "magnetic-angular-position-sensor"
    outcome = station.run("--json", "provision", "--all", "--profile", profile, "--yes", *links, "--timeout", "2")
    *lines, last = (json.loads(line) for line in outcome.out.splitlines())
    failed = [line for line in lines if line.get("error")]
    assert last["totals"]["failed"] == len(failed) > 0
    assert outcome.code != 0
    assert all(line["error"]["message"] for line in failed)


def test_a_node_whose_key_was_imported_is_read_and_not_signed_again(
    desk: Desk, station: Station, bus: list[Node], tmp_path: Path
) -> None:
    """--all gave boards that another station of the owner had finished a second signature, or ended with 6."""
    links, rival = desk.links.over("can"), desk.station("rival")
    calibration = tmp_path / "old.csv"
    calibration.write_text("# date: 2020-01-01\nraw,value [degree]\n0,0\n65535,359.9\n")
    sheet = tmp_path / "boards.csv"
    rows = [f"{uuid},node {at},{ANGLE},{calibration}" for at, uuid in enumerate(UUIDS)]
    sheet.write_text("\n".join(["uuid,name,profile,calibration", *rows]) + "\n")
    made = station.run("--json", "provision", "--all", "--batch", sheet, *links)
    assert made.code == 0, made
    assert made.err.count("was due again on") == 1, made.err
    assert "Warning: All 3 boards: " in made.err, "once, with the nodes that have it"

    for first, other, name in ((station, rival, "rival"), (rival, station, "bench")):
        key = tmp_path / f"{name}.pem"
        key.write_text(other.ask("init")["public_key"])
        first.ask("trust", "add", name, key, "--yes")
    bundle = tmp_path / "keys.bundle"
    station.ask("export-keys", "--to", "rival", "--all", "--output", bundle, "--yes")
    rival.ask("import-keys", bundle, "--yes")
    before = [node.flash["sequence"] for node in bus]
    outcome = rival.run("--json", "provision", "--all", *links)
    assert outcome.code == 0, outcome
    assert json.loads(outcome.out)["totals"] | {"seconds": 0} == {
        "passed": 0, "failed": 0, "skipped": 0, "seconds": 0, "first_pass": None, "steps": {},
    }  # fmt: skip
    assert [node.flash["sequence"] for node in bus] == before
    assert rival.ask("nodes", UUIDS[0])["nodes"][0]["verdict"] == "authentic"
