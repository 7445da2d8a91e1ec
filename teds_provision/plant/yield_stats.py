"""Statistics of a line: first-pass yield, seconds per step, failures by code, per station (``job status``).

From evidence if it is at hand; of other stations from their pages alone, which contain no seconds.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import chain
from statistics import median
from typing import Any, Final

from teds_provision.plant.apply_pages import counted_places
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.evidence import GOOD_RESULTS, PASSED, Evidence, read
from teds_provision.protocol.plant.job import Job
from teds_provision.station.station import Station

UNREPORTED: Final = "unreported"
"""The code of a board that an office signed and whose line reported no result yet."""
COLUMNS: Final = ("station", "name", "uuid", "unit", "attempt", "verdict", "code", "finished", "seconds")


@dataclass(frozen=True)
class Attempt:
    """One attempt at one board.

    ``code`` is that of the error that ended it, None if it passed; ``steps`` are seconds, None if unknown.
    """

    station: str
    uuid: bytes
    unit: int | None
    attempt: int
    code: str | None
    finished: str
    steps: dict[str, float] | None = None

    @classmethod
    def from_evidence(cls, evidence: Evidence) -> Attempt:
        """Return the attempt of an evidence document; a failed step counts in ``code`` alone."""
        facts = evidence.facts
        steps = {name: milliseconds / 1000 for name, result, milliseconds in facts.steps if result in GOOD_RESULTS}
        return cls(facts.station, evidence.uuid, facts.unit, facts.attempt, facts.failure, evidence.finished, steps)


@dataclass
class StationYield:
    """One station's part of a job. ``units``: boards; ``reported``: those with a result; ``first``: passed at once."""

    station: str
    name: str
    allotment: int
    units: int = 0
    passed: int = 0
    first: int = 0
    reported: int = 0
    attempts: int = 0
    failures: Counter[str] = field(default_factory=Counter)
    steps: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Median and worst seconds of each step, over the attempts that passed."""

    @property
    def over(self) -> bool:
        """True if it took more units than the job allots to it."""
        return self.units > self.allotment

    @property
    def first_pass(self) -> float | None:
        """Share of the reported boards that passed at their first attempt, None before the first result."""
        return round(self.first / self.reported, 4) if self.reported else None

    def to_json(self) -> dict[str, Any]:
        """Return one station of ``job status``."""
        steps = {name: {"median": middle, "worst": worst} for name, (middle, worst) in self.steps.items()}
        members: dict[str, Any] = {
            "station": self.station,
            "name": self.name,
            "allotment": self.allotment,
            "units": self.units,
            "passed": self.passed,
            "first_pass": self.first_pass,
            "attempts": self.attempts,
            "over": self.over,
        }
        return {**members, "failures": dict(self.failures.most_common()), "steps": steps}


def attempts_of(station: Station, job: str, files: Iterable[bytes] = ()) -> list[Attempt]:
    """Return every known attempt of a job: own evidence, evidence of others (``files``), and the pages of others.

    A file that is no evidence of this job raises BadDataError, or is passed over.
    """
    found: dict[tuple[str, bytes, int], Attempt] = {}
    known: set[str] = set()
    for octets in chain((row.document for row in station.plant.line.evidence(job=job)), files):
        evidence = read(octets)
        if evidence.facts.job == job:
            attempt = Attempt.from_evidence(evidence)
            found[attempt.station, attempt.uuid, attempt.attempt] = attempt
            known.add(hashlib.sha256(octets).hexdigest())
    for digest, attempt in _of_pages(station, job):
        if digest not in known:
            found.setdefault((attempt.station, attempt.uuid, attempt.attempt), attempt)
    boards = {(attempt.station, attempt.uuid) for attempt in found.values()}
    signed = [attempt for attempt in _of_requests(station, job) if (attempt.station, attempt.uuid) not in boards]
    return sorted([*found.values(), *signed], key=lambda attempt: (attempt.station, attempt.uuid, attempt.attempt))


def _of_requests(station: Station, job: str) -> Iterator[Attempt]:
    """Yield the boards that this office signed for a line whose pages and evidence are not here yet."""
    line = station.plant.line
    for unit in line.units(job):
        peers = {row.peer for row in line.sign_requests(job, unit.uuid, "in") if row.sequence is not None}
        for peer in sorted(peers):
            yield Attempt(peer, unit.uuid, unit.unit, 1, UNREPORTED, "")


def _of_pages(station: Station, job: str) -> Iterator[tuple[str, Attempt]]:
    """Yield the attempts that pages which count report, in their order, each with the SHA-256 of its evidence."""
    roster, counts = station.plant.roster, Counter[tuple[str, bytes]]()
    if roster is None:
        return
    for name, pages in station.plant.pages.chains().items():
        counted = counted_places(station, roster, pages)
        for page in station.plant.pages.each(pages.id):
            if (page.n, page.hash) not in counted:
                continue
            for value in json.loads(page.content).get("events", []):
                stated = event.read(value)
                if not isinstance(stated, event.Event) or stated.act != "evidence" or stated.uuid is None:
                    continue
                if stated.members["job"] != job:
                    continue
                counts[name, stated.uuid] += 1
                verdict = stated.members["verdict"]
                code = None if verdict == PASSED else verdict.partition(": ")[2] or verdict
                attempt = Attempt(name, stated.uuid, stated.members["unit"], counts[name, stated.uuid], code, stated.at)
                yield stated.members["sha256"], attempt


def yield_stats(station: Station, job: Job, attempts: Iterable[Attempt]) -> list[StationYield]:
    """Return the result of each station of a job, those without any attempt included."""
    roster = station.plant.roster
    names = {key: roster.name_of(key) if roster is not None else key[:16] for key in job.stations}
    found = {key: StationYield(key, names[key], number) for key, number in job.stations.items()}
    by_board: dict[tuple[str, bytes], list[Attempt]] = {}
    for attempt in attempts:
        by_board.setdefault((attempt.station, attempt.uuid), []).append(attempt)
    times: dict[str, dict[str, list[float]]] = {}
    for (key, _), tries in by_board.items():
        name = roster.name_of(key) if roster is not None else key[:16]
        part = found.setdefault(key, StationYield(key, name, 0))
        tries.sort(key=lambda attempt: attempt.attempt)
        part.units += 1
        if tries[0].code == UNREPORTED:
            continue
        part.reported += 1
        part.attempts += len(tries)
        part.passed += any(attempt.code is None for attempt in tries)
        part.first += tries[0].code is None and tries[0].attempt == 1
        part.failures.update(attempt.code for attempt in tries if attempt.code is not None)
        for attempt in tries:
            for step, seconds in (attempt.steps or {}).items() if attempt.code is None else ():
                times.setdefault(key, {}).setdefault(step, []).append(seconds)
    for key, steps in times.items():
        found[key].steps = {step: (round(median(all_of), 3), max(all_of)) for step, all_of in steps.items()}
    return list(found.values())


def to_csv(station: Station, attempts: Iterable[Attempt]) -> str:
    """Return every attempt as a row of CSV."""
    roster = station.plant.roster
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    attempts = list(attempts)
    steps = list(dict.fromkeys(step for attempt in attempts for step in attempt.steps or {}))
    writer.writerow([*COLUMNS, *map(_as_text, steps)])
    for attempt in attempts:
        name = _as_text(roster.name_of(attempt.station) if roster is not None else "")
        seconds = "" if attempt.steps is None else f"{sum(attempt.steps.values()):.3f}"
        verdict = "passed" if attempt.code is None else "failed"
        row = [
            attempt.station,
            name,
            attempt.uuid.hex(),
            attempt.unit or "",
            attempt.attempt,
            verdict,
            _as_text(attempt.code or ""),
            attempt.finished,
        ]
        writer.writerow([*row, seconds, *((attempt.steps or {}).get(step, "") for step in steps)])
    return out.getvalue()


def _as_text(text: str) -> str:
    """Return a text of others as a cell: what a spreadsheet would evaluate as a formula gets an apostrophe."""
    return f"'{text}" if text[:1] in ("=", "+", "-", "@") else text
