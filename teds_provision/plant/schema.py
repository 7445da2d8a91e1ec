"""The SQL that the keeper of a registry gives to PostgreSQL: schema, members, closing, mending (``registry sql``).

A station never runs any of it: that takes a superuser. Whatever stands in it is printed for a person, who pipes it into
``psql``; every value is a number, a UUID, hex digits or a verifier, and is held against its form here.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib.resources import files
from typing import Final
from uuid import UUID

from teds_provision.errors import BadData
from teds_provision.plant.scram import is_verifier

VERSION: Final = 2
"""The newest schema that this program knows; it refuses newer ones."""
CONNECTIONS: Final = 4
_FINGERPRINT = re.compile(r"[0-9a-f]{64}")


def role_of(fingerprint: str) -> str:
    """The login role of a station; raises BadData for what is no fingerprint of 64 digits."""
    if not _FINGERPRINT.fullmatch(fingerprint):
        raise BadData("A station's login needs all 64 digits of its fingerprint.")
    return f"teds_{fingerprint[:16]}"


def registry_sql(registry: str, removed: Iterable[str] = ()) -> str:
    """The whole schema for one registry id, as one transaction; closes every station of ``removed`` (fingerprints).

    Running it again is harmless, and the cure after a pg_restore.
    """
    text = (files("teds_provision.plant") / "registry.sql").read_text(encoding="utf-8")
    quiet = "set client_min_messages = warning;\n"  # run again, each table that is there would be a notice
    return quiet + text.replace(":'registry'", f"'{UUID(registry)}'") + "".join(map(close_sql, removed))


def member_sql(fingerprint: str, verifier: str) -> str:
    """The login of one station; run again it gives it the password of a newer request. Raises BadData."""
    role = role_of(fingerprint)
    if not is_verifier(verifier):
        raise BadData("The request's login is not a SCRAM-SHA-256 verifier.", hint="Create it again: registry request")
    return f"""\
begin;
set local lock_timeout = '500ms';
do $$ begin if not exists (select from pg_roles where rolname = '{role}') then create role {role}; end if; end $$;
alter role {role} login connection limit {CONNECTIONS} password '{verifier}';
grant teds_member to {role};
insert into registry.member(role, station) values ('{role}', '\\x{fingerprint}') on conflict do nothing;
commit;
"""


def close_sql(fingerprint: str) -> str:
    """Nothing more from this station: its row closed, its login off, its connections ended."""
    role = role_of(fingerprint)
    return f"""\
begin;
set local lock_timeout = '500ms';
update registry.member set open = false where station = '\\x{fingerprint}';
do $$ begin if exists (select from pg_roles where rolname = '{role}') then alter role {role} nologin; end if; end $$;
commit;
select pg_terminate_backend(pid) from pg_stat_activity where usename = '{role}';
"""


def mend_sql(fingerprint: str, first: int) -> str:
    """Take off the rows of a station from number ``first`` on, which its key did not sign."""
    if first < 1:
        raise BadData("Page numbers start at 1.")
    station = f"'\\x{role_of(fingerprint) and fingerprint}'"
    before = f"(select hash from registry.page p where p.station = {station} and p.n = {first - 1})"
    return f"""\
begin;
set local lock_timeout = '500ms';
delete from registry.page where station = {station} and n >= {first};
update registry.member set n = {first - 1}, hash = coalesce({before}, '\\x') where station = {station};
commit;
"""
