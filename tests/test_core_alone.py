"""The core without its optional rooms: a copy of the tree without their folders runs, and keeps what they wrote.

Their own tests are left out with them: those in their folders, and every file that imports a room or its tests. A test
that uses a command of a room is marked ``needs_room``.
"""

from __future__ import annotations

import json
import re
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from teds_provision.optional_rooms import OPTIONAL
from teds_provision.station.station import Station
from tests.bench import PASSPHRASE
from tests.cli.shell import call, clean_environment
from tests.pace import PATIENCE
from tests.plant.stations import Plant, ask

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parent.parent
_LEFT = ("build", "dist", ".venv*", ".git", "*.egg-info", ".*_cache", ".hypothesis")
_NAMES = "|".join(OPTIONAL)
_OF_A_ROOM = re.compile(
    rf"^\s*(?:from|import) (?:teds_provision|tests)\.(?:{_NAMES})\b"
    rf"|^\s*from (?:teds_provision|tests) import [^\n]*\b(?:{_NAMES})\b",
    re.M,
)
_GATE = (
    "tests/ncap/test_api.py::test_status_says_what_runs",
    "tests/e2e/test_whole_runs.py::test_a_tapped_node_is_provisioned_and_a_second_run_finds_nothing_to_do[python-4]",
)
"""What the gate runs of the core's tests, for a few seconds of CPU: the service, and a node from tap to verdict."""


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Copy of the tree without the optional rooms and their tests; what is compiled already is in it."""
    folder = tmp_path_factory.mktemp("core") / "tree"
    shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*_LEFT), symlinks=True)
    for room in OPTIONAL:
        shutil.rmtree(folder / "teds_provision" / room)
        shutil.rmtree(folder / "tests" / room)
    for path in (folder / "tests").rglob("*.py"):
        if _OF_A_ROOM.search(path.read_text(encoding="utf-8")):
            path.unlink()
    return folder


def run(core: Path, *words: object, given: str = "", patience: float = PATIENCE) -> subprocess.CompletedProcess[str]:
    """Run Python over the copy."""
    return subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=core,
        env=clean_environment(PYTHONPATH=str(core)),
        input=given,
        capture_output=True,
        text=True,
        timeout=patience,
        check=False,
    )


def test_every_module_is_imported_without_the_rooms(core: Path) -> None:
    code = """
import importlib, pathlib, sys
for path in sorted(pathlib.Path("teds_provision").rglob("*.py")):
    name = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
    if not name.endswith("__main__"):
        importlib.import_module(name)
print(importlib.import_module("teds_provision").__file__)
print(sorted(importlib.import_module("teds_provision.optional_rooms").rooms()))
"""
    done = run(core, "-c", code)
    assert done.stdout.splitlines() == [str(core / "teds_provision" / "__init__.py"), "[]"], done.stderr[-2000:]


def test_the_tests_of_the_core_pass(core: Path) -> None:
    done = run(core, "-m", "pytest", "-q", "-p", "no:cacheprovider", *_GATE, patience=10 * PATIENCE)
    assert done.returncode == 0, done.stdout[-4000:]


def test_options_of_a_room_are_not_offered_and_its_commands_do_not_exist(core: Path, tmp_path: Path) -> None:
    refused = {
        ("registry", "status"): "No such command 'registry'.",
        ("node", "check"): "No such command 'check'.",
        ("provision", "--job", "fifty.jws"): "No such option '--job'.",
        ("sign", "8d4d", "--by", "office"): "No such option '--by'.",
        ("nodes", "--plant"): "No such option '--plant'.",
        ("demo", "--line"): "No such option '--line'.",
        ("export-keys", "--to", "lab", "--all"): "Give --output FILE.",
        ("import-keys",): "Missing argument 'FILE'.",
        ("ncap", "run", "--registry"): "No such option '--registry'.",
    }
    code = f"""
import json
from teds_provision.cli.context import App
from teds_provision.cli.main import run
for words in {list(refused)!r}:
    App.current = None
    code = run(["--home", {str(tmp_path / "home")!r}, "--json", *words])
    assert code == 2, (code, words)
run(["--help"])
"""
    done = run(core, "-c", code)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    for line, message in zip(lines, refused.values(), strict=False):
        error = json.loads(line)["error"]
        assert (error["code"], error["message"].startswith(message)) == ("usage", True), line
    help_text = "\n".join(lines[len(refused) :])
    assert "Create and run virtual nodes.\n" in help_text
    assert "The plant" not in help_text


@pytest.mark.nightly(
    "tests/test_core_alone.py::test_the_tests_of_the_core_pass holds a node from tap to verdict there, and "
    "tests/cli/test_demo_ends.py::test_the_whole_story_as_make_demo_starts_it the demo"
)
def test_the_demo_shows_the_whole_story(core: Path) -> None:
    done = run(core, "-m", "teds_provision", "--json", "demo", patience=10 * PATIENCE)
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout.splitlines()[-1])["verdict"] == "authentic"


def _rows(home: Path) -> dict[str, list[tuple[object, ...]]]:
    """Return every row of every table that a plant fills, as it is in the file."""
    with closing(sqlite3.connect(f"file:{home / 'store.sqlite3'}?mode=ro", uri=True)) as file:
        found = {table: file.execute(f"SELECT * FROM {table}").fetchall() for table in _TABLES}
        found["plant"] = file.execute("SELECT registry, joined, synced, acknowledged, mac FROM plant").fetchall()
        return {table: sorted(rows, key=repr) for table, rows in found.items()}


def _must_look_first(home: Path) -> bool:
    """Return True if a restored station must look for its own pages before it states anything in its plant."""
    with closing(sqlite3.connect(f"file:{home / 'store.sqlite3'}?mode=ro", uri=True)) as file:
        return bool(file.execute("SELECT restored IS NOT NULL AND restored_mac IS NOT NULL FROM plant").fetchone()[0])


_TABLES = ("rosters", "chains", "pages", "heads", "claims", "digests", "parcels", "shared", "jobs", "alarms")


def test_a_backup_with_the_rows_of_a_plant_comes_through_a_core_without_the_room(core: Path, tmp_path: Path) -> None:
    plant = Plant(tmp_path)
    plant.member("south", "base")
    home = plant.north.home
    plant.north.plant.record_event("agreed", bytes(10), fingerprint="ab" * 32, epoch=2, key_id="0123456789abcdef")
    plant.round()
    plant.close()
    before = _rows(home)
    assert all(before[table] for table in ("plant", "rosters", "pages", "claims"))
    assert call(home, "backup", tmp_path / "north.backup").code == 0
    restored = tmp_path / "restored"
    for words in (("restore", tmp_path / "north.backup"), ("backup", tmp_path / "again.backup")):
        program = ("-m", "teds_provision", "--home", restored, "--passphrase-fd", "0")
        done = run(core, *program, *words, given=f"{PASSPHRASE}\n")
        assert done.returncode == 0, done.stdout + done.stderr
    assert _rows(restored) == before
    assert call(tmp_path / "twice", "restore", tmp_path / "again.backup").code == 0
    assert _rows(tmp_path / "twice") == before
    assert not _must_look_first(home)
    assert _must_look_first(restored), "a rule of the plant that the core keeps without the room"
    with Station.open(tmp_path / "twice", ask=ask) as station:
        assert station.plant.roster is not None
        assert station.plant.roster.name == "plant Augsburg"


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_the_whole_suite_of_the_core_passes(core: Path) -> None:
    usual = "not soak and not machine and not rclpy and not nightly and not realtime and not needs_room"
    words = ("-m", "pytest", "-q", "-n", "2", "--dist", "worksteal", "-p", "no:cacheprovider", "-m", usual, "tests")
    done = run(core, *words, "--hypothesis-profile", "gate", patience=3500)
    assert done.returncode == 0, done.stdout[-8000:]
