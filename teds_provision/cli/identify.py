"""``identify``: which node lies there, and can it prove it."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING, Any

import click

from teds_provision import steps, talk
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, link_options
from teds_provision.cli.rendering import reporter_for
from teds_provision.links import LinkSettings

if TYPE_CHECKING:
    from teds_provision.steps.commands import ProvenNode


@command(
    "teds-provision identify --nfc udp:localhost:54321 --add",
    "teds-provision --json identify --via can --can udp_multicast:239.74.163.2",
)
@click.option("--watch", is_flag=True, help="Keep watching: one line per node.")
@click.option("--add", is_flag=True, help="Whitelist nodes that prove their key.")
@link_options
@pass_app
def identify(app: App, links: LinkSettings, watch: bool, add: bool) -> None:
    """Wait for a tap, read the node's UUID and key, and have it prove that it holds the key.

    With --via can, every node on the bus is asked; --json lists several under "nodes".
    """
    stop = talk.meeting.IdleStop(None)
    if watch:
        signal.signal(signal.SIGTERM, lambda *_: stop.ask())
    several = len(links.places) > 1
    found: list[dict[str, Any]] = []
    for arrival in steps.commands.identify_at(
        app.station(), links, reporter_for(app, several=several), add=add, watch=watch, stop=stop
    ):
        if arrival.error is not None:
            app.fail_line(arrival.error, uuid=arrival.uuid.hex(), time=arrival.time)
        elif arrival.result is not None:
            found.append(_to_json(arrival.result))
            if watch:
                _emit(app, found.pop() | {"time": arrival.time})
    if not watch:
        _emit(app, found[0] if len(found) == 1 else {**found[0], "nodes": found})


def _to_json(found: ProvenNode) -> dict[str, Any]:
    who, identity = found.who, found.identity
    return {
        "uuid": who.uuid.hex(),
        "fingerprint": who.fingerprint,
        "tag_uid": None if who.tag_uid is None else who.tag_uid.hex(),
        "state": who.state.name.lower(),
        "whitelisted": found.whitelisted,
        "channels": found.channels,
        "name": found.name,
        "epoch": identity.epoch,
        "sequence": identity.sequence,
        "can_address": identity.can_address,
        "charging": found.charging,
        "ble": found.ble,
    }


def _emit(app: App, found: dict[str, Any]) -> None:
    app.emit(found, "\n".join(map(_line, found.get("nodes", [found]))))


def _line(found: dict[str, Any]) -> str:
    listed = "whitelisted" if found["whitelisted"] else "not whitelisted"
    name = f"  {found['name']}" if found["name"] else ""
    tag = f"  tag {found['tag_uid']}" if found["tag_uid"] else ""
    charge = f"  {found['charging']['text']}" if found["charging"] else ""
    return f"{found['uuid']}  key {found['fingerprint'][:16]}  {found['state']}  {listed}{name}{tag}{charge}"
