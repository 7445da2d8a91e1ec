"""The vault for machines without a keyring: ``vault.json`` in the home directory, sealed under a passphrase."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from teds_provision.errors import BadData, NotFound, VaultFailure
from teds_provision.files import read_limited, write_new, write_whole
from teds_provision.vault.base import Ask
from teds_provision.vault.master import Material
from teds_provision.vault.passphrase import PRODUCT, Costs, SealingKey, check_new, unseal, unseal_with
from teds_provision.vault.software import SoftwareVault, settle

FILE_NAME = "vault.json"
_FORMAT = "teds-provision-vault/1"
_MAX_OCTETS = 64 * 1024
Stamp = tuple[int, int, int]


class FileVault(SoftwareVault):
    """The station's keys in one file of mode 0600: Argon2id and AES-256-GCM, bound to the store's id."""

    kind = "file"

    def __init__(self, path: Path, store_id: str, material: Material, key: SealingKey) -> None:
        super().__init__(material)
        self.description = f"passphrase file {path}"
        self._path = path
        self._store_id = store_id
        self._key = key
        self.stamp = stamp(path)

    @classmethod
    def create(
        cls, home: Path, store_id: str, ask: Ask, *, costs: Costs = PRODUCT, restored: str | None = None
    ) -> FileVault:
        """Make the vault, or open the one that is there (it is never overwritten).

        ``ask`` is called once: for a new passphrase (with confirmation) or for that of the existing file.
        ``restored`` is the secret material of a backup. Raises VaultFailure, WrongPassphrase.
        """
        path = home / FILE_NAME
        if path.exists():
            vault = cls.open(home, store_id, ask)
            if restored is not None:
                vault._replace(settle(vault._material, restored))
            return vault
        passphrase = ask("New passphrase for this station's keys", True)
        check_new(passphrase)
        material = settle(None, restored)
        key = SealingKey.derive(passphrase, costs=costs)
        write_new(path, _sealed(store_id, material, key), failure=VaultFailure)
        return cls(path, store_id, material, key)

    @classmethod
    def open(cls, home: Path, store_id: str, ask: Ask, *, held: bytes | None = None) -> FileVault:
        """Open the vault with what an agent held (:meth:`opener`), else with the passphrase that ``ask`` gives.

        Raises VaultFailure (missing, damaged, of another store), WrongPassphrase.
        """
        path = home / FILE_NAME
        content = read_sealed(path)
        if content.get("store") != store_id:
            raise VaultFailure(f"{path} belongs to another store.", hint="Restore the backup that holds both.")
        opened = None if held is None else unseal_with(held, content, context=_context(store_id))
        if opened is None:  # nothing is held, or the passphrase is another one by now
            passphrase = ask("Passphrase of this station's keys", False)
            opened = unseal(passphrase, content, context=_context(store_id))
        plaintext, key = opened
        return cls(path, store_id, Material.decode(plaintext.decode("ascii", "replace")), key)

    def opener(self) -> bytes:
        """What opens this file without its passphrase, as long as that stays: for an agent that the user started."""
        return self._key.salt + self._key.key

    def change_passphrase(self, ask: Ask, *, costs: Costs = PRODUCT) -> None:
        """Seal the same keys under a new passphrase. Copies and backups made before still open with the old one."""
        passphrase = ask("New passphrase for this station's keys", True)
        check_new(passphrase)
        key = SealingKey.derive(passphrase, costs=costs)
        write_whole(self._path, _sealed(self._store_id, self._material, key), failure=VaultFailure)
        self._key = key
        self.stamp = stamp(self._path)

    def replaced(self) -> bool:
        """Say whether another process has written the file since this one opened it."""
        return self.stamp != stamp(self._path)

    def _save(self, material: Material) -> None:
        write_whole(self._path, _sealed(self._store_id, material, self._key), failure=VaultFailure)
        self.stamp = stamp(self._path)


def stamp(path: Path) -> Stamp | None:
    """Return what changes when the file is replaced, None if it is not there."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


def _context(store_id: str) -> bytes:
    return f"{_FORMAT}\0{store_id}".encode()


def _sealed(store_id: str, material: Material, key: SealingKey) -> bytes:
    sealed = key.seal(material.encode().encode(), context=_context(store_id))
    return json.dumps({"format": _FORMAT, "store": store_id, **sealed}, indent=1).encode() + b"\n"


def read_sealed(path: Path) -> dict[str, Any]:
    """Read the file, still sealed; raises VaultFailure (missing, damaged)."""
    try:
        octets = read_limited(path, _MAX_OCTETS, "vault", failure=VaultFailure, follow=False)
    except NotFound:
        raise VaultFailure(
            f"The passphrase file {path} is missing.", hint="Restore a backup of this station (teds-provision restore)."
        ) from None
    except BadData:
        octets = b""
    try:
        content = json.loads(octets)
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            raise ValueError
    except (ValueError, RecursionError):
        raise VaultFailure(
            f"{path} is damaged or not a vault of this version.", hint="Restore a backup (teds-provision restore)."
        ) from None
    return content
