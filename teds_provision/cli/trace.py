"""``trace show``: what a link carried, a line for each frame and message."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import COMMAND_SETTINGS, examples
from teds_provision.cli.rendering import print_json_list
from teds_provision.lazy import late
from teds_provision.sanitize import sanitize

if TYPE_CHECKING:
    from teds_provision.trace import recorder
    from teds_provision.trace.record import Record
else:  # the help of this command does without
    recorder = late("teds_provision.trace.recorder")

_ARROWS = {"out": ">", "in": "<"}
_SHOWN = 24
"""Octets of a line, unless --whole."""


@click.group(context_settings=COMMAND_SETTINGS, epilog=examples("teds-provision trace show bench.trace"))
def trace() -> None:
    """Show traces: every frame and message that --trace FILE recorded. docs/trace.md describes the file."""


@trace.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Show a trace in readable form.",
    epilog=examples(
        "teds-provision trace show bench.trace",
        "teds-provision trace show bench.pcapng --messages",
        "teds-provision --json trace show bench.trace",
    ),
)
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--messages", is_flag=True, help="Show only whole commands and replies, not the frames that carried them."
)
@click.option("--whole", is_flag=True, help="Show all octets, not just the first 24.")
@pass_app
def show(app: App, file: Path, messages: bool, whole: bool) -> None:
    """Show each frame and message of FILE with time, direction and meaning; sealed ones are shown decrypted.

    FILE is a trace in either format, or another program's pcapng of a CAN bus. Exits 8 if it is not a trace.
    """
    records = (record for record in recorder.read_trace(file) if not messages or record.layer == "message")
    if app.json:
        print_json_list("frames", (record.as_json() for record in records))
        return
    app.emit({}, "\n".join(_lines(records, whole=whole)) or "The trace is empty.")


def _lines(records: Iterator[Record], *, whole: bool) -> Iterator[str]:
    for record in records:
        moment = datetime.fromtimestamp(record.time).astimezone().strftime("%H:%M:%S.%f")[:-3]
        seal = "  sealed" if record.sealed else ""
        shown = record.opened if record.opened is not None else record.octets
        where = f"{record.identifier:08x} " if record.identifier is not None else ""
        mark = "  " if record.layer == "frame" else ""
        octets = shown.hex() if whole or len(shown) <= _SHOWN else f"{shown[:_SHOWN].hex()}…"
        head = f"{moment} {record.link:4} {_ARROWS[record.direction]} {mark}"
        yield sanitize(f"{head}{record.command}{seal}  {where}{octets}".rstrip())
