"""``identify``: which node lies there, and can it prove it."""

from __future__ import annotations

import signal
import threading
from typing import Any

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, link_options
from teds_provision.links import LinkSettings


@command(
    "teds-provision identify --nfc udp:localhost:54321 --add",
    "teds-provision --json identify --via can --can udp_multicast:239.74.163.2",
)
@click.option("--watch", is_flag=True, help="Go on: one line per node that comes.")
@click.option("--add", is_flag=True, help="Whitelist what proves its key.")
@link_options
@pass_app
def identify(app: App, links: LinkSettings, watch: bool, add: bool) -> None:
    """Wait for a tap; read UUID and key, and have the node prove that it holds it.

    Over --via can every node on the bus is asked; with --json several are listed under "nodes".
    """
    from teds_provision.cli.rendering import reporter_for
    from teds_provision.talk.meeting import meet_everyone

    station, reporter = app.station(), reporter_for(app)
    if add:
        station.unlock()  # before a node lies there: a pin is sealed by the vault
    if not watch:
        with meet_everyone(links, reporter) as nodes:
            found = [_one(station, node, add) for node in nodes]
        _emit(app, found[0] if len(found) == 1 else {**found[0], "nodes": found})
        return
    from teds_provision.talk.watching import watch_nodes

    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    for outcome in watch_nodes(station, links, lambda node: _one(station, node, add), reporter, stop):
        if isinstance(outcome, dict):
            _emit(app, outcome)
        else:
            app.fail_line(outcome)


def _one(station: Any, node: Any, add: bool) -> dict[str, Any]:
    from teds_provision.steps.identify import describe
    from teds_provision.steps.identify import identify as run
    from teds_provision.steps.provision import add_to_whitelist

    who = run(station, node)
    described = describe(node)
    with station.lock("identify"):
        entry = who.whitelisted
        if entry is None and add:
            entry = add_to_whitelist(station, node, who)
        known = station.nodes.get(who.uuid)
        name = (known.name if known else None) or described.name
        station.nodes.remember(who.uuid, name=name, channels=described.channels)
        station.audit("identify", who.uuid, "proven", fingerprint=who.fingerprint)
    return {
        "uuid": who.uuid.hex(),
        "fingerprint": who.fingerprint,
        "tag_uid": None if who.tag_uid is None else who.tag_uid.hex(),
        "state": who.state.name.lower(),
        "whitelisted": entry is not None,
        "channels": described.channels,
        "name": name,
        "epoch": node.identity.epoch,
        "sequence": node.identity.sequence,
        "can_address": node.identity.can_address,
        "charging": node.contact.charging.to_json() if node.contact.charging else None,
        "ble": node.contact.ble.text if node.contact.ble else None,
    }


def _emit(app: App, found: dict[str, Any]) -> None:
    app.emit(found, "\n".join(map(_line, found.get("nodes", [found]))))


def _line(found: dict[str, Any]) -> str:
    listed = "whitelisted" if found["whitelisted"] else "not whitelisted"
    name = f"  {found['name']}" if found["name"] else ""
    tag = f"  tag {found['tag_uid']}" if found["tag_uid"] else ""
    charge = f"  {found['charging']['text']}" if found["charging"] else ""
    return f"{found['uuid']}  key {found['fingerprint'][:16]}  {found['state']}  {listed}{name}{tag}{charge}"
