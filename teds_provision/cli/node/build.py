"""``build``, ``sign``, ``write``, ``read``, ``draft``, ``history``: a datasheet, from its profile to the flash."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from teds_provision import provisioning
from teds_provision import teds as teds_room
from teds_provision.cli.context import App, Station, pass_app
from teds_provision.cli.named_files import write_file
from teds_provision.cli.options import (
    CalibrationFile,
    Day,
    FileToRead,
    Function,
    WholeNumber,
    command,
    dry_run_option,
    examples,
    link_options,
    yes_option,
)
from teds_provision.cli.rendering import local_time, reporter_for
from teds_provision.errors import UsageError
from teds_provision.lazy import late
from teds_provision.links import LinkSettings
from teds_provision.teds.certificate import CertificateReference

if TYPE_CHECKING:
    from teds_provision.cli import terminal_operator
    from teds_provision.provisioning.datasheet_history import RestoreOrder
    from teds_provision.provisioning.write import WriteResult
else:  # imports the steps
    terminal_operator = late("teds_provision.cli.terminal_operator")


def order_options(function: Function) -> Function:
    """Add --profile, --calibration and what belongs to it, --name, --retype: one ``order``."""
    from functools import wraps

    @wraps(function)
    def with_order(*args: Any, profile: Any, calibration: Any, no_calibration: bool, name: Any, **rest: Any) -> Any:
        accepted, retype = rest.pop("accept_calibration"), rest.pop("retype")
        item, trusted, due = rest.pop("item"), rest.pop("trust_dcc"), rest.pop("due")
        line = rest.get("line")
        elsewhere = rest.get("batch") is not None or (line is not None and line.names_boards)
        # with --batch or a line's job, calibrations are named there
        if calibration is None and (item is not None or due is not None) and not elsewhere:
            raise UsageError("--item and --due belong to a calibration.", hint="Add --calibration FILE.")
        channel, file = calibration or (None, None)
        order = provisioning.build.BuildOrder(
            profile,
            file,
            name,
            no_calibration,
            accepted,
            retype,
            channel=channel,
            item=item,
            trusted=trusted,
            due=due,
        )
        return function(*args, order=order, **rest)

    options = [
        click.option(
            "--profile", "-p", metavar="P", help="Transducer type, or a TOML file (default: the node's last)."
        ),
        click.option(
            "--calibration",
            "-c",
            type=CalibrationFile(),
            metavar="[N=]FILE",
            help="CSV of raw, value pairs or coefficients, or a certificate (DCC, .xml); N= for channel N alone.",
        ),
        click.option("--item", metavar="ID", help="Result of the certificate to use; see: show CERT.xml"),
        click.option(
            "--trust-dcc",
            type=FileToRead(),
            multiple=True,
            metavar="CERT.pem",
            help="Require a certificate signed by this one, or under this CA; repeatable.",
        ),
        click.option(
            "--due",
            type=Day(),
            metavar="DATE",
            help="When to calibrate again (default: the calibration's date and the interval of file or profile).",
        ),
        click.option("--no-calibration", is_flag=True, help="Drop the node's existing calibration."),
        click.option("--name", help="Node name, written to its XdcrName TEDS."),
        click.option(
            "--accept-calibration",
            metavar='"WHY"',
            help="Accept a calibration that the guard refuses; the reason is logged.",
        ),
        click.option("--retype", is_flag=True, help="Allow the board to change type."),
    ]
    wrapped: Any = with_order
    for option in reversed(options):
        wrapped = option(wrapped)
    return wrapped  # type: ignore[no-any-return]


@command(
    "teds-provision build 8d4d --profile magnetic-angular-position-sensor --output angle.json",
    "teds-provision build 8d4d --profile magnetic-angular-position-sensor --calibration angle.xml --item as-left",
)
@click.argument("uuid")
@order_options
@click.option(
    "--output",
    "-o",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="IMAGE",
    help="Also write it to this file.",
)
@click.option("--edition", type=click.Choice(["2007", "2024"]), default="2007", show_default=True, help="TEDS edition.")
@yes_option
@dry_run_option
@pass_app
def build(app: App, uuid: str, order: Any, output: Path | None, edition: str, yes: bool, dry_run: bool) -> None:
    """Build a node's TEDS from its type and calibration, plus the Security TEDS; nothing is signed yet."""
    station = app.station()
    octets = station.nodes.resolve(uuid)
    order = replace(order, choose=app.chooses_item())
    built = provisioning.build.build(
        station,
        octets,
        order,
        edition=int(edition),
        keep_draft=not dry_run,
        retype=terminal_operator.TerminalOperator(app, yes=yes).retype,
    )
    if output is not None and not dry_run:
        write_file(output, built.image.to_json())
    for warning in built.warnings:
        app.warn(warning)
    blocks = [
        {"access_code": code, "channel": channel, "octets": len(teds), "sha256": hashlib.sha256(teds).hexdigest()}
        for (channel, code), teds in sorted(built.image.blocks.items())
    ]

    calibrations = [
        teds_room.calibration.describe_calibration(calibration) for calibration in built.calibrations.values()
    ]
    fits = "".join(f"\n  {teds_room.calibration.sentence(calibration)}" for calibration in built.calibrations.values())
    lines = [f"{b['access_code']:>4}  channel {b['channel']:<3} {b['octets']:>5} octets" for b in blocks]
    app.emit(
        {
            "uuid": octets.hex(),
            "profile": built.profile,
            "blocks": blocks,
            "warnings": list(built.warnings),
            "calibrations": calibrations,
            **calibration_json(provisioning.build.certificate_brought(built.calibrations)),
        },
        f"Built {octets.hex()} as {built.profile}:\n" + "\n".join(lines) + fits,
    )


def calibration_json(certificate: CertificateReference | None) -> dict[str, Any]:
    """Return the member ``calibration`` if a certificate was used for the calibration, else nothing."""
    return {} if certificate is None else {"calibration": certificate.to_json()}


@command(
    "teds-provision sign 8d4d",
    "teds-provision sign angle.json --output signed.json",
)
@click.argument("what", metavar="UUID|IMAGE")
@click.option(
    "--output",
    "-o",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="IMAGE",
    help="Write the signed image to this file.",
)
@click.option("--read-node", is_flag=True, help="Use the node's own epoch, sequence and TEDS instead of the store's.")
@click.option(
    "--accept-calibration", metavar='"WHY"', help="Accept a calibration that the guard refuses; the reason is logged."
)
@yes_option
@dry_run_option
@link_options
@pass_app
def sign(
    app: App,
    what: str,
    output: Path | None,
    read_node: bool,
    accept_calibration: str | None,
    yes: bool,
    dry_run: bool,
    links: LinkSettings,
) -> None:
    """Sign the datasheet that was built for a node, or an image file (needs --output).

    If content, key epoch and signer are unchanged, the existing signature is reused.
    """
    del yes  # not needed: a signature only uses up a sequence number
    station = app.station()
    done = provisioning.sign.sign_at(
        station,
        links,
        what,
        reporter_for(app),
        read_node=read_node,
        accept_calibration=accept_calibration,
        dry_run=dry_run,
        output=output,
    )
    uuid = done.signed.image.uuid
    if dry_run:
        app.emit({"uuid": uuid.hex(), "changes": list(done.changes)}, _changes(done.changes))
        return
    if output is not None:
        write_file(output, done.signed.image.to_json())
    result: dict[str, Any] = {
        "uuid": uuid.hex(),
        "sequence": done.signed.sequence,
        "signature": done.signed.signature.hex(),
        "signed_by": station.fingerprint,
        "reused": done.signed.reused,
        "changes": list(done.changes),
    }
    again = " (existing signature reused)" if done.signed.reused else ""
    app.emit(result, f"{_changes(done.changes)}\nSigned {uuid.hex()}, sequence {done.signed.sequence}{again}.")


def _changes(changes: tuple[str, ...]) -> str:
    return "\n".join(f"  {change}" for change in changes) or "  no changes"


@command(
    "teds-provision write 8d4d --nfc udp:localhost:54321",
    "teds-provision write 8d4d --image signed.json --via can --can udp_multicast:239.74.163.2",
    "teds-provision write 8d4d --from 3 --nfc udp:localhost:54321",
)
@click.argument("uuid")
@click.option("--image", type=FileToRead(), metavar="IMAGE", help="Write the image in this file.")
@click.option(
    "--from",
    "sequence",
    type=WholeNumber(0, 2**32 - 1),
    metavar="SEQUENCE",
    help="Restore an earlier datasheet; see history.",
)
@click.option("--retype", is_flag=True, help="Allow the board to change type.")
@click.option("--sequence-jump", is_flag=True, help="Write even if its sequence is far ahead of the node's.")
@yes_option
@dry_run_option
@link_options
@pass_app
def write(
    app: App,
    uuid: str,
    image: Path | None,
    sequence: int | None,
    retype: bool,
    sequence_jump: bool,
    yes: bool,
    dry_run: bool,
    links: LinkSettings,
) -> None:
    """Write a signed datasheet over a session, commit it, read it back and compare.

    --from restores an earlier datasheet of the node, signed again.
    """
    if sequence is not None:
        if image is not None:
            raise UsageError("--from and --image cannot be combined.", hint="Use one of them.")
        order = provisioning.datasheet_history.RestoreOrder(uuid, sequence, retype, sequence_jump, dry_run)
        _bring_back(app, order, links, yes=yes)
        return
    if dry_run:
        done = provisioning.write.plan_write(app.station(), uuid, image)
    else:
        done = provisioning.write.write_at(
            app.station(),
            links,
            uuid,
            reporter_for(app),
            file=image,
            operator=terminal_operator.TerminalOperator(app, yes=yes),
            jump=sequence_jump,
            retyped=retype,
        )
    node, written = done.image.uuid.hex(), done.written
    if written is None:
        blocks, octets = len(done.image.blocks), sum(map(len, done.image.blocks.values()))
        plan = {"uuid": node, "plan": "write", "blocks": blocks, "octets": octets}
        app.emit(plan, f"Plan: write {blocks} TEDS, {octets} octets, to {node}.")
        return
    app.emit(_to_json(node, written), f"Node {node}: {_said(written)}.")


def _bring_back(app: App, order: RestoreOrder, links: LinkSettings, *, yes: bool) -> None:
    done = provisioning.datasheet_history.restore_datasheet(
        app.station(), links, order, reporter_for(app), operator=terminal_operator.TerminalOperator(app, yes=yes)
    )
    for warning in done.warnings:
        app.warn(warning)
    node, changes = done.uuid.hex(), [change.text for change in done.changes]
    lines = "".join(f"\n  {text}" for text in changes) or "\n  no changes"
    if done.written is None:
        plan = {"uuid": node, "plan": "write", "from": order.sequence, "changes": changes}
        app.emit(plan, f"Plan: restore the datasheet of sequence {order.sequence} on {node}.{lines}")
        return
    result = _to_json(node, done.written) | {"from": order.sequence, "sequence": done.sequence, "changes": changes}
    sentence = f"datasheet {order.sequence} restored as sequence {done.sequence}"
    app.emit(result, f"Node {node}: {sentence}; {_said(done.written)}.{lines}")


def _to_json(node: str, written: WriteResult) -> dict[str, Any]:
    return {
        "uuid": node,
        "octets_written": written.octets,
        "verified": True,
        "seconds": round(written.seconds, 3),
    }


def _said(written: WriteResult) -> str:
    text = f"{written.octets} octets written and read back" if written.octets else "nothing to do, it is already there"
    return f"{text} ({written.seconds:.2f} s)"


@command("teds-provision read 8d4d --nfc udp:localhost:54321 --output node.json")
@click.argument("uuid")
@click.option(
    "--output",
    "-o",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="IMAGE",
    help="Write the image to this file.",
)
@link_options
@pass_app
def read(app: App, uuid: str, output: Path | None, links: LinkSettings) -> None:
    """Read every TEDS of a node, in a session if this station holds its key; decode the result with show.

    If a key is held but no session can be opened, nothing is proven: the data received is shown, no file is written,
    and the exit code is 5.
    """
    done = provisioning.read.read_at(app.station(), links, uuid, reporter_for(app))
    text = done.image.to_json()
    if done.error is not None:
        app.conclude({**json.loads(text), "verdict": "unproven"}, text.rstrip("\n"), done.error)
        return
    if output is not None:
        write_file(output, text)
    total = sum(map(len, done.image.blocks.values()))
    into = f" into {output}." if output else "."
    sentence = f"{len(done.image.blocks)} TEDS, {total} octets read from {done.image.uuid.hex()}{into}"
    app.emit(json.loads(text), sentence if output is not None else text.rstrip("\n"))


@click.group(epilog=examples("teds-provision draft list", "teds-provision draft drop 8d4d"))
def draft() -> None:
    """Drafts: datasheets built but not written, by a trial or an interrupted run."""


@command("teds-provision draft list")
@pass_app
def list_(app: App) -> None:
    """List every draft: node, stage and profile."""
    drafts = _drafts(app.station())
    lines = [
        f"{draft['uuid']}  {draft['stage']:<6}  {local_time(str(draft['created']))}  {draft['profile'] or ''}".rstrip()
        for draft in drafts
    ]
    app.emit({"drafts": drafts}, "\n".join(lines) or "There are no drafts.")


def _drafts(station: Station) -> list[dict[str, Any]]:
    return [
        {"uuid": draft.uuid.hex(), "profile": draft.profile, "stage": draft.stage, "created": draft.created}
        for draft in station.datasheets.drafts()
    ]


@command("teds-provision draft drop 8d4d")
@click.argument("uuid")
@yes_option
@dry_run_option
@pass_app
def drop(app: App, uuid: str, yes: bool, dry_run: bool) -> None:
    """Drop a node's draft; the datasheet on the node is not affected."""
    del yes  # not needed: the draft can be built again
    station = app.station()
    done = provisioning.datasheet_history.drop_draft(station, uuid, dry_run=dry_run)
    node, drafts = done.uuid.hex(), _drafts(station)
    if done.draft is None:
        app.emit({"uuid": node, "dropped": False, "drafts": drafts}, f"Node {node} has no draft.")
        return
    text = f"{'Plan: drop' if dry_run else 'Dropped'} the {done.draft.stage} draft of node {node}."
    app.emit({"uuid": node, "dropped": not dry_run, "drafts": drafts}, text)


draft.add_command(list_, "list")
draft.add_command(drop, "drop")


@command("teds-provision history 8d4d")
@click.argument("uuid")
@pass_app
def history(app: App, uuid: str) -> None:
    """List a node's earlier datasheets, newest first; write UUID --from SEQUENCE restores one, signed again."""
    node, records = provisioning.datasheet_history.history_of(app.station(), uuid)
    rows = [
        {
            "sequence": record.sequence,
            "epoch": record.epoch,
            "signed": record.signed,
            "profile": record.profile,
            "sha256": record.digest,
            "seen": record.seen,
        }
        for record in records
    ]
    lines = [
        f"{row.sequence:>6}  epoch {row.epoch}  {local_time(row.signed or 'not signed'):<25}  {row.profile or ''}"
        for row in records
    ]
    app.emit(
        {"uuid": node.hex(), "history": rows},
        "\n".join(map(str.rstrip, lines)) or f"No datasheets are known for node {node.hex()}.",
    )
