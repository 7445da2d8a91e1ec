"""The vault for machines without a keyring: ``vault.json`` in the home directory, sealed under a passphrase."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from teds_provision.errors import BadDataError, NotFoundError, VaultChangedError, VaultError, WrongPassphraseError
from teds_provision.files import read_limited, write_new, write_whole
from teds_provision.vault.base import Ask
from teds_provision.vault.master import Material
from teds_provision.vault.passphrase import PRODUCT, Costs, SealingKey, check_new, unseal, unseal_with
from teds_provision.vault.software import SoftwareVault, merge_keys

FILE_NAME = "vault.json"
_FORMAT = "teds-provision-vault/1"
_MAX_OCTETS = 64 * 1024


class FileVault(SoftwareVault):
    """The station's keys in one file of mode 0600: Argon2id and AES-256-GCM, bound to the store's id."""

    kind = "file"

    def __init__(self, path: Path, store_id: str, material: Material, key: SealingKey, content: dict[str, Any]) -> None:
        super().__init__(material)
        self.description = f"passphrase file {path}"
        self._path = path
        self._store_id = store_id
        self._key = key
        self._content = content
        """The file as this process last read or wrote it, still sealed; detects a change by another process."""

    @classmethod
    def create(
        cls, home: Path, store_id: str, ask: Ask, *, costs: Costs = PRODUCT, restored: str | None = None
    ) -> FileVault:
        """Make the vault, or open the one that is there (it is never overwritten).

        ``ask`` is called once: for a new passphrase (with confirmation) or for that of the existing file.
        ``restored`` is the secret material of a backup. Raises VaultError, WrongPassphraseError.
        """
        path = home / FILE_NAME
        if path.exists():
            vault = cls.open(home, store_id, ask)
            if restored is not None:
                vault.join(restored)
            return vault
        passphrase = ask("New passphrase for this station's keys", True)
        check_new(passphrase)
        material = merge_keys(None, restored)
        key = SealingKey.derive(passphrase, costs=costs)
        content = _sealed(store_id, material, key)
        write_new(path, _octets_of(content), failure=VaultError)
        return cls(path, store_id, material, key, content)

    @classmethod
    def open(cls, home: Path, store_id: str, ask: Ask, *, held: bytes | None = None) -> FileVault:
        """Open the vault with what an agent held (:meth:`opener`), else with the passphrase that ``ask`` gives.

        Raises VaultError (missing, damaged, of another store), WrongPassphraseError.
        """
        path = home / FILE_NAME
        content = read_sealed(path)
        _require_store(content, store_id, path)
        opened = None if held is None else unseal_with(held, content, context=_context(store_id))
        if opened is None:  # no secret is held, or the passphrase has changed
            passphrase, asked = ask("Passphrase of this station's keys", False), content
            content = read_sealed(path)  # read again: the user may have taken an hour to answer
            try:
                opened = unseal(passphrase, content, context=_context(store_id))
            except WrongPassphraseError:
                if content == asked:
                    raise
                raise _another_passphrase() from None
        plaintext, key = opened
        return cls(path, store_id, _material(plaintext), key, content)

    def opener(self) -> bytes:
        """Return the secret that opens this file while its passphrase stays: for an agent that the user started."""
        return self._key.salt + self._key.key

    def new_passphrase(self, ask: Ask, *, costs: Costs = PRODUCT) -> Callable[[], None]:
        """Ask for a new passphrase; what is returned seals the same keys under it, the store being held.

        Copies and backups made before still open with the old one.
        """
        passphrase = ask("New passphrase for this station's keys", True)
        check_new(passphrase)
        key = SealingKey.derive(passphrase, costs=costs)

        def seal_anew() -> None:
            self.refresh()
            before, self._key = self._key, key
            try:
                self._save(self._material)
            except BaseException:
                self._key = before
                raise

        return seal_anew

    def _load(self) -> Material:
        content = read_sealed(self._path)
        if content == self._content:
            return self._material
        _require_store(content, self._store_id, self._path)
        opened = unseal_with(self.opener(), content, context=_context(self._store_id))
        if opened is None:
            raise _another_passphrase()
        self._content = content
        return _material(opened[0])

    def _save(self, material: Material) -> None:
        content = _sealed(self._store_id, material, self._key)
        write_whole(self._path, _octets_of(content), failure=VaultError)
        self._content = content


def _another_passphrase() -> VaultChangedError:
    return VaultChangedError(
        "Another command has changed the passphrase in the meantime; this one changed nothing.",
        hint="Run it again with the new passphrase.",
    )


def _material(plaintext: bytes) -> Material:
    return Material.decode(plaintext.decode("ascii", "replace"))


def _require_store(content: dict[str, Any], store_id: str, path: Path) -> None:
    if content.get("store") != store_id:
        raise VaultError(f"{path} belongs to another store.", hint="Restore a backup that contains both.")


def _context(store_id: str) -> bytes:
    return f"{_FORMAT}\0{store_id}".encode()


def _sealed(store_id: str, material: Material, key: SealingKey) -> dict[str, Any]:
    sealed = key.seal(material.encode().encode(), context=_context(store_id))
    return {"format": _FORMAT, "store": store_id, **sealed}


def _octets_of(content: dict[str, Any]) -> bytes:
    return json.dumps(content, indent=1).encode() + b"\n"


def read_sealed(path: Path) -> dict[str, Any]:
    """Read the file, still sealed; raises VaultError (missing, damaged)."""
    try:
        octets = read_limited(path, _MAX_OCTETS, "vault", failure=VaultError, follow=False)
    except NotFoundError:
        raise VaultError(
            f"The passphrase file {path} is missing.", hint="Restore a backup of this station (teds-provision restore)."
        ) from None
    except BadDataError:
        octets = b""
    try:
        content = json.loads(octets)
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            raise ValueError
    except (ValueError, RecursionError):
        raise VaultError(
            f"{path} is damaged or not a vault of this version.", hint="Restore a backup (teds-provision restore)."
        ) from None
    return content
