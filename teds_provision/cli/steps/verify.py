"""``verify``: everything that the profile demands, check by check, with one verdict."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from teds_provision.cli import steps as steps_cli
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, link_options, said_here
from teds_provision.cli.rendering import print_table, reporter_for
from teds_provision.errors import UsageFailure
from teds_provision.links import LinkSettings
from teds_provision.steps import visits

if TYPE_CHECKING:
    from rich.console import Console

    from teds_provision.steps.verify import Verified


@command(
    "teds-provision verify 8d4d --nfc udp:localhost:54321",
    "teds-provision verify signed.json",
    "teds-provision --json verify datasheets/",
)
@click.argument("what", metavar="UUID|IMAGE…|DIR", nargs=-1, required=True)
@click.option("--accept-calibration", metavar='"WHY"', help="Take a calibration that the guard refuses; logged.")
@link_options
@pass_app
def verify(app: App, what: tuple[str, ...], links: LinkSettings, accept_calibration: str | None) -> None:
    """Read a node (or an image file) and check its datasheet; a node must also sign a fresh challenge.

    A file is judged alone; with --can, --nfc or --ble here a node's name goes before that of a file or folder.
    A node whose key is held here must open a session, else nothing is proven.
    Several files, or a folder, give a line each and at last the totals; on every core.
    Exits 0 for "authentic", 4 for "unsigned" and "not authentic", 5 for "unproven", 6 for a harmful calibration;
    of several the worst.
    """
    node = len(what) == 1 and bool(said_here("via", "nfc", "can", "ble"))
    if not node and steps_cli.verify_files.are_files(what):
        if accept_calibration is not None:
            raise UsageFailure("--accept-calibration is for one image.", hint="Verify that one by itself.")
        steps_cli.verify_files.verify_many(app, what)
        return
    done = visits.at_node.verify_at(
        app.station(), links, what[0], reporter_for(app), accept_calibration=accept_calibration, node=node
    )
    verified = done.verified
    result = {
        "uuid": verified.uuid.hex(),
        "scope": verified.scope,
        "verdict": verified.verdict,
        "checks": [check.to_json() for check in verified.checks],
        "warnings": list(done.warnings),
    }
    for warning in done.warnings:
        app.warn(warning)
    app.conclude(result, lambda console: _table(console, verified), done.error)


def _table(console: Console, verified: Verified) -> None:
    from rich.markup import escape
    from rich.table import Table

    style = {"passed": "green", "failed": "bold red", "skipped": "dim"}
    table = Table("check", "result", "found", box=None, pad_edge=False)
    for check in verified.checks:
        table.add_row(check.name, f"[{style[check.result]}]{check.result}[/]", escape(check.why))
    print_table(console, table)
    colour = "bold green" if verified.verdict == "authentic" else "bold red"
    console.print(f"[{colour}]{verified.uuid.hex()}: {verified.verdict}[/]")
