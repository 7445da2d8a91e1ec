"""The interface of every vault: give the station's keys, and wrap node keys under its master key."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Protocol

from teds_provision.protocol.keys import PrivateKey
from teds_provision.vault.master import MasterKeys

Ask = Callable[[str, bool], str]
"""``ask(prompt, confirm)`` returns a passphrase or PIN; raises if there is no terminal to ask at."""

SERVICE = "teds-provision"
LAST_ATTEMPT = "last attempt before it locks"
"""Part of the prompt for a PIN when one wrong attempt locks the token: only a person may spend that one."""


class Vault(Protocol):
    """Store of one station's secrets. All methods raise VaultError or a leaf below it.

    A change of the vault first rereads its current content and starts from that: the caller holds the store's lock, and
    a copy from before the lock decides nothing. It raises VaultChangedError if the passphrase (or PIN) that opened this
    one is no longer the vault's.
    """

    @property
    def kind(self) -> str:
        """``keyring``, ``file`` or ``pkcs11``."""

    @property
    def description(self) -> str:
        """A description for people: for example the keyring's name or the path of the file."""

    def identity(self) -> PrivateKey:
        """Return the station's identity key."""

    def ca(self) -> PrivateKey | None:
        """Return the CA key, None if it is kept elsewhere."""

    def wrap(self, key: bytes, *, context: bytes) -> bytes:
        """Seal a node key (AES-256-GCM under the master key, bound to ``context``)."""

    def unwrap(self, wrapped: bytes, *, context: bytes) -> bytes:
        """Open what :meth:`wrap` gave, under the same context."""

    def masters(self) -> tuple[int, ...]:
        """Return the numbers of the master keys, ascending; the last one wraps, all of them unwrap."""

    def add_master(self) -> None:
        """Add a master key durably; it wraps from now on. First step of a change."""

    def retire_masters(self) -> None:
        """Delete all master keys but the newest, durably. Last step of a change, after every key was wrapped again."""

    def new_passphrase(self, ask: Ask) -> Callable[[], None]:
        """Ask for another passphrase (or PIN), with no lock held, and return a function that sets it.

        That function writes durably, under the lock. The keys stay. ``ask`` is called for the new one, and before it
        for the old one if the vault needs it. Raises VaultError if another program manages the passphrase.
        """

    def refresh(self) -> bool:
        """Take in changes of other processes without asking; False if there were none."""

    def reread(self) -> None:
        """Read the master keys again with what this process has opened already, for a process that runs for long.

        A token's PIN may be another one by now: an open session does not need it. Raises VaultChangedError if only the
        new passphrase opens the vault.
        """

    def master_keys(self) -> MasterKeys:
        """Return the master keys, for another process of this user that has the vault open."""

    def accept(self, masters: MasterKeys) -> None:
        """Use these master keys from now on, in this process alone: nothing is written."""

    def opener(self) -> bytes:
        """Return the secret that opens this vault without asking, for an agent (``unlock``).

        It is the key of a passphrase file. Empty if only the passphrase or PIN itself would do, or if the vault asks
        for nothing.
        """

    def export_ca(self, path: Path, passphrase: str) -> None:
        """Write the CA key to a new file as an encrypted PKCS #8 PEM; the vault keeps it until :meth:`drop_ca`.

        Raises VaultError: no CA key here, one that cannot leave, a weak passphrase, the file exists.
        """

    def drop_ca(self) -> bool:
        """Delete the CA key from the vault; False if there is none."""

    def import_ca(self, path: Path, passphrase: str) -> PrivateKey:
        """Take in the CA key that :meth:`export_ca` wrote, and return it.

        Raises WrongPassphraseError, NotFoundError, VaultError: not such a file, another CA key is here, none can come
        in.
        """

    def secret_material(self) -> str:
        """Return what a sealed backup needs to recreate this vault. The caller seals it."""


def node_key_context(store_id: str, uuid: bytes, epoch: int, slot: int) -> bytes:
    """Return what a wrapped node key is bound to: store, node, epoch (u32) and slot (u32)."""
    return _of_store(store_id) + uuid + epoch.to_bytes(4, "big") + slot.to_bytes(4, "big")


@lru_cache(maxsize=4)
def _of_store(store_id: str) -> bytes:
    """Return the part of the context that all keys of a store share; there may be ten thousand."""
    identifier = store_id.encode()
    return b"TEDS1 wrapped key\0" + len(identifier).to_bytes(2, "big") + identifier
