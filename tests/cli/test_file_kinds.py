"""A file of another kind is named for what it is, by every command that takes a file of a format."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from teds_provision.cli.file_kinds import _kind_of, mistaken_file
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from tests.bench import PASSPHRASE

from .shell import call

UUID = bytes.fromhex("8d4d9da65281f7000000")


@pytest.fixture
def folder(tmp_path: Path, home: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return one file of each kind that a person has at hand."""
    there = tmp_path / "files"
    there.mkdir()
    (there / "angle.csv").write_text("# date: 2026-11-26\nraw,value [degree]\n0,0\n65535,360\n")
    (there / "boards.csv").write_text("uuid,name,profile\n,a,gripper\n")
    (there / "gripper.toml").write_text('extends = "gripper"\ntitle = "Mine"\n')
    (there / "image.json").write_text(Image(UUID, load_profile("gripper").build(UUID).blocks).to_json())
    (there / "list.xml").write_text('<?xml version="1.0"?>\n<whitelist/>\n')
    (there / "bus.dbc").write_text('VERSION ""\nNS_ :\nBO_ 1 A: 8 B\n')
    (there / "node.td.json").write_text('{\n "@context": ["https://www.w3.org/2022/wot/td/v1.1"]\n}\n')
    (there / "node.aas.json").write_text('{"assetAdministrationShells": []}')
    (there / "node.xacro").write_text('<?xml version="1.0"?>\n<robot xmlns:xacro="http://wiki.ros.org/xacro"/>\n')
    (there / "report.pdf").write_bytes(b"%PDF-1.7\n")
    pem = call(home, "--json", "init").json["public_key"]
    (there / "station.pem").write_text(pem)
    monkeypatch.chdir(there)
    return there


@pytest.mark.parametrize(
    ("words", "code", "kind"),
    [
        (["show", "angle.csv"], 8, "angle.csv is a calibration (CSV)."),
        (["show", "node.td.json"], 8, "node.td.json is a Thing Description (JSON)."),
        (["show", "node.aas.json"], 8, "node.aas.json is an Asset Administration Shell (JSON)."),
        (["show", "node.xacro"], 8, "node.xacro is a robot description (xacro, URDF)."),
        (["verify", "list.xml"], 8, "list.xml is a whitelist."),
        (["whitelist", "import", "image.json"], 8, "image.json is a TEDS image."),
        (["import-keys", "station.pem"], 8, "station.pem is a public key (PEM)."),
        (["restore", "image.json"], 8, "image.json is a TEDS image."),
        (["trust", "add", "x", "boards.csv"], 8, "boards.csv is a sheet of boards (CSV)."),
        (["trust", "ca", "import", "station.pem"], 7, "station.pem is a public key (PEM)."),
        (["init", "--certificate", "station.pem"], 8, "station.pem is a public key (PEM)."),
        (["build", UUID.hex(), "-p", "gripper", "--calibration", "1=gripper.toml"], 8, "a transducer profile (TOML)."),
        (["provision", "--batch=angle.csv"], 8, "angle.csv is a calibration (CSV)."),
        (["node", "create", "node", "--teds", "bus.dbc"], 8, "bus.dbc is a DBC file."),
        (["record", "info", "report.pdf"], 8, "report.pdf is a PDF."),
        (["profile", "check", "./boards.csv"], 3, "boards.csv is a sheet of boards (CSV)."),
    ],
    ids=lambda words: " ".join(words[:2]) if isinstance(words, list) else "",
)
def test_a_file_of_another_kind_is_named(home: Path, folder: Path, words: list[str], code: int, kind: str) -> None:
    del folder
    outcome = call(home, "--json", *words, passphrase=PASSPHRASE)
    assert outcome.code == code, outcome
    assert kind in outcome.json["error"]["hint"], outcome


def test_a_file_of_the_right_kind_is_not_explained(home: Path, folder: Path) -> None:
    """A mistake inside it is reported alone."""
    for words in (["show", "image.json"], ["provision", "--batch", "boards.csv", "-p", "gripper"], ["show", "none"]):
        assert mistaken_file(words) == ""
    (folder / "angle.csv").write_text("raw,value [degree]\n0,zero\n")
    error = call(home, "--json", "calibrate", "fit", "angle.csv").json["error"]
    assert "angle.csv is" not in error["hint"]


LONG = " " * 70


@pytest.mark.parametrize(
    ("octets", "kind"),
    [
        (b"\x89MCAP0\r\n", "a recording (MCAP)"),
        (b"PAR1abc", "a recording (Parquet)"),
        (b"%PDF-1.7", "a PDF"),
        (b"PK\x03\x04abc", "a ZIP archive or an office document"),
        (b"-----BEGIN PUBLIC KEY-----", "a public key (PEM)"),
        (b"-----BEGIN ENCRYPTED PRIVATE KEY-----", "a private key (PEM)"),
        (b"-----BEGIN PRIVATE KEY-----", "a private key (PEM)"),
        (b"-----BEGIN EC PRIVATE KEY-----", "a private key (PEM)"),
        (b"-----BEGIN CERTIFICATE-----", "an X.509 certificate (PEM)"),
        (b" \r\n\t", "an empty file"),
        (b'<?xml version="1.0"?><!-- a <b> --><x:whitelist/>', "a whitelist"),
        (b"<teds-set/>", "TEDS in XML"),
        (b"<digitalCalibrationCertificate/>", "a calibration certificate (DCC)"),
        (b"<robot/>", "a robot description (xacro, URDF)"),
        (b"<other/>", None),
        (b"<?only?>", None),
        (b'{"event": "x"}', "a recording (JSON lines)"),
        (b'{"@context": ["https://www.w3.org/2022/wot/td/v1.1"]}', "a Thing Description (JSON)"),
        (b'{"submodels" : []}', "an Asset Administration Shell (JSON)"),
        (b'{"recipients": []}', "a handover bundle"),
        (b'{"whitelist": []}', "a whitelist"),
        (f'{{{LONG}"whitelist": []}}'.encode(), None),
        (b'{"format": "nothing/1"}', None),
        (b'{"recipients": [], "format" : "teds-backup/2"}', "a backup of a station"),
        (b'{"format":"teds-station-request/1"}', "a station's certificate request"),
        (b'{"format": "teds-station-certificate/1"}', "a station's certificate"),
        (b'{"event": "x", "format": "teds-trace/1"}', "a trace"),
        (b'{"format": "teds/1"}', "TEDS in JSON"),
        (b'{"a": "' + b" " * 4096 + b'", "format": "teds/1"}', None),
        (b'{"a": 1}', None),
        (b"# teds-provision measurement\n", "a recording (text)"),
        (b'VERSION "1"', "a DBC file"),
        (b"\nBO_ 12 A: 8 B", "a DBC file"),
        (b"[fileinfo]\n", "an EDS file"),
        (b"; x\n[DeviceInfo]\n", "an EDS file"),
        (b"title = 'x'\nextends = 'y'\n", "a transducer profile (TOML)"),
        (b"extends='y'\n", "a transducer profile (TOML)"),
        ("raw,value [°C]\n".encode("latin-1"), "a calibration (CSV)"),
        (b"[channel.1]\n", "a transducer profile (TOML)"),
        (b"# date\n\nRaw; value [degree]\n", "a calibration (CSV)"),
        (b"raw,other\n", None),
        (b"UUID\tname\tProfile\n", "a sheet of boards (CSV)"),
        (b"uuid,calibration\n", "a sheet of boards (CSV)"),
        (b"uuid,name\n", "a whitelist"),
        (b"hello", None),
    ],
)  # fmt: skip
def test_what_a_file_is_shows_in_its_beginning(tmp_path: Path, octets: bytes, kind: str | None) -> None:
    file = tmp_path / "file"
    file.write_bytes(octets)
    found = _kind_of(file)
    assert found == kind
    assert _kind_of(tmp_path) is None
    assert _kind_of(tmp_path / "none") is None


@pytest.mark.parametrize(
    ("name", "octets", "message", "hint"),
    [
        ("b.backup", b'{"format":"teds-backup/2"}', "{} holds no TEDS: it is a backup of a station.",
         "Read it with: teds-provision restore {}"),
        ("r.mcap", b"\x89MCAP0\r\n", "{} holds no TEDS: it is a recording (MCAP).", "Read it with: mcap info {}"),
        ("report.pdf", b"%PDF-1.7\n", "{} holds no TEDS: it is neither binary nor hex (read as hex: line 1 holds '%', "
         "which is no hex digit).", "{} is a PDF. TEDS come as binary, hex, Intel HEX, JSON, XML, an image, a profile "
         "or a bundle."),
    ],
)  # fmt: skip
def test_a_kind_that_the_error_names_already_is_not_named_twice(
    home: Path, tmp_path: Path, name: str, octets: bytes, message: str, hint: str
) -> None:
    file = tmp_path / name
    file.write_bytes(octets)
    error = call(home, "--json", "show", file).json["error"]
    assert (error["message"], error["hint"]) == (message.format(file), hint.format(file))


def test_a_file_that_cannot_be_opened_has_no_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its own error is reported, without another one about the same file."""
    file = tmp_path / "image.json"
    file.write_text("{}")

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    assert _kind_of(file) is None
    assert _kind_of(Path("a\0b")) is None


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["trust", "ca", "import", "list.xml"], "list.xml is a whitelist."),
        (["trust", "ca", "sign", "list.xml"], "list.xml is a whitelist."),
        (["trust", "add", "lab", "angle.csv"], "angle.csv is a calibration (CSV)."),
        (["whitelist", "import", "list.xml"], ""),
        (["build", "8d4d", "-p", "list.xml"], "list.xml is a whitelist."),
        (["build", "8d4d", "--profile=list.xml"], "list.xml is a whitelist."),
        (["build", "8d4d", "-p", "gripper.toml"], ""),
        (["build", "8d4d", "--calibration", "2=list.xml"], "list.xml is a whitelist."),
        (["node", "run", "a", "--source", "dbc:list.xml"], "list.xml is a whitelist."),
        (["node", "run", "a", "--source", "dbc:bus.dbc"], ""),
        (["nodes", "list.xml"], ""),
    ],
)
def test_which_file_of_a_command_line_is_not_taken_there(folder: Path, words: list[str], found: str) -> None:
    del folder
    assert mistaken_file(words) == found


@pytest.mark.parametrize("mark", ["", "\ufeff", "\ufeff \r\n", " \ufeff"])
def test_a_mark_before_the_text_hides_no_kind(tmp_path: Path, mark: str) -> None:
    file = tmp_path / "file"
    file.write_text(f"{mark}<whitelist/>", encoding="utf-8")
    assert _kind_of(file) == "a whitelist"


def test_a_pipe_has_no_kind_and_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.setattr(Path, "open", lambda *_: pytest.fail("it was opened"))
    assert _kind_of(tmp_path / "pipe") is None
