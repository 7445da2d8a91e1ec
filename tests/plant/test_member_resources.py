"""Bounds on what one member's login can take from the server (plant.md section 5): locks, time, disk, connections."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress

import psycopg
import pytest
from psycopg import errors

from teds_provision.plant.postgres import Registry, parameters
from teds_provision.plant.schema import close_sql, member_sql, mend_sql, registry_sql
from teds_provision.plant.scram import verifier
from tests.plant.postgres import Cluster, Database, Login

pytestmark = pytest.mark.system


@pytest.fixture
def thief(database: Database) -> Login:
    return database.member()


def ended(connection: psycopg.Connection[tuple[object, ...]]) -> bool:
    with suppress(psycopg.OperationalError):
        connection.execute("select 1")
        return False
    return True


ADVISORY = [
    f"pg_{attempt}advisory_{scope}lock{shared}({key})"
    for attempt in ("", "try_")
    for scope in ("", "xact_")
    for shared in ("", "_shared")
    for key in ("1::bigint", "1, 1")
]


def test_no_member_takes_any_of_the_advisory_locks(thief: Login) -> None:
    assert len(ADVISORY) == 16
    with thief.connect() as connection:
        for call in ADVISORY:
            with pytest.raises(errors.InsufficientPrivilege):
                connection.execute(f"select {call}")
        with pytest.raises(errors.InsufficientPrivilege):
            connection.execute("select count(pg_try_advisory_lock(g)) from generate_series(1, 200000) g")


@pytest.mark.parametrize(
    "attempt",
    [
        "do $$ begin for i in 1..1000000 loop execute 'notify teds'; end loop; end $$",
        "select pg_export_snapshot() from generate_series(1, 1000000)",
        "select pg_logical_emit_message(false, 'x', repeat('x', 1000000)) from generate_series(1, 1000)",
    ],
    ids=["loop", "snapshot files", "messages in the WAL"],
)
def test_no_member_fills_queue_or_disk_by_what_every_login_may_do_by_default(thief: Login, attempt: str) -> None:
    with thief.connect() as connection, pytest.raises(errors.InsufficientPrivilege):
        connection.execute(attempt)


def test_while_notifications_pile_up_the_next_member_ends_younger_transactions_too(thief: Login) -> None:
    """A session that listens, in a transaction, keeps the queue that all databases share from being emptied."""
    database, limit = thief.database, "usage() > 0.1 and a.xact_start < clock_timestamp() - interval '10"
    with thief.connect() as connection, database.member().connect() as member:
        connection.execute("listen teds")
        connection.execute("begin; select 1")
        for now, ends in ((limit.replace("'10", "'0"), 0), (limit.replace("> 0.1", ">= 0").replace("'10", "'0"), 1)):
            with stricter(database, limit, now):
                assert member.execute("select registry.sweep()").fetchone() == (ends,)
        assert ended(connection)


SENDING = "select registry.send(gen_random_uuid(), %s, decode(repeat('00', %s), 'hex'), now() + interval '1 day')"


def test_two_sessions_of_one_login_share_the_limit_of_what_waits(thief: Login) -> None:
    """Each counted what the other had not committed yet: six connections sent six times the limit."""
    values, send = (bytes.fromhex(thief.fingerprint), 60 << 10), "send(uuid, bytea, bytea, timestamptz)"
    with (
        thief.connect() as first,
        thief.connect() as second,
        stricter(thief.database, "> 268435456", "> 262144", function=send),
    ):
        for _ in range(3):
            first.execute(SENDING, values)
        first.execute("begin")
        first.execute(SENDING, values)
        second.execute("set lock_timeout = '300ms'")
        with pytest.raises(errors.LockNotAvailable):
            second.execute(SENDING, values)
        first.execute("commit")
        with pytest.raises(psycopg.Error, match="too much waits"):
            second.execute(SENDING, values)
        second.execute("delete from registry.parcel")


def test_a_parcel_without_content_counts_for_16_kib(thief: Login) -> None:
    thief.database.sql(
        "insert into registry.parcel(id, recipient, sender, document, expires) select gen_random_uuid(), station,"
        " station, '', now() + interval '1 day' from registry.member, generate_series(1, 16384)"
        f" where role = '{thief.role}'"
    )
    with thief.connect() as connection:
        with pytest.raises(psycopg.Error, match="too much waits"):
            connection.execute(SENDING, (bytes.fromhex(thief.fingerprint), 0))
        connection.execute("delete from registry.parcel")


def test_a_member_does_not_lift_the_limit_of_its_temporary_files(thief: Login) -> None:
    with thief.connect() as connection:
        for attempt in (
            "set temp_file_limit = -1",
            "alter role current_user set temp_file_limit = -1",
            "alter role current_user reset temp_file_limit",
        ):
            with pytest.raises(errors.InsufficientPrivilege):
                connection.execute(attempt)
        connection.execute("alter role current_user reset all")  # takes off what it may change, and nothing else
    with thief.connect() as connection:
        assert connection.execute("show temp_file_limit").fetchone() == ("512MB",)
        assert connection.execute("show statement_timeout").fetchone() == ("0",), "only a default"


def test_a_sort_ends_at_the_limit_of_temporary_files(thief: Login) -> None:
    thief.database.sql(f"alter role {thief.role} set temp_file_limit = '1MB'")
    with thief.connect() as connection, pytest.raises(errors.ConfigurationLimitExceeded):
        connection.execute("select g from generate_series(1, 1000000) g order by md5(g::text)")


@contextmanager
def stricter(database: Database, limit: str, now: str, function: str = "sweep()") -> Iterator[None]:
    """Give sweep(), or another function, another limit, so that a test reaches it at once."""
    found = database.cluster.psql(f"select pg_get_functiondef('registry.{function}'::regprocedure)", database.name)
    assert limit in found
    database.sql(found.replace(limit, now))
    yield
    database.sql(found)


def test_the_next_member_ends_a_transaction_that_holds_too_many_locks(thief: Login) -> None:
    """Each savepoint with a change takes a lock in the table that all sessions share; no right to revoke stops it."""
    database = thief.database
    with thief.connect() as connection, database.member().connect() as member, stricter(database, "> 1000", "> 50"):
        connection.execute("begin")
        assert member.execute("select registry.sweep()").fetchone() == (0,)
        for _ in range(60):
            connection.execute("savepoint s; select registry.post_roster(1, 'x')")
        assert member.execute("select registry.sweep()").fetchone() == (1,)
        assert ended(connection)
        assert member.execute("select registry.sweep()").fetchone() == (0,)


@pytest.mark.parametrize("busy", ["select 1", "lock table registry.page in access share mode"])
def test_the_next_member_ends_an_old_transaction_and_leaves_a_young_one(thief: Login, busy: str) -> None:
    database = thief.database
    with thief.connect() as connection, database.member().connect() as member:
        connection.execute("set idle_in_transaction_session_timeout = 0; set statement_timeout = 0")
        connection.execute(f"begin; {busy}")
        assert member.execute("select registry.sweep()").fetchone() == (0,)
        assert not ended(connection)
        with stricter(database, "120 seconds", "0 seconds"):
            assert member.execute("select registry.sweep()").fetchone() == (1,)
        assert ended(connection)


def test_no_member_ends_a_session_of_the_administrator(thief: Login) -> None:
    database = thief.database
    where = {"host": str(database.cluster.socket), "port": str(database.cluster.port)}
    with (
        psycopg.connect(**where, user="postgres", dbname=database.name) as keeper,  # type: ignore[arg-type]
        thief.connect() as connection,
        stricter(database, "120 seconds", "0 seconds"),
    ):
        keeper.execute("select 1")
        assert connection.execute("select registry.sweep()").fetchone() == (0,)
        assert keeper.execute("select 1").fetchone() == (1,)


@pytest.fixture
def lasting(cluster: Cluster) -> Iterator[tuple[Database, Login]]:
    """Yield a database whose tables a member holds, in a transaction that it never ends."""
    database = Database.new(cluster)
    login = database.member()
    connection = login.connect()
    connection.execute("set idle_in_transaction_session_timeout = 0")
    connection.execute("begin; select registry.post_roster(1, 'x')")
    connection.execute("select * from registry.parcel, registry.page, registry.member")
    connection.execute("alter role current_user set work_mem = '1MB'")
    yield database, login
    connection.close()


def test_an_idle_transaction_of_a_member_does_not_stop_the_schema(lasting: tuple[Database, Login]) -> None:
    database, login = lasting
    database.sql(registry_sql(database.registry))
    with login.connect() as connection:
        assert connection.execute("select count(*) from registry.meta").fetchone() == (1,)


def test_an_idle_transaction_of_a_member_does_not_stop_its_closing(lasting: tuple[Database, Login]) -> None:
    database, login = lasting
    database.sql(close_sql(login.fingerprint))
    assert database.sql(f"select open from registry.member where role = '{login.role}'") == [["f"]]
    with pytest.raises(psycopg.OperationalError, match="not permitted to log in"):
        login.connect()
    with pytest.raises(Exception, match="this login was closed"):
        database.sql(member_sql(login.fingerprint, verifier(login.secret)))
    with pytest.raises(psycopg.OperationalError, match="not permitted to log in"):
        login.connect()


def test_an_idle_transaction_of_a_member_stops_neither_mending_nor_its_new_password(
    lasting: tuple[Database, Login],
) -> None:
    database, login = lasting
    database.sql(mend_sql(login.fingerprint, 1))
    with login.connect() as connection:
        connection.execute("set idle_in_transaction_session_timeout = 0")
        connection.execute("begin; alter role current_user set work_mem = '1MB'; select registry.post_roster(1, 'x')")
        login.secret = bytes(32)
        database.sql(member_sql(login.fingerprint, verifier(login.secret)))
        assert ended(connection)
    with login.connect() as connection:
        assert connection.execute("select count(*) from registry.meta").fetchone() == (1,)


def test_the_schema_run_again_brings_the_limits_to_logins_that_were_made_before(cluster: Cluster) -> None:
    database = Database.new(cluster)
    login = database.member()
    database.sql(f"alter role {login.role} reset all; alter role {login.role} connection limit 4")
    database.sql(
        "grant execute on function pg_try_advisory_lock(bigint) to public; grant usage on language plpgsql to public;"
        "grant execute on function pg_export_snapshot() to public"
    )
    settings = parameters(database.url, login.fingerprint, login.secret)
    registry = Registry(settings)
    assert registry.open_doors() == [
        "procedural blocks",
        "snapshot files or messages in the WAL",
        "advisory locks",
        "temporary files without limit",
    ]
    registry.close()
    database.sql(registry_sql(database.registry))
    assert registry.open_doors() == []
    registry.close()
    assert database.sql(f"select rolconnlimit from pg_roles where rolname = '{login.role}'") == [["6"]]
