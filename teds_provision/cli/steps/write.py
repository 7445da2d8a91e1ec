"""``write``: a signed datasheet into the node's flash."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, dry_run_option, link_options, yes_option
from teds_provision.links import LinkSettings


@command(
    "teds-provision write 8d4d --nfc udp:localhost:54321",
    "teds-provision write 8d4d --image signed.json --via can --can udp_multicast:239.74.163.2",
)
@click.argument("uuid")
@click.option(
    "--image", type=click.Path(path_type=Path, dir_okay=False), metavar="IMAGE", help="Write this file's image."
)
@click.option("--sequence-jump", is_flag=True, help="Write although its sequence is far ahead of the node's.")
@yes_option
@dry_run_option
@link_options
@pass_app
def write(
    app: App, uuid: str, image: Path | None, sequence_jump: bool, yes: bool, dry_run: bool, links: LinkSettings
) -> None:
    """Write a signed datasheet over a session, commit it, read it back and compare."""
    from teds_provision.cli.rendering import reporter_for
    from teds_provision.steps.at_node import write_at

    confirm = partial(app.confirm, yes=yes)
    done = write_at(
        app.station(),
        links,
        uuid,
        reporter_for(app),
        file=image,
        dry_run=dry_run,
        jump=confirm if sequence_jump else None,
    )
    node, written = done.image.uuid.hex(), done.written
    if written is None:
        blocks, octets = len(done.image.blocks), sum(map(len, done.image.blocks.values()))
        plan = {"uuid": node, "plan": "write", "blocks": blocks, "octets": octets}
        app.emit(plan, f"Plan: write {blocks} TEDS, {octets} octets, to {node}.")
        return
    result = {
        "uuid": node,
        "octets_written": written.octets,
        "verified": True,
        "seconds": round(written.seconds, 3),
    }
    told = f"{written.octets} octets written and read back" if written.octets else "nothing to do, it is there already"
    app.emit(result, f"Node {node}: {told} ({written.seconds:.2f} s).")
