"""The doctor's checks of the station: home, store, audit log, vault, keyring, and the workspace's ``keys/``."""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from teds_provision.doctor.checks import Finding, System, check, intact
from teds_provision.errors import KeyringUnavailableError, NotFoundError, StoreError, VaultError
from teds_provision.files import open_to_read
from teds_provision.sanitize import counted
from teds_provision.station.snapshot import totals
from teds_provision.station.station import Station
from teds_provision.station.store.audit import AuditFilter, AuditLog
from teds_provision.station.store.lock import holder_of
from teds_provision.station.store.row_sample import SAMPLED, RowSample
from teds_provision.station.store.sqlite import has_store
from teds_provision.vault import agent
from teds_provision.vault.file_vault import read_sealed
from teds_provision.vault.keyring_vault import KeyringVault, inspect
from teds_provision.vault.pkcs11_token import find_token
from teds_provision.vault.pkcs11_uri import Pkcs11Uri

_MIN_FREE: Final = 64 * 1024 * 1024
_BACKUP_DAYS: Final = 90
_MAX_KEY_FILE: Final = 64 * 1024
_NO_STATION: Final = "There is no station yet."
_INIT: Final = "teds-provision init"


@check("home", "store")
def home(system: System) -> Iterator[Finding]:
    """Check that home and each file in it belong to this user alone, before anything opens (and repairs) it."""
    if not system.home.is_dir():
        yield Finding("home", "skipped", f"There is no station in {system.home} yet.", _INIT)
        return
    status = system.home.stat()
    if status.st_uid != os.geteuid():
        why = f"{system.home} belongs to another user."
        yield Finding("home", "warning", why, f"sudo chown -R $USER {system.home}, or use another --home")
    elif status.st_mode & 0o022:
        yield Finding("home", "failed", f"Other users can write to {system.home}.", f"chmod 700 {system.home}")
    elif status.st_mode & 0o055:
        yield Finding("home", "warning", f"Other users can read {system.home}.", f"chmod 700 {system.home}")
    else:
        yield Finding("home", "ok", f"{system.home} is private to this user.")
    open_files = [path for path in sorted(system.home.iterdir()) if _open_to_others(path)]
    if open_files:
        names = " ".join(str(path) for path in open_files)
        why = f"Other users can read {', '.join(path.name for path in open_files)}."
        yield Finding("files", "failed", why, f"chmod 600 {names}")


def _open_to_others(path: Path) -> bool:
    private = path.name.startswith(("store.", "vault")) and path.is_file()
    return private and bool(stat.S_IMODE(path.stat().st_mode) & 0o077)


@check("disk", "store")
def disk(system: System) -> Iterator[Finding]:
    """Check that there is room to write."""
    where = next(path for path in (system.home, *system.home.absolute().parents) if path.is_dir())
    free = shutil.disk_usage(where).free
    enough = free >= _MIN_FREE
    fix = "" if enough else "Free some space: a full disk stops every command that changes something."
    yield Finding("disk", "ok" if enough else "warning", f"{free >> 20} MiB free at {where}.", fix)


@check("store", "store")
def store(system: System) -> Iterator[Finding]:
    """Check that the store is intact, that its audit log verifies, whether it is in use, and that there is a backup."""
    if not has_store(system.home):
        yield Finding("store", "skipped", _NO_STATION, _INIT)
        return
    sample = RowSample(full=system.full)
    with Station.inspect(system.home) as opened:
        damage = opened.damage(None if system.full else sample)
        if damage is not None:
            yield Finding("store", "failed", f"The store is damaged: {damage}.", "teds-provision restore FILE")
            return
        if not opened.identity.is_complete():
            yield Finding("store", "warning", "init was started here but not finished.", _INIT)
            return
        count = totals(opened)
        what = f"{counted(count['nodes'], 'node')}, {count['whitelist']} whitelisted"
        part = f"Intact, of each large table {SAMPLED:,} random rows and the newest; {what}"
        yield intact("store", f"Intact; {what}", part, sample)
        yield from _audit(opened.audit_log, RowSample(full=system.full))
        yield from _backups(opened.audit_log, count["nodes"])
    holder = holder_of(system.home)
    if holder is None:
        yield Finding("lock", "ok", "The store is not locked.")
    else:
        yield Finding("lock", "warning", f"The store is locked by {holder}.", "Wait until it has ended.")


def _audit(log: AuditLog, sample: RowSample) -> Iterator[Finding]:
    verdict = log.check() if sample.full else log.spot_check(sample)
    entries = counted(verdict.count, "entry", "entries")
    if verdict.intact:
        part = f"{entries}; the newest {SAMPLED:,} and {SAMPLED:,} random ones are intact"
        yield intact("audit log", f"{entries}, chain intact", part, sample)
    else:
        fix = "Keep a copy, run teds-provision log, and find out who changed the file."
        yield Finding("audit log", "failed", f"The hash chain is broken: {verdict.why}.", fix)


def _backups(log: AuditLog, nodes: int) -> Iterator[Finding]:
    backups = AuditFilter(act="backup")
    taken = [entry.at for entry in log.chosen(backups, log.entry_before(backups, last=1))]
    fix = "teds-provision backup FILE"
    if not taken:
        why = "There is no backup: without one, losing this machine means re-keying every node at the bench."
        yield Finding(
            "backup", "warning" if nodes else "ok", why if nodes else "Nothing to back up yet.", fix * bool(nodes)
        )
        return
    days = (datetime.now(UTC) - datetime.strptime(taken[-1], "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=UTC)).days
    if days < -1:  # the clock was ahead then, or is behind now: such a backup would never get old
        yield Finding(
            "backup",
            "warning",
            f"The last backup is dated {taken[-1]}, in the future.",
            f"Check the clock, then: {fix}",
        )
        return
    old = days > _BACKUP_DAYS
    yield Finding(
        "backup",
        "warning" if old else "ok",
        f"The last backup is {counted(max(days, 0), 'day')} old.",
        fix if old else "",
    )


@check("keyring", "store")
def keyring(system: System) -> Iterator[Finding]:
    """Check which keyring would hold the keys, whether it is permitted, and answers; a failure only if it is used."""
    used = _keystore(system)
    if used not in (None, "keyring"):  # looking for a keyring takes longer than all other checks
        yield Finding("keyring", "skipped", "Not used by this station.")
        return
    try:
        with _quiet_logging():
            name = inspect()
    except VaultError as failure:
        if used == "keyring":
            yield Finding("keyring", "failed", failure.message, failure.hint)
        else:
            none = isinstance(failure, KeyringUnavailableError)
            fix = "teds-provision init --keystore file" if none else failure.hint
            yield Finding("keyring", "warning", f"{failure.message} init will use a passphrase file.", fix)
        return
    yield Finding("keyring", "ok", f"{name}.")


@contextmanager
def _quiet_logging() -> Iterator[None]:
    """Silence the backends, which log what they could not load: the finding reports it."""
    import logging

    logger = logging.getLogger("keyring")
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


@check("vault", "store")
def vault(system: System) -> Iterator[Finding]:
    """Check that the store of the station's keys is there, without a prompt for passphrase or PIN."""
    used = _keystore(system)
    if used is None:
        yield Finding("vault", "skipped", _NO_STATION, _INIT)
    elif used == "file":
        yield _file_vault(system)
    elif used == "keyring":
        with Station.inspect(system.home) as opened:
            yield Finding("vault", "ok", f"{KeyringVault.open(opened.id).description}.")
    else:
        token = find_token(Pkcs11Uri.parse(used))
        if not (system.home / "vault-pkcs11.json").exists():
            raise VaultError("The file vault-pkcs11.json is missing.", hint="teds-provision restore FILE")
        yield Finding("vault", "ok", f"The token {token.label.strip()!r} is there.")


@check("unlock", "store")
def unlocked(system: System) -> Iterator[Finding]:
    """Report a process that holds the vault open."""
    left = agent.seconds_left(system.home)
    if left is None:
        yield Finding("unlock", "ok", "The vault is locked.")
    else:
        why = f"The vault stays unlocked for {left // 60} min {left % 60} s more, for every process of this user."
        yield Finding("unlock", "warning", why, "teds-provision lock")


def _file_vault(system: System) -> Finding:
    with Station.inspect(system.home) as opened:
        content = read_sealed(system.home / "vault.json")
        if content.get("store") != opened.id:
            raise VaultError("vault.json belongs to another store.", hint="teds-provision restore FILE")
    memory = content.get("memory_kib")
    if not isinstance(memory, int) or memory < 19 * 1024:  # OWASP's minimum for Argon2id
        return Finding("vault", "warning", "The passphrase file has weak demo settings.", "Create a new station.")
    return Finding("vault", "ok", f"The passphrase file exists (Argon2id, {memory >> 10} MiB).")


def _keystore(system: System) -> str | None:
    if not has_store(system.home):
        return None
    try:
        with Station.inspect(system.home) as opened:
            facts = opened.identity.record()
            return facts.keystore if facts is not None else None
    except StoreError:  # the check of the store reports this
        return None


@check("keys folder", "machine")
def keys_folder(system: System) -> Iterator[Finding]:
    """Check that the workspace's ``keys/`` holds public keys only."""
    folder = system.workspace / "keys"
    if not folder.is_dir():
        yield Finding("keys folder", "skipped", "There is no keys/ folder here.")
        return
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    private = [str(path.relative_to(system.workspace)) for path in files if holds_private_key(path)]
    if private:
        fix = f"git rm --cached {' '.join(private)}; remove it, and create a new key: this one is no longer secret"
        yield Finding("keys folder", "failed", f"Private keys: {', '.join(private)}.", fix)
    else:
        yield Finding("keys folder", "ok", f"{counted(len(files), 'file')}, no private key.")


def holds_private_key(path: Path) -> bool:
    """Return True if a file holds a private key in PEM, a private JWK, or a private key of SSH or PKCS #8 in DER."""
    try:
        with open_to_read(path) as file:
            octets = file.read(_MAX_KEY_FILE)
    except (OSError, NotFoundError):
        return False
    if b"PRIVATE KEY" in octets or b"PuTTY-User-Key-File" in octets:
        return True
    if b'"kty"' in octets and (b'"d"' in octets or b'"k"' in octets):
        return True
    # SEC 1 ECPrivateKey, or PKCS #8 PrivateKeyInfo with id-ecPublicKey or rsaEncryption, in DER
    inside = octets[:48]
    return octets[:1] == b"\x30" and (b"\x02\x01\x01\x04\x20" in inside or b"\x02\x01\x00\x30" in inside)
