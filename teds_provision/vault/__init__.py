"""Where a station's secrets lie: the keyring of the operating system, a PKCS #11 token, or a passphrase file."""

from teds_provision.vault.base import Ask, Vault, node_key_context
from teds_provision.vault.choose import create_vault, forget_vaults, open_vault

__all__ = ["Ask", "Vault", "create_vault", "forget_vaults", "node_key_context", "open_vault"]
