"""A head that a member invents must not turn a thief's datasheet from failed into unproven (plant.md section 1)."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from teds_provision import plant
from teds_provision.protocol.plant.roster import Role
from tests.plant.stations import Plant


@pytest.mark.parametrize(("role", "unproven"), [("audit", False), ("base", True)])
def test_an_auditors_word_counts_for_nothing_and_a_keeper_knows_its_own_chain(
    tmp_path: Path, role: Role, unproven: bool
) -> None:
    made = Plant(tmp_path)
    thief, witness, south = made.member("thief", "sign"), made.member("witness", role), made.member("south", "base")
    made.round()
    last = made.north.plant.pages.chain(thief.fingerprint).counted[0]
    made.change(plant.owner.draft_removal(made.north, "thief", "stolen", last))
    for station in (made.north, south):
        made.sync(station)
        station.plant.pages.put_heads(
            station.plant.pages.chain(witness.fingerprint).id, {made.north.fingerprint: (10_000, "ab" * 32)}
        )
        rules = station.policy.signer_rules()
        assert rules is not None
        request = rules.signing(station.ca, thief.point, os.urandom(32))
        assert request is not None
        assert request.result == ("unproven" if unproven and station is south else "failed")
        if request.result == "unproven":
            why = "pages of the keeper north are missing here: witness names page 10000, and the last one here is 0"
            assert request.why == why
    made.close()
