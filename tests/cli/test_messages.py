"""Each message names what it is, not how it failed to parse: the fifteen of issue 9 section 1 line 8, and their like.

Here: files that are not there (3), files that are something else (5), a number that is none, a serial line without a
reader, a kernel without CAN, a wrong board on the reader, a second init, a node without name. Elsewhere: matplotlib is
missing (tests/teds/test_plot.py), no node of ours on a bus (tests/e2e/test_many.py).
"""

from __future__ import annotations

import errno
import re
import time
from pathlib import Path

import pytest

from teds_provision.errors import NoNodeError, NoReaderError
from teds_provision.links.can import bus as can_bus
from teds_provision.links.can.spec import parse_spec
from teds_provision.links.nfc.port import NfcPort
from teds_provision.trace import record
from teds_provision.trace.record import Record
from tests.bench import PASSPHRASE

from .shell import call, spawn

UUID = "8d4d9da65281f7000000"


def test_a_wrong_passphrase_is_called_so(home: Path) -> None:
    error = call(home, "--json", "trust", "ca", "drop", "--yes", passphrase="not this one").json["error"]
    assert (error["code"], error["message"]) == ("wrong-passphrase", "Wrong passphrase.")


def test_no_hint_offers_a_profile_that_is_only_a_base(home: Path) -> None:
    error = call(home, "--json", "provision", "-p", "smart-senso", "--nfc", "udp:localhost:1").json["error"]
    assert "temperature-sensor" in error["hint"]
    assert "smart-sensor" not in error["hint"]


@pytest.mark.parametrize(
    ("words", "code", "message", "cure"),
    [
        (["verify", "none.json"], 3, "There is no file none.json", ""),
        (["sign", "none.json"], 3, "There is no file none.json", ""),
        (["show", "none.json"], 3, "There is no file", ""),
        (["show", UUID], 3, "There is no file", "nodes UUID"),
        (["describe", UUID], 2, "Missing option '--as'. Choose from: td, ros2-control, aas", ""),
        (["verify", "hello.txt"], 8, "hello.txt is not a TEDS image", "build, sign and read"),
        (["show", "hello.txt"], 8, "hello.txt holds no TEDS", "Intel HEX"),
        (["import-keys", "hello.txt"], 8, "hello.txt is not a handover bundle", "export-keys"),
        (["import-keys", "some.json"], 8, "some.json is not a handover bundle", "export-keys"),
        (["restore", "hello.txt"], 8, "This is not a backup", "backup"),
        (["identify", "--timeout", "abc"], 2, "'abc' is not a number of seconds", ""),
        (["identify", "--nfc", "tty:NONE7:pn532", "--timeout", "1"], 5, "serial line tty:NONE7", "ls /dev/ttyUSB*"),
        (["provision", "--report", "x.pdf", "--batch", "hello.txt"], 2, "neither CSV nor HTML", "FILE.html"),
        (["provision", "--batch", "hello.txt"], 8, "hello.txt:1: there is no column 'hello'", "Fix the sheet"),
        (["provision", "--name", "", "-p", "load-cell"], 2, "A name has 1 to 120 octets", ""),
        (["provision", "--name", "a\nb", "-p", "load-cell"], 2, "A name is one line of printable characters", ""),
        (["handover", "receipt", "hello.txt"], 8, "hello.txt is not a receipt", "import-keys"),
        (["whitelist", "import", "empty"], 8, "empty is empty.", "CSV"),
        (["verify", "empty"], 8, "empty is not a TEDS image: The TEDS image is empty", "build, sign and read"),
        (["verify", "octets"], 8, "octets is not a TEDS image: The TEDS image is not text", "build, sign and read"),
        (["sign", "folder"], 3, "folder is a folder", ""),
        (["verify", "/dev/null"], 3, "/dev/null is not a regular file", ""),
        (["nodes", "--due", "soon"], 2, "'soon' is not a whole number", ""),
        (["write", "8d4d", "--from", "last"], 2, "'last' is not a whole number", ""),
        (["init", "--name", "another"], 2, "already holds a station", "--name"),
        (["init", "--keystore", "keyring"], 2, "already holds a station", "--keystore"),
    ],
)
def test_a_message_names_what_it_is(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], code: int, message: str, cure: str
) -> None:
    (tmp_path / "hello.txt").write_text("hello\n")
    (tmp_path / "empty").touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "octets").write_bytes(b"\xe4" * 9)
    (tmp_path / "some.json").write_text('{"a": 1}\n')
    monkeypatch.chdir(tmp_path)
    outcome = call(home, "--json", *words)
    assert outcome.code == code, outcome
    assert message in outcome.json["error"]["message"]
    assert cure in outcome.json["error"]["hint"]
    for word in ("base64url", "JWE", "JWS", "codec", "float range", "integer range", "hold it flat", "054c:"):
        assert word not in outcome.out


def test_a_second_init_that_asks_for_the_same_shows_it(home: Path) -> None:
    shown = call(home, "--json", "init").json
    again = call(home, "--json", "init", "--name", shown["name"], "--keystore", shown["keystore"])
    assert (again.code, again.json["fingerprint"]) == (0, shown["fingerprint"])


def test_a_kernel_without_can_is_called_that(monkeypatch: pytest.MonkeyPatch) -> None:
    for number, message, cure in (
        (errno.EAFNOSUPPORT, "This kernel has no CAN support.", "modprobe can_raw"),
        (errno.ENODEV, "There is no CAN interface can7.", "ip -brief link"),
    ):

        def fails(*_: object, number: int = number) -> None:
            raise OSError(number, "as the system says it")

        monkeypatch.setattr(can_bus, "_opened", fails)
        with pytest.raises(NoReaderError) as caught:
            can_bus.Bus(parse_spec("socketcan:can7"))
        assert caught.value.message == message
        assert cure in caught.value.hint


@pytest.mark.link
def test_another_board_on_the_reader_is_named(tmp_path: Path) -> None:
    from tests.e2e.desk import Desk

    desk = Desk(tmp_path, tmp_path)
    try:
        node = desk.node().start()
        port = NfcPort(desk.links.nfc)
        with pytest.raises(NoNodeError) as caught:
            port.find(lambda identity: False, seconds=1.5, notice=lambda notice: None)
        port.close()
    finally:
        desk.clear()
    assert f"Node {node.uuid} is on the reader" in caught.value.message
    assert "flat" not in caught.value.hint


def test_replacing_a_node_without_name_prints_no_none(home: Path) -> None:
    for uuid in (UUID, UUID[:-1] + "1"):
        added = spawn("--home", home, "whitelist", "add", uuid, passphrase=PASSPHRASE)
        assert added.code == 0, added
    from teds_provision.station.station import Station

    station = Station.open(home, ask=lambda prompt, confirm: PASSPHRASE)
    station.nodes.remember(bytes.fromhex(UUID), channels=1)
    station.close()
    outcome = spawn("--home", home, "replace", UUID, UUID[:-1] + "1", "--dry-run", passphrase=PASSPHRASE)
    assert (outcome.code, "None" in outcome.out, "no name or profile" in outcome.out) == (0, False, True), outcome


def test_a_name_that_no_file_can_have_is_called_that_and_is_no_bug(home: Path, tmp_path: Path) -> None:
    long, loop, file = "x" * 5000, tmp_path / "loop", tmp_path / "file"
    loop.symlink_to(loop)
    file.write_text("x")
    wrong = []
    for words, code in (
        (["trust", "ca", "export", long], 3),
        (["init", "--request", long], 3),
        (["identify", "--trace", long, "--timeout", "1"], 3),
        (["build", UUID, "-p", "load-cell", "-c", long], 3),
        (["sign", long], 3),
        (["trust", "ca", "export", str(loop / "x")], 3),
        (["profile", "new", "thing", "-o", str(file / "x")], 3),
        (["whitelist", "export", ""], 2),
        (["import-keys", ""], 3),
        (["group", "delete", "\udcff"], 8),
        (["group", "create", "\udcff", UUID], 2),
        (["log", "--act", "\udcff"], 8),
        (["profile", "new", "thing", "-o", "/dev/full"], 2),  # which can be read without end
    ):
        outcome = call(home, "--json", *words)
        if outcome.code != code or "bug" in outcome.out or len(outcome.out) > 700:
            wrong.append((words[:3], outcome.code, outcome.out[:200]))
    assert not wrong


def test_a_group_of_any_script_is_made_changed_and_deleted(home: Path) -> None:
    """64 characters are a name, whatever their length in octets; and a name that nobody gave leaves no file."""
    name = "名" * 64
    for words in (
        ["create", name],
        ["add", name, UUID],
        ["remove", name, UUID],
        ["delete", name],
        ["delete", "x" * 999],
    ):
        outcome = call(home, "--json", "group", *words)
        assert outcome.code == 0, outcome
    assert len([path for path in home.iterdir() if path.name.startswith("measuring-")]) == 1


def test_a_number_that_is_none_is_no_number_of_anything(home: Path) -> None:
    """NaN is within all bounds of click; a rate of NaN measured nothing and ended well."""
    for words in (
        ["identify", "--timeout", "nan"],
        ["identify", "--timeout", "inf"],
        ["measure", UUID, "--rate", "nan"],
        ["measure", UUID, "--rate", "inf"],
        ["measure", UUID, "--duration", "nan"],
        ["measure", UUID, "--scalar-rate", "nan"],
        ["set", UUID, "1", "1", "--hold", "nan"],
        ["set", UUID, "1", "nan"],
        ["node", "run", "nowhere", "--battery", "nan"],
    ):
        outcome = call(home, "--json", *words)
        assert outcome.code == 2, outcome
        assert "finite" in outcome.json["error"]["message"], outcome


def test_a_list_that_breaks_off_is_one_json_object_all_the_same(home: Path, tmp_path: Path) -> None:
    """What was told before stands, the error beside it, and its code is the command's."""
    line = record.line(Record(1.0, "out", "can", "frame", b"\1", "a frame"))
    (tmp_path / "b.trace").write_bytes(record.head() + line + b"{]\n" + line)
    outcome = call(home, "--json", "trace", "show", tmp_path / "b.trace")
    assert outcome.code == 8
    assert len(outcome.json["frames"]) == 1
    assert outcome.json["error"]["code"] == "bad-data"


def test_people_see_their_own_time_with_its_offset(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """cli.md: local time with offset for people, ISO 8601 with Z in JSON."""
    call(home, "whitelist", "add", UUID)
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    time.tzset()
    try:
        output = call(home, "whitelist", "list").out
        assert "+09:00" in output
        assert not re.search(r"\dZ\b", output)
        (entry,) = call(home, "--json", "whitelist", "list").json["whitelist"]
        assert entry["added"].endswith("Z")
    finally:
        monkeypatch.undo()
        time.tzset()
