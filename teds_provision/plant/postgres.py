"""The registry on PostgreSQL, as a member sees it: read rows, append pages, post a roster, send and take parcels.

Nothing that comes from here is trusted: the callers check the signatures. A connection is TLS 1.3 to a server whose
name is verified, and logs in by SCRAM bound to that channel; no password is in a URL, a file or a variable. Each method
is one round trip, but for :meth:`Registry.pages`, which takes one for every few pages.

No wait is endless: libpq's own keepalive is two hours, so ``tcp_user_timeout`` and short keepalives notice a connection
that is half open, the server ends a statement after 60 s, and a watchdog ends the connection if the server itself
does not.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from teds_provision.errors import (
    ForkError,
    NotMemberError,
    PolicyError,
    RegistryError,
    StoreError,
    TedsProvisionError,
    UsageError,
)
from teds_provision.lazy import how_to_install, late
from teds_provision.plant import schema, scram
from teds_provision.plant.transport import AT_ONCE, SMALL, CarriedPage, Offer, Parcel, Returned
from teds_provision.sanitize import printable

if TYPE_CHECKING:
    import psycopg
else:
    psycopg = late("psycopg")

CONNECTING: Final = 10
"""Seconds for a connection to come about."""
STATEMENT: Final = 60
"""Seconds for one statement, by the server's clock; ours gives a little more."""
PAGES_AT_ONCE: Final = 32
_GRACE: Final = 5.0
_CHANNEL: Final = "teds"
_FROM_URL: Final = frozenset({"host", "hostaddr", "port", "dbname", "sslrootcert", "sslcrl", "sslcrldir"})
_NO_SCHEMA: Final = frozenset({"42P01", "3F000", "42883", "42703"})  # no such table, schema, function, column
# The server's messages, because libpq has no SQLSTATE before a login; messages in other languages are passed on as they
# are.
_LOGIN_REFUSED: Final = ("is not permitted to log in", "password authentication failed")
_RETURNING: Final = 2  # the first schema that has the table `found`


@dataclass(frozen=True)
class WaitingParcel:
    """A parcel that waits in the database; ``sender`` and ``to`` are fingerprints, ``octets`` its size."""

    id: str
    sender: str
    to: str
    octets: int
    expires: datetime


@dataclass(frozen=True)
class DatabaseState:
    """State of the database at one moment, unverified.

    ``rosters`` are those that members posted, each once; ``posted`` is this station's own. ``heads`` are number and H
    of each chain's newest page.
    """

    registry: str
    rosters: tuple[bytes, ...] = field(repr=False)
    posted: bytes | None = field(repr=False)
    heads: Mapping[str, tuple[int, str]]
    parcels: tuple[WaitingParcel, ...]
    newest: tuple[int, bytes] | None = field(repr=False)
    """This station's own newest page there, if it is a short one: each sync looks at it."""
    open: frozenset[str] = frozenset()
    """The stations whose row is there and open: they append their pages themselves."""
    handed_in: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """By author, one text for each member that handed in pages of it; the text changes with each page."""
    schema: int = schema.VERSION


_LOOK_1: Final = """\
select 'meta', null::bytea, version, registry::text, null::bytea, null::timestamptz from registry.meta
union all select 'roster', null, bool_or(station = registry.me())::int, jws, null, null
  from registry.roster group by jws
union all select 'head', station, n, encode(hash, 'hex'), case when open then '\\x01'::bytea end, null
  from registry.member
union all select 'parcel', sender, octet_length(document), id::text, recipient, expires from registry.parcel
  where recipient = registry.me() or sender = registry.me()
union all select 'page', p.station, p.n, p.jws, null, null from registry.page p
  join registry.member m on (m.station, m.n) = (p.station, p.n)
  where p.station = registry.me() and octet_length(p.jws) <= 65536"""
_LOOK: Final = f"""{_LOOK_1}
union all select 'handed', author, pages, at::text, by, null from registry.handed"""

# Every page of an author, by its sender: null for the author itself, otherwise another station.
_OFFERS: Final = """\
select n, encode(hash, 'hex'), encode(sha256(convert_to(jws, 'UTF8')), 'hex'), null::text
  from registry.page where station = %s
union all select n, encode(hash, 'hex'), encode(sha256(convert_to(jws, 'UTF8')), 'hex'), encode(by, 'hex')
  from registry.found where author = %s"""

_SMALL_PARCELS: Final = """\
select id::text, document, expires, sender from registry.parcel
  where recipient = registry.me() and octet_length(document) <= %s and id <> all(%s::uuid[])
  order by received limit %s"""

# Rights that a member's login has in a database whose schema was not run by a superuser, or that pg_restore brought
# back.
_OPEN_DOORS: Final = """\
select what from (values
  ('TEMP for PUBLIC', has_database_privilege(current_database(), 'TEMP')),
  ('CREATE on schema public', coalesce((select has_schema_privilege(oid, 'CREATE') from pg_namespace
    where nspname = 'public'), false)),
  ('procedural blocks', has_language_privilege('plpgsql', 'USAGE')),
  ('snapshot files or messages in the WAL', exists (select from pg_proc where pronamespace = 'pg_catalog'::regnamespace
    and proname in ('pg_export_snapshot', 'pg_logical_emit_message') and has_function_privilege(oid, 'EXECUTE'))),
  ('pg_notify', has_function_privilege('pg_catalog.pg_notify(text, text)', 'EXECUTE')),
  ('advisory locks', exists (select from pg_proc where pronamespace = 'pg_catalog'::regnamespace
    and proname ~ '^pg_(try_)?advisory_' and has_function_privilege(oid, 'EXECUTE'))),
  ('prepared transactions (max_prepared_transactions must be 0)',
    current_setting('max_prepared_transactions')::int > 0),
  ('temporary files without limit', current_setting('temp_file_limit') = '-1'),
  ('large objects', has_function_privilege('pg_catalog.lo_from_bytea(oid, bytea)', 'EXECUTE')),
  ('writing pages past the functions', has_table_privilege('registry.page', 'INSERT, UPDATE, DELETE')),
  ('a superuser''s login', (select rolsuper or rolcreaterole or rolbypassrls from pg_roles
    where rolname = session_user))
) as door(what, open) where open"""


def parameters(url: str, fingerprint: str, secret: bytes) -> dict[str, Any]:
    """Return libpq's parameters for a registry's URL; raises UsageError (2) if the URL has more than a location.

    ``postgresql://HOST[:PORT]/DATABASE[?sslrootcert=FILE]``; without the file libpq's own place for root certificates
    counts. A ``sslmode`` or a user in it would decide whom this station trusts.
    """
    parts = urlsplit(url)
    if parts.scheme not in ("postgresql", "postgres"):
        raise UsageError("Give the registry as postgresql://HOST/DATABASE, or use --files DIR.")
    if parts.password is not None or "password" in parts.query:
        raise UsageError(
            "The URL of a registry must not contain a password.",
            hint="The station logs in with its own key: registry request --output FILE",
        )
    if parts.username is not None:
        raise UsageError("The URL of a registry must not contain a user: each station logs in as itself.")
    require_driver()
    parameters_given: dict[str, Any]
    try:
        parameters_given = psycopg.conninfo.conninfo_to_dict(url)
    except psycopg.ProgrammingError as error:
        raise UsageError(f"PostgreSQL's driver rejects this URL: {_words(error)}") from error
    unknown = sorted(set(parameters_given) - _FROM_URL)
    if unknown:
        raise UsageError(f"The URL of a registry may not set {', '.join(unknown)}.", hint="Remove it.")
    if not parameters_given.get("host") or not parameters_given.get("dbname"):
        raise UsageError("The URL of a registry needs a host and a database: postgresql://HOST/DATABASE")
    return parameters_given | {
        "user": schema.role_of(fingerprint),
        "password": scram.password(secret),
        "sslmode": "verify-full",
        "ssl_min_protocol_version": "TLSv1.3",
        "channel_binding": "require",
        "gssencmode": "disable",
        "target_session_attrs": "read-write",  # a standby that lags behind does not have all rows
        "connect_timeout": CONNECTING,
        "tcp_user_timeout": CONNECTING * 1000,
        "keepalives_idle": 10,
        "keepalives_interval": 5,
        "keepalives_count": 3,
        "application_name": "teds-provision",
        "client_encoding": "UTF8",
        "options": f"-c statement_timeout={STATEMENT}s -c lock_timeout=10s -c idle_in_transaction_session_timeout=60s",
    }


def require_driver() -> None:
    """Raise UsageError if psycopg is missing."""
    try:
        _ = psycopg.conninfo
    except ImportError as error:
        raise UsageError(
            "A registry on PostgreSQL needs psycopg, which is not installed.", hint=how_to_install("registry")
        ) from error


class Registry:
    """One login at the database, connected at its first use and again after a failure.

    Several threads may use it (the readers of a line do): one at a time, as a login has four connections for all that
    its station runs. Every method raises RegistryError (5: not reached, login refused, no answer), NotMemberError (6),
    PolicyError (6: full), ForkError (4), StoreError (7: schema, gap).
    """

    def __init__(self, connection_parameters: Mapping[str, Any], patience: float = STATEMENT + _GRACE) -> None:
        self._told, self._patience = connection_parameters, patience
        self._connection: psycopg.Connection[tuple[Any, ...]] | None = None
        self._turn = threading.RLock()

    def close(self) -> None:
        """End the connection; a later use makes another one."""
        connection, self._connection = self._connection, None
        if connection is not None:
            with suppress(psycopg.Error):
                connection.close()

    def interrupt(self) -> None:
        """Interrupt a waiting thread by closing its connection; its request fails."""
        connection = self._connection
        if connection is not None:
            _shut(connection)

    def look(self) -> DatabaseState:
        """Return everything that shows whether anything is new, in one round trip."""
        try:
            rows = self._rows(_LOOK, ())
        except _NoSchemaError:  # the schema is older, newer with other tables, or missing
            rows = self._rows("select 'meta', null, version from registry.meta", ())
            if rows and rows[0][2] < _RETURNING:
                rows = self._rows(_LOOK_1, ())
        meta = next((row for row in rows if row[0] == "meta"), None)
        if meta is None:
            raise StoreError(
                "The database does not contain a registry.", hint="Ask its administrator to run: registry sql | psql"
            )
        if meta[2] > schema.VERSION:
            raise StoreError(
                f"The database has schema {meta[2]}; this program knows {schema.VERSION}.",
                hint="Use a newer version of teds-provision.",
            )
        return DatabaseState(
            meta[3],
            tuple(row[3].encode() for row in rows if row[0] == "roster"),
            next((row[3].encode() for row in rows if row[0] == "roster" and row[2]), None),
            {row[1].hex(): (row[2], row[3]) for row in rows if row[0] == "head"},
            tuple(
                WaitingParcel(row[3], row[1].hex(), row[4].hex(), row[2], row[5]) for row in rows if row[0] == "parcel"
            ),
            next(((row[2], row[3].encode()) for row in rows if row[0] == "page"), None),
            frozenset(row[1].hex() for row in rows if row[0] == "head" and row[4]),
            _handed_in(rows),
            meta[2],
        )

    def pages(self, after: Mapping[str, int]) -> Iterator[tuple[str, int, bytes]]:
        """Yield pages of these stations above these numbers, ascending: station, number in the database, octets."""
        for station, n in after.items():
            last, more = n, True
            while more:
                rows = self._rows(
                    "select n, jws from registry.page where station = %s and n > %s order by n limit %s",
                    (bytes.fromhex(station), last, PAGES_AT_ONCE),
                )
                for last, jws in rows:
                    yield station, last, jws.encode()
                more = len(rows) == PAGES_AT_ONCE

    def offers(self, station: str) -> list[Offer]:
        """Return every page of a station, from any sender; one round trip."""
        author = bytes.fromhex(station)
        return [Offer(station, n, hash, octets, by or "") for n, hash, octets, by in self._rows(_OFFERS, (author,) * 2)]

    def offered(self, offers: Sequence[Offer]) -> list[CarriedPage]:
        """Return the octets of some offers of one author, in one round trip."""
        asked: list[tuple[str, int, str, str]] = [(offer.station, offer.n, offer.hash, offer.by) for offer in offers]
        rows = self._rows(
            "select asked.place, coalesce(p.jws, f.jws) from"
            " unnest(%s::int[], %s::bytea[], %s::int[], %s::bytea[], %s::bytea[]) asked(place, author, n, hash, by)"
            " left join registry.page p on by = '' and (p.station, p.n, p.hash) = (asked.author, asked.n, asked.hash)"
            " left join registry.found f"
            " on (f.author, f.by, f.n, f.hash) = (asked.author, asked.by, asked.n, asked.hash) order by asked.place",
            (
                list(range(len(asked))),
                [bytes.fromhex(author) for author, _, _, _ in asked],
                [n for _, n, _, _ in asked],
                [bytes.fromhex(hash) for _, _, hash, _ in asked],
                [bytes.fromhex(by) for _, _, _, by in asked],
            ),
        )
        there = {place: jws for place, jws in rows if jws is not None}
        return [
            CarriedPage(offer.station, offer.n, there[k].encode(), offer.by)
            for k, offer in enumerate(offers)
            if k in there
        ]

    def restore(self, author: str, pages: Sequence[tuple[int, bytes]]) -> None:
        """Hand in pages (number, octets) of a station that is no open member: one round trip, one transaction.

        Raises AuthorIsMemberError when it is one by now, PolicyError beyond a member's limit.
        """
        with self._connected() as connection, connection.pipeline():
            for n, octets in pages:
                connection.execute("select registry.restore(%s, %s, %s)", (bytes.fromhex(author), n, octets.decode()))

    def append(self, pages: Sequence[tuple[int, str, bytes]]) -> None:
        """Push own pages (number, H of the one before or "", octets): one round trip, one transaction.

        A push that was cut off is simply repeated: pages that arrived are skipped.
        """
        with self._connected() as connection, connection.pipeline():
            for n, previous, octets in pages:
                asked = (n, bytes.fromhex(previous), octets.decode())
                connection.execute("select registry.append(%s, %s, %s)", asked)

    def post_roster(self, version: int, octets: bytes) -> None:
        """Post the newest roster known here."""
        self._rows("select registry.post_roster(%s, %s)", (version, octets.decode()))

    def send(self, parcel: str, to: str, octets: bytes, until: datetime) -> None:
        """Leave a parcel for a station; the same id again changes nothing."""
        try:
            self._rows("select registry.send(%s, %s, %s, %s)", (parcel, bytes.fromhex(to), octets, until))
        except _DuplicateParcelError:
            return

    def parcel(self, parcel: str) -> bytes | None:
        """Return a parcel's octets, None if it is no longer there."""
        rows = self._rows("select document from registry.parcel where id = %s", (parcel,))
        return bytes(rows[0][0]) if rows else None

    def small_parcels(self, to: str, known: Collection[str]) -> list[Parcel]:
        """Return the oldest parcels for this station (``to``), skipping known ids."""
        rows = self._rows(_SMALL_PARCELS, (SMALL, list(known), AT_ONCE))
        return [Parcel(id, to, octets, until.astimezone(UTC).isoformat(), by.hex()) for id, octets, until, by in rows]

    def remove(self, parcels: Sequence[str]) -> None:
        """Take parcels away that came here or were sent from here."""
        self._rows("delete from registry.parcel where id = any(%s::uuid[])", (list(parcels),))

    def open_doors(self) -> list[str]:
        """Return excessive rights of this login; empty if the schema was run by a superuser."""
        return [str(row[0]) for row in self._rows(_OPEN_DOORS, ())]

    def open_logins(self) -> list[str]:
        """Return the fingerprints of the stations that can log in."""
        asked = "select station from registry.member join pg_roles on rolname = role where rolcanlogin"
        return [row[0].hex() for row in self._rows(asked, ())]

    def sweep(self) -> None:
        """End other members' transactions that are too old or hold too many locks; any member keeps the others to it.

        A login may change its own time-outs, so the server's settings alone end nothing. Does nothing in a database
        whose schema has no such function yet.
        """
        with suppress(StoreError):
            self._rows("select registry.sweep()", ())

    def listen(self) -> None:
        """Subscribe to notifications of changes; on a connection that does nothing else."""
        self._rows(f"listen {_CHANNEL}", ())

    def wait(self, seconds: float, *, parcel_to: str = "") -> bool:
        """Wait for a notification, or a parcel for a station; False if none came in ``seconds``."""
        until = time.monotonic() + seconds
        with self._connected(seconds) as connection:
            while (left := until - time.monotonic()) > 0:
                for notification in connection.notifies(timeout=left, stop_after=1):
                    if not parcel_to or notification.payload == f"parcel {parcel_to}":
                        return True
        return False

    def _rows(self, statement: str, values: tuple[Any, ...]) -> list[tuple[Any, ...]]:
        with self._connected() as connection:
            cursor = connection.execute(statement, values)
            return cursor.fetchall() if cursor.description is not None else []

    @contextmanager
    def _connected(self, more: float = 0.0) -> Iterator[psycopg.Connection[tuple[Any, ...]]]:
        """Yield the connection, for at most a statement's time and ``more``; failures are translated."""
        require_driver()
        ended = threading.Event()
        with self._turn:
            try:
                if self._connection is None or self._connection.closed:
                    self._connection = psycopg.connect(**self._told, autocommit=True)
                with _cut_after(self._connection, self._patience + more, ended):
                    yield self._connection
            except psycopg.Error as error:
                if self._connection is not None and (self._connection.broken or ended.is_set()):
                    self.close()
                raise _failure(error, late=ended.is_set()) from error


class PostgresTransport:
    """The registry as a :class:`.transport.Transport`.

    Reads an overview at the beginning of a sync, and then only new rows: a sync without news is one round trip.
    """

    carries_all = False

    def __init__(self, registry: Registry, where: str, station: str) -> None:
        self._registry, self._station = registry, station
        self.where = where
        self.returned: Returned | None = ReturnedPages(self)
        self._seen: DatabaseState | None = None

    def registry(self) -> str | None:
        """Return the registry that the database is of; looks again, so a sync calls this first."""
        self._seen = self._registry.look()
        return self._seen.registry

    def open_doors(self) -> list[str]:
        """Return excessive rights of this station's login: after a pg_restore, for one."""
        return self._registry.open_doors()

    def open_logins(self) -> list[str]:
        """Return the fingerprints of the stations that can log in."""
        return self._registry.open_logins()

    def sweep(self) -> None:
        """End other members' transactions that are too old or hold too many locks."""
        self._registry.sweep()

    def rosters(self) -> Iterator[bytes]:
        """Yield the rosters that members posted."""
        yield from self._look.rosters

    def post_roster(self, version: int, hash: str, octets: bytes) -> None:
        """Post the newest roster known here, if the database does not have it from this station."""
        if self._look.posted != octets:
            self._registry.post_roster(version, octets)

    def heads(self) -> Mapping[str, int]:
        """Return the greatest number of a page, by station."""
        return {station: n for station, (n, _) in self._look.heads.items() if n}

    def pages(self, station: str, after: int) -> Iterator[CarriedPage]:
        """Yield the pages of a station above a number."""
        look, there = self._look, self._look.heads.get(station, (0, ""))[0]
        if station == self._station and look.newest is not None and look.newest[0] == there == after + 1:
            yield CarriedPage(station, *look.newest)
        elif there > after:
            for of, n, octets in self._registry.pages({station: after}):
                yield CarriedPage(of, n, octets)

    def append(self, station: str, n: int, previous: str, hash: str, octets: bytes) -> None:
        """Push a page of one's own."""
        self._registry.append([(n, previous, octets)])

    def parcels(self, to: str) -> Iterator[Parcel]:
        """Yield the parcels for this station."""
        for waiting in self._look.parcels:
            octets = self._registry.parcel(waiting.id) if waiting.to == to else None
            if octets is not None:
                yield Parcel(waiting.id, to, octets, waiting.expires.astimezone(UTC).isoformat(), waiting.sender)

    def new_parcels(self, to: str, known: Collection[str]) -> Iterator[Parcel]:
        """Yield the parcels for this station, skipping known ids, the oldest first, in one round trip."""
        yield from self._registry.small_parcels(to, known)

    def send(self, parcel: Parcel) -> None:
        """Store a parcel in the registry; a large one is sent only if it is not there yet."""
        if len(parcel.octets) <= SMALL or all(waiting.id != parcel.id for waiting in self._look.parcels):
            self._registry.send(parcel.id, parcel.to, parcel.octets, datetime.fromisoformat(parcel.expires))

    def drop(self, parcel: str, to: str) -> None:
        """Take a parcel away."""
        self._registry.remove([parcel])

    def interrupt(self) -> None:
        """Close the connection even if another thread is using it."""
        self._registry.interrupt()

    def close(self) -> None:
        """End the connection."""
        self._registry.close()

    @property
    def _look(self) -> DatabaseState:
        if self._seen is None:
            self.registry()
        assert self._seen is not None
        return self._seen


class ReturnedPages:
    """Pages in the database that their authors did not append themselves: others handed them in (table ``found``)."""

    def __init__(self, transport: PostgresTransport) -> None:
        self._transport = transport

    @property
    def takes_pages(self) -> bool:
        """False for a database of schema 1, which has no such table."""
        return self._transport._look.schema >= _RETURNING

    def state(self, station: str) -> str:
        """Return a text that changes with any handed-in page of a station, or its state.

        "" for an open member without handed-in pages.
        """
        look = self._transport._look
        handed_in = look.handed_in.get(station, ())
        if station in look.open and not handed_in:
            return ""
        n, hash = look.heads.get(station, (0, ""))
        return " ".join((station, str(station in look.open), str(n), hash, *handed_in))

    def was_handed_in(self, station: str) -> bool:
        """Return True if a member handed in a page of this station."""
        return station in self._transport._look.handed_in

    def is_open(self, station: str) -> bool:
        """Return True if the station appends its pages itself."""
        return station in self._transport._look.open

    def head(self, station: str) -> int:
        """Return the number of the newest page that the station appended itself."""
        return self._transport._look.heads.get(station, (0, ""))[0]

    def offers(self, station: str) -> list[Offer]:
        """Return every page of a station, from any sender."""
        return self._transport._registry.offers(station)

    def octets(self, offers: Sequence[Offer]) -> list[CarriedPage]:
        """Return the offered pages; one that is gone is left out."""
        return self._transport._registry.offered(offers)

    def restore(self, author: str, pages: Sequence[tuple[int, bytes]]) -> None:
        """Hand in pages of a station. Raises AuthorIsMemberError, PolicyError."""
        self._transport._registry.restore(author, pages)


def _handed_in(rows: Sequence[tuple[Any, ...]]) -> dict[str, tuple[str, ...]]:
    found: dict[str, list[str]] = {}
    for kind, author, pages, at, by, *_ in (row for row in rows if row[0] == "handed"):
        assert kind
        found.setdefault(author.hex(), []).append(f"{by.hex()}:{pages}:{at}")
    return {author: tuple(sorted(texts)) for author, texts in found.items()}


def where_of(url: str) -> str:
    """Return a registry's URL for people: host and database."""
    parts = urlsplit(url)
    return f"postgresql://{parts.hostname or ''}{f':{parts.port}' if parts.port else ''}{parts.path}"


@contextmanager
def _cut_after(connection: psycopg.Connection[Any], seconds: float, ended: threading.Event) -> Iterator[None]:
    """Cut the connection if the block takes longer: a stuck server keeps TCP alive and answers nothing."""

    def cut() -> None:
        ended.set()
        _shut(connection)

    watch = threading.Timer(seconds, cut)
    watch.daemon = True
    watch.start()
    try:
        yield
    finally:
        watch.cancel()


def _shut(connection: psycopg.Connection[Any]) -> None:
    with suppress(OSError, psycopg.Error), socket.socket(fileno=os.dup(connection.pgconn.socket)) as end:
        end.shutdown(socket.SHUT_RDWR)


class AuthorIsMemberError(PolicyError):
    """The author of a page is an open member, who appends its pages itself."""


class _NoSchemaError(StoreError):
    """A table or function of the schema is missing."""


class _DuplicateParcelError(TedsProvisionError):
    """A parcel with this ID already exists."""


def _failure(error: psycopg.Error, *, late: bool) -> TedsProvisionError:
    """Return the error for people of an error of the database; foreign text in it is sanitized."""
    state, words = error.sqlstate, _words(error)
    match state:
        case "TE001":
            return NotMemberError(
                "The database does not list this station's login as open: it was closed, or its row was lost.",
                hint="At a keeper, with FILE from registry request --output FILE: registry sql --member FILE | psql",
            )
        case "TE002":
            return ForkError(f"The registry rejected a page: {words}", hint="See: registry status")
        case "TE003":
            return StoreError(f"The registry rejected a page: {words}", hint="Run it again: registry sync")
        case "TE004":
            return PolicyError(
                f"The registry accepts no more from this station: {words}.", hint="A later sync sends the rest."
            )
        case "23505":
            return _DuplicateParcelError("A parcel with this ID already exists.")
        case "53100" | "53200":
            return RegistryError(f"The database is full: {words}", hint="Its administrator must free some space.")
        case _ if state in _NO_SCHEMA:
            return _NoSchemaError(
                "The database does not contain a registry.", hint="Ask its administrator to run: registry sql | psql"
            )
        case "TE006":
            return AuthorIsMemberError("The author of these pages is an open member, who appends them itself.")
        case "42501":
            return StoreError(
                f"The database does not allow a member to do this: {words}",
                hint="Ask its administrator to run again: registry sql | psql",
            )
    if late:
        return RegistryError("The registry did not answer in time.", hint="All other work can continue without it.")
    if any(refusal in words for refusal in _LOGIN_REFUSED):
        return RegistryError(
            f"The database refuses this station's login: {words}",
            hint="If this station was removed, its key cannot return. Otherwise at a keeper, with FILE from registry"
            " request --output FILE: registry sql --member FILE | psql",
        )
    return RegistryError(f"Cannot use the registry: {words}", hint="All other work can continue without it.")


def _words(error: BaseException) -> str:
    """Return the first line of a foreign message, which a server may have written."""
    lines = [printable(line.strip()) for line in str(error).splitlines() if line.strip()]
    return lines[0][:300] if lines else type(error).__name__
