"""``export-keys`` and ``import-keys``: what the plant adds: bundles that travel through the registry as parcels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from teds_provision import plant
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.extending import add_examples, add_options, callback_of
from teds_provision.cli.station.handover import import_plan, import_text, require_as_shown
from teds_provision.errors import RosterExpiredError, TedsProvisionError
from teds_provision.handover.incoming import NothingImportedError, plan_import
from teds_provision.handover.outgoing import ExportPlan
from teds_provision.sanitize import counted
from teds_provision.station.station import Station


@dataclass(frozen=True)
class ParcelCarrier:
    """Sends bundles of this mode with the next sync of the registry."""

    mode: str

    def require(self, station: Station) -> None:
        """Raise PolicyError if the station joined no registry, RosterExpiredError if no sync would send a copy."""
        roster = plant.apply_pages.require_roster(station)
        if self.mode == "copy" and plant.jobs.now_of(roster) >= roster.expires:
            raise RosterExpiredError(
                f"The roster expired on {roster.expires:%Y-%m-%d}, so no copy of keys is sent.",
                hint="Ask its owner to renew it: registry renew. Or hand over a file: --output FILE",
            )

    def send(self, station: Station, plans: Sequence[ExportPlan]) -> tuple[dict[str, Any], str]:
        """Keep each bundle as a parcel that leaves with the next sync; the parcels' names."""
        names = [plant.parcels.send_export(station, plan, datetime.now(UTC)) for plan in plans]
        return {"parcels": names}, "the next registry sync"


def extend_export(command: click.Command) -> None:
    """Add --send."""
    core = callback_of(command)

    def export_keys(*, send: bool, **rest: Any) -> None:
        if rest["everything"] != bool(rest["uuids"]):  # otherwise the core command reports that nodes are missing
            if send == (rest["output"] is not None):
                raise click.UsageError("Give one of --output FILE and --send.")
            if send and len(rest["receivers"]) != 1:
                raise click.UsageError("A parcel is for one station: give --to once.")
        core(carrier=ParcelCarrier(rest["mode"]) if send else None, **rest)

    says = "Send it through the registry at the next sync, instead of a file."
    add_options(command, "--output", click.Option(["--send"], is_flag=True, help=says))
    add_examples(command, "finger.jwe", "teds-provision export-keys --to south 8d4d --mode move --send")
    command.callback = export_keys


def extend_import(command: click.Command) -> None:
    """Add --received, without which a file must be named."""
    core = callback_of(command)

    @pass_app
    def import_keys(app: App, /, *, received: bool, file: Path | None, **rest: Any) -> None:
        station = app.station()
        if received == (file is not None):
            raise click.UsageError("Give one of FILE and --received.")
        if file is None:
            _take_received(app, station, yes=rest["yes"], dry_run=rest["dry_run"])
        else:
            core(file=file, **rest)

    [argument] = [parameter for parameter in command.params if isinstance(parameter, click.Argument)]
    argument.required = False
    says = "Import parcels from the registry that wait for confirmation."
    command.params.insert(command.params.index(argument) + 1, click.Option(["--received"], is_flag=True, help=says))
    add_examples(command, "--yes", "teds-provision import-keys --received")
    command.callback = import_keys


def _refuse(app: App, station: Station, parcel: str, octets: bytes) -> None:
    """Answer a bundle of which nothing can be imported, unless that has changed or was done meanwhile."""
    with station.lock("import-keys", app.note):
        if station.plant.parcels.get(parcel, "in") is None:
            return
        try:
            plan_import(station, octets)
        except NothingImportedError as error:
            plant.parcels.refuse_bundle(station, error, parcel)


def _take_received(app: App, station: Station, *, yes: bool, dry_run: bool) -> None:
    """Show each waiting parcel with its reason; take in those that the user confirms.

    One that is refused does not keep the others from being imported; the command then ends with the first refusal.
    """
    plant.apply_pages.require_roster(station)
    station.unlock()
    parcels, results, refused = station.plant.parcels, list[dict[str, Any]](), dict[str, TedsProvisionError]()
    for row in parcels.all("in", "waiting", "later"):
        if row.kind != "bundle":
            continue
        octets = parcels.document(row.id, "in")
        if not octets:
            continue  # another command or a sync took it meanwhile
        try:
            shown = plan_import(station, octets)
        except TedsProvisionError as error:
            app.warn(f"Parcel {row.id} is refused: {error.message}")
            if isinstance(error, NothingImportedError):  # others may be imported all the same
                error.hint = "The next sync reports this to the sender, which does not send these keys again."
                if not dry_run:
                    _refuse(app, station, row.id, octets)
            refused[row.id] = error
            continue
        app.note(f"{import_text(station, shown)}\nReason for waiting: {row.detail or 'it has just arrived'}")
        one = {**import_plan(shown), "parcel": row.id, "why": row.detail}
        results.append(one)
        if dry_run:
            continue
        app.confirm("Import this parcel?", yes=yes)
        with station.lock("import-keys", app.note):
            plan = plan_import(station, octets)
            require_as_shown(plan, shown)
            done = plant.parcels.import_parcel(station, row, plan)
        one["fresh"] = done.fresh
    text = f"{counted(len(results), 'parcel')}"
    text += "." if dry_run else " imported; the receipts leave with the next sync." if results else " imported."
    text += f" {counted(len(refused), 'parcel')} refused." if refused else ""
    listed = [{"parcel": parcel, "why": error.message} for parcel, error in refused.items()]
    app.conclude(
        {"received": results, "refused": listed, "plan": dry_run},
        text if results or refused else "Nothing waits.",
        next(iter(refused.values()), None),
    )
