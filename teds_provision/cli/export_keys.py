"""``export-keys``: node keys to another base station, in a sealed bundle."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from teds_provision import handover, plant
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import WholeNumber, command, dry_run_option, yes_option
from teds_provision.cli.rendering import count_of, first_lines, local_time
from teds_provision.errors import PolicyRefused

if TYPE_CHECKING:
    from teds_provision.handover.outgoing import Exported, ExportPlan, Leaving
    from teds_provision.station.station import Station

_SHOWN = 20
_MEANS = {
    "copy": "A copy: both stations will hold the same keys, and either can impersonate a node to the other.",
    "move": "A move: this station stops using the keys at once. It is only certain to be locked out when the other"
    " station has rotated them at its first contact.",
}


@command(
    "teds-provision export-keys --to lab --all --output lab.jwe",
    "teds-provision export-keys --to lab 8d4d --mode move --output finger.jwe",
    "teds-provision export-keys --to south 8d4d --mode move --send",
)
@click.argument("uuids", metavar="[UUID]…", nargs=-1)
@click.option("--to", "receivers", multiple=True, required=True, metavar="STATION", help="Name, fingerprint or PEM.")
@click.option("--all", "everything", is_flag=True, help="Export every node whose key is held and proven.")
@click.option(
    "--mode",
    type=click.Choice(["copy", "move"]),
    default="copy",
    show_default=True,
    help="Share the keys, or hand them over.",
)
@click.option(
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Where to write the sealed bundle.",
)
@click.option("--send", is_flag=True, help="Send it through the registry at the next sync, instead of a file.")
@click.option(
    "--expires",
    type=WholeNumber(1, 365),
    default=7,
    show_default=True,
    metavar="DAYS",
    help="Days until the bundle expires.",
)
@click.option("--ca", metavar="FINGERPRINT", help="Only nodes that hold this CA key.")
@yes_option
@dry_run_option
@pass_app
def export_keys(
    app: App,
    uuids: tuple[str, ...],
    receivers: tuple[str, ...],
    everything: bool,
    mode: Literal["copy", "move"],
    output: Path | None,
    send: bool,
    expires: int,
    ca: str | None,
    yes: bool,
    dry_run: bool,
) -> None:
    """Hand node keys to other base stations in a bundle sealed to them and signed by this one.

    Nothing is ever written unencrypted. A move marks the nodes as given away before the file exists; its receipt
    completes it ("handover receipt"), and until then "handover undo" reverts it. If one bundle cannot hold all nodes,
    they are split into FILE, FILE.2 and so on, each with its own receipt.
    """
    if everything == bool(uuids):
        raise click.UsageError("Name the nodes, or use --all.")
    if send == (output is not None):
        raise click.UsageError("Give one of --output FILE and --send.")
    if send and len(receivers) != 1:
        raise click.UsageError("A parcel is for one station: give --to once.")
    station = app.station()
    if send:
        plant.folding.require_roster(station)
    nodes = None if everything else tuple(station.nodes.resolve(uuid) for uuid in uuids)
    order = handover.outgoing.ExportOrder(receivers, nodes, mode, expires, ca)
    if not dry_run:
        station.unlock()  # now: nobody is asked for a passphrase while the store is held
    state = station.version()  # before the plan: what changes while it is made is not overlooked either
    shown = handover.outgoing.plan_exports(station, order)
    outputs = handover.outgoing.outputs_of(output, len(shown)) if output is not None else []
    if dry_run:
        told = _exported(shown, outputs, station)
        id_ = None if shown[0].earlier is None else shown[0].id
        app.emit({**told, "id": id_, "plan": True}, _plan_text(shown, station))
        return
    app.note(_plan_text(shown, station))
    app.confirm(f"{mode.capitalize()} {_count(shown)}?", yes=yes)
    with station.lock("export-keys", app.note):
        # A person may have taken minutes to answer. What they said yes to is done, or nothing is.
        plans = shown if station.version() == state else handover.outgoing.plan_exports(station, order)
        require_same([plan.content for plan in plans] == [plan.content for plan in shown])
        told = _exported(plans, outputs, station)
        if send:
            names = [plant.parcels.send_export(station, plan, datetime.now(UTC)) for plan in plans]
            app.emit({**told, "parcels": names}, f"{_count(plans)} will leave with the next registry sync.")
            return
        done = handover.outgoing.export_all(station, plans, outputs)
    _tell_export(app, plans, outputs, told, done)


def _tell_export(
    app: App, plans: Sequence[ExportPlan], outputs: Sequence[Path], told: dict[str, Any], done: Sequence[Exported]
) -> None:
    for bundle, one in zip(told["bundles"], done, strict=True):
        bundle |= {"sha256": one.sha256, "octets": one.octets, "fresh": one.fresh}
    fresh = any(one.fresh for one in done)
    told |= {"sha256": done[0].sha256, "octets": sum(one.octets for one in done), "fresh": fresh}
    again = "" if fresh else " (nothing to do: it already exists)"
    moved = plans[0].mode == "move"
    next_step = "\nTo complete the move with its receipt: teds-provision handover receipt FILE.receipt" if moved else ""
    files = ", ".join(map(str, outputs))
    app.emit(told, f"{_count(plans)} in {files}, handover {plans[0].id}{again}.{next_step}")


def _count(plans: Sequence[ExportPlan]) -> str:
    return count_of(sum(len(plan.nodes) for plan in plans))


def _exported(plans: Sequence[ExportPlan], outputs: Sequence[Path], station: Station) -> dict[str, Any]:
    plan = plans[0]
    return {
        "bundle": str(outputs[0]) if outputs else None,
        "from": station.fingerprint,
        "to": [{"name": record.name, "fingerprint": record.fingerprint} for record in plan.receivers],
        "mode": plan.mode,
        "count": sum(len(one.nodes) for one in plans),
        "id": plan.id,
        "expires": plan.expires.strftime("%Y-%m-%dT%H:%M:%SZ"),
        "nodes": [node.uuid.hex() for one in plans for node in one.nodes],
        "skipped": [{"uuid": uuid.hex(), "why": why} for uuid, why in plan.skipped],
        "also_held_by": sorted({digits for one in plans for digits in one.also_held_by}),
        "bundles": [
            {"bundle": None if output is None else str(output), "id": one.id, "count": len(one.nodes)}
            for one, output in zip_longest(plans, outputs)
        ],
    }


def _plan_text(plans: Sequence[ExportPlan], station: Station) -> str:
    plan, chosen = plans[0], [one for part in plans for one in part.nodes]
    lines = [f"{plan.mode.capitalize()} {_count(plans)}, to be imported by {local_time(plan.expires.isoformat())}"]
    lines += [f"  in {len(plans)} bundles"] if len(plans) > 1 else []
    lines += first_lines(_node_lines(chosen[:_SHOWN], station), _SHOWN, len(chosen))
    lines += [f"  not {uuid.hex()}: {why}" for uuid, why in plan.skipped]
    if plan.also_held_by:
        names = ", ".join(handover.pending.peer_name(station, digits) for digits in plan.also_held_by)
        lines.append(f"  also held by {names} from an earlier copy, until the keys are rotated")
    lines.append("Compare by voice:")
    lines += [f"  to   {record.name}\n       {handover.trust.spoken(record.fingerprint)}" for record in plan.receivers]
    lines.append(f"  from {station.name}\n       {handover.trust.spoken(station.fingerprint)}")
    return "\n".join([*lines, _MEANS[plan.mode]])


def _node_lines(chosen: Sequence[Leaving], station: Station) -> list[str]:
    known = station.nodes.of_page([node.uuid for node in chosen])
    return [f"  {node.uuid.hex()}  epoch {node.epoch}  {known[node.uuid].name or ''}".rstrip() for node in chosen]


def require_same(same: bool) -> None:
    """What a person was shown must still be so under the lock."""
    if not same:
        raise PolicyRefused("Another command changed the plan while this one was waiting.", hint="Run it again.")
