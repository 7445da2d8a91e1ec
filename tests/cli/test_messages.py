"""Each message names what it is, not how it failed to parse: the fifteen of issue 9 section 1 line 8, and their like.

Here: files that are not there (3), files that are something else (5), a number that is none, a serial line without a
reader, a kernel without CAN, a wrong board on the reader, a second init, a node without name. Elsewhere: matplotlib is
missing (tests/teds/test_plot.py), no node of ours on a bus (tests/e2e/test_many.py).
"""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from teds_provision.errors import NoNode, NoReader
from teds_provision.links.can import bus as can_bus
from teds_provision.links.can.spec import parse_spec
from teds_provision.links.nfc.reader import NfcPort
from tests.bench import PASSPHRASE

from .shell import call, spawn

UUID = "8d4d9da65281f7000000"


@pytest.mark.parametrize(
    ("words", "code", "said", "cure"),
    [
        (["verify", "none.json"], 3, "There is no file none.json", ""),
        (["sign", "none.json"], 3, "There is no file none.json", ""),
        (["show", "none.json"], 3, "There is no file", ""),
        (["verify", "hello.txt"], 8, "hello.txt is no TEDS image", "build, sign and read"),
        (["show", "hello.txt"], 8, "hello.txt holds no TEDS", "Intel HEX"),
        (["import-keys", "hello.txt"], 8, "hello.txt is no handover bundle", "export-keys"),
        (["import-keys", "some.json"], 8, "some.json is no handover bundle", "export-keys"),
        (["restore", "hello.txt"], 8, "This is not a backup", "backup"),
        (["identify", "--timeout", "abc"], 2, "'abc' is no number of seconds", ""),
        (["identify", "--nfc", "tty:NONE7:pn532", "--timeout", "1"], 5, "serial line tty:NONE7", "ls /dev/ttyUSB*"),
        (["provision", "--report", "x.pdf", "--batch", "hello.txt"], 2, "neither CSV nor HTML", "FILE.html"),
        (["provision", "--batch", "hello.txt"], 8, "hello.txt:1: there is no column 'hello'", "Mend the sheet"),
        (["provision", "--name", "", "-p", "load-cell"], 2, "A name has 1 to 120 octets", ""),
        (["init", "--name", "another"], 2, "There is a station", "--name"),
        (["init", "--keystore", "keyring"], 2, "There is a station", "--keystore"),
    ],
)
def test_a_message_names_what_it_is(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], code: int, said: str, cure: str
) -> None:
    (tmp_path / "hello.txt").write_text("hello\n")
    (tmp_path / "some.json").write_text('{"a": 1}\n')
    monkeypatch.chdir(tmp_path)
    told = call(home, "--json", *words)
    assert told.code == code, told
    assert said in told.json["error"]["message"]
    assert cure in told.json["error"]["hint"]
    for word in ("base64url", "JWE", "float range", "hold it flat", "054c:"):
        assert word not in told.out


def test_a_second_init_that_asks_for_the_same_shows_it(home: Path) -> None:
    shown = call(home, "--json", "init").json
    again = call(home, "--json", "init", "--name", shown["name"], "--keystore", shown["keystore"])
    assert (again.code, again.json["fingerprint"]) == (0, shown["fingerprint"])


def test_a_kernel_without_can_is_called_that(monkeypatch: pytest.MonkeyPatch) -> None:
    for number, said, cure in (
        (errno.EAFNOSUPPORT, "This kernel has no CAN.", "modprobe can_raw"),
        (errno.ENODEV, "There is no CAN interface can7.", "ip -brief link"),
    ):

        def fails(*_: object, number: int = number) -> None:
            raise OSError(number, "as the system says it")

        monkeypatch.setattr(can_bus, "_opened", fails)
        with pytest.raises(NoReader) as told:
            can_bus.Bus(parse_spec("socketcan:can7"))
        assert told.value.message == said
        assert cure in told.value.hint


@pytest.mark.link
def test_another_board_on_the_reader_is_named(tmp_path: Path) -> None:
    from tests.e2e.desk import Desk

    desk = Desk(tmp_path, tmp_path)
    try:
        node = desk.node().start()
        port = NfcPort(desk.links.nfc)
        with pytest.raises(NoNode) as told:
            port.find(lambda identity: False, seconds=1.5, notice=lambda notice: None)
        port.close()
    finally:
        desk.clear()
    assert f"Node {node.uuid} lies on the reader" in told.value.message
    assert "flat" not in told.value.hint


def test_replacing_a_node_without_name_prints_no_none(home: Path) -> None:
    for uuid in (UUID, UUID[:-1] + "1"):
        added = spawn("--home", home, "whitelist", "add", uuid, passphrase=PASSPHRASE)
        assert added.code == 0, added
    from teds_provision.station.station import Station

    station = Station.open(home, ask=lambda prompt, confirm: PASSPHRASE)
    station.nodes.remember(bytes.fromhex(UUID), channels=1)
    station.close()
    told = spawn("--home", home, "replace", UUID, UUID[:-1] + "1", "--dry-run", passphrase=PASSPHRASE)
    assert (told.code, "None" in told.out, "without name and profile" in told.out) == (0, False, True), told
