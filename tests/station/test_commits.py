"""How often a provisioning waits for the disk: the aims of issue 13 row 1 and issue 8."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import LinkError, StoreError
from teds_provision.protocol.messages.frames import Command
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.station.station import Station
from teds_provision.station.store.audit import ACTOR
from teds_provision.station.store.records import NodeRecord
from tests.bench import Board, MemoryLink, make_station, talk
from tests.work import COUNTS_BLOCKS, kept_by_each_thread

_CHANGES = ("INSERT", "UPDATE", "DELETE", "REPLACE")


@dataclass
class StatementLog:
    """What SQLite was told to do."""

    station: Station
    statements: list[str] = field(default_factory=list)
    waited: int = 0
    """Commits of the last run that waited for the disk."""

    def run(self, board: Board) -> tuple[int, int]:
        """Provision once; returns rows written, and commits that wrote something."""
        self.statements.clear()
        with talk(board) as node:
            order = BuildOrder("temperature-sensor")
            provision(self.station, node, order, operator=AcceptingOperator(), reporter=SilentReporter())
        rows = commits = open_rows = self.waited = 0
        last, waits = "", True
        for statement in self.statements:
            word = statement.split(maxsplit=1)[0]
            if word in _CHANGES and statement != last:  # SQLite traces a statement once more for its trigger
                rows += 1
                open_rows += 1
            elif word == "COMMIT":
                commits += open_rows > 0
                self.waited += open_rows > 0 and waits
                open_rows = 0
            elif statement.startswith("PRAGMA synchronous"):
                waits = statement.endswith("FULL")
            last = statement
        assert open_rows == 0, "a row was written outside a transaction"
        return rows, commits


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[StatementLog]:
    watched = StatementLog(make_station(tmp_path / "home"))
    watched.station._store._connection.set_trace_callback(watched.statements.append)
    yield watched
    watched.station.close()


@pytest.fixture
def synced(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the files that this process waited for by itself, beside what SQLite does."""
    names: list[str] = []
    monkeypatch.setattr(
        "os.fdatasync", lambda descriptor: names.append(Path(os.readlink(f"/proc/self/fd/{descriptor}")).name)
    )
    return names


def test_a_whole_provisioning_is_eight_commits_at_most_and_waits_for_the_disk_three_times(
    watched: StatementLog, synced: list[str]
) -> None:
    """The pending key before Confirm, the sequence before the signature leaves, and the verdict with all before it."""
    _, commits = watched.run(Board())
    assert commits <= 8
    assert watched.waited == 2
    assert synced == ["store.sqlite3-wal"]


def test_the_key_is_on_the_disk_before_its_confirmation_leaves_and_the_sequence_before_the_signature(
    watched: StatementLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The signature is in the TEDS that is written last; the others may go while the disk is waited for."""
    steps: list[str] = []
    plain, send = os.fdatasync, Conversation.request
    slowly = threading.Event()

    def synced(descriptor: int) -> None:
        slowly.wait(0.2)  # never set: a slow disk
        plain(descriptor)
        steps.append("on the disk")

    def sent(node: Conversation, command: Command, doing: str, *, within: float | None = None) -> bytes:
        steps.append(doing)
        return send(node, command, doing, within=within)

    def stated(statement: str) -> None:
        if statement == "COMMIT":
            if threading.current_thread() is not threading.main_thread():
                slowly.wait(0.2)
            steps.append("commit")

    monkeypatch.setattr("os.fdatasync", synced)
    monkeypatch.setattr(Conversation, "request", sent)
    watched.station._store._connection.set_trace_callback(stated)
    with talk(Board()) as node:
        provision(
            watched.station,
            node,
            BuildOrder("temperature-sensor"),
            operator=AcceptingOperator(),
            reporter=SilentReporter(),
        )
        steps.append("told")
    of_teds = [doing for doing in steps if doing.startswith(("TEDS", "on the disk", "the commit"))]
    assert of_teds[-3:] == ["on the disk", "TEDS 128 of channel 0", "the commit"]
    assert "TEDS 1 of channel 0" in of_teds[:-3]
    assert steps[steps.index("the key confirmation") - 1] == "commit"
    assert steps[-4:] == ["to report its mode", "to close the session", "commit", "told"], "Close rests on no record"


def test_a_run_that_ends_early_is_on_the_disk_all_the_same(watched: StatementLog, synced: list[str]) -> None:
    """Identify is written to the log and not waited for: the next step was to do that."""
    link = MemoryLink(Board(), lose_request=3)
    with pytest.raises(LinkError), talk(link.board, link) as node:
        provision(
            watched.station,
            node,
            BuildOrder("temperature-sensor"),
            operator=AcceptingOperator(),
            reporter=SilentReporter(),
        )
    assert synced == ["store.sqlite3-wal"]


def test_what_comes_later_is_on_the_disk_with_the_next_entry_or_when_it_is_asked_for(
    watched: StatementLog, synced: list[str]
) -> None:
    station, node = watched.station, NodeRecord(bytes(10))
    store = station._store
    with store.transaction(later=True):
        station.nodes.restore(node)
    with store.transaction():
        station.nodes.restore(node)  # the same again: SQLite may find nothing to write
    store.flush()
    assert synced == ["store.sqlite3-wal"]
    with store.transaction(later=True):
        station.nodes.restore(node)
    store.audit.append("identify", node.uuid, "done")
    store.flush()
    assert synced == ["store.sqlite3-wal"]


def test_a_step_by_itself_never_comes_later(watched: StatementLog) -> None:
    """Only a run of steps may leave one to the next; ``identify`` alone waits."""
    with watched.station.durable("identify", more_follows=True):
        watched.station.audit("identify", None, "done")
    assert "PRAGMA synchronous=NORMAL" not in watched.statements


def test_the_stations_facts_are_never_older_than_the_store(watched: StatementLog) -> None:
    """They are remembered: another process, and a change that was taken back, must be seen."""
    here = watched.station
    there = Station.open(here.home, ask=lambda prompt, confirm: pytest.fail("no secret is needed"))
    try:
        assert here.identity.master == there.identity.master == 1
        there.identity.begin_rewrapping(2)
        assert here.identity.master == 2
        with here.transaction():
            assert here.identity.master == 2
        with suppress(InterruptedError), here.transaction():
            here.identity.begin_rewrapping(3)
            assert here.identity.master == 3
            raise InterruptedError
        assert here.identity.master == 2
    finally:
        there.close()


def test_a_provisioning_with_nothing_to_do_writes_four_rows_and_waits_twice_for_the_disk(watched: StatementLog) -> None:
    board = Board()
    watched.run(board)
    for _ in range(2):
        rows, commits = watched.run(board)
        assert rows <= 4
        assert commits <= 2


def test_a_run_does_not_wait_for_what_another_thread_has_written_since(
    watched: StatementLog, synced: list[str]
) -> None:
    """Eight readers on one store would wait for each other's steps."""
    other_is_going, this_is_done = threading.Event(), threading.Event()

    def other() -> None:
        with watched.station.run():
            with watched.station.durable("identify", more_follows=True):
                watched.station.audit("identify", None, "done")
            other_is_going.set()
            this_is_done.wait(60)

    reader = threading.Thread(target=other)
    with watched.station.run():
        with watched.station.durable("identify", more_follows=True):
            watched.station.audit("identify", None, "done")
        with watched.station.durable("sign"):
            watched.station.audit("sign", None, "done")
        reader.start()
        assert other_is_going.wait(60)
    assert synced == []
    this_is_done.set()
    reader.join(60)
    assert synced == ["store.sqlite3-wal"]


def test_what_is_not_waited_for_does_not_bring_what_came_before_onto_the_disk(
    watched: StatementLog, synced: list[str]
) -> None:
    """Two readers: the second one's step that comes later said nothing about the first one's."""
    with watched.station.run():
        for act in ("identify", "whitelist"):
            with watched.station.durable(act, more_follows=True):
                watched.station.audit(act, None, "done")
        watched.station._store.flush(1)
        assert synced == ["store.sqlite3-wal"]


def test_nothing_that_a_provisioning_or_a_look_up_asks_reads_a_whole_table(watched: StatementLog) -> None:
    """They cost the same with a hundred thousand nodes; the list of trusted stations is short, and read whole."""
    station, board = watched.station, Board()
    watched.run(board)
    station.overview.is_known(board.uuid)
    station.nodes.resolve(board.uuid.hex()[:8])
    station.nodes.named("finger-1")
    asked = {statement for statement in watched.statements if statement.startswith(("SELECT", "UPDATE", "DELETE"))}
    assert len(asked) > 20
    plans = {name: [row[3] for row in station._store.execute(f"EXPLAIN QUERY PLAN {name}")] for name in asked}
    one_row = {"SCAN trust", "SCAN station", "SCAN plant", "SCAN CONSTANT ROW"}  # or as many as there are stations
    whole = {
        asked_for
        for asked_for, plan in plans.items()
        if any(step.startswith("SCAN") and step not in one_row for step in plan)
    }
    assert {name for name in whole if not name.endswith("FROM audit ORDER BY seq DESC LIMIT 1")} == set()


def test_what_a_run_asks_of_the_store_comes_after_the_steps_that_it_takes_behind_its_back(
    watched: StatementLog,
) -> None:
    station, free = watched.station, threading.Event()

    def slow() -> None:
        free.wait(0.2)  # nobody sets it
        with station.durable("agree", more_follows=True):
            station.nodes.remember(bytes(10), name="left")

    with station.run():
        station.run_in_background(slow)
        assert station.nodes.get(bytes(10)) == NodeRecord(bytes(10), name="left")
        station.run_in_background(slow)
        with station.durable("sign"):  # takes the locks that the step takes too
            station.nodes.remember(bytes(10), name="right")
    record = station.nodes.get(bytes(10))
    assert record is not None
    assert record.name == "right"
    assert "durable steps" not in {thread.name for thread in threading.enumerate()}


def test_a_step_that_fails_behind_a_run_fails_the_run(watched: StatementLog) -> None:
    """At what it asks of the store next, or at its end; never in silence."""
    station, went_on = watched.station, []

    def full() -> None:
        raise StoreError("The disk is full.")

    def ask() -> None:
        with station.run():
            station.run_in_background(full)
            station.nodes.get(bytes(10))
            went_on.append("after a question")

    def end() -> None:
        with station.run():
            station.run_in_background(full)
            went_on.append("at the end")

    for run in (ask, end):
        with pytest.raises(StoreError, match="full"):
            run()
    with pytest.raises(StoreError, match="full"):
        station.run_in_background(full)
    assert went_on == ["at the end"]


def test_what_is_done_behind_a_run_is_done_by_the_same_person(watched: StatementLog) -> None:
    before = ACTOR.set("token lab")
    try:
        with watched.station.run():
            watched.station.run_in_background(lambda: watched.station.audit("agree", None, "done"))
    finally:
        ACTOR.reset(before)
    assert [entry.who for entry in watched.station.audit_log.entries()][-1] == "token lab"


def test_what_joins_the_next_durable_step_is_written_with_it_and_kept_with_it(watched: StatementLog) -> None:
    station, names = watched.station, ["left", "right"]
    kept: list[str] = []

    def join(name: str) -> None:
        uuid = bytes([names.index(name)]) * 10
        station.join_next_step(lambda: station.nodes.remember(uuid, name=name), lambda: kept.append(name))

    def known() -> list[str | None]:
        return [row.name for row in station.nodes.all()]

    with station.run():
        join("left")
        join("right")
        assert (known(), kept) == ([], [])

        def undone() -> None:
            with station.durable("agree"):
                assert known() == names
                raise StoreError("The step is undone, and they with it.")

        with pytest.raises(StoreError, match="undone"):
            undone()
        assert (known(), kept) == ([], [])
        watched.statements.clear()
        with station.durable("agree"):
            assert kept == []
        assert (known(), kept) == (names, names)
        assert watched.statements.count("COMMIT") == 1
        with station.durable("agree"):
            pass
    assert kept == names


def test_what_no_step_takes_is_written_at_the_end_of_a_run_however_it_ends(watched: StatementLog) -> None:
    station = watched.station

    def cut_short() -> None:
        with station.run():
            station.join_next_step(lambda: station.nodes.remember(bytes(10), name="left"))
            raise LinkError("It was pulled.")

    with pytest.raises(LinkError):
        cut_short()
    assert station.nodes.named("left") is not None
    station.join_next_step(lambda: station.nodes.remember(bytes([1]) * 10, name="right"))
    assert station.nodes.named("right") is not None, "outside a run at once"


def test_an_error_of_what_joins_a_step_is_that_steps_and_it_is_not_tried_again(watched: StatementLog) -> None:
    station, tries = watched.station, []

    def full() -> None:
        tries.append("a try")
        raise StoreError("No unit is left.")

    with station.run():
        station.join_next_step(lambda: station.nodes.remember(bytes(10), name="left"))
        station.join_next_step(full)
        with pytest.raises(StoreError, match="No unit"), station.durable("agree"):
            tries.append("the step itself")
        assert station.nodes.named("left") is None
        with station.durable("agree"):
            pass
    assert tries == ["a try"]
    assert station.nodes.named("left") is not None


def test_rows_of_a_chunk_of_nodes_are_found_among_many_others_and_with_none_between(watched: StatementLog) -> None:
    """One walk over the index where all between are asked for, look-ups where others are."""
    station = watched.station
    uuids = [number.to_bytes(10, "big") for number in range(400)]
    with station.transaction():
        for uuid in uuids:
            station.nodes.put(NodeRecord(uuid, name=uuid.hex()))
    absent = [(1000 + number).to_bytes(10, "big") for number in range(40)]
    for asked in (uuids[:100], uuids[::7], uuids[:5], [*reversed(uuids[:50]), *absent], absent, []):
        watched.statements.clear()
        found = station.nodes.get_many(asked)
        assert found.keys() == {uuid for uuid in asked if uuid in uuids}
        assert all(record.name == uuid.hex() for uuid, record in found.items())
    assert station.keys.get_many(uuids) == []


def test_a_damaged_row_between_the_nodes_of_a_chunk_is_an_error_of_the_store(watched: StatementLog) -> None:
    uuids = [number.to_bytes(10, "big") for number in range(40)]

    def unreadable(uuid: bytes, name: str) -> bytes:
        raise ValueError(name)

    with watched.station.transaction():
        for uuid in uuids:
            watched.station.nodes.put(NodeRecord(uuid, name=uuid.hex()))
    with pytest.raises(StoreError, match="damaged"):
        watched.station._store.read_of_nodes(unreadable, "SELECT uuid, name FROM nodes", uuids)


_STATEMENTS = """
import sqlite3
from collections import deque
from pathlib import Path
from teds_provision.station.store.connection import Connection

store = Connection(Path("store"), sqlite3.connect(":memory:", check_same_thread=False, isolation_level=None))
others = deque(maxlen=100)

def begin():
    def act():
        for _ in range(9):
            store.execute("SELECT 1")
            others.append(bytes(1500))  # what is in between, so that no block grows where it is; too long for a cache
    return act
"""


@pytest.mark.slow
@pytest.mark.skipif(not COUNTS_BLOCKS, reason="the C library does not count its blocks")
def test_statements_leave_nothing_in_the_cache_of_each_nodes_thread() -> None:
    """The connection's list of cursors was made longer by all threads in turn: each kept its former memory."""
    assert kept_by_each_thread(_STATEMENTS, first=3, rounds=90) < 1500


def test_a_flush_waits_first_for_what_is_still_written_behind_the_run(watched: StatementLog) -> None:
    """It would else bring the commits before onto the disk, and report the newest as kept."""
    store = watched.station._store
    waits: list[int] = []
    behind: Any = SimpleNamespace(wait=lambda: waits.append(store._settled))
    store.background[threading.get_ident()] = behind
    try:
        store.flush()
        assert len(waits) == 1
        store.flush(through=0)
        assert len(waits) == 2
    finally:
        del store.background[threading.get_ident()]
