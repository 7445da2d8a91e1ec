"""The SQL that the keeper of a registry gives to PostgreSQL: schema, members, closing, repair (``registry sql``).

A station never runs any of it: that takes a superuser. It is printed for an operator, who pipes it into ``psql``; every
value is a number, a UUID, hex digits or a verifier, and is checked against its form here.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib.resources import files
from typing import Final
from uuid import UUID

from teds_provision.errors import BadDataError
from teds_provision.plant.scram import is_verifier

VERSION: Final = 2
"""The newest schema that this program knows; it refuses newer ones."""
CONNECTIONS: Final = 6
"""Connections of a login: two each for the service and a production line, one for a sync, one for another command."""
_FINGERPRINT = re.compile(r"[0-9a-f]{64}")


def role_of(fingerprint: str) -> str:
    """Return the login role of a station; raises BadDataError for what is no fingerprint of 64 digits."""
    if not _FINGERPRINT.fullmatch(fingerprint):
        raise BadDataError("A station's login needs all 64 digits of its fingerprint.")
    return f"teds_{fingerprint[:16]}"


def registry_sql(registry: str, removed: Iterable[str] = ()) -> str:
    """Return the whole schema for one registry id, as one transaction.

    Closes every station of ``removed`` (fingerprints).

    Running it again is harmless, and the remedy after a pg_restore.
    """
    text = (files("teds_provision.plant") / "registry.sql").read_text(encoding="utf-8")
    quiet = "set client_min_messages = warning;\n"  # on a second run, each existing table would cause a notice
    return quiet + text.replace(":'registry'", f"'{UUID(registry)}'") + "".join(map(close_sql, removed))


def _after_ending(role: str, change: str, *, attempts: int = 20) -> str:
    """Return SQL that makes a change (PL/pgSQL) to what a login's open transactions may hold, ending them first."""
    return f"""\
do $$ declare attempt int; begin
  for attempt in 1..{attempts} loop
    perform pg_stat_clear_snapshot();
    perform pg_terminate_backend(pid, 2000) from pg_stat_activity where usename = '{role}' and xact_start is not null;
    begin
      {change}
      exit;
    exception when lock_not_available then if attempt = {attempts} then raise; end if; end;
  end loop; end $$;
"""


def member_sql(fingerprint: str, verifier: str) -> str:
    """Return the login of one station; run again it sets the password of a newer request. Raises BadDataError."""
    role = role_of(fingerprint)
    if not is_verifier(verifier):
        raise BadDataError(
            "The request's login is not a SCRAM-SHA-256 verifier.", hint="Create it again: registry request"
        )
    login = f"alter role {role} login connection limit {CONNECTIONS} password '{verifier}';"
    return f"""\
begin;
set local lock_timeout = '500ms';
do $$ begin if exists (select from registry.member where role = '{role}' and not open) then
  raise exception 'this login was closed' using hint = 'To open it: update registry.member set open = true '
    'where role = ''{role}''; then run this again.'; end if; end $$;
do $$ begin if not exists (select from pg_roles where rolname = '{role}') then create role {role}; end if; end $$;
{_after_ending(role, login)}\
alter role {role} set temp_file_limit = '512MB';
alter role {role} set statement_timeout = '60s';
alter role {role} set idle_in_transaction_session_timeout = '60s';
grant teds_member to {role};
insert into registry.member(role, station) values ('{role}', '\\x{fingerprint}') on conflict do nothing;
commit;
"""


def close_sql(fingerprint: str) -> str:
    """Return SQL that closes a station's row, disables its login and ends its connections."""
    role = role_of(fingerprint)
    change = f"""\
if exists (select from pg_roles where rolname = '{role}') then alter role {role} nologin; end if;
      update registry.member set open = false where station = '\\x{fingerprint}';"""
    return f"""\
begin;
set local lock_timeout = '500ms';
{_after_ending(role, change)}\
commit;
select pg_terminate_backend(pid, 2000) from pg_stat_activity where usename = '{role}';
"""


def mend_sql(fingerprint: str, first: int) -> str:
    """Take off the rows of a station from number ``first`` on, which its key did not sign."""
    if first < 1:
        raise BadDataError("Page numbers start at 1.")
    role = role_of(fingerprint)
    station = f"'\\x{fingerprint}'"
    before = f"(select hash from registry.page p where p.station = {station} and p.n = {first - 1})"
    change = f"""\
delete from registry.page where station = {station} and n >= {first};
      update registry.member set n = {first - 1}, hash = coalesce({before}, '\\x') where station = {station};"""
    return f"""\
begin;
set local lock_timeout = '500ms';
{_after_ending(role, change)}\
commit;
"""
