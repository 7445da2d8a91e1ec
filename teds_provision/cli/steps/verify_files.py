"""``verify FILES…|DIR``: a line for each image, at last the totals, and the worst one's exit code."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from teds_provision.cli.context import App, to_json
from teds_provision.harmless import printable
from teds_provision.steps.many.verify_files import Totals, image_files, verify_files

if TYPE_CHECKING:
    from teds_provision.steps.many.verify_files import FileVerdict


def are_files(what: Sequence[str]) -> bool:
    """Whether these words name many images rather than one image or a node."""
    return len(what) > 1 or (len(what) == 1 and Path(what[0]).is_dir())


def verify_many(app: App, what: Sequence[str]) -> None:
    """Judge every file by itself; one that fails stops no other."""
    files = image_files([Path(word) for word in what])
    totals = Totals()
    for lines, counted in verify_files(app.station(), files, _json if app.json else _line):
        totals.join(counted)
        app.lines(lines)
    if app.json:
        app.emit(totals.to_json())
    else:
        words = ", ".join(f"{count} {word}" for word, count in sorted(totals.verdicts.items()))
        app.lines([f"{totals.files} image{'' if totals.files == 1 else 's'}: {words}."])
    if totals.exit_code:
        raise click.exceptions.Exit(totals.exit_code)


def _line(found: FileVerdict) -> str:
    why = found.error or ("; ".join(found.warnings) if found.warnings else "")
    text = f"{found.verdict or 'unreadable':<13}  {found.uuid or '-':<20}  {found.path}"
    return printable(f"{text}: {why}" if why else text)


def _json(found: FileVerdict) -> str:
    return to_json(found.to_json())
