"""A measurement's request: what to measure of each node, and the receivers of news."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from teds_provision.errors import PolicyError
from teds_provision.measure.blocks import Block, ChannelFacts, NodeReport
from teds_provision.measure.verified_session import LEASE
from teds_provision.protocol.operation.stream_commands import StreamKind
from teds_provision.shapes.measurement import MeasurementSpec
from teds_provision.teds.fits import Fit, Requirement, judge, met
from teds_provision.teds.sheet import Sheet

# Requirements that the verified datasheets of a measurement must meet (`measure --require`).
#
# Any node of the group may meet a requirement. So before channels are claimed, each node waits until the others have
# shown their datasheets (at most :data:`WAITING`). A node that returns with another datasheet is checked again.

WAITING = 10.0  # seconds, from the first datasheet


class Requirements:
    """Requirements against the nodes of one measurement. Thread-safe; ``fits`` is what was found last."""

    def __init__(self, requirements: Sequence[Requirement], *, waiting: float = WAITING) -> None:
        self._requirements, self._waiting = tuple(requirements), waiting
        self._sheets: dict[bytes, Sheet] = {}
        self._coming: set[bytes] = set()
        self._until: float | None = None
        self._turn = threading.Condition()
        self.fits: list[dict[str, Any]] = []

    def expect(self, uuids: Iterable[bytes]) -> None:
        """Expect these nodes to show a datasheet."""
        with self._turn:
            self._coming.update(uuids)

    def drop_node(self, uuid: bytes) -> None:
        """Drop a node that will not show any requirement after all."""
        with self._turn:
            self._coming.discard(uuid)
            self._turn.notify_all()

    def offer(self, uuid: bytes, sheet: Sheet, stop: threading.Event) -> None:
        """Check a node's present datasheet; returns when all of them suffice. Raises PolicyError (6)."""
        with self._turn:
            self._sheets[uuid] = sheet
            self._coming.discard(uuid)
            self._turn.notify_all()
            self._until = self._until or time.monotonic() + self._waiting
            while self._coming and not stop.is_set() and (left := self._until - time.monotonic()) > 0:
                self._turn.wait(min(left, 0.2))
            unmet = self._judge()
        if unmet:
            raise PolicyError(
                f"The datasheets do not meet: {', '.join(unmet)}.",
                hint="For the reasons: nodes --fits, or --json.",
            )

    def _judge(self) -> list[str]:
        self.fits, unmet = [], []
        for requirement in self._requirements:
            found: list[Fit] = []
            for uuid, sheet in sorted(self._sheets.items()):
                for fit in judge(requirement, sheet):
                    found.append(fit)
                    self.fits.append({"uuid": uuid.hex(), "channel": fit.channel, "result": fit.result, "why": fit.why})
            if not met(requirement, found):
                unmet.append(requirement.subject)
        return unmet


@dataclass(frozen=True, kw_only=True)
class MeasurementRequest(MeasurementSpec):
    """Request for a measurement: settings that are stored, and what holds for this run alone."""

    lease: int = LEASE
    timeout: float = 60.0
    patient: bool = False  # wait for a node and retry without limit: no refusal is final
    unverified: bool = False  # only nodes with an unsigned datasheet, calibrated by it and marked so
    requirements: Requirements | None = None  # the parsed text of ``require``, checked against all nodes of the run
    require_firmware: bool = False  # only nodes whose firmware their type accepts
    # nodes come and go: no share of the bus is reserved for an absent one, and its first error ends it
    newcomers: bool = False
    by: str = "measure"  # the command that is recorded with a reading of the datasheet
    # other processes that measure the same nodes, for messages
    beside: Mapping[bytes, str] = field(default_factory=dict)

    @property
    def stream_kind(self) -> StreamKind | None:
        """How each channel samples, None: by the datasheet."""
        return None if self.kind is None else StreamKind[self.kind.upper()]


@dataclass
class Events:
    """Receivers of a node's news; each may be called from any thread and returns at once."""

    block: Callable[[Block], None]
    facts: Callable[[Sequence[ChannelFacts]], None]
    report: Callable[[NodeReport], None]
    reread_done: Callable[[bytes], None] = lambda _uuid: None  # the rest of its datasheet was read in the background
