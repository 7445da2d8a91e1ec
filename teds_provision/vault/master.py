"""The master key that wraps node keys, and the one secret that a software vault keeps.

A wrapped key is version u8 (1) ‖ number of the master key u32 ‖ nonce (12) ‖ ciphertext and tag (16), AES-256-GCM with
the first five octets and the context as associated data. Numbers let a new master key come in before the old one goes:
add it, wrap every key with it in one transaction of the store, retire the old one.
"""

from __future__ import annotations

import base64
import binascii
import json
import os
from dataclasses import dataclass, field, replace
from typing import Any

from teds_provision.errors import UnknownMasterKeyError, VaultError
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.primitives import aead, exceptions

MASTER_OCTETS = 32
_SECRET_OCTETS = 32
_VERSION = 1
_HEAD_OCTETS = 5
_NONCE_OCTETS = 12
_SEALED_AT = _HEAD_OCTETS + _NONCE_OCTETS
_PREFIX = "teds1:"
_DAMAGED = "Restore a backup of this station (teds-provision restore)."


@dataclass(frozen=True)
class MasterKeys:
    """Numbered master keys; the highest number wraps, all of them unwrap."""

    keys: dict[int, bytes] = field(repr=False)
    _ciphers: dict[int, aead.AESGCM] = field(init=False, default_factory=dict, repr=False, compare=False)

    @classmethod
    def generate(cls) -> MasterKeys:
        """Make the first master key, from the operating system's random source."""
        return cls({1: os.urandom(MASTER_OCTETS)})

    @property
    def current(self) -> int:
        """Number of the key that wraps."""
        return max(self.keys)

    def with_new(self) -> MasterKeys:
        """Return the same keys and a new one, which wraps from now on."""
        return MasterKeys({**self.keys, self.current + 1: os.urandom(MASTER_OCTETS)})

    def newest_only(self) -> MasterKeys:
        """Return only the key that wraps."""
        return MasterKeys({self.current: self.keys[self.current]})

    def wrap(self, key: bytes, *, context: bytes) -> bytes:
        """Seal ``key`` and bind it to ``context``."""
        number = self.current
        head = bytes([_VERSION]) + number.to_bytes(4, "big")
        nonce = os.urandom(_NONCE_OCTETS)
        return head + nonce + self._cipher(number).encrypt(nonce, key, head + context)

    def unwrap(self, wrapped: bytes, *, context: bytes) -> bytes:
        """Open a wrapped key.

        Raises VaultError if it is damaged or moved, UnknownMasterKeyError if of another master key.
        """
        head, nonce, sealed = wrapped[:_HEAD_OCTETS], wrapped[_HEAD_OCTETS:_SEALED_AT], wrapped[_SEALED_AT:]
        if len(sealed) < 16 or head[0] != _VERSION:
            raise VaultError("A wrapped key in the store is damaged.", hint=_DAMAGED)
        number = int.from_bytes(head[1:], "big")
        if number not in self.keys:
            raise UnknownMasterKeyError(
                "A key in the store is wrapped under a master key that the vault lacks.", hint=_DAMAGED
            )
        try:
            return self._cipher(number).decrypt(nonce, sealed, head + context)
        except exceptions.InvalidTag:
            raise VaultError(
                "A wrapped key in the store does not belong to this vault, node, epoch or slot.", hint=_DAMAGED
            ) from None

    def _cipher(self, number: int) -> aead.AESGCM:
        """Return the cipher of one master key, cached because a handover opens ten thousand keys."""
        if number not in self._ciphers:
            self._ciphers[number] = aead.AESGCM(self.keys[number])
        return self._ciphers[number]


@dataclass(frozen=True)
class Material:
    """Everything secret of a station that keeps its keys in software; 32 octets each, never in a repr."""

    identity: bytes = field(repr=False)
    ca: bytes | None = field(repr=False)
    masters: MasterKeys = field(repr=False)

    @classmethod
    def generate(cls) -> Material:
        """Make a station key, a CA key and a master key."""
        return cls(SoftwareKey.generate().secret(), SoftwareKey.generate().secret(), MasterKeys.generate())

    def with_ca(self, secret: bytes | None) -> Material:
        """Return the same with another CA key, or without one."""
        return replace(self, ca=secret)

    def encode(self) -> str:
        """Return one line of ASCII, far below the 1280 characters that every keyring can hold."""
        content: dict[str, Any] = {
            "identity": _text(self.identity),
            "ca": None if self.ca is None else _text(self.ca),
            "masters": {str(number): _text(key) for number, key in self.masters.keys.items()},
        }
        return _PREFIX + _text(json.dumps(content, separators=(",", ":")).encode())

    @classmethod
    def decode(cls, line: str) -> Material:
        """Read what :meth:`encode` gave; raises VaultError, without a word of the content."""
        try:
            if not line.startswith(_PREFIX):
                raise ValueError
            content = json.loads(_octets(line.removeprefix(_PREFIX)))
            masters = {int(number): _octets(key) for number, key in content["masters"].items()}
            ca = None if content["ca"] is None else _octets(content["ca"])
            material = cls(_octets(content["identity"]), ca, MasterKeys(masters))
        except (ValueError, KeyError, TypeError, AttributeError, binascii.Error):
            raise VaultError("The vault contains something other than a station's keys.", hint=_DAMAGED) from None
        secrets = [material.identity, *masters.values(), *([] if ca is None else [ca])]
        if not masters or any(len(secret) != _SECRET_OCTETS for secret in secrets):
            raise VaultError("The station's keys in the vault are damaged.", hint=_DAMAGED)
        return material


def _text(octets: bytes) -> str:
    return base64.b64encode(octets).decode()


def _octets(text: str) -> bytes:
    return base64.b64decode(text, validate=True)


def another_life() -> VaultError:
    """Return the error for two backups of one station that give one number to different master keys."""
    return VaultError(
        "The vault and the backup are of one station, but each has another master key of the same number: "
        "the vault was restored from an older backup, and vault rewrap was run there since.",
        hint="Restore the backup into another --home.",
    )
