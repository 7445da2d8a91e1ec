"""``node check``: the rules of the profile against somebody's board."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from teds_provision import check as check_room
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, dry_run_option, link_options, yes_option
from teds_provision.cli.rendering import print_table, reporter_for
from teds_provision.errors import NotAuthentic, TedsProvisionError
from teds_provision.links import LinkSettings

if TYPE_CHECKING:
    from rich.console import Console

    from teds_provision.check.run import Report


@command(
    "teds-provision node check --nfc udp:localhost:54321",
    "teds-provision node check --factory --yes --via can --can udp_multicast:239.74.163.2",
)
@click.option(
    "--factory",
    is_flag=True,
    help="Key, write and reset the node too; it ends in factory state. One of ours loses its key.",
)
@yes_option
@dry_run_option
@link_options
@pass_app
def check(app: App, factory: bool, yes: bool, dry_run: bool, links: LinkSettings) -> None:
    """Run the rules of the profile against a board.

    Each ends as passed, failed or skipped, with its clause and what was seen.

    A node of another owner is left alone (6). Keys change only with --factory: a factory node, or one of this
    station's, is then keyed, written and reset.
    Exits 4 where a rule failed, 5 where no node is, or it fell silent.
    """
    station = app.station()
    if dry_run:
        plan = "key, write and reset the node, then every rule" if factory else "the rules that change no key"
        app.emit({"plan": plan}, f"Plan: {plan}.")
        return
    if factory:
        app.confirm(
            "Key, write and reset the node that is met? If it is one of yours its key and datasheet go.", yes=yes
        )
    report = check_room.run.check_at(station, links, reporter_for(app), factory=factory)
    counts = {result: report.count(result) for result in ("passed", "failed", "skipped")}
    checks = [
        {"rule": each.rule, "clause": each.clause, "result": each.result, "detail": each.detail}
        for each in report.checks
    ]
    broken = [each.rule for each in report.checks if each.result == "failed"]
    error: TedsProvisionError | None = report.lost
    if broken:
        count = "a rule" if len(broken) == 1 else f"{len(broken)} rules"
        error = NotAuthentic(f"The node breaks {count}: {', '.join(broken)}.", hint=_silent(report))
    app.conclude(
        {"uuid": report.uuid.hex(), "checks": checks, **counts}, lambda console: _table(console, report), error
    )


def _silent(report: Report) -> str:
    return "" if report.lost is None else f"{report.lost.message} What comes after it was not tried."


def _table(console: Console, report: Report) -> None:
    from rich.markup import escape
    from rich.table import Table

    style = {"passed": "green", "failed": "bold red", "skipped": "dim"}
    table = Table("rule", "result", "clause", "seen", box=None, pad_edge=False)
    for each in report.checks:
        table.add_row(each.rule, f"[{style[each.result]}]{each.result}[/]", each.clause, escape(each.detail))
    print_table(console, table)
    counts = ", ".join(f"{report.count(result)} {result}" for result in style)
    console.print(f"{report.uuid.hex()}: {counts}")
