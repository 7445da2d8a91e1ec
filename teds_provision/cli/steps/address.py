"""``address``: another CAN address for one node."""

from __future__ import annotations

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, dry_run_option, link_options, yes_option
from teds_provision.cli.rendering import reporter_for
from teds_provision.links import LinkSettings
from teds_provision.protocol.announce import LAST_ADDRESS
from teds_provision.steps import visits


def _address(_ctx: click.Context, _parameter: click.Parameter, text: str) -> int:
    """Read 1 to 239, decimal or with 0x."""
    try:
        number = int(text, 0)
    except ValueError:
        number = 0
    if not 1 <= number <= LAST_ADDRESS:
        raise click.BadParameter("a CAN address is 1 to 239 (0x01 to 0xEF).")
    return number


@command("teds-provision address 8d4d 0x21 --nfc udp:localhost:54321")
@click.argument("uuid")
@click.argument("address", callback=_address)
@yes_option
@dry_run_option
@link_options
@pass_app
def address(app: App, uuid: str, address: int, yes: bool, dry_run: bool, links: LinkSettings) -> None:
    """Give a node another CAN address, 1 to 239, for good: by tap, or in a session where its key is held."""
    del yes  # the old address can be given back the same way
    done = visits.at_node.set_address_at(app.station(), links, uuid, address, reporter_for(app), dry_run=dry_run)
    node = done.uuid.hex()
    if done.changed is None:
        plan = f"Plan: node {node} gets CAN address 0x{address:02x}."
        app.emit({"uuid": node, "plan": "address", "can_address": address}, plan)
        return
    told = "has" if done.changed else "has already"
    app.emit(
        {"uuid": node, "can_address": address, "changed": done.changed},
        f"Node {node} {told} CAN address 0x{address:02x}.",
    )
