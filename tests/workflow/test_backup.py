"""``backup`` and ``restore``: a lost station comes back whole, and nothing in a living one ever goes back."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import subprocess
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.backup import sealed_file as backup_file
from teds_provision.backup.backup import BackedUp, backup
from teds_provision.backup.restore import Restored, complete_vault, merge, open_present, rebuild
from teds_provision.backup.sealed_file import Content, is_for_key, open_with_key, open_with_passphrase
from teds_provision.errors import (
    BadData,
    NotAuthentic,
    NotFound,
    PolicyRefused,
    StoreFailure,
    VaultFailure,
    WrongPassphrase,
)
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.station.station import Station, initialise
from teds_provision.store import Draft, Holder, NodeRecord, Revocation, Store, Tombstone, TrustRecord, WhitelistEntry
from teds_provision.store.snapshot import Relation, load, place, take
from teds_provision.teds.image import Image
from teds_provision.vault import forget_vaults
from teds_provision.vault.passphrase import THROWAWAY
from teds_provision.vault.software import SoftwareVault

from ..vault.softhsm import PIN, loaded, unload
from .bench import PASSPHRASE, make_station

SEALED = "sealed under other words"
ONE, TWO, NEW = (bytes.fromhex(f"8d4d9da65281f700000{n}") for n in (1, 2, 3))
POINT = SoftwareKey.generate().point


def ask(prompt: str, confirm: bool) -> str:
    return SEALED if "backup" in prompt else PASSPHRASE


def add_key(station: Station, uuid: bytes, epoch: int, *, active: bool = True) -> bytes:
    key = bytes([epoch]) * 16
    key_id = epoch.to_bytes(8, "big")
    station.keys.add_pending(uuid, key=key, key_id=key_id, epoch=epoch)
    if active:
        station.keys.promote(uuid, key_id.hex())
    return key


def keys_of(station: Station, uuid: bytes) -> list[tuple[int, str, bytes]]:
    return [(held.record.epoch, held.record.state, held.key) for held in station.keys.unwrapped(uuid)]


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    """A station with two nodes in use, one of them in the middle of a rotation, and one trusted CA."""
    forget_vaults()
    made = make_station(tmp_path / "home")
    for uuid in (ONE, TWO):
        made.pins.put(WhitelistEntry(uuid, assurance="tap"))
        made.nodes.put(NodeRecord(uuid, POINT, state=2, epoch=1, sequence=5, verdict="authentic"))
        add_key(made, uuid, 1)
        made.nodes.keep_datasheet(Image(uuid))
    add_key(made, TWO, 2, active=False)
    made.policy.trust(TrustRecord("owner", "ca", POINT, "ab" * 32))
    made.nodes.keep_draft(Draft(ONE, "{}"))
    made.audit("test", ONE, "ready")
    yield made
    made.close()
    forget_vaults()


def back_up(station: Station, path: Path, recovery: bytes | None = None) -> BackedUp:
    return backup(station, path, ask, recovery=recovery, costs=THROWAWAY)


def opened(path: Path) -> Content:
    return open_with_passphrase(path.read_bytes(), SEALED)


def restored_into(home: Path, content: Content) -> Restored:
    forget_vaults()
    return rebuild(home, content, ask, costs=THROWAWAY)


# -- the file ----------------------------------------------------------------------------------------------------------


def test_the_file_is_private_whole_and_tells_nothing_secret(station: Station, tmp_path: Path) -> None:
    path = tmp_path / "station.backup"
    done = back_up(station, path)
    octets = path.read_bytes()
    assert (done.nodes, done.keys, done.sealed_to, done.warnings) == (2, 3, "passphrase", ())
    assert path.stat().st_mode & 0o777 == 0o600
    assert set(json.loads(octets)) == {"format", "store", "station", "created", "sealed", "sha256"}
    assert station.vault.secret_material().encode() not in octets
    assert ONE not in octets
    assert ONE.hex().encode() not in octets
    assert [left.name for left in tmp_path.iterdir() if left.name.startswith(".")] == []
    assert "material" not in repr(opened(path))


def test_a_wrong_passphrase_and_every_kind_of_damage_are_told_apart(station: Station, tmp_path: Path) -> None:
    path = tmp_path / "station.backup"
    back_up(station, path)
    octets = path.read_bytes()
    with pytest.raises(WrongPassphrase):
        open_with_passphrase(octets, "other words here")
    step = max(1, len(octets) // 400)
    for place_ in range(0, len(octets) - 1, step):
        changed = bytearray(octets)
        changed[place_] ^= 1
        with pytest.raises((NotAuthentic, BadData)):
            open_with_passphrase(bytes(changed), SEALED)
    for length in (0, 1, 70, len(octets) // 2, len(octets) - 2):
        with pytest.raises(BadData):
            open_with_passphrase(octets[:length], SEALED)


def test_who_recomputes_the_digest_still_needs_the_passphrase(station: Station, tmp_path: Path) -> None:
    path = tmp_path / "station.backup"
    back_up(station, path)
    document = json.loads(path.read_bytes())
    document.pop("sha256")
    document["created"] = "2030-01-01T00:00:00Z"
    forged = {**document, "sha256": backup_file._digest(document)}
    with pytest.raises(WrongPassphrase):
        open_with_passphrase(json.dumps(forged).encode(), SEALED)


@pytest.mark.parametrize("octets", [b"", b"{}", b"[]", b"\0" * 1000, b'{"format": "teds-image/1"}', b"{" * 100_000])
def test_what_is_no_backup_is_bad_data(octets: bytes) -> None:
    with pytest.raises(BadData):
        is_for_key(octets)


def test_a_recovery_key_opens_it_and_no_other(station: Station, tmp_path: Path) -> None:
    recovery, path = SoftwareKey.generate(), tmp_path / "station.backup"
    back_up(station, path, recovery.point)
    octets = path.read_bytes()
    assert is_for_key(octets)
    assert open_with_key(octets, recovery).point == station.point
    with pytest.raises(PolicyRefused, match="sealed to the recovery key"):
        open_with_key(octets, SoftwareKey.generate())
    changed = octets.replace(b'"tag":"', b'"tag":"A', 1)[:-2]
    with pytest.raises((NotAuthentic, BadData)):
        open_with_key(changed, recovery)


def test_a_backup_that_another_key_has_signed_is_not_the_stations(station: Station, tmp_path: Path) -> None:
    """Whoever has the public recovery key can seal something; it must not pass for this station."""
    recovery, path, forger = SoftwareKey.generate(), tmp_path / "station.backup", SoftwareKey.generate()
    back_up(station, path, recovery.point)
    real = open_with_key(path.read_bytes(), recovery)
    with pytest.raises(NotAuthentic):
        open_with_key(backup_file.seal_to_key(real, forger, recovery.point), recovery)
    forged = open_with_key(backup_file.seal_to_key(replace(real, point=forger.point), forger, recovery.point), recovery)
    with pytest.raises(PolicyRefused, match=r"the store in .* is of station"):
        open_present(station.home, forged)
    with pytest.raises(NotAuthentic):
        restored_into(tmp_path / "new", forged)
    assert not (tmp_path / "new" / "store.sqlite3").exists()


@pytest.mark.system
def test_the_jose_tool_opens_a_backup_with_the_recovery_key(station: Station, tmp_path: Path) -> None:
    if shutil.which("jose") is None:
        pytest.skip("the Debian package jose is not installed (scripts/install-test-packages)")
    from teds_provision.protocol.handover.jwk import public_jwk
    from teds_provision.protocol.handover.strict_json import encode_base64url

    recovery = SoftwareKey.generate()
    back_up(station, tmp_path / "b", recovery.point)
    jwk = {**public_jwk(recovery.point), "d": encode_base64url(recovery.secret())}
    (tmp_path / "k.jwk").write_text(json.dumps(jwk))
    words = ["jose", "jwe", "dec", "-i", str(tmp_path / "b"), "-k", str(tmp_path / "k.jwk")]
    inner = subprocess.run(words, capture_output=True, check=True, timeout=30).stdout
    assert inner.count(b".") == 2
    assert backup_file._verified(inner.strip()).store == station.id


def test_a_backup_taken_while_the_store_is_written_is_one_moment(station: Station, tmp_path: Path) -> None:
    stop, home = threading.Event(), station.home

    def write() -> None:
        with Store.open(home) as store:
            number = 10
            while not stop.is_set():
                number += 1
                with store.transaction():
                    for uuid in (ONE, TWO):
                        store.put_node(NodeRecord(uuid, POINT, sequence=number))

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for _ in range(20):
            with load(take(station._store)) as copy:
                sequences = {record.sequence for record in copy.nodes()}
                assert len(sequences) == 1
                assert copy.audit.check().intact
    finally:
        stop.set()
        writer.join()


# -- a lost station ----------------------------------------------------------------------------------------------------


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
    with pytest.raises(NotFound):
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


def test_a_store_is_never_put_over_another(station: Station, tmp_path: Path) -> None:
    with load(take(station._store)) as copy, pytest.raises(StoreFailure, match="already"):
        place(copy, station.home)


def test_a_log_left_by_a_lost_store_is_not_replayed_into_the_restored_one(station: Station, tmp_path: Path) -> None:
    path, home = tmp_path / "station.backup", tmp_path / "new"
    back_up(station, path)
    home.mkdir(mode=0o700)
    (home / "store.sqlite3-wal").write_bytes(os.urandom(5000))
    restored_into(home, opened(path))
    with Store.open(home) as store:
        assert store.damage() is None


# -- a living station --------------------------------------------------------------------------------------------------


def test_restoring_the_present_state_is_nothing_to_do(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    count = station.audit_log.check().count
    done = merge(station._store, opened(tmp_path / "b"), dry_run=False)
    assert (done.action, done.relation, done.back) == ("nothing", Relation.OLDER, {})
    assert station.audit_log.check().count == count


def test_an_older_state_brings_back_what_is_missing_and_nothing_goes_back(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    store = station._store
    store.remove_whitelist(ONE)
    store.remove_trust("owner")
    add_key(station, ONE, 2)  # rotated since: the key of epoch 1 is gone
    store.put_node(NodeRecord(ONE, POINT, epoch=2, sequence=9))
    add_key(station, NEW, 1)
    store.put_whitelist(WhitelistEntry(NEW, assurance="tap"))
    store.put_tombstone(Tombstone(TWO, "cd" * 32, "id"))
    station.audit("sign", ONE, "done")
    before = {uuid: keys_of(station, uuid) for uuid in (ONE, TWO, NEW)}
    plan = merge(store, opened(tmp_path / "b"), dry_run=True)
    assert store.whitelisted(ONE) is None
    done = merge(store, opened(tmp_path / "b"), dry_run=False)
    assert done == plan
    assert done.relation is Relation.OLDER
    assert done.back == {"whitelist": 1, "trust in ca owner": 1}
    assert "older keys left out: 1" in done.kept
    assert "nodes whose epoch or sequence is higher now: 1" in done.kept
    assert "nodes moved away since: 1" in done.kept
    known = store.node(ONE)
    assert known is not None
    assert (known.epoch, known.sequence) == (2, 9)
    assert {uuid: keys_of(station, uuid) for uuid in (ONE, TWO, NEW)} == before
    assert store.tombstone(TWO) is not None
    assert store.whitelisted(NEW) is not None
    assert store.audit.check().intact


def test_a_revoked_node_stays_revoked_and_off_the_whitelist(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    station.policy.deny(Revocation(ONE, None, "stolen", "{}"))
    station.pins.remove(ONE)
    station.keys.remove(ONE)
    station.audit("revoke", ONE, "done")
    done = merge(station._store, opened(tmp_path / "b"), dry_run=False)
    assert done.action == "nothing"
    assert station.pins.entry(ONE) is None
    assert station.keys.of(ONE) == []
    assert "revocations made since: 1" in done.kept


def test_keys_given_up_since_are_not_brought_back(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    station.keys.remove(ONE)
    station.audit("decommission", ONE, "done")
    merge(station._store, opened(tmp_path / "b"), dry_run=False)
    assert station.keys.of(ONE) == []


def test_a_node_that_was_pinned_anew_keeps_its_new_key(station: Station, tmp_path: Path) -> None:
    station.pins.put(WhitelistEntry(ONE, "ab" * 32, assurance="tap"))
    back_up(station, tmp_path / "b")
    station.pins.remove(ONE)
    station.pins.let_go(ONE)
    other = SoftwareKey.generate().point
    station.nodes.remember(ONE, point=other)
    station.audit("identify", ONE, "proven")
    done = merge(station._store, opened(tmp_path / "b"), dry_run=False)
    known = station.nodes.get(ONE)
    assert known is not None
    assert known.point == other
    assert station.pins.entry(ONE) is None
    assert "whitelist entries pinned to another key now: 1" in done.kept


def test_a_newer_state_brings_a_rolled_back_store_forward(station: Station, tmp_path: Path) -> None:
    home, stale = station.home, tmp_path / "stale"
    with load(take(station._store)) as copy:
        stale.mkdir(mode=0o700)
        place(copy, stale)
    shutil.copy(home / "vault.json", stale / "vault.json")
    new_key = add_key(station, ONE, 2)
    station.nodes.put(NodeRecord(ONE, POINT, epoch=2, sequence=9, verdict="authentic"))
    station.policy.give_away(Tombstone(TWO, "cd" * 32, "id"))
    station.keys.put_holder(Holder(ONE, "cd" * 32))
    station.audit("sign", ONE, "done")
    back_up(station, tmp_path / "b")
    old = Station.open(stale, ask=ask)
    done = merge(old._store, opened(tmp_path / "b"), dry_run=False)
    assert done.relation is Relation.NEWER
    known = old.nodes.get(ONE)
    assert known is not None
    assert (known.epoch, known.sequence) == (2, 9)
    assert next(key for _, _, key in keys_of(old, ONE)) == new_key
    assert [state for _, state, _ in keys_of(old, ONE)] == ["pending", "active"]  # an Open decides
    assert old.policy.tombstone(TWO) is not None
    assert old.keys.holders(ONE)[0].fingerprint == "cd" * 32
    assert old.audit_log.check().intact
    assert [entry.act for entry in old.audit_log.entries()][-2:] == ["sign", "restore"]
    assert merge(old._store, opened(tmp_path / "b"), dry_run=False).action == "nothing"
    old.close()


def test_states_that_went_different_ways_keep_both_sides_newest(station: Station, tmp_path: Path) -> None:
    stale = tmp_path / "stale"
    with load(take(station._store)) as copy:
        stale.mkdir(mode=0o700)
        place(copy, stale)
    shutil.copy(station.home / "vault.json", stale / "vault.json")
    add_key(station, ONE, 4)
    station.audit("agree", ONE, "done")
    back_up(station, tmp_path / "b")
    other = Station.open(stale, ask=ask)
    add_key(other, TWO, 7)
    other.audit("agree", TWO, "done")
    done = merge(other._store, opened(tmp_path / "b"), dry_run=False)
    assert done.relation is Relation.DIVERGED
    assert {epoch for epoch, _, _ in keys_of(other, ONE)} == {1, 4}
    assert {epoch for epoch, _, _ in keys_of(other, TWO)} == {7}
    assert other.audit_log.check().intact
    other.close()


def test_the_backup_of_another_station_is_refused(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    other = make_station(tmp_path / "other")
    with pytest.raises(PolicyRefused, match=r"the store in .* is of station") as caught:
        open_present(tmp_path / "other", opened(tmp_path / "b"))
    assert caught.value.exit_code == 6
    other.close()


def software(station: Station) -> SoftwareVault:
    assert isinstance(station.vault, SoftwareVault)
    return station.vault


def test_master_keys_of_the_backup_join_those_of_the_vault(station: Station, tmp_path: Path) -> None:
    """The master key was changed since: keys from before and after have to open."""
    back_up(station, tmp_path / "b")
    software(station).add_master()
    software(station).retire_masters()
    software(station).drop_ca()
    forget_vaults()
    vault = complete_vault(station._store, opened(tmp_path / "b"), ask)
    assert isinstance(vault, SoftwareVault)
    assert len(vault._material.masters.keys) == 2
    assert vault.ca() is None  # it was taken out since, and stays out


def test_a_vault_that_lacks_nothing_is_left_as_it_is(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    software(station).drop_ca()
    before = (station.home / "vault.json").read_bytes()
    forget_vaults()
    assert complete_vault(station._store, opened(tmp_path / "b"), ask).ca() is None
    assert (station.home / "vault.json").read_bytes() == before


def test_a_lost_vault_comes_back_beside_its_store(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    (station.home / "vault.json").unlink()
    forget_vaults()
    assert complete_vault(station._store, opened(tmp_path / "b"), ask).identity().point == station.point
    again = Station.open(station.home, ask=ask)
    assert keys_of(again, ONE)[0][0] == 1
    again.close()


def test_marks_on_nodes_do_not_go_back_and_come_forward(station: Station, tmp_path: Path) -> None:
    """For example that a rotation is due: an older backup that does not know it must not lift it."""
    station._store.set_setting("mark", "before")
    back_up(station, tmp_path / "old")
    station._store.set_setting("mark", "due")
    station._store.set_setting("other", "due")
    station.audit("test", ONE, "marked")
    merge(station._store, opened(tmp_path / "old"), dry_run=False)
    assert station._store.setting("mark") == "due"
    back_up(station, tmp_path / "new")
    stale = tmp_path / "stale"
    with load(opened(tmp_path / "old").database) as copy:
        stale.mkdir(mode=0o700)
        place(copy, stale)
    with Store.open(stale) as store:
        done = merge(store, opened(tmp_path / "new"), dry_run=False)
        assert done.relation is Relation.NEWER
        assert (store.setting("mark"), store.setting("other")) == ("due", "due")


def test_a_key_that_the_vault_does_not_open_is_told_when_backing_up(station: Station, tmp_path: Path) -> None:
    with closing(sqlite3.connect(station.home / "store.sqlite3")) as connection, connection:
        connection.execute("UPDATE keys SET wrapped = zeroblob(60) WHERE uuid = ? AND epoch = 1", (ONE,))
    assert "1 keys in the store do not open" in back_up(station, tmp_path / "b").warnings[0]


@pytest.mark.system
def test_a_token_keeps_its_keys_and_opens_the_restored_station(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    forget_vaults()
    uri = loaded(tmp_path, monkeypatch, ("bench",))["bench"]

    def pin(prompt: str, confirm: bool) -> str:
        return SEALED if "backup" in prompt else PIN

    try:
        station, _ = initialise(tmp_path / "home", name="bench", keystore=uri, ask=pin)
        key = add_key(station, ONE, 1)
        done = backup(station, tmp_path / "b", pin, costs=THROWAWAY)
        assert "cannot leave the token" in done.warnings[0]
        content = opened(tmp_path / "b")
        with pytest.raises(PolicyRefused, match="in a token"):
            rebuild(tmp_path / "file", content, pin, keystore="file", costs=THROWAWAY)
        forget_vaults()
        assert rebuild(tmp_path / "new", content, pin).keystore == uri
        again = Station.open(tmp_path / "new", ask=pin)
        assert keys_of(again, ONE) == [(1, "active", key)]
        again.close()
        station.close()
    finally:
        forget_vaults()
        unload()


def test_a_passphrase_that_is_none_is_refused_before_anything_is_written(station: Station, tmp_path: Path) -> None:
    with pytest.raises(VaultFailure, match="too short"):
        backup(station, tmp_path / "b", lambda prompt, confirm: "short", costs=THROWAWAY)
    assert not (tmp_path / "b").exists()
