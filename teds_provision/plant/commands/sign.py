"""``sign``: what the line adds: --by, an office that signs in place of this station."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from teds_provision import plant
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.extending import add_examples, add_options, callback_of, option_of
from teds_provision.cli.options import FileToRead, link_options
from teds_provision.cli.rendering import reporter_for
from teds_provision.links import LinkSettings


def extend(command: click.Command) -> None:
    """Add --by, --job, --calibration and --files."""
    core = callback_of(command)

    def sign(*, by: str | None, job: str | None, calibration: Path | None, files: Path | None, **rest: Any) -> None:
        if by is None:
            core(**rest)
        else:
            _sign_by(by=by, job=job, calibration=calibration, files=files, **rest)

    option_of(command, "--output").help = "Write the signed image to this file; with --by, the request."
    add_options(
        command,
        "--output",
        click.Option(
            ["--by"], metavar="OFFICE", help="Have this station of the plant sign; the node must be reachable."
        ),
        click.Option(["--job"], metavar="ID", help="With --by: the job that the board belongs to."),
        click.Option(
            ["--calibration"],
            type=FileToRead(),
            metavar="FILE",
            help="With --by: the calibration that it was built with.",
        ),
        click.Option(
            ["--files"],
            type=click.Path(path_type=Path, file_okay=False),
            metavar="DIR",
            help="With --by: transfer folder to the office, instead of the registry.",
        ),
    )
    add_examples(
        command, "--output signed.json", "teds-provision sign 8d4d --by office --job 0b5f --output request.jws"
    )
    command.callback = sign


@link_options
@pass_app
def _sign_by(
    app: App,
    /,
    *,
    what: str,
    output: Path | None,
    by: str,
    job: str | None,
    calibration: Path | None,
    files: Path | None,
    links: LinkSettings,
    **_rest: Any,
) -> None:
    """Have an office sign; with an output the request is written, and signed when its answer comes as a file."""
    order = plant.sign_requests.OfficeOrder(what, by, job, calibration, files, output)
    try:
        signed = plant.sign_requests.sign_by_office(app.station(), links, order, reporter_for(app))
    except plant.sign_requests.OfficeSilentError as waits:
        if order.output is None:
            raise
        app.emit({"request": str(order.output)}, f"Wrote the request to {order.output}. {waits.hint}")
        return
    uuid = signed.image.uuid.hex()
    app.emit(
        {"uuid": uuid, "sequence": signed.sequence, "signed_by": order.by, "reused": signed.reused},
        f"{order.by} signed {uuid}, sequence {signed.sequence}. Write it: teds-provision write {uuid}",
    )
