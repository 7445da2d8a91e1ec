"""``agree``: a link key for one node."""

from __future__ import annotations

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, dry_run_option, link_options, yes_option
from teds_provision.links import LinkSettings


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

    The first agreement needs a tap (or the bus of a node built without NFC); a rotation goes over any link.
    """
    from teds_provision.cli.rendering import reporter_for
    from teds_provision.steps.agree import agree as run
    from teds_provision.steps.identify import identify
    from teds_provision.talk.meeting import meet

    station = app.station()
    octets = station.nodes.resolve(uuid)
    station.policy.require_whitelisted(octets)
    if dry_run:
        held = [f"{record.state} key of epoch {record.epoch}" for record in station.keys.of(octets)]
        plan = ("rotate" if rotate else "keep") if held else "agree on a first key"
        app.emit(
            {"uuid": octets.hex(), "plan": plan, "held": held}, f"Plan: {plan} ({', '.join(held) or 'no key held'})."
        )
        return
    if station.keys.restored(octets) and links.via != "nfc" and rotate:
        app.confirm(f"Node {octets.hex()} is {station.keys.rotation_due(octets)}. Is it still this station's?", yes=yes)
    meeting = meet(station, links, octets, reporter_for(app), before=station.unlock)
    with meeting as node, station.lock("agree", app.note):
        agreed = run(station, node, identify(station, node), rotate=rotate)
    app.emit(
        {"uuid": octets.hex(), "epoch": agreed.epoch, "key_id": agreed.key_id, "fresh": agreed.fresh},
        f"Node {octets.hex()}: key {agreed.key_id}, epoch {agreed.epoch}"
        + ("." if agreed.fresh else " (nothing to do)."),
    )
