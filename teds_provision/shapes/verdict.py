"""The checks of a datasheet, their one verdict, and how it is known.

``verify``, the API, its description and ``client`` take them from here. One more member is a field, its value in
``to_json`` and its type in the typed dictionary below, which type checkers hold against ``to_json``. The checks:
step 7, ``provisioning/verify.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Literal, NamedTuple, NotRequired, TypedDict

CheckResult = Literal["passed", "failed", "skipped"]
VerdictWord = Literal["authentic", "unsigned", "not authentic", "unproven"]
Scope = Literal["node", "image"]
Origin = Literal["session", "kept", "plain"]

SESSION: Final = "session"
"""The check that the TEDS came from the node."""
PAGES: Final = "pages"
"""The check that this station has every page of the plant that is needed to judge the signer."""
FRESHNESS: Final = frozenset({"sequence", "key epoch"})
MERELY_UNSIGNED: Final = frozenset({"signed", "every TEDS is signed"})
"""Checks that fail if the only fault is a missing signature."""


class Check(NamedTuple):  # a tuple, to save time: ten thousand files have thirteen checks each
    """One check of the datasheet; ``why`` is the finding.

    ``kept``: the TEDS concerned were not read again since the node last started; those of the last reading are judged
    in their place.
    """

    name: str
    result: CheckResult
    why: str = ""
    kept: bool = False

    def to_json(self) -> CheckMembers:
        """Return the check as `verify --json` and the API have it; a stored one has also ``from: kept``."""
        found = CheckMembers(name=self.name, result=self.result, why=self.why)
        if self.kept:
            found["from"] = "kept"
        return found


@dataclass(frozen=True)
class Verification:
    """All checks and the one verdict. ``scope``: a node, or an image file alone.

    ``unsigned``: the only fault is that (part of) it has no signature. ``unproven``: a key of the node is held and no
    session was opened, so that the answers may be a replay of recorded ones.
    """

    uuid: bytes
    checks: tuple[Check, ...]
    scope: Scope = "node"

    @cached_property  # read several times for each of ten thousand files
    def verdict(self) -> VerdictWord:
        """One word for all checks."""
        failed = {check.name for check in self.checks if check.result == "failed"}
        if PAGES in failed and failed <= {PAGES, SESSION}:
            return "unproven"
        if SESSION in failed:  # without a session, only the checks of freshness count
            return "not authentic" if failed & FRESHNESS else "unproven"
        if failed - MERELY_UNSIGNED:
            return "not authentic"
        return "unsigned" if failed else "authentic"

    def to_json(self) -> dict[str, Any]:
        """Return the members that `verify --json` begins with, of a node as of a file."""
        checks = [check.to_json() for check in self.checks]
        return {"uuid": self.uuid.hex(), "scope": self.scope, "verdict": self.verdict, "checks": checks}


@dataclass(frozen=True)
class NodeVerdict:
    """The verdict on a node, and what it rests on.

    ``origin``: every TEDS was read in a ``session`` since the node last started; or ``kept``: the Security TEDS was,
    and the rest is as it was read before; or ``plain``: nothing was read in a session. ``at`` is when the TEDS were
    read (ISO 8601), ``by`` the command that did.
    """

    verified: Verification
    origin: Origin
    at: str
    by: str

    def to_json(self) -> VerdictMembers:
        """Return the object of api.md, ``verdict``."""
        checks = [check.to_json() for check in self.verified.checks]
        return {"verdict": self.verified.verdict, "checks": checks, "from": self.origin, "at": self.at, "by": self.by}

    def reading(self) -> dict[str, str]:
        """Return how the verdict is known, as ``reading`` of `nodes --json`."""
        return {"from": self.origin, "at": self.at, "by": self.by}


KeptMember = TypedDict("KeptMember", {"from": NotRequired[Literal["kept"]]})  # "from" is a keyword of Python


class CheckMembers(KeptMember):
    """One check of a verdict; ``from`` if the TEDS concerned were not read again since the node last started."""

    name: str
    result: CheckResult
    why: str


OriginMember = TypedDict("OriginMember", {"from": Origin})


class VerdictMembers(OriginMember):
    """Verdict on a datasheet, and how it is known."""

    verdict: VerdictWord
    checks: list[CheckMembers]
    at: str
    by: str
