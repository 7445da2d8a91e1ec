"""The parts of cryptography that this program uses, each at its first use: commands that only list load none of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from teds_provision.lazy import late

__all__ = [
    "aead",
    "algorithms",
    "ciphers",
    "concatkdf",
    "ec",
    "exceptions",
    "hashes",
    "hkdf",
    "keywrap",
    "modes",
    "serialization",
    "utils",
]

if TYPE_CHECKING:
    from cryptography import exceptions
    from cryptography.hazmat.primitives import ciphers, hashes, keywrap, serialization
    from cryptography.hazmat.primitives.asymmetric import ec, utils
    from cryptography.hazmat.primitives.ciphers import aead, algorithms, modes
    from cryptography.hazmat.primitives.kdf import concatkdf, hkdf
else:
    exceptions = late("cryptography.exceptions")
    ec = late("cryptography.hazmat.primitives.asymmetric.ec")
    utils = late("cryptography.hazmat.primitives.asymmetric.utils")
    ciphers = late("cryptography.hazmat.primitives.ciphers")
    aead = late("cryptography.hazmat.primitives.ciphers.aead")
    algorithms = late("cryptography.hazmat.primitives.ciphers.algorithms")
    modes = late("cryptography.hazmat.primitives.ciphers.modes")
    hashes = late("cryptography.hazmat.primitives.hashes")
    concatkdf = late("cryptography.hazmat.primitives.kdf.concatkdf")
    hkdf = late("cryptography.hazmat.primitives.kdf.hkdf")
    keywrap = late("cryptography.hazmat.primitives.keywrap")
    serialization = late("cryptography.hazmat.primitives.serialization")
