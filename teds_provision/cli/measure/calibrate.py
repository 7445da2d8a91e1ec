"""``calibrate``: a mounted sensor's zero, points from the running sensor, and the quality of a fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import click

from teds_provision import __version__, measure, provisioning, teds
from teds_provision.cli.context import App, Console, pass_app
from teds_provision.cli.measure.sample import over_the_bus
from teds_provision.cli.options import (
    ChannelName,
    FileToRead,
    WholeNumber,
    command,
    dry_run_option,
    examples,
    link_options,
    yes_option,
)
from teds_provision.cli.rendering import print_table, reporter_for, shown
from teds_provision.errors import UsageError
from teds_provision.files import SHARED, read_text, write_whole
from teds_provision.limits import LIMITS
from teds_provision.links import LinkSettings
from teds_provision.teds.calibration import Calibration
from teds_provision.teds.calibration.model import METHODS

_NEGATIVE: dict[str, Any] = {"ignore_unknown_options": True}  # -0.5 is a value, not an option


@click.group(
    epilog=examples(
        "teds-provision calibrate zero 8d4d 1 --can socketcan:can0",
        "teds-provision calibrate capture 8d4d 1 --reference 90 --unit degree --to joint3.csv --can socketcan:can0",
        "teds-provision calibrate fit joint3.csv --method polynomial",
    )
)
def calibrate() -> None:
    """Zero a mounted sensor, and take calibration points from it."""


@command(
    "teds-provision calibrate zero 8d4d 1 --can socketcan:can0",
    "teds-provision calibrate zero 8d4d 1 --value 90 --unit degree --nfc usb",
    context_settings=_NEGATIVE,
)
@click.argument("node", metavar="UUID")
@click.argument("channel", type=ChannelName())
@click.option("--value", type=float, metavar="V", help="What the channel should read now (default: 0).")
@click.option("--unit", metavar="U", help="Unit of V (default: the SI unit of the datasheet).")
@click.option(
    "--accept-calibration", metavar='"WHY"', help="Accept a result that the guard refuses; the reason is logged."
)
@yes_option
@dry_run_option
@link_options
@pass_app
def zero(
    app: App,
    node: str,
    channel: int | str,
    value: float | None,
    unit: str | None,
    accept_calibration: str | None,
    yes: bool,
    dry_run: bool,
    links: LinkSettings,
) -> None:
    """Make a channel read 0, or --value V, in its present position.

    Reads the channel, then signs, writes and verifies the datasheet with the new zero offset. The curve and the date of
    the calibration stay; the zero offset gets a date of its own. Nothing is written if the reading is unstable or the
    guard refuses the result (exit 6). A running ncap releases the node in the meantime.
    """
    if value is not None and not math.isfinite(value):
        raise UsageError("--value is not a finite number.")
    order = measure.zero.ZeroOrder(channel, value, unit, app.interactive, accept_calibration)
    done = measure.zero.zero_at(
        app.station(),
        over_the_bus(links),
        node,
        order,
        reporter_for(app),
        dry_run=dry_run,
        low=partial(app.confirm, yes=yes),
    )
    for warning in done.warnings:
        app.warn(warning)
    app.emit(_zero_json(done, dry_run=dry_run), _zero_lines(done, dry_run=dry_run))


def _zero_json(done: measure.zero.ZeroResult, *, dry_run: bool) -> dict[str, Any]:
    channel = done.channel
    unit = channel.shown
    differences = {"offset": done.offset, "moved": done.moved, "spread": done.spread}
    readings = {"before": done.before, "after": done.after}
    return {
        "uuid": done.uuid.hex(),
        "channel": channel.number,
        "name": channel.name,
        **differences,
        **readings,
        "unit": channel.si_unit,
        "shown": {name: value / unit.scale for name, value in differences.items()}
        | {name: unit.from_si(value) for name, value in readings.items()}
        | {"unit": unit.text},
        "count": done.count,
        "sequence": done.sequence,
        "written": done.written,
        "dry_run": dry_run,
        "changes": list(done.changes),
        "warnings": list(done.warnings),
        "steps": [{"name": step.name, "result": step.result, "seconds": step.seconds} for step in done.steps],
    }


def _zero_lines(done: measure.zero.ZeroResult, *, dry_run: bool) -> str:
    channel = done.channel
    named = f"Channel {channel.number}" + (f" ({shown(channel.name)})" if channel.name else "")
    read = f"{named} read {channel.show_reading(done.before)}"
    seen = f"{done.count} samples, spread {channel.show(done.spread, difference=True)}"
    if not done.moved:
        return f"{named} reads {channel.show_reading(done.before)} ({seen}): nothing to do."
    offset = f"zero offset {channel.show(done.offset, difference=True)}"
    offset += f" (moved by {channel.show(done.moved, difference=True)})"
    changes = "".join(f"\n  {text}" for text in done.changes)
    if dry_run:
        return f"Plan: {read} ({seen}); it would read {channel.show_reading(done.after)}, {offset}.{changes}"
    sentence = f"{read} ({seen}) and now reads {channel.show_reading(done.after)}: {offset}."
    return f"{sentence}{changes}\nWritten and verified, sequence {done.sequence}."


@command(
    "teds-provision calibrate capture 8d4d 1 --reference 90 --unit degree --to joint3.csv --can socketcan:can0",
    context_settings=_NEGATIVE,
)
@click.argument("node", metavar="UUID")
@click.argument("channel", type=ChannelName())
@click.option(
    "--reference", type=float, required=True, metavar="V", help="True value at this moment, from your reference."
)
@click.option("--unit", metavar="U", help="Unit of V (default: the SI unit of the datasheet).")
@click.option(
    "--to",
    "file",
    type=click.Path(path_type=Path, dir_okay=False),
    required=True,
    metavar="FILE.csv",
    help="Calibration file to add the point to; created if missing.",
)
@link_options
@pass_app
def capture(
    app: App, node: str, channel: int | str, reference: float, unit: str | None, file: Path, links: LinkSettings
) -> None:
    """Take one calibration point from the running sensor.

    Records the mean of 32 raw values, taken over half a second, with the reference, the spread and the count. Pass the
    file to --calibration; calibrate fit shows how good the fit is. The sensor may be in use while you capture.
    """
    if not math.isfinite(reference):
        raise UsageError("--reference is not a finite number.")
    done = measure.capture.capture_at(
        app.station(),
        over_the_bus(links),
        node,
        channel,
        reference,
        file,
        reporter_for(app),
        unit=unit,
        shown_unit_asked=app.interactive,
    )
    point, own = done.point, done.channel
    added = {"raw": point.raw, "mean": point.raw, "reference": point.reference, "unit": own.si_unit}
    result = {
        "uuid": done.uuid.hex(),
        "channel": own.number,
        "name": own.name,
        "file": str(file),
        "added": {**added, "spread": point.spread, "count": point.count},
        "points": [dict(point) for point in done.points],
    }
    count = len(done.points)
    app.emit(
        result,
        f"Channel {own.number}: raw {point.raw:.8g} at {own.show_reading(point.reference)} ({point.count} samples, "
        f"spread {point.spread:.3g}). {file} holds {count} point{'' if count == 1 else 's'}.",
    )


@command(
    "teds-provision calibrate fit joint3.csv --method polynomial",
    "teds-provision calibrate fit joint3.csv --profile magnetic-angular-position-sensor",
    "teds-provision calibrate fit joint3.csv --dcc joint3.xml --laboratory laboratory.toml",
)
@click.argument("file", type=FileToRead(), metavar="FILE.csv")
@click.option("--method", type=click.Choice(METHODS), help="How to fit (default: the file's method, else table).")
@click.option("--degree", type=WholeNumber(1, 12), metavar="N", help="Degree of a polynomial (default: 3).")
@click.option("--profile", "-p", metavar="P", help="Also check it against this transducer type and the guard.")
@click.option(
    "--dcc",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="OUT.xml",
    help="Write the points and the fit as a calibration certificate (DCC 3.2.1), unsigned.",
)
@click.option(
    "--laboratory",
    type=FileToRead(),
    metavar="FILE.toml",
    help="With --dcc: who calibrated, for whom, under which number; see docs/calibration.md.",
)
@pass_app
def fit(
    app: App,
    file: Path,
    method: str | None,
    degree: int | None,
    profile: str | None,
    dcc: Path | None,
    laboratory: Path | None,
) -> None:
    """Show how well a calibration fits its points, and certify it.

    Writes nothing to a node; --dcc writes points and fit as a certificate. A table passes through every point, so the
    error at each inner point of a fit without that point is shown as well.
    """
    if laboratory is not None and dcc is None:
        raise UsageError("--laboratory belongs to a certificate.", hint="Add --dcc OUT.xml.")
    if file.suffix.lower() == ".xml" and profile is None:
        raise UsageError(
            "A certificate is fitted for a transducer type.",
            hint=f"Add --profile P, or see: teds-provision show {file}",
        )
    text = "" if file.suffix.lower() == ".xml" else read_text(file, LIMITS.text_file, "calibration")
    warnings: tuple[str, ...] = ()
    if profile is not None:
        if method is not None or degree is not None:
            raise UsageError(
                "The profile already sets the method.",
                hint="Omit --method and --degree, or write them into the file.",
            )
        prepared = provisioning.build.prepare(app.station(), provisioning.build.BuildOrder(profile, calibration=file))
        fitted, warnings = dict(prepared.calibrations or {}), prepared.warnings
    else:
        fitted = teds.calibration.fit_points(text, str(file), method=method, degree=degree)
    fits = [_fit_json(calibration) for _, calibration in sorted(fitted.items())]
    for warning in warnings:
        app.warn(warning)
    result = {"file": str(file), **fits[0], "channels": fits, "warnings": list(warnings)}
    if dcc is not None:
        result["dcc"] = _write_dcc(app, dcc, laboratory, fitted, file, text)
    app.emit(result, lambda console: _fits(console, [calibration for _, calibration in sorted(fitted.items())], fits))


def _write_dcc(
    app: App, path: Path, laboratory: Path | None, fitted: Mapping[int, Calibration], file: Path, text: str
) -> str:
    """Write the certificate, print what it does not state, and return its path."""
    write = teds.dcc.write
    known = write.Laboratory()
    if laboratory is not None:
        known = write.read_laboratory(read_text(laboratory, LIMITS.text_file, "description"), str(laboratory))
    node = teds.calibration.points.node_of(text)
    certificate = write.write_certificate(
        fitted, known, node=node, software=__version__, source=text.encode(), today=datetime.now(UTC).date()
    )
    write_whole(path, [certificate.encode()], mode=SHARED)
    if known.missing:
        app.warn(f"{path} does not state: {', '.join(known.missing)}. Give them in a file: --laboratory FILE.toml")
    app.note(f"Wrote {path}; it is not signed.")
    return str(path)


def _fit_json(calibration: Calibration) -> dict[str, Any]:
    found, without = teds.calibration.residuals(calibration), teds.calibration.left_out(calibration)
    if found is None:
        raise UsageError("There are no points to fit.", hint="calibrate fit takes a CSV of points: raw, value.")
    rows = zip(found.inputs, found.references, found.curve, found.differences, strict=True)
    return {
        "channel": calibration.channel,
        "method": calibration.method,
        "kind": teds.calibration.kind_of(calibration),
        "unit": calibration.unit.text,
        "residuals": [
            {"raw": raw, "value": value, "fit": curve, "residual": residual} for raw, value, curve, residual in rows
        ],
        "rms": found.rms,
        "maximum": found.maximum,
        "left_out": {"rms": _rms(without), "maximum": max(map(abs, without))} if without else None,
    }


def _rms(values: Sequence[float]) -> float:
    return math.sqrt(sum(value * value for value in values) / len(values))


def _fits(console: Console, fitted: Sequence[Calibration], fits: Sequence[dict[str, Any]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    for calibration, fit_json in zip(fitted, fits, strict=True):
        unit = calibration.unit.text
        table = Table("raw", escape(f"value [{unit}]"), "fit", "residual", box=None, pad_edge=False)
        for row in fit_json["residuals"]:
            table.add_row(*(f"{row[name]:.6g}" for name in ("raw", "value", "fit")), f"{row['residual']:+.3g}")
        print_table(console, table)
        console.print(teds.calibration.sentence(calibration), markup=False)
        if fit_json["left_out"] is not None:
            worst, rms = fit_json["left_out"]["maximum"], fit_json["left_out"]["rms"]
            console.print(
                f"Leave-one-out error of the inner points: up to {worst:.3g} {unit}, rms {rms:.3g} {unit}.",
                markup=False,
            )


calibrate.add_command(zero, "zero")
calibrate.add_command(capture, "capture")
calibrate.add_command(fit, "fit")
