"""``trust``: public keys of other stations and CAs that count here, and this owner's CA key."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import click

from teds_provision.cli.context import App, pass_app
from teds_provision.cli.options import (
    COMMAND_SETTINGS,
    FileToRead,
    dry_run_option,
    examples,
    fingerprint_option,
    yes_option,
)
from teds_provision.cli.rendering import count_of, local_time
from teds_provision.cli.station.handover import require_same
from teds_provision.errors import KeyMismatchError, NotFoundError
from teds_provision.files import holds, read_limited, write_new
from teds_provision.handover import trust as handover_trust
from teds_provision.handover.trust import (
    MAX_OCTETS,
    Candidate,
    Removal,
    RemovedTrust,
    candidates_of,
    drop_ca,
    export_ca,
    find_removed,
    find_trusted,
    import_ca,
    plan_removal,
    read_request,
    require_ca,
    require_own_ca,
    sign_request,
    spoken,
    write_certificate,
)
from teds_provision.protocol import keys as protocol_keys
from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.keys import to_pem
from teds_provision.station.station import Station
from teds_provision.station.store.records import TrustRecord

_FILE = click.Path(path_type=Path, dir_okay=False)


@click.group(
    context_settings=COMMAND_SETTINGS,
    epilog=examples("teds-provision trust add lab keys/lab.pem", "teds-provision trust list"),
)
def trust() -> None:
    """Manage the public keys of other stations and CAs that this station trusts; nothing else is trusted.

    Key files, including those under version control in keys/, count only after you add them.
    """


@trust.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Trust the public key of a station or CA.",
    epilog=examples("teds-provision trust add lab keys/lab.pem", "teds-provision trust add --from keys/ --yes"),
)
@click.argument("name", required=False)
@click.argument("file", type=FileToRead(), required=False)
@click.option(
    "--from", "folder", type=click.Path(path_type=Path), metavar="DIR", help="Add every key in this directory."
)
@click.option(
    "--role", type=click.Choice(["station", "ca"]), default="station", show_default=True, help="Whose key it is."
)
@fingerprint_option(
    "Trust it without asking if its fingerprint starts with these 32 to 64 digits, as read out by its owner."
)
@yes_option
@dry_run_option
@pass_app
def add(
    app: App,
    name: str | None,
    file: Path | None,
    folder: Path | None,
    role: Literal["station", "ca"],
    fingerprint: str | None,
    yes: bool,
    dry_run: bool,
) -> None:
    """Trust the public key of a station or CA: a PEM file, or a certificate from "trust ca sign".

    Compare the fingerprint with its owner by voice. In a directory, NAME.pem and NAME.cert are stations, NAME.ca.pem
    CAs.
    """
    station = app.station()
    found = _candidates(station, name, file, folder, role, fingerprint)
    fresh = [key for key in found if not key.known]
    result = {"trusted": [_record(key.record) for key in found], "added": len(fresh)}
    if dry_run:
        app.emit({**result, "plan": True}, _shown(found))
        return
    _add(app, station, [key for key in found if key.known or _agreed(app, key, yes or fingerprint is not None)])


def _add(app: App, station: Station, chosen: list[Candidate]) -> None:
    fresh = [candidate for candidate in chosen if not candidate.known]
    if fresh:
        station.unlock()  # trust records are sealed by the vault
    with station.lock("trust add", app.note):
        added = handover_trust.add(station, chosen)
    result = {"trusted": [_record(candidate.record) for candidate in chosen], "added": added}
    names = ", ".join(candidate.record.name for candidate in fresh)
    app.emit(result, f"Now trusted: {names}." if added else "Nothing to do.")


def _candidates(
    station: Station,
    name: str | None,
    file: Path | None,
    folder: Path | None,
    role: Literal["station", "ca"],
    fingerprint: str | None,
) -> list[Candidate]:
    """Return the selected keys: NAME and FILE, compared with ``fingerprint`` if one is given, or all of a folder."""
    if folder is not None and (name is not None or fingerprint is not None):
        raise click.UsageError("--from DIR cannot be combined with NAME or --fingerprint.")
    if folder is not None:
        return candidates_of(station, folder, role)
    if name is None or file is None:
        raise click.UsageError("Give NAME and FILE, or --from DIR.")
    found = handover_trust.candidate(station, name, file, role)
    if fingerprint is not None and not same_key(fingerprint, found.record.fingerprint):
        raise KeyMismatchError(
            f"{file} holds the key {found.record.fingerprint[:32]}, not {fingerprint[:32]}.",
            hint="Nothing was changed. Compare it with its owner again.",
        )
    return [found]


def _agreed(app: App, candidate: Candidate, yes: bool) -> bool:
    """Show one fingerprint and ask; a folder goes on after a no."""
    app.note(_shown([candidate]))
    if yes or not app.interactive:
        app.confirm("", yes=yes)
        return True
    return app.ask_for_key(
        f"Trust the {candidate.record.role} {candidate.record.name!r}?", candidate.record.fingerprint
    )


def _shown(found: list[Candidate]) -> str:
    lines = []
    for key in found:
        lines.append(f"{key.record.role} {key.record.name}  ({key.path}){'  already trusted' if key.known else ''}")
        lines.append(f"  {spoken(key.record.fingerprint)}")
        if key.certificate is not None:
            lines.append(f"  certified by the CA {protocol_keys.fingerprint(key.certificate.ca)[:32]}")
    return "\n".join(lines)


def _record(record: TrustRecord) -> dict[str, str]:
    return {"name": record.name, "role": record.role, "fingerprint": record.fingerprint}


@trust.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Stop trusting a key and undo what depends on it.",
    epilog=examples("teds-provision trust remove lab --yes"),
)
@click.argument("name", metavar="NAME|FINGERPRINT")
@yes_option
@dry_run_option
@pass_app
def remove(app: App, name: str, yes: bool, dry_run: bool) -> None:
    """Stop trusting a key and undo what depends on it; the consequences are listed first.

    Nodes whose key that station holds are rotated at the next contact; CAs that only it introduced no longer count for
    the nodes that keep them; bans that it issued are lifted.
    """
    station = app.station()
    record = _trusted_until_now(app, station, name)
    if record is None:
        return
    plan = plan_removal(station, record)
    result: dict[str, Any] = {"trusted": _trusted(station), "removed": _record(record), "ends": _ends(plan)}
    result["fresh"] = True
    text = f"{record.role} {record.name}, {record.fingerprint[:32]}"
    if dry_run:
        app.emit({**result, "plan": True}, "\n".join([f"Plan: stop trusting the {text}.", *_ended(plan)]))
        return
    app.note("\n".join([f"Trusted as {text}", *_ended(plan)]))
    app.confirm(f"Stop trusting the {text}?", yes=yes)
    station.unlock()
    with station.lock("trust remove", app.note):
        current = _trusted_until_now(app, station, name)
        if current is None:  # the same command, run at the same time, was first
            return
        require_same(current == record and plan_removal(station, record) == plan)
        done = handover_trust.remove(station, record)
    result |= {"trusted": _trusted(station), "ends": _ends(done)}
    app.emit(result, "\n".join([f"No longer trusted: {text}.", *_ended(done)]))


def _trusted_until_now(app: App, station: Station, name: str) -> TrustRecord | None:
    """Return the trusted key, None if it was removed before, which is printed. Raises NotFoundError if it never was."""
    try:
        return find_trusted(station, name)
    except NotFoundError:
        before = find_removed(station, name)
        if before is None:
            raise
    _print_removed(app, station, before)
    return None


def _trusted(station: Station) -> list[dict[str, str]]:
    return [_record(record) for record in station.policy.listed()]


def _print_removed(app: App, station: Station, before: RemovedTrust) -> None:
    """Print that a key was removed by an earlier run; nothing ends any more."""
    ended = {"rotations": [], "cas": [], "nodes_under_them": 0, "bans": [], "open_handovers": []}
    removed = {"name": before.name, "role": before.role, "fingerprint": before.fingerprint}
    text = f"{before.role} {before.name}, {before.fingerprint[:32]}"
    app.emit(
        {"trusted": _trusted(station), "removed": removed, "ends": ended, "fresh": False},
        f"Nothing to do: the {text}, is not trusted any more since {local_time(before.at)}.",
    )


def _ends(removal: Removal) -> dict[str, Any]:
    return {
        "rotations": [uuid.hex() for uuid in removal.shared],
        "cas": [protocol_keys.fingerprint(ca) for ca in removal.cas],
        "nodes_under_them": removal.under,
        "bans": [uuid.hex() for uuid in removal.bans],
        "open_handovers": list(removal.open),
    }


def _ended(removal: Removal) -> list[str]:
    """Return what ends with it, for people."""
    lines = []
    if removal.shared:
        lines.append(f"  {count_of(len(removal.shared))} whose key it holds: to be rotated at the next contact")
        lines += [f"    {uuid.hex()}" for uuid in removal.shared[:20]]
    lines += [f"  the CA {protocol_keys.fingerprint(ca)[:32]} is no longer trusted" for ca in removal.cas]
    if removal.under:
        keeps, them = ("keeps", "it") if removal.under == 1 else ("keep", "them")
        lines.append(f"    {count_of(removal.under)} {keeps} it: reset and provision {them} again")
    lines += [f"  its ban of node {uuid.hex()} is lifted" for uuid in removal.bans]
    lines += [
        f"  handover {id_} to it is still open, so it may have these keys; see handover list" for id_ in removal.open
    ]
    return lines


@trust.command("list", context_settings=COMMAND_SETTINGS, epilog=examples("teds-provision trust list"))
@pass_app
def list_(app: App) -> None:
    """List the trusted keys, besides this station's own."""
    station = app.station()
    records = station.policy.listed()
    ca, certificate = station.ca, station.identity.certificate
    certified = {record.fingerprint: certificate(ca, record.point) is not None for record in records}
    keys = [
        {
            **_record(record),
            "added": record.added,
            "certified": certified[record.fingerprint],
            "source": "roster" if station.policy.in_roster(record.fingerprint) else "added",
        }
        if record.role == "station"
        else {**_record(record), "added": record.added}
        for record in records
    ]
    own = {"name": station.name, "fingerprint": station.fingerprint, "ca": protocol_keys.fingerprint(station.ca)}
    lines = [f"this station   {station.name}  {station.fingerprint[:16]}, CA {own['ca'][:16]}"]
    for record in records:
        mark = "  certified by this station's CA" if record.role == "station" and certified[record.fingerprint] else ""
        if record.role == "station" and station.policy.in_roster(record.fingerprint):
            mark = "  member of the plant"
        lines.append(f"{record.role:<14} {record.name}  {record.fingerprint[:16]}{mark}")
    app.emit({"trusted": keys, "own": own}, "\n".join(lines))


@trust.group(
    "ca",
    context_settings=COMMAND_SETTINGS,
    short_help="Show, use, export, drop and import the owner's CA key.",
    epilog=examples("teds-provision trust ca sign lab.request --output lab.cert"),
)
def ca() -> None:
    """Manage the owner's CA key, which signs station keys so that one owner's stations can write each other's nodes.

    The public key is not secret; the private key stays in the vault, or in the encrypted file that export writes.
    """


@ca.command(
    context_settings=COMMAND_SETTINGS, short_help="Show the CA key.", epilog=examples("teds-provision trust ca create")
)
@pass_app
def create(app: App) -> None:
    """Show the CA key that init created; a station certified by another CA has none."""
    station = app.station()
    require_ca(station)
    digits, pem = protocol_keys.fingerprint(station.ca), to_pem(station.ca)
    app.emit({"fingerprint": digits, "public_key": pem, "here": True}, f"CA key {digits[:16]}, in this vault\n\n{pem}")


@ca.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Certify the station that made REQUEST with init --request.",
    epilog=examples("teds-provision trust ca sign lab.request --output lab.cert --yes"),
)
@click.argument("request", type=FileToRead())
@click.option("--output", "-o", type=_FILE, required=True, metavar="CERT", help="Where to write the certificate.")
@yes_option
@dry_run_option
@pass_app
def sign(app: App, request: Path, output: Path, yes: bool, dry_run: bool) -> None:
    """Certify the station that made REQUEST (init --request); it can then key and write this owner's nodes."""
    station = app.station()
    wanted = read_request(read_limited(request, MAX_OCTETS, "request"))
    digits = protocol_keys.fingerprint(wanted.station)
    result = {
        "name": wanted.name,
        "fingerprint": digits,
        "ca": protocol_keys.fingerprint(station.ca),
        "certificate": str(output),
    }
    shown = f"Station {wanted.name}\n  {spoken(digits)}"
    if dry_run:
        app.emit({**result, "plan": True}, f"Plan: certify\n{shown}")
        return
    station.unlock()
    app.note(shown)
    app.confirm("Certify it? Whoever holds its key can then write and rekey all of this owner's nodes.", yes=yes)
    with station.lock("trust ca sign", app.note):
        octets = write_certificate(sign_request(station, wanted))
        fresh = not holds(output, octets)
        if fresh:
            write_new(output, octets)
    there = f"On that station: teds-provision init --certificate {output}"
    text = f"{wanted.name} ({digits[:16]}) is certified: {output}. {there}"
    app.emit({**result, "fresh": fresh}, text if fresh else f"Nothing to do: {output} already exists.")


@ca.command(
    context_settings=COMMAND_SETTINGS,
    short_help="Write the CA key to a new file, encrypted under a passphrase.",
    epilog=examples("teds-provision trust ca export owner-ca.pem"),
)
@click.argument("file", type=_FILE)
@pass_app
def export(app: App, file: Path) -> None:
    """Write the CA key to a new file, encrypted under a passphrase (PKCS #8).

    The vault keeps it until "trust ca drop".
    """
    station = app.station()
    station.use_agent = False  # a passer-by at an unlocked desk must not be able to export the CA key
    vault = station.vault
    passphrase = app.ask_secret("New passphrase for the CA key's file", confirm=True)
    with station.lock("trust ca export", app.note):
        fresh = export_ca(station, vault, file, passphrase)
    stored = f"The CA key is in {file}{'' if fresh else ' already'}."
    app.emit({"file": str(file), "fresh": fresh}, f"{stored} Store it offline, then: teds-provision trust ca drop")


@ca.command(context_settings=COMMAND_SETTINGS, epilog=examples("teds-provision trust ca drop --yes"))
@yes_option
@dry_run_option
@pass_app
def drop(app: App, yes: bool, dry_run: bool) -> None:
    """Permanently remove the CA key from the vault. Export it first: no station can be certified without it."""
    station = app.station()
    station.unlock()
    if dry_run:
        present = station.vault.ca() is not None
        text = "Plan: remove the CA key from this vault." if present else "Nothing to do."
        app.emit({"dropped": present, "plan": True}, text)
        return
    app.confirm("Delete the CA key from this vault? You can only restore it from its exported file.", yes=yes)
    with station.lock("trust ca drop", app.note):
        dropped = drop_ca(station)
    app.emit({"dropped": dropped}, "The CA key was removed from this vault." if dropped else "Nothing to do.")


@ca.command("import", context_settings=COMMAND_SETTINGS, epilog=examples("teds-provision trust ca import owner-ca.pem"))
@click.argument("file", type=FileToRead())
@dry_run_option
@pass_app
def import_(app: App, file: Path, *, dry_run: bool) -> None:
    """Import the CA key from a file written by "trust ca export"."""
    station = app.station()
    vault = station.vault
    passphrase = app.ask_secret("Passphrase of the CA key's file")
    digits = protocol_keys.fingerprint(station.ca)
    if dry_run:
        require_own_ca(station, file, passphrase)
        app.emit({"fingerprint": digits, "plan": True}, f"Plan: import the CA key {digits[:16]} into this vault.")
        return
    with station.lock("trust ca import", app.note):
        import_ca(station, vault, file, passphrase)
    app.emit({"fingerprint": digits}, f"The CA key {digits[:16]} is now in this vault.")
