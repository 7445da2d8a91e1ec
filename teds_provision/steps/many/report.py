"""What a batch came to, as a file for people and spreadsheets: CSV or HTML by suffix."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Final

from teds_provision.errors import NotFound, UsageFailure
from teds_provision.files import SHARED, write_whole
from teds_provision.steps.many.board import Totals
from teds_provision.steps.many.progress import Progress

_HEAD: Final = ("row", "uuid", "name", "profile", "result", "tries", "first_pass", "seconds", "time", "message")
_RESULT: Final = _HEAD.index("result")
_STYLE: Final = (
    "body{font:16px sans-serif;margin:2em}table{border-collapse:collapse}td,th{border:1px solid #999;padding:.3em .6em;"
    "text-align:left;white-space:nowrap}td:last-child{white-space:normal}.passed{background:#cfc}.failed{background:#fcc}.skipped{background:#eee}"
)


def check_report(path: Path | None) -> None:
    """Raise UsageFailure for a report of an unknown form, NotFound without a folder to lie in, before the first tap."""
    if path is None:
        return
    if path.suffix.lower() not in (".csv", ".html", ".htm"):
        raise UsageFailure(f"{path.name} is neither CSV nor HTML.", hint="Name it FILE.csv or FILE.html.")
    if not path.parent.is_dir():
        raise NotFound(f"There is no folder {path.parent} for the report.", hint="Make it, or name another place.")


def write_report(path: Path, progress: Progress) -> None:
    """Write the report whole; raises what ``write_whole`` raises."""
    rows, totals = _rows(progress), progress.totals()
    text = _csv(rows, totals) if path.suffix.lower() == ".csv" else _html(progress.sheet.path.name, rows, totals)
    write_whole(path, text.encode(), mode=SHARED)


def _rows(progress: Progress) -> list[tuple[str, ...]]:
    told = []
    for row in progress.sheet.rows:
        kept, order = progress.rows[row.number], row.prepared.order
        uuid = kept.uuid or (row.uuid.hex() if row.uuid is not None else "")
        values = (row.number, uuid, order.name or "", order.profile or "", kept.result or "not reached", kept.tries)
        told.append((*map(str, values), str(kept.first).lower(), str(kept.seconds), kept.time, kept.message))
    return told


def _totals(totals: Totals) -> list[tuple[str, str]]:
    share = "" if totals.first_pass is None else f"{totals.first_pass:.4f}"
    told = [
        ("passed", str(totals.passed)),
        ("failed", str(totals.failed)),
        ("skipped", str(totals.skipped)),
        ("seconds", f"{totals.seconds:.3f}"),
        ("first_pass", share),
    ]
    return told + [(f"seconds of {name}", f"{seconds:.4f}") for name, seconds in totals.steps.items()]


def _csv(rows: Sequence[Sequence[str]], totals: Totals) -> str:
    out = io.StringIO(newline="")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(_HEAD)
    writer.writerows([[_tame(cell) for cell in row] for row in rows])
    writer.writerow([])
    writer.writerows(_totals(totals))
    return out.getvalue()


def _tame(cell: str) -> str:
    """A cell that no spreadsheet takes for a formula: names and messages come from outside."""
    return f"'{cell}" if cell[:1] in ("=", "+", "-", "@") else cell


def _html(name: str, rows: Sequence[Sequence[str]], totals: Totals) -> str:
    head = "".join(f"<th>{html.escape(cell.replace('_', ' '))}</th>" for cell in _HEAD)
    body = "".join(
        f'<tr class="{html.escape(row[_RESULT])}">'
        + "".join(f"<td>{html.escape(cell)}</td>" for cell in _for_people(row))
        + "</tr>\n"
        for row in rows
    )
    sums = "".join(
        f"<tr><th>{html.escape(what)}</th><td>{html.escape(value)}</td></tr>\n" for what, value in _sums(totals)
    )
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(name)}</title>'
        f"<style>{_STYLE}</style></head><body><h1>{html.escape(name)}</h1>\n<table>{sums}</table><p></p>"
        f"<table><tr>{head}</tr>\n{body}</table></body></html>\n"
    )


def _sums(totals: Totals) -> list[tuple[str, str]]:
    share = "none was tried" if totals.first_pass is None else f"{totals.first_pass:.1%}"
    counts = [("passed", totals.passed), ("failed", totals.failed), ("skipped or not reached", totals.skipped)]
    told = [(what, str(count)) for what, count in counts]
    told += [("first-pass yield", share), ("seconds in all", f"{totals.seconds:.1f}")]
    return told + [(f"seconds of {name}, mean", f"{seconds:.2f}") for name, seconds in totals.steps.items()]


def _for_people(row: Sequence[str]) -> list[str]:
    """The cells of a row with the time of day here; nothing where the board was not reached."""
    cells = dict(zip(_HEAD, row, strict=True))
    tried = bool(cells["time"])
    cells["first_pass"] = ("yes" if cells["first_pass"] == "true" else "no") if tried else ""
    cells["seconds"] = f"{float(cells['seconds']):.1f}" if tried else ""
    if tried:
        cells["time"] = datetime.fromisoformat(cells["time"]).astimezone().isoformat(sep=" ", timespec="seconds")
    return list(cells.values())
