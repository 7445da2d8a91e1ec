"""``backup`` and ``restore``: a lost station comes back whole, and nothing in a living one ever goes back."""

from __future__ import annotations

import io
import json
import os
import shutil
import sqlite3
import subprocess
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.backup import sealed_file as backup_file
from teds_provision.backup.backup import BackedUp, backup
from teds_provision.backup.chunks import CHUNK_OCTETS, ChunkReader, ChunkWriter
from teds_provision.backup.content import Content, Head
from teds_provision.backup.restore import Restored, complete_vault, merge, merge_sealed, open_present, rebuild
from teds_provision.backup.sealed_file import SealedFile, Sealer
from teds_provision.errors import (
    BadData,
    NotAuthentic,
    NotFound,
    PolicyRefused,
    StoreFailure,
    StoreLocked,
    UsageFailure,
    VaultFailure,
    WrongPassphrase,
)
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.station.station import Station, initialise
from teds_provision.store import (
    Draft,
    Holder,
    NodeRecord,
    Revocation,
    Store,
    StoreLock,
    Tombstone,
    TrustRecord,
    WhitelistEntry,
)
from teds_provision.store import dump as rows
from teds_provision.store.schema import SCHEMA_VERSION
from teds_provision.store.snapshot import Relation, place
from teds_provision.teds.image import Image
from teds_provision.vault import forget_vaults
from teds_provision.vault.passphrase import THROWAWAY
from teds_provision.vault.software import SoftwareVault

from ..bench import PASSPHRASE, make_station
from ..vault.softhsm import PIN, loaded, unload

FIXTURES = Path(__file__).parent / "fixtures"
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
    made.nodes.keep_draft(Draft(ONE, Image(ONE)))
    made.audit("test", ONE, "ready")
    yield made
    made.close()
    forget_vaults()


def back_up(station: Station, path: Path, recovery: bytes | None = None) -> BackedUp:
    return backup(station, path, ask, recovery=recovery, costs=THROWAWAY)


def opened(path: Path) -> Content:
    return SealedFile(path).open_with_passphrase(SEALED)


def opened_octets(folder: Path, octets: bytes, passphrase: str = SEALED) -> Content:
    (folder / "octets").write_bytes(octets)
    return SealedFile(folder / "octets").open_with_passphrase(passphrase)


def copy_of(station: Station, folder: Path) -> Content:
    """The station as it is now, as a backup that was opened."""
    back_up(station, folder / "copy.backup")
    return opened(folder / "copy.backup")


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
    head = json.loads(octets.split(b"\n", 1)[0])
    assert set(head) == {"format", "store", "station", "created", "key", "sha256"}
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
        opened_octets(tmp_path, octets, "other words here")
    step = max(1, len(octets) // 150)
    for place_ in range(0, len(octets) - 1, step):
        changed = bytearray(octets)
        changed[place_] ^= 1
        with pytest.raises((NotAuthentic, BadData)):
            opened_octets(tmp_path, bytes(changed))
    with pytest.raises((BadData, NotAuthentic)):
        opened_octets(tmp_path, octets + b"more")
    for length in (0, 1, 70, len(octets) // 2, len(octets) - 2):
        with pytest.raises(BadData):
            opened_octets(tmp_path, octets[:length])


def test_who_recomputes_the_digest_still_needs_the_passphrase(station: Station, tmp_path: Path) -> None:
    path = tmp_path / "station.backup"
    back_up(station, path)
    line, chunks = path.read_bytes().split(b"\n", 1)
    document = json.loads(line)
    document.pop("sha256")
    document["created"] = "2030-01-01T00:00:00Z"
    forged = backup_file.dump({**document, "sha256": backup_file.digest_of(document)})
    with pytest.raises(WrongPassphrase):
        opened_octets(tmp_path, forged + b"\n" + chunks)


@pytest.mark.parametrize("octets", [b"", b"{}", b"[]", b"\0" * 1000, b'{"format": "teds-image/1"}', b"{" * 100_000])
def test_what_is_no_backup_is_bad_data(tmp_path: Path, octets: bytes) -> None:
    (tmp_path / "b").write_bytes(octets)
    with pytest.raises(BadData):
        SealedFile(tmp_path / "b")


def test_a_recovery_key_opens_it_and_no_other(station: Station, tmp_path: Path) -> None:
    recovery, path = SoftwareKey.generate(), tmp_path / "station.backup"
    back_up(station, path, recovery.point)
    sealed = SealedFile(path)
    assert sealed.is_for_key
    with sealed.open_with_key(recovery) as content:
        assert content.point == station.point
    with pytest.raises(PolicyRefused, match="sealed to the recovery key"):
        sealed.open_with_key(SoftwareKey.generate())
    path.write_bytes(path.read_bytes().replace(b'"tag":"', b'"tag":"A', 1))
    with pytest.raises((NotAuthentic, BadData)):
        SealedFile(path).open_with_key(recovery)


def test_a_backup_that_another_key_has_signed_is_not_the_stations(station: Station, tmp_path: Path) -> None:
    """Whoever has the public recovery key can seal something; it must not pass for this station."""
    recovery, path, forger = SoftwareKey.generate(), tmp_path / "station.backup", SoftwareKey.generate()
    back_up(station, path, recovery.point)
    sealer = Sealer(recovery=recovery.point)
    with SealedFile(path).open_with_key(recovery) as real, path.open("wb") as file:
        backup_file.write(file, real, rows.dump(real.copy), forger, sealer)
    with pytest.raises(NotAuthentic, match="not signed"):
        SealedFile(path).open_with_key(recovery)
    with copy_of(station, tmp_path) as real, path.open("wb") as file:
        backup_file.write(file, replace(real, point=forger.point), rows.dump(real.copy), forger, sealer)
    forged = SealedFile(path).open_with_key(recovery)
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
    line = (tmp_path / "b").read_bytes().split(b"\n", 1)[0]
    (tmp_path / "key.jwe").write_text(json.dumps(json.loads(line)["key"]))
    words = ["jose", "jwe", "dec", "-i", str(tmp_path / "key.jwe"), "-k", str(tmp_path / "k.jwk")]
    own = subprocess.run(words, capture_output=True, check=True, timeout=30).stdout
    with SealedFile(tmp_path / "b").open_with_content_key(own) as content:
        assert content.store == station.id


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
                stop.wait(0.002)  # SQLite's writers wait their turn without a queue

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for _ in range(20):
            with copy_of(station, tmp_path) as content:
                sequences = {record.sequence for record in content.copy.nodes()}
                assert len(sequences) == 1
                assert content.copy.audit.check().intact
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
    with copy_of(station, tmp_path) as content, pytest.raises(StoreFailure, match="already"):
        place(content.copy, station.home)


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
    with copy_of(station, tmp_path) as content:
        stale.mkdir(mode=0o700)
        place(content.copy, stale)
    shutil.copy(home / "vault.json", stale / "vault.json")
    new_key = add_key(station, ONE, 2)
    station.nodes.put(NodeRecord(ONE, POINT, epoch=2, sequence=9, verdict="authentic"))
    station._store.put_tombstone(Tombstone(TWO, "cd" * 32, "id"))
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
    with copy_of(station, tmp_path) as content:
        stale.mkdir(mode=0o700)
        place(content.copy, stale)
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
    station.keys.demand_rotation(ONE, "before")
    back_up(station, tmp_path / "old")
    station.keys.demand_rotation(ONE, "due")
    station.keys.demand_rotation(TWO, "due")
    station.audit("test", ONE, "marked")
    merge(station._store, opened(tmp_path / "old"), dry_run=False)
    assert station.keys.rotation_due(ONE) == "due"
    back_up(station, tmp_path / "new")
    stale = tmp_path / "stale"
    with opened(tmp_path / "old") as content:
        stale.mkdir(mode=0o700)
        place(content.copy, stale)
    with Store.open(stale) as store:
        done = merge(store, opened(tmp_path / "new"), dry_run=False)
        assert done.relation is Relation.NEWER
        assert (store.marks(ONE).rotation, store.marks(TWO).rotation) == ("due", "due")


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
        with pytest.raises(UsageFailure, match="which module"):
            rebuild(tmp_path / "new", content, pin)
        assert rebuild(tmp_path / "new", content, pin, keystore=uri).keystore == uri
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


# -- many chunks, other versions, hostile rows -------------------------------------------------------------------------


def test_a_store_of_several_chunks_goes_out_and_comes_back(station: Station, tmp_path: Path) -> None:
    filler = {(0, 1): os.urandom(100_000)}
    with station.transaction():
        for number in range(40):
            station._store.put_draft(Draft(uuid := number.to_bytes(10, "big"), Image(uuid, filler)))
    done = back_up(station, tmp_path / "b")
    assert done.octets > 3 * CHUNK_OCTETS
    octets = (tmp_path / "b").read_bytes()
    with opened(tmp_path / "b") as content:
        assert list(rows.dump(content.copy))[1:] != []
        draft = content.copy.draft((39).to_bytes(10, "big"))
        assert draft is not None
        assert draft.image.blocks == filler
    head = octets.index(b"\n") + 1
    full = CHUNK_OCTETS + 16
    first, second = octets[head : head + full], octets[head + full : head + 2 * full]
    assert len(first) == len(second) == full
    swapped = octets[:head] + second + first + octets[head + 2 * full :]
    dropped = octets[:head] + first + octets[head + 2 * full :]
    doubled = octets[:head] + first + first + octets[head + full :]
    cut_at_a_chunk = octets[: head + 2 * full]
    ended_early = cut_at_a_chunk + b"teds-backup end\n"
    for changed in (swapped, dropped, doubled, cut_at_a_chunk, ended_early):
        with pytest.raises((NotAuthentic, BadData)):
            opened_octets(tmp_path, changed)


def test_a_chunk_of_another_backup_of_the_same_station_does_not_fit(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "a")
    back_up(station, tmp_path / "b")
    (head, _), (_, chunks) = ((tmp_path / name).read_bytes().split(b"\n", 1) for name in "ab")
    with pytest.raises(NotAuthentic):
        opened_octets(tmp_path, head + b"\n" + chunks)


@pytest.mark.parametrize("length", [0, 1, CHUNK_OCTETS - 1, CHUNK_OCTETS, CHUNK_OCTETS + 1, 2 * CHUNK_OCTETS])
def test_any_length_goes_through_the_chunks(length: int) -> None:
    key, context, out = os.urandom(32), b"context", io.BytesIO()
    writer = ChunkWriter(out, key, context)
    writer.write(b"x" * length)
    writer.end()
    reader = ChunkReader(io.BytesIO(out.getvalue()), key, context)
    assert reader.read(length) == b"x" * length
    reader.require_end()
    assert reader.digest.digest() == writer.digest.digest()
    with pytest.raises(BadData):
        reader.read(1)
    with pytest.raises(NotAuthentic):
        ChunkReader(io.BytesIO(out.getvalue()), key, b"other").require_end()


def test_backups_of_version_1_still_open(tmp_path: Path) -> None:
    """Made by version 1's own code: a station named "version one" with two nodes and their keys."""
    with SealedFile(FIXTURES / "version-1.backup").open_with_passphrase(SEALED) as content:
        assert (content.name, len(content.copy.nodes())) == ("version one", 2)
        done = rebuild(tmp_path / "home", content, ask, costs=THROWAWAY)
    assert (done.back["nodes"], done.rotations_due) == (2, 2)
    again = Station.open(tmp_path / "home", ask=ask)
    assert keys_of(again, TWO) == [(1, "active", bytes([2]) * 16)]
    again.close()
    recovery = SoftwareKey.from_secret(bytes(31) + b"\x07")
    with SealedFile(FIXTURES / "version-1-recovery.backup").open_with_key(recovery) as content:
        assert len(content.copy.nodes()) == 2
    with pytest.raises(WrongPassphrase):
        SealedFile(FIXTURES / "version-1.backup").open_with_passphrase("other words here")


def test_what_a_backup_of_version_1_brings_into_a_sealed_store_is_sealed(tmp_path: Path) -> None:
    with SealedFile(FIXTURES / "version-1.backup").open_with_passphrase(SEALED) as content:
        rebuild(tmp_path / "home", content, ask, costs=THROWAWAY)
        forget_vaults()
        station = Station.open(tmp_path / "home", ask=ask)
        station.unlock()  # takes it over
        lost = station.pins.whitelist()[0].uuid
        station.pins.remove(lost)
    with SealedFile(FIXTURES / "version-1.backup").open_with_passphrase(SEALED) as content:
        done = merge_sealed(station._store, content, station.vault, ask)
    assert done.back["whitelist"] == 1
    assert list(station.seals.all_broken()) == []
    assert station.pins.entry(lost) is not None
    station._store.put_whitelist(WhitelistEntry(b"\xee" * 10))  # by another program
    station.pins.remove(lost)
    with SealedFile(FIXTURES / "version-1.backup").open_with_passphrase(SEALED) as content:
        merge_sealed(station._store, content, station.vault, ask)
    assert f"the whitelist entry of {'ee' * 10}" in list(station.seals.all_broken())
    station.close()


class Octets:
    """Octets as a dump is read from."""

    def __init__(self, octets: bytes) -> None:
        self._octets = io.BytesIO(octets)

    def read(self, size: int) -> bytes:
        octets = self._octets.read(size)
        if len(octets) < size:
            raise BadData("too early")
        return octets

    def read_line(self, limit: int) -> bytes:
        return self._octets.readline(limit).rstrip(b"\n")


def test_a_dump_comes_back_row_for_row(station: Station) -> None:
    first = b"".join(station.rows())
    with rows.load(Octets(first)) as copy:
        assert b"".join(rows.dump(copy)) == first


def head(tables: dict[str, list[str]], schema: object = SCHEMA_VERSION) -> bytes:
    return json.dumps({"schema": schema, "tables": tables}).encode() + b"\n"


@pytest.mark.parametrize(
    "octets",
    [
        b"",
        b"[]\n",
        b'{"schema": 1}\n',
        b'{"schema": true, "tables": {}}\n',
        head({"sqlite_schema": ["name"]}) + b"\xff\0\0\0\0",
        head({"x; DROP TABLE keys": ["a"]}) + b"\xff\0\0\0\0",
        head({"meta": ["name", "value", "more"]}) + b"\xff\0\0\0\0",
        head({"meta": ["name", "value"]}),
        head({"meta": ["name", "value"]}) + b"\0\xff\xff\xff\xff",
        head({"meta": ["name", "value"]}) + b"\7\0\0\0\0",
        head({"meta": ["name", "value"]}) + b"\0\0\0\0\2\0\0\xff\0\0\0\0",  # NULL where none may be
        head({"meta": ["name", "value"]}) + b"\0\0\0\0\1\0\xff\0\0\0\0",  # a value too few
        head({"meta": ["name", "value"]}) + b"\0\0\0\0\5\2\0\0\1\0\xff\0\0\0\0",  # a text longer than its row
        head({"meta": ["name", "value"]}) + b"\xff\0\0\0\0",  # no identifier
    ],
)
def test_rows_that_are_none_are_bad_data(octets: bytes) -> None:
    with pytest.raises((BadData, StoreFailure)):
        rows.load(Octets(octets))


@given(st.binary(max_size=200))
def test_no_octets_make_a_dump_raise_anything_foreign(octets: bytes) -> None:
    with pytest.raises((BadData, StoreFailure)):
        rows.load(Octets(head({"meta": ["name", "value"], "nodes": []}) + octets))
    with pytest.raises((BadData, StoreFailure)):
        rows.load(Octets(head({"meta": ["name", "value"]}) + octets))


def test_a_newer_schema_is_not_guessed_at() -> None:
    with pytest.raises(StoreFailure, match="knows up to"):
        rows.load(Octets(head({}, SCHEMA_VERSION + 1) + b"\xff\0\0\0\0"))


# -- what is told, and what a restored station may not do --------------------------------------------------------------


def test_after_a_restore_every_key_has_to_be_rotated_by_a_person(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    done = restored_into(tmp_path / "new", opened(tmp_path / "b"))
    assert done.rotations_due == 2
    again = Station.open(tmp_path / "new", ask=ask)
    for uuid in (ONE, TWO):
        assert "restored from a backup" in (again.keys.rotation_due(uuid) or "")
        with pytest.raises(PolicyRefused, match="restored from a backup"):
            again.policy.require_not_restored(uuid)
    again.keys.rotated(ONE)
    again.policy.require_not_restored(ONE)
    again.close()


def test_no_module_path_goes_into_a_backup_or_comes_out_of_one(station: Station, tmp_path: Path) -> None:
    with copy_of(station, tmp_path) as content:
        evil = replace(content, keystore="pkcs11:token=x?module-path=/tmp/evil.so")
        for asked in (None, "file"):
            with pytest.raises((UsageFailure, PolicyRefused)):
                rebuild(tmp_path / "new", evil, ask, keystore=asked)
        with pytest.raises(UsageFailure, match="no such keystore"):
            rebuild(tmp_path / "new", replace(content, keystore="other"), ask)
    assert not (tmp_path / "new").exists()


def test_a_backup_beside_a_stuck_writer_says_so_and_leaves_no_file(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    held = station.lock("provision")
    monkeypatch.setattr(
        Station, "lock", lambda self, command, notice: StoreLock(self.home, command=command, wait=1.0, notice=notice)
    )
    before = station.audit_log.check().count
    with held, pytest.raises(StoreLocked):
        backup(station, tmp_path / "b", ask, costs=THROWAWAY, notice=told.append)
    assert len(told) == 1
    assert "provision" in told[0]
    assert not (tmp_path / "b").exists()
    assert station.audit_log.check().count == before


def test_a_backup_that_does_not_open_again_is_not_kept(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("teds_provision.backup.sealed_file.MAX_OCTETS", 1000)
    with pytest.raises(StoreFailure, match="does not open again"):
        back_up(station, tmp_path / "b")
    assert list(tmp_path.glob("*b")) == []
    assert station.audit_log.check().count == 1 + 1  # init and ready


def test_the_age_of_a_backup() -> None:
    made = Head("id", POINT, "n", "2026-01-01T00:00:00Z", "file", "")
    assert made.age_days(datetime(2026, 1, 13, 12, tzinfo=UTC)) == 12
    assert replace(made, created="yesterday").age_days() == 0


def test_a_backup_beside_a_writer_of_the_file_itself_says_what_it_waits_for(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not one of our commands: a program that holds SQLite's own lock."""
    told: list[str] = []
    station.notice = told.append
    monkeypatch.setattr("teds_provision.store.database.BUSY_SECONDS", 0.5)
    with closing(sqlite3.connect(station.home / "store.sqlite3", isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreLocked):
            back_up(station, tmp_path / "b")
        assert told == ["Waiting up to 0 s for another process that is writing to the store."]
        assert not (tmp_path / "b").exists()
        other.execute("ROLLBACK")
    assert back_up(station, tmp_path / "b").nodes == 2
