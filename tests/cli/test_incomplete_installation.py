"""A required package that is missing is named before a command writes anything."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from teds_provision.lazy import REQUIRED, missing_packages
from tests.cli.shell import call, clean_environment

RUN = """
import sys
for module in sys.argv.pop(1).split(","):
    sys.modules[module] = None  # as if it were not installed: every import of it fails
from teds_provision.__main__ import main
main()
"""


def without(modules: str, *words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", RUN, modules, *map(str, words)],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        env=clean_environment(),
        check=False,
    )


def content(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("package", REQUIRED)
def test_each_required_package_is_missed(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert missing_packages() == []
    monkeypatch.setitem(sys.modules, REQUIRED[package][0], None)
    assert missing_packages() == [package]


def test_provision_names_missing_packages_and_writes_nothing(tmp_path: Path) -> None:
    home = tmp_path / "home"
    assert call(home, "init", "--keystore", "file", "--name", "bench").code == 0
    before = content(home)
    words = ("provision", "--profile", "magnetic-angular-position-sensor", "--nfc", "udp:localhost:1", "--yes")
    done = without("numpy,backports.zstd", "--json", "--home", home, *words)
    assert done.returncode == 1, done.stderr
    error = json.loads(done.stdout)["error"]
    assert error["code"] == "incomplete-installation"
    assert error["message"] == "The installation is incomplete: numpy, backports.zstd missing."
    assert error["hint"].endswith(" numpy backports.zstd")
    assert content(home) == before
    done = without("jaraco", "--home", tmp_path / "other", "init")  # keyring needs it
    assert (done.returncode, "jaraco.context missing" in done.stderr) == (1, True), done.stderr


@pytest.mark.needs_room("plant")
def test_a_package_for_labels_is_missed_before_a_board_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "home"
    assert call(home, "init", "--keystore", "file", "--name", "bench").code == 0
    for missing, label_format, message in (("PIL", "png", "A PNG needs Pillow"), ("segno", "svg", "Labels need segno")):
        monkeypatch.setitem(sys.modules, missing, None)
        words = ("--job", "none", "--watch", "--yes", "--label-to", tmp_path / "labels", "--label-format", label_format)
        done = call(home, "provision", *words)
        assert (done.code, message in done.err) == (1, True), done.err


def test_the_doctor_runs_without_and_says_so(tmp_path: Path) -> None:
    done = without("numpy", "--json", "--home", tmp_path / "home", "doctor")
    checks = json.loads(done.stdout)["checks"]
    assert {check["name"] for check in checks} >= {"python", "libraries"}, done.stderr


def test_without_click_there_is_still_a_sentence() -> None:
    done = without("click", "nodes")
    assert (done.returncode, done.stdout) == (1, "")
    assert "click missing" in done.stderr
    assert "Traceback" not in done.stderr
