"""Stores of a station's secrets: the OS keyring, a PKCS #11 token, or a passphrase file."""

from typing import TYPE_CHECKING

from teds_provision.lazy import lazy

if TYPE_CHECKING:
    from teds_provision.vault import (
        ca_file,
        file_vault,
        hardening,
        keyring_vault,
        master_socket,
        passphrase,
        pkcs11,
        pkcs11_token,
        pkcs11_uri,
    )
    from teds_provision.vault.base import Ask, Vault, node_key_context
    from teds_provision.vault.selection import asked_first, create_vault, forget_vaults, open_vault
else:
    __getattr__ = lazy(
        __name__,
        {"base": "Ask Vault node_key_context", "selection": "asked_first create_vault forget_vaults open_vault"},
    )

__all__ = ["Ask", "Vault", "asked_first", "create_vault", "forget_vaults", "node_key_context", "open_vault"]
