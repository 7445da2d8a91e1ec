"""``log``: the audit log, and whether its hash chain holds. ``trace show``: what a link carried, frame by frame."""

from __future__ import annotations

import json
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from datetime import datetime
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import click

from teds_provision import provisioning
from teds_provision.cli.context import App, Station, pass_app
from teds_provision.cli.options import COMMAND_SETTINGS, WholeNumber, command, examples
from teds_provision.cli.rendering import local_time, moment, print_json_list, shown
from teds_provision.errors import StoreError, UsageError
from teds_provision.lazy import late
from teds_provision.sanitize import counted, sanitize
from teds_provision.station.store.audit import AuditEntry, AuditFilter, AuditVerdict, is_failure

if TYPE_CHECKING:
    from teds_provision.trace import recorder
    from teds_provision.trace.record import Record
else:  # not needed for this command's help
    recorder = late("teds_provision.trace.recorder")


# -- log ---------------------------------------------------------------------------------------------------------------

_INDENT = " " * 7
_POLL_SECONDS = 0.3


@command("teds-provision log --last 20", "teds-provision log --today --failed", "teds-provision log --follow")
@click.argument("uuid", required=False)
@click.option("--follow", "-f", is_flag=True, help="Follow the log: one line per new entry (one object with --json).")
@click.option("--last", "-n", type=WholeNumber(min=0), metavar="N", help="Show only the last N entries.")
@click.option("--today", is_flag=True, help="Show only today's entries.")
@click.option("--since", metavar="TIME", help="Show only entries since: ISO 8601, today, or 2h, 3d.")
@click.option("--act", metavar="A", help="Show only this action: agree, write, verify, whitelist …")
@click.option("--failed", is_flag=True, help="Show only what was refused or failed.")
@pass_app
def log(
    app: App,
    uuid: str | None,
    follow: bool,
    last: int | None,
    today: bool,
    since: str | None,
    act: str | None,
    failed: bool,
) -> None:
    """Show who did what to which node, and check the hash chain of the log.

    The chain is checked from the first entry shown to the end; in full without --last, --today and --since. Exits 7
    if an entry was changed, removed or added by hand.
    """
    if today and since is not None:
        raise UsageError("--today and --since cannot be combined.", hint="Use one of them.")
    station = app.station()
    audit_log = station.audit_log
    wanted = "today" if today else since
    choice = AuditFilter(
        station.nodes.resolve(uuid) if uuid else None, act, failed, since=moment(wanted) if wanted is not None else None
    )
    after = audit_log.entry_before(choice, last=last)
    verdict = audit_log.check(after)
    if follow:
        _follow(app, station, choice, verdict, after)
        return
    entries = _CountedEntries(audit_log.chosen(choice, after))
    if app.json:
        _print_json(entries, verdict, after)
    else:
        _print_lines(app, entries, verdict, after, narrowed=choice != AuditFilter())


class _CountedEntries:
    """Entries one after the other, counted as they are printed: a long log is never held in memory."""

    def __init__(self, entries: Iterable[AuditEntry]) -> None:
        self._from = entries
        self.entries = self.failed = 0
        self.acts = Counter[str]()

    def __iter__(self) -> Iterator[AuditEntry]:
        for entry in self._from:
            self.entries += 1
            self.failed += is_failure(entry.outcome)
            self.acts[entry.act] += 1
            yield entry


def _print_json(entries: _CountedEntries, verdict: AuditVerdict, after: int) -> None:
    """Print one object, written as it is read; exits 7 if the chain is broken."""
    out = sys.stdout
    out.write('{"entries": [')
    for number, entry in enumerate(entries):
        out.write((", " if number else "") + json.dumps(_as_dict(entry)))
    rest = {
        "intact": verdict.intact,
        "checked": {"after": after, "to": verdict.count},
        "count": verdict.count,
        "head": verdict.head,
        "first_bad": verdict.first_bad,
        "why": verdict.why,
        "totals": {"entries": entries.entries, "failed": entries.failed, "acts": dict(entries.acts)},
    }
    out.write("], " + json.dumps(rest)[1:] + "\n")
    out.flush()
    if not verdict.intact:
        raise click.exceptions.Exit(7)


def _print_lines(app: App, entries: _CountedEntries, verdict: AuditVerdict, after: int, *, narrowed: bool) -> None:
    """Print a line for each entry; if only some were requested (``narrowed``), how many came."""
    sys.stdout.writelines(_line(entry) + "\n" for entry in entries)
    sys.stdout.flush()
    _require_intact(verdict)
    if narrowed:
        by_act = ", ".join(f"{count} {name}" for name, count in entries.acts.most_common())
        app.note(
            f"{counted(entries.entries, 'entry', 'entries')}, {entries.failed} failed{': ' if by_act else '.'}{by_act}"
        )
    part = f" from entry {after + 1} on" if after else ""
    app.note(f"{counted(verdict.count, 'entry', 'entries')}, chain intact{part}, head {verdict.head[:16]}.")


def _follow(app: App, station: Station, choice: AuditFilter, verdict: AuditVerdict, after: int) -> None:
    """Give entries as they come, until SIGTERM (exit 0) or Ctrl-C (exit 130)."""
    stop = provisioning.meeting.IdleStop(None)
    signal.signal(signal.SIGTERM, lambda *_: stop.request_stop())
    _require_intact(verdict)
    while True:
        for entry in station.audit_log.chosen(choice, after):
            after = entry.seq
            print(json.dumps(_as_dict(entry)) if app.json else _line(entry), flush=True)
        if stop.wait(_POLL_SECONDS):
            return


def _require_intact(verdict: AuditVerdict) -> None:
    if not verdict.intact:
        raise StoreError(
            f"The audit log is not intact: {verdict.why}.",
            hint=f"Entries before {verdict.first_bad} are intact. Keep a copy, and find out who changed the file.",
        )


def _as_dict(entry: AuditEntry) -> dict[str, Any]:
    return {
        "seq": entry.seq,
        "at": entry.at,
        "who": entry.who,
        "actor": entry.actor,
        "act": entry.act,
        "uuid": None if entry.uuid is None else entry.uuid.hex(),
        "outcome": entry.outcome,
        "detail": entry.detail,
        "hash": entry.hash,
    }


def _line(entry: AuditEntry) -> str:
    """Return the line of an entry; on a terminal it is wrapped, with time and act before node and details."""
    node = entry.uuid.hex() if entry.uuid else "-"
    detail = ", ".join(f"{key} {_short(value)}" for key, value in entry.detail.items() if value is not None)
    if sys.stdout.isatty():
        what = f"{entry.seq:>5}  {local_time(entry.at)}  {entry.act:<10} {node:<20}  {entry.outcome}"
        width = max(40, shutil.get_terminal_size().columns)
        rows = [
            *wrap(shown(what), width, subsequent_indent=_INDENT, drop_whitespace=False),
            *wrap(shown(f"{entry.who}  {detail}".rstrip()), width, initial_indent=_INDENT, subsequent_indent=_INDENT),
        ]
        return "\n".join(row.rstrip() for row in rows)
    line = f"{entry.seq:>5}  {local_time(entry.at)}  {entry.who}  {entry.act:<10} {node:<20}  {entry.outcome}"
    return shown(f"{line}  {detail}".rstrip())


def _short(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text[:16] if len(text) == 64 and text.isalnum() else text


# -- trace -------------------------------------------------------------------------------------------------------------

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
