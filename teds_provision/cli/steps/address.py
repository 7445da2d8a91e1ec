"""``address``: another CAN address for one node."""

from __future__ import annotations

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, dry_run_option, link_options, yes_option
from teds_provision.links import LinkSettings


def _address(_ctx: click.Context, _parameter: click.Parameter, text: str) -> int:
    """Read 1 to 239, decimal or with 0x."""
    try:
        number = int(text, 0)
    except ValueError:
        number = 0
    if not 1 <= number <= 239:
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
    from teds_provision.cli.rendering import reporter_for
    from teds_provision.steps.address import set_address
    from teds_provision.talk.meeting import meet

    del yes  # the old address can be given back the same way
    station = app.station()
    octets = station.nodes.resolve(uuid)
    if dry_run:
        plan = f"Plan: node {octets.hex()} gets CAN address 0x{address:02x}."
        app.emit({"uuid": octets.hex(), "plan": "address", "can_address": address}, plan)
        return
    with meet(station, links, octets, reporter_for(app)) as node, station.lock("address", app.note):
        changed = set_address(station, node, address)
    told = "has" if changed else "has already"
    app.emit(
        {"uuid": octets.hex(), "can_address": address, "changed": changed},
        f"Node {octets.hex()} {told} CAN address 0x{address:02x}.",
    )
