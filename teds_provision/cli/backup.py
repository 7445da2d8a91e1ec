"""``backup`` and ``restore``: the whole store of this station, sealed into one file and back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from teds_provision import backup as backup_room
from teds_provision import handover, protocol
from teds_provision import store as store_room
from teds_provision import vault as vault_room
from teds_provision.cli.build import read_file
from teds_provision.cli.context import App, pass_app, read_line
from teds_provision.cli.options import FileToRead, command, dry_run_option, yes_option
from teds_provision.errors import NotFound, UsageFailure, VaultChanged, VaultFailure, WrongPassphrase

if TYPE_CHECKING:
    from teds_provision.backup.content import Content
    from teds_provision.backup.restore import Restored
    from teds_provision.store import Store

_KEY_HINT = (
    "A recovery key is an encrypted PEM: openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256 "
    "-aes256 -out recovery.pem"
)
_fd_option = click.option(
    "--backup-passphrase-fd",
    type=int,
    metavar="N",
    help="Read the passphrase of the backup (or recovery key) from this file descriptor; --passphrase-fd serves both "
    "where this is not given.",
)


@command("teds-provision backup station.backup", "teds-provision backup station.backup --to recovery-public.pem")
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--to",
    "recovery",
    type=FileToRead(),
    metavar="PEM",
    help="Seal to this public recovery key (P-256) instead of a passphrase.",
)
@_fd_option
@yes_option
@dry_run_option
@pass_app
def backup(
    app: App, file: Path, recovery: Path | None, backup_passphrase_fd: int | None, yes: bool, dry_run: bool
) -> None:
    """Write the whole store, and what the vault keeps secret, to one sealed file (mode 0600).

    Whitelist, nodes, keys, trust, handovers and the audit log, at one moment, also while the station is at work.
    With a PKCS #11 keystore the keys in the token are not in it. config.toml is not in it.
    """
    station = app.station()
    point = protocol.keys.from_pem(read_file(recovery)) if recovery is not None else None
    to = f"recovery key {protocol.keys.fingerprint(point)[:32]}" if point is not None else "a passphrase"
    if dry_run:
        plan = {"backup": str(file), "to": to, "replaces": file.exists(), "dry_run": True}
        app.emit(plan, f"Plan: seal the store of {station.name} to {to}, into {file}.")
        return
    _require_place(app.home, file)
    if file.exists():
        app.confirm(f"{file} exists. Replace it?", yes=yes)
    done = backup_room.backup.backup(station, file, _asker(app, backup_passphrase_fd), recovery=point, notice=app.note)
    for warning in done.warnings:
        app.warn(warning)
    result = {
        "backup": str(file),
        "station": station.fingerprint,
        "octets": done.octets,
        "sha256": done.sha256,
        "nodes": done.nodes,
        "keys": done.keys,
        "to": done.sealed_to,
        "warnings": list(done.warnings),
    }
    app.emit(result, f"Sealed nodes: {done.nodes}, keys: {done.keys}, to {to}: {file} ({done.octets} octets).")


@command(
    "teds-provision restore station.backup",
    "teds-provision --home new restore station.backup --recovery-key recovery.pem",
)
@click.argument("file", type=FileToRead())
@click.option(
    "--recovery-key",
    type=FileToRead(),
    metavar="PEM",
    help="The recovery key it was sealed to, as an encrypted PEM.",
)
@click.option("--keystore", metavar="keyring|file|pkcs11:URI", help="Where the keys shall lie (default: as before).")
@_fd_option
@yes_option
@dry_run_option
@pass_app
def restore(
    app: App,
    file: Path,
    recovery_key: Path | None,
    keystore: str | None,
    backup_passphrase_fd: int | None,
    yes: bool,
    dry_run: bool,
) -> None:
    """Bring a sealed store back: into an empty home the whole station, else what the station here lacks.

    Nothing goes back: epochs and sequences keep the greater value, newer keys stay, tombstones and revocations stay,
    the audit log only grows. A backup of another station is refused (exit 6). A wrong passphrase is exit 7, a file
    that was changed 4, one that is cut off or something else 8.
    """
    content = _open(file, recovery_key, _asker(app, backup_passphrase_fd))
    app.closing(content.close)
    present = backup_room.restore.open_present(app.home, content)
    if present is not None:
        app.closing(present.close)
        _merge(app, present, content, keystore, yes=yes, dry_run=dry_run)
        return
    wanted = backup_room.restore.keystore_for(content, keystore)
    app.note(_told(content, wanted))
    if dry_run:
        plan = {"action": "rebuild", "station": content.station, "created": content.created, "dry_run": True}
        app.emit(plan | {"age_days": content.age_days()}, f"Plan: make this station in {app.home}.")
        return
    if recovery_key is not None:  # whoever has the public key can seal: only the fingerprint tells whose this is
        app.confirm(f"Is that your station, and shall its keys lie in {_named(wanted)}?", yes=yes)
    done = backup_room.restore.rebuild(app.home, content, app.ask_secret, keystore=keystore)
    if done.set_aside is not None:
        app.warn(f"The damaged store is kept as {done.set_aside}.")
    if done.rotations_due:
        app.warn(
            f"Nodes that need a new key before anything else: {done.rotations_due}; the keys in a backup may have been"
            " given away since. Tap each, or: teds-provision agree UUID --rotate"
        )
    _emit(app, content, done, f"The station is back in {app.home}, its keys in the keystore {done.keystore}.")


def _told(content: Content, keystore: str | None) -> str:
    """Whose backup it is, how old, and where the keys shall lie: what a person has to compare."""
    days = content.age_days()
    age = f"{days} day{'' if days == 1 else 's'} ago" if days >= 0 else "in the future: compare the clocks"
    return (
        f"Backup of station {content.name}, made {content.created} ({age})\n"
        f"  key      {handover.trust.spoken(content.station)}\n"
        f"  keystore {_named(keystore)}"
    )


def _named(keystore: str | None) -> str:
    return keystore or "the keyring, or a passphrase file where none works"


def _require_place(home: Path, file: Path) -> None:
    """Refuse a folder that is not there, and the station's own files, before anyone is asked for a passphrase."""
    folder = file.absolute().parent
    if not folder.is_dir():
        raise NotFound(f"There is no folder {folder}.")
    own = file.name.startswith(("store.", "vault", "config.toml")) and folder.resolve() == home.resolve()
    if own:
        raise UsageFailure(f"{file} is a file of the station itself.", hint="Give the backup another name or place.")


def _merge(app: App, store: Store, content: Content, keystore: str | None, *, yes: bool, dry_run: bool) -> None:
    plan = backup_room.restore.merge(store, content, dry_run=True)
    how = plan.relation.value if plan.relation is not None else ""
    facts = store.facts()
    head = f"{_told(content, facts.keystore if facts is not None else keystore)}\nIt is {how} of this station."
    app.note("\n".join([head, *_lines(plan)]))
    if dry_run:
        _emit(app, content, plan, f"Plan: {'bring back what is listed' if plan.back else 'nothing to do'}.", dry=True)
        return
    if plan.back:
        app.confirm("Bring this back?", yes=yes)

    def work(known: Callable[[str, bool], str]) -> Restored:
        with store_room.StoreLock(app.home, command="restore", notice=app.note):
            if not yes and backup_room.restore.merge(store, content, dry_run=True).back not in (plan.back, {}):
                raise VaultChanged(
                    "Another command changed the station while the question stood: something else would come back now. "
                    "Nothing was changed.",
                    hint="Run it again, and look at the new list.",
                )
            vault = backup_room.restore.complete_vault(store, content, known, keystore=keystore)
            return backup_room.restore.merge_checked(store, content, vault, known)

    backup_room.restore.open_vault_of(store, app.ask_secret)
    done = vault_room.asked_first(app.ask_secret, work)
    _emit(app, content, done, "Brought back." if done.back else "The store lacks nothing of it (nothing to do).")


def _lines(done: Restored) -> list[str]:
    back = [f"  comes back: {what}: {count}" for what, count in done.back.items()]
    return back + [f"  stays as it is: {kept}" for kept in done.kept]


def _emit(app: App, content: Content, done: Restored, text: str, *, dry: bool = False) -> None:
    result = {
        "action": done.action,
        "station": content.station,
        "name": content.name,
        "created": content.created,
        "age_days": content.age_days(),
        "relation": done.relation.name.lower() if done.relation is not None else None,
        "back": done.back,
        "kept": list(done.kept),
        "keystore": done.keystore,
        "rotations_due": done.rotations_due,
        "dry_run": dry,
    }
    app.emit(result, lambda console: console.print(text, markup=False))


def _open(file: Path, recovery_key: Path | None, ask: Callable[[str, bool], str]) -> Content:
    sealed = backup_room.sealed_file.SealedFile(file)
    if not sealed.is_for_key:
        return sealed.open_with_passphrase(ask("Passphrase of the backup", False))
    if recovery_key is None:
        raise UsageFailure("This backup is sealed to a recovery key.", hint="Give it with --recovery-key PEM.")
    passphrase = ask(f"Passphrase of {recovery_key}", False)
    try:
        key = protocol.keys.SoftwareKey.from_secret(vault_room.ca_file.read_ca(recovery_key, passphrase))
    except WrongPassphrase:
        raise
    except VaultFailure as failure:
        raise VaultFailure(failure.message, hint=_KEY_HINT) from failure
    return sealed.open_with_key(key)


def _asker(app: App, descriptor: int | None) -> Callable[[str, bool], str]:
    """Who gives the backup's passphrase: its own file descriptor, else whoever gives the station's."""
    if descriptor is None:
        return app.ask_secret
    return lambda prompt, confirm: read_line(descriptor)
