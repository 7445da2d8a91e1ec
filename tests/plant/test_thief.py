"""Everything that a thief with a station's login tried at a real server (plant.md section 12)."""

from __future__ import annotations

import hashlib
import os
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import psycopg
import pytest
from psycopg import errors

from teds_provision.plant.schema import close_sql, member_sql, mend_sql, registry_sql
from teds_provision.plant.scram import verifier
from tests.plant.postgres import Cluster, Database, Login

pytestmark = pytest.mark.system

Connection = psycopg.Connection[tuple[Any, ...]]


@dataclass
class Rig:
    """A database with a victim, who has a page and a parcel to a third station, and a thief."""

    database: Database
    victim: Login
    thief: Login
    third: Login
    parcel: str


def page(text: str = "") -> str:
    """Something with two dots, as long as a page is at least; nobody looks into it there."""
    return f"h.{text or os.urandom(8).hex()}{'x' * 100}.s"


def digest(text: str) -> bytes:
    return hashlib.sha256(text.rpartition(".")[0].encode()).digest()


def append(connection: Connection, n: int, previous: bytes, text: str) -> int:
    row = connection.execute("select registry.append(%s, %s, %s)", (n, previous, text)).fetchone()
    assert row is not None
    return int(row[0])


def send(connection: Connection, to: Login, content: bytes = b"sealed", days: int = 7, parcel: str = "") -> str:
    name = parcel or str(uuid.uuid4())
    connection.execute(
        "select registry.send(%s, %s, %s, now() + make_interval(days => %s))",
        (name, bytes.fromhex(to.fingerprint), content, days),
    )
    return name


@pytest.fixture(scope="module")
def rig(database: Database) -> Rig:
    victim, thief, third = (database.member() for _ in range(3))
    with victim.connect() as connection:
        append(connection, 1, b"", page("the victim's first page"))
        parcel = send(connection, third)
    return Rig(database, victim, thief, third, parcel)


@pytest.fixture(scope="module")
def own(rig: Rig) -> Iterator[Connection]:
    with rig.thief.connect() as connection:
        yield connection


@pytest.fixture
def thief(own: Connection) -> Iterator[Connection]:
    """Yield the thief's connection, in a transaction that is rolled back."""
    with own.transaction(force_rollback=True):
        yield own


DENIED = errors.InsufficientPrivilege

REFUSED = {
    "insert a page as another": (
        "insert into registry.page(station, n, hash, jws) select station, 2, '\\x00', repeat('x', 100)"
        " from registry.member",
        DENIED,
    ),
    "update another's head": ("update registry.member set n = 99", DENIED),
    "open himself wider": ("update registry.member set open = true where role = session_user", DENIED),
    "delete pages": ("delete from registry.page", DENIED),
    "truncate pages": ("truncate registry.page", DENIED),
    "write a roster row": ("insert into registry.roster values ('\\x00', 9, 'x')", DENIED),
    "change a roster row": ("update registry.roster set version = 1", DENIED),
    "write a parcel row": (
        "insert into registry.parcel select gen_random_uuid(), station, station, 'x', now() from registry.member",
        DENIED,
    ),
    "change a parcel": ("update registry.parcel set expires = now()", DENIED),
    "change the registry id": ("update registry.meta set registry = gen_random_uuid()", DENIED),
    "become the owner": ("set role teds_owner", DENIED),
    "become the superuser": ("set session authorization postgres", DENIED),
    "a temporary table": ("create temporary table member(role name)", DENIED),
    "a temporary function": (
        "create function pg_temp.sha256(bytea) returns bytea language sql as $$ select '\\x00'::bytea $$",
        DENIED,
    ),
    "a table in public": ("create table public.mine(a int)", DENIED),
    "a table in registry": ("create table registry.mine(a int)", DENIED),
    "a function in public": ("create function public.f() returns int language sql as $$ select 1 $$", DENIED),
    "an operator in registry": (
        "create operator registry.= (leftarg = bytea, rightarg = bytea, function = byteane)",
        DENIED,
    ),
    "a schema": ("create schema mine", DENIED),
    "a trusted extension": ("create extension hstore schema registry", DENIED),
    "an extension": ("create extension file_fdw schema registry", DENIED),
    "an untrusted language": (
        "create function public.f() returns int language c as 'libc', 'getpid'",
        DENIED,
    ),
    "triggers off": ("set session_replication_role = replica", DENIED),
    "row security off": ("alter table registry.parcel disable row level security", DENIED),
    "row security not asked": ("set row_security = off; select * from registry.parcel", DENIED),
    "a policy of his own": ("create policy his on registry.parcel using (true)", DENIED),
    "alter a table": ("alter table registry.page drop constraint page_pkey", DENIED),
    "replace a function": (
        "create or replace function registry.me() returns bytea language sql as $$ select '\\x00'::bytea $$",
        DENIED,
    ),
    "run a program": ("copy registry.meta to program 'id'", DENIED),
    "write a file": ("copy registry.meta to '/tmp/teds-thief'", DENIED),
    "read a file": ("select pg_read_file('/etc/passwd')", DENIED),
    "read the verifiers": ("select rolpassword from pg_authid", DENIED),
    "a large object": ("select lo_from_bytea(0, 'x')", DENIED),
    "a large object by lo_creat": ("select lo_creat(-1)", DENIED),
    "a large object by lo_create": ("select lo_create(0)", DENIED),
    "a large object from a file": ("select lo_import('/etc/passwd')", DENIED),
    "write a large object": ("select lowrite(0, 'x')", DENIED),
    "a session's advisory lock": ("select pg_advisory_lock(1)", DENIED),
    "a session's advisory lock of two numbers": ("select pg_advisory_lock(1, 1)", DENIED),
    "wake others by pg_notify": ("select pg_notify('teds', 'x')", DENIED),
    "lock the members": ("lock table registry.member in exclusive mode", DENIED),
    "lock the members against writing": ("lock table registry.member in share mode", DENIED),
    "lock the pages": ("lock table registry.page in access exclusive mode", DENIED),
    "lock a head": ("select * from registry.member for update", DENIED),
    "lock a head against others": ("select * from registry.member for share", DENIED),
    "lock a page": ("select * from registry.page for key share", DENIED),
    "a new role": ("create role accomplice login", DENIED),
    "more connections": ("alter role current_user connection limit 100", DENIED),
    "make himself superuser": ("alter role current_user superuser", DENIED),
    "join the owner": ("grant teds_owner to current_user", (DENIED, errors.InvalidGrantOperation)),
    "set the database up": ("alter database postgres set search_path = pg_temp", DENIED),
    "see the server's files": ("select pg_ls_dir('.')", DENIED),
    "reload the server": ("select pg_reload_conf()", DENIED),
    "a publication": ("create publication p for all tables", DENIED),
    "a subscription": ("create subscription s connection 'dbname=x' publication p with (connect = false)", DENIED),
    "a server elsewhere": ("create server s foreign data wrapper postgres_fdw", (DENIED, errors.UndefinedObject)),
    "an event trigger": (
        "create event trigger t on ddl_command_start execute function registry.me()",
        (DENIED, errors.InvalidObjectDefinition),
    ),
}


@pytest.mark.parametrize("attempt", REFUSED)
def test_a_stolen_login_may_not(attempt: str, thief: Connection) -> None:
    statement, error = REFUSED[attempt]
    with pytest.raises(error):
        thief.execute(statement)


def test_a_thief_does_not_become_another_station(thief: Connection, rig: Rig) -> None:
    for statement in (f"set role {rig.victim.role}", f"set session authorization {rig.victim.role}"):
        with pytest.raises(DENIED), thief.transaction():
            thief.execute(statement)


def test_a_thief_does_not_end_others(thief: Connection, rig: Rig) -> None:
    with rig.victim.connect() as victim:
        pid = victim.info.backend_pid
        with pytest.raises(DENIED):
            thief.execute("select pg_terminate_backend(%s)", (pid,))
        assert victim.execute("select 1").fetchone() == (1,)


def test_a_thief_sees_no_parcel_of_others_and_takes_none_away(thief: Connection, rig: Rig) -> None:
    assert thief.execute("select id from registry.parcel").fetchall() == []
    assert thief.execute("delete from registry.parcel").rowcount == 0
    with rig.third.connect() as third:
        assert [str(row[0]) for row in third.execute("select id from registry.parcel")] == [rig.parcel]


def test_a_thief_sends_in_his_own_name_only(thief: Connection, rig: Rig) -> None:
    name = send(thief, rig.victim)
    row = thief.execute("select sender from registry.parcel where id = %s", (name,)).fetchone()
    assert row == (bytes.fromhex(rig.thief.fingerprint),)


def test_a_parcel_of_anothers_id_is_not_replaced(thief: Connection, rig: Rig) -> None:
    with pytest.raises(errors.UniqueViolation):
        send(thief, rig.third, b"forged", parcel=rig.parcel)


def test_a_thief_writes_junk_into_his_own_chain_and_nowhere_else(rig: Rig) -> None:
    login = rig.database.member()
    with login.connect() as connection:
        assert append(connection, 1, b"", page("junk")) == 1
        rows = connection.execute("select station from registry.page where n = 1 and jws like '%%junk%%'").fetchall()
    assert rows == [(bytes.fromhex(login.fingerprint),)]


def test_the_own_search_path_does_not_reach_the_functions(rig: Rig) -> None:
    login = rig.database.member()
    with login.connect() as connection:
        connection.execute("set search_path = pg_temp, public, registry")
        first = page()
        append(connection, 1, b"", first)
        row = connection.execute("select hash from registry.member where role = session_user").fetchone()
        assert row == (digest(first),)


def test_pages_follow_each_other_and_the_same_again_is_done(rig: Rig) -> None:
    first, second = page(), page()
    with rig.database.member().connect() as connection:
        assert append(connection, 1, b"", first) == 1
        assert append(connection, 1, b"", first) == 1
        with pytest.raises(psycopg.Error) as other:
            append(connection, 1, b"", second)
        with pytest.raises(psycopg.Error) as unfollowing:
            append(connection, 2, digest(second), second)
        with pytest.raises(psycopg.Error) as gap:
            append(connection, 3, digest(first), second)
        assert append(connection, 2, digest(first), second) == 2
    assert [exception_info.value.sqlstate for exception_info in (other, unfollowing, gap)] == [
        "TE002",
        "TE002",
        "TE003",
    ]


def test_a_page_is_appended_at_read_committed_only(rig: Rig) -> None:
    with rig.database.member().connect() as connection:
        connection.execute("set default_transaction_isolation = 'serializable'")
        with pytest.raises(psycopg.Error) as refused:
            append(connection, 1, b"", page())
    assert refused.value.sqlstate == "TE005"


def test_more_than_a_mebibyte_is_no_page(thief: Connection) -> None:
    with pytest.raises(errors.CheckViolation):
        append(thief, 1, b"", page("x" * (1 << 20)))


@pytest.mark.nightly(
    "tests/plant/test_member_resources.py::test_a_parcel_without_content_counts_for_16_kib fills the same 256 MiB with "
    "rows that are empty; tests/plant/test_member_resources.py::test_two_sessions_of_one_login_share_the_limit_of_what_"
    "waits counts octets"
)
def test_spam_ends_at_256_mebibytes(rig: Rig) -> None:
    spammer = rig.database.member()
    rig.database.sql(  # what waits already, without sending it
        "insert into registry.parcel select gen_random_uuid(), station, station, "
        "decode(repeat('00', 67108864), 'hex'), now() + interval '1 day' from registry.member, generate_series(1, 4) "
        f"where role = '{spammer.role}'"
    )
    try:
        with spammer.connect() as connection, pytest.raises(psycopg.Error) as full:
            send(connection, rig.victim)
        assert full.value.sqlstate == "TE004"
    finally:
        rig.database.sql(f"delete from registry.parcel where sender = '\\x{spammer.fingerprint}'")


def test_a_parcel_waits_31_days_at_most(thief: Connection, rig: Rig) -> None:
    send(thief, rig.victim, days=31)
    with pytest.raises(psycopg.Error) as refused:
        send(thief, rig.victim, days=32)
    assert refused.value.sqlstate == "TE004"


def test_who_sends_takes_away_what_expired_of_its_own_and_of_nobody_else(rig: Rig) -> None:
    sender, other = rig.database.member(), rig.database.member()
    with sender.connect() as own, other.connect() as others:
        expired, theirs, waiting = send(own, rig.third, days=-1), send(others, rig.third, days=-1), send(own, rig.third)
        last = send(own, rig.third)
    with rig.third.connect() as third:
        there = {str(name) for (name,) in third.execute("select id from registry.parcel").fetchall()}
        mine = [expired, theirs, waiting, last]
        third.execute("delete from registry.parcel where id = any(%s::uuid[])", (mine,))
    assert there & set(mine) == {theirs, waiting, last}


def test_what_others_ask_is_not_seen(thief: Connection, rig: Rig) -> None:
    with rig.victim.connect() as victim:
        victim.execute("select 'a word of the victim'")
        rows = thief.execute("select query from pg_stat_activity").fetchall()
    assert not any("a word of the victim" in (text or "") for (text,) in rows)


def test_what_is_allowed_does_no_harm(own: Connection, rig: Rig) -> None:
    """NOTIFY, a lock on a table, time-outs of his own: the victim works on."""
    with own.transaction(force_rollback=True), rig.victim.connect() as victim:
        own.execute("notify teds, 'x'")
        own.execute("set local statement_timeout = 0")
        own.execute("lock table registry.page in access share mode")
        head = victim.execute("select n, hash from registry.member where role = session_user").fetchone()
        assert head is not None
        victim.execute("set lock_timeout = '5s'")
        assert append(victim, head[0] + 1, head[1], page()) == head[0] + 1


def test_no_login_has_more_than_six_connections(rig: Rig) -> None:
    login = rig.database.member()
    held = [login.connect() for _ in range(6)]
    try:
        with pytest.raises(psycopg.OperationalError, match="too many connections"):
            login.connect()
    finally:
        for connection in held:
            connection.close()


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"sslmode": "disable", "channel_binding": "disable"}, "pg_hba"),
        ({"channel_binding": "require", "password": "0" * 64}, "password authentication failed"),
        ({"dbname": "postgres"}, "permission denied for database|CONNECT"),
    ],
)
def test_a_login_without_tls_with_another_secret_or_elsewhere_is_refused(
    rig: Rig, more: dict[str, str], why: str
) -> None:
    rig.database.cluster.psql("revoke connect on database postgres from public")
    with pytest.raises(psycopg.OperationalError, match=why):
        rig.thief.connect(**more)


def test_the_verifier_does_not_log_in(rig: Rig) -> None:
    login = rig.database.member()
    with pytest.raises(psycopg.OperationalError):
        login.connect(password=verifier(login.secret))


def test_a_closed_station_neither_writes_nor_reads_parcels_and_its_connections_end(rig: Rig) -> None:
    login = rig.database.member()
    with rig.victim.connect() as victim:
        send(victim, login)
    connection = login.connect()
    rig.database.sql(f"update registry.member set open = false where role = '{login.role}'")
    with pytest.raises(psycopg.Error) as closed:
        append(connection, 1, b"", page())
    assert closed.value.sqlstate == "TE001"
    assert connection.execute("select id from registry.parcel").fetchall() == []
    rig.database.sql(close_sql(login.fingerprint))
    with pytest.raises(psycopg.OperationalError):
        connection.execute("select 1")
    with pytest.raises(psycopg.OperationalError, match="not permitted to log in"):
        login.connect()


def test_a_member_reads_all_pages_and_a_reader_all_but_parcels(thief: Connection, rig: Rig) -> None:
    assert thief.execute("select count(*) from registry.page where jws like '%%victim''s first%%'").fetchone() == (1,)
    query = "set role teds_reader; select count(*) > 0 from registry.page; select count(*) from registry.parcel"
    with pytest.raises(Exception, match="permission denied for table parcel"):
        rig.database.sql(query)
    for table in ("page", "member", "roster", "meta", "found", "handed"):
        assert rig.database.sql(f"set role teds_reader; select count(*) >= 0 from registry.{table}")[-1] == ["t"], table


def test_each_member_has_its_roster_row_and_a_rolled_back_one_is_put_back(rig: Rig) -> None:
    with rig.victim.connect() as victim, rig.third.connect() as third:
        victim.execute("select registry.post_roster(3, 'the third')")
        third.execute("select registry.post_roster(2, 'an older one')")
        third.execute("select registry.post_roster(1, 'one rolled back')")
        rows = third.execute("select version, jws from registry.roster order by version").fetchall()
    assert rows == [(1, "one rolled back"), (3, "the third")]


def test_the_schema_run_again_takes_back_what_a_restore_gave(cluster: Cluster) -> None:
    """pg_restore gives TEMP back to PUBLIC and opens a station that was closed since the dump."""
    database = Database.new(cluster)
    gone, stays = database.member(), database.member()
    name = database.name
    database.sql(f"grant temporary on database {name} to public; update registry.member set open = true")
    database.sql(registry_sql(database.registry, [gone.fingerprint]))
    assert database.sql("select role, open from registry.member order by open") == [[gone.role, "f"], [stays.role, "t"]]
    with stays.connect() as connection, pytest.raises(DENIED):
        connection.execute("create temporary table member(a int)")
    with pytest.raises(psycopg.OperationalError, match="not permitted to log in"):
        gone.connect()


def test_another_registry_id_does_not_replace_the_first(cluster: Cluster) -> None:
    database = Database.new(cluster)
    database.sql(registry_sql(str(uuid.uuid4())))
    assert database.sql("select registry from registry.meta") == [[database.registry]]


def test_a_newer_schema_is_not_touched(cluster: Cluster) -> None:
    database = Database.new(cluster)
    database.sql("update registry.meta set version = 3")
    with pytest.raises(Exception, match="this is schema 3, newer than 2"):
        database.sql(registry_sql(database.registry))


def test_a_member_that_is_added_again_gets_its_new_password_and_keeps_its_chain(rig: Rig) -> None:
    login = rig.database.member()
    with login.connect() as connection:
        append(connection, 1, b"", page())
    newer = Login(rig.database, login.fingerprint)
    rig.database.sql(member_sql(newer.fingerprint, verifier(newer.secret)))
    with newer.connect() as connection:
        assert connection.execute("select n from registry.member where role = session_user").fetchone() == (1,)
    with pytest.raises(psycopg.OperationalError):
        login.connect()


def test_mending_takes_rows_off_and_the_chain_goes_on(rig: Rig) -> None:
    login = rig.database.member()
    first, forged, second = page(), page("forged"), page()
    with login.connect() as connection:
        append(connection, 1, b"", first)
        append(connection, 2, digest(first), forged)
        rig.database.sql(mend_sql(login.fingerprint, 2))
        assert append(connection, 2, digest(first), second) == 2
        rig.database.sql(mend_sql(login.fingerprint, 1))
        assert append(connection, 1, b"", first) == 1
