"""Jobs at a station: their signers, finding one by its id, and reasons against work on it."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from teds_provision.errors import BadDataError, NotAuthenticError, NotFoundError, PolicyError, RosterExpiredError
from teds_provision.files import read_limited
from teds_provision.plant import parcels
from teds_provision.protocol.plant.document import JOB, is_form
from teds_provision.protocol.plant.job import Job, open_job
from teds_provision.protocol.plant.roster import Roster
from teds_provision.station.plant.line import JobRow
from teds_provision.station.station import Station
from teds_provision.teds.profile.load import default_folders, files_digest, find_profile

CLOSED: Final = "closed"
_MAX_PROFILE_OCTETS: Final = 1 << 20


def roster_of(station: Station) -> Roster:
    """Return the current roster; raises PolicyError if none was joined, RosterExpiredError."""
    roster = station.plant.roster
    if roster is None:
        raise PolicyError(
            "Jobs need a registry, and this station has not joined one.",
            hint="To join one: teds-provision registry connect. To create one: teds-provision registry create",
        )
    if now_of(roster) >= roster.expires:
        raise RosterExpiredError(
            "The roster has expired, so no job can start.",
            hint="Ask the owner to renew it: teds-provision registry renew",
        )
    return roster


def now_of(roster: Roster) -> datetime:
    """Return the time here, never before the roster was made: a clock that was put back opens no job again."""
    return max(datetime.now(UTC), roster.created)


def read_job(station: Station, octets: bytes) -> Job:
    """Read a signed job. Raises PolicyError (not a keeper's, another registry's), NotAuthenticError, BadDataError."""
    roster = roster_of(station)
    job = open_job(octets, roster.point_of)
    if not roster.has(job.signer, "keeper"):
        raise PolicyError(
            f"{roster.name_of(job.signer)} signed this job but is not a keeper.", hint="Ask a keeper for a job."
        )
    if job.registry != roster.registry:
        raise PolicyError("This job belongs to another registry.")
    return job


def kept_job(station: Station, row: JobRow) -> Job:
    """Return a job that was taken, also if its signer is no keeper today.

    Raises NotAuthenticError if the roster does not know its signer any more.
    """
    roster = station.plant.roster
    job = open_job(row.octets, roster.point_of if roster is not None else lambda kid: None)
    return replace(job, hash=row.hash)


def take_job(station: Station, octets: bytes) -> Job:
    """Read a job and keep it: its id means this document from now on. Raises PolicyError if it means another."""
    job = read_job(station, octets)
    with station.durable("job"):
        station.plant.line.add_job(JobRow(job.id, job.hash, job.octets))
        kept = station.plant.line.job(job.id)
        if kept is None or kept.hash != job.hash:
            raise PolicyError(
                f"A different job with the ID {job.id} is already known here.",
                hint="Ask the keeper for a job with a new ID.",
            )
    return job


def find_job(station: Station, text: str) -> Job:
    """Return the job of a file, or one that is kept here, by its id or the first digits of it.

    Raises NotFoundError, and what :func:`take_job` raises.
    """
    path = Path(text)
    if path.is_file():
        return take_job(station, read_limited(path, JOB.most, "job"))
    return read_job(station, job_row(station, text).octets)


def take_received(station: Station) -> None:
    """Take the jobs that a sync brought; a job not signed by a keeper is dropped and reported."""
    for row, octets in parcels.received(station, "job"):
        try:
            take_job(station, octets)
        except RosterExpiredError:
            return  # keep the jobs until a renewed roster decides
        except (BadDataError, NotAuthenticError, PolicyError) as error:
            station.notice(f"A received job was rejected: {error.message}")
        with station.durable("job"):
            station.plant.parcels.drop(row.id, "in")


def job_id(station: Station, text: str) -> str:
    """Return the whole id of a job that is kept here, from its first digits; raises NotFoundError."""
    return job_row(station, text).id


def job_row(station: Station, text: str) -> JobRow:
    """Return a job that is kept here, by its id or the first digits of it; raises NotFoundError."""
    take_received(station)
    if is_form("random_id", text.lower()):
        rows = [row for row in [station.plant.line.job(text.lower())] if row is not None]
    else:
        rows = [row for row in station.plant.line.jobs() if len(text) >= 4 and row.id.startswith(text.lower())]
    if len(rows) > 1:
        raise NotFoundError(
            f"{len(rows)} jobs have an ID that begins with {text}.",
            hint="Give more digits; see: teds-provision job list",
        )
    if not rows:
        raise NotFoundError(f"There is no job {text}, and no file with that name.", hint="See: teds-provision job list")
    return rows[0]


def require_open(station: Station, job: Job, *, for_station: str | None = None) -> None:
    """Raise PolicyError if a station may not work on the job now: too early, over, closed here, not for it.

    A job whose end this station has seen stays over: it is recorded, as the clock may be put back. ``for_station``: its
    fingerprint, by default this one's.
    """
    with station.reading():
        state, seen = station.plant.line.state_of(job.id)
        now = now_of(roster_of(station))
    if now >= job.ends and not seen:
        with station.durable("job"):
            station.plant.line.put_end_seen(job.id)
    why = "it is closed here" if state == CLOSED else None
    why = why or job.why_not(max(now, job.ends) if seen else now, for_station or station.identity.fingerprint)
    if why is not None:
        raise PolicyError(f"The job “{job.title}” cannot be worked on: {why}.", hint="Ask the keeper for a new job.")


def require_adopted(station: Station) -> None:
    """Raise PolicyError if a backup rebuilt this home and it does not know yet which units it gave since."""
    if station.plant.restored:
        raise PolicyError(
            "This home was restored from a backup, and only its own pages show which units it has assigned since.",
            hint="To get them: teds-provision registry sync",
        )


def close_job(station: Station, job: Job) -> None:
    """Take no further board of a job here, and report that to other stations."""
    with station.durable("job"):
        row = station.plant.line.job(job.id)
        if row is not None and row.state != CLOSED:
            station.plant.line.set_job_state(job.id, CLOSED)
            station.audit("job", None, CLOSED, job=job.id)
            station.plant.record_event("closed", None, job=job.id)


def profile_file(station: Station, job: Job) -> Path:
    """Return the file of the job's profile.

    Raises NotFoundError, BadDataError, and PolicyError if it, or a profile that it extends, is not the one in the job.
    """
    path = find_profile(job.profile, default_folders(station.home))
    require_profile(station, job, path)
    return path


def require_profile(station: Station, job: Job, path: Path) -> None:
    """Raise PolicyError unless a profile's file, with all that it extends, is the one in the job."""
    if files_digest(path, default_folders(station.home)) == job.profile_sha256:
        return
    if digest_of_file(path) == job.profile_sha256:
        raise PolicyError(
            f"The job names the file of profile {job.profile} alone, without the profiles that it extends.",
            hint="An earlier version created it. Ask its keeper for a new job.",
        )
    raise PolicyError(
        f"Profile {job.profile} is not the one in the job: {path}, with all that it extends, has a different SHA-256.",
        hint=f"Copy the job's profile, and those that it extends, to {station.home / 'profiles'}.",
    )


def digest_of_file(path: Path) -> str:
    """Return the SHA-256 of a small file, 64 hex digits; raises NotFoundError, BadDataError."""
    return hashlib.sha256(read_limited(path, _MAX_PROFILE_OCTETS, "file")).hexdigest()
