"""Every fuzz target reads what is kept for it, and some hundred inputs made from that; the rest is ``make fuzz``."""

from __future__ import annotations

import random

import pytest

from tests.fuzz.targets import TARGETS, Target

MUTATED = 120
INTERESTING = (0, 1, 0x7F, 0x80, 0xFF, ord("["), ord("{"), ord('"'), ord("9"), ord("<"))


def mutated(seed: bytes, rng: random.Random) -> bytes:
    """Return the input with a few octets changed, dropped, doubled or cut off."""
    octets = bytearray(seed)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(octets) + 1)
        match rng.randrange(5):
            case 0:
                octets[at : at + 1] = bytes([rng.choice(INTERESTING)])
            case 1:
                del octets[at : at + rng.randint(1, 8)]
            case 2:
                octets[at:at] = octets[at : at + rng.randint(1, 20)]
            case 3:
                octets[at:at] = rng.randbytes(rng.randint(1, 4))
            case _:
                del octets[at:]
    return bytes(octets)


@pytest.mark.parametrize("target", TARGETS.values(), ids=lambda target: target.name)
def test_a_parser_reads_what_is_kept_and_what_is_made_from_it(target: Target) -> None:
    kept = target.kept()
    assert kept
    rng = random.Random(f"seed of {target.name}")
    for octets in [b"", *kept, *(mutated(rng.choice(kept), rng) for _ in range(MUTATED))]:
        target.check(octets)
