"""``verify``: everything that the profile demands, check by check, with one verdict."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from teds_provision import provisioning
from teds_provision.cli.context import App, Console, pass_app, to_json
from teds_provision.cli.options import command, link_options, options_given
from teds_provision.cli.rendering import aligned, firmware_words, print_table, reporter_for
from teds_provision.errors import UsageError
from teds_provision.files import json_files
from teds_provision.links import LinkSettings
from teds_provision.sanitize import printable
from teds_provision.shapes.verdict import Verification


@command(
    "teds-provision verify 8d4d --nfc udp:localhost:54321",
    "teds-provision verify signed.json",
    "teds-provision --json verify datasheets/",
)
@click.argument("what", metavar="UUID|IMAGE…|DIR", nargs=-1, required=True)
@click.option(
    "--accept-calibration", metavar='"WHY"', help="Accept a calibration that the guard refuses; the reason is logged."
)
@click.option(
    "--accept-firmware", is_flag=True, help="The calibration holds with the firmware that runs on the node now."
)
@link_options
@pass_app
def verify(
    app: App, what: tuple[str, ...], links: LinkSettings, accept_calibration: str | None, accept_firmware: bool
) -> None:
    """Read a node or an image file and check its datasheet; a node must also sign a fresh challenge.

    A file is checked by itself; with --can, --nfc or --ble, a name means a node rather than a file or directory.
    A node whose key this station holds must open a session, otherwise nothing is proven.
    Several files, or a directory, are checked on all cores, with one line each and totals at the end.
    Exits 0 for "authentic", 4 for "unsigned" and "not authentic", 5 for "unproven", 6 for a harmful calibration;
    for several files, with the worst.
    """
    node = len(what) == 1 and bool(options_given("via", "nfc", "can", "ble"))
    if not node and are_files(what):
        if accept_firmware:
            raise UsageError("--accept-firmware applies to a node.", hint="Verify the node itself.")
        if accept_calibration is not None:
            raise UsageError("--accept-calibration applies to a single image.", hint="Verify that image by itself.")
        verify_many(app, what)
        return
    station = app.station()
    if not node and Path(what[0]).is_file():
        done = provisioning.image_file.verify_image_file(station, Path(what[0]), accept_calibration)
    else:
        done = provisioning.verify_node.verify_at(
            station,
            links,
            what[0],
            reporter_for(app),
            accept_calibration=accept_calibration,
            accept_firmware=accept_firmware,
            is_node=node,
        )
    verified = done.verified
    result: dict[str, Any] = {**verified.to_json(), "warnings": list(done.warnings)}
    if verified.scope == "node":
        result["firmware"] = done.firmware and done.firmware.to_json()
    for warning in done.warnings:
        app.warn(warning)
    if sys.stdout.isatty():
        app.conclude(result, lambda console: _table(console, verified, result.get("firmware")), done.error)
    else:
        app.conclude(result, "\n".join(_lines(verified, result.get("firmware"))), done.error)


def _lines(verified: Verification, firmware: Any) -> list[str]:
    rows = [(check.name, check.result, check.why) for check in verified.checks]
    runs = firmware_words(firmware)
    verdict = f"{verified.uuid.hex()}: {verified.verdict}"
    return [*aligned([("check", "result", "found"), *rows]), verdict, *([f"firmware: {runs}"] if runs else [])]


def _table(console: Console, verified: Verification, firmware: Any) -> None:
    from rich.markup import escape
    from rich.table import Table

    style = {"passed": "green", "failed": "bold red", "skipped": "dim"}
    table = Table("check", "result", "found", box=None, pad_edge=False)
    for check in verified.checks:
        table.add_row(check.name, f"[{style[check.result]}]{check.result}[/]", escape(check.why))
    print_table(console, table)
    colour = "bold green" if verified.verdict == "authentic" else "bold red"
    console.print(f"[{colour}]{verified.uuid.hex()}: {verified.verdict}[/]")
    if runs := firmware_words(firmware):
        console.print(escape(f"firmware: {runs}"))


# ``verify FILES…|DIR``: one line per image, then the totals; exits with the worst image's code.


def are_files(what: Sequence[str]) -> bool:
    """Return True if these words name many images rather than one image or a node."""
    return len(what) > 1 or (len(what) == 1 and Path(what[0]).is_dir())


def verify_many(app: App, what: Sequence[str]) -> None:
    """Judge every file by itself; one that fails stops no other."""
    files = json_files([Path(word) for word in what], "image")
    totals = provisioning.verify_files.VerdictTotals()
    for lines, counted in provisioning.verify_files.verify_files(app.station(), files, _json if app.json else _line):
        totals.join(counted)
        app.lines(lines)
    if app.json:
        app.emit(totals.to_json())
    else:
        words = ", ".join(f"{count} {word}" for word, count in sorted(totals.verdicts.items()))
        app.lines([f"{totals.files} image{'' if totals.files == 1 else 's'}: {words}."])
    if totals.exit_code:
        raise click.exceptions.Exit(totals.exit_code)


def _line(found: provisioning.verify_files.FileVerdict) -> str:
    why = found.error["message"] if found.error is not None else "; ".join(found.warnings)
    uuid = found.verified.uuid.hex() if found.verified is not None else "-"
    text = f"{found.word:<13}  {uuid:<20}  {found.file}"
    return printable(f"{text}: {why}" if why else text)


def _json(found: provisioning.verify_files.FileVerdict) -> str:
    return to_json(found.to_json())
