"""New passphrases of tests cost little: Argon2id runs at its least costs if the product's were asked for.

A quarter of a second of CPU for each passphrase proves nothing about what the tests hold. It is a change of the tests'
processes (and of the zygote's children), reachable by no option, file or variable; what a file says of its costs is
obeyed. A program that a test starts by an interpreter has the product's costs.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from teds_provision.vault.passphrase import PRODUCT, THROWAWAY, Costs, SealingKey

_derive = SealingKey.derive.__func__  # type: ignore[attr-defined]


def _derive_cheaply(cls: type[SealingKey], passphrase: str, *, costs: Costs, salt: bytes | None = None) -> SealingKey:
    cheap = costs == PRODUCT and salt is None
    derived: SealingKey = _derive(cls, passphrase, costs=THROWAWAY if cheap else costs, salt=salt)
    return derived


def lower_costs() -> None:
    """Run Argon2id at its least costs for each new passphrase of this process."""
    SealingKey.derive = classmethod(_derive_cheaply)  # type: ignore[assignment,method-assign]


@contextmanager
def product_costs() -> Iterator[None]:
    """Have the product's costs again while it lasts."""
    SealingKey.derive = classmethod(_derive)  # type: ignore[method-assign]
    try:
        yield
    finally:
        lower_costs()
