"""A lost station comes back whole from its backup, and never over another one."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.backup.restore import open_present, open_vault_of
from teds_provision.errors import NewerStoreError, NotFoundError, StoreError, VaultChangedError, WrongPassphraseError
from teds_provision.station.snapshot import place, set_aside
from teds_provision.station.station import Station
from teds_provision.station.store.store import Store
from teds_provision.vault.selection import forget_vaults
from tests.backup.backups import ONE, POINT, TWO, ask, back_up, copy_of, keys_of, opened, restored_into


def test_an_empty_home_becomes_the_station_again(station: Station, tmp_path: Path) -> None:
    path, home = tmp_path / "station.backup", tmp_path / "new" / "home"
    back_up(station, path)
    before = {uuid: keys_of(station, uuid) for uuid in (ONE, TWO)}
    done = restored_into(home, opened(path))
    assert (done.action, done.keystore) == ("rebuilt", "file")
    assert done.back["keys"] == 3
    assert (home / "store.sqlite3").stat().st_mode & 0o777 == 0o600
    assert home.stat().st_mode & 0o777 == 0o700
    forget_vaults()
    again = Station.open(home, ask=ask)
    assert (again.fingerprint, again.ca, again.id) == (station.fingerprint, station.ca, station.id)
    assert {uuid: keys_of(again, uuid) for uuid in (ONE, TWO)} == before
    assert again.identity.certify(POINT) == station.identity.certify(POINT)
    assert again.audit_log.check().intact
    again.close()


def test_killed_between_vault_and_store_the_same_command_carries_on(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, home = tmp_path / "station.backup", tmp_path / "new"
    back_up(station, path)
    with monkeypatch.context() as patch:
        patch.setattr("teds_provision.backup.restore.place", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            restored_into(home, opened(path))
    with pytest.raises(NotFoundError):
        Station.open(home, ask=ask)
    restored_into(home, opened(path))
    again = Station.open(home, ask=ask)
    assert len(keys_of(again, TWO)) == 2
    again.close()


def test_a_damaged_store_is_kept_under_another_name(station: Station, tmp_path: Path) -> None:
    path, home = tmp_path / "station.backup", station.home
    back_up(station, path)
    station.close()
    (home / "store.sqlite3").write_bytes(b"\0" * 8192)
    for end in ("-wal", "-shm"):
        (home / f"store.sqlite3{end}").unlink(missing_ok=True)
    content = opened(path)
    assert open_present(home, content) is None
    done = restored_into(home, content)
    assert done.set_aside is not None
    assert done.set_aside.read_bytes() == b"\0" * 8192
    again = Station.open(home, ask=ask)
    assert keys_of(again, ONE)[0][0] == 1
    again.close()


@pytest.mark.parametrize("left", [None, "2026-11-01T00:00:00Z"], ids=["member", "left"])
def test_a_rebuilt_home_of_a_plant_has_another_name_and_looks_for_its_pages_first(
    station: Station, tmp_path: Path, left: str | None
) -> None:
    """Also after it left: it may take part again, and its pages since the backup are in the registry."""
    registry, home = "0b7a6c3e-5a0c-4f59-9d0b-3a1c2e4f5a6b", station.home
    station.plant.join(registry, None)
    joined = station.plant.record()
    assert joined is not None
    station.plant.put_record(replace(joined, left=left))
    name = station.plant.home
    back_up(station, tmp_path / "station.backup")
    station.close()
    (home / "store.sqlite3").unlink()
    restored_into(home, opened(tmp_path / "station.backup"))
    again = Station.open(home, ask=ask)
    assert again.plant.home != name, "another copy of this home may write under the old name"
    again.plant.join(registry, None)
    assert again.plant.restored
    again.close()


@pytest.mark.parametrize("step", [1, 2, 3])
def test_a_damaged_store_keeps_its_name_until_its_log_is_set_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """A store that was renamed before its log is no store any more: the repeated command would leave the log there."""
    ends = ("", "-wal", "-shm")
    for end in ends:
        (tmp_path / f"store.sqlite3{end}").write_bytes(b"damaged" + end.encode())
    renames, rename = [0], Path.rename

    def dying(path: Path, target: Path) -> Path:
        renames[0] += 1
        if renames[0] == step:
            raise KeyboardInterrupt
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", dying)
        with pytest.raises(KeyboardInterrupt):
            set_aside(tmp_path)
    assert (tmp_path / "store.sqlite3").exists()
    assert set_aside(tmp_path).read_bytes() == b"damaged"
    kept = {path.read_bytes() for path in tmp_path.glob("store.sqlite3.damaged-*")}
    assert kept == {b"damaged" + end.encode() for end in ends}
    assert not any((tmp_path / f"store.sqlite3{end}").exists() for end in ends)


def test_a_store_is_never_put_over_another(station: Station, tmp_path: Path) -> None:
    with copy_of(station, tmp_path) as content, pytest.raises(StoreError, match="already"):
        place(content.copy, station.home)


def test_a_log_left_by_a_lost_store_is_not_replayed_into_the_restored_one(station: Station, tmp_path: Path) -> None:
    path, home = tmp_path / "station.backup", tmp_path / "new"
    back_up(station, path)
    home.mkdir(mode=0o700)
    (home / "store.sqlite3-wal").write_bytes(os.urandom(5000))
    restored_into(home, opened(path))
    with Store.open(home) as store:
        assert store.damage() is None


def test_a_home_that_cannot_be_made_is_named(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    (tmp_path / "taken").write_text("a file")
    with opened(tmp_path / "b") as content, pytest.raises(StoreError) as refused:
        restored_into(tmp_path / "taken" / "home", content)
    assert refused.value.message == f"{tmp_path / 'taken' / 'home'} cannot be made: Not a directory."
    assert refused.value.hint == "Choose another --home."


def test_a_store_that_is_no_use_for_another_reason_than_damage_is_not_replaced(
    station: Station, tmp_path: Path
) -> None:
    """One of a newer version holds more than the backup: it is neither moved away nor merged into."""
    with copy_of(station, tmp_path) as content:
        station._store.execute("PRAGMA user_version = 999")
        with pytest.raises(NewerStoreError):
            open_present(station.home, content)
    assert [path.name for path in station.home.iterdir() if "damaged" in path.name] == []


def test_a_store_whose_rows_are_damaged_counts_as_lost(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with copy_of(station, tmp_path) as content:
        present = open_present(station.home, content)
        assert present is not None
        present.close()
        monkeypatch.setattr(Station, "damage", lambda _station: "row 7 is missing from an index")
        assert open_present(station.home, content) is None


def test_a_station_that_another_command_made_meanwhile_is_not_replaced(station: Station, tmp_path: Path) -> None:
    """While a person typed the passphrase, another restore had come to its end."""
    back_up(station, tmp_path / "b")
    home = tmp_path / "new"
    restored_into(home, opened(tmp_path / "b"))
    with Station.inspect(home) as made:
        before = b"".join(made.rows())
    with opened(tmp_path / "b") as content, pytest.raises(VaultChangedError) as refused:
        restored_into(home, content)
    assert refused.value.message == (
        f"Another command has created the station in {home} in the meantime; this one changed nothing."
    )
    assert refused.value.hint == "Run it again: it restores what is missing."
    with Station.inspect(home) as made:
        assert b"".join(made.rows()) == before


def test_before_any_lock_a_lost_vault_is_no_error_and_a_wrong_passphrase_is(station: Station) -> None:
    forget_vaults()
    with pytest.raises(WrongPassphraseError):
        open_vault_of(station, lambda _prompt, _confirm: "not that passphrase")
    open_vault_of(station, ask)
    (station.home / "vault.json").unlink()
    forget_vaults()
    open_vault_of(station, lambda _prompt, _confirm: pytest.fail("there is nothing to ask for"))
