"""``reset``: a node back to factory state, with its signed receipt."""

from __future__ import annotations

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, dry_run_option, link_options, yes_option
from teds_provision.cli.rendering import reporter_for
from teds_provision.links import LinkSettings
from teds_provision.steps import visits


@command("teds-provision reset 8d4d --yes --nfc udp:localhost:54321")
@click.argument("uuid")
@yes_option
@dry_run_option
@link_options
@pass_app
def reset(app: App, uuid: str, yes: bool, dry_run: bool, links: LinkSettings) -> None:
    """Erase a node's key and trust in a session; its identity, epoch and sequence stay.

    The node signs the statement; in factory state it signs it again, so a lost receipt can be fetched.
    """
    station = app.station()
    octets = station.nodes.resolve(uuid)
    if dry_run:
        app.emit({"uuid": octets.hex(), "plan": "reset"}, f"Plan: reset {octets.hex()} to factory state.")
        return
    app.confirm(f"Reset node {octets.hex()}? Its key is erased and its datasheet counts as unsigned.", yes=yes)
    receipt = visits.at_node.reset_at(station, links, octets, reporter_for(app))
    app.emit(
        {
            "uuid": octets.hex(),
            "state": "factory",
            "epoch": receipt.epoch,
            "challenge": receipt.challenge.hex(),
            "proof": receipt.proof.hex(),
        },
        f"Node {octets.hex()} is back in factory state; it signed that at epoch {receipt.epoch}.",
    )
