"""A day at the bench: sheets, names, what nobody named, "no", an undo; and every node of a bus at once."""

from __future__ import annotations

import csv
import json
import signal
from pathlib import Path
from typing import Any

import pytest

from tests.cli.shell import Outcome, clean_environment
from tests.terminal import on_terminal

from .desk import ANGLE, FINGER, Desk, Node, Station, results

pytestmark = [
    pytest.mark.link,
    pytest.mark.both_nodes(nightly_in_c="test_whole_runs.py and tests/firmware/test_host_port.py hold the one in C"),
]

CALIBRATION = "raw,value [degree]\n0,0\n32768,{middle}\n65535,359.9\n"


def sheet(path: Path, *rows: dict[str, str]) -> Path:
    """Return a sheet of boards."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["uuid", "name", "profile", "calibration", "fingerprint"])
        writer.writeheader()
        writer.writerows(rows)
    return path


def lines_of(outcome: Outcome) -> list[Any]:
    return [json.loads(line) for line in outcome.out.splitlines()]


def on_a_terminal(station: Station, *words: object, answer: str) -> tuple[int, str]:
    """Run a command on a terminal, answer its question; exit code and all that was shown."""
    environment = clean_environment(TERM="xterm")
    outcome = on_terminal(
        station.home, *words, answers=[answer], passphrase=station.passphrase, environment=environment
    )
    return outcome.code, outcome.screen


# -- what is written is what was asked for -----------------------------------------------------------------------------


def test_a_trial_build_is_not_written_by_the_next_plain_provision(station: Station, node: Node) -> None:
    node.start()
    links = station.desk.links.over("nfc")
    station.provision("nfc", "--profile", ANGLE, "--name", "first")
    station.ask("build", node.uuid, "--profile", ANGLE, "--name", "only a trial")
    assert [draft["stage"] for draft in station.ask("draft", "list")["drafts"]] == ["built"]
    before = node.octets
    error = station.provision("nfc", code=6)
    assert error["error"]["code"] == "not-named"
    assert any("only a trial" in change for change in error["changes"]), error
    assert node.octets == before
    code, output = on_a_terminal(station, "provision", *links, answer="n")
    assert code == 6
    assert "only a trial" in output
    assert "Interrupted" not in output
    assert node.octets == before
    station.ask("draft", "drop", node.uuid)
    ended = results(station.provision("nfc"))
    assert ended.pop("check") == "skipped"  # it does not measure: its hardware is not asked
    assert set(ended.values()) == {"done", "nothing to do"}
    assert node.octets == before
    station.ask("build", node.uuid, "--profile", ANGLE, "--name", "wanted after all")
    code, output = on_a_terminal(station, "provision", *links, answer="y")
    assert code == 0, output
    assert station.ask("identify", *links)["name"] == "wanted after all"


def test_what_was_put_onto_the_node_by_hand_stays_until_something_else_is_named(
    station: Station, node: Node, tmp_path: Path
) -> None:
    node.start()
    links = station.desk.links.over("nfc")
    station.provision("nfc", "--profile", ANGLE, "--name", "old name")
    station.ask("build", node.uuid, "--profile", FINGER, "--retype", "--output", tmp_path / "finger.json")
    station.ask("sign", tmp_path / "finger.json", "--output", tmp_path / "signed.json")
    station.ask("write", node.uuid, "--image", tmp_path / "signed.json", "--retype", *links)
    station.ask("draft", "drop", node.uuid)
    written = node.octets
    assert station.provision("nfc")["verdict"] == "authentic"
    assert node.octets == written
    plan = station.ask("provision", "--name", "new name", "--dry-run", *links)
    assert any("new name" in change for change in plan["changes"]), plan
    assert node.octets == written


def test_an_older_datasheet_is_restored_under_a_new_signature(station: Station, node: Node) -> None:
    node.start()
    links = station.desk.links.over("nfc")
    for name in ("one", "two"):
        station.provision("nfc", "--profile", ANGLE, "--name", name)
    history = station.ask("history", node.uuid)["history"]
    assert [(entry["sequence"], entry["profile"]) for entry in history] == [(2, ANGLE), (1, ANGLE)]
    assert station.refuses("write", node.uuid, "--from", "7", *links, code=3)["hint"] == "Known are: 2, 1."
    assert station.ask("write", node.uuid, "--from", "1", "--dry-run", *links)["changes"]
    done = station.ask("write", node.uuid, "--from", "1", *links)
    assert (done["sequence"], done["verified"]) == (3, True)
    assert station.ask("identify", *links)["name"] == "one" or station.ask("verify", node.uuid, *links)
    assert station.ask("verify", node.uuid, *links)["verdict"] == "authentic"


# -- names -------------------------------------------------------------------------------------------------------------


def test_one_name_or_calibration_is_not_given_to_every_board(station: Station, node: Node, tmp_path: Path) -> None:
    node.start()
    links, file = station.desk.links.over("nfc"), tmp_path / "angle.csv"
    file.write_text(CALIBRATION.format(middle=180))
    for words in (["--name", "same"], ["--calibration", file]):
        error = station.refuses("provision", "--watch", "-p", ANGLE, "--yes", *words, *links, code=2)
        assert "--batch" in error["hint"]
    bus = station.desk.links.over("can")
    assert "--batch" in station.refuses("provision", "--all", "-p", ANGLE, "--name", "same", *bus, code=2)["hint"]
    station.refuses("provision", "-p", ANGLE, "--yes", "--name", "x" * 121, *links, code=2)
    assert node.flash["key"] is None


def test_names_by_pattern_and_a_name_that_is_taken(desk: Desk, station: Station) -> None:
    nodes = [desk.node(f"node{number}") for number in range(3)]
    names = []
    for node in (nodes[0], nodes[1], nodes[0]):
        node.start()
        names.append(station.provision("nfc", "-p", ANGLE, "--name", "cell {n}")["name"])
        node.stop()
    assert names == ["cell 1", "cell 2", "cell 1"]
    nodes[2].start()
    error = station.provision("nfc", "-p", ANGLE, "--name", "cell 2", code=6)["error"]
    assert nodes[1].uuid in error["message"]
    assert nodes[2].flash["key"] is None
    assert station.provision("nfc", "-p", ANGLE, "--name", "node-{uuid}")["name"] == f"node-{nodes[2].uuid}"


def test_a_board_of_another_owner_is_not_whitelisted(desk: Desk, station: Station, node: Node) -> None:
    node.start()
    assert desk.station("rival").provision("nfc", "-p", ANGLE)["verdict"] == "authentic"
    error = station.provision("nfc", "-p", ANGLE, code=6)["error"]
    assert "another owner's CA" in error["message"]
    assert station.ask("whitelist", "list")["whitelist"] == []
    (entry,) = [entry for entry in station.ask("log")["entries"] if entry["act"] == "provision"]
    assert (entry["uuid"], entry["outcome"]) == (node.uuid, "refused")


# -- sheets ------------------------------------------------------------------------------------------------------------


def test_a_sheet_with_errors_is_8_with_every_line_before_the_first_tap(station: Station, tmp_path: Path) -> None:
    rows = [
        {"uuid": "12", "profile": ANGLE},
        {"profile": "no-such-type"},
        {"profile": ANGLE, "calibration": "none.csv"},
        {"profile": ANGLE, "name": "twice"},
        {"profile": ANGLE, "name": "twice", "fingerprint": "abc"},
        {"profile": ANGLE, "name": "x" * 121},
    ]
    file = sheet(tmp_path / "boards.csv", *rows)
    error = station.refuses("provision", "--batch", file, "--yes", "--nfc", "tty:nowhere:pn532", code=8)
    for line in range(2, 8):
        if line != 5:
            assert f"boards.csv:{line}:" in error["message"], line
    file.write_text("uuid,nome\n,x\n")
    assert "nome" in station.refuses("provision", "--batch", file, "--nfc", "tty:nowhere:pn532", code=8)["message"]
    station.refuses("provision", "--batch", tmp_path / "none.csv", "--nfc", "tty:nowhere:pn532", code=3)


def test_a_sheet_gives_each_board_its_own_and_carries_on(desk: Desk, station: Station, tmp_path: Path) -> None:
    """By order of taps, by UUID, by the key of a label; killed in between; the report at the end."""
    nodes = [desk.node(f"node{number}") for number in range(3)]
    for number, middle in enumerate((175, 180)):
        (tmp_path / f"{number}.csv").write_text(CALIBRATION.format(middle=middle))
    key = nodes[2].start() and station.ask("identify", *desk.links.over("nfc"))["fingerprint"]
    nodes[2].stop()
    file = sheet(
        tmp_path / "boards.csv",
        {"name": "first", "profile": ANGLE, "calibration": "0.csv"},
        {"uuid": f"0x{nodes[1].uuid.upper()}", "name": "second", "profile": ANGLE, "calibration": "1.csv"},
        {"fingerprint": key[:32], "name": "third", "profile": FINGER},
    )
    report = tmp_path / "report.html"
    words = ["--json", "provision", "--batch", file, "--yes", "--timeout", "55", "--report", report]
    batch = station.start(*words, *desk.links.over("nfc"))
    nodes[0].start()
    (line,) = batch.wait_for_lines(1)
    assert (line["uuid"], line["row"], line["name"], line["verdict"]) == (nodes[0].uuid, 1, "first", "authentic")
    assert line["seconds"] > 0
    nodes[0].stop()
    batch.signal(signal.SIGKILL)
    batch.end()
    batch = station.start(*words, *desk.links.over("nfc"))
    nodes[2].start()
    assert [line["row"] for line in batch.wait_for_lines(1)] == [3]
    nodes[2].stop()
    nodes[1].start()
    outcome = batch.end()
    assert outcome.code == 0, outcome
    third, second, last = lines_of(outcome)
    assert (third["name"], second["row"], second["name"], second["uuid"]) == ("third", 2, "second", nodes[1].uuid)
    totals = last["totals"]
    assert (totals["passed"], totals["failed"], totals["skipped"], totals["first_pass"]) == (3, 0, 0, 1.0)
    assert set(totals["steps"]) >= {"identify", "agree", "write", "verify"}
    assert all(uuid in report.read_text() for uuid in (nodes[0].uuid, nodes[1].uuid, nodes[2].uuid))
    again = station.run(*words, *desk.links.over("nfc"))
    assert (again.code, list(again.json)) == (0, ["totals"])


def test_a_name_that_another_node_has_takes_no_row(desk: Desk, station: Station, tmp_path: Path) -> None:
    """The row was bound to the first board that came, before its name was looked at."""
    owner, stranger = desk.node("owner").start(), desk.node("stranger")
    links = desk.links.over("nfc")
    station.provision("nfc", "-p", ANGLE, "--name", "left knee")
    owner.stop()
    rows = [{"name": name, "profile": ANGLE} for name in ("left knee", "right knee")]
    words = ["--json", "provision", "--batch", sheet(tmp_path / "boards.csv", *rows), "--yes", *links, "--timeout"]
    stranger.start()
    outcome = station.run(*words, "5")
    line, _ = lines_of(outcome)
    assert (outcome.code, line["row"], line["uuid"], line["error"]["code"]) == (6, 1, stranger.uuid, "refused")
    assert owner.uuid in line["error"]["message"]
    assert stranger.flash["key"] is None
    stranger.stop()
    owner.start()
    batch = station.start(*words, "55")
    (line,) = batch.wait_for_lines(1)
    assert (line["row"], line["uuid"], line["name"]) == (1, owner.uuid, "left knee")
    owner.stop()
    stranger.start()
    outcome = batch.end()
    line = lines_of(outcome)[1]
    assert (outcome.code, line["row"], line["uuid"], line["name"]) == (0, 2, stranger.uuid, "right knee")


def test_a_label_pins_the_key_before_the_tap(station: Station, node: Node, tmp_path: Path) -> None:
    node.start()
    file = sheet(tmp_path / "boards.csv", {"uuid": node.uuid, "profile": ANGLE, "fingerprint": "ab" * 32})
    outcome = station.run("--json", "provision", "--batch", file, "--timeout", "5", *station.desk.links.over("nfc"))
    line, last = lines_of(outcome)
    assert (line["row"], line["uuid"], line["error"]["code"]) == (1, node.uuid, "other-key")
    assert (outcome.code, last["totals"]["failed"]) == (6, 1)
    assert node.flash["key"] is None
    (listed,) = [entry for entry in station.ask("nodes")["nodes"] if entry["uuid"] == node.uuid] or [None]
    assert listed is None or listed["fingerprint"] is None


def test_no_at_the_question_skips_the_board(station: Station, node: Node, tmp_path: Path) -> None:
    node.start()
    file = sheet(tmp_path / "boards.csv", {"profile": ANGLE, "name": "a"})
    words = ["provision", "--batch", file, "--timeout", "10", *station.desk.links.over("nfc")]
    code, output = on_a_terminal(station, *words, answer="n")
    assert code == 6
    assert "1 skipped" in output
    assert "\a" in output
    assert node.flash["key"] is None
    code, output = on_a_terminal(station, *words, answer="y")
    assert code == 0, output
    assert "1 passed" in output


# -- a whole bus -------------------------------------------------------------------------------------------------------


@pytest.mark.needs("a slow chip")
def test_every_whitelisted_node_of_a_bus_is_brought_up_at_once(desk: Desk, station: Station) -> None:
    nodes = [desk.node(f"node{number}").start("--crypto-delay", "20", nfc=False, can=True) for number in range(4)]
    words = ["--json", "provision", "--all", "--yes", "-p", FINGER, "--name", "axis {n}", *desk.links.over("can")]
    outcome = station.run(*words)
    assert outcome.code == 6, "a yes adds no strangers, and none of them is ours"
    assert "none is on the whitelist" in outcome.out
    for node in nodes[:3]:
        station.ask("whitelist", "add", node.uuid)
    outcome = station.run(*words)
    assert outcome.code == 0, outcome
    *lines, last = lines_of(outcome)
    assert sorted(line["uuid"] for line in lines) == sorted(node.uuid for node in nodes[:3])
    assert sorted(line["name"] for line in lines) == ["axis 1", "axis 2", "axis 3"]
    assert last["totals"]["passed"] == 3
    assert nodes[3].flash["key"] is None
    assert station.log_is_whole()
    assert list(station.run(*words).json) == ["totals"], "the finished ones are left alone"


@pytest.mark.needs("its own datasheet")
def test_of_many_on_a_bus_each_line_names_its_node_and_one_without_the_calibration_of_its_type_does_not_pass(
    desk: Desk, station: Station
) -> None:
    nodes = [desk.node(f"node{number}", called=f"arm {number}").start(nfc=False, can=True) for number in range(3)]
    for node in nodes:
        station.ask("whitelist", "add", node.uuid)
    over = desk.links.over("can")
    for number in (0, 1):
        calibration = desk.folder / "calibration.csv"
        calibration.write_text("# date: 2026-11-01\nraw,value [degree]\n0,0\n65535,359.9\n")
        station.ask("provision", nodes[number].uuid, "-p", ANGLE, "--calibration", calibration, "--yes", *over)
    done = station.run("provision", "--all", "-p", ANGLE, *over)
    assert done.code == 6, done
    assert f"1 of 1  {nodes[2].uuid}" in done.out, "the finished ones are left alone"
    assert f"Board {nodes[2].uuid} has no calibration of channel 1, which its type requires." in done.err
    steps = [line for line in done.err.splitlines() if "✓" in line]
    assert len(steps) >= 5
    assert all(line.startswith((f"{nodes[2].uuid}: ", "arm 2: ")) for line in steps), done.err
    again = station.run("provision", "--all", "-p", ANGLE, *over)
    assert (again.code, "1 failed" in again.out) == (6, True), "it is not finished the second time either"


def test_a_warning_of_several_boards_is_printed_once_with_what_identifies_them(desk: Desk, station: Station) -> None:
    """It began with "load cell, load cell, load cell": unnamed boards take the name of their type."""
    uuids = [desk.node(f"node{number}").start(nfc=False, can=True).uuid for number in range(3)]
    over = desk.links.over("can")
    for uuid in uuids:
        station.ask("whitelist", "add", uuid)
    done = station.run("provision", "--all", "-p", ANGLE, *over)
    assert done.err.count("Channel 1 has no calibration") == 1
    assert "Warning: All 3 boards: Channel 1 has no calibration" in done.err

    calibration, sheet = desk.folder / "calibration.csv", desk.folder / "boards.csv"
    calibration.write_text("# date: 2026-11-01\nraw,value [degree]\n0,0\n65535,359.9\n")
    sheet.write_text(f"uuid,calibration\n{uuids[0]},calibration.csv\n{uuids[1]},\n{uuids[2]},\n")
    done = station.run("provision", "--all", "--batch", sheet, "-p", ANGLE, "--yes", *over)
    [warning] = [line for line in done.err.splitlines() if "Channel 1 has no calibration" in line]
    assert uuids[0] not in warning
    assert all(uuid in warning for uuid in uuids[1:])


@pytest.mark.needs("a slow chip")
def test_every_board_of_a_sheet_counts_whatever_the_time_out_and_a_corrected_calibration_is_written(
    desk: Desk, station: Station, tmp_path: Path
) -> None:
    """The idle timer ran during discovery: six boards were finished, and the report knew one of them, exit 5."""
    nodes = [desk.node(f"node{number}").start("--crypto-delay", "150", nfc=False, can=True) for number in range(3)]
    curve = tmp_path / "curve.csv"
    curve.write_text(f"# date: 2026-11-01\n{CALIBRATION.format(middle=180)}")
    rows = [{"uuid": node.uuid, "profile": ANGLE, "calibration": "curve.csv"} for node in nodes]
    file, report = sheet(tmp_path / "boards.csv", *rows), tmp_path / "report.csv"
    words = ["--json", "provision", "--all", "--batch", file, "--report", report, "--timeout", "1"]
    words += desk.links.over("can")
    outcome = station.run(*words)
    *lines, last = lines_of(outcome)
    assert (outcome.code, last["totals"]["passed"], len(lines)) == (0, 3, 3), outcome

    curve.write_text(f"# date: 2026-11-01\n{CALIBRATION.format(middle=181)}")
    outcome = station.run(*words)
    *lines, last = lines_of(outcome)
    assert [results(line)["write"] for line in lines] == ["done"] * 3, outcome
    assert (outcome.code, last["totals"]["passed"]) == (0, 3)
    assert report.read_text().count("because the calibration changed") == 3
    assert "Rows 1, 2, 3: provisioned again" in outcome.err

    nodes[2].stop()
    sheet(tmp_path / "boards.csv", *[row | {"name": f"arm {at}"} for at, row in enumerate(rows) if at])
    outcome = station.run(*words)
    last = lines_of(outcome)[-1]
    assert (outcome.code, last["totals"]["passed"], last["totals"]["skipped"]) == (5, 1, 1), outcome
    assert "No board answered on the bus for row 2" in last["error"]["message"]
    outcome = station.run(*words[1:])
    assert outcome.err.count("not in the sheet") == 1, "the first board; a finished one is in the sheet"


# -- global options and a look at a plan -------------------------------------------------------------------------------


def test_global_options_stand_anywhere(station: Station) -> None:
    assert station.desk.start("nodes", "--json", "--home", station.home).end().json == {"nodes": []}
    assert station.desk.start("whitelist", "list", f"--home={station.home}", "--json", "-q").end().json
    outcome = station.desk.start("nodes", "--home").end()
    assert (outcome.code, "--home" in outcome.err) == (2, True)
