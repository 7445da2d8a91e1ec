"""The audit log: what tampering it notices."""

from __future__ import annotations

import sqlite3
from contextlib import closing, suppress
from pathlib import Path

import pytest

from teds_provision.errors import StoreError
from teds_provision.station.store import audit
from teds_provision.station.store.store import Store

NODE = bytes(range(10))
DROP = "DROP TRIGGER audit_is_never_changed; DROP TRIGGER audit_is_never_shortened; DROP TRIGGER audit_only_grows;"


@pytest.fixture
def logged(store: Store) -> Store:
    for number in range(5):
        store.audit.append("provision", NODE, "done", {"step": number, "word": "größe"})
    store.audit.append("init", None, "done")
    return store


def outside(home: Path, statements: str) -> None:
    with closing(sqlite3.connect(home / "store.sqlite3")) as database:
        database.executescript(statements)
        database.commit()


def test_entries_come_back_and_the_chain_holds(logged: Store) -> None:
    entries = list(logged.audit.entries())
    assert [entry.seq for entry in entries] == [1, 2, 3, 4, 5, 6]
    assert (entries[0].act, entries[0].uuid, entries[0].outcome) == ("provision", NODE, "done")
    assert entries[0].detail == {"step": 0, "word": "größe"}
    assert entries[5].uuid is None
    assert "@" in entries[0].who
    verdict = logged.audit.check()
    assert (verdict.intact, verdict.first_bad, verdict.count, verdict.head) == (True, None, 6, entries[5].hash)


def test_following_the_log_gives_only_what_is_new(logged: Store) -> None:
    assert [entry.seq for entry in logged.audit.entries(after=4)] == [5, 6]
    assert list(logged.audit.entries(after=6)) == []


def test_an_entry_is_no_change_for_which_nodes_are_judged_anew(store: Store) -> None:
    """Each of 200 nodes that join has an entry, and had the others' standing judged again with it."""
    before = store.changes()
    for _ in range(3):
        store.audit.append("measure", NODE, "joined")
        assert store.changes() == before
    with store.transaction():
        store.audit.append("measure", NODE, "joined")
        store.execute("INSERT INTO meta VALUES('decided', 'today')")
        store.audit.append("revoke", NODE, "done")
    decided = store.changes()
    assert decided != before
    with closing(Store.open(store.path.parent)) as other:
        other.audit.append("measure", NODE, "joined")
    assert store.changes() != decided, "what another process changed is not known"


@pytest.mark.parametrize(("note", "first"), [("4", 4), ("x", 1), ("", 1), ("-4", 1)])
def test_a_log_that_once_lost_its_end_stays_broken_from_there(logged: Store, note: str, first: int) -> None:
    logged.execute("INSERT INTO meta VALUES('audit-lost', ?)", (note,))
    verdict = logged.audit.check()
    assert (verdict.intact, verdict.first_bad, verdict.count) == (False, first, 6)
    assert verdict.why == f"the log once ended before entry {first} and was cut there"


def test_an_empty_log_is_intact(store: Store) -> None:
    assert store.audit.check().intact
    assert store.audit.check().count == 0


def test_the_log_is_as_long_as_needed(store: Store) -> None:
    with store.transaction():
        for number in range(1203):
            store.audit.append("write", NODE, "done", {"number": number})
    assert [entry.detail["number"] for entry in store.audit.entries()] == list(range(1203))
    assert store.audit.check().intact


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE audit SET outcome = 'refused' WHERE seq = 2",
        "DELETE FROM audit WHERE seq = 6",
        "DELETE FROM audit",
        "INSERT OR REPLACE INTO audit SELECT seq, at, who, 'x', uuid, outcome, detail, hash FROM audit WHERE seq = 3",
        "INSERT INTO audit SELECT 99, at, who, act, uuid, outcome, detail, hash FROM audit WHERE seq = 3",
    ],
)
def test_the_file_itself_refuses_to_change_the_log(logged: Store, home: Path, statement: str) -> None:
    with pytest.raises(sqlite3.IntegrityError, match="append-only"):
        outside(home, statement)
    assert logged.audit.check().intact


@pytest.mark.parametrize(
    ("statement", "first_bad"),
    [
        ("UPDATE audit SET outcome = 'refused' WHERE seq = 2", 2),
        ("UPDATE audit SET at = '2020-01-01T00:00:00Z' WHERE seq = 6", 6),
        ("UPDATE audit SET who = 'x' WHERE seq = 1", 1),
        ("UPDATE audit SET uuid = NULL WHERE seq = 3", 3),
        ("UPDATE audit SET detail = '{}' WHERE seq = 4", 4),
        ("UPDATE audit SET hash = zeroblob(32) WHERE seq = 4", 4),
        ("DELETE FROM audit WHERE seq = 1", 1),
        ("DELETE FROM audit WHERE seq = 3", 3),
        ("DELETE FROM audit WHERE seq >= 5", 5),
        ("DELETE FROM audit", 1),
        ("UPDATE meta SET value = '6:00' WHERE name = 'audit-head'", 7),
        ("UPDATE meta SET value = 'nonsense' WHERE name = 'audit-head'", 7),
        ("DELETE FROM meta WHERE name = 'audit-head'", 7),
    ],
)
def test_who_takes_the_triggers_away_is_noticed_by_the_chain(
    logged: Store, home: Path, statement: str, first_bad: int
) -> None:
    logged.close()
    outside(home, DROP + statement)
    with Store.open(home) as again:
        verdict = again.audit.check()
        assert not verdict.intact
        assert verdict.first_bad == first_bad
        assert verdict.why
        assert all(entry.seq for entry in again.audit.entries())


def test_a_log_that_was_cut_goes_on_and_the_cut_is_never_forgotten(logged: Store, home: Path) -> None:
    logged.close()
    outside(home, DROP + "DELETE FROM audit WHERE seq > 4")
    with Store.open(home) as again:
        again.audit.append("write", NODE, "done")
        again.audit.append("write", NODE, "done")
        verdict = again.audit.check()
        assert (verdict.intact, verdict.first_bad, verdict.count) == (False, 5, 6)
    outside(home, "DELETE FROM audit WHERE seq > 5")
    with Store.open(home) as again:
        again.audit.append("write", NODE, "done")
        verdict = again.audit.check()
        assert (verdict.intact, verdict.first_bad, verdict.count) == (False, 5, 6), "the first of two cuts"


def test_a_log_of_another_store_does_not_pass(logged: Store, home: Path) -> None:
    logged.close()
    outside(home, "UPDATE meta SET value = 'another' WHERE name = 'id'")
    with Store.open(home) as again:
        assert again.audit.check().first_bad == 1


def test_an_entry_shares_the_fate_of_its_transaction(store: Store) -> None:
    with suppress(RuntimeError), store.transaction():
        store.audit.append("write", NODE, "done")
        raise RuntimeError
    assert list(store.audit.entries()) == []
    assert store.audit.check().intact


def test_octets_cannot_be_logged(store: Store) -> None:
    with pytest.raises(TypeError):
        store.audit.append("agree", NODE, "done", {"key": b"secret"})
    assert list(store.audit.entries()) == []


def test_an_unreadable_detail_is_shown_and_found_bad(logged: Store, home: Path) -> None:
    logged.close()
    outside(home, DROP + "UPDATE audit SET detail = '{nonsense' WHERE seq = 2")
    with Store.open(home) as again:
        assert list(again.audit.entries())[1].detail == {"unreadable": "{nonsense"}
        assert again.audit.check().first_bad == 2


def test_a_closed_store_says_so(store: Store) -> None:
    store.close()
    with pytest.raises(StoreError):
        store.audit.append("write", NODE, "done")


@pytest.mark.parametrize("error", [KeyError("uid not found"), OSError("No entry"), ImportError("pwd"), None])
@pytest.mark.parametrize("owners", [True, False])
def test_an_entry_names_the_user_by_number_where_there_is_no_name(
    monkeypatch: pytest.MonkeyPatch, error: Exception | None, owners: bool
) -> None:
    def user() -> str:
        if error is not None:
            raise error
        return "me"

    monkeypatch.setattr(audit.getpass, "getuser", user)
    monkeypatch.setattr(audit.os, "getuid", lambda: 1234)
    monkeypatch.setattr(audit, "HAS_OWNERS", owners)
    monkeypatch.setattr(audit, "name_of_machine", lambda: "bench")
    named = "me" if error is None else "uid 1234" if owners else "unknown"
    assert audit._who.__wrapped__() == f"{named}@bench"
