"""Decides how long a node is retried after an error, and which errors are final."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from teds_provision.errors import (
    BadDataError,
    BadDatasheetError,
    InternalError,
    NodeRefusedError,
    NotAuthenticError,
    PolicyError,
    StoreError,
    TedsProvisionError,
)
from teds_provision.protocol.messages.frames import Reason

CURED_BY_TIME = frozenset({Reason.WRONG_STATE, Reason.BUSY, Reason.BAD_TAG, 21, 22, 23})
_FINAL = (NotAuthenticError, PolicyError, BadDataError, StoreError, InternalError)


class RetryPolicy:
    """Retries a node for ``timeout`` seconds (None: without limit) until its first value, and then without limit."""

    def __init__(self, timeout: float | None) -> None:
        self._until = math.inf if timeout is None else time.monotonic() + timeout
        self._ends = timeout is not None

    def has_run(self) -> None:
        """Handle its first value: from now on a refusal may come from another device, so retry without end."""
        self._until = math.inf

    @property
    def seconds_left(self) -> float:
        """Seconds in which a first value has to come."""
        return max(0.0, self._until - time.monotonic())

    def next_try(self, pause: float) -> str:
        """Return when it is tried again, and for how long, as text."""
        left = self.seconds_left
        return f"{pause:.0f} s" if left == math.inf else f"{min(pause, left):.0f} s, giving up in {left:.0f} s"

    def gives_up(
        self, error: TedsProvisionError, *, proven: bool, elsewhere: Callable[[], bool], decided: bool = False
    ) -> bool:
        """Return True if no other try is worth it.

        ``decided``: this station itself decided so, by a ban, its whitelist or its trust. ``proven``: the error came
        under the node's key. Without it any device on the bus can take the node's UUID and refuse: then the node is
        searched ``elsewhere``.
        """
        # no deadline: only a decision, or a datasheet that changed during the run, can end the tries
        if self.seconds_left == math.inf:
            return self._ends and (decided or (proven and isinstance(error, BadDatasheetError)))
        if decided:
            return True
        passing = isinstance(error, NodeRefusedError) and error.reason in CURED_BY_TIME
        if not isinstance(error, _FINAL) or passing:
            return not self.seconds_left
        return proven or not elsewhere()
