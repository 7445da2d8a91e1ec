"""The shared part of keyring vault and passphrase file: the keys are in memory once unlocked."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

from teds_provision.errors import VaultError
from teds_provision.protocol.keys import PrivateKey, SoftwareKey, fingerprint
from teds_provision.vault import ca_file
from teds_provision.vault.master import MasterKeys, Material, another_life


class SoftwareVault(ABC):
    """A vault whose secrets are one :class:`Material`, read once and kept for the life of the process.

    Python cannot wipe memory reliably: while the process lives, the keys are in it.
    """

    kind: str
    description: str

    def __init__(self, material: Material) -> None:
        self._material = material
        self._identity = SoftwareKey.from_secret(material.identity)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.description}, station {fingerprint(self._identity.point)[:16]})"

    def identity(self) -> PrivateKey:
        """Return the station's identity key."""
        return self._identity

    def ca(self) -> PrivateKey | None:
        """Return the CA key, None if it is kept elsewhere."""
        return None if self._material.ca is None else SoftwareKey.from_secret(self._material.ca)

    def wrap(self, key: bytes, *, context: bytes) -> bytes:
        """Seal a node key under the newest master key, bound to ``context``."""
        return self._material.masters.wrap(key, context=context)

    def unwrap(self, wrapped: bytes, *, context: bytes) -> bytes:
        """Open a wrapped node key; raises VaultError if it is damaged or belongs elsewhere."""
        return self._material.masters.unwrap(wrapped, context=context)

    def export_ca(self, path: Path, passphrase: str) -> None:
        """Write the CA key to ``path`` as an encrypted PKCS #8 PEM; the vault keeps it until :meth:`drop_ca`.

        Raises VaultError: no CA key here, weak passphrase, the file exists or cannot be written.
        """
        if self._material.ca is None:
            raise VaultError(
                "This vault does not contain a CA key.", hint="It was exported and dropped, or never created here."
            )
        ca_file.write_ca(path, self._material.ca, passphrase)

    def drop_ca(self) -> bool:
        """Delete the CA key from the vault; False if there is none. Export it first."""
        self.refresh()
        if self._material.ca is None:
            return False
        self._replace(self._material.with_ca(None))
        return True

    def import_ca(self, path: Path, passphrase: str) -> PrivateKey:
        """Take in the CA key that :meth:`export_ca` wrote, and return it.

        Raises WrongPassphraseError, VaultError (not such a file, or another CA key is here), NotFoundError.
        """
        secret = ca_file.read_ca(path, passphrase)
        self.refresh()
        if self._material.ca not in (None, secret):
            raise VaultError("This vault contains a different CA key.", hint="Export and drop that one first.")
        if self._material.ca is None:
            self._replace(self._material.with_ca(secret))
        return SoftwareKey.from_secret(secret)

    def masters(self) -> tuple[int, ...]:
        """Return the numbers of the master keys, ascending; the last one wraps."""
        return tuple(sorted(self._material.masters.keys))

    def refresh(self) -> bool:
        """Take in changes of other processes without asking; False if there were none.

        Raises VaultChangedError if its passphrase has changed, VaultError if it is gone.
        """
        there = self._load()
        if there == self._material:
            return False
        if there.identity != self._material.identity:
            raise VaultError("The vault holds the keys of another station.", hint="Restore into another --home.")
        self._material = there
        return True

    def reread(self) -> None:
        """Read the master keys again; raises VaultChangedError, VaultError as :meth:`refresh` does."""
        self.refresh()

    def master_keys(self) -> MasterKeys:
        """Return the master keys, for another process of this user that has the vault open."""
        return self._material.masters

    def accept(self, masters: MasterKeys) -> None:
        """Use these master keys from now on, in this process alone."""
        self._material = Material(self._material.identity, self._material.ca, masters)

    def add_master(self) -> None:
        """Add a master key, which wraps from now on; the old ones still unwrap. First step of a change."""
        self.refresh()
        material = self._material
        self._replace(Material(material.identity, material.ca, material.masters.with_new()))

    def retire_masters(self) -> None:
        """Delete all master keys but the newest: the last step of a change, after every key was wrapped again."""
        self.refresh()
        material = self._material
        if len(material.masters.keys) > 1:
            self._replace(Material(material.identity, material.ca, material.masters.newest_only()))

    def secret_material(self) -> str:
        """Return all secrets as one line of text, for a sealed backup. The caller must seal it."""
        return self._material.encode()

    def _replace(self, material: Material) -> None:
        self._save(material)
        self._material = material

    def join(self, restored: str) -> None:
        """Take in what a backup brings (:meth:`secret_material`); raises VaultError if it is of another station."""
        self.refresh()
        joined = merge_keys(self._material, restored)
        if joined != self._material:
            self._replace(joined)

    @abstractmethod
    def _load(self) -> Material:
        """Return the current content.

        Raises VaultChangedError if this vault's passphrase does not open it, VaultError.
        """

    @abstractmethod
    def _save(self, material: Material) -> None:
        """Write ``material`` durably in place of the old one, or raise VaultError and keep the old."""


def merge_keys(existing: Material | None, restored: str | None) -> Material:
    """Return the keys a vault shall hold: what is there, joined with what a backup brings, or new ones.

    Raises VaultError if the backup is of another station than what is there.
    """
    if restored is None:
        return existing or Material.generate()
    material = Material.decode(restored)
    if existing is None:
        return material
    here, there = existing.masters.keys, material.masters.keys
    if existing.identity != material.identity:
        raise VaultError("The vault holds the keys of another station.", hint="Restore into another --home.")
    if any(here[number] != there[number] for number in here.keys() & there):
        raise another_life()
    return Material(existing.identity, existing.ca or material.ca, MasterKeys({**there, **here}))
