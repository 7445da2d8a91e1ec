"""``doctor --report``: what a maintainer needs, without what identifies a site."""

from __future__ import annotations

import getpass
import json
import shutil
import socket
from contextlib import closing
from importlib import metadata
from pathlib import Path

import pytest

from teds_provision.doctor import report
from teds_provision.doctor.checks import Finding, System
from teds_provision.doctor.report import Mask, build_report
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.plant.roster import Member, RemovedMember
from teds_provision.station.station import Station
from teds_provision.station.store.records import TrustRecord
from tests.bench import make_station
from tests.cli.shell import call
from tests.plant.owner import ALL, alone, join, member, roster_of

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


def test_addresses_of_every_link_and_the_folders_of_a_user_are_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "bench-7")
    system = System(
        tmp_path / "home" / "teds", "tty:USB0:pn532", "socketcand:can0?host=10.1.2.3", "tcp-client:10.9.8.7:46100",
        workspace=tmp_path / "home" / "work", environment={"HOME": str(tmp_path / "home")},
    )  # fmt: skip
    mask = Mask(system, with_uuids=True)
    assert mask("nfc tty:USB0:pn532, can socketcand:can0?host=10.1.2.3, ble tcp-client:10.9.8.7:46100") == (
        "nfc tty:ADDRESS, can socketcand:ADDRESS, ble tcp-client:ADDRESS"
    )
    board = Mask(System(tmp_path, ble="hci0?address=C4:9A:02:11:22:33"), with_uuids=True)
    assert board("hci0?address=C4:9A:02:11:22:33 opens.") == "hci0?ADDRESS opens."
    assert mask(f"{tmp_path}/home/teds/x {tmp_path}/home/work/y {tmp_path}/home/z") == "HOME/x WORKSPACE/y ~/z"
    assert mask("bench-7, bench-78") == "HOST, bench-78"
    assert mask(f"{UUID} {'ab' * 8} {'ab' * 7}") == f"{UUID} HEX {'ab' * 7}", "from 16 digits on, but UUIDs"


def test_a_report_has_names_of_settings_kinds_of_links_and_the_last_errors(home: Path, tmp_path: Path) -> None:
    here = tmp_path / "copy"
    shutil.copytree(home, here)
    with Station.inspect(here) as station:
        for number in range(21):
            station.audit("write", bytes.fromhex(UUID), f"refused {number} {UUID}")
            station.audit("verify", None, "authentic")
    config = {"nfc": "usb", "provision": {"via": "can"}, "ncap": {"brokers": {"lab": "mqtt://h"}}}
    report = build_report(
        System(here, "usb:072f:2200", ble="hci0?address=C4:9A:02:11:22:33"), [], config, with_uuids=False
    )
    assert report["config"] == ["ncap.brokers.lab", "nfc", "provision.via"]
    assert report["links"] == {"nfc": "usb", "ble": "hci0"}
    assert [(entry["act"], entry["outcome"], entry["uuid"]) for entry in report["errors"]] == [
        ("write", f"refused {number} UUID-1", "UUID-1") for number in range(1, 21)
    ]


def test_a_report_never_replaces_a_file(home: Path, tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text("mine")
    assert call(home, "doctor", "--report", path).code == 2
    assert path.read_text() == "mine"


def test_a_machine_without_a_station_has_a_report_too(tmp_path: Path) -> None:
    report = json.loads(call(tmp_path / "none", "doctor", "--report", "-", passphrase=None).out)
    assert report["errors"] == []


def test_names_of_the_plant_and_of_stations_are_gone(tmp_path: Path) -> None:
    """The check of the registry names the plant, and whoever's clock is wrong."""
    west, old = SoftwareKey(71), SoftwareKey(72)
    with closing(alone(tmp_path / "home")) as station:
        removed = RemovedMember("old mill", old.point, frozenset({"line"}), "retired", (0, ""))
        members = (
            member(station, "owner", *ALL),
            Member("west", west.point, station.identity.certify(west.point), frozenset({"line"})),
        )
        join(station, roster_of(station, *members, version=2, previous="0" * 64, removed=(removed,), name="Mill (A)"))
        station.policy.trust(TrustRecord("lab", "station", SoftwareKey(73).point, "73" * 32))
    why = "Mill (A): roster 2 holds. west has dated its page; lab, owner and old mill have not. Westward."
    finding = Finding("registry", "warning", why, "Set the clock of west.")
    (shown,) = build_report(System(tmp_path / "home"), [finding], {}, with_uuids=True)["checks"]
    assert (shown["why"], shown["fix"]) == (
        "PLANT: roster 2 holds. STATION-4 has dated its page; STATION-1, STATION-3 and STATION-2 have not. Westward.",
        "Set the clock of STATION-4.",
    )


def test_the_name_of_a_station_alone_is_gone(tmp_path: Path) -> None:
    make_station(tmp_path / "home", "crane-7").close()
    mask = Mask(System(tmp_path / "home"), with_uuids=True)
    assert mask("crane-7 and crane-78") == "STATION-1 and crane-78"
    (tmp_path / "home" / "store.sqlite3").write_bytes(b"no database")
    assert Mask(System(tmp_path / "home"), with_uuids=True)("crane-7") == "crane-7", "its name cannot be read"


def test_a_user_without_a_name_and_a_copy_that_was_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert report._user() == getpass.getuser()
    for error in (KeyError(0), OSError(2, "No such file")):

        def nameless(error: Exception = error) -> str:
            raise error

        monkeypatch.setattr(getpass, "getuser", nameless)
        assert report._user() == ""
    known = {"click": "8.4.2", "zstd": "1.0"}

    def version(name: str) -> str:
        if name not in known:
            raise metadata.PackageNotFoundError(name)
        return known[name]

    monkeypatch.setattr(report.metadata, "version", version)
    wanted = ["zstd>=1; extra == 'x'", "click[x]>=8.4.2", "missing (>=1)"]
    monkeypatch.setattr(report.metadata, "requires", lambda name: wanted if name == "teds-provision" else None)
    assert list(report._packages().items()) == [("click", "8.4.2"), ("zstd", "1.0")]
    monkeypatch.setattr(report.metadata, "requires", lambda _: None)
    assert report._packages() == {}

    def not_installed(name: str) -> list[str]:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(report.metadata, "requires", not_installed)
    assert report._packages() == {}


def test_a_store_that_cannot_be_read_has_no_last_errors(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir(mode=0o700)
    (tmp_path / "home" / "store.sqlite3").write_bytes(b"no database, but as long as a page" * 200)
    system = System(tmp_path / "home", workspace=tmp_path, root=tmp_path, environment={})
    assert report._last_errors(system, Mask(system, with_uuids=True)) == []


def test_a_user_of_one_letter_hides_no_other_letters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(getpass, "getuser", lambda: "a")
    monkeypatch.setattr(socket, "gethostname", lambda: "")
    assert Mask(System(tmp_path), with_uuids=False)("a node, in a group") == "a node, in a group"
