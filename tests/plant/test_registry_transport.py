"""The registry as a transport, without a database: what a sync asks of it, and how its errors read for people."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from typing import Any, cast

import psycopg
import pytest

from teds_provision.errors import ForkError, NotMemberError, PolicyError, RegistryError, StoreError, TedsProvisionError
from teds_provision.plant import postgres
from teds_provision.plant.postgres import DatabaseState, PostgresTransport, Registry, WaitingParcel, where_of
from teds_provision.plant.transport import CarriedPage, Offer, Parcel

OWN, WEST, GONE = "aa" * 32, "bb" * 32, "cc" * 32
UNTIL = datetime(2026, 3, 1, 13, tzinfo=timezone(timedelta(hours=1)))
SMALL, LARGE = bytes(8 << 20), bytes((8 << 20) + 1)


class Database:
    """What a login at the registry gives, and notes what is asked of it."""

    def __init__(self) -> None:
        self.state = DatabaseState(
            "the registry", (b"roster 1", b"roster 2"), b"roster 1",
            {OWN: (5, "05" * 32), WEST: (3, "03" * 32), GONE: (0, "")},
            (WaitingParcel("one", WEST, OWN, 4, UNTIL), WaitingParcel("two", OWN, WEST, 4, UNTIL),
             WaitingParcel("three", WEST, OWN, 4, UNTIL)),
            (5, b"page 5"), frozenset((OWN, WEST)), {GONE: ("by a", "by b")},
        )  # fmt: skip
        self.log: list[Any] = []

    def look(self) -> DatabaseState:
        self.log.append("look")
        return self.state

    def pages(self, after: Mapping[str, int]) -> Iterator[tuple[str, int, bytes]]:
        self.log.append(("pages", dict(after)))
        for station, n in after.items():
            yield station, n + 1, b"octets"

    def parcel(self, parcel: str) -> bytes | None:
        self.log.append(("parcel", parcel))
        return None if parcel == "three" else b"sealed"

    def __getattr__(self, name: str) -> Any:
        def asked(*given: Any) -> list[Any]:
            self.log.append((name, *given))
            return []

        return asked


@pytest.fixture
def database() -> Database:
    return Database()


@pytest.fixture
def transport(database: Database) -> PostgresTransport:
    return PostgresTransport(cast("Registry", database), "postgresql://office/plant", OWN)


def test_a_sync_looks_once_unless_it_begins_again(transport: PostgresTransport, database: Database) -> None:
    assert (transport.carries_all, transport.where) == (False, "postgresql://office/plant")
    assert list(transport.rosters()) == [b"roster 1", b"roster 2"]
    assert transport.heads() == {OWN: 5, WEST: 3}
    assert database.log == ["look"]
    assert transport.registry() == "the registry"
    assert database.log == ["look", "look"]


def test_a_roster_is_posted_if_it_is_another_one(transport: PostgresTransport, database: Database) -> None:
    transport.post_roster(1, "H", b"roster 1")
    assert database.log == ["look"]
    transport.post_roster(2, "H", b"roster 2")
    assert database.log[1:] == [("post_roster", 2, b"roster 2")]


def test_pages_are_asked_for_only_where_there_are_some(transport: PostgresTransport, database: Database) -> None:
    transport.registry()
    assert list(transport.pages(OWN, 4)) == [CarriedPage(OWN, 5, b"page 5")], "the newest came with the look"
    assert list(transport.pages(WEST, 3)) == []
    assert list(transport.pages(GONE, 0)) == []
    assert list(transport.pages("dd" * 32, 0)) == []
    assert database.log == ["look"]
    assert list(transport.pages(OWN, 3)) == [CarriedPage(OWN, 4, b"octets")]
    assert list(transport.pages(WEST, 2)) == [CarriedPage(WEST, 3, b"octets")]
    database.state = replace(database.state, newest=(4, b"page 4"))
    transport.registry()
    assert list(transport.pages(OWN, 4)) == [CarriedPage(OWN, 5, b"octets")]
    assert [entry for entry in database.log if entry != "look"] == [
        ("pages", {OWN: 3}), ("pages", {WEST: 2}), ("pages", {OWN: 4})
    ]  # fmt: skip


def test_parcels_for_this_station_are_fetched_and_those_that_are_gone_left_out(
    transport: PostgresTransport, database: Database
) -> None:
    assert list(transport.parcels(OWN)) == [Parcel("one", OWN, b"sealed", "2026-03-01T12:00:00+00:00", WEST)]
    assert database.log == ["look", ("parcel", "one"), ("parcel", "three")]


def test_a_large_parcel_is_sent_once_and_a_small_one_each_time(
    transport: PostgresTransport, database: Database
) -> None:
    expires = "2026-03-01T12:00:00+00:00"
    sent = datetime(2026, 3, 1, 12, tzinfo=UTC)
    transport.registry()
    transport.send(Parcel("two", WEST, SMALL, expires, OWN))
    transport.send(Parcel("two", WEST, LARGE, expires, OWN))
    transport.send(Parcel("four", WEST, LARGE, expires, OWN))
    assert database.log[1:] == [("send", "two", WEST, SMALL, sent), ("send", "four", WEST, LARGE, sent)]
    transport.drop("one", OWN)
    transport.append(OWN, 6, "05" * 32, "06" * 32, b"page 6")
    list(transport.new_parcels(OWN, ["one"]))
    assert database.log[3:] == [
        ("remove", ["one"]), ("append", [(6, "05" * 32, b"page 6")]), ("small_parcels", OWN, ["one"])
    ]  # fmt: skip


def test_what_others_handed_in_of_a_station(transport: PostgresTransport, database: Database) -> None:
    returned = transport.returned
    assert returned is not None
    assert [returned.is_open(station) for station in (OWN, WEST, GONE)] == [True, True, False]
    assert [returned.was_handed_in(station) for station in (WEST, GONE)] == [False, True]
    assert [returned.head(station) for station in (WEST, GONE, "dd" * 32)] == [3, 0, 0]
    assert returned.state(WEST) == ""
    assert returned.state(GONE) == f"{GONE} False 0  by a by b"
    assert returned.state("dd" * 32) == f"{'dd' * 32} False 0 "
    database.state = replace(database.state, handed_in={WEST: ("by c",)}, schema=1)
    transport.registry()
    assert returned.state(WEST) == f"{WEST} True 3 {'03' * 32} by c"
    assert not returned.takes_pages
    database.state = replace(database.state, schema=2)
    transport.registry()
    assert returned.takes_pages
    offer = Offer(GONE, 3, "H", "D", "")
    assert (returned.offers(GONE), returned.octets([offer])) == ([], [])
    returned.restore(GONE, [(3, b"page")])
    assert database.log[-3:] == [("offers", GONE), ("offered", [offer]), ("restore", GONE, [(3, b"page")])]


def test_what_was_handed_in_is_one_text_by_author_and_sender() -> None:
    rows = [
        ("head", bytes.fromhex(OWN), 3, "H", None, None),
        ("handed", bytes.fromhex(GONE), 2, "t2", bytes.fromhex(WEST), None),
        ("handed", bytes.fromhex(GONE), 9, "t1", bytes.fromhex(OWN), None),
        ("handed", bytes.fromhex(WEST), 1, "t3", bytes.fromhex(OWN), None),
    ]
    assert postgres._handed_in(rows) == {GONE: (f"{OWN}:9:t1", f"{WEST}:2:t2"), WEST: (f"{OWN}:1:t3",)}


@pytest.mark.parametrize(
    ("url", "where"),
    [
        ("postgresql://office/plant?sslrootcert=/x", "postgresql://office/plant"),
        ("postgres://office:5433/plant", "postgresql://office:5433/plant"),
        ("postgresql://user:secret@office/plant", "postgresql://office/plant"),
    ],
)
def test_a_registry_is_called_by_host_and_database(url: str, where: str) -> None:
    assert where_of(url) == where


def error(state: str | None, text: str) -> psycopg.Error:
    made = psycopg.Error(text)
    made.sqlstate = state
    return made


@pytest.mark.parametrize(
    ("state", "text", "late", "kind", "code", "message"),
    [
        ("TE001", "x", False, NotMemberError, 6, "The database does not list this station's login as open"),
        ("TE002", "page 3", False, ForkError, 4, "The registry rejected a page: page 3"),
        ("TE003", "page 3", False, StoreError, 7, "The registry rejected a page: page 3"),
        ("TE004", "100 pages", False, PolicyError, 6, "The registry accepts no more from this station: 100 pages."),
        ("TE006", "x", False, PolicyError, 6, "The author of these pages is an open member"),
        ("23505", "x", True, TedsProvisionError, 1, "A parcel with this ID already exists."),
        ("53100", "disk full", False, RegistryError, 5, "The database is full: disk full"),
        ("53200", "out of memory", True, RegistryError, 5, "The database is full: out of memory"),
        ("42P01", "x", False, StoreError, 7, "The database does not contain a registry."),
        ("3F000", "x", False, StoreError, 7, "The database does not contain a registry."),
        ("42883", "x", False, StoreError, 7, "The database does not contain a registry."),
        ("42703", "x", False, StoreError, 7, "The database does not contain a registry."),
        ("42501", "denied", False, StoreError, 7, "The database does not allow a member to do this: denied"),
        (None, "x", True, RegistryError, 5, "The registry did not answer in time."),
        (None, 'role "x" is not permitted to log in', False, RegistryError, 5, "refuses this station's login: role"),
        (None, "FATAL: password authentication failed", False, RegistryError, 5, "refuses this station's login: FATAL"),
        ("57P01", "going down", False, RegistryError, 5, "Cannot use the registry: going down"),
    ],
)
def test_an_error_of_the_database_in_words(
    state: str | None, text: str, late: bool, kind: type[TedsProvisionError], code: int, message: str
) -> None:
    found = postgres._failure(error(state, text), late=late)
    assert isinstance(found, kind)
    assert message in found.message
    if kind is not TedsProvisionError:
        assert found.exit_code == code
        assert found.hint or state == "TE006"
    assert not isinstance(found, StoreError) or state in ("TE003", "42P01", "3F000", "42883", "42703", "42501")


def test_a_foreign_message_is_its_first_line_without_control_characters() -> None:
    assert postgres._words(error(None, "\n\n  first\x1b[31m  \nsecond")) == "first\N{REPLACEMENT CHARACTER}[31m"
    assert postgres._words(error(None, "x" * 301)) == "x" * 300
    assert postgres._words(error(None, "")) == "Error"


@pytest.mark.parametrize("fails", [True, False])
def test_a_connection_is_cut_only_while_its_block_takes_longer(monkeypatch: pytest.MonkeyPatch, fails: bool) -> None:
    timers, shut, ended = list[Any](), list[object](), threading.Event()

    class Timer:
        daemon = False

        def __init__(self, seconds: float, cut: Callable[[], None]) -> None:
            self.seconds, self.cut, self.log = seconds, cut, list[str]()
            timers.append(self)

        def start(self) -> None:
            self.log.append(f"start, daemon {self.daemon}")

        def cancel(self) -> None:
            self.log.append("cancel")

    def block() -> None:
        with postgres._cut_after(connection, 2.5, ended):
            if fails:
                raise KeyError

    connection: Any = object()
    monkeypatch.setattr(postgres.threading, "Timer", Timer)
    monkeypatch.setattr(postgres, "_shut", shut.append)
    if fails:
        with pytest.raises(KeyError):
            block()
    else:
        block()
    [timer] = timers
    assert (timer.seconds, timer.log, ended.is_set(), shut) == (2.5, ["start, daemon True", "cancel"], False, [])
    timer.cut()
    assert (ended.is_set(), shut) == (True, [connection])


@pytest.mark.parametrize("error", [OSError("It is closed."), psycopg.OperationalError("It is lost.")])
def test_a_connection_that_is_gone_is_shut_without_a_word(error: Exception) -> None:
    class Gone:
        @property
        def pgconn(self) -> Any:
            raise error

    postgres._shut(cast("Any", Gone()))
