"""What every vault can do: give the station's keys, and wrap node keys under its one master key."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from teds_provision.protocol.keys import PrivateKey

Ask = Callable[[str, bool], str]
"""``ask(prompt, confirm)`` returns a passphrase or PIN; raises where nobody can be asked."""

SERVICE = "teds-provision"


class Vault(Protocol):
    """Where the secrets of one station lie. All methods raise VaultFailure or a leaf below it."""

    @property
    def kind(self) -> str:
        """``keyring``, ``file`` or ``pkcs11``."""

    @property
    def description(self) -> str:
        """What it is, for people: for example the keyring's name or the path of the file."""

    def identity(self) -> PrivateKey:
        """Return the station's identity key."""

    def ca(self) -> PrivateKey | None:
        """Return the CA key, None if it is kept elsewhere."""

    def wrap(self, key: bytes, *, context: bytes) -> bytes:
        """Seal a node key (AES-256-GCM under the master key, bound to ``context``)."""

    def unwrap(self, wrapped: bytes, *, context: bytes) -> bytes:
        """Open what :meth:`wrap` gave, under the same context."""

    def secret_material(self) -> str:
        """Return what a sealed backup has to hold so that this vault can be made again. Whoever calls it seals it."""


def node_key_context(store_id: str, uuid: bytes, epoch: int, slot: int) -> bytes:
    """Return what a wrapped node key is bound to: store, node, epoch (u32) and slot (u32)."""
    identifier = store_id.encode()
    return (
        b"TEDS1 wrapped key\0"
        + len(identifier).to_bytes(2, "big")
        + identifier
        + uuid
        + epoch.to_bytes(4, "big")
        + slot.to_bytes(4, "big")
    )
