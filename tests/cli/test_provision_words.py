"""``provision`` and ``verify UUID``: what they print for one board, for many and of a plan, and their exit codes."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision import firmware_image, provisioning
from teds_provision.cli.context import App
from teds_provision.cli.node import verify
from teds_provision.cli.rendering import firmware_words
from teds_provision.errors import (
    NodeSilentError,
    NotAuthenticError,
    NotWhitelistedError,
    TedsProvisionError,
    UnprovenError,
)
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.adoption import FactoryDatasheet, NotAdoptedError
from teds_provision.provisioning.batch import ProvisionPlan, ProvisionRequest
from teds_provision.provisioning.batch_sheet import BatchTotals, BoardResult, DeclinedError
from teds_provision.provisioning.build import UnrequestedChangeError
from teds_provision.provisioning.identify import IdentifiedNode
from teds_provision.provisioning.image_file import VerifyReport
from teds_provision.provisioning.progress import NOTHING, StepResult
from teds_provision.provisioning.provision import ProvisionResult
from teds_provision.provisioning.update import BoardUpdate, UpdatePlan
from teds_provision.shapes.verdict import Check, Verification
from teds_provision.station.firmware import FirmwareReading, KnownFirmware
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile

from .shell import Outcome, call
from .test_datasheet_words import NFC

UUID, OTHER, THIRD = bytes(range(10)), bytes(range(10, 20)), bytes(range(20, 30))
NODE = UUID.hex()
POINT = b"\x04" + bytes(64)
WHO = IdentifiedNode(UUID, POINT, bytes(64), NodeState.PROVISIONED, None, 0x21, b"", None)
IMAGE = Image(UUID, load_profile("gripper").build(UUID, name="hand").blocks)
GOOD = Verification(UUID, (Check("signed", "passed"), Check("session", "passed", "epoch 1")))
FORGED = Verification(UUID, (Check("signature", "failed", "the signature does not verify"),))
FORCE = {"channel": 3, "name": "grip force", "value": 2.5, "unit": "N", "valid": True,
         "shown": {"value": 2.5, "unit": "N"}}  # fmt: skip
DONE = ProvisionResult(
    WHO,
    (StepResult("identify", seconds=0.25, detail="x"), StepResult("agree", NOTHING, 0.0)),
    IMAGE,
    GOOD,
    ("The battery is low.",),
    (FORCE,),
)
AT = "2026-11-22T10:00:00Z"


def board(
    uuid: bytes = UUID, *, error: TedsProvisionError | None = None, row: int | None = None, **more: Any
) -> BoardResult:
    done = None if error is not None else replace(DONE, who=replace(WHO, uuid=uuid))
    return BoardResult(uuid, 1.23456, more.get("done", done), error, row, "nfc:usb", AT)


class Run:
    """Stands for the work on boards: what ended, and how."""

    def __init__(self, boards: list[BoardResult] | None = None, **more: Any) -> None:
        self.boards, self.request = boards or [], ProvisionRequest()
        self.warnings: tuple[str, ...] = ()
        self.line, self.of_a_job, self.expected, self.ended, self.unlocked = None, False, 0, 0, False
        self.stop = SimpleNamespace(request_stop=lambda: None)
        self.board_warnings: dict[str, list[bytes]] = {}
        self.planned: list[Any] = []
        self.worst: TedsProvisionError | None = None
        self.sum = BatchTotals(1, 0, 0, 3.5, 1.0, {"identify": 0.25})
        self.failure: TedsProvisionError | None = None
        vars(self).update(more)

    def __len__(self) -> int:
        return 0

    def unlock(self) -> None:
        self.unlocked = True

    def one(self, _operator: Any) -> ProvisionResult:
        if self.failure is not None:
            raise self.failure
        done = self.boards[0].done
        assert done is not None
        return done

    def many(self, operator: Any) -> Iterator[BoardResult]:
        self.operator = operator
        for number, one in enumerate(self.boards, 1):
            self.ended = number
            yield one

    def plan(self) -> Any:
        return self.planned[0]

    def plans(self) -> Iterator[Any]:
        for one in self.planned:
            self.ended += not isinstance(one, ProvisionPlan)
            yield one

    def totals(self) -> BatchTotals:
        return self.sum


@pytest.fixture
def running(home: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Outcome, Run]]:
    def run(boards: Run, *words: object, as_json: bool = False) -> tuple[Outcome, Run]:
        def begin(_station: Any, links: Any, request: ProvisionRequest, _reporter: Any, *, line: Any) -> Run:
            assert line is None
            boards.request, boards.links = request, links  # type: ignore[attr-defined]
            return boards

        monkeypatch.setattr(provisioning.batch, "BatchRun", begin)
        return call(home, *(["--json"] if as_json else []), "provision", *words, *NFC), boards

    return run


def lines_of(outcome: Outcome) -> list[Any]:
    return [json.loads(line) for line in outcome.out.splitlines()]


MEMBERS = {
    "uuid": NODE,
    "fingerprint": WHO.fingerprint,
    "name": "hand",
    "channels": [
        {"number": 1, "name": "opening set point", "unit": "m", "range": "0 m to 0.11 m", "calibrated": False},
        {"number": 2, "name": "opening", "unit": "m", "range": "0 m to 0.11 m", "calibrated": False},
        {"number": 3, "name": "grip force", "unit": "N", "range": "0 N to 140 N", "calibrated": False},
    ],
    "steps": [
        {"name": "identify", "result": "done", "seconds": 0.25},
        {"name": "agree", "result": "nothing to do", "seconds": 0.0},
    ],
    "sample": [{"channel": 3, "value": 2.5, "unit": "N", "valid": True, "shown": {"value": 2.5, "unit": "N"}}],
    "verdict": "authentic",
    "warnings": ["The battery is low."],
    "firmware": None,
}


def test_one_board_is_reported_whole(running: Any) -> None:
    words = ("8d4d", "--profile", "gripper", "--name", "hand", "--calibration", "2=cell.csv", "--retype", "--yes")
    outcome, run = running(Run([board()]), *words, as_json=True)
    assert (outcome.code, outcome.err) == (0, "Warning: The battery is low.\n")
    assert outcome.json == MEMBERS
    order, request = run.request.order, run.request
    assert (order.profile, order.name, order.calibration, order.channel) == ("gripper", "hand", Path("cell.csv"), 2)
    assert (order.retype, order.drop_calibration, order.adopt) == (True, False, False)
    assert (request.node, request.watch, request.whole_bus, request.sheet) == ("8d4d", False, False, None)
    people, _ = running(Run([board()]))
    assert people.out.splitlines() == [
        "node       hand",
        f"UUID       {NODE}",
        f"key        {WHO.fingerprint[:16]}",
        "channel 1  opening set point  0 m to 0.11 m",
        "channel 2  opening  0 m to 0.11 m",
        "channel 3  grip force  0 N to 140 N, reads 2.5 N",
        "verdict    authentic",
    ]


def test_a_board_that_is_not_authentic_is_reported_with_its_error(running: Any) -> None:
    bad = board(done=replace(DONE, verified=FORGED))
    outcome, _ = running(Run([bad]), as_json=True)
    found = outcome.json
    assert outcome.code == 4
    assert (found["verdict"], found["uuid"]) == ("not authentic", NODE)
    assert found["error"]["code"] == "not-authentic"
    assert "the signature does not verify" in found["error"]["message"]


def test_changes_that_nobody_named_are_listed_with_the_refusal(running: Any) -> None:
    change: Any = SimpleNamespace(text="Channel 1: the range becomes 0 to 80 mm.")
    refusal = UnrequestedChangeError("It would change.", (change,), hint="Name it.")
    outcome, _ = running(Run(failure=refusal), as_json=True)
    assert (outcome.code, outcome.json) == (
        6,
        {"changes": [change.text], "error": {"code": "not-named", "message": "It would change.", "hint": "Name it."}},
    )
    people, _ = running(Run(failure=refusal))
    assert (people.code, people.out) == (6, f"  {change.text}\n")


SILENT = NodeSilentError("It is silent.", hint="Put it back.")


@pytest.mark.parametrize(
    ("words", "request_of", "totals"),
    [
        (["--watch"], (True, False, False), False),
        (["--batch", "boards.csv"], (False, False, True), True),
        (["--batch", "boards.csv", "--watch"], (True, False, True), True),
        (["--all"], (False, True, False), True),
    ],
)
def test_of_many_boards_each_has_a_line_and_the_sum_is_the_last(
    running: Any, words: list[str], request_of: tuple[bool, bool, bool], totals: bool
) -> None:
    boards = [board(row=1), board(OTHER, error=SILENT, row=2), board(THIRD, error=DeclinedError("No."))]
    failed = replace(BatchTotals(1, 1, 1, 3.5, 0.5, {"identify": 0.25}), worst=SILENT)
    outcome, run = running(Run(boards, sum=failed), *words, "--yes", as_json=True)
    request = run.request
    assert (request.watch, request.whole_bus, request.sheet is not None) == request_of
    assert run.unlocked
    first, second, third, *last = lines_of(outcome)
    assert first == MEMBERS | {"row": 1, "time": AT, "seconds": 1.235}
    assert second == {
        "uuid": OTHER.hex(),
        "time": AT,
        "row": 2,
        "seconds": 1.235,
        "error": {"code": "node-silent", "message": "It is silent.", "hint": "Put it back."},
    }
    assert ("row" in third, third["error"]["code"]) == (False, "declined")
    if not totals:
        assert (last, outcome.code) == ([], 0)
        return
    hint = "Run the same command again to continue with the rest."
    assert (outcome.code, last) == (
        5,
        [
            {
                "totals": {
                    "passed": 1, "failed": 1, "skipped": 1, "seconds": 3.5, "first_pass": 0.5,
                    "steps": {"identify": 0.25},
                },
                "error": {"code": "node-silent", "message": "1 passed, 1 failed, 1 skipped.", "hint": hint},
            }
        ],
    )  # fmt: skip


def test_each_result_and_error_of_many_boards_shows_its_time_to_people(
    running: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """docs/batch.md: a result had none, and an error had that of Greenwich."""
    monkeypatch.setenv("TZ", "Asia/Kolkata")
    time.tzset()
    try:
        boards = [board(), board(OTHER, error=SILENT, row=2), board(THIRD, done=replace(DONE, verified=FORGED))]
        boards = [replace(each, time="2026-11-28T01:02:03Z") for each in boards]
        outcome, _ = running(Run(boards), "--watch", "--yes")
        (one, _) = running(Run(boards[:1]))
    finally:
        monkeypatch.undo()
        time.tzset()
    at = "2026-11-28 06:32:03+05:30"
    assert [line for line in outcome.out.splitlines() if line.startswith("time")] == [f"time       {at}"] * 2
    assert f"Error ({OTHER.hex()}, {at}, row 2): It is silent.\n  → Put it back.\n" in outcome.err
    assert f"Error ({THIRD.hex()}, {at}): " in outcome.err
    assert "time  " not in one.out, "one board is here now"


def test_the_sum_of_a_batch_for_people(running: Any) -> None:
    outcome, _ = running(Run([board(row=1)]), "--batch", "boards.csv", "--yes")
    assert outcome.code == 0
    assert outcome.out.splitlines()[-2:] == [
        "1 passed, 0 failed, 0 skipped, 100.0% at the first attempt, 3.5 s in total.",
        "  identify      0.25 s",
    ]
    none = BatchTotals(0, 0, 0, 0.0, None, {})
    people, _ = running(Run(sum=none), "--batch", "boards.csv", "--yes")
    assert people.out == "0 passed, 0 failed, 0 skipped, 0.0 s in total.\n"
    never = BatchTotals(3, 0, 0, 9.0, 0.0, {})
    people, _ = running(Run(sum=never), "--batch", "boards.csv", "--yes")
    assert people.out == "3 passed, 0 failed, 0 skipped, 0.0% at the first attempt, 9.0 s in total.\n"


def test_boards_of_a_bus_have_a_line_each_and_warnings_are_printed_once(running: Any) -> None:
    boards = [board(), board(OTHER, error=SILENT)]
    warnings = {"The battery is low.": [UUID, OTHER], "The calibration is old.": [UUID]}
    failed = replace(BatchTotals(1, 1, 0, 3.5, 0.5, {}), worst=SILENT)
    run = Run(boards, expected=200, sum=failed, board_warnings=warnings)
    outcome, _ = running(run, "--all", "--yes")
    assert outcome.code == 5
    assert outcome.out.splitlines() == [
        f"  1 of 200  {NODE}  hand  authentic  1.2 s",
        f"  2 of 200  {OTHER.hex()}  (no name)  failed  1.2 s",
        "1 passed, 1 failed, 0 skipped, 50.0% at the first attempt, 3.5 s in total.",
    ]
    assert f"{OTHER.hex()}: It is silent.\n  → Put it back.\n" in outcome.err
    assert outcome.err.count("Warning: All 2 boards: The battery is low.") == 1
    assert outcome.err.count("The calibration is old.") == 1


def test_yes_adds_no_strangers_of_a_bus(running: Any) -> None:
    who: Any = SimpleNamespace(uuid=UUID, fingerprint="ab" * 32)
    _, run = running(Run([]), "--all", "--yes")
    with pytest.raises(NotWhitelistedError):
        run.operator.accept(who)
    _, run = running(Run([]), "--watch", "--yes")
    run.operator.accept(who)


PLAN = ProvisionPlan(
    UUID, NodeState.FACTORY, ("identify", "whitelist", "agree"), ("The name becomes hand.",), ("A warning.",)
)


def test_a_plan_has_its_steps_changes_and_warnings(running: Any) -> None:
    outcome, run = running(Run(planned=[PLAN]), "--dry-run", as_json=True)
    assert (outcome.code, run.unlocked, outcome.json) == (
        0,
        False,
        {
            "uuid": NODE,
            "state": "factory",
            "plan": ["identify", "whitelist", "agree"],
            "changes": ["The name becomes hand."],
            "warnings": ["A warning."],
        },
    )
    people, _ = running(Run(planned=[replace(PLAN, changes=())]), "--dry-run")
    assert people.out == f"Plan for {NODE} (factory): identify, whitelist, agree.\n  no changes\n"
    assert people.err == "Warning: A warning.\n"


def test_the_plans_for_a_bus_are_counted_and_the_worst_refusal_ends_them(running: Any) -> None:
    refused = board(OTHER, error=NotAuthenticError("Forged."))
    plans = [PLAN, refused]
    outcome, _ = running(Run(planned=plans, worst=refused.error), "--all", "--dry-run", as_json=True)
    one, two, totals = lines_of(outcome)
    assert (outcome.code, one["uuid"], two["error"]["message"]) == (4, NODE, "Forged.")
    assert totals == {"totals": {"planned": 1, "failed": 1}}
    for planned, words in (([PLAN], "1 node"), ([PLAN, PLAN], "2 nodes"), ([], "No nodes")):
        people, _ = running(Run(planned=planned), "--all", "--dry-run")
        assert people.out.splitlines()[-1] == f"{words} would be provisioned."


@pytest.mark.parametrize(
    "words",
    [
        ["--adopt", "--batch", "boards.csv"],
        ["--operator", "Ann"],
        ["--firmware-key", "owner.pem"],
        ["--firmware", "a.bin", "--dry-run"],
        ["--firmware", "a.bin", "--watch"],
        ["--firmware", "a.bin", "--all"],
        ["--item", "as-left"],
        ["--due", "2027-10-31"],
    ],
)
def test_options_of_provision_that_do_not_go_together(running: Any, words: list[str]) -> None:
    outcome, run = running(Run([board()]), *words, as_json=True)
    assert (outcome.code, run.unlocked) == (2, False)


@pytest.mark.parametrize("words", [["--firmware-key", "o.pem"], ["--firmware", "a.bin", "--dry-run"]])
def test_firmware_is_for_one_board_and_the_refusal_says_how_many_get_it(running: Any, words: list[str]) -> None:
    outcome, _ = running(Run([board()]), *words, as_json=True)
    assert outcome.json["error"] == {
        "code": "usage",
        "message": "--firmware installs an image on one board; --firmware-key goes with it.",
        "hint": "Many boards: whitelist add, agree, update --match EXPR IMAGE, provision. Plan: update --dry-run.",
    }


@pytest.mark.parametrize(
    ("words", "message", "hint"),
    [
        (["--adopt", "--batch", "b.csv"], "The sheet or job already defines what each board gets.", "Drop --adopt."),
        (
            ["--operator", "Ann"],
            "--calibrations, --operator, --files, --only, --label-to and --scan require a job.",
            "Add --job FILE, or --evidence.",
        ),
    ],
)
def test_an_option_that_goes_with_no_other_is_refused_in_words(
    running: Any, words: list[str], message: str, hint: str
) -> None:
    outcome, _ = running(Run([board()]), *words, as_json=True)
    assert (outcome.code, outcome.json) == (2, {"error": {"code": "usage", "message": message, "hint": hint}})


WRONG = "The image is for finger/r1, the board is of no known type."


@pytest.mark.parametrize(
    ("question", "answers", "stage", "words", "ended", "code", "course"),
    [
        ("", [], "upload", ["--yes"], None, 0, [False]),
        ("", [True], "upload", [], None, 0, ["Install 1.4.0 on board {}?", False]),
        ("", [False], "upload", [], None, 6, ["Install 1.4.0 on board {}?"]),
        ("", None, "upload", [], None, 6, []),
        ("", None, "nothing", [], None, 0, []),
        (WRONG, None, "upload", ["--yes"], None, 6, []),
        (WRONG, [False], "upload", ["--yes"], None, 6, [WRONG + " Install it all the same?"]),
        (WRONG, [True], "upload", ["--yes"], None, 0, [WRONG + " Install it all the same?", True]),
        ("", [], "upload", ["--yes"], NodeSilentError("It is silent."), 5, [False]),
    ],
)
def test_a_board_gets_its_firmware_first_if_a_person_agrees(
    running: Any,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    question: str,
    answers: list[bool] | None,
    stage: Any,
    words: list[str],
    ended: TedsProvisionError | None,
    code: int,
    course: list[Any],
) -> None:
    image: Any = SimpleNamespace(version_text="1.4.0")
    plan, done, left = UpdatePlan(UUID, Any, stage, 7, 1.0, (), question), list[Any](), list(answers or [])

    def ask(_app: App, asked: str) -> bool:
        done.append(asked)
        return left.pop(0)

    def update_boards(_station: Any, links: Any, orders: Any, reporter_of: Any) -> Iterator[BoardUpdate]:
        [(uuid, order)] = orders
        assert (uuid, order.image, links.via_chosen, reporter_of(uuid) is not None) == (UUID, image, True, True)
        done.append(order.other_board)
        yield BoardUpdate(UUID, "lost" if ended else "updated", "1.3.0", 7, 1.0, ended)

    monkeypatch.setattr(App, "interactive", property(lambda _app: answers is not None))
    monkeypatch.setattr(App, "ask_yes_no", ask)
    monkeypatch.setattr(firmware_image, "load_firmware_image", lambda *_: image)
    monkeypatch.setattr(provisioning.provision, "key_board_at", lambda *_, **__: UUID)
    monkeypatch.setattr(provisioning.update, "plan_update", lambda *_: plan)
    monkeypatch.setattr(provisioning.update, "update_boards", update_boards)
    outcome, run = running(Run([board()]), "--firmware", tmp_path / "a.bin", *words)
    assert (outcome.code, done) == (code, [one.format(NODE) if isinstance(one, str) else one for one in course])
    assert run.request.node == (NODE if code == 0 else None), "then that board is provisioned, whichever was meant"
    if question and code:
        assert f"Error: {question}\n  → update {NODE} IMAGE --other-board, then provision.\n" in outcome.err


def test_a_datasheet_that_was_not_adopted_is_shown_with_its_findings(running: Any) -> None:
    brought = FactoryDatasheet(IMAGE, "finger", (), ("It is overdue.",), ("It is old.",))
    refusal = NotAdoptedError("It is not approved.", brought, hint="Check it.")
    outcome, _ = running(Run(failure=refusal), "--adopt", as_json=True)
    assert (outcome.code, outcome.json, outcome.err) == (
        6,
        {
            "findings": [
                {"severity": "error", "message": "It is overdue."},
                {"severity": "warning", "message": "It is old."},
            ],
            "error": {"code": "not-adopted", "message": "It is not approved.", "hint": "Check it."},
        },
        "",
    )
    people, _ = running(Run(failure=refusal), "--adopt")
    assert (people.code, people.out) == (6, "")
    assert people.err.splitlines() == [
        f"Node {NODE} brought its own datasheet: finger",
        "  error: It is overdue.",
        "  warning: It is old.",
        "Error: It is not approved.",
        "  → Check it.",
    ]


def test_of_many_boards_the_changes_that_nobody_named_are_listed_with_the_refusal(running: Any) -> None:
    change: Any = SimpleNamespace(text="Channel 1: the range becomes 0 to 80 mm.")
    refusal = UnrequestedChangeError("It would change.", (change,), hint="Name it.")
    outcome, _ = running(Run([board(error=refusal)]), "--watch", as_json=True)
    [line] = lines_of(outcome)
    assert (line["changes"], line["error"]["code"]) == ([change.text], "not-named")
    people, _ = running(Run([board(error=refusal)]), "--watch")
    assert change.text not in people.out


# -- verify UUID -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("verified", "error", "code"),
    [
        (GOOD, None, 0),
        (FORGED, NotAuthenticError("It is forged."), 4),
        (Verification(UUID, (Check("session", "failed", "no session"),)), UnprovenError("Nothing is proven."), 5),
    ],
)
def test_what_verify_prints_of_a_node(
    home: Path, monkeypatch: pytest.MonkeyPatch, verified: Verification, error: TedsProvisionError | None, code: int
) -> None:
    given: list[Any] = []

    def verify(*words: Any, **more: Any) -> VerifyReport:
        given.append((words[2], more))
        return VerifyReport(verified, ("A warning.",), error)

    monkeypatch.setattr(provisioning.verify_node, "verify_at", verify)
    people = call(home, "verify", NODE, "--accept-firmware", *NFC)
    assert people.code == code
    width = max(len(check.name) for check in (*verified.checks, Check("check", "passed")))
    assert people.out.splitlines() == [
        f"{'check':<{width}}  result  found",
        *(f"{check.name:<{width}}  {check.result}  {check.why}".rstrip() for check in verified.checks),
        f"{NODE}: {verified.verdict}",
    ]
    assert "Warning: A warning." in people.err
    assert given == [(NODE, {"accept_calibration": None, "accept_firmware": True, "is_node": True})]
    outcome = call(home, "--json", "verify", NODE, "--accept-calibration", "it is so", *NFC)
    found = outcome.json
    assert (outcome.code, found.pop("error", {}).get("message")) == (code, error and error.message)
    assert found == {
        "uuid": NODE,
        "scope": "node",
        "verdict": verified.verdict,
        "checks": [{"name": name, "result": result, "why": why} for name, result, why, _ in verified.checks],
        "warnings": ["A warning."],
        "firmware": None,
    }
    assert given[-1][1] == {"accept_calibration": "it is so", "accept_firmware": False, "is_node": True}


@pytest.mark.parametrize("option", [["--accept-firmware"], ["--accept-calibration", "it is so"]])
def test_what_is_accepted_of_a_node_is_not_accepted_of_many_files(
    home: Path, tmp_path: Path, option: list[str]
) -> None:
    (tmp_path / "folder").mkdir()
    for what in (["a.json", "b.json"], [tmp_path / "folder"]):
        assert call(home, "--json", "verify", *what, *option).code == 2


@pytest.mark.parametrize(
    ("verified", "ends", "colour"), [(GOOD, None, "32"), (FORGED, NotAuthenticError("Forged."), "31")]
)
def test_a_terminal_shows_what_was_checked_as_a_table_in_colours(
    home: Path, monkeypatch: pytest.MonkeyPatch, verified: Verification, ends: TedsProvisionError | None, colour: str
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.delenv("NO_COLOR", raising=False)
    skipped = replace(verified, checks=(*verified.checks, Check("calibration", "skipped", "no [bold]calibration[/]")))
    runs = KnownFirmware(FirmwareReading(None, False), "not-reported")
    report = VerifyReport(skipped, (), ends, runs)
    monkeypatch.setattr(provisioning.verify_node, "verify_at", lambda *_, **__: report)
    shown = call(home, "verify", NODE, *NFC, terminal=True).out
    assert f"\x1b[1;{colour}m{NODE}: {skipped.verdict}\x1b[0m" in shown
    assert "\x1b[2mskipped\x1b[0m" in shown
    assert f"\x1b[{'32mpassed' if colour == '32' else '1;31mfailed'}\x1b[0m" in shown
    plain = re.sub(r"\x1b\[[0-9;]*m", "", shown)
    assert plain.startswith("check ")
    lines = [line.split() for line in plain.splitlines() if line.strip()]
    assert lines == [
        ["check", "result", "found"],
        *([check.name, check.result, *check.why.split()] for check in skipped.checks),
        [f"{NODE}:", *skipped.verdict.split()],
        ["firmware:", *firmware_words(runs.to_json()).split()],
    ]


@pytest.mark.parametrize(
    ("facts", "text"),
    [
        ({"verified": GOOD}, f"authentic      {NODE}  a.json"),
        ({"verified": GOOD, "warnings": ("It is old.", "It is odd.")},
         f"authentic      {NODE}  a.json: It is old.; It is odd."),
        ({"error": {"code": "bad-data", "message": "a\x1b[2J is torn.", "hint": ""}},
         "unreadable     -                     a.json: a\ufffd[2J is torn."),
    ],
)  # fmt: skip
def test_each_file_of_many_is_one_line_with_what_is_odd_about_it(facts: dict[str, Any], text: str) -> None:
    assert verify._line(provisioning.verify_files.FileVerdict("a.json", **facts)) == text


def test_the_verdicts_of_many_files_are_summed_by_name_and_the_worst_ends_the_command(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.json").write_text("{}")
    totals = provisioning.verify_files.VerdictTotals
    parts = [(["one"], totals()), (["two", "three"], totals())]
    parts[0][1].verdicts.update({"unsigned": 1})
    parts[1][1].verdicts.update({"authentic": 2})
    parts[0][1].exit_code = 4
    monkeypatch.setattr(provisioning.verify_files, "verify_files", lambda _station, _files, _line: iter(parts))
    done = call(home, "verify", tmp_path)
    assert done.code == 4
    assert done.out.splitlines()[:3] == ["one", "two", "three"]
    assert done.out.splitlines()[3].endswith(": 2 authentic, 1 unsigned.")


def test_several_names_are_files_whatever_link_is_named_and_an_empty_reason_is_one(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    many: list[Any] = []
    monkeypatch.setattr(verify, "verify_many", lambda _app, what: many.append(what))
    assert call(home, "verify", "a.json", "b.json", *NFC).code == 0
    assert many == [("a.json", "b.json")]
    refused = call(home, "--json", "verify", tmp_path, "--accept-calibration", "")
    assert (refused.code, refused.json["error"]["message"]) == (
        2,
        "--accept-calibration applies to a single image.",
    )
