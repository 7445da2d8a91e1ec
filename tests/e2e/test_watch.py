"""Tap after tap: ``--watch`` with nodes that come and go, and how it ends."""

from __future__ import annotations

import signal

import pytest

from tests.bench import PASSPHRASE
from tests.cli.shell import call, set_passphrase
from tests.pace import until
from tests.places import free_reader

from .desk import ANGLE, Desk, Links, Node, Station, results

pytestmark = pytest.mark.link


def test_node_after_node_is_provisioned_as_it_is_tapped(desk: Desk, station: Station) -> None:
    """Three nodes on one reader, the first one twice; one line each; SIGTERM ends it well."""
    nodes = [desk.node(f"node{number}") for number in range(3)]
    words = ["--json", "provision", "--watch", "--yes", "--profile", ANGLE, *desk.links.over("nfc")]
    watch = station.start(*words)
    for count, node in enumerate([*nodes, nodes[0]], start=1):
        node.start()
        done = watch.wait_for_lines(count)[-1]
        assert (done["uuid"], done["verdict"]) == (node.uuid, "authentic")
        node.stop()
    ended = results(done)
    assert ended.pop("check") == "skipped"  # it does not measure: its hardware is not asked
    assert set(ended.values()) == {"done", "nothing to do"}
    watch.signal(signal.SIGTERM)
    outcome = watch.end()
    assert outcome.code == 0
    assert outcome.out.count("\n") == 4
    assert len(station.ask("nodes")["nodes"]) == 3


def test_both_kinds_of_tag_take_turns(desk: Desk, station: Station) -> None:
    first, second = desk.node("first"), desk.node("second")
    watch = station.start("--json", "identify", "--watch", "--add", *desk.links.over("nfc"))
    first.start("--tag", "2")
    found = watch.wait_for_lines(1)[-1]
    assert (found["uuid"], found["whitelisted"], found["state"]) == (first.uuid, True, "factory")
    first.stop()
    second.start("--tag", "4")
    assert watch.wait_for_lines(2)[-1]["uuid"] == second.uuid
    watch.signal(signal.SIGTERM)
    assert watch.end().code == 0
    listed = {entry["uuid"]: entry["assurance"] for entry in station.ask("whitelist", "list")["whitelist"]}
    assert listed == {first.uuid: "tap", second.uuid: "tap"}


def test_new_nodes_on_the_bus_are_seen_as_they_are_plugged_in(desk: Desk, station: Station) -> None:
    first, second = desk.node("first"), desk.node("second")
    first.start(nfc=False, can=True)
    watch = station.start("--json", "provision", "--watch", "--yes", "--profile", ANGLE, *desk.links.over("can"))
    assert watch.wait_for_lines(1)[-1]["uuid"] == first.uuid
    second.start(nfc=False, can=True)
    assert watch.wait_for_lines(2)[-1]["uuid"] == second.uuid
    watch.signal(signal.SIGTERM)
    outcome = watch.end()
    assert outcome.code == 0
    assert outcome.out.count("authentic") == 2


def test_one_node_that_fails_does_not_end_the_watch(desk: Desk, station: Station) -> None:
    """A node of another owner is refused in its line; the next one is provisioned."""
    foreign, own = desk.node("foreign"), desk.node("own")
    foreign.start()
    assert desk.station("rival").provision("nfc", "--profile", ANGLE)["verdict"] == "authentic"
    sheet = foreign.octets
    watch = station.start("--json", "provision", "--watch", "--yes", "--profile", ANGLE, *desk.links.over("nfc"))
    (line,) = watch.wait_for_lines(1)
    assert line["error"]["code"] == "refused"
    assert "another owner's CA" in line["error"]["message"]
    assert foreign.octets == sheet
    foreign.stop()
    own.start()
    assert watch.wait_for_lines(2)[-1]["verdict"] == "authentic"
    watch.signal(signal.SIGTERM)
    assert watch.end().code == 0


@pytest.mark.parametrize("command", ["provision", "identify"])
@pytest.mark.parametrize("via", ["nfc", "can"])
def test_ctrl_c_ends_a_watch_with_130(station: Station, command: str, via: str) -> None:
    links = station.desk.links.over(via)
    order = ["--profile", ANGLE, "--yes"] if command == "provision" else []
    watch = station.start("-v", command, "--watch", *order, *links)
    watch.wait_for("…")
    watch.signal(signal.SIGINT)
    outcome = watch.end()
    assert outcome.code == 130
    assert "Interrupted" in outcome.err
    assert "Traceback" not in outcome.err
    assert outcome.out == ""


def test_a_person_reads_one_line_for_each_node(station: Station, node: Node) -> None:
    node.start()
    watch = station.start("identify", "--watch", *station.desk.links.over("nfc"))
    watch.wait_for(node.uuid)
    watch.wait_for("not whitelisted")
    watch.signal(signal.SIGTERM)
    outcome = watch.end()
    assert outcome.code == 0
    assert outcome.out.count("\n") == 1


def test_several_readers_serve_several_taps_and_a_slow_board_delays_no_other(desk: Desk, station: Station) -> None:
    """Two readers; the board on one takes its time over each point operation, the other one passes meanwhile."""
    slow, quick = desk.node("slow"), desk.node("quick")
    ports = [desk.links.nfc, free_reader()]
    words = ["--json", "provision", "--watch", "--yes", "-p", ANGLE, "--nfc", ports[0], "--nfc", ports[1]]
    desk.links = Links(nfc=ports[1], can=desk.links.can)
    quick.start()
    assert quick.process is not None
    quick.process.signal(
        signal.SIGSTOP
    )  # it is not there yet: when it is to come, the test need not wait for its start
    desk.links = Links(nfc=ports[0], can=desk.links.can)
    slow.start("--crypto-delay", "700")
    watch = station.start(*words)
    until(lambda: slow.flash["key"] is not None, "the slow one is being worked on")
    quick.process.signal(signal.SIGCONT)
    lines = watch.wait_for_lines(2)
    assert [line["uuid"] for line in lines] == [quick.uuid, slow.uuid]
    assert {line["verdict"] for line in lines} == {"authentic"}
    assert all(line["time"] for line in lines)
    watch.signal(signal.SIGTERM)
    assert watch.end().code == 0
    assert station.log_is_whole()


def test_a_watch_ends_when_passphrase_and_master_key_were_changed(desk: Desk, station: Station) -> None:
    """It cannot open the vault again, and keeps no passphrase: exit 7 at the next board, which is not harmed."""
    first, second = desk.node("first"), desk.node("second")
    first.start()
    watch = station.start("--json", "provision", "--watch", "--yes", "--profile", ANGLE, *desk.links.over("nfc"))
    assert watch.wait_for_lines(1)[-1]["verdict"] == "authentic"
    first.stop()
    assert set_passphrase(station.home, PASSPHRASE, "a new one for all").code == 0
    assert call(station.home, "vault", "rewrap", passphrase="a new one for all").code == 0
    second.start()
    outcome = watch.end()
    assert (outcome.code, "vault-locked" in outcome.out) == (7, True), outcome
    station.passphrase = "a new one for all"
    assert station.provision("nfc", "--profile", ANGLE)["verdict"] == "authentic"
