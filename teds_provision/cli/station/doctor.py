"""``doctor``: what is wrong on this machine, why, and the command that mends it."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import click

from teds_provision.cli.config_file import config_path, problems
from teds_provision.cli.context import App, Console, pass_app
from teds_provision.cli.options import command
from teds_provision.cli.station.config import check_values
from teds_provision.doctor.checks import Finding, System, examine, exit_code
from teds_provision.doctor.report import build_report
from teds_provision.errors import BadDataError, TedsProvisionError, UsageError
from teds_provision.files import SHARED, require_new, write_new
from teds_provision.limits import load_toml
from teds_provision.sanitize import sanitize

_STYLES = {"ok": "green", "warning": "yellow", "failed": "bold red", "skipped": "dim"}


@command(
    "teds-provision doctor",
    "teds-provision doctor --nfc udp:localhost:54321 --can udp_multicast:239.74.163.2",
    "teds-provision doctor --report -",
)
@click.option("--nfc", metavar="PATH", help="Also open this reader: usb, tty:USB0:pn532, udp:localhost:54321.")
@click.option("--can", metavar="INTERFACE:CHANNEL", help="Also open this bus: socketcan:can0, …")
@click.option("--ble", metavar="ADAPTER", help="Also require this Bluetooth adapter: auto, hci0.")
@click.option("--full", is_flag=True, help="Check every row and log entry of a large store, not only a sample.")
@click.option(
    "--report",
    type=click.Path(dir_okay=False, allow_dash=True, path_type=Path),
    metavar="FILE|-",
    help="Write one document to paste into a bug report: versions, links, checks, last errors; no keys, no UUIDs.",
)
@click.option("--with-uuids", is_flag=True, help="With --report: keep the UUIDs of nodes.")
@pass_app
def doctor(
    app: App, nfc: str | None, can: str | None, ble: str | None, full: bool, report: Path | None, with_uuids: bool
) -> None:
    """Check Python, libraries, readers, buses, clock, keyring, vault and store; explain each problem and how to fix it.

    Opens only the readers and buses you name, and never asks for a passphrase; with --passphrase-fd it also checks the
    seals of pins and trust. Exits 0 unless a check failed (warnings do not count): 7 for the store, the keyring or the
    vault, 5 for a named reader or bus, 1 for the rest.

    In a store of more than 5,000 nodes, or a log of more than 10,000 entries, the newest and a random sample are
    checked ("sampled" with --json); --full checks everything.

    --report writes one document to paste into a bug report. It contains no keys, passphrases, fingerprints, paths of
    this user or names of this machine; UUIDs only with --with-uuids.
    """
    if with_uuids and report is None:
        raise UsageError("--with-uuids needs --report.", hint="teds-provision doctor --report FILE --with-uuids")
    if report is not None and str(report) != "-":
        require_new(report)
    root = click.get_current_context().find_root()
    ask = app.ask_secret if app.has_passphrase else None
    bad_value = partial(_bad_value, app, root)
    system = System(app.home, nfc, can, ble, full, bad_names=problems, bad_value=bad_value, ask=ask)
    found = list(examine(system))
    findings = [finding for _, finding in found]
    checks = [asdict(finding) for finding in findings]
    code = exit_code(found)
    counts = {word: sum(finding.result == word for finding in findings) for word in _STYLES}
    if report is None:
        _show(app, findings, {"checks": checks, **counts})
    else:
        document = build_report(system, findings, _settings(app), with_uuids=with_uuids)
        _give_report(app, document, report, {"checks": checks, **counts})
    app.note(", ".join(f"{count} {word}" for word, count in counts.items()) + ".")
    if code:
        raise click.exceptions.Exit(code)


def _settings(app: App) -> Mapping[str, Any]:
    """Return what config.toml sets; empty if it cannot be read, which a check reports."""
    path = config_path(app.home)
    try:
        return load_toml(path.read_text(encoding="utf-8"), str(path))
    except (TedsProvisionError, OSError, ValueError):
        return {}


def _give_report(app: App, document: Mapping[str, Any], path: Path, result: Mapping[str, Any]) -> None:
    """Print the report, or write it to a new file and name it; with --json it is the member ``report``."""
    text = json.dumps(document, indent=2, ensure_ascii=False)
    if str(path) == "-":
        if app.json:
            app.emit({**result, "report": document})
        else:
            app.lines([text])
        return
    write_new(path, text.encode() + b"\n", mode=SHARED)
    app.emit(
        {**result, "report": str(path)},
        lambda console: console.print(f"Report: {path}. Read it before you share it.", markup=False),
    )


def _bad_value(app: App, root: click.Context, values: Mapping[str, Any]) -> str:
    try:
        check_values(root, values, config_path(app.home))
    except BadDataError as error:
        return error.message
    return ""


def _show(app: App, findings: list[Finding], result: Mapping[str, Any]) -> None:
    """Print the findings: with colours and folded in a terminal, else one plain line each, and one for the cure."""
    if app.json or sys.stdout.isatty():
        app.emit(dict(result), lambda console: _print(console, findings))
        return
    width = max(len(finding.name) for finding in findings)
    lines = []
    for finding in findings:
        lines.append(f"{finding.result:<8} {finding.name:<{width}}  {finding.why}")
        if finding.fix and finding.result != "ok":
            lines.append(f"  → {finding.fix}")
    app.lines([sanitize(line) for line in lines])


def _print(console: Console, findings: list[Finding]) -> None:
    from rich.padding import Padding
    from rich.text import Text

    width = max(len(finding.name) for finding in findings)
    for finding in findings:
        line = Text(f"{finding.result:<8}", style=_STYLES[finding.result])
        line.append(f" {finding.name:<{width}}  {finding.why}", style="not bold default")
        console.print(line)
        if finding.fix and finding.result != "ok":
            console.print(Padding(Text(f"→ {finding.fix}"), (0, 0, 0, 9)))
