"""What a rule is, when it can be run, and the register of all rules."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final

from teds_provision.check.probe import Probe


class Stage(Enum):
    """When a rule is run, in this order. From AGREEMENT on the node's key changes, but for SESSION with a held key."""

    PLAIN = "in any state, changes nothing"
    FACTORY = "in factory state, changes nothing"
    AGREEMENT = "a factory node is given a key"
    KEYED = "a node with a key of this station, plainly"
    SESSION = "in sessions; what is staged is dropped"
    COMMIT = "a datasheet is committed"
    RESET = "the node goes back to factory state"


@dataclass(frozen=True)
class Rule:
    """One rule: its name, the section of docs/profile.md that makes it, and how it is tried.

    ``run`` returns what was seen, in few words; raises RuleBroken, NotApplicable or a LinkFailure.
    """

    name: str
    section: str
    stage: Stage
    run: Callable[[Probe], str]

    @property
    def clause(self) -> str:
        """Page and section."""
        return f"profile.md, {self.section}"


RULES: Final[list[Rule]] = []
"""Every rule, in the order in which they are run within their stage."""


def rule(name: str, section: str, stage: Stage) -> Callable[[Callable[[Probe], str]], Callable[[Probe], str]]:
    """Register a function as a rule of this name."""

    def register(run: Callable[[Probe], str]) -> Callable[[Probe], str]:
        RULES.append(Rule(name, section, stage, run))
        return run

    return register
