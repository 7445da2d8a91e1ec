"""Live progress on stderr: each step, what it waits for and until when, and the time it took."""

from __future__ import annotations

import json
import math
import re
import sys
import time
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

import click

from teds_provision.cli.context import App, Console, RenderableType
from teds_provision.errors import TedsProvisionError, UsageError
from teds_provision.provisioning.progress import FAILED, NOTHING, SKIPPED, Reporter, SilentReporter, StepResult
from teds_provision.sanitize import sanitize
from teds_provision.shapes.problem import problem_of

if TYPE_CHECKING:
    from rich.live import Live
    from rich.table import Table

    from teds_provision.links import Notice


_PIPE_COLUMNS = 1000
_MARKS = {NOTHING: "·", SKIPPED: "–", FAILED: "✗"}
_STYLES = {NOTHING: "dim", SKIPPED: "dim", FAILED: "red"}


def count_of(number: int) -> str:
    """Return the number with its noun: ``1 node``, ``2 nodes``."""
    return f"{number} node{'' if number == 1 else 's'}"


def first_lines(lines: list[str], most: int, count: int) -> list[str]:
    """Return the first lines of a list of so many, and how many more there are."""
    return [*lines[:most], f"  … and {count - most} more"] if count > most else lines


def shown(text: str | None) -> str:
    """Return foreign text, fit for a terminal: unprintable characters become ``?``."""
    return "".join(character if character.isprintable() else "?" for character in text or "")


def tidy(value: float, uncertainty: float | None) -> float:
    """Return a measured value for people: no digits below a thousandth of its uncertainty, and a zero is 0."""
    if uncertainty is None or not 0 < uncertainty < math.inf or not math.isfinite(value):
        return value
    return round(value, 3 - math.floor(math.log10(uncertainty))) + 0.0


def local_time(text: str) -> str:
    """Return a moment of the store (UTC) in local time with its offset; anything else unchanged."""
    try:
        return datetime.fromisoformat(text).astimezone().isoformat(sep=" ", timespec="seconds")
    except (ValueError, OverflowError):  # a moment from an untrusted document can be out of range in local time
        return text


def time_for(app: App, text: str) -> str:
    """Return a moment of the store as this run shows it: UTC with --json, else local time."""
    return text if app.json else local_time(text)


FIRMWARE_CHANGED = "firmware changed since calibration"


def firmware_words(firmware: dict[str, Any] | None) -> str:
    """Return a ``firmware`` of JSON in words: ``loadcell/app 1.2.3+4, outdated``; "" if nothing is known."""
    if firmware is None:
        return ""
    build = f"+{firmware['build']}" if firmware["build"] else ""
    words = (
        "firmware not reported"
        if firmware["version"] is None
        else f"{firmware['text']} {firmware['version']}{build}".strip()
    )
    state = "" if firmware["state"] in ("unjudged", "not-reported", "good") else f", {firmware['state']}"
    heard = "" if firmware["from"] == "session" else " (not verified)"
    changed = f"; {FIRMWARE_CHANGED}" if firmware["changed"] else ""
    return f"{words}{state}{heard}{changed}"


def print_json_list(name: str, entries: Iterable[dict[str, Any]]) -> None:
    """Print one JSON object with one list to stdout as it is made: a long list takes no memory.

    An error in the middle is in the same object, behind what came before it; then raises Exit with its code.
    """
    out = sys.stdout
    wide = (out.encoding or "utf-8").lower().replace("-", "") == "utf8"
    encode = json.JSONEncoder(ensure_ascii=not wide).encode
    out.write(f'{{"{name}": [')
    failed: TedsProvisionError | None = None
    try:
        for number, entry in enumerate(entries):
            out.write(f", {encode(entry)}" if number else encode(entry))
    except TedsProvisionError as error:
        failed = error
    body = problem_of(failed) if failed is not None else None
    out.write(f'], "error": {encode(body)}}}\n' if body is not None else "]}\n")
    out.flush()
    if failed is not None:
        raise click.exceptions.Exit(failed.exit_code)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines with columns one below the other, for a pipe; rich takes longer to load than most commands.

    The first row is the head.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]


def print_table(console: Console, table: Table) -> None:
    """Print a table; outside a terminal nothing of it is cut off, wrapped or padded at the end of a line."""
    if console.is_terminal:
        console.print(table)
        return
    console.width = _PIPE_COLUMNS
    with console.capture() as captured:
        console.print(table)
    console.file.writelines(f"{line.rstrip()}\n" for line in captured.get().splitlines())


def reporter_for(app: App, *, several: bool = False) -> Reporter:
    """Return the reporter for this run: silent for --json and --quiet, lines in a pipe, live on a terminal.

    ``several`` nodes are worked on at once: their lines come between each other.
    """
    if app.json or app.quiet:
        return SilentReporter()
    if several or not sys.stderr.isatty():
        return LineReporter(app)
    live = LiveReporter(app)
    app.live_line = live.close
    return live


class LineReporter:
    """One plain line per step and per notice."""

    def __init__(self, app: App) -> None:
        self._app = app
        self._last = ""

    def started(self, step: str) -> None:
        """Do nothing: a line comes when the step is done."""

    def finished(self, step: StepResult) -> None:
        """Print the step in one line."""
        self._app.note(line_of(step))

    def notice(self, notice: Notice) -> None:
        """Print a notice once."""
        if notice.text != self._last:
            self._last = notice.text
            until = f" (up to {notice.seconds:.0f} s)" if notice.seconds is not None else ""
            self._app.note(f"… {notice.text}{until}")

    def written(self, octets: int, total: int) -> None:
        """Do nothing: too many lines."""


def line_of(step: StepResult) -> str:
    """Return the line of a step: ``✓ agree       0.05 s  key epoch 1``."""
    mark = _MARKS.get(step.result, "✓")
    detail = step.detail if step.result != NOTHING else f"{NOTHING}{': ' if step.detail else ''}{step.detail}"
    whose = f"{step.of}: " if step.of else ""
    return f"{whose}{mark} {step.name:<11} {step.seconds:6.2f} s  {detail}".rstrip()


class LiveReporter:
    """Steps done above, and one live line: what runs, what it waits for, how long still."""

    def __init__(self, app: App) -> None:
        self._console = app.console(stderr=True)
        self._live: Live | None = None
        self._step = ""
        self._what = ""
        self._until: float | None = None

    def started(self, step: str) -> None:
        """Show the step as running."""
        self._step, self._what, self._until = step, "", None
        self._show()

    def finished(self, step: StepResult) -> None:
        """Put the step above the live line."""
        self._stop()
        style = _STYLES.get(step.result, "green")
        self._console.print(line_of(step), style=style, markup=False)

    def notice(self, notice: Notice) -> None:
        """Show what is waited for, or put what came by above the live line."""
        if notice.kind in ("waiting", "retry"):
            self._what = notice.text
            self._until = None if notice.seconds is None else time.monotonic() + notice.seconds
            self._show()
        else:
            self._stop()
            if notice.kind == "node-left":  # the node's step ended
                self._step = ""
            self._console.print(sanitize(f"… {notice.text}"), style="yellow", markup=False)

    def written(self, octets: int, total: int) -> None:
        """Show how far the transfer is."""
        self._what, self._until = f"{octets} of {total} octets", None
        self._show()

    def _show(self) -> None:
        from rich.live import Live

        if self._live is None:
            self._live = Live(get_renderable=self._render, console=self._console, transient=True, refresh_per_second=8)
            self._live.start()
        self._live.refresh()

    def _stop(self) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _render(self) -> RenderableType:
        from rich.spinner import Spinner
        from rich.text import Text

        left = "" if self._until is None else f" ({max(0.0, self._until - time.monotonic()):.0f} s left)"
        what = f"  {self._what}{left}" if self._what else ""
        return Spinner(
            "dots", text=Text(sanitize(f"{self._step}{what}".lstrip()))
        )  # rich would parse plain text as markup

    def close(self) -> None:
        """Take the live line away."""
        self._stop()


# Points in time as given to ``--since``: ISO 8601, ``today``, or an age (``2h``, ``3d``).

_UNITS = {"s": "seconds", "m": "minutes", "h": "hours", "d": "days", "w": "weeks"}


def duration(text: str) -> float:
    """Parse a time span as people write it (``90s``, ``15m``, ``2h``) and return seconds; raises UsageError."""
    found = re.fullmatch(r"(\d{1,6})\s*([smhdw])", text.strip().lower())
    if found is None:
        raise UsageError(f"{text!r} is not a valid time span.", hint="Use 90s, 15m or 2h.")
    return timedelta(**{_UNITS[found[2]]: int(found[1])}).total_seconds()


def moment(text: str, now: datetime | None = None) -> str:
    """Return a moment in UTC as the store writes it (``2026-01-31T12:00:00Z``); raises UsageError.

    A time without an offset is local; a date alone, and ``today``, mean its first moment there.
    """
    at = (now or datetime.now(UTC)).astimezone()
    word = text.strip().lower()
    ago = re.fullmatch(r"(\d{1,6})\s*([smhdw])", word)
    try:
        if word in ("today", "yesterday"):
            day = at.date() - timedelta(days=word == "yesterday")
            found = datetime(day.year, day.month, day.day)  # local: its offset may be another one than now
        elif ago is not None:
            found = at - timedelta(**{_UNITS[ago[2]]: int(ago[1])})
        else:
            found = datetime.fromisoformat(text.strip())
        return found.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    except (ValueError, OverflowError) as error:
        raise UsageError(
            f"{text!r} is not a valid time.", hint="Use 2026-01-31, 2026-01-31T12:00, today, or a time ago: 2h, 3d."
        ) from error
