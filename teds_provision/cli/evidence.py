"""``evidence``: proof of every board, checked with nothing but files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from teds_provision import plant, protocol
from teds_provision.cli.build import read_file
from teds_provision.cli.context import App, pass_app, to_json
from teds_provision.cli.options import COMMAND_SETTINGS, FileToRead, command, dry_run_option, examples
from teds_provision.cli.rendering import local_time, print_table
from teds_provision.files import json_files
from teds_provision.sanitize import printable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import Console

    from teds_provision.plant.verify_evidence import JudgedEvidence
    from teds_provision.station.station import Station
    from teds_provision.store import EvidenceRow


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples(
        "teds-provision evidence list",
        "teds-provision evidence export evidence/",
        "teds-provision evidence verify evidence/ --ca ca.pem",
    ),
)
def evidence() -> None:
    """List, export and verify evidence: one file per board and attempt, signed by station and board."""


@command(
    "teds-provision evidence verify evidence/ --ca ca.pem",
    "teds-provision --json evidence verify 8d4d9da65281f7000000.1.json --ca ca.pem --pins boards.csv",
    name="verify",
)
@click.argument("files", metavar="FILE|DIR…", nargs=-1, required=True)
@click.option("--ca", type=FileToRead(), required=True, metavar="KEY.pem", help="The owner's CA key.")
@click.option("--pins", type=FileToRead(), metavar="FILE", help="Whitelist file: the key of each board.")
@click.option("--roster", type=FileToRead(), metavar="FILE", help="Also check it against this roster of the plant.")
@pass_app
def verify(app: App, files: tuple[str, ...], ca: Path, pins: Path | None, roster: Path | None) -> None:
    """Verify evidence offline, from files alone.

    Needs no station, no store and no network. A file is valid if a station certified by this CA signed it, its
    datasheet is authentic under this CA, and the board itself signed the facts. Valid evidence may document a failed
    attempt. Prints one line each, then totals; exits with the worst: 4 for an invalid file, 8 for one that cannot be
    read.
    """
    grounds = plant.verify_evidence.Grounds.of(protocol.keys.from_pem(read_file(ca)), pins, roster)
    names = json_files([Path(file) for file in files], "evidence")
    totals = plant.verify_evidence.EvidenceTotals()
    for lines, counted in plant.verify_evidence.verify_evidence(grounds, names, _json if app.json else _line):
        totals.join(counted)
        app.lines(lines)
    if app.json:
        app.emit(totals.to_json())
    else:
        words = ", ".join(f"{count} {word}" for word, count in sorted(totals.words.items()))
        app.lines([f"{totals.files} file{'' if totals.files == 1 else 's'}: {words}."])
        if roster is None:
            app.note("Without --roster, evidence from a stolen station counts as valid too.")
    if totals.exit_code:
        raise click.exceptions.Exit(totals.exit_code)


def _line(judged: JudgedEvidence) -> str:
    found = judged.evidence
    text = f"{judged.word:<13}  {found.uuid.hex() if found else '-':<20}  {judged.path}"
    why = judged.error.message if judged.error is not None else "; ".join(judged.faults)
    if judged.good and found is not None and found.facts.failure is not None:
        why = f"the attempt ended with {found.facts.failure}"
    return printable(f"{text}: {why}" if why else text)


def _json(judged: JudgedEvidence) -> str:
    return to_json(judged.to_json())


@command("teds-provision evidence list", "teds-provision evidence list 8d4d --job 0b5f", name="list")
@click.argument("uuids", metavar="[UUID…]", nargs=-1)
@click.option("--job", metavar="ID", help="Only evidence of this job.")
@pass_app
def list_evidence(app: App, uuids: tuple[str, ...], job: str | None) -> None:
    """List the evidence that this station keeps, by board and attempt."""
    rows = list(_rows(app.station(), uuids, job))
    told = [
        {
            "uuid": row.uuid.hex(),
            "job": row.job,
            "unit": row.unit,
            "attempt": row.attempt,
            "verdict": row.verdict,
            "finished": row.finished,
            "sha256": row.sha256,
        }
        for row in rows
    ]

    def table(console: Console) -> None:
        from rich.table import Table

        shown = Table("board", "job", "unit", "attempt", "verdict", "finished", box=None, pad_edge=False)
        for row in rows:
            job, unit = (row.job or "")[:8], str(row.unit or "")
            shown.add_row(row.uuid.hex(), job, unit, str(row.attempt), row.verdict, local_time(row.finished))
        print_table(console, shown)

    none = "There is no evidence yet. To collect it: teds-provision provision --evidence"
    app.emit({"evidence": told}, table if told else none)


@command(
    "teds-provision evidence export evidence/",
    "teds-provision evidence export evidence/ 8d4d --job 0b5f",
    name="export",
)
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path, file_okay=False))
@click.argument("uuids", metavar="[UUID…]", nargs=-1)
@click.option("--job", metavar="ID", help="Only evidence of this job.")
@dry_run_option
@pass_app
def export(app: App, folder: Path, uuids: tuple[str, ...], job: str | None, dry_run: bool) -> None:
    """Write evidence to files, UUID.N.json.

    One file per board and attempt; a file with the same content is left alone.
    """
    station = app.station()
    files = plant.evidence.export(station.plant.line, _rows(station, uuids, job), folder, write=not dry_run)
    told = {"folder": str(folder), "files": len(files), "written": sum(files.values())}
    word = "Would write" if dry_run else "Wrote"
    app.emit(told, f"{word} {told['written']} of {told['files']} files to {folder}.")


def _rows(station: Station, uuids: tuple[str, ...], job: str | None) -> Iterator[EvidenceRow]:
    id = plant.jobs.job_id(station, job) if job is not None else None
    chosen: list[bytes | None] = [station.nodes.resolve(text) for text in uuids]
    for uuid in chosen or [None]:
        yield from station.plant.line.evidence(uuid=uuid, job=id)


for one in (verify, list_evidence, export):
    evidence.add_command(one)
