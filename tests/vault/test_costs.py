"""What a guess may cost: the bounds of Argon2id's costs, which come from a file that is not verified yet."""

from __future__ import annotations

import pytest

from teds_provision.vault.passphrase import Costs


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
