"""``nodes``: what this station knows of its nodes, as a table, CSV or JSON; streamed, so a big list costs little."""

from __future__ import annotations

import csv
import shutil
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final, Protocol

import click

from teds_provision import provisioning, teds
from teds_provision.cli.context import App, Console, pass_app
from teds_provision.cli.options import WholeNumber, command
from teds_provision.cli.rendering import (
    FIRMWARE_CHANGED,
    firmware_words,
    local_time,
    moment,
    print_json_list,
    print_table,
    shown,
)
from teds_provision.errors import BadDataError, NotFoundError, UsageError
from teds_provision.optional_rooms import Hook
from teds_provision.provisioning.inventory import STATES, inventory, search
from teds_provision.sanitize import by_name
from teds_provision.station.label import label_of, write_label
from teds_provision.station.station import Station


class NodeView(Protocol):
    """Facts that an optional room adds about nodes."""

    def named(self, station: Station, text: str) -> list[bytes]:
        """Return the one node that the room knows by this name, empty if none; raises NotFoundError, UsageError."""

    def described(self, station: Station, nodes: Iterator[dict[str, Any]]) -> Iterator[dict[str, Any]]:
        """Yield each node with what the room adds to it."""


NODE_VIEWS: Final[Hook[NodeView]] = Hook("cli.node.views")
_FIRST = 200  # column widths are computed from this many rows
_NAME_COLUMNS = 24
_GAP = "  "


@command("teds-provision nodes", "teds-provision nodes finger --state provisioned", "teds-provision --json nodes 8d4d")
@click.argument("text", required=False, metavar="[UUID|TEXT]")
@click.option("--state", type=click.Choice(STATES), help="Show only nodes in this state.")
@click.option("--profile", metavar="P", help="Show only nodes of this type.")
@click.option("--group", metavar="G", help="Show only nodes in this group.")
@click.option(
    "--due",
    type=WholeNumber(min=0, max=36500),
    metavar="DAYS",
    help="Show only nodes whose calibration expires within DAYS, or has expired.",
)
@click.option("--since", metavar="TIME", help="Show only nodes seen since: ISO 8601, today, or 2h, 3d.")
@click.option(
    "--fits", metavar="EXPR", help='Check datasheets: "angle >= 360 deg, uncertainty <= 1 deg, rate >= 1 kHz".'
)
@click.option("--format", "form", type=click.Choice(["table", "csv", "json"]), help="Default: table.")
@pass_app
def nodes(
    app: App,
    text: str | None,
    state: str | None,
    profile: str | None,
    group: str | None,
    due: int | None,
    since: str | None,
    fits: str | None,
    form: str | None,
) -> None:
    """List every node that this station has met, whitelisted or received, or show one in detail.

    TEXT matches any part of UUID, name or profile; a full UUID or an exact name shows that node. The nodes themselves
    are not contacted.
    """
    station = app.station()
    day = (datetime.now(UTC) + timedelta(days=due)).strftime("%Y-%m-%d") if due is not None else None
    seen = moment(since) if since is not None else None
    try:
        found = search(station, text, state=state, profile=profile, group=group, due=day, since=seen)
    except NotFoundError:
        found = [] if text is None or any((state, profile, group, due, since)) else _named_elsewhere(station, text)
        if not found:
            raise
    if fits is not None:
        show_fits(app, station, fits, found)
        return
    if len(found) > 1 and not app.json and form in (None, "table"):  # output for scripts remains sorted by UUID
        names = station.nodes.names()
        found = sorted(found, key=lambda uuid: by_name(names.get(uuid), uuid.hex()))
    described = _with_views(station, (node.to_json() for node in inventory(station, found)))
    if app.json or form == "json":
        print_json_list("nodes", described)
    elif form == "csv":
        writer = csv.writer(sys.stdout, lineterminator="\n")
        writer.writerow((*_FIELDS, "remarks"))
        for node in described:
            row = [node[name] for name in _FIELDS]
            writer.writerow([shown(value) if isinstance(value, str) else value for value in (*row, _remarks(node))])
    elif not found:
        known = bool(search(station))
        print("No known node matches." if known else "No nodes are known yet.", end=" ")
        print("To list all: teds-provision nodes" if known else "To add one by tap: teds-provision identify --add")
    elif text is not None and len(found) == 1:
        _one(next(described))
    else:
        _table(described)


def _named_elsewhere(station: Station, text: str) -> list[bytes]:
    """Return the known node that only an optional room knows by this name; empty if there is none."""
    return next(filter(None, (view.named(station, text) for view in NODE_VIEWS.parts())), [])


def _with_views(station: Station, described: Iterator[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Add to each node what optional rooms know about it."""
    for view in NODE_VIEWS.parts():
        described = view.described(station, described)
    return described


_FIELDS = (
    "uuid", "name", "profile", "state", "epoch", "sequence", "fingerprint", "whitelisted", "assurance", "verdict",
    "last_seen", "due", "channels", "can_address", "group", "retired",
)  # fmt: skip


# Title, the function that makes a cell, and the order in which columns are dropped on a narrow terminal (0: never).
_COLUMNS: tuple[tuple[str, Callable[[dict[str, Any]], str], int], ...] = (
    ("UUID", lambda node: node["uuid"], 0),
    ("name", lambda node: _cut(shown(node["name"]), _NAME_COLUMNS), 1),
    ("state", lambda node: node["state"] or "unseen", 2),
    ("verdict", lambda node: node["retired"] or node["verdict"] or "", 3),
    ("profile", lambda node: node["profile"] or "", 6),
    ("epoch", lambda node: str(node["epoch"]), 8),
    ("sequence", lambda node: str(node["sequence"]), 9),
    ("due", lambda node: node["due"] or "", 5),
    ("key", lambda node: (node["fingerprint"] or "")[:16], 7),
    ("remarks", lambda node: shown(_remarks(node)), 4),
)


def _table(described: Iterator[dict[str, Any]]) -> None:
    """Print a line per node as it is read. The first rows decide the widths; a narrow terminal gets fewer columns."""
    head = list(islice(described, _FIRST))
    widths = [max(len(title), *(len(cell(node)) for node in head)) for title, cell, _ in _COLUMNS]
    kept = _fitting(widths)
    columns = [(*_COLUMNS[number][:2], widths[number]) for number in kept]
    limit = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    lines = chain(
        [_GAP.join(title.ljust(width) for title, _, width in columns)],
        (_GAP.join(cell(node).ljust(width) for _, cell, width in columns) for node in chain(head, described)),
    )
    sys.stdout.writelines(f"{_cut(shown(line.rstrip()), limit)}\n" for line in lines)
    sys.stdout.flush()


def _fitting(widths: list[int]) -> list[int]:
    """Return the numbers of the columns that fit side by side; the least important are left out first, a UUID never."""
    kept = list(range(len(widths)))
    if not sys.stdout.isatty():
        return kept
    room = shutil.get_terminal_size().columns
    remarks = len(_COLUMNS) - 1
    while len(kept) > 1:
        # The last column may be cut at the edge if enough of it can be read.
        needed = sum(min(widths[number], 24) if number == remarks else widths[number] for number in kept)
        if needed + len(_GAP) * (len(kept) - 1) <= room:
            break
        kept.remove(max(kept, key=lambda number: _COLUMNS[number][2]))
    return kept


def _cut(text: str, limit: int | None) -> str:
    return text if limit is None or len(text) <= limit else f"{text[: limit - 1]}…"


def _remarks(node: dict[str, Any]) -> str:
    remarks = []
    if node["wrapped"]:
        remarks.append(f"wrapped: {node['wrapped']['name']} ({node['wrapped']['kind']})")
    if node["firmware"] and node["firmware"]["state"] in ("bad", "other", "outdated", "not-reported"):
        remarks.append(f"firmware {node['firmware']['state']}")
    if node["firmware"] and node["firmware"]["changed"]:
        remarks.append(FIRMWARE_CHANGED)
    if node["revoked"]:
        remarks.append(f"revoked: {node['revoked']['why']}")
    if node["moved_to"]:
        remarks.append(f"moved to {node['moved_to']['fingerprint'][:16]}")
    if not node["whitelisted"]:
        remarks.append("not whitelisted")
    if node["rotation_due"]:
        remarks.append("rotation due")
    if node["holders"]:
        remarks.append("also held by " + ", ".join(holder["fingerprint"][:16] for holder in node["holders"]))
    pending = sum(key["state"] == "pending" for key in node["keys"])
    if pending:
        remarks.append(f"{pending} key{'s' if pending > 1 else ''} pending")
    return "; ".join(remarks)


def _verdict(node: dict[str, Any]) -> str:
    """Return the verdict and its basis; for a retired node, the reason comes first."""
    read, retired = node["reading"], node["retired"]
    if read is None:
        return retired or node["verdict"] or "never verified"
    how = {
        "session": "read in a session",
        "kept": "Security TEDS read in a session, the rest from the stored copy",
        "plain": "read without a session",
    }
    verdict = f"{node['verdict']} ({how[read['from']]} {local_time(read['at'])}, by {read['by']})"
    return f"{retired}; {verdict}" if retired else verdict


def _charge(charging: dict[str, Any] | None) -> str:
    """Return the node's last charge report; unauthenticated."""
    return f"{shown(charging['text'])} (reported by the node at {local_time(charging['at'])})" if charging else ""


def _link_keys(node: dict[str, Any]) -> list[str]:
    keys = [
        f"{key['key_id']} {key['state']}, epoch {key['epoch']}, {local_time(key['created'])}" for key in node["keys"]
    ]
    return keys or ["none"]


# Title and text of each line about one node; empty lines are left out, and a list gives one line per element.
_LINES: tuple[tuple[str, Callable[[dict[str, Any]], str | list[str]]], ...] = (
    ("UUID", lambda node: node["uuid"]),
    ("name", lambda node: node["name"] or ""),
    ("profile", lambda node: node["profile"] or ""),
    ("state", lambda node: node["state"] or "unseen"),
    ("epoch", lambda node: f"{node['epoch']}, sequence {node['sequence']}"),
    ("key", lambda node: (node["fingerprint"] or "not pinned yet")[:32]),
    ("whitelist", lambda node: f"yes, assurance {node['assurance']}" if node["whitelisted"] else "no"),
    ("verdict", _verdict),
    ("firmware", lambda node: firmware_words(node["firmware"])),
    ("last seen", lambda node: local_time(node["last_seen"]) if node["last_seen"] else "never"),
    ("calibration", lambda node: f"due {node['due']}" if node["due"] else ""),
    ("charging", lambda node: _charge(node["charging"])),
    ("channels", lambda node: str(node["channels"])),
    ("CAN address", lambda node: f"0x{node['can_address']:02x}" if node["can_address"] else "none"),
    ("groups", lambda node: ", ".join(node["groups"])),
    ("link key", _link_keys),
    ("rotation", lambda node: node["rotation_due"] or ""),
    ("conflict", lambda node: [f"{conflict['name']}: {conflict['why']}" for conflict in node.get("conflicts", ())]),
    ("remarks", _remarks),
)


def _one(node: dict[str, Any]) -> None:
    for title, text_of in _LINES:
        found = text_of(node)
        for text in [found] if isinstance(found, str) else found:
            if text:
                print(f"{title:<12} {shown(text)}")


# ``label``: QR code and text for a board.


@command("teds-provision label 8d4d --output finger-1.svg", "teds-provision label 8d4d --output finger-1.png")
@click.argument("uuid")
@click.option(
    "--output",
    "-o",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.svg|png",
    help="Output file; the extension selects the format.",
)
@pass_app
def label(app: App, uuid: str, output: Path) -> None:
    """Write a label with the node's UUID and full key fingerprint, as QR code and text.

    Pass the scanned text to whitelist add to pin the key before the first tap.
    """
    station = app.station()
    made = label_of(station, station.nodes.resolve(uuid))
    write_label(made, output)
    result = {
        "label": {"text": made.text, "uuid": made.uuid.hex(), "fingerprint": made.fingerprint, "file": str(output)}
    }
    app.emit(result, f"{output}: {made.text}")


# ``nodes --fits``: whether datasheets suffice for a task.


def show_fits(app: App, station: Station, expression: str, uuids: list[bytes]) -> None:
    """Print for every channel of these nodes whether it meets ``expression``, and why not."""
    try:
        requirement = teds.fits.parse_fits(expression)
    except BadDataError as error:
        raise UsageError(f"--fits: {error.message}", hint=error.hint) from error
    found = [fit.to_json() for fit in provisioning.inventory.fits_of(station, [requirement], uuids, datetime.now(UTC))]
    app.emit({"fits": found}, lambda console: _fits_table(console, found))


def _fits_table(console: Console, found: list[dict[str, Any]]) -> None:
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
