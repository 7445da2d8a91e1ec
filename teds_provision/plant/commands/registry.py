"""``registry``: the plant, that is many stations of one owner that exchange what they did."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from shlex import quote
from typing import Any, Final

import click

from teds_provision import plant
from teds_provision.cli.context import App, Station, pass_app
from teds_provision.cli.named_files import read_file
from teds_provision.cli.options import (
    COMMAND_SETTINGS,
    FileToRead,
    WholeNumber,
    command,
    dry_run_option,
    examples,
    yes_option,
)
from teds_provision.cli.rendering import local_time, moment, print_json_list
from teds_provision.errors import NotFoundError, PolicyError
from teds_provision.files import SHARED, write_new
from teds_provision.plant.transport import Transport
from teds_provision.protocol import keys
from teds_provision.protocol.plant import document, roster
from teds_provision.protocol.plant.roster import Roster
from teds_provision.sanitize import sanitize

_FILE: Final = click.Path(path_type=Path, dir_okay=False)
_FOLDER: Final = click.Path(path_type=Path, file_okay=False)
_ROLES: Final = click.Choice(["keeper", "line", "sign", "base", "audit"])


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples(
        "teds-provision registry create --name 'plant Augsburg'",
        "teds-provision registry sync --files /media/stick",
        "teds-provision registry status",
    ),
)
def registry() -> None:
    """Connect an owner's stations into a plant: who holds which key, who signed what, which board was revoked.

    Stations publish signed pages, carried in a folder (a stick, a share) or a PostgreSQL database. Joining is optional,
    and a station that joined keeps working while the registry is out of reach.
    """


# -- the roster: commands of the station with the CA key ---------------------------------------------------------------


def _change_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add --draft, --output, --yes and --dry-run of the commands that make a new version of the roster."""
    for option in (
        dry_run_option,
        yes_option,
        click.option("--output", "-o", type=_FILE, metavar="FILE", help="Also write the signed roster to a new file."),
        click.option("--draft", type=_FILE, metavar="FILE", help="Only write a draft; sign it where the CA key is."),
    ):
        function = option(function)
    return function


def _emit_change(
    app: App,
    station: Station,
    draft: Roster,
    *,
    file: Path | None,
    output: Path | None,
    yes: bool,
    dry_run: bool,
) -> None:
    """Show what a new version changes, ask, sign it, and have it count here; ``file``: only write it as a draft."""
    before = station.plant.roster
    if plant.owner.is_ahead(draft):
        _warn_ahead(app, draft)
    if before is not None and plant.owner.says_the_same(before, draft):
        if output is not None and not dry_run:
            _write_once(output, before.octets + b"\n")
        plan = {"plan": dry_run, "draft": None} if dry_run or file is not None else {}
        app.emit({**_to_json(before), **plan}, f"Nothing to do: roster {before.version} already says so.")
        return
    changes = "\n".join(plant.owner.changes(before, draft))
    if dry_run or file is not None:
        if file is not None and not dry_run:
            write_new(file, plant.owner.write_draft(draft), mode=SHARED)
        text = f"Draft: {file}" if file is not None and not dry_run else "Plan only; nothing was changed."
        app.emit({**_to_json(draft), "plan": dry_run, "draft": str(file) if file else None}, f"{changes}\n{text}")
        return
    app.note(changes)
    app.confirm("Sign this roster?", yes=yes)
    station.unlock()
    with station.lock("registry", app.note):
        held = station.plant.roster
        # two rosters of one version would raise an alarm at all stations
        if held is None or draft.previous != held.hash:
            raise PolicyError("Another command changed the roster in the meantime.", hint="Run this again.")
        signed = plant.owner.signed(station, draft)
        if output is not None:
            write_new(output, signed.octets + b"\n", mode=SHARED)
        plant.apply_pages.put_roster(station, signed)
    # flags the keys that a removed station had
    plant.removed_members.review(station, signed, plant.status.moment(signed))
    app.emit(
        _to_json(signed), f"Roster {signed.version} is in force here. To tell the others: teds-provision registry sync"
    )


def _warn_ahead(app: App, ahead: Roster) -> None:
    app.warn(
        f"Roster {ahead.version} is dated {local_time(ahead.created.isoformat())}, in the future by this machine's"
        " clock. Set the clock; if it is right, no other station takes this roster: registry renew --redate"
    )


def _write_once(path: Path, octets: bytes) -> None:
    """Write a new file; one that holds just this is left as it is."""
    if not (path.is_file() and read_file(path) == octets):
        write_new(path, octets, mode=SHARED)


def _to_json(signed_roster: Roster) -> dict[str, Any]:
    return {
        "registry": signed_roster.registry,
        "name": signed_roster.name,
        "version": signed_roster.version,
        "members": [
            {"name": member.name, "fingerprint": member.fingerprint, "roles": _in_order(member.roles)}
            for member in signed_roster.members
        ],
        "removed": [
            {"name": left.name, "fingerprint": left.fingerprint, "why": left.why, "last": left.last[0]}
            for left in signed_roster.removed
        ],
        "share": [
            {"what": {share.what[0]: share.what[1] or True}, "to": list(share.to), "forget": share.forget}
            for share in signed_roster.share
        ],
        "expires": _time(signed_roster.expires),
    }


def _in_order(roles: frozenset[str]) -> list[str]:
    return [role for role in roster.ROLES if role in roles]


def _time(when: Any) -> str:
    return f"{when:%Y-%m-%dT%H:%M:%SZ}"


@command("teds-provision registry create --name 'plant Augsburg'", name="create")
@click.option("--name", required=True, help="Name of the plant.")
@click.option(
    "--days", type=WholeNumber(1, 400), default=90, show_default=True, metavar="DAYS", help="Validity of the roster."
)
@click.option("--output", "-o", type=_FILE, metavar="FILE", help="Also write the signed roster to a new file.")
@yes_option
@dry_run_option
@pass_app
def create(app: App, name: str, days: int, output: Path | None, yes: bool, dry_run: bool) -> None:
    """Create a registry; this station is its first member.

    Requires the CA key. The station gets the roles keeper, sign, line and base.
    """
    station = app.station()
    draft = plant.owner.draft_first(station, name, timedelta(days=days))
    past = list(plant.backlog.backlog(station))
    changes = "\n".join([*plant.owner.changes(None, draft), _past(past)])
    if dry_run:
        app.emit({**_to_json(draft), "roster": None, "events": len(past), "plan": True}, f"Plan:\n{changes}")
        return
    app.note(changes)
    app.confirm("Create this registry?", yes=yes)
    station.unlock()
    with station.lock("registry create", app.note):
        signed = plant.owner.signed(station, draft)
        if output is not None:
            write_new(output, signed.octets + b"\n", mode=SHARED)
        events = plant.owner.join(station, signed, url=None, events=list(plant.backlog.backlog(station)))
    text = f"Registry {signed.registry} of {name} was created. Next: registry connect --files DIR"
    app.emit({**_to_json(signed), "roster": signed.octets.decode(), "events": events}, text)


def _past(past: Sequence[Any]) -> str:
    counts = plant.backlog.count(list(past))
    listed = ", ".join(f"{count} {act}" for act, count in sorted(counts.items())) or "nothing"
    return f"  it will publish what this store knows: {listed}"


@command("teds-provision registry request --output south.request", name="request")
@click.option("--output", "-o", type=_FILE, required=True, metavar="FILE", help="Where to write the request.")
@pass_app
def request(app: App, output: Path) -> None:
    """Write this station's membership request.

    Give it to the owner of the CA key. Running the command again writes the same request.
    """
    station = app.station()
    station.unlock()
    with station.lock("registry request", app.note):
        octets = plant.membership.request(station)
    _write_once(output, octets + b"\n")
    login = plant.schema.role_of(station.fingerprint)
    held = station.plant.roster
    member = held is not None and held.member(station.fingerprint) is not None
    step = f"sql --member {quote(output.name)} | psql" if member else f"add {quote(output.name)} --role base"
    app.emit(
        {"request": str(output), "fingerprint": station.fingerprint, "role": login},
        f"Request of {station.name}: {output}\n{station.fingerprint}\n"
        f"{'At a keeper' if member else 'There'}: teds-provision registry {step}",
    )


@command("teds-provision registry add south.request --role base", name="add")
@click.argument("file", type=FileToRead())
@click.option("--role", "roles", type=_ROLES, multiple=True, required=True, help="Its roles; repeatable.")
@click.option("--name", help="Name in the roster (default: the station's own).")
@_change_options
@pass_app
def add(app: App, /, file: Path, roles: Sequence[roster.Role], name: str | None, **how: Any) -> None:
    """Add the station that made this request to the roster.

    Compare the fingerprint by voice.
    """
    station = app.station()
    asked = document.open_request(read_file(file))
    draft = plant.owner.add(station, replace(asked, name=name) if name else asked, frozenset(roles))
    _emit_change(app, station, draft, **_named(how))


@command("teds-provision registry role west line", "teds-provision registry role west line --signed 88", name="role")
@click.argument("name")
@click.argument("roles", type=_ROLES, nargs=-1, required=True, metavar="ROLE…")
@click.option("--signed", type=WholeNumber(0, 1 << 31), metavar="N", help="Last page whose signatures still count.")
@_change_options
@pass_app
def role(app: App, /, name: str, roles: Sequence[roster.Role], signed: int | None, **how: Any) -> None:
    """Set a member's roles. If it loses "sign", what it has signed stays authentic."""
    station = app.station()
    member = plant.owner.require_member(plant.apply_pages.require_roster(station), name)
    place = None if signed is None else plant.owner.page_place(station, member.fingerprint, signed)
    _emit_change(app, station, plant.owner.with_roles(station, name, frozenset(roles), place), **_named(how))


@command("teds-provision registry share --group left-hand --to south", name="share")
@click.option("--all", "every", is_flag=True, help="All nodes.")
@click.option("--group", metavar="NAME", help="Nodes of a group.")
@click.option("--profile", metavar="NAME", help="Nodes of a type.")
@click.option(
    "--to", "names", multiple=True, required=True, metavar="NAME", help="A member with the role base; repeatable."
)
@click.option("--forget", is_flag=True, help="Senders not named here delete their key once all have it.")
@_change_options
@pass_app
def share(
    app: App, /, every: bool, group: str | None, profile: str | None, names: Sequence[str], forget: bool, **how: Any
) -> None:
    """Copy node keys to these members automatically."""
    station = app.station()
    held = plant.apply_pages.require_roster(station)
    to = tuple(plant.owner.require_member(held, name).fingerprint for name in names)
    draft = plant.owner.shared(station, roster.Share(_what(every, group, profile), to, forget))
    _emit_change(app, station, draft, **_named(how))


@command("teds-provision registry unshare --group left-hand", name="unshare")
@click.option("--all", "every", is_flag=True, help="All nodes.")
@click.option("--group", metavar="NAME", help="Nodes of a group.")
@click.option("--profile", metavar="NAME", help="Nodes of a type.")
@_change_options
@pass_app
def unshare(app: App, /, every: bool, group: str | None, profile: str | None, **how: Any) -> None:
    """Stop copying the keys of these nodes.

    Keys that were already copied stay where they are.
    """
    station = app.station()
    _emit_change(app, station, plant.owner.unshared(station, _what(every, group, profile)), **_named(how))


def _what(every: bool, group: str | None, profile: str | None) -> Any:
    named = [choice for choice in (("all", "") if every else None, group and ("group", group),
                             profile and ("profile", profile)) if choice]  # fmt: skip
    if len(named) != 1:
        raise click.UsageError("Give one of --all, --group and --profile.")
    return named[0]


@command("teds-provision registry remove west --lost --last 88", name="remove")
@click.argument("name")
@click.option("--retired", is_flag=True, help="Taken out of service in an orderly way.")
@click.option("--lost", is_flag=True, help="Its whereabouts are unknown.")
@click.option("--stolen", is_flag=True, help="Someone else has it: its sessions end at once.")
@click.option("--last", type=WholeNumber(0, 1 << 31), metavar="N", help="Its last page that counts.")
@_change_options
@pass_app
def remove(app: App, /, name: str, last: int | None, **how: Any) -> None:
    """Remove a station permanently. What it published up to its last page still counts."""
    reasons: tuple[roster.Why, ...] = ("retired", "lost", "stolen")
    given = [reason for reason in reasons if how[reason]]
    if len(given) != 1:
        raise click.UsageError("Give one of --retired, --lost and --stolen.")
    (why,) = given
    station = app.station()
    member = plant.apply_pages.require_roster(station).named(name)
    if isinstance(member, roster.Member) and last is None and why != "retired":
        pages = plant.status.page_list(station, member.fingerprint)
        listed = "\n".join(f"  {n:>6}  {local_time(created)}  {hash[:16]}" for n, hash, created in pages)
        app.note(f"The newest pages of {member.name}:\n{listed or '  none'}")
    _emit_change(app, station, plant.owner.draft_removal(station, name, why, last), **_named(how))


@command("teds-provision registry renew --days 90", name="renew")
@click.option(
    "--days",
    type=WholeNumber(1, 400),
    default=90,
    show_default=True,
    metavar="DAYS",
    help="Validity from now on.",
)
@click.option(
    "--redate", is_flag=True, help="Date it by this clock, after a wrong clock dated the present one in the future."
)
@_change_options
@pass_app
def renew(app: App, /, days: int, redate: bool, **how: Any) -> None:
    """Extend the roster."""
    station = app.station()
    held = plant.apply_pages.require_roster(station)
    if redate:
        plant.owner.require_wrong_date(station, held)
    draft = plant.owner.renewed(station, timedelta(days=days), redate=redate)
    _emit_change(app, station, draft if redate else plant.owner.same_end(held, draft), **_named(how))


def _named(how: dict[str, Any]) -> dict[str, Any]:
    return {"file": how["draft"], "output": how["output"], "yes": how["yes"], "dry_run": how["dry_run"]}


@command("teds-provision registry sign roster.draft --output roster.jws", name="sign")
@click.argument("file", type=FileToRead())
@click.option("--output", "-o", type=_FILE, required=True, metavar="FILE", help="Where to write the signed roster.")
@yes_option
@dry_run_option
@pass_app
def sign(app: App, file: Path, output: Path, yes: bool, dry_run: bool) -> None:
    """Sign a draft of a roster with the CA key.

    The station that signs need not be a member. Shows everything in the draft first.
    """
    station = app.station()
    draft = plant.owner.read_draft(read_file(file), station.ca)
    before = station.plant.roster
    same = before is not None and before.registry == draft.registry
    changes = "\n".join(plant.owner.changes(before if same else None, draft))
    if dry_run:
        app.emit({**_to_json(draft), "plan": True}, f"Plan:\n{changes}")
        return
    app.note(changes)
    app.confirm("Sign this roster?", yes=yes)
    station.unlock()
    signed = plant.owner.signed(station, draft)
    write_new(output, signed.octets + b"\n", mode=SHARED)
    if same:
        with station.lock("registry sign", app.note):
            plant.apply_pages.take_rosters(station, [signed.octets])
        plant.removed_members.review(station, signed, plant.status.moment(signed))
    app.emit(
        _to_json(signed),
        f"Signed: {output}. To distribute it: registry sync --files DIR, or connect --roster {quote(output.name)}",
    )


# -- joining and leaving -----------------------------------------------------------------------------------------------


@command(
    "teds-provision registry connect --files /media/stick",
    "teds-provision registry connect 'postgresql://office/plant?sslrootcert=office.crt'",
    name="connect",
)
@click.argument("url", required=False)
@click.option("--files", type=_FOLDER, metavar="DIR", help="Transfer folder: a stick or a share.")
@click.option(
    "--roster",
    "roster_file",
    type=FileToRead(exists=True),
    metavar="FILE",
    help="Roster file, if it is not in the folder.",
)
@yes_option
@dry_run_option
@pass_app
def connect(app: App, url: str | None, files: Path | None, roster_file: Path | None, yes: bool, dry_run: bool) -> None:
    """Join a registry whose roster names this station.

    Shows the registry and CA, to compare, and what this station will publish.

    URL names a PostgreSQL database: postgresql://HOST/DATABASE, with ?sslrootcert=FILE if the server has a private
    certificate. The station logs in with the key from its request; there is no password to type.
    """
    if (files is None) == (url is None):
        raise click.UsageError("Give a URL, or --files DIR.")
    station = app.station()
    transport: Transport
    if url is not None:
        station.unlock()
        transport = plant.connecting.database(station, plant.connecting.absolute(url))
    else:
        assert files is not None
        transport = plant.folder_transport.FolderTransport(files)
    octets = None if roster_file is None else read_file(roster_file).strip()
    found = plant.membership.found_roster(station, transport, octets)
    if url is not None:
        plant.connecting.require_registry(transport, found.registry)
    joined = station.plant.joined
    same = joined is not None and joined.registry == found.registry
    if joined is not None and not same:
        raise PolicyError(
            f"This station already belongs to registry {joined.registry}.", hint="Leave it first: registry disconnect"
        )
    past = [] if same else list(plant.backlog.backlog(station))
    text = "\n".join([
        f"{found.name}, registry {found.registry}, roster {found.version} until {_time(found.expires)}",
        f"  CA {keys.fingerprint(station.ca)}",
        f"  as {' '.join(_in_order(found.roles_of(station.fingerprint)))}",
        _past(past),
    ])  # fmt: skip
    result = {"registry": found.registry, "version": found.version, "events": len(past)}
    if dry_run:
        app.emit({**result, "plan": True}, f"Plan: join {text}")
        return
    app.note(text)
    if not same:
        app.confirm("Join this registry?", yes=yes)
    station.unlock()
    with station.lock("registry connect", app.note):
        place = plant.membership.FILES + str(files.resolve()) if files else plant.connecting.absolute(url or "")
        events = plant.owner.join(station, found, url=place, events=past)
    transport.close()
    app.emit({**result, "events": events}, f"Joined {found.name}. Next: teds-provision registry sync")


@command("teds-provision registry disconnect --yes", name="disconnect")
@yes_option
@dry_run_option
@pass_app
def disconnect(app: App, yes: bool, dry_run: bool) -> None:
    """Leave the registry. Keys, pins and pages stay; the roster no longer applies here."""
    station = app.station()
    held = plant.apply_pages.require_roster(station)
    text = (
        f"Leave {held.name}: this station stops publishing, and trusts every station that the CA certified again,"
        " removed ones included. It stays on the roster until the owner runs: registry remove"
    )
    if dry_run:
        app.emit({"registry": held.registry, "plan": True}, f"Plan: {text}")
        return
    app.note(text)
    app.confirm("Leave this registry?", yes=yes)
    with station.lock("registry disconnect", app.note):
        plant.membership.disconnect(station)
    app.emit({"registry": held.registry}, f"Left {held.name}.")


def _transport(station: Station, files: Path | None) -> tuple[Transport, bool]:
    """Return the transport, and True if it is the one by which this station joined."""
    joined = plant.connecting.open_transport(station)
    if files is not None:
        named = plant.folder_transport.FolderTransport(files)
        return named, joined is not None and joined.where == str(files.resolve())
    if joined is None:
        plant.apply_pages.require_roster(station)
        raise NotFoundError(
            "This station does not know how to reach the registry.", hint="Name a folder: registry sync --files DIR"
        )
    return joined, True


_files = click.option("--files", type=_FOLDER, metavar="DIR", help="Transfer folder: a stick or a share.")


@command("teds-provision registry sync", "teds-provision registry sync --files /media/stick", name="sync")
@_files
@pass_app
def sync(app: App, files: Path | None) -> None:
    """Exchange pages with the other stations. If interrupted, run it again."""
    station = app.station()
    transport, connected = _transport(station, files)
    try:
        done = plant.sync.sync(station, transport, connected=connected)
        doors = plant.connecting.check_database(station, transport)
    finally:
        transport.close()
    alarms = [alarm for alarm in station.plant.alarms.all() if not alarm.seen]
    result = {
        "pushed": done.pushed,
        "fetched": done.fetched,
        "returned": done.returned,
        "parcels": {"in": done.parcels_in, "out": done.parcels_out, "waiting": done.waiting},
        "alarms": [_alarm(station, alarm) for alarm in alarms],
        "told": done.remarks,
        "rosters": done.rosters,
        "open_doors": doors,
    }
    if doors:
        app.warn(
            f"The database allows what it should not: {', '.join(doors)}. As its superuser, run: registry sql | psql"
        )
    app.emit(result, _synced(station, done, alarms))
    if alarms:
        raise click.exceptions.Exit(4)


def _synced(station: Station, done: plant.sync.SyncResult, alarms: Sequence[Any]) -> str:
    lines = [f"{_count(done.pushed, 'page')} out, {done.fetched} in"]
    if done.parcels_in or done.parcels_out:
        lines.append(f"{_count(done.parcels_out, 'parcel')} out, {done.parcels_in} in")
    if done.waiting:
        waits = f"{_count(done.waiting, 'parcel')} {'waits' if done.waiting == 1 else 'wait'}"
        lines.append(f"{waits} for confirmation: teds-provision import-keys --received")
    lines += [f"roster {version} is now in force" for version in done.rosters]
    lines += done.remarks
    lines += [f"ALARM {_alarm_line(station, alarm)}" for alarm in alarms]
    return "\n".join(lines)


def _alarm(station: Station, alarm: Any) -> dict[str, Any]:
    return {
        "code": alarm.code,
        "about": alarm.about,
        "n": alarm.n,
        "why": alarm.why,
        "at": alarm.at,
        "seen": alarm.seen,
    }


def _alarm_line(station: Station, alarm: Any) -> str:
    held = station.plant.roster
    name = held.name_of(alarm.about) if held is not None and alarm.about else ""
    return f"{alarm.code}{f' of {name}' if name else ''}{f', {alarm.n}' if alarm.n else ''}: {alarm.why}"


# -- status and overviews ----------------------------------------------------------------------------------------------


@command("teds-provision registry status", name="status")
@pass_app
def status(app: App) -> None:
    """Show the state of every station, and open decisions.

    Works offline. Exits 4 while there are unacknowledged alarms, 6 if the roster has expired or this station was
    removed.
    """
    station = app.station()
    held = plant.apply_pages.require_roster(station)
    record = station.plant.joined
    assert record is not None
    found = plant.status.status(station, record, held)
    if plant.owner.is_ahead(held):
        _warn_ahead(app, held)
    result = {
        "registry": held.registry,
        "name": held.name,
        "roster": held.version,
        "expires": _time(held.expires),
        "members": [_standing(peer) for peer in found.standings],
        "unsent": found.unsent,
        "synced": record.synced,
        "conflicts": found.conflicts,
        "alarms": [_alarm(station, alarm) for alarm in found.alarms],
        "to_rotate": plant.removed_members.rotations_due(station),
        "heads": list(found.heads),
        "open_doors": station.plant.doors(),
    }
    app.emit(result, _shown(station, found))
    if found.exit_code:
        raise click.exceptions.Exit(found.exit_code)


def _standing(standing: plant.status.StationStanding) -> dict[str, Any]:
    return {
        "name": standing.name,
        "fingerprint": standing.fingerprint,
        "roles": list(standing.roles),
        "n": standing.number,
        "age": standing.age,
        "state": standing.state,
    }


def _shown(station: Station, found: plant.status.PlantStatus) -> str:
    held, digits = found.roster, found.heads[0]
    heads = " ".join(digits[at : at + 4] for at in range(0, 16, 4))
    lines = [
        f"{held.name} {held.registry[:8]}   roster {held.version}, until {held.expires:%Y-%m-%d}"
        f"   heads {heads} of {found.heads[1]}"
    ]
    wide = max(len(peer.name) for peer in found.standings)
    roles = max(len(" ".join(peer.roles)) for peer in found.standings)
    for peer in found.standings:
        age = _age(peer.age) if peer.age is not None else "-"
        lines.append(
            f"{peer.name:<{wide}}  {' '.join(peer.roles):<{roles}}  page {peer.number:>5}  {age:>8}  {peer.state}"
        )
    last = f"last sync {local_time(found.record.synced)}" if found.record.synced else "never synced"
    lines.append(f"{_count(found.conflicts, 'conflict')}, {_count(found.unsent, 'event')} unsent, {last}")
    review, due = plant.removed_members.last(station), plant.removed_members.rotations_due(station)
    if review is not None and due:
        tap = f"; {review.alone} need a tap" if review.alone else ""
        lines.append(f"to rotate: {due} of {review.of}{tap}")
    elif review is not None and review.alone:
        need = "needs" if review.alone == 1 else "need"
        lines.append(f"{_count(review.alone, 'node')} {need} a tap: only a station that left held the key")
    lines += [f"ALARM {_alarm_line(station, alarm)}" for alarm in found.alarms if not alarm.seen]
    doors = station.plant.doors()
    if doors:
        lines.append(f"The database allows what it should not: {', '.join(doors)}")
    if found.expired:
        lines.append("The roster has EXPIRED: on the station with the CA key: registry renew")
    elif found.expires_soon:
        lines.append("The roster expires soon: on the station with the CA key: registry renew")
    return "\n".join(lines)


def _count(number: int, singular: str) -> str:
    return f"{number} {singular}{'' if number == 1 else 's'}"


def _age(seconds: int) -> str:
    for unit, length in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length or (unit == "min" and seconds >= length):
            return f"{seconds // length} {unit}"
    return f"{seconds} s"


@command("teds-provision registry log --since today", "teds-provision registry log 8d4d --station west", name="log")
@click.argument("node", required=False, metavar="[UUID]")
@click.option("--station", "name", metavar="NAME", help="Only what this station published.")
@click.option("--since", metavar="TIME", help="Only pages made since: ISO 8601, today, 2h.")
@pass_app
def log(app: App, node: str | None, name: str | None, since: str | None) -> None:
    """Show what the stations published, with station and page.

    Every page's signature has been checked.
    """
    station = app.station()
    held = plant.apply_pages.require_roster(station)
    of = None
    if name is not None:
        found = held.named(name)
        if found is None:
            raise NotFoundError(f"{name!r} is not in the roster.", hint="See: teds-provision registry status")
        of = found.fingerprint
    uuid = None if node is None else plant.status.resolve(station, node)
    statements = plant.status.log(station, uuid=uuid, of=of, since=moment(since) if since else None)
    if app.json:
        more = (
            (stated, {"fingerprint_of_station": stated.station, "page": stated.number, "counts": stated.counts})
            for stated in statements
        )
        print_json_list(
            "events", ({**stated.event, "station": held.name_of(stated.station), **facts} for stated, facts in more)
        )
        return
    for stated in statements:
        counts = "" if stated.counts else "  (does not count)"
        who = f"{held.name_of(stated.station)} {stated.number}"
        app.lines([sanitize(f"{stated.event['at']}  {who}  {stated.event['act']}  {_members(stated.event)}{counts}")])


def _members(event: dict[str, Any]) -> str:
    hidden = ("act", "id", "at", "statement", "proof")
    shown = {name: value for name, value in event.items() if name not in hidden and value is not None}
    return " ".join(f"{name}={_short(value)}" for name, value in shown.items())


def _short(value: object) -> str:
    if isinstance(value, list):  # of firmware, show text and version, but not the digest of the image
        return " ".join(map(str, value[:2]))
    return str(value)[:20]


# -- decisions of the operator -----------------------------------------------------------------------------------------


@command("teds-provision registry vouch --all", name="vouch")
@click.argument("nodes", nargs=-1, metavar="[UUID …]")
@click.option(
    "--all", "every", is_flag=True, help="Every datasheet that is authentic here and whose signer is not in the plant."
)
@yes_option
@dry_run_option
@pass_app
def vouch(app: App, nodes: Sequence[str], every: bool, yes: bool, dry_run: bool) -> None:
    """As a keeper, declare older datasheets valid everywhere.

    For datasheets signed by stations that left before the plant was created.
    """
    if every == bool(nodes):
        raise click.UsageError("Give UUIDs, or --all.")
    station = app.station()
    uuids = None if every else [station.nodes.resolve(text) for text in nodes]
    found = plant.membership.vouchable(station, uuids)
    lines = "\n".join(f"  {uuid.hex()}  signed by {signer}" for uuid, _, signer in found) or "  none"
    result = {"nodes": [{"uuid": uuid.hex(), "teds_sha256": digest} for uuid, digest, _ in found]}
    if dry_run:
        app.emit({**result, "done": 0, "plan": True}, f"Plan: vouch for these datasheets:\n{lines}")
        return
    if not found:
        app.emit({**result, "done": 0}, "Nothing to do: no datasheet needs a keeper's word.")
        return
    app.note(f"Datasheets that are authentic here but not in the plant:\n{lines}")
    app.confirm("Vouch for them?", yes=yes)
    station.unlock()
    with station.lock("registry vouch", app.note):
        done = plant.membership.vouch(station, found)
    app.emit({**result, "done": done}, f"Vouched for {_count(done, 'datasheet')}. To tell the others: registry sync")


@command("teds-provision registry accept west --page 4f1c09aa77e012bd", name="accept")
@click.argument("name")
@click.option("--page", metavar="HASH", help="First page of the branch: at least 8 digits of its hash.")
@_files
@yes_option
@dry_run_option
@pass_app
def accept(app: App, name: str, page: str | None, files: Path | None, yes: bool, dry_run: bool) -> None:
    """Accept one of a station's two histories, here only."""
    station = app.station()
    held = plant.apply_pages.require_roster(station)
    member = plant.owner.require_member(held, name)
    transport = (
        plant.folder_transport.FolderTransport(files) if files is not None else plant.connecting.open_transport(station)
    )
    if dry_run:
        n, hash = plant.membership.branch(station, member.fingerprint, page, transport)
        app.emit(
            {"done": 0, "n": n, "hash": hash, "plan": True}, f"Plan: page {n} ({hash[:16]}) would be accepted here."
        )
        return
    app.confirm(f"Accept this history of {member.name}?", yes=yes, named="--page")
    station.unlock()
    with plant.sync.sync_lock(station):
        n, hash = plant.membership.accept(station, member.fingerprint, page, transport)
        plant.apply_pages.apply_claims(station)
    app.emit({"done": 1, "n": n, "hash": hash}, f"Page {n} ({hash[:16]}) and its successors count here.")


@command("teds-provision registry resume", name="resume")
@_files
@yes_option
@dry_run_option
@pass_app
def resume(app: App, files: Path | None, yes: bool, dry_run: bool) -> None:
    """Continue after a fork.

    Adopts the pages found there under this station's key.

    First find out who else uses a copy of this home. If you cannot, remove this station instead.
    """
    station = app.station()
    transport, _ = _transport(station, files)
    if dry_run:
        there = len(plant.sync.unknown_pages(station, transport))
        app.emit({"done": 0, "adopts": there, "plan": True}, f"Plan: {_count(there, 'page')} would be adopted.")
        return
    app.note("If a copy of this home is in use elsewhere, stop it first. If in doubt, have this station removed.")
    app.confirm("Is this the only home with this station's key?", yes=yes)
    done = plant.sync.resume(station, transport)
    app.emit({"done": done}, f"Adopted: {_count(done, 'page')}. Next: teds-provision registry sync")


@command("teds-provision registry seen", name="seen")
@pass_app
def seen(app: App) -> None:
    """Acknowledge all alarms and reports of missing pages so far.

    They are no longer shown (--json lists alarms with "seen"), and commands no longer exit 4 because of them.
    """
    station = app.station()
    plant.apply_pages.require_roster(station)
    with station.lock("registry seen", app.note):
        alarms, heads = plant.sync.acknowledge(station)
    also = f", {_count(heads, 'report')} of missing pages" if heads else ""
    app.emit({"done": alarms + heads}, f"{_count(alarms, 'alarm')} seen{also}.")


@command(
    "teds-provision registry sql",
    "teds-provision registry sql --member south.request",
    "teds-provision registry sql --close west",
    name="sql",
)
@click.option(
    "--member", type=FileToRead(), metavar="FILE", help="Create the login of the station that sent this request."
)
@click.option("--close", "closed", metavar="NAME", help="Disable this station's login.")
@click.option("--mend", nargs=2, metavar="NAME N", help="Delete rows from number N on that NAME did not sign.")
@pass_app
def sql(app: App, member: Path | None, closed: str | None, mend: tuple[str, str] | None) -> None:
    """Print the SQL for the database superuser.

    Pipe it into psql; this program never runs it. Without options it prints the schema, which can be run again at any
    time, and must be after every pg_restore.
    """
    if sum(subcommand is not None for subcommand in (member, closed, mend)) > 1:
        raise click.UsageError("Give one of --member, --close and --mend.")
    station = app.station()
    held = plant.apply_pages.require_roster(station)
    if member is not None:
        asked = document.open_request(read_file(member))
        left = held.removed_one(asked.fingerprint)
        if left is not None:
            raise PolicyError(
                f"{left.name} was removed from {held.name} ({left.why}); its login stays closed.",
                hint="A removed key cannot return: create a new station (init), and add that one.",
            )
        if held.member(asked.fingerprint) is None:
            app.warn(f"{asked.name} is not in the roster yet. To add it: registry add {quote(str(member))} --role ROLE")
        text = plant.schema.member_sql(asked.fingerprint, asked.login)
    elif closed is not None:
        text = plant.schema.close_sql(_of_roster(held, closed))
    elif mend is not None:
        if not mend[1].isdecimal() or len(mend[1]) > 10:
            raise click.UsageError(f"--mend: {mend[1]!r} is not a page number.")
        text = plant.schema.mend_sql(_of_roster(held, mend[0]), int(mend[1]))
    else:
        text = plant.schema.registry_sql(held.registry, [removed.fingerprint for removed in held.removed])
    app.emit({"sql": text}, text.rstrip("\n"))


def _of_roster(held: Roster, name: str) -> str:
    found = held.named(name)
    if found is None:
        raise NotFoundError(f"{name!r} is not in the roster.", hint="See: teds-provision registry status")
    return found.fingerprint


for subcommand in (
    create, request, add, role, share, unshare, remove, renew, sign, connect, disconnect, sync, status, log, vouch,
    accept, resume, seen, sql,
):  # fmt: skip
    registry.add_command(subcommand)
