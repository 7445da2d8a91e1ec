"""How a station logs in, and the SQL that an administrator gets: whole, as contract/plant.md section 5 has them."""

from __future__ import annotations

import pytest

from teds_provision.errors import BadDataError, UsageError
from teds_provision.plant import postgres, schema

STATION = "0d9ce5609c2920bb" + "5" * 48
VERIFIER = "SCRAM-SHA-256$4096:" + "A" * 22 + "==$" + "B" * 43 + "=:" + "C" * 43 + "="


def test_a_login_is_the_stations_own_over_tls_1_3_bound_to_its_channel_and_waits_for_nothing_long() -> None:
    """All of it, as each line keeps a station from a wrong server, a wrong row or a wait without end."""
    secret = bytes(range(32))
    assert postgres.parameters("postgresql://office:5433/plant?sslrootcert=/etc/office.crt", STATION, secret) == {
        "host": "office",
        "port": "5433",
        "dbname": "plant",
        "sslrootcert": "/etc/office.crt",
        "user": "teds_0d9ce5609c2920bb",
        "password": "000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f",
        "sslmode": "verify-full",
        "ssl_min_protocol_version": "TLSv1.3",
        "channel_binding": "require",
        "gssencmode": "disable",
        "target_session_attrs": "read-write",
        "connect_timeout": 10,
        "tcp_user_timeout": 10_000,
        "keepalives_idle": 10,
        "keepalives_interval": 5,
        "keepalives_count": 3,
        "application_name": "teds-provision",
        "client_encoding": "UTF8",
        "options": "-c statement_timeout=60s -c lock_timeout=10s -c idle_in_transaction_session_timeout=60s",
    }


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("postgresql://teds:secret@office/plant", "The URL of a registry must not contain a password."),
        ("postgresql://:@office/plant", "The URL of a registry must not contain a password."),
        ("postgresql://office/plant?password=secret", "The URL of a registry must not contain a password."),
        ("postgresql://office/plant?sslpassword=secret", "The URL of a registry must not contain a password."),
        ("postgresql://teds@office/plant", "must not contain a user"),
        ("postgresql://office/plant?user=teds", "may not set user"),
        ("postgresql://office/plant?sslmode=disable", "may not set sslmode"),
        ("postgresql://office/plant?options=x&sslmode=prefer", "may not set options, sslmode"),
        ("postgresql://office/plant?connect_timeout=0", "may not set connect_timeout"),
        ("postgresql:///plant", "needs a host and a database"),
        ("postgresql://office", "needs a host and a database"),
        ("postgresql://office/plant?nonsense=1", "rejects this URL"),
        ("mysql://office/plant", "Give the registry as postgresql://HOST/DATABASE, or use --files DIR."),
    ],
)
def test_a_url_says_where_a_registry_is_and_nothing_of_whom_to_trust(url: str, message: str) -> None:
    with pytest.raises(UsageError) as error:
        postgres.parameters(url, STATION, bytes(32))
    assert message in error.value.message
    assert error.value.exit_code == 2


def test_a_role_is_named_by_16_digits_of_a_whole_fingerprint() -> None:
    assert schema.role_of(STATION) == "teds_0d9ce5609c2920bb"
    for wrong in (STATION[:63], STATION + "5", STATION.upper(), STATION[:63] + "'", STATION + "\n"):
        with pytest.raises(BadDataError):
            schema.role_of(wrong)


ENDS = """\
do $$ declare attempt int; begin
  for attempt in 1..20 loop
    perform pg_stat_clear_snapshot();
    perform pg_terminate_backend(pid, 2000) from pg_stat_activity where usename = 'teds_0d9ce5609c2920bb' and xact_start is not null;
    begin
      {change}
      exit;
    exception when lock_not_available then if attempt = 20 then raise; end if; end;
  end loop; end $$;
"""  # noqa: E501


def test_the_login_of_a_member() -> None:
    change = f"alter role teds_0d9ce5609c2920bb login connection limit 6 password '{VERIFIER}';"
    assert schema.member_sql(STATION, VERIFIER) == (
        """\
begin;
set local lock_timeout = '500ms';
do $$ begin if exists (select from registry.member where role = 'teds_0d9ce5609c2920bb' and not open) then
  raise exception 'this login was closed' using hint = 'To open it: update registry.member set open = true '
    'where role = ''teds_0d9ce5609c2920bb''; then run this again.'; end if; end $$;
do $$ begin if not exists (select from pg_roles where rolname = 'teds_0d9ce5609c2920bb') then create role teds_0d9ce5609c2920bb; end if; end $$;
"""  # noqa: E501
        + ENDS.format(change=change)
        + f"""\
alter role teds_0d9ce5609c2920bb set temp_file_limit = '512MB';
alter role teds_0d9ce5609c2920bb set statement_timeout = '60s';
alter role teds_0d9ce5609c2920bb set idle_in_transaction_session_timeout = '60s';
grant teds_member to teds_0d9ce5609c2920bb;
insert into registry.member(role, station) values ('teds_0d9ce5609c2920bb', '\\x{STATION}') on conflict do nothing;
commit;
"""
    )
    for wrong in (VERIFIER + "'", VERIFIER.replace("4096", "1"), "secret", VERIFIER + "\n"):
        with pytest.raises(BadDataError, match="SCRAM-SHA-256 verifier"):
            schema.member_sql(STATION, wrong)


def closed() -> str:
    change = f"""\
if exists (select from pg_roles where rolname = 'teds_0d9ce5609c2920bb') then alter role teds_0d9ce5609c2920bb nologin; end if;
      update registry.member set open = false where station = '\\x{STATION}';"""  # noqa: E501
    return (
        "begin;\nset local lock_timeout = '500ms';\n" + ENDS.format(change=change) + "commit;\n"
        "select pg_terminate_backend(pid, 2000) from pg_stat_activity where usename = 'teds_0d9ce5609c2920bb';\n"
    )


def test_the_end_of_a_login_in_the_schema_too_for_every_station_that_was_removed() -> None:
    assert schema.close_sql(STATION) == closed()
    registry = "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"
    whole = schema.registry_sql(registry, [STATION])
    assert whole.startswith("set client_min_messages = warning;\n-- registry/2.")
    assert whole.endswith("commit;\n" + closed())
    assert schema.registry_sql(registry) == whole.removesuffix(closed())
    assert f"insert into registry.meta(version, registry) values (2, '{registry}')" in whole
    with pytest.raises(ValueError):
        schema.registry_sql("'; drop table registry.page; --")


def test_rows_that_a_station_did_not_sign_are_taken_off_from_a_number_on() -> None:
    change = f"""\
delete from registry.page where station = '\\x{STATION}' and n >= 7;
      update registry.member set n = 6, hash = coalesce((select hash from registry.page p where p.station = '\\x{STATION}' and p.n = 6), '\\x') where station = '\\x{STATION}';"""  # noqa: E501
    assert schema.mend_sql(STATION, 7) == (
        "begin;\nset local lock_timeout = '500ms';\n" + ENDS.format(change=change) + "commit;\n"
    )
    with pytest.raises(BadDataError, match="Page numbers start at 1"):
        schema.mend_sql(STATION, 0)
