"""What a person has seen is shown no more; clocks that are wrong, and sticks at other paths (plant.md, "Time")."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from teds_provision import plant
from teds_provision.errors import PolicyError
from teds_provision.plant.apply_pages import alarm, take_rosters
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.membership import FILES
from teds_provision.plant.sync import acknowledge, sync
from tests.plant.stations import Plant, certified, request_of


def test_a_report_of_pages_that_are_missing_is_shown_until_a_person_has_seen_it(tmp_path: Path) -> None:
    made = Plant(tmp_path)
    witness, south = made.member("witness", "base"), made.member("south", "base")
    made.round()

    def report(n: int) -> None:
        south.plant.pages.put_heads(
            south.plant.pages.chain(witness.fingerprint).id, {made.north.fingerprint: (n, "ab" * 32)}
        )

    report(10_000)
    message = "witness saw page 10000 of north; the last one here is 0"
    assert message in made.sync(south).remarks
    assert message in made.sync(south).remarks
    assert acknowledge(south) == (0, 1)
    entry = list(south.audit_log.entries())[-1]
    assert (entry.act, entry.outcome, entry.detail) == ("registry", "seen", {"alarms": 0, "heads": 1})
    assert made.sync(south).remarks == []
    assert acknowledge(south) == (0, 0)
    report(10_001)
    assert made.sync(south).remarks == ["witness saw page 10001 of north; the last one here is 0"], "one that is new"
    made.close()


def test_an_alarm_that_was_seen_is_raised_again_by_one_more_occurrence_and_not_by_a_state_that_lasts(
    tmp_path: Path,
) -> None:
    made = Plant(tmp_path)
    about = made.north.fingerprint
    for again, left in ((False, []), (True, ["later"])):
        alarm(made.north, "junk", about, 3, "first", again=again)
        assert acknowledge(made.north) == (1, 0)
        assert list(made.north.audit_log.entries())[-1].detail == {"alarms": 1, "heads": 0}
        alarm(made.north, "junk", about, 3, "later", again=again)
        assert [raised.why for raised in made.north.plant.alarms.all() if not raised.seen] == left
        made.north.plant.alarms.end_about("junk", about)
    made.close()


@pytest.mark.parametrize("days", [0, 2])
def test_the_own_roster_is_never_refused_for_a_clock_that_was_put_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, days: int
) -> None:
    made = Plant(tmp_path)
    made.round()
    past = datetime.now(UTC) - timedelta(days=days)
    monkeypatch.setattr("teds_provision.plant.apply_pages.now", lambda: past)
    assert made.sync(made.north).remarks == []
    made.close()


def test_a_sync_with_a_stick_at_another_path_is_a_sync(tmp_path: Path) -> None:
    made = Plant(tmp_path)
    other = tmp_path / "the same stick, mounted elsewhere"
    other.mkdir()
    joined = made.north.plant.joined
    assert joined is not None
    made.north.plant.put_record(replace(joined, url=f"{FILES}{made.stick}"))
    made.north.plant.record_event("named", bytes(10), name="finger")
    sync(made.north, FolderTransport(other), connected=False)
    after = made.north.plant.joined
    assert after is not None
    assert after.synced is not None
    assert made.north.plant.unsent() == 0
    made.close()


def test_a_request_and_a_roster_from_the_future_are_not_taken_and_the_message_names_the_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Plant(tmp_path)
    south = certified(tmp_path / "south", "south", made.north)
    ahead = replace(request_of(south), created=datetime.now(UTC) + timedelta(days=2))
    with pytest.raises(PolicyError, match=r"The request of south is dated 20.* in the future"):
        plant.owner.add(made.north, ahead, frozenset({"base"}))
    made.change(plant.owner.add(made.north, request_of(south), frozenset({"base"})))
    made.sync(made.north)
    past = datetime.now(UTC) - timedelta(days=2)
    monkeypatch.setattr("teds_provision.plant.membership.now", lambda: past)
    transport = FolderTransport(made.stick)
    with pytest.raises(PolicyError, match="in the future"):
        plant.membership.found_roster(south, transport, None)
    assert plant.membership.found_roster(made.north, transport, None).version == 2, "its own roster shows the time"
    south.close()
    made.close()


def test_two_rosters_of_a_version_are_an_alarm_until_the_next_version(tmp_path: Path) -> None:
    made = Plant(tmp_path)
    north = made.north
    version = made.roster.version
    for n, left in ((version, [version]), (version - 1, [])):
        alarm(north, "two-rosters", "", n, "two rosters")
        take_rosters(north, [])
        assert [raised.n for raised in north.plant.alarms.all()] == left
        north.plant.alarms.end_about("two-rosters", "")
    made.close()
