"""How one board of many ended, and what all of them came to."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from teds_provision.errors import NoNode, NotAuthentic, PolicyRefused, TedsProvisionError
from teds_provision.steps.provision import Provisioned
from teds_provision.steps.verify import require_authentic
from teds_provision.store import utc_now

Result = Literal["passed", "failed", "skipped"]


class Declined(PolicyRefused):
    """A person said no: nothing was changed."""

    code = "declined"


@dataclass(frozen=True)
class Board:
    """The end of one board: what was done, or the error that ended it. ``row`` is that of a sheet, from 1."""

    uuid: bytes
    seconds: float
    done: Provisioned | None = None
    error: TedsProvisionError | None = None
    row: int | None = None
    place: str = ""
    time: str = field(default_factory=utc_now)

    @property
    def failure(self) -> TedsProvisionError | None:
        """The error that ended it, or the verdict that is not ``authentic``; None for a board that passed."""
        if self.error is not None or self.done is None:
            return self.error
        try:
            require_authentic(self.done.verified)
        except TedsProvisionError as error:
            return error
        return None

    @property
    def result(self) -> Result:
        """``passed``: provisioned and authentic; ``skipped``: somebody said no."""
        if isinstance(self.error, Declined):
            return "skipped"
        return "failed" if self.failure is not None else "passed"


@dataclass(frozen=True)
class Totals:
    """What a batch came to: boards by result, seconds, and the share that passed at their first try (None: no try).

    ``steps`` are the mean seconds of each step over the boards that passed.
    """

    passed: int
    failed: int
    skipped: int
    seconds: float
    first_pass: float | None
    steps: dict[str, float]
    worst: TedsProvisionError | None = None

    @property
    def error(self) -> TedsProvisionError | None:
        """What the command ends with: nothing if all passed, else the worst that happened."""
        if not self.failed and not self.skipped:
            return None
        told = f"{self.passed} passed, {self.failed} failed, {self.skipped} skipped."
        if isinstance(self.worst, NoNode):  # told nowhere else: no board came whose error it would be
            told = f"{told} {self.worst.message}"
        kind = type(self.worst) if self.worst is not None else PolicyRefused
        known = kind if kind.__init__ is TedsProvisionError.__init__ else PolicyRefused
        return known(told, hint="Run the same command again: it carries on with what is left.")


def worse(one: TedsProvisionError | None, other: TedsProvisionError | None) -> TedsProvisionError | None:
    """Whichever a person should hear of first: not authentic, then refused, then the rest."""
    if one is None or other is None:
        return one or other
    return max(one, other, key=_weight)


def _weight(error: TedsProvisionError) -> int:
    if isinstance(error, NotAuthentic):
        return 3
    return 2 if isinstance(error, PolicyRefused) and not isinstance(error, Declined) else 1
