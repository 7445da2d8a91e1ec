"""``nodes``: what this station knows of its nodes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command
from teds_provision.errors import BadData, UsageFailure

if TYPE_CHECKING:
    from rich.console import Console

_COLOURS = {"authentic": "green", None: "dim"}


@command("teds-provision nodes", "teds-provision --json nodes 8d4d")
@click.argument("uuid", required=False)
@click.option(
    "--fits", metavar="EXPR", help='Judge datasheets: "angle >= 360 deg, uncertainty <= 1 deg, rate >= 1 kHz".'
)
@pass_app
def nodes(app: App, uuid: str | None, fits: str | None) -> None:
    """Show every node that this station has met or been given, or all about one.

    UUID may be a prefix of four digits or more, or the node's name. Nothing is asked of the nodes themselves.
    """
    from teds_provision.station.inventory import inventory

    station = app.station()
    if fits is not None:
        _fits(app, fits, [station.nodes.resolve(uuid)] if uuid else [record.uuid for record in station.nodes.all()])
        return
    found = inventory(station, station.nodes.resolve(uuid) if uuid else None)
    app.emit({"nodes": found}, lambda console: _one(console, found[0]) if uuid else _table(console, found))


def _fits(app: App, expression: str, uuids: list[bytes]) -> None:
    from datetime import UTC, datetime

    from teds_provision.steps.fits import fits_of
    from teds_provision.teds.fits import parse_fits

    try:
        requirement = parse_fits(expression)
    except BadData as error:
        raise UsageFailure(f"--fits: {error.message}", hint=error.hint) from error
    found = [fit.to_json() for fit in fits_of(app.station(), [requirement], uuids, datetime.now(UTC))]
    app.emit({"fits": found}, lambda console: _fit_table(console, found))


def _fit_table(console: Console, found: list[dict[str, Any]]) -> None:
    from rich.table import Table
    from rich.text import Text

    from teds_provision.cli.rendering import print_table, shown

    table = Table("UUID", "channel", "result", "why", box=None, pad_edge=False)
    style = {"passed": "green", "failed": "red", "skipped": "dim"}
    for fit in found:
        channel = "" if fit["channel"] is None else f"{fit['channel']} {fit['name']}".strip()
        table.add_row(
            fit["uuid"], Text(shown(channel)), Text(fit["result"], style[fit["result"]]), Text(shown(fit["why"]))
        )
    print_table(console, table)


def _table(console: Console, found: list[dict[str, Any]]) -> None:
    from rich.table import Table
    from rich.text import Text

    from teds_provision.cli.rendering import print_table, shown

    if not found:
        console.print("No node is known yet. Tap one: teds-provision identify --add")
        return
    columns = ("UUID", "name", "state", "epoch", "sequence", "key", "verdict", "remarks")
    table = Table(*columns, box=None, pad_edge=False)
    for node in found:
        table.add_row(
            node["uuid"],
            Text(shown(node["name"])),
            node["state"] or "unseen",
            str(node["epoch"]),
            str(node["sequence"]),
            (node["fingerprint"] or "")[:16],
            Text(node["verdict"] or "", style=_COLOURS.get(node["verdict"], "red")),
            Text(shown(_remarks(node))),
        )
    print_table(console, table)


def _remarks(node: dict[str, Any]) -> str:
    remarks = []
    if node["revoked"]:
        remarks.append(f"revoked: {node['revoked']['why']}")
    if node["moved_to"]:
        remarks.append(f"moved to {node['moved_to']['fingerprint'][:16]}")
    if not node["whitelisted"]:
        remarks.append("not whitelisted")
    if node["holders"]:
        remarks.append("also held by " + ", ".join(holder["fingerprint"][:16] for holder in node["holders"]))
    pending = sum(key["state"] == "pending" for key in node["keys"])
    if pending:
        remarks.append(f"{pending} key{'s' if pending > 1 else ''} pending")
    return "; ".join(remarks)


def _one(console: Console, node: dict[str, Any]) -> None:
    from teds_provision.cli.rendering import shown

    address = f"0x{node['can_address']:02x}" if node["can_address"] else "none"
    keys = [f"{key['key_id']} {key['state']}, epoch {key['epoch']}, {key['created']}" for key in node["keys"]]
    rows = [
        ("UUID", node["uuid"]),
        ("name", node["name"] or ""),
        ("profile", node["profile"] or ""),
        ("state", node["state"] or "unseen"),
        ("epoch", f"{node['epoch']}, sequence {node['sequence']}"),
        ("key", (node["fingerprint"] or "not pinned yet")[:16]),
        ("whitelist", f"yes, assurance {node['assurance']}" if node["whitelisted"] else "no"),
        ("verdict", node["verdict"] or "never verified"),
        ("last seen", node["last_seen"] or "never"),
        ("channels", str(node["channels"])),
        ("CAN address", address),
        ("groups", ", ".join(node["groups"])),
        *(("link key", key) for key in keys or ["none"]),
        ("remarks", _remarks(node)),
    ]
    for title, text in rows:
        if text:
            console.print(f"{title:<12} {shown(text)}", markup=False)
