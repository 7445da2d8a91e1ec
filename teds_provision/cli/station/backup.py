"""``backup`` and ``restore``: the whole store of this station, sealed into one file and back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click

from teds_provision.backup.backup import backup as back_up
from teds_provision.backup.content import Content
from teds_provision.backup.restore import (
    RestoreResult,
    complete_vault,
    keystore_for,
    merge,
    merge_checked,
    open_present,
    open_vault_of,
    rebuild,
)
from teds_provision.backup.sealed_file import SealedFile
from teds_provision.cli.context import App, pass_app, read_line
from teds_provision.cli.named_files import read_file
from teds_provision.cli.options import FileToRead, command, dry_run_option, yes_option
from teds_provision.errors import NotFoundError, UsageError, VaultChangedError, VaultError, WrongPassphraseError
from teds_provision.handover.trust import spoken
from teds_provision.protocol.keys import SoftwareKey, fingerprint, from_pem
from teds_provision.station.station import Station
from teds_provision.station.store.lock import StoreLock
from teds_provision.vault.ca_file import read_ca
from teds_provision.vault.selection import asked_first

_KEY_HINT = (
    "A recovery key is an encrypted PEM file: openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256 "
    "-aes256 -out recovery.pem"
)
_fd_option = click.option(
    "--backup-passphrase-fd",
    type=int,
    metavar="N",
    help="Read the passphrase of the backup (or recovery key) from this file descriptor (default: --passphrase-fd).",
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
    """Back up the whole store and the vault's secrets to one sealed file (mode 0600).

    Contains whitelist, nodes, keys, trust, handovers and the audit log as of one moment, even while the station is
    running. Does not contain config.toml, nor the keys inside a PKCS #11 token.
    """
    station = app.station()
    point = from_pem(read_file(recovery)) if recovery is not None else None
    to = f"recovery key {fingerprint(point)[:32]}" if point is not None else "a passphrase"
    if dry_run:
        plan = {"backup": str(file), "to": to, "replaces": file.exists(), "dry_run": True}
        app.emit(plan, f"Plan: seal the store of {station.name} to {to}, into {file}.")
        return
    _require_place(app.home, file)
    if file.exists():
        app.confirm(f"{file} exists. Replace it?", yes=yes)
    done = back_up(station, file, _asker(app, backup_passphrase_fd), recovery=point, notice=app.note)
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
    help="The recovery key it was sealed to, an encrypted PEM file.",
)
@click.option("--keystore", metavar="keyring|file|pkcs11:URI", help="Where to keep the keys (default: as before).")
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
    """Restore a backup: the whole station into an empty home, otherwise only what this station lacks.

    Nothing goes back: epochs and sequences keep the greater value, newer keys, tombstones and revocations stay, and
    the audit log only grows. Another station's backup is refused (exit 6). Exits 7 for a wrong passphrase, 4 for a
    modified file, 8 for one that is truncated or not a backup.
    """
    content = _open(file, recovery_key, _asker(app, backup_passphrase_fd))
    app.closing(content.close)
    present = open_present(app.home, content)
    if present is not None:
        app.closing(present.close)
        _merge(app, present, content, keystore, yes=yes, dry_run=dry_run)
        return
    wanted = keystore_for(content, keystore)
    app.note(_summary(content, wanted))
    if dry_run:
        plan = {"action": "rebuild", "station": content.station, "created": content.created, "dry_run": True}
        app.emit(plan | {"age_days": content.age_days()}, f"Plan: rebuild this station in {app.home}.")
        return
    if recovery_key is not None:  # a bundle needs only the public key, so its fingerprint identifies the owner
        app.confirm(f"Is this your station, and should its keys be kept in {_named(wanted)}?", yes=yes)
    done = rebuild(app.home, content, app.ask_secret, keystore=keystore)
    if done.set_aside is not None:
        app.warn(f"The damaged store was kept as {done.set_aside}.")
    if done.rotations_due:
        app.warn(
            f"Nodes that need a new key first: {done.rotations_due}; the keys in a backup may have been handed over"
            " since. Tap each node, or: teds-provision agree UUID --rotate"
        )
    _emit(app, content, done, f"The station is restored in {app.home}, with its keys in the keystore {done.keystore}.")


def _summary(content: Content, keystore: str | None) -> str:
    """Return whose backup it is, how old, and where the keys will be: what an operator has to compare."""
    days = content.age_days()
    age = f"{days} day{'' if days == 1 else 's'} ago" if days >= 0 else "in the future: check the clocks"
    return (
        f"Backup of station {content.name}, made {content.created} ({age})\n"
        f"  key      {spoken(content.station)}\n"
        f"  keystore {_named(keystore)}"
    )


def _named(keystore: str | None) -> str:
    return keystore or "the OS keyring, or a passphrase file if there is none"


def _require_place(home: Path, file: Path) -> None:
    """Refuse a folder that is not there, and the station's own files, before asking for a passphrase."""
    folder = file.absolute().parent
    if not folder.is_dir():
        raise NotFoundError(f"There is no folder {folder}.")
    own = file.name.startswith(("store.", "vault", "config.toml")) and folder.resolve() == home.resolve()
    if own:
        raise UsageError(
            f"{file} is one of the station's own files.", hint="Choose another name or place for the backup."
        )


def _merge(app: App, station: Station, content: Content, keystore: str | None, *, yes: bool, dry_run: bool) -> None:
    plan = merge(station, content, dry_run=True)
    how = plan.relation.value if plan.relation is not None else ""
    facts = station.identity.record()
    head = f"{_summary(content, facts.keystore if facts is not None else keystore)}\nIt is {how} of this station."
    back = [f"  restored: {what}: {count}" for what, count in plan.back.items()]
    app.note("\n".join([head, *back + [f"  unchanged: {kept}" for kept in plan.kept]]))
    if dry_run:
        _emit(app, content, plan, f"Plan: {'restore the items listed' if plan.back else 'nothing to do'}.", dry=True)
        return
    if plan.back:
        app.confirm("Restore this?", yes=yes)

    def work(known: Callable[[str, bool], str]) -> RestoreResult:
        with StoreLock(app.home, command="restore", notice=app.note):
            if not yes and merge(station, content, dry_run=True).back not in (plan.back, {}):
                raise VaultChangedError(
                    "Another command changed the station while you were being asked, so the list is out of date. "
                    "Nothing was changed.",
                    hint="Run it again and check the new list.",
                )
            vault = complete_vault(station, content, known, keystore=keystore)
            return merge_checked(station, content, vault, known)

    open_vault_of(station, app.ask_secret)
    done = asked_first(app.ask_secret, work)
    _emit(app, content, done, "Restored." if done.back else "Nothing to do: the store already has everything in it.")


def _emit(app: App, content: Content, done: RestoreResult, text: str, *, dry: bool = False) -> None:
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
    sealed = SealedFile(file)
    if not sealed.is_for_key:
        return sealed.open_with_passphrase(ask("Passphrase of the backup", False))
    if recovery_key is None:
        raise UsageError("This backup is sealed to a recovery key.", hint="Pass it with --recovery-key PEM.")
    passphrase = ask(f"Passphrase of {recovery_key}", False)
    try:
        key = SoftwareKey.from_secret(read_ca(recovery_key, passphrase))
    except WrongPassphraseError:
        raise
    except VaultError as failure:
        raise VaultError(failure.message, hint=_KEY_HINT) from failure
    return sealed.open_with_key(key)


def _asker(app: App, descriptor: int | None) -> Callable[[str, bool], str]:
    """Return the source of the backup's passphrase: its file descriptor, else that of the station's."""
    if descriptor is None:
        return app.ask_secret
    return lambda prompt, confirm: read_line(descriptor)
