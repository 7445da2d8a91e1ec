"""What a guess may cost: the bounds of Argon2id's costs, which come from a file that is not verified yet."""

from __future__ import annotations

from typing import NoReturn

import pytest
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.kdf import argon2

from teds_provision.errors import VaultError
from teds_provision.vault.passphrase import Costs, SealingKey


@pytest.mark.parametrize(
    ("memory_kib", "iterations", "lanes", "good"),
    [
        (32, 1, 4, True),
        (31, 1, 4, False),  # Argon2 takes 8 KiB a lane
        (8, 1, 1, True),
        (8, 1, 0, False),
        (0, 1, 0, False),
        (128, 1, 16, True),
        (136, 1, 17, False),
        (192 << 10, 1, 4, True),
        ((192 << 10) + 1, 1, 4, False),
        (32, 0, 4, False),
        (32, (2 << 20) // 32, 4, True),
        (32, (2 << 20) // 32 + 1, 4, False),  # memory times passes
    ],
)
def test_costs_are_tried_up_to_their_bounds(memory_kib: int, iterations: int, lanes: int, good: bool) -> None:
    assert Costs(memory_kib, iterations, lanes).bounded() is good


@pytest.mark.parametrize(
    ("failure", "message", "hint"),
    [
        (MemoryError(), "Not enough memory for Argon2id (64 KiB).", ""),
        (
            UnsupportedAlgorithm("argon2"),
            "This Python's OpenSSL has no Argon2id.",
            "Install the wheel of cryptography from PyPI.",
        ),
    ],
    ids=["memory", "algorithm"],
)
def test_a_machine_that_cannot_run_argon2id_is_named_with_its_lack(
    monkeypatch: pytest.MonkeyPatch, failure: Exception, message: str, hint: str
) -> None:
    def fail(**_: object) -> NoReturn:
        raise failure

    monkeypatch.setattr(argon2, "Argon2id", fail)
    with pytest.raises(VaultError) as refused:
        SealingKey.derive("four random words here", costs=Costs(64, 1, 4))
    assert (refused.value.message, refused.value.hint) == (message, hint)
