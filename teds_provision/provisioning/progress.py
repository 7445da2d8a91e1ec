"""Progress of a running workflow: steps with their time, and what it waits for."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from teds_provision.links import Notice

NOTHING = "nothing to do"
DONE = "done"
SKIPPED = "skipped"
FAILED = "failed"


@dataclass
class StepResult:
    """One step: ``result`` is "done", "nothing to do", "skipped" or "failed"; ``detail`` one short sentence for people.

    ``of`` names the node if several are worked on at once.
    """

    name: str
    result: str = DONE
    seconds: float = 0.0
    detail: str = ""
    of: str = ""

    def take_verdict(self, verdict: str) -> None:
        """End a step that verified a node: every verdict but "authentic" fails it."""
        self.result, self.detail = DONE if verdict == "authentic" else FAILED, verdict


class Reporter(Protocol):
    """Receiver of progress."""

    def started(self, step: str) -> None:
        """Report the start of a step."""

    def finished(self, step: StepResult) -> None:
        """Report a step that ended well."""

    def notice(self, notice: Notice) -> None:
        """Report that the run waits for something, or that something arrived."""

    def written(self, octets: int, total: int) -> None:
        """Report how many octets of the datasheet are staged."""


class SilentReporter:
    """A reporter without output."""

    def started(self, step: str) -> None:
        """Do nothing."""

    def finished(self, step: StepResult) -> None:
        """Do nothing."""

    def notice(self, notice: Notice) -> None:
        """Do nothing."""

    def written(self, octets: int, total: int) -> None:
        """Do nothing."""


class NodeReporter:
    """A reporter for one of several nodes that are worked on at once: its messages name that node."""

    def __init__(self, inner: Reporter, label: str) -> None:
        self._inner, self._label = inner, label

    def started(self, step: str) -> None:
        """Report the start of a step."""
        self._inner.started(step)

    def finished(self, step: StepResult) -> None:
        """Report a step of this node that ended well."""
        self._inner.finished(replace(step, of=self._label))

    def notice(self, notice: Notice) -> None:
        """Report that this node's run waits for something, or that something arrived."""
        self._inner.notice(replace(notice, text=f"{self._label}: {notice.text}"))

    def written(self, octets: int, total: int) -> None:
        """Report how many octets of its datasheet are staged."""
        self._inner.written(octets, total)


@dataclass
class Steps:
    """The steps of one run, reported as they happen."""

    reporter: Reporter
    done: list[StepResult] = field(default_factory=list)
    current: str = ""
    """The step that runs, or ran last."""

    @contextmanager
    def step(self, name: str) -> Iterator[StepResult]:
        """Run one step; what it found is put into the yielded result."""
        with self.deferred(name) as result:
            yield result
        self.finish(result)

    @contextmanager
    def deferred(self, name: str) -> Iterator[StepResult]:
        """Run one step whose effect a later one keeps: it is reported by :meth:`finish`, and not before."""
        self.current = name
        self.reporter.started(name)
        result, began = StepResult(name), time.monotonic()
        yield result
        result.seconds = round(time.monotonic() - began, 4)

    def finish(self, result: StepResult) -> None:
        """Report a step as it ended."""
        self.done.append(result)
        self.reporter.finished(result)
