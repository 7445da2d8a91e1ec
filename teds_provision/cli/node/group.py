"""``node``: a virtual transducer for trying things out, for tests, and as the other side for firmware authors."""

from __future__ import annotations

from pathlib import Path

import click

from teds_provision import node as node_room
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.node.check import check
from teds_provision.cli.node.create import create
from teds_provision.cli.node.run import run
from teds_provision.cli.options import COMMAND_SETTINGS, examples


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples(
        "teds-provision node create bench/finger",
        "teds-provision node run bench/finger --nfc udp:localhost:54321 --can udp_multicast:239.74.163.2",
    ),
)
def node() -> None:
    """A virtual transducer: the whole node half of the profile, its flash in a file."""


node.add_command(check)
node.add_command(create)
node.add_command(run)


@node.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Reset the node in DIR by hand.",
    epilog=examples("teds-provision node reset bench/finger"),
)
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path, file_okay=False))
@pass_app
def reset(app: App, folder: Path) -> None:
    """Reset the node in DIR by hand (button held 5 s) while it is not running."""
    node = node_room.virtual.VirtualNode(folder, exclusive=True)
    node.reset_by_hand()
    uuid = node.tim.flash.uuid.hex()
    app.emit({"uuid": uuid, "state": "factory"}, f"Node {uuid} is back in factory state.")
