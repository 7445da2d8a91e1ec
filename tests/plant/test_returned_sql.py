"""Schema 2: pages of stations that are no open member, handed in by others; and what a member may not do with them."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Iterator
from typing import Any

import psycopg
import pytest
from psycopg import errors

from teds_provision.plant.demo.cluster import Cluster
from teds_provision.plant.schema import close_sql, member_sql, registry_sql
from teds_provision.plant.scram import verifier
from tests.pace import PATIENCE
from tests.plant.postgres import Database, Login
from tests.plant.test_thief import append, digest, page

pytestmark = pytest.mark.system

Connection = psycopg.Connection[tuple[Any, ...]]
DENIED = errors.InsufficientPrivilege
LIMIT = 64 << 20


def restore(connection: Connection, author: str, n: int, text: str) -> bool:
    row = connection.execute("select registry.restore(%s, %s, %s)", (bytes.fromhex(author), n, text)).fetchone()
    assert row is not None
    return bool(row[0])


def rows_of(connection: Connection, author: str) -> list[tuple[int, bytes, str]]:
    found = connection.execute(
        "select n, hash, encode(by, 'hex') from registry.found where author = %s order by n, by",
        (bytes.fromhex(author),),
    )
    return [(n, bytes(hash), by) for n, hash, by in found]


@pytest.fixture
def author() -> str:
    """Return a station of which the database has no row."""
    return os.urandom(32).hex()


@pytest.fixture
def login(database: Database) -> Login:
    return database.member()


@pytest.fixture
def own(login: Login) -> Iterator[Connection]:
    with login.connect() as connection:
        yield connection


def test_a_page_of_a_station_without_a_row_is_taken_once(own: Connection, login: Login, author: str) -> None:
    text = page()
    assert restore(own, author, 7, text)
    assert not restore(own, author, 7, text)
    with login.database.member().connect() as other:
        assert not restore(other, author, 7, text)
        assert rows_of(other, author) == [(7, digest(text), login.fingerprint)]


def test_a_forged_signature_keeps_no_other_page_out(own: Connection, login: Login, author: str) -> None:
    """The same signing input has the same H: the row of who hands in first is not the only one."""
    text = page()
    forged = text[:-1] + "t"
    assert restore(own, author, 1, forged)
    with login.database.member().connect() as other:
        assert restore(other, author, 1, text)
        assert len(rows_of(other, author)) == 2


def test_a_closed_member_is_an_author_and_hands_nothing_in(own: Connection, login: Login, author: str) -> None:
    gone = login.database.member()
    with gone.connect() as connection:
        text = page()
        append(connection, 1, b"", text)
        login.database.sql(f"update registry.member set open = false where role = '{gone.role}'")
        with pytest.raises(psycopg.Error) as closed:
            restore(connection, author, 1, page())
        assert closed.value.sqlstate == "TE001"
    assert not restore(own, gone.fingerprint, 1, text), "the page is there"
    assert restore(own, gone.fingerprint, 2, page())


def test_the_chain_of_an_open_member_is_its_own(own: Connection, login: Login) -> None:
    for victim in (login.database.member(), login):
        with pytest.raises(psycopg.Error) as refused:
            restore(own, victim.fingerprint, 1, page())
        assert refused.value.sqlstate == "TE006"


@pytest.mark.parametrize("isolation", ["repeatable read", "serializable"])
def test_the_limit_is_not_read_from_an_old_snapshot(own: Connection, author: str, isolation: str) -> None:
    own.execute(f"set default_transaction_isolation = '{isolation}'")
    with pytest.raises(psycopg.Error) as refused:
        restore(own, author, 1, page())
    assert refused.value.sqlstate == "TE005"


@pytest.mark.parametrize(
    ("number", "text", "author_octets"),
    [
        (0, page(), 32),
        (-1, page(), 32),
        (1, "h.x.s", 32),
        (1, page("x" * (1 << 20)), 32),
        (1, page(), 31),
        (1, page(), 0),
    ],
)
def test_what_is_no_page_is_not_taken(own: Connection, number: int, text: str, author_octets: int) -> None:
    with pytest.raises(errors.CheckViolation):
        restore(own, os.urandom(author_octets).hex(), number, text)


def test_null_is_not_taken(own: Connection, author: str) -> None:
    for values in ((None, 1, page()), (bytes.fromhex(author), None, page()), (bytes.fromhex(author), 1, None)):
        with pytest.raises(psycopg.Error):
            own.execute("select registry.restore(%s, %s, %s)", values)


def test_a_flood_ends_at_64_mebibytes_and_holds_up_no_other_member(own: Connection, login: Login, author: str) -> None:
    large = "x" * ((1 << 20) - 150)
    for n in range(1, 65):
        restore(own, author, n, page(large + os.urandom(8).hex()))
    with pytest.raises(psycopg.Error) as full:
        restore(own, author, 65, page(large))
    assert full.value.sqlstate == "TE004"
    total = own.execute(
        "select count(*), sum(octet_length(jws)) from registry.found where by = %s", (bytes.fromhex(login.fingerprint),)
    ).fetchone()
    assert total is not None
    assert total[0] == 64
    assert total[1] <= LIMIT
    with login.database.member().connect() as other:
        assert restore(other, author, 1, page())


def test_many_small_rows_count_for_more_than_their_octets(own: Connection, login: Login, author: str) -> None:
    login.database.sql(
        "insert into registry.handed values "
        f"('\\x{author}', '\\x{login.fingerprint}', 65535, 1024 * 65535::bigint, now())"
    )
    assert restore(own, author, 1, page())
    with pytest.raises(psycopg.Error) as full:
        restore(own, author, 2, page())
    assert full.value.sqlstate == "TE004"


def test_two_sessions_of_a_member_share_its_limit(login: Login, author: str) -> None:
    login.database.sql(
        "insert into registry.handed values "
        f"('\\x{author}', '\\x{login.fingerprint}', 65535, 1024 * 65535::bigint, now())"
    )
    refused: list[str | None] = []
    with login.connect() as session, login.connect() as two:
        with session.transaction():
            restore(session, author, 1, page())

            def second() -> None:
                try:
                    restore(two, author, 2, page())
                except psycopg.Error as error:
                    refused.append(error.sqlstate)

            waits = threading.Thread(target=second)
            waits.start()
            waits.join(0.2)
        waits.join(PATIENCE)
    assert refused == ["TE004"]


@pytest.mark.parametrize(
    "statement",
    [
        "insert into registry.found select station, 1, '\\x00', repeat('x', 100), station from registry.member",
        "update registry.found set by = '\\x00'",
        "delete from registry.found",
        "truncate registry.found",
        "delete from registry.handed",
        "update registry.handed set octets = 0",
        "insert into registry.handed select station, station, 0, -1000000000, now() from registry.member",
        "lock table registry.found in exclusive mode",
        "select * from registry.handed for update",
        "create or replace function registry.restore(bytea, int, text) returns boolean language sql as 'select true'",
        "alter function registry.restore(bytea, int, text) security invoker",
        "drop table registry.found",
    ],
)
def test_a_member_changes_no_row_but_by_the_function(own: Connection, statement: str) -> None:
    with pytest.raises(DENIED), own.transaction():
        own.execute(statement)


def test_the_own_search_path_does_not_reach_the_function(own: Connection, login: Login, author: str) -> None:
    own.execute("set search_path = pg_temp, public, registry")
    text = page()
    assert restore(own, author, 1, text)
    assert rows_of(own, author) == [(1, hashlib.sha256(text.rpartition(".")[0].encode()).digest(), login.fingerprint)]


def test_a_reader_hands_nothing_in(login: Login) -> None:
    with pytest.raises(Exception, match="permission denied for function restore"):
        login.database.sql(
            "set role teds_reader; select count(*) from registry.found; select registry.restore('', 1, '')"
        )


def test_schema_1_becomes_schema_2_and_keeps_what_it_has(cluster: Cluster) -> None:
    database = Database.new(cluster)
    login = database.member()
    with login.connect() as connection:
        text = page()
        append(connection, 1, b"", text)
    as_schema_1(database)
    for _ in range(2):
        database.sql(registry_sql(database.registry))
        assert database.sql("select version, registry from registry.meta") == [["2", database.registry]]
        with login.connect() as connection:
            append(connection, 1, b"", text)
            restore(connection, os.urandom(32).hex(), 1, page())
    assert database.sql("select count(*) from registry.found") == [["2"]]


def as_schema_1(database: Database) -> None:
    """Make of a database what the program before this one printed."""
    database.sql(
        "drop function registry.restore(bytea, int, text); drop table registry.found, registry.handed;"
        " update registry.meta set version = 1"
    )


def test_an_author_that_returns_as_a_member_is_its_own_again(own: Connection, login: Login, author: str) -> None:
    assert restore(own, author, 1, page())
    back = Login(login.database, author)
    login.database.sql(member_sql(back.fingerprint, verifier(back.secret)))
    with pytest.raises(psycopg.Error) as refused:
        restore(own, author, 2, page())
    assert refused.value.sqlstate == "TE006"
    with back.connect() as connection:
        append(connection, 1, b"", page())
    login.database.sql(close_sql(author))
    assert restore(own, author, 2, page())
