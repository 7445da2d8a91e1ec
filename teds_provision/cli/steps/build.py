"""``build``: a node's datasheet from its profile and calibration."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

from teds_provision import steps
from teds_provision import teds as teds_room
from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import FileToRead, Function, command, dry_run_option, yes_option
from teds_provision.files import SHARED, read_limited, write_whole

MAX_INPUT_OCTETS = 32 << 20


def order_options(function: Function) -> Function:
    """Add --profile, --calibration, --no-calibration, --name, --accept-calibration, --retype: one ``order``."""
    from functools import wraps

    @wraps(function)
    def with_order(*args: Any, profile: Any, calibration: Any, no_calibration: bool, name: Any, **rest: Any) -> Any:
        accepted, retype = rest.pop("accept_calibration"), rest.pop("retype")
        order = steps.build_order.BuildOrder(profile, calibration, name, no_calibration, accepted, retype)
        return function(*args, order=order, **rest)

    options = [
        click.option(
            "--profile", "-p", metavar="P", help="Transducer type, or a TOML file (default: the node's last)."
        ),
        click.option(
            "--calibration",
            "-c",
            type=FileToRead(),
            metavar="FILE",
            help="CSV of raw, value pairs, or coefficients.",
        ),
        click.option("--no-calibration", is_flag=True, help="Drop the calibration that the node has."),
        click.option("--name", help="Name of this node, written into its XdcrName TEDS."),
        click.option(
            "--accept-calibration", metavar='"WHY"', help="Take a calibration that the guard refuses; logged."
        ),
        click.option("--retype", is_flag=True, help="The board may become one of another type than it says it is."),
    ]
    wrapped: Any = with_order
    for option in reversed(options):
        wrapped = option(wrapped)
    return wrapped  # type: ignore[no-any-return]


@command("teds-provision build 8d4d --profile magnetic-angular-position-sensor --output angle.json")
@click.argument("uuid")
@order_options
@click.option(
    "--output", "-o", type=click.Path(path_type=Path, dir_okay=False), metavar="IMAGE", help="Also write it here."
)
@click.option("--edition", type=click.Choice(["2007", "2024"]), default="2007", show_default=True, help="TEDS form.")
@yes_option
@dry_run_option
@pass_app
def build(app: App, uuid: str, order: Any, output: Path | None, edition: str, yes: bool, dry_run: bool) -> None:
    """Build the TEDS of the node's type, plus calibration, plus the Security TEDS, still unsigned."""
    station = app.station()
    octets = station.nodes.resolve(uuid)
    built = steps.build.build(
        station, octets, order, edition=int(edition), keep_draft=not dry_run, retype=app.asks_retype(yes=yes)
    )
    if output is not None and not dry_run:
        write_file(output, built.image.to_json())
    for warning in built.warnings:
        app.warn(warning)
    blocks = [
        {"access_code": code, "channel": channel, "octets": len(teds), "sha256": hashlib.sha256(teds).hexdigest()}
        for (channel, code), teds in sorted(built.image.blocks.items())
    ]

    calibrations = [
        teds_room.calibration.describe_calibration(calibration) for calibration in built.calibrations.values()
    ]
    fits = "".join(f"\n  {teds_room.calibration.sentence(calibration)}" for calibration in built.calibrations.values())
    lines = [f"{b['access_code']:>4}  channel {b['channel']:<3} {b['octets']:>5} octets" for b in blocks]
    app.emit(
        {
            "uuid": octets.hex(),
            "profile": built.profile,
            "blocks": blocks,
            "warnings": list(built.warnings),
            "calibrations": calibrations,
        },
        f"Built {octets.hex()} as {built.profile}:\n" + "\n".join(lines) + fits,
    )


def write_file(path: Path, text: str | Iterable[str]) -> None:
    """Write a result file whole or not at all; its parts as they come."""
    parts = (text,) if isinstance(text, str) else text
    write_whole(path, (part.encode("utf-8") for part in parts), mode=SHARED)


def read_file(path: Path) -> bytes:
    """Read an input file; raises NotFound, BadData (too large)."""
    return read_limited(path, MAX_INPUT_OCTETS, "image")
