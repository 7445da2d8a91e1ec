"""``provision``: from tap to verified datasheet in one command, for one board, for fifty, for every node of a bus."""

from __future__ import annotations

import signal
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import click

from teds_provision import firmware_image, provisioning, teds
from teds_provision.cli.context import App, Console, pass_app
from teds_provision.cli.node.build import calibration_json, order_options
from teds_provision.cli.options import FileToRead, command, dry_run_option, link_options, options_given, yes_option
from teds_provision.cli.rendering import firmware_words, local_time, print_table, reporter_for, time_for
from teds_provision.errors import TedsProvisionError, UsageError, WrongImageError
from teds_provision.firmware_image import FirmwareImage
from teds_provision.lazy import late
from teds_provision.links import LinkSettings, Notice
from teds_provision.provisioning.progress import Reporter, StepResult
from teds_provision.sanitize import sanitize
from teds_provision.shapes.problem import problem_of
from teds_provision.station.firmware import firmware_of
from teds_provision.station.shown_units import shown_units
from teds_provision.station.station import Station
from teds_provision.station.summary import NodeSummary, summarise

if TYPE_CHECKING:
    from teds_provision.cli import terminal_operator
    from teds_provision.provisioning.batch import BatchRun, ProvisionPlan, ProvisionRequest
    from teds_provision.provisioning.batch_sheet import BoardResult, SheetRow
    from teds_provision.provisioning.operator import Operator
    from teds_provision.provisioning.provision import ProductionLine, ProvisionResult
else:  # imports the steps
    terminal_operator = late("teds_provision.cli.terminal_operator")


class LineChoice(Protocol):
    """Choice that an optional room makes from its options, for all boards of a run."""

    @property
    def names_boards(self) -> bool:
        """True if what each board gets, its calibration too, is named elsewhere than by options."""

    def begin(self, app: App, base: Station, request: ProvisionRequest, links: LinkSettings) -> ProductionLine | None:
        """Return the line that is asked for, or None; raises UsageError if options do not go together."""


@command(
    "teds-provision provision --profile tactile-finger-sensor --nfc udp:localhost:54321",
    "teds-provision provision --profile magnetic-angular-position-sensor --calibration angle.csv --yes",
    "teds-provision provision --profile load-cell --calibration cell.xml --trust-dcc laboratory.pem",
    "teds-provision provision --watch --yes --profile load-cell --name 'cell {n}'",
    "teds-provision provision --batch boards.csv --report boards.html",
    "teds-provision provision --all --via can --can socketcan:can0 --profile load-cell",
    "teds-provision provision --adopt --nfc usb",
)
@click.argument("uuid", required=False)
@order_options
@click.option("--adopt", is_flag=True, help="Sign the datasheet that the board brought, after showing it.")
@click.option("--watch", is_flag=True, help="Provision board after board until Ctrl-C.")
@click.option(
    "--batch",
    type=FileToRead(),
    metavar="FILE",
    help="Sheet of boards: uuid, name, profile, calibration, item, fingerprint.",
)
@click.option(
    "--report",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Write a report of the batch, .csv or .html.",
)
@click.option("--all", "everything", is_flag=True, help="Provision every whitelisted node on the bus in parallel.")
@click.option("--firmware", type=FileToRead(), metavar="IMAGE", help="Install this firmware first; see: update.")
@click.option(
    "--firmware-key", type=FileToRead(), metavar="PEM", help="Owner's key: check the image's signature first."
)
@click.option(
    "--operator",
    metavar="NAME",
    help="Name of the operator, for --report.",
)
@yes_option
@dry_run_option
@link_options
@pass_app
def provision(
    app: App,
    uuid: str | None,
    order: Any,
    adopt: bool,
    watch: bool,
    batch: Path | None,
    report: Path | None,
    everything: bool,
    firmware: Path | None,
    firmware_key: Path | None,
    operator: str | None,
    yes: bool,
    dry_run: bool,
    links: LinkSettings,
    line: LineChoice | None = None,
) -> None:
    """Identify, whitelist, agree, build, sign, write and verify; continues an earlier run that was stopped.

    --yes accepts the node on the reader. A finished node keeps its datasheet: only what you name (--profile,
    --calibration, --name) changes, or what you confirm after seeing the changes.
    """
    adopt = adopt and bool(options_given("adopt"))  # a setting of that name is for ncap run only
    order = replace(order, choose=app.chooses_item(), adopt=adopt)
    if order.adopt and batch is not None:
        raise UsageError("The sheet already defines what each board gets.", hint="Drop --adopt.")
    request = provisioning.batch.ProvisionRequest(uuid, order, watch, everything, batch, report, operator or "")
    several = everything or len(links.places) > 1
    reporter = BoardReporter(reporter_for(app, several=several))
    base = app.station()
    run = line.begin(app, base, request, links) if line is not None else None
    if run is None and operator and report is None:
        raise UsageError("--operator requires --report.", hint="Add --report FILE.")
    if firmware is not None or firmware_key is not None:
        if firmware is None or dry_run or request.several or run is not None:
            raise UsageError(
                "--firmware installs an image on one board; --firmware-key goes with it.",
                hint="Many boards: whitelist add, agree, update --match EXPR IMAGE, provision. Plan: update --dry-run.",
            )
        image = firmware_image.load_firmware_image(firmware, firmware_key)
        links = replace(links, via_chosen=True)  # the board is tapped for this too, unless a bus was named
        request = replace(request, node=_with_firmware(app, base, links, uuid, image, reporter, yes=yes))
    boards = provisioning.batch.BatchRun(base, links, request, reporter, line=run)
    for warning in boards.warnings:
        app.warn(warning)
    if dry_run and everything:
        _print_plans(app, boards)
    elif dry_run:
        _print_plan(app, boards.plan())
    elif request.several:
        boards.unlock()  # asks for the passphrase before the screen shows instructions
        begun = None if several else reporter  # with several readers, one board may start while another one ends
        with screen_for(app, boards, begun) as screen:
            person = terminal_operator.TerminalOperator(app, yes=yes, strangers=not everything, several=True)
            _many(app, boards, person, screen, totals=everything or batch is not None or boards.of_a_job)
    else:
        _one(app, boards, terminal_operator.TerminalOperator(app, yes=yes))


def _with_firmware(
    app: App,
    base: Station,
    links: LinkSettings,
    node: str | None,
    image: FirmwareImage,
    reporter: Reporter,
    *,
    yes: bool,
) -> str:
    """Key the one board, install firmware on it, and return its UUID."""
    operator = terminal_operator.TerminalOperator(app, yes=yes)
    uuid = provisioning.provision.key_board_at(base, links, node, reporter, operator=operator)
    update = provisioning.update
    order, onward = update.UpdateOrder(image), links.after_agreeing()
    plan = update.plan_update(base, onward, uuid, order, reporter)
    if plan.question:
        if not app.interactive or not app.ask_yes_no(f"{plan.question} Install it all the same?"):
            raise WrongImageError(plan.question, hint=f"update {uuid.hex()} IMAGE --other-board, then provision.")
        order = replace(order, other_board=True)
    if plan.stage != "nothing":
        app.confirm(f"Install {image.version_text} on board {uuid.hex()}?", yes=yes)
        for done in update.update_boards(base, onward, [(uuid, order)], lambda _uuid: reporter):
            if done.error is not None:
                raise done.error
    return uuid.hex()


def _one(app: App, boards: BatchRun, operator: Operator) -> None:
    try:
        done = boards.one(operator)
    except provisioning.build.UnrequestedChangeError as error:
        # With --json the changes are printed with the error, so that a caller can pass them as options.
        changes = [change.text for change in error.changes]
        app.conclude({"changes": changes}, "\n".join(f"  {text}" for text in changes), error)
        return
    except provisioning.adoption.NotAdoptedError as error:
        terminal_operator.show_brought(app, error.datasheet)
        app.conclude({"findings": error.datasheet.findings}, None, error)
        return
    failure = provisioning.batch_sheet.BoardResult(done.who.uuid, 0.0, done).failure
    _print_result(app, done, error=failure, **_of_line(boards, done.who.uuid))


def _of_line(boards: BatchRun, uuid: bytes) -> dict[str, Any]:
    """Return job, unit, attempt and evidence of a board, nothing outside a line."""
    return boards.line.unit_to_json(uuid) if boards.line is not None else {}


def _many(app: App, boards: BatchRun, operator: Operator, screen: Screen, *, totals: bool) -> None:
    signal.signal(signal.SIGTERM, lambda *_: boards.stop.request_stop())
    try:
        for board in boards.many(operator):
            if boards.expected and not app.json:
                _print_one_of(app, boards, board)
            elif not screen.shows_boards:
                _print_board(app, board, warn=not boards.expected, **_of_line(boards, board.uuid))
            screen.ended(board)
    finally:
        screen.close()
        if boards.expected:
            _print_warnings(app, boards)
        if totals:
            _print_totals(app, boards)
    error = boards.totals().error if totals else None
    if error is not None and app.json:
        raise click.exceptions.Exit(error.exit_code)
    if error is not None:
        raise error


# -- printing ----------------------------------------------------------------------------------------------------------


def _print_plan(app: App, plan: ProvisionPlan) -> None:
    changes = "".join(f"\n  {text}" for text in plan.changes) or "\n  no changes"
    text = f"Plan for {plan.uuid.hex()} ({plan.state.name.lower()}): {', '.join(plan.steps)}.{changes}"
    for warning in plan.warnings:
        app.warn(warning)
    result = {
        "uuid": plan.uuid.hex(),
        "state": plan.state.name.lower(),
        "plan": list(plan.steps),
        "changes": list(plan.changes),
        "warnings": list(plan.warnings),
    }
    app.emit(result, text)


def _print_plans(app: App, boards: BatchRun) -> None:
    """Print a plan for each selected node of the bus, and finally their number; the worst refusal ends the command."""
    planned = 0
    for plan in boards.plans():
        if isinstance(plan, provisioning.batch.ProvisionPlan):
            planned += 1
            _print_plan(app, plan)
        else:
            _print_board(app, plan)
    nodes = "1 node" if planned == 1 else f"{planned or 'No'} nodes"
    app.emit({"totals": {"planned": planned, "failed": boards.ended}}, f"{nodes} would be provisioned.")
    if boards.worst is not None:
        raise click.exceptions.Exit(boards.worst.exit_code)


def _print_result(
    app: App, done: ProvisionResult, *, error: TedsProvisionError | None = None, warn: bool = True, **more: object
) -> None:
    """Print one node's result; ``error`` ends the command, ``more`` is on the line of one of many.

    ``warn`` False: its warnings are printed with those of the others.
    """
    for warning in done.warnings if warn else ():
        app.warn(warning)
    units = shown_units(app.station(), done.who.uuid)
    summary = summarise(done.image, units)
    runs = firmware_of(app.station(), done.who.uuid, done.firmware)
    firmware = runs.to_json() if runs is not None else None
    result = {
        "uuid": done.who.uuid.hex(),
        "fingerprint": done.who.fingerprint,
        "name": summary.name,
        "channels": [vars(channel) for channel in summary.channels],
        "steps": [{"name": s.name, "result": s.result, "seconds": s.seconds} for s in done.steps],
        "sample": [
            {key: sample[key] for key in ("channel", "value", "unit", "valid", "shown")} for sample in done.samples
        ],
        "verdict": done.verified.verdict,
        "warnings": list(done.warnings),
        "firmware": firmware,
        **calibration_json(done.certificate),
        **{name: value for name, value in more.items() if value is not None and name != "failure"},
    }
    if more.get("failure") is not None:
        result["error"] = more["failure"]
    app.conclude(
        result,
        lambda console: _summary(console, done, summary, _readings(done, units), more, firmware_words(firmware)),
        error,
    )


def _print_board(app: App, board: BoardResult, *, warn: bool = True, **line: Any) -> None:
    """Print a board's result as a JSON line, or for people: UUID, time and row of the sheet; ``line`` has its unit."""
    if board.done is not None:
        failure = board.failure
        # an authentic board can fail: without a calibration that its type requires, or if a channel read nothing
        if failure is not None:
            line["failure"] = problem_of(failure)
        seconds = round(board.seconds, 3)
        _print_result(app, board.done, warn=warn, row=board.row, time=board.time, seconds=seconds, **line)
        if board.failure is not None and not app.json:
            app.fail_line(board.failure, uuid=board.uuid.hex(), time=local_time(board.time), row=board.row)
    elif board.error is not None:
        of: dict[str, object] = {"uuid": board.uuid.hex(), "time": time_for(app, board.time), "row": board.row}
        if app.json:
            of |= {"seconds": round(board.seconds, 3), **line}
            if isinstance(board.error, provisioning.build.UnrequestedChangeError):
                of["changes"] = [change.text for change in board.error.changes]
        app.fail_line(board.error, **of)


def _print_one_of(app: App, boards: BatchRun, board: BoardResult) -> None:
    """Print one line for one of many on a bus: ``37 of 200  8d4d…  arm 3  authentic  1.2 s``.

    With the reason of a failure.
    """
    name = summarise(board.done.image).name if board.done is not None else None
    words = board.done.verified.verdict if board.result == "passed" and board.done is not None else board.result
    place = f"{boards.ended:>{len(str(boards.expected))}} of {boards.expected}"
    app.lines([sanitize(f"{place}  {board.uuid.hex()}  {name or '(no name)'}  {words}  {board.seconds:.1f} s")])
    if board.failure is not None:
        app.note(f"{board.uuid.hex()}: {board.failure.message}\n  → {board.failure.hint}".removesuffix("\n  → "))


def _print_warnings(app: App, boards: BatchRun) -> None:
    """Print each warning about boards of a bus once, with the boards that have it.

    A board is named by its UUID if it has no name, or shares it as boards do that are named after their type.
    """
    found = boards.board_warnings
    station = app.station() if found else None
    for warning, uuids in found.items():
        if len(uuids) == boards.ended > 1:
            app.warn(f"All {boards.ended} boards: {warning}")
            continue
        known = [station.nodes.get(uuid) for uuid in uuids[:_NAMED]] if station is not None else []
        names = [record.name or "" for record in known if record is not None]
        shown = [
            name if name and names.count(name) == 1 else uuid.hex() for name, uuid in zip(names, uuids, strict=False)
        ]
        more = f" and {len(uuids) - _NAMED} more" if len(uuids) > _NAMED else ""
        app.warn(f"{', '.join(shown)}{more}: {warning}")


def _print_totals(app: App, boards: BatchRun) -> None:
    totals = boards.totals()
    members: dict[str, Any] = {
        "passed": totals.passed,
        "failed": totals.failed,
        "skipped": totals.skipped,
        "seconds": totals.seconds,
        "first_pass": totals.first_pass,
        "steps": totals.steps,
    }
    result: dict[str, Any] = {"totals": members}
    if totals.error is not None:
        result["error"] = problem_of(totals.error)
    share = "" if totals.first_pass is None else f", {totals.first_pass:.1%} at the first attempt"
    steps = "".join(f"\n  {name:<11} {seconds:6.2f} s" for name, seconds in totals.steps.items())
    counts = f"{totals.passed} passed, {totals.failed} failed, {totals.skipped} skipped"
    app.emit(result, f"{counts}{share}, {totals.seconds:.1f} s in total.{steps}")


def _readings(done: ProvisionResult, units: Mapping[int, str]) -> dict[int, str]:
    """Return the readings at the end for people, by channel."""
    sheet = teds.sheet.Sheet.from_image(done.image).shown_in(units)
    valid = {sample["channel"]: sample["value"] for sample in done.samples if sample["valid"]}
    return {own.number: own.show_reading(valid[own.number]) for own in sheet.channels if own.number in valid}


def _summary(
    console: Console,
    done: ProvisionResult,
    summary: NodeSummary,
    readings: Mapping[int, str],
    more: Mapping[str, object],
    firmware: str,
) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_row("node", f"[bold]{escape(summary.name or '(no name)')}[/]")
    table.add_row("UUID", done.who.uuid.hex())
    table.add_row("key", done.who.fingerprint[:16])
    if "unit" in more:
        table.add_row("unit", f"{more['unit']} of {more['of']}")
    for channel in summary.channels:
        calibrated = ", calibrated" if channel.calibrated else ""
        read = readings.get(channel.number)
        reads = f", reads {read}" if read is not None else ""
        facts = f"{channel.range}{calibrated}{reads}".removeprefix(", ")
        what = f"{escape(channel.name)}  {facts}".strip()
        table.add_row(f"channel {channel.number}", what)
    if firmware:
        table.add_row("firmware", escape(firmware))
    if "time" in more:
        table.add_row("time", local_time(str(more["time"])))
    verdict = done.verified.verdict
    table.add_row("verdict", f"[bold {'green' if verdict == 'authentic' else 'red'}]{verdict}[/]")
    print_table(console, table)


# The operator's screen during a batch, readable at two metres: the next action, PASS or FAIL, n of 50, the last five
# boards.

_BELL: Final = "\a"
_LAST: Final = 5
_NAMED: Final = 5
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
    """Return five rows of letters that can be read from afar; characters without a shape are left out."""
    shapes = [_GLYPHS[character].split("|") for character in text.upper() if character in _GLYPHS]
    lines = ["  ".join(shape[row] for shape in shapes) for row in range(_ROWS)]
    return [line.replace("#", "██").replace(" ", "  ") for line in lines]


class BatchState(Protocol):
    """State of the batch as the screen needs it: :class:`BatchRun` is one."""

    def __len__(self) -> int:
        """Return the number of boards on the sheet."""

    @property
    def passed(self) -> int:
        """How many of them have passed."""

    @property
    def next_row(self) -> SheetRow | None:
        """The row that the next board may be of."""

    @property
    def of_a_job(self) -> bool:
        """True if a job counts them, and no sheet: any board may be the next one."""

    def row(self, number: int) -> SheetRow:
        """Return the row of the sheet with this number, counted from 1."""

    def board_of(self, row: SheetRow) -> str | None:
        """Return the UUID of the board that had a row before, None for none."""


class Screen(Protocol):
    """Display of each board's end; ``shows_boards``: nothing else needs to be printed about it."""

    shows_boards: bool

    def ended(self, board: BoardResult) -> None:
        """Show how it ended."""

    def close(self) -> None:
        """Give the terminal back."""


class _NoScreen:
    """No screen: a pipe, --json, --quiet, or no sheet. The bell is for people alone."""

    shows_boards = False

    def ended(self, board: BoardResult) -> None:
        """Do nothing: the line is printed already."""

    def close(self) -> None:
        """Do nothing: there is nothing to close."""


class BoardReporter:
    """A reporter that also reports a new board: its first step is to identify it."""

    def __init__(self, inner: Reporter) -> None:
        self._inner = inner
        self.begun: Callable[[], None] = lambda: None

    def started(self, step: str) -> None:
        """Report the start of a step."""
        if step == "identify":
            self.begun()
        self._inner.started(step)

    def finished(self, step: StepResult) -> None:
        """Report a step that ended well."""
        self._inner.finished(step)

    def notice(self, notice: Notice) -> None:
        """Show that the run waits for something, or that something arrived."""
        self._inner.notice(notice)

    def written(self, octets: int, total: int) -> None:
        """Show how many octets of the datasheet are staged."""
        self._inner.written(octets, total)


class OperatorScreen:
    """Redrawn when a board is begun and when it ends, on stderr; ``live_line`` removes what runs below it."""

    def __init__(self, console: Console, boards: BatchState, live_line: Callable[[], None] = lambda: None) -> None:
        # redirected output gets one line per board, beside the screen on stderr
        self.shows_boards = sys.stdout.isatty()
        self._console, self._boards, self._live_line = console, boards, live_line
        self._last: deque[BoardResult] = deque(maxlen=_LAST)
        self._draw(">>> ", self._next())

    def begun(self) -> None:
        """Clear the previous board's lines: a new board is on the reader."""
        self._draw(">>> ", "KEEP THE BOARD ON THE READER", word=("WAIT", "black on yellow"))

    def ended(self, board: BoardResult) -> None:
        """Ring, and show PASS or FAIL."""
        self._last.appendleft(board)
        self._console.file.write(_BELL)
        word = _WORDS.get(board.result, ("SKIP", "black on yellow"))
        self._draw(">>> TAKE IT OFF. ", self._next(), word=word, board=board)

    def close(self) -> None:
        """Leave the present display."""

    def _draw(
        self, mark: str, now: str, *, word: tuple[str, str] | None = None, board: BoardResult | None = None
    ) -> None:
        from rich.text import Text

        self._live_line()
        console, boards = self._console, self._boards
        air = [""] if console.height >= _ROOMY else []
        console.clear()
        if word is not None:
            for line in [*air, *big(word[0]), *air]:
                console.print(Text(f"    {line}".ljust(console.width)), style=word[1], no_wrap=True)
        if board is not None:
            self._print_end(board)
        for line in ["", *big(f"{boards.passed}/{len(boards)}"), ""]:
            console.print(Text(f"    {line}"), no_wrap=True)
        self._line(f"{mark}{now}", style="bold")
        for end in self._last:
            row = f"row {end.row}" if end.row is not None else ""
            line = f"{_clock(end.time)}  {row:<8} {end.uuid.hex()}  {end.result.upper():<8} {end.seconds:6.1f} s"
            style = "green" if end.result == "passed" else "red"
            self._line(f"{line}  {self._name(end)}", style=style)

    def _print_end(self, board: BoardResult) -> None:
        """Print seconds and board; for one that failed also why, and what to do, in a few lines."""
        from rich.text import Text

        row = f"  row {board.row}" if board.row is not None else ""
        self._line(f"{board.seconds:.1f} s  {board.uuid.hex()}{row}  {self._name(board)}", style="bold")
        if board.failure is not None:
            hint = f" → {board.failure.hint}" if board.failure.hint else ""
            why = Text(sanitize(f"{board.failure.message}{hint}"), style="bold red")
            for line in why.wrap(self._console, self._console.width)[:_WHY_LINES]:
                self._console.print(line)
        elif board.done is not None and board.done.warnings:
            self._line(f"Warning: {board.done.warnings[0]}", style="yellow")

    def _line(self, text: str, *, style: str) -> None:
        """Print one line, cut with an ellipsis at the terminal's edge."""
        from rich.text import Text

        self._console.print(Text(sanitize(text).rstrip()), style=style, no_wrap=True, overflow="ellipsis")

    def _name(self, board: BoardResult) -> str:
        return self._boards.row(board.row).prepared.order.name or "" if board.row is not None else ""

    def _next(self) -> str:
        row = self._boards.next_row
        if row is None and self._boards.of_a_job and self._boards.passed < len(self._boards):
            return "TAP THE NEXT BOARD"
        if row is None:
            return "ALL BOARDS ARE DONE."
        name = row.prepared.order.name or ""
        if row.by_order:
            had = self._boards.board_of(row)
            board = "THE BOARD" if had is None else f"BOARD {had} AGAIN"
            return sanitize(f"TAP {board} FOR ROW {row.number}  {name}".rstrip())
        which = row.uuid.hex() if row.uuid is not None else f"key {(row.fingerprint or '')[:16]}"
        return sanitize(f"TAP ANY BOARD OF THE SHEET, e.g. {which}  {name}".rstrip())


def _clock(moment: str) -> str:
    """Return the local time of day of a moment in UTC."""
    return datetime.fromisoformat(moment).astimezone().strftime("%H:%M:%S")


@contextmanager
def screen_for(app: App, boards: BatchRun, reporter: BoardReporter | None = None) -> Iterator[Screen]:
    """Yield the operator's screen on a terminal with a sheet, else none; ``reporter`` notifies it of each new board."""
    if app.json or app.quiet or not len(boards) or not sys.stderr.isatty():
        yield _NoScreen()
        return
    screen = OperatorScreen(app.console(stderr=True), boards, app.live_line)
    if reporter is not None:
        reporter.begun = screen.begun
    yield screen
