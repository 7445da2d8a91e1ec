"""A finished command, run again: it changes nothing and exits 0 (docs/contract/cli.md, "Rules")."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from teds_provision.cli.context import App
from teds_provision.handover.life import DECOMMISSIONED
from teds_provision.protocol.keys import SoftwareKey, to_pem
from teds_provision.station.station import Station
from teds_provision.station.store.lock import _HeldFile
from teds_provision.vault.selection import forget_vaults
from tests.bench import PASSPHRASE

from .shell import call

ONE, TWO, BUS = "8d4d9da65281f7000000", "8d4d9da65281f7000001", ("--can", "virtual:again", "--timeout", "0.2")

# In their order: each finds what the ones before it left. FOLDER stands for a folder of the test.
COMMANDS = (
    ("whitelist", "add", ONE, "--name", "thumb", "--fingerprint", "ab" * 32),
    ("whitelist", "add", TWO),
    ("whitelist", "export", "FOLDER/list.xml"),
    ("whitelist", "import", "FOLDER/list.xml"),
    ("group", "create", "hand", ONE),
    ("group", "add", "hand", TWO),
    ("group", "remove", "hand", TWO),
    ("names", "set", ONE, "0", "left"),
    ("names", "frame", ONE, "0", "tool"),
    ("names", "reset", ONE, "0"),
    ("trust", "add", "lab", "FOLDER/lab.pem", "--yes"),
    ("trust", "add", "owner", "FOLDER/owner.pem", "--role", "ca", "--yes"),
    ("trust", "remove", "owner", "--yes"),
    ("trust", "ca", "export", "FOLDER/ca.pem"),
    ("trust", "ca", "drop", "--yes"),
    ("trust", "ca", "import", "FOLDER/ca.pem"),
    ("label", ONE, "--output", "FOLDER/label.svg"),
    ("config", "set", "can", "socketcan:can0"),
    ("config", "unset", "can"),
    ("node", "create", "FOLDER/node", "--profile", "gripper"),
    ("profile", "new", "mine", "--output", "FOLDER/mine.toml"),
    ("revoke", TWO, "--why", "stolen", "--yes"),
    ("revoke", "--lift", TWO, "--yes"),
    ("whitelist", "remove", TWO, "--yes"),
    ("group", "delete", "hand", "--yes"),
    ("draft", "drop", ONE, "--yes"),
    ("decommission", ONE, "--force", "--yes", *BUS),
    ("lock",),
)

# They only write a file that is named, or change nothing of the station (docs/contract/cli.md).
NO_PLAN = frozenset({"label", "config", "lock", "node", "trust ca export", "registry request"})
SPARE = "8d4d9da65281f7000003"
OTHERS = (
    ("whitelist", "add", TWO, "--name", "finger"),
    ("whitelist", "add", SPARE),
    ("replace", TWO, SPARE, "--yes"),
    ("replace", TWO, SPARE, "--yes"),
    ("decommission", ONE, "--force", "--yes", *BUS),
    ("build", SPARE, "--profile", "gripper"),
    ("registry", "create", "--name", "plant", "--yes"),
    ("registry", "renew", "--yes"),
    ("registry", "request", "--output", "FOLDER/request"),
    ("backup", "FOLDER/x.backup"),
    ("restore", "FOLDER/x.backup", "--yes"),
    ("vault", "rewrap"),
)


def rows(home: Path) -> dict[str, Any]:
    """Return every row of the store but those of the log, which has each run."""
    with closing(sqlite3.connect(f"file:{home / 'store.sqlite3'}?mode=ro", uri=True)) as database:
        tables = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {
            name: sorted(map(repr, database.execute(f"SELECT * FROM {name}")))
            for name in tables
            if "audit" not in name and name != "meta" and not name.startswith("sqlite")
        }


def entries(home: Path) -> int:
    """Return how many entries the log has: a plan leaves none."""
    with closing(sqlite3.connect(f"file:{home / 'store.sqlite3'}?mode=ro", uri=True)) as database:
        return int(database.execute("SELECT count(*) FROM audit").fetchone()[0])


def contents(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder without the store, whose rows are compared, and without empty ones: locks."""
    found = [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("store.")]
    return {str(path.relative_to(folder)): path.read_bytes() for path in found if path.stat().st_size}


def require_a_plan_that_changes_nothing(home: Path, folder: Path, given: list[str], words: tuple[str, ...]) -> None:
    """Run a command with `--dry-run`, and find neither a row, a file nor an entry of the log changed."""
    if words[0] in NO_PLAN or " ".join(words[:3]) in NO_PLAN or " ".join(words[:2]) in NO_PLAN:
        return
    before = rows(home), entries(home), contents(folder)
    plan = call(home, "--json", *given, "--dry-run")
    assert plan.code == 0, (words, plan)
    assert (rows(home), entries(home), contents(folder)) == before, words


def test_a_finished_command_changes_nothing_and_exits_0(home: Path, tmp_path: Path) -> None:
    (tmp_path / "lab.pem").write_text(to_pem(SoftwareKey(51).point))
    (tmp_path / "owner.pem").write_text(to_pem(SoftwareKey(52).point))
    for words in COMMANDS:
        given = [word.replace("FOLDER", str(tmp_path)) for word in words]
        require_a_plan_that_changes_nothing(home, tmp_path, given, words)
        first = call(home, "--json", *given)
        before = rows(home)
        again = call(home, "--json", *given)
        assert (first.code, again.code) == (0, 0), (words, first, again)
        assert rows(home) == before, words


@pytest.mark.parametrize("words", [("whitelist", "add"), ("trust", "remove"), ("group", "add")])
def test_a_plan_of_what_is_finished_says_so_too(home: Path, tmp_path: Path, words: tuple[str, str]) -> None:
    (tmp_path / "lab.pem").write_text(to_pem(SoftwareKey(51).point))
    call(home, "group", "create", "hand", ONE)
    call(home, "trust", "add", "lab", tmp_path / "lab.pem", "--yes")
    more = {"whitelist": [ONE], "trust": ["lab"], "group": ["hand", ONE]}[words[0]]
    assert call(home, *words, *more, *(["--yes"] if words[0] == "trust" else [])).code == 0
    assert call(home, "--json", *words, *more, "--dry-run").code == 0


@pytest.mark.parametrize(
    "words",
    [
        ("revoke", ONE, "--why", "stolen", "--yes"),
        ("decommission", ONE, "--yes"),
        ("replace", ONE, SPARE, "--yes"),
    ],
    ids=lambda words: words[0],
)
def test_a_plan_of_a_finished_end_of_life_is_what_the_command_prints(home: Path, words: tuple[str, ...]) -> None:
    call(home, "whitelist", "add", SPARE)
    with Station.open(home, ask=lambda _prompt, _confirm: PASSPHRASE) as station, station.transaction():
        retired = DECOMMISSIONED if words[0] == "decommission" else None
        station.nodes.remember(bytes.fromhex(ONE), retired=retired)
    if words[0] != "decommission":
        assert call(home, *words).code == 0
    before = rows(home), entries(home)
    plan = call(home, "--json", *words, "--dry-run")
    assert (rows(home), entries(home)) == before
    assert (plan.code, plan.json["fresh"]) == (0, False)
    assert plan.json == call(home, "--json", *words).json


def test_no_passphrase_is_asked_for_while_a_lock_is_held(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A person types it in their own time: another command must not wait for them."""
    (tmp_path / "lab.pem").write_text(to_pem(SoftwareKey(51).point))
    (tmp_path / "owner.pem").write_text(to_pem(SoftwareKey(52).point))
    with Station.open(home, ask=lambda _prompt, _confirm: PASSPHRASE) as station, station.transaction():
        for uuid in (TWO, SPARE):
            station.nodes.remember(bytes.fromhex(uuid))
    held: list[Path] = []
    asked: list[tuple[str, ...]] = []
    enter, leave, ask = _HeldFile.__enter__, _HeldFile.__exit__, App.ask_secret

    def entered(lock: _HeldFile) -> _HeldFile:
        found = enter(lock)
        held.append(lock._path)
        return found

    def left(lock: _HeldFile, *of: Any) -> None:
        leave(lock, *of)
        held.remove(lock._path)

    def asks(app: App, prompt: str, confirm: bool = False) -> str:
        asked.append(tuple(path.name for path in held))
        return ask(app, prompt, confirm)

    monkeypatch.setattr(_HeldFile, "__enter__", entered)
    monkeypatch.setattr(_HeldFile, "__exit__", left)
    monkeypatch.setattr(App, "ask_secret", asks)
    found = {}
    for words in (*COMMANDS, *OTHERS):
        given = [word.replace("FOLDER", str(tmp_path)) for word in words]
        if words in OTHERS:
            require_a_plan_that_changes_nothing(home, tmp_path, given, words)
        forget_vaults()
        asked.clear()
        assert call(home, "--json", *given).code == 0, words
        if any(asked):
            found[words] = list(asked)
    assert found == {}
