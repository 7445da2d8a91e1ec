"""``write``: a signed datasheet into the node's flash."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import FileToRead, WholeNumber, command, dry_run_option, link_options, yes_option
from teds_provision.cli.rendering import reporter_for
from teds_provision.errors import UsageFailure
from teds_provision.links import LinkSettings
from teds_provision.steps import visits

if TYPE_CHECKING:
    from teds_provision.steps.write import Written


@command(
    "teds-provision write 8d4d --nfc udp:localhost:54321",
    "teds-provision write 8d4d --image signed.json --via can --can udp_multicast:239.74.163.2",
    "teds-provision write 8d4d --from 3 --nfc udp:localhost:54321",
)
@click.argument("uuid")
@click.option("--image", type=FileToRead(), metavar="IMAGE", help="Write this file's image.")
@click.option(
    "--from",
    "sequence",
    type=WholeNumber(0, 2**32 - 1),
    metavar="SEQUENCE",
    help="Bring back what it had; see history.",
)
@click.option("--retype", is_flag=True, help="The board may become one of another type than it says it is.")
@click.option("--sequence-jump", is_flag=True, help="Write although its sequence is far ahead of the node's.")
@yes_option
@dry_run_option
@link_options
@pass_app
def write(
    app: App,
    uuid: str,
    image: Path | None,
    sequence: int | None,
    retype: bool,
    sequence_jump: bool,
    yes: bool,
    dry_run: bool,
    links: LinkSettings,
) -> None:
    """Write a signed datasheet over a session, commit it, read it back and compare.

    --from brings an older datasheet of the node back, signed anew.
    """
    if sequence is not None:
        if image is not None:
            raise UsageFailure("--from and --image name two datasheets.", hint="Give one of them.")
        _bring_back(app, uuid, sequence, links, dry_run=dry_run)
        return
    confirm = partial(app.confirm, yes=yes)
    done = visits.at_node.write_at(
        app.station(),
        links,
        uuid,
        reporter_for(app),
        file=image,
        dry_run=dry_run,
        jump=confirm if sequence_jump else None,
        low=confirm,
        retype=app.asks_retype(yes=yes),
        retyped=retype,
    )
    node, written = done.image.uuid.hex(), done.written
    if written is None:
        blocks, octets = len(done.image.blocks), sum(map(len, done.image.blocks.values()))
        plan = {"uuid": node, "plan": "write", "blocks": blocks, "octets": octets}
        app.emit(plan, f"Plan: write {blocks} TEDS, {octets} octets, to {node}.")
        return
    app.emit(_told(node, written), f"Node {node}: {_said(written)}.")


def _bring_back(app: App, uuid: str, sequence: int, links: LinkSettings, *, dry_run: bool) -> None:
    done = visits.history.bring_back(app.station(), links, uuid, sequence, reporter_for(app), dry_run=dry_run)
    node, changes = done.uuid.hex(), [change.text for change in done.changes]
    lines = "".join(f"\n  {text}" for text in changes) or "\n  no change of what it has"
    if done.written is None:
        plan = {"uuid": node, "plan": "write", "from": sequence, "changes": changes}
        app.emit(plan, f"Plan: bring the datasheet of sequence {sequence} back to {node}.{lines}")
        return
    result = _told(node, done.written) | {"from": sequence, "sequence": done.sequence, "changes": changes}
    told = f"the datasheet of sequence {sequence} is back, as sequence {done.sequence}"
    app.emit(result, f"Node {node}: {told}; {_said(done.written)}.{lines}")


def _told(node: str, written: Written) -> dict[str, Any]:
    return {
        "uuid": node,
        "octets_written": written.octets,
        "verified": True,
        "seconds": round(written.seconds, 3),
    }


def _said(written: Written) -> str:
    told = f"{written.octets} octets written and read back" if written.octets else "nothing to do, it is there already"
    return f"{told} ({written.seconds:.2f} s)"
