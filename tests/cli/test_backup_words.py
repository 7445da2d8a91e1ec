"""``backup`` and ``restore``: which places are refused, and what a person compares before a restore."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.cli.station import backup as commands
from teds_provision.errors import NotFoundError, UsageError
from teds_provision.handover.trust import spoken


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
