"""``verify``: everything that the profile demands, check by check, with one verdict."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, link_options
from teds_provision.errors import TedsProvisionError
from teds_provision.links import LinkSettings

if TYPE_CHECKING:
    from rich.console import Console

    from teds_provision.station.station import Station
    from teds_provision.steps.verify import Verified
    from teds_provision.teds.image import Image


@command("teds-provision verify 8d4d --nfc udp:localhost:54321", "teds-provision verify signed.json")
@click.argument("what", metavar="UUID|IMAGE")
@click.option("--accept-calibration", metavar='"WHY"', help="Take a calibration that the guard refuses; logged.")
@link_options
@pass_app
def verify(app: App, what: str, links: LinkSettings, accept_calibration: str | None) -> None:
    """Read a node (or an image file) and check its datasheet; a node must also sign a fresh challenge.

    A file is judged alone. A node whose key is held here must open a session, else nothing is proven.
    Exits 0 for "authentic", 4 for "unsigned" and "not authentic", 5 for "unproven", 6 for a harmful calibration.
    """
    from teds_provision.cli.steps.build import read_file
    from teds_provision.steps.verify import Verified, verify_image
    from teds_provision.teds.image import Image

    station = app.station()
    path = Path(what)
    if path.is_file():
        image = Image.from_json(read_file(path))
        verified = Verified(image.uuid, tuple(verify_image(station, image)), scope="image")
    else:
        image, verified = _node(app, what, links)
    result = {
        "uuid": verified.uuid.hex(),
        "scope": verified.scope,
        "verdict": verified.verdict,
        "checks": [{"name": check.name, "result": check.result, "why": check.why} for check in verified.checks],
    }
    warnings, error = _judged(station, image, verified, accept_calibration)
    for warning in warnings:
        app.warn(warning)
    app.conclude(result | {"warnings": list(warnings)}, lambda console: _table(console, verified), error)


def _judged(
    station: Station, image: Image, verified: Verified, accepted: str | None
) -> tuple[tuple[str, ...], TedsProvisionError | None]:
    """Warnings, and what the verification ends with: not authentic (4), or a calibration that would hurt (6)."""
    from teds_provision.steps.build import guard
    from teds_provision.steps.verify import require_authentic

    try:
        require_authentic(verified)
        return guard(station, image, None, accepted), None
    except TedsProvisionError as error:
        return (), error


def _node(app: App, what: str, links: LinkSettings) -> tuple[Image, Verified]:
    from teds_provision.cli.rendering import reporter_for
    from teds_provision.steps.identify import identify
    from teds_provision.steps.verify_node import look_at_node
    from teds_provision.talk.meeting import meet

    station = app.station()
    uuid = station.nodes.resolve(what)
    with meet(station, links, uuid, reporter_for(app), before=lambda: station.unlock(uuid)) as node:
        who = identify(station, node)
        with station.lock("verify", app.note):
            looked = look_at_node(station, node, who)
    return looked.image, looked.verified


def _table(console: Console, verified: Verified) -> None:
    from rich.markup import escape
    from rich.table import Table

    from teds_provision.cli.rendering import print_table

    style = {"passed": "green", "failed": "bold red", "skipped": "dim"}
    table = Table("check", "result", "found", box=None, pad_edge=False)
    for check in verified.checks:
        table.add_row(check.name, f"[{style[check.result]}]{check.result}[/]", escape(check.why))
    print_table(console, table)
    colour = "bold green" if verified.verdict == "authentic" else "bold red"
    console.print(f"[{colour}]{verified.uuid.hex()}: {verified.verdict}[/]")
