"""A backup restored into a living station: what is missing comes back, nothing goes back."""

from __future__ import annotations

import hashlib
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.backup.backup import backup
from teds_provision.backup.restore import complete_vault, merge, open_present, rebuild
from teds_provision.errors import PolicyError, UsageError, VaultError
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.station.plant.line import EvidenceRow, JobRow, SignRequestRow, UnitRow
from teds_provision.station.snapshot import Relation, place
from teds_provision.station.station import Station, initialise
from teds_provision.station.store.records import (
    Group,
    Handover,
    Holder,
    NodeRecord,
    RevocationRecord,
    Tombstone,
    WhitelistEntry,
)
from teds_provision.vault.passphrase import THROWAWAY
from teds_provision.vault.selection import forget_vaults
from teds_provision.vault.software import SoftwareVault
from tests.backup.backups import NEW, ONE, POINT, SEALED, TWO, add_key, ask, back_up, copy_of, keys_of, opened

from ..bench import make_station
from ..vault.softhsm import PIN, loaded, unload


def test_restoring_the_present_state_is_nothing_to_do(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    count = station.audit_log.check().count
    done = merge(station, opened(tmp_path / "b"), dry_run=False)
    assert (done.action, done.relation, done.back) == ("nothing", Relation.OLDER, {})
    assert station.audit_log.check().count == count


def test_an_older_state_brings_back_what_is_missing_and_nothing_goes_back(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    store = station
    store.pins.remove(ONE)
    store.policy.distrust("owner")
    add_key(station, ONE, 2)  # rotated since: the key of epoch 1 is gone
    store.nodes.restore(NodeRecord(ONE, POINT, epoch=2, sequence=9))
    add_key(station, NEW, 1)
    store.pins.restore([WhitelistEntry(NEW, assurance="tap")])
    store.policy.put_tombstone(Tombstone(TWO, "cd" * 32, "id"))
    station.audit("sign", ONE, "done")
    before = {uuid: keys_of(station, uuid) for uuid in (ONE, TWO, NEW)}
    plan = merge(store, opened(tmp_path / "b"), dry_run=True)
    assert store.pins.row(ONE) is None
    done = merge(store, opened(tmp_path / "b"), dry_run=False)
    assert done == plan
    assert done.relation is Relation.OLDER
    assert done.back == {"whitelist": 1, "trust in ca owner": 1}
    assert "older keys left out: 1" in done.kept
    assert "nodes whose epoch or sequence is higher now: 1" in done.kept
    assert "nodes moved away since: 1" in done.kept
    known = store.nodes.get(ONE)
    assert known is not None
    assert (known.epoch, known.sequence) == (2, 9)
    assert {uuid: keys_of(station, uuid) for uuid in (ONE, TWO, NEW)} == before
    assert store.policy.tombstone(TWO) is not None
    assert store.pins.row(NEW) is not None
    assert store.audit_log.check().intact


def test_groups_that_were_deleted_or_changed_since_stay_so(station: Station, tmp_path: Path) -> None:
    station.groups.put(Group("left hand", (ONE,)))
    station.groups.put(Group("right hand", (TWO,)))
    back_up(station, tmp_path / "b")
    station.groups.delete("left hand")
    station.groups.add("right hand", [ONE])
    station.audit("group", None, "done")
    assert merge(station, opened(tmp_path / "b"), dry_run=False).relation is Relation.OLDER
    assert [(group.name, group.uuids) for group in station.groups.all()] == [("right hand", (ONE, TWO))]


def test_a_handover_goes_forward_with_a_newer_backup_and_never_back(station: Station, tmp_path: Path) -> None:
    begun, stale = Handover("h1", "out", "move", ("cd" * 32,), "open", "{}"), tmp_path / "stale"
    with station.durable("export"):
        station.handovers.put(begun)
    back_up(station, tmp_path / "before")
    with copy_of(station, tmp_path) as content:
        stale.mkdir(mode=0o700)
        place(content.copy, stale)
    shutil.copy(station.home / "vault.json", stale / "vault.json")
    with station.durable("export"):
        station.handovers.put(replace(begun, state="done"))
        station.audit("export", ONE, "done")
    back_up(station, tmp_path / "after")
    assert merge(station, opened(tmp_path / "before"), dry_run=False).relation is Relation.OLDER
    assert [known.state for known in station.handovers.all()] == ["done"]
    old = Station.open(stale, ask=ask)
    assert merge(old, opened(tmp_path / "after"), dry_run=False).relation is Relation.NEWER
    assert [known.state for known in old.handovers.all()] == ["done"]
    old.close()


def test_a_revoked_node_stays_revoked_and_off_the_whitelist(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    station.policy.deny(RevocationRecord(ONE, None, "stolen", "{}"))
    station.pins.remove(ONE)
    station.keys.remove(ONE)
    station.audit("revoke", ONE, "done")
    done = merge(station, opened(tmp_path / "b"), dry_run=False)
    assert done.action == "nothing"
    assert station.pins.entry(ONE) is None
    assert station.keys.keys_of(ONE) == []
    assert "revocations made since: 1" in done.kept


def test_keys_given_up_since_are_not_brought_back(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    station.keys.remove(ONE)
    station.audit("decommission", ONE, "done")
    merge(station, opened(tmp_path / "b"), dry_run=False)
    assert station.keys.keys_of(ONE) == []


def test_a_node_that_was_pinned_again_keeps_its_new_key(station: Station, tmp_path: Path) -> None:
    station.pins.put(WhitelistEntry(ONE, "ab" * 32, assurance="tap"))
    back_up(station, tmp_path / "b")
    station.pins.remove(ONE)
    station.pins.unpin(ONE)
    other = SoftwareKey.generate().point
    station.nodes.remember(ONE, point=other)
    station.audit("identify", ONE, "proven")
    done = merge(station, opened(tmp_path / "b"), dry_run=False)
    known = station.nodes.get(ONE)
    assert known is not None
    assert known.point == other
    assert station.pins.entry(ONE) is None
    assert "whitelist entries pinned to another key now: 1" in done.kept


def test_a_board_that_was_unpinned_since_gets_its_key_from_a_newer_backup_alone(
    station: Station, tmp_path: Path
) -> None:
    station.nodes.put(NodeRecord(NEW, POINT))
    stale = tmp_path / "stale"
    with copy_of(station, tmp_path) as older:
        stale.mkdir(mode=0o700)
        place(older.copy, stale)
        station.pins.unpin(NEW)
        station.audit("whitelist", NEW, "unpinned")
        assert merge(station, older, dry_run=False).relation is Relation.OLDER
        known = station.nodes.get(NEW)
        assert known is not None
        assert known.point is None
    shutil.copy(station.home / "vault.json", stale / "vault.json")
    with Station.open(stale, ask=ask) as behind:
        behind.pins.unpin(NEW)
        station.nodes.put(NodeRecord(NEW, POINT))
        back_up(station, tmp_path / "b")
        with opened(tmp_path / "b") as newer:
            assert merge(behind, newer, dry_run=False).relation is Relation.NEWER
        pinned = behind.nodes.get(NEW)
        assert pinned is not None
        assert pinned.point == POINT


def test_a_ca_that_counts_again_stays_so_after_an_older_backup(station: Station, tmp_path: Path) -> None:
    ca = SoftwareKey.generate().point
    station.policy.end_ca(ca)
    station.audit("trust", None, "removed")
    with copy_of(station, tmp_path) as older:
        merge(station, older, dry_run=False)
        assert not station.policy.counts(ca)
        station.policy.renew_ca(ca)
        station.audit("trust", None, "added")
        assert merge(station, older, dry_run=False).relation is Relation.OLDER
    assert station.policy.counts(ca)


def test_a_newer_state_brings_a_rolled_back_store_forward(station: Station, tmp_path: Path) -> None:
    home, stale = station.home, tmp_path / "stale"
    with copy_of(station, tmp_path) as content:
        stale.mkdir(mode=0o700)
        place(content.copy, stale)
    shutil.copy(home / "vault.json", stale / "vault.json")
    new_key = add_key(station, ONE, 2)
    station.nodes.put(NodeRecord(ONE, POINT, epoch=2, sequence=9))
    station.policy.put_tombstone(Tombstone(TWO, "cd" * 32, "id"))
    station.keys.put_holder(Holder(ONE, "cd" * 32))
    station.audit("sign", ONE, "done")
    back_up(station, tmp_path / "b")
    old = Station.open(stale, ask=ask)
    done = merge(old, opened(tmp_path / "b"), dry_run=False)
    assert done.relation is Relation.NEWER
    known = old.nodes.get(ONE)
    assert known is not None
    assert (known.epoch, known.sequence) == (2, 9)
    assert next(key for _, _, key in keys_of(old, ONE)) == new_key
    assert [state for _, state, _ in keys_of(old, ONE)] == ["pending", "active"]  # an Open decides
    assert [key.source for key in old.keys.keys_of(ONE)] == ["import", "agreement"], "of an agreement here nobody knows"
    assert old.policy.tombstone(TWO) is not None
    assert old.keys.holders(ONE)[0].fingerprint == "cd" * 32
    assert old.audit_log.check().intact
    assert [entry.act for entry in old.audit_log.entries()][-2:] == ["sign", "restore"]
    assert merge(old, opened(tmp_path / "b"), dry_run=False).action == "nothing"
    old.close()


def test_states_that_went_different_ways_keep_both_sides_newest(station: Station, tmp_path: Path) -> None:
    stale = tmp_path / "stale"
    with copy_of(station, tmp_path) as content:
        stale.mkdir(mode=0o700)
        place(content.copy, stale)
    shutil.copy(station.home / "vault.json", stale / "vault.json")
    add_key(station, ONE, 4)
    station.nodes.remember(ONE, epoch=4, sequence=9)
    station.nodes.remember(TWO, epoch=1, sequence=1)
    station.audit("agree", ONE, "done")
    back_up(station, tmp_path / "b")
    other = Station.open(stale, ask=ask)
    add_key(other, TWO, 7)
    other.nodes.remember(TWO, epoch=7, sequence=8)
    other.audit("agree", TWO, "done")
    done = merge(other, opened(tmp_path / "b"), dry_run=False)
    assert done.relation is Relation.DIVERGED
    assert {epoch for epoch, _, _ in keys_of(other, ONE)} == {1, 4}
    assert {epoch for epoch, _, _ in keys_of(other, TWO)} == {7}
    known = {node.uuid: (node.epoch, node.sequence) for node in other.nodes.all()}
    assert (known[ONE], known[TWO]) == ((4, 9), (7, 8))
    assert other.audit_log.check().intact
    other.close()


def test_a_key_of_an_epoch_that_only_the_stations_own_pages_told_comes_back(station: Station, tmp_path: Path) -> None:
    """A home that was rebuilt knew that epoch and held the old key: the key that opens the node was left out."""
    stale = tmp_path / "stale"
    with copy_of(station, tmp_path) as content:
        stale.mkdir(mode=0o700)
        place(content.copy, stale)
    shutil.copy(station.home / "vault.json", stale / "vault.json")
    add_key(station, ONE, 2)
    station.nodes.remember(ONE, epoch=2)
    station.audit("agree", ONE, "done")
    back_up(station, tmp_path / "b")
    with closing(Station.open(stale, ask=ask)) as rebuilt:
        rebuilt.nodes.remember(ONE, epoch=2)
        rebuilt.audit("registry", None, "adopted")
        done = merge(rebuilt, opened(tmp_path / "b"), dry_run=False)
        assert done.relation is Relation.DIVERGED
        assert done.back["keys"] == 1
        assert {epoch for epoch, _, _ in keys_of(rebuilt, ONE)} == {1, 2}
        rebuilt.nodes.remember(ONE, epoch=3)
        for key in rebuilt.keys.keys_of(ONE):
            if key.epoch == 2:
                rebuilt.keys.remove_key(ONE, key.key_id)
        done = merge(rebuilt, opened(tmp_path / "b"), dry_run=False)
        assert {epoch for epoch, _, _ in keys_of(rebuilt, ONE)} == {1}, "the node has a newer one by now"


def test_chosen_names_and_frames_come_back_from_a_backup_that_is_not_older(station: Station, tmp_path: Path) -> None:
    """Topics had their default names again after a restore, and whoever read them heard nothing."""
    stale, here = tmp_path / "stale", station.measurements
    here.rename(ONE, 0, "wrist")
    with copy_of(station, tmp_path) as content:
        stale.mkdir(mode=0o700)
        place(content.copy, stale)
        here.rename(ONE, 0, None)
        station.audit("rename", ONE, "done")
        assert merge(station, content, dry_run=False).relation is Relation.OLDER
        assert here.names == {}
    shutil.copy(station.home / "vault.json", stale / "vault.json")
    here.rename(TWO, 0, "elbow")
    here.rename(TWO, 1, "wrist")
    here.set_frame(ONE, 0, "tool0")
    station.audit("rename", TWO, "done")
    back_up(station, tmp_path / "b")
    with closing(Station.open(stale, ask=ask)) as behind:
        done = merge(behind, opened(tmp_path / "b"), dry_run=False)
        assert (done.relation, done.back["names"], done.back["frames"]) == (Relation.NEWER, 1, 1)
        assert "chosen names in use here: 1" in done.kept
        assert behind.measurements.names == {(ONE, 0): "wrist", (TWO, 0): "elbow"}
        assert behind.measurements.frames == {(ONE, 0): "tool0"}


def test_a_lines_jobs_units_and_evidence_that_are_missing_come_back(station: Station, tmp_path: Path) -> None:
    """Evidence that only a newer backup held was lost: nothing of a line was merged, and nobody was told."""

    def evidence(uuid: bytes, document: bytes) -> EvidenceRow:
        digest = hashlib.sha256(document).hexdigest()
        return EvidenceRow(digest, uuid, "job", 1, 1, "passed", "2026-11-28T10:00:00Z", document)

    line, stale = station.plant.line, tmp_path / "stale"
    line.add_job(JobRow("job", "0" * 64, b"octets"))
    line.put_unit(UnitRow("job", ONE, 1, "2026-11-28T10:00:00Z"))
    line.put_sign_request(SignRequestRow("1" * 64, "out", "job", ONE, "peer", b"request"))
    with copy_of(station, tmp_path) as content:
        stale.mkdir(mode=0o700)
        place(content.copy, stale)
    shutil.copy(station.home / "vault.json", stale / "vault.json")
    line.put_unit(UnitRow("job", ONE, 1, "2026-11-28T10:00:00Z", 3, 2))
    line.put_unit(UnitRow("job", TWO, 2, "2026-11-28T11:00:00Z"))
    line.add_job(JobRow("later", "2" * 64, b"octets"))
    line.put_end_seen("job")
    line.add_evidence(evidence(ONE, b"one"))
    line.put_sign_request(SignRequestRow("1" * 64, "out", "job", ONE, "peer", b"request", b"answer", 4))
    station.audit("unit", ONE, "taken")
    back_up(station, tmp_path / "b")
    with closing(Station.open(stale, ask=ask)) as rebuilt:
        rebuilt.plant.line.put_unit(UnitRow("job", NEW, 2, "2026-11-28T12:00:00Z"))
        rebuilt.plant.line.add_evidence(evidence(NEW, b"new"))
        rebuilt.audit("unit", NEW, "taken")
        plan = merge(rebuilt, opened(tmp_path / "b"), dry_run=True)
        assert list(rebuilt.plant.line.evidence(uuid=ONE)) == []
        done = merge(rebuilt, opened(tmp_path / "b"), dry_run=False)
        assert done == plan
        assert done.back == {"jobs": 1, "units": 2, "evidence": 1, "sign requests": 1}
        held = [(unit.uuid, unit.unit, unit.attempts, unit.passed) for unit in rebuilt.plant.line.units("job")]
        assert held == [(ONE, 1, 3, 2), (NEW, 2, 1, 0), (TWO, 3, 1, 0)]
        assert {row.document for row in rebuilt.plant.line.evidence()} == {b"one", b"new"}
        request = rebuilt.plant.line.sign_request("1" * 64, "out")
        assert request is not None
        assert (request.answer, rebuilt.plant.line.state_of("job")) == (b"answer", ("open", True))
        assert merge(rebuilt, opened(tmp_path / "b"), dry_run=False).back == {}


def test_the_backup_of_another_station_is_refused(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    other = make_station(tmp_path / "other")
    with pytest.raises(PolicyError, match=r"the store in .* is of station") as caught:
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
    vault = complete_vault(station, opened(tmp_path / "b"), ask)
    assert isinstance(vault, SoftwareVault)
    assert len(vault._material.masters.keys) == 2
    assert vault.ca() is None  # it was taken out since, and stays out


def test_a_vault_that_lacks_nothing_is_left_as_it_is(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    software(station).drop_ca()
    before = (station.home / "vault.json").read_bytes()
    forget_vaults()
    assert complete_vault(station, opened(tmp_path / "b"), ask).ca() is None
    assert (station.home / "vault.json").read_bytes() == before


def test_a_lost_vault_comes_back_beside_its_store(station: Station, tmp_path: Path) -> None:
    back_up(station, tmp_path / "b")
    (station.home / "vault.json").unlink()
    forget_vaults()
    assert complete_vault(station, opened(tmp_path / "b"), ask).identity().point == station.point
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
    merge(station, opened(tmp_path / "old"), dry_run=False)
    assert station.keys.rotation_due(ONE) == "due"
    station.keys.rotated(ONE)
    merge(station, opened(tmp_path / "old"), dry_run=False)
    assert station.keys.rotation_due(ONE) is None, "it was done since"
    station.keys.demand_rotation(ONE, "due")
    back_up(station, tmp_path / "new")
    stale = tmp_path / "stale"
    with opened(tmp_path / "old") as content:
        stale.mkdir(mode=0o700)
        place(content.copy, stale)
    with Station.inspect(stale) as store:
        done = merge(store, opened(tmp_path / "new"), dry_run=False)
        assert done.relation is Relation.NEWER
        assert (store.keys.rotation_due(ONE), store.keys.rotation_due(TWO)) == ("due", "due")


def test_a_key_that_the_vault_does_not_open_is_reported_when_backing_up(station: Station, tmp_path: Path) -> None:
    with closing(sqlite3.connect(station.home / "store.sqlite3")) as connection, connection:
        connection.execute("UPDATE keys SET wrapped = zeroblob(60) WHERE uuid = ? AND epoch = 1", (ONE,))
    assert "1 key in the store cannot be opened under this vault" in back_up(station, tmp_path / "b").warnings[0]


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
        with pytest.raises(PolicyError, match="in a token"):
            rebuild(tmp_path / "file", content, pin, keystore="file", costs=THROWAWAY)
        forget_vaults()
        with pytest.raises(UsageError, match="which module"):
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
    with pytest.raises(VaultError, match="too short"):
        backup(station, tmp_path / "b", lambda prompt, confirm: "short", costs=THROWAWAY)
    assert not (tmp_path / "b").exists()
