"""Files that a command names: one to read that is not there is 3, one that would be written over is 2, everywhere."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.places import free_bus

from .shell import call

UUID = "8d4d9da65281f7000000"

READ = (
    "import-keys", "restore", "show", "sign", "trace show", "trust add crane", "trust ca sign --output c",
    "handover receipt", "trust ca import", "whitelist import", "profile check", "measure recover",
    "init --certificate", "ncap run --tls-cert", "build UUID --profile load-cell --calibration",
    "node create new --teds", "verify", "write UUID --image", "provision --batch", "provision --calibration",
    "measure UUID --require", "backup b --to",
)  # fmt: skip
WRITTEN = (
    "backup", "build UUID --profile load-cell --output", "init --request", "label UUID --output", "whitelist export",
    "profile new crane --output", "provision --batch sheet.csv --report", "identify --trace",
)  # fmt: skip
SUFFIX = {"label": ".svg", "provision": ".csv"}


@pytest.fixture
def desk(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TEDS_PROVISION_CAN", free_bus())
    monkeypatch.setenv("TEDS_PROVISION_NFC", "tty:nowhere:pn532")
    call(home, "whitelist", "add", UUID, "--fingerprint", "ab" * 32)
    (tmp_path / "sheet.csv").write_text("name,profile\na,load-cell\n")
    return home


def words(text: str) -> list[str]:
    return text.replace("UUID", UUID).split()


@pytest.mark.parametrize("command", READ)
def test_a_folder_or_nothing_in_the_place_of_a_file_is_no_such_thing(desk: Path, command: str, tmp_path: Path) -> None:
    """``import-keys FOLDER`` ended with 2, ``show FOLDER`` with 3."""
    (tmp_path / "folder").mkdir()
    for name in ("folder", "none"):
        outcome = call(desk, "--json", *words(command), name)
        assert (outcome.code, outcome.json["error"]["code"]) == (3, "not-found"), outcome.out
        assert name in outcome.json["error"]["message"]


@pytest.mark.parametrize("command", WRITTEN)
def test_a_file_to_be_written_needs_its_folder_and_is_no_folder(desk: Path, command: str, tmp_path: Path) -> None:
    """``label --output`` ended with 7, ``--report`` with 2, ``profile new --output`` made folders."""
    name = f"file{SUFFIX.get(command.partition(' ')[0], '')}"
    outcome = call(desk, "--json", *words(command), f"none/{name}")
    assert (outcome.code, outcome.json["error"]["code"]) == (3, "not-found"), outcome.out
    assert outcome.json["error"]["message"].startswith("There is no folder ")
    assert not (tmp_path / "none").exists()
    (tmp_path / name).mkdir()
    outcome = call(desk, "--json", *words(command), name)
    assert (outcome.code, outcome.json["error"]["code"]) == (2, "usage"), outcome.out
