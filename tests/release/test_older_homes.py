"""Homes, backups and bundles that earlier versions wrote open with this one (docs/compatibility.md).

Each archive in assets/ (make_assets.py) holds two homes of one schema (keystore file), a backup and a bundle. North
provisioned a sensor and a gripper, put both into the group crane, named a topic, and exported both keys to south.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from teds_provision.station.store.schema import SCHEMA_VERSION
from tests.cli.shell import Outcome, call

ASSETS = sorted((Path(__file__).parent / "assets").glob("schema-*.zip"))
PASSPHRASE = "correct horse"
SENSOR, GRIPPER = "8d4d9da65281f7000000", "1111111111111f000000"


@pytest.fixture(params=ASSETS, ids=lambda path: path.stem)
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    with zipfile.ZipFile(request.param) as archive:
        archive.extractall(tmp_path)
    for home in ("north", "south"):
        (tmp_path / home).chmod(0o700)
    for path in tmp_path.rglob("*.*"):
        path.chmod(0o600)
    return tmp_path


def run(home: Path, *words: object) -> Outcome:
    done = call(home, "--json", *words, passphrase=PASSPHRASE)
    assert done.code == 0, done.err
    return done


def check_north(home: Path) -> None:
    """Check what north held when the archive was made."""
    nodes = {node["uuid"]: node for node in run(home, "nodes").json["nodes"]}
    assert {uuid: (node["name"], node["groups"]) for uuid, node in nodes.items()} == {
        SENSOR: ("slew angle", ["crane"]),
        GRIPPER: ("hand", ["crane"]),
    }
    assert {node["verdict"] for node in nodes.values()} == {"authentic"}
    assert run(home, "group", "list").json["groups"] == [{"name": "crane", "uuids": sorted([SENSOR, GRIPPER])}]
    topics = {(row["uuid"], row["channel"]): row["topic"] for row in run(home, "names", "list").json["names"]}
    assert topics[SENSOR, 1].endswith("crane/slew_angle")


def test_a_home_of_an_earlier_schema_keeps_everything(folder: Path) -> None:
    check_north(folder / "north")
    log = run(folder / "north", "log").json
    assert log["intact"] is True
    assert len(log["entries"]) >= 13


def test_an_earlier_backup_is_restored(folder: Path) -> None:
    passphrase = folder / "passphrase"
    passphrase.write_text(PASSPHRASE)
    with passphrase.open() as file:
        words = ("restore", folder / "north.backup", "--backup-passphrase-fd", file.fileno(), "--yes")
        assert run(folder / "new", *words).json["back"]["nodes"] == 2
    check_north(folder / "new")


def test_an_earlier_bundle_is_imported(folder: Path) -> None:
    done = call(folder / "south", "--json", "import-keys", folder / "keys.jwe", "--dry-run", passphrase=PASSPHRASE)
    if done.code:  # after its year a bundle is refused, and nothing else may be wrong with it
        assert done.json["error"]["code"] == "expired"
    else:
        assert done.json["imported"] == sorted([SENSOR, GRIPPER])


@pytest.mark.soak
def test_todays_schema_has_an_archive() -> None:
    assert ASSETS[-1].stem == f"schema-{SCHEMA_VERSION}", "python -m tests.release.make_assets"
