"""``write``: a signed datasheet into the node's flash."""

from __future__ import annotations

from pathlib import Path

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command, dry_run_option, link_options, yes_option
from teds_provision.links import LinkSettings


@command(
    "teds-provision write 8d4d --nfc udp:localhost:54321",
    "teds-provision write 8d4d --image signed.json --via can --can udp_multicast:239.74.163.2",
)
@click.argument("uuid")
@click.option(
    "--image", type=click.Path(path_type=Path, dir_okay=False), metavar="IMAGE", help="Write this file's image."
)
@click.option("--sequence-jump", is_flag=True, help="Write although its sequence is far ahead of the node's.")
@yes_option
@dry_run_option
@link_options
@pass_app
def write(
    app: App, uuid: str, image: Path | None, sequence_jump: bool, yes: bool, dry_run: bool, links: LinkSettings
) -> None:
    """Write a signed datasheet over a session, commit it, read it back and compare."""
    from teds_provision.cli.rendering import reporter_for
    from teds_provision.cli.steps.build import read_file
    from teds_provision.errors import BadData, NotFound, PolicyRefused
    from teds_provision.steps.agree import require_session
    from teds_provision.steps.identify import identify
    from teds_provision.steps.write import write as run
    from teds_provision.talk.meeting import meet
    from teds_provision.teds.image import Image

    station, reporter = app.station(), reporter_for(app)
    octets = station.nodes.resolve(uuid)
    station.policy.require_whitelisted(octets)
    draft = station.nodes.draft(octets)
    if image is not None:
        wanted = Image.from_json(read_file(image))
    elif draft is not None:
        wanted = draft.image
    elif (known := station.nodes.datasheet(octets)) is not None and known.unsigned_blocks():
        wanted = known  # written already: the same command once more
    else:
        raise NotFound(f"Nothing is built for node {octets.hex()}.", hint="build and sign it first, or give --image.")
    if wanted.uuid != octets:
        raise PolicyRefused(f"The image is for node {wanted.uuid.hex()}, not for {octets.hex()}.")
    if wanted.security is None:
        raise BadData("The image holds no Security TEDS.", hint=f"Sign it first: teds-provision sign {octets.hex()}")
    total = sum(map(len, wanted.blocks.values()))
    if dry_run:
        plan = {"uuid": octets.hex(), "plan": "write", "blocks": len(wanted.blocks), "octets": total}
        app.emit(plan, f"Plan: write {len(wanted.blocks)} TEDS, {total} octets, to {octets.hex()}.")
        return
    if sequence_jump:
        app.confirm("The sequence of this node is then used up that far, for good. Write it?", yes=yes)
    meeting = meet(station, links, octets, reporter, before=lambda: station.unlock(octets))
    with meeting as node, station.lock("write", app.note):
        identify(station, node)
        require_session(station, node)
        written = run(station, node, wanted, progress=reporter.written, jump=sequence_jump)
    result = {
        "uuid": octets.hex(),
        "octets_written": written.octets,
        "verified": True,
        "seconds": round(written.seconds, 3),
    }
    told = f"{written.octets} octets written and read back" if written.octets else "nothing to do, it is there already"
    app.emit(result, f"Node {octets.hex()}: {told} ({written.seconds:.2f} s).")
