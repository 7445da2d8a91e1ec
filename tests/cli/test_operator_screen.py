"""What an operator at a batch sees: one screen of 24 lines, drawn anew when a board is begun and when it ends."""

from __future__ import annotations

import io
from dataclasses import dataclass

import pytest
from rich.console import Console

from teds_provision.cli.node.provision import BoardReporter, OperatorScreen
from teds_provision.errors import NodeSilentError, TedsProvisionError
from teds_provision.provisioning.batch_sheet import BoardResult, DeclinedError, SheetRow
from teds_provision.provisioning.build import BuildOrder, PreparedOrder
from teds_provision.provisioning.progress import SilentReporter

UUID = bytes.fromhex("8d4d9da65281f7000000")
LONG = "the left knee of the third robot in hall B, at the very end of the row, behind the crane, and then to the right"


DONE = "ALL BOARDS ARE DONE."


@dataclass
class Batch:
    """Fifty boards; the next one is named by its order, its UUID or its key."""

    passed: int = 0
    next_row: SheetRow | None = None
    had: str | None = None
    of_a_job: bool = False

    def board_of(self, row: SheetRow) -> str | None:
        return self.had

    def __len__(self) -> int:
        return 50

    def row(self, number: int) -> SheetRow:
        return row(number)


def row(number: int, *, name: str = LONG, uuid: bytes | None = None, fingerprint: str | None = None) -> SheetRow:
    return SheetRow(number, number + 1, uuid, fingerprint, PreparedOrder(BuildOrder(name=name)), "")


class Terminal:
    """A screen of 80 by 24 characters, and the text of its last drawing."""

    def __init__(self, batch: Batch) -> None:
        self.out = io.StringIO()
        console = Console(
            file=self.out,
            force_terminal=True,
            force_interactive=False,
            width=80,
            height=24,
            color_system=None,
            _environ={"TERM": "xterm"},
        )
        self.screen = OperatorScreen(console, batch)

    @property
    def lines(self) -> list[str]:
        return [line.rstrip() for line in self.out.getvalue().rpartition("\x1b[H")[2].splitlines()]


def failed(number: int, error: TedsProvisionError) -> BoardResult:
    return BoardResult(UUID, 12.3, error=error, row=number, time="2026-11-22T12:34:56Z")


@pytest.mark.parametrize(
    ("next_row", "message"),
    [
        (row(7, name="knee"), ">>> TAP THE BOARD FOR ROW 7  knee"),
        (row(7, name="", uuid=UUID), f">>> TAP ANY BOARD OF THE SHEET, e.g. {UUID.hex()}"),
        (row(7, name="", fingerprint="ab" * 16), ">>> TAP ANY BOARD OF THE SHEET, e.g. key abababababababab"),
        (None, ">>> ALL BOARDS ARE DONE."),
    ],
    ids=["order", "uuid", "label", "done"],
)
def test_it_says_what_to_do_now(next_row: SheetRow | None, message: str) -> None:
    assert message in Terminal(Batch(next_row=next_row)).lines


@pytest.mark.parametrize(
    ("of_a_job", "passed", "words"), [(True, 49, "TAP THE NEXT BOARD"), (True, 50, DONE), (False, 49, DONE)]
)
def test_a_job_goes_on_until_as_many_boards_passed_as_it_has(of_a_job: bool, passed: int, words: str) -> None:
    lines = Terminal(Batch(passed=passed, of_a_job=of_a_job)).lines
    assert f">>> {words}" in lines


def test_a_board_that_did_not_pass_is_asked_for_by_its_uuid() -> None:
    """Another one that is held there gets the next free row, whatever the operator took it for."""
    prompt = f">>> TAP BOARD {UUID.hex()} AGAIN FOR ROW 7  knee"
    assert prompt in Terminal(Batch(next_row=row(7, name="knee"), had=UUID.hex())).lines


def test_while_a_board_is_worked_on_nothing_says_pass_of_the_one_before() -> None:
    """Else an operator takes the board away: the large letters were those of the last one."""
    terminal = Terminal(Batch(next_row=row(1)))
    reporter = BoardReporter(SilentReporter())
    reporter.begun = terminal.screen.begun
    terminal.screen.ended(failed(1, NodeSilentError("It is silent.")))
    ended = terminal.lines
    assert any(line.startswith(">>> TAKE IT OFF. TAP THE BOARD FOR ROW 1") for line in ended)
    reporter.started("identify")
    assert ">>> KEEP THE BOARD ON THE READER" in terminal.lines
    assert terminal.lines[:5] != ended[:5]
    seen = len(terminal.out.getvalue())
    reporter.started("agree")
    assert len(terminal.out.getvalue()) == seen  # once for each board


def test_the_worst_board_of_many_fits_on_24_lines_with_its_cause_and_cure() -> None:
    terminal = Terminal(Batch(passed=48, next_row=row(1)))
    error = NodeSilentError("The node no longer answers. " * 9, hint="Put it back, and hold it flat.")
    for number in range(1, 8):
        terminal.screen.ended(failed(number, error))
    lines = terminal.lines
    assert len(lines) <= 22  # below them stand a notice and the line of what is waited for
    assert max(map(len, lines)) <= 80
    assert sum("FAILED" in line for line in lines) == 5
    assert all(UUID.hex() in line for line in lines if "FAILED" in line)
    assert terminal.out.getvalue().count("\a") == 7


def test_cause_and_cure_of_a_failure_are_both_told() -> None:
    terminal = Terminal(Batch(next_row=row(1)))
    terminal.screen.ended(failed(3, NodeSilentError("The node is silent.", hint="Put it back.")))
    assert "The node is silent. → Put it back." in terminal.lines
    terminal.screen.ended(failed(3, DeclinedError("You said no.")))
    assert any("SKIPPED" in line for line in terminal.lines)


def test_what_runs_below_the_screen_is_removed_before_each_drawing() -> None:
    course: list[str] = []

    class Out(io.StringIO):
        def write(self, text: str) -> int:
            course.extend([] if course[-1:] == ["drawn"] else ["drawn"])
            return len(text)

    console = Console(file=Out(), force_terminal=True, width=80, height=24, color_system=None)
    screen = OperatorScreen(console, Batch(next_row=row(1)), lambda: course.append("removed"))
    screen.begun()
    assert course == ["removed", "drawn", "removed", "drawn"]
    screen.close()
