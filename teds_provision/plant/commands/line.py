"""The production line: ``job``, what may be built; ``signer``, the office; ``evidence``, the proof of every board."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import click

from teds_provision import plant, provisioning, teds
from teds_provision.cli.context import App, Console, Station, pass_app, to_json
from teds_provision.cli.named_files import read_file, write_file
from teds_provision.cli.options import (
    COMMAND_SETTINGS,
    FileToRead,
    Seconds,
    WholeNumber,
    command,
    dry_run_option,
    examples,
)
from teds_provision.cli.rendering import local_time, moment, print_table
from teds_provision.errors import BadDataError, LinkError, NotAuthenticError, NotFoundError, PolicyError, UsageError
from teds_provision.files import json_files
from teds_provision.lazy import late
from teds_provision.protocol.keys import SoftwareKey, from_pem
from teds_provision.sanitize import printable

if TYPE_CHECKING:
    from teds_provision.plant.office import AnsweredRequest
    from teds_provision.plant.transport import Transport
    from teds_provision.plant.verify_evidence import JudgedEvidence
    from teds_provision.plant.yield_stats import StationYield
    from teds_provision.protocol.plant import document, signing
    from teds_provision.protocol.plant import job as jobs
    from teds_provision.protocol.plant.roster import Roster
    from teds_provision.station.plant.line import EvidenceRow
else:  # `evidence verify` needs neither jobs nor requests
    document, jobs = late("teds_provision.protocol.plant.document"), late("teds_provision.protocol.plant.job")
    signing = late("teds_provision.protocol.plant.signing")


# -- job ---------------------------------------------------------------------------------------------------------------


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples(
        "teds-provision job new --title angles -p load-cell --count 50 --station west --ends 2027-01-31",
        "teds-provision job status 0b5f",
    ),
)
def job() -> None:
    """Jobs for a line: a keeper defines what may be built, how many, by which station and until when."""


@command(
    "teds-provision job new --title cells -p load-cell --count 50 --station west=50 --ends 2027-01-31",
    "teds-provision job new --title spares -p load-cell --list boards.csv --station west --ends 2027-01-31",
    name="new",
)
@click.option("--title", required=True, metavar="TEXT", help="Title of the job.")
@click.option(
    "--profile", "-p", required=True, metavar="P", help="Transducer type; the job pins the SHA-256 of its file."
)
@click.option("--count", type=WholeNumber(1), metavar="N", help="Any boards, up to this number.")
@click.option("--list", "listed", type=FileToRead(), metavar="FILE", help="Only these boards (uuid, fingerprint).")
@click.option(
    "--station", "stations", multiple=True, required=True, metavar="NAME[=N]", help="Station that builds; its share."
)
@click.option("--ends", required=True, metavar="TIME", help="When it ends.")
@click.option("--not-before", metavar="TIME", help="When it begins (default: now).")
@click.option("--calibration", type=FileToRead(), metavar="FILE", help="One calibration for all boards.")
@click.option(
    "--calibrations",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Directory with a calibration per board: UUID.csv, .toml, .json or .xml.",
)
@click.option("--calibration-age", type=WholeNumber(1), metavar="DAYS", help="Any calibration no older than this.")
@click.option(
    "--assurance",
    type=click.Choice(["uuid", "bus", "tap"]),
    default="tap",
    show_default=True,
    help="How boards are identified.",
)
@click.option("--sign", default="station", show_default=True, metavar="station|NAME", help="Who signs the datasheets.")
@click.option("--no-evidence", is_flag=True, help="Do not keep evidence of each board.")
@click.option("--read-only", multiple=True, metavar="CHANNEL:CODE", help="TEDS that boards bring and keep.")
@click.option("--name", metavar="PATTERN", help="Name of each board: {unit}, {unit:03}, {uuid}, {uuid8}.")
@click.option(
    "--output",
    "-o",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Also write the job to FILE.",
)
@dry_run_option
@pass_app
def new(app: App, /, output: Path | None, dry_run: bool, **settings: Any) -> None:
    """Create and sign a job; this station must be a keeper."""
    station = app.station()
    roster = plant.jobs.roster_of(station)
    if not roster.has(station.identity.fingerprint, "keeper"):
        raise PolicyError("This station is not a keeper, so no station would accept its job.", hint="Ask a keeper.")
    drafted = _drafted(station, roster, settings)
    if dry_run:  # sealing checks the job, in a plan too
        jobs.seal_job(drafted, SoftwareKey.generate())
    else:
        station.unlock()
        octets = jobs.seal_job(drafted, station.credentials().key)
        drafted = plant.jobs.take_job(station, octets)
        if output is not None:
            write_file(output, octets.decode())
    app.emit(
        _to_json(station, drafted), f"{'Would create' if dry_run else 'Created'} job {drafted.id}: {_sentence(drafted)}"
    )


def _drafted(station: Station, roster: Roster, settings: dict[str, Any]) -> jobs.Job:
    if (settings["count"] is None) == (settings["listed"] is None):
        raise UsageError("A job needs a number of boards or a list of boards.", hint="Use one of --count and --list.")
    path = teds.profile.load.find_profile(settings["profile"], teds.profile.load.default_folders(station.home))
    teds.profile.load.load_profile(path, teds.profile.load.default_folders(station.home)).build(
        bytes(10)
    )  # fails here if no station could build the profile
    boards = _boards(settings["listed"]) if settings["listed"] is not None else {}
    total = settings["count"] or len(boards)
    sign = settings["sign"]
    begins = settings["not_before"]
    return jobs.Job(
        str(uuid4()),
        roster.registry,
        settings["title"],
        path.stem,
        teds.profile.load.files_digest(path, teds.profile.load.default_folders(station.home)),
        _rule(settings, boards),
        settings["count"],
        boards,
        _time(begins) if begins is not None else datetime.now(UTC).replace(microsecond=0),
        _time(settings["ends"]),
        _allotments(roster, settings["stations"], total),
        settings["assurance"],
        sign if sign == "station" else _office(roster, sign),
        not settings["no_evidence"],
        tuple(_block(text) for text in settings["read_only"]),
        settings["name"],
    )


def _time(text: str) -> datetime:
    return datetime.fromisoformat(moment(text))


def _boards(path: Path) -> dict[bytes, str]:
    """Return the boards of a whitelist file, each with its whole fingerprint."""
    listed = provisioning.whitelist.read_whitelist(path)
    for node in listed:
        if node.fingerprint is None or len(node.fingerprint) != 64:
            raise BadDataError(f"{path}:{node.line}: a job needs the full fingerprint (64 digits) of each board.")
    return {node.uuid: node.fingerprint or "" for node in listed}


def _rule(settings: dict[str, Any], boards: dict[bytes, str]) -> jobs.CalibrationRule:
    given = [name for name in ("calibration", "calibrations", "calibration_age") if settings[name] is not None]
    if len(given) > 1:
        named = " and ".join(f"--{name.replace('_', '-')}" for name in given)
        raise UsageError("A job takes one calibration option.", hint=f"Use one of {named}.")
    rule = jobs.CalibrationRule
    if settings["calibration"] is not None:
        return rule("one", plant.jobs.digest_of_file(settings["calibration"]))
    if settings["calibration_age"] is not None:
        return rule("any", max_age_days=settings["calibration_age"])
    if settings["calibrations"] is None:
        return rule()
    by_uuid: dict[bytes, str] = {}
    for path in sorted(settings["calibrations"].glob("*")):
        if len(path.stem) == 20 and set(path.stem) <= set("0123456789abcdef") and path.is_file():
            by_uuid[bytes.fromhex(path.stem)] = plant.jobs.digest_of_file(path)
    if not by_uuid or boards.keys() - by_uuid.keys():
        lacking = next(iter(boards.keys() - by_uuid.keys()), b"").hex() or "UUID"
        raise NotFoundError(f"There is no calibration {lacking}.* in {settings['calibrations']}.")
    return rule("list", by_uuid=by_uuid)


def _allotments(roster: Roster, texts: Sequence[str], total: int) -> dict[str, int]:
    allotted: dict[str, int] = {}
    for text in texts:
        station, number = _allotment(roster, text, total)
        if station in allotted:
            raise UsageError(
                f"Station {roster.name_of(station)} is named twice.", hint="Give each station one allotment."
            )
        allotted[station] = number
    return allotted


def _allotment(roster: Roster, text: str, total: int) -> tuple[str, int]:
    name, _, number = text.rpartition("=") if "=" in text else (text, "", str(total))
    found = roster.named(name)
    if found is None or roster.member(found.fingerprint) is None:
        raise NotFoundError(f"The roster has no member {name!r}.", hint="See: teds-provision registry status")
    if not number.isdecimal() or not int(number) >= 1:
        raise UsageError(f"{text!r}: an allotment must be 1 or more.")
    return found.fingerprint, int(number)


def _office(roster: Roster, name: str) -> str:
    found = roster.named(name)
    if found is None or not roster.has(found.fingerprint, "sign"):
        raise NotFoundError(f"The roster has no member {name!r} with the role sign.", hint="See: registry status")
    return found.fingerprint


def _block(text: str) -> tuple[int, int]:
    channel, _, code = text.partition(":")
    if not (channel.isdecimal() and code.isdecimal() and int(channel) <= 255 and int(code) <= 255):
        raise UsageError(f"{text!r} is not CHANNEL:CODE, like 1:5.")
    return int(channel), int(code)


def _to_json(station: Station, found: jobs.Job) -> dict[str, Any]:
    """Return a job with its state here; its own members as they were signed."""
    row = station.plant.line.job(found.id)
    given, passed, _ = station.plant.line.count_units(found.id)
    members = found.unsigned()
    return {
        **members,
        "H": found.hash,
        "state": row.state if row is not None else "draft",
        "units": given,
        "passed": passed,
    }


def _sentence(found: jobs.Job) -> str:
    until = local_time(found.ends.isoformat())
    return f"“{found.title}”, {found.total} × {found.profile}, until {until}."


@command("teds-provision job list", name="list")
@pass_app
def list_jobs(app: App) -> None:
    """List the jobs that this station knows."""
    station = app.station()
    plant.jobs.take_received(station)
    found = []
    for row in station.plant.line.jobs():
        try:
            found.append(plant.jobs.kept_job(station, row))
        except NotAuthenticError:
            app.warn(f"Job {row.id[:8]} is left out: no roster that is known here names its signer.")
    lines = [_to_json(station, job) for job in found]

    def table(console: Console) -> None:
        from rich.markup import escape
        from rich.table import Table

        shown = Table("id", "title", "profile", "boards", "passed here", "until", "state", box=None, pad_edge=False)
        for job, members in zip(found, lines, strict=True):
            until = local_time(job.ends.isoformat())
            counted = f"{members['passed']} of {job.total}"
            title, profile = escape(job.title), escape(job.profile)
            shown.add_row(job.id[:8], title, profile, str(job.total), counted, until, members["state"])
        print_table(console, shown)

    app.emit(
        {"jobs": lines}, table if lines else "There are no jobs yet. To create one, at a keeper: teds-provision job new"
    )


@command("teds-provision job show fifty.jws", name="show")
@click.argument("which", metavar="FILE|ID")
@pass_app
def show(app: App, which: str) -> None:
    """Show a job, and keep it if it comes from a file."""
    station = app.station()
    found = plant.jobs.find_job(station, which)
    roster = plant.jobs.roster_of(station)
    members = _to_json(station, found)
    who = ", ".join(f"{roster.name_of(key)} {number}" for key, number in found.stations.items())
    lines = [
        f"job          {found.id}",
        f"title        {found.title}",
        f"signed by    {roster.name_of(found.signer)}",
        f"profile      {found.profile}  {found.profile_sha256[:16]}",
        f"calibration  {found.calibration.rule}",
        f"boards       {found.total}{', by list' if found.boards else ''}; {members['units']} given here",
        f"stations     {who}",
        f"from, until  {local_time(found.not_before.isoformat())}, {local_time(found.ends.isoformat())}",
        f"assurance    {found.assurance}",
        f"signs        {'each station' if found.office is None else roster.name_of(found.office)}",
        f"evidence     {'yes' if found.evidence else 'no'}",
        f"state        {members['state']}",
    ]
    app.emit(members, "\n".join(lines))


@command("teds-provision job send 0b5f", "teds-provision job send 0b5f --files /media/stick", name="send")
@click.argument("which", metavar="FILE|ID")
@click.option(
    "--files",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Transfer folder, instead of the registry.",
)
@dry_run_option
@pass_app
def send(app: App, which: str, files: Path | None, dry_run: bool) -> None:
    """Send a job to its stations and its office.

    They have it after their next sync, and then run `provision --job ID`.
    """
    station = app.station()
    found = plant.jobs.find_job(station, which)
    roster = plant.jobs.roster_of(station)
    to = plant.sign_requests.receivers(station, found)
    if not dry_run:
        station.unlock()
        transport = plant.sign_requests.transport_for(station, files)
        app.closing(transport.close)
        plant.sign_requests.send_job(station, transport, found)
    names = [roster.name_of(receiver) for receiver in to]
    sent = f"{'Would send' if dry_run else 'Sent'} {found.id[:8]} to {', '.join(names)}."
    app.emit({"id": found.id, "to": to}, sent if to else f"{found.id[:8]} is for this station alone: nothing to send.")


@command("teds-provision job close 0b5f", name="close")
@click.argument("which", metavar="ID")
@dry_run_option
@pass_app
def close(app: App, which: str, dry_run: bool) -> None:
    """Close a job on this station: it accepts no further boards here."""
    station = app.station()
    found = plant.jobs.find_job(station, which)
    if not dry_run:
        plant.jobs.close_job(station, found)
    app.emit(_to_json(station, found), f"{'Would close' if dry_run else 'Closed'} {_sentence(found)}")


@command(
    "teds-provision job status 0b5f",
    "teds-provision job status 0b5f west/ --csv attempts.csv",
    name="status",
)
@click.argument("which", metavar="FILE|ID")
@click.argument("evidence", metavar="[FILE|DIR…]", nargs=-1)
@click.option(
    "--csv",
    "csv_file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Also write all attempts to FILE.",
)
@pass_app
def status(app: App, which: str, evidence: Sequence[str], csv_file: Path | None) -> None:
    """Show the progress of a job, station by station.

    Counts boards, first-pass yield, seconds per step and failures by code. Add other stations' evidence, as written
    there by `evidence export`; without it, a station's figures come from its pages.
    """
    station = app.station()
    found = plant.jobs.find_job(station, which)
    names = json_files([Path(file) for file in evidence], "evidence")
    attempts = plant.yield_stats.attempts_of(station, found.id, (read_file(Path(name)) for name in names))
    parts = plant.yield_stats.yield_stats(station, found, attempts)
    if csv_file is not None:
        write_file(csv_file, plant.yield_stats.to_csv(station, attempts))
    result = {**_to_json(station, found), "stations": [part.to_json() for part in parts]}
    app.emit(result, lambda console: _table(console, found, parts, station.fingerprint))


def _table(console: Console, found: jobs.Job, parts: list[StationYield], here: str) -> None:
    from rich.markup import escape
    from rich.table import Table

    passed = sum(part.passed for part in parts)
    console.print(f"[bold]{escape(found.title)}[/]: {passed} of {found.total} passed")
    table = Table("station", "units", "of", "passed", "first pass", "failures", box=None, pad_edge=False)
    for part in parts:
        first = "" if part.first_pass is None else f"{part.first_pass:.1%}"
        failures = ", ".join(f"{count} {code}" for code, count in part.failures.most_common())
        over = " [bold red]over[/]" if part.over else ""
        units = f"{part.units}{over}"
        table.add_row(escape(part.name), units, str(part.allotment), str(part.passed), first, escape(failures))
    print_table(console, table)
    for part in parts:
        if not part.steps:
            continue
        times = Table(f"{escape(part.name)}: step", "median s", "worst s", box=None, pad_edge=False)
        for step, (middle, worst) in part.steps.items():
            times.add_row(escape(step), f"{middle:.2f}", f"{worst:.2f}")
        print_table(console, times)
    silent = ", ".join(part.name for part in parts if not part.attempts and part.station != here)
    if silent:
        hint = f"To add evidence exported there: teds-provision job status {found.id[:8]} DIR"
        console.print(f"{silent}: nothing received yet, neither pages nor evidence. {hint}", markup=False)


for subcommand in (new, list_jobs, show, send, close, status):
    job.add_command(subcommand)


# -- signer ------------------------------------------------------------------------------------------------------------

_LOOK_SECONDS = 0.2
_MOST_WAIT_SECONDS = 1.0
_MOST_RETRY_SECONDS = 30.0
"""Seconds at most between two tries while the registry or the folder is out of reach."""


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples(
        "teds-provision signer run --job 0b5f --files /media/stick",
        "teds-provision signer once request.jws --output signed.json",
    ),
)
def signer() -> None:
    """Sign what a line builds: every datasheet is rebuilt here before it is signed."""


@command("teds-provision signer run --job 0b5f --files /media/stick", name="run")
@click.option("--job", "jobs", multiple=True, required=True, metavar="ID", help="Sign for this job; repeatable.")
@click.option(
    "--files",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Transfer folder, instead of the registry.",
)
@click.option(
    "--for", "seconds", type=Seconds(min=0), metavar="SECONDS", help="Stop after this time (default: Ctrl-C)."
)
@pass_app
def run(app: App, jobs: Sequence[str], files: Path | None, seconds: float | None) -> None:
    """Answer requests until Ctrl-C, one line each.

    A request is signed if its board signed it, its job allows it, and the datasheet built here is the same. While the
    registry or the folder is out of reach, requests wait.
    """
    station = app.station()
    ids = {plant.jobs.find_job(station, job).id for job in jobs}
    station.unlock()
    opened = ExitStack()
    app.closing(opened.close)
    place, transport, inbox = _office_inbox(station, files, opened)
    stop = provisioning.meeting.IdleStop(None)
    signal.signal(signal.SIGTERM, lambda *_: stop.request_stop())
    if seconds is not None:
        threading.Timer(seconds, stop.set).start()
    app.note(f"Signing for {len(ids)} job{'' if len(ids) == 1 else 's'}; Ctrl-C ends it.")
    again = 0.0  # seconds to the next try; 0 while requests arrive
    while not stop.is_set():
        station.unlock()  # ends with vault-locked if another command changed passphrase and master key
        if files is None and plant.connecting.place_of(station) != place:  # registry connect named another one
            opened.close()
            place, transport, inbox = _office_inbox(station, files, opened)
        try:
            for answered in plant.office.answer_all(station, transport, inbox, ids, stop=stop.is_set):
                _print_answer(app, station, answered)
        except LinkError as error:
            if not again:
                app.warn(f"{error.message.rstrip('.')}. Requests wait; trying again until Ctrl-C.")
            again = min(2 * again or _MOST_WAIT_SECONDS, _MOST_RETRY_SECONDS)
            inbox.start_over()
            stop.wait(again)
        else:
            if again:
                app.warn(f"{transport.where} can be used again; signing continues.")
                again = 0.0
            if not stop.is_set():
                inbox.wait(_MOST_WAIT_SECONDS, _LOOK_SECONDS)


def _office_inbox(
    station: Station, files: Path | None, opened: ExitStack
) -> tuple[str | None, Transport, plant.sign_requests.Inbox]:
    """Return the joined place, the transport, and the inbox of requests; ``opened`` closes both."""
    place = plant.connecting.place_of(station)
    transport = plant.sign_requests.transport_for(station, files)
    opened.callback(transport.close)
    inbox = plant.sign_requests.Inbox(station, transport, document.SIGN_REQUEST)
    opened.callback(inbox.close)
    return place, transport, inbox


@command(
    "teds-provision signer once request.jws --output signed.json",
    "teds-provision signer once request.jws --output answer.jws",
    name="once",
)
@click.argument("file", type=FileToRead(), metavar="FILE")
@click.option(
    "--output",
    "-o",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="FILE.json for the signed image (see: write --image), otherwise the answer.",
)
@click.option("--jump", is_flag=True, help="Accept a sequence far above the one known here.")
@pass_app
def once(app: App, file: Path, output: Path, jump: bool) -> None:
    """Answer one request that came as a file.

    `sign UUID --by OFFICE --output FILE` creates it. This station must know its job: teds-provision job show FILE.
    """
    station = app.station()
    station.unlock()
    octets = read_file(file).strip()
    sealed = plant.office.answer(station, octets, jump=jump)
    if sealed is None:
        raise NotAuthenticError(
            f"{file} is not a request from a member of this plant to this office.",
            hint="To create one: teds-provision sign UUID --by OFFICE --output FILE",
        )
    request = signing.open_request(octets, plant.jobs.roster_of(station).point_of)
    answered = signing.open_answer(sealed, lambda kid: station.point)
    if output.suffix != ".json":
        write_file(output, sealed.decode())
    elif answered.security:
        write_file(output, request.image.with_block(teds.image.SECURITY, answered.security).to_json())
    _print_answer(app, station, plant.office.AnsweredRequest(request, answered), end=True)


def _print_answer(app: App, station: Station, signed_request: AnsweredRequest, *, end: bool = False) -> None:
    request, answered = signed_request.request, signed_request.answer
    result: dict[str, Any] = {"uuid": request.uuid.hex(), "job": request.job, "from": request.signer}
    roster = station.plant.roster
    name = roster.name_of(request.signer) if roster is not None else request.signer[:16]
    if not answered.refused:
        app.emit(
            {**result, "sequence": answered.sequence}, f"signed   {request.uuid.hex()}  {answered.sequence}  {name}"
        )
        return
    if end:
        raise plant.sign_requests.OfficeRefusedError(f"Not signed ({answered.refused}): {answered.why}.")
    refused = {**result, "refused": answered.refused, "why": answered.why}
    app.emit(refused, f"refused  {request.uuid.hex()}  {answered.refused}  {name}: {answered.why}")


for subcommand in (run, once):
    signer.add_command(subcommand)


# -- evidence ----------------------------------------------------------------------------------------------------------


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
    grounds = plant.verify_evidence.EvidenceAnchors.from_files(from_pem(read_file(ca)), pins, roster)
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
    text = f"{judged.word:<13}  {found.uuid.hex() if found else '-':<20}  {judged.file}"
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
    lines = [
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
    app.emit({"evidence": lines}, table if lines else none)


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

    One file per board and attempt; no file is replaced. If another station's evidence of a board is there, that of this
    one gets the next numbers.
    """
    station = app.station()
    files = plant.evidence.export(station, _rows(station, uuids, job), folder, write=not dry_run)
    result = {"folder": str(folder), "files": len(files), "written": sum(files.values())}
    word = "Would write" if dry_run else "Wrote"
    app.emit(result, f"{word} {result['written']} of {result['files']} files to {folder}.")


def _rows(station: Station, uuids: tuple[str, ...], job: str | None) -> Iterator[EvidenceRow]:
    id = plant.jobs.job_id(station, job) if job is not None else None
    chosen: list[bytes | None] = [station.nodes.resolve(text) for text in uuids]
    for uuid in chosen or [None]:
        yield from station.plant.line.evidence(uuid=uuid, job=id)


for subcommand in (verify, list_evidence, export):
    evidence.add_command(subcommand)
