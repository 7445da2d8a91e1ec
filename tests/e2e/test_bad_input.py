"""Bad input, bad luck and broken parts: a clear error with its exit code, and node and store as they were."""

from __future__ import annotations

import json
import os
import sqlite3
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from teds_provision.station.store.lock import StoreLock

from .desk import ANGLE, Desk, Node, Station, limited, results

pytestmark = pytest.mark.link

ANOTHER_TAG = (sys.executable, "-m", "tests.links.nfc.echo_node")
NOT_A_NODE = "D101085504" + b"example".hex()  # one URI record
QUICK = ("--timeout", "1.5")


@contextmanager
def unchanged(station: Station, *nodes: Node, without: tuple[str, ...] = ()) -> Iterator[None]:
    """Neither the store (but for its logs) nor the nodes' flash files change within."""
    left_out = ("audit", "steps", *without)
    before = station.tables(without=left_out), [node.octets for node in nodes]
    yield
    assert (station.tables(without=left_out), [node.octets for node in nodes]) == before


@pytest.fixture
def finished(station: Station, node: Node) -> Node:
    """Return a node that lies there, provisioned."""
    node.start(can=True)
    station.provision("nfc", "--profile", ANGLE)
    return node


# -- names that mean nothing -------------------------------------------------------------------------------------------


def test_what_does_not_exist_is_3(station: Station, finished: Node, tmp_path: Path) -> None:
    nfc, nowhere = station.desk.links.over("nfc"), tmp_path / "nowhere"
    with unchanged(station, finished):
        for words in (
            ["agree", "ffff", *nfc],
            ["verify", "no-such-name", *nfc],
            ["nodes", "ffffffffffffffffffff"],
            ["build", finished.uuid, "--profile", "no-such-type"],
            ["build", finished.uuid, "--calibration", nowhere],
            ["write", finished.uuid, "--image", nowhere, *nfc],
            ["whitelist", "import", nowhere],
            ["show", nowhere],
            ["sign", "00112233445566778899"],
        ):
            code = 6 if words[0] == "sign" else 3
            error = station.refuses(*words, code=code)
            assert error["message"], words
    assert "Known are" in station.refuses("build", finished.uuid, "--profile", "no-such-type", code=3)["hint"]


def test_a_prefix_that_two_nodes_share_is_refused(station: Station) -> None:
    for last in ("01", "02"):
        station.ask("whitelist", "add", "8d4d9da65281f70000" + last)
    with unchanged(station):
        error = station.refuses("agree", "8d4d", "--nfc", "udp:localhost:1", code=2)
        for last in ("01", "02"):
            assert "8d4d9da65281f70000" + last in error["message"] + error["hint"]


@pytest.mark.parametrize(
    "words",
    [
        ["agree"],
        ["provision", "--via", "radio"],
        ["provision", "--via", "can"],
        ["identify", "--timeout", "0"],
        ["identify", "--via", "can", "--can", "nonsense"],
        ["identify", "--via", "can", "--can", "udp_multicast:239.74.163.2?node=900"],
        ["provsion"],
        ["node", "run", "{tmp}"],
    ],
)
def test_a_wrong_command_line_is_2(station: Station, tmp_path: Path, words: list[str]) -> None:
    station.ask("whitelist", "add", "8d4d9da65281f7000000")
    with unchanged(station):
        error = station.refuses(*(word.format(tmp=tmp_path) for word in words), code=2)
    assert error["code"] == "usage"


# -- links -------------------------------------------------------------------------------------------------------------


def test_no_reader_no_bus_and_nobody_there_are_5(station: Station) -> None:
    links = station.desk.links
    with unchanged(station):
        for words, code in (
            (["--nfc", "tty:USB99:pn532"], "no-reader"),
            (["--via", "can", "--can", "socketcan:can99"], "no-reader"),
            (links.over("nfc"), "no-node"),
            (links.over("can"), "no-node"),
        ):
            error = station.refuses("identify", *words, *QUICK, code=5)
            assert error["code"] == code, words
            assert error["hint"]


@pytest.mark.nightly(
    "tests/links/nfc/test_nfc_exchange.py::test_a_foreign_tag_is_named_once_and_waited_past, "
    "tests/links/nfc/test_nfc_exchange.py::test_a_tag_that_says_nonsense_is_a_foreign_tag"
)
def test_a_tag_that_is_no_node_is_named_and_left_alone(station: Station) -> None:
    links = station.desk.links
    options = {"path": links.nfc, "uuid": "00" * 10, "tag": "2", "uid": "02112233445566", "initial": NOT_A_NODE}
    tag = station.desk.start(json.dumps(options), program=ANOTHER_TAG)
    tag.wait_for("ready")
    with unchanged(station):
        outcome = station.run("provision", "--profile", ANGLE, "--yes", *links.over("nfc"), "--timeout", "6")
        assert outcome.code == 5
        assert "02112233445566" in outcome.err
        assert "not" in outcome.err
    assert "request" not in tag.out


@pytest.mark.parametrize(("torn", "code"), [(1000, "garbled"), (0, None)])
def test_a_node_that_talks_nonsense_is_an_error_of_one_line(station: Station, torn: int, code: str | None) -> None:
    """Every NFC message torn; and a node that gives back our own octets."""
    options = {"path": station.desk.links.nfc, "uuid": "8d4d9da65281f7000000", "torn": torn}
    station.desk.start(json.dumps(options), program=ANOTHER_TAG).wait_for("ready")
    with unchanged(station):
        error = station.refuses("provision", "-p", ANGLE, "--yes", *station.desk.links.over("nfc"), code=5)
    assert error["code"] == (code or "garbled")


@pytest.mark.nightly(
    "tests/e2e/test_pulled_steps.py::test_above_the_udp_driver pulls it half written; that a lost node is 5 says "
    "tests/e2e/test_cut_short.py::test_a_node_that_lost_power_is_carried_on_with"
)
def test_a_node_that_moves_away_in_the_transfer_is_5(station: Station, node: Node) -> None:
    node.start("--flash-delay", "300")
    command = station.start("provision", "--profile", ANGLE, "--yes", *station.desk.links.over("nfc"))
    command.wait_for("✓ sign")
    node.kill()
    outcome = command.end()
    assert outcome.code == 5
    assert 1 <= outcome.err[outcome.err.index("Error:") :].count("\n") <= 3
    assert node.flash["provisioned"] is False
    failed = [entry for entry in station.ask("log")["entries"] if entry["act"] == "provision"]
    assert [(entry["uuid"], entry["outcome"]) for entry in failed] == [(node.uuid, "node-silent")]


NO_KEY = pytest.mark.nightly(
    "tests/provisioning/test_provision.py::test_power_cut_at_every_flash_commit; the flash that fails at the datasheet "
    "is here, and tests/provisioning/test_provision.py::test_a_broken_flash_is_reported"
)


@pytest.mark.needs("flash.json")
@pytest.mark.parametrize("room", [pytest.param(100, marks=NO_KEY), 2500])
def test_a_node_whose_flash_fails_is_refused_by_it_and_stays_as_it_was(station: Station, node: Node, room: int) -> None:
    """No room for the key, or for the datasheet: old state whole, and the same command finishes on a mended board."""
    node.start(program=limited(room))
    before = node.octets
    error = station.refuses("provision", "-p", ANGLE, "--yes", *station.desk.links.over("nfc"), code=6)
    assert error["code"] == "node-refused"
    assert "flash" in error["message"]
    assert (node.octets == before) == (room == 100)
    assert node.flash["provisioned"] is False
    node.kill()
    node.start()
    assert station.provision("nfc", "--profile", ANGLE)["verdict"] == "authentic"


# -- datasheets --------------------------------------------------------------------------------------------------------


@pytest.mark.nightly("tests/provisioning/test_verify.py::test_every_flipped_octet_is_caught")
def test_an_image_that_was_tampered_with_is_not_authentic(station: Station, finished: Node, tmp_path: Path) -> None:
    """One octet in each TEDS, and in each part of the Security TEDS; every single octet: tests/provisioning."""
    image, file = tmp_path / "image.json", tmp_path / "tampered.json"
    station.ask("read", finished.uuid, "--output", image, *station.desk.links.over("nfc"))
    assert station.ask("verify", image)["verdict"] == "authentic"
    good = json.loads(image.read_text())
    with unchanged(station, finished):
        for number, block in enumerate(good["blocks"]):
            octets = bytes.fromhex(block["teds"])
            for at in {0, 5, len(octets) // 2, len(octets) - 1}:
                bad = bytes((*octets[:at], octets[at] ^ 1, *octets[at + 1 :]))
                changed = [*good["blocks"]]
                changed[number] = {**block, "teds": bad.hex()}
                file.write_text(json.dumps({**good, "blocks": changed}))
                reply = station.ask("verify", file, code=4)
                assert reply["verdict"] == "not authentic", (block["access_code"], at)


@pytest.mark.needs("flash.json")
def test_a_node_whose_flash_was_tampered_with_is_found_out_and_mended(station: Station, finished: Node) -> None:
    """Somebody changed the range in the flash chip, checksum and all; provisioning it again writes it anew."""
    links = station.desk.links
    finished.stop()
    document = json.loads(finished.octets)
    for block in document["flash"]["blocks"]:
        if block[1] == 3:
            octets = bytearray.fromhex(block[2])
            octets[20] ^= 1
            octets[-2:] = (0xFFFF ^ sum(octets[:-2]) & 0xFFFF).to_bytes(2, "big")
            block[2] = octets.hex()
    (finished.folder / "flash.json").write_text(json.dumps(document))
    finished.start(can=True)
    for via in ("nfc", "can"):
        reply = station.ask("verify", finished.uuid, *links.over(via), code=4)
        assert reply["verdict"] == "not authentic"
        assert {check["name"] for check in reply["checks"] if check["result"] == "failed"} == {"signed TEDS"}
    done = station.provision("nfc")
    assert done["verdict"] == "authentic"
    assert results(done)["write"] == "done"
    assert station.ask("verify", finished.uuid, *links.over("can"))["verdict"] == "authentic"


@pytest.mark.needs("flash.json")
@pytest.mark.nightly(
    "tests/e2e/test_bad_input.py::test_a_node_whose_flash_was_tampered_with_is_found_out_and_mended; by hand "
    "tests/provisioning/test_by_hand.py::test_what_the_node_lost_since_it_was_read_is_sent_again"
)
def test_a_tampered_flash_is_mended_by_hand_too(station: Station, finished: Node) -> None:
    links = station.desk.links.over("nfc")
    finished.stop()
    document = json.loads(finished.octets)
    document["flash"]["blocks"] = [block for block in document["flash"]["blocks"] if block[1] != 12]
    (finished.folder / "flash.json").write_text(json.dumps(document))
    finished.start()
    assert station.ask("verify", finished.uuid, *links, code=4)["verdict"] == "not authentic"
    assert "--read-node" in station.refuses("write", finished.uuid, *links, code=6)["hint"]
    assert station.ask("sign", finished.uuid, "--read-node", *links)["sequence"] == 2
    assert station.ask("write", finished.uuid, *links)["verified"] is True
    assert station.ask("verify", finished.uuid, *links)["verdict"] == "authentic"


def test_an_image_that_the_node_must_not_take_is_refused(station: Station, finished: Node, tmp_path: Path) -> None:
    links, file = station.desk.links.over("nfc"), tmp_path / "image.json"
    image = station.ask("read", finished.uuid, "--output", file, *links)
    with unchanged(station, finished, without=("nodes", "datasheets")):
        file.write_text("{")
        station.refuses("write", finished.uuid, "--image", file, *links, code=8)
        station.refuses("verify", file, code=8)
        file.write_text(json.dumps({**image, "uuid": "00" * 10}))
        station.refuses("write", finished.uuid, "--image", file, *links, code=6)
        unsigned = [block for block in image["blocks"] if block["access_code"] != 128]
        file.write_text(json.dumps({**image, "blocks": unsigned}))
        station.refuses("write", finished.uuid, "--image", file, *links, code=8)
        assert station.ask("verify", file, code=4)["verdict"] == "unsigned"
        fewer = [block for block in image["blocks"] if block["access_code"] != 3]
        file.write_text(json.dumps({**image, "blocks": fewer}))
        assert station.ask("verify", file, code=4)["verdict"] == "not authentic"


def test_an_older_datasheet_is_not_put_back(station: Station, finished: Node, tmp_path: Path) -> None:
    links, old = station.desk.links.over("nfc"), tmp_path / "old.json"
    station.ask("read", finished.uuid, "--output", old, *links)
    station.provision("nfc", "--name", "renamed")
    with unchanged(station, finished, without=("nodes", "datasheets")):
        error = station.refuses("write", finished.uuid, "--image", old, *links, code=6)
    assert "sequence" in error["message"]


@pytest.mark.parametrize(
    ("name", "text", "line"),
    [
        ("bad.toml", 'title = "x"\nextends = "load-cell"\n[channel.1]\nnmae = "y"\n', 4),
        ("torn.toml", 'title = "x\n', 1),
    ],
)
def test_a_profile_with_errors_is_8_and_names_file_and_line(
    station: Station, node: Node, tmp_path: Path, name: str, text: str, line: int
) -> None:
    file = tmp_path / name
    file.write_text(text)
    node.start()
    station.ask("identify", "--add", *station.desk.links.over("nfc"))
    with unchanged(station, node):
        error = station.refuses("build", node.uuid, "--profile", file, code=8)
        assert f"{name}:{line}" in error["message"]
        error = station.refuses("profile", "check", file, code=8)
        assert f"{name}:{line}" in error["message"]


@pytest.mark.parametrize(
    ("text", "line"),
    [("raw,value [degree]\n0,0\n16384,ninety\n65535,360\n", 3), ("raw,value [kg]\n0,0\n65535,360\n", 1)],
)
def test_a_calibration_with_errors_is_8_and_names_file_and_line(
    station: Station, node: Node, tmp_path: Path, text: str, line: int
) -> None:
    file = tmp_path / "angle.csv"
    file.write_text(text)
    node.start()
    words = ["provision", "--profile", ANGLE, "--calibration", file, "--yes", *station.desk.links.over("nfc")]
    error = station.refuses(*words, code=8)
    assert f"angle.csv:{line}" in error["message"]
    assert node.flash["provisioned"] is False
    assert node.flash["sequence"] == 0


# -- store and vault ---------------------------------------------------------------------------------------------------


def test_a_passphrase_that_is_wrong_or_missing_is_7(station: Station, finished: Node) -> None:
    links = station.desk.links.over("nfc")
    with unchanged(station, finished, without=("nodes",)):
        station.passphrase = "wrong horse battery"
        assert station.refuses("agree", finished.uuid, *links, code=7)["code"] == "wrong-passphrase"
        station.passphrase = ""
        assert station.refuses("agree", finished.uuid, *links, code=7)["code"] == "wrong-passphrase"
        station.passphrase = None
        error = station.refuses("agree", finished.uuid, *links, code=7)
        assert "--passphrase-fd" in error["hint"]
        station.refuses("--passphrase-fd", "99", "agree", finished.uuid, *links, code=2)
        assert station.run("nodes").code == 0


def test_a_keyring_that_is_not_there_is_7(station: Station, finished: Node, desk: Desk, tmp_path: Path) -> None:
    """A station whose keys lie in a keyring, on a machine (or in a session) that has none."""
    with closing(sqlite3.connect(station.home / "store.sqlite3")) as database, database:
        database.execute("UPDATE station SET keystore = 'keyring'")
    error = station.refuses("provision", "--yes", *desk.links.over("nfc"), code=7)
    assert error["code"] in ("no-keyring", "vault")
    assert error["hint"]
    new = Station(desk, tmp_path / "new", "a good long passphrase")
    assert new.refuses("init", "--keystore", "keyring", code=7)["code"] == "no-keyring"
    chosen = new.ask("init")
    assert chosen["keystore"] == "file"
    assert chosen["why"]


def test_a_damaged_store_or_vault_is_7(station: Station, finished: Node) -> None:
    links = station.desk.links.over("nfc")
    vault = next(path for path in station.home.iterdir() if "vault" in path.name)
    good = vault.read_bytes()
    for bad in (b"", b"{}", good[: len(good) // 2], good.replace(b'"ciphertext": "', b'"ciphertext": "A')):
        vault.write_bytes(bad)
        if bad != good:
            station.refuses("agree", finished.uuid, *links, code=7)
    vault.unlink()
    station.refuses("agree", finished.uuid, *links, code=7)
    vault.write_bytes(good)
    vault.chmod(0o600)
    assert station.ask("agree", finished.uuid, *links)["epoch"] == 1
    (station.home / "store.sqlite3").write_bytes(b"this is no database" * 100)
    for words in (["nodes"], ["agree", finished.uuid, *links], ["init"]):
        assert station.refuses(*words, code=7)["hint"]


def test_a_second_process_waits_and_goes_on_when_the_store_is_free(station: Station, finished: Node) -> None:
    with StoreLock(station.home, command="backup"):
        command = station.start("agree", finished.uuid, *station.desk.links.over("can"))
        command.wait_for("Waiting for the store")
        assert f"pid {os.getpid()} (backup)" in command.err
    assert command.end().code == 0


@pytest.mark.nightly(
    "tests/station/test_lock.py::test_the_second_process_is_told_who_holds_the_store without 10 s of waiting"
)
def test_a_second_process_says_at_last_who_holds_the_store(station: Station, finished: Node) -> None:
    with unchanged(station, finished, without=("nodes",)), StoreLock(station.home, command="backup"):
        error = station.refuses("provision", "--yes", *station.desk.links.over("can"), code=7)
        assert error["code"] == "store-locked"
        assert f"pid {os.getpid()} (backup)" in error["message"]


def test_a_full_disk_is_7_and_the_same_command_carries_on(station: Station, node: Node) -> None:
    node.start()
    size = (station.home / "store.sqlite3").stat().st_size
    codes = []
    for room in (0, 8192, 20000, 60000):
        words = ["--json", "provision", "--profile", ANGLE, "--yes", *station.desk.links.over("nfc")]
        outcome = station.run(*words, program=limited(room))
        codes.append(outcome.code)
        assert outcome.code in (0, 7), (size, outcome)
        if outcome.code == 7:
            assert outcome.json["error"]["code"] == "store"
            assert outcome.json["error"]["hint"]
    assert codes[0] == 7
    assert station.provision("nfc", "--profile", ANGLE)["verdict"] == "authentic"
    assert station.ask("log")["intact"] is True


def test_results_that_cannot_be_written_are_an_error(station: Station, finished: Node, tmp_path: Path) -> None:
    links = station.desk.links.over("nfc")
    with unchanged(station, finished, without=("nodes", "datasheets", "readings")):
        error = station.refuses("read", finished.uuid, "--output", tmp_path / "no" / "image.json", *links, code=3)
        assert str(tmp_path / "no") in error["message"]
        outcome = station.run(
            "--json", "read", finished.uuid, "-o", tmp_path / "image.json", *links, program=limited(99)
        )
        assert outcome.code != 0
        assert not list(tmp_path.glob("image.json*"))


def test_a_home_that_cannot_be_used_is_7(desk: Desk, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    for home in (file / "home", Path("/proc/nowhere")):
        station = Station(desk, home, "a good long passphrase")
        error = station.refuses("init", "--keystore", "file", code=7)
        assert error["hint"]


@pytest.mark.parametrize("words", [["nodes"], ["--json", "nodes"], ["--help"]])
def test_a_reader_of_results_that_goes_away_is_no_error_of_python(station: Station, words: list[str]) -> None:
    """``| head`` that ends before the first line came."""
    command = station.start(*words, fork=False)  # its interpreter has a word too as it ends
    command._selector.unregister(command.stdout)
    command.stdout.close()
    outcome = command.end()
    assert outcome.code in (0, 141)
    assert outcome.err == ""
