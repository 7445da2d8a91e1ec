"""Rules, the stages and links that they need, the register of all rules, and their results."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final, Literal

from teds_provision.check.probe import Probe

Result = Literal["passed", "failed", "skipped"]
PROFILE: Final = "profile.md"
OPERATION_PAGE: Final = "operation.md"


class Stage(Enum):
    """Stages of a check, in order. From AGREEMENT on the key changes, but in KEYED and SESSION with one held."""

    PLAIN = "in any state, changes nothing"
    FACTORY = "in factory state, changes nothing"
    AGREEMENT = "a factory node is given a key"
    KEYED = "a node with a key of this station"
    SESSION = "in sessions; what is staged is dropped"
    COMMIT = "a datasheet is committed"
    MEASURING = "channels are claimed; a board of ours keeps its TEDS"
    ROTATION = "the node is given another key"
    RESET = "the node goes back to factory state"


@dataclass(frozen=True)
class Rule:
    """One rule: its name, the section of a page of docs/ that makes it, and how it is tried.

    ``run`` returns what was seen, in few words; raises RuleBrokenError, NotApplicableError or a LinkError.
    """

    name: str
    section: str
    stage: Stage
    run: Callable[[Probe], str]
    page: str = PROFILE

    @property
    def clause(self) -> str:
        """Page and section."""
        return f"{self.page}, {self.section}"


@dataclass(frozen=True)
class RuleResult:
    """The result of one rule; ``detail`` gives what was sent and seen, or why it was skipped. Never holds a key.

    ``slip`` is the name of the known slip that explains it, None if none does.
    """

    rule: str
    clause: str
    result: Result
    detail: str
    slip: str | None = None


RULES: Final[list[Rule]] = []
"""Every rule, in the order in which they are run within their stage."""


def rule(
    name: str, section: str, stage: Stage, *, page: str = PROFILE
) -> Callable[[Callable[[Probe], str]], Callable[[Probe], str]]:
    """Register a function as a rule of this name."""

    def register(run: Callable[[Probe], str]) -> Callable[[Probe], str]:
        RULES.append(Rule(name, section, stage, run, page))
        return run

    return register
