"""A head that a member invents must not turn a thief's datasheet from failed into unproven (plant.md section 1)."""

from __future__ import annotations

import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from teds_provision import plant
from teds_provision.plant.apply_pages import alarm
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.membership import FILES
from teds_provision.plant.sync import acknowledge, sync
from teds_provision.protocol.plant.roster import Role
from tests.plant.stations import Plant


@pytest.mark.parametrize(("role", "unproven"), [("audit", False), ("base", True)])
def test_an_auditors_word_counts_for_nothing_and_a_keeper_knows_its_own_chain(
    tmp_path: Path, role: Role, unproven: bool
) -> None:
    made = Plant(tmp_path)
    thief, witness, south = made.member("thief", "sign"), made.member("witness", role), made.member("south", "base")
    made.round()
    last = made.north.plant.tables.chain(thief.fingerprint).counted[0]
    made.change(plant.owner.draft_removal(made.north, "thief", "stolen", last))
    for station in (made.north, south):
        made.sync(station)
        tables = station.plant.tables
        tables.put_heads(tables.chain(witness.fingerprint).chain, {made.north.fingerprint: (10_000, "ab" * 32)})
        rules = station.plant.signer_rules()
        assert rules is not None
        said = rules.signing(station.ca, thief.point, os.urandom(32))
        assert said is not None
        assert said.result == ("unproven" if unproven and station is south else "failed")
        if said.result == "unproven":
            why = "pages of the keeper north are missing here: witness names page 10000, and the last one here is 0"
            assert said.why == why
    made.close()


def test_a_report_of_pages_that_are_missing_is_shown_until_a_person_has_seen_it(tmp_path: Path) -> None:
    made = Plant(tmp_path)
    witness, south = made.member("witness", "base"), made.member("south", "base")
    made.round()
    tables = south.plant.tables

    def report(n: int) -> None:
        tables.put_heads(tables.chain(witness.fingerprint).chain, {made.north.fingerprint: (n, "ab" * 32)})

    report(10_000)
    said = "witness saw page 10000 of north; the last one here is 0"
    assert said in made.sync(south).told
    assert said in made.sync(south).told
    assert acknowledge(south) == (0, 1)
    assert made.sync(south).told == []
    assert acknowledge(south) == (0, 0)
    report(10_001)
    assert made.sync(south).told == ["witness saw page 10001 of north; the last one here is 0"], "one that is new"
    made.close()


def test_an_alarm_that_was_seen_is_raised_anew_by_one_more_occurrence_and_not_by_a_state_that_lasts(
    tmp_path: Path,
) -> None:
    made = Plant(tmp_path)
    about, tables = made.north.fingerprint, made.north.plant.tables
    for again, left in ((False, []), (True, ["later"])):
        alarm(made.north, "junk", about, 3, "first", again=again)
        assert acknowledge(made.north) == (1, 0)
        alarm(made.north, "junk", about, 3, "later", again=again)
        assert [raised.why for raised in tables.alarms() if not raised.seen] == left
        tables.end_alarms("junk", about)
    made.close()


@pytest.mark.parametrize("days", [0, 2])
def test_the_own_roster_is_never_refused_for_a_clock_that_was_put_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, days: int
) -> None:
    made = Plant(tmp_path)
    made.round()
    past = datetime.now(UTC) - timedelta(days=days)
    monkeypatch.setattr("teds_provision.plant.apply_pages.now", lambda: past)
    assert made.sync(made.north).told == []
    made.close()


def test_a_sync_with_a_stick_at_another_path_is_a_sync(tmp_path: Path) -> None:
    made = Plant(tmp_path)
    other = tmp_path / "the same stick, mounted elsewhere"
    other.mkdir()
    joined = made.north.plant.joined
    assert joined is not None
    made.north.plant.tables.put_plant(replace(joined, url=f"{FILES}{made.stick}"))
    made.north.plant.record_event("named", bytes(10), name="finger")
    sync(made.north, FolderTransport(other), connected=False)
    after = made.north.plant.joined
    assert after is not None
    assert after.synced is not None
    assert made.north.plant.tables.unsent(made.north.fingerprint) == 0
    made.close()
