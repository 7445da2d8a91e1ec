"""``sign``: sign a built datasheet, and say in physical units what changes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, dry_run_option, link_options, yes_option
from teds_provision.cli.rendering import reporter_for
from teds_provision.cli.steps.build import write_file
from teds_provision.links import LinkSettings
from teds_provision.steps import visits


@command("teds-provision sign 8d4d", "teds-provision sign angle.json --output signed.json")
@click.argument("what", metavar="UUID|IMAGE")
@click.option("--output", "-o", type=click.Path(path_type=Path, dir_okay=False), metavar="IMAGE", help="Signed image.")
@click.option("--read-node", is_flag=True, help="Meet the node: take its epoch, sequence and TEDS, not the store's.")
@click.option("--accept-calibration", metavar='"WHY"', help="Take a calibration that the guard refuses; logged.")
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

    Unchanged content, key epoch and signer give back the existing signature.
    """
    del yes  # a signature uses up a sequence number, nothing else
    station = app.station()
    done = visits.sign_command.sign_at(
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
    again = " (the signature that was there still holds)" if done.signed.reused else ""
    app.emit(result, f"{_changes(done.changes)}\nSigned {uuid.hex()}, sequence {done.signed.sequence}{again}.")


def _changes(changes: tuple[str, ...]) -> str:
    return "\n".join(f"  {change}" for change in changes) or "  no change against what the node has"
