"""Processor time of a signed file, in turns in one process: ours, the libraries alone, its bare signature checks."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import Prehashed, encode_dss_signature

from teds_provision.protocol.keys import public_key

ROW: Final = 64
"""Files in a turn: as many as one process of a command checks together."""
PREHASHED: Final = ec.ECDSA(Prehashed(hashes.SHA256()))


@dataclass(frozen=True)
class SignedDigest:
    """One check: the key's point (64 octets), the signature in DER, the SHA-256 of what was signed."""

    point: bytes
    der: bytes
    digest: bytes


@dataclass(frozen=True)
class FileCost:
    """Processor seconds of one file."""

    ours: float
    libraries: float
    checks: float

    @property
    def text(self) -> str:
        """Microseconds, and ratios to the checks."""
        ours, libraries, checks = (1e6 * seconds for seconds in (self.ours, self.libraries, self.checks))
        return (
            f"ours {ours:.0f} µs, libraries alone {libraries:.0f} µs, checks alone {checks:.0f} µs:"
            f" {ours / checks:.2f} × and {libraries / checks:.2f} × the checks"
        )


def signed_digest(point: bytes, message: bytes, signature: bytes) -> SignedDigest:
    """Return the check of a signature of 64 octets, r and s."""
    der = encode_dss_signature(int.from_bytes(signature[:32], "big"), int.from_bytes(signature[32:], "big"))
    return SignedDigest(point, der, hashlib.sha256(message).digest())


def load_key(point: bytes) -> ec.EllipticCurvePublicKey:
    """Load a key by the library, without our cache."""
    return ec.EllipticCurvePublicKey.from_encoded_point(ec.SECP256R1(), point)


def octets_of(path: Path) -> bytes:
    """Read a file of at most 64 KiB by the system's calls."""
    file = os.open(path, os.O_RDONLY)
    try:
        return os.read(file, 1 << 16)
    finally:
        os.close(file)


def cost_of_a_file(
    paths: Sequence[Path],
    *,
    signed: Callable[[Path], list[SignedDigest]],
    ours: Callable[[list[Path]], object],
    libraries: Callable[[list[Path], list[list[SignedDigest]]], object],
    forget: Callable[[], object] = lambda: None,
) -> FileCost:
    """Measure :data:`ROW` files at a time by each of the three; ``forget`` empties ours' caches before its turn."""
    spent = [0.0, 0.0, 0.0]
    for at in range(0, len(paths), ROW):
        row = list(paths[at : at + ROW])
        digests = [signed(path) for path in row]
        public_key.cache_clear()
        forget()
        loaded = [(load_key(check.point), check) for checks in digests for check in checks]
        works: list[Callable[[], object]] = [
            partial(ours, row),
            partial(libraries, row, digests),
            partial(_check, loaded),
        ]
        for place, work in enumerate(works):
            began = time.process_time()
            work()
            spent[place] += time.process_time() - began
    return FileCost(*(seconds / len(paths) for seconds in spent))


def _check(loaded: list[tuple[ec.EllipticCurvePublicKey, SignedDigest]]) -> None:
    for key, check in loaded:
        key.verify(check.der, check.digest, PREHASHED)
