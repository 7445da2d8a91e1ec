"""What backup and restore tell, and what a restored station may not do."""

from __future__ import annotations

import io
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.backup.backup import _write, backup
from teds_provision.backup.content import BackupHead
from teds_provision.backup.restore import rebuild
from teds_provision.errors import PolicyError, StoreError, StoreLockedError, UsageError
from teds_provision.station.station import Station, rewrap
from teds_provision.station.store.lock import StoreLock
from teds_provision.vault.master import Material
from teds_provision.vault.passphrase import THROWAWAY
from teds_provision.vault.selection import forget_vaults
from tests.backup.backups import ONE, POINT, TWO, ask, back_up, copy_of, opened, restored_into


def test_after_a_restore_every_key_has_to_be_rotated_by_a_person(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    done = restored_into(tmp_path / "new", opened(tmp_path / "b"))
    assert done.rotations_due == 2
    again = Station.open(tmp_path / "new", ask=ask)
    for uuid in (ONE, TWO):
        assert "restored from a backup" in (again.keys.rotation_due(uuid) or "")
        with pytest.raises(PolicyError, match="restored from a backup"):
            again.policy.require_not_restored(uuid)
    again.keys.rotated(ONE)
    again.policy.require_not_restored(ONE)
    again.close()


def test_no_module_path_goes_into_a_backup_or_comes_out_of_one(station: Station, tmp_path: Path) -> None:
    with copy_of(station, tmp_path) as content:
        evil = replace(content, keystore="pkcs11:token=x?module-path=/tmp/evil.so")
        for asked in (None, "file"):
            with pytest.raises((UsageError, PolicyError)):
                rebuild(tmp_path / "new", evil, ask, keystore=asked)
        with pytest.raises(UsageError, match="no such keystore"):
            rebuild(tmp_path / "new", replace(content, keystore="other"), ask)
    assert not (tmp_path / "new").exists()


def test_a_backup_beside_a_stuck_writer_says_so_and_leaves_no_file(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages: list[str] = []
    held = station.lock("provision")
    monkeypatch.setattr(
        Station, "lock", lambda self, command, notice: StoreLock(self.home, command=command, wait=1.0, notice=notice)
    )
    before = station.audit_log.check().count
    with held, pytest.raises(StoreLockedError):
        backup(station, tmp_path / "b", ask, costs=THROWAWAY, notice=messages.append)
    assert len(messages) == 1
    assert "provision" in messages[0]
    assert not (tmp_path / "b").exists()
    assert station.audit_log.check().count == before


def test_a_backup_that_does_not_open_again_is_not_kept(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("teds_provision.backup.sealed_file.MAX_OCTETS", 1000)
    with pytest.raises(StoreError, match="cannot be opened"):
        back_up(station, tmp_path / "b")
    assert list(tmp_path.glob("*b")) == []
    assert station.audit_log.check().count == 1 + 1  # init and ready


def test_a_backup_beside_a_change_of_the_master_key_is_written_again(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows, changes = station.rows, iter([True])

    def rows_after_a_change() -> Iterator[bytes]:
        if next(changes, False):  # the vault's secrets are taken already
            forget_vaults()  # as another process has it
            with Station.open(station.home, ask=ask) as other:
                rewrap(other)
        return rows()

    monkeypatch.setattr(station, "rows", rows_after_a_change)
    assert back_up(station, tmp_path / "b").warnings == ()
    with opened(tmp_path / "b") as content:
        assert list(content.unopened(station.vault)) == []
        assert Material.decode(content.material).masters.keys.keys() == {2}


@pytest.mark.parametrize(
    ("created", "days"),
    [
        ("2026-01-01T00:00:00Z", 12),
        ("2026-01-13T12:00:00", 0),
        ("2026-01-12T12:00:00", 1),
        ("2026-01-12T12:00:01Z", 0),
        ("2026-01-12T15:00:00+02:00", 0),
        ("2026-01-13T12:00:01Z", -1),
        ("yesterday", 0),
    ],
)
def test_the_age_of_a_backup(created: str, days: int) -> None:
    made = BackupHead("id", POINT, "n", created, "file", "")
    assert made.age_days(datetime(2026, 1, 13, 12, tzinfo=UTC)) == days


def test_a_backup_beside_a_writer_of_the_file_itself_says_what_it_waits_for(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not one of our commands: a program that holds SQLite's own lock."""
    messages: list[str] = []
    station.notice = messages.append
    monkeypatch.setattr("teds_provision.station.store.connection.BUSY_SECONDS", 0.5)
    with closing(sqlite3.connect(station.home / "store.sqlite3", isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreLockedError):
            back_up(station, tmp_path / "b")
        assert messages == ["Waiting up to 0 s for another process that is writing to the store."]
        assert not (tmp_path / "b").exists()
        other.execute("ROLLBACK")
    assert back_up(station, tmp_path / "b").nodes == 2


def test_what_a_change_of_the_vault_made_useless_is_written_over_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """The secrets are those of the vault as it is now, and the head names no path of a module."""
    course, heads = list[str](), list[BackupHead]()
    written, changed = [b"the first try, which is longer", b"whole"], [False, True, False, False]

    def refresh() -> bool:
        course.append("refresh")
        return changed.pop(0)

    def secrets() -> str:
        course.append("secrets")
        return "material"

    def write(file: io.BytesIO, head: BackupHead, rows: object, identity: object, sealer: object) -> bytes:
        course.append(f"{rows} {identity} {sealer}")
        heads.append(head)
        file.write(written.pop(0))
        return b"key"

    monkeypatch.setattr("teds_provision.backup.backup.write", write)
    vault: Any = SimpleNamespace(refresh=refresh, secret_material=secrets, identity=lambda: "identity")
    identity = SimpleNamespace(keystore="pkcs11:token=x?module-path=/x.so")
    station: Any = SimpleNamespace(identity=identity, id="id", point=POINT, name="n", rows=lambda: "rows")
    file, sealer = io.BytesIO(), cast("Any", "sealer")
    assert _write(station, vault, file, sealer) == b"key"
    assert file.getvalue() == b"whole"
    assert course == ["refresh", "secrets", "rows identity sealer", "refresh"] * 2
    assert [(head.keystore, head.material) for head in heads] == [("pkcs11", "material")] * 2
    identity.keystore, changed[:], written[:] = "file", [True, False], [b"once"]
    _write(station, vault, io.BytesIO(), sealer)
    assert (heads[-1].keystore, changed, written) == ("file", [], [])
