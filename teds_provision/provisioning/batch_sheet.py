"""The sheet of a batch (``--batch FILE``): its rows, how each board ended, how far the sheet is, and the report.

CSV with a header: ``uuid`` (or empty: the rows are taken in the order of the taps), ``name``, ``profile``,
``calibration`` (a file, ``N=FILE`` for channel N alone; a relative path starts at the sheet), ``item`` (the result of a
certificate) and ``fingerprint`` (32 to 64 hex digits, for example from a scanned label: it pins the board's key before
the tap). Everything is checked before the first tap. Progress is kept
per sheet in the station's home, so the same command carries on after an interruption.
"""

from __future__ import annotations

import csv
import hashlib
import html
import io
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Final, Literal

from teds_provision.errors import (
    BadDataError,
    NodeBusyError,
    NoNodeError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    TedsProvisionError,
    UsageError,
)
from teds_provision.files import SHARED, open_lock, private_folder, read_limited, write_whole
from teds_provision.portable import lock
from teds_provision.provisioning.build import BuildOrder, PreparedOrder, content_digests, prepare
from teds_provision.provisioning.provision import ProvisionResult
from teds_provision.provisioning.verify import require_authentic
from teds_provision.station.label import read_label
from teds_provision.station.station import Station
from teds_provision.station.store.records import utc_now
from teds_provision.teds.certificate import split_channel

Result = Literal["passed", "failed", "skipped"]


class DeclinedError(PolicyError):
    """The operator declined: nothing was changed."""

    code = "declined"


@dataclass(frozen=True)
class BoardResult:
    """The end of one board: what was done, or the error that ended it. ``row`` is that of a sheet, from 1."""

    uuid: bytes
    seconds: float
    done: ProvisionResult | None = None
    error: TedsProvisionError | None = None
    row: int | None = None
    place: str = ""
    time: str = field(default_factory=utc_now)

    @property
    def failure(self) -> TedsProvisionError | None:
        """The error that ended it, or the verdict that is not ``authentic``; None for a board that passed."""
        if self.error is not None or self.done is None:
            return self.error
        try:
            require_authentic(self.done.verified)
        except TedsProvisionError as error:
            return error
        return None

    @property
    def result(self) -> Result:
        """``passed``: provisioned and authentic; ``skipped``: the operator declined."""
        if isinstance(self.error, DeclinedError):
            return "skipped"
        return "failed" if self.failure is not None else "passed"


@dataclass(frozen=True)
class BatchTotals:
    """Totals of a batch: boards by result, seconds, and the share that passed at their first try (None: no try).

    ``steps`` are the mean seconds of each step over the boards that passed.
    """

    passed: int
    failed: int
    skipped: int
    seconds: float
    first_pass: float | None
    steps: dict[str, float]
    worst: TedsProvisionError | None = None

    @property
    def error(self) -> TedsProvisionError | None:
        """Error that the command ends with: None if all passed, else the worst one."""
        if not self.failed and not self.skipped:
            return None
        text = f"{self.passed} passed, {self.failed} failed, {self.skipped} skipped."
        if isinstance(self.worst, NoNodeError):  # no board arrived, so no row reports this error
            text = f"{text} {self.worst.message}"
        kind = type(self.worst) if self.worst is not None else PolicyError
        known = kind if kind.__init__ is TedsProvisionError.__init__ else PolicyError
        return known(text, hint="Run the same command again to continue with the rest.")


def worse(one: TedsProvisionError | None, other: TedsProvisionError | None) -> TedsProvisionError | None:
    """Return the error that a person should see first: not authentic, then refused, then the rest."""
    if one is None or other is None:
        return one or other
    return max(one, other, key=_weight)


def _weight(error: TedsProvisionError) -> int:
    if isinstance(error, NotAuthenticError):
        return 3
    return 2 if isinstance(error, PolicyError) and not isinstance(error, DeclinedError) else 1


# -- reading the sheet -------------------------------------------------------------------------------------------------

MAX_SHEET_OCTETS: Final = 4 << 20
MAX_ROWS: Final = 10_000
COLUMNS: Final = ("uuid", "name", "profile", "calibration", "item", "fingerprint")
_SHOWN: Final = 20
_DELIMITERS: Final = ",;\t"  # if two are equally frequent, the first one counts
_UUID = re.compile("[0-9a-f]{20}")
_LEAST_DIGITS: Final = 32
_FINGERPRINT = re.compile("[0-9a-f]{32,64}")


@dataclass(frozen=True)
class SheetRow:
    """One board of the sheet: ``number`` counts from 1, ``line`` is that of the file."""

    number: int
    line: int
    uuid: bytes | None
    fingerprint: str | None
    prepared: PreparedOrder
    digest: str

    @cached_property
    def content(self) -> dict[str, str]:
        """Digests of what the row names: a row stays done only while profile, calibration and name are unchanged."""
        profile, calibration = content_digests(self.prepared)
        return {"profile": profile, "calibration": calibration, "name": self.prepared.order.name or ""}

    @property
    def by_order(self) -> bool:
        """True if the row names no board and goes to the next one tapped."""
        return self.uuid is None and self.fingerprint is None

    @property
    def lacks_calibration(self) -> bool:
        """True if the type requires a calibration and the row has none; its board may have one from before."""
        profile = self.prepared.profile
        if profile is None or self.prepared.calibrations is not None:
            return False
        return any(channel.calibration.required for channel in profile.channels)

    def means(self, uuid: bytes, fingerprint: str) -> bool:
        """Return True if this row names that board; a UUID with another key is for the pin to refuse."""
        if self.uuid is not None:
            return self.uuid == uuid
        return self.fingerprint is not None and fingerprint.startswith(self.fingerprint)


@dataclass(frozen=True)
class BatchSheet:
    """All rows of one file, each found good."""

    path: Path
    rows: tuple[SheetRow, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings before the first board, one for all rows that share it."""
        found: dict[str, list[int]] = {}
        for row in self.rows:
            for warning in row.prepared.warnings:
                found.setdefault(warning, []).append(row.number)
            if row.lacks_calibration:
                found.setdefault("the type requires a calibration, but the sheet gives none.", []).append(row.number)
        return tuple(f"Row{'s' if len(rows) > 1 else ''} {_numbers(rows)}: {why}" for why, rows in found.items())


def read_sheet(station: Station, path: Path, order: BuildOrder) -> BatchSheet:
    """Read a sheet, and read, fit and guard all that it names; ``order`` is what rows get that leave it out.

    Raises NotFoundError (no such file), BadDataError with every line that is wrong.
    """
    reading = _SheetReader(station, path, order)
    reading.read(read_limited(path, MAX_SHEET_OCTETS, "sheet of boards"))
    if reading.mistakes:
        mistakes = [f"{path.name}:{_numbers(lines)}: {why}" for why, lines in reading.mistakes.items()]
        shown = "; ".join(mistakes[:_SHOWN])
        more = f"; and {len(mistakes) - _SHOWN} more" if len(mistakes) > _SHOWN else ""
        raise BadDataError(
            f"{shown}{more}.", hint="Nothing was provisioned. Fix the sheet and run the same command again."
        )
    if not reading.rows:
        raise BadDataError(
            f"{path} has no rows.", hint=f"It needs a header ({', '.join(COLUMNS)}) and one line per board."
        )
    return BatchSheet(path, tuple(reading.rows))


def _numbers(numbers: Sequence[int]) -> str:
    """Return ``2, 9, 16``; of many numbers the first few, and how many more."""
    more = f" and {len(numbers) - _SHOWN} more" if len(numbers) > _SHOWN else ""
    return f"{', '.join(map(str, numbers[:_SHOWN]))}{more}"


class _SheetReader:
    def __init__(self, station: Station, path: Path, order: BuildOrder) -> None:
        self.station, self.path, self.order = station, path, order
        self.rows: list[SheetRow] = []
        self.mistakes: dict[str, list[int]] = {}
        self.count = 0
        self._seen: dict[tuple[str, str], int] = {}
        self._prepared: dict[BuildOrder, PreparedOrder | str] = {}

    def wrong(self, line: int, why: str) -> None:
        lines = self.mistakes.setdefault(why, [])
        if lines[-1:] != [line]:
            lines.append(line)
        self.count += 1

    def read(self, octets: bytes) -> None:
        try:
            text = octets.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            self.wrong(1 + octets[: error.start].count(b"\n"), "it is not UTF-8 (a spreadsheet calls it: CSV UTF-8)")
            return
        first = text.partition("\n")[0]
        delimiter = max(_DELIMITERS, key=first.count)
        table = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, strict=True)
        try:
            header = [cell.strip().lower() for cell in next(table, [])]
            if not self._header_is_good(header):
                return
            for row in table:
                cells = [cell.strip() for cell in row]
                if any(cells):
                    self._row(table.line_num, header, cells)
                if len(self.rows) > MAX_ROWS:
                    self.wrong(table.line_num, f"there are more than {MAX_ROWS} rows")
                    return
        except csv.Error as error:
            self.wrong(table.line_num, f"this is not CSV: {error}")

    def _header_is_good(self, header: Sequence[str]) -> bool:
        for name in header:
            if name not in COLUMNS:
                self.wrong(1, f"there is no column {name!r}; columns are {', '.join(COLUMNS)}")
            elif header.count(name) > 1:
                self.wrong(1, f"the column {name!r} appears twice")
        return not self.mistakes

    def _row(self, line: int, header: Sequence[str], cells: Sequence[str]) -> None:
        before = self.count
        if len(cells) > len(header):
            self.wrong(line, f"{len(cells)} cells under {len(header)} columns")
        values = dict(zip(header, cells, strict=False))
        self._take_label(line, values)
        uuid = self._digits(line, "uuid", values.get("uuid", ""), _UUID, "20 hex digits")
        pin = self._digits(line, "fingerprint", values.get("fingerprint", ""), _FINGERPRINT, "32 to 64 hex digits")
        prepared = self._order(line, values)
        # the first 32 digits are a key's: a row may have more of them than another one
        short = pin[:_LEAST_DIGITS] if pin is not None else ""
        for what, value in (("uuid", uuid), ("fingerprint", short), ("name", values.get("name", ""))):
            self._once(line, what, value or "")
        if uuid is not None and prepared is not None and prepared.order.name is not None:
            name = prepared.order.name
            others = [other for other in self.station.nodes.all_named(name) if other != bytes.fromhex(uuid)]
            if others:
                self.wrong(line, f"node {others[0].hex()} already has the name {name!r}")
        if self.count == before and prepared is not None:
            digest = hashlib.sha256("\0".join(cells).encode()).hexdigest()
            number = len(self.rows) + 1
            self.rows.append(SheetRow(number, line, bytes.fromhex(uuid) if uuid else None, pin, prepared, digest))

    def _take_label(self, line: int, values: dict[str, str]) -> None:
        """Fill in UUID and fingerprint from a label that was scanned into either cell.

        The other must not contradict.
        """
        for name in ("uuid", "fingerprint"):
            label = read_label(values.get(name, ""))
            if label is None:
                continue
            facts = {"uuid": label[0].hex(), "fingerprint": label[1]}
            other = "uuid" if name == "fingerprint" else "fingerprint"
            digits = re.sub(r"[\s:-]", "", values.get(other, "")).lower().removeprefix("0x")
            if digits and read_label(values[other]) is None and not facts[other].startswith(digits):
                self.wrong(line, f"{other}: {values[other][:48]!a}, and the label in {name} says {facts[other]}")
            values.update(facts)

    def _digits(self, line: int, what: str, text: str, form: re.Pattern[str], rule: str) -> str | None:
        if not text:
            return None
        digits = re.sub(r"[\s:-]", "", text).lower().removeprefix("0x")
        if form.fullmatch(digits):
            return digits
        self.wrong(line, f"{what}: expected {rule}, not {text[:48]!a}")
        return None

    def _once(self, line: int, what: str, value: str) -> None:
        if not value:
            return
        other = self._seen.setdefault((what, value), line)
        if other != line and not (what == "name" and ("{uuid}" in value or "{n}" in value)):
            self.wrong(line, f"the {what} {value} is already in line {other}")

    def _order(self, line: int, values: dict[str, str]) -> PreparedOrder | None:
        channel, file = split_channel(values.get("calibration") or "")
        order = replace(
            self.order,
            profile=values.get("profile") or self.order.profile,
            name=values.get("name") or self.order.name,
            calibration=self.path.parent / file if file else None,
            channel=channel,
            item=values.get("item") or self.order.item,
        )
        shared = replace(order, name=None)  # calculate a calibration only once for all rows that name the same file
        if shared not in self._prepared:
            try:
                self._prepared[shared] = prepare(self.station, shared)
            except TedsProvisionError as error:
                self._prepared[shared] = error.message.rstrip(".")
        try:
            prepare(self.station, BuildOrder(name=order.name))
        except TedsProvisionError as error:
            self.wrong(line, error.message.rstrip("."))
        found = self._prepared[shared]
        if isinstance(found, str):
            self.wrong(line, found)
            return None
        return replace(found, order=order)


# -- progress ----------------------------------------------------------------------------------------------------------

FOLDER: Final = "batches"
_MAX_OCTETS: Final = 64 << 20


@dataclass
class RowOutcome:
    """Outcome of one row: the board that took it, its last result, and whether the first try passed.

    ``digest`` is of the row's cells: other cells are another board, and start afresh. ``content`` has the digests of
    what the cells name (:attr:`SheetRow.content`), None in a file of an older version; ``again`` is why the row is done
    once more, "" if it is not.
    """

    digest: str
    content: dict[str, str] | None = None
    again: str = ""
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

    def __init__(
        self, home: Path, sheet: BatchSheet, has_it: Callable[[SheetRow, bytes], bool] = lambda _row, _uuid: True
    ) -> None:
        """Read what earlier runs kept; ``has_it`` decides on rows of an older version: True keeps them done."""
        self.sheet, self._has_it = sheet, has_it
        name = hashlib.sha256(str(sheet.path.resolve()).encode()).hexdigest()[:32]
        self._path = home / FOLDER / f"{name}.json"
        self._there = kept = self._read_progress()
        self.rows = {row.number: self._attempted(row, found) for row, found in self._matched(kept)}
        self.worst: TedsProvisionError | None = None
        self._tried: frozenset[int] = frozenset()
        self._turned_away: dict[int, str] = {}

    def _read_progress(self) -> dict[str, Any]:
        try:
            document = json.loads(read_limited(self._path, _MAX_OCTETS, "progress of a sheet", follow=False))
        except (NotFoundError, ValueError):
            return {}
        rows = document.get("rows") if isinstance(document, dict) else None
        return rows if isinstance(rows, dict) else {}

    def _matched(self, kept: dict[str, Any]) -> Iterator[tuple[SheetRow, Any]]:
        """Yield each row of the sheet with what was kept of it, also if the row has moved within the sheet since."""
        left = {key: found for key, found in kept.items() if isinstance(found, dict)}
        matched: dict[int, Any] = {}
        for row in self.sheet.rows:
            if left.get(str(row.number), {}).get("digest") == row.digest:
                matched[row.number] = left.pop(str(row.number))
        moved: dict[str, list[str]] = {}
        for key, found in left.items():
            moved.setdefault(str(found.get("digest")), []).append(key)
        for row in self.sheet.rows:
            if row.number not in matched and moved.get(row.digest):
                matched[row.number] = left.pop(moved[row.digest].pop(0))
        for row in self.sheet.rows:  # a changed row replaces the one with its number
            yield row, matched[row.number] if row.number in matched else left.get(str(row.number))

    def _attempted(self, row: SheetRow, kept: Any) -> RowOutcome:
        try:
            found = RowOutcome(**kept)
        except TypeError:  # no outcome yet, or one of another version of this program
            return RowOutcome(row.digest, row.content)
        if found.digest != row.digest:
            again = "the sheet changed" if found.result == "passed" else ""
            return RowOutcome(row.digest, row.content, again)
        if found.result == "passed":
            again = self._why_again(row, found)
            if again:
                return RowOutcome(row.digest, row.content, again, uuid=found.uuid)
        return replace(found, content=row.content)

    def _why_again(self, row: SheetRow, found: RowOutcome) -> str:
        """Return why a row that has passed is done once more, "" if it stays done."""
        if found.content is None:  # an older version of this program, which stored no digests
            same = found.uuid is not None and self._has_it(row, bytes.fromhex(found.uuid))
            return "" if same else "the datasheet differs from the one that the sheet gives"
        changed = [what for what, digest in row.content.items() if found.content.get(what) != digest]
        return f"the {' and '.join(changed)} changed" if changed else ""

    @property
    def again(self) -> tuple[str, ...]:
        """Which rows are done once more, and why, in sentences."""
        found: dict[str, list[int]] = {}
        for row in self.open:
            if self.rows[row.number].again:
                found.setdefault(self.rows[row.number].again, []).append(row.number)
        return tuple(
            f"{'Rows' if len(rows) > 1 else 'Row'} {_numbers(rows)}: provisioned again, because {why}."
            for why, rows in found.items()
        )

    def has_passed(self, uuid: bytes) -> bool:
        """Return True if the row of this board is done."""
        return any(row.uuid == uuid.hex() and row.result == "passed" for row in self.rows.values())

    def save(self, *changed: SheetRow) -> None:
        """Write these rows (all, if none is named) to the disk, merged with those of another run of this sheet.

        Raises StoreError.
        """
        with self._alone():
            self._read_again(but={row.number for row in changed or self.sheet.rows})
            self._write()

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Lock the sheet, so that a change starts from the file's present content and two runs lose no board."""
        private_folder(self._path.parent)
        place = self._path.with_suffix(".lock")
        descriptor = open_lock(place)
        try:
            lock(descriptor, wait=True)  # waits: the lock is held only while a small file is written
            yield
        finally:
            os.close(descriptor)

    def _read_again(self, but: Collection[int] = ()) -> None:
        """Take in the rows that another run has changed since this one looked."""
        before, self._there = self._there, self._read_progress()
        self.rows |= {
            row.number: self._attempted(row, self._there[key])
            for row in self.sheet.rows
            if row.number not in but and (key := str(row.number)) in self._there and self._there[key] != before.get(key)
        }

    def _write(self) -> None:
        self._there = {str(number): asdict(row) for number, row in self.rows.items()}
        document = {"sheet": str(self.sheet.path.resolve()), "rows": self._there}
        write_whole(self._path, json.dumps(document, indent=1).encode())

    @property
    def open(self) -> list[SheetRow]:
        """The rows whose board has not passed."""
        return [row for row in self.sheet.rows if self.rows[row.number].result != "passed"]

    @property
    def untried(self) -> list[SheetRow]:
        """The open rows without a try in this run."""
        return [row for row in self.open if row.number not in self._tried]

    @property
    def next_row(self) -> SheetRow | None:
        """The row that the next board may be of."""
        rows = self.untried or self.open
        return rows[0] if rows else None

    def row_for(self, uuid: bytes, fingerprint: str, *, busy: Collection[int] = ()) -> SheetRow | None:
        """Return the row of a board: that which names it or had it before, else the next in the order of the taps.

        A row without a board goes before one whose board did not pass: that is for a spare, once nothing else is left.
        ``busy`` are the numbers of the rows on which another reader is at work.
        """
        for row in self.sheet.rows:
            if row.means(uuid, fingerprint) or (row.by_order and self.board_of(row) == uuid.hex()):
                return row
        rows = [row for row in self.open if row.by_order and row.number not in busy]
        return min(
            rows, key=lambda row: (self.rows[row.number].uuid is not None, row.number in self._tried), default=None
        )

    def board_of(self, row: SheetRow) -> str | None:
        """Return the board that has the row, or was refused for it in this run; None if there was none."""
        return self.rows[row.number].uuid or self._turned_away.get(row.number)

    def assign_row(self, row: SheetRow, uuid: bytes) -> None:
        """Record that this board has the row, before anything is done with it.

        Raises NodeBusyError if another run of this sheet has given the row to another board meanwhile.
        """
        before = self.rows[row.number].uuid
        if before == uuid.hex():
            return
        with self._alone():
            self._read_again()
            attempted = self.rows[row.number]
            if row.by_order and attempted.uuid not in (before, uuid.hex()):
                raise NodeBusyError(
                    f"Row {row.number} was assigned to board {attempted.uuid} by another run of this sheet.",
                    hint="Tap this board again to use the next row.",
                )
            attempted.uuid = uuid.hex()
            self._write()

    def turn_away(self, row: SheetRow, uuid: bytes) -> None:
        """Record that this board did not get the row; the row stays free, and is tried again with it."""
        self._turned_away[row.number] = uuid.hex()

    def not_this_board(self, row: SheetRow, board: BoardResult) -> None:
        """Note that another type of board was tapped for this row: nothing was written, the row waits for its own."""
        attempted = self.rows[row.number]
        attempted.uuid, attempted.time = None, board.time
        attempted.message = board.failure.message if board.failure is not None else ""
        self.worst = worse(self.worst, board.failure)
        self.save(row)

    def note(self, row: SheetRow, board: BoardResult) -> None:
        """Note how a board ended."""
        attempted = self.rows[row.number]
        attempted.tries += board.result != "skipped"  # a "no" of the operator is not an attempt
        attempted.result = board.result
        attempted.first = attempted.first or (attempted.tries == 1 and board.result == "passed")
        attempted.seconds, attempted.time = round(board.seconds, 3), board.time
        attempted.message = board.failure.message if board.failure is not None else ""
        if board.done is not None:
            attempted.message = attempted.message or " ".join(board.done.warnings)
        if attempted.again:
            attempted.message = f"Provisioned again, because {attempted.again}. {attempted.message}".rstrip()
        if board.done is not None:
            attempted.steps = {step.name: step.seconds for step in board.done.steps}
        self._tried = self._tried | {row.number}
        self.worst = worse(self.worst, board.failure)
        self.save(row)

    def ran_out(self, how: str) -> None:
        """Note that no board came for the rows that were not tried, if there are any; ``how``: was tapped, answered."""
        if self.untried:
            missed = ", ".join(str(row.number) for row in self.untried[:10])
            self.worst = worse(self.worst, NoNodeError(f"No board {how} for row {missed}."))

    def totals(self) -> BatchTotals:
        """Return the totals of the whole sheet, over all runs; a row that was not reached is ``skipped``."""
        rows = list(self.rows.values())
        results = Counter(row.result for row in rows)
        passed, failed = results["passed"], results["failed"]
        firsts = [row.first for row in rows if row.tries and row.result != "skipped"]
        return BatchTotals(
            passed,
            failed,
            len(rows) - passed - failed,
            round(sum(row.seconds for row in rows), 3),
            round(sum(firsts) / len(firsts), 4) if firsts else None,
            mean_steps([row.steps for row in rows if row.result == "passed"]),
            self.worst,
        )


def mean_steps(all_steps: list[dict[str, float]]) -> dict[str, float]:
    """Return the mean seconds of each step."""
    names = list(dict.fromkeys(name for steps in all_steps for name in steps))
    return {name: round(sum(steps.get(name, 0.0) for steps in all_steps) / len(all_steps), 4) for name in names}


# -- the report: CSV or HTML, by suffix --------------------------------------------------------------------------------

_HEAD: Final = ("row", "uuid", "name", "profile", "result", "tries", "first_pass", "seconds", "time", "message")
_RESULT: Final = _HEAD.index("result")
_STYLE: Final = (
    "body{font:16px sans-serif;margin:2em}table{border-collapse:collapse}td,th{border:1px solid #999;padding:.3em .6em;"
    "text-align:left;white-space:nowrap}td:last-child{white-space:normal}"
    ".passed{background:#cfc}.failed{background:#fcc}.skipped{background:#eee}"
    # For printing: A4 landscape, the table's head on each page, no row split between pages, colours as on the screen.
    "@page{size:A4 landscape;margin:12mm}@media print{body{font-size:8pt;margin:0}thead{display:table-header-group}"
    "tr{break-inside:avoid}td,th{padding:.15em .35em}thead th,td:nth-child(4){white-space:normal}"
    "td:nth-child(3),td:last-child{white-space:normal;overflow-wrap:anywhere}"
    "td:nth-child(3),td:nth-child(4){min-width:10em}td:nth-child(10){min-width:16em}"
    "*{print-color-adjust:exact;-webkit-print-color-adjust:exact}}"
)


@dataclass(frozen=True)
class ReportHead:
    """The origin of a report: the station with its key (64 hex digits), the operator, and the software."""

    station: str
    fingerprint: str
    operator: str
    software: str


def check_report(path: Path | None) -> None:
    """Raise UsageError for a report of an unknown form, NotFoundError without a folder to lie in.

    Before the first tap.
    """
    if path is None:
        return
    if path.suffix.lower() not in (".csv", ".html", ".htm"):
        raise UsageError(f"{path.name} is neither CSV nor HTML.", hint="Name it FILE.csv or FILE.html.")
    if not path.parent.is_dir():
        raise NotFoundError(
            f"There is no folder {path.parent} for the report.", hint="Create it, or choose another path."
        )


def write_report(path: Path, progress: Progress, about: ReportHead) -> None:
    """Write the report whole; raises what ``write_whole`` raises. CSV is for programs: rows and totals alone."""
    rows, totals, name = _rows(progress), progress.totals(), progress.sheet.path.name
    text = _csv(rows, totals) if path.suffix.lower() == ".csv" else _html(name, rows, totals, about)
    write_whole(path, text.encode(), mode=SHARED)


def _rows(progress: Progress) -> list[tuple[str, ...]]:
    rows = []
    for row in progress.sheet.rows:
        kept, order = progress.rows[row.number], row.prepared.order
        uuid = kept.uuid or (row.uuid.hex() if row.uuid is not None else "")
        values = (row.number, uuid, order.name or "", order.profile or "", kept.result or "not reached", kept.tries)
        rows.append((*map(str, values), str(kept.first).lower(), str(kept.seconds), kept.time, kept.message))
    return rows


def _totals(totals: BatchTotals) -> list[tuple[str, str]]:
    share = "" if totals.first_pass is None else f"{totals.first_pass:.4f}"
    rows = [
        ("passed", str(totals.passed)),
        ("failed", str(totals.failed)),
        ("skipped", str(totals.skipped)),
        ("seconds", f"{totals.seconds:.3f}"),
        ("first_pass", share),
    ]
    return rows + [(f"seconds of {name}", f"{seconds:.4f}") for name, seconds in totals.steps.items()]


def _csv(rows: Sequence[Sequence[str]], totals: BatchTotals) -> str:
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_HEAD)
    writer.writerows([[_tame(cell) for cell in row] for row in rows])
    writer.writerow([])
    writer.writerows(_totals(totals))
    return out.getvalue()


def _tame(cell: str) -> str:
    """Return a cell that no spreadsheet takes for a formula: names and messages come from outside."""
    return f"'{cell}" if cell[:1] in ("=", "+", "-", "@") else cell


def _html(name: str, rows: Sequence[Sequence[str]], totals: BatchTotals, about: ReportHead) -> str:
    head = "".join(f"<th>{html.escape(cell.replace('_', ' '))}</th>" for cell in _HEAD)
    body = "".join(
        f'<tr class="{html.escape(row[_RESULT])}">'
        + "".join(f"<td>{html.escape(cell)}</td>" for cell in _for_people(row))
        + "</tr>\n"
        for row in rows
    )
    sums = "".join(
        f"<tr><th>{html.escape(what)}</th><td>{html.escape(value)}</td></tr>\n" for what, value in _sums(totals)
    )
    made = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
    who = [("station", about.station), ("key", about.fingerprint), ("operator", about.operator)]
    who += [("software", about.software), ("made", made)]
    sums = "".join(f"<tr><th>{what}</th><td>{html.escape(value)}</td></tr>\n" for what, value in who) + sums
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(name)}</title>'
        f"<style>{_STYLE}</style></head><body><h1>{html.escape(name)}</h1>\n<table>{sums}</table><p></p>"
        f"<table><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></body></html>\n"
    )


def _sums(totals: BatchTotals) -> list[tuple[str, str]]:
    share = "none was tried" if totals.first_pass is None else f"{totals.first_pass:.1%}"
    counts = [("passed", totals.passed), ("failed", totals.failed), ("skipped or not reached", totals.skipped)]
    rows = [(what, str(count)) for what, count in counts]
    rows += [("first-pass yield", share), ("seconds in all", f"{totals.seconds:.1f}")]
    return rows + [(f"seconds of {name}, mean", f"{seconds:.2f}") for name, seconds in totals.steps.items()]


def _for_people(row: Sequence[str]) -> list[str]:
    """Return the cells of a row with the local time of day; empty if the board was not reached."""
    cells = dict(zip(_HEAD, row, strict=True))
    tried = bool(cells["time"])
    cells["first_pass"] = ("yes" if cells["first_pass"] == "true" else "no") if tried else ""
    cells["seconds"] = f"{float(cells['seconds']):.1f}" if tried else ""
    if tried:
        cells["time"] = datetime.fromisoformat(cells["time"]).astimezone().isoformat(sep=" ", timespec="seconds")
    return list(cells.values())
