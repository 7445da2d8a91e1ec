"""``export-keys``, ``import-keys``: node keys from one base station to another."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal

import click

from teds_provision import handover, protocol
from teds_provision.cli import options
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import WholeNumber, command, dry_run_option, link_options, links_given, yes_option
from teds_provision.cli.rendering import local_time, reporter_for
from teds_provision.errors import BadData, LinkFailure, PolicyRefused
from teds_provision.files import holds, open_to_read, require_new, write_new
from teds_provision.links import LinkSettings

if TYPE_CHECKING:
    from contextlib import AbstractContextManager

    from teds_provision.handover.arrivals import PlannedNode
    from teds_provision.handover.export_keys import Exported, ExportPlan
    from teds_provision.handover.import_keys import Imported, ImportPlan
    from teds_provision.handover.selection import Leaving
    from teds_provision.station.station import Station

_SHOWN = 20
_SHOWN_TO_IMPORT = 40
_PIECE = 64 * 1024
_CIPHERTEXT = b'"ciphertext"'
_MEANS = {
    "copy": "A copy: both stations hold the same keys from now on, and either can pose as a node to the other.",
    "move": "A move: the keys rest here at once. Only when the other station has rotated them at its first contact is"
    " this one locked out for certain.",
}
_COPIED = "A copy: the sender keeps the same keys, and either can pose as a node to the other."
_MOVED = "A move: each key is rotated at the first contact; until then the sender can still use it."


@command(
    "teds-provision export-keys --to lab --all --output lab.jwe",
    "teds-provision export-keys --to lab 8d4d --mode move --output finger.jwe",
)
@click.argument("uuids", metavar="[UUID]…", nargs=-1)
@click.option("--to", "receivers", multiple=True, required=True, metavar="STATION", help="Name, fingerprint or PEM.")
@click.option("--all", "everything", is_flag=True, help="Every node whose key is held and proven.")
@click.option("--mode", type=click.Choice(["copy", "move"]), default="copy", show_default=True, help="Share, or give.")
@click.option(
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    required=True,
    metavar="FILE",
    help="Where the sealed bundle goes.",
)
@click.option(
    "--expires",
    type=WholeNumber(1, 365),
    default=7,
    show_default=True,
    metavar="DAYS",
    help="How long it can be imported.",
)
@click.option("--ca", metavar="FINGERPRINT", help="Only the nodes that keep this CA key.")
@yes_option
@dry_run_option
@pass_app
def export_keys(
    app: App,
    uuids: tuple[str, ...],
    receivers: tuple[str, ...],
    everything: bool,
    mode: Literal["copy", "move"],
    output: Path,
    expires: int,
    ca: str | None,
    yes: bool,
    dry_run: bool,
) -> None:
    """Hand node keys to other base stations in a bundle, sealed to them and signed by this one.

    Nothing is ever written unsealed. A move marks the nodes as given away before the file exists; its receipt closes
    it ("handover receipt"); before that "handover undo" takes it back. More nodes than one bundle holds go into FILE,
    FILE.2 and so on, each with a receipt of its own.
    """
    if everything == bool(uuids):
        raise click.UsageError("Name the nodes, or say --all.")
    station = app.station()
    nodes = None if everything else tuple(station.nodes.resolve(uuid) for uuid in uuids)
    order = handover.selection.ExportOrder(receivers, nodes, mode, expires, ca)
    if not dry_run:
        station.unlock()
    shown = handover.export_keys.plan_exports(station, order)
    outputs = handover.export_keys.outputs_of(output, len(shown))
    if dry_run:
        told = _exported(shown, outputs, station)
        id_ = None if shown[0].earlier is None else shown[0].id
        app.emit({**told, "id": id_, "plan": True}, _plan_text(shown, station))
        return
    state = station.version()
    app.note(_plan_text(shown, station))
    app.confirm(f"{mode.capitalize()} {_count(shown)}?", yes=yes)
    with station.lock("export-keys", app.note):
        plans = shown if station.version() == state else handover.export_keys.plan_exports(station, order)
        _require_same([plan.content for plan in plans] == [plan.content for plan in shown])
        told = _exported(plans, outputs, station)
        done = handover.export_keys.export_all(station, plans, outputs)
    _tell_export(app, plans, outputs, told, done)


def _tell_export(
    app: App, plans: Sequence[ExportPlan], outputs: Sequence[Path], told: dict[str, Any], done: Sequence[Exported]
) -> None:
    for bundle, one in zip(told["bundles"], done, strict=True):
        bundle |= {"sha256": one.sha256, "octets": one.octets, "fresh": one.fresh}
    fresh = any(one.fresh for one in done)
    told |= {"sha256": done[0].sha256, "octets": sum(one.octets for one in done), "fresh": fresh}
    again = "" if fresh else " (nothing to do, it is there already)"
    moved = plans[0].mode == "move"
    next_step = "\nIts receipt closes the move: teds-provision handover receipt FILE.receipt" if moved else ""
    files = ", ".join(map(str, outputs))
    app.emit(told, f"{_count(plans)} in {files}, handover {plans[0].id}{again}.{next_step}")


def _count(plans: Sequence[ExportPlan]) -> str:
    return count_of(sum(len(plan.nodes) for plan in plans))


def _exported(plans: Sequence[ExportPlan], outputs: Sequence[Path], station: Station) -> dict[str, Any]:
    plan = plans[0]
    return {
        "bundle": str(outputs[0]),
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
            {"bundle": str(output), "id": one.id, "count": len(one.nodes)}
            for one, output in zip(plans, outputs, strict=True)
        ],
    }


def _plan_text(plans: Sequence[ExportPlan], station: Station) -> str:
    plan, chosen = plans[0], [one for part in plans for one in part.nodes]
    lines = [f"{plan.mode.capitalize()} {_count(plans)}, to be imported by {local_time(plan.expires.isoformat())}"]
    lines += [f"  in {len(plans)} bundles"] if len(plans) > 1 else []
    lines += _first(_node_lines(chosen[:_SHOWN], station), _SHOWN, len(chosen))
    lines += [f"  not {uuid.hex()}: {why}" for uuid, why in plan.skipped]
    if plan.also_held_by:
        names = ", ".join(handover.pending.peer_name(station, digits) for digits in plan.also_held_by)
        lines.append(f"  also held, by an earlier copy, by {names}: until the keys are rotated")
    lines.append("For comparison by voice:")
    lines += [f"  to   {record.name}\n       {handover.trust.spoken(record.fingerprint)}" for record in plan.receivers]
    lines.append(f"  from {station.name}\n       {handover.trust.spoken(station.fingerprint)}")
    return "\n".join([*lines, _MEANS[plan.mode]])


def _node_lines(chosen: Sequence[Leaving], station: Station) -> list[str]:
    known = station.nodes.of_page([node.uuid for node in chosen])
    return [f"  {node.uuid.hex()}  epoch {node.epoch}  {known[node.uuid].name or ''}".rstrip() for node in chosen]


def _first(lines: list[str], most: int, count: int) -> list[str]:
    """The first lines of a list of so many, and how many more there are."""
    return [*lines[:most], f"  … and {count - most} more"] if count > most else lines


@command(
    "teds-provision import-keys lab.jwe --no-prove",
    "teds-provision import-keys lab.jwe --via can --can udp_multicast:239.74.163.2 --yes",
)
@click.argument("file", type=options.FileToRead())
@click.option(
    "--prove/--no-prove", default=None, help="Meet each node and open a session (default: with link options)."
)
@click.option(
    "--receipt",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Where the signed receipt goes (default: FILE.receipt).",
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
    """Take node keys over from a trusted base station: check, show the plan, take in, write the receipt.

    A node counts as taken over when it opened a session here; after a move its key is rotated in it, and only then is
    the sender locked out. The same bundle again changes nothing and gives the same receipt.
    """
    app = ctx.find_object(App)
    assert app is not None
    station = app.station()
    with _bundle_file(file) as bundle:
        receipt = receipt or file.with_name(file.name + ".receipt")
        station.unlock()
        shown = handover.import_keys.plan_import(station, bundle)
        state = station.version()
        if dry_run:
            app.emit({**_import_plan(shown), "receipt": None, "plan": True}, _import_text(station, shown))
            return
        if not isinstance(shown, handover.import_keys.Imported):
            require_new(receipt)
            app.note(_import_text(station, shown))
            app.confirm(f"Take {count_of(len(shown.taken))} in?", yes=yes)
        with station.lock("import-keys", app.note):
            plan = shown if station.version() == state else handover.import_keys.plan_import(station, bundle)
            done = _take_in(station, plan, shown)
            _write_receipt(receipt, done.receipt)
    outcomes: list[dict[str, Any]] = []
    if links_given(ctx) if prove is None else prove:
        outcomes = _prove(app, station, done, links)
    _tell_import(app, station, done, receipt, _import_plan(shown), outcomes)
    if prove:
        _require_proven(outcomes)


def _require_proven(outcomes: list[dict[str, Any]]) -> None:
    """Exit 5 where a node that was to be met was not."""
    if any(outcome["why"] for outcome in outcomes):
        raise click.exceptions.Exit(LinkFailure.exit_code)


@contextmanager
def _bundle_file(path: Path) -> Iterator[BinaryIO]:
    """Open a bundle, to be read from any place; one that comes through a pipe is read whole."""
    most = protocol.handover.bundle.MAX_BUNDLE_OCTETS
    with open_to_read(path) as file:
        whole = file if file.seekable() else BytesIO(file.read(most + 1))
        if whole.seek(0, os.SEEK_END) > most:
            raise BadData(f"{path} is larger than {most} octets: that is no bundle.")
        if not _is_sealed(whole):
            raise BadData(f"{path} is no handover bundle.", hint="Give the file that export-keys wrote.")
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


def _take_in(station: Station, plan: ImportPlan | Imported, shown: ImportPlan | Imported) -> Imported:
    """Import what was ``shown``, under the lock; nothing to do where it was taken in before."""
    if isinstance(plan, handover.import_keys.Imported):
        return plan
    _require_same(not isinstance(shown, handover.import_keys.Imported) and plan.nodes == shown.nodes)
    return handover.import_keys.import_keys(station, plan)


def _require_same(same: bool) -> None:
    """What a person was shown must still be so under the lock."""
    if not same:
        raise PolicyRefused("Another command changed the plan while this one waited.", hint="Run it again.")


def _import_plan(plan: ImportPlan | Imported) -> dict[str, Any]:
    """The result as far as it is known before anything happens."""
    if isinstance(plan, handover.import_keys.Imported):
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
    if isinstance(plan, handover.import_keys.Imported):
        return f"This bundle was taken in on {plan.row.created}; nothing is left to do."
    bundle, nodes = plan.opened.bundle, plan.nodes
    lines = [f"A {bundle.mode} of {count_of(len(nodes))} from {handover.pending.peer_name(station, bundle.sender)}"]
    shown = [f"  {one.decision:<8} {one.node.uuid.hex()}  {one.why}".rstrip() for one in nodes[:_SHOWN_TO_IMPORT]]
    lines += _first(shown, _SHOWN_TO_IMPORT, len(nodes))
    lines += _noted(nodes)
    lines += [f"  revoked  {one.uuid.hex()}  {one.why}" for one in plan.denied]
    lines += [f"  its ban of {one.uuid.hex()} does not count: {why}" for one, why in plan.passed_over]
    own, sender = handover.trust.spoken(station.fingerprint), handover.trust.spoken(bundle.sender)
    lines += [f"For comparison by voice:\n  from {sender}\n  to   {own}"]
    if not plan.ca_is_known:
        lines.append(
            f"The CA {protocol.keys.fingerprint(bundle.ca)[:32]} will be trusted for these nodes, and for no others."
        )
    return "\n".join([*lines, _COPIED if bundle.mode == "copy" else _MOVED])


def _noted(nodes: Iterable[PlannedNode]) -> list[str]:
    noted = islice((one for one in nodes if one.notes), _SHOWN_TO_IMPORT)
    return [f"  {one.node.uuid.hex()}: {note}" for one in noted for note in one.notes]


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


def _write_receipt(receipt: Path, octets: bytes) -> None:
    if not holds(receipt, octets + b"\n"):
        write_new(receipt, octets + b"\n")


def _prove(app: App, station: Station, done: Imported, links: LinkSettings) -> list[dict[str, Any]]:
    proven = handover.prove.proven_of(station, done.uuids)
    waiting = [uuid for uuid in done.uuids if uuid not in proven]

    def hold() -> AbstractContextManager[None]:
        return station.lock("import-keys", app.note)

    outcomes = handover.prove.prove_nodes(station, links, waiting, reporter_for(app), hold=hold) if waiting else []
    return [
        {"uuid": one.uuid.hex(), "rotated": one.rotated, "why": ""}
        if isinstance(one, handover.prove.Proven)
        else {"uuid": one.uuid.hex(), "rotated": False, "why": one.why}
        for one in outcomes
    ]


def _tell_import(
    app: App, station: Station, done: Imported, receipt: Path, told: dict[str, Any], outcomes: list[dict[str, Any]]
) -> None:
    imported = told["imported"]
    known = handover.prove.proven_of(station, map(bytes.fromhex, imported))
    proven = [uuid for uuid in imported if bytes.fromhex(uuid) in known] if known else []
    pending = [uuid for uuid in imported if bytes.fromhex(uuid) not in known] if known else imported
    not_met = {one["uuid"]: one["why"] for one in outcomes if one["why"]}
    told |= {"receipt": str(receipt), "fresh": done.fresh, "proven": proven, "pending": pending, "not_proven": not_met}
    app.emit(told, _import_told(done, receipt, not_met, pending, sum(bool(one["rotated"]) for one in outcomes)))


def _import_told(done: Imported, receipt: Path, not_met: dict[str, str], pending: list[str], rotated: int) -> str:
    lines = [
        f"{count_of(len(done.notes.uuids) - len(done.notes.refused))} taken in"
        + ("." if done.fresh else " before; nothing changed.")
    ]
    lines += [f"  refused {uuid}: {why}" for uuid, why in done.notes.refused]
    lines += [f"  not met {uuid}: {why}" for uuid, why in not_met.items()]
    lines += [f"{count_of(rotated)} rotated: the sender is locked out for certain."] if rotated else []
    if pending:
        lines.append(f"{count_of(len(pending))} not proven yet: their first contact here proves them (agree UUID).")
    lines.append(f"Receipt for the sender: {receipt}")
    return "\n".join(lines)


def count_of(number: int) -> str:
    """``1 node``, ``2 nodes``."""
    return f"{number} node{'' if number == 1 else 's'}"
