"""``import-keys``: node keys from another base station."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BytesIO
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import click

from teds_provision import handover, plant, protocol
from teds_provision.cli import options
from teds_provision.cli.context import App
from teds_provision.cli.export_keys import require_same
from teds_provision.cli.options import command, dry_run_option, link_options, links_given, yes_option
from teds_provision.cli.rendering import count_of, first_lines, reporter_for
from teds_provision.errors import BadData, LinkFailure, TedsProvisionError
from teds_provision.files import holds, open_to_read, require_new, write_new
from teds_provision.links import LinkSettings

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from teds_provision.handover.incoming import Imported, ImportPlan
    from teds_provision.station.station import Station

_SHOWN = 40
_PIECE = 64 * 1024
_CIPHERTEXT = b'"ciphertext"'
_COPIED = "A copy: the sender keeps the same keys, and either station can impersonate a node to the other."
_MOVED = "A move: each key is rotated at the first contact; until then, the sender can still use it."


@command(
    "teds-provision import-keys lab.jwe --no-prove",
    "teds-provision import-keys lab.jwe --via can --can udp_multicast:239.74.163.2 --yes",
    "teds-provision import-keys --received",
)
@click.argument("file", type=options.FileToRead(), required=False)
@click.option("--received", is_flag=True, help="Import parcels from the registry that wait for confirmation.")
@click.option(
    "--prove/--no-prove", default=None, help="Contact each node and open a session (default if a link is named)."
)
@click.option(
    "--receipt",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Where to write the signed receipt (default: FILE.receipt).",
)
@yes_option
@dry_run_option
@link_options
@click.pass_context
def import_keys(
    ctx: click.Context,
    file: Path | None,
    received: bool,
    prove: bool | None,
    receipt: Path | None,
    yes: bool,
    dry_run: bool,
    links: LinkSettings,
) -> None:
    """Take over node keys from a trusted base station: check, show the plan, import, write the receipt.

    A node counts as taken over once it opens a session here; after a move its key is rotated in that session, and only
    then is the sender locked out. Importing the same bundle again changes nothing and gives the same receipt.
    """
    app = ctx.find_object(App)
    assert app is not None
    station = app.station()
    if received == (file is not None):
        raise click.UsageError("Give one of FILE and --received.")
    if file is None:
        _take_received(app, station, yes=yes, dry_run=dry_run)
        return
    with _bundle_file(file) as bundle:
        receipt = receipt or file.with_name(file.name + ".receipt")
        station.unlock()
        state = station.version()  # before the plan: what changes while it is made is not overlooked either
        shown = handover.incoming.plan_import(station, bundle)
        if dry_run:
            app.emit({**_import_plan(shown), "receipt": None, "plan": True}, _import_text(station, shown))
            return
        if not isinstance(shown, handover.incoming.Imported):
            require_new(receipt)
            app.note(_import_text(station, shown))
            app.confirm(f"Import {count_of(len(shown.taken))}?", yes=yes)
        with station.lock("import-keys", app.note):
            plan = shown if station.version() == state else handover.incoming.plan_import(station, bundle)
            _require_as_shown(plan, shown)
            if isinstance(plan, handover.incoming.Imported):  # before, or meanwhile by another command
                done = plan
            else:
                done = handover.incoming.import_bundle(station, plan)
            if not holds(receipt, done.receipt + b"\n"):  # the same bundle once more: its receipt may lie there
                write_new(receipt, done.receipt + b"\n")
    outcomes: list[dict[str, Any]] = []
    if links_given(ctx) if prove is None else prove:
        outcomes = _prove(app, station, done, links)
    _tell_import(app, station, done, receipt, _import_plan(shown), outcomes)
    if prove and any(outcome["why"] for outcome in outcomes):
        raise click.exceptions.Exit(LinkFailure.exit_code)


def _take_received(app: App, station: Station, *, yes: bool, dry_run: bool) -> None:
    """Show each parcel that waits, and why; take in those that a person says yes to."""
    plant.folding.require_roster(station)
    station.unlock()
    tables, told = station.plant.parcels, list[dict[str, Any]]()
    for row in tables.parcels("in", "waiting", "later"):
        if row.kind != "bundle":
            continue
        octets = tables.parcel_document(row.id, "in")
        try:
            shown = handover.incoming.plan_import(station, octets)
        except TedsProvisionError as error:
            app.warn(f"{row.id}: {error.message}")
            continue
        app.note(f"{_import_text(station, shown)}\nReason for waiting: {row.detail or 'it has just arrived'}")
        one = {**_import_plan(shown), "parcel": row.id, "why": row.detail}
        told.append(one)
        if dry_run:
            continue
        app.confirm("Import this parcel?", yes=yes)
        with station.lock("import-keys", app.note):
            plan = handover.incoming.plan_import(station, octets)
            _require_as_shown(plan, shown)
            done = plant.parcels.import_parcel(station, row, plan)
        one["fresh"] = done.fresh
    count = f"{len(told)} parcel{'s' * (len(told) != 1)}"
    text = f"{count}." if dry_run else f"{count} imported; the receipts leave with the next sync."
    app.emit({"received": told, "plan": dry_run}, text if told else "Nothing waits.")


@contextmanager
def _bundle_file(path: Path) -> Iterator[BinaryIO]:
    """Open a bundle, to be read from any place; one that comes through a pipe is read whole."""
    most = protocol.handover.bundle.MAX_BUNDLE_OCTETS
    with open_to_read(path) as file:
        whole = file if file.seekable() else BytesIO(file.read(most + 1))
        if whole.seek(0, os.SEEK_END) > most:
            raise BadData(f"{path} is larger than {most} octets and cannot be a bundle.")
        if not _is_sealed(whole):
            raise BadData(f"{path} is not a handover bundle.", hint="Use the file that export-keys wrote.")
        yield whole


def _is_sealed(file: BinaryIO) -> bool:
    """Whether a file looks like a JWE."""
    file.seek(0)
    before = file.read(_PIECE)
    if before.lstrip()[:1] != b"{":
        return False
    while (piece := file.read(_PIECE)) and _CIPHERTEXT not in before:
        before = before[-len(_CIPHERTEXT) :] + piece
    return _CIPHERTEXT in before


def _require_as_shown(plan: ImportPlan | Imported, shown: ImportPlan | Imported) -> None:
    """Raise PolicyRefused where another command changed what becomes of a node; taken in meanwhile is fine."""
    if not isinstance(plan, handover.incoming.Imported):
        require_same(not isinstance(shown, handover.incoming.Imported) and plan.nodes == shown.nodes)


def _import_plan(plan: ImportPlan | Imported) -> dict[str, Any]:
    """The result as far as it is known before anything happens."""
    if isinstance(plan, handover.incoming.Imported):
        return _taken_before(plan)
    bundle = plan.opened.bundle
    nodes = ((one.node.uuid.hex(), one.decision, one.why) for one in plan.nodes)
    denied = [{"uuid": one.uuid.hex(), "why": one.why} for one in plan.denied]
    told = _import_result(bundle.sender, bundle.mode, bundle.id, nodes, denied)
    notes = {one.node.uuid.hex(): list(one.notes) for one in plan.nodes if one.notes}
    passed_over = [{"uuid": one.uuid.hex(), "why": why} for one, why in plan.passed_over]
    return told | {"notes": notes, "revocations_passed_over": passed_over}


def _taken_before(done: Imported) -> dict[str, Any]:
    refused = done.refused_uuids
    same = ((uuid, "same", "") for uuid in done.notes.uuids if uuid not in refused)
    nodes = chain(same, ((uuid, "refused", why) for uuid, why in done.notes.refused))
    return _import_result(done.row.peers[0], done.row.mode, done.row.id, nodes, [])


def _import_text(station: Station, plan: ImportPlan | Imported) -> str:
    """The plan for people."""
    if isinstance(plan, handover.incoming.Imported):
        return f"This bundle was imported on {plan.row.created}; there is nothing to do."
    bundle, nodes = plan.opened.bundle, plan.nodes
    lines = [f"A {bundle.mode} of {count_of(len(nodes))} from {handover.pending.peer_name(station, bundle.sender)}"]
    shown = [f"  {one.decision:<8} {one.node.uuid.hex()}  {one.why}".rstrip() for one in nodes[:_SHOWN]]
    lines += first_lines(shown, _SHOWN, len(nodes))
    noted = islice((one for one in nodes if one.notes), _SHOWN)
    lines += [f"  {one.node.uuid.hex()}: {note}" for one in noted for note in one.notes]
    lines += [f"  revoked  {one.uuid.hex()}  {one.why}" for one in plan.denied]
    lines += [f"  its ban of {one.uuid.hex()} is ignored: {why}" for one, why in plan.passed_over]
    own, sender = handover.trust.spoken(station.fingerprint), handover.trust.spoken(bundle.sender)
    lines += [f"Compare by voice:\n  from {sender}\n  to   {own}"]
    if not plan.ca_is_known:
        lines.append(f"The CA {protocol.keys.fingerprint(bundle.ca)[:32]} will be trusted for these nodes only.")
    return "\n".join([*lines, _COPIED if bundle.mode == "copy" else _MOVED])


def _import_result(
    sender: str, mode: str, handover_id: str, nodes: Iterable[tuple[str, str, str]], denied: list[dict[str, str]]
) -> dict[str, Any]:
    decisions: dict[str, str] = {}
    refused: list[dict[str, str]] = []
    for uuid, decision, why in nodes:
        decisions[uuid] = decision
        if decision == "refused":
            refused.append({"uuid": uuid, "why": why})
    return {
        "from": sender,
        "id": handover_id,
        "mode": mode,
        "count": len(decisions),
        "imported": [uuid for uuid, decision in decisions.items() if decision != "refused"],
        "refused": refused,
        "decisions": decisions,
        "revoked": denied,
    }


def _prove(app: App, station: Station, done: Imported, links: LinkSettings) -> list[dict[str, Any]]:
    proven = handover.incoming.proven_of(station, done.uuids)
    waiting = [uuid for uuid in done.uuids if uuid not in proven]

    def hold() -> AbstractContextManager[None]:
        return station.lock("import-keys", app.note)

    outcomes = handover.incoming.prove_nodes(station, links, waiting, reporter_for(app), hold=hold) if waiting else []
    return [
        {"uuid": one.uuid.hex(), "rotated": one.rotated, "why": ""}
        if isinstance(one, handover.incoming.Proven)
        else {"uuid": one.uuid.hex(), "rotated": False, "why": one.why}
        for one in outcomes
    ]


def _tell_import(
    app: App, station: Station, done: Imported, receipt: Path, told: dict[str, Any], outcomes: list[dict[str, Any]]
) -> None:
    imported = told["imported"]
    known = handover.incoming.proven_of(station, map(bytes.fromhex, imported))
    proven = [uuid for uuid in imported if bytes.fromhex(uuid) in known] if known else []
    pending = [uuid for uuid in imported if bytes.fromhex(uuid) not in known] if known else imported
    not_met = {one["uuid"]: one["why"] for one in outcomes if one["why"]}
    told |= {"receipt": str(receipt), "fresh": done.fresh, "proven": proven, "pending": pending, "not_proven": not_met}
    app.emit(told, _summary(done, receipt, not_met, pending, sum(bool(one["rotated"]) for one in outcomes)))


def _summary(done: Imported, receipt: Path, not_met: dict[str, str], pending: list[str], rotated: int) -> str:
    lines = [
        f"{count_of(len(done.notes.uuids) - len(done.notes.refused))} imported"
        + ("." if done.fresh else " earlier; nothing changed.")
    ]
    lines += [f"  refused {uuid}: {why}" for uuid, why in done.notes.refused]
    lines += [f"  no contact with {uuid}: {why}" for uuid, why in not_met.items()]
    lines += [f"{count_of(rotated)} rotated: the sender is locked out."] if rotated else []
    if pending:
        lines.append(f"{count_of(len(pending))} not proven yet: the first contact here proves them (agree UUID).")
    lines.append(f"Receipt for the sender: {receipt}")
    return "\n".join(lines)
