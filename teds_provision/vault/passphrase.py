"""Sealing under a passphrase: Argon2id (RFC 9106) and AES-256-GCM.

The product's costs are 64 MiB, 3 passes, 4 lanes (RFC 9106 section 4, second recommended option). The sealed object
contains them, so they can grow; when reading they are bounded, so that a forged object cannot exhaust the machine.
"""

from __future__ import annotations

import base64
import binascii
import os
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from teds_provision.errors import VaultError, WrongPassphraseError

MIN_CHARACTERS: Final = 8
MAX_OCTETS: Final = 1024
_SALT_OCTETS: Final = 16
_NONCE_OCTETS: Final = 12
_KEY_OCTETS: Final = 32
_MAX_MEMORY_KIB: Final = 192 * 1024
_MAX_WORK_KIB: Final = 2 << 20  # memory times passes: a few seconds on a small machine
_MAX_LANES: Final = 16


@dataclass(frozen=True)
class Costs:
    """Cost of one guess: memory in KiB, passes over it, lanes."""

    memory_kib: int
    iterations: int
    lanes: int

    def bounded(self) -> bool:
        """Return True if these costs may be tried; they come from a file that is not verified yet."""
        return (
            1 <= self.lanes <= _MAX_LANES
            and 8 * self.lanes <= self.memory_kib <= _MAX_MEMORY_KIB
            and self.iterations >= 1
            and self.memory_kib * self.iterations <= _MAX_WORK_KIB
        )


PRODUCT: Final = Costs(memory_kib=64 * 1024, iterations=3, lanes=4)
THROWAWAY: Final = Costs(memory_kib=32, iterations=1, lanes=4)
"""The least that Argon2id allows: only for a vault whose keys and passphrase are thrown away together."""


@dataclass(frozen=True)
class SealingKey:
    """An AES-256 key derived from a passphrase, with what is needed to derive it again."""

    costs: Costs
    salt: bytes
    key: bytes = field(repr=False)

    @classmethod
    def derive(cls, passphrase: str, *, costs: Costs, salt: bytes | None = None) -> SealingKey:
        """Run Argon2id over the passphrase (NFKC, UTF-8). Raises VaultError if the platform cannot."""
        from cryptography.exceptions import UnsupportedAlgorithm

        salt = os.urandom(_SALT_OCTETS) if salt is None else salt
        try:
            from cryptography.hazmat.primitives.kdf.argon2 import Argon2id

            kdf = Argon2id(
                salt=salt,
                length=_KEY_OCTETS,
                iterations=costs.iterations,
                lanes=costs.lanes,
                memory_cost=costs.memory_kib,
            )
            return cls(costs, salt, kdf.derive(_octets_of(passphrase)))
        except (UnsupportedAlgorithm, ImportError) as error:
            raise VaultError(
                "This Python's OpenSSL has no Argon2id.", hint="Install the wheel of cryptography from PyPI."
            ) from error
        except MemoryError as error:
            raise VaultError(f"Not enough memory for Argon2id ({costs.memory_kib} KiB).") from error

    def seal(self, plaintext: bytes, *, context: bytes) -> dict[str, Any]:
        """Return a JSON object that holds ``plaintext``, sealed and bound to ``context``."""
        from cryptography.hazmat.primitives.ciphers.aead import AESGCM

        nonce = os.urandom(_NONCE_OCTETS)
        return {
            "kdf": "argon2id",
            "memory_kib": self.costs.memory_kib,
            "iterations": self.costs.iterations,
            "lanes": self.costs.lanes,
            "salt": _text(self.salt),
            "cipher": "aes-256-gcm",
            "nonce": _text(nonce),
            "ciphertext": _text(AESGCM(self.key).encrypt(nonce, plaintext, context)),
        }


def seal(passphrase: str, plaintext: bytes, *, context: bytes, costs: Costs = PRODUCT) -> dict[str, Any]:
    """Seal ``plaintext`` under a new passphrase; raises VaultError if the passphrase is too weak to be one."""
    check_new(passphrase)
    return SealingKey.derive(passphrase, costs=costs).seal(plaintext, context=context)


def unseal(passphrase: str, sealed: Mapping[str, Any], *, context: bytes) -> tuple[bytes, SealingKey]:
    """Open a sealed object; return the plaintext and the key, to seal again without asking.

    Raises WrongPassphraseError if the tag is wrong (a wrong passphrase and a changed object cannot be distinguished),
    VaultError if it is not a sealed object.
    """
    costs, salt, _, _ = _parts(sealed)
    key = SealingKey.derive(passphrase, costs=costs, salt=salt)
    opened = _decrypted(key, sealed, context)
    if opened is None:
        raise WrongPassphraseError(
            "Wrong passphrase.",
            hint="Try again, and check the keyboard layout. If it is right, the file was changed: restore a backup.",
        )
    return opened, key


def unseal_with(held: bytes, sealed: Mapping[str, Any], *, context: bytes) -> tuple[bytes, SealingKey] | None:
    """Open as :func:`unseal`, by salt ‖ key (32 octets) instead of the passphrase; return None if the salt differs."""
    costs, salt, _, _ = _parts(sealed)
    key = SealingKey(costs, held[:-_KEY_OCTETS], held[-_KEY_OCTETS:])
    opened = _decrypted(key, sealed, context) if key.salt == salt else None
    return None if opened is None else (opened, key)


def _parts(sealed: Mapping[str, Any]) -> tuple[Costs, bytes, bytes, bytes]:
    """Return costs, salt, nonce and ciphertext of a sealed object; raises VaultError if it is malformed."""
    try:
        known = (sealed["kdf"], sealed["cipher"]) == ("argon2id", "aes-256-gcm")
        costs = Costs(int(sealed["memory_kib"]), int(sealed["iterations"]), int(sealed["lanes"]))
        salt, nonce, ciphertext = (_octets(sealed[name]) for name in ("salt", "nonce", "ciphertext"))
    except (KeyError, TypeError, ValueError, binascii.Error):
        known, costs, salt, nonce, ciphertext = False, PRODUCT, b"", b"", b""
    if not (
        known and costs.bounded() and 8 <= len(salt) <= 64 and len(nonce) == _NONCE_OCTETS and len(ciphertext) > 16
    ):
        raise VaultError("The data encrypted under a passphrase is damaged.", hint="Restore a backup of it.")
    return costs, salt, nonce, ciphertext


def _decrypted(key: SealingKey, sealed: Mapping[str, Any], context: bytes) -> bytes | None:
    from cryptography.exceptions import InvalidTag
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

    _, _, nonce, ciphertext = _parts(sealed)
    try:
        return AESGCM(key.key).decrypt(nonce, ciphertext, context)
    except InvalidTag:
        return None


def check_new(passphrase: str) -> None:
    """Raise VaultError unless this can be a new passphrase: 8 characters to 1024 octets, one line, not one sign."""
    if len(passphrase) < MIN_CHARACTERS:
        raise VaultError(
            f"The passphrase is too short: at least {MIN_CHARACTERS} characters.", hint="Four random words are good."
        )
    if len(set(passphrase)) == 1:
        raise VaultError("The passphrase repeats one character.", hint="Four random words are good.")
    if any(unicodedata.category(character) == "Cc" for character in passphrase):
        raise VaultError("The passphrase holds a control character.", hint="Use letters, digits, signs and spaces.")
    _octets_of(passphrase)


def _octets_of(passphrase: str) -> bytes:
    try:
        octets = unicodedata.normalize("NFKC", passphrase).encode()
    except UnicodeEncodeError:
        raise VaultError("The passphrase is not valid text.", hint="Check the encoding of the terminal.") from None
    if len(octets) > MAX_OCTETS:
        raise VaultError(f"The passphrase is longer than {MAX_OCTETS} octets.")
    return octets


def _text(octets: bytes) -> str:
    return base64.b64encode(octets).decode()


def _octets(text: str) -> bytes:
    octets = base64.b64decode(text, validate=True)
    if _text(octets) != text:  # the unused bits of the last digit are not zero
        raise ValueError
    return octets
