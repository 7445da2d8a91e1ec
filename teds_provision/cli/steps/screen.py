"""What an operator at a batch sees from two metres: what to do now, PASS or FAIL, n of 50, the last five boards."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from typing import TYPE_CHECKING, Final, Protocol

from teds_provision.cli.context import App
from teds_provision.harmless import harmless
from teds_provision.talk.progress import Reporter, StepResult

if TYPE_CHECKING:
    from rich.console import Console

    from teds_provision.links import Notice
    from teds_provision.steps.many.board import Board
    from teds_provision.steps.many.boards import Boards
    from teds_provision.steps.many.sheet import Row

_BELL: Final = "\a"
_LAST: Final = 5
_ROWS: Final = 5
_WHY_LINES: Final = 3
_ROOMY: Final = 30
"""Lines of a terminal on which the large letters have air above and below."""
_GLYPHS: Final = {
    "A": " ## |#  #|####|#  #|#  #",
    "F": "####|#   |### |#   |#   ",
    "I": "###| # | # | # |###",
    "K": "#  #|# # |##  |# # |#  #",
    "L": "#   |#   |#   |#   |####",
    "P": "### |#  #|### |#   |#   ",
    "S": " ###|#   | ## |   #|### ",
    "T": "#####|  #  |  #  |  #  |  #  ",
    "W": "#   #|#   #|# # #|## ##|#   #",
    "0": " ## |#  #|#  #|#  #| ## ",
    "1": " # |## | # | # |###",
    "2": "### |   #| ## |#   |####",
    "3": "### |   #| ## |   #|### ",
    "4": "#  #|#  #|####|   #|   #",
    "5": "####|#   |### |   #|### ",
    "6": " ## |#   |### |#  #| ## ",
    "7": "####|   #|  # | #  | #  ",
    "8": " ## |#  #| ## |#  #| ## ",
    "9": " ## |#  #| ###|   #| ## ",
    "/": "    #|   # |  #  | #   |#    ",
    " ": "  |  |  |  |  ",
}
_WORDS: Final = {"passed": ("PASS", "black on green"), "failed": ("FAIL", "white on red")}


def big(text: str) -> list[str]:
    """Five lines of letters that are read from afar; characters without a shape are left out."""
    shapes = [_GLYPHS[character].split("|") for character in text.upper() if character in _GLYPHS]
    lines = ["  ".join(shape[row] for shape in shapes) for row in range(_ROWS)]
    return [line.replace("#", "██").replace(" ", "  ") for line in lines]


class Told(Protocol):
    """What the screen needs to know of the batch: :class:`Boards` is one."""

    def __len__(self) -> int:
        """How many boards the sheet has."""

    @property
    def passed(self) -> int:
        """How many of them have passed."""

    @property
    def next_row(self) -> Row | None:
        """The row that the next board may be of."""

    def row(self, number: int) -> Row:
        """The row of that number."""

    def board_of(self, row: Row) -> str | None:
        """UUID of the board that had a row before."""


class Screen(Protocol):
    """Where the end of each board is shown; ``tells``: so that nothing else needs to be printed of it."""

    tells: bool

    def ended(self, board: Board) -> None:
        """Show how it ended."""

    def close(self) -> None:
        """Give the terminal back."""


class _Plain:
    """No screen: a pipe, --json, --quiet, or no sheet. The bell is for people alone."""

    tells = False

    def ended(self, board: Board) -> None:
        """Lines were told already."""

    def close(self) -> None:
        """Nothing to give back."""


class Watched:
    """A reporter that also says when a board is begun: its first step is to identify it."""

    def __init__(self, inner: Reporter) -> None:
        self._inner = inner
        self.begun: Callable[[], None] = lambda: None

    def started(self, step: str) -> None:
        """A step begins."""
        if step == "identify":
            self.begun()
        self._inner.started(step)

    def finished(self, step: StepResult) -> None:
        """A step ended well."""
        self._inner.finished(step)

    def notice(self, notice: Notice) -> None:
        """Something is waited for, or came by."""
        self._inner.notice(notice)

    def written(self, octets: int, total: int) -> None:
        """So many octets of the datasheet are staged."""
        self._inner.written(octets, total)


class OperatorScreen:
    """Drawn anew when a board is begun and when it ends, on stderr; ``live_line`` takes away what runs below it."""

    def __init__(self, console: Console, boards: Told, live_line: Callable[[], None] = lambda: None) -> None:
        self.tells = sys.stdout.isatty()  # a file or a pipe gets its lines all the same
        self._console, self._boards, self._live_line = console, boards, live_line
        self._last: deque[Board] = deque(maxlen=_LAST)
        self._draw(">>> ", self._next())

    def begun(self) -> None:
        """A board lies on the reader: what stood there of the one before counts no more."""
        self._draw(">>> ", "KEEP THE BOARD ON THE READER", word=("WAIT", "black on yellow"))

    def ended(self, board: Board) -> None:
        """Ring, and show PASS or FAIL."""
        self._last.appendleft(board)
        self._console.file.write(_BELL)
        word = _WORDS.get(board.result, ("SKIP", "black on yellow"))
        self._draw(">>> TAKE IT OFF. ", self._next(), word=word, board=board)

    def close(self) -> None:
        """Leave what stands there."""

    def _draw(self, mark: str, now: str, *, word: tuple[str, str] | None = None, board: Board | None = None) -> None:
        from rich.text import Text

        self._live_line()
        console, boards = self._console, self._boards
        air = [""] if console.height >= _ROOMY else []
        console.clear()
        if word is not None:
            for line in [*air, *big(word[0]), *air]:
                console.print(Text(f"    {line}".ljust(console.width)), style=word[1], no_wrap=True)
        if board is not None:
            self._tell_end(board)
        for line in ["", *big(f"{boards.passed}/{len(boards)}"), ""]:
            console.print(Text(f"    {line}"), no_wrap=True)
        self._line(f"{mark}{now}", style="bold")
        for one in self._last:
            row = f"row {one.row}" if one.row is not None else ""
            line = f"{_clock(one.time)}  {row:<8} {one.uuid.hex()}  {one.result.upper():<8} {one.seconds:6.1f} s"
            style = "green" if one.result == "passed" else "red"
            self._line(f"{line}  {self._name(one)}", style=style)

    def _tell_end(self, board: Board) -> None:
        """Seconds and which board; of one that failed why, and what to do, in a few lines."""
        from rich.text import Text

        row = f"  row {board.row}" if board.row is not None else ""
        self._line(f"{board.seconds:.1f} s  {board.uuid.hex()}{row}  {self._name(board)}", style="bold")
        if board.failure is not None:
            hint = f" → {board.failure.hint}" if board.failure.hint else ""
            why = Text(harmless(f"{board.failure.message}{hint}"), style="bold red")
            for line in why.wrap(self._console, self._console.width)[:_WHY_LINES]:
                self._console.print(line)
        elif board.done is not None and board.done.warnings:
            self._line(f"Warning: {board.done.warnings[0]}", style="yellow")

    def _line(self, text: str, *, style: str) -> None:
        """One line, cut with an ellipsis where the terminal ends."""
        from rich.text import Text

        self._console.print(Text(harmless(text).rstrip()), style=style, no_wrap=True, overflow="ellipsis")

    def _name(self, board: Board) -> str:
        return self._boards.row(board.row).prepared.order.name or "" if board.row is not None else ""

    def _next(self) -> str:
        row = self._boards.next_row
        if row is None:
            return "ALL BOARDS ARE DONE."
        name = row.prepared.order.name or ""
        if row.by_order:
            had = self._boards.board_of(row)
            board = "THE BOARD" if had is None else f"BOARD {had} AGAIN"
            return harmless(f"TAP {board} FOR ROW {row.number}  {name}".rstrip())
        which = row.uuid.hex() if row.uuid is not None else f"key {(row.fingerprint or '')[:16]}"
        return harmless(f"TAP ANY BOARD OF THE SHEET, e.g. {which}  {name}".rstrip())


def _clock(moment: str) -> str:
    """The time of day here, of a moment in UTC."""
    return datetime.fromisoformat(moment).astimezone().strftime("%H:%M:%S")


@contextmanager
def screen_for(app: App, boards: Boards, reporter: Watched | None = None) -> Iterator[Screen]:
    """The operator's screen on a terminal with a sheet, else none; ``reporter`` tells it when a board is begun."""
    if app.json or app.quiet or not len(boards) or not sys.stderr.isatty():
        yield _Plain()
        return
    screen = OperatorScreen(app.console(stderr=True), boards, app.live_line)
    if reporter is not None:
        reporter.begun = screen.begun
    yield screen
