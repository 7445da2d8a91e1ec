"""What an operator at a batch sees from two metres: what to do now, PASS or FAIL, n of 50, the last five boards."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Protocol

from teds_provision.cli.context import App
from teds_provision.harmless import harmless

if TYPE_CHECKING:
    from rich.console import Console

    from teds_provision.steps.many.board import Board
    from teds_provision.steps.many.boards import Boards

_BELL: Final = "\a"
_LAST: Final = 5
_ROWS: Final = 5
_GLYPHS: Final = {
    "A": " ## |#  #|####|#  #|#  #",
    "F": "####|#   |### |#   |#   ",
    "I": "###| # | # | # |###",
    "K": "#  #|# # |##  |# # |#  #",
    "L": "#   |#   |#   |#   |####",
    "P": "### |#  #|### |#   |#   ",
    "S": " ###|#   | ## |   #|### ",
    "T": "#####|  #  |  #  |  #  |  #  ",
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


class OperatorScreen:
    """Drawn anew after each board, on stderr."""

    def __init__(self, console: Console, boards: Boards) -> None:
        self.tells = sys.stdout.isatty()  # a file or a pipe gets its lines all the same
        self._console, self._boards = console, boards
        self._last: deque[Board] = deque(maxlen=_LAST)
        self.draw(None)

    def ended(self, board: Board) -> None:
        """Ring, and show PASS or FAIL."""
        self._last.appendleft(board)
        self._console.file.write(_BELL)
        self.draw(board)

    def draw(self, board: Board | None) -> None:
        """Show it all."""
        from rich.text import Text

        console, boards = self._console, self._boards
        console.clear()
        if board is not None:
            word, style = _WORDS.get(board.result, ("SKIP", "black on yellow"))
            for line in ["", *big(word), ""]:
                console.print(Text(f"    {line}".ljust(console.width)), style=style, no_wrap=True)
            console.print(Text(f"{board.seconds:.1f} s  {board.uuid.hex()}"), style="bold")
            if board.failure is not None:
                console.print(Text(harmless(board.failure.message)), style="bold red")
        for line in ["", *big(f"{boards.passed}/{len(boards)}"), ""]:
            console.print(Text(f"    {line}"), no_wrap=True)
        console.print(Text(f">>> {self._what_now()}"), style="bold")
        for one in self._last:
            row = f"row {one.row}" if one.row is not None else ""
            line = f"{one.time}  {row:<8} {one.uuid.hex()}  {one.result.upper():<8} {one.seconds:6.1f} s"
            console.print(Text(line), style="green" if one.result == "passed" else "red", no_wrap=True)

    def _what_now(self) -> str:
        row = self._boards.next_row
        if row is None:
            return "ALL BOARDS ARE DONE."
        name = row.prepared.order.name or ""
        if row.by_order:
            return harmless(f"TAP THE BOARD FOR ROW {row.number}  {name}".rstrip())
        which = row.uuid.hex() if row.uuid is not None else f"key {(row.fingerprint or '')[:16]}"
        return harmless(f"TAP ANY BOARD OF THE SHEET, e.g. {which}  {name}".rstrip())

    def close(self) -> None:
        """Leave what stands there."""


@contextmanager
def screen_for(app: App, boards: Boards) -> Iterator[Screen]:
    """The operator's screen on a terminal with a sheet, else none."""
    if app.json or app.quiet or not len(boards) or not sys.stderr.isatty():
        yield _Plain()
        return
    yield OperatorScreen(app.console(stderr=True), boards)
