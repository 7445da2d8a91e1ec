"""Node keys that leave for another station and come from one: ``export-keys``, ``import-keys``, ``handover``."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from io import BytesIO
from itertools import chain, islice, zip_longest
from pathlib import Path
from typing import Any, BinaryIO, Literal, Protocol

import click

from teds_provision.cli import options
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import (
    COMMAND_SETTINGS,
    WholeNumber,
    command,
    dry_run_option,
    examples,
    link_options,
    links_given,
    yes_option,
)
from teds_provision.cli.rendering import count_of, first_lines, local_time, reporter_for
from teds_provision.errors import BadDataError, LinkError, NotFoundError, PolicyError, TedsProvisionError
from teds_provision.files import holds, open_to_read, read_limited, require_new, write_new
from teds_provision.handover import pending as handover_pending
from teds_provision.handover.incoming import (
    ImportPlan,
    ImportResult,
    NodeProof,
    import_bundle,
    plan_import,
    prove_nodes,
    proven_of,
)
from teds_provision.handover.outgoing import (
    ExportOrder,
    ExportPlan,
    ExportResult,
    LeavingNode,
    export_all,
    outputs_of,
    plan_exports,
)
from teds_provision.handover.pending import CloseResult, close, find_handover, list_handovers, peer_name
from teds_provision.handover.trust import spoken
from teds_provision.links import LinkSettings
from teds_provision.protocol.handover.bundle import MAX_BUNDLE_OCTETS
from teds_provision.protocol.handover.jose import NO_COMPACT_JWS
from teds_provision.protocol.handover.receipt import MAX_RECEIPT_OCTETS
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.station import Station

# -- export-keys -------------------------------------------------------------------------------------------------------

_LEAVING_SHOWN = 20
_MEANS = {
    "copy": "A copy: both stations will hold the same keys, and either can impersonate a node to the other.",
    "move": "A move: this station stops using the keys at once. It is only certain to be locked out when the other"
    " station has rotated them at its first contact.",
}


class KeyCarrier(Protocol):
    """Another way than a file on which an optional room sends bundles."""

    def require(self, station: Station) -> None:
        """Raise PolicyError if this station cannot send on this way."""

    def send(self, station: Station, plans: Sequence[ExportPlan]) -> tuple[dict[str, Any], str]:
        """Keep the bundles to be sent, durably; return the members of the result about them, and what they wait for."""


@command(
    "teds-provision export-keys --to lab --all --output lab.jwe",
    "teds-provision export-keys --to lab 8d4d --mode move --output finger.jwe",
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
    "-o",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Where to write the sealed bundle.",
)
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
    expires: int,
    ca: str | None,
    yes: bool,
    dry_run: bool,
    carrier: KeyCarrier | None = None,
) -> None:
    """Hand node keys to other base stations in a bundle sealed to them and signed by this one.

    Nothing is ever written unencrypted. A move marks the nodes as given away before the file exists; its receipt
    completes it ("handover receipt"), and until then "handover undo" reverts it. If one bundle cannot hold all nodes,
    they are split into FILE, FILE.2 and so on, each with its own receipt.
    """
    if everything == bool(uuids):
        raise click.UsageError("Name the nodes, or use --all.")
    if output is None and carrier is None:
        raise click.UsageError("Give --output FILE.")
    station = app.station()
    if carrier is not None:
        carrier.require(station)
    nodes = None if everything else tuple(station.nodes.resolve(uuid) for uuid in uuids)
    order = ExportOrder(receivers, nodes, mode, expires, ca)
    if not dry_run:
        station.unlock()  # before the lock: the store is not held while the user types a passphrase
    state = station.version()  # before the plan, so that changes made during planning are noticed
    shown = plan_exports(station, order)
    outputs = outputs_of(output, len(shown)) if output is not None else []
    if dry_run:
        result = _result_of(shown, outputs, station)
        id_ = None if shown[0].earlier is None else shown[0].id
        app.emit({**result, "id": id_, "plan": True}, _plan_text(shown, station))
        return
    app.note(_plan_text(shown, station))
    app.confirm(f"{mode.capitalize()} {_count(shown)}?", yes=yes)
    with station.lock("export-keys", app.note):
        # The user may have taken minutes to answer: export exactly what was confirmed, or nothing.
        plans = shown if station.version() == state else plan_exports(station, order)
        require_same([plan.content for plan in plans] == [plan.content for plan in shown])
        result = _result_of(plans, outputs, station)
        if carrier is not None:
            more, when = carrier.send(station, plans)
            app.emit({**result, **more}, f"{_count(plans)} will leave with {when}.")
            return
        done = export_all(station, plans, outputs)
    _print_export(app, plans, outputs, result, done)


def _print_export(
    app: App, plans: Sequence[ExportPlan], outputs: Sequence[Path], result: dict[str, Any], done: Sequence[ExportResult]
) -> None:
    for bundle, exported in zip(result["bundles"], done, strict=True):
        bundle |= {"sha256": exported.sha256, "octets": exported.octets, "fresh": exported.fresh}
    fresh = any(exported.fresh for exported in done)
    result |= {"sha256": done[0].sha256, "octets": sum(exported.octets for exported in done), "fresh": fresh}
    again = "" if fresh else " (nothing to do: it already exists)"
    moved = plans[0].mode == "move"
    next_step = "\nTo complete the move with its receipt: teds-provision handover receipt FILE.receipt" if moved else ""
    files = ", ".join(map(str, outputs))
    app.emit(result, f"{_count(plans)} in {files}, handover {plans[0].id}{again}.{next_step}")


def _count(plans: Sequence[ExportPlan]) -> str:
    return count_of(sum(len(plan.nodes) for plan in plans))


def _result_of(plans: Sequence[ExportPlan], outputs: Sequence[Path], station: Station) -> dict[str, Any]:
    plan = plans[0]
    return {
        "bundle": str(outputs[0]) if outputs else None,
        "from": station.fingerprint,
        "to": [{"name": record.name, "fingerprint": record.fingerprint} for record in plan.receivers],
        "mode": plan.mode,
        "count": sum(len(plan.nodes) for plan in plans),
        "id": plan.id,
        "expires": plan.expires.strftime("%Y-%m-%dT%H:%M:%SZ"),
        "nodes": [node.uuid.hex() for plan in plans for node in plan.nodes],
        "skipped": [{"uuid": uuid.hex(), "why": why} for uuid, why in plan.skipped],
        "also_held_by": _other_holders(plans),
        "bundles": [
            {"bundle": None if output is None else str(output), "id": pair.id, "count": len(pair.nodes)}
            for pair, output in zip_longest(plans, outputs)
        ],
    }


def _other_holders(plans: Sequence[ExportPlan]) -> list[str]:
    """Return the fingerprints of the stations that hold a copy of a key of any bundle."""
    return sorted({digits for plan in plans for digits in plan.also_held_by})


def _plan_text(plans: Sequence[ExportPlan], station: Station) -> str:
    plan, chosen = plans[0], [leaving for part in plans for leaving in part.nodes]
    lines = [f"{plan.mode.capitalize()} {_count(plans)}, to be imported by {local_time(plan.expires.isoformat())}"]
    lines += [f"  in {len(plans)} bundles"] if len(plans) > 1 else []
    lines += first_lines(_node_lines(chosen[:_LEAVING_SHOWN], station), _LEAVING_SHOWN, len(chosen))
    lines += [f"  not {uuid.hex()}: {why}" for uuid, why in plan.skipped]
    holders = _other_holders(plans)
    if holders:
        names = ", ".join(peer_name(station, digits) for digits in holders)
        lines.append(f"  also held by {names} from an earlier copy, until the keys are rotated")
    lines.append("Compare by voice:")
    lines += [f"  to   {record.name}\n       {spoken(record.fingerprint)}" for record in plan.receivers]
    lines.append(f"  from {station.name}\n       {spoken(station.fingerprint)}")
    return "\n".join([*lines, _MEANS[plan.mode]])


def _node_lines(chosen: Sequence[LeavingNode], station: Station) -> list[str]:
    known = station.nodes.get_many([node.uuid for node in chosen])
    return [f"  {node.uuid.hex()}  epoch {node.epoch}  {known[node.uuid].name or ''}".rstrip() for node in chosen]


def require_same(same: bool) -> None:
    """Raise unless what the user was shown is still true under the lock."""
    if not same:
        raise PolicyError("Another command changed the plan while this one was waiting.", hint="Run it again.")


# -- import-keys -------------------------------------------------------------------------------------------------------

_COMING_SHOWN = 40
_PIECE = 64 * 1024
_CIPHERTEXT = b'"ciphertext"'
_COPIED = "A copy: the sender keeps the same keys, and either station can impersonate a node to the other."
_MOVED = "A move: each key is rotated at the first contact; until then, the sender can still use it."


@command(
    "teds-provision import-keys lab.jwe --no-prove",
    "teds-provision import-keys lab.jwe --via can --can udp_multicast:239.74.163.2 --yes",
)
@click.argument("file", type=options.FileToRead())
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
    file: Path,
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
    with _bundle_file(file) as bundle:
        receipt = receipt or file.with_name(file.name + ".receipt")
        station.unlock()
        state = station.version()  # before the plan, so that changes made during planning are noticed
        shown = plan_import(station, bundle)
        if dry_run:
            app.emit({**import_plan(shown), "receipt": None, "plan": True}, import_text(station, shown))
            return
        if not isinstance(shown, ImportResult):
            require_new(receipt)
            app.note(import_text(station, shown))
            app.confirm(f"Import {count_of(len(shown.taken))}?", yes=yes)
        with station.lock("import-keys", app.note):
            plan = shown if station.version() == state else plan_import(station, bundle)
            require_as_shown(plan, shown)
            # An ImportResult: this bundle was imported before, perhaps meanwhile by another command.
            done = plan if isinstance(plan, ImportResult) else import_bundle(station, plan)
            if not holds(receipt, done.receipt + b"\n"):  # the bundle may have been imported before, with its receipt
                write_new(receipt, done.receipt + b"\n")
    outcomes: list[dict[str, Any]] = []
    if links_given(ctx) if prove is None else prove:
        outcomes = _prove(app, station, done, links)
    _print_import(app, station, done, receipt, import_plan(shown), outcomes)
    if prove and any(outcome["why"] for outcome in outcomes):
        raise click.exceptions.Exit(LinkError.exit_code)


@contextmanager
def _bundle_file(path: Path) -> Iterator[BinaryIO]:
    """Open a bundle, to be read from any place; one that comes through a pipe is read whole."""
    most = MAX_BUNDLE_OCTETS
    with open_to_read(path) as file:
        whole = file if file.seekable() else BytesIO(file.read(most + 1))
        if whole.seek(0, os.SEEK_END) > most:
            raise BadDataError(f"{path} is larger than {most} octets and cannot be a bundle.")
        if not _is_sealed(whole):
            raise BadDataError(f"{path} is not a handover bundle.", hint="Use the file that export-keys wrote.")
        yield whole


def _is_sealed(file: BinaryIO) -> bool:
    """Return True if a file looks like a JWE."""
    file.seek(0)
    before = file.read(_PIECE)
    if before.lstrip()[:1] != b"{":
        return False
    while (piece := file.read(_PIECE)) and _CIPHERTEXT not in before:
        before = before[-len(_CIPHERTEXT) :] + piece
    return _CIPHERTEXT in before


def require_as_shown(plan: ImportPlan | ImportResult, shown: ImportPlan | ImportResult) -> None:
    """Raise PolicyError if another command changed the outcome of a node; nodes imported meanwhile are fine."""
    if not isinstance(plan, ImportResult):
        require_same(not isinstance(shown, ImportResult) and plan.nodes == shown.nodes)


def import_plan(plan: ImportPlan | ImportResult) -> dict[str, Any]:
    """Return the result as far as it is known before anything happens."""
    if isinstance(plan, ImportResult):
        return _taken_before(plan)
    bundle = plan.opened.bundle
    nodes = ((planned.node.uuid.hex(), planned.decision, planned.why) for planned in plan.nodes)
    denied = [{"uuid": revocation.uuid.hex(), "why": revocation.why} for revocation in plan.denied]
    result = _import_result(bundle.sender, bundle.mode, bundle.id, nodes, denied)
    notes = {planned.node.uuid.hex(): list(planned.notes) for planned in plan.nodes if planned.notes}
    passed_over = [{"uuid": revocation.uuid.hex(), "why": why} for revocation, why in plan.passed_over]
    return result | {"notes": notes, "revocations_passed_over": passed_over}


def _taken_before(done: ImportResult) -> dict[str, Any]:
    refused = done.refused_uuids
    same = ((uuid, "same", "") for uuid in done.notes.uuids if uuid not in refused)
    nodes = chain(same, ((uuid, "refused", why) for uuid, why in done.notes.refused))
    return _import_result(done.row.peers[0], done.row.mode, done.row.id, nodes, [])


def import_text(station: Station, plan: ImportPlan | ImportResult) -> str:
    """Return the plan for people."""
    if isinstance(plan, ImportResult):
        return f"This bundle was imported on {plan.row.created}; there is nothing to do."
    bundle, nodes = plan.opened.bundle, plan.nodes
    lines = [f"A {bundle.mode} of {count_of(len(nodes))} from {peer_name(station, bundle.sender)}"]
    shown = [
        f"  {planned.decision:<8} {planned.node.uuid.hex()}  {planned.why}".rstrip()
        for planned in nodes[:_COMING_SHOWN]
    ]
    lines += first_lines(shown, _COMING_SHOWN, len(nodes))
    noted = islice((planned for planned in nodes if planned.notes), _COMING_SHOWN)
    lines += [f"  {planned.node.uuid.hex()}: {note}" for planned in noted for note in planned.notes]
    lines += [f"  revoked  {revocation.uuid.hex()}  {revocation.why}" for revocation in plan.denied]
    lines += [f"  its ban of {revocation.uuid.hex()} is ignored: {why}" for revocation, why in plan.passed_over]
    own, sender = spoken(station.fingerprint), spoken(bundle.sender)
    lines += [f"Compare by voice:\n  from {sender}\n  to   {own}"]
    if not plan.ca_is_known:
        lines.append(f"The CA {fingerprint(bundle.ca)[:32]} will be trusted for these nodes only.")
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


def _prove(app: App, station: Station, done: ImportResult, links: LinkSettings) -> list[dict[str, Any]]:
    proven = proven_of(station, done.uuids)
    waiting = [uuid for uuid in done.uuids if uuid not in proven]

    def hold() -> AbstractContextManager[None]:
        return station.lock("import-keys", app.note)

    outcomes = prove_nodes(station, links, waiting, reporter_for(app), hold=hold) if waiting else []
    return [
        {"uuid": outcome.uuid.hex(), "rotated": outcome.rotated, "why": ""}
        if isinstance(outcome, NodeProof)
        else {"uuid": outcome.uuid.hex(), "rotated": False, "why": outcome.why}
        for outcome in outcomes
    ]


def _print_import(
    app: App,
    station: Station,
    done: ImportResult,
    receipt: Path,
    result: dict[str, Any],
    outcomes: list[dict[str, Any]],
) -> None:
    imported = result["imported"]
    known = proven_of(station, map(bytes.fromhex, imported))
    proven = [uuid for uuid in imported if bytes.fromhex(uuid) in known] if known else []
    pending = [uuid for uuid in imported if bytes.fromhex(uuid) not in known] if known else imported
    not_met = {outcome["uuid"]: outcome["why"] for outcome in outcomes if outcome["why"]}
    result |= {
        "receipt": str(receipt),
        "fresh": done.fresh,
        "proven": proven,
        "pending": pending,
        "not_proven": not_met,
    }
    app.emit(result, _summary(done, receipt, not_met, pending, sum(bool(outcome["rotated"]) for outcome in outcomes)))


def _summary(done: ImportResult, receipt: Path, not_met: dict[str, str], pending: list[str], rotated: int) -> str:
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


# -- handover ----------------------------------------------------------------------------------------------------------


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

    listed = list_handovers(app.station(), datetime.now(UTC))
    rows = [
        {
            "id": handover.row.id,
            "direction": handover.row.direction,
            "mode": handover.row.mode,
            "state": handover.row.state,
            "peers": list(handover.row.peers),
            "names": list(handover.peers),
            "count": handover.count,
            "created": handover.row.created,
            "expires": handover.expires,
            "expired": handover.expired,
        }
        for handover in listed
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
@dry_run_option
@pass_app
def receipt(app: App, file: Path, *, dry_run: bool) -> None:
    """Complete a handover with the receiver's signed receipt; after a move, the keys are then deleted here.

    FILE may be a directory: every *.receipt in it is used.
    """
    station = app.station()
    files = sorted(file.glob("*.receipt")) if file.is_dir() else [file]
    if not files:
        raise NotFoundError(f"There is no receipt (*.receipt) in {file}.")
    with station.lock("handover receipt", app.note):
        closed, failed = _close_all(app, station, files, go_on=file.is_dir(), dry_run=dry_run)
    results = [_closed(result) for result in closed]
    lines = ["Plan, nothing is changed:"] if dry_run and closed else []
    lines += [_closed_text(station, result, dry_run=dry_run) for result in closed]
    plan = {"plan": True} if dry_run else {}
    result = {**results[0], "receipts": results} if results else {"receipts": []}
    app.conclude(result | plan, "\n".join(lines) or None, failed)


def _close_all(
    app: App, station: Station, files: list[Path], *, go_on: bool, dry_run: bool
) -> tuple[list[CloseResult], TedsProvisionError | None]:
    """Close by each receipt; return what was closed, and the first error if one does not end all (``go_on``)."""
    closed: list[CloseResult] = []
    failed: TedsProvisionError | None = None
    for path in files:
        try:
            octets = read_limited(path, MAX_RECEIPT_OCTETS, "receipt")
            closed.append(close(station, octets, dry_run=dry_run))
        except TedsProvisionError as error:
            if not go_on and error.message == NO_COMPACT_JWS:
                raise BadDataError(f"{path} is not a receipt.", hint="Use the file that import-keys wrote.") from error
            if not go_on:
                raise
            app.warn(f"{path.name}: {error.message}")
            failed = failed or error
    return closed, failed


def _closed(done: CloseResult) -> dict[str, Any]:
    return {
        "id": done.row.id,
        "from": done.receipt.sender,
        "mode": done.row.mode,
        "state": done.row.state,
        "imported": [uuid.hex() for uuid in done.receipt.imported],
        "refused": [{"uuid": refused.uuid.hex(), "why": refused.why} for refused in done.receipt.refused],
        "fresh": done.fresh,
    }


def _closed_text(station: Station, done: CloseResult, *, dry_run: bool) -> str:
    imported, refused = done.receipt.imported, done.receipt.refused
    text = f"Station {peer_name(station, done.receipt.sender)} imported {count_of(len(imported))}"
    deleted = f"; their keys {'would be' if dry_run else 'are'} deleted here." if done.row.mode == "move" else "."
    text += deleted if done.fresh else " (already known)."
    lines = [f"  refused {node.uuid.hex()}: {node.why}" for node in refused]
    if refused and done.row.mode == "move":
        again = "would belong" if dry_run else "belong"
        lines.append(f"The refused nodes {again} to this station again; their keys are rotated at the next contact.")
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
    row = find_handover(station, id_)
    if dry_run:
        app.emit({"id": row.id, "state": row.state, "plan": "undo"}, f"Plan: undo the {row.mode} {row.id}.")
        return
    app.confirm("Undo this move? The receiver may still have the keys until they are rotated.", yes=yes)
    with station.lock("handover undo", app.note):
        done = handover_pending.undo(station, find_handover(station, id_))
    result = {"id": row.id, "state": "undone", "nodes": [uuid.hex() for uuid in done.uuids], "fresh": done.fresh}
    text = f"{count_of(len(done.uuids))} back on this station; each key is rotated at the next contact."
    app.emit(result, text if done.fresh else "Nothing to do: this move was already undone.")
