"""A station's registry, and the connection to it: a folder, or PostgreSQL."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import parse_qsl, quote, urlencode, urlsplit, urlunsplit

from teds_provision.errors import NotMemberError, PolicyError
from teds_provision.plant import postgres
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.membership import FILES
from teds_provision.plant.transport import Transport
from teds_provision.station.station import Station


def place_of(station: Station) -> str | None:
    """Return where the joined registry is, as the store has it now; None if none was joined, or it is unknown."""
    record = station.plant.joined
    return record.url if record is not None else None


def open_transport(station: Station) -> Transport | None:
    """Return the transport of the joined registry; None if it is unknown. Opens no connection."""
    record = station.plant.joined
    if record is None or record.url is None:
        return None
    if record.url.startswith(FILES):
        return FolderTransport(Path(record.url.removeprefix(FILES)))
    return database(station, record.url)


def database(station: Station, url: str) -> postgres.PostgresTransport:
    """Return the registry at a URL, with the login of this station's request (the vault opens); not connected yet.

    Raises UsageError (the URL, the driver), NotMemberError (no request was ever made).
    """
    return postgres.PostgresTransport(
        postgres.Registry(_login(station, url)), postgres.where_of(url), station.fingerprint
    )


def listener(station: Station) -> postgres.Registry | None:
    """Return a second connection that is notified of changes; None for a folder."""
    record = station.plant.joined
    if record is None or record.url is None or record.url.startswith(FILES):
        return None
    return postgres.Registry(_login(station, record.url))


def check_database(station: Station, transport: Transport) -> list[str]:
    """Return what the database allows and should not, and keep it for ``registry status``; empty for a folder."""
    if not isinstance(transport, postgres.PostgresTransport):
        return []
    transport.sweep()
    doors, roster = transport.open_doors(), station.plant.roster
    left = {removed.fingerprint: removed.name for removed in roster.removed} if roster is not None else {}
    doors += [
        f"login of {left[open_login]}, which was removed"
        for open_login in transport.open_logins()
        if open_login in left
    ]
    station.plant.put_doors(doors)
    return doors


def absolute(url: str) -> str:
    """Return a URL whose root certificate is found from any folder."""
    parts = urlsplit(url)
    words = [
        (name, str(Path(value).absolute()) if name == "sslrootcert" and value != "system" else value)
        for name, value in parse_qsl(parts.query, keep_blank_values=True)
    ]
    return urlunsplit(parts._replace(query=urlencode(words, quote_via=quote)))


def require_registry(transport: Transport, registry: str) -> None:
    """Raise PolicyError if a database is of another registry than the roster that is to be joined."""
    there = transport.registry()
    if there != registry:
        raise PolicyError(f"{transport.where} belongs to another registry ({there}) than the roster ({registry}).")


def _login(station: Station, url: str) -> dict[str, object]:
    kept = station.plant.login()
    if kept is None:
        raise NotMemberError(
            "This station has no database login yet.",
            hint="To get one: registry request --output FILE; the database's administrator then runs: registry"
            " sql --member FILE | psql",
        )
    return postgres.parameters(url, station.fingerprint, kept[0])
