"""``backup`` and ``restore``: which places are refused, and what a person compares before a restore."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.backup.backup import BackupResult
from teds_provision.backup.restore import Relation, RestoreResult
from teds_provision.cli.context import App
from teds_provision.cli.station import backup as commands
from teds_provision.errors import NotFoundError, UsageError
from teds_provision.handover.trust import spoken
from teds_provision.station.station import Station
from tests.bench import PASSPHRASE

from .shell import call


@pytest.mark.parametrize(
    ("name", "own"),
    [
        ("store.sqlite3", True),
        ("store.sqlite3-wal", True),
        ("store.lock", True),
        ("vault.json", True),
        ("vault-pkcs11.json", True),
        ("config.toml", True),
        ("station.backup", False),
        ("my-store.sqlite3", False),
    ],
)
def test_a_backup_is_none_of_the_files_that_it_is_made_of(tmp_path: Path, name: str, own: bool) -> None:
    home, link = tmp_path / "home", tmp_path / "link"
    home.mkdir()
    link.symlink_to(home)
    commands._require_place(home, tmp_path / name)
    for folder in (home, link):  # by whatever way it is named
        if own:
            with pytest.raises(UsageError, match="is one of the station's own files"):
                commands._require_place(home, folder / name)
        else:
            commands._require_place(home, folder / name)
    with pytest.raises(NotFoundError, match="There is no folder"):
        commands._require_place(home, tmp_path / "none" / name)


@pytest.mark.parametrize(
    ("days", "age"),
    [(0, "0 days ago"), (1, "1 day ago"), (400, "400 days ago"), (-1, "in the future: check the clocks")],
)
@pytest.mark.parametrize(
    ("keystore", "named"), [("file", "file"), (None, "the OS keyring, or a passphrase file if there is none")]
)
def test_a_backup_is_known_by_station_date_key_and_keystore(
    days: int, age: str, keystore: str | None, named: str
) -> None:
    content: Any = SimpleNamespace(
        name="north", created="2026-11-21T18:37:10Z", station="ab" * 32, age_days=lambda: days
    )
    assert commands._summary(content, keystore).splitlines() == [
        f"Backup of station north, made 2026-11-21T18:37:10Z ({age})",
        f"  key      {spoken('ab' * 32)}",
        f"  keystore {named}",
    ]


def test_what_a_backup_lacks_is_said_on_stderr_and_in_its_result(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "station.backup"
    done = BackupResult(4711, "ab" * 32, 3, 2, "passphrase", ("The token's keys are not in it.",))
    monkeypatch.setattr(commands, "back_up", lambda *_, **__: done)
    found = call(home, "--json", "backup", file)
    assert found.err == "Warning: The token's keys are not in it.\n"
    assert (found.json["warnings"], found.json["nodes"], found.json["keys"]) == (
        ["The token's keys are not in it."],
        3,
        2,
    )
    assert call(home, "backup", file).out == f"Sealed nodes: 3, keys: 2, to a passphrase: {file} (4711 octets).\n"


def test_a_damaged_store_that_was_set_aside_and_keys_that_are_due_are_named(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content: Any = SimpleNamespace(
        name="north", created="2026-11-21T18:37:10Z", station="ab" * 32, age_days=lambda: 3, close=lambda: None
    )
    done = RestoreResult("rebuilt", None, {}, (), "file", tmp_path / "store.damaged", 2)
    monkeypatch.setattr(commands, "_open", lambda *_: content)
    monkeypatch.setattr(commands, "open_present", lambda *_: None)
    monkeypatch.setattr(commands, "keystore_for", lambda *_: "file")
    monkeypatch.setattr(commands, "rebuild", lambda *_, **__: done)
    (tmp_path / "b").touch()
    words = call(home, "restore", tmp_path / "b").err
    assert f"Warning: The damaged store was kept as {tmp_path / 'store.damaged'}.\n" in words
    assert "Warning: Nodes that need a new key first: 2; the keys in a backup may have been handed over since." in words
    monkeypatch.setattr(commands, "rebuild", lambda *_, **__: replace(done, set_aside=None, rotations_due=0))
    quiet = call(home, "--json", "restore", tmp_path / "b")
    assert ("Warning" in quiet.err, quiet.json["action"], quiet.json["rotations_due"]) == (False, "rebuilt", 0)


@pytest.mark.parametrize(("yes", "later", "code"), [(False, 1, 7), (False, 0, 0), (False, 2, 0), (True, 1, 0)])
def test_a_merge_restores_what_the_person_was_asked_about_or_nothing(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, yes: bool, later: int, code: int
) -> None:
    """``later``: what the list has after the question; 0 is none, as if another restore had been faster."""
    content: Any = SimpleNamespace(
        name="north", created="2026-11-21T18:37:10Z", station="ab" * 32, age_days=lambda: 3, close=lambda: None
    )
    lists = [{"whitelist": 2}, {"whitelist": later} if later else {}]
    plan = RestoreResult("merged", Relation.OLDER, {"whitelist": 2}, (), "file")
    merged: list[Any] = []
    station = Station.open(home, ask=lambda *_: PASSPHRASE)
    monkeypatch.setattr(commands, "_open", lambda *_: content)
    monkeypatch.setattr(commands, "open_present", lambda *_: station)
    monkeypatch.setattr(commands, "merge", lambda *_, **__: replace(plan, back=lists.pop(0)))
    monkeypatch.setattr(commands, "merge_checked", lambda *given: merged.append(given) or plan)
    monkeypatch.setattr(commands, "complete_vault", lambda *_, **__: None)
    monkeypatch.setattr(App, "confirm", lambda *_, **__: None)
    (tmp_path / "b").touch()
    done = call(home, "--json", "restore", tmp_path / "b", *(["--yes"] if yes else []))
    assert (done.code, len(merged)) == (code, 0 if code else 1)
    if code:
        assert done.json["error"]["message"].endswith("so the list is out of date. Nothing was changed.")
        assert done.json["error"]["hint"].endswith("Run it again and check the new list.")


def test_a_merge_lists_all_that_comes_back_and_all_that_stays(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    content: Any = SimpleNamespace(
        name="north", created="2026-11-21T18:37:10Z", station="ab" * 32, age_days=lambda: 3, close=lambda: None
    )
    back = {"whitelist entries": 1, "names": 12}
    plan = RestoreResult("merged", Relation.OLDER, back, ("the newer key of thumb",), "file")
    monkeypatch.setattr(commands, "merge", lambda *_, **__: plan)
    notes: list[str] = []
    results: list[Any] = []
    app: Any = SimpleNamespace(home=home, note=notes.append, emit=lambda result, _human: results.append(result))
    station: Any = SimpleNamespace(identity=SimpleNamespace(record=lambda: SimpleNamespace(keystore="file")))
    commands._merge(app, station, content, None, yes=False, dry_run=True)
    assert notes[0].splitlines()[3:] == [
        f"It is {Relation.OLDER.value} of this station.",
        "  restored: whitelist entries: 1",
        "  restored: names: 12",
        "  unchanged: the newer key of thumb",
    ]
    assert (results[0]["back"], results[0]["kept"], results[0]["dry_run"]) == (back, ["the newer key of thumb"], True)
