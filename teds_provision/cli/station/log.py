"""``log``: the audit log, and whether its hash chain holds."""

from __future__ import annotations

import json
import signal
import threading
from typing import TYPE_CHECKING, Any

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import command
from teds_provision.cli.rendering import shown
from teds_provision.errors import StoreFailure

if TYPE_CHECKING:
    from rich.console import Console

    from teds_provision.station.station import Station
    from teds_provision.store import AuditEntry, AuditVerdict

_POLL_SECONDS = 0.3


@command("teds-provision log --last 20", "teds-provision --json log 8d4d", "teds-provision log --follow")
@click.argument("uuid", required=False)
@click.option("--follow", "-f", is_flag=True, help="Go on: one line per entry as it comes (with --json one object).")
@click.option("--last", "-n", type=click.IntRange(min=0), metavar="N", help="Only the last N entries.")
@pass_app
def log(app: App, uuid: str | None, follow: bool, last: int | None) -> None:
    """Show who did what to which node, and whether the hash chain of the log holds.

    The whole chain is checked, whatever is shown. Exits 7 where an entry was changed, removed or added by hand.
    """
    station = app.station()
    wanted = station.nodes.resolve(uuid) if uuid else None
    verdict = station.audit_log.check()
    if follow:
        _follow(app, station, wanted, verdict, last)
        return
    entries = [entry for entry in station.audit_log.entries() if wanted in (None, entry.uuid)]
    shown = entries if last is None else entries[max(0, len(entries) - last) :]
    app.emit(
        {
            "entries": [_as_dict(entry) for entry in shown],
            "intact": verdict.intact,
            "count": verdict.count,
            "head": verdict.head,
            "first_bad": verdict.first_bad,
            "why": verdict.why,
        },
        lambda console: _print(console, shown),
    )
    if not verdict.intact and app.json:
        raise click.exceptions.Exit(7)
    _require_intact(verdict)
    app.note(f"{verdict.count} entries, chain intact, head {verdict.head[:16]}.")


def _print(console: Console, entries: list[AuditEntry]) -> None:
    for entry in entries:
        console.print(_line(entry), markup=False)


def _follow(app: App, station: Station, wanted: bytes | None, verdict: AuditVerdict, last: int | None) -> None:
    """Give entries as they come, until SIGTERM (exit 0) or Ctrl-C (exit 130)."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    _require_intact(verdict)
    after = 0 if last is None else max(0, verdict.count - last)
    while True:
        for entry in station.audit_log.entries(after):
            after = entry.seq
            if wanted in (None, entry.uuid):
                print(json.dumps(_as_dict(entry)) if app.json else _line(entry), flush=True)
        if stop.wait(_POLL_SECONDS):
            return


def _require_intact(verdict: AuditVerdict) -> None:
    if not verdict.intact:
        raise StoreFailure(
            f"The audit log does not hold: {verdict.why}.",
            hint=f"What stands before entry {verdict.first_bad} holds. Keep a copy, and find out who wrote the file.",
        )


def _as_dict(entry: AuditEntry) -> dict[str, Any]:
    return {
        "seq": entry.seq,
        "at": entry.at,
        "who": entry.who,
        "act": entry.act,
        "uuid": None if entry.uuid is None else entry.uuid.hex(),
        "outcome": entry.outcome,
        "detail": entry.detail,
        "hash": entry.hash,
    }


def _line(entry: AuditEntry) -> str:
    node = entry.uuid.hex() if entry.uuid else "-"
    detail = ", ".join(f"{key} {_short(value)}" for key, value in entry.detail.items() if value is not None)
    line = f"{entry.seq:>5}  {entry.at}  {entry.who}  {entry.act:<10} {node:<20}  {entry.outcome}"
    return shown(f"{line}  {detail}".rstrip())


def _short(value: object) -> str:
    text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text[:16] if len(text) == 64 and text.isalnum() else text
