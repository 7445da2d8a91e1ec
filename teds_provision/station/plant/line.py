"""Rows of a line: jobs, their units, evidence of every attempt, and requests to an office (contract/plant.md)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import Any, Final, Literal

from teds_provision.station.store.database import CHUNK, places
from teds_provision.station.store.records import utc_now
from teds_provision.station.store.store import Store


@dataclass(frozen=True)
class JobRow:
    """A job as it was taken: its id belongs to this H for ever. ``state``: ``open`` or ``closed``."""

    id: str
    hash: str
    octets: bytes = field(repr=False)
    state: str = "open"
    at: str = field(default_factory=utc_now)


@dataclass(frozen=True)
class UnitRow:
    """One unit of a job: given to one board, for ever.

    ``attempts`` were begun; ``passed`` is the number of the one at which it passed first, 0 for none.
    """

    job: str
    uuid: bytes
    unit: int
    at: str
    attempts: int = 1
    passed: int = 0


@dataclass(frozen=True)
class EvidenceRow:
    """One document with its own facts; ``sha256`` is that of its octets."""

    sha256: str
    uuid: bytes
    job: str | None
    unit: int | None
    attempt: int
    verdict: str
    finished: str
    document: bytes = field(repr=False)


@dataclass(frozen=True)
class SignRequestRow:
    """A request for a signature, asked (``out``) or answered (``in``) here; ``hash`` is H of the request."""

    hash: str
    direction: Literal["out", "in"]
    job: str
    uuid: bytes
    peer: str
    request: bytes = field(repr=False)
    answer: bytes | None = field(default=None, repr=False)
    sequence: int | None = None
    at: str = field(default_factory=utc_now)


_UNIT = ", ".join(column.name for column in fields(UnitRow))
_EVIDENCE = ", ".join(column.name for column in fields(EvidenceRow))
_REQUEST = ", ".join(column.name for column in fields(SignRequestRow))
_REQUESTS_AT_ONCE: Final = 16
"""Each has an image and a calibration: up to 1 MiB."""


class Line:
    """Jobs, units, evidence and sign requests of one station."""

    def __init__(self, store: Store) -> None:
        self._store = store

    # -- jobs and their units --------------------------------------------------------------------------------------

    def job(self, id: str) -> JobRow | None:
        """Return a job that was taken."""
        return self._store.read_one(JobRow, "SELECT id, hash, octets, state, at FROM jobs WHERE id = ?", (id,))

    def jobs(self) -> list[JobRow]:
        """Return every job, oldest first."""
        return self._store.read(JobRow, "SELECT id, hash, octets, state, at FROM jobs ORDER BY at, id")

    def add_job(self, row: JobRow) -> None:
        """Keep a job; one of this id that is there stays as it is."""
        values = (row.id, row.hash, row.octets, row.state, row.at)
        self._store.execute("INSERT OR IGNORE INTO jobs(id, hash, octets, state, at) VALUES(?, ?, ?, ?, ?)", values)

    def set_job_state(self, id: str, state: str) -> None:
        """Open or close a job."""
        self._store.execute("UPDATE jobs SET state = ? WHERE id = ?", (state, id))

    def state_of(self, id: str) -> tuple[str | None, bool]:
        """Return a job's state, None if it was not taken, and whether this station's clock was once past its end."""
        state, seen = self._store.execute(
            "SELECT (SELECT state FROM jobs WHERE id = ?), EXISTS(SELECT 1 FROM meta WHERE name = ?)",
            (id, f"job-over-{id}"),
        )[0]
        return state, bool(seen)

    def put_end_seen(self, id: str) -> None:
        """Record that this station's clock was past the end of the job."""
        self._store.execute("INSERT OR IGNORE INTO meta VALUES(?, ?)", (f"job-over-{id}", utc_now()))

    def unit(self, job: str, uuid: bytes) -> UnitRow | None:
        """Return the unit that a board has of a job."""
        return self._store.read_one(UnitRow, f"SELECT {_UNIT} FROM units WHERE job = ? AND uuid = ?", (job, uuid))

    def units(self, job: str) -> list[UnitRow]:
        """Return every unit of a job, by number."""
        return self._store.read(UnitRow, f"SELECT {_UNIT} FROM units WHERE job = ? ORDER BY unit", (job,))

    def count_units(self, job: str) -> tuple[int, int, int]:
        """Return how many units were given, how many of them passed, and the greatest number."""
        row = self._store.execute(
            "SELECT count(*), coalesce(sum(passed > 0), 0), coalesce(max(unit), 0) FROM units WHERE job = ?",
            (job,),
        )[0]
        return int(row[0]), int(row[1]), int(row[2])

    def put_unit(self, row: UnitRow) -> None:
        """Keep a unit, or its new attempt."""
        self._store.execute(
            f"INSERT INTO units({_UNIT}) VALUES(?, ?, ?, ?, ?, ?)"
            " ON CONFLICT(job, uuid) DO UPDATE SET attempts = excluded.attempts, passed = excluded.passed",
            (row.job, row.uuid, row.unit, row.at, row.attempts, row.passed),
        )

    def put_passed(self, job: str, uuid: bytes, attempt: int) -> None:
        """Note the attempt at which a unit passed first; a unit that has passed stays as it is."""
        self._store.execute(
            "UPDATE units SET passed = ? WHERE job = ? AND uuid = ? AND passed = 0", (attempt, job, uuid)
        )

    # -- evidence --------------------------------------------------------------------------------------------------

    def add_evidence(self, row: EvidenceRow) -> None:
        """Keep a document, whole."""
        values = tuple(getattr(row, column.name) for column in fields(EvidenceRow))
        self._store.execute(f"INSERT OR IGNORE INTO evidence({_EVIDENCE}) VALUES({places(values)})", values)

    def last_attempt(self, uuid: bytes) -> int:
        """Return the number of the newest document about a board outside any job, 0 for none."""
        rows = self._store.execute(
            "SELECT coalesce(max(attempt), 0) FROM evidence WHERE uuid = ? AND job IS NULL", (uuid,)
        )
        return int(rows[0][0])

    def evidence(self, *, uuid: bytes | None = None, job: str | None = None) -> Iterator[EvidenceRow]:
        """Give documents, by board and attempt, some at a time: all, of one board, of one job."""
        which = [("uuid", uuid)] if uuid is not None else []
        chosen = [*which, *([("job", job)] if job is not None else [])]
        where = "".join(f" AND {name} = ?" for name, _ in chosen)
        values = [value for _, value in chosen]
        after: tuple[Any, ...] = (b"", 0, "")
        while True:
            rows = self._store.read(
                EvidenceRow,
                f"SELECT {_EVIDENCE} FROM evidence WHERE (uuid, attempt, sha256) > (?, ?, ?){where}"
                f" ORDER BY uuid, attempt, sha256 LIMIT {CHUNK}",
                (*after, *values),
            )
            yield from rows
            if len(rows) < CHUNK:
                return
            after = (rows[-1].uuid, rows[-1].attempt, rows[-1].sha256)

    def evidence_digests(self) -> set[str]:
        """Return the SHA-256 of every document that is kept."""
        return {str(row[0]) for row in self._store.execute("SELECT sha256 FROM evidence")}

    # -- requests to an office -------------------------------------------------------------------------------------

    def sign_request(self, hash: str, direction: Literal["out", "in"]) -> SignRequestRow | None:
        """Return a request by its H, None if it has the other direction or does not exist."""
        return self._store.read_one(
            SignRequestRow, f"SELECT {_REQUEST} FROM sign_requests WHERE hash = ? AND direction = ?", (hash, direction)
        )

    def sign_requests(self, job: str, uuid: bytes, direction: Literal["out", "in"]) -> list[SignRequestRow]:
        """Return the requests for one board of a job."""
        return self._store.read(
            SignRequestRow,
            f"SELECT {_REQUEST} FROM sign_requests WHERE job = ? AND uuid = ? AND direction = ?"
            " ORDER BY coalesce(sequence, 0), hash",
            (job, uuid, direction),
        )

    def all_sign_requests(self) -> Iterator[SignRequestRow]:
        """Give every request, asked and answered, some at a time."""
        after = ""
        while rows := self._store.read(
            SignRequestRow,
            f"SELECT {_REQUEST} FROM sign_requests WHERE hash > ? ORDER BY hash LIMIT {_REQUESTS_AT_ONCE}",
            (after,),
        ):
            yield from rows
            after = rows[-1].hash

    def put_sign_request(self, row: SignRequestRow) -> None:
        """Keep a request, or its answer."""
        values = tuple(getattr(row, column.name) for column in fields(SignRequestRow))
        self._store.execute(f"INSERT OR REPLACE INTO sign_requests({_REQUEST}) VALUES({places(values)})", values)
