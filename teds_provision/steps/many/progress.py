"""How far a sheet is: kept per sheet in the station's home, so that the same command carries on after anything."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from teds_provision.errors import NodeBusy, NoNode, NotFound, TedsProvisionError
from teds_provision.files import private_folder, read_limited, write_whole
from teds_provision.steps.many.board import Board, Totals, worse
from teds_provision.steps.many.sheet import Row, Sheet

FOLDER: Final = "batches"
_MAX_OCTETS: Final = 64 << 20


@dataclass
class Attempted:
    """What became of one row: the board that took it, its last result, and whether the first try passed.

    ``digest`` is of the row's cells: another content is another board, and begins anew.
    """

    digest: str
    uuid: str | None = None
    result: str = ""
    tries: int = 0
    first: bool = False
    seconds: float = 0.0
    time: str = ""
    message: str = ""
    steps: dict[str, float] = field(default_factory=dict)


class Progress:
    """The rows of one sheet with what became of them; durable after each board."""

    def __init__(self, home: Path, sheet: Sheet) -> None:
        self.sheet = sheet
        name = hashlib.sha256(str(sheet.path.resolve()).encode()).hexdigest()[:32]
        self._path = home / FOLDER / f"{name}.json"
        self._there = kept = self._kept()
        self.rows = {row.number: self._of(row, kept.get(str(row.number))) for row in sheet.rows}
        self.worst: TedsProvisionError | None = None
        self._tried: frozenset[int] = frozenset()
        self._turned_away: dict[int, str] = {}

    def _kept(self) -> dict[str, Any]:
        try:
            told = json.loads(read_limited(self._path, _MAX_OCTETS, "progress of a sheet", follow=False))
        except (NotFound, ValueError):
            return {}
        rows = told.get("rows") if isinstance(told, dict) else None
        return rows if isinstance(rows, dict) else {}

    @staticmethod
    def _of(row: Row, kept: Any) -> Attempted:
        if not isinstance(kept, dict) or kept.get("digest") != row.digest:
            return Attempted(row.digest)
        try:
            return Attempted(**kept)
        except TypeError:  # of another version of this tool
            return Attempted(row.digest)

    def save(self, *changed: Row) -> None:
        """Put these rows (all, where none is named) onto the disk, beside what another run of this sheet put there.

        Raises StoreFailure.
        """
        with self._alone():
            self._read_again(but={row.number for row in changed or self.sheet.rows})
            self._write()

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """What is written is made from what lies there: two runs of one sheet (two desks) lose each other no board."""
        private_folder(self._path.parent)
        place = self._path.with_suffix(".lock")
        descriptor = os.open(place, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)  # held for one small file
            yield
        finally:
            os.close(descriptor)

    def _read_again(self, but: Collection[int] = ()) -> None:
        """Take in the rows that another run has changed since this one looked."""
        before, self._there = self._there, self._kept()
        self.rows |= {
            row.number: self._of(row, self._there[key])
            for row in self.sheet.rows
            if row.number not in but and (key := str(row.number)) in self._there and self._there[key] != before.get(key)
        }

    def _write(self) -> None:
        self._there = {str(number): asdict(row) for number, row in self.rows.items()}
        told = {"sheet": str(self.sheet.path.resolve()), "rows": self._there}
        write_whole(self._path, json.dumps(told, indent=1).encode())

    @property
    def open(self) -> list[Row]:
        """The rows whose board has not passed."""
        return [row for row in self.sheet.rows if self.rows[row.number].result != "passed"]

    @property
    def untried(self) -> list[Row]:
        """The open rows that nobody tried in this run."""
        return [row for row in self.open if row.number not in self._tried]

    @property
    def next_row(self) -> Row | None:
        """The row that the next board may be of."""
        rows = self.untried or self.open
        return rows[0] if rows else None

    def row_for(self, uuid: bytes, fingerprint: str, *, busy: Collection[int] = ()) -> Row | None:
        """The row of a board: that which names it or had it before, else the next in the order of the taps.

        One that had no board goes before one whose board did not pass: that is for a spare, once nothing else is left.
        ``busy`` are the numbers of the rows on which another reader is at work.
        """
        for row in self.sheet.rows:
            if row.means(uuid, fingerprint) or (row.by_order and self.board_of(row) == uuid.hex()):
                return row
        rows = [row for row in self.open if row.by_order and row.number not in busy]
        return min(rows, key=self._lateness, default=None)

    def _lateness(self, row: Row) -> tuple[bool, bool]:
        return self.rows[row.number].uuid is not None, row.number in self._tried

    def board_of(self, row: Row) -> str | None:
        """The board that has the row, or was turned away from it in this run; None where there was none."""
        return self.rows[row.number].uuid or self._turned_away.get(row.number)

    def take(self, row: Row, uuid: bytes) -> None:
        """Note that this board is the row's, before anything is done with it.

        Raises NodeBusy where another run of this sheet has given the row to another board meanwhile.
        """
        before = self.rows[row.number].uuid
        if before == uuid.hex():
            return
        with self._alone():
            self._read_again()
            attempted = self.rows[row.number]
            if row.by_order and attempted.uuid not in (before, uuid.hex()):
                raise NodeBusy(
                    f"Row {row.number} was given to board {attempted.uuid} by another run of this sheet.",
                    hint="Tap this board again: it gets the next row.",
                )
            attempted.uuid = uuid.hex()
            self._write()

    def turn_away(self, row: Row, uuid: bytes) -> None:
        """Note that this board was not given what the row says; the row stays free, and is tried again with it."""
        self._turned_away[row.number] = uuid.hex()

    def not_this_board(self, row: Row, board: Board) -> None:
        """Note that another type of board was tapped for this row: nothing was written, the row waits for its own."""
        attempted = self.rows[row.number]
        attempted.uuid, attempted.time = None, board.time
        attempted.message = board.failure.message if board.failure is not None else ""
        self.worst = worse(self.worst, board.failure)
        self.save(row)

    def note(self, row: Row, board: Board) -> None:
        """Note how a board ended."""
        attempted = self.rows[row.number]
        attempted.tries += board.result != "skipped"  # a "no" says nothing of the board
        attempted.result = board.result
        attempted.first = attempted.first or (attempted.tries == 1 and board.result == "passed")
        attempted.seconds, attempted.time = round(board.seconds, 3), board.time
        attempted.message = board.failure.message if board.failure is not None else ""
        if board.done is not None:
            attempted.message = attempted.message or " ".join(board.done.warnings)
            attempted.steps = {step.name: step.seconds for step in board.done.steps}
        self._tried = self._tried | {row.number}
        self.worst = worse(self.worst, board.failure)
        self.save(row)

    def ran_out(self, seconds: float) -> None:
        """Note that no board came in time for the rows that nobody tried, if there are any."""
        if self.untried:
            missed = ", ".join(str(row.number) for row in self.untried[:10])
            self.worst = worse(self.worst, NoNode(f"No board came within {seconds:.0f} s for row {missed}."))

    def totals(self) -> Totals:
        """What the whole sheet came to, over all runs; a row that was not reached is ``skipped``."""
        rows = list(self.rows.values())
        results = Counter(row.result for row in rows)
        passed, failed = results["passed"], results["failed"]
        firsts = [row.first for row in rows if row.tries and row.result != "skipped"]
        return Totals(
            passed,
            failed,
            len(rows) - passed - failed,
            round(sum(row.seconds for row in rows), 3),
            round(sum(firsts) / len(firsts), 4) if firsts else None,
            mean_steps([row.steps for row in rows if row.result == "passed"]),
            self.worst,
        )


def mean_steps(all_steps: list[dict[str, float]]) -> dict[str, float]:
    """Mean seconds of each step."""
    names = list(dict.fromkeys(name for steps in all_steps for name in steps))
    return {name: round(sum(steps.get(name, 0.0) for steps in all_steps) / len(all_steps), 4) for name in names}
