"""Fingerprints as users type them: 64 hex digits, or at least the first 32 of them. Imports no cryptography."""

from __future__ import annotations

import re
from typing import Final

DIGITS: Final = 64
LEAST_DIGITS: Final = 32
"""128 bits: too many to find a second key whose fingerprint begins alike."""


def read_fingerprint(text: str) -> str | None:
    """Return the digits in lower case, without blanks, colons, dashes and 0x; None unless there are 32 to 64."""
    digits = re.sub(r"[\s:-]", "", text).lower().removeprefix("0x")
    return digits if re.fullmatch(f"[0-9a-f]{{{LEAST_DIGITS},{DIGITS}}}", digits) else None


def same_key(one: str, other: str) -> bool:
    """Return True if two fingerprints, each whole or its first digits, are of the same key."""
    if len(one) > len(other):
        one, other = other, one
    return len(one) >= LEAST_DIGITS and other.startswith(one)


def is_whole(fingerprint: str | None) -> bool:
    """Return True if all 64 digits are known."""
    return fingerprint is not None and len(fingerprint) == DIGITS
