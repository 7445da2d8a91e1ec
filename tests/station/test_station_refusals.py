"""Checks and re-reads of a station before it uses a row of its store: identity, keys, nodes, copies."""

from __future__ import annotations

import errno
import sqlite3
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import (
    FrozenError,
    NotFoundError,
    PolicyError,
    StoreChangedError,
    StoreError,
    UnknownMasterKeyError,
    UsageError,
    VaultChangedError,
    VaultError,
    VaultLockedError,
)
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message
from teds_provision.station import measurements, snapshot
from teds_provision.station import station as stations
from teds_provision.station.datasheets import unpacked
from teds_provision.station.node_keys import NodeKeys
from teds_provision.station.plant.alarms import Alarm
from teds_provision.station.plant.pages import PageRow
from teds_provision.station.plant.plant import HOME_FILE, RosterRow
from teds_provision.station.snapshot import Relation, is_damage, relation
from teds_provision.station.station import Station, initialise
from teds_provision.station.store.lock import UsageLock, UsageLockTakenError
from teds_provision.station.store.records import KeyRecord, NodeRecord, StationRecord
from teds_provision.vault.master import MasterKeys
from tests.bench import PASSPHRASE

NODE, OTHER = bytes(range(10)), bytes(range(1, 11))
OWNER = SoftwareKey(71)


def raises(error: Exception) -> Callable[..., Any]:
    def raised(*_: Any, **__: Any) -> Any:
        raise error

    return raised


# -- the station itself ------------------------------------------------------------------------------------------------


def test_a_home_without_a_station_or_with_a_half_made_one_says_what_to_run(tmp_path: Path) -> None:
    with Station.make(tmp_path / "home") as made:
        with pytest.raises(NotFoundError) as error:
            _ = made.identity.name
        assert (error.value.message, error.value.hint) == (
            f"There is no base station in {tmp_path / 'home'} yet.", "To create one: teds-provision init"
        )  # fmt: skip
        made.identity.put(StationRecord("north", "file", "it was asked for", OWNER.point))
        assert (made.identity.name, made.identity.keystore, made.identity.is_complete()) == ("north", "file", False)
        for asked in ("point", "fingerprint", "ca"):
            with pytest.raises(NotFoundError) as error:
                getattr(made.identity, asked)
            assert (error.value.message, error.value.hint) == (
                f"init was not finished in {tmp_path / 'home'}.", "To finish it: teds-provision init"
            )  # fmt: skip


def test_a_station_shows_a_certificate_of_the_ca_that_is_asked_for_or_none(station: Station) -> None:
    own = station.identity.signature_under(station.ca)
    with pytest.raises(PolicyError) as error:
        station.identity.signature_under(OWNER.point)
    assert (error.value.message, error.value.hint) == (
        f"This station is not certified by the CA {fingerprint(OWNER.point)[:16]}.",
        "Have it signed on the station with that CA key: teds-provision trust ca sign REQUEST",
    )
    signature = OWNER.sign(station_key_message(station.point))
    station.identity.keep_certificate(OWNER.point, station.point, signature)
    station.unlock()
    shown = station.identity.credentials(OWNER.point)
    assert (shown.station_signature, shown.ca) == (signature, OWNER.point)
    assert station.identity.credentials().station_signature == own


def test_master_keys_of_another_vault_do_not_open_this_store(station: Station) -> None:
    assert not station.identity.opened_by(cast("Any", None)), "before the vault was opened nothing is compared"
    station.unlock()
    assert station.identity.opened_by(station.vault.master_keys())
    assert not station.identity.opened_by(cast("Any", SimpleNamespace(unwrap=raises(VaultError("another vault")))))
    assert not station.identity.opened_by(cast("Any", SimpleNamespace(unwrap=lambda *_, **__: bytes(32))))


def test_a_vault_that_was_opened_before_the_master_key_changed_is_read_again(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    station.unlock()
    tried = list[str]()

    def unlocked(vault: Any) -> None:
        tried.append(vault.state)
        if vault.state == "old":
            raise UnknownMasterKeyError("another master key")

    def vault(*, newer: bool) -> Any:
        made = SimpleNamespace(state="old")

        def refresh() -> bool:
            made.state = "new" if newer else "old"
            return newer

        made.refresh = refresh
        return made

    monkeypatch.setattr(station.identity, "unlocked", unlocked)
    monkeypatch.setattr(station.policy, "unlocked", lambda: tried.append("rows"))
    station.adopt(vault(newer=True))
    assert tried == ["old", "new", "rows"]
    with pytest.raises(UnknownMasterKeyError):
        station.adopt(vault(newer=False))
    assert tried == ["old", "new", "rows", "old"]
    assert station._vault is None, "a vault that does not fit is not used"


def test_no_station_is_made_in_a_vault_without_a_ca_key_or_over_a_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = SoftwareKey(72)
    made = SimpleNamespace(identity=lambda: key, ca=lambda: None, kind="token")
    monkeypatch.setattr(stations.selection, "create_vault", lambda *_, **__: (made, "it was asked for"))
    with pytest.raises(NotFoundError) as error:
        initialise(tmp_path / "home", name="north", keystore="token", ask=lambda *_: PASSPHRASE)
    assert (error.value.message, error.value.hint) == (
        "The vault does not contain a CA key.", "Choose another keystore, or import the CA key."
    )  # fmt: skip
    with Station.inspect(tmp_path / "home") as station:
        assert station.identity.record() is None, "nothing was kept"


@pytest.mark.parametrize(
    ("held", "handed", "opens", "accepted"),
    [
        ({1: b"one"}, {1: b"one", 2: b"two"}, False, True),
        ({1: b"one", 2: b"two"}, {2: b"two"}, False, True),
        ({1: b"one"}, {2: b"two"}, True, True),  # nothing in common, but they open the key of the row MACs
        ({1: b"one"}, {2: b"two"}, False, False),
        ({1: b"one"}, {1: b"ONE", 2: b"two"}, True, False),
        ({1: b"one"}, {1: b"one", 3: b"two"}, True, False),  # without the one that is in use here
        (None, {1: b"one", 2: b"two"}, True, False),
    ],
)
def test_master_keys_are_accepted_from_who_knows_one_of_this_store(
    station: Station, monkeypatch: pytest.MonkeyPatch, held: Any, handed: dict[int, bytes], opens: bool, accepted: bool
) -> None:
    taken, given = list[MasterKeys](), MasterKeys(handed)
    if held is not None:
        station._vault = cast("Any", SimpleNamespace(master_keys=lambda: MasterKeys(held), accept=taken.append))
    monkeypatch.setattr(type(station.identity), "master", 2)
    monkeypatch.setattr(station.identity, "opened_by", lambda masters: opens and masters is given)
    assert station.accept_masters(given) is accepted
    assert taken == ([given] if accepted else [])


# -- keys --------------------------------------------------------------------------------------------------------------


def test_a_key_that_was_read_before_the_master_key_changed_is_read_again() -> None:
    """The vault, too; what no master key opens then is damaged, or another command was quicker once more."""

    def opened(*, first: bool, again: bool, known: bool) -> bytes:
        asked = list[tuple[str, bytes]]()

        def vault(name: str, *, good: bool) -> Any:
            def unwrap(wrapped: bytes, *, context: bytes) -> bytes:
                asked.append((name, wrapped))
                if not good:
                    raise UnknownMasterKeyError("of another master key")
                return name.encode()

            return SimpleNamespace(unwrap=unwrap, masters=lambda: {"m2"} if known else set())

        def key(wrapped: bytes, key_id: str = "k1") -> KeyRecord:
            return KeyRecord(NODE, 3, key_id, "active", 1, wrapped)

        keys = NodeKeys(
            cast("Any", SimpleNamespace(id="store", recall=lambda *_: (key(b"other", "k2"), key(b"fresh")))),
            lambda: vault("held", good=first), cast("Any", SimpleNamespace(master="m2")), cast("Any", None),
            lambda: vault("reopened", good=again), cast("Any", None),
        )  # fmt: skip
        try:
            return keys.unwrap(key(b"stale"))
        finally:
            assert asked == [("held", b"stale"), *([] if first else [("reopened", b"fresh")])]

    assert opened(first=True, again=False, known=False) == b"held"
    assert opened(first=False, again=True, known=False) == b"reopened"
    with pytest.raises(UnknownMasterKeyError):
        opened(first=False, again=False, known=True)
    with pytest.raises(VaultChangedError) as error:
        opened(first=False, again=False, known=False)
    assert (error.value.message, error.value.hint) == (
        "Another command has just changed the master key.", "Run this again."
    )  # fmt: skip


# -- nodes -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("fitting", "shown"), [(2, 2), (5, 5), (6, 5), (8, 5)])
def test_of_many_nodes_that_fit_five_are_named(station: Station, fitting: int, shown: int) -> None:
    uuids = [bytes.fromhex("8d4d0000000000000000")[:9] + bytes([number]) for number in range(fitting)]
    for uuid in uuids:
        station.nodes.restore(NodeRecord(uuid))
    with pytest.raises(UsageError) as error:
        station.nodes.resolve("0X8D4D")
    more = f" and {fitting - 5} more" if fitting > 5 else ""
    named = ", ".join(uuid.hex() for uuid in uuids[:shown])
    assert (error.value.message, error.value.hint) == (
        f"'0X8D4D' fits several nodes: {named}{more}.", "Give more digits of the UUID."
    )  # fmt: skip


def test_a_node_that_is_renamed_or_measured_is_left_as_it_is(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    path = station.measurements._home / measurements.FOLDER / f"{OTHER.hex()}.lock"
    with UsageLock(path, command="rename") as renaming:
        with pytest.raises(PolicyError) as error, station.measurements.running([OTHER, NODE, NODE]):
            pytest.fail("it is being renamed")
        assert error.value.message.startswith(f"Node {OTHER.hex()} is in use by pid ")
        assert error.value.message.partition(" (")[2].startswith("rename) since 20")
        assert error.value.hint == "Try again."
        assert not station.measurements.is_running(NODE), "nothing is held"
        renaming.share()
        assert not renaming.is_taken_alone, "whoever shares it may come in"
        with station.measurements.running([OTHER]):
            assert station.measurements.is_running(OTHER)
            with pytest.raises(FrozenError) as frozen:
                station.measurements.set_frame(OTHER, 0, "hand")
            assert (frozen.value.message, frozen.value.hint) == (
                f"Node {OTHER.hex()} is being measured, so its frames cannot be changed now.",
                "End that measurement first.",
            )
            with pytest.raises(UsageLockTakenError), UsageLock(path, command="rename"):
                pytest.fail("it is measured")
    station.measurements.set_frame(OTHER, 0, "hand")
    assert station.measurements.frames == {(OTHER, 0): "hand"}


STAT = "41 (a (name) x) S" + " 0" * 18 + " 4200 0 0"


def test_when_this_process_started(monkeypatch: pytest.MonkeyPatch) -> None:
    """Field 22 of /proc/self/stat: clock ticks since the machine started, whatever the command's name is."""
    files = {"/proc/self/stat": STAT, "/proc/stat": "cpu 1 2\nbtime 1000\nprocesses 7\n"}
    monkeypatch.setattr(Path, "read_text", lambda path: files[str(path)])
    monkeypatch.setattr(measurements.os, "sysconf", {"SC_CLK_TCK": 100}.__getitem__)
    monkeypatch.setattr(measurements.time, "time", lambda: 99.9)
    assert measurements._process_start() == 1042
    for stat, whole in ((STAT, "cpu 1 2\n"), (STAT, "btime\n"), ("41 (x) S 0", files["/proc/stat"]), ("", "btime x"),
                        (STAT, "btime x\n")):  # fmt: skip
        files.update({"/proc/self/stat": stat, "/proc/stat": whole})
        assert measurements._process_start() == 99, "now, if the system does not report it"
    monkeypatch.setattr(Path, "read_text", raises(FileNotFoundError(errno.ENOENT, "no /proc")))
    assert measurements._process_start() == 99


@pytest.mark.parametrize(
    "whole",
    [
        struct.pack(">HBI", 0, 1, 4) + b"met",  # its octets are cut
        struct.pack(">HBI", 0, 1, 4) + b"meta" + struct.pack(">HBI", 1, 3, 1),
        struct.pack(">HBI", 0, 1, 4)[:6],  # its head is cut
        struct.pack(">HBI", 0, 1, 4) + b"meta" + b"\0",
    ],
)
def test_a_datasheet_that_ends_within_a_block_is_damage(whole: bytes) -> None:
    good = struct.pack(">HBI", 0, 1, 4) + b"meta"
    assert unpacked(NODE, zlib.compress(good)).blocks == {(0, 1): b"meta"}
    for octets in (zlib.compress(whole), zlib.compress(good)[:-1], good):
        with pytest.raises(ValueError):
            unpacked(NODE, octets)


# -- the plant ---------------------------------------------------------------------------------------------------------


def test_own_events_are_those_that_wait_and_those_on_own_pages(station: Station) -> None:
    station.unlock()
    plant = station.plant
    plant.begin_restored()
    assert plant.record() is None, "a home in no plant has nothing to look for"
    assert plant.own_events() == set()
    with station.transaction():
        plant.queue_event({"id": "1111111111111111", "act": "keyed", "uuid": NODE.hex()})
        plant.queue_event({"id": "2222222222222222", "act": "closed"})
    assert plant.own_events() == {"1111111111111111", "2222222222222222"}
    with station.transaction():
        for of, n, content in (
            (station.fingerprint, 1, b'{"events": [{"id": "3333333333333333"}, "none", {"act": "x"}]}'),
            (station.fingerprint, 2, b"{}"),
            ("ab" * 32, 1, b'{"events": [{"id": "another station\'s"}]}'),
        ):
            chain = plant.pages.chain(of)
            plant.pages.add(chain.id, PageRow(n, f"{n:064x}", "", "", "", b"", content, bytes(64)))
    assert plant.own_events() == {"1111111111111111", "2222222222222222", "3333333333333333", "None"}


# -- copies of a store -------------------------------------------------------------------------------------------------


def log(*heads: str, root: str = "00") -> Any:
    """Return a station with an audit log whose entries have these hashes."""

    def entries(after: int) -> Any:
        return iter(SimpleNamespace(seq=seq, hash=hash) for seq, hash in enumerate(heads, 1) if seq > after)

    whole = SimpleNamespace(count=len(heads), head=heads[-1] if heads else root)
    audit = SimpleNamespace(check=lambda: whole, entries=entries, _root=bytes.fromhex(root))
    return cast("Station", SimpleNamespace(audit_log=audit))


@pytest.mark.parametrize(
    ("copy", "live", "found"),
    [
        (("a", "b"), ("a", "b"), Relation.SAME),
        ((), (), Relation.SAME),
        (("a",), ("a", "b"), Relation.OLDER),
        ((), ("a",), Relation.OLDER),
        (("a", "b"), ("a",), Relation.NEWER),
        (("a",), (), Relation.NEWER),
        (("a", "c"), ("a", "b"), Relation.DIVERGED),
        (("a", "c"), ("a", "b", "d"), Relation.DIVERGED),
        (("a", "c", "d"), ("a", "b"), Relation.DIVERGED),
    ],
)
def test_the_log_that_continues_the_other_is_the_newer(
    copy: tuple[str, ...], live: tuple[str, ...], found: Relation
) -> None:
    assert relation(log(*copy), log(*live)) is found


def test_a_log_of_another_store_went_another_way() -> None:
    assert relation(log(root="11"), log("a")) is Relation.DIVERGED


def test_a_copy_takes_the_place_of_no_store_and_of_a_damaged_one(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "rebuilt"
    home.mkdir(mode=0o700)
    for left in ("store.sqlite3-wal", "store.sqlite3-shm"):
        (home / left).write_bytes(b"of a former store")
    with monkeypatch.context() as patch:
        patch.setattr(snapshot, "whole_draft", raises(OSError(errno.ENOSPC, "No space left on device")))
        with pytest.raises(StoreError, match="cannot be used: there is no space left on the disk"):
            snapshot.place(station, home)
    snapshot.place(station, home)
    assert sorted(path.name for path in home.iterdir()) == ["store.sqlite3"]
    with Station.inspect(home) as copy:
        assert snapshot.totals(copy) == {"whitelist": 0, "nodes": 0, "keys": 0, "trust": 0}
        assert copy.fingerprint == station.fingerprint
    with pytest.raises(StoreError) as error:
        snapshot.place(station, home)
    assert (error.value.message, error.value.hint) == (
        f"There is a store in {home} already.", "Restore into another --home."
    )  # fmt: skip
    for left in list(home.glob("store.sqlite3-*")):
        left.unlink()
    (home / "store.sqlite3-wal").write_bytes(b"log")
    monkeypatch.setattr(snapshot.time, "strftime", lambda *_: "20260301T120000")
    aside = snapshot.set_aside(home)
    assert aside == home / "store.sqlite3.damaged-20260301T120000"
    assert sorted(path.name for path in home.iterdir()) == [aside.name, f"{aside.name}-wal"]
    (home / "store.sqlite3").mkdir()
    (home / f"{aside.name}").unlink()
    monkeypatch.setattr(Path, "rename", raises(OSError(errno.EROFS, "Read-only file system")))
    with pytest.raises(StoreError, match="cannot be used: it cannot be written"):
        snapshot.set_aside(home)


@pytest.mark.parametrize(
    ("code", "damage"), [(sqlite3.SQLITE_CORRUPT, True), (sqlite3.SQLITE_NOTADB, True),
                         (sqlite3.SQLITE_CORRUPT | 1 << 8, True), (sqlite3.SQLITE_FULL, False), (None, False)],
)  # fmt: skip
def test_only_a_damaged_file_is_set_aside(code: int | None, damage: bool) -> None:
    failure, cause = StoreError("why"), sqlite3.DatabaseError("why")
    if code is not None:
        cause.sqlite_errorcode = code
    failure.__cause__ = cause
    assert is_damage(failure) is damage
    failure.__cause__ = OSError(11, "11 is EAGAIN here")
    assert not is_damage(failure)


# -- the plant that was joined ----------------------------------------------------------------------------------------

FIRST, SECOND = "11111111-2222-4333-8444-555555555555", "21111111-2222-4333-8444-555555555555"


def test_a_registry_is_joined_again_moved_or_left_for_another(station: Station) -> None:
    station.unlock()
    plant = station.plant

    def joined(registry: str, url: str | None, **before: Any) -> tuple[Any, ...]:
        with station.transaction():
            if before:
                record = plant.record()
                assert record is not None
                plant.put_record(replace(record, **before))
            plant.join(registry, url)
        found = plant.joined
        assert found is not None
        return found.registry, found.url, found.acknowledged, found.left

    assert joined(FIRST, None) == (FIRST, None, 0, None)
    assert joined(FIRST, "postgresql://one", acknowledged=7) == (FIRST, "postgresql://one", 7, None)
    assert joined(FIRST, "postgresql://one", left="now") == (FIRST, "postgresql://one", 7, None)
    assert joined(FIRST, None) == (FIRST, "postgresql://one", 7, None)
    assert joined(FIRST, "postgresql://two") == (FIRST, "postgresql://two", 0, None), "it has acknowledged nothing yet"
    with station.transaction():
        plant.alarms.put(Alarm("junk", "", 1, "why"))
    assert joined(FIRST, "postgresql://two", acknowledged=3) == (FIRST, "postgresql://two", 3, None)
    assert len(plant.alarms.all()) == 1
    assert joined(SECOND, None) == (SECOND, None, 0, None)
    assert plant.alarms.all() == [], "everything of the first one is forgotten"


def test_a_roster_that_another_program_put_there_is_not_believed(station: Station) -> None:
    station.unlock()
    plant = station.plant
    with station.transaction():
        plant.join(FIRST, None)
        plant.put_roster(RosterRow(1, "ab" * 32, b"octets", False, "now"))
    assert plant.roster is None, "none is in force"
    with station.transaction():
        plant.put_roster(RosterRow(2, "cd" * 32, b"octets", True, "now"))
        plant._store.execute("UPDATE rosters SET held = 0")
        plant._store.execute("UPDATE rosters SET held = 1 WHERE version = 1")
    with pytest.raises(StoreChangedError) as error:
        _ = plant.roster
    assert (error.value.message, error.value.hint) == (
        "The roster in the store was changed by another program and is not trusted.",
        "To get it again: teds-provision registry sync",
    )


def roster(station: Station, *roles: str, **more: Any) -> Any:
    members = {station.fingerprint: frozenset(roles), **more.pop("members", {})}

    def roles_of(digits: str) -> frozenset[str]:
        return members.get(digits, frozenset())

    return SimpleNamespace(
        name="plant", removed=(), by_key=dict.fromkeys(members), member=members.get, roles_of=roles_of,
        has=lambda digits, role: role in roles_of(digits), name_of=lambda digits: digits[:5], **more,
    )  # fmt: skip


def test_a_role_is_required_of_a_member_alone(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    plant = station.plant
    plant.require_role("line", "keys no board", "See: registry status")
    monkeypatch.setattr(type(plant), "roster", roster(station, "line"))
    plant.require_role("line", "keys no board", "See: registry status")
    with pytest.raises(PolicyError) as error:
        plant.require_role("sign", "signs no datasheet", "See: registry status")
    assert (error.value.message, error.value.hint) == (
        "This station does not have the role sign in plant, so it signs no datasheet.", "See: registry status"
    )  # fmt: skip


def test_signatures_wait_for_pages_of_a_keeper_that_a_member_has_seen(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeper, base, audit, me = "keepr" + "a" * 59, "based" + "b" * 59, "audit" + "c" * 59, station.fingerprint
    members = {keeper: frozenset({"keeper"}), base: frozenset({"base"}), audit: frozenset({"audit"})}
    monkeypatch.setattr(type(station.plant), "roster", roster(station, "keeper", members=members))
    chains = {keeper: SimpleNamespace(counted=(4, "h"))}
    heads = list[tuple[str, str, int, str]]()
    monkeypatch.setattr(station.plant.pages, "chains", lambda: chains)
    monkeypatch.setattr(station.plant.pages, "heads", lambda: heads)

    def behind(*reported: tuple[str, str, int]) -> str:
        heads[:] = [(*one, "h") for one in reported]
        rules = station.plant.signer_rules(["stranger", base])
        assert rules is not None
        assert rules.counted == {name: chain.counted[0] for name, chain in chains.items()}
        assert rules.added == {"stranger"}
        return rules.keepers_behind

    missing = "pages of the keeper keepr are missing here: based names page 5, and the last one here is 4"
    assert behind() == behind((base, keeper, 4)) == ""
    assert behind((base, keeper, 4), (base, keeper, 5)) == missing
    assert behind((audit, keeper, 5)) == "", "an auditor's word counts for nothing"
    assert behind(("stranger" + "d" * 56, keeper, 5)) == ""
    assert behind((base, audit, 5), (keeper, base, 5)) == "", "they are no keepers"
    assert behind((base, me, 5)) == "", "a keeper always has its own"
    chains.clear()
    assert behind((base, keeper, 1)).endswith("based names page 1, and the last one here is 0")


def test_the_name_of_a_home_is_made_once_and_damage_is_reported(station: Station) -> None:
    digits = station.plant.home
    assert (len(digits), station.plant.home) == (16, digits)
    path = station.home / HOME_FILE
    for octets in (b"", b"0123456789abcde", b"0123456789abcdefg", b"0123456789ABCDEF", b"\xff" * 16):
        path.write_bytes(octets)
        with pytest.raises(StoreError) as error:
            _ = station.plant.home
        assert (error.value.message, error.value.hint) == (
            f"{path} is damaged.", "Remove it; the next registry sync creates a new one."
        )  # fmt: skip
    path.write_bytes(b" 0123456789abcdef\n")
    assert station.plant.home == "0123456789abcdef"
    path.unlink()
    assert station.plant.home not in ("0123456789abcdef", digits)


def test_signers_are_read_in_a_fork_by_a_connection_of_its_own(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    station.unlock()
    claims, digest = station.plant.claims, bytes(range(32))
    with station.transaction():
        claims.put_digests(station.plant.pages.chain("ab" * 32), [(digest, 3, False), (digest, 5, True)])
    before = claims._store
    found = [("ab" * 32, 3, False), ("ab" * 32, 5, True)]
    assert sorted(claims.signers(digest)) == found
    assert claims._store is before
    monkeypatch.setattr(claims, "_process", -1)
    assert sorted(claims.signers(digest)) == found
    forked = claims._store
    assert forked is not before
    assert sorted(claims.signers(digest)) == found
    assert claims._store is forked, "opened once"
    forked.close()
    monkeypatch.setattr(claims, "_store", before)


def test_a_changed_vault_is_read_again_and_nobody_is_asked(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    adopted, asked = list[str](), list[Any]()
    changed = VaultChangedError("another passphrase")

    def vault(reread: Exception | None, *masters: int) -> Any:
        return SimpleNamespace(reread=raises(reread) if reread else lambda: None, masters=lambda: masters)

    def open_vault(home: Path, id: str, keystore: str, ask: Any, *, use_agent: bool) -> Any:
        asked.append((home, id, keystore, use_agent))
        with pytest.raises(VaultError):  # the prompt itself raises
            ask("Passphrase", False)
        if opened is None:
            raise VaultError("nothing holds it open")
        return opened

    def reopened(held: Any) -> Any:
        monkeypatch.setattr(station, "_opened", lambda: held)
        return station._reopened()

    monkeypatch.setattr(type(station.identity), "master", 2)
    monkeypatch.setattr(stations.selection, "open_vault", open_vault)
    monkeypatch.setattr(station, "adopt", adopted.append)
    opened: Any = None
    good, handed, stale = vault(None), vault(changed, 1, 2), vault(changed, 1)
    assert reopened(good) is good
    assert reopened(handed) is handed, "the command that made the new key handed it over"
    assert asked == []
    with pytest.raises(VaultLockedError) as error:
        reopened(stale)
    assert (error.value.message, error.value.hint) == (
        "The vault's passphrase and master key were changed by another command.",
        "To let a running ncap continue: teds-provision unlock. Start any other command again.",
    )
    assert asked == [(station.home, station.id, station.identity.keystore, True)]
    opened = "a vault that is held open"
    assert reopened(stale) == opened
    assert adopted == [opened]
    assert len(asked) == 2
    monkeypatch.setattr(station, "_reopened", lambda: "reopened")
    for held, found in ((handed, handed), (stale, "reopened")):
        monkeypatch.setattr(station, "_opened", lambda held=held: held)
        assert cast("Any", station.current_vault()) is found
