"""``node check``: what it prints and how it ends, by what the rules found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from teds_provision import check as check_room
from teds_provision.check.rule import RuleResult
from teds_provision.check.run import CheckReport
from teds_provision.errors import NodeSilentError

from .shell import call

UUID = "8d4d9da65281f7000000"
PASSED = RuleResult("identify", "profile.md, Identify, Prove, List", "passed", "factory, epoch 0")
FAILED = RuleResult("open", "profile.md, Sessions", "failed", "a bad tag", "the label without its 00")
SKIPPED = RuleResult("keyed-untapped", "profile.md, Which command when", "skipped", "Connect the board's CAN.")
LOST = NodeSilentError("The node fell silent in the rule open.", hint="Look at its power.")
NFC = ("--nfc", "udp:localhost:9")


@pytest.fixture
def found(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return what the rules find, and behind it how each run was asked for."""
    calls: list[Any] = []

    def check_at(_station: object, links: Any, _reporter: object, **how: bool) -> CheckReport:
        calls.append((links.places, how))
        return calls[0]  # type: ignore[no-any-return]

    monkeypatch.setattr(check_room.run, "check_at", check_at)
    return calls


@pytest.mark.parametrize(
    ("checks", "lost", "code", "message", "hint"),
    [
        ((PASSED, SKIPPED), None, 0, None, None),
        ((), None, 0, None, None),
        ((PASSED, FAILED), None, 4, "The node breaks a rule: open.", ""),
        ((FAILED, FAILED, SKIPPED), None, 4, "The node breaks 2 rules: open, open.", ""),
        ((PASSED, SKIPPED), LOST, 5, "The node fell silent in the rule open.", "Look at its power."),
        ((FAILED, SKIPPED), LOST, 4, "The node breaks a rule: open.",
         "The node fell silent in the rule open. The remaining rules were not tried."),
    ],
)  # fmt: skip
def test_a_broken_rule_is_4_and_a_node_that_fell_silent_5(
    home: Path,
    found: list[Any],
    checks: tuple[RuleResult, ...],
    lost: NodeSilentError | None,
    code: int,
    message: str | None,
    hint: str | None,
) -> None:
    found.append(CheckReport(bytes.fromhex(UUID), checks, lost))
    done = call(home, "--json", "node", "check", *NFC)
    members = done.json
    assert done.code == code
    assert [entry["rule"] for entry in members["checks"]] == [result.rule for result in checks]
    counts = {word: sum(result.result == word for result in checks) for word in ("passed", "failed", "skipped")}
    assert {word: members[word] for word in counts} == counts
    error = members.get("error")
    assert (error and error["message"], error and error["hint"]) == (message, hint)
    assert "explain" not in members
    if FAILED in checks:
        assert members["checks"][checks.index(FAILED)] == {
            "rule": "open", "clause": "profile.md, Sessions", "result": "failed", "detail": "a bad tag",
            "slip": "the label without its 00",
        }  # fmt: skip
    assert found[1:] == [(("nfc:udp:localhost:9",), {"factory": False, "explained": False})]
    people = call(home, "node", "check", *NFC)
    assert people.code == code
    summary = ", ".join(f"{count} {word}" for word, count in counts.items())
    assert people.out.splitlines()[-1] == f"{UUID}: {summary}"


def test_a_test_agreement_that_could_not_be_made_says_why(home: Path, found: list[Any]) -> None:
    found.append(CheckReport(bytes.fromhex(UUID), (PASSED,), None, "The node has another owner."))
    done = call(home, "--json", "node", "check", "--explain", *NFC)
    assert (done.code, done.json["explain"]) == (0, {"problem": "The node has another owner."})
    assert found[1][1] == {"factory": False, "explained": True}
    people = call(home, "node", "check", "--explain", *NFC)
    assert people.out.splitlines()[-1] == "The node has another owner."


@pytest.mark.parametrize(
    ("words", "plan"),
    [
        ((), "the rules that change no key"),
        (("--factory",), "key, write and reset the node, claim an actuator, every rule"),
    ],
)
def test_a_plan_meets_no_node_and_a_yes_is_needed_for_keys_alone(
    home: Path, found: list[Any], words: tuple[str, ...], plan: str
) -> None:
    found.append(CheckReport(bytes.fromhex(UUID), (PASSED,)))
    done = call(home, "--json", "node", "check", *words, "--dry-run", *NFC)
    assert (done.code, done.json, len(found)) == (0, {"plan": plan}, 1)
    refused = call(home, "--json", "node", "check", *words, *NFC)
    assert (refused.code, len(found)) == ((6, 1) if words else (0, 2))
    assert call(home, "--json", "node", "check", *words, "--yes", *NFC).code == 0
    assert found[-1][1]["factory"] == bool(words)
