"""``doctor --report``: what a maintainer needs, without what identifies a site."""

from __future__ import annotations

import getpass
import json
import socket
from pathlib import Path

import pytest

from teds_provision.doctor.checks import System
from teds_provision.doctor.report import Mask
from tests.cli.shell import call

UUID = "8d4d9da65281f7000000"


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a station that refused two things."""
    home = tmp_path_factory.mktemp("station") / "home"
    assert call(home, "init", "--keystore", "file").code == 0
    assert call(home, "whitelist", "add", UUID).code == 0
    assert call(home, "export-keys", UUID, "--to", "nowhere", "--output", home.parent / "x").code != 0
    assert call(home, "config", "set", "nfc", "udp:localhost:1").code == 0
    return home


def test_the_report_names_versions_checks_and_settings(home: Path, tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    done = call(home, "--json", "doctor", "--report", path)
    assert done.json["report"] == str(path)
    assert done.json["checks"]
    report = json.loads(path.read_text())
    assert report["format"] == "teds-report/1"
    assert {"click", "cryptography"} <= report["packages"].keys()
    assert report["config"] == ["nfc"]
    assert {"python", "store", "audit log"} <= {check["name"] for check in report["checks"]}


def test_the_report_holds_nothing_that_identifies_a_site(home: Path) -> None:
    done = call(home, "doctor", "--report", "-")
    assert json.loads(done.out)["format"] == "teds-report/1"
    for private in (UUID, str(home), str(home.parent), socket.gethostname(), "udp:localhost:1", "PRIVATE KEY"):
        assert private not in done.out


def test_uuids_are_kept_if_asked_for_and_the_option_needs_a_report(home: Path) -> None:
    kept = System(home)
    assert Mask(kept, with_uuids=True)(f"node {UUID} failed") == f"node {UUID} failed"
    assert call(home, "doctor", "--with-uuids").code == 2


def test_one_uuid_is_one_word_and_fingerprints_are_gone(tmp_path: Path) -> None:
    mask = Mask(System(tmp_path), with_uuids=False)
    other = "1111111111111f000000"
    assert mask(f"{UUID} and {other}, {UUID}") == "UUID-1 and UUID-2, UUID-1"
    assert mask(f"{UUID.upper()} too") == "UUID-1 too", "however it is written"
    assert mask("key " + "ab" * 32) == "key HEX"
    assert mask("5fa9 1809 991e e906 7a8b 1a1c 6ad8 114b") == "HEX"
    assert mask(f"{tmp_path}/x of {getpass.getuser()}") == "HOME/x of USER"


def test_a_report_never_replaces_a_file(home: Path, tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text("mine")
    assert call(home, "doctor", "--report", path).code == 2
    assert path.read_text() == "mine"


def test_a_machine_without_a_station_has_a_report_too(tmp_path: Path) -> None:
    report = json.loads(call(tmp_path / "none", "doctor", "--report", "-", passphrase=None).out)
    assert report["errors"] == []
