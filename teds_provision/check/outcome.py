"""How a rule ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Result = Literal["passed", "failed", "skipped"]


class RuleBroken(Exception):
    """The node did not keep to the rule; the text says what was sent, what was due and what came."""


class NotApplicable(Exception):
    """The rule cannot be tried on this node, link or state; the text says why."""


@dataclass(frozen=True)
class Checked:
    """How one rule ended; ``detail`` is what was sent and seen, or why it was skipped. Never holds a key."""

    rule: str
    clause: str
    result: Result
    detail: str
