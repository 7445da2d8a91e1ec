"""``signer``: the office, which signs what a line builds."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from teds_provision import plant, protocol, talk
from teds_provision.cli.build import read_file, write_file
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import COMMAND_SETTINGS, FileToRead, Seconds, command, examples
from teds_provision.errors import NotAuthentic
from teds_provision.teds.image import SECURITY

if TYPE_CHECKING:
    from collections.abc import Sequence

    from teds_provision.plant.office import Answered
    from teds_provision.station.station import Station

_LOOK_SECONDS = 0.2
_MOST_WAIT_SECONDS = 1.0


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples(
        "teds-provision signer run --job 0b5f --files /media/stick",
        "teds-provision signer once request.jws --output signed.json",
    ),
)
def signer() -> None:
    """Sign what a line builds: every datasheet is rebuilt here before it is signed."""


@command("teds-provision signer run --job 0b5f --files /media/stick", name="run")
@click.option("--job", "jobs", multiple=True, required=True, metavar="ID", help="Sign for this job; repeatable.")
@click.option(
    "--files",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Transfer folder, instead of the registry.",
)
@click.option(
    "--for", "seconds", type=Seconds(min=0), metavar="SECONDS", help="Stop after this time (default: Ctrl-C)."
)
@pass_app
def run(app: App, jobs: Sequence[str], files: Path | None, seconds: float | None) -> None:
    """Answer requests until Ctrl-C, one line each.

    A request is signed if its board signed it, its job allows it, and the datasheet built here is the same.
    """
    station = app.station()
    ids = {plant.jobs.find_job(station, job).id for job in jobs}
    station.unlock()
    post = plant.asking.post_of(station, files)
    app.closing(post.close)
    inbox = plant.asking.Inbox(station, post, protocol.plant.document.SIGN_REQUEST)
    app.closing(inbox.close)
    stop = talk.meeting.IdleStop(None)
    signal.signal(signal.SIGTERM, lambda *_: stop.ask())
    if seconds is not None:
        threading.Timer(seconds, stop.set).start()
    app.note(f"Signing for {len(ids)} job{'' if len(ids) == 1 else 's'}; Ctrl-C ends it.")
    while True:
        for one in plant.office.answer_all(station, post, inbox, ids, stop=stop.is_set):
            _tell(app, station, one)
        if stop.is_set():
            return
        inbox.wait(_MOST_WAIT_SECONDS, _LOOK_SECONDS)


@command(
    "teds-provision signer once request.jws --output signed.json",
    "teds-provision signer once request.jws --output answer.jws",
    name="once",
)
@click.argument("file", type=FileToRead(), metavar="FILE")
@click.option(
    "--output",
    "-o",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="FILE.json for the signed image (see: write --image), otherwise the answer.",
)
@click.option("--jump", is_flag=True, help="Accept a sequence far above the one known here.")
@pass_app
def once(app: App, file: Path, output: Path, jump: bool) -> None:
    """Answer one request that came as a file.

    `sign UUID --by OFFICE --output FILE` creates it. This station must know its job: teds-provision job show FILE.
    """
    station = app.station()
    station.unlock()
    octets = read_file(file).strip()
    sealed = plant.office.answer(station, octets, jump=jump)
    if sealed is None:
        raise NotAuthentic(
            f"{file} is not a request from a member of this plant to this office.",
            hint="To create one: teds-provision sign UUID --by OFFICE --output FILE",
        )
    request = protocol.plant.signing.open_request(octets, plant.jobs.roster_of(station).point_of)
    answered = protocol.plant.signing.open_answer(sealed, lambda kid: station.point)
    if output.suffix != ".json":
        write_file(output, sealed.decode())
    elif answered.security:
        write_file(output, request.image.with_block(SECURITY, answered.security).to_json())
    _tell(app, station, plant.office.Answered(request, answered), end=True)


def _tell(app: App, station: Station, one: Answered, *, end: bool = False) -> None:
    request, answered = one.request, one.answer
    told: dict[str, Any] = {"uuid": request.uuid.hex(), "job": request.job, "from": request.signer}
    roster = station.plant.roster
    name = roster.name_of(request.signer) if roster is not None else request.signer[:16]
    if not answered.refused:
        app.emit({**told, "sequence": answered.sequence}, f"signed   {request.uuid.hex()}  {answered.sequence}  {name}")
        return
    if end:
        raise plant.asking.OfficeRefused(f"Not signed ({answered.refused}): {answered.why}.")
    refused = {**told, "refused": answered.refused, "why": answered.why}
    app.emit(refused, f"refused  {request.uuid.hex()}  {answered.refused}  {name}: {answered.why}")


for one in (run, once):
    signer.add_command(one)
