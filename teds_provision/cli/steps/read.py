"""``read``: every TEDS of a node, as an image."""

from __future__ import annotations

import json
from pathlib import Path

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, link_options
from teds_provision.links import LinkSettings


@command("teds-provision read 8d4d --nfc udp:localhost:54321 --output node.json")
@click.argument("uuid")
@click.option(
    "--output", "-o", type=click.Path(path_type=Path, dir_okay=False), metavar="IMAGE", help="Write the image here."
)
@link_options
@pass_app
def read(app: App, uuid: str, output: Path | None, links: LinkSettings) -> None:
    """Read every TEDS of a node, over a session where this station holds its key; look at it with show."""
    from teds_provision.cli.rendering import reporter_for
    from teds_provision.cli.steps.build import write_file
    from teds_provision.steps.agree import session_if_keyed
    from teds_provision.steps.identify import identify
    from teds_provision.steps.read import read_image
    from teds_provision.talk.meeting import meet

    station = app.station()
    octets = station.nodes.resolve(uuid)
    with meet(station, links, octets, reporter_for(app), before=lambda: station.unlock(octets)) as node:
        identify(station, node)
        with station.lock("read", app.note):
            session_if_keyed(station, node)
        image = read_image(node)
        if node.sealed:
            station.nodes.keep_datasheet(image)
    text = image.to_json()
    if output is not None:
        write_file(output, text)
    total = sum(map(len, image.blocks.values()))
    told = f"{len(image.blocks)} TEDS, {total} octets read from {octets.hex()}" + (
        f" into {output}." if output else "."
    )
    app.emit(json.loads(text), told if output is not None else text.rstrip("\n"))
