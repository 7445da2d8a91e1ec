"""What a backup says of itself is held against its content, and where its keys may be kept is decided here.

Whoever has the public recovery key can seal something, and a station whose key was stolen can sign it.
"""

from __future__ import annotations

import stat
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from teds_provision.backup import sealed_file
from teds_provision.backup.content import BackupHead, Content
from teds_provision.backup.restore import complete_vault, keystore_for, merge, merge_checked, open_present, rebuild
from teds_provision.backup.sealed_file import SealedFile, Sealer
from teds_provision.errors import (
    BadDataError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    StoreChangedError,
    StoreError,
    TedsProvisionError,
    UsageError,
)
from teds_provision.protocol.handover.strict_json import dump
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.station.plant.plant import HOME_FILE, PlantRecord
from teds_provision.station.snapshot import place, set_aside
from teds_provision.station.station import Station
from teds_provision.vault.master import Material
from teds_provision.vault.passphrase import THROWAWAY
from teds_provision.vault.selection import forget_vaults
from tests.backup.backups import NEW, ONE, TWO, add_key, ask, back_up, copy_of, restored_into

URI = "pkcs11:token=bench?module-path=/usr/lib/softhsm.so"
RECOVERY = SoftwareKey.generate()


def sealed_again(station: Station, content: Content, head: BackupHead, path: Path) -> SealedFile:
    """Return a backup of the content of another one, with this head, signed by the station's key."""
    with path.open("wb") as file:
        sealed_file.write(file, head, content.copy.rows(), station.vault.identity(), Sealer(recovery=RECOVERY.point))
    return SealedFile(path)


@pytest.mark.parametrize(
    ("was", "asked", "kept_in"),
    [
        ("keyring", None, None),
        ("keyring", "keyring", "keyring"),
        ("keyring", "file", "file"),
        ("keyring", URI, PolicyError),
        ("file", None, "file"),
        ("file", "keyring", "keyring"),
        ("file", "file", "file"),
        ("file", URI, PolicyError),
        ("file", "paper", UsageError),
        ("file", "pkcs11", UsageError),
        ("paper", None, UsageError),
        ("pkcs11", None, UsageError),
        ("pkcs11", "file", PolicyError),
        ("pkcs11", "keyring", PolicyError),
        ("pkcs11", URI, URI),
        (URI, None, UsageError),
        (URI, URI, URI),
    ],
)
def test_where_the_keys_of_a_restored_station_are_kept(was: str, asked: str | None, kept_in: Any) -> None:
    """As before where that works on any machine; never by a module that only the backup names."""
    content: Any = BackupHead("ab" * 16, RECOVERY.point, "north", "2026-01-31T12:00:00Z", was, "")
    if isinstance(kept_in, type):
        with pytest.raises(kept_in):
            keystore_for(content, asked)
    else:
        assert keystore_for(content, asked) == kept_in


@dataclass(frozen=True)
class _TwoHeads(BackupHead):
    """A head that says one thing in the clear and another inside."""

    inside: Callable[[dict[str, Any]], dict[str, Any]] = dict

    def line(self, form: str) -> bytes:
        members = {
            name: getattr(self, name) for name in ("store", "station", "name", "created", "keystore", "material")
        }
        return dump(self.inside({"format": form, **members, "point": self.point.hex()})) + b"\n"


ANOTHER = SoftwareKey.generate().point
OTHER_STATION = (NotAuthenticError, "names a different station than its content")
OTHER_VERSION = (BadDataError, "from another version")


@pytest.mark.parametrize(
    ("inside", "error"),
    [
        ({}, None),
        ({"store": "0" * 32}, OTHER_STATION),
        ({"point": ANOTHER.hex()}, OTHER_STATION),
        ({"created": "2030-01-01T00:00:00Z"}, OTHER_STATION),
        ({"point": "04" * 65}, (BadDataError, "no valid station key")),
        ({"point": "no digits"}, (BadDataError, "no valid station key")),
        ({"format": "teds-backup/3"}, OTHER_VERSION),
        ({"material": None}, OTHER_VERSION),
        ({"keystore": 5}, OTHER_VERSION),
        ({"name": None}, OTHER_VERSION),
    ],
)
def test_what_the_head_inside_has_to_say(
    station: Station, tmp_path: Path, inside: dict[str, Any], error: tuple[type[TedsProvisionError], str] | None
) -> None:
    with copy_of(station, tmp_path) as real:
        facts = {name: getattr(real, name) for name in ("store", "point", "name", "created", "keystore", "material")}
        head = _TwoHeads(**facts, inside=lambda members: {**members, **inside})
        sealed = sealed_again(station, real, head, tmp_path / "b")
    if error is None:
        sealed.open_with_key(RECOVERY).close()
        return
    with pytest.raises(error[0], match=error[1]):
        sealed.open_with_key(RECOVERY)


def test_a_signed_backup_of_another_store_or_other_keys_is_not_restored(station: Station, tmp_path: Path) -> None:
    with copy_of(station, tmp_path) as real:
        other_store = sealed_again(station, real, replace(_head(real), store="0" * 32), tmp_path / "store")
        other_keys = sealed_again(
            station, real, replace(_head(real), material=Material.generate().encode()), tmp_path / "k"
        )
    with other_store.open_with_key(RECOVERY) as content:
        with pytest.raises(NotAuthenticError, match="not that of the station that signed it"):
            restored_into(tmp_path / "new", content)
        with pytest.raises(NotAuthenticError, match="not that of the station that signed it"):
            merge(station, content, dry_run=True)
        with pytest.raises(PolicyError, match=r"the store in .* is of station"):
            open_present(station.home, content)
    assert not (tmp_path / "new").exists()
    with (
        other_keys.open_with_key(RECOVERY) as content,
        pytest.raises(NotAuthenticError, match="keys in the backup are not those of the station that signed it"),
    ):
        restored_into(tmp_path / "new", content)
    assert not (tmp_path / "new" / "store.sqlite3").exists()


def _head(content: Content) -> BackupHead:
    return BackupHead(content.store, content.point, content.name, content.created, content.keystore, content.material)


def test_the_digest_of_the_head_is_checked_before_the_recovery_key_is_used(station: Station, tmp_path: Path) -> None:
    """A damaged file is reported as such, not as one that was sealed to another key."""
    back_up(station, tmp_path / "b", RECOVERY.point)
    octets = (tmp_path / "b").read_bytes()
    (tmp_path / "b").write_bytes(octets.replace(b'"created":"2', b'"created":"3', 1))
    with pytest.raises(NotAuthenticError, match="its digest does not match"):
        SealedFile(tmp_path / "b").open_with_key(SoftwareKey.generate())


def test_the_files_own_key_has_32_octets(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    for length in (16, 31, 33):
        with pytest.raises(BadDataError, match="another length than 32 octets"):
            SealedFile(tmp_path / "b").open_with_content_key(bytes(length))


def test_a_key_without_proof_is_to_be_rotated_after_a_restore_too(station: Station, tmp_path: Path) -> None:
    add_key(station, NEW, 1, active=False)
    with copy_of(station, tmp_path) as content:
        assert restored_into(tmp_path / "new", content).rotations_due == 3
    with Station.inspect(tmp_path / "new") as again:
        assert all(again.keys.restored(uuid) for uuid in (ONE, TWO, NEW))
        entry = list(again.audit_log.entries())[-1]
    assert (entry.act, entry.outcome, entry.detail) == (
        "restore",
        "rebuilt",
        {"created": content.created, "keystore": "file", "rotations_due": 3},
    )
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == 0o700


@pytest.mark.parametrize("in_plant", [False, True])
def test_a_home_is_a_new_one_to_its_plant_if_it_has_one(station: Station, tmp_path: Path, in_plant: bool) -> None:
    if in_plant:
        station.plant.put_record(PlantRecord("11111111-2222-4333-8444-555555555555"))
    restored_into(tmp_path / "new", copy_of(station, tmp_path))
    assert (tmp_path / "new" / HOME_FILE).exists() is in_plant


def test_a_rebuilt_station_names_the_keystore_of_this_machine(station: Station, tmp_path: Path) -> None:
    with copy_of(station, tmp_path) as real:
        content = replace(real, keystore="keyring")
        forget_vaults()
        done = rebuild(tmp_path / "new", content, ask, keystore="file", costs=THROWAWAY)
    assert done.keystore == "file"
    with Station.inspect(tmp_path / "new") as again:
        assert (again.identity.keystore, again.identity.keystore_why) == ("file", "as requested")


def test_a_living_station_keeps_its_keystore_whatever_the_backup_had(station: Station, tmp_path: Path) -> None:
    with copy_of(station, tmp_path) as content:
        for was in ("keyring", "pkcs11"):
            forget_vaults()
            assert complete_vault(station, replace(content, keystore=was), ask).kind == "file"


def test_into_a_store_whose_own_key_was_changed_nothing_is_merged(station: Station, tmp_path: Path) -> None:
    with copy_of(station, tmp_path) as content:
        station.pins.remove(ONE)
        facts = station.identity.record()
        assert facts is not None
        station.identity.put(replace(facts, ca=ANOTHER))
        forget_vaults()
        with Station.inspect(station.home, ask=ask) as again, pytest.raises(StoreChangedError, match="own key or CA"):
            merge_checked(again, content, complete_vault(again, content, ask), ask)
    assert station.pins.row(ONE) is None


def test_a_backup_is_made_although_the_log_takes_no_entry(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that is full is a reason to make one."""

    def full(*_: object, **__: object) -> None:
        raise StoreError("The store cannot be used: there is no space left on the disk.")

    monkeypatch.setattr(Station, "audit", full)
    done = back_up(station, tmp_path / "b")
    assert done.warnings == (
        "The audit log has no entry of this backup: The store cannot be used: there is no space left on the disk.",
    )
    assert (tmp_path / "b").stat().st_size == done.octets


def test_the_entry_of_a_backup_names_its_file_by_digest(station: Station, tmp_path: Path) -> None:
    done = back_up(station, tmp_path / "b", RECOVERY.point)
    entry = list(station.audit_log.entries())[-1]
    assert (entry.act, entry.uuid, entry.outcome) == ("backup", None, "done")
    assert entry.detail == {"sha256": done.sha256, "to": done.sealed_to, "nodes": 2, "keys": 3}
    assert (done.nodes, done.keys, len(done.sha256), len(done.sealed_to)) == (2, 3, 64, 64)


def test_a_merge_writes_its_entry_once_and_a_plan_none(station: Station, tmp_path: Path) -> None:
    with copy_of(station, tmp_path) as content:
        station.pins.remove(ONE)
        before = station.audit_log.newest()[0]
        merge(station, content, dry_run=True)
        assert station.audit_log.newest()[0] == before
        merge(station, content, dry_run=False)
        merge(station, content, dry_run=False)
    (entry,) = station.audit_log.entries(before)
    assert (entry.act, entry.outcome) == ("restore", "merged")
    assert entry.detail == {"created": content.created, "relation": "older", "back": {"whitelist": 1}}


def test_a_store_takes_the_place_of_no_store_and_leaves_no_log_of_the_one_before(
    station: Station, tmp_path: Path
) -> None:
    home = tmp_path / "new"
    home.mkdir()
    for end in ("-wal", "-shm"):
        (home / f"store.sqlite3{end}").write_bytes(b"of a lost store")
    with copy_of(station, tmp_path) as content:
        place(content.copy, home)
        assert sorted(path.name for path in home.iterdir()) == ["store.sqlite3"]
        with pytest.raises(StoreError, match="There is a store in"):
            place(content.copy, home)
    for end in ("-wal", "-shm"):
        (home / f"store.sqlite3{end}").write_bytes(b"log")
    aside = set_aside(home)
    assert sorted(path.name for path in home.iterdir()) == [aside.name, f"{aside.name}-shm", f"{aside.name}-wal"]
    assert aside.name.startswith("store.sqlite3.damaged-")


def test_a_file_beyond_the_bound_is_not_opened(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    back_up(station, tmp_path / "b")
    size = (tmp_path / "b").stat().st_size
    monkeypatch.setattr(sealed_file, "MAX_OCTETS", size)
    SealedFile(tmp_path / "b")
    monkeypatch.setattr(sealed_file, "MAX_OCTETS", size - 1)
    with pytest.raises(BadDataError, match="larger than"):
        SealedFile(tmp_path / "b")


HEAD = b'{"format":"teds-backup/2"'
OTHER, TORN = "not a backup of this version of teds-provision", "truncated in its header, or damaged"


@pytest.mark.parametrize(
    ("octets", "why"),
    [
        (HEAD + b',"key":{"protected":"x"}}\n', ""),
        (HEAD + b',"key":{"kdf":"x"}}\n', ""),
        (b"", "This is not a backup."),  # with its full stop
        (b"a letter\n", "This is not a backup."),
        (b'{"format":"teds-backup/3"}\n', OTHER),
        (b" " + HEAD + b',"key":{"kdf":"x"}}\n', OTHER),
        (HEAD + b',"key":{"kdf":"x"}}', TORN),
        (HEAD + b',"key":[]}\n', TORN),
        (HEAD + b"}\n", TORN),
    ],
)
def test_what_the_first_line_of_a_backup_has_to_be(tmp_path: Path, octets: bytes, why: str) -> None:
    (tmp_path / "b").write_bytes(octets)
    if why:
        with pytest.raises(BadDataError) as refused:
            SealedFile(tmp_path / "b")
        assert why in refused.value.message
        return
    file = SealedFile(tmp_path / "b")
    assert (file.octets, file.is_for_key) == (len(octets), b"protected" in octets)
    with pytest.raises(NotFoundError, match=r"cannot be read: No such file or directory\.$"):
        SealedFile(tmp_path / "none")
