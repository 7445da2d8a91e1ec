"""``read``: every TEDS of a node, as an image."""

from __future__ import annotations

import json
from pathlib import Path

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, link_options
from teds_provision.cli.rendering import reporter_for
from teds_provision.cli.steps.build import write_file
from teds_provision.links import LinkSettings
from teds_provision.steps import visits


@command("teds-provision read 8d4d --nfc udp:localhost:54321 --output node.json")
@click.argument("uuid")
@click.option(
    "--output", "-o", type=click.Path(path_type=Path, dir_okay=False), metavar="IMAGE", help="Write the image here."
)
@link_options
@pass_app
def read(app: App, uuid: str, output: Path | None, links: LinkSettings) -> None:
    """Read every TEDS of a node, over a session where this station holds its key; look at it with show.

    Where a key is held and no session came about, nothing is proven: what was heard is shown, no file is written,
    and the exit code is 5.
    """
    done = visits.at_node.read_at(app.station(), links, uuid, reporter_for(app))
    text = done.image.to_json()
    if done.error is not None:
        app.conclude({**json.loads(text), "verdict": "unproven"}, text.rstrip("\n"), done.error)
        return
    if output is not None:
        write_file(output, text)
    total = sum(map(len, done.image.blocks.values()))
    into = f" into {output}." if output else "."
    told = f"{len(done.image.blocks)} TEDS, {total} octets read from {done.image.uuid.hex()}{into}"
    app.emit(json.loads(text), told if output is not None else text.rstrip("\n"))
