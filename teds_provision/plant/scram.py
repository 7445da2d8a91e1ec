"""The login of a station at the registry: a secret that is never sent, and the verifier that PostgreSQL stores.

RFC 5802 and RFC 7677, in the form of ``pg_authid.rolpassword``. The password is 32 random octets in hex, so neither the
number of iterations nor SASLprep matters to its strength.
"""

from __future__ import annotations

import hashlib
import hmac
import re
from base64 import b64encode
from typing import Final

SECRET_OCTETS: Final = 32
_ITERATIONS: Final = 4096  # PostgreSQL's own number; with 256 random bits, more iterations protect nothing
_SALT_LABEL: Final = b"TEDS1 registry salt"
_VERIFIER = re.compile(r"SCRAM-SHA-256\$4096:[A-Za-z0-9+/]{22}==\$[A-Za-z0-9+/]{43}=:[A-Za-z0-9+/]{43}=")


def password(secret: bytes) -> str:
    """Return what libpq is given; only it and the server's challenge see it."""
    return secret.hex()


def verifier(secret: bytes) -> str:
    """Return the SCRAM-SHA-256 verifier of a secret; the same secret gives the same one, so a request can be repeated.

    It is not enough to log in: that takes ClientKey, of which only the hash (StoredKey) is in it.
    """
    salt = hmac.digest(secret, _SALT_LABEL, "sha256")[:16]
    salted = hashlib.pbkdf2_hmac("sha256", password(secret).encode("ascii"), salt, _ITERATIONS)
    stored = hashlib.sha256(hmac.digest(salted, b"Client Key", "sha256")).digest()
    server = hmac.digest(salted, b"Server Key", "sha256")
    salt64, stored64, server64 = (b64encode(octets).decode("ascii") for octets in (salt, stored, server))
    return f"SCRAM-SHA-256${_ITERATIONS}:{salt64}${stored64}:{server64}"


def is_verifier(text: str) -> bool:
    """Return True if a text is a verifier of this form, and nothing that ends a quoted SQL literal."""
    return _VERIFIER.fullmatch(text) is not None
