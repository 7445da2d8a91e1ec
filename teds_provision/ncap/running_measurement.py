"""One measurement of the service: the request, its nodes and their reports, its state."""

from __future__ import annotations

import threading
from concurrent.futures import Future
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from teds_provision.measure.matching import ListedNodes, NodeMatch, UnsignedNodes
from teds_provision.measure.running.measurement import Measurement
from teds_provision.measure.running.measurement_job import MeasurementJob
from teds_provision.ncap.membership import Budget, Membership
from teds_provision.station.store.records import KeptMeasurement


class Phase(Enum):
    """The phase of a measurement; ``SELECTING``: a frozen expression has not selected a node yet."""

    SELECTING = "selecting"
    LOCKING = "locking"
    MEASURING = "measuring"
    ENDING = "ending"
    OVER = "over"


@dataclass
class RunningMeasurement:
    """One measurement that runs, or tries to.

    ``kept`` has the nodes of a frozen expression once it has selected any; ``asked`` is the request. ``past``:
    nodes whose reports are obsolete. ``logged``: nodes whose first value is in the audit log.
    """

    kept: KeptMeasurement
    membership: Membership
    asked: KeptMeasurement
    who: NodeMatch | UnsignedNodes | ListedNodes | None = None  # only for measurements that nodes join as they come
    job: MeasurementJob | None = None
    phase: Phase = Phase.LOCKING
    state: str = "starting"
    why: str = ""
    reports: dict[str, dict[str, Any]] = field(default_factory=dict)
    past: set[str] = field(default_factory=set)
    logged: set[str] = field(default_factory=set)
    stop: threading.Event = field(default_factory=threading.Event)
    over: threading.Event = field(default_factory=threading.Event)
    deleted: bool = False  # it is ending and is no longer shown
    looked: float = 0.0  # time.monotonic() of the last slow check, or of the start of waiting for its nodes
    until: float = 0.0  # latest time of its end, in order or not
    # the selection of nodes for a frozen expression, in progress
    selection: Future[tuple[list[bytes], str]] | None = None
    again: bool = False  # it will start again with other nodes
    failed: str = ""
    not_before: float = 0.0  # after a failed read of the store: time of the next try
    # Only for measurements that nodes join as they come.
    budget: Budget = field(default_factory=Budget)
    unknown_type: str = ""
    # the one to which the members belong; a new one is made after sinks have failed
    measurement: Measurement | None = None
    version: object = None
    followed: float = 0.0
    asked_anew: bool = False

    @property
    def uuids(self) -> tuple[str, ...]:
        """Its nodes; of one that takes nodes in as they come, those that are in."""
        return self.membership.joined

    @property
    def takes_in(self) -> bool:
        """True if it takes nodes in as they come."""
        return self.asked.match is not None and not self.asked.frozen

    def log_facts(self) -> dict[str, Any]:
        """Return its members of an audit entry: what is measured, and who requested it."""
        return facts_for_log(self.asked)

    def counts(self) -> dict[str, int]:
        """Return samples and lost ones of all its nodes, for the audit log; nothing if it never had a node."""
        reports = list(self.reports.values())
        found = {name: sum(int(report.get(name) or 0) for report in reports) for name in ("samples", "lost")}
        return found if reports else {}

    def lower_rate(self) -> float | None:
        """Return the rate to try if it loses values, for its worst stream; None if it loses none."""
        measurement = self.job.measurement if self.job is not None else None
        if measurement is None:
            return None
        streams = [totals for supervisor in list(measurement.supervisors) for totals in supervisor.streams.summed()]
        return min((rate for totals in streams if (rate := totals.lower_rate) is not None), default=None)

    def present_state(self, job: MeasurementJob, taken: int) -> tuple[str, str]:
        """Return state and reason by the reports of its nodes; ``taken`` are measured by another measurement."""
        return self._state_of_open(job, taken) if self.takes_in else self._state_of_listed(job)

    def is_measuring(self, uuid: str) -> bool:
        """Return True if values of a node come."""
        return bool(self.reports.get(uuid, {}).get("state") == "running")

    def _state_of_open(self, job: MeasurementJob, taken: int) -> tuple[str, str]:
        if any(self.is_measuring(uuid) for uuid in self.uuids):
            return "running", ""
        if job.error is not None:
            return "waiting", job.error.message
        if taken:
            return "waiting", f"{taken} matching node{'s are' if taken > 1 else ' is'} measured by another measurement"
        return "waiting", (self.unknown_type if not self.reports else "") or "no matching node is present"

    def _state_of_listed(self, job: MeasurementJob) -> tuple[str, str]:
        states = [report["state"] for report in self.reports.values()]
        if "running" in states:
            lacking = sum(not self.is_measuring(uuid) for uuid in self.uuids)
            return "running", self._of_all(lacking, "missing") if lacking else ""
        if job.error is not None:
            return "waiting", job.error.message
        refused = states.count("refused")
        if refused:
            return "waiting", self._of_all(refused, "refused")
        return ("waiting", "no node has answered yet") if states else ("starting", "")

    def _of_all(self, some: int, what: str) -> str:
        """Return ``1 of 3 nodes is missing``."""
        every = len(self.uuids)
        return f"{some} of {every} node{'s' if every > 1 else ''} {'is' if some == 1 else 'are'} {what}"


def facts_for_log(kept: KeptMeasurement) -> dict[str, Any]:
    """Return the members of an audit entry: what is measured, and who requested it."""
    meant = {"group": kept.group, "match": kept.match, "rate": kept.rate, "owner": kept.owner}
    return {"id": kept.id, **{name: value for name, value in meant.items() if value is not None}}
