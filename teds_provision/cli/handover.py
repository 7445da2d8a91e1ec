"""``handover``: what became of the bundles that left here and came here."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from teds_provision import handover as handover_room
from teds_provision import protocol
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import COMMAND_SETTINGS, dry_run_option, examples, yes_option
from teds_provision.cli.rendering import count_of, local_time
from teds_provision.errors import BadData, NotFound, TedsProvisionError
from teds_provision.files import read_limited

if TYPE_CHECKING:
    from teds_provision.handover.pending import Closed
    from teds_provision.station.station import Station


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples("teds-provision handover list", "teds-provision handover receipt lab.jwe.receipt"),
)
def handover() -> None:
    """Manage key handovers: list them, complete them with a receipt, undo a move."""


@handover.command("list", context_settings=COMMAND_SETTINGS, epilog=examples("teds-provision handover list"))
@pass_app
def list_(app: App) -> None:
    """List every bundle sent or received."""
    from datetime import UTC, datetime

    listed = handover_room.pending.list_handovers(app.station(), datetime.now(UTC))
    rows = [
        {
            "id": one.row.id,
            "direction": one.row.direction,
            "mode": one.row.mode,
            "state": one.row.state,
            "peers": list(one.row.peers),
            "names": list(one.peers),
            "count": one.count,
            "created": one.row.created,
            "expires": one.expires,
            "expired": one.expired,
        }
        for one in listed
    ]
    lines = [
        f"{row['id']}  {row['direction']:<3} {row['mode']}  {row['state']:<8} {row['count']:>5}"
        f"  {', '.join(row['names'])}  {local_time(str(row['created']))}{'  expired' if row['expired'] else ''}"  # type: ignore[arg-type]
        for row in rows
    ]
    app.emit({"handovers": rows}, "\n".join(lines) or "No bundles have been sent or received.")


@handover.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Complete a handover with the receiver's receipt.",
    epilog=examples("teds-provision handover receipt lab.jwe.receipt"),
)
@click.argument("file", type=click.Path(path_type=Path))
@pass_app
def receipt(app: App, file: Path) -> None:
    """Complete a handover with the receiver's signed receipt; after a move, the keys are then deleted here.

    FILE may be a directory: every *.receipt in it is used.
    """
    station = app.station()
    files = sorted(file.glob("*.receipt")) if file.is_dir() else [file]
    if not files:
        raise NotFound(f"There is no receipt (*.receipt) in {file}.")
    with station.lock("handover receipt", app.note):
        closed, failed = _close_all(app, station, files, go_on=file.is_dir())
    told = [_closed(one) for one in closed]
    text = "\n".join(_closed_text(station, one) for one in closed)
    app.conclude({**told[0], "receipts": told} if told else {"receipts": []}, text or None, failed)


def _close_all(
    app: App, station: Station, files: list[Path], *, go_on: bool
) -> tuple[list[Closed], TedsProvisionError | None]:
    """Close what each receipt closes; what was closed, and the first error where one ends not all (``go_on``)."""
    closed: list[Closed] = []
    failed: TedsProvisionError | None = None
    for path in files:
        try:
            octets = read_limited(path, protocol.handover.receipt.MAX_RECEIPT_OCTETS, "receipt")
            closed.append(handover_room.pending.close(station, octets))
        except TedsProvisionError as error:
            if not go_on and error.message == protocol.handover.jose.NO_COMPACT_JWS:
                raise BadData(f"{path} is not a receipt.", hint="Use the file that import-keys wrote.") from error
            if not go_on:
                raise
            app.warn(f"{path.name}: {error.message}")
            failed = failed or error
    return closed, failed


def _closed(done: Closed) -> dict[str, Any]:
    return {
        "id": done.row.id,
        "from": done.receipt.sender,
        "mode": done.row.mode,
        "state": done.row.state,
        "imported": [uuid.hex() for uuid in done.receipt.imported],
        "refused": [{"uuid": one.uuid.hex(), "why": one.why} for one in done.receipt.refused],
        "fresh": done.fresh,
    }


def _closed_text(station: Station, done: Closed) -> str:
    imported, refused = done.receipt.imported, done.receipt.refused
    text = f"Station {handover_room.pending.peer_name(station, done.receipt.sender)} imported {count_of(len(imported))}"
    text += (
        ("; their keys are deleted here." if done.row.mode == "move" else ".") if done.fresh else " (already known)."
    )
    lines = [f"  refused {one.uuid.hex()}: {one.why}" for one in refused]
    if refused and done.row.mode == "move":
        lines.append("The refused nodes belong to this station again; their keys are rotated at the next contact.")
    return "\n".join([text, *lines])


@handover.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Undo a move that has no receipt yet.",
    epilog=examples("teds-provision handover undo 3d1a4d1c --yes"),
)
@click.argument("id_", metavar="ID")
@yes_option
@dry_run_option
@pass_app
def undo(app: App, id_: str, yes: bool, dry_run: bool) -> None:
    """Undo a move that has no receipt yet; each node's key is rotated at the next contact, before anything else."""
    station = app.station()
    row = handover_room.pending.find_handover(station, id_)
    if dry_run:
        app.emit({"id": row.id, "state": row.state, "plan": "undo"}, f"Plan: undo the {row.mode} {row.id}.")
        return
    app.confirm("Undo this move? The receiver may still have the keys until they are rotated.", yes=yes)
    with station.lock("handover undo", app.note):
        done = handover_room.pending.undo(station, handover_room.pending.find_handover(station, id_))
    told = {"id": row.id, "state": "undone", "nodes": [uuid.hex() for uuid in done.uuids], "fresh": done.fresh}
    text = f"{count_of(len(done.uuids))} back on this station; each key is rotated at the next contact."
    app.emit(told, text if done.fresh else "Nothing to do: this move was already undone.")
