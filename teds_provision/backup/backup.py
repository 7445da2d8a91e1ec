"""``backup``: the whole store of this station, with what its vault keeps secret, sealed into one file."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from teds_provision.backup.content import BackupHead
from teds_provision.backup.sealed_file import MAX_OCTETS, SealedFile, Sealer, write
from teds_provision.errors import StoreError, StoreLockedError, TedsProvisionError, VaultError
from teds_provision.files import whole_draft
from teds_provision.protocol.keys import fingerprint
from teds_provision.sanitize import counted
from teds_provision.station.snapshot import totals
from teds_provision.station.station import Station
from teds_provision.station.store.records import utc_now
from teds_provision.vault.base import Ask, Vault
from teds_provision.vault.passphrase import PRODUCT, Costs


@dataclass(frozen=True)
class BackupResult:
    """Result of a backup: size and digest of the file, the numbers of rows in it, and warnings."""

    octets: int
    sha256: str
    nodes: int
    keys: int
    sealed_to: str
    warnings: tuple[str, ...]


def backup(
    station: Station,
    path: Path,
    ask: Ask,
    *,
    recovery: bytes | None = None,
    costs: Costs = PRODUCT,
    notice: Callable[[str], object] | None = None,
) -> BackupResult:
    """Write a sealed copy of the station to ``path`` (mode 0600, whole or not at all; an old file is replaced).

    ``recovery`` is the public point of a recovery key; without it ``ask`` returns a new passphrase. The store may be in
    use meanwhile. If the entry in the audit log has to wait for another process, ``notice`` receives a message with its
    name. The file gets its name only after it was read back as ``restore`` would read it, and after that entry: if
    another process blocks the entry, the command fails (StoreLockedError). If the disk is full and takes no entry, the
    backup is made, with a warning. Raises StoreError, VaultError and its leaves.
    """
    vault = station.vault
    sealer = Sealer(
        passphrase=ask("New passphrase for the backup", True) if recovery is None else None,
        recovery=recovery,
        costs=costs,
    )
    to = fingerprint(recovery) if recovery is not None else "passphrase"
    try:
        with whole_draft(path, replace=True) as (draft, file):
            key = _write(station, vault, file, sealer)
            file.flush()
            nodes, keys, useless = _read_back(station, draft, key)
            octets = file.tell()
            file.seek(0)
            digest = hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]
            warnings = _warnings(station, recovery, useless)
            warnings += _note(station, notice, sha256=digest, to=to, nodes=nodes, keys=keys)
    except OSError as error:
        raise VaultError(
            f"{path} cannot be written: {error.strerror}.", hint="Fix that and run the same command again."
        ) from error
    return BackupResult(octets, digest, nodes, keys, to, tuple(warnings))


def _write(station: Station, vault: Vault, file: BinaryIO, sealer: Sealer) -> bytes:
    """Write the vault's secrets and the rows of one moment: keys are useless without the master key that wraps them.

    Starts over if another command changes the vault in between, which is rare. Returns the content key.
    """
    while True:
        vault.refresh()
        # Never a path in the head: nothing may be loaded because a backup names it.
        kind = station.identity.keystore
        kind = "pkcs11" if kind.startswith("pkcs11:") else kind
        head = BackupHead(station.id, station.point, station.name, utc_now(), kind, vault.secret_material())
        key = write(file, head, station.rows(), vault.identity(), sealer)
        if not vault.refresh():
            return key
        file.seek(0)
        file.truncate()


def _read_back(station: Station, draft: Path, key: bytes) -> tuple[int, int, int]:
    """Open what was written as restore would; count nodes, keys, and keys that are lost already."""
    try:
        sealed = SealedFile(draft)
        with sealed.open_with_content_key(key) as content:
            found = totals(content.copy)
            return found["nodes"], found["keys"], sum(1 for _ in content.unopened(station.vault))
    except TedsProvisionError as error:
        raise StoreError(
            f"The backup was written but cannot be opened: {error.message}",
            hint=f"It was deleted. Check the disk (at most {MAX_OCTETS >> 30} GiB are read), then run it again.",
        ) from error


def _note(station: Station, notice: Callable[[str], object] | None, **detail: object) -> list[str]:
    """Make the entry in the audit log."""
    try:
        with station.lock("backup", notice):
            station.audit("backup", None, "done", **detail)
    except StoreLockedError:
        raise
    except StoreError as failure:  # a full or read-only disk is a reason to make a backup, so it must not prevent one
        return [f"The audit log has no entry of this backup: {failure.message}"]
    return []


def _warnings(station: Station, recovery: bytes | None, useless: int) -> list[str]:
    warnings = []
    if station.identity.keystore.startswith("pkcs11:"):
        warnings.append(
            "The station key (and a CA key in the token) cannot leave the token and is not in this backup: "
            "it opens with the same token only."
        )
    if recovery is not None and recovery in (station.point, station.ca):
        warnings.append("It is sealed to a key of this station: if the station is lost, it cannot be opened.")
    if useless:
        warnings.append(
            f"{counted(useless, 'key')} in the store cannot be opened under this vault; run teds-provision doctor."
        )
    return warnings
