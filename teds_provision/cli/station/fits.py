"""``nodes --fits``: whether datasheets suffice for a task."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from teds_provision import steps, teds
from teds_provision.cli.context import App
from teds_provision.cli.rendering import print_table, shown
from teds_provision.errors import BadData, UsageFailure

if TYPE_CHECKING:
    from rich.console import Console

    from teds_provision.station.station import Station


def show_fits(app: App, station: Station, expression: str, uuids: list[bytes]) -> None:
    """Tell for every channel of these nodes whether it meets ``expression``, and why not."""
    try:
        requirement = teds.fits.parse_fits(expression)
    except BadData as error:
        raise UsageFailure(f"--fits: {error.message}", hint=error.hint) from error
    found = [fit.to_json() for fit in steps.many.fits.fits_of(station, [requirement], uuids, datetime.now(UTC))]
    app.emit({"fits": found}, lambda console: _table(console, found))


def _table(console: Console, found: list[dict[str, Any]]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table("UUID", "channel", "result", "why", box=None, pad_edge=False)
    style = {"passed": "green", "failed": "red", "skipped": "dim"}
    for fit in found:
        channel = "" if fit["channel"] is None else f"{fit['channel']} {fit['name']}".strip()
        table.add_row(
            fit["uuid"], Text(shown(channel)), Text(fit["result"], style[fit["result"]]), Text(shown(fit["why"]))
        )
    print_table(console, table)
