"""``node check``: its plan, its question, the results in JSON and in words, and the error that it ends with."""

from __future__ import annotations

import inspect
import io
from typing import Any

import click
import pytest
from rich.console import Console

from teds_provision import check as check_room
from teds_provision.check import commands
from teds_provision.check.agreement_rules import ExplainedRequest
from teds_provision.check.rule import RuleResult
from teds_provision.check.run import CheckReport
from teds_provision.errors import LinkError, TedsProvisionError

UUID = bytes(range(10))
PASSED = RuleResult("identify", "profile.md, Identify", "passed", "factory [bold]", None)
FAILED = RuleResult("prove", "profile.md, Prove", "failed", "63 octets", "sign-not-hashed")
ALSO = RuleResult("open", "profile.md, Sessions", "failed", "silent", None)
SKIPPED = RuleResult("can-busy", "profile.md, CAN", "skipped", "no CAN", None)
SILENT = LinkError("The node fell silent in the rule open.", hint="Tap it again.")


class _App:
    """What ``check`` uses of a run of the program; keeps what it was given."""

    def __init__(self) -> None:
        self.given: list[Any] = []
        self.question = ""

    def station(self) -> str:
        return "station"

    def emit(self, result: dict[str, Any], human: str) -> None:
        self.given = [result, human]

    def confirm(self, question: str, *, yes: bool) -> None:
        self.question = f"{question} {yes}"

    def conclude(self, result: dict[str, Any], human: Any, error: TedsProvisionError | None) -> None:
        self.given = [result, human, error]


def _run(monkeypatch: pytest.MonkeyPatch, report: CheckReport | None, **more: Any) -> tuple[_App, dict[str, Any]]:
    app, asked = _App(), dict[str, Any]()

    def check_at(station: Any, links: Any, reporter: Any, **options: Any) -> CheckReport:
        asked.update(options, station=station, links=links)
        assert report is not None
        return report

    monkeypatch.setattr(check_room.run, "check_at", check_at)
    monkeypatch.setattr(commands, "reporter_for", lambda _app: None)
    options = {"factory": False, "explain": False, "yes": False, "dry_run": False, "links": "links"} | more
    inspect.unwrap(commands.check.callback)(app, **options)  # type: ignore[arg-type]
    return app, asked


@pytest.mark.parametrize(
    ("checks", "lost", "code", "message", "hint"),
    [
        ((PASSED, SKIPPED), None, 0, "", ""),
        ((PASSED, FAILED), None, 4, "The node breaks a rule: prove.", ""),
        ((FAILED, PASSED, ALSO), None, 4, "The node breaks 2 rules: prove, open.", ""),
        ((PASSED,), SILENT, 5, "The node fell silent in the rule open.", "Tap it again."),
        (
            (FAILED,), SILENT, 4, "The node breaks a rule: prove.",
            "The node fell silent in the rule open. The remaining rules were not tried.",
        ),
    ],
)  # fmt: skip
def test_a_broken_rule_ends_with_4_and_a_silent_node_with_5(
    monkeypatch: pytest.MonkeyPatch, checks: tuple[RuleResult, ...], lost: LinkError | None, code: int, message: str,
    hint: str,
) -> None:  # fmt: skip
    app, asked = _run(monkeypatch, CheckReport(UUID, checks, lost), factory=True, yes=True)
    assert asked == {"station": "station", "links": "links", "factory": True, "explained": False}
    result, _, error = app.given
    ended = (0, "", "") if error is None else (error.exit_code, error.message, error.hint)
    assert ended == (code, message, hint)
    assert {key: result[key] for key in ("uuid", "passed", "failed", "skipped")} == {
        "uuid": "00010203040506070809",
        "passed": sum(check.result == "passed" for check in checks),
        "failed": sum(check.result == "failed" for check in checks),
        "skipped": sum(check.result == "skipped" for check in checks),
    }
    assert "explain" not in result
    members = ("rule", "clause", "result", "detail", "slip")
    assert result["checks"] == [{name: getattr(check, name) for name in members} for check in checks]


def test_only_factory_asks_before_it_keys_and_a_dry_run_asks_and_does_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    app, _ = _run(monkeypatch, CheckReport(UUID, (PASSED,)))
    assert app.question == ""
    app, asked = _run(monkeypatch, CheckReport(UUID, (PASSED,)), factory=True, explain=True)
    assert app.question == (
        "Key, write and reset the node found, and claim an actuator that it has? If the node is one of yours, it loses"
        " its key and datasheet. False"
    )
    assert (asked["factory"], asked["explained"]) == (True, True)
    for factory, plan in (
        (True, "key, write and reset the node, claim an actuator, every rule"),
        (False, "the rules that change no key"),
    ):
        app, asked = _run(monkeypatch, None, factory=factory, dry_run=True)
        assert (app.given, app.question, asked) == ([{"plan": plan}, f"Plan: {plan}."], "", {})


REPLY = bytes(range(16)) + b"\0\0\0\5" + b"\4" + b"e" * 64 + b"t" * 16 + b"s" * 64
EXPLAINED = ExplainedRequest(b"rq", REPLY, b"teds", b"T" * 32, bytes(range(48)), b"d" * 16, b"S" * 16, "", None)
IN_HEX = {
    "request": "7271", "security_teds": "74656473", "nonce": "000102030405060708090a0b0c0d0e0f", "epoch": "00000005",
    "en": "04" + "65" * 64, "t": "54" * 32, "okm": bytes(range(48)).hex(), "m": bytes(range(16, 48)).hex(),
    "tag_n": "64" * 16, "tag_n_received": "74" * 16, "sig_n_received": "73" * 64, "tag_s": "53" * 16,
    "problem": None, "slip": None,
}  # fmt: skip


def test_a_test_agreement_is_shown_in_hex_and_its_absence_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = ExplainedRequest(
        b"rq", REPLY, b"teds", b"T" * 32, bytes(range(48)), b"d" * 16, b"S" * 16, "tagN is wrong.", "m-is-k"
    )
    for explained, due in (
        (EXPLAINED, IN_HEX),
        (wrong, {**IN_HEX, "problem": "tagN is wrong.", "slip": "m-is-k"}),
        ("Needs NFC.", {"problem": "Needs NFC."}),
    ):
        app, _ = _run(monkeypatch, CheckReport(UUID, (PASSED,), None, explained))
        assert app.given[0]["explain"] == due


@pytest.mark.parametrize(
    ("explained", "lines"),
    [
        (None, []),
        ("Needs [NFC].", ["Needs [NFC]."]),
        (
            EXPLAINED,
            [
                "Request, payload   7271", "Security TEDS      74656473",
                "nonceN             000102030405060708090a0b0c0d0e0f", "epoch              00000005",
                "En                 04" + "65" * 64, "T                  " + "54" * 32,
                "OKM (48 octets)    " + bytes(range(48)).hex(), "M                  " + bytes(range(16, 48)).hex(),
                "tagN, expected     " + "64" * 16, "tagN, received     " + "74" * 16,
                "sigN, received     " + "73" * 64, "tagS               " + "53" * 16,
            ],
        ),
    ],
)  # fmt: skip
def test_the_table_names_every_rule_and_what_was_seen(explained: Any, lines: list[str]) -> None:
    seen = io.StringIO()
    console: Any = Console(file=seen, soft_wrap=True, width=200)
    commands._table(console, CheckReport(UUID, (PASSED, FAILED, SKIPPED), None, explained))
    rows = seen.getvalue().splitlines()
    assert [row.split()[:2] for row in rows[:4]] == [
        ["rule", "result"], ["identify", "passed"], ["prove", "failed"], ["can-busy", "skipped"],
    ]  # fmt: skip
    assert rows[1].endswith("profile.md, Identify  factory [bold]")
    assert rows[4] == "00010203040506070809: 1 passed, 1 failed, 1 skipped"
    if explained is not None:
        assert rows[5] == (
            "A test agreement, never confirmed and ended on the node; none of these values is a key in use:"
        )
    assert rows[6:] == lines


def test_on_a_narrow_terminal_no_value_is_broken_into_lines() -> None:
    """They are copied into a firmware's log, digit by digit."""
    seen = io.StringIO()
    console: Any = Console(file=seen, force_terminal=True, no_color=True, width=50)
    commands._table(console, CheckReport(UUID, (PASSED,), None, EXPLAINED))
    assert f"En                 04{'65' * 64}\n" in seen.getvalue()
    commands._table(
        console, CheckReport(UUID, (PASSED,), None, "No agreement was made, and this says at length why not.")
    )
    assert "No agreement was made, and this says at length why not.\n" in seen.getvalue()


def test_the_command_hangs_on_the_group_node() -> None:
    added: list[Any] = []
    group = click.Group("node")
    group.add_command = added.append  # type: ignore[assignment,method-assign]
    commands.extend(group)
    assert added == [commands.check]
    assert commands.check.name == "check"
