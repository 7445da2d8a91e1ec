"""``label``: QR code and text for a board."""

from __future__ import annotations

from pathlib import Path

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command
from teds_provision.station.label import label_of, write_label


@command("teds-provision label 8d4d --output finger-1.svg", "teds-provision label 8d4d --output finger-1.png")
@click.argument("uuid")
@click.option(
    "--output",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.svg|png",
    help="Where it goes; the ending says which kind.",
)
@pass_app
def label(app: App, uuid: str, output: Path) -> None:
    """Write a label: a QR code with UUID and the whole fingerprint of the node's key, and the same as text.

    What a scanner reads of it is taken by whitelist add, and pins the key before the first tap.
    """
    station = app.station()
    made = label_of(station, station.nodes.resolve(uuid))
    write_label(made, output)
    told = {"label": {"text": made.text, "uuid": made.uuid.hex(), "fingerprint": made.fingerprint, "file": str(output)}}
    app.emit(told, f"{output}: {made.text}")
