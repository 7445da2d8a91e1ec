"""The doctor's checks of the plant: the registry that this station joined. No connection is opened."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import UTC, datetime, timedelta
from importlib.util import find_spec
from typing import TYPE_CHECKING

from teds_provision.doctor.checks import Finding, System, check
from teds_provision.lazy import install_command, late
from teds_provision.sanitize import counted
from teds_provision.station.station import Station
from teds_provision.station.store.sqlite import has_store

if TYPE_CHECKING:
    from teds_provision.protocol.plant import roster as rosters
    from teds_provision.protocol.plant.roster import Roster
else:  # imports cryptography: only for a station that joined a registry
    rosters = late("teds_provision.protocol.plant.roster")

_SYNC = "teds-provision registry sync"
_LATE = timedelta(days=7)
_AHEAD = timedelta(minutes=5)


@check("registry", "store")
def registry(system: System) -> Iterator[Finding]:
    """Check roster, last sync, what waits and what is to be decided; nothing for a station that joined none."""
    if not has_store(system.home):
        return
    with Station.inspect(system.home) as station:
        plant, record = station.plant, station.plant.joined
        row = plant.held_roster()
        if record is None or row is None or not station.identity.is_complete():
            return
        now, roster = datetime.now(UTC), rosters.open_roster(row.octets, station.ca)
        yield _roster(roster, now)
        if record.url is not None and record.url.startswith("postgres") and find_spec("psycopg") is None:
            yield Finding("registry", "failed", "psycopg is missing.", install_command("teds-provision[registry]"))
        synced = datetime.fromisoformat(record.synced) if record.synced is not None else None
        if synced is None or abs(now - synced) > _LATE:  # dated ahead: a clock that was wrong then
            yield Finding("registry", "warning", f"The last sync was {record.synced or 'never'}.", _SYNC)
        yield from _clocks(roster, plant.pages.newest(), now)
        alarms = [alarm for alarm in plant.alarms.all() if not alarm.seen]
        for alarm in alarms:
            yield Finding("registry", "warning", f"Alarm {alarm.code}: {alarm.why}.", "teds-provision registry status")
        conflicts = len({uuid for uuid, _, _ in plant.claims.conflicts()})
        text = f"{counted(plant.unsent(), 'event')} unsent, {counted(conflicts, 'conflict')}."
        fix = "teds-provision registry status" if conflicts else ""
        yield Finding("registry", "warning" if conflicts else "ok", text, fix)


def _clocks(roster: Roster, newest: Iterable[tuple[str, str]], now: datetime) -> Iterator[Finding]:
    """Check the members' clocks by the date of each one's newest page.

    A page from beyond the roster's end was dated by a wrong clock there; a nearer one may mean that this one is slow.
    """
    members = {member.fingerprint: member.name for member in roster.members}
    for station, created in newest:
        when = datetime.fromisoformat(created)
        if station not in members or when <= now + _AHEAD:
            continue
        name = members[station]
        if when > roster.expires:
            why, fix = f"{name} has dated its newest page {created}.", f"Set the clock of {name}."
        else:
            why = f"The clock is behind the newest page of {name} ({created})."
            fix = f"Set the clock of this machine, or that of {name}."
        yield Finding("registry", "warning", why, fix)


def _roster(roster: Roster, now: datetime) -> Finding:
    until = f"{roster.name}: roster {roster.version} holds until {roster.expires:%Y-%m-%d}."
    if now >= roster.expires:
        return Finding("registry", "failed", f"{until} It has expired.", "Where the CA key is: registry renew")
    if now >= roster.expires - rosters.WARN_BEFORE:
        return Finding("registry", "warning", until, "Where the CA key is: teds-provision registry renew")
    return Finding("registry", "ok", until)
