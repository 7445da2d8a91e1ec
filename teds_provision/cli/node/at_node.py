"""``identify``, ``agree``, ``reset``, ``address``: what a person has one node do, each a meeting with it."""

from __future__ import annotations

import re
import signal
from typing import Any

import click

from teds_provision import provisioning
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, dry_run_option, link_options, yes_option
from teds_provision.cli.rendering import firmware_words, reporter_for, time_for
from teds_provision.errors import UsageError
from teds_provision.links import LINKS, LinkSettings, Notice
from teds_provision.protocol.announce import LAST_ADDRESS
from teds_provision.protocol.messages.firmware import LOCATE_SECONDS
from teds_provision.provisioning.progress import Reporter, StepResult
from teds_provision.station.store.records import utc_now

# -- identify ----------------------------------------------------------------------------------------------------------


@command(
    "teds-provision identify --nfc udp:localhost:54321 --add",
    "teds-provision --json identify --via can --can udp_multicast:239.74.163.2",
)
@click.option("--watch", is_flag=True, help="Keep watching: one line per node.")
@click.option("--add", is_flag=True, help="Whitelist nodes that prove their key.")
@click.option("--locate", "locating", is_flag=True, help="Make each board blink in turn, and ask for its name.")
@dry_run_option
@link_options
@pass_app
def identify(app: App, links: LinkSettings, watch: bool, add: bool, locating: bool, dry_run: bool) -> None:
    """Wait for a tap, read the node's UUID and key, and have it prove that it holds the key.

    With --via can, every node on the bus is asked; --json lists them under "nodes". A board whose button is pressed
    meanwhile says so.
    """
    if locating:
        _require_a_person(app, watch, dry_run)
    stop = provisioning.meeting.IdleStop(None)
    if watch:
        signal.signal(signal.SIGTERM, lambda *_: stop.request_stop())
    several = len(links.places) > 1
    found: list[dict[str, Any]] = []
    reporter = reporter_for(app, several=several)
    for arrival in provisioning.identify.identify_at(
        app.station(),
        links,
        PressLines(app, reporter) if watch else reporter,
        add=add,
        watch=watch,
        stop=stop,
        dry_run=dry_run,
    ):
        if arrival.error is not None:
            app.fail_line(arrival.error, uuid=arrival.uuid.hex(), time=time_for(app, arrival.time))
        elif arrival.result is not None:
            found.append(_to_json(arrival.result) | (_plan(arrival.result, add=add) if dry_run else {}))
            if watch:
                _emit(app, found.pop() | {"time": arrival.time})
    if locating:
        _locate_each(app, links, found, reporter)
    elif not watch:
        listed = len(found) > 1 or LINKS[links.via].capabilities.many
        _emit(app, {**found[0], "nodes": found} if listed else found[0])


class PressLines:
    """A reporter that prints a separate line for each board whose button was pressed."""

    def __init__(self, app: App, inner: Reporter) -> None:
        self._app, self._inner = app, inner

    def started(self, step: str) -> None:
        """Report the start of a step."""
        self._inner.started(step)

    def finished(self, step: StepResult) -> None:
        """Report a step that ended well."""
        self._inner.finished(step)

    def notice(self, notice: Notice) -> None:
        """Print a press, pass on anything else."""
        if notice.kind != "pressed" or notice.uuid is None:
            self._inner.notice(notice)
            return
        line = {"uuid": notice.uuid.hex(), "pressed": True, "time": utc_now()}
        self._app.emit(line, f"{notice.uuid.hex()}  says it was pressed")

    def written(self, octets: int, total: int) -> None:
        """Report how many octets of a datasheet are staged."""
        self._inner.written(octets, total)


def _to_json(found: provisioning.identify.ProvenNode) -> dict[str, Any]:
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
        "firmware": found.firmware and found.firmware.to_json(),
        "pressed": found.pressed,
    }


def _plan(found: provisioning.identify.ProvenNode, *, add: bool) -> dict[str, Any]:
    return {"plan": ["whitelist"] if add and not found.whitelisted else []}


def _emit(app: App, found: dict[str, Any]) -> None:
    app.emit(found, "\n".join(map(_line, found.get("nodes", [found]))))


def _line(found: dict[str, Any]) -> str:
    listed = "whitelisted" if found["whitelisted"] else "not whitelisted"
    listed = "would be whitelisted" if found.get("plan") else listed
    name = f"  {found['name']}" if found["name"] else ""
    tag = f"  tag {found['tag_uid']}" if found["tag_uid"] else ""
    charge = f"  {found['charging']['text']}" if found["charging"] else ""
    runs = firmware_words(found["firmware"])
    pressed = "  says it was pressed" if found["pressed"] else ""
    text = f"{name}{tag}{charge}{runs and f'  {runs}'}{pressed}"
    return f"{found['uuid']}  key {found['fingerprint'][:16]}  {found['state']}  {listed}{text}"


# -- locate ------------------------------------------------------------------------------------------------------------


_SPAN = re.compile(r"(\d+) ?(s|min)?")


def _span(_ctx: click.Context, _parameter: click.Parameter, text: str) -> int:
    """Read seconds: 10, 10s, 1min; at most a minute."""
    found = _SPAN.fullmatch(text.strip())
    seconds = int(found[1]) * (60 if found[2] == "min" else 1) if found is not None else -1
    if not 0 <= seconds <= LOCATE_SECONDS:
        raise click.BadParameter(f"0 to {LOCATE_SECONDS} seconds are expected, such as 10s; 0 stops.")
    return seconds


@command(
    "teds-provision locate 8d4d --via can --can socketcan:can0",
    "teds-provision locate finger-3 --for 30s --via can",
)
@click.argument("uuid")
@click.option("--for", "seconds", callback=_span, default="10s", show_default=True, metavar="TIME", help="0 stops it.")
@link_options
@pass_app
def locate(app: App, uuid: str, seconds: int, links: LinkSettings) -> None:
    """Make a board blink or beep, so that you see which one it is.

    A node that has a key does so in a session, a node in factory state for anyone.
    """
    (done,) = provisioning.locate.locate_at(app.station(), links, [uuid], seconds, reporter_for(app))
    if isinstance(done, tuple):
        raise done[1]
    who = f"{done.name or 'Node'} ({done.uuid.hex()})"
    app.emit(
        {"located": [{"uuid": done.uuid.hex(), "name": done.name}]},
        f"{who} blinks for {seconds} s." if seconds else f"{who} no longer blinks.",
    )


def _require_a_person(app: App, watch: bool, dry_run: bool) -> None:
    if dry_run:
        raise UsageError("--locate makes boards blink, so it cannot be combined with --dry-run.")
    if watch:
        raise UsageError("--locate takes the boards that are there now, so it cannot be combined with --watch.")
    if not app.interactive:
        raise UsageError("--locate asks for a name for each board, so it needs a terminal.", hint="Use locate UUID.")


def _locate_each(app: App, links: LinkSettings, found: list[dict[str, Any]], reporter: Reporter) -> None:
    """Make each board blink, ask for its name, and keep it; an empty answer keeps the one that it has."""
    located = []
    uuids = [board["uuid"] for board in found]

    def ask(uuid: bytes, name: str) -> str:
        number = uuids.index(uuid.hex()) + 1
        return app.ask_text(f"Board {number} of {len(uuids)} ({uuid.hex()}) blinks. Its name", name)

    for done in provisioning.locate.locate_at(app.station(), links, uuids, LOCATE_SECONDS, reporter, ask_name=ask):
        if isinstance(done, tuple):
            app.fail_line(done[1], uuid=done[0].hex())
        else:
            located.append({"uuid": done.uuid.hex(), "name": done.name})
    app.emit({"located": located}, "\n".join(f"{board['uuid']}  {board['name'] or '(no name)'}" for board in located))


# -- agree, reset, address ---------------------------------------------------------------------------------------------


@command(
    "teds-provision agree 8d4d --nfc udp:localhost:54321",
    "teds-provision agree 8d4d --rotate --via can --can udp_multicast:239.74.163.2",
)
@click.argument("uuid")
@click.option("--rotate", is_flag=True, help="Replace the existing key with a new one.")
@yes_option
@dry_run_option
@link_options
@pass_app
def agree(app: App, uuid: str, links: LinkSettings, rotate: bool, yes: bool, dry_run: bool) -> None:
    """Agree on a key with a whitelisted node; if it already has one, do nothing, or --rotate it.

    The first agreement needs a tap (or the bus of a node built without NFC); a rotation works over any link. A node
    keyed by another station is taken over by tap after confirmation, or with --rotate --yes; that locks the other
    station out.
    """

    def confirm(question: str) -> None:
        app.confirm(question, yes=yes and rotate, named="--rotate")

    done = provisioning.agree.agree_at(
        app.station(), links, uuid, reporter_for(app), rotate=rotate, dry_run=dry_run, confirm=confirm
    )
    node, agreed = done.uuid.hex(), done.agreed
    if agreed is None:
        text = f"Plan: {done.plan} ({', '.join(done.held) or 'no key yet'})."
        app.emit({"uuid": node, "plan": done.plan, "held": list(done.held)}, text)
        return
    again = "." if agreed.fresh else " (nothing to do)."
    app.emit(
        {"uuid": node, "epoch": agreed.epoch, "key_id": agreed.key_id, "fresh": agreed.fresh},
        f"Node {node}: key {agreed.key_id}, epoch {agreed.epoch}{again}",
    )


@command("teds-provision reset 8d4d --yes --nfc udp:localhost:54321")
@click.argument("uuid")
@yes_option
@dry_run_option
@link_options
@pass_app
def reset(app: App, uuid: str, yes: bool, dry_run: bool, links: LinkSettings) -> None:
    """Erase a node's key and trust in a session; its identity, epoch and sequence remain.

    The node signs a receipt. A node in factory state signs it again, so a lost receipt can be fetched.
    """
    station = app.station()
    octets = station.nodes.resolve(uuid)
    if dry_run:
        app.emit({"uuid": octets.hex(), "plan": "reset"}, f"Plan: reset {octets.hex()} to factory state.")
        return
    app.confirm(f"Reset node {octets.hex()}? Its key is erased, and its datasheet becomes unsigned.", yes=yes)
    receipt = provisioning.agree.reset_at(station, links, octets, reporter_for(app))
    app.emit(
        {
            "uuid": octets.hex(),
            "state": "factory",
            "epoch": receipt.epoch,
            "challenge": receipt.challenge.hex(),
            "proof": receipt.proof.hex(),
        },
        f"Node {octets.hex()} is back in factory state and signed a receipt (epoch {receipt.epoch}).",
    )


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
    """Permanently change a node's CAN address, 1 to 239: by tap, or in a session if its key is held."""
    del yes  # not needed: the change can be undone with the same command
    done = provisioning.address.set_address_at(app.station(), links, uuid, address, reporter_for(app), dry_run=dry_run)
    node = done.uuid.hex()
    if done.changed is None:
        plan = f"Plan: change the CAN address of node {node} to 0x{address:02x}."
        app.emit({"uuid": node, "plan": "address", "can_address": address}, plan)
        return
    state = "now has" if done.changed else "already has"
    app.emit(
        {"uuid": node, "can_address": address, "changed": done.changed},
        f"Node {node} {state} CAN address 0x{address:02x}.",
    )
