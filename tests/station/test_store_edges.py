"""Files of a home in rare cases: another process in between, a failing disk, a row that no version wrote."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import sqlite3
import tempfile
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import BadDataError, FrozenError, NodeBusyError, StoreError, StoreLockedError
from teds_provision.station import snapshot
from teds_provision.station.groups import Groups
from teds_provision.station.station import Station
from teds_provision.station.store import connection, database, dump, lock, row_sample
from teds_provision.station.store.audit import ACTOR, AuditFilter, _entry, _linked
from teds_provision.station.store.database import Database, open_copy
from teds_provision.station.store.lock import NodeLock, OwnerLock, StoreLock, UsageLock, UsageLockTakenError
from teds_provision.station.store.row_sample import _between, _Column
from teds_provision.station.store.store import Store

NODE = bytes(range(10))
NO_ROOM = "there is no space left on the disk"
FREE_SOME = "Free some space and run the same command again; nothing is lost."


def full(*_: Any, **__: Any) -> Any:
    raise OSError(errno.ENOSPC, "No space left on device")


def refused(*_: Any, **__: Any) -> Any:
    raise OSError(errno.ENOLCK, "No locks available")


# -- waiting for another process ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["execute", "change"])
def test_a_statement_waits_for_the_other_writer_and_says_so_once(store: Store, way: str) -> None:
    notices = list[str]()
    with closing(sqlite3.connect(store.path, isolation_level=None, check_same_thread=False)) as other:
        other.execute("BEGIN IMMEDIATE")

        def notice(text: str) -> None:
            notices.append(text)
            other.execute("ROLLBACK")

        store.notice = notice
        store.execute("PRAGMA busy_timeout=1")
        found = getattr(store, way)("UPDATE meta SET value = value WHERE name = 'id'")
    assert found == ([] if way == "execute" else 1)
    assert notices == ["Waiting up to 10 s for another process that is writing to the store."]


@pytest.mark.parametrize("way", ["execute", "change"])
def test_a_statement_waits_ten_seconds_and_no_longer(store: Store, monkeypatch: pytest.MonkeyPatch, way: str) -> None:
    clock = iter([100.0, 105.0, 109.9, 110.0])
    store.execute("PRAGMA busy_timeout=1")
    with closing(sqlite3.connect(store.path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        monkeypatch.setattr(connection, "time", SimpleNamespace(monotonic=lambda: next(clock)))
        with pytest.raises(StoreLockedError) as error:
            getattr(store, way)("UPDATE meta SET value = value WHERE name = 'id'")
    assert next(clock, None) is None, "it gave up at the very end"
    assert error.value.message == f"The store {store.path} was kept busy by another process for 10 s."


def test_the_journal_is_switched_when_another_process_has_opened_too(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, tries = iter([100.0, 109.9, 110.0]), list[str]()
    sleeps = list[float]()
    monkeypatch.setattr(database, "time", SimpleNamespace(monotonic=lambda: next(clock), sleep=sleeps.append))

    def busy(statement: str) -> None:
        tries.append(statement)
        if statement and len(tries) < worked_at:
            raise StoreLockedError("busy")

    monkeypatch.setattr(store, "execute", busy)
    worked_at = 9
    with pytest.raises(StoreLockedError, match="busy"):
        store._write_ahead()
    assert (tries, sleeps) == (["PRAGMA journal_mode=WAL"] * 2, [0.01])
    worked_at, clock = 4, iter([0.0, 1.0])
    store._write_ahead()
    assert len(tries) == 4


def test_a_transaction_that_cannot_begin_leaves_the_store_as_durable_as_before(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def newer() -> None:
        raise StoreError("newer schema")

    monkeypatch.setattr(store, "require_known_schema", newer)
    with pytest.raises(StoreError, match="newer schema"), store.transaction(later=True):
        pytest.fail("it began")
    assert store.execute("PRAGMA synchronous") == [(2,)], "FULL"
    monkeypatch.undo()
    with store.transaction():
        store.execute("UPDATE meta SET value = value WHERE name = 'id'")
        assert not store._is_to_wait(cast("Any", SimpleNamespace(sqlite_errorcode=sqlite3.SQLITE_BUSY)))
    assert store._is_to_wait(cast("Any", SimpleNamespace(sqlite_errorcode=sqlite3.SQLITE_BUSY)))


@pytest.mark.parametrize("way", ["execute", "change", "execute_many"])
@pytest.mark.parametrize("waited", [False, True])
def test_no_foreign_error_comes_out_of_a_statement(
    store: Store, monkeypatch: pytest.MonkeyPatch, way: str, waited: bool
) -> None:
    busy = sqlite3.OperationalError("database is locked")
    monkeypatch.setattr(store, "_is_to_wait", lambda error: error is busy)
    cases: list[tuple[Exception, type[Exception], str]] = [
        (sqlite3.DatabaseError("malformed"), StoreError, "cannot be used: SQLite says: malformed."),
        (OSError(errno.ENOSPC, "full"), StoreError, NO_ROOM),
        (UnicodeEncodeError("utf-8", "\udcff", 0, 1, "surrogates"), BadDataError, "not valid UTF-8"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid"), StoreError, "it is damaged"),
    ]
    for error, kind, message in cases:
        raised = iter([busy, error] if waited and way != "execute_many" else [error])

        def fail(*_: Any, raised: Any = raised) -> Any:
            raise next(raised)

        with monkeypatch.context() as patch:
            patch.setattr(store, "_cursor", SimpleNamespace(execute=fail))
            if way == "execute_many":
                real = store._connection
                patch.setattr(store, "_cursor", real.cursor())
                patch.setattr(store, "_connection", SimpleNamespace(
                    executemany=fail, execute=real.execute, total_changes=0, in_transaction=True))  # fmt: skip
            words = ("DELETE FROM meta WHERE name = ?", [("x",)]) if way == "execute_many" else ("DELETE FROM meta",)
            with pytest.raises(kind, match=message):
                getattr(store, way)(*words)
        assert next(raised, None) is None


def test_after_a_block_other_threads_use_the_store(store: Store) -> None:
    free = list[bool]()

    def look() -> None:
        taken = store._lock.acquire(blocking=False)
        free.append(taken)
        if taken:
            store._lock.release()

    def other() -> None:
        thread = threading.Thread(target=look)
        thread.start()
        thread.join()

    for fails in (False, True):
        with contextlib.suppress(KeyError), store.transaction():
            other()
            if fails:
                raise KeyError
        other()
    assert free == [False, True] * 2


# -- a store that cannot be written ------------------------------------------------------------------------------------


def test_of_a_store_that_can_only_be_read_everything_is_read_and_nothing_changed(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    why = StoreError("The disk is read-only.")
    why.__cause__ = OSError(errno.EROFS, "Read-only file system")

    def unwritable(_cls: Any, _path: Path, *, create: bool) -> Any:
        raise why

    monkeypatch.setattr(Database, "_opened", classmethod(unwritable))
    with pytest.raises(StoreError) as error:
        Store.open(store.home, create=True)
    assert error.value is why
    with Store.open(store.home) as copy:
        assert copy.frozen is why
        assert copy.id == store.id
        changing: list[Callable[[], object]] = [
            lambda: copy.execute("DELETE FROM meta"),
            lambda: copy.change("DELETE FROM meta"),
            lambda: copy.execute_many("DELETE FROM meta WHERE name = ?", [("id",)]),
            lambda: copy.transaction().__enter__(),
        ]
        for change in changing:
            with pytest.raises(StoreError) as error:
                change()
            assert error.value is why

    def damaged(*_: Any) -> Any:
        raise sqlite3.DatabaseError("malformed")

    for failing in (full, damaged):
        why.__cause__ = OSError(errno.EROFS, "Read-only file system")
        monkeypatch.setattr(database, "open_copy", failing)
        with pytest.raises(StoreError) as error:
            Store.open(store.home)
        assert error.value is why, "not what the copy lacks"
    why.__cause__ = OSError(errno.EIO, "Input/output error")
    monkeypatch.undo()
    monkeypatch.setattr(Database, "_opened", classmethod(unwritable))
    with pytest.raises(StoreError) as error:
        Store.open(store.home)
    assert error.value is why, "another failure is no reason for a copy"


def test_a_copy_that_is_no_store_is_closed_again(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    store.execute("PRAGMA user_version=99")
    copies = list[sqlite3.Connection]()

    def kept(path: Path) -> sqlite3.Connection:
        copies.append(open_copy(path))
        return copies[-1]

    monkeypatch.setattr(database, "open_copy", kept)
    with pytest.raises(StoreError, match="schema 99"):
        Store._read_only(store.path, StoreError("why"))
    with pytest.raises(sqlite3.ProgrammingError, match="closed"):
        copies[0].execute("SELECT 1")


def test_a_copy_is_made_where_there_is_room(store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory first, then the folder of the user's session, then that of temporary files."""
    (tmp_path / "run").mkdir()
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    assert list(database._places()) == ["/dev/shm", str(tmp_path / "run"), str(tmp_path / "tmp")]
    monkeypatch.setattr(database, "_places", lambda: iter([str(tmp_path / "none"), str(tmp_path / "run"), "/dev/shm"]))
    copied, used = database._copied, list[Path]()

    def with_room(path: Path, folder: Path) -> sqlite3.Connection:
        used.append(folder.parent)
        if folder.parent == tmp_path / "run":
            full()
        return copied(path, folder)

    monkeypatch.setattr(database, "_copied", with_room)
    with closing(open_copy(store.path)) as made:
        assert made.execute("SELECT value FROM meta WHERE name = 'id'").fetchone() == (store.id,)
    assert used == [tmp_path / "run", Path("/dev/shm")]
    assert list((tmp_path / "run").iterdir()) == [], "nothing is left of the one that did not fit"
    monkeypatch.setattr(database, "_places", lambda: iter([str(tmp_path / "none"), str(tmp_path / "run")]))
    with pytest.raises(OSError, match="No space left"):
        open_copy(store.path)
    monkeypatch.setattr(database, "_places", lambda: iter([]))
    with pytest.raises(OSError, match=f"There is no space for a copy of {store.path}"):
        open_copy(store.path)
    monkeypatch.undo()
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(tempfile, "gettempdir", full)
    assert list(database._places()) == ["/dev/shm"]


def test_what_cannot_be_read_of_a_store_or_its_copy_is_closed_again(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed, refused_at = list[str](), [""]

    def execute(statement: str) -> Any:
        if statement.startswith(refused_at[0]):
            raise (sqlite3.DatabaseError("malformed") if refused_at[0] != "SELECT" else KeyboardInterrupt())
        return SimpleNamespace(fetchone=lambda: None)

    made = SimpleNamespace(execute=execute, close=lambda: closed.append(refused_at[0]))
    monkeypatch.setattr(database, "sqlite3", SimpleNamespace(Error=sqlite3.Error, connect=lambda *_, **__: made))
    for error, statement in ((sqlite3.DatabaseError, "PRAGMA journal"), (KeyboardInterrupt, "SELECT")):
        refused_at[0] = statement
        with pytest.raises(error):
            database._copied(store.path, tmp_path)
    assert closed == ["PRAGMA journal", "SELECT"]
    assert (tmp_path / "store.sqlite3").read_bytes() == store.path.read_bytes()

    def no_connection(*_: Any, **__: Any) -> Any:
        raise sqlite3.OperationalError("unable to open database file")

    monkeypatch.setattr(database, "sqlite3", SimpleNamespace(Error=sqlite3.Error, connect=no_connection))
    with pytest.raises(StoreError) as failure:
        Database._opened(store.path, create=False)
    assert failure.value.hint == "Run teds-provision doctor."
    assert isinstance(failure.value.__cause__, sqlite3.OperationalError)


@pytest.mark.parametrize("error", [sqlite3.OperationalError("disk I/O error"), OSError(errno.ENOSPC, "full")])
def test_a_copy_that_cannot_be_put_in_place_leaves_no_store(store: Store, tmp_path: Path, error: Exception) -> None:
    def backup(target: sqlite3.Connection) -> None:
        target.execute("CREATE TABLE half(done)")
        raise error

    there = SimpleNamespace(
        _lock=store._lock, _translated=contextlib.nullcontext, _connection=SimpleNamespace(backup=backup)
    )
    (tmp_path / "new").mkdir()
    with pytest.raises(StoreError) as failure:
        snapshot.place(cast("Any", SimpleNamespace(_store=there)), tmp_path / "new")
    assert failure.value.message.startswith(f"The store {tmp_path / 'new' / 'store.sqlite3'} cannot be used: ")
    assert failure.value.__cause__ is error
    assert list((tmp_path / "new").iterdir()) == []
    with pytest.raises(StoreError) as failure:
        snapshot.place(cast("Any", None), store.home)
    assert (failure.value.message, failure.value.hint) == (
        f"There is a store in {store.home} already.", "Restore into another --home."
    )  # fmt: skip


def test_a_home_that_cannot_be_opened_is_a_store_failure_with_its_cure(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(database, "prepare_home", full)
        with pytest.raises(StoreError) as error:
            Store.open(store.home, create=True)
    assert (error.value.message, error.value.hint) == (
        f"The store {store.path} cannot be used: {NO_ROOM}.", FREE_SOME
    )  # fmt: skip
    store.execute("DELETE FROM meta WHERE name = 'id'")
    closed = list[Path]()
    monkeypatch.setattr(Database, "close", lambda opened: closed.append(opened.path))
    with pytest.raises(StoreError) as error:
        Store.open(store.home)
    assert (error.value.message, error.value.hint) == (
        f"The store {store.path} has no identifier.", "Run teds-provision init."
    )  # fmt: skip
    assert closed == [store.path]


def test_no_file_stays_open_after_a_look_or_a_failure(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """A service that runs for months looks at locks a thousand times a day."""
    home, group = store.home, Groups(store, store.home, cast("Any", None))

    def fail() -> None:
        with group.frozen("hand"):
            raise KeyError

    def busy() -> None:
        with group.frozen("hand"), group.frozen("hand"):
            pytest.fail("two hold one group")

    def flushed() -> None:
        with store.transaction(later=True):
            store.execute("UPDATE meta SET value = value")
        with monkeypatch.context() as patch:
            patch.setattr(connection, "sync_content", full)
            store.flush()

    def held() -> None:
        with StoreLock(home, command="x"):
            assert lock.holder_of(home) is not None
        assert lock.holder_of(home) is None

    def looked() -> None:
        with NodeLock(home, NODE):
            assert NodeLock(home, NODE).is_taken

    def unlockable() -> None:
        with monkeypatch.context() as patch:
            patch.setattr(lock, "lock", refused)
            assert lock.holder_of(home) is None
            patch.setattr(lock, "fcntl", SimpleNamespace(fcntl=refused, F_OFD_GETLK=0, F_WRLCK=0))
            assert not NodeLock(home, NODE).is_taken

    held()
    looked()
    before = len(os.listdir("/proc/self/fd"))
    for act, error in ((fail, KeyError), (busy, FrozenError), (flushed, StoreError)):
        with pytest.raises(error):
            act()
    for quiet in (held, looked, unlockable):
        quiet()
    assert len(os.listdir("/proc/self/fd")) == before


# -- rows that this tool never wrote -----------------------------------------------------------------------------------


def test_a_row_that_makes_no_record_is_damage(store: Store) -> None:
    raised = iter([ValueError, TypeError, AttributeError] * 4)

    def unreadable(*_: Any) -> Any:
        raise next(raised)("row")

    store.execute("INSERT INTO key_slots VALUES(?, 1)", (NODE,))
    select = "SELECT uuid FROM key_slots"
    reads: list[Callable[[], object]] = [
        lambda: store.read(unreadable, select),
        lambda: store.read_one(unreadable, select),
        lambda: store.read_of_nodes(unreadable, select, [NODE]),
        lambda: list(store.stream(unreadable, "SELECT 1 WHERE 1 > ? LIMIT ?")),
        lambda: list(store.stream(tuple, "SELECT 'one' WHERE 1 > ? LIMIT ?")),
        lambda: list(store.stream(lambda number: number, "SELECT 0 WHERE 1 > ? LIMIT ?")),
        lambda: store.execute("SELECT CAST(x'ff' AS TEXT)"),
    ]
    for read in [*reads[:4] * 3, *reads[4:]]:
        with pytest.raises(StoreError) as error:
            read()
        assert error.value.message == f"The store {store.path} cannot be used: it is damaged."
    assert next(raised, None) is None, "each kind of error in each way to read"
    with pytest.raises(BadDataError, match="not valid UTF-8"):
        store.execute("SELECT ?", ("\udcff",))


GOOD_ENTRY = (7, "2026-03-01T12:00:00Z", "me", "write", NODE, "done", "{}", bytes(32))


@pytest.mark.parametrize(
    ("place", "value"), [*((place, 5) for place in (1, 2, 3, 5, 6)), (4, "uuid"), (7, "hash"), (7, None), (1, None)]
)
def test_an_entry_of_the_log_with_a_value_of_another_type_is_damage(place: int, value: object) -> None:
    assert _linked(*GOOD_ENTRY)[0] == 7
    assert _linked(*GOOD_ENTRY[:4], None, *GOOD_ENTRY[5:])[2] == bytes(32)
    with pytest.raises(TypeError):
        _linked(*GOOD_ENTRY[:place], value, *GOOD_ENTRY[place + 1 :])


def test_a_log_is_checked_from_an_entry_that_is_there(store: Store) -> None:
    for _ in range(3):
        store.audit.append("write", NODE, "done")
    assert store.audit.check(2).intact
    verdict = store.audit.check(9)
    assert (verdict.intact, verdict.first_bad, verdict.count, verdict.why) == (False, 9, 8, "entry 9 is missing")


@pytest.mark.parametrize("text", ["[1]", "null", "7", "{", ""])
def test_details_of_an_entry_that_are_no_object_are_shown_as_they_stand(text: str) -> None:
    assert _entry(1, "", "", "verify", None, "done", text, b"").detail == {"unreadable": text}


def test_a_part_of_a_text_is_found_in_every_column_and_signs_of_sql_stand_for_themselves(store: Store) -> None:
    store.audit.append("verify", NODE, "refused", {"why": "50% of_it!"})
    before = ACTOR.set("token lab")
    try:
        store.audit.append("write", None, "done")
    finally:
        ACTOR.reset(before)

    def found(**choice: Any) -> list[str]:
        return [entry.act for entry in store.audit.chosen(AuditFilter(**choice))]

    for text in ("erif", "efuse", "50%", "of_it!", "00010203", "%", "_", "!"):
        assert found(text=text) == ["verify"], text
    assert found(text="en la") == found(text="rit") == ["write"]
    for text in ("0%f", "e_u", "'", "\0"):
        assert found(text=text) == [], text
    at = next(iter(store.audit.entries(0))).at
    assert found(since=at) == found(since="'") == ["verify", "write"], "from that second on"
    assert (found(act="verify\0"), found(act="it's")) == (["verify"], [])
    second = store.audit.newest()[0]
    assert [found(before=number) for number in (second + 1, second)] == [["verify", "write"], ["verify"]]


def test_counts_and_what_is_wrong_with_the_file(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    assert (store.count("trust"), store.damage()) == (0, None)
    store.execute("INSERT INTO trust VALUES('south', 'station', zeroblob(65), ?, '', NULL)", ("ab" * 32,))
    assert (store.count("trust"), store.count("keys")) == (1, 0)

    def broken(_statement: str) -> Any:
        raise StoreError("The file is damaged.")

    with monkeypatch.context() as patch:
        patch.setattr(store, "_checked", broken)
        assert store.damage() == "The file is damaged."
        patch.setattr(store, "_checked", lambda _: "row 3 missing from index")
        assert store.damage() == "row 3 missing from index"
        patch.setattr(Path, "stat", lambda _: SimpleNamespace(st_size=4097))
        assert store.damage() == "The file ends within a page.", "SQLite would not find it"
    with monkeypatch.context() as patch:
        patch.setattr(Path, "stat", full)
        assert store.damage() == "The file cannot be read: No space left on device."


# -- locks -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def place(home: Path) -> Path:
    home.mkdir(mode=0o700)
    return home


def holding(path: Path, text: str) -> int:
    """Lock a file as another command does that wrote this about itself; return its descriptor."""
    descriptor = os.open(path, os.O_CREAT | os.O_RDWR, 0o600)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    os.write(descriptor, text.encode())
    return descriptor


SINCE = "2026-03-01T12:00:00Z"
OTHER = "another process"


@pytest.mark.parametrize(
    ("holder", "named"),
    [
        ({"pid": 1, "command": "write", "since": SINCE}, f"pid 1 (write) since {SINCE}"),
        ({"pid": 1 << 30, "command": "write", "since": SINCE}, OTHER),
        ({"pid": 1, "command": "write"}, OTHER),
        ({"command": "write", "since": SINCE}, OTHER),
        ({"pid": "none", "command": "write", "since": SINCE}, OTHER),
        ([], OTHER),
        (None, OTHER),
    ],
)
def test_who_holds_the_store_is_named_if_it_lives(place: Path, holder: object, named: str) -> None:
    assert lock.holder_of(place) is None
    descriptor = holding(place / "store.lock", json.dumps(holder))
    try:
        assert lock.holder_of(place) == named
        with pytest.raises(StoreLockedError) as error, StoreLock(place, command="agree", wait=0):
            pytest.fail("two hold one lock")
        assert (error.value.message, error.value.hint) == (
            f"The store is locked by {named}.", "Wait for it to finish, or stop it."
        )  # fmt: skip
        with pytest.raises(UsageLockTakenError) as taken, UsageLock(place / "store.lock", command="agree"):
            pytest.fail("two hold one lock")
        assert (taken.value.message, taken.value.holder, taken.value.hint) == (
            f"It is locked by {named}.", named, "Wait for it to finish, or stop it."
        )  # fmt: skip
    finally:
        os.close(descriptor)
    assert lock.holder_of(place) is None, "what the last holder left names no holder"


def test_a_station_holds_the_store_for_a_command_and_for_what_is_nested_in_it(station: Station) -> None:
    def holder() -> str:
        return (lock.holder_of(station.home) or "(nobody)").partition("(")[2].partition(")")[0]

    for _ in range(2):  # the second time as the first
        assert holder() == "nobody"
        with station.lock("agree"):
            assert holder() == "agree"
            with station.lock("rotate"), station.durable("sign"):
                assert holder() == "agree"
            assert holder() == "agree", "what was nested let go of nothing"
        with pytest.raises(ValueError, match="cut"), station.lock("agree"):
            raise ValueError("cut")
        assert holder() == "nobody"
        with station.durable("sign"):
            assert holder() == "sign"


def test_a_store_of_the_present_schema_is_opened_while_another_process_writes(store: Store) -> None:
    with closing(sqlite3.connect(store.path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        with Store.open(store.home) as again:
            assert again.id == store.id


@pytest.mark.parametrize("told", [True, False])
def test_a_command_looks_often_says_once_whom_it_waits_for_and_gives_up_after_ten_seconds(
    place: Path, monkeypatch: pytest.MonkeyPatch, told: bool
) -> None:
    clock = iter([0.0, 0.0, 0.049, 0.05, 0.1, 0.2, 0.3, 1.0, 2.0, 9.99, 10.0])
    sleeps, notices = list[float](), list[str]()
    monkeypatch.setattr(lock, "time", SimpleNamespace(monotonic=lambda: next(clock), sleep=sleeps.append))
    descriptor = holding(place / "store.lock", json.dumps({"pid": 1, "command": "write", "since": SINCE}))
    store_lock = StoreLock(place, command="agree", notice=notices.append if told else None)
    with pytest.raises(StoreLockedError), store_lock:
        pytest.fail("two hold one lock")
    os.close(descriptor)
    assert next(clock, None) is None
    slow = [0.004, 0.008, 0.016, 0.032, 0.05, 0.05, 0.05] if told else [0.004] * 7
    assert sleeps == [0.001, 0.002, *slow]
    assert notices == ([f"Waiting for the store, locked by pid 1 (write) since {SINCE}."] if told else [])


def test_a_system_that_locks_nothing_is_a_store_failure(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    holders: list[Any] = [
        StoreLock(place, command="agree"), UsageLock(place / "n.lock", command="agree"), NodeLock(place, NODE),
        OwnerLock(place, "m1"),
    ]  # fmt: skip
    monkeypatch.setattr(lock, "lock", refused)
    monkeypatch.setattr(lock, "fcntl", SimpleNamespace(**{**vars(fcntl), "fcntl": refused}))
    before = len(os.listdir("/proc/self/fd"))
    for holder in holders:
        with pytest.raises(StoreError, match="cannot be used: No locks available"), holder:
            pytest.fail("it is locked")
    (place / "store.lock").touch()
    assert lock.holder_of(place) is None
    assert not NodeLock(place, NODE).is_taken
    assert len(os.listdir("/proc/self/fd")) == before, "every file was closed again"
    with pytest.raises(StoreError, match="cannot be used"), UsageLock(place / "no" / "folder" / "x", command="agree"):
        pytest.fail("it is locked")


def test_a_usage_lock_shows_whether_its_last_holder_ended_well(place: Path) -> None:
    path = place / "n.lock"

    def left_behind(*, shared: bool = False) -> bool:
        with UsageLock(path, command="measure", shared=shared) as held:
            assert (held.is_taken, held.is_taken_alone) == (True, not shared)
            return held.left_behind

    assert [left_behind(), left_behind(shared=True), left_behind()] == [False] * 3
    path.write_bytes(b'{"pid": 1, "command": "measure"}')  # its holder was killed
    assert [left_behind(), left_behind()] == [True, False]
    with UsageLock(path, command="measure", shared=True):
        left_behind(shared=True)
        assert path.read_bytes(), "the other one still holds it"
    assert path.read_bytes() == b""
    free = UsageLock(path, command="measure")
    assert (free.is_taken, free.holder, free.is_taken_alone) == (False, None, False)


def test_the_folder_that_a_usage_lock_makes_is_its_owners_alone(place: Path) -> None:
    for _ in range(2):
        with UsageLock(place / "locks" / "n.lock", command="measure"):
            assert (place / "locks").stat().st_mode & 0o777 == 0o700


def test_a_full_disk_hides_neither_a_lock_nor_its_end(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "_write_at_start", full)
    monkeypatch.setattr(os, "ftruncate", full)
    for holder in (StoreLock(place, command="agree"), UsageLock(place / "n.lock", command="agree")):
        with cast("Any", holder):
            pass


def test_one_command_waits_a_minute_for_a_node_and_owns_a_measurement_alone(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not NodeLock(place, NODE).is_taken, "there is no file yet"
    clock, notices, sleeps = iter([0.0, 1.0, 59.9, 60.0]), list[str](), list[float]()
    with NodeLock(place, NODE), OwnerLock(place, "m1"):
        assert NodeLock(place, NODE).is_taken
        assert not NodeLock(place, bytes(10)).is_taken
        assert (OwnerLock(place, "m1").is_taken, OwnerLock(place, "m2").is_taken) == (True, False)
        monkeypatch.setattr(lock, "time", SimpleNamespace(monotonic=lambda: next(clock), sleep=sleeps.append))
        with pytest.raises(NodeBusyError) as error, NodeLock(place, NODE, notice=notices.append):
            pytest.fail("two work on one node")
        with pytest.raises(StoreLockedError) as owned, OwnerLock(place, "m1"):
            pytest.fail("two own one measurement")
    assert (error.value.message, error.value.hint) == (
        f"Another command of this station is using node {NODE.hex()}.", "Wait for it to finish, or stop it."
    )  # fmt: skip
    assert notices == [f"Waiting: another command is using node {NODE.hex()}."]
    assert sleeps == [0.05, 0.05]
    assert (owned.value.message, owned.value.hint) == (
        "Another command owns this measurement.", "Wait for it to finish, or stop it."
    )  # fmt: skip


def test_a_lock_that_another_one_holds_or_that_cannot_be_read_has_no_name(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """POSIX lets a system answer EACCES or EAGAIN for a lock that is held."""
    fates = iter([PermissionError("EACCES"), BlockingIOError("EAGAIN"), OSError(errno.ENOLCK, "No locks")])

    def fails(*_: Any) -> Any:
        raise next(fates)

    held = NodeLock(place, NODE)
    with monkeypatch.context() as patch:
        patch.setattr(lock, "fcntl", SimpleNamespace(fcntl=fails, F_OFD_SETLK=0, F_WRLCK=0))
        assert [held._try_to_lock(0), held._try_to_lock(0)] == [False, False]
        with pytest.raises(StoreError):
            held._try_to_lock(0)
        patch.setattr(lock, "_read_at_start", full)
        assert lock._holder(0) == OTHER


def test_a_head_of_a_backup_that_is_nested_too_deep_holds_no_store(monkeypatch: pytest.MonkeyPatch) -> None:
    def loads(_: object) -> Any:
        raise RecursionError

    monkeypatch.setattr(dump, "json", SimpleNamespace(loads=loads))
    with pytest.raises(BadDataError, match="The backup holds no store"):
        dump._head(cast("Any", dumped()))


def test_without_locks_of_the_system_a_database_beside_the_file_is_locked(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "HAS_LOCKS", False)
    for _ in range(2):  # the second time shows that the first one was released
        with StoreLock(place, command="agree", wait=0):
            assert (place / "store.lock.sqlite").exists()
            with pytest.raises(BlockingIOError):
                lock._locked_database(place / "store.lock")
            with pytest.raises(StoreLockedError), StoreLock(place, command="write", wait=0):
                pytest.fail("two hold one lock")
    (place / "store.lock.sqlite").unlink()
    (place / "store.lock.sqlite").write_bytes(b"")
    (place / "store.lock.sqlite-journal").mkdir()
    with pytest.raises(StoreError) as error:
        lock._locked_database(place / "store.lock")
    assert error.value.hint == "Check its owner and mode."
    assert error.value.message.startswith(f"{place / 'store.lock'} cannot be locked: ")


# -- a store in a backup -----------------------------------------------------------------------------------------------


class Dump:
    """The octets of a dump, as a backup gives them."""

    def __init__(self, octets: bytes) -> None:
        self.octets = octets

    def read_line(self, most: int) -> bytes:
        line, _, self.octets = self.octets.partition(b"\n")
        return line

    def read(self, length: int) -> bytes:
        given, self.octets = self.octets[:length], self.octets[length:]
        return given


def dumped(**changes: Any) -> Dump:
    return Dump(json.dumps({"schema": 15, "tables": {}, **changes}).encode() + b"\n" + dump._HEAD.pack(dump._END, 0))


@pytest.mark.parametrize(
    ("changes", "kind", "message"),
    [
        ({"schema": 6}, StoreError, "The store in the backup is of schema 6, from before KeyAgreement 2"),
        ({"schema": 0}, BadDataError, "The backup holds no store."),
        ({"schema": True}, BadDataError, "The backup holds no store."),
        ({"schema": "15"}, BadDataError, "The backup holds no store."),
        ({"schema": 99}, StoreError, "The store in the backup has schema 99; this version of the tool knows up to "),
        ({"tables": {"nodes": []}}, BadDataError, "The backup holds no store."),
        ({"tables": {"nodes": ["uuid, 1"]}}, BadDataError, "The backup holds no store."),
        ({"tables": {"nodes; --": ["uuid"]}}, BadDataError, "The backup holds no store."),
        ({"tables": ["nodes"]}, BadDataError, "The backup holds no store."),
        ({"tables": {"strange": ["uuid"]}}, BadDataError, "The store in the backup has an unknown table strange."),
        ({"tables": {"nodes": ["uuid"]}}, BadDataError, "The store in the backup has an unknown table nodes."),
    ],
)
def test_a_dump_that_is_no_store_of_this_version(changes: dict[str, Any], kind: type, message: str) -> None:
    with pytest.raises(kind) as error:
        dump.load(cast("Any", dumped(**changes)))
    assert error.value.message.startswith(message)


def test_a_dump_that_breaks_a_reference_or_finds_no_room(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = b"".join(dump.dump(store)) if hasattr(dump, "dump") else b""
    assert whole
    loaded = dump.load(cast("Any", Dump(whole)))
    assert loaded.id == store.id
    loaded.close()
    real = sqlite3.connect

    def loads(error: type[Exception] | None, *, referring: bool = False) -> None:
        made = real("", isolation_level=None)

        class Failing:
            def execute(self, statement: str, *values: Any) -> Any:
                if error is not None and statement == "COMMIT":
                    raise error("why")
                if referring and statement == "PRAGMA foreign_key_check":
                    return SimpleNamespace(fetchone=lambda: ("nodes", 1))
                return made.execute(statement, *values)

            def __getattr__(self, name: str) -> Any:
                return getattr(made, name)

        monkeypatch.setattr(dump, "sqlite3", SimpleNamespace(**{
            **{name: getattr(sqlite3, name) for name in ("IntegrityError", "DataError", "Error")},
            "connect": lambda *_, **__: Failing(),
        }))  # fmt: skip
        try:
            dump.load(cast("Any", Dump(whole)))
        finally:
            with pytest.raises(sqlite3.ProgrammingError, match="closed"):
                made.execute("SELECT 1")

    with pytest.raises(BadDataError) as error:
        loads(None, referring=True)
    assert error.value.message == "The store in the backup is damaged."
    for rule in (sqlite3.IntegrityError, sqlite3.DataError, lambda _: UnicodeDecodeError("utf-8", b"x", 0, 1, "no")):
        with pytest.raises(BadDataError) as error:
            loads(cast("Any", rule))
        assert error.value.message == "The store in the backup breaks a rule of its tables."
    with pytest.raises(StoreError) as failed:
        loads(sqlite3.OperationalError)
    assert (failed.value.message, failed.value.hint) == (
        "The backup cannot be unpacked: why.", "Free some space in the folder for temporary files."
    )  # fmt: skip


DAMAGED = "A row of the store in the backup is damaged."


def test_rows_of_a_backup_come_a_table_and_a_chunk_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dump, "CHUNK", 2)
    end = dump._HEAD.pack(dump._END, 0)
    rows = [(0, (1, None)), (0, ("é", b"\0")), (0, (-1, 0.5)), (2, ("x",)), (1, (2,))]
    octets = b"".join(dump._record(number, row) for number, row in rows)
    assert list(dump._chunks(cast("Any", Dump(octets + end)), [2, 1, 1])) == [
        (0, [(1, None), ("é", b"\0")]), (0, [(-1, 0.5)]), (2, [("x",)]), (1, [(2,)])
    ]  # fmt: skip
    assert list(dump._chunks(cast("Any", Dump(end)), [2])) == []
    one = dump._record(0, ("12345",))
    monkeypatch.setattr(dump, "MAX_RECORD_OCTETS", 10)
    assert list(dump._chunks(cast("Any", Dump(one + end)), [1])) == [(0, [("12345",)])]
    for damaged in (dump._HEAD.pack(1, 0), dump._HEAD.pack(0, 11), dump._HEAD.pack(dump._END, 1)):
        with pytest.raises(BadDataError, match=DAMAGED):
            list(dump._chunks(cast("Any", Dump(one + damaged + end)), [1]))


@pytest.mark.parametrize(
    "body",
    [
        b"", b"\0\0", b"\1\0\0\0", b"\4\0\0", b"\2\0\0\0\5four", b"\3\0\0\0\5four", b"\2\0\0\0\2\xff\xff",
        b"\5\0\0\0\0",
    ],
)  # fmt: skip
def test_a_row_of_a_backup_that_is_not_of_its_form_is_damaged(body: bytes) -> None:
    assert dump._row(b"\2\0\0\0\4four", 1) == ("four",)
    assert dump._row(b"\3\0\0\0\0\0", 2) == (b"", None)
    with pytest.raises(BadDataError) as error:
        dump._row(body, 1)
    assert error.value.message == DAMAGED


def test_a_row_that_no_backup_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dump, "MAX_RECORD_OCTETS", 10)
    assert len(dump._record(0, (b"12345",))) == dump._HEAD.size + 10
    with pytest.raises(StoreError) as error:
        dump._record(0, (b"123456",))
    assert (error.value.message, error.value.hint) == (
        "A row of the store is too large for a backup.", "Please report this."
    )  # fmt: skip


# -- samples -----------------------------------------------------------------------------------------------------------


def test_between_two_values_of_a_column(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(row_sample, "random", SimpleNamespace(randint=lambda low, high: high))
    assert [_between(2, 9), _between(2, 9, random_one=False), _between(2, 8, random_one=False)] == [9, 6, 5]
    assert _between("0a", "ff", random_one=False) == "85"
    assert _between("az", "zz", random_one=False) == "m", "texts that are no hex digits"
    assert _between(b"\x01", b"\x03\x00", random_one=False) == b"\x02\x00"


def test_a_damaged_table_ends_the_halving(monkeypatch: pytest.MonkeyPatch) -> None:
    def drawn(*ends: Any, lower: bool) -> Any:
        found = iter(ends)
        monkeypatch.setattr(row_sample, "random", SimpleNamespace(random=lambda: 0.4 if lower else 0.5))
        column = _Column(cast("Any", None), "nodes", "uuid", ())
        monkeypatch.setattr(_Column, "_end", lambda *_: next(found))
        value = column.drawn_by_halves()
        assert next(found, None) is None
        return value

    assert drawn(4, 4, lower=True) == 4
    assert drawn(1, 9, None, lower=True) == 1
    assert drawn(1, 9, 4, 1, lower=True) == 1
    assert drawn(1, 9, 7, 9, lower=False) == 9
    assert drawn("a", "b", "b", lower=False) == "b", "texts that are close have no middle: the last one is taken"


@pytest.mark.parametrize("after", range(1, 12))
def test_a_store_that_another_process_makes_at_this_moment_is_ours(
    after: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mark was read before the schema number: of two inits at once, one failed with "another program"."""
    plain, count = Database.execute, 0

    def execute(self: Database, statement: str, values: Any = ()) -> Any:
        nonlocal count
        count += 1
        if count == after:
            with monkeypatch.context() as undisturbed:
                undisturbed.setattr(Database, "execute", plain)
                Store.open(tmp_path / "home", create=True).close()
        return plain(self, statement, values)

    monkeypatch.setattr(Database, "execute", execute)
    Store.open(tmp_path / "home", create=True).close()
    assert count >= after


def test_a_database_of_another_program_is_left_alone(tmp_path: Path) -> None:
    home = tmp_path / "home"
    Store.open(home, create=True).close()
    [file] = [path for path in home.iterdir() if path.suffix == ".sqlite3"]
    for mark, version in ((7, 15), (7, 0), (0, 15)):
        with closing(sqlite3.connect(file)) as other:
            other.execute(f"PRAGMA application_id={mark}")
            other.execute(f"PRAGMA user_version={version}")
        with pytest.raises(StoreError, match="is a database of another program"):
            Store.open(home, create=True)
