"""``update``: new firmware for one board or many, over the session that their keys seal."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Final

import click

from teds_provision import firmware_image, measure, provisioning
from teds_provision.cli.context import App, Station, pass_app
from teds_provision.cli.options import (
    FileToRead,
    Number,
    WholeNumber,
    command,
    dry_run_option,
    link_options,
    yes_option,
)
from teds_provision.cli.rendering import reporter_for
from teds_provision.errors import UsageError, WrongImageError
from teds_provision.links import LinkSettings, Notice
from teds_provision.provisioning.progress import NodeReporter, Reporter, SilentReporter
from teds_provision.shapes.problem import problem_of

if TYPE_CHECKING:
    from rich.live import Live

    from teds_provision.provisioning.update import BoardUpdate, UpdateOrder, UpdatePlan

_WORST_FIRST: Final = (4, 6, 5)
"""Exit codes of boards, the worst first; any other one is less than these."""
_SLOW: Final = 3_000
"""Octets a second below which a link is called slow."""


@command(
    "teds-provision update 8d4d zephyr.signed.bin --can socketcan:can0",
    "teds-provision update 8d4d finger-1.4.0.bin --key owner.pem --dry-run --can udp_multicast:239.74.163.2",
    "teds-provision update --match type:load-cell finger-1.4.0.bin --parallel 4 --yes --can socketcan:can0",
)
@click.argument("uuids", metavar="UUID…", nargs=-1)
@click.argument("image", metavar="IMAGE", type=FileToRead())
@click.option("--key", type=FileToRead(), metavar="PEM", help="Owner's key: check the image's signature first.")
@click.option("--match", metavar="EXPR", help="Update every known node that matches: type:, name:, group:, bounds.")
@click.option(
    "--parallel", type=WholeNumber(1, 24), default=1, show_default=True, metavar="N", help="Boards updated at once."
)
@click.option(
    "--wait",
    type=Number(1, 3600),
    default=180,
    show_default=True,
    metavar="SECONDS",
    help="How long a restarted board may take to come back.",
)
@click.option("--allow-downgrade", is_flag=True, help="Install an older version, too.")
@click.option("--other-board", is_flag=True, help="Install an image that names another board, or none.")
@yes_option
@dry_run_option
@link_options
@pass_app
def update(
    app: App,
    uuids: Sequence[str],
    image: Path,
    key: Path | None,
    match: str | None,
    parallel: int,
    wait: float,
    allow_downgrade: bool,
    other_board: bool,
    yes: bool,
    dry_run: bool,
    links: LinkSettings,
) -> None:
    """Install an MCUboot image over the session, restart the board, and keep the image only if it proves itself.

    The board's boot loader checks the owner's signature and runs the new image once, on trial. If anything fails, the
    old image runs again, with keys and datasheet as they were; the same command resumes.
    """
    if bool(uuids) == (match is not None):
        raise UsageError("update needs UUIDs or --match EXPR.", hint="Name the boards, or select them; not both.")
    _require_image_last(uuids, image)
    firmware = firmware_image.load_firmware_image(image, key)
    station = app.station()
    boards = (
        measure.matching.known_nodes(station, match)
        if match is not None
        else [station.nodes.resolve(uuid) for uuid in uuids]
    )
    boards = list(dict.fromkeys(boards))
    for uuid in boards:
        station.policy.require_whitelisted(uuid)
    station.unlock()
    links = links.after_agreeing()
    order = provisioning.update.UpdateOrder(firmware, wait, allow_downgrade, other_board)
    planned, ended = _look(app, station, links, boards, order)
    if dry_run:
        for plan in planned:
            _print_plan(app, plan, order)
        if len(boards) > 1:
            _print_planned_totals(app, planned, ended)
        _conclude(app, ended)
        return
    orders = _asked(app, planned, order, yes=yes, ended=ended)
    _update(app, station, links, orders, ended, parallel)


def _require_image_last(uuids: Sequence[str], image: Path) -> None:
    """Raise UsageError if a file is given in place of a board, and the last argument is no file."""
    files = [uuid for uuid in uuids if Path(uuid).is_file()]
    if files and not image.exists():
        boards = " ".join(quote(word) for word in (*(uuid for uuid in uuids if uuid not in files), str(image)))
        raise UsageError(
            f"{files[0]} is a file, and {image} is none: the image comes last.",
            hint=f"teds-provision update {boards} {quote(files[0])}",
        )


def _look(
    app: App, station: Station, links: LinkSettings, boards: Sequence[bytes], order: UpdateOrder
) -> tuple[list[UpdatePlan], list[BoardUpdate]]:
    """Return a plan for each board, and the boards that may not be updated; a line was printed for those."""
    reporter = reporter_for(app, several=len(boards) > 1)
    planned: list[UpdatePlan] = []
    refused: list[BoardUpdate] = []
    for uuid in boards:
        of = NodeReporter(reporter, uuid.hex()) if len(boards) > 1 else reporter
        plan = provisioning.update.plan_or_refusal(station, links, uuid, order, of)
        if isinstance(plan, provisioning.update.BoardUpdate):
            refused.append(plan)
            _print_board_update(app, plan, order)
        else:
            planned.append(plan)
    return planned, refused


def _asked(
    app: App, planned: Sequence[UpdatePlan], order: UpdateOrder, *, yes: bool, ended: list[BoardUpdate]
) -> list[tuple[bytes, UpdateOrder]]:
    """Ask what a person must answer, and return an order for each board that may be updated."""
    orders: list[tuple[bytes, UpdateOrder]] = []
    for plan in planned:
        allowed = order
        if plan.question and not order.other_board:
            hint = "If it is the right one all the same: --other-board"
            if not app.interactive or not app.ask_yes_no(f"{plan.question} Install it all the same?"):
                refused = WrongImageError(plan.question, hint=hint)
                board = provisioning.update.BoardUpdate(
                    plan.uuid, "refused", provisioning.update.version_of(plan.report), 0, 0.0, refused
                )
                ended.append(board)
                _print_board_update(app, board, order)
                continue
            allowed = replace(order, other_board=True)
        orders.append((plan.uuid, allowed))
    asked = {uuid for uuid, _ in orders}
    at_work = [plan for plan in planned if plan.stage != "nothing" and plan.uuid in asked]
    if at_work and not app.json:
        for plan in at_work:
            app.note(_plan_text(plan, order))
    if at_work:
        boards = "1 board" if len(at_work) == 1 else f"{len(at_work)} boards"
        app.confirm(f"Install {order.image.version_text} on {boards}?", yes=yes)
    return orders


def _update(
    app: App,
    station: Station,
    links: LinkSettings,
    orders: Sequence[tuple[bytes, UpdateOrder]],
    ended: list[BoardUpdate],
    parallel: int,
) -> None:
    began = time.monotonic()
    several = len(orders) + len(ended) > 1
    table = _ProgressTable(app, [uuid for uuid, _ in orders]) if several and _shows(app) else None
    lines = reporter_for(app, several=several)

    def reporter_of(uuid: bytes) -> Reporter:
        if table is not None:
            return table.reporter_of(uuid)
        return NodeReporter(lines, uuid.hex()) if several else lines

    try:
        for board in provisioning.update.update_boards(station, links, orders, reporter_of, parallel=parallel):
            ended.append(board)
            if table is not None:
                table.ended(board)
            else:
                _print_board_update(app, board, orders[0][1])
    finally:
        if table is not None:
            table.close()
    _print_totals(app, ended, time.monotonic() - began)
    _conclude(app, ended)


def _shows(app: App) -> bool:
    return not app.json and not app.quiet and app.console(stderr=True).is_terminal


def _conclude(app: App, ended: Sequence[BoardUpdate]) -> None:
    """End with the exit code of the worst board."""
    errors = [board.error for board in ended if board.error is not None]
    if not errors:
        return
    rank = {code: place for place, code in enumerate(_WORST_FIRST)}
    worst = min(errors, key=lambda error: rank.get(error.exit_code, len(rank)))
    raise click.exceptions.Exit(worst.exit_code)


# -- printing ----------------------------------------------------------------------------------------------------------


def _to_json(board: BoardUpdate, order: UpdateOrder) -> dict[str, Any]:
    result: dict[str, Any] = {
        "uuid": board.uuid.hex(),
        "from": board.before,
        "to": order.image.version_text,
        "image": order.image.digest.hex(),
        "octets": board.octets,
        "seconds": round(board.seconds, 3),
        "result": board.result,
    }
    if board.error is not None:
        result["error"] = problem_of(board.error)
    return result


def _print_board_update(app: App, board: BoardUpdate, order: UpdateOrder) -> None:
    if app.json:
        app.emit(_to_json(board, order))
    elif board.error is not None:
        app.fail_line(board.error, uuid=board.uuid.hex())
    else:
        before = f"{board.before} → " if board.result == "updated" else ""
        text = f"{board.uuid.hex()}  {before}{order.image.version_text}  {board.result}  {board.seconds:.1f} s"
        app.emit({}, text)


def _print_totals(app: App, ended: Sequence[BoardUpdate], seconds: float) -> None:
    counted = Counter(board.result for board in ended)
    totals: dict[str, Any] = {name: counted[name] for name in provisioning.update.RESULTS}
    words = ", ".join(f"{count} {name}" for name, count in totals.items() if count)
    app.emit({"totals": totals | {"seconds": round(seconds, 3)}}, f"{words or 'nothing to do'} in {seconds:.1f} s")


def _print_planned_totals(app: App, planned: Sequence[UpdatePlan], ended: Sequence[BoardUpdate]) -> None:
    """Print what a dry run found, of all boards."""
    counted = Counter(board.result for board in ended) + Counter(_planned(plan) for plan in planned)
    totals = {name: counted[name] for name in ("planned", *provisioning.update.RESULTS)}
    octets, seconds = sum(plan.octets for plan in planned), sum(plan.seconds for plan in planned)
    words = ", ".join(f"{count} {name}" for name, count in totals.items() if count)
    result = {"totals": totals | {"octets": octets, "seconds": round(seconds, 1)}}
    app.emit(result, f"{words}; {octets} octets, about {seconds:.0f} s one board after the other")


def _planned(plan: UpdatePlan) -> str:
    return "already" if plan.stage == "nothing" else "planned"


def _print_plan(app: App, plan: UpdatePlan, order: UpdateOrder) -> None:
    result = {
        "uuid": plan.uuid.hex(),
        "plan": plan.stage,
        "from": provisioning.update.version_of(plan.report),
        "to": order.image.version_text,
        "image": order.image.digest.hex(),
        "octets": plan.octets,
        "seconds": round(plan.seconds, 1),
        "interrupts": list(plan.interrupts),
        **({"question": plan.question} if plan.question else {}),
    }
    app.emit(result, _plan_text(plan, order))


_STAGES: Final = {
    "upload": "install",
    "restart": "restart with",
    "prove": "prove and keep",
    "nothing": "nothing to do, it runs",
}


def _plan_text(plan: UpdatePlan, order: UpdateOrder) -> str:
    before, image = provisioning.update.version_of(plan.report), order.image
    lines = [f"Plan for {plan.uuid.hex()}: {_STAGES[plan.stage]} {image.version_text} (image {image.digest.hex()})."]
    if plan.stage != "nothing":
        lines.append(f"  now: {before}, {plan.report.text or 'no name'}")
    if plan.octets:
        slow = "; this link is slow, keep the board where it is" if plan.octets / plan.seconds < _SLOW else ""
        lines.append(f"  {plan.octets} octets, about {plan.seconds:.0f} s if nothing else uses the link{slow}")
    lines += [f"  interrupts the measurement by {holder}" for holder in plan.interrupts]
    if plan.question:
        lines.append(f"  {plan.question}")
    return "\n".join(lines)


class _ProgressTable:
    """A live table on stderr: a row for each board, with what it does and how far it is."""

    def __init__(self, app: App, boards: Sequence[bytes]) -> None:
        from rich.live import Live

        self._rows: dict[bytes, tuple[str, str]] = dict.fromkeys(boards, ("waits", ""))
        self._lock = threading.Lock()
        self._live: Live = Live(
            get_renderable=self._render, console=app.console(stderr=True), refresh_per_second=4, transient=False
        )
        self._live.start()
        app.live_line = self.close

    def reporter_of(self, uuid: bytes) -> Reporter:
        """Return the receiver of a board's progress."""
        return _RowReporter(lambda doing, detail: self._put(uuid, doing, detail))

    def ended(self, board: BoardUpdate) -> None:
        """Show how a board ended."""
        why = f"{board.error.message} {board.error.hint}" if board.error is not None else f"{board.seconds:.1f} s"
        self._put(board.uuid, board.result, why)

    def close(self) -> None:
        """End the display; the last table stays on the screen."""
        self._live.stop()

    def _put(self, uuid: bytes, doing: str, detail: str) -> None:
        with self._lock:
            self._rows[uuid] = (doing, detail)

    def _render(self) -> Any:
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, pad_edge=False)
        for title in ("board", "", ""):
            table.add_column(title)
        with self._lock:
            rows = list(self._rows.items())
        for uuid, (doing, detail) in rows:
            table.add_row(uuid.hex(), doing, Text(detail))
        done = sum(doing in provisioning.update.RESULTS for _, (doing, _) in rows)
        table.add_row("", f"{done} of {len(rows)}", "")
        return table


class _RowReporter(SilentReporter):
    """The progress of one board in its row."""

    def __init__(self, put: Callable[[str, str], None]) -> None:
        self._put = put

    def started(self, step: str) -> None:
        """Show the step."""
        self._put(step, "")

    def notice(self, notice: Notice) -> None:
        """Show what is waited for."""
        if notice.kind == "retry":
            self._put("waits", notice.text)

    def written(self, octets: int, total: int) -> None:
        """Show how much is on the board."""
        self._put("upload", f"{100 * octets // total:>3} %")
