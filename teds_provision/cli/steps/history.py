"""``draft`` and ``history``: what was built and not written, and what a node had."""

from __future__ import annotations

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, dry_run_option, examples, yes_option
from teds_provision.cli.rendering import local_time
from teds_provision.steps import visits


@click.group(epilog=examples("teds-provision draft list", "teds-provision draft drop 8d4d"))
def draft() -> None:
    """What was built and not written: a trial, or a run that was cut."""


@command("teds-provision draft list")
@pass_app
def list_(app: App) -> None:
    """List every draft: the node, its profile, and how far it came."""
    drafts = [
        {"uuid": one.uuid.hex(), "profile": one.profile, "stage": one.stage, "created": one.created}
        for one in app.station().nodes.drafts()
    ]
    lines = [
        f"{one['uuid']}  {one['stage']:<6}  {local_time(str(one['created']))}  {one['profile'] or ''}".rstrip()
        for one in drafts
    ]
    app.emit({"drafts": drafts}, "\n".join(lines) or "Nothing lies ready.")


@command("teds-provision draft drop 8d4d")
@click.argument("uuid")
@yes_option
@dry_run_option
@pass_app
def drop(app: App, uuid: str, yes: bool, dry_run: bool) -> None:
    """Drop the draft of a node: its datasheet stays as it is."""
    del yes  # what was built can be built again
    done = visits.history.drop_draft(app.station(), uuid, dry_run=dry_run)
    node = done.uuid.hex()
    if done.draft is None:
        app.emit({"uuid": node, "dropped": False}, f"Nothing lies ready for node {node}.")
        return
    told = f"{'Plan: drop' if dry_run else 'Dropped'} the {done.draft.stage} draft of node {node}."
    app.emit({"uuid": node, "dropped": not dry_run}, told)


draft.add_command(list_, "list")
draft.add_command(drop, "drop")


@command("teds-provision history 8d4d")
@click.argument("uuid")
@pass_app
def history(app: App, uuid: str) -> None:
    """The datasheets that a node had, newest first; write UUID --from SEQUENCE brings one back, signed anew."""
    node, records = visits.history.history_of(app.station(), uuid)
    told = [
        {
            "sequence": record.sequence,
            "epoch": record.epoch,
            "signed": record.signed,
            "profile": record.profile,
            "sha256": record.digest,
            "seen": record.seen,
        }
        for record in records
    ]
    lines = [
        f"{one.sequence:>6}  epoch {one.epoch}  {local_time(one.signed or 'not signed'):<25}  {one.profile or ''}"
        for one in records
    ]
    app.emit(
        {"uuid": node.hex(), "history": told},
        "\n".join(map(str.rstrip, lines)) or f"No datasheet of node {node.hex()} is known.",
    )
