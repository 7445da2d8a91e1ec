"""Rows that decide whom the station believes carry a seal; what another program changed is named, never believed."""

from __future__ import annotations

import hashlib
import hmac
import sqlite3
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NotAuthenticError, NotFoundError, PolicyError, StoreChangedError, WrongPassphraseError
from teds_provision.handover.outgoing import ExportOrder, plan_export
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.station.row_macs import RowMacs
from teds_provision.station.station import Station, initialise, rewrap
from teds_provision.station.store.records import RevocationRecord, TrustRecord, WhitelistEntry
from teds_provision.station.store.row_sample import RowSample
from teds_provision.vault import passphrase, selection
from teds_provision.vault.master import MasterKeys
from teds_provision.vault.selection import forget_vaults
from tests.pace import PATIENCE

NODE = bytes(range(10))
POINT = SoftwareKey.generate().point
OTHER = SoftwareKey.generate().point


PASSPHRASE = "correct horse battery"


def ask(prompt: str, confirm: bool) -> str:
    return PASSPHRASE


def nobody(prompt: str, confirm: bool) -> str:
    raise WrongPassphraseError("Nobody can be asked.")


Open = Callable[..., Station]


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Return a station with one pinned node, one trusted station, one trusted CA, and a node of another CA."""
    forget_vaults()
    made, _ = initialise(tmp_path / "home", name="n", keystore="file", ask=ask, costs=passphrase.THROWAWAY)
    made.pins.put(WhitelistEntry(NODE, fingerprint(POINT), assurance="tap"))
    made.nodes.remember(NODE, point=POINT)
    made.policy.trust(TrustRecord("peer", "station", OTHER, fingerprint(OTHER)))
    made.policy.trust(TrustRecord("owner", "ca", POINT, fingerprint(POINT)))
    made.keys.set_ca_of(NODE, POINT)
    made.close()
    return tmp_path / "home"


@pytest.fixture
def opened(home: Path) -> Iterator[Open]:
    """Open the station of ``home`` as a new process would; everything is closed at the end."""
    stations: list[Station] = []

    def open_one(collect: list[str] | None = None, ask: Callable[[str, bool], str] = ask) -> Station:
        forget_vaults()
        messages: list[str] = [] if collect is None else collect
        stations.append(Station.open(home, ask=ask, notify=messages.append))
        return stations[-1]

    yield open_one
    for station in stations:
        station.close()
    forget_vaults()


def behind_its_back(home: Path, *statements: str) -> None:
    with closing(sqlite3.connect(home / "store.sqlite3")) as database, database:
        for statement in statements:
            database.execute(statement)


def test_without_a_sample_every_row_is_checked() -> None:
    macs, asked = RowMacs(lambda: pytest.fail("no row, no MAC")), []
    macs.sources = (lambda sample: (asked.append(sample.full), iter(()))[1],)
    assert list(macs.all_broken()) == []
    assert list(macs.all_broken(RowSample())) == []
    assert asked == [True, False]


def test_of_two_threads_that_need_the_vault_one_asks_for_the_passphrase(
    opened: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    station = opened([])
    assert station._vault is None
    both, opens = threading.Barrier(2), []
    open_vault = selection.open_vault

    def counted(*words: Any, **more: Any) -> Any:
        opens.append(1)
        return open_vault(*words, **more)

    monkeypatch.setattr("teds_provision.station.station.selection", SimpleNamespace(open_vault=counted))
    monkeypatch.setattr(station._store, "drain", lambda: both.wait(PATIENCE))  # both have seen that it is closed
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(lambda _: station.vault, range(2))
    assert first is second
    assert opens == [1]


def test_an_untouched_store_says_nothing(opened: Open) -> None:
    messages: list[str] = []
    station = opened(messages)
    first = next(station.audit_log.entries())
    assert (first.act, first.outcome, first.detail) == (
        "init", "done", {"fingerprint": station.fingerprint, "keystore": "file"}
    )  # fmt: skip
    station.unlock()
    assert messages == []
    assert list(station.row_macs.all_broken()) == []
    assert station.pins.pinned(NODE) == fingerprint(POINT)
    assert {record.name for record in station.policy.trusted()} == {"peer", "owner"}


def test_a_seal_is_the_one_that_earlier_versions_made(home: Path, opened: Open) -> None:
    station = opened()
    station.unlock()
    with closing(sqlite3.connect(home / "store.sqlite3")) as database:
        ((wrapped,),) = database.execute("SELECT seal_key FROM station").fetchall()
        ((seal,),) = database.execute("SELECT mac FROM whitelist").fetchall()
    key = station.vault.unwrap(wrapped, context=b"TEDS1 seal key\0" + station.id.encode())
    values = (NODE, fingerprint(POINT).encode(), b"tap")
    whole = b"whitelist\0" + b"".join(len(value).to_bytes(4, "big") + value for value in values)
    assert seal == hmac.digest(key, whole + b"\xff" * 4, "sha256")[:16]  # it has no name


@pytest.mark.parametrize("change", ["ca = x'OTHER'", "point = x'OTHER'", "seal_key = NULL"])
def test_a_changed_ca_or_station_key_or_no_seal_key_stops_the_vault(home: Path, opened: Open, change: str) -> None:
    """Without its seal key a store once passed for one of version 0.1: planted rows were sealed as they lay."""
    behind_its_back(
        home, f"UPDATE station SET {change.replace('OTHER', OTHER.hex())}", "UPDATE whitelist SET mac = NULL"
    )
    station = opened()
    for _ in range(2):  # and it is not believed at the second try either
        with pytest.raises(StoreChangedError, match="own key or CA"):
            station.unlock()


@pytest.mark.parametrize(
    "statement",
    [
        f"UPDATE trust SET point = x'POINT', fingerprint = '{'ab' * 32}' WHERE name = 'peer'",
        "UPDATE trust SET mac = NULL WHERE name = 'peer'",
        "UPDATE trust SET role = 'ca' WHERE name = 'peer'",
        "UPDATE trust SET mac = (SELECT mac FROM trust WHERE name = 'owner') WHERE name = 'peer'",
    ],
)
def test_changed_trust_is_named_and_does_not_count(home: Path, opened: Open, statement: str) -> None:
    behind_its_back(home, statement.replace("POINT", POINT.hex()))
    messages: list[str] = []
    station = opened(messages)
    station.unlock()
    assert "peer" in messages[0]
    assert "peer" not in {record.name for record in station.policy.trusted()}
    assert OTHER not in station.policy.trusted_stations()
    assert list(station.row_macs.all_broken()) == ["trust in peer"]
    assert station.policy.distrust("peer")  # it is still listed, and can be taken away
    assert list(station.row_macs.all_broken()) == []


def test_planted_trust_does_not_count(home: Path, opened: Open) -> None:
    row = f"'evil', 'ca', x'{OTHER.hex()}', '{fingerprint(OTHER)}', 't', zeroblob(16)"
    behind_its_back(home, f"INSERT INTO trust VALUES({row})")
    station = opened()
    station.unlock()
    assert OTHER not in station.policy.trusted_cas()


def test_a_planted_end_of_trust_and_a_planted_lifting_do_not_count(home: Path, opened: Open) -> None:
    statement = hashlib.sha256(b"a ban").hexdigest()
    behind_its_back(
        home,
        f"INSERT INTO ended_cas VALUES('{fingerprint(OTHER)}', 't', zeroblob(16))",
        f"INSERT INTO lifted VALUES('{statement}', 't', NULL)",
    )
    messages: list[str] = []
    station = opened(messages)
    station.unlock()
    assert station.policy.counts(OTHER)
    assert not station.policy.was_lifted("a ban")
    assert [
        sentence
        for sentence in messages
        if "another program added" in sentence.lower() and fingerprint(OTHER)[:16] in sentence
    ]
    assert len(list(station.row_macs.all_broken())) == 2


def test_a_lifting_needs_the_vault(opened: Open) -> None:
    station = opened(ask=nobody)
    station.policy.deny(RevocationRecord(NODE, None, "lost", "a ban", "2026-11-21T00:00:00Z"))
    with pytest.raises(WrongPassphraseError):
        station.policy.lift(NODE)
    assert station.policy.revocation(NODE) is not None


def test_an_end_of_trust_and_a_lifting_that_a_person_made_hold(opened: Open) -> None:
    station = opened()
    station.unlock()
    station.policy.end_ca(OTHER)
    station.policy.deny(RevocationRecord(NODE, None, "lost", "a ban", "2026-11-21T00:00:00Z"))
    assert station.policy.lift(NODE)
    station.close()
    messages: list[str] = []
    station = opened(messages)
    station.unlock()
    assert not station.policy.counts(OTHER)
    assert station.policy.was_lifted("a ban")
    assert not messages
    assert not list(station.row_macs.all_broken())


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE whitelist SET fingerprint = 'OTHER'",
        "UPDATE whitelist SET fingerprint = NULL",
        "UPDATE whitelist SET assurance = 'uuid'",
        "UPDATE whitelist SET mac = NULL",
    ],
)
def test_a_changed_pin_is_not_believed_and_can_be_made_again(home: Path, opened: Open, statement: str) -> None:
    behind_its_back(home, statement.replace("OTHER", fingerprint(OTHER)))
    station = opened()
    station.unlock()
    for use in (station.pins.pinned, station.pins.entry, station.policy.require_whitelisted):
        with pytest.raises(StoreChangedError, match=NODE.hex()):
            use(NODE)
    station.pins.unpin(NODE)
    station.pins.remove(NODE)
    station.pins.put(WhitelistEntry(NODE, fingerprint(POINT)))
    assert station.pins.pinned(NODE) == fingerprint(POINT)


def test_a_pin_moved_to_another_node_is_not_believed(home: Path, opened: Open) -> None:
    behind_its_back(home, f"UPDATE whitelist SET uuid = x'{'ee' * 10}'")
    station = opened()
    station.unlock()
    with pytest.raises(StoreChangedError):
        station.pins.entry(b"\xee" * 10)


def test_a_changed_identity_key_of_a_node_is_not_believed(home: Path, opened: Open) -> None:
    behind_its_back(home, f"UPDATE nodes SET point = x'{OTHER.hex()}'", "DELETE FROM whitelist")
    station = opened()
    station.unlock()
    with pytest.raises(StoreChangedError):
        station.pins.pinned(NODE)


def test_a_changed_ca_of_a_node_is_not_believed(home: Path, opened: Open) -> None:
    behind_its_back(home, f"UPDATE marks SET ca = x'{OTHER.hex()}'")
    station = opened()
    station.unlock()
    with pytest.raises(StoreChangedError):
        station.policy.trusted_cas(NODE)


def test_lists_need_no_passphrase_and_changes_do(opened: Open) -> None:
    station = opened(ask=nobody)
    assert station.pins.pinned(NODE) == fingerprint(POINT)
    assert len(station.policy.listed()) == 2
    for change in (
        lambda: station.pins.put(WhitelistEntry(b"\1" * 10)),
        lambda: station.pins.remove(NODE),
        lambda: station.pins.unpin(NODE),
        lambda: station.policy.trust(TrustRecord("x", "ca", OTHER, fingerprint(OTHER))),
        lambda: station.policy.distrust("peer"),
    ):
        with pytest.raises(WrongPassphraseError):
            change()
    assert station.pins.entry(NODE) is not None
    assert len(station.policy.listed()) == 2


def test_a_key_seen_with_a_closed_vault_is_a_hint_that_can_only_refuse(opened: Open) -> None:
    station = opened(ask=nobody)
    fresh = b"\2" * 10
    station.nodes.remember(fresh, point=POINT)
    node = station.nodes.get(fresh)
    assert node is not None
    assert node.point_mac is None
    assert station.pins.pinned(fresh) == fingerprint(POINT)


def test_a_new_master_key_leaves_the_seals_whole(opened: Open) -> None:
    rewrap(opened())
    station = opened()
    station.unlock()
    assert list(station.row_macs.all_broken()) == []


def test_a_changed_identity_key_is_not_handed_over(home: Path, opened: Open) -> None:
    """What goes into a bundle is what another station will pin."""
    behind_its_back(home, f"UPDATE nodes SET point = x'{OTHER.hex()}', point_mac = NULL")
    station = opened()
    station.keys.add_pending(NODE, key=bytes(16), key_id=bytes(8), epoch=1)
    station.keys.promote(NODE, bytes(8).hex())
    peer = SoftwareKey.generate().point
    station.policy.trust(TrustRecord("east", "station", peer, fingerprint(peer)))
    with pytest.raises(PolicyError, match="pinned"):
        plan_export(station, ExportOrder(("east",), (NODE,), "copy"))


def test_whose_master_keys_are_accepted(home: Path, opened: Open) -> None:
    """Of a process that knows one that is in use here, or the key of the seals; what else opens it proves nothing."""
    station = opened()
    theirs = MasterKeys({1: b"t" * 32})
    assert not station.accept_masters(theirs), "the vault is closed"
    station.unlock()
    here = station.vault.master_keys()
    assert list(here.keys) == [1]
    assert not station.accept_masters(theirs), "another key of the same number"
    assert not station.accept_masters(MasterKeys({2: b"n" * 32})), "not the one that wraps here"
    assert not station.accept_masters(MasterKeys({1: b"t" * 32, 2: b"n" * 32}))
    both = MasterKeys({**here.keys, 2: b"n" * 32})
    assert station.accept_masters(both)
    assert station.vault.masters() == (1, 2)

    record = station.identity.record()
    assert record is not None
    assert record.seal_key is not None
    context = b"TEDS1 seal key\0" + station.id.encode()
    key = station.vault.unwrap(record.seal_key, context=context)
    evil, next_one = MasterKeys({7: b"e" * 32}), MasterKeys({7: b"m" * 32})
    station.identity.put(replace(record, master=7, seal_key=evil.wrap(bytes(32), context=context)))
    assert not station.accept_masters(evil), "it opens a key that another program put there"
    station.identity.put(replace(record, master=7, seal_key=next_one.wrap(key, context=context)))
    assert not station.accept_masters(evil)
    assert station.accept_masters(next_one)


def test_a_ca_key_that_is_not_the_owners_certifies_nobody(home: Path, opened: Open) -> None:
    station = opened()
    record = station.identity.record()
    assert record is not None
    station.unlock()
    station.identity.put(replace(record, ca=OTHER))
    with pytest.raises(NotFoundError, match="The CA key is not in this vault"):
        station.identity.certify(POINT)
    station.identity.put(record)
    signature = station.identity.certify(POINT)
    station.identity.keep_certificate(station.ca, POINT, signature)
    station.identity.put_certificate(fingerprint(station.ca), fingerprint(POINT), b"kept before".ljust(64))
    station.identity.keep_certificate(station.ca, POINT, signature)
    assert station.identity.certificate(station.ca, POINT) == b"kept before".ljust(64), "the first one stays"
    with pytest.raises(NotAuthenticError) as error:
        station.identity.keep_certificate(OTHER, POINT, signature)
    assert error.value.message == (
        f"The CA {fingerprint(OTHER)[:16]} did not sign the station {fingerprint(POINT)[:16]}."
    )
    assert station.identity.certificate(OTHER, POINT) is None


def test_facts_of_a_step_that_was_taken_back_are_not_remembered(home: Path, opened: Open) -> None:
    station = opened()

    def fail() -> None:
        with station.transaction():
            station.identity.begin_rewrapping(2)
            assert (station.identity.master, station.identity.rewrapping) == (2, 2)
            raise KeyError

    assert (station.identity.master, station.identity.rewrapping) == (1, None)
    with pytest.raises(KeyError):
        fail()
    assert (station.identity.master, station.identity.rewrapping) == (1, None)


def test_a_hint_about_firmware_needs_no_seal_and_becomes_no_report_of_a_session(home: Path, opened: Open) -> None:
    first, second = bytes(10), b"\1" * 10
    closed = opened()
    for uuid in (first, second):
        closed.nodes.remember(uuid)
        closed.firmware_reports.keep(uuid, bytes(42), in_session=False)
    station = opened()
    station.unlock()
    sealed = station.firmware_reports.keep(second, bytes(43), in_session=False)
    assert [record.report for record in station.firmware_reports.all()] == [bytes(42), bytes(43)]
    assert list(station.row_macs.all_broken()) == [], "a hint decides nothing, with a seal or without one"
    assert sealed.at
    behind_its_back(home, "UPDATE firmware SET in_session = 1")
    again = opened()
    assert len(list(again.firmware_reports.all())) == 2, "nobody can tell while the vault is closed"
    again.unlock()
    assert [again.firmware_reports.get(uuid) for uuid in (first, second)] == [None, None]
    assert sorted(again.row_macs.all_broken()) == [
        f"the firmware report of {uuid.hex()}" for uuid in (first, second)
    ]  # fmt: skip


def test_a_changed_request_for_a_certificate_stops_the_vault(home: Path, opened: Open) -> None:
    """The key that a CA is asked to certify is this station's own."""
    station = opened()
    record = station.identity.record()
    assert record is not None
    station.unlock()
    values = (POINT, record.point, record.ca, record.signature, None)
    sealed = replace(record, requested=POINT, mac=station.row_macs.mac("station", values))
    station.identity.put(sealed)
    opened().unlock()
    station.identity.put(replace(sealed, requested=OTHER))
    with pytest.raises(StoreChangedError, match="own key or CA"):
        opened().unlock()
