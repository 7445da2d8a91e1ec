"""``agree``: a link key for one node."""

from __future__ import annotations

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, dry_run_option, link_options, yes_option
from teds_provision.cli.rendering import reporter_for
from teds_provision.links import LinkSettings
from teds_provision.steps import visits


@command(
    "teds-provision agree 8d4d --nfc udp:localhost:54321",
    "teds-provision agree 8d4d --rotate --via can --can udp_multicast:239.74.163.2",
)
@click.argument("uuid")
@click.option("--rotate", is_flag=True, help="Make a new key although there is one.")
@yes_option
@dry_run_option
@link_options
@pass_app
def agree(app: App, uuid: str, links: LinkSettings, rotate: bool, yes: bool, dry_run: bool) -> None:
    """Agree on a key with a whitelisted node; on a node that has one, do nothing, or --rotate it.

    The first agreement needs a tap (or the bus of a node built without NFC); a rotation goes over any link. A node that
    has a key of another station is taken over by tap, after a question, or with --rotate --yes: that one is locked out.
    """

    def confirm(question: str) -> None:
        app.confirm(question, yes=yes and rotate, named="--rotate")

    done = visits.at_node.agree_at(
        app.station(), links, uuid, reporter_for(app), rotate=rotate, dry_run=dry_run, confirm=confirm
    )
    node, agreed = done.uuid.hex(), done.agreed
    if agreed is None:
        told = f"Plan: {done.plan} ({', '.join(done.held) or 'no key held'})."
        app.emit({"uuid": node, "plan": done.plan, "held": list(done.held)}, told)
        return
    again = "." if agreed.fresh else " (nothing to do)."
    app.emit(
        {"uuid": node, "epoch": agreed.epoch, "key_id": agreed.key_id, "fresh": agreed.fresh},
        f"Node {node}: key {agreed.key_id}, epoch {agreed.epoch}{again}",
    )
