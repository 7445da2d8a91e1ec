"""An owner with stations: the first has the CA key; each has joined the registry whose roster the CA signed."""

from __future__ import annotations

import uuid
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from teds_provision.protocol.plant.job import CalibrationRule, Job, seal_job
from teds_provision.protocol.plant.roster import Member, Roster, open_roster, seal_roster
from teds_provision.station.plant.plant import PlantRecord, RosterRow
from teds_provision.station.station import Station
from teds_provision.teds.profile.load import default_folders, files_digest, find_profile
from teds_provision.vault.base import Vault
from tests.bench import make_station

REGISTRY = "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"
NOW = datetime.now(UTC).replace(microsecond=0)
ANGLE = "magnetic-angular-position-sensor"
ALL = ("keeper", "line", "sign", "base")


def member(station: Station, name: str, *roles: str) -> Member:
    return Member(name, station.point, station.identity.signature, frozenset(roles))


def roster_of(owner: Station, *members: Member, **changes: Any) -> Roster:
    """Return a roster that the owner's CA signed."""
    drafted = Roster(
        REGISTRY,
        "plant",
        changes.pop("version", 1),
        changes.pop("previous", ""),
        NOW - timedelta(days=1),
        NOW + timedelta(days=30),
        members,
    )
    return open_roster(seal_roster(replace(drafted, **changes), ca_of(owner).ca()), owner.identity.ca)  # type: ignore[arg-type]


def ca_of(station: Station) -> Vault:
    station.unlock()
    return station.vault


def join(station: Station, roster: Roster) -> None:
    """What `registry connect` does: this roster holds here."""
    station.unlock()
    with station.transaction():
        station.plant.put_record(PlantRecord(REGISTRY))
        station.plant.put_roster(RosterRow(roster.version, roster.hash, roster.octets, True, ""))


def alone(home: Path) -> Station:
    """Return an owner whose one station is everything."""
    station = make_station(home, "owner")
    join(station, roster_of(station, member(station, "owner", *ALL)))
    return station


def job_of(keeper: Station, **changes: Any) -> bytes:
    """Return a job for three boards, signed by the keeper."""
    drafted = Job(
        str(uuid.uuid4()),
        REGISTRY,
        "three angles",
        ANGLE,
        files_digest(find_profile(ANGLE), default_folders()),
        CalibrationRule(),
        3,
        {},
        NOW - timedelta(hours=1),
        NOW + timedelta(hours=1),
        {keeper.identity.fingerprint: 3},
        "tap",
    )
    keeper.unlock()
    return seal_job(replace(drafted, **changes), keeper.credentials().key)
