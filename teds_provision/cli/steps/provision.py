"""``provision``: from tap to verified datasheet in one command."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, dry_run_option, link_options, yes_option
from teds_provision.cli.steps.build import order_options
from teds_provision.errors import NotWhitelisted, TedsProvisionError
from teds_provision.links import LinkSettings

if TYPE_CHECKING:
    from rich.console import Console

    from teds_provision.station.station import Station
    from teds_provision.steps.identify import Identified
    from teds_provision.steps.provision import Provisioned
    from teds_provision.talk.conversation import Conversation
    from teds_provision.talk.progress import Reporter


@command(
    "teds-provision provision --profile tactile-finger-sensor --nfc udp:localhost:54321",
    "teds-provision provision --profile magnetic-angular-position-sensor --calibration angle.csv --yes",
    "teds-provision provision --watch --yes --profile load-cell",
)
@click.argument("uuid", required=False)
@order_options
@click.option("--watch", is_flag=True, help="Tap after tap, until Ctrl-C.")
@yes_option
@dry_run_option
@link_options
@pass_app
def provision(
    app: App, uuid: str | None, order: Any, watch: bool, yes: bool, dry_run: bool, links: LinkSettings
) -> None:
    """Identify, whitelist, agree, build, sign, write and verify; carries on where an earlier run stopped.

    --yes accepts the node that lies on the reader. A finished node is left as it is.
    """
    from teds_provision.cli.rendering import reporter_for
    from teds_provision.steps.build import check_order
    from teds_provision.talk.meeting import meet

    station, reporter = app.station(), reporter_for(app)
    wanted = station.nodes.resolve(uuid) if uuid is not None else None
    check_order(station, wanted, order)
    run = _runner(app, station, order, yes, reporter)
    if dry_run:
        with meet(station, links, wanted, reporter) as node:
            _plan(app, station, node)
        return
    if watch:
        station.unlock()
        _watch(app, station, links, run, reporter)
        return
    with meet(station, links, wanted, reporter, before=station.unlock) as node:
        done = run(node)
    _tell(app, done)


def _runner(
    app: App, station: Station, order: Any, yes: bool, reporter: Reporter
) -> Callable[[Conversation], Provisioned]:
    from teds_provision.steps.identify import examine
    from teds_provision.steps.provision import provision as run

    accepted: set[tuple[bytes, str]] = set()

    def accept(who: Identified) -> None:
        if yes or (who.uuid, who.fingerprint) in accepted:
            return
        if not app.interactive:
            raise NotWhitelisted(
                f"Node {who.uuid.hex()} is not on the whitelist, and nobody can be asked.",
                hint=f"Add --yes, or: teds-provision whitelist add {who.uuid.hex()} --fingerprint {who.fingerprint}",
            )
        app.confirm(f"Whitelist node {who.uuid.hex()} with key {who.fingerprint[:16]}?", yes=False)
        accepted.add((who.uuid, who.fingerprint))

    def one(node: Conversation) -> Provisioned:
        if app.interactive and not yes and station.pins.entry(node.uuid) is None:
            accept(examine(station, node))  # before the store is locked: people take their time
        with station.lock("provision", app.note):
            done = run(station, node, order, accept=accept, reporter=reporter)
        for warning in done.warnings:
            app.warn(warning)
        return done

    return one


def _watch(
    app: App, station: Station, links: LinkSettings, run: Callable[[Conversation], Provisioned], reporter: Reporter
) -> None:
    from teds_provision.talk.watching import watch_nodes

    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    for outcome in watch_nodes(station, links, run, reporter, stop):
        if isinstance(outcome, TedsProvisionError):
            app.fail_line(outcome)
        else:
            _tell(app, outcome, last=False)


def _plan(app: App, station: Station, node: Conversation) -> None:
    from teds_provision.protocol.messages.identity import NodeState
    from teds_provision.steps.identify import examine

    who = examine(station, node)
    steps = ["identify"]
    steps += [] if who.whitelisted else ["whitelist"]
    steps += ["agree"] if who.state == NodeState.FACTORY or not station.keys.held(who.uuid) else []
    steps += ["build", "sign", "write", "verify"]
    text = f"Plan for {who.uuid.hex()} ({who.state.name.lower()}): {', '.join(steps)}."
    app.emit({"uuid": who.uuid.hex(), "state": who.state.name.lower(), "plan": steps}, text)


def _tell(app: App, done: Provisioned, *, last: bool = True) -> None:
    """Tell one node's end; ``last`` ends the command with the error of a datasheet that is not authentic."""
    from teds_provision.station.summary import summarise
    from teds_provision.steps.verify import require_authentic

    error: TedsProvisionError | None = None
    try:
        require_authentic(done.verified)
    except TedsProvisionError as failure:
        error = failure
    summary = summarise(done.image)
    app.conclude(
        {
            "uuid": done.who.uuid.hex(),
            "fingerprint": done.who.fingerprint,
            "name": summary.name,
            "channels": [vars(channel) for channel in summary.channels],
            "steps": [{"name": s.name, "result": s.result, "seconds": s.seconds} for s in done.steps],
            "verdict": done.verified.verdict,
            "warnings": list(done.warnings),
        },
        lambda console: _summary(console, done),
        error if last else None,
    )


def _summary(console: Console, done: Provisioned) -> None:
    from rich.markup import escape
    from rich.table import Table

    from teds_provision.cli.rendering import print_table
    from teds_provision.station.summary import summarise

    summary = summarise(done.image)
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_row("node", f"[bold]{escape(summary.name or '(no name)')}[/]")
    table.add_row("UUID", done.who.uuid.hex())
    table.add_row("key", done.who.fingerprint[:16])
    for channel in summary.channels:
        calibrated = ", calibrated" if channel.calibrated else ""
        table.add_row(f"channel {channel.number}", f"{escape(channel.name)}  {channel.range}{calibrated}".strip())
    verdict = done.verified.verdict
    table.add_row("verdict", f"[bold {'green' if verdict == 'authentic' else 'red'}]{verdict}[/]")
    print_table(console, table)
